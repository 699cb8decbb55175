"""Members of a unix bus; the rules stand in relay.pyx."""

from libc.stdint cimport int64_t, uint8_t, uint32_t

from jtqd.drivers.frame_socket cimport Frame, FrameReceiver

cdef enum:
    MOST_CLIENTS = 64
    STANDARD_IDS = 0x800

cdef class HubCounters:
    cdef readonly int64_t frames, malformed, dropped, refused, tx_full

cdef class Member:
    cdef bint take(self, const Frame *frame, int64_t stamp_ns) except -1

cdef class LocalPort(Member):
    cdef Relay relay
    cdef object on_frame
    cdef bint hears_all
    cdef uint8_t hears[STANDARD_IDS]

cdef class Client(Member):
    cdef object sock
    cdef int fd
    cdef uint32_t dropped

cdef class Relay:
    cdef readonly HubCounters counters
    cdef readonly object wire, _listener, _answering_ns
    cdef readonly dict _clients
    cdef FrameReceiver receiver
    cdef list members  # replaced, never changed: a delivery goes on with those that were there
    cdef object queue
    cdef bint delivering, heard
    cdef double paused_until
    cpdef run_once(self, timeout_s)
    cdef int64_t bounded(self, timeout_s) except -1
    cdef int accept(self) except -1
    cdef int read(self, Client client) except -1
    cdef bint submit(self, Member sender, const Frame *frame, int64_t stamp_ns) except -1
    cdef int advance(self) except -1
    cdef int deliver(self, Member sender, const Frame *frame, int64_t stamp_ns) except -1
    cdef int deliver_one(self, Member sender, const Frame *frame, int64_t stamp_ns) except -1
