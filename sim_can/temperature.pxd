"""Temperature of one joint; the law stands in temperature.pyx."""

cimport cython

@cython.final
cdef class JointTemperature:
    cdef double usual, reference, kelvin_per_w, time_constant, viscous_per_k, coulomb_per_k
    cdef double ambient, heat_j, time_s
    cdef public double celsius
    cdef readonly double viscous, coulomb
    cpdef bint add(self, double power_w, double dt_s) noexcept
    cdef void factors(self) noexcept
