"""Schedule of a cycle; schedule.pyx."""

from libc.stdint cimport int64_t

from jtqd.daemon.core.record cimport MOST_JOINTS

cdef struct GridState:
    int64_t slot_ns, period_ns, missed

cdef class Grid:
    cdef GridState now
    cpdef int64_t advance(self, int64_t now_ns) noexcept
    cpdef bint too_late(self, int64_t now_ns) noexcept
    cdef int64_t end_ns(self) noexcept

cdef struct WakeUpState:
    int64_t wait_ns, deadline_ns

cdef class WakeUp:
    cdef WakeUpState now
    cpdef void follow(self, int64_t last_delay_ns) noexcept

cdef struct Cost:  # what one joint's estimate takes with its network, as far as known
    int64_t cost_ns, last_ns
    bint wanted

cdef struct BudgetState:
    Cost costs[MOST_JOINTS]
    int64_t end_ns, since_ns, left_ns

cdef class NetworkBudget:
    cdef BudgetState now
    cdef int joints
    cpdef void begin(self, int64_t next_sync_ns) noexcept
    cpdef bint wanted(self, int joint, int64_t now_ns) noexcept
    cpdef void ended(self, int64_t now_ns) noexcept
