"""The loop's writer of the snapshot: counters and histograms in each cycle; inputs, nodes and the last estimate in every 8th.

`jtqd.daemon.shared.snapshot` describes the memory, `jtqd.daemon.shared.counters` names the counters.
"""

from libc.stdint cimport int64_t, uint8_t, uint64_t
from libc.string cimport memcpy

from jtqd.daemon.core.bus cimport Bus, bus_of
from jtqd.daemon.core.intake cimport MOST_INPUTS, NODES, NOT_HEARD, Input, Intake
from jtqd.daemon.core.joint cimport JointCycle, JointState
from jtqd.daemon.core.record cimport JointBlock
from jtqd.daemon.shared import cycle_record as cr
from jtqd.daemon.shared import snapshot as shared
from jtqd.daemon.shared.counters import word_of
from jtqd.drivers.frame import worst_case_bits

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

cdef int CYCLES = word_of("cycles"), MISSED = word_of("missed"), COMPLETE = word_of("complete")
cdef int PUBLISHED = word_of("published"), PUBLISHED_LATE = word_of("published_late")
cdef int WORK_MAX = word_of("work_max_ns"), LATE_MAX = word_of("late_max_ns"), BITS = word_of("bits_worst_case")
cdef int TX_DROPPED = word_of("tx_dropped"), RX_DROPPED = word_of("rx_dropped")

cdef int FLAG_COMPLETE = cr.FLAG_COMPLETE, FLAG_PUBLISHED = cr.FLAG_PUBLISHED
cdef int FLAG_BEFORE_NEXT_SYNC = cr.FLAG_BEFORE_NEXT_SYNC
cdef int64_t WORK_BIN_NS = shared.WORK_BIN_NS, LATE_BIN_NS = shared.LATE_BIN_NS
cdef int64_t LAST_WORK_BIN = shared.WORK_BINS - 1, LAST_LATE_BIN = shared.LATE_BINS - 1
cdef int CODES = shared.STATUS_CODES

if (sizeof(InputBlock), sizeof(EstimateBlock), sizeof(LearnedBlock), NODES) != (
    shared.INPUT.size,
    shared.ESTIMATE_SIZE,
    shared.LEARNED.size,
    shared.MAX_NODE,
):
    raise ImportError("the snapshot has another layout than the one that is compiled in")


cdef ViewBlock _view(const JointState *joint) noexcept nogil:
    """Return a joint's `JointView`."""
    cdef const JointBlock *s = &joint.sample
    return ViewBlock(
        s.torque_nm,
        s.sigma_nm,
        s.tob_nm,
        s.physics_nm,
        s.network_nm,
        s.sensor_torque_nm,
        s.statusword,
        s.status,
        s.sensor_status,
        s.input_flags,
        joint.latched,
        s.reference_nm,
        s.age_ms,
        s.torque_rate_nm_s,
        s.contact_nm,
    )


cdef MeasuredBlock _measured(const JointState *joint) noexcept nogil:
    """Return a joint's `Measured`."""
    cdef const JointBlock *s = &joint.sample
    return MeasuredBlock(
        s.current_a,
        s.motor_position_rad,
        s.motor_velocity_rad_s,
        s.link_position_rad,
        s.sensor_torque_nm,
        s.temperature_c,
    )


cdef class SnapshotWriter:
    """Writes into a `Snapshot`.

    Args:
        snapshot: the memory.
        intake: counts frames and inputs, from here on in the snapshot's words.
        socket: counts the frames that it drops.
    """

    def __init__(self, snapshot, Intake intake, socket):
        cdef int n
        if intake.count > shared.MAX_INPUTS:
            raise ValueError(f"found {intake.count} inputs, the snapshot has room for {shared.MAX_INPUTS}")
        self.intake = intake
        self.bus = socket if isinstance(socket, Bus) else bus_of(socket)
        self.counters = intake.counters = snapshot.counters
        self.work, self.late, self.status_cycles = snapshot.work, snapshot.late, snapshot.status_cycles
        self.inputs, self.node_heard, self.node_states = snapshot.inputs, snapshot.node_heard, snapshot.node_states
        self.unconfigured, self.restarts, self.learned = snapshot.unconfigured, snapshot.restarts, snapshot.learned
        self.sequence, self.estimate, self.joints = snapshot.sequence, snapshot.estimate, snapshot.joints
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
        if flags & FLAG_COMPLETE:
            self.counters[COMPLETE] += 1
        else:
            for n in range(self.intake.count):
                if not self.intake.inputs[n].fresh:
                    bits -= self.bits_of[n]
        if flags & FLAG_PUBLISHED:
            self.counters[PUBLISHED] += 1
            if not flags & FLAG_BEFORE_NEXT_SYNC:
                self.counters[PUBLISHED_LATE] += 1
        self.bits += bits
        self.counters[WORK_MAX] = max(self.counters[WORK_MAX], <uint64_t> work_ns)
        self.counters[LATE_MAX] = max(self.counters[LATE_MAX], <uint64_t> late)
        self.work[min(work_ns // WORK_BIN_NS, LAST_WORK_BIN)] += 1
        self.late[min(late // LATE_BIN_NS, LAST_LATE_BIN)] += 1

    cdef void count_status(self, int joint, int status) noexcept nogil:
        """Count the published status of one joint in one cycle."""
        self.status_cycles[CODES * joint + status] += 1

    cdef void begin(self) noexcept nogil:
        """Mark the snapshot as inconsistent until `end` (inputs included)."""
        begin_write(&self.sequence[0])

    cpdef int flush(self, int64_t missed, int64_t sync_ns) except -1:
        """Copy inputs, nodes and the counts of other objects; `sync_ns` is the cycle's SYNC (CLOCK_MONOTONIC)."""
        self.flush_inputs(sync_ns)
        self.counters[MISSED] = missed
        self.counters[BITS] = self.bits  # not in every cycle: readers divide it by the time between two snapshots
        self.counters[TX_DROPPED] = self.bus.tx_dropped()
        self.counters[RX_DROPPED] = self.bus.rx_dropped()
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
                self.used_ns[n],
                self.delay_ns[n],
                state.band_low_ns,
                state.band_high_ns,
                state.late,
                state.lost,
                state.duplicates,
                state.rejected,
                state.missed,
                state.in_a_row,
                state.too_short,
                state.too_long,
            )

    cdef void write_learned(self, int number, JointCycle joint) noexcept nogil:
        """Write what the estimator of joint `number`, from 0 on, has learned, and its state; between `begin` and `end`."""
        cdef LearnedBlock *block = &(<LearnedBlock *> &self.learned[0])[number]
        cdef size_t size = 0
        cdef const void *state = joint.learned(&block.zeros, &size)
        block.size = 0
        if state != NULL and size <= sizeof(block.state):
            block.size = size
            memcpy(block.state, state, size)

    cdef void end(
        self,
        int64_t cycle,
        int sync_counter,
        int64_t sync_realtime_ns,
        int64_t sync_monotonic_ns,
        JointState **joints,
    ) noexcept nogil:
        """Write the last estimate; the snapshot is consistent again."""
        cdef EstimateBlock *block = <EstimateBlock *> &self.estimate[0]
        cdef int n
        block.cycle, block.sync_counter = cycle, sync_counter
        block.sync_realtime_ns, block.sync_monotonic_ns = sync_realtime_ns, sync_monotonic_ns
        for n in range(self.joints):
            if joints[n].sample.status != self.status[n]:
                self.status[n], self.since[n] = joints[n].sample.status, cycle
            block.status_since[n] = self.since[n]
            block.joints[n], block.measured[n] = _view(joints[n]), _measured(joints[n])
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
