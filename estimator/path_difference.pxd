"""Difference of the two torque paths as flat blocks; the equations stand in path_difference.pyx."""

from libc.stdint cimport uint64_t

from jtqd.estimator.observer cimport FusedObserverLaw
from jtqd.estimator.sample cimport Learned

cdef enum:
    ZERO_STATES = 5  # link zero [rad], current zero [A], friction [Nm], viscous [Nms/rad], gain

cdef struct ZerosLaw:
    bint used  # zeros are taken off
    bint watched  # the states are followed
    double prior[ZERO_STATES]  # variances
    double drift[ZERO_STATES]  # variance per second
    double stiffness, torque_per_ampere, limit
    double floor  # variance of the link zero [rad^2] that the joint file's own sigma covers
    double known  # variance of the link zero [rad^2] below which it counts as learned
    double correlation  # [s]: of the noise on the days of the fit
    double spread, spread_nm  # variance of the link zero over the days [rad^2, Nm^2]; 0: the file does not say
    double early  # [1/Nm^2]: what the spread of the estimate is wider by for each Nm^2 of that not known

cdef struct Gathered:  # sums over the samples of a block
    double dt, y, direction, velocity, torsion, variance
    int samples

cdef struct ZerosState:
    double x[ZERO_STATES]
    double p[ZERO_STATES][ZERO_STATES]
    double day_x[ZERO_STATES]  # the same with the noise of the fit's days; followed where their spread is known
    double day_p[ZERO_STATES][ZERO_STATES]
    double link_rad, current_a  # what is taken off the readings
    double left_nm  # what is known of the link zero and not yet taken off, as torque
    double apart_s  # for how long the views are farther apart than can be
    uint64_t jumps  # how often a zero that was known became unknown again
    Gathered block

cdef int fill_zeros(
    ZerosLaw *law, double torque_per_ampere, double rated_nm, fused, bint used, bint watched
) except -1
cdef void restart_zeros(const ZerosLaw *law, ZerosState *s) noexcept nogil
cdef void drop_block(ZerosState *s) noexcept nogil
cdef bint completes(
    ZerosState *s, double dt, double y, double direction, double velocity, double torsion, double variance
) noexcept nogil
cdef double local_stiffness(const FusedObserverLaw *law, double deflection) noexcept nogil
cdef double update_zeros(const ZerosLaw *law, ZerosState *s, double stiffness, double slope) noexcept nogil
cdef double known_nm2(const ZerosLaw *law, const ZerosState *s) noexcept nogil
cdef double early_factor(const ZerosLaw *law, double known) noexcept nogil
cdef double left_behind_nm(const ZerosLaw *law, const ZerosState *s) noexcept nogil
cdef bint beyond(const ZerosLaw *law, const ZerosState *s) noexcept nogil
cdef void tell_zeros(const ZerosLaw *law, const ZerosState *s, Learned *out) noexcept nogil
cdef zeros_of(const ZerosLaw *law, const ZerosState *s)

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
    bint turned  # the file has what the views differ by over the motor's turn
    double own[TURN_WAVES][TURN_PARTS]
    double whitening[TURN_SUMS]  # W: covariance^-1 = W'W
    double turn_limit

cdef struct TurnState:
    double trend[TURN_WAVES + 1]  # of the waves and of the difference of the views
    double m[TURN_SUMS]  # sums over the time of motion, faded: X'X [s]
    double z[TURN_WAVES]  # X'y [Nm s]
    double a[TURN_WAVES]  # waves beyond the file's [Nm]
    double square  # of the waves beyond the file's, against its covariance
    double settle_s  # for how long the observer's start is still in what it sees
    double dt, moved  # since the last sample that was taken; over the block
    int skipped, taken
    bint going

cdef struct AgreementState:
    double trend  # of the innovation [Nm]
    double slow, fast  # levels of its trend and of the rest [Nm^2]
    double doubt, gain_doubt  # what is beyond the fit's: variance [Nm^2], and standard deviation of a gain
    TurnState turn

cdef int fill_agreement(AgreementLaw *law, agreement, double rated_nm) except -1
cdef void restart_agreement(AgreementState *s) noexcept nogil
cdef void follow_agreement(
    const AgreementLaw *law,
    AgreementState *s,
    double innovation,
    double dt,
    double gain,
    double gain_variance,
    double left_nm,
) noexcept nogil
cdef void pause_turn(AgreementState *s) noexcept nogil
cdef void unsettle_turn(AgreementState *s) noexcept nogil
cdef void follow_turn(
    const AgreementLaw *law,
    AgreementState *s,
    double dt,
    double apart,
    double direction,
    double velocity,
    double loss,
    const double *wave,
) noexcept nogil
cdef bint turns_otherwise(const AgreementLaw *law, const AgreementState *s) noexcept nogil
cdef double doubt_of(const AgreementState *s, double alpha, double torsion) noexcept nogil
cdef bint lowers(
    const AgreementLaw *law,
    const AgreementState *s,
    double doubt,
    double sigma,
    double gain,
    double gain_variance,
    double alpha,
    double torsion,
) noexcept nogil
