"""What the instruments of the bench read."""

cdef class DriveSignals:
    cdef public double motor_position_rad, motor_velocity_rad_s, link_position_rad, current_a, temperature_c
    cdef public bint enabled

cdef class ChannelSignal:
    cdef public double torque_nm
    cdef public bint valid
