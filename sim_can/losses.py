"""The effects of a joint file (`jtqd.estimator.effects`) as the plant's inner loop needs them. Pure.

Each effect goes where effect.py says: losses on the motor side, those that are friction into the implicit friction,
twist on the spring, loads between gear and sensor. What instruments read is in `jtqd.sim_can.plant_source`.

A twist that depends on where gear and link stand alone (a kinematic error) bends the gear; any other twist is a
property of the spring and sees the torsion of the bent gear, so that no pair of effects makes energy.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.checked import ConfigError
from jtqd.estimator.effects.effect import Effect, Functions, State, Values
from jtqd.estimator.effects.functions import Scalar
from jtqd.estimator.effects.library import EFFECTS
from jtqd.estimator.joint import Joint

# Transmission losses of one joint as the plant needs them: friction magnitude over transmitted torque and
# velocity. Pure.


# Table I holds for 0.2 to 3 rad/s and up to 5 A. Below 0.2 rad/s an estimator's loss law may be smoothed
# through zero velocity; a real joint sticks there. So the table is taken from 0.2 rad/s on and continued
# below as a straight line.
LOWEST_TABLE_VELOCITY_RAD_S = 0.2
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
        rows = self.forward
        if velocity_rad_s < 0.0:
            rows = self.reverse
            velocity_rad_s = -velocity_rad_s
        x = velocity_rad_s * self.per_velocity_step
        k = int(x)
        if k > self.last_row:
            k = self.last_row
            x = k + 1.0
        y = (torque_nm + self.torque_limit) * self.per_torque_step
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
        """From now on so much Coulomb and viscous friction more (or less) than in the table."""
        self._constant = constant_nm
        self._viscous = viscous_nms_per_rad

    def __call__(self, torque_nm: float, velocity_rad_s: float) -> float:
        """Magnitude in Nm at transmitted torque τ and joint velocity v (its sign gives the direction).

        Called 16 times per millisecond: `LossTable.magnitude` is written out here.
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


Hook = tuple[Callable[..., Any], Values, Functions]

# A few angles and torsions, to tell hooks apart and to see that they know all they need.
_PROBES = (0.0, 0.37, 1.9, 4.4)
_PROBE_TORSION_RAD = 1.0e-3


def effects_of(joint: Joint) -> list[tuple[Effect, Values]]:
    """The joint's effects of the library with all their parameters."""
    return [(EFFECTS[entry.name], dict(entry.parameters)) for entry in joint.effects]


def changed_joint(joint: Joint) -> Joint:
    """The joint with the values that its effects replace (inertias)."""
    for effect, values in effects_of(joint):
        joint = effect.joint(values, joint)
    return joint


def uses_temperature(joint: Joint) -> bool:
    """Whether any effect of the joint depends on the temperature, with its parameters."""
    cold, warm = _at(0.4, _PROBE_TORSION_RAD), _at(0.4, _PROBE_TORSION_RAD)
    for state, celsius in ((cold, 20.0), (warm, 40.0)):
        state.temperature_c = celsius
        state.current_rate_a_s = state.torque_rate_nm_s = 1.0
    for effect, values in effects_of(joint):
        for name in effect.hooks:
            call = getattr(effect, name)
            if call(values, cold, joint, Scalar()) != call(values, warm, joint, Scalar()):
                return True
    return False


def total(hooks: list[Hook], state: State, joint: Joint) -> float:
    """Sum of the hooks at this state."""
    value = 0.0
    for call, values, functions in hooks:
        value += call(values, state, joint, functions)
    return value


def _at(position_rad: float, torsion_rad: float = 0.0) -> State:
    """A state in which everything that the inner loop knows is a number."""
    return State(
        current_a=1.0,
        velocity_rad_s=0.5,
        direction=1.0,
        motor_position_rad=position_rad,
        motor_acceleration_rad_s2=0.0,
        link_position_rad=0.1,
        link_velocity_rad_s=0.5,
        link_acceleration_rad_s2=0.0,
        coupling_position_rad=0.1,
        torque_nm=1.0,
        torsion_rad=torsion_rad,
        temperature_c=30.0,
        time_s=1.0,
    )


