"""The bench of a campaign: its part of jtqd's configuration, the bus load with the commander, the motion."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Final

from jtqd.daemon.config import JointConfig, load_config
from jtqd.drivers.bus_load import BusLoad, BusLoadError, Row, check_bus_load, configured_load, heartbeat_row
from jtqd.drivers.drive import CIA_402, DriveProfile, Temperature
from jtqd.drivers.object_dictionary import Identity
from jtqd.drivers.own_objects import COMMANDER_NODE
from jtqd.drivers.pdo import PdoMap
from jtqd.drivers.sdo import Key, label, parse_key
from jtqd.drivers.sensor import SensorProfile
from jtqd.estimator.checked import ConfigError
from jtqd.estimator.joint import Joint
from jtqd.sysid.campaign.processes import on_time
from jtqd.sysid.motion.setpoints import (
    Limits,
    MotionResult,
    OutOfPlaceError,
    Setpoints,
    Surroundings,
    Timing,
)
from jtqd.sysid.motion.shell import Progress, play
from jtqd.sysid.planner.design import current_at
from jtqd.sysid.planner.single_joint import allowed_torque, approach

PERIOD_US: Final = 1000
LONGEST_PERIOD_US: Final = 10_000
_SETPOINT_RPDO: Final = 0x200  # or 300h+n: either way four bytes
_RPDO_BYTES: Final = 4
"""RPDO1: 6040h and 6071h; RPDO2: 60FFh."""


@dataclass(frozen=True)
class BenchConfig:
    """The part of jtqd's configuration that concerns the bench.

    Attributes:
        path: the file. drives: of joints 1, 2, ... joints: their joint files. channels: of the sensor, for each joint; None:
            it has none. temperatures: jtqd takes that of the joint. sensor: None without one. master: jtqd's own node-ID.
        period_us: of SYNC, whole milliseconds. tpdos: by node-ID, as they are wanted. contacts: jtqd sends their PDOs.
    """

    path: Path
    drives: tuple[DriveProfile, ...]
    joints: tuple[Joint, ...]
    channels: tuple[int | None, ...]
    temperatures: tuple[bool, ...]
    sensor: SensorProfile | None
    master: int
    heartbeat_ms: int
    bitrate: int
    period_us: int
    tpdos: Mapping[int, tuple[PdoMap, ...]]
    contacts: bool

    @classmethod
    def load(cls, path: Path | None) -> BenchConfig:
        """Read a configuration of jtqd (None: the one that ships).

        Raises:
            ConfigError: naming file, key, found and expected; also for a period of SYNC that is no whole milliseconds up to
                10, and for drives that tell what they are commanded by otherwise than CiA 402.
        """
        config = load_config(path)
        joints = config.joints
        period_us, rest_ns = divmod(config.period_ns, 1000)
        if rest_ns or period_us % PERIOD_US or period_us > LONGEST_PERIOD_US:
            raise ConfigError(
                f"{config.path}: key 'sync.period_us': found {period_us}, expected whole milliseconds up to "
                f"{LONGEST_PERIOD_US // PERIOD_US} for a campaign: set-points are that far apart"
            )
        sensor = config.sensor
        return cls(
            path=config.path,
            drives=tuple(_drive(config.path, joint) for joint in joints),
            joints=tuple(joint.joint for joint in joints),
            channels=tuple(joint.sensor_channel for joint in joints),
            temperatures=tuple(joint.temperature is not None for joint in joints),
            sensor=None
            if sensor is None
            else SensorProfile(
                sensor.node_id,
                Identity(**asdict(sensor.identity)),
                sensor.channels,
                _by_key(sensor.given),
                {int(word, 16): nm for word, nm in sensor.unit_words.items()},
            ),
            master=config.node_id,
            heartbeat_ms=config.heartbeat_ms,
            bitrate=config.bitrate,
            period_us=period_us,
            tpdos={joint.node_id: joint.tpdos for joint in joints},
            contacts=config.contact is not None and config.contact.pdo,
        )

    @property
    def nodes(self) -> tuple[int, ...]:
        """Node-IDs of the drives."""
        return tuple(drive.node_id for drive in self.drives)

    @property
    def period_s(self) -> float:
        """Period of SYNC."""
        return 1e-6 * self.period_us

    def measured(self, number: int) -> bool:
        """Return whether a channel of the torque sensor belongs to the joint."""
        return self.sensor is not None and self.channels[number - 1] is not None

    def check_temperature(self, limit_c: float) -> None:
        """Refuse a limit of the temperature where jtqd leaves that of a joint off.

        A drive on which the commander switched TPDO3 on would count as changed, and lose its inputs.

        Raises:
            ConfigError: naming file, joint and what to do.
        """
        if not math.isfinite(limit_c) or all(self.temperatures):
            return
        number = 1 + self.temperatures.index(False)
        raise ConfigError(
            f"{self.path}: joint_{number}: found no 'temperature: true', expected it for the limit of {limit_c:g} degC "
            "(--limit temperature_c=none: not supervised)"
        )

    def timing(self, timing: Timing) -> Timing:
        """Return times of the supervision at this period of SYNC: a set-point leaves at the same part of the cycle."""
        return replace(
            timing,
            period_s=self.period_s,
            setpoint_delay_s=timing.setpoint_delay_s / timing.period_s * self.period_s,
        )

    def around(self, run: Setpoints) -> Surroundings:
        """Return what is beside the joints of a run: those that are held may need what they need to carry their rating."""
        held = {
            number: current_at(joint, allowed_torque(joint), 0.0)
            for number, joint in enumerate(self.joints, 1)
            if number not in run.joints
        }
        own: dict[int, tuple[int, ...]] = {}
        for number in run.joints:
            channel = self.channels[number - 1]
            if channel is not None:
                own[channel] = (*own.get(channel, ()), number)
        # where there are no others, every channel of the sensor is theirs, named in the configuration or not
        everything = len(run.joints) == 2 == len(self.joints)
        return Surroundings(held, None if everything else own)

    @property
    def estimate_cob_id(self) -> int:
        """COB-ID of jtqd's estimate: it is publishing when this is on the bus."""
        return 0x180 + self.master

    def load_with_commander(self) -> BusLoad:
        """Load of the bus during a campaign: jtqd's configuration, and what the commander and its drives add.

        Set-points go to the drives in turn, so that a cycle holds one RPDO.

        Raises:
            ConfigError: above 95 % in the worst case, or two users of one COB-ID.
        """
        extra = [heartbeat_row("commander", COMMANDER_NODE, round(Timing().own_heartbeat_s * 1e3))]
        # any drive may be the velocity joint: both RPDOs have four bytes, so one row stands for both
        share = 1.0 / len(self.nodes)
        extra += [
            Row(_SETPOINT_RPDO + node, f"set-points of drive {node}", _RPDO_BYTES, share)
            for node in self.nodes
        ]
        try:
            return check_bus_load(
                configured_load(
                    self.tpdos,
                    {} if self.sensor is None else {self.sensor.node_id: self.sensor.channels},
                    temperatures=self.nodes,  # the commander switches TPDO3 on where jtqd does not
                    contacts=self.contacts,
                    heartbeat_ms=self.heartbeat_ms,
                    master=self.master,
                    extra=extra,
                    bitrate=self.bitrate,
                    period_s=self.period_s,
                )
            )
        except BusLoadError as error:
            raise ConfigError(f"{self.path}: with the commander's set-points: {error}") from None


