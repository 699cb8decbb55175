"""Effects of a joint file (`jtqd.estimator.effects`) as the plant's inner loop needs them. Pure.

Each effect acts where `jtqd.estimator.effects.effect` states: losses on the motor side (those that are friction in the
implicit friction), twist on the spring, loads between gear and sensor. What instruments read is in `plant_source`.

A twist that depends on where gear and link stand alone (a kinematic error) bends the gear; any other twist is a
property of the spring and sees the torsion of the bent gear, so that no pair of effects makes energy.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from jtqd.estimator.effects import EFFECTS
from jtqd.estimator.effects.effect import Effect, Functions, ScalarFunctions, State, Values
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.joint import Joint
from jtqd.sim_can.losses import JointFriction

Hook = tuple[Callable[..., Any], Values, Functions]

_PROBES = (0.0, 0.37, 1.9, 4.4)
_PROBE_TORSION_RAD = 1.0e-3
"""Angles [rad] and a torsion at which hooks are called once: to classify them, and to check that they are finite."""


def effects_of(joint: Joint) -> list[tuple[Effect, Values]]:
    """Return the joint's effects of the library, each with its parameters."""
    return [(EFFECTS[entry.name], dict(entry.parameters)) for entry in joint.effects]


def changed_joint(joint: Joint) -> Joint:
    """Return the joint with the values that its effects replace (inertias, damping)."""
    for effect, values in effects_of(joint):
        joint = effect.joint(values, joint)
    return joint


def uses_temperature(joint: Joint) -> bool:
    """Return whether any effect of the joint depends on the temperature, with its parameters."""
    cold, warm = _at(0.4, _PROBE_TORSION_RAD), _at(0.4, _PROBE_TORSION_RAD)
    for state, celsius in ((cold, 20.0), (warm, 40.0)):
        state.temperature_c = celsius
        state.current_rate_a_s = state.torque_rate_nm_s = state.torsion_rate_rad_s = 1.0
    for effect, values in effects_of(joint):
        for name in effect.hooks:
            call = getattr(effect, name)
            if call(values, cold, joint, ScalarFunctions()) != call(values, warm, joint, ScalarFunctions()):
                return True
    return False


def total(hooks: list[Hook], state: State, joint: Joint) -> float:
    """Return the sum of the hooks at this state."""
    value = 0.0
    for call, values, functions in hooks:
        value += call(values, state, joint, functions)
    return value


def _at(position_rad: float, torsion_rad: float = 0.0) -> State:
    """Return a state in which everything that the inner loop knows is a number."""
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
    """Effects of one joint: its hooks by place of action, and the state at which they are evaluated.

    joint: parameters for the hooks: the file's friction, the true stiffness and torque constant.

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
                    self._place(effect, name, call, values).append((call, values, ScalarFunctions()))

    def __bool__(self) -> bool:
        return any((self.friction, self.loss, self.bend, self.spring, self.load))

    def _place(self, effect: Effect, name: str, call: Callable[..., Any], values: Values) -> list[Hook]:
        if name == "load_nm":
            return self.load
        if name == "loss_nm":
            return self.friction if effect.dissipative else self.loss
        by_place = set()
        for place in _PROBES:
            functions = (
                ScalarFunctions()
            )  # the same for both: a hysteresis starts where it is evaluated first
            slack = call(values, _at(place), self.joint, functions)
            if call(values, _at(place, _PROBE_TORSION_RAD), self.joint, functions) != slack:
                return self.spring
            by_place.add(slack)
        return self.bend if len(by_place) > 1 else self.spring

    def _check(self, name: str, call: Callable[..., Any], values: Values) -> None:
        for place in _PROBES:
            value = call(values, _at(place, _PROBE_TORSION_RAD), self.joint, ScalarFunctions())
            if not math.isfinite(value):
                raise ConfigError(
                    f"joint {self.joint.name}: effect {name}: {call.__name__} is {value!r}, expected a finite number: "
                    f"its parameters, or it needs a quantity that the plant's inner loop does not have"
                )

    def bend_rad(self, motor_rad: float, link_rad: float = 0.0) -> float:
        """Return the twist by position alone at this motor angle, rad."""
        self.state.motor_position_rad = motor_rad
        self.state.link_position_rad = link_rad
        return total(self.bend, self.state, self.joint)

    def steepest_bend(self) -> float:
        """Return the largest |d bend/dθm| over two motor turns, times G: part of the gear's own transmission."""
        if not self.bend:
            return 0.0
        e = 1.0e-5
        angles = (4.0 * math.pi * k / 1440.0 for k in range(1440))
        slopes = (abs(self.bend_rad(angle + e) - self.bend_rad(angle - e)) for angle in angles)
        return self.joint.gear_ratio * max(slopes) / (2.0 * e)

    def stiffest_spring(self) -> float:
        """Return the largest slope of the spring's torque over torsion against the stiffness alone, at least 1.

        Over torsions up to three times the rated torque, loaded once from rest.

        Raises:
            ConfigError: the torque falls with torsion before it has reached the rated torque: the joint would run away.
        """
        if not self.spring:
            return 1.0
        fresh: list[Hook] = [(call, values, ScalarFunctions()) for call, values, _ in self.spring]
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
        """Return the magnitude in Nm at transmitted torque and joint velocity (v = 0 counts as forward)."""
        state = self._effects.state
        state.torque_nm = torque_nm
        state.velocity_rad_s = velocity_rad_s
        state.direction = direction = -1.0 if velocity_rad_s < 0.0 else 1.0
        lost = total(self._hooks, state, self._effects.joint)
        force = self._file(torque_nm, velocity_rad_s) + direction * lost
        return force if force > 0.0 else 0.0
