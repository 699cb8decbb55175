"""Plant files as frozen values: how the true joints differ from their joint files, drives, instruments, temperature, days.

The values of day n come from a Kronecker sequence, frac(s_j + n α_j), which spreads evenly over a handful of runs
(Niederreiter 1992, section 3.1); s_j come from the seed.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple

from jtqd.estimator.decoder import FieldError, Text, below, choice, in_file, limits, read
from jtqd.estimator.effects import EFFECTS
from jtqd.estimator.effects.effect import Effect, ScalarFunctions, State, Values
from jtqd.estimator.joint import Joint
from jtqd.models.files import load_joint, load_yaml
from jtqd.sim_can.source import USUAL_DRIVE, Day, DriveParameters, MeasurementParameters, SensorParameters

REFERENCE_C: Final = 25.0


# Effects of a joint file

PROBES = (0.0, 0.37, 1.9, 4.4)
PROBE_TORSION_RAD = 1.0e-3
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
    cold, warm = probe_state(0.4, PROBE_TORSION_RAD), probe_state(0.4, PROBE_TORSION_RAD)
    for state, celsius in ((cold, 20.0), (warm, 40.0)):
        state.temperature_c = celsius
        state.current_rate_a_s = state.torque_rate_nm_s = state.torsion_rate_rad_s = 1.0
    for effect, values in effects_of(joint):
        for name in effect.hooks:
            call = getattr(effect, name)
            if call(values, cold, joint, ScalarFunctions()) != call(values, warm, joint, ScalarFunctions()):
                return True
    return False


def probe_state(position_rad: float, torsion_rad: float = 0.0) -> State:
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


# Plant files


@dataclass(frozen=True, slots=True)
class Thermal:
    """Thermal behaviour of a joint (`thermal` of a plant file); the defaults are one that stays as it is.

    reference_c: where the joint file's friction holds; ambient_c: surroundings of the nominal day; left out: at the
    reference.
    """

    reference_c: Annotated[float, limits("degC", ge=-40.0, le=100.0)] = REFERENCE_C
    viscous_per_k: Annotated[float, limits("1/K", ge=0.0, le=0.1)] = 0.0
    coulomb_per_k: Annotated[float, limits("1/K", ge=0.0, le=0.1)] = 0.0
    kelvin_per_w: Annotated[float, limits("K/W", ge=0.0, le=20.0)] = 0.0
    time_constant_s: Annotated[float, limits("s", ge=10.0, le=1.0e5)] = 600.0
    ambient_c: Annotated[float, limits("degC", ge=-40.0, le=100.0)] = math.nan

    def __post_init__(self) -> None:
        if math.isnan(self.ambient_c):
            object.__setattr__(self, "ambient_c", self.reference_c)


# α_j = frac(sqrt(prime)), in the order of `Day`'s values: viscous, temperature and link zero of both joints, sensor zero.
# Not any primes: where a α_i + b α_j is nearly a whole number for small a and b (2 frac(sqrt(71)) - 3 frac(sqrt(53)) is
# 0.012), two values stay on a few lines of their square for as many days, no more even together than independent draws.
# These were searched for a small diaphony (Zinterhof 1976) of every pair, over 12 to 96 days, every one or every 2nd to
# 6th of them; and ordered so that it is smallest for the sensor's zero beside a link encoder's, the sum that a run shows.
_PRIMES = (5, 17, 37, 97, 11, 53, 23)
_STEPS = tuple(math.sqrt(prime) % 1.0 for prime in _PRIMES)


@dataclass(frozen=True, slots=True)
class RunToRun:
    """Half widths of the uniform spread of each value over the days (`run_to_run` of a plant file).

    viscous: share of the file's viscous friction, below 1 so that friction stays dissipative; temperature_k: ambient
    and start of the day against the joint's reference.
    """

    viscous: Annotated[float, limits(ge=0.0, le=0.9)] = 0.0
    sensor_zero_nm: Annotated[float, limits("Nm", ge=0.0)] = 0.0
    temperature_k: Annotated[float, limits("K", ge=0.0, le=100.0)] = 0.0
    link_zero_rad: Annotated[float, limits("rad", ge=0.0, le=0.1)] = 0.0

    @property
    def varies(self) -> bool:
        """Whether one day differs from another."""
        return self != RunToRun()

    def day(self, seed: int, n: int) -> Day:
        """Day n = 0, 1, 2, ... of a bench with this seed; every value lies within its half width."""
        if not self.varies:
            return Day()
        # a text as seed: the noise generator of the same seed must not give the same numbers
        start = random.Random(f"run to run {seed}")
        u = [2.0 * ((start.random() + n * step) % 1.0) - 1.0 for step in _STEPS]
        return Day(
            viscous=(self.viscous * u[0], self.viscous * u[1]),
            temperature_k=(self.temperature_k * u[2], self.temperature_k * u[3]),
            link_zero_rad=(self.link_zero_rad * u[4], self.link_zero_rad * u[5]),
            sensor_zero_nm=self.sensor_zero_nm * u[6],
        )


PROFILES: Final = ("demo", "rest")
STEEPEST_KINEMATIC_ERROR: Final = 0.5
"""Largest part of the gear's own transmission 1/G that a kinematic error may add or take away; with 1 the link would
stand still, or go back, while the motor turns on."""
WARMING_K_PER_W: Final = 0.6
"""Warming of a joint that comes as a joint file with effects of the temperature: that of campaign_plant.yaml."""


_Amplitude = Annotated[float, limits("Nm", ge=0.0)]
_Order = Annotated[float, limits("1/rev", ge=0.0)]
_Phase = Annotated[float, limits("rad")]
_Scale = Annotated[float, limits(ge=0.05, le=10.0)]
_FrictionScale = Annotated[float, limits(ge=0.0, le=10.0)]


@dataclass(frozen=True)
class Ripple:
    """A cos(order θm + phase) on the motor's load, joint side."""

    amplitude_nm: _Amplitude
    order_per_motor_rev: _Order = 2.0
    phase_rad: _Phase = 0.0


