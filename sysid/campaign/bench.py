"""The bench of a campaign: its part of jtqd's configuration, the bus load with the commander, the motion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from jtqd.drivers.boot_request import RequestError, parse_request
from jtqd.drivers.bus_load import BusLoad, BusLoadError, Row, check_bus_load, configured_load, heartbeat_row
from jtqd.drivers.devices import COMMANDER_NODE, DriveProfile, SensorProfile
from jtqd.estimator.checked import ConfigError, Section
from jtqd.estimator.joint import Joint
from jtqd.models.files import load_joint, load_yaml, shipped
from jtqd.sysid.campaign.processes import on_time
from jtqd.sysid.motion.setpoints import Limits, MotionResult, Setpoints, Timing
from jtqd.sysid.motion.shell import Progress, play

DEFAULT_CONFIG: Final = "bench.yaml"
PERIOD_US: Final = 1000
_SETPOINT_RPDO: Final = 0x200  # or 300h+n: either way four bytes
_RPDO_BYTES: Final = 4
"""RPDO1: 6040h and 6071h; RPDO2: 60FFh."""


@dataclass(frozen=True)
class BenchConfig:
    """The part of jtqd's configuration that concerns the bench.

    Attributes:
        path: the file. drives: of joint 1 and 2. joints: their joint files.
        sensor: None without one. master: jtqd's own node-ID.
    """

    path: Path
    drives: tuple[DriveProfile, DriveProfile]
    joints: tuple[Joint, Joint]
    sensor: SensorProfile | None
    master: int
    heartbeat_ms: int
    bitrate: int

    @classmethod
    def load(cls, path: Path | None) -> BenchConfig:
        """Read a configuration of jtqd (None: the one that ships); what is not asked for here jtqd checks itself.

        Raises:
            ConfigError: naming file, key, found and expected; also for a period of SYNC other than 1 ms.
        """
        path = path if path is not None else shipped(DEFAULT_CONFIG)
        mapping = load_yaml(path)
        top = Section(mapping, str(path))
        joints = [name for name in (f"joint_{number}" for number in range(1, 5)) if top.has(name)]
        if joints != ["joint_1", "joint_2"]:
            raise ConfigError(
                f"{path}: found {', '.join(joints) or 'no joint'}, expected joint_1 and joint_2: a campaign moves two "
                "joints that are coupled, and no others may be on the bus; logs of other motions are read by jtq diagnose"
            )
        sync = top.section("sync", optional=True)
        if sync is not None:
            sync.integer("period_us", low=PERIOD_US, high=PERIOD_US, default=PERIOD_US)
        sections = [top.required(name) for name in joints]
        files = [load_joint(path.parent / joint.text("file")) for joint in sections]
        nodes = [_node(joint, "drive") for joint in sections]
        sensor = top.section("sensor", optional=True)
        if sensor is not None:
            nodes.append(_node(sensor, "sensor"))
        master = top.integer("node_id", low=1, high=127)
        try:
            request = parse_request({"bus": "-", "nodes": nodes, "master_node": master})
        except RequestError as error:
            raise ConfigError(f"{path}: {error}") from None
        one, two = (each for each in request.profiles if isinstance(each, DriveProfile))
        timing = top.section("nodes", optional=True)
        return cls(
            path=path,
            drives=(one, two),
            joints=(files[0], files[1]),
            sensor=next((each for each in request.profiles if isinstance(each, SensorProfile)), None),
            master=master,
            heartbeat_ms=100 if timing is None else timing.integer("heartbeat_ms", low=10, default=100),
            bitrate=top.integer("bitrate", low=10_000, high=1_000_000, default=1_000_000),
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
                    self.nodes,
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


def _node(section: Section, kind: str) -> dict[str, Any]:
    """Return a node of the configuration as the boot takes it: the commander asks of it what jtqd's boot asks."""
    node = {"node": section.integer("node", low=1, high=127), "kind": kind}
    node |= {key: section.raw(key) for key in ("identity", "given", "unit_words") if section.has(key)}
    if kind == "sensor":
        node["channels"] = list(range(1, section.integer("channels", low=1, high=2, default=1) + 1))
    return node


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
