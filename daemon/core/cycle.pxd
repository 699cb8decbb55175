"""One cycle of the loop; cycle.pyx."""

from cpython.object cimport PyObject
from libc.stdint cimport int64_t, uint8_t, uint16_t, uint32_t, uint64_t

from jtqd.daemon.core.intake cimport MOST_INPUTS, Intake
from jtqd.daemon.core.joint cimport ContactWatch, JointCycle, JointState
from jtqd.daemon.core.record cimport MOST_JOINTS, RecordRing
from jtqd.daemon.core.schedule cimport Clock, Grid, NetworkBudget, SyncGrid, WakeUp
from jtqd.drivers.frame_socket cimport Frame, FrameSocket
from jtqd.estimator.fusion cimport Learned

# The snapshot: structs that lie in memory as `jtqd.daemon.shared.snapshot` has them

cdef struct InputBlock:  # `INPUT` of the snapshot
    int64_t used_ns, delay_ns, low_ns, high_ns
    int64_t late, lost, duplicates, rejected, missed, in_a_row, too_short, too_long

cdef struct ViewBlock:  # a `JointView`
    double torque_nm, sigma_nm, tob_nm, physics_nm, network_nm, sensor_nm
    uint16_t statusword
    uint8_t status, sensor_status
    uint16_t input_flags, latched
    double reference_nm, age_ms
    double torque_rate_nm_s, contact_nm
    uint32_t latches, released

cdef struct MeasuredBlock:  # a `Measured`
    double current_a, motor_position_rad, motor_velocity_rad_s, link_position_rad, sensor_nm, temperature_c

cdef enum:
    STATE_WORDS = 320  # room for the state of an estimator

cdef struct LearnedBlock:  # `LEARNED`: zeros, and the estimator's state after the cycle of the last estimate
    Learned zeros
    uint64_t size  # of the state in bytes; 0: there is none
    uint64_t state[STATE_WORDS]

cdef struct EstimateBlock:
    int64_t cycle
    uint64_t sync_counter
    int64_t sync_realtime_ns, sync_monotonic_ns
    int64_t status_since[MOST_JOINTS]
    ViewBlock joints[MOST_JOINTS]
    MeasuredBlock measured[MOST_JOINTS]

cdef class SnapshotWriter:
    cdef uint64_t[::1] counters, work, late, status_cycles, restarts, sequence
    cdef int64_t[::1] node_heard
    cdef uint8_t[::1] inputs, node_states, unconfigured, learned, estimate, shadows
    cdef Intake intake
    cdef FrameSocket bus
    cdef int joints
    cdef int64_t bits, bits_complete
    cdef int64_t bits_of[MOST_INPUTS]
    cdef int64_t used_ns[MOST_INPUTS]
    cdef int64_t delay_ns[MOST_INPUTS]
    cdef int status[MOST_JOINTS]
    cdef int64_t since[MOST_JOINTS]
    cdef void count(self, int flags, int64_t work_ns, int64_t late_ns, int64_t missed) noexcept nogil
    cdef void begin(self) noexcept nogil
    cpdef int flush(self, int64_t missed, int64_t sync_ns) except -1
    cdef void flush_inputs(self, int64_t sync_ns) noexcept nogil
    cdef void flush_nodes(self) noexcept nogil
    cdef void write_learned(self, int number, JointCycle joint) noexcept nogil
    cdef void end(
        self, int64_t cycle, int sync_counter, int64_t sync_realtime_ns, int64_t sync_monotonic_ns, JointState **joints
    ) noexcept nogil

cdef class PythonSocket(FrameSocket):
    cdef int count_dropped(self) except -1

cdef enum:
    MOST_ESTIMATES = 2

cdef class Cycle:
    cdef readonly object snapshot, configured_nodes
    cdef readonly Intake intake
    cdef readonly Grid grid
    cdef readonly tuple joints
    cdef NetworkBudget budget
    cdef WakeUp wake_up
    cdef SnapshotWriter writer
    cdef ContactWatch contacts  # None: they are not watched
    cdef bint watches
    cdef int count  # of joints
    cdef PyObject *at[MOST_JOINTS]  # `joints`, which keeps them
    cdef JointState *states[MOST_JOINTS]  # theirs
    cdef RecordRing ring
    cdef Clock clock
    cdef FrameSocket bus
    cdef int counter_overflow
    cdef int64_t heartbeat_cycles
    cdef int estimates  # PDOs: one for each two joints
    cdef Frame estimate_frames[MOST_ESTIMATES]
    cdef int contact_pdos
    cdef Frame contact_frames[MOST_ESTIMATES]
    cdef Frame heartbeat_frame
    cdef readonly int64_t index, sync_ns, sent_ns
    cdef public int64_t work_start_ns, late_ns
    cdef readonly int counter
    cdef readonly uint32_t flags
    cdef uint32_t next_flags
    cdef int64_t heartbeat_due, sync_realtime_ns, realtime_offset_ns
    cdef uint64_t counted[4]  # stale inputs, late, duplicate and rejected frames when the cycle began
    cdef SyncGrid seen  # the grid, where SYNC is another node's
    cdef bint follows, sends, slot_begun, opened, next_sync, quiet
    cdef int node_id, batch, next_frame, first  # frames of the last `receive`, the next of them, and the first to be taken
    cdef int64_t first_index, slot_index  # of the first SYNC seen, and of the last one
    cdef int open_record(self) except -1
    cdef int64_t read_clocks(self) except? -1
    cdef int beat(self) except -1
    cdef int follow(self, int64_t end_ns) except -1
    cdef int take_until_sync(self) except -1
    cdef int begin_with(self, const Frame *sync, int64_t stamp_ns) except -1
    cdef int go_without(self, int64_t now_ns) except -1
    cpdef int reset_communication(self) except -1
    cdef int obey(self, int number, int node) except -1
    cdef int enter(self, uint8_t state) except -1
    cpdef int begin(self) except -1
    cpdef int gather(self) except -1
    cpdef int observe(self) except -1
    cpdef int publish(self) except -1
    cpdef int record(self) except -1
    cpdef bint pass_slot(self) except -1
    cdef void withdraw(self, int status) noexcept
    cpdef int write_snapshot(self) except -1
    cdef bint send_estimate(self) except -1
    cdef int drain(self) except -1
    cdef int receive(self) except -1
    cdef bint send(self, const Frame *frame) except -1