@dataclass(frozen=True)
class Stribeck:
    """Peak of the friction. Above 0.06 rad/s it would reach into Table I's range, which begins at 0.2 rad/s."""

    torque_nm: _Amplitude
    velocity_rad_s: Annotated[float, limits("rad/s", ge=0.002, le=0.06)] = 0.05


@dataclass(frozen=True)
class KinematicError:
    """Torsion gains A sin(order θm + phase), joint side."""

    amplitude_rad: Annotated[float, limits("rad", ge=0.0, le=0.01)]
    order_per_motor_rev: _Order = 2.0
    phase_rad: _Phase = 0.0

    @property
    def slope(self) -> float:
        """Largest |de/dθm|, joint rad per motor rad."""
        return self.amplitude_rad * self.order_per_motor_rev


@dataclass(frozen=True)
class Hysteresis:
    """One Maxwell-slip element beside the spring; it goes from 0 to its torque over its travel."""

    torque_nm: _Amplitude
    travel_rad: Annotated[float, limits("rad", ge=1.0e-6, le=0.1)] = 1.0e-4


@dataclass(frozen=True)
class Deviations:
    """How the true joint differs from its file. The defaults are a joint that is exactly as its file states."""

    friction_scale: _FrictionScale = 1.0
    viscous_scale: _FrictionScale = (
        1.0  # of the file's viscous friction; the difference is added to the losses
    )
    torque_constant_scale: _Scale = 1.0
    stiffness_scale: _Scale = 1.0
    rotor_inertia_scale: _Scale = 1.0
    ripple: Ripple = Ripple(0.0)
    stribeck: Stribeck = Stribeck(0.0)
    kinematic_error: KinematicError = KinematicError(0.0)
    hysteresis: Hysteresis = Hysteresis(0.0)


@dataclass(frozen=True)
class Measurement(MeasurementParameters):
    """The same with the current's offset."""

    current_offset_a: Annotated[float, limits("A")] = 0.0


