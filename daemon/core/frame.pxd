"""One CAN frame: `struct can_frame` of linux/can.h, as `jtqd.drivers.frame.FRAME` describes it."""

from libc.stdint cimport uint8_t, uint32_t

cdef struct Frame:
    uint32_t can_id  # with its flags
    uint8_t length
    uint8_t padding[3]
    uint8_t data[8]
