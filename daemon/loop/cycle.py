"""One cycle of the loop, stage by stage. The stages are methods of `Cycle`, so that a benchmark can time each of them.

    begin    take what came late, send SYNC
    gather   one wake-up for all inputs, then wait for stragglers until the deadline
    observe  scale, estimate, decide the status of both joints
    publish  send the estimate PDO, and every n-th cycle the heartbeat
    record   hand the cycle to the ring, and every n-th cycle the snapshot

No stage raises because of what is on the bus; a bus that is down is a counter and a stale estimate.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Collection, Sequence
from operator import attrgetter

from jtqd.daemon.loop import estimate_pdo
from jtqd.daemon.loop.counters import LoopCounters
from jtqd.daemon.loop.intake import Intake
from jtqd.daemon.loop.joint import JointCycle, JointInputs
from jtqd.daemon.loop.joint_status import JointSafety
from jtqd.daemon.loop.schedule import Grid, NetworkBudget, WakeUp
from jtqd.daemon.shared import cycle_record as cr
from jtqd.daemon.shared.ring import Ring
from jtqd.daemon.shared.snapshot import Snapshot
from jtqd.drivers.frame import pack
from jtqd.drivers.frame_socket import BusDown, FrameSocket
from jtqd.drivers.nmt import OPERATIONAL, heartbeat
from jtqd.estimator import status as st
from jtqd.estimator.methods import AnyEstimator


class ConfiguredNodes:
    """Nodes that restarted, are in doubt or were absent at the start; they are used after the supervisor configured them.

    It looks at the snapshot's `configured` while a node waits. What counts is a configuration that was noted after the node
    had begun to wait: one that was only stopped is configured again without ever waiting, and that must not answer for its
    next restart. And it must have begun after the node's last boot-up message: a node may restart when its boot has just
    ended and is not yet noted.
    """

    def __init__(self, snapshot: Snapshot, intake: Intake, joints: Sequence[JointCycle]) -> None:
        self._snapshot, self._intake, self._joints = snapshot, intake, joints
        self._since = {node: snapshot.configured[node] for node in intake.unconfigured}
        self._doubts = list(snapshot.doubts)

    def look(self) -> None:
        """Check for configured nodes between the inputs of a cycle and its estimate."""
        intake, snapshot = self._intake, self._snapshot
        for node in intake.unconfigured:
            now = snapshot.configured[node]
            if self._since.setdefault(node, now) == now:
                continue
            if snapshot.configured_for[node] != intake.nodes.restarts.get(node, 0):
                self._since[node] = now
                continue
            del self._since[node]
            intake.configured(node)
            snapshot.unconfigured[node] = 0
            for joint in self._joints:
                if intake.pdos[joint.inputs.position].node_id == node:
                    joint.begin_again()
                joint.rescale(node, snapshot.factors(node))

    def doubt(self) -> None:
        """Stop using, between two cycles, the nodes that the supervisor found differently configured."""
        doubts = self._snapshot.doubts
        for node, (before, now) in enumerate(zip(self._doubts, doubts, strict=True)):
            if now != before:
                self._doubts[node] = now
                self._intake.nodes.doubt(node)


class CycleFrames:
    """Frames of a cycle, copied unchanged into its record: 16 bytes each beside their stamps.

    Attributes:
        slot: record of the current cycle in the ring.
        count: frames stored in it.
        left_out: frames of the cycle that found no room.
    """

    def __init__(self, slot: memoryview) -> None:
        self.slot = slot
        self.count = self.left_out = 0
        self._held: list[tuple[bytes, int]] = []
        self._stamps = [struct.Struct(f"<{n}q") for n in range(cr.FRAME_CAPACITY + 1)]

    def begin(self, slot: memoryview) -> None:
        """Store the next frames in this record."""
        self.slot = slot
        self.count = self.left_out = 0
        if self._held:
            for frame, stamp_ns in self._held:
                self.keep_one(frame, stamp_ns)
            self._held.clear()

    def hold(
        self, frames: bytearray, stamps_ns: Sequence[int], count: int, identifiers: Collection[int]
    ) -> None:
        """Keep frames of a slot without a record for the next one that has one: those with these identifiers."""
        for n in range(count):
            frame = bytes(frames[16 * n : 16 * n + 16])
            if int.from_bytes(frame[:4], "little") in identifiers:
                self._held.append((frame, stamps_ns[n]))

    def keep(self, frames: bytearray, stamps_ns: Sequence[int], count: int) -> None:
        """Copy `count` received frames; `stamps_ns` are CLOCK_REALTIME."""
        stored = self.count
        room = cr.FRAME_CAPACITY - stored
        if count > room:
            self.left_out += count - room
            count = room
        if count <= 0:
            return
        start = cr.FRAMES_OFFSET + 16 * stored
        self.slot[start : start + 16 * count] = memoryview(frames)[: 16 * count]
        self._stamps[count].pack_into(self.slot, cr.STAMPS_OFFSET + 8 * stored, *stamps_ns[:count])
        self.count = stored + count

    def keep_one(self, frame: bytes, stamp_ns: int) -> None:
        """Copy one frame; of our own, `stamp_ns` (CLOCK_REALTIME) is when it was handed to the socket."""
        stored = self.count
        if stored >= cr.FRAME_CAPACITY:
            self.left_out += 1
            return
        start = cr.FRAMES_OFFSET + 16 * stored
        self.slot[start : start + 16] = frame
        self._stamps[1].pack_into(self.slot, cr.STAMPS_OFFSET + 8 * stored, stamp_ns)
        self.count = stored + 1


STARTING_CYCLES = 20
"""Cycles at the start that are published as "starting": the arrival bands and the filters see their first inputs."""
_SNAPSHOT_EVERY = 8
_CLOCK_READING_NS = 20_000
"""Both clocks are read within this, or their difference is not taken."""
_counted = attrgetter("stale_inputs", "late_frames", "duplicate_frames", "rejected_frames")


class Cycle:
    """State of the loop and its stages.

    Args:
        socket: frame socket with filters for SYNC, the inputs and the nodes' heartbeats, own echo on.
        intake: the rule that says which frame belongs to which cycle.
        joints: inputs and estimator of joint 1 and 2.
        ring, snapshot: shared memory towards recorder and viewers.
        safety: limits and checks of joint 1 and 2; None for those that need no joint file.
        node_id: own node-ID; the estimate PDO is 180h + node_id, the heartbeat 700h + node_id.
        counter_overflow: SYNC counter runs 1..overflow (1019h).
        wait_ns, deadline_ns: from SYNC to the wake-up for the inputs (it follows their arrival) and to the end of the wait.
        heartbeat_cycles: cycles between two heartbeats.
        grid: time grid; its slot is the current cycle's.

    Attributes:
        configured_nodes: nodes that restarted or are in doubt, until they are configured.
    """

    def __init__(
        self,
        socket: FrameSocket,
        intake: Intake,
        joints: Sequence[tuple[JointInputs, AnyEstimator]],
        ring: Ring,
        snapshot: Snapshot,
        *,
        safety: Sequence[JointSafety] | None = None,
        node_id: int,
        counter_overflow: int,
        wait_ns: int,
        deadline_ns: int,
        heartbeat_cycles: int,
        grid: Grid,
    ) -> None:
        self.socket, self.intake, self.ring, self.snapshot, self.grid = socket, intake, ring, snapshot, grid
        limits = safety or (JointSafety(), JointSafety())
        self._joints = [
            JointCycle(
                n, *joint, intake=intake, snapshot=snapshot, period_ns=grid.period_ns, safety=limits[n]
            )
            for n, joint in enumerate(joints)
        ]
        self._budget = NetworkBudget()
        self._temperatures = intake.temperatures
        self._temperature_ids = frozenset(each.cob_id for each in intake.temperatures)
        self._frames = CycleFrames(ring.slot())
        self._counters = LoopCounters(snapshot, intake, socket)
        self._overflow = counter_overflow
        self._wake_up = WakeUp(wait_ns, deadline_ns)
        self._sync_frames = [pack(0x080, bytes((n,))) for n in range(counter_overflow + 1)]
        self._estimate_id = 0x180 + node_id
        self._heartbeat = heartbeat(node_id, OPERATIONAL)
        self._heartbeat_cycles, self._heartbeat_due = heartbeat_cycles, 0
        self.index = self.counter = self.late_ns = 0
        self._flags = self._next_flags = 0
        self._sync_ns = self._realtime_offset_ns = self._sync_realtime_ns = self._work_start_ns = 0
        self._before = (0, 0, 0, 0)
        self.configured_nodes = ConfiguredNodes(snapshot, intake, self._joints)

    def begin(self) -> None:
        """Drain the frames received after the last cycle was closed, then send SYNC."""
        intake, socket = self.intake, self.socket
        self._frames.begin(self.ring.slot())
        self._flags, self._next_flags = self._next_flags, 0
        self._before = _counted(intake)
        count = self._receive()
        if count:
            intake.drain(socket.frames, socket.stamps_ns, socket.own, count)
            self._frames.keep(socket.frames, socket.stamps_ns, count)
        self.counter = self.counter % self._overflow + 1
        intake.begin(self.counter)
        before = time.monotonic_ns()
        realtime = time.time_ns()
        now = time.monotonic_ns()
        if now - before < _CLOCK_READING_NS or not self._realtime_offset_ns:
            self._realtime_offset_ns = realtime - now  # else something came between: the last one is better
        self._send(self._sync_frames[self.counter])
        self._sync_ns = now
        self.late_ns = now - self.grid.slot_ns

    def gather(self) -> None:
        """Take the inputs: one wake-up for all that have come, then wait for the missing ones until the deadline."""
        due = self._sync_ns + self._wake_up.wait_ns
        pause = due - time.monotonic_ns()
        if pause > 0:
            time.sleep(pause * 1e-9)
        self._work_start_ns = time.monotonic_ns()
        intake, socket = self.intake, self.socket
        deadline = min(
            self._sync_ns + self._wake_up.deadline_ns, self.grid.slot_ns + self.grid.period_ns - 100_000
        )
        done = False
        while True:
            count = self._receive()
            if count:
                done = intake.take(socket.frames, socket.stamps_ns, socket.own, count)
                self._frames.keep(socket.frames, socket.stamps_ns, count)
            if done:
                break
            left = deadline - time.monotonic_ns()
            if left <= 0 or not socket.wait(left * 1e-9):
                break
        if intake.close():
            self._flags |= cr.FLAG_COMPLETE
            self._wake_up.follow(intake.last_delay_ns)
        for temperature in self._temperatures:
            temperature.at(self.index)
        if intake.unconfigured:
            self.configured_nodes.look()
        if intake.sync_stamp_ns:
            self._flags |= cr.FLAG_SYNC_CONFIRMED
            self._sync_realtime_ns = intake.sync_stamp_ns
        else:
            self._sync_realtime_ns = self._sync_ns + self._realtime_offset_ns

    def observe(self) -> None:
        """Estimate both joints from the inputs of this cycle; without their networks if there is no time for them."""
        sync_ns = self._sync_realtime_ns - self._realtime_offset_ns
        starting = self.index < STARTING_CYCLES
        one, two = self._joints
        budget, grid = self._budget, self.grid
        wanted = budget.first(time.monotonic_ns(), grid.slot_ns + grid.period_ns)
        one.observe(sync_ns, starting, wanted)
        wanted = budget.second(time.monotonic_ns())
        two.observe(sync_ns, starting, wanted)

    def publish(self) -> None:
        """Send the estimate PDO, and the heartbeat when it is due. A late estimate is withdrawn."""
        one, two = self._joints
        now = time.monotonic_ns()
        self._budget.ended(now)
        if now >= self.grid.slot_ns + self.grid.period_ns:
            one.withdraw()
            two.withdraw()
            self._flags |= cr.FLAG_WITHDRAWN
            self._counters.overruns += 1
        frame = pack(self._estimate_id, estimate_pdo.encode(one.published, two.published, self.counter))
        if self._send(frame):
            self._flags |= cr.FLAG_PUBLISHED
            if time.monotonic_ns() < self.grid.slot_ns + self.grid.period_ns:
                self._flags |= cr.FLAG_BEFORE_NEXT_SYNC
        self._frames.keep_one(frame, time.monotonic_ns() + self._realtime_offset_ns)
        if self.index >= self._heartbeat_due:
            self._heartbeat_due = self.index + self._heartbeat_cycles
            self._send(self._heartbeat)

    def record(self) -> None:
        """Write the cycle to the ring, update counters and, every n-th cycle, the snapshot."""
        intake, frames, (one, two) = self.intake, self._frames, self._joints
        slot = frames.slot
        stale, late, duplicate, rejected = self._before
        work_ns = time.monotonic_ns() - self._work_start_ns
        cr.HEAD.pack_into(
            slot,
            0,
            self.index,
            self._sync_ns,
            self._sync_realtime_ns,
            self._flags,
            min(work_ns, 0xFFFF_FFFF),
            min(self.late_ns, 0x7FFF_FFFF),
            self.grid.missed & 0xFFFF_FFFF,
            self.counter,
            frames.count,
            min(frames.left_out, 255),
            min(intake.stale_inputs - stale, 255),
            min(intake.late_frames - late, 255),
            min(intake.duplicate_frames - duplicate, 255),
            min(intake.rejected_frames - rejected, 255),
            0,
            *one.sample,
            *two.sample,
        )
        cr.TAIL.pack_into(slot, cr.TAIL_OFFSET, self.index)
        self.ring.commit()
        self._counters.cycle(self._flags, work_ns, self.late_ns, self.grid.missed)
        self._counters.statuses(one.status, two.status)
        if self.index % _SNAPSHOT_EVERY == 0:
            self._write_snapshot()
        self.index += 1

    def hold_back(self) -> bool:
        """Return whether this slot must pass without SYNC, to distinguish late frames from lost ones (see intake)."""
        gaps = self.intake.gaps
        if not (gaps.wanted or gaps.open):
            return False
        count = self._receive()
        if count:
            self.between(self.socket.frames, self.socket.stamps_ns, self.socket.own, count)
        if not gaps.wanted:
            return False
        gaps.pass_slot()
        self.index += 1
        return True

    def between(self, frames: bytearray, stamps_ns: Sequence[int], own: Sequence[bool], count: int) -> None:
        """Take frames received while no cycle was open; arguments as `Intake.drain`."""
        self.intake.drain(frames, stamps_ns, own, count)
        self._frames.hold(frames, stamps_ns, count, self._temperature_ids)

    def skip(self, slots: int) -> None:
        """Skip missed slots: the index follows the grid, so that a gap in the log shows them."""
        self.index += slots

    @property
    def complete(self) -> bool:
        """Return whether the last cycle had every input that it waited for."""
        return bool(self._flags & cr.FLAG_COMPLETE)

    def reset_faults(self) -> None:
        """Release latched faults before the next estimate (`jtq control reset`); the record says so."""
        for joint in self._joints:
            if joint.reset_latch():
                self._next_flags = cr.FLAG_RESET
                self._counters.latch_resets += 1

    def use_own(self) -> None:
        """Use the estimators and limits built here, after the state of another loop was restored."""
        for joint in self._joints:
            joint.use(joint.estimator, joint.safety)

    def leave(self) -> None:
        """Send a last estimate with status off, so that no receiver keeps the last torque."""
        one, two = self._joints
        one.withdraw(st.OFF)
        two.withdraw(st.OFF)
        self._send(pack(self._estimate_id, estimate_pdo.encode(one.published, two.published, self.counter)))
        self._write_snapshot()

    def _write_snapshot(self) -> None:
        """Copy counters, inputs and the last estimate into the snapshot."""
        one, two = self._joints
        self.snapshot.begin()
        self._counters.flush(self.grid.missed, self._sync_ns)
        self.snapshot.write(
            self.index,
            self.counter,
            self._sync_realtime_ns,
            (one.view, two.view),
            sync_monotonic_ns=self._sync_ns,
            measured=(one.sample, two.sample),
        )

    def _receive(self) -> int:
        try:
            return self.socket.receive()
        except BusDown:
            self._counters.bus_errors += 1
            return 0

    def _send(self, frame: bytes) -> bool:
        try:
            return self.socket.send(frame)
        except BusDown:
            self._counters.bus_errors += 1
            return False
