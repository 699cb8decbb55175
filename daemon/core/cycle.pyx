"""One cycle of the loop, stage by stage. The stages are methods of `Cycle`, so that a benchmark can time each of them.

    begin    count late frames, send SYNC
    gather   one wake-up for all inputs, then wait for missing ones until the deadline
    observe  scale, estimate, decide the status of every joint
    publish  send the estimate PDO, or two of them with more than two joints, and every n-th cycle the heartbeat
    record   write the cycle to the ring, and every 8th cycle the snapshot

`go_on` goes from slot to slot without the interpreter. No stage raises because of what is on the bus; a bus that is down is a
counter and a stale estimate.
"""

from cpython.object cimport PyObject
from libc.stdint cimport int64_t, uint8_t, uint32_t
from libc.string cimport memset

from typing import Final

from jtqd.daemon.core.bus cimport Bus, bus_of
from jtqd.daemon.core.contact cimport ContactWatch
from jtqd.daemon.core.estimate_pdo cimport NOBODY, Published, encode_into
from jtqd.drivers.frame_socket cimport Frame
from jtqd.daemon.core.intake cimport Input, Intake
from jtqd.daemon.core.joint cimport JointCycle
from jtqd.daemon.core.joint_safety import JointSafety
from jtqd.daemon.core.record cimport CycleFrames, Header, RecordRing
from jtqd.daemon.core.schedule cimport Clock, Grid, NetworkBudget, WakeUp
from jtqd.daemon.core.snapshot cimport SnapshotWriter
from jtqd.daemon.shared import cycle_record as cr
from jtqd.daemon.shared.counters import word_of
from jtqd.drivers import nmt, own_objects
from jtqd.drivers.frame_socket import BusDown
from jtqd.drivers.pdo import SYNC_COB_ID
from jtqd.estimator import status as st

STARTING_CYCLES: Final = 20
"""Cycles at the start that are published as "starting": the arrival bands and the filters see their first inputs."""
_SNAPSHOT_EVERY: Final = 8
_CLOCK_READING_NS: Final = 20_000
"""Both clocks are read within this, or their difference is not taken."""
CYCLE_ENDED: Final = 0
"""`Cycle.go_on`: the last slot's cycle has ended, and the grid stands at that slot."""
SLOT_PASSED: Final = 1
"""... the last slot passed without a cycle, and the grid stands at the next one."""
RUN_ENDED: Final = 2
"""... no cycle begins any more."""
_LAST_NUMBER: Final = 240
"""Of the cycles of a SYNC without counter, in estimate PDO and record."""
_LAST_CALL_NS: Final = 100_000
"""Before the next SYNC; nobody waits for inputs from here on."""

cdef int64_t FIRST_CYCLES = STARTING_CYCLES, SNAPSHOT_EVERY = _SNAPSHOT_EVERY
cdef int64_t CLOCK_READING_NS = _CLOCK_READING_NS, LAST_CALL_NS = _LAST_CALL_NS
cdef int ENDED = CYCLE_ENDED, PASSED = SLOT_PASSED, OVER = RUN_ENDED
cdef uint32_t COMPLETE = cr.FLAG_COMPLETE, PUBLISHED = cr.FLAG_PUBLISHED, WITHDRAWN = cr.FLAG_WITHDRAWN
cdef uint32_t BEFORE_NEXT_SYNC = cr.FLAG_BEFORE_NEXT_SYNC, SYNC_CONFIRMED = cr.FLAG_SYNC_CONFIRMED
cdef uint32_t RESET = cr.FLAG_RESET
cdef uint32_t SYNC = SYNC_COB_ID, HEARTBEAT = nmt.HEARTBEAT_BASE
cdef uint8_t OPERATIONAL = nmt.OPERATIONAL
cdef int STALE = st.STALE, OFF = st.OFF, LAST_NUMBER = _LAST_NUMBER
cdef int BUS_ERRORS = word_of("bus_errors"), OVERRUNS = word_of("overruns")
cdef int LATCH_RESETS = word_of("latch_resets"), CONTACTS = word_of("contacts")
cdef int COUNTED[4]  # of the record: what came in its cycle
COUNTED[:] = [word_of(name) for name in ("stale_inputs", "late_frames", "duplicate_frames", "rejected_frames")]
cdef int64_t BYTE = 255, MOST_WORK_NS = 0xFFFF_FFFF, MOST_LATE_NS = 0x7FFF_FFFF

