"""Agreement of the two views over seconds; the equations stand in agreement.pyx."""

cdef struct AgreementLaw:
    bint used
    double slow, fast  # variances [Nm^2]
    double gain
    double zero  # square [Nm^2]
    double relevant, lowered  # squares [Nm^2]
    double level_square, gain_factor

cdef struct AgreementState:
    double trend  # of the innovation [Nm]
    double slow, fast  # levels of its trend and of the rest [Nm^2]
    double doubt, gain_doubt  # what is beyond the fit's: variance [Nm^2], and standard deviation of a gain

cdef int fill_agreement(AgreementLaw *law, agreement, double rated_nm) except -1
cdef void restart_agreement(AgreementState *s) noexcept nogil
cdef void follow_agreement(
    const AgreementLaw *law, AgreementState *s, double innovation, double dt, double gain, double left_nm
) noexcept nogil
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
