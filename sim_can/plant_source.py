"""Sources of the bench's measurements from plants: one pair of joints, and any number of joints side by side.

Each pair is a plant of its own. A last joint without a partner turns a passive load: the second joint of its pair, without
current and without a node on the bus.
"""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from jtqd.estimator.effects.effect import Effect, ScalarFunctions, State, Values
from jtqd.estimator.joint import Joint
from jtqd.sim_can.effect_plant import EffectPlant
from jtqd.sim_can.instruments import Instruments
from jtqd.sim_can.joint_effects import effects_of
from jtqd.sim_can.plant import Plant
from jtqd.sim_can.plant_file import JointPlant, PlantParameters
from jtqd.sim_can.plants import AnyDay, AnyPlant
from jtqd.sim_can.signals import Noise
from jtqd.sim_can.source import OFF, ChannelSignal, DriveRatings, DriveSignals, Source
from jtqd.sim_can.towing.bench_file import TowedJoint, TowingBench
from jtqd.sim_can.towing.instruments import Instruments as TowingInstruments
from jtqd.sim_can.towing.plant import TowingPlant

Errors = tuple[float, float, float]
"""What motor encoder [rad, motor side], link encoder [rad] and current [A] read above the truth."""


class _Truth(NamedTuple):
    """True values of the quantities that a channel delay acts on, at one time."""

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
        """Return the truth of delay_s ago, between samples by a straight line; 0: of the last sample before this one."""
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
    """One hook of one effect, with a state of its own.

    Its rates are means over its own delay d, so that truth - d * rate is the truth d ago.
    """

    def __init__(self, effect: Effect, name: str, values: Values, joint: Joint, number: int) -> None:
        self._call: Callable[..., Any] = getattr(effect, name)
        self._values = values
        self.joint = joint
        self._number = number
        self._functions = ScalarFunctions()
        self.state = State()
        self.delay_s = abs(values.get("delay_s", 0.0))
        self.at_motor = name == "link_rad" and effect.at_motor_of(values)

    def update(self, plant: EffectPlant, truth: _Truth, past: _Past) -> None:
        """Set the hook's state to the truth in this joint's own frame."""
        number, state = self._number, self.state
        sign = -1.0 if number else 1.0
        inner = plant.effects[number].state
        for name in ("direction", "velocity_rad_s", "motor_position_rad", "torsion_rad", "torque_nm"):
            setattr(state, name, getattr(inner, name))
        state.motor_acceleration_rad_s2 = inner.motor_acceleration_rad_s2
        state.link_acceleration_rad_s2 = inner.link_acceleration_rad_s2
        state.temperature_c, state.time_s = inner.temperature_c, inner.time_s
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
        """Return the hook's value at the state."""
        return float(self._call(self._values, self.state, self.joint, self._functions))


class Readings:
    """Errors by effects of all instruments of one bench; `read` once per sample, after the plant's step.

    An error of the motor's encoder, which the library expresses as one of the link's (motor_side=1), is the motor's here.
    """

    def __init__(self, plant: EffectPlant) -> None:
        self._plant = plant
        sides = [side.true_joint for side in plant.parameters.joints]
        entries = [(k, *entry) for k, joint in enumerate(sides) for entry in effects_of(joint)]
        first = next((k for k, effect, values in entries if effect.at_sensor_of(values)), 0)
        self._current: list[list[_Reading]] = [[], []]
        self._position: list[list[_Reading]] = [[], []]
        self._sensor: list[_Reading] = []
        for k, effect, values in entries:
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
        """Return the errors of both joints' instruments, and what the sensor reads where torque_nm is the truth.

        dt_s: time since the last call.
        """
        self._time_s += dt_s
        plant = self._plant
        one, two = plant.drives
        truth = _Truth(self._time_s, (one.current_a, two.current_a), plant.link_position, torque_nm)
        self._past.add(truth)
        for reading in self._all:
            reading.update(plant, truth, self._past)
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
        """Return what the sensor reads. Its hooks depend on just that, linearly: a secant is exact."""
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


def ratings_of(side: JointPlant | TowedJoint) -> DriveRatings:
    """Return the ratings in the drive's own objects: nominal values, as a drive knows no others."""
    return DriveRatings(
        gear_ratio=side.joint.gear_ratio,
        rated_current_a=side.drive.rated_current_a,
        rated_torque_nm=side.joint.torque_constant_nm_per_a * side.drive.rated_current_a,
        trip_current_a=side.drive.trip_current_a,
        motor_counts_per_rev=side.measurement.motor_counts_per_rev,
        link_counts_per_rev=side.measurement.link_counts_per_rev,
    )


