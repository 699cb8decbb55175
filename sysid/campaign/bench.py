"""The bench of a campaign: jtqd's configuration as the commander takes it, the load of the bus, the motion."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Final, NoReturn

from jtqd.daemon.config import Config, JointConfig, SensorConfig, load_config
from jtqd.drivers.bus_load import BusLoad, BusLoadError, Row, check_bus_load, configured_load, heartbeat_row
from jtqd.drivers.drive import CIA_402, DriveProfile, Temperature
from jtqd.drivers.object_dictionary import Identity
from jtqd.drivers.own_objects import COMMANDER_NODE
from jtqd.drivers.sdo import Key, label, parse_key
from jtqd.drivers.sensor import SensorProfile
from jtqd.estimator.decoder import FieldError, below, in_file
from jtqd.estimator.errors import ConfigError, Verbatim
from jtqd.estimator.joint import Joint
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

_LONGEST_PERIOD_MS: Final = 10
_SETPOINT_RPDO: Final = 0x200  # or 300h+n: either way four bytes
_RPDO_BYTES: Final = 4
"""RPDO1: 6040h and 6071h; RPDO2: 60FFh."""
_COMMANDER_PRIORITY: Final = 30


@dataclass(frozen=True)
class BenchConfig:
    """jtqd's configuration of the bench.

    Attributes:
        joints: parameters of joints 1, 2, ... drives: their drives. sensor: None without one.
    """

    config: Config
    joints: tuple[Joint, ...]
    drives: tuple[DriveProfile, ...]
    sensor: SensorProfile | None

    @classmethod
    def load(cls, path: Path | None) -> BenchConfig:
        """Read a configuration of jtqd (None: the one that ships).

        Raises:
            ConfigError: naming file, key, found and expected; also for a period of SYNC that is no whole milliseconds up to
                10, and for drives whose velocity, current or state are not in the objects that command them (CiA 402).
        """
        config = load_config(path)
        with in_file(str(config.path)):
            if config.period_ns % 1_000_000 or config.period_ns > _LONGEST_PERIOD_MS * 1_000_000:
                expected = f"whole milliseconds up to {_LONGEST_PERIOD_MS} for a campaign: set-points are that far apart"
                raise FieldError("sync", "sync.period_us", config.period_ns // 1000, expected)
            drives = []
            for joint in config.joints:
                with below(f"joint_{joint.number}"):
                    drives.append(_drive(joint))
        sensor = None if config.sensor is None else _sensor(config.sensor)
        return cls(config, tuple(joint.joint for joint in config.joints), tuple(drives), sensor)

    @property
    def path(self) -> Path:
        """The file."""
        return self.config.path

    @property
    def channels(self) -> tuple[int | None, ...]:
        """Channel of the torque sensor of each joint; None: it has none."""
        return tuple(joint.sensor_channel for joint in self.config.joints)

    @property
    def nodes(self) -> tuple[int, ...]:
        """Node-IDs of the drives."""
        return tuple(drive.node_id for drive in self.drives)

    @property
    def period_s(self) -> float:
        """Period of SYNC."""
        return 1e-9 * self.config.period_ns

    @property
    def estimate_cob_id(self) -> int:
        """COB-ID of the estimate PDO that jtqd publishes."""
        return 0x180 + self.config.node_id

    def measured(self, number: int) -> bool:
        """Return whether a channel of the torque sensor belongs to the joint."""
        return self.sensor is not None and self.channels[number - 1] is not None

    def check_temperature(self, limit_c: float) -> None:
        """Refuse a limit of the temperature where jtqd does not receive that of a joint.

        The commander cannot switch TPDO3 on: jtqd would take the drive for a changed one and drop its inputs.

        Raises:
            ConfigError: naming file, joint and what to do.
        """
        for number, joint in enumerate(self.config.joints, 1):
            if joint.temperature is None and math.isfinite(limit_c):
                raise ConfigError(
                    f"{self.path}: joint_{number}: found no 'temperature: true', expected it for the limit of {limit_c:g} "
                    "degC (--limit temperature_c=none: not supervised)"
                )

    def timing(self, timing: Timing) -> Timing:
        """Return the supervision's times at this period of SYNC: a set-point leaves at the same part of the cycle."""
        delay_s = timing.setpoint_delay_s / timing.period_s * self.period_s
        return replace(timing, period_s=self.period_s, setpoint_delay_s=delay_s)

    def around(self, run: Setpoints) -> Surroundings:
        """Return the joints and sensor channels of the bus that are not moved by a run.

        A joint that is held may take the current of its rated torque.
        """
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
        # two joints alone on the bus: every channel of the sensor is theirs, named in the configuration or not
        return Surroundings(held, None if len(run.joints) == 2 == len(self.joints) else own)

    def load_with_commander(self) -> BusLoad:
        """Return the load of the bus during a campaign: jtqd's configuration, the commander's heartbeat and set-points.

        Set-points go to the drives in turn, so that a cycle holds one RPDO.

        Raises:
            ConfigError: above 95 % in the worst case, or two users of one COB-ID.
        """
        config = self.config
        share = 1.0 / len(self.nodes)
        extra = [heartbeat_row("commander", COMMANDER_NODE, round(Timing().own_heartbeat_s * 1e3))]
        extra += [
            Row(_SETPOINT_RPDO + node, f"set-points of drive {node}", _RPDO_BYTES, share)
            for node in self.nodes
        ]
        try:
            return check_bus_load(
                configured_load(
                    {joint.node_id: joint.tpdos for joint in config.joints},
                    {} if self.sensor is None else {self.sensor.node_id: self.sensor.channels},
                    temperatures=self.nodes,
                    contacts=config.contact is not None and config.contact.pdo,
                    heartbeat_ms=config.heartbeat_ms,
                    master=config.node_id,
                    extra=extra,
                    bitrate=config.bitrate,
                    period_s=self.period_s,
                )
            )
        except BusLoadError as error:
            raise ConfigError(f"{self.path}: with the commander's set-points: {error}") from None


