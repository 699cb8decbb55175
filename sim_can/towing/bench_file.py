"""Bench files as frozen values: two joints with laws of their own, their instruments, and how days differ.

Days are drawn independently and uniformly within half widths. `models/plants/typical.yaml` has every key with its unit and
source.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from itertools import pairwise
from typing import Annotated, Any, Final

from jtqd.estimator.decoder import FieldError, Text, below, in_file, limits, parsed, read
from jtqd.estimator.errors import Verbatim
from jtqd.estimator.joint import Joint
from jtqd.sim_can.source import USUAL_DRIVE, Day, DriveParameters, MeasurementParameters, SensorParameters


@dataclass(frozen=True, slots=True)
class DayWidths:
    """Half widths of the spread of each value over the days (`run_to_run` of a bench file).

    viscous, coulomb: share of the usual friction; temperature_k: of the room; current_gain: share.
    """

    viscous: Annotated[float, limits(ge=0.0, le=0.9)] = 0.0
    coulomb: Annotated[float, limits(ge=0.0, le=0.9)] = 0.0
    temperature_k: Annotated[float, limits("K", ge=0.0, le=60.0)] = 0.0
    motor_zero_rad: Annotated[float, limits("rad", ge=0.0, le=1.0)] = 0.0
    link_zero_rad: Annotated[float, limits("rad", ge=0.0, le=0.1)] = 0.0
    current_zero_a: Annotated[float, limits("A", ge=0.0)] = 0.0
    current_gain: Annotated[float, limits(ge=0.0, le=0.5)] = 0.0
    sensor_zero_nm: Annotated[float, limits("Nm", ge=0.0)] = 0.0

    @property
    def varies(self) -> bool:
        """Whether one day differs from another."""
        return self != DayWidths()

    def day(self, seed: int, number: int) -> Day:
        """Return day 0, 1, 2, ... of a bench with this seed."""

        def draw(of: str) -> float:
            return random.Random(f"{seed} day {number} {of}").uniform(-1.0, 1.0)

        def pair(name: str) -> tuple[float, float]:
            width: float = getattr(self, name)
            return width * draw(f"joint 1 {name}"), width * draw(f"joint 2 {name}")

        pairs = {each.name: pair(each.name) for each in fields(self) if each.name != "sensor_zero_nm"}
        return Day(sensor_zero_nm=self.sensor_zero_nm * draw("sensor"), **pairs)


KEY: Final = "towing"
"""Key that tells a bench file from other files: number of joints, 2."""
_MOST: Final = 8
STEEPEST_ERROR: Final = 0.5
"""Largest part of the gear's own transmission that its errors may add or take away."""


@dataclass(frozen=True, slots=True)
class AngleWave:
    """Error of an angle over a turn."""

    order: Annotated[float, limits("1/rev", gt=0.0, le=1000.0)]
    amplitude_rad: Annotated[float, limits("rad", ge=0.0, le=0.1)]
    phase_rad: Annotated[float, limits("rad")] = 0.0


@dataclass(frozen=True, slots=True)
class TorqueWave:
    """Ripple of a torque over a turn."""

    order: Annotated[float, limits("1/rev", gt=0.0, le=1000.0)]
    amplitude_nm: Annotated[float, limits("Nm", ge=0.0)]
    phase_rad: Annotated[float, limits("rad")] = 0.0


@dataclass(frozen=True, slots=True)
class CurrentWave:
    """Ripple of a measured current over a turn of the motor."""

    order: Annotated[float, limits("1/rev", gt=0.0, le=1000.0)]
    amplitude_a: Annotated[float, limits("A", ge=0.0)]
    phase_rad: Annotated[float, limits("rad")] = 0.0


@dataclass(frozen=True, slots=True)
class ShareWave:
    """Change of friction over a turn of the motor, as a share."""

    order: Annotated[float, limits("1/rev", gt=0.0, le=1000.0)]
    share: Annotated[float, limits(ge=0.0, le=0.5)]
    phase_rad: Annotated[float, limits("rad")] = 0.0


@dataclass(frozen=True, slots=True)
class Slip:
    """A spring beside the gear's that slips at its torque."""

    torque_nm: Annotated[float, limits("Nm", ge=0.0)]
    travel_rad: Annotated[float, limits("rad", ge=1.0e-6, le=0.1)]


