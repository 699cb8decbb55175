"""The emulated bench: drives and a torque sensor around their sources. Frames and times in, frames out.

While no master commands the drives the bench moves them itself (`jtqd.sim_can.demo`). No socket, no clock.
"""

from __future__ import annotations

from collections.abc import Sequence

from jtqd.drivers.bus_socket import CanFilter, exact
from jtqd.drivers.nmt import HEARTBEAT_BASE
from jtqd.drivers.own_objects import COMMANDER_NODE, JTQD_NODE
from jtqd.drivers.pdo import SYNC_COB_ID
from jtqd.drivers.sdo import REQUEST_ID
from jtqd.sim_can.canopen_node import CanopenNode
from jtqd.sim_can.demo import demo_current, demo_velocity
from jtqd.sim_can.drive_node import DEFAULT_INTERPOLATION_S, OPERATION_ENABLED, DriveNode
from jtqd.sim_can.eds_entries import sensor_node
from jtqd.sim_can.sensor_node import SensorNode
from jtqd.sim_can.source import CURRENT, OFF, VELOCITY, DriveSignals, Source

CLOCK_STEP_NS = 100_000_000  # stamps and steady clock never differ by this from SYNC to SYNC, unless CLOCK_REALTIME was set
LONGEST_STEP_NS = 50_000_000  # a source never jumps further than this, however long SYNC was away
# a software stamp is no better; the plant then gets an exact grid wherever SYNC keeps one
RESOLUTION_NS = 10_000
IDLE_STEP_NS = 10_000_000  # step of powered drives once SYNC has been away for LONGEST_STEP_NS


def bench_filters(drives: int = 2) -> tuple[CanFilter, ...]:
    """Return filters for what the bench receives.

    NMT, SYNC, SDO requests, RPDOs 1 and 2 of so many drives, heartbeats of jtqd and of the node that commands.
    """
    ids = [0x000, SYNC_COB_ID, HEARTBEAT_BASE + JTQD_NODE, HEARTBEAT_BASE + COMMANDER_NODE]
    nodes = range(1, drives + 1)
    ids += [REQUEST_ID + node for node in (*nodes, sensor_node(drives))]
    ids += [base + node for base in (0x200, 0x300) for node in nodes]
    return tuple(exact(can_id) for can_id in ids)


