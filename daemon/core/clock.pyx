"""The clocks of the loop, integer ns: CLOCK_MONOTONIC for its grid, CLOCK_REALTIME for the kernel's stamps."""

from libc.errno cimport EINTR
from libc.stdint cimport int64_t
from posix.time cimport CLOCK_MONOTONIC, CLOCK_REALTIME, clock_gettime, clock_nanosleep, timespec

cdef enum:
    TIMER_ABSTIME = 1
cdef int64_t NS_PER_S = 1_000_000_000


cdef int64_t _read(int clock) noexcept nogil:
    cdef timespec now
    clock_gettime(clock, &now)
    return now.tv_sec * NS_PER_S + now.tv_nsec


cdef class Clock:
    """Those of the machine."""

    cdef int64_t monotonic(self) except? -1:
        """Return CLOCK_MONOTONIC."""
        return _read(CLOCK_MONOTONIC)

    cdef int64_t realtime(self) except? -1:
        """Return CLOCK_REALTIME."""
        return _read(CLOCK_REALTIME)

    cdef int sleep_until(self, int64_t due_ns) except -1:
        """Return when it is `due_ns` (CLOCK_MONOTONIC), at once when it has passed; other threads may run meanwhile."""
        cdef timespec due
        due.tv_sec, due.tv_nsec = due_ns // NS_PER_S, due_ns % NS_PER_S
        with nogil:
            while clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &due, NULL) == EINTR:
                pass
        return 0


cdef class PythonClock(Clock):
    """One that a test turns: `monotonic_ns`, `time_ns` and `sleep` of module `time`, or of what takes its place."""

    cdef object time

    def __init__(self, time):
        self.time = time

    cdef int64_t monotonic(self) except? -1:
        """Return CLOCK_MONOTONIC."""
        return self.time.monotonic_ns()

    cdef int64_t realtime(self) except? -1:
        """Return CLOCK_REALTIME."""
        return self.time.time_ns()

    cdef int sleep_until(self, int64_t due_ns) except -1:
        """Sleep for what is left."""
        cdef int64_t left_ns = due_ns - self.monotonic()
        if left_ns > 0:
            self.time.sleep(left_ns * 1e-9)
        return 0