@dataclass(frozen=True)
class Motor:
    """Motor of a joint. saturation_share: of the torque at rated current; torque_constant_per_k falls with the housing."""

    torque_constant_nm_per_a: Annotated[float, limits("Nm/A", gt=0.0)]
    rotor_inertia_kgm2: Annotated[float, limits("kgm2", gt=0.0)]
    torque_constant_per_k: Annotated[float, limits("1/K", ge=0.0, le=0.01)] = 0.0
    saturation_share: Annotated[float, limits(ge=0.0, le=0.3)] = 0.0
    cogging: tuple[TorqueWave, ...] = ()


@dataclass(frozen=True)
class Friction:
    """Friction of a joint, joint side: `jtqd.sim_can.towing.plant`."""

    coulomb_nm: Annotated[float, limits("Nm", gt=0.0)]
    static_ratio: Annotated[float, limits(ge=1.0, le=3.0)]
    stribeck_velocity_rad_s: Annotated[float, limits("rad/s", gt=0.0, le=1.0)]
    stribeck_exponent: Annotated[float, limits(ge=0.3, le=3.0)]
    viscous_nm: Annotated[float, limits("Nm at 1 rad/s", ge=0.0)]
    viscous_exponent: Annotated[float, limits(ge=0.2, le=2.0)]
    load_nm: Annotated[float, limits("Nm at rated torque", ge=0.0)]
    load_exponent: Annotated[float, limits(ge=0.5, le=2.0)]
    bristle_rad: Annotated[float, limits("rad", ge=1.0e-6, le=0.01)]
    bristle_damping_ratio: Annotated[float, limits(ge=0.0, le=2.0)] = 0.3
    direction_share: Annotated[float, limits(ge=-0.5, le=0.5)] = 0.0
    angle: tuple[ShareWave, ...] = ()


@dataclass(frozen=True)
class Gear:
    """Gear of a joint: `jtqd.sim_can.towing.plant`. stiffness K1, K2, K3; corners T1, T2."""

    stiffness_nm_per_rad: Annotated[tuple[float, ...], limits("Nm/rad", length=(3, 3))]
    corners_nm: Annotated[tuple[float, ...], limits("Nm", length=(2, 2))]
    damping_nms_per_rad: Annotated[float, limits("Nms/rad", ge=0.0)]
    errors: tuple[AngleWave, ...] = ()
    slips: tuple[Slip, ...] = ()

    def __post_init__(self) -> None:
        if not all(a < b for a, b in pairwise((0.0, *self.corners_nm))):
            raise FieldError("gear", "corners_nm", list(self.corners_nm), "rising numbers in Nm > 0")
        if min(self.stiffness_nm_per_rad) <= 0.0:
            found = list(self.stiffness_nm_per_rad)
            raise FieldError("gear", "stiffness_nm_per_rad", found, "numbers in Nm/rad > 0")

    @property
    def steepest_error(self) -> float:
        """Bound of |d error / dθ|, joint rad per motor rad."""
        return sum(each.order * each.amplitude_rad for each in self.errors)

    @property
    def stiffest(self) -> float:
        """Stiffness of spring and sticking slips together, Nm/rad."""
        return max(self.stiffness_nm_per_rad) + sum(each.torque_nm / each.travel_rad for each in self.slips)


@dataclass(frozen=True)
class Warmth:
    """Temperatures of a joint: `jtqd.sim_can.towing.plant`. ambient_c: room of the usual day."""

    reference_c: Annotated[float, limits("degC", ge=-40.0, le=100.0)] = 25.0
    ambient_c: Annotated[float, limits("degC", ge=-40.0, le=80.0)] = 25.0
    coulomb_per_k: Annotated[float, limits("1/K", ge=0.0, le=0.02)] = 0.0
    viscous_per_k: Annotated[float, limits("1/K", ge=0.0, le=0.1)] = 0.0
    grease_kelvin_per_w: Annotated[float, limits("K/W", ge=0.0, le=20.0)] = 0.0
    grease_time_constant_s: Annotated[float, limits("s", ge=10.0, le=1.0e4)] = 120.0
    housing_kelvin_per_w: Annotated[float, limits("K/W", ge=0.0, le=20.0)] = 0.0
    housing_time_constant_s: Annotated[float, limits("s", ge=10.0, le=1.0e5)] = 1200.0


@dataclass(frozen=True)
class Measurement(MeasurementParameters):
    """The same with errors of the scales and of the current's measurement: `jtqd.sim_can.drives.Encoders`."""

    motor_errors: tuple[AngleWave, ...] = ()
    link_errors: tuple[AngleWave, ...] = ()
    current_ripple: tuple[CurrentWave, ...] = ()


