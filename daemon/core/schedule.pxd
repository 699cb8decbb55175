"""Schedule of a cycle; schedule.pyx."""

from libc.stdint cimport int64_t

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
    Cost one, two
    int64_t end_ns, since_ns

cdef class NetworkBudget:
    cdef BudgetState now
    cpdef bint first(self, int64_t now_ns, int64_t next_sync_ns) noexcept
    cpdef bint second(self, int64_t now_ns) noexcept
    cpdef void ended(self, int64_t now_ns) noexcept
