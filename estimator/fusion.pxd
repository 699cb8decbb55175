"""Fusion of the current path and the torsion path as a flat block; the equations stand in fusion.pyx."""

cdef struct FusionLaw:
    double current, viscous, load, torsion, torsion_load, reference  # squares
    bint with_torsion

cdef struct Fused:
    double alpha, value, sigma
    double apart, variance  # torsion less current, and its variance; 0 and 1 without torsion

cdef int fill_fusion(FusionLaw *law, sigma, bint with_torsion) except -1
cdef double share_by_speed(double velocity) noexcept nogil
cdef double keep(double half, double before, double dt) noexcept nogil
cdef Fused fuse_paths(
    const FusionLaw *law, double raw, double loss, double half, double velocity, double torsion, double open_nm
) noexcept nogil

cdef void sharpen(Fused *fused, double known) noexcept nogil

cdef struct Rest:
    double spread, bound

cdef Rest at_rest(
    const FusionLaw *law, double alpha, double raw, double half, double v, double torsion, double open_nm
) noexcept nogil

cdef double widening(const Fused *fused, double left_nm) noexcept nogil

cdef class Fusion:
    cdef FusionLaw law