@dataclass(frozen=True)
class TowedJoint:
    """One joint of the bench (`joint_1`, `joint_2`); `joint` is what its drive and its user believe."""

    joint: Joint
    motor: Motor
    friction: Friction
    gear: Gear
    link_inertia_kgm2: float
    warmth: Warmth = field(default_factory=Warmth)
    measurement: Measurement = field(default_factory=Measurement)
    drive: DriveParameters = USUAL_DRIVE


@dataclass(frozen=True)
class TowingBench:
    """Both joints, the sensor, the days. Of `PlantParameters` it has what `PlantSource` asks for."""

    joints: tuple[TowedJoint, TowedJoint]
    sensor: SensorParameters = field(default_factory=SensorParameters)
    run_to_run: DayWidths = field(default_factory=DayWidths)
    substep_s: float = 125e-6

    @property
    def profile(self) -> str:
        """Motion while no master commands."""
        return "demo"

    @property
    def longest_step_s(self) -> float:
        """Largest integration step [s]: ω h <= 0.25 for every mode, as `jtqd.sim_can.plant_file.substep_limit` derives.

        The bristles' friction is implicit and needs no bound.
        """
        link = sum(side.link_inertia_kgm2 for side in self.joints)
        squares = [2.0 * sum(side.gear.stiffest for side in self.joints) / link]
        rates = [sum(side.gear.damping_nms_per_rad for side in self.joints) / link]
        for side in self.joints:
            ratio = side.joint.gear_ratio
            inertia = side.motor.rotor_inertia_kgm2 * (ratio / (1.0 + ratio * side.gear.steepest_error)) ** 2
            squares.append(2.0 * side.gear.stiffest / inertia)
            rates.append(side.gear.damping_nms_per_rad / inertia)
        step = min(self.substep_s, 0.25 / math.sqrt(max(squares)))
        return min(step, 0.25 / max(rates)) if max(rates) > 0.0 else step


def bench_from_mapping(
    mapping: Mapping[str, Any], where: str, joint_of: Callable[[str], Joint]
) -> TowingBench:
    """Return the checked bench of a file's mapping; joint_of(file name) -> Joint. Raises ConfigError."""
    with in_file(where):
        file = read(_BenchFile, mapping)
        sides = _joint("joint_1", file.joint_1, joint_of), _joint("joint_2", file.joint_2, joint_of)
    return TowingBench(sides, file.sensor, file.run_to_run, file.substep_s)


@dataclass(frozen=True)
class _JointFile:
    """`joint_1`, `joint_2` of a bench file."""

    joint: Text
    motor: Motor
    friction: Friction
    gear: Gear
    link_inertia_kgm2: Annotated[float, limits("kgm2", gt=0.0)]
    warmth: Warmth = Warmth()
    measurement: Measurement = Measurement()
    drive: DriveParameters = USUAL_DRIVE

    def __post_init__(self) -> None:
        for key, waves in (
            ("motor.cogging", self.motor.cogging),
            ("friction.angle", self.friction.angle),
            ("gear.errors", self.gear.errors),
            ("gear.slips", self.gear.slips),
            ("measurement.motor_errors", self.measurement.motor_errors),
            ("measurement.link_errors", self.measurement.link_errors),
            ("measurement.current_ripple", self.measurement.current_ripple),
        ):
            most = 6 if key == "gear.slips" else _MOST
            if len(waves) > most:
                raise FieldError("bench", key, Verbatim(f"{len(waves)} entries"), f"at most {most}")


def _joints(value: object) -> int:
    if value != 2 or isinstance(value, bool):
        raise ValueError("found another number of joints")
    return 2


@dataclass(frozen=True)
class _BenchFile:
    towing: Annotated[int, parsed(_joints, "2, the number of joints")]
    joint_1: _JointFile
    joint_2: _JointFile
    sensor: SensorParameters = field(default_factory=SensorParameters)
    run_to_run: DayWidths = field(default_factory=DayWidths)
    substep_s: Annotated[float, limits("s", ge=10e-6, le=500e-6)] = 125e-6


def _joint(key: str, file: _JointFile, joint_of: Callable[[str], Joint]) -> TowedJoint:
    joint = joint_of(file.joint)
    steepest = file.gear.steepest_error
    if joint.gear_ratio * steepest > STEEPEST_ERROR:
        limit = STEEPEST_ERROR / joint.gear_ratio
        with below(key):
            raise FieldError(
                "bench",
                "gear.errors",
                steepest,
                f"the sum of amplitude_rad times order <= {limit:g}, half of 1/gear_ratio",
            )
    return TowedJoint(**vars(file) | {"joint": joint})
