"""One cycle of the loop, stage by stage. The stages are methods of `Cycle`, so that a benchmark can time each of them.

    begin    count late frames, send SYNC; as a guest, wait for the SYNC of another node
    gather   one wake-up for all inputs, then wait for missing ones until the deadline
    observe  scale, estimate, decide the status of every joint
    publish  send the estimate PDO, or two of them with more than two joints, and every n-th cycle the heartbeat
    record   estimate by the shadow methods; write the cycle to the ring, and every 8th cycle the snapshot

`go_on` goes from slot to slot without the interpreter. No stage raises because of what is on the bus; a bus that is down is a
counter and a stale estimate.
"""

from cpython.object cimport PyObject
from libc.stdint cimport int64_t, uint8_t, uint32_t, uint64_t
from libc.string cimport memcpy, memset

from typing import Final

from jtqd.daemon.core.estimate_pdo cimport NOBODY, Published, encode_into
from jtqd.daemon.core.intake cimport MOST_INPUTS, NODES, NOT_HEARD, Input, Intake
from jtqd.daemon.core.joint cimport ContactWatch, JointCycle, JointState
from jtqd.daemon.core.record cimport Header, JointBlock, RecordRing, ShadowBlock
from jtqd.daemon.core.schedule cimport Clock, Grid, NetworkBudget, SyncGrid, WakeUp
from jtqd.daemon.core.status import JointSafety
from jtqd.daemon.shared import cycle_record as cr
from jtqd.daemon.shared import snapshot as shared
from jtqd.daemon.shared.counters import word_of
from jtqd.drivers import frame_socket, nmt, own_objects
from jtqd.drivers.frame import worst_case_bits
from jtqd.drivers.frame_socket cimport Frame, FrameSocket
from jtqd.drivers.frame_socket import BusDown
from jtqd.drivers.pdo import SYNC_COB_ID
from jtqd.estimator import status as st

STARTING_CYCLES: Final = 20
"""Cycles at the start that are published as "starting": the arrival bands and the filters see their first inputs."""
CYCLE_ENDED: Final = 0
"""`Cycle.go_on`: the last slot's cycle has ended, and the grid stands at that slot."""
SLOT_PASSED: Final = 1
"""... the last slot passed without a cycle, and the grid stands at the next one."""
RUN_ENDED: Final = 2
"""... no cycle begins any more."""

cdef int64_t FIRST_CYCLES = STARTING_CYCLES, SNAPSHOT_EVERY = 8
cdef int64_t CLOCK_READING_NS = 20_000  # both clocks are read within this, or their difference is not taken
cdef int64_t PATIENCE_NS = 5_000_000, SILENCE_NS = 20_000_000  # without SYNC: until the duties, until nothing is fresh
cdef int64_t LAST_CALL_NS = 100_000  # before the next SYNC: nobody waits for inputs from here on
cdef int LAST_NUMBER = 240  # of the cycles of a SYNC without counter, in estimate PDO and record
cdef int ENDED = CYCLE_ENDED, PASSED = SLOT_PASSED, OVER = RUN_ENDED
cdef uint32_t COMPLETE = cr.FLAG_COMPLETE, PUBLISHED = cr.FLAG_PUBLISHED, WITHDRAWN = cr.FLAG_WITHDRAWN
cdef uint32_t BEFORE_NEXT_SYNC = cr.FLAG_BEFORE_NEXT_SYNC, SYNC_CONFIRMED = cr.FLAG_SYNC_CONFIRMED
cdef uint32_t RESET = cr.FLAG_RESET, UNCHECKED = cr.FLAG_UNCHECKED, FIRST_ONES = cr.FLAG_STARTING
cdef uint32_t NMT_COMMAND = 0, SYNC = SYNC_COB_ID, HEARTBEAT = nmt.HEARTBEAT_BASE
cdef uint8_t OPERATIONAL = nmt.OPERATIONAL, PRE_OPERATIONAL = nmt.PRE_OPERATIONAL, BOOT_UP = nmt.BOOT_UP
cdef int START = nmt.START, RESET_NODE = nmt.RESET_NODE, RESET_COMMUNICATION = nmt.RESET_COMMUNICATION
cdef dict COMMANDS = nmt.COMMANDS, STATE_AFTER = nmt.STATE_AFTER
cdef int STALE = st.STALE, OFF = st.OFF
cdef int BUS_ERRORS = word_of("bus_errors"), OVERRUNS = word_of("overruns")
cdef int LATCH_RESETS = word_of("latch_resets"), CONTACTS = word_of("contacts")
cdef int COUNTED[4]  # of the record: what came in its cycle
COUNTED[:] = [word_of(name) for name in ("stale_inputs", "late_frames", "duplicate_frames", "rejected_frames")]
cdef int64_t BYTE = 255, MOST_WORK_NS = 0xFFFF_FFFF, MOST_LATE_NS = 0x7FFF_FFFF

