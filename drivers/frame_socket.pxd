"""Frames of a bus without Python objects; the rules stand in frame_socket.pyx."""

from libc.stdint cimport int64_t, uint8_t, uint16_t, uint32_t
from posix.uio cimport iovec

from jtqd.drivers.linux_socket cimport mmsghdr

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
