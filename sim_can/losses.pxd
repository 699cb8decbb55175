"""Losses of a true joint by what it transmits; the laws stand in losses.pyx."""

cimport cython

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
