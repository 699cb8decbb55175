"""Fusion and difference of the two torque paths as flat blocks; the equations stand in fusion.pyx."""

from libc.stdint cimport uint64_t

from jtqd.estimator.observer cimport FusedObserved, FusedObserverLaw

cdef struct FusionLaw:
    double current, viscous, load, torsion, torsion_load, reference  # squares
    bint with_torsion

cdef struct Fused:
    double alpha, value, sigma
    double difference, variance  # torsion less current, and its variance; 0 and 1 without torsion
    double half  # part of the difference that the friction interval bounds, in `variance` as its square

cdef int fill_fusion(FusionLaw *law, sigma, bint with_torsion) except -1
cdef double fading(double half, double before, double dt) noexcept nogil
cdef Fused fuse_paths(
    const FusionLaw *law, double raw, double loss, double half, double velocity, double torsion, double open_nm
) noexcept nogil
cdef void reweigh(Fused *fused, double known, double day) noexcept nogil

cdef struct Rest:
    double spread, bound

cdef Rest at_rest(
    const FusionLaw *law, double alpha, double raw, double half, double v, double torsion, double open_nm
) noexcept nogil

cdef double apart_nm2(const Fused *fused, double uncorrected_nm) noexcept nogil

cdef struct ProofLaw:
    double most, tolerance, stiffness, day  # day: square of the usual correction [Nm^2]

cdef struct ProofState:
    double unproven  # what the torsion may be off by [Nm]
    double low, high, torsion_low, torsion_high  # ranges at rest: torsion less motor torque, torsion [Nm]

cdef double possible_error(const Fused *fused) noexcept nogil
cdef int fill_proof(ProofLaw *law, double rated_nm, fused) except -1
cdef void restart_proof(const ProofLaw *law, ProofState *s) noexcept nogil
cdef double prove(
    const ProofLaw *law, ProofState *s, const Fused *fused, const FusedObserved *seen, double dt, bint standing, bint in_order
) noexcept nogil
cdef double unproven_nm2(const ProofLaw *law, double unproven, double alpha, double link_rad, double behind_nm2) noexcept nogil

cdef class Fusion:
    cdef FusionLaw law

# Offsets

cdef struct Learned:  # `jtqd.estimator.status.Zeros` as a block
    double link_rad, link_sigma_rad, link_used_rad, current_a, current_sigma_a, current_used_a, limit_rad
    uint64_t flags, jumps

cdef enum:
    OFFSET_STATES = 5  # link offset [rad], current offset [A], friction [Nm], viscous [Nms/rad], gain

cdef struct OffsetLaw:
    bint corrected  # offsets are subtracted from the readings
    bint estimated  # the states are estimated
    double prior[OFFSET_STATES]  # variances
    double drift[OFFSET_STATES]  # variance per second
    double stiffness, torque_per_ampere, limit
    double floor  # variance of the link offset [rad^2] that the joint file's sigma covers
    double known  # variance of the link offset [rad^2] below which it counts as learned
    double correlation  # [s]: of the noise on the days of the fit
    double spread, spread_nm  # variance of the link offset over the days [rad^2, Nm^2]; 0: not known

cdef struct Block:  # sums over the samples of a block
    double dt, y, direction, velocity, torsion, variance
    int samples

cdef struct OffsetEstimate:
    double x[OFFSET_STATES]
    double p[OFFSET_STATES][OFFSET_STATES]
    double day_x[OFFSET_STATES]  # the same with the noise of the fit's days; estimated where their spread is known
    double day_p[OFFSET_STATES][OFFSET_STATES]
    double link_rad, current_a  # corrections of the readings

cdef struct OffsetState:
    OffsetEstimate now, kept  # kept: the paths have agreed by it
    double agreed_s, parted_nm  # for how long the paths agree, below 0: by `kept` alone; least load of paths that were far apart
    double uncorrected_nm  # known link offset that is not corrected yet, as torque
    double disagreeing_s  # for how long the paths differ by more than JUMP sigmas
    uint64_t jumps  # how often a known offset became unknown again
    Block block