class JointConstants(NamedTuple):
    """True constants of one joint for the inner loop, SI units."""

    gear_ratio: float
    torque_constant: float
    rotor_inertia: float
    stiffness: float
    damping: float
    ripple_nm: float
    ripple_order: float
    ripple_phase: float
    error_rad: float  # E, kinematic error
    error_order: float
    error_phase: float
    error_slope: float  # G E k: e' in units of 1/G
    slip_nm: float  # H, hysteresis
    per_travel: float


@dataclass(frozen=True)
class JointPlant:
    """One joint with its drive and encoders (`joint_1`, `joint_2`)."""

    joint: Joint
    deviations: Deviations = field(default_factory=Deviations)
    drive: DriveParameters = USUAL_DRIVE
    measurement: Measurement = field(default_factory=Measurement)
    thermal: Thermal = field(default_factory=Thermal)

    @cached_property
    def true_joint(self) -> Joint:
        """Return the joint with its true constants: its file's, the deviations, and what effects replace.

        An effect states the right value, whatever file and deviations say.
        """
        joint, d = self.joint, self.deviations
        joint = replace(
            joint,
            torque_constant_nm_per_a=joint.torque_constant_nm_per_a * d.torque_constant_scale,
            rotor_inertia_kgm2=joint.rotor_inertia_kgm2 * d.rotor_inertia_scale,
            stiffness_nm_per_rad=joint.stiffness_nm_per_rad * d.stiffness_scale,
        )
        return changed_joint(joint)

    @cached_property
    def constants(self) -> JointConstants:
        """Return the constants of the inner loop; effects on torque constant and stiffness are losses and twists."""
        joint, d = self.true_joint, self.deviations
        ripple, error = d.ripple, d.kinematic_error
        return JointConstants(
            joint.gear_ratio,
            joint.torque_constant_nm_per_a,
            joint.rotor_inertia_kgm2,
            joint.stiffness_nm_per_rad,
            joint.damping_nms_per_rad,
            ripple.amplitude_nm,
            ripple.order_per_motor_rev,
            ripple.phase_rad,
            error.amplitude_rad,
            error.order_per_motor_rev,
            error.phase_rad,
            joint.gear_ratio * error.slope,
            d.hysteresis.torque_nm,
            1.0 / d.hysteresis.travel_rad,
        )


@dataclass(frozen=True)
class PlantParameters:
    """Both joints, the sensor, the built-in motion, the largest integration step, the spread of the days."""

    joints: tuple[JointPlant, JointPlant]
    sensor: SensorParameters = field(default_factory=SensorParameters)
    profile: str = "demo"
    substep_s: float = 125e-6
    run_to_run: RunToRun = field(default_factory=RunToRun)

    @property
    def has_effects(self) -> bool:
        """Whether a joint has effects of the library; the bench is then an `EffectPlant`."""
        return any(side.joint.effects for side in self.joints)


def load_plant(path: Path) -> PlantParameters:
    """Read a plant file, or a joint file (known by its key gear_ratio), which serves both joints without deviations.

    Joint files named in a plant file are looked up beside it.

    Raises:
        ConfigError: unreadable file, unknown or missing key, value out of range; the message names file and key.
    """
    mapping = load_yaml(path)
    where = str(path)
    if "gear_ratio" in mapping:
        return plant_of_joint(Joint.from_mapping(mapping, where))
    return plant_from_mapping(mapping, where, lambda name: load_joint(path.parent / name))


def plant_from_mapping(
    mapping: Mapping[str, Any], where: str, joint_of: Callable[[str], Joint]
) -> PlantParameters:
    """Return the checked parameters of a plant file's mapping; joint_of(file name) -> Joint. Raises ConfigError."""
    with in_file(where):
        file = read(_PlantFile, mapping)
        sides = (
            _joint_plant("joint_1", file.joint_1, joint_of),
            _joint_plant("joint_2", file.joint_2, joint_of),
        )
    return PlantParameters(sides, file.sensor, file.profile, file.substep_s, file.run_to_run)


