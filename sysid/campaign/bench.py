"""The bench of a campaign: its part of jtqd's configuration, the bus load with the commander, the motion."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from jtqd.drivers.boot_request import RequestError, parse_request
from jtqd.drivers.bus_load import BusLoad, BusLoadError, Row, check_bus_load, configured_load, heartbeat_row
from jtqd.drivers.devices import COMMANDER_NODE, DriveProfile, SensorProfile
from jtqd.estimator.checked import ConfigError, Section
from jtqd.estimator.joint import Joint
from jtqd.models.files import load_joint, load_yaml, shipped
from jtqd.sysid.campaign.alone import allowed_torque
from jtqd.sysid.campaign.processes import on_time
from jtqd.sysid.excitation.model import current_at
from jtqd.sysid.motion.setpoints import (
    MOST_JOINTS,
    Limits,
    MotionResult,
    OutOfPlaceError,
    Setpoints,
    Surroundings,
    Timing,
    approach,
)
from jtqd.sysid.motion.shell import Progress, play

DEFAULT_CONFIG: Final = "bench.yaml"
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
        period_us: of SYNC, whole milliseconds.
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

    @classmethod
    def load(cls, path: Path | None) -> BenchConfig:
        """Read a configuration of jtqd (None: the one that ships); what is not asked for here jtqd checks itself.

        Raises:
            ConfigError: naming file, key, found and expected; also for a period of SYNC that is no whole milliseconds.
        """
        path = path if path is not None else shipped(DEFAULT_CONFIG)
        mapping = load_yaml(path)
        top = Section(mapping, str(path))
        joints = [
            name for name in (f"joint_{number}" for number in range(1, MOST_JOINTS + 1)) if top.has(name)
        ]
        if not joints or joints[-1] != f"joint_{len(joints)}":
            raise ConfigError(
                f"{path}: found {', '.join(joints) or 'no joint'}, expected joint_1 to joint_{MOST_JOINTS} without a gap"
            )
        sync = top.section("sync", optional=True)
        period_us = PERIOD_US
        if sync is not None:
            period_us = sync.integer("period_us", low=PERIOD_US, high=LONGEST_PERIOD_US, default=PERIOD_US)
            if period_us % PERIOD_US:
                raise sync.error("period_us", period_us, "whole milliseconds: set-points are that far apart")
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
        timing = top.section("nodes", optional=True)
        return cls(
            path=path,
            drives=tuple(each for each in request.profiles if isinstance(each, DriveProfile)),
            joints=tuple(files),
            channels=tuple(
                joint.integer("sensor_channel", low=1, high=2) if joint.has("sensor_channel") else None
                for joint in sections
            ),
            temperatures=tuple(
                joint.has("temperature") and joint.raw("temperature") is True for joint in sections
            ),
            sensor=next((each for each in request.profiles if isinstance(each, SensorProfile)), None),
            master=master,
            heartbeat_ms=100 if timing is None else timing.integer("heartbeat_ms", low=10, default=100),
            bitrate=top.integer("bitrate", low=10_000, high=1_000_000, default=1_000_000),
            period_us=period_us,
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
                    self.nodes,
                    {} if self.sensor is None else {self.sensor.node_id: self.sensor.channels},
                    temperatures=self.nodes,  # the commander switches TPDO3 on where jtqd does not
                    heartbeat_ms=self.heartbeat_ms,
                    master=self.master,
                    extra=extra,
                    bitrate=self.bitrate,
                    period_s=self.period_s,
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
