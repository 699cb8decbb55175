"""Gear of one joint; the law stands in gear.pyx."""

cimport cython

from jtqd.sim_can.towing.waves cimport Waves

cdef enum: MOST_SLIPS = 6

@cython.final
cdef class Gear:
    cdef double per_ratio, damping
    cdef double stiffness[3]
    cdef double corner[2]  # torsion at T1 and T2
    cdef double level[2]  # T1 and T2
    cdef Waves errors
    cdef int slips
    cdef double slip_nm[MOST_SLIPS]
    cdef double per_travel[MOST_SLIPS]
    cdef double state[MOST_SLIPS]  # z_j
    cdef readonly double torsion  # δ [rad]
    cpdef double spring(self, double torsion) noexcept
    cdef double slope(self, double angle) noexcept
    cdef double torque(self, double rate) noexcept
    cpdef void turn(self, double angle, double link) noexcept
    cpdef void relax(self, double angle, double link) noexcept