cdef uint32_t ESTIMATE[MOST_ESTIMATES]
ESTIMATE[:] = own_objects.ESTIMATE_BASES
cdef uint32_t CONTACT[MOST_ESTIMATES]
CONTACT[:] = own_objects.CONTACT_BASES

clock = Clock()
"""Of all cycles that are made from here on; tests replace it."""


cdef Frame _frame(uint32_t can_id, int length) noexcept nogil:
    """Return a frame without data."""
    cdef Frame frame
    memset(&frame, 0, sizeof(Frame))
    frame.id, frame.length = can_id, length
    return frame


class ConfiguredNodes:
    """Nodes that restarted, were changed or were absent at the start; they are used after the supervisor configured them.

    Rare, and therefore Python. A configuration counts that the supervisor noted after the node had begun to wait: a node that
    was only stopped is configured again without ever waiting, and that must not answer for its next restart. And it must have
    begun after the node's last boot-up message: a node may restart when its boot has just ended and is not yet noted.
    """

    def __init__(self, snapshot, intake, joints):
        self._snapshot, self._intake, self._joints = snapshot, intake, joints
        self._since = {node: snapshot.configured[node] for node in intake.unconfigured}
        self._doubts = list(snapshot.doubts)

    def look(self):
        """Check for configured nodes between the inputs of a cycle and its estimate."""
        intake, snapshot = self._intake, self._snapshot
        for node in intake.unconfigured:
            now = snapshot.configured[node]
            if self._since.setdefault(node, now) == now:
                continue
            if snapshot.configured_for[node] != intake.restarts(node):
                self._since[node] = now
                continue
            del self._since[node]
            intake.configured(node)
            snapshot.unconfigured[node] = 0
            for joint in self._joints:
                if joint.node_id == node:
                    joint.begin_again()
                joint.rescale(node, snapshot.factors(node))

    def doubt(self):
        """Stop using, between two cycles, the nodes that the supervisor found differently configured."""
        doubts = self._snapshot.doubts
        for node, (before, now) in enumerate(zip(self._doubts, doubts, strict=True)):
            if now != before:
                self._doubts[node] = now
                self._intake.doubt(node)