class JointEffects:
    """Effects of one joint: lists of hooks, and the state which they are asked at.

    joint: what the hooks measure themselves against: the file's friction, the true stiffness and torque constant.

    Raises:
        ConfigError: a hook that is not finite, or needs what the inner loop does not know.
    """

    __slots__ = ("bend", "friction", "joint", "load", "loss", "spring", "state")

    def __init__(self, joint: Joint) -> None:
        self.joint = joint
        self.state = _at(0.0)
        self.friction: list[Hook] = []  # losses that oppose the velocity
        self.loss: list[Hook] = []  # other losses
        self.bend: list[Hook] = []  # twist by position alone
        self.spring: list[Hook] = []  # twist by torsion
        self.load: list[Hook] = []
        for effect, values in effects_of(joint):
            if effect.changes_joint:
                continue
            for name in ("loss_nm", "twist_rad", "load_nm"):
                if name in effect.hooks:
                    call = getattr(effect, name)
                    self._check(effect.name, call, values)
                    self._place(effect, name, call, values).append((call, values, Scalar()))

    def __bool__(self) -> bool:
        return any((self.friction, self.loss, self.bend, self.spring, self.load))

    def _place(self, effect: Effect, name: str, call: Callable[..., Any], values: Values) -> list[Hook]:
        if name == "load_nm":
            return self.load
        if name == "loss_nm":
            return self.friction if effect.dissipative else self.loss
        by_place = set()
        for place in _PROBES:
            functions = Scalar()  # the same for both: a hysteresis begins where it is asked first
            slack = call(values, _at(place), self.joint, functions)
            if call(values, _at(place, _PROBE_TORSION_RAD), self.joint, functions) != slack:
                return self.spring
            by_place.add(slack)
        return self.bend if len(by_place) > 1 else self.spring

    def _check(self, name: str, call: Callable[..., Any], values: Values) -> None:
        for place in _PROBES:
            value = call(values, _at(place, _PROBE_TORSION_RAD), self.joint, Scalar())
            if not math.isfinite(value):
                raise ConfigError(
                    f"joint {self.joint.name}: effect {name}: {call.__name__} is {value!r}, expected a finite number: "
                    f"its parameters, or it needs what the plant's inner loop does not know"
                )

    def bend_rad(self, motor_rad: float, link_rad: float = 0.0) -> float:
        """Twist by position alone at this motor angle, rad."""
        self.state.motor_position_rad = motor_rad
        self.state.link_position_rad = link_rad
        return total(self.bend, self.state, self.joint)

    def steepest_bend(self) -> float:
        """Largest |d bend/dθm| over two motor turns, times G: part of the gear's own transmission."""
        if not self.bend:
            return 0.0
        e = 1.0e-5
        angles = (4.0 * math.pi * k / 1440.0 for k in range(1440))
        slopes = (abs(self.bend_rad(angle + e) - self.bend_rad(angle - e)) for angle in angles)
        return self.joint.gear_ratio * max(slopes) / (2.0 * e)

    def stiffest_spring(self) -> float:
        """Largest slope of the spring's torque over torsion against the stiffness alone, at least 1.

        Over torsions up to three times the rated torque, loaded once from rest.

        Raises:
            ConfigError: the torque falls with torsion before it has reached the rated torque: the joint would run away.
        """
        if not self.spring:
            return 1.0
        fresh: list[Hook] = [(call, values, Scalar()) for call, values, _ in self.spring]
        rated = self.joint.rated_torque_nm / self.joint.stiffness_nm_per_rad
        grid = [0.0] + [3.0 * rated * 10.0 ** (-(400 - k) / 64.0) for k in range(401)]
        largest, before, at = 1.0, 0.0, 0.0
        for torsion in grid:
            if before > 3.0 * rated:
                break
            whole = torsion + total(fresh, _at(0.0, torsion), self.joint)
            if whole < before < rated:
                raise ConfigError(
                    f"joint {self.joint.name}: effects: the torque falls with torsion from {at:.2g} rad on, "
                    f"expected it to rise up to rated_torque_nm ({self.joint.rated_torque_nm:g} Nm)"
                )
            if torsion > 0.0:
                largest = max(largest, (whole - before) / (torsion - at))
            before, at = whole, torsion
        return largest


class EffectFriction:
    """Friction of a joint with effects: that of its file and its dissipative effects, never below zero.

    Called like `JointFriction`; the effects see the direction that the joint would move in.
    """

    __slots__ = ("_effects", "_file", "_hooks")

    def __init__(self, file: JointFriction, effects: JointEffects) -> None:
        self._file = file
        self._effects = effects
        self._hooks = effects.friction

    def __call__(self, torque_nm: float, velocity_rad_s: float) -> float:
        """Magnitude in Nm at transmitted torque and joint velocity (v = 0 counts as forward)."""
        state = self._effects.state
        state.torque_nm = torque_nm
        state.velocity_rad_s = velocity_rad_s
        state.direction = direction = -1.0 if velocity_rad_s < 0.0 else 1.0
        lost = total(self._hooks, state, self._effects.joint)
        force = self._file(torque_nm, velocity_rad_s) + direction * lost
        return force if force > 0.0 else 0.0
