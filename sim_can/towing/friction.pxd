"""Bristle friction; the law stands in friction.pyx."""

cimport cython

from jtqd.sim_can.towing.waves cimport Waves

@cython.final
cdef class BristleFriction:
    cdef double coulomb, static_share, inverse_vs, peak_exponent
    cdef double load, load_exponent, per_rated, direction
    cdef double viscous, viscous_exponent
    cdef double stiffness, damping
    cdef double coulomb_factor, viscous_factor
    cdef Waves waves
    cdef readonly double deflection
    cdef public double torque
    cpdef void warm(self, double coulomb_factor, double viscous_factor) noexcept
    cpdef double sliding(self, double torque, double velocity, double angle) noexcept
    cpdef double viscous_at(self, double speed) noexcept
    cdef double settle(self, double free, double mobility, double torque, double velocity, double angle, double h) noexcept