cdef void go_back(OffsetState *s) noexcept nogil
cdef int fill_offsets(OffsetLaw *law, double torque_per_ampere, double rated_nm, fused, bint used, bint estimated) except -1
cdef void restart_offsets(const OffsetLaw *law, OffsetState *s) noexcept nogil
cdef void drop_block(OffsetState *s) noexcept nogil
cdef bint gather(
    OffsetState *s, double dt, double y, double direction, double velocity, double torsion, double variance
) noexcept nogil
cdef double local_stiffness(const FusedObserverLaw *law, double deflection) noexcept nogil
cdef double known_nm2(const OffsetLaw *law, const OffsetState *s) noexcept nogil
cdef double day_nm2(const OffsetLaw *law, double known, double alpha) noexcept nogil
cdef bint implausible(const OffsetLaw *law, const OffsetState *s) noexcept nogil
cdef void report_offsets(const OffsetLaw *law, const OffsetState *s, Learned *out) noexcept nogil
cdef offsets_of(const OffsetLaw *law, const OffsetState *s)

# Agreement

cdef enum:
    TURN_WAVES = 6  # cos and sin of 1, 2 and 4 times the motor's angle
    TURN_SUMS = 21  # lower triangle, by rows
    TURN_PARTS = 4  # of a wave: constant, by loss, by speed, by its square

cdef struct AgreementLaw:
    bint used
    double slow, fast  # variances [Nm^2]
    double gain
    double zero  # square [Nm^2]
    double relevant, lowered  # squares [Nm^2]
    double level_square, gain_factor, zero_square, gain_sigmas
    bint with_turn  # the file has the difference of the paths over the motor's turn
    double own[TURN_WAVES][TURN_PARTS]
    double whitening[TURN_SUMS]  # W: covariance^-1 = W'W
    double turn_limit

cdef struct TurnState:
    double trend[TURN_WAVES + 1]  # of the waves and of the difference of the paths
    double m[TURN_SUMS]  # sums over the time of motion, faded: X'X [s]
    double z[TURN_WAVES]  # X'y [Nm s]
    double a[TURN_WAVES]  # waves beyond the file's [Nm]
    double square  # of the waves beyond the file's, against its covariance
    double settle_s  # remaining wait after the observer's start
    double dt, moved  # since the last sample that counted; over the block
    int skipped, taken
    bint going

cdef struct AgreementState:
    double trend  # of the innovation [Nm]
    double slow, fast  # levels of its trend and of the rest [Nm^2]
    double mismatch, gain_mismatch  # beyond the fit's: variance [Nm^2], and standard deviation of a gain
    TurnState turn

cdef int fill_agreement(AgreementLaw *law, agreement, double rated_nm) except -1
cdef void restart_agreement(AgreementState *s) noexcept nogil
cdef void keep_offsets(
    const OffsetLaw *law, OffsetState *s, AgreementState *a, const Fused *fused, double load, double dt
) noexcept nogil
cdef void update_difference(
    const OffsetLaw *offset_law, OffsetState *offsets, const AgreementLaw *law, AgreementState *s, double stiffness,
    double slope
) noexcept nogil
cdef void pause_turn(AgreementState *s) noexcept nogil
cdef void restart_turn(AgreementState *s) noexcept nogil
cdef void update_turn(
    const AgreementLaw *law, AgreementState *s, double dt, double difference, double direction, double velocity,
    double loss, const double *wave
) noexcept nogil
cdef bint turn_differs(const AgreementLaw *law, const AgreementState *s) noexcept nogil
cdef double mismatch_variance(const AgreementState *s, double alpha, double torsion) noexcept nogil
cdef bint degrades(
    const AgreementLaw *law, const AgreementState *s, const OffsetState *offsets, double mismatch, double sigma,
    double alpha, double torsion
) noexcept nogil
