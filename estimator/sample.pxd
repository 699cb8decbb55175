"""One sample of a joint, what an estimator makes of it, and the class that all estimators share."""

from libc.stdint cimport uint64_t

cdef enum:
    MOST_FEATURES = 8

cdef struct Sample:
    double dt_s  # since the sample before
    double current_a, motor_position_rad, motor_velocity_rad_s, link_position_rad
    double temperature_c  # NaN where it is not known

cdef struct Values:  # `jtqd.estimator.status.Estimate` as a block; NaN where not computed or not to be published
    double torque_nm, sigma_nm, tob_nm, physics_nm, network_nm
    double torque_rate_nm_s, load_nm  # `contact`: load of the sample before
    int status

cdef struct Learned:  # `jtqd.estimator.path_difference.Zeros` as a block
    double link_rad, link_sigma_rad, link_used_rad, current_a, current_sigma_a, current_used_a, limit_rad
    uint64_t flags, jumps

cdef void no_values(Values *out, int status) noexcept nogil

cdef class Estimator:
    cdef readonly object joint, settings
    cdef int width  # features of the network
    cdef double features[MOST_FEATURES]  # of the last sample that was observed
    cdef bint observed  # whether the last sample was
    cdef object run_one  # of a network that is not evaluated natively
    cdef void advance(self, const Sample *sample, bint network_wanted, Values *out) noexcept nogil
    cdef double ask(self) noexcept with gil
    cdef const void *learned(self, Learned *out, size_t *size) noexcept nogil
