"""Transmission losses of one joint as the plant needs them: friction magnitude over transmitted torque and
velocity. Pure.
"""

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

# Table I holds for 0.2 to 3 rad/s and up to 5 A. Below 0.2 rad/s an estimator's loss law may be smoothed
# through zero velocity; a real joint sticks there. So the table is taken from 0.2 rad/s on and continued
# below as a straight line.
LOWEST_TABLE_VELOCITY_RAD_S = 0.2
VELOCITY_STEP_RAD_S = 0.1
HIGHEST_TABLE_VELOCITY_RAD_S = 3.6
TORQUE_STEPS = 400

FloatArray = npt.NDArray[np.float64]
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
        self._torque_limit = nm_per_a * highest_current_a
        self._per_torque_step = TORQUE_STEPS / (2.0 * self._torque_limit)
        self._per_velocity_step = 1.0 / VELOCITY_STEP_RAD_S
        self._last_row = round(HIGHEST_TABLE_VELOCITY_RAD_S / VELOCITY_STEP_RAD_S) - 1
        grid = np.linspace(-self._torque_limit, self._torque_limit, TORQUE_STEPS + 1)
        self._forward = self._rows(loss, nm_per_a, grid, highest_current_a, +1.0)
        self._reverse = self._rows(loss, nm_per_a, grid, highest_current_a, -1.0)

    @staticmethod
    def _rows(
        loss: VectorLoss, nm_per_a: float, grid: FloatArray, highest: float, sign: float
    ) -> list[list[float]]:
        """Rows by velocity k * 0.1 rad/s, columns by torque; magnitudes of the loss for one direction of
        motion.
        """
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
        """F(τ, v) in Nm, never negative; the sign of v selects the direction (v = 0 counts as forward)."""
        rows = self._forward
        if velocity_rad_s < 0.0:
            rows = self._reverse
            velocity_rad_s = -velocity_rad_s
        x = velocity_rad_s * self._per_velocity_step
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
        return low_value + (x - k) * (high[m] + y * (high[m + 1] - high[m]) - low_value)


class JointFriction:
    """Friction magnitude of one true joint: scaled loss table, additional viscous part and Stribeck peak.

    F(τ, v) = scale * table(τ, v) + c |v| + Fs exp(-(v / vs)²). The Stribeck term is below 1e-6 Fs at 0.2
    rad/s for vs <= 0.05 rad/s.
    """

    __slots__ = ("_inverse_vs", "_magnitude", "_reach", "_scale", "_stribeck", "_viscous")

    def __init__(
        self,
        table: LossTable,
        scale: float = 1.0,
        viscous_nms_per_rad: float = 0.0,
        stribeck_nm: float = 0.0,
        stribeck_velocity_rad_s: float = 0.05,
    ) -> None:
        self._magnitude = table.magnitude
        self._scale = scale
        self._viscous = viscous_nms_per_rad
        self._stribeck = stribeck_nm
        self._inverse_vs = 1.0 / stribeck_velocity_rad_s
        self._reach = 4.0 * stribeck_velocity_rad_s if stribeck_nm > 0.0 else -1.0

    def __call__(self, torque_nm: float, velocity_rad_s: float) -> float:
        """Magnitude in Nm at transmitted torque τ and joint velocity v (its sign gives the direction)."""
        force = self._scale * self._magnitude(torque_nm, velocity_rad_s)
        speed = velocity_rad_s if velocity_rad_s >= 0.0 else -velocity_rad_s
        force += self._viscous * speed
        if speed < self._reach:
            x = speed * self._inverse_vs
            force += self._stribeck * math.exp(-x * x)
        return force if force > 0.0 else 0.0
