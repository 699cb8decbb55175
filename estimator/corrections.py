"""Effects of a joint file as corrections of the estimator's inputs, so that estimators know nothing of effects.

    I       = i - current_a                       true current
    i'      = I - loss_nm / (G Kt)                current without the additional losses
    theta_l' = theta_l - link_rad - twist_rad     link position at which the plain spring carries the same torque

An error of the motor's encoder (`Effect.at_motor_of`: one wave per turn, reading off by -G link_rad) is one of the link's
for the spring, and makes the rotor seem to accelerate by G link_rad omega_m^2 (its part of the true acceleration is
neglected): i' compensates that inertia, + Jm G link_rad omega_m^2 / Kt.

Current and link readings are corrected first; loss and twist see the corrected ones. A loss that depends on the torque
takes the last estimate. Inertias and the gear's damping replace the joint file's (`plain_joint`). Loads and the sensor's
effects do not change the torque at the drive side.

Derivatives of a noisy channel and the deflection that moves a slip pass a first-order filter; it starts at the first
sample, and again after a value that is not finite or a gap.
"""

from __future__ import annotations

from dataclasses import replace
from math import expm1, isfinite, nan, tanh
from typing import Any, Final, NamedTuple

from jtqd.estimator.effects import EFFECTS
from jtqd.estimator.effects.effect import Effect, Functions, ScalarFunctions, State, Values
from jtqd.estimator.joint import Joint
from jtqd.estimator.losses import DIRECTION_VELOCITY_RAD_S
from jtqd.estimator.settings import EstimatorSettings

Pairs = tuple[tuple[Effect, Values], ...]

_INPUT_HOOKS: Final = ("current_a", "link_rad", "twist_rad", "loss_nm")
INVERSE_W0: Final = 1.0 / DIRECTION_VELOCITY_RAD_S


class Smoothed(ScalarFunctions):
    """`ScalarFunctions` whose slip follows the filtered deflection: noise would let the slip creep.

    share: gain of the filter for this step; 1 at a start.
    """

    __slots__ = ("_d", "share")

    def __init__(self) -> None:
        super().__init__()
        self._d = 0.0
        self.share = 1.0

    def slip(self, d: float, travel: float) -> float:
        """Return the state after the filtered deflection moved towards d [rad]."""
        self._d += self.share * (d - self._d)
        return ScalarFunctions.slip(self, self._d, travel)


def acting_effects(joint: Joint) -> Pairs:
    """Return the effects that correct inputs of an estimator of the drive-side torque, with their parameters."""
    pairs = [(EFFECTS[e.name], dict(e.parameters)) for e in joint.effects]
    return tuple(
        (effect, p)
        for effect, p in pairs
        if not effect.changes_joint
        and any(hook in _INPUT_HOOKS for hook in effect.hooks)
        and not effect.at_sensor_of(p)
    )


def plain_joint(joint: Joint) -> Joint:
    """Return the joint without effects, with the parameters that they replace."""
    plain = replace(joint, effects=()) if joint.effects else joint
    for entry in joint.effects:
        effect = EFFECTS[entry.name]
        if effect.changes_joint:
            plain = effect.joint(entry.parameters, plain)
    return plain


def with_effects_applied(joint: Joint) -> Joint:
    """Return the joint with every effect put into the file's values where all its given parameters have a key for it: the
    same joint in other words.

    With an efficiency in the file the losses are the table's: there another friction or torque constant in the file is not
    the effect that bears its name, which is what is lost beside the table. Such an effect stays an effect.
    """
    kept = []
    for item in joint.effects:
        effect = EFFECTS[item.name]
        keys = {p.name: p.key for p in effect.parameters}
        beside_table = joint.efficiency is not None and "loss_nm" in effect.hooks and not effect.changes_joint
        if beside_table or not all(keys[name] for name in item.parameters):
            kept.append(item)
            continue
        for name, value in item.parameters.items():
            joint = _with_value(joint, keys[name], value)
    return replace(joint, effects=tuple(kept))


def _with_value(joint: Joint, key: str, value: float) -> Joint:
    section, _, name = key.rpartition(".")
    changed: dict[str, Any] = {name: value}
    if section:
        return replace(joint, friction=replace(joint.friction, **changed))
    return replace(joint, **changed)


class Hook(NamedTuple):
    """A hook with its parameters and its own functions."""

    call: Any
    p: Values
    x: Functions


def hooks_of(pairs: Pairs, name: str, functions: Any) -> tuple[Hook, ...]:
    """Return the hooks of one name, each with functions of its own."""
    return tuple(Hook(getattr(e, name), p, functions()) for e, p in pairs if name in e.hooks)


