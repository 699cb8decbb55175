"""Agreement of the two views over seconds: what is beyond that of the runs of the fit counts as doubt of the joint file.

A stiffness, a hysteresis, an encoder error or a friction that has changed since the fit shows in the difference of the views
long before a single sample is impossible. What the slow states of `zeros` leave of the difference, the innovation r of a block,
is split by its time scale, and each part's level follows fast upwards and slowly downwards:

    trend' = (r - trend)/TREND_S
    slow, fast = levels of trend^2 and (r - trend)^2, time constants UP_S and DOWN_S

slow: friction, hysteresis, the spring's law, the link encoder's own turn. fast: errors over the motor's turn. Two of the slow
states count beside them: the gain (stiffness against torque constant), and what is known of the link zero and is not
taken off. The joint file has the level of each that the runs of the fit kept below, each run judged by a fit on others (section
`fused.agreement`). Beyond it

    doubt^2 = level^2 ([slow - slow_0]+ + [fast - fast_0]+) + [left^2 - left_0^2]+ + (gain [|g| - g_0]+ tau)^2
    sigma^2 = (as fused)^2 + (max(alpha, 1 - alpha) doubt)^2

level, gain: `level_factor`, `gain_factor` of the section, above 1: errors that the slow states take for friction or for a zero,
and a gain's prior, hide a part.

The status is lowered by a doubt of LOWER_SIGMAS sigmas and LEAST_SHARE of the rated torque; where the file says what ordinary days
have (`lowered_nm`), by more than that, counting of the gain only what is surely one, |g| - SURE_SIGMAS sigma_g: a joint that is
always driven, or always back-driven, shows friction and a gain alike.

Which view is wrong is not known: the one that the estimate follows counts. What both views share (a wrong gear ratio of both
encoders, an external load) is in neither difference, and nothing here sees it.
"""

from libc.math cimport exp, fabs, fmax, sqrt
from libc.string cimport memset

from typing import Final

import numpy as np

from jtqd.estimator.zeros cimport (
    ZerosLaw,
    ZerosState,
    completes,
    fill_zeros,
    known_nm2,
    left_behind_nm,
    restart_zeros,
    update_zeros,
)

TREND_S: Final = 0.1
UP_S: Final = 0.15
DOWN_S: Final = 5.0
LOWER_SIGMAS: Final = 4.0
LEAST_SHARE: Final = 0.02
"""The status is lowered where the doubt is this many times the estimate's own sigma, and this part of the rated torque."""
SURE_SIGMAS: Final = 2.0
"""So many of its own standard deviations a gain is in doubt to be one, for the status."""

cdef double INVERSE_TREND = 1.0 / TREND_S, INVERSE_UP = 1.0 / UP_S, INVERSE_DOWN = 1.0 / DOWN_S
cdef double LOWER_SQUARE = LOWER_SIGMAS**2, SURE = SURE_SIGMAS


cdef int fill_agreement(AgreementLaw *law, agreement, double rated_nm) except -1:
    """Set the levels from section `fused.agreement` of a joint file; None: nothing is known of them."""
    memset(law, 0, sizeof(AgreementLaw))
    law.relevant = (LEAST_SHARE * rated_nm) ** 2
    if agreement is None:
        return 0
    law.used = True
    law.slow, law.fast = agreement.slow_nm**2, agreement.fast_nm**2
    law.gain, law.zero = agreement.gain, agreement.zero_nm**2
    law.lowered = agreement.lowered_nm**2
    law.level_square, law.gain_factor = agreement.level_factor**2, agreement.gain_factor
    return 0


cdef void restart_agreement(AgreementState *s) noexcept nogil:
    """Forget all: the views agree."""
    memset(s, 0, sizeof(AgreementState))


cdef double _level(double level, double square, double dt) noexcept nogil:
    return level + (square - level) * (1.0 - exp(-dt * (INVERSE_UP if square > level else INVERSE_DOWN)))


cdef void follow_agreement(
    const AgreementLaw *law, AgreementState *s, double innovation, double dt, double gain, double left_nm
) noexcept nogil:
    """Take the innovation [Nm] of a block of length dt [s], the gain, and the zero that is not taken off [Nm]."""
    cdef double rest
    s.trend += (innovation - s.trend) * (1.0 - exp(-dt * INVERSE_TREND))
    rest = innovation - s.trend
    s.slow = _level(s.slow, s.trend * s.trend, dt)
    s.fast = _level(s.fast, rest * rest, dt)
    s.doubt = law.level_square * (fmax(0.0, s.slow - law.slow) + fmax(0.0, s.fast - law.fast))
    s.doubt += fmax(0.0, left_nm * left_nm - law.zero)
    s.gain_doubt = law.gain_factor * fmax(0.0, fabs(gain) - law.gain)


cdef double doubt_of(const AgreementState *s, double alpha, double torsion) noexcept nogil:
    """Return what the doubt adds to sigma^2 [Nm^2] of the fused value; alpha: share of the torsion [Nm] in it."""
    cdef double share = fmax(alpha, 1.0 - alpha), by_gain = s.gain_doubt * torsion
    return share * share * (s.doubt + by_gain * by_gain)


cdef double _sure(
    const AgreementLaw *law, const AgreementState *s, double gain, double gain_variance, double torsion
) noexcept nogil:
    """Return the doubt [Nm^2] of the torsion [Nm] with what is surely a gain."""
    cdef double by_gain = law.gain_factor * fmax(0.0, fabs(gain) - SURE * sqrt(gain_variance) - law.gain) * torsion
    return s.doubt + by_gain * by_gain


