"""Losses and temperature of a true joint; the laws stand in losses.pyx."""

cimport cython


@cython.final
cdef class JointTemperature:
    cdef double usual, reference, kelvin_per_w, time_constant, viscous_per_k, coulomb_per_k
    cdef double ambient, heat_j, time_s
    cdef public double celsius
    cdef readonly double viscous, coulomb
    cpdef bint add(self, double power_w, double dt_s) noexcept
    cdef void factors(self) noexcept

@cython.final
cdef class LossTable:
    cdef readonly double torque_limit, per_torque_step, per_velocity_step
    cdef readonly int last_row
    cdef readonly object forward, reverse
    cdef double[:, ::1] forward_rows, reverse_rows
    cdef int columns
    cdef double at(self, double torque, double velocity) noexcept nogil

@cython.final
cdef class JointFriction:
    cdef LossTable table
    cdef double scale, stribeck, inverse_vs, reach, constant, viscous
    cpdef void differ(self, double constant_nm, double viscous_nms_per_rad) noexcept
    cdef double at(self, double torque, double velocity) noexcept nogil
