"""What the instruments of a bench with effects read beside the truth: hooks current_a, link_rad, sensor_nm. Pure.

Encoders and current measurement belong to their joint's file. There is one sensor: its effects are those of joint
1's file, and joint 2's only where joint 1's has none.

What reads late reads the past: the rates that a delay is multiplied with are means over the delay itself, so that
truth - d * rate is the truth d ago, between samples by a straight line. An error of the motor's encoder, which
the library expresses as one of the link's (motor_side=1), goes to the motor's.
"""

from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

from estimator.effects.effect import Effect, State, Values
from estimator.effects.functions import Scalar
from estimator.parameters import Joint
from sim_can.effect_plant import EffectPlant
from sim_can.joint_effects import effects_of

Errors = tuple[float, float, float]
"""What motor encoder [rad, motor side], link encoder [rad] and current [A] read above the truth."""


class _Truth(NamedTuple):
    """What reads late, at one time."""

    time_s: float
    currents: tuple[float, float]
    link_rad: float  # of joint 1
    torque_nm: float


def _between(early: _Truth, late: _Truth, time_s: float) -> _Truth:
    share = (time_s - early.time_s) / (late.time_s - early.time_s)

    def mix(a: float, b: float) -> float:
        return a + share * (b - a)

    return _Truth(
        time_s,
        (mix(early.currents[0], late.currents[0]), mix(early.currents[1], late.currents[1])),
        mix(early.link_rad, late.link_rad),
        mix(early.torque_nm, late.torque_nm),
    )


class _Past:
    """Samples of the truth over the last `span_s`; before the first one it was as in the first one."""

    def __init__(self, span_s: float) -> None:
        self._span_s = span_s
        self._samples: deque[_Truth] = deque()

    def add(self, now: _Truth) -> None:
        samples = self._samples
        if samples and now.time_s <= samples[-1].time_s:
            samples.pop()
        samples.append(now)
        while len(samples) > 2 and samples[1].time_s <= now.time_s - self._span_s:
            samples.popleft()

    def ago(self, delay_s: float) -> _Truth:
        """The truth of delay_s ago; 0: of the last sample before this one."""
        samples = self._samples
        if delay_s <= 0.0:
            return samples[-2] if len(samples) > 1 else samples[-1]
        time_s = samples[-1].time_s - delay_s
        if time_s <= samples[0].time_s:
            return samples[0]._replace(time_s=time_s)
        for k in range(len(samples) - 2, -1, -1):
            if samples[k].time_s <= time_s:
                return _between(samples[k], samples[k + 1], time_s)
        raise AssertionError("the first sample is earlier")


class _Reading:
    """One hook of one effect, with a state of its own: its rates are over its own delay."""

    def __init__(self, effect: Effect, name: str, values: Values, joint: Joint, number: int) -> None:
        self._call: Callable[..., Any] = getattr(effect, name)
        self._values = values
        self.joint = joint
        self._number = number
        self._functions = Scalar()
        self.state = State()
        self.delay_s = abs(values.get("delay_s", 0.0))
        self.at_motor = name == "link_rad" and effect.at_motor_of(values)

    def see(self, plant: EffectPlant, truth: _Truth, past: _Past) -> None:
        """The truth as this joint sees it, in its own frame."""
        number, state = self._number, self.state
        sign = -1.0 if number else 1.0
        seen = plant.effects[number].state
        for name in ("direction", "velocity_rad_s", "motor_position_rad", "torsion_rad", "torque_nm"):
            setattr(state, name, getattr(seen, name))
        state.motor_acceleration_rad_s2 = seen.motor_acceleration_rad_s2
        state.link_acceleration_rad_s2 = seen.link_acceleration_rad_s2
        state.temperature_c, state.time_s = seen.temperature_c, seen.time_s
        state.current_a = truth.currents[number]
        state.link_position_rad, state.coupling_position_rad = sign * truth.link_rad, truth.link_rad
        before = past.ago(self.delay_s)
        span_s = truth.time_s - before.time_s
        if span_s > 0.0:
            state.current_rate_a_s = (truth.currents[number] - before.currents[number]) / span_s
            state.torque_rate_nm_s = (truth.torque_nm - before.torque_nm) / span_s
            state.link_velocity_rad_s = sign * (truth.link_rad - before.link_rad) / span_s
        else:
            state.current_rate_a_s = state.torque_rate_nm_s = 0.0
            state.link_velocity_rad_s = sign * plant.link_velocity

    def error(self) -> float:
        """The hook at the state."""
        return float(self._call(self._values, self.state, self.joint, self._functions))


class Readings:
    """Errors of all instruments of one bench; `read` once per sample, after the plant's step."""

    def __init__(self, plant: EffectPlant) -> None:
        self._plant = plant
        sides = [side.true_joint for side in plant.parameters.joints]
        found = [(k, *entry) for k, joint in enumerate(sides) for entry in effects_of(joint)]
        first = next((k for k, effect, values in found if effect.at_sensor_of(values)), 0)
        self._current: list[list[_Reading]] = [[], []]
        self._position: list[list[_Reading]] = [[], []]
        self._sensor: list[_Reading] = []
        for k, effect, values in found:
            for name, readings in (
                ("current_a", self._current[k]),
                ("link_rad", self._position[k]),
                ("sensor_nm", self._sensor if k == first else []),
            ):
                if name in effect.hooks:
                    readings.append(_Reading(effect, name, values, sides[k], k))
        self._all = [
            *self._current[0],
            *self._current[1],
            *self._position[0],
            *self._position[1],
            *self._sensor,
        ]
        self._past = _Past(max((reading.delay_s for reading in self._all), default=0.0))
        self._time_s = 0.0

    def read(self, torque_nm: float, dt_s: float) -> tuple[tuple[Errors, Errors], float]:
        """Errors of both joints' instruments, and what the sensor reads where torque_nm is the truth.

        dt_s: time since the last call.
        """
        self._time_s += dt_s
        plant = self._plant
        one, two = plant.drives
        truth = _Truth(self._time_s, (one.current_a, two.current_a), plant.link_position, torque_nm)
        self._past.add(truth)
        for reading in self._all:
            reading.see(plant, truth, self._past)
        return (self._of_joint(0), self._of_joint(1)), self._of_sensor(torque_nm)

    def _of_joint(self, k: int) -> Errors:
        motor = link = current = 0.0
        for reading in self._current[k]:
            current += reading.error()
        for reading in self._position[k]:
            if reading.at_motor:
                motor -= reading.joint.gear_ratio * reading.error()
            else:
                link += reading.error()
        return motor, link, current

    def _of_sensor(self, truth_nm: float) -> float:
        """The hooks use what the sensor reads, which is what is wanted; they are linear in it: a secant is exact."""
        if not self._sensor:
            return truth_nm
        low, high = (self._sensor_errors(truth_nm + more) for more in (0.0, 1.0))
        return truth_nm + low / (1.0 - (high - low))

    def _sensor_errors(self, reading_nm: float) -> float:
        error = 0.0
        for reading in self._sensor:
            reading.state.torque_nm = reading_nm
            error += reading.error()
        return error
