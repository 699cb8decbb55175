"""What the emulated bench truly is: per joint its nominal file and how the real part deviates from it, drive,
encoders, thermal behaviour; the sensor; what changes from day to day.

`models/campaign_plant.yaml` is the shipped example with every key. Unknown keys are errors.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from jtqd.estimator.checked import Section
from jtqd.estimator.joint import Joint
from jtqd.sim_can.days import RunToRun, Thermal
from jtqd.sim_can.joint_effects import changed_joint, uses_temperature

# How a true joint differs from its file: `deviations` of a plant file. Unknown keys are errors.


@dataclass(frozen=True)
class Deviations:
    """How the true joint differs from its file. The defaults are a joint that is exactly as its file says."""

    friction_scale: float = 1.0
    viscous_scale: float = (
        1.0  # of the file's friction.viscous_nms_per_rad; the difference is added to the losses
    )
    torque_constant_scale: float = 1.0
    stiffness_scale: float = 1.0
    rotor_inertia_scale: float = 1.0
    ripple_nm: float = 0.0  # joint side, A cos(order θm + phase) on the motor's load
    ripple_order_per_motor_rev: float = 2.0
    ripple_phase_rad: float = 0.0
    stribeck_nm: float = 0.0
    stribeck_velocity_rad_s: float = 0.05
    kinematic_error_rad: float = 0.0  # joint side, torsion gains A sin(order θm + phase)
    kinematic_error_order_per_motor_rev: float = 2.0
    kinematic_error_phase_rad: float = 0.0
    hysteresis_nm: float = 0.0  # one Maxwell-slip element beside the spring
    hysteresis_travel_rad: float = 1.0e-4  # torsion over which it goes from 0 to hysteresis_nm

    @property
    def kinematic_slope(self) -> float:
        """Largest |de/dθm| of the kinematic error, joint rad per motor rad."""
        return self.kinematic_error_rad * self.kinematic_error_order_per_motor_rev

    @property
    def hysteresis_stiffness(self) -> float:
        """Stiffness of the Maxwell-slip element while it sticks, Nm/rad."""
        return self.hysteresis_nm / self.hysteresis_travel_rad


_SCALES = (
    "friction_scale",
    "viscous_scale",
    "torque_constant_scale",
    "stiffness_scale",
    "rotor_inertia_scale",
)


def deviations_from(section: Section | None) -> Deviations:
    """Checked deviations; None: none. Raises ConfigError."""
    if section is None:
        return Deviations()
    values = {key: section.number(key, unit="1", low=0.0, high=10.0, default=1.0) for key in _SCALES}
    for key in ("torque_constant_scale", "stiffness_scale", "rotor_inertia_scale"):
        if values[key] < 0.05:
            raise section.error(key, values[key], "a number >= 0.05")
    ripple = section.section("ripple", optional=True)
    if ripple is not None:
        values["ripple_nm"] = ripple.number("amplitude_nm", unit="Nm", low=0.0)
        values["ripple_order_per_motor_rev"], values["ripple_phase_rad"] = _order_and_phase(ripple)
        ripple.finish()
    stribeck = section.section("stribeck", optional=True)
    if stribeck is not None:
        values["stribeck_nm"] = stribeck.number("torque_nm", unit="Nm", low=0.0)
        # above 0.06 rad/s the peak would reach into Table I's range, which begins at 0.2 rad/s
        values["stribeck_velocity_rad_s"] = stribeck.number(
            "velocity_rad_s", unit="rad/s", low=0.002, high=0.06, default=0.05
        )
        stribeck.finish()
    error = section.section("kinematic_error", optional=True)
    if error is not None:
        values["kinematic_error_rad"] = error.number("amplitude_rad", unit="rad", low=0.0, high=0.01)
        order, phase = _order_and_phase(error)
        values["kinematic_error_order_per_motor_rev"], values["kinematic_error_phase_rad"] = order, phase
        error.finish()
    hysteresis = section.section("hysteresis", optional=True)
    if hysteresis is not None:
        values["hysteresis_nm"] = hysteresis.number("torque_nm", unit="Nm", low=0.0)
        values["hysteresis_travel_rad"] = hysteresis.number(
            "travel_rad", unit="rad", low=1.0e-6, high=0.1, default=1.0e-4
        )
        hysteresis.finish()
    section.finish()
    return Deviations(**values)


def _order_and_phase(section: Section) -> tuple[float, float]:
    order = section.number("order_per_motor_rev", unit="1/rev", low=0.0, default=2.0)
    return order, section.number("phase_rad", unit="rad", default=0.0)


# Drives, encoders and torque sensor of the emulated bench: `drive`, `measurement` and `sensor` of a plant
# file.


@dataclass(frozen=True)
class DriveParameters:
    """Ratings and loops of a drive. Velocity loop gains are on the motor side."""

    rated_current_a: float = 8.0
    current_limit_a: float = 9.0
    trip_current_a: float = 12.0
    current_bandwidth_hz: float = 500.0
    velocity_bandwidth_rad_s: float = 400.0  # of the proportional loop with the rotor's inertia alone
    velocity_integral_time_s: float = 0.01
    acceleration_feedforward: float = 2.0  # in rotor inertias: a towing pair moves both rotors
    friction_feedforward_a: float = 0.0  # sign(reference velocity) times this
    acceleration_limit_rad_s2: float = 60.0  # joint side, of the velocity reference


@dataclass(frozen=True)
class MeasurementParameters:
    """Encoders and current measurement of a drive."""

    motor_counts_per_rev: int = 65536
    link_counts_per_rev: int = 524288
    link_noise_rad: float = 0.0
    velocity_filter_s: float = 0.001
    current_noise_a: float = 0.0
    current_offset_a: float = 0.0


@dataclass(frozen=True)
class SensorParameters:
    """Torque sensor between the joints: measured = gain * true + offset + noise."""

    noise_nm: float = 0.0
    offset_nm: float = 0.0
    gain: float = 1.0


def drive_from(section: Section | None) -> DriveParameters:
    """Checked values; None: the defaults. Raises ConfigError."""
    if section is None:
        return DriveParameters()
    base = DriveParameters()
    rated = section.number("rated_current_a", unit="A", low=0.1, high=1000.0, default=base.rated_current_a)
    limit = section.number("current_limit_a", unit="A", low=0.1, high=20.0 * rated, default=1.125 * rated)
    drive = DriveParameters(
        rated_current_a=rated,
        current_limit_a=limit,
        trip_current_a=section.number("trip_current_a", unit="A", low=0.05, default=1.33 * limit),
        current_bandwidth_hz=section.number(
            "current_bandwidth_hz", unit="Hz", low=50.0, high=5000.0, default=500.0
        ),
        velocity_bandwidth_rad_s=section.number(
            "velocity_bandwidth_rad_s",
            unit="rad/s",
            low=1.0,
            high=2000.0,
            default=base.velocity_bandwidth_rad_s,
        ),
        velocity_integral_time_s=section.number(
            "velocity_integral_time_s", unit="s", low=0.002, high=10.0, default=base.velocity_integral_time_s
        ),
        acceleration_feedforward=section.number(
            "acceleration_feedforward",
            unit="rotor inertias",
            low=0.0,
            high=10.0,
            default=base.acceleration_feedforward,
        ),
        friction_feedforward_a=section.number(
            "friction_feedforward_a", unit="A", low=0.0, high=limit, default=0.0
        ),
        acceleration_limit_rad_s2=section.number(
            "acceleration_limit_rad_s2", unit="rad/s2", low=0.1, default=base.acceleration_limit_rad_s2
        ),
    )
    section.finish()
    return drive


def measurement_from(section: Section | None) -> MeasurementParameters:
    """Checked values; None: the defaults. Raises ConfigError."""
    if section is None:
        return MeasurementParameters()
    measurement = MeasurementParameters(
        motor_counts_per_rev=section.integer("motor_counts_per_rev", low=16, high=1 << 24, default=65536),
        link_counts_per_rev=section.integer("link_counts_per_rev", low=16, high=1 << 26, default=524288),
        link_noise_rad=section.number("link_noise_rad", unit="rad", low=0.0, default=0.0),
        velocity_filter_s=section.number("velocity_filter_s", unit="s", low=0.0, high=0.1, default=0.001),
        current_noise_a=section.number("current_noise_a", unit="A", low=0.0, default=0.0),
        current_offset_a=section.number("current_offset_a", unit="A", default=0.0),
    )
    section.finish()
    return measurement


def sensor_from(section: Section | None) -> SensorParameters:
    """Checked values; None: the defaults. Raises ConfigError."""
    if section is None:
        return SensorParameters()
    sensor = SensorParameters(
        noise_nm=section.number("noise_nm", unit="Nm", low=0.0, default=0.0),
        offset_nm=section.number("offset_nm", unit="Nm", default=0.0),
        gain=section.number("gain", unit="1", low=0.01, high=100.0, default=1.0),
    )
    section.finish()
    return sensor


PROFILES = ("demo", "rest")
# Largest part of the gear's own transmission 1/G that a kinematic error may add or take away; with 1 the
# link would stand still, or go back, while the motor turns on.
STEEPEST_KINEMATIC_ERROR = 0.5
# Warming of a joint that comes as a joint file with effects of the temperature: that of campaign_plant.yaml.
WARMING_K_PER_W = 0.6


@dataclass(frozen=True)
class JointPlant:
    """One joint with its drive and encoders."""

    joint: Joint
    deviations: Deviations = field(default_factory=Deviations)
    drive: DriveParameters = field(default_factory=DriveParameters)
    measurement: MeasurementParameters = field(default_factory=MeasurementParameters)
    thermal: Thermal = field(default_factory=Thermal)

    @cached_property
    def true_joint(self) -> Joint:
        """The joint with its true constants: its file's, the deviations, and inertias that effects replace.

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

    @property
    def torque_constant(self) -> float:
        """True Kt, Nm/A; effects on it are losses."""
        return self.true_joint.torque_constant_nm_per_a

    @property
    def rotor_inertia(self) -> float:
        """True Jm, kgm² on the motor side."""
        return self.true_joint.rotor_inertia_kgm2

    @property
    def stiffness(self) -> float:
        """True K, Nm/rad; effects on it are twists."""
        return self.true_joint.stiffness_nm_per_rad

    @property
    def link_inertia(self) -> float:
        """True Jl, kgm²."""
        return self.true_joint.link_inertia_kgm2


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
    """Read a plant file, or a joint file (known by its key gear_ratio), which then serves both joints without
    deviations.

    Joint files named in a plant file are looked up beside it.

    Raises:
        ConfigError: unreadable file, unknown or missing key, value out of range; the message names file and
        key.
    """
    from jtqd.models.files import load_joint, load_yaml

    mapping, _ = load_yaml(path)
    where = str(path)
    if "gear_ratio" in mapping:
        return plant_of_joint(Joint.from_mapping(mapping, where))
    return plant_from_mapping(mapping, where, lambda name: load_joint(path.parent / name))


