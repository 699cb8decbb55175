"""What the emulated bench truly is: per joint its nominal file and how the real part deviates from it, drive,
encoders, noise.

`models/plant.yaml` is the shipped example with every key. Unknown keys are errors.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from estimator.checked import Section
from estimator.parameters import Joint

PROFILES = ("demo", "rest")


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


@dataclass(frozen=True)
class JointPlant:
    """One joint with its drive and encoders."""

    joint: Joint
    deviations: Deviations = Deviations()
    drive: DriveParameters = DriveParameters()
    measurement: MeasurementParameters = MeasurementParameters()

    @property
    def torque_constant(self) -> float:
        """True Kt, Nm/A."""
        return self.joint.torque_constant_nm_per_a * self.deviations.torque_constant_scale

    @property
    def rotor_inertia(self) -> float:
        """True Jm, kgm² on the motor side."""
        return self.joint.rotor_inertia_kgm2 * self.deviations.rotor_inertia_scale

    @property
    def stiffness(self) -> float:
        """True K, Nm/rad."""
        return self.joint.stiffness_nm_per_rad * self.deviations.stiffness_scale


@dataclass(frozen=True)
class PlantParameters:
    """Both joints, the sensor, the built-in motion and the largest integration step."""

    joints: tuple[JointPlant, JointPlant]
    sensor: SensorParameters = SensorParameters()
    profile: str = "demo"
    substep_s: float = 125e-6


def _deviations(section: Section | None) -> Deviations:
    if section is None:
        return Deviations()
    scale = {"low": 0.0, "high": 10.0, "default": 1.0}
    values: dict[str, float] = {
        key: section.number(key, unit="1", **scale)
        for key in (
            "friction_scale",
            "viscous_scale",
            "torque_constant_scale",
            "stiffness_scale",
            "rotor_inertia_scale",
        )
    }
    for key in ("torque_constant_scale", "stiffness_scale", "rotor_inertia_scale"):
        if values[key] < 0.05:
            raise section.error(key, values[key], "a number >= 0.05")
    ripple = section.section("ripple", optional=True)
    if ripple is not None:
        values["ripple_nm"] = ripple.number("amplitude_nm", unit="Nm", low=0.0)
        values["ripple_order_per_motor_rev"] = ripple.number(
            "order_per_motor_rev", unit="1/rev", low=0.0, default=2.0
        )
        values["ripple_phase_rad"] = ripple.number("phase_rad", unit="rad", default=0.0)
        ripple.finish()
    stribeck = section.section("stribeck", optional=True)
    if stribeck is not None:
        values["stribeck_nm"] = stribeck.number("torque_nm", unit="Nm", low=0.0)
        # above 0.06 rad/s the peak would reach into Table I's range, which begins at 0.2 rad/s
        values["stribeck_velocity_rad_s"] = stribeck.number(
            "velocity_rad_s", unit="rad/s", low=0.002, high=0.06, default=0.05
        )
        stribeck.finish()
    section.finish()
    return Deviations(**values)


def _drive(section: Section | None) -> DriveParameters:
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


def _measurement(section: Section | None) -> MeasurementParameters:
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


def _sensor(section: Section | None) -> SensorParameters:
    if section is None:
        return SensorParameters()
    sensor = SensorParameters(
        noise_nm=section.number("noise_nm", unit="Nm", low=0.0, default=0.0),
        offset_nm=section.number("offset_nm", unit="Nm", default=0.0),
        gain=section.number("gain", unit="1", low=0.01, high=100.0, default=1.0),
    )
    section.finish()
    return sensor


def load_plant(path: Path) -> PlantParameters:
    """Read a plant file, or a joint file (known by its key gear_ratio), which then serves both joints without
    deviations.

    Joint files named in a plant file are looked up beside it.

    Raises:
        ConfigError: unreadable file, unknown or missing key, value out of range; the message names file and
        key.
    """
    from models.files import load_joint, load_yaml

    mapping, _ = load_yaml(path)
    where = str(path)
    if "gear_ratio" in mapping:
        return plant_of_joint(Joint.from_mapping(mapping, where))
    return plant_from_mapping(mapping, where, lambda name: load_joint(path.parent / name))


def plant_of_joint(joint: Joint) -> PlantParameters:
    """Two ideal joints of one kind: the file's friction, no deviation, no noise beyond quantisation."""
    friction = joint.friction
    stribeck = {}
    if friction.stribeck_nm > 0.0:
        velocity = min(max(friction.stribeck_velocity_rad_s, 0.002), 0.06)
        stribeck = {"stribeck_nm": friction.stribeck_nm, "stribeck_velocity_rad_s": velocity}
    side = JointPlant(joint, Deviations(**stribeck))
    return PlantParameters((side, side))


def plant_from_mapping(mapping: Mapping[str, Any], where: str, joint_of: Any) -> PlantParameters:
    """Checked parameters from the mapping of a plant file; joint_of(file name) -> Joint.

    Raises:
        ConfigError: as in `load_plant`.
    """
    section = Section(mapping, where)
    sides = []
    for key in ("joint_1", "joint_2"):
        part = section.required(key)
        joint = joint_of(part.text("joint"))
        sides.append(
            JointPlant(
                joint,
                _deviations(part.section("deviations", optional=True)),
                _drive(part.section("drive", optional=True)),
                _measurement(part.section("measurement", optional=True)),
            )
        )
        part.finish()
    sensor = _sensor(section.section("sensor", optional=True))
    profile = section.text("profile", choices=PROFILES, default="demo")
    substep = section.number("substep_s", unit="s", low=10e-6, high=500e-6, default=125e-6)
    section.finish()
    return PlantParameters((sides[0], sides[1]), sensor, profile, substep)


def substep_limit(parameters: PlantParameters) -> float:
    """Largest integration step [s]: substep_s, made smaller where a stiff or light joint needs it.

    Semi-implicit Euler is stable up to ω h = 2; ω h <= 0.25 keeps the frequency error (ωh)²/24 below 0.3 %.
    ω² <= the sum of K / J over what a mass hangs on bounds every mode (Gershgorin). Damping D: D h / J <=
    0.25.
    """
    one, two = parameters.joints
    link = one.joint.link_inertia_kgm2 + two.joint.link_inertia_kgm2
    damping = one.joint.damping_nms_per_rad + two.joint.damping_nms_per_rad
    squares = [2.0 * (one.stiffness + two.stiffness) / link]
    rates = [damping / link]
    for side in (one, two):
        inertia = side.rotor_inertia * side.joint.gear_ratio**2
        squares.append(2.0 * side.stiffness / inertia)
        rates.append(side.joint.damping_nms_per_rad / inertia)
    step = min(parameters.substep_s, 0.25 / math.sqrt(max(squares)))
    fastest = max(rates)
    return min(step, 0.25 / fastest) if fastest > 0.0 else step