cdef uint32_t ESTIMATE[MOST_ESTIMATES]
ESTIMATE[:] = own_objects.ESTIMATE_BASES
cdef uint32_t CONTACT[MOST_ESTIMATES]
CONTACT[:] = own_objects.CONTACT_BASES

cdef int CAPACITY = frame_socket.CAPACITY

clock = Clock()
"""Of all cycles that are made from here on; tests replace it."""


cdef class PythonSocket(FrameSocket):
    """What takes the place of a frame socket in a test, through its Python methods."""

    cdef int take(self) except -1:
        """Copy what `receive` gives."""
        cdef int count = self.sock.receive(), n
        cdef const unsigned char[::1] frames
        self.count_dropped()
        if count > CAPACITY:
            raise ValueError(f"found {count} frames at once, expected at most {CAPACITY}")
        if count:
            frames = self.sock.frames
            memcpy(self.frames_c, &frames[0], count * sizeof(Frame))
            stamps_ns, own = self.sock.stamps_ns, self.sock.own
            for n in range(count):
                self.stamps_c[n], self.own_c[n] = stamps_ns[n], own[n]
        return count

    cdef bint put(self, const Frame *frame) except -1:
        """As `send`."""
        taken = self.sock.send((<const char *> frame)[:sizeof(Frame)])
        self.count_dropped()
        return taken

    cdef bint ready(self, int64_t timeout_ns) except -1:
        """As `wait`."""
        return self.sock.wait(timeout_ns * 1e-9)

    cdef int count_dropped(self) except -1:
        self.tx_dropped, self.rx_dropped = self.sock.tx_dropped, self.sock.rx_dropped
        return 0


cdef FrameSocket socket_of(object socket):
    """Return a frame socket as it is, and what takes its place in a test as one."""
    if isinstance(socket, FrameSocket):
        return socket
    return PythonSocket(socket, "test", unix=False, receive_own=True, error_frames=False, capacity=CAPACITY)


cdef Frame _frame(uint32_t can_id, int length) noexcept nogil:
    """Return a frame without data."""
    cdef Frame frame
    memset(&frame, 0, sizeof(Frame))
    frame.id, frame.length = can_id, length
    return frame


# Snapshot -------------------------------------------------------------------------------------------------------------

cdef extern from *:
    """
    static inline void begin_write(uint64_t *sequence) {
        __atomic_store_n(sequence, *sequence | 1, __ATOMIC_RELAXED);
        __atomic_thread_fence(__ATOMIC_RELEASE);
    }
    static inline void end_write(uint64_t *sequence) {
        __atomic_store_n(sequence, *sequence + 1, __ATOMIC_RELEASE);
    }
    """
    void begin_write(uint64_t *sequence) noexcept nogil
    void end_write(uint64_t *sequence) noexcept nogil

cdef int CYCLES = word_of("cycles"), MISSED = word_of("missed"), CYCLES_COMPLETE = word_of("complete")
cdef int CYCLES_PUBLISHED = word_of("published"), PUBLISHED_LATE = word_of("published_late")
cdef int WORK_MAX = word_of("work_max_ns"), LATE_MAX = word_of("late_max_ns"), BITS = word_of("bits_worst_case")
cdef int TX_DROPPED = word_of("tx_dropped"), RX_DROPPED = word_of("rx_dropped")

