"""Transmission losses of a true joint: friction magnitude over transmitted torque and velocity.

A gear's losses depend on what it transmits, F(τ, v), not on the motor's current: `LossTable` turns the joint file's law of
current and velocity into a table of that, `JointFriction` adds what the true joint differs from its file. Pure.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from jtqd.estimator.arrays import FloatArray

LOWEST_TABLE_VELOCITY_RAD_S = 0.2
"""Table I holds for 0.2 to 3 rad/s and up to 5 A. Below 0.2 rad/s an estimator's loss law may be smoothed through zero
velocity; a real joint sticks there. So the table is taken from 0.2 rad/s on and continued below as a straight line.
"""
VELOCITY_STEP_RAD_S = 0.1
HIGHEST_TABLE_VELOCITY_RAD_S = 3.6
TORQUE_STEPS = 400

VectorLoss = Callable[[FloatArray, FloatArray], FloatArray]


class LossTable:
    """F(τ, v) >= 0 [Nm]: loss of a joint that transmits τ at joint velocity v, by bilinear interpolation.

    A law given over current (Table I: τ = η(i, v) G Kt i) is inverted once: at constant velocity the motor
    must carry both, so G Kt i = τ + loss(i, v) for every i; where i moves, (τ, loss) is a curve, and this
    table holds its points. Friction then depends on what the gear transmits, not on the motor current: the
    same at standstill of the motor's inertia term, different when the rotor accelerates (τ, not i, loads the
    teeth). In steady state both are the same and η is Table I's.

    Args:
        loss: loss(currents [A], joint velocities [rad/s]) -> Nm, arrays of one shape, signed like the
        velocity.
        gear_ratio: G. torque_constant_nm_per_a: Kt of the law (the nominal one, also where the plant's true
        Kt deviates).
        highest_current_a: the law is tabulated for |i| up to this; beyond, the loss stays what it is there.
    """

    def __init__(
        self,
        loss: VectorLoss,
        gear_ratio: float,
        torque_constant_nm_per_a: float,
        highest_current_a: float,
    ) -> None:
        nm_per_a = gear_ratio * torque_constant_nm_per_a
        self.torque_limit = nm_per_a * highest_current_a
        self.per_torque_step = TORQUE_STEPS / (2.0 * self.torque_limit)
        self.per_velocity_step = 1.0 / VELOCITY_STEP_RAD_S
        self.last_row = round(HIGHEST_TABLE_VELOCITY_RAD_S / VELOCITY_STEP_RAD_S) - 1
        grid = np.linspace(-self.torque_limit, self.torque_limit, TORQUE_STEPS + 1)
        self.forward = self._rows(loss, nm_per_a, grid, highest_current_a, +1.0)
        self.reverse = self._rows(loss, nm_per_a, grid, highest_current_a, -1.0)

    @staticmethod
    def _rows(
        loss: VectorLoss, nm_per_a: float, grid: FloatArray, highest: float, sign: float
    ) -> list[list[float]]:
        """Return magnitudes of the loss for one direction of motion: rows by velocity k * 0.1 rad/s, columns by torque."""
        count = round(HIGHEST_TABLE_VELOCITY_RAD_S / VELOCITY_STEP_RAD_S) + 1
        first = round(LOWEST_TABLE_VELOCITY_RAD_S / VELOCITY_STEP_RAD_S)
        # three times the range in current, so that the curve covers the torque grid where η is small, too
        currents = np.linspace(-3.0 * highest, 3.0 * highest, 6 * TORQUE_STEPS + 1)
        clipped = np.clip(currents, -highest, highest)
        rows = np.empty((count, len(grid)))
        for k in range(first, count):
            values = loss(clipped, np.full_like(clipped, sign * k * VELOCITY_STEP_RAD_S))
            # A law may bend back where it is extrapolated; the inverse needs a rising curve.
            torque = np.maximum.accumulate(nm_per_a * currents - values)
            rows[k] = np.maximum(sign * np.interp(grid, torque, values), 0.0)
        for k in range(first):
            rows[k] = np.maximum(rows[first] - (first - k) * (rows[first + 1] - rows[first]), 0.0)
        return [[float(x) for x in row] for row in rows]

    def magnitude(self, torque_nm: float, velocity_rad_s: float) -> float:
        """Return F(τ, v) in Nm, never negative; the sign of v selects the direction (v = 0 counts as forward).

        The plain form of what `JointFriction` does fast. Beyond its range the table keeps its outermost values.
        """
        rows = self.reverse if velocity_rad_s < 0.0 else self.forward
        x = min(abs(velocity_rad_s) * self.per_velocity_step, self.last_row + 1.0)
        y = min(max((torque_nm + self.torque_limit) * self.per_torque_step, 0.0), TORQUE_STEPS - 1e-9)
        k, m = min(int(x), self.last_row), int(y)
        low, high = (row[m] + (y - m) * (row[m + 1] - row[m]) for row in rows[k : k + 2])
        return low + (x - k) * (high - low)


class JointFriction:
    """Friction magnitude of one true joint: scaled loss table, constant and viscous parts, Stribeck peak.

    F(τ, v) = scale * table(τ, v) + c0 + c1 |v| + Fs exp(-(v / vs)²), never below zero. c0 and c1 are what the
    joint's Coulomb and viscous friction differ from its file's (`differ`), with temperature and from day to
    day. The Stribeck term is below 1e-6 Fs at 0.2 rad/s for vs <= 0.05 rad/s.
    """

    __slots__ = (
        "_constant",
        "_forward",
        "_inverse_vs",
        "_last_row",
        "_per_torque_step",
        "_per_velocity_step",
        "_reach",
        "_reverse",
        "_scale",
        "_stribeck",
        "_torque_limit",
        "_viscous",
    )

    def __init__(
        self,
        table: LossTable,
        scale: float = 1.0,
        viscous_nms_per_rad: float = 0.0,
        stribeck_nm: float = 0.0,
        stribeck_velocity_rad_s: float = 0.05,
    ) -> None:
        self._forward, self._reverse = table.forward, table.reverse
        self._last_row = table.last_row
        self._torque_limit = table.torque_limit
        self._per_torque_step, self._per_velocity_step = table.per_torque_step, table.per_velocity_step
        self._scale = scale
        self._stribeck = stribeck_nm
        self._inverse_vs = 1.0 / stribeck_velocity_rad_s
        self._reach = 4.0 * stribeck_velocity_rad_s if stribeck_nm > 0.0 else -1.0
        self.differ(0.0, viscous_nms_per_rad)

    def differ(self, constant_nm: float, viscous_nms_per_rad: float) -> None:
        """Set how much more (or less) Coulomb and viscous friction there is than in the table."""
        self._constant = constant_nm
        self._viscous = viscous_nms_per_rad

    def __call__(self, torque_nm: float, velocity_rad_s: float) -> float:
        """Return the magnitude in Nm at transmitted torque τ and joint velocity v (its sign gives the direction).

        Called 16 times per millisecond: `LossTable.magnitude` is written out here, without calls.
        """
        rows = self._forward
        speed = velocity_rad_s
        if velocity_rad_s < 0.0:
            rows = self._reverse
            speed = -velocity_rad_s
        x = speed * self._per_velocity_step
        k = int(x)
        if k > self._last_row:
            k = self._last_row
            x = k + 1.0
        y = (torque_nm + self._torque_limit) * self._per_torque_step
        if y < 0.0:
            y = 0.0
        elif y >= TORQUE_STEPS:
            y = TORQUE_STEPS - 1e-9
        m = int(y)
        y -= m
        low = rows[k]
        high = rows[k + 1]
        low_value = low[m] + y * (low[m + 1] - low[m])
        table = low_value + (x - k) * (high[m] + y * (high[m + 1] - high[m]) - low_value)
        force = self._scale * table + self._viscous * speed + self._constant
        if speed < self._reach:
            x = speed * self._inverse_vs
            force += self._stribeck * math.exp(-x * x)
        return force if force > 0.0 else 0.0
