"""Frames of a bus without Python objects; the rules stand in frame_socket.pyx."""

from libc.stdint cimport int64_t, uint16_t, uint32_t, uint8_t
from posix.time cimport timespec
from posix.uio cimport iovec


# System calls on sockets, and their structures, that Cython itself does not declare

cdef extern from "<sys/socket.h>" nogil:
    enum: MSG_CONFIRM, MSG_DONTWAIT, MSG_NOSIGNAL, MSG_TRUNC, SOL_SOCKET

    struct msghdr:
        iovec *msg_iov
        size_t msg_iovlen
        void *msg_control
        size_t msg_controllen
        int msg_flags

    struct mmsghdr:
        msghdr msg_hdr
        unsigned int msg_len

    struct cmsghdr:
        size_t cmsg_len
        int cmsg_level, cmsg_type

    cmsghdr *CMSG_FIRSTHDR(msghdr *message)
    cmsghdr *CMSG_NXTHDR(msghdr *message, cmsghdr *part)
    unsigned char *CMSG_DATA(cmsghdr *part)
    int recvmmsg(int fd, mmsghdr *messages, unsigned int count, int flags, timespec *timeout)
    ssize_t send(int fd, const void *message, size_t size, int flags)

cdef extern from "<poll.h>" nogil:
    enum: POLLIN

    struct pollfd:
        int fd
        short events, revents

    int ppoll(pollfd *waited, unsigned long count, const timespec *timeout, const void *signals)

cdef struct Frame:  # `struct can_frame` of linux/can.h
    uint32_t id  # with its flags
    uint8_t length
    uint8_t pad[3]
    uint8_t data[8]

cdef enum:
    CONTROL_SIZE = 64  # bytes: stamp 32, overflow counter 24

cdef struct Slot:
    iovec part
    uint8_t control[CONTROL_SIZE]

cdef class FrameReceiver:
    cdef readonly bytearray frames
    cdef readonly bint closed
    cdef readonly uint32_t overflow
    cdef Frame *frames_c  # the memory of `frames`
    cdef int64_t *stamps_c
    cdef mmsghdr *messages
    cdef Slot *slots
    cdef object held
    cdef int capacity, count
    cdef int take(self, int fd) noexcept nogil
    cdef void read_control(self, int i) noexcept nogil

cdef class FrameSocket:
    cdef public int64_t tx_dropped, rx_dropped
    cdef readonly str bus
    cdef readonly int fd
    cdef readonly bytearray frames
    cdef Frame *frames_c  # of the last `take`, as `frames`, `stamps_ns` and `own` are
    cdef int64_t *stamps_c
    cdef bint *own_c
    cdef FrameReceiver receiver
    cdef object sock
    cdef bint on_unix, receive_own, error_frames, gone
    cdef uint16_t hub_drops
    cdef int take(self) except -1
    cdef bint put(self, const Frame *frame) except -1
    cdef bint ready(self, int64_t timeout_ns) except -1
    cdef void read_marks(self, int i) noexcept nogil
    cdef int nothing(self, int n) except -1
    cdef object failure(self, int number)

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