cdef int64_t WORK_BIN_NS = shared.WORK_BIN_NS, LATE_BIN_NS = shared.LATE_BIN_NS
cdef int64_t LAST_WORK_BIN = shared.WORK_BINS - 1, LAST_LATE_BIN = shared.LATE_BINS - 1
cdef int CODES = shared.STATUS_CODES

if (sizeof(InputBlock), sizeof(EstimateBlock), sizeof(LearnedBlock), NODES) != (
    shared.INPUT.size, shared.ESTIMATE_SIZE, shared.LEARNED.size, shared.MAX_NODE
):
    raise ImportError("the snapshot has another layout than the one that is compiled in")


cdef class SnapshotWriter:
    """Writes into a `Snapshot`.

    snapshot: the memory; intake: counts frames and inputs, from here on in the snapshot's words; socket: counts the frames
    that it drops.
    """

    def __init__(self, snapshot, Intake intake, socket):
        cdef int n
        if intake.count > shared.MAX_INPUTS:
            raise ValueError(f"found {intake.count} inputs, the snapshot has room for {shared.MAX_INPUTS}")
        self.intake = intake
        self.bus = socket_of(socket)
        self.counters = intake.counters = snapshot.counters
        self.work, self.late, self.status_cycles = snapshot.work, snapshot.late, snapshot.status_cycles
        self.inputs, self.node_heard, self.node_states = snapshot.inputs, snapshot.node_heard, snapshot.node_states
        self.unconfigured, self.restarts, self.learned = snapshot.unconfigured, snapshot.restarts, snapshot.learned
        intake.conflict = snapshot.conflict
        self.sequence, self.estimate, self.joints = snapshot.sequence, snapshot.estimate, snapshot.joints
        self.shadows = snapshot.shadows
        for n in range(MOST_JOINTS):
            self.status[n] = -1
        self.bits_complete = worst_case_bits(1) + (self.joints + 1) // 2 * worst_case_bits(8)
        for n in range(intake.count):
            self.bits_of[n] = worst_case_bits(intake.inputs[n].length)
            self.bits_complete += self.bits_of[n]

    cdef void count(self, int flags, int64_t work_ns, int64_t late_ns, int64_t missed) noexcept nogil:
        """Count one cycle, with the flags of its record; times in ns, `missed` slots so far."""
        cdef int64_t bits = self.bits_complete, late = max(late_ns, 0)
        cdef int n
        self.counters[CYCLES] += 1
        self.counters[MISSED] = missed
        if flags & COMPLETE:
            self.counters[CYCLES_COMPLETE] += 1
        else:
            for n in range(self.intake.count):
                if not self.intake.inputs[n].fresh:
                    bits -= self.bits_of[n]
        if flags & PUBLISHED:
            self.counters[CYCLES_PUBLISHED] += 1
            if not flags & BEFORE_NEXT_SYNC:
                self.counters[PUBLISHED_LATE] += 1
        self.bits += bits
        self.counters[WORK_MAX] = max(self.counters[WORK_MAX], <uint64_t> work_ns)
        self.counters[LATE_MAX] = max(self.counters[LATE_MAX], <uint64_t> late)
        self.work[min(work_ns // WORK_BIN_NS, LAST_WORK_BIN)] += 1
        self.late[min(late // LATE_BIN_NS, LAST_LATE_BIN)] += 1

    cdef void begin(self) noexcept nogil:
        """Mark the snapshot as inconsistent until `end` (inputs included)."""
        begin_write(&self.sequence[0])

    cpdef int flush(self, int64_t missed, int64_t sync_ns) except -1:
        """Copy inputs, nodes and the counts of other objects; `sync_ns` is the cycle's SYNC (CLOCK_MONOTONIC)."""
        self.flush_inputs(sync_ns)
        self.counters[MISSED] = missed
        self.counters[BITS] = self.bits  # not in every cycle: readers divide it by the time between two snapshots
        self.counters[TX_DROPPED] = self.bus.tx_dropped
        self.counters[RX_DROPPED] = self.bus.rx_dropped
        self.flush_nodes()
        return 0

    cdef void flush_nodes(self) noexcept nogil:
        """Copy heartbeats, restarts, and the nodes that wait for their configuration."""
        cdef int node
        for node in range(NODES):
            if self.intake.nodes.unconfigured[node]:
                self.unconfigured[node] = 1
            if self.intake.nodes.state[node] == NOT_HEARD:
                continue
            self.node_states[node] = self.intake.nodes.state[node]
            self.node_heard[node] = self.intake.nodes.heard_ns[node]
            if self.intake.nodes.restarts[node]:
                self.restarts[node] = self.intake.nodes.restarts[node]

    cdef void flush_inputs(self, int64_t sync_ns) noexcept nogil:
        """Write one `InputView` for each PDO."""
        cdef InputBlock *blocks = <InputBlock *> &self.inputs[0]
        cdef Input *state
        cdef int n
        for n in range(self.intake.count):
            state = &self.intake.inputs[n]
            if state.fresh:
                self.used_ns[n] = sync_ns
                self.delay_ns[n] = state.stamp_ns - self.intake.sync_stamp_ns
            blocks[n] = InputBlock(
                self.used_ns[n], self.delay_ns[n], state.band_low_ns, state.band_high_ns,
                state.late, state.lost, state.duplicates, state.rejected,
                state.missed, state.in_a_row, state.too_short, state.too_long,
            )

    cdef void write_learned(self, int number, JointCycle joint) noexcept nogil:
        """Write what the estimator of joint `number`, from 0 on, has learned, and its state; between `begin` and `end`."""
        cdef LearnedBlock *block = &(<LearnedBlock *> &self.learned[0])[number]
        cdef size_t size = 0
        cdef const void *state = joint.core.learned(&block.zeros, &size)
        block.size = 0
        if state != NULL and size <= sizeof(block.state):
            block.size = size
            memcpy(block.state, state, size)

    cdef void end(
        self, int64_t cycle, int sync_counter, int64_t sync_realtime_ns, int64_t sync_monotonic_ns, JointState **joints
    ) noexcept nogil:
        """Write the last estimate; the snapshot is consistent again."""
        cdef EstimateBlock *block = <EstimateBlock *> &self.estimate[0]
        cdef const JointBlock *s
        cdef int n
        block.cycle, block.sync_counter = cycle, sync_counter
        block.sync_realtime_ns, block.sync_monotonic_ns = sync_realtime_ns, sync_monotonic_ns
        for n in range(self.joints):
            s = &joints[n].sample
            if s.status != self.status[n]:
                self.status[n], self.since[n] = s.status, cycle
            block.status_since[n] = self.since[n]
            block.joints[n] = ViewBlock(
                s.torque_nm, s.sigma_nm, s.tob_nm, s.physics_nm, s.network_nm, s.sensor_torque_nm,
                s.statusword, s.status, s.sensor_status, s.input_flags, joints[n].held.latched,
                s.reference_nm, s.age_ms, s.torque_rate_nm_s, s.contact_nm, joints[n].held.latches, joints[n].held.released,
            )
            block.measured[n] = MeasuredBlock(
                s.current_a, s.motor_position_rad, s.motor_velocity_rad_s, s.link_position_rad, s.sensor_torque_nm,
                s.temperature_c,
            )
            if joints[n].shadow != NULL:
                (<ShadowBlock *> &self.shadows[0])[n] = joints[n].shadow[0]
        end_write(&self.sequence[0])


def frame_counts(Intake intake):
    """Return late, lost, duplicate and rejected frames by PDO name; for a temperature, how often it became unknown."""
    counts = {
        pdo.name: {
            "late": intake.inputs[n].late,
            "lost": intake.inputs[n].lost,
            "duplicate": intake.inputs[n].duplicates,
            "rejected": intake.inputs[n].rejected,
        }
        for n, pdo in enumerate(intake.pdos)
    }
    for n, each in enumerate(intake.temperatures):
        lost, rejected = intake.celsius[n].lost, intake.celsius[n].rejected
        counts[each.name] = {"late": 0, "lost": lost, "duplicate": 0, "rejected": rejected}
    return counts


# The cycle ------------------------------------------------------------------------------------------------------------


class ConfiguredNodes:
    """Nodes that restarted, were changed or were absent at the start; they are used after the supervisor configured them.

    Rare, and therefore Python. A configuration counts that the supervisor noted after the node had begun to wait (one that was
    only stopped is configured again without ever waiting), and that began after the node's last boot-up message.
    """

    def __init__(self, snapshot, intake, joints):
        self._snapshot, self._intake, self._joints = snapshot, intake, joints
        self._since = {node: snapshot.configured[node] for node in intake.unconfigured}
        self._doubts = list(snapshot.doubts)
        self._trust()

    def _trust(self):
        for joint in self._joints:
            joint.trust(not self._snapshot.unchecked[joint.node_id])

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
        self._trust()


cdef class Cycle:
    """State of the loop and its stages.

    Args:
        socket: frame socket with filters for SYNC, the inputs and the nodes' heartbeats, own echo on.
        intake: decides which frame belongs to which cycle.
        joints: inputs and estimator of each joint, 1 to 4 of them.
        ring, snapshot: shared memory towards recorder and viewers.
        safety: limits and checks of each joint; None for those that need no joint file.
        node_id: own node-ID, added to the bases of estimate PDOs, contact PDOs and heartbeat.
        counter_overflow: SYNC counter runs 1..overflow (1019h); 0: SYNC without counter.
        wait_ns, deadline_ns: from SYNC to the wake-up for the inputs (it follows their arrival) and to the end of the wait.
        heartbeat_cycles: cycles between two heartbeats; 0: none.
        grid: time grid; its slot is the current cycle's. A SyncGrid follows the SYNC of another node, whose NMT slave this is.
        contacts: watches for contacts of all joints; None: nobody does.
        shadows: estimators of each joint's shadow methods; left out: there are none.

    Attributes:
        joints: what is kept of each joint.
        configured_nodes: nodes that restarted or are in doubt, until they are configured.
        flags: of the cycle's record.
        sync_ns, late_ns: when its SYNC was sent (CLOCK_MONOTONIC), and by how much that was late.
        work_start_ns: when it woke up for its inputs.
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
        shadows=(),
    ):
        cdef JointCycle joint
        cdef int n
        joints = list(joints)
        shadows = shadows or [()] * len(joints)
        if not 1 <= len(joints) <= MOST_JOINTS:
            raise ValueError(f"found {len(joints)} joints, expected 1 to {MOST_JOINTS}")
        limits = safety or [JointSafety() for _ in joints]
        self.intake, self.snapshot, self.grid = intake, snapshot, grid
        self.joints = tuple([
            JointCycle(
                n, inputs, each, intake=intake, snapshot=snapshot, period_ns=grid.period_ns, safety=limits[n],
                shadows=shadows[n]
            )
            for n, (inputs, each) in enumerate(joints)
        ])
        self.count = len(joints)
        for n in range(self.count):
            joint = self.joints[n]
            self.at[n], self.states[n] = <PyObject *> joint, &joint.now
        self.clock, self.bus = clock, socket_of(socket)
        self.ring = RecordRing(ring, self.count, any(shadows))
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
        self.node_id, self.sends, self.follows, self.slot_index = node_id, True, isinstance(grid, SyncGrid), -1
        if self.follows:
            self.seen, self.sends = grid, False
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
            if self.follows:
                outcome = self.follow(end_ns)
                if outcome != ENDED or not self.slot_begun:
                    return outcome
                continue
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

    cdef int open_record(self) except -1:
        """Begin the record of a cycle: what comes from here on is in it."""
        cdef int n
        self.ring.begin()
        self.flags, self.next_flags = self.next_flags, 0
        for n in range(4):
            self.counted[n] = self.intake.counters[COUNTED[n]]
        return 0

    cdef int64_t read_clocks(self) except? -1:
        """Return CLOCK_MONOTONIC, and learn what CLOCK_REALTIME is ahead of it."""
        cdef int64_t before_ns, realtime_ns, at_ns
        before_ns = self.clock.monotonic()
        realtime_ns = self.clock.realtime()
        at_ns = self.clock.monotonic()
        if at_ns - before_ns < CLOCK_READING_NS or not self.realtime_offset_ns:
            self.realtime_offset_ns = realtime_ns - at_ns  # else something came between: the last one is better
        return at_ns

    cpdef int begin(self) except -1:
        """Drain the frames received after the last cycle was closed, then send SYNC."""
        cdef Frame sync
        cdef int64_t at_ns
        cdef int count
        self.open_record()
        count = self.drain()
        if count:
            self.ring.keep(self.bus.frames_c, self.bus.stamps_c, count)
        self.counter = self.counter % (self.counter_overflow or LAST_NUMBER) + 1
        self.intake.begin(self.counter)
        at_ns = self.read_clocks()
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
            count = self.receive() if not self.follows else self.take_until_sync()
            if count:
                for n in range(self.first, self.first + count):
                    intake.take_frame(&self.bus.frames_c[n], self.bus.stamps_c[n], self.bus.own_c[n])
                self.ring.keep(&self.bus.frames_c[self.first], &self.bus.stamps_c[self.first], count)
                if intake.missing == 0:
                    break
            if self.next_sync:
                break
            left_ns = deadline_ns - self.clock.monotonic()
            if left_ns <= 0 or not self.bus.ready(left_ns):
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
        cdef bint starting = self.index - self.first_index < FIRST_CYCLES, wanted
        cdef int n
        self.budget.begin(self.grid.end_ns())
        for n in range(self.count):
            wanted = self.budget.wanted(n, self.clock.monotonic())
            (<JointCycle> self.at[n]).observe(sync_ns, starting, wanted)
            if (<JointCycle> self.at[n]).rules.at_most_degraded:
                self.flags |= UNCHECKED << (2 + n)
        if starting and self.first_index:
            self.flags |= FIRST_ONES
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
        if self.sends and self.send_estimate():
            self.flags |= PUBLISHED
            if self.clock.monotonic() < self.grid.end_ns():
                self.flags |= BEFORE_NEXT_SYNC
        self.sent_ns = self.clock.monotonic()
        at_ns = self.sent_ns + self.realtime_offset_ns
        if self.sends:
            for n in range(self.estimates):
                self.ring.keep(&self.estimate_frames[n], &at_ns, 1)
            for n in range(self.contact_pdos):
                self.ring.keep(&self.contact_frames[n], &at_ns, 1)
        self.beat()

    cpdef int record(self) except -1:
        """Estimate by the shadow methods, write the cycle to the ring, update counters and, every n-th cycle, the snapshot."""
        cdef Intake intake = self.intake
        cdef int n
        cdef int64_t work_ns, missed = self.grid.missed
        for n in range(self.count):
            if self.states[n].shadow != NULL:
                (<JointCycle> self.at[n]).observe_shadows()
                self.ring.record.shadows[n] = self.states[n].shadow[0]
        work_ns = self.clock.monotonic() - self.work_start_ns
        self.ring.record.header[0] = Header(
            self.index, self.sync_ns, self.sync_realtime_ns,
            self.flags, min(work_ns, MOST_WORK_NS), min(self.late_ns, MOST_LATE_NS), missed,
            self.counter, self.ring.count, min(self.ring.left_out, BYTE),
            min(intake.counters[COUNTED[0]] - self.counted[0], BYTE),
            min(intake.counters[COUNTED[1]] - self.counted[1], BYTE),
            min(intake.counters[COUNTED[2]] - self.counted[2], BYTE),
            min(intake.counters[COUNTED[3]] - self.counted[3], BYTE),
            0,
        )
        for n in range(self.count):
            self.ring.record.joints[n] = self.states[n].sample
            self.writer.status_cycles[CODES * n + self.states[n].status] += 1
        self.ring.record.tail[0] = self.index
        self.ring.commit()
        self.writer.count(self.flags, work_ns, self.late_ns, missed)
        if self.index % SNAPSHOT_EVERY == 0:
            self.write_snapshot()
        self.index += 1

    cpdef bint pass_slot(self) except -1:
        """Pass the slot without SYNC where the intake asks for it, to tell late frames from lost ones; return whether it did."""
        cdef Intake intake = self.intake
        cdef Input *state
        cdef const Frame *frame
        cdef int n
        if not (intake.gap_wanted or intake.gap.open):
            return False
        for n in range(self.drain()):  # there is no record: what belongs to no cycle goes into the next one
            frame = &self.bus.frames_c[n]
            state = intake.input_with(frame.id)
            if intake.temperature_with(frame.id) != NULL or (state != NULL and state.age_ns):
                self.ring.keep_for_next(frame, self.bus.stamps_c[n])
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
        if self.sends:
            self.send_estimate()
        self.write_snapshot()

    cdef int beat(self) except -1:
        """Send the heartbeat when it is due."""
        if self.index >= self.heartbeat_due and self.heartbeat_cycles:
            self.heartbeat_due = self.index + self.heartbeat_cycles
            self.send(&self.heartbeat_frame)
        return 0

    # As a guest: SYNC and NMT commands of another node ------------------------------------------------------------------

    cdef int follow(self, int64_t end_ns) except -1:
        """Wait for a SYNC (`slot_begun`) and go through its cycle; without one return soon. Returns as `go_on`.

        A cycle is missed where the next SYNC has come before its inputs were taken.
        """
        cdef int64_t now_ns, until_ns = self.clock.monotonic() + PATIENCE_NS
        cdef uint64_t errors = self.writer.counters[BUS_ERRORS]
        cdef int count, n
        self.slot_begun = False
        if not self.opened:
            self.open_record()
            self.opened = True
        while not self.slot_begun:
            now_ns = self.clock.monotonic()
            if end_ns and now_ns >= end_ns:
                return OVER
            count = self.take_until_sync()
            for n in range(self.first, self.first + count):
                self.intake.drain_frame(&self.bus.frames_c[n], self.bus.stamps_c[n], self.bus.own_c[n])
            self.ring.keep(&self.bus.frames_c[self.first], &self.bus.stamps_c[self.first], count + self.next_sync)
            if self.next_sync:
                self.next_frame += 1
                self.begin_with(&self.bus.frames_c[self.first + count], self.bus.stamps_c[self.first + count])
                break
            if now_ns >= until_ns:
                return self.go_without(now_ns)
            if self.writer.counters[BUS_ERRORS] > errors:  # the bus is down, and is ready to report it at any time
                self.clock.sleep_until(until_ns)
            self.bus.ready(until_ns - now_ns)
        self.opened = False
        self.gather()
        if self.next_sync:
            self.grid.missed += 1
            return ENDED
        self.observe()
        self.publish()
        self.record()
        return ENDED

    cdef int take_until_sync(self) except -1:
        """Return how many frames, from `first` of the batch on, stand before a SYNC in it (`next_sync`), or before its end."""
        cdef const Frame *frame
        if self.next_frame == self.batch:
            self.batch, self.next_frame = self.receive(), 0
        self.first, self.next_sync = self.next_frame, False
        while self.next_frame < self.batch:
            frame = &self.bus.frames_c[self.next_frame]
            if frame.id == SYNC and frame.length <= 1:
                self.next_sync = True
                break
            if frame.id == NMT_COMMAND and frame.length == 2:
                self.obey(frame.data[0], frame.data[1])
            self.next_frame += 1
        return self.next_frame - self.first

    cdef int begin_with(self, const Frame *sync, int64_t stamp_ns) except -1:
        """Begin a cycle with a SYNC of another node, seen at `stamp_ns` (CLOCK_REALTIME)."""
        cdef int64_t slots
        self.read_clocks()
        self.sync_ns = stamp_ns - self.realtime_offset_ns
        if self.slot_index < 0:  # the first one
            self.first_index, self.slot_index = self.index, self.index - 1
            self.grid.slot_ns = self.sync_ns - self.grid.period_ns
        self.late_ns = self.sync_ns - self.grid.slot_ns
        slots = self.seen.seen(self.sync_ns)
        self.late_ns -= slots * self.grid.period_ns
        self.index = self.slot_index = max(self.index, self.slot_index + slots)
        self.counter = self.counter % (self.counter_overflow or LAST_NUMBER) + 1
        if self.counter_overflow and sync.length and 0 < sync.data[0] <= self.counter_overflow:
            self.counter = sync.data[0]
        self.intake.begin_seen(self.counter, stamp_ns, self.seen.regular, slots)
        self.slot_begun, self.quiet = True, False
        return 0

    cdef int go_without(self, int64_t now_ns) except -1:
        """Go on without SYNC: the index follows time, the heartbeat is sent; after SILENCE_NS no estimate looks fresh."""
        cdef int64_t silent_ns
        self.grid.slot_ns = self.grid.slot_ns or now_ns
        silent_ns = now_ns - self.grid.slot_ns
        self.index = max(self.index, self.slot_index + silent_ns // self.grid.period_ns)
        if silent_ns > SILENCE_NS + 2 * self.grid.period_ns:
            if not self.quiet and self.slot_index >= 0:
                self.withdraw(STALE)
            self.quiet = True
            self.write_snapshot()
        self.beat()
        return ENDED

    cpdef int reset_communication(self) except -1:
        """Send the boot-up message, and be pre-operational, as an NMT slave begins."""
        self.heartbeat_frame.data[0] = BOOT_UP
        self.send(&self.heartbeat_frame)
        return self.enter(PRE_OPERATIONAL)

    cdef int obey(self, int number, int node) except -1:
        """Obey an NMT command, unless there is no heartbeat; other nodes that leave operational may get another mapping."""
        if number not in COMMANDS:
            return 0  # no node obeys it
        if number != START:
            self.intake.idle(node)
        if node not in (0, self.node_id) or not self.heartbeat_cycles:
            return 0
        if number in (RESET_NODE, RESET_COMMUNICATION):
            return self.reset_communication()
        return self.enter(STATE_AFTER[number])

    cdef int enter(self, uint8_t state) except -1:
        """Enter an NMT state; the supervisor reads it where those of the other nodes are."""
        self.heartbeat_frame.data[0] = self.intake.nodes.state[self.node_id] = state
        self.sends = state == OPERATIONAL
        return 0

    cdef void withdraw(self, int status) noexcept:
        """Withdraw the estimates of all joints (`JointCycle.withdraw`)."""
        cdef int n
        for n in range(self.count):
            (<JointCycle> self.at[n]).withdraw(status)
        if self.watches:
            self.contacts.withdraw(self.states)

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
            encode_into(self.estimate_frames[n].data, &self.states[2 * n].published, second, self.counter)
            sent = self.send(&self.estimate_frames[n]) and sent
        for n in range(self.contact_pdos):
            self.contacts.encode(self.contact_frames[n].data, n, self.counter)
            self.send(&self.contact_frames[n])
        return sent

    cdef int drain(self) except -1:
        """Take the frames that came after the last cycle was closed; return their number."""
        cdef int count = self.receive(), n
        if count:
            for n in range(count):
                self.intake.drain_frame(&self.bus.frames_c[n], self.bus.stamps_c[n], self.bus.own_c[n])
            self.intake.drained()
        return count

    cdef int receive(self) except -1:
        """Take what has come, without echoes of own PDOs; a bus that is down gives nothing and is counted."""
        cdef int count
        try:
            count = self.bus.take()
        except BusDown:
            self.writer.counters[BUS_ERRORS] += 1
            return 0
        return self.intake.without_own(self.bus.frames_c, self.bus.stamps_c, self.bus.own_c, count)

    cdef bint send(self, const Frame *frame) except -1:
        """Send a frame; a bus that is down takes none and is counted."""
        try:
            return self.bus.put(frame)
        except BusDown:
            self.writer.counters[BUS_ERRORS] += 1
            return False
