"""One cycle of the loop; cycle.pyx."""

from cpython.object cimport PyObject
from libc.stdint cimport int64_t, uint32_t

from jtqd.daemon.core.bus cimport Bus
from jtqd.daemon.core.clock cimport Clock
from jtqd.daemon.core.contact cimport ContactWatch
from jtqd.daemon.core.counters cimport LoopCounters
from jtqd.drivers.frame_socket cimport Frame
from jtqd.daemon.core.intake cimport Intake
from jtqd.daemon.core.joint cimport JointCycle, JointState
from jtqd.daemon.core.record cimport MOST_JOINTS, CycleFrames, RecordRing
from jtqd.daemon.core.schedule cimport Grid, NetworkBudget, WakeUp

cdef enum:
    MOST_ESTIMATES = 2

cdef struct CycleState:
    int64_t index, heartbeat_due
    int64_t sync_ns, sync_realtime_ns, realtime_offset_ns, work_start_ns, late_ns, sent_ns
    int64_t stale_before, late_before, duplicate_before, rejected_before  # counts of the intake when it began
    int counter
    uint32_t flags, next_flags

cdef class Cycle:
    cdef readonly object socket, ring, snapshot, configured_nodes
    cdef readonly Intake intake
    cdef readonly Grid grid
    cdef readonly tuple joints
    cdef readonly NetworkBudget budget
    cdef readonly WakeUp wake_up
    cdef readonly CycleFrames frames
    cdef readonly LoopCounters counters
    cdef readonly ContactWatch contacts  # None: they are not watched
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
    cdef CycleState now
    cpdef int begin(self) except -1
    cpdef int gather(self) except -1
    cpdef int observe(self) except -1
    cpdef int publish(self) except -1
    cpdef int record(self) except -1
    cpdef bint hold_back(self) except -1
    cdef void hold(self, const Frame *frame, int64_t stamp_ns) noexcept nogil
    cdef void take_back(self, int status) noexcept
    cdef int write_snapshot(self) except -1
    cdef bint send_estimate(self) except -1
    cdef int receive(self) except -1
    cdef bint send(self, const Frame *frame) except -1