def _by_key(given: Mapping[str, int]) -> dict[Key, int]:
    return {parse_key(name): value for name, value in given.items()}


def _drive(path: Path, joint: JointConfig) -> DriveProfile:
    """Return the drive as the commander takes it: by jtqd's configuration, as far as it can be commanded.

    60FFh counts as 606Ch does, and 6071h as 6077h, or as 6078h of 6075h. Raises ConfigError where the drive's velocity and
    current are told by other objects, with another sign, or not at each SYNC: it could be moved otherwise than is planned.
    """
    where, objects = f"{path}: key 'joint_{joint.number}", joint.objects
    if joint.max_age_ms:
        raise ConfigError(
            f"{where}.max_age_ms': found {joint.max_age_ms:g}, expected none for a campaign: a motion needs every value at "
            "each SYNC"
        )
    if objects.motor_velocity is None:
        raise ConfigError(
            f"{where}.objects.motor_velocity': found false, expected 606Ch for a campaign: it counts as 60FFh does, by "
            "which the drive is commanded"
        )
    for name, each, indices in (
        ("motor_velocity", objects.motor_velocity, (0x606C,)),
        ("current", objects.current, (0x6078, 0x6077)),
    ):
        if each.index not in indices or each.sign != 1:
            found = f"{label(each.index, each.subindex)}, sign {each.sign}"
            wanted = " or ".join(f"{index:04X}h" for index in indices)
            raise ConfigError(
                f"{where}.objects.{name}': found {found}, expected {wanted} with sign 1 for a campaign: the drive is "
                "commanded in its units"
            )
    if objects.statusword != CIA_402.statusword:
        raise ConfigError(f"{where}.objects.statusword': found another one, expected 6041h for a campaign")
    if joint.temperature not in (None, Temperature()):
        raise ConfigError(f"{where}.objects.temperature': found another one, expected 3001h for a campaign")
    return DriveProfile(
        joint.node_id,
        Identity(**asdict(joint.identity)),
        _by_key(joint.given),
        objects=objects,
        layout=joint.tpdos,
        torque_constant_nm_per_a=joint.joint.torque_constant_nm_per_a,
    )


Play = Callable[[Setpoints], MotionResult]
"""The motion itself: `jtqd.sysid.motion.shell.play` on the bench, or what a test puts in its place. Raises MotionError."""


@dataclass(frozen=True)
class Bench:
    """Where the runs take place: bus, jtqd's configuration (None: the one that ships) and what is in it.

    timing: of the commander's supervision; None: its own.
    """

    bus: str
    config_path: Path | None
    config: BenchConfig
    timing: Timing | None = None

    def play(self, limits_of: Callable[[Setpoints], Limits], on_progress: Progress) -> Play:
        """Return the commander on this bench; limits_of: what holds in a run."""
        timing = self.config.timing(self.timing or Timing())

        def played(setpoints: Setpoints) -> MotionResult:
            with on_time():
                return play(
                    self.bus,
                    setpoints,
                    limits_of(setpoints),
                    on_progress=on_progress,
                    drives=self.config.drives,
                    sensor=self.config.sensor,
                    timing=timing,
                    around=self.config.around(setpoints),
                )

        def motion(setpoints: Setpoints) -> MotionResult:
            """Play; a joint that is moved alone and stands elsewhere is brought to the middle of its travel first."""
            try:
                return played(setpoints)
            except OutOfPlaceError as away:
                low, high = limits_of(setpoints).position_rad
                middle = 0.5 * (low + high)
                there = approach(setpoints.velocity_joint, away.position_rad, middle, limits_of(setpoints))
                result = played(there)
                if result.status == "stopped":
                    return result._replace(
                        reason=f"on the way to {middle:g} rad: {result.reason}", played_s=0.0
                    )
                return played(setpoints)

        return motion
