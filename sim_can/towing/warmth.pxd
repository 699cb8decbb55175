"""Temperatures of one joint; the law stands in warmth.pyx."""

cimport cython

@cython.final
cdef class Warmth:
    cdef double ambient_c, reference_c
    cdef double grease_k_per_w, grease_s, housing_k_per_w, housing_s
    cdef double coulomb_per_k, vogel_k, vogel_c
    cdef double room_c, heat_j, time_s
    cdef readonly double grease_c, housing_c, coulomb, viscous
    cpdef void start(self, double difference_k) noexcept
    cpdef bint add(self, double power_w, double dt_s) noexcept
