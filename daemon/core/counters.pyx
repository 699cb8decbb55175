"""What the loop counts: once per cycle what only it knows, every n-th cycle what its parts have counted and the last estimate.

All of it goes into the memory of the snapshot (`jtqd.daemon.shared.snapshot`), which says what its parts are.
"""

from libc.stdint cimport int64_t, uint8_t, uint64_t
from libc.string cimport memcpy

import struct

from jtqd.estimator.block cimport copied, put_back
from jtqd.daemon.core.bus cimport Bus, bus_of
from jtqd.daemon.core.intake cimport MOST_INPUTS, NODES, Input, Intake, NodeState
from jtqd.daemon.core.joint cimport JointCycle, JointState
from jtqd.daemon.core.record cimport JointBlock
from jtqd.daemon.shared import cycle_record as cr
from jtqd.daemon.shared import snapshot as shared
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

_INDEX = {name: n for n, name in enumerate(shared.COUNTERS)}

cdef int CYCLES = _INDEX["cycles"], MISSED = _INDEX["missed"], COMPLETE = _INDEX["complete"]
cdef int PUBLISHED = _INDEX["published"], PUBLISHED_LATE = _INDEX["published_late"]
cdef int WORK_MAX = _INDEX["work_max_ns"], LATE_MAX = _INDEX["late_max_ns"], BITS = _INDEX["bits_worst_case"]
cdef int STALE_INPUTS = _INDEX["stale_inputs"], LATE_FRAMES = _INDEX["late_frames"]
cdef int DUPLICATE_FRAMES = _INDEX["duplicate_frames"], REJECTED_FRAMES = _INDEX["rejected_frames"]
cdef int UNKNOWN_FRAMES = _INDEX["unknown_frames"], FOREIGN_SYNC = _INDEX["foreign_sync"]
cdef int SYNC_ERRORS = _INDEX["sync_errors"], SYNC_GAPS = _INDEX["sync_gaps"], BOOT_UPS = _INDEX["boot_ups"]
cdef int TEMPERATURES_LOST = _INDEX["temperatures_lost"]
cdef int TX_DROPPED = _INDEX["tx_dropped"], RX_DROPPED = _INDEX["rx_dropped"], BUS_ERRORS = _INDEX["bus_errors"]
cdef int OVERRUNS = _INDEX["overruns"], LATCH_RESETS = _INDEX["latch_resets"]
cdef int CONTACTS = _INDEX["contacts"]

cdef int FLAG_COMPLETE = cr.FLAG_COMPLETE, FLAG_PUBLISHED = cr.FLAG_PUBLISHED
cdef int FLAG_BEFORE_NEXT_SYNC = cr.FLAG_BEFORE_NEXT_SYNC
cdef int64_t WORK_BIN_NS = shared.WORK_BIN_NS, LATE_BIN_NS = shared.LATE_BIN_NS
cdef int64_t LAST_WORK_BIN = shared.WORK_BINS - 1, LAST_LATE_BIN = shared.LATE_BINS - 1
cdef int CODES = shared.STATUS_CODES
cdef enum:
    NOT_HEARD = 0xFF

if (sizeof(InputBlock), sizeof(EstimateBlock), sizeof(LearnedBlock), NODES) != (
    shared.INPUT.size,
    shared.ESTIMATE_SIZE,
    shared.LEARNED.size,
    shared.MAX_NODE,
):
    raise ImportError("the snapshot has another layout than the one that is compiled in")