def plant_of_joint(joint: Joint) -> PlantParameters:
    """Two ideal joints of one kind: the file's friction and effects, no deviation, no noise beyond quantisation.

    They stay at 25 °C, but warm as the campaign's bench does where an effect depends on the temperature.
    """
    friction = joint.friction
    stribeck = {}
    if friction.stribeck_nm > 0.0:
        velocity = max(friction.stribeck_velocity_rad_s, 0.002)
        if joint.efficiency is not None:
            velocity = min(velocity, 0.06)  # Table I holds from 0.2 rad/s on
        stribeck = {"stribeck_nm": friction.stribeck_nm, "stribeck_velocity_rad_s": velocity}
    thermal = Thermal(kelvin_per_w=WARMING_K_PER_W) if uses_temperature(joint) else Thermal()
    side = JointPlant(joint, Deviations(**stribeck), thermal=thermal)
    return PlantParameters((side, side))


def plant_from_mapping(
    mapping: Mapping[str, Any], where: str, joint_of: Callable[[str], Joint]
) -> PlantParameters:
    """Checked parameters from the mapping of a plant file; joint_of(file name) -> Joint.

    Raises:
        ConfigError: as in `load_plant`.
    """
    section = Section(mapping, where)
    one, two = (_joint_plant(section.required(key), joint_of) for key in ("joint_1", "joint_2"))
    sensor = sensor_from(section.section("sensor", optional=True))
    profile = section.text("profile", choices=PROFILES, default="demo")
    substep = section.number("substep_s", unit="s", low=10e-6, high=500e-6, default=125e-6)
    run_to_run = RunToRun.from_section(section.section("run_to_run", optional=True))
    section.finish()
    return PlantParameters((one, two), sensor, profile, substep, run_to_run)


