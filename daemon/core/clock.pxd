"""The clocks of the loop; clock.pyx."""

from libc.stdint cimport int64_t

cdef class Clock:
    cdef int64_t monotonic(self) except? -1
    cdef int64_t realtime(self) except? -1
    cdef int sleep_until(self, int64_t due_ns) except -1