cdef class LastEstimate:
    """The last estimate of all joints in the snapshot, guarded by its sequence number.

    snapshot: whose memory it is.
    """

    def __init__(self, snapshot):
        cdef int n
        self.sequence, self.memory, self.joints = snapshot.sequence, snapshot.estimate, snapshot.joints
        for n in range(MOST_JOINTS):
            self.now.status[n] = -1

    def begin(self):
        """Mark the snapshot as inconsistent until the end of `write` (counters and inputs included)."""
        self.begin_telling()

    def write(
        self,
        int64_t index,
        int sync_counter,
        int64_t sync_realtime_ns,
        joints,
        *,
        int64_t sync_monotonic_ns=0,
        measured=None,
    ):
        """Publish the last estimate; `joints` are `JointView` tuples, `measured` begin with the fields of `Measured`.

        Without `measured` no input is known.
        """
        cdef ViewBlock views[MOST_JOINTS]
        cdef MeasuredBlock inputs[MOST_JOINTS]
        cdef int n
        if len(joints) != self.joints:
            raise ValueError(f"found {len(joints)} joints, expected {self.joints}")
        measured = measured or [shared.NOT_MEASURED] * self.joints
        for n in range(self.joints):
            put_back(&views[n], sizeof(ViewBlock), shared.JOINT.pack(*joints[n]))
            put_back(&inputs[n], sizeof(MeasuredBlock), struct.pack("<6d", *measured[n][:6]))
        self.begin_telling()
        self.tell(index, sync_counter, sync_realtime_ns, sync_monotonic_ns, views, inputs)

    cdef void begin_telling(self) noexcept nogil:
        """As `begin`."""
        begin_write(&self.sequence[0])

    cdef void tell(
        self,
        int64_t cycle,
        int sync_counter,
        int64_t sync_realtime_ns,
        int64_t sync_monotonic_ns,
        const ViewBlock *joints,
        const MeasuredBlock *measured,
    ) noexcept nogil:
        """As `write`."""
        cdef EstimateBlock *told = <EstimateBlock *> &self.memory[0]
        cdef int n
        told.cycle, told.sync_counter = cycle, sync_counter
        told.sync_realtime_ns, told.sync_monotonic_ns = sync_realtime_ns, sync_monotonic_ns
        for n in range(self.joints):
            if joints[n].status != self.now.status[n]:
                self.now.status[n], self.now.since[n] = joints[n].status, cycle
            told.status_since[n] = self.now.since[n]
            told.joints[n], told.measured[n] = joints[n], measured[n]
        end_write(&self.sequence[0])


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