@dataclass(frozen=True)
class _JointFile:
    """`joint_1`, `joint_2` of a plant file."""

    joint: Text
    deviations: Deviations = Deviations()
    drive: DriveParameters = USUAL_DRIVE
    measurement: Measurement = Measurement()
    thermal: Thermal = field(default_factory=Thermal)


@dataclass(frozen=True)
class _PlantFile:
    joint_1: _JointFile
    joint_2: _JointFile
    sensor: SensorParameters = field(default_factory=SensorParameters)
    profile: Annotated[str, choice(PROFILES)] = "demo"
    substep_s: Annotated[float, limits("s", ge=10e-6, le=500e-6)] = 125e-6
    run_to_run: RunToRun = field(default_factory=RunToRun)


def _joint_plant(key: str, file: _JointFile, joint_of: Callable[[str], Joint]) -> JointPlant:
    joint = joint_of(file.joint)
    side = JointPlant(joint, file.deviations, file.drive, file.measurement, file.thermal)
    steepest = STEEPEST_KINEMATIC_ERROR / joint.gear_ratio
    slope = side.deviations.kinematic_error.slope
    if slope > steepest:
        expected = f"amplitude_rad times order_per_motor_rev <= {steepest:g}, half of 1/gear_ratio"
        with below(key):
            raise FieldError("plant", "deviations.kinematic_error", slope, expected)
    return side


def plant_of_joint(joint: Joint) -> PlantParameters:
    """Two ideal joints of one kind: the file's friction and effects, no deviation, no noise beyond quantisation.

    They stay at 25 °C, but warm as the campaign's bench does where an effect depends on the temperature.
    """
    friction = joint.friction
    stribeck = Stribeck(0.0)
    if friction.stribeck_nm > 0.0:
        velocity = max(friction.stribeck_velocity_rad_s, 0.002)
        if joint.efficiency is not None:
            velocity = min(velocity, 0.06)  # Table I holds from 0.2 rad/s on
        stribeck = Stribeck(friction.stribeck_nm, velocity)
    thermal = Thermal(kelvin_per_w=WARMING_K_PER_W) if uses_temperature(joint) else Thermal()
    side = JointPlant(joint, Deviations(stribeck=stribeck), thermal=thermal)
    return PlantParameters((side, side))


def substep_limit(
    parameters: PlantParameters,
    stiffer: tuple[float, float] = (1.0, 1.0),
    steeper: tuple[float, float] = (0.0, 0.0),
) -> float:
    """Return the largest integration step [s]: substep_s, made smaller where a stiff or light joint needs it.

    stiffer: factor of each joint's stiffness by its effects; steeper: G |de/dθm| of their kinematic errors.

    Semi-implicit Euler is stable up to ω h = 2; ω h <= 0.25 keeps the frequency error (ωh)²/24 below 0.3 %.
    ω² <= the sum of K / J over what a mass hangs on bounds every mode (Gershgorin). Damping D: D h / J <=
    0.25. A sticking hysteresis element is a spring beside K; a kinematic error changes the gear ratio.
    """
    sides = parameters.joints
    constants = [side.constants for side in sides]
    link = sum(side.true_joint.link_inertia_kgm2 for side in sides)
    stiffness = [
        c.stiffness * factor + side.deviations.hysteresis.torque_nm / side.deviations.hysteresis.travel_rad
        for c, side, factor in zip(constants, sides, stiffer, strict=True)
    ]
    squares = [2.0 * sum(stiffness) / link]
    rates = [sum(c.damping for c in constants) / link]
    for c, spring, bend in zip(constants, stiffness, steeper, strict=True):
        inertia = c.rotor_inertia * (c.gear_ratio / (1.0 + c.error_slope + bend)) ** 2
        squares.append(2.0 * spring / inertia)
        rates.append(c.damping / inertia)
    step = min(parameters.substep_s, 0.25 / math.sqrt(max(squares)))
    return min(step, 0.25 / max(rates)) if max(rates) > 0.0 else step
