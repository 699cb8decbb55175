"""Drives, instruments and the frame of a plant of all benches; what they do stands in drives.pyx."""

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

@cython.final
cdef class DriveControl:
    cdef readonly int mode
    cdef readonly double target, current_a, integral_a, reference_rad_s, slope_rad_s2
    cdef public double interpolation_s
    cdef double bandwidth, kp, integral_rate, inertia_a, friction, smooth, slope_limit, limit
    cdef double to_go_s, feedforward, base, decay_step, decay
    cpdef void plan(self, double dt_s) noexcept
    cpdef double step(self, double h, double motor_velocity_rad_s) noexcept

cdef struct Truth:  # of one joint, own frame
    double motor_rad, motor_rad_s, link_rad, current_a, celsius

cdef class TwoJoints:
    cdef readonly object parameters
    cdef readonly tuple drives
    cdef public double substep_s, link_position, link_velocity
    cdef DriveControl drive_1, drive_2
    cdef double external_nm, next_external_nm, until_next_s  # on link 2, joint 1's frame
    cdef double external(self, double h) noexcept
    cpdef step(self, double dt_s)
    cpdef _integrate(self, int steps, double h)
    cdef int warm(self, double dt_s) except -1
    cdef Truth truth(self, int k) except *
    cpdef double sensor_torque(self) except? -1.0

cdef enum: MOST_WAVES = 8

cdef struct Waves:
    int count
    double order[MOST_WAVES]
    double amplitude[MOST_WAVES]
    double phase[MOST_WAVES]

cdef Waves waves_of(entries) except *
cdef double waves_at(const Waves *waves, double angle) noexcept nogil
cdef double waves_slope(const Waves *waves, double angle) noexcept nogil

@cython.final
cdef class Encoders:
    cdef double count_rad, filter_s, link_noise, current_noise, current_offset
    cdef double motor_zero, link_zero, current_zero, current_gain
    cdef double count, share_dt, share
    cdef Waves motor_errors, link_errors, current_ripple
    cdef Noise noise
    cdef readonly DriveSignals signals
    cdef int begin_day(self, double motor_zero, double link_zero, double current_zero, double current_gain) except -1
    cdef int sample(self, const Truth *truth, double dt_s) except -1

cdef class Instruments:
    cdef Encoders encoders_1, encoders_2
    cdef readonly tuple drives
    cdef readonly ChannelSignal channel
    cdef double gain, zero_nm, noise_nm
    cdef readonly double day_zero_nm
    cdef Noise noise