def _joint_plant(part: Section, joint_of: Callable[[str], Joint]) -> JointPlant:
    joint = joint_of(part.text("joint"))
    deviations = deviations_from(part.section("deviations", optional=True))
    steepest = STEEPEST_KINEMATIC_ERROR / joint.gear_ratio
    if deviations.kinematic_slope > steepest:
        raise part.error(
            "deviations.kinematic_error",
            deviations.kinematic_slope,
            f"amplitude_rad times order_per_motor_rev <= {steepest:g}, half of 1/gear_ratio",
        )
    side = JointPlant(
        joint,
        deviations,
        drive_from(part.section("drive", optional=True)),
        measurement_from(part.section("measurement", optional=True)),
        Thermal.from_section(part.section("thermal", optional=True)),
    )
    part.finish()
    return side


def substep_limit(
    parameters: PlantParameters,
    stiffer: tuple[float, float] = (1.0, 1.0),
    steeper: tuple[float, float] = (0.0, 0.0),
) -> float:
    """Largest integration step [s]: substep_s, made smaller where a stiff or light joint needs it.

    stiffer: factor of each joint's stiffness by its effects; steeper: G |de/dθm| of their kinematic errors.

    Semi-implicit Euler is stable up to ω h = 2; ω h <= 0.25 keeps the frequency error (ωh)²/24 below 0.3 %.
    ω² <= the sum of K / J over what a mass hangs on bounds every mode (Gershgorin). Damping D: D h / J <=
    0.25. A sticking hysteresis element is a spring beside K; a kinematic error changes the gear ratio.
    """
    one, two = parameters.joints
    link = one.link_inertia + two.link_inertia
    damping = one.joint.damping_nms_per_rad + two.joint.damping_nms_per_rad
    stiffness = [
        side.stiffness * factor + side.deviations.hysteresis_stiffness
        for side, factor in zip((one, two), stiffer, strict=True)
    ]
    squares = [2.0 * sum(stiffness) / link]
    rates = [damping / link]
    for side, spring, bend in zip((one, two), stiffness, steeper, strict=True):
        steepest = 1.0 + side.joint.gear_ratio * side.deviations.kinematic_slope + bend
        inertia = side.rotor_inertia * (side.joint.gear_ratio / steepest) ** 2
        squares.append(2.0 * spring / inertia)
        rates.append(side.joint.damping_nms_per_rad / inertia)
    step = min(parameters.substep_s, 0.25 / math.sqrt(max(squares)))
    fastest = max(rates)
    return min(step, 0.25 / fastest) if fastest > 0.0 else step
