"""Clocks and schedule of a cycle; schedule.pyx."""

from libc.stdint cimport int64_t

from jtqd.daemon.core.record cimport MOST_JOINTS

cdef class Clock:
    cdef int64_t monotonic(self) except? -1
    cdef int64_t realtime(self) except? -1
    cdef int sleep_until(self, int64_t due_ns) except -1

cdef class Grid:
    cdef public int64_t slot_ns, period_ns, missed
    cpdef int64_t advance(self, int64_t now_ns) noexcept
    cpdef bint too_late(self, int64_t now_ns) noexcept
    cdef int64_t end_ns(self) noexcept

cdef class SyncGrid(Grid):
    cdef int64_t mean_ns, near, due_ns  # of intervals; share of those near the period; where the last SYNC was due
    cdef readonly bint regular
    cdef int64_t seen(self, int64_t sync_ns) noexcept

cdef class WakeUp:
    cdef readonly int64_t wait_ns, deadline_ns
    cpdef void follow(self, int64_t last_delay_ns) noexcept

cdef struct Cost:  # what one joint's estimate takes with its network, as far as known
    int64_t cost_ns, last_ns
    bint wanted

cdef class NetworkBudget:
    cdef int joints
    cdef Cost costs[MOST_JOINTS]
    cdef int64_t latest_ns, since_ns, left_ns
    cpdef void begin(self, int64_t next_sync_ns) noexcept
    cpdef bint wanted(self, int joint, int64_t now_ns) noexcept
    cpdef void ended(self, int64_t now_ns) noexcept
