"""What the instruments of the bench read, and their noise."""

cimport cython


@cython.final
cdef class Noise:
    cdef object uniform
    cdef double left
    cdef bint one_left
    cdef double normal(self) except? -1.0

cdef class DriveSignals:
    cdef public double motor_position_rad, motor_velocity_rad_s, link_position_rad, current_a, temperature_c
    cdef public bint enabled

cdef class ChannelSignal:
    cdef public double torque_nm
    cdef public bint valid