class _Simulated:
    """Plant of joint files, its instruments, and their errors by effects. Raises ConfigError as `EffectPlant` does."""

    def __init__(self, parameters: PlantParameters, noise: Noise) -> None:
        self._readings: Readings | None = None
        if parameters.has_effects:
            self.plant: Plant = EffectPlant(parameters)
            self._readings = Readings(self.plant)
        else:
            self.plant = Plant(parameters)
        self.instruments = Instruments(parameters, noise)

    def read(self, dt_s: float) -> None:
        """Sample everything, dt_s after the last time."""
        torque_nm, errors = self.plant.sensor_torque(), None
        if self._readings is not None:
            errors, torque_nm = self._readings.read(torque_nm, dt_s)
        self.instruments.read(self.plant, dt_s, torque_nm, errors)


class _Towing:
    """Bench with laws of its own, and its instruments."""

    def __init__(self, parameters: TowingBench, noise: Noise) -> None:
        self.plant = TowingPlant(parameters)
        self.instruments = TowingInstruments(parameters, noise)

    def read(self, dt_s: float) -> None:
        """Sample everything, dt_s after the last time."""
        self.instruments.read(self.plant, dt_s, self.plant.sensor_torque())


class PlantSource:
    """`Source` of the emulated bench; the same seed and the same calls give the same signals bit by bit.

    Where the plant file has `run_to_run`, the source starts in day 0 of its seed, and each time a drive is enabled after
    both were off it is the next day, unless the run goes on (`resume`). `noise_seed`: of the noise, where it is not `seed`.
    """

    def __init__(self, parameters: AnyPlant, seed: int = 0, noise_seed: str | None = None) -> None:
        self.ratings = tuple(ratings_of(side) for side in parameters.joints)
        noise = Noise(random.Random(seed if noise_seed is None else noise_seed).random)
        made: _Simulated | _Towing = (
            _Towing(parameters, noise)
            if isinstance(parameters, TowingBench)
            else _Simulated(parameters, noise)
        )
        self.plant: Plant | TowingPlant = made.plant
        self._instruments, self._read = made.instruments, made.read
        self.drives = self._instruments.drives
        self.channels = (self._instruments.channel,)
        self._widths = parameters.run_to_run
        self._seed = seed
        self._modes = [OFF, OFF]
        self._ran = self._resumed = False
        self.day_number = 0
        self.begin_day(self._widths.day(seed, 0))

    def begin_day(self, values: AnyDay | None = None) -> None:
        """Set what another day brings (None: the nominal day's). The joints stay where they are."""
        values = self._widths.nominal_day if values is None else values
        self.plant.begin_day(values)
        self._instruments.begin_day(values)

    def advance(self, dt_s: float) -> bool:
        """Integrate by dt_s and sample everything. An emulated run has no end: always True."""
        self.plant.step(dt_s)
        self._read(dt_s)
        return True

    def command(self, drive: int, mode: int, target: float) -> None:
        """Set mode and target of the control loops of drive 0 or 1."""
        modes = self._modes
        if mode != modes[drive]:
            if modes == [OFF, OFF] and not self._resumed:
                self.plant.begin_run()
                if self._ran and self._widths.varies:
                    self.day_number += 1
                    self.begin_day(self._widths.day(self._seed, self.day_number))
            modes[drive] = mode
            self._ran, self._resumed = True, False
        self.plant.command(drive, mode, target)

    def resume(self) -> None:
        """Continue the run with what is enabled next, also after both drives were off."""
        self._resumed = True

    def interpolate(self, drive: int, period_s: float) -> None:
        """Set the time between two velocity targets of drive 0 or 1 [s]."""
        self.plant.drives[drive].interpolation_s = period_s


_SEEDS_APART = 1_000_003
"""Between the seeds of two pairs: noise and days of each are its own."""


class SingleJoint:
    """`Source` of the first joint of a pair; the second one is its load.

    pair: whose drive 0 it is.
    """

    def __init__(self, pair: Source) -> None:
        self._pair = pair
        self.ratings: Sequence[DriveRatings] = tuple(pair.ratings[:1])
        self.drives: Sequence[DriveSignals] = tuple(pair.drives[:1])
        self.channels: Sequence[ChannelSignal] = tuple(pair.channels[:1])

    def advance(self, dt_s: float) -> bool:
        """As `Source.advance`."""
        return self._pair.advance(dt_s)

    def command(self, drive: int, mode: int, target: float) -> None:
        """As `Source.command`; there is drive 0 only."""
        self._pair.command(drive, mode, target)

    def resume(self) -> None:
        """As `Source.resume`."""
        self._pair.resume()

    def interpolate(self, drive: int, period_s: float) -> None:
        """As `Source.interpolate`; there is drive 0 only."""
        self._pair.interpolate(drive, period_s)


def sources_of(parameters: AnyPlant, seed: int, joints: int) -> list[Source]:
    """Return the plants of a bench with so many joints; with two it is the one pair of this seed."""
    sources: list[Source] = []
    for number in range((joints + 1) // 2):
        pair = PlantSource(parameters, seed + number * _SEEDS_APART)
        sources.append(pair if 2 * number + 1 < joints else SingleJoint(pair))
    return sources
