"""Where a cycle takes its frames from and puts its own; bus.pyx."""

from libc.stdint cimport int64_t

from jtqd.drivers.frame_socket cimport Frame

cdef class Bus:
    cdef const Frame *frames
    cdef const int64_t *stamps_ns
    cdef const bint *own
    cdef int take(self) except -1
    cdef bint put(self, const Frame *frame) except -1
    cdef bint wait(self, int64_t timeout_ns) except -1
    cdef int64_t tx_dropped(self) except -1
    cdef int64_t rx_dropped(self) except -1

cdef Bus bus_of(object socket)
