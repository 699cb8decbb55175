"""Fusion, standard deviations and trust as flat blocks; the equations stand in uncertainty.pyx."""

from jtqd.estimator.losses cimport EfficiencyLaw

cdef enum:
    FEATURES = 6  # of the paper's network (jtqd.estimator.network.FEATURES)
    MOST_CELLS = 129  # of an envelope's map in each direction, with its frame

cdef struct Spread:
    double value, sigma

cdef struct UncertaintyLaw:
    double floor, u_friction, widened, load
    bint with_efficiency

cdef struct TrustLaw:
    double low[FEATURES]
    double high[FEATURES]
    double inverse_margin[FEATURES]
    double limit, fade, inverse_fade

cdef struct FusedTrustLaw:
    double inverse_velocity, inverse_torque, velocity_0, torque_0
    int velocity_last, torque_last
    double distance, inverse_fade
    bint with_temperature
    double low, high
    double load  # largest joint torque [Nm]
    unsigned char known[MOST_CELLS][MOST_CELLS]

cdef int fill_uncertainty(UncertaintyLaw *law, joint, settings, bint has_efficiency) except -1
cdef int fill_trust(TrustLaw *law, low, high, double margin, double limit) except -1
cdef int fill_fused_trust(FusedTrustLaw *law, envelope) except -1
cdef double sigma_moving(
    const UncertaintyLaw *law, const EfficiencyLaw *losses, double raw, double current, double velocity
) noexcept nogil
cdef Spread standing(const UncertaintyLaw *law, const EfficiencyLaw *losses, double raw, double current) noexcept nogil
cdef double trust(const TrustLaw *law, const double *features, double difference) noexcept nogil
cdef double fused_trust(
    const FusedTrustLaw *law, double velocity, double raw, double distance, double temperature
) noexcept nogil

# Fusion

cdef struct FusionLaw:
    double current, viscous, load, torsion, torsion_load, reference  # squares
    bint with_torsion

cdef struct Fused:
    double alpha, value, sigma
    double difference, variance  # torsion less current, and its variance; 0 and 1 without torsion

cdef int fill_fusion(FusionLaw *law, sigma, bint with_torsion) except -1
cdef double network_share(double velocity) noexcept nogil
cdef double fading(double half, double before, double dt) noexcept nogil
cdef Fused fuse_paths(
    const FusionLaw *law, double raw, double loss, double half, double velocity, double torsion, double open_nm
) noexcept nogil

cdef void reweigh(Fused *fused, double known) noexcept nogil

cdef struct Rest:
    double spread, bound

cdef Rest at_rest(
    const FusionLaw *law, double alpha, double raw, double half, double v, double torsion, double open_nm
) noexcept nogil

cdef double disagreement(const Fused *fused, double uncorrected_nm) noexcept nogil

cdef class Fusion:
    cdef FusionLaw law
