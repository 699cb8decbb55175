"""Agreement of the two views over seconds; the equations stand in agreement.pyx."""

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
