"""What the emulated bench truly is: per joint its nominal file and how the real part deviates from it, drive,
encoders, thermal behaviour; the sensor; what changes from day to day.

`models/campaign_plant.yaml` is the shipped example with every key. Unknown keys are errors.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from estimator.checked import Section
from estimator.parameters import Joint
from sim_can.plant_deviations import Deviations, deviations_from
from sim_can.plant_equipment import (
    DriveParameters,
    MeasurementParameters,
    SensorParameters,
    drive_from,
    measurement_from,
    sensor_from,
)
from sim_can.run_to_run import RunToRun
from sim_can.thermal import Thermal

__all__ = [
    "PROFILES",
    "Deviations",
    "DriveParameters",
    "JointPlant",
    "MeasurementParameters",
    "PlantParameters",
    "SensorParameters",
    "load_plant",
    "plant_from_mapping",
    "plant_of_joint",
    "substep_limit",
]

PROFILES = ("demo", "rest")
# Largest part of the gear's own transmission 1/G that a kinematic error may add or take away; with 1 the
# link would stand still, or go back, while the motor turns on.
STEEPEST_KINEMATIC_ERROR = 0.5


@dataclass(frozen=True)
class JointPlant:
    """One joint with its drive and encoders."""

    joint: Joint
    deviations: Deviations = field(default_factory=Deviations)
    drive: DriveParameters = field(default_factory=DriveParameters)
    measurement: MeasurementParameters = field(default_factory=MeasurementParameters)
    thermal: Thermal = field(default_factory=Thermal)

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
    """Both joints, the sensor, the built-in motion, the largest integration step, the spread of the days."""

    joints: tuple[JointPlant, JointPlant]
    sensor: SensorParameters = field(default_factory=SensorParameters)
    profile: str = "demo"
    substep_s: float = 125e-6
    run_to_run: RunToRun = field(default_factory=RunToRun)


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


def substep_limit(parameters: PlantParameters) -> float:
    """Largest integration step [s]: substep_s, made smaller where a stiff or light joint needs it.

    Semi-implicit Euler is stable up to ω h = 2; ω h <= 0.25 keeps the frequency error (ωh)²/24 below 0.3 %.
    ω² <= the sum of K / J over what a mass hangs on bounds every mode (Gershgorin). Damping D: D h / J <=
    0.25. A sticking hysteresis element is a spring beside K; a kinematic error changes the gear ratio.
    """
    one, two = parameters.joints
    link = one.joint.link_inertia_kgm2 + two.joint.link_inertia_kgm2
    damping = one.joint.damping_nms_per_rad + two.joint.damping_nms_per_rad
    stiffness = [side.stiffness + side.deviations.hysteresis_stiffness for side in (one, two)]
    squares = [2.0 * sum(stiffness) / link]
    rates = [damping / link]
    for side, spring in zip((one, two), stiffness, strict=True):
        steepest = 1.0 + side.joint.gear_ratio * side.deviations.kinematic_slope
        inertia = side.rotor_inertia * (side.joint.gear_ratio / steepest) ** 2
        squares.append(2.0 * spring / inertia)
        rates.append(side.joint.damping_nms_per_rad / inertia)
    step = min(parameters.substep_s, 0.25 / math.sqrt(max(squares)))
    fastest = max(rates)
    return min(step, 0.25 / fastest) if fastest > 0.0 else step