def _rounded(time_ns: int) -> int:
    return (time_ns + RESOLUTION_NS // 2) // RESOLUTION_NS * RESOLUTION_NS


class Bench:
    """Nodes 1, 2, ... (drives) and 3 or 5 (sensor) of the bench. `over` turns True when a recorded run has ended.

    Args:
        source: of the first drives; its torque channels are those of the sensor.
        profile: "demo": while no master commands the drives, the first one of each source follows the built-in motion, the
            second one its load.
        more: sources of further drives, with the next channels.
        with_sensor: there is a sensor node.

    A source's time is the measured time since the first SYNC, in steps of RESOLUTION_NS: equal stamps give
    equal values, and so do stamps that differ by their own inaccuracy.
    """

    def __init__(
        self, source: Source, profile: str = "demo", more: Sequence[Source] = (), *, with_sensor: bool = True
    ) -> None:
        self.source = source
        self._sources = (source, *more)
        self.over = False
        drives: list[DriveNode] = []
        for each in self._sources:
            first = len(drives) + 1
            drives += [DriveNode(each, n, self._hand_over, first + n) for n in range(len(each.drives))]
        self.drives = tuple(drives)
        self.nodes: tuple[CanopenNode, ...] = self.drives
        if with_sensor:
            channels = [channel for each in self._sources for channel in each.channels]
            self.sensor = SensorNode(channels, sensor_node(len(drives)))
            self.nodes += (self.sensor,)
        self.sync_count = 0
        self._profile = profile
        self._profile_s = 0.0
        self._target_period_s = DEFAULT_INTERPOLATION_S  # of the built-in motion: as a master sets 60C2h
        self._first_stamp_ns = 0
        self._last_time_ns = 0  # of the last SYNC, since the first one
        self._last_steady_ns = 0  # steady clock at the last step, for idle steps
        self._sync_steady_ns = 0  # steady clock at the last SYNC
        self._idle_ns = 0  # source time spent in idle steps since the last SYNC

    @property
    def due_ns(self) -> int:
        """Steady time at which `tick` has something to do next."""
        due = min(node.due_ns for node in self.nodes)
        return min(due, self._idle_due_ns()) if self._moving() else due

    def on_frame(self, can_id: int, data: bytes, stamp_ns: int, now_ns: int) -> list[bytes]:
        """Handle a frame from the bus; return frames to send. stamp_ns: of its reception (kernel); now_ns: steady clock."""
        if can_id == SYNC_COB_ID:
            return self._on_sync(data, stamp_ns, now_ns)
        frames: list[bytes] = []
        for node in self.nodes:
            frames += node.on_frame(can_id, data, now_ns)
        return frames

    def tick(self, now_ns: int) -> list[bytes]:
        """Serve heartbeats and timers; advance powered drives when there is no SYNC."""
        frames: list[bytes] = []
        for node in self.nodes:
            if now_ns >= node.due_ns:
                frames += node.tick(now_ns)
        if self._moving() and now_ns >= self._idle_due_ns():
            step_ns = min(now_ns - self._last_steady_ns, LONGEST_STEP_NS)
            self._last_steady_ns = now_ns
            self._idle_ns += step_ns
            frames += self._advance(step_ns * 1e-9)
        return frames

    def _on_sync(self, data: bytes, stamp_ns: int, now_ns: int) -> list[bytes]:
        step_ns = 0
        if self.sync_count:
            time_ns = _rounded(stamp_ns - self._first_stamp_ns)
            since_ns, steady_ns = time_ns - self._last_time_ns, now_ns - self._sync_steady_ns
            if abs(since_ns - steady_ns) > CLOCK_STEP_NS:
                since_ns = _rounded(
                    steady_ns
                )  # a clock that was set must neither stop the bench nor hurry it
            # time that idle steps covered does not count twice
            step_ns = min(max(since_ns - self._idle_ns, 0), LONGEST_STEP_NS)
            self._last_time_ns = time_ns
        else:
            self._first_stamp_ns = stamp_ns
        self.sync_count += 1
        self._last_steady_ns = self._sync_steady_ns = now_ns
        self._idle_ns = 0
        self._target_period_s = max(round(step_ns * 1e-9, 3), DEFAULT_INTERPOLATION_S)
        frames = self._advance(step_ns * 1e-9)
        if self.over:
            return frames
        for node in self.nodes:
            frames += node.on_sync(data)
        return frames

    def _advance(self, dt_s: float) -> list[bytes]:
        for source in self._sources:
            if not source.advance(dt_s):
                self.over = True
                return []
        frames: list[bytes] = []
        for drive in self.drives:
            frames += drive.watch()
        if not self.drives[0].commanded:
            frames += self._by_itself(dt_s)
        return frames

    def _by_itself(self, dt_s: float) -> list[bytes]:
        """Run drives that no master commands: enabled by a recorded run, or by the built-in motion."""
        frames: list[bytes] = []
        if self._played():
            for drive, signal in zip(self.drives, self._signals(), strict=True):
                if signal.enabled:
                    frames += drive.run_by_itself(OFF, 0.0)
            return frames
        if all(drive.machine.state == OPERATION_ENABLED for drive in self.drives):
            self._profile_s += dt_s
        else:
            self._profile_s = 0.0  # start, or start again after a stop, from rest
        if self._profile != "demo":
            return []
        velocity, current = demo_velocity(self._profile_s), demo_current(self._profile_s)
        drives = iter(self.drives)
        for source in self._sources:
            gear = source.ratings[0].gear_ratio
            frames += next(drives).run_by_itself(VELOCITY, velocity * gear, self._target_period_s)
            if len(source.drives) > 1:
                frames += next(drives).run_by_itself(CURRENT, current)
        return frames

    def _signals(self) -> list[DriveSignals]:
        return [signals for source in self._sources for signals in source.drives]

    def _played(self) -> bool:
        """Return whether a recorded run is played."""
        return any(signals.enabled for signals in self._signals())

    def _hand_over(self) -> None:
        for drive in self.drives:
            drive.hand_over()

    def _idle_due_ns(self) -> int:
        return self._last_steady_ns + (IDLE_STEP_NS if self._idle_ns else LONGEST_STEP_NS)

    def _moving(self) -> bool:
        """Return whether drives go on without SYNC: powered ones of a plant do, a recorded run does not."""
        if not self.sync_count or self._played():
            return False
        return any(drive.machine.powered for drive in self.drives)