cdef class Cycle:
    """State of the loop and its stages.

    Args:
        socket: frame socket with filters for SYNC, the inputs and the nodes' heartbeats, own echo on.
        intake: decides which frame belongs to which cycle.
        joints: inputs and estimator of each joint, 1 to 4 of them.
        ring, snapshot: shared memory towards recorder and viewers.
        safety: limits and checks of each joint; None for those that need no joint file.
        node_id: own node-ID; the estimate PDOs are 180h + node_id (joints 1 and 2) and 280h + node_id (joints 3 and 4, where
            there are more than two), the heartbeat 700h + node_id.
        counter_overflow: SYNC counter runs 1..overflow (1019h); 0: SYNC without counter.
        wait_ns, deadline_ns: from SYNC to the wake-up for the inputs (it follows their arrival) and to the end of the wait.
        heartbeat_cycles: cycles between two heartbeats.
        grid: time grid; its slot is the current cycle's.
        contacts: watches for contacts of all joints, and where it `sends`, sends the contact PDOs 380h + node_id and
            480h + node_id; None: nobody does.

    Attributes:
        joints: what is kept of each joint.
        configured_nodes: nodes that restarted or are in doubt, until they are configured.
        flags: of the cycle's record.
        sync_ns: when its SYNC was sent, CLOCK_MONOTONIC.
        work_start_ns: when it woke up for its inputs.
        late_ns: by how much its SYNC was late.
        sent_ns: when its estimate had been handed to the socket.
    """

    def __init__(
        self,
        socket,
        Intake intake,
        joints,
        ring,
        snapshot,
        *,
        safety=None,
        int node_id,
        int counter_overflow,
        int64_t wait_ns,
        int64_t deadline_ns,
        int64_t heartbeat_cycles,
        Grid grid,
        ContactWatch contacts=None,
    ):
        cdef JointCycle joint
        cdef int n
        joints = list(joints)
        if not 1 <= len(joints) <= MOST_JOINTS:
            raise ValueError(f"found {len(joints)} joints, expected 1 to {MOST_JOINTS}")
        limits = safety or [JointSafety() for _ in joints]
        self.intake, self.snapshot, self.grid = intake, snapshot, grid
        self.joints = tuple([
            JointCycle(
                n, inputs, estimator, intake=intake, snapshot=snapshot, period_ns=grid.period_ns, safety=limits[n]
            )
            for n, (inputs, estimator) in enumerate(joints)
        ])
        self.count = len(joints)
        for n in range(self.count):
            joint = self.joints[n]
            self.at[n], self.states[n] = <PyObject *> joint, &joint.now
        self.clock, self.bus = clock, bus_of(socket)
        self.records, self.frames = RecordRing(ring, self.count), CycleFrames(self.count)
        self.frames.begin(self.records.slot())
        self.budget, self.wake_up = NetworkBudget(self.count), WakeUp(wait_ns, deadline_ns)
        self.writer = SnapshotWriter(snapshot, intake, self.bus)
        self.counter_overflow, self.heartbeat_cycles = counter_overflow, heartbeat_cycles
        self.estimates = (self.count + 1) // 2
        for n in range(self.estimates):
            self.estimate_frames[n] = _frame(ESTIMATE[n] + node_id, 8)
        self.contacts, self.watches = contacts, contacts is not None
        if self.watches and contacts.count != self.count:
            raise ValueError(f"found contacts of {contacts.count} joints, expected {self.count}")
        self.contact_pdos = self.estimates if self.watches and contacts.sends else 0
        for n in range(self.contact_pdos):
            self.contact_frames[n] = _frame(CONTACT[n] + node_id, 4)
        self.heartbeat_frame = _frame(HEARTBEAT + node_id, 1)
        self.heartbeat_frame.data[0] = OPERATIONAL
        self.configured_nodes = ConfiguredNodes(snapshot, intake, self.joints)

    def go_on(self, int slots, int64_t end_ns):
        """Go through up to `slots` > 0 slots, from that of the grid on; return CYCLE_ENDED, SLOT_PASSED or RUN_ENDED.

        A slot that cannot be begun in time is missed, one that the intake asks for passes without SYNC. No cycle begins from
        end_ns on (CLOCK_MONOTONIC; 0: without end).
        """
        cdef int outcome = PASSED
        cdef int64_t at_ns
        while slots:
            slots -= 1
            if outcome == ENDED:
                self.index += self.grid.advance(self.clock.monotonic())
            if self.clock.monotonic() < self.grid.slot_ns:
                self.clock.sleep_until(self.grid.slot_ns)
            at_ns = self.clock.monotonic()
            outcome = PASSED
            if self.grid.too_late(at_ns):
                self.index += self.grid.advance(at_ns) + 1
                self.grid.missed += 1
            elif end_ns and self.grid.slot_ns >= end_ns:
                return OVER
            elif self.pass_slot():
                self.grid.advance(at_ns)
            else:
                self.begin()
                self.gather()
                self.observe()
                self.publish()
                self.record()
                outcome = ENDED
        return outcome

    cpdef int begin(self) except -1:
        """Drain the frames received after the last cycle was closed, then send SYNC."""
        cdef Intake intake = self.intake
        cdef Frame sync
        cdef int64_t before_ns, realtime_ns, at_ns
        cdef int count, n
        self.frames.begin(self.records.slot())
        self.flags, self.next_flags = self.next_flags, 0
        for n in range(4):
            self.counted[n] = intake.counters[COUNTED[n]]
        count = self.receive()
        if count:
            for n in range(count):
                intake.drain_frame(&self.bus.frames[n], self.bus.stamps_ns[n], self.bus.own[n])
            intake.drained()
            self.frames.keep(self.bus.frames, self.bus.stamps_ns, count)
        self.counter = self.counter % (self.counter_overflow or LAST_NUMBER) + 1
        intake.begin(self.counter)
        before_ns = self.clock.monotonic()
        realtime_ns = self.clock.realtime()
        at_ns = self.clock.monotonic()
        if at_ns - before_ns < CLOCK_READING_NS or not self.realtime_offset_ns:
            self.realtime_offset_ns = realtime_ns - at_ns  # else something came between: the last one is better
        sync = _frame(SYNC, 1 if self.counter_overflow else 0)
        sync.data[0] = self.counter  # of a plain SYNC behind its end: not on the wire, but in our own echo
        self.send(&sync)
        self.sync_ns = at_ns
        self.late_ns = at_ns - self.grid.slot_ns

    cpdef int gather(self) except -1:
        """Take the inputs: one wake-up for all that have come, then wait for the missing ones until the deadline."""
        cdef Intake intake = self.intake
        cdef int64_t due_ns = self.sync_ns + self.wake_up.wait_ns, deadline_ns, left_ns
        cdef int count, n
        if due_ns > self.clock.monotonic():
            self.clock.sleep_until(due_ns)
        self.work_start_ns = self.clock.monotonic()
        deadline_ns = min(self.sync_ns + self.wake_up.deadline_ns, self.grid.end_ns() - LAST_CALL_NS)
        while True:
            count = self.receive()
            if count:
                for n in range(count):
                    intake.take_frame(&self.bus.frames[n], self.bus.stamps_ns[n], self.bus.own[n])
                self.frames.keep(self.bus.frames, self.bus.stamps_ns, count)
                if intake.missing == 0:
                    break
            left_ns = deadline_ns - self.clock.monotonic()
            if left_ns <= 0 or not self.bus.wait(left_ns):
                break
        if intake.close():
            self.flags |= COMPLETE
            self.wake_up.follow(intake.last_delay_ns)
        intake.age_temperatures(self.index)
        if intake.nodes.waiting:
            self.configured_nodes.look()
        if intake.sync_stamp_ns:
            self.flags |= SYNC_CONFIRMED
            self.sync_realtime_ns = intake.sync_stamp_ns
        else:
            self.sync_realtime_ns = self.sync_ns + self.realtime_offset_ns

    cpdef int observe(self) except -1:
        """Estimate every joint from the inputs of this cycle; without their networks if there is no time for them."""
        cdef int64_t sync_ns = self.sync_realtime_ns - self.realtime_offset_ns
        cdef bint starting = self.index < FIRST_CYCLES, wanted
        cdef int n
        self.budget.begin(self.grid.end_ns())
        for n in range(self.count):
            wanted = self.budget.wanted(n, self.clock.monotonic())
            (<JointCycle> self.at[n]).observe(sync_ns, starting, wanted)
        if self.watches:
            self.contacts.watch(self.states)
            self.writer.counters[CONTACTS] += self.contacts.begun

    cpdef int publish(self) except -1:
        """Send the estimate PDOs, and the heartbeat when it is due. A late estimate is withdrawn."""
        cdef int64_t at_ns = self.clock.monotonic()
        cdef int n
        self.budget.ended(at_ns)
        if at_ns >= self.grid.end_ns():
            self.withdraw(STALE)
            self.flags |= WITHDRAWN
            self.writer.counters[OVERRUNS] += 1
        if self.send_estimate():
            self.flags |= PUBLISHED
            if self.clock.monotonic() < self.grid.end_ns():
                self.flags |= BEFORE_NEXT_SYNC
        self.sent_ns = self.clock.monotonic()
        for n in range(self.estimates):
            self.frames.keep_one(&self.estimate_frames[n], self.sent_ns + self.realtime_offset_ns)
        for n in range(self.contact_pdos):
            self.frames.keep_one(&self.contact_frames[n], self.sent_ns + self.realtime_offset_ns)
        if self.index >= self.heartbeat_due:
            self.heartbeat_due = self.index + self.heartbeat_cycles
            self.send(&self.heartbeat_frame)

    cpdef int record(self) except -1:
        """Write the cycle to the ring, update counters and, every n-th cycle, the snapshot."""
        cdef Intake intake = self.intake
        cdef int n
        cdef int64_t work_ns = self.clock.monotonic() - self.work_start_ns, missed = self.grid.missed
        self.frames.record.header[0] = Header(
            self.index,
            self.sync_ns,
            self.sync_realtime_ns,
            self.flags,
            min(work_ns, MOST_WORK_NS),
            min(self.late_ns, MOST_LATE_NS),
            missed,
            self.counter,
            self.frames.count,
            min(self.frames.left_out, BYTE),
            min(intake.counters[COUNTED[0]] - self.counted[0], BYTE),
            min(intake.counters[COUNTED[1]] - self.counted[1], BYTE),
            min(intake.counters[COUNTED[2]] - self.counted[2], BYTE),
            min(intake.counters[COUNTED[3]] - self.counted[3], BYTE),
            0,
        )
        for n in range(self.count):
            self.frames.record.joints[n] = self.states[n].sample
            self.writer.count_status(n, self.states[n].status)
        self.frames.record.tail[0] = self.index
        self.records.commit()
        self.writer.count(self.flags, work_ns, self.late_ns, missed)
        if self.index % SNAPSHOT_EVERY == 0:
            self.write_snapshot()
        self.index += 1

    cpdef bint pass_slot(self) except -1:
        """Pass the slot without SYNC where the intake asks for it, to tell late frames from lost ones; return whether it did."""
        cdef Intake intake = self.intake
        cdef int count, n
        if not (intake.gap_wanted or intake.gap.open):
            return False
        count = self.receive()
        if count:
            for n in range(count):
                intake.drain_frame(&self.bus.frames[n], self.bus.stamps_ns[n], self.bus.own[n])
                self.keep_for_next(&self.bus.frames[n], self.bus.stamps_ns[n])
            intake.drained()
        if not intake.gap_wanted:
            return False
        intake.pass_slot()
        self.index += 1
        return True

    def skip(self, int64_t slots):
        """Skip missed slots: the index follows the grid, so that a gap in the log shows them."""
        self.index += slots

    def reset_faults(self):
        """Release latched faults before the next estimate (`jtq control reset`); the record has a flag."""
        for joint in self.joints:
            if joint.reset_latch():
                self.next_flags = RESET
                self.writer.counters[LATCH_RESETS] += 1

    def leave(self):
        """Send a last estimate with status off, so that no receiver keeps the last torque."""
        self.withdraw(OFF)
        self.send_estimate()
        self.write_snapshot()

    cdef void withdraw(self, int status) noexcept:
        """Withdraw the estimates of all joints (`JointCycle.withdraw`)."""
        cdef int n
        for n in range(self.count):
            (<JointCycle> self.at[n]).withdraw(status)
        if self.watches:
            self.contacts.withdraw(self.states)

    cdef void keep_for_next(self, const Frame *frame, int64_t stamp_ns) noexcept nogil:
        """Of a slot without a record, what belongs to no cycle goes into the next record."""
        cdef Input *state = self.intake.input_with(frame.id)
        if self.intake.temperature_with(frame.id) != NULL or (state != NULL and state.age_ns):
            self.frames.keep_for_next(frame, stamp_ns)

    cpdef int write_snapshot(self) except -1:
        """Copy counters, inputs and the last estimate into the snapshot."""
        cdef int n
        self.writer.begin()
        self.writer.flush(self.grid.missed, self.sync_ns)
        for n in range(self.count):
            self.writer.write_learned(n, <JointCycle> self.at[n])
        self.writer.end(self.index, self.counter, self.sync_realtime_ns, self.sync_ns, self.states)
        return 0

    cdef bint send_estimate(self) except -1:
        """Send the estimate PDOs; return whether the socket took all of them."""
        cdef const Published *second
        cdef bint sent = True
        cdef int n
        for n in range(self.estimates):
            second = &self.states[2 * n + 1].published if 2 * n + 1 < self.count else &NOBODY
            encode_into(
                self.estimate_frames[n].data, &self.states[2 * n].published, second, self.counter
            )
            sent = self.send(&self.estimate_frames[n]) and sent
        for n in range(self.contact_pdos):
            self.contacts.encode(self.contact_frames[n].data, n, self.counter)
            self.send(&self.contact_frames[n])
        return sent

    cdef int receive(self) except -1:
        """Take what has come; a bus that is down gives nothing and is counted."""
        try:
            return self.bus.take()
        except BusDown:
            self.writer.counters[BUS_ERRORS] += 1
            return 0

    cdef bint send(self, const Frame *frame) except -1:
        """Send a frame; a bus that is down takes none and is counted."""
        try:
            return self.bus.put(frame)
        except BusDown:
            self.writer.counters[BUS_ERRORS] += 1
            return False
