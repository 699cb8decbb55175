"""The bench of a campaign: its part of jtqd's configuration, the bus load with the commander, the motion."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from jtqd.daemon.config import JointConfig, load_config
from jtqd.drivers.bus_load import BusLoad, BusLoadError, Row, check_bus_load, configured_load, heartbeat_row
from jtqd.drivers.devices import (
    CIA_402,
    COMMANDER_NODE,
    DriveProfile,
    Identity,
    SensorProfile,
    parse_key,
)
from jtqd.drivers.pdo import PdoMap
from jtqd.drivers.sdo import Key, label
from jtqd.estimator.checked import ConfigError
from jtqd.estimator.joint import Joint
from jtqd.sysid.campaign.processes import on_time
from jtqd.sysid.motion.setpoints import Limits, MotionResult, Setpoints, Timing
from jtqd.sysid.motion.shell import Progress, play

PERIOD_US: Final = 1000
_SETPOINT_RPDO: Final = 0x200  # or 300h+n: either way four bytes
_RPDO_BYTES: Final = 4
"""RPDO1: 6040h and 6071h; RPDO2: 60FFh."""


@dataclass(frozen=True)
class BenchConfig:
    """The part of jtqd's configuration that concerns the bench.

    Attributes:
        path: the file. drives: of joint 1 and 2. joints: their joint files. tpdos: by node-ID, as they are wanted.
        sensor: None without one. master: jtqd's own node-ID.
    """

    path: Path
    drives: tuple[DriveProfile, DriveProfile]
    joints: tuple[Joint, Joint]
    sensor: SensorProfile | None
    master: int
    heartbeat_ms: int
    bitrate: int
    tpdos: Mapping[int, tuple[PdoMap, ...]]

    @classmethod
    def load(cls, path: Path | None) -> BenchConfig:
        """Read a configuration of jtqd (None: the one that ships).

        Raises:
            ConfigError: naming file, key, found and expected; also for a period of SYNC other than 1 ms, and for drives
                that tell what they are commanded by otherwise than CiA 402.
        """
        config = load_config(path)
        numbers = [joint.number for joint in config.joints]
        if numbers != [1, 2]:
            raise ConfigError(
                f"{config.path}: found {', '.join(f'joint_{n}' for n in numbers)}, expected joint_1 and joint_2: a campaign "
                "moves two joints that are coupled, and no others may be on the bus; logs of other motions are read by jtq "
                "diagnose"
            )
        if config.period_ns != PERIOD_US * 1000:
            raise ConfigError(
                f"{config.path}: key 'sync.period_us': found {config.period_ns // 1000}, expected {PERIOD_US} for a campaign"
            )
        one, two = config.joints
        sensor = config.sensor
        return cls(
            path=config.path,
            drives=(_drive(config.path, one), _drive(config.path, two)),
            joints=(one.joint, two.joint),
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
            tpdos={joint.node_id: joint.tpdos for joint in config.joints},
        )

    @property
    def nodes(self) -> tuple[int, int]:
        """Node-IDs of drive 1 and 2."""
        return self.drives[0].node_id, self.drives[1].node_id

    @property
    def estimate_cob_id(self) -> int:
        """COB-ID of jtqd's estimate: it is publishing when this is on the bus."""
        return 0x180 + self.master

    def load_with_commander(self) -> BusLoad:
        """Load of the bus during a campaign: jtqd's configuration, and what the commander and its drives add.

        Set-points go to the two drives in turn, so that a cycle holds one RPDO.

        Raises:
            ConfigError: above 95 % in the worst case, or two users of one COB-ID.
        """
        extra = [heartbeat_row("commander", COMMANDER_NODE, round(Timing().own_heartbeat_s * 1e3))]
        # either drive may be the velocity joint: both RPDOs have four bytes, so one row stands for both
        extra += [
            Row(_SETPOINT_RPDO + node, f"set-points of drive {node}", _RPDO_BYTES, 0.5) for node in self.nodes
        ]
        try:
            return check_bus_load(
                configured_load(
                    self.tpdos,
                    {} if self.sensor is None else {self.sensor.node_id: self.sensor.channels},
                    temperatures=self.nodes,  # the commander switches TPDO3 on where jtqd does not
                    heartbeat_ms=self.heartbeat_ms,
                    master=self.master,
                    extra=extra,
                    bitrate=self.bitrate,
                    period_s=1e-6 * PERIOD_US,
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

    def play(self, limits: Limits, on_progress: Progress) -> Play:
        """Return the commander on this bench."""

        def motion(setpoints: Setpoints) -> MotionResult:
            with on_time():
                return play(
                    self.bus,
                    setpoints,
                    limits,
                    on_progress=on_progress,
                    drives=self.config.drives,
                    sensor=self.config.sensor,
                    timing=self.timing,
                )

        return motion