cdef bint lowers(
    const AgreementLaw *law,
    const AgreementState *s,
    double doubt,
    double sigma,
    double gain,
    double gain_variance,
    double alpha,
    double torsion,
) noexcept nogil:
    """Return whether a doubt [Nm^2], as `doubt_of`, lowers the status beside the estimate's own sigma [Nm]."""
    cdef double most = fmax(LOWER_SQUARE * sigma * sigma, law.relevant), share
    if not doubt > most:
        return False
    if law.lowered == 0.0:
        return True
    share = fmax(alpha, 1.0 - alpha)
    return share * share * _sure(law, s, gain, gain_variance, torsion) > fmax(most, law.lowered)


def levels(fused, double rated_nm, dt_s, apart_nm, direction, velocity_rad_s, torsion_nm, variance_nm2, slope):
    """Return (slow, fast, |gain|, |left|, doubt) after each block of a run, arrays [blocks] in Nm^2, Nm^2, 1, Nm, Nm; zeros tracked.

    doubt: of the torsion, with what is surely a gain, beyond the levels of `fused.agreement`; 0 where that is None.
    Arrays [n] of samples in motion: apart_nm: torsion less current path; variance_nm2: of that; slope: dL/draw of the loss.
    """
    columns = (dt_s, apart_nm, direction, velocity_rad_s, torsion_nm, variance_nm2, slope)
    cdef const double[:, ::1] x = np.ascontiguousarray(np.column_stack(columns), np.float64)
    cdef ZerosLaw law
    cdef ZerosState zeros
    cdef AgreementLaw usual
    cdef AgreementState s
    cdef double dt, innovation, torsion, left
    cdef Py_ssize_t k
    # the current zero counts as a torque: whatever a torque per ampere is, its part of the difference is the same
    fill_zeros(&law, 1.0, rated_nm, fused, True, True)
    fill_agreement(&usual, fused.agreement, rated_nm)
    restart_zeros(&law, &zeros)
    restart_agreement(&s)
    found = []
    for k in range(x.shape[0]):
        if completes(&zeros, x[k, 0], x[k, 1], x[k, 2], x[k, 3], x[k, 4], x[k, 5] - law.spread_nm):
            dt, torsion = zeros.block.dt, zeros.block.torsion / zeros.block.samples
            # nothing was taken off what is seen here: `update_zeros` expects that it was
            zeros.block.y += law.stiffness * zeros.link_rad * zeros.block.samples
            zeros.block.y += (1.0 - x[k, 6]) * zeros.current_a * zeros.block.samples
            innovation = update_zeros(&law, &zeros, law.stiffness, x[k, 6])
            left = left_behind_nm(&law, &zeros)
            follow_agreement(&usual, &s, innovation, dt, zeros.x[4], left)
            doubt = sqrt(_sure(&usual, &s, zeros.x[4], zeros.p[4][4], torsion))
            found.append((s.slow, s.fast, fabs(zeros.x[4]), fabs(left), doubt))
    return tuple(np.array(found, np.float64).reshape(-1, 5).T)


def followed(
    fused, rated_nm, dt_s, apart_nm, direction, velocity_rad_s, torsion_nm, variance_nm2, slope, stiffness, bint tracked=True
):
    """Return (torsion, current, known, doubt, gain) of a run from its start: what the service adds to values and sigma.

    torsion, current: what tracked zeros add to both paths [Nm]; known: what they take off s_t^2 [Nm^2]; doubt [Nm^2] and its
    gain, as of `doubt_of`. Arrays [n] of samples in motion: apart_nm: torsion less current path; variance_nm2: of that; slope:
    dL/draw of the loss; stiffness: d tau_t/d d of the spring [Nm/rad]. tracked: zeros are taken off.
    """
    columns = (dt_s, apart_nm, direction, velocity_rad_s, torsion_nm, variance_nm2, slope, stiffness)
    cdef const double[:, ::1] x = np.ascontiguousarray(np.column_stack(columns), np.float64)
    out = np.zeros((5, x.shape[0]))
    cdef double[:, ::1] to = out
    cdef ZerosLaw law
    cdef ZerosState s
    cdef AgreementLaw usual
    cdef AgreementState agreement
    cdef double link, current, dt, innovation
    cdef Py_ssize_t k
    # the current zero counts as a torque: whatever a torque per ampere is, its part of the difference is the same
    fill_zeros(&law, 1.0, rated_nm, fused, tracked, True)
    fill_agreement(&usual, fused.agreement, rated_nm)
    restart_zeros(&law, &s)
    restart_agreement(&agreement)
    for k in range(x.shape[0]):
        link, current = x[k, 7] * s.link_rad, -(1.0 - x[k, 6]) * s.current_a
        to[0, k], to[1, k], to[2, k] = link, current, known_nm2(&law, &s)
        to[3, k], to[4, k] = agreement.doubt, agreement.gain_doubt
        if completes(&s, x[k, 0], x[k, 1] + link - current, x[k, 2], x[k, 3], x[k, 4] + link, x[k, 5] - law.spread_nm):
            dt = s.block.dt
            innovation = update_zeros(&law, &s, x[k, 7], x[k, 6])
            if usual.used:
                follow_agreement(&usual, &agreement, innovation, dt, s.x[4], left_behind_nm(&law, &s))
    return tuple(out)