def _sensor(sensor: SensorConfig) -> SensorProfile:
    words = {int(word, 16): nm for word, nm in sensor.unit_words.items()}
    identity = Identity(**asdict(sensor.identity))
    return SensorProfile(sensor.node_id, identity, sensor.channels, _by_key(sensor.given), words)


def _by_key(given: Mapping[str, int]) -> dict[Key, int]:
    return {parse_key(name): value for name, value in given.items()}


def _drive(joint: JointConfig) -> DriveProfile:
    """Return the drive of a joint, as far as it can be commanded.

    60FFh counts as 606Ch does, and 6071h as 6077h, or as 6078h of 6075h. Raises FieldError where velocity or current come
    from other objects, with another sign, or not at each SYNC: the motion would not be the planned one.
    """
    objects = joint.objects

    def refuse(key: str, found: object, expected: str) -> NoReturn:
        raise FieldError(f"joint_{joint.number}", key, found, expected)

    if joint.max_age_ms:
        age = Verbatim(f"{joint.max_age_ms:g}")
        refuse("max_age_ms", age, "none for a campaign: a motion needs every value at each SYNC")
    if objects.motor_velocity is None:
        expected = "606Ch for a campaign: it counts as 60FFh does, by which the drive is commanded"
        refuse("objects.motor_velocity", Verbatim("false"), expected)
    for name, each, indices in (
        ("motor_velocity", objects.motor_velocity, (0x606C,)),
        ("current", objects.current, (0x6078, 0x6077)),
    ):
        if each.index not in indices or each.sign != 1:
            found = Verbatim(f"{label(each.index, each.subindex)}, sign {each.sign}")
            wanted = " or ".join(f"{index:04X}h" for index in indices)
            expected = f"{wanted} with sign 1 for a campaign: the drive is commanded in its units"
            refuse(f"objects.{name}", found, expected)
    if objects.statusword != CIA_402.statusword:
        refuse("objects.statusword", Verbatim("another one"), "6041h for a campaign")
    if joint.temperature not in (None, Temperature()):
        refuse("objects.temperature", Verbatim("another one"), "3001h for a campaign")
    return DriveProfile(
        joint.node_id,
        Identity(**asdict(joint.identity)),
        _by_key(joint.given),
        objects=objects,
        layout=joint.tpdos,
        torque_constant_nm_per_a=joint.joint.torque_constant_nm_per_a,
    )


Play = Callable[[Setpoints], MotionResult]
"""The motion: `jtqd.sysid.motion.shell.play` on the bench, or that of a test. Raises MotionError."""


@dataclass(frozen=True)
class Bench:
    """Where the runs take place: bus, jtqd's configuration (None: the one that ships) and its content.

    timing: of the commander's supervision; None: its own.
    """

    bus: str
    config_path: Path | None
    config: BenchConfig
    timing: Timing | None = None

    def play(self, limits_of: Callable[[Setpoints], Limits], on_progress: Progress) -> Play:
        """Return the commander on this bench; limits_of: the limits of a run."""
        timing = self.config.timing(self.timing or Timing())

        def played(setpoints: Setpoints) -> MotionResult:
            with _real_time():
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
                limits = limits_of(setpoints)
                middle = 0.5 * sum(limits.position_rad)
                result = played(approach(setpoints.velocity_joint, away.position_rad, middle, limits))
                if result.status == "stopped":
                    reason = f"on the way to {middle:g} rad: {result.reason}"
                    return result._replace(reason=reason, played_s=0.0)
                return played(setpoints)

        return motion


@contextmanager
def _real_time() -> Iterator[None]:
    """Give this process a real-time priority below jtqd's loop and the emulated drives, where permitted."""
    before, priority = os.sched_getscheduler(0), os.sched_getparam(0)
    with suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_COMMANDER_PRIORITY))
    try:
        yield
    finally:
        with suppress(PermissionError):
            os.sched_setscheduler(0, before, priority)
