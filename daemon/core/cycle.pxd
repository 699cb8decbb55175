"""One cycle of the loop; cycle.pyx."""

from cpython.object cimport PyObject
from libc.stdint cimport int64_t, uint32_t, uint64_t

from jtqd.daemon.core.bus cimport Bus
from jtqd.daemon.core.contact cimport ContactWatch
from jtqd.drivers.frame_socket cimport Frame
from jtqd.daemon.core.intake cimport Intake
from jtqd.daemon.core.joint cimport JointCycle, JointState
from jtqd.daemon.core.record cimport MOST_JOINTS, CycleFrames, RecordRing
from jtqd.daemon.core.schedule cimport Clock, Grid, NetworkBudget, WakeUp
from jtqd.daemon.core.snapshot cimport SnapshotWriter

cdef enum:
    MOST_ESTIMATES = 2

cdef class Cycle:
    cdef readonly object snapshot, configured_nodes
    cdef readonly Intake intake
    cdef readonly Grid grid
    cdef readonly tuple joints
    cdef NetworkBudget budget
    cdef WakeUp wake_up
    cdef CycleFrames frames
    cdef SnapshotWriter writer
    cdef ContactWatch contacts  # None: they are not watched
    cdef bint watches
    cdef int count  # of joints
    cdef PyObject *at[MOST_JOINTS]  # `joints`, which keeps them
    cdef JointState *states[MOST_JOINTS]  # theirs
    cdef RecordRing records
    cdef Clock clock
    cdef Bus bus
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
    cpdef int begin(self) except -1
    cpdef int gather(self) except -1
    cpdef int observe(self) except -1
    cpdef int publish(self) except -1
    cpdef int record(self) except -1
    cpdef bint pass_slot(self) except -1
    cdef void keep_for_next(self, const Frame *frame, int64_t stamp_ns) noexcept nogil
    cdef void withdraw(self, int status) noexcept
    cpdef int write_snapshot(self) except -1
    cdef bint send_estimate(self) except -1
    cdef int receive(self) except -1
    cdef bint send(self, const Frame *frame) except -1
