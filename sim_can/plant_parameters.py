"""What the emulated bench truly is: per joint its nominal file and how the real part deviates from it, drive,
encoders, thermal behaviour; the sensor; what changes from day to day.

`models/campaign_plant.yaml` is the shipped example with every key. Unknown keys are errors.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from estimator.checked import Section
from estimator.parameters import Joint
from sim_can.joint_effects import changed_joint, uses_temperature
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
    from models.files import load_joint, load_yaml

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