class ExtendedInputs:
    """Corrections of one joint's inputs, sample by sample, in one preallocated `State`."""

    def __init__(self, joint: Joint, settings: EstimatorSettings) -> None:
        pairs = acting_effects(joint)
        motor = tuple((effect, p) for effect, p in pairs if effect.at_motor_of(p))
        torsion = None if joint.fused is None else joint.fused.torsion
        self._joint: Final = replace(joint, effects=())
        self._current: Final = hooks_of(pairs, "current_a", ScalarFunctions)
        self._motor: Final = hooks_of(motor, "link_rad", ScalarFunctions)
        self._link: Final = hooks_of(tuple(p for p in pairs if p not in motor), "link_rad", ScalarFunctions)
        self._twist: Final = hooks_of(pairs, "twist_rad", Smoothed)
        self._loss: Final = hooks_of(pairs, "loss_nm", ScalarFunctions)
        self._slips: Final = tuple(hook.x for hook in self._twist)
        self._gear: Final = 1.0 / joint.gear_ratio
        self._inverse_gain: Final = 1.0 / (joint.gear_ratio * joint.torque_constant_nm_per_a)
        # times link_rad omega_m^2: the apparent current of an error of the motor's encoder
        inertia = plain_joint(joint).rotor_inertia_kgm2 * joint.gear_ratio
        self._inertia_a: Final = inertia / joint.torque_constant_nm_per_a
        self._zero: Final = 0.0 if torsion is None else torsion.zero_rad
        self._max_gap: Final = settings.max_gap_s
        self._rate_rad_s: Final = settings.link_bandwidth_rad_s
        self._slip_rad_s: Final = settings.bandwidth_rad_s
        self._state: Final = State(current_rate_a_s=0.0)
        self._rate = self._last_current = 0.0
        self._running = False

    def restart(self) -> None:
        """Restart the filters at the next sample."""
        self._running = False

    def step(  # noqa: PLR0917 - a sample, positional for speed
        self,
        dt_s: float,
        current_a: float,
        motor_position_rad: float,
        motor_velocity_rad_s: float,
        link_position_rad: float,
        temperature_c: float,
        torque_nm: float,
    ) -> tuple[float, float]:
        """Return (i', theta_l'); torque_nm: the last estimate, NaN without one.

        A sample that is not finite is returned unchanged: the estimator refuses it.
        """
        if not isfinite(current_a + motor_position_rad + motor_velocity_rad_s + link_position_rad):
            self._running = False
            return current_a, link_position_rad
        s = self._state
        self._advance(dt_s, current_a)
        s.current_a = current_a
        s.motor_position_rad = motor_position_rad
        s.link_position_rad = link_position_rad
        s.velocity_rad_s = s.link_velocity_rad_s = v = motor_velocity_rad_s * self._gear
        s.direction = tanh(v * INVERSE_W0)
        s.temperature_c = temperature_c
        joint = self._joint
        try:
            for call, p, x in self._current:
                current_a -= call(p, s, joint, x)
            for call, p, x in self._link:
                link_position_rad -= call(p, s, joint, x)
            for call, p, x in self._motor:
                error = call(p, s, joint, x)
                link_position_rad -= error
                current_a += self._inertia_a * error * motor_velocity_rad_s * motor_velocity_rad_s
            s.current_a = current_a
            s.torsion_rad = motor_position_rad * self._gear - link_position_rad - self._zero
            s.torque_nm = torque_nm if isfinite(torque_nm) else current_a / self._inverse_gain
            for call, p, x in self._twist:
                link_position_rad -= call(p, s, joint, x)
            lost = 0.0
            for call, p, x in self._loss:
                lost += call(p, s, joint, x)
        except ValueError:  # the cosine of a multiple of an absurd angle
            return nan, link_position_rad
        return current_a - lost * self._inverse_gain, link_position_rad

    def _advance(self, dt_s: float, current_a: float) -> None:
        """Move the filters by dt_s, or start them at this sample."""
        share = 1.0
        if self._running and 0.0 < dt_s <= self._max_gap:
            slope = (current_a - self._last_current) / dt_s
            self._rate -= expm1(-self._rate_rad_s * dt_s) * (slope - self._rate)
            share = -expm1(-self._slip_rad_s * dt_s)
        else:
            self._rate = 0.0
        self._running = True
        self._last_current = current_a
        self._state.current_rate_a_s = self._rate
        for x in self._slips:
            x.share = share  # type: ignore[attr-defined]