cdef class LoopCounters:
    """Counters, histograms, inputs, nodes and the last estimate in the snapshot, fed by the loop.

    Args:
        snapshot: whose memory they are.
        intake, socket: count frames and inputs themselves.

    Attributes:
        bus_errors: calls that a bus which is down refused.
        overruns: cycles whose estimate was not ready before the next SYNC was due.
        latch_resets: joints whose latched faults were released by a reset.
        last: the last estimate.
    """

    def __init__(self, snapshot, Intake intake, socket):
        cdef int n
        if intake.count > shared.MAX_INPUTS:
            raise ValueError(f"found {intake.count} inputs, the snapshot has room for {shared.MAX_INPUTS}")
        self.intake = intake
        self.bus = socket if isinstance(socket, Bus) else bus_of(socket)
        self.counters, self.work, self.late = snapshot.counters, snapshot.work, snapshot.late
        self.status_cycles, self.inputs = snapshot.status_cycles, snapshot.inputs
        self.node_heard, self.node_states = snapshot.node_heard, snapshot.node_states
        self.unconfigured, self.restarts = snapshot.unconfigured, snapshot.restarts
        self.learned = snapshot.learned
        self.last = LastEstimate(snapshot)
        self.bits_complete = worst_case_bits(1) + (snapshot.joints + 1) // 2 * worst_case_bits(8)
        for n in range(intake.count):
            self.bits_of[n] = worst_case_bits(intake.inputs[n].length)
            self.bits_complete += self.bits_of[n]

    @property
    def bus_errors(self):
        return self.now.bus_errors

    @property
    def overruns(self):
        return self.now.overruns

    @property
    def latch_resets(self):
        return self.now.latch_resets

    def cycle(self, int flags, int64_t work_ns, int64_t late_ns, int64_t missed):
        """Count one cycle, with the flags of its record; times in ns, `missed` slots so far."""
        self.count(flags, work_ns, late_ns, missed)

    def statuses(self, *codes):
        """Count the published status of each joint in one cycle, joint 1 first."""
        for joint, status in enumerate(codes):
            self.count_status(joint, status)

    def flush(self, int64_t missed, int64_t sync_ns):
        """Copy the counts of other objects to the snapshot; `sync_ns` is the cycle's SYNC (CLOCK_MONOTONIC)."""
        self.flush_all(missed, sync_ns)

    cdef void count(self, int flags, int64_t work_ns, int64_t late_ns, int64_t missed) noexcept nogil:
        """As `cycle`."""
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
        self.now.bits += bits
        self.counters[WORK_MAX] = max(self.counters[WORK_MAX], <uint64_t> work_ns)
        self.counters[LATE_MAX] = max(self.counters[LATE_MAX], <uint64_t> late)
        self.work[min(work_ns // WORK_BIN_NS, LAST_WORK_BIN)] += 1
        self.late[min(late // LATE_BIN_NS, LAST_LATE_BIN)] += 1

    cdef void count_status(self, int joint, int status) noexcept nogil:
        """Count the published status of one joint in one cycle."""
        self.status_cycles[CODES * joint + status] += 1

    cdef int flush_all(self, int64_t missed, int64_t sync_ns) except -1:
        """As `flush`."""
        cdef Intake intake = self.intake
        cdef int64_t lost = 0
        cdef int n
        for n in range(intake.temperature_count):
            lost += intake.celsius[n].lost
        self.flush_inputs(sync_ns)
        self.counters[MISSED] = missed
        self.counters[BITS] = self.now.bits  # not in every cycle: readers divide it by the time between two snapshots
        self.counters[STALE_INPUTS] = intake.now.stale_inputs
        self.counters[LATE_FRAMES] = intake.now.late_frames
        self.counters[DUPLICATE_FRAMES] = intake.now.duplicate_frames
        self.counters[REJECTED_FRAMES] = intake.now.rejected_frames
        self.counters[UNKNOWN_FRAMES] = intake.now.unknown_frames
        self.counters[FOREIGN_SYNC] = intake.now.foreign_sync
        self.counters[SYNC_ERRORS] = intake.now.sync_errors
        self.counters[SYNC_GAPS] = intake.gaps.now.count
        self.counters[BOOT_UPS] = intake.nodes.now.boot_ups
        self.counters[TEMPERATURES_LOST] = lost
        self.counters[TX_DROPPED] = self.bus.tx_dropped()
        self.counters[RX_DROPPED] = self.bus.rx_dropped()
        self.counters[BUS_ERRORS] = self.now.bus_errors
        self.counters[OVERRUNS] = self.now.overruns
        self.counters[LATCH_RESETS] = self.now.latch_resets
        self.counters[CONTACTS] = self.now.contacts
        self.flush_nodes()
        return 0

    cdef void flush_nodes(self) noexcept nogil:
        """Who was heard, who has restarted, who is not believed."""
        cdef NodeState *nodes = &self.intake.nodes.now
        cdef int node
        for node in range(NODES):
            if nodes.unconfigured[node]:
                self.unconfigured[node] = 1
            if nodes.state[node] == NOT_HEARD:
                continue
            self.node_states[node] = nodes.state[node]
            self.node_heard[node] = nodes.heard_ns[node]
            if nodes.restarts[node]:
                self.restarts[node] = nodes.restarts[node]

    cdef void flush_inputs(self, int64_t sync_ns) noexcept nogil:
        """One `InputView` for each PDO."""
        cdef InputBlock *told = <InputBlock *> &self.inputs[0]
        cdef Input *state
        cdef int n
        for n in range(self.intake.count):
            state = self.intake.inputs[n]
            if state.fresh:
                self.now.used_ns[n] = sync_ns
                self.now.delay_ns[n] = state.stamp_ns - self.intake.now.sync_stamp_ns
            told[n] = InputBlock(
                self.now.used_ns[n],
                self.now.delay_ns[n],
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

    cdef void tell_learned(self, int number, JointCycle joint) noexcept nogil:
        """Tell what the estimator of joint `number`, from 0 on, has learned, and its state; between `begin` and `tell`."""
        cdef LearnedBlock *block = &(<LearnedBlock *> &self.learned[0])[number]
        cdef size_t size = 0
        cdef const void *past = joint.learned(&block.told, &size)
        block.size = 0
        if past != NULL and size <= sizeof(block.past):
            block.size = size
            memcpy(block.past, past, size)

    cdef void tell(
        self,
        int64_t cycle,
        int sync_counter,
        int64_t sync_realtime_ns,
        int64_t sync_monotonic_ns,
        JointState **joints,
    ) noexcept nogil:
        """Publish the last estimate."""
        cdef ViewBlock views[MOST_JOINTS]
        cdef MeasuredBlock measured[MOST_JOINTS]
        cdef int n
        for n in range(self.last.joints):
            views[n], measured[n] = _view(joints[n]), _measured(joints[n])
        self.last.tell(cycle, sync_counter, sync_realtime_ns, sync_monotonic_ns, views, measured)


def frame_counts(intake):
    """Return late, lost, duplicate and rejected frames by PDO name; for a temperature, how often it became unknown."""
    counts = {
        state.pdo.name: {
            "late": state.late,
            "lost": state.lost,
            "duplicate": state.duplicates,
            "rejected": state.rejected,
        }
        for state in intake.views()
    }
    for each in intake.temperatures:
        counts[each.name] = {"late": 0, "lost": each.lost, "duplicate": 0, "rejected": each.rejected}
    return counts
