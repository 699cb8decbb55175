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

    doubt^2 = level^2 ([slow - slow_0]+ + [fast - fast_0]+) + zero^2 [left^2 - left_0^2]+ + (gain [|g| - n sigma_g - g_0]+ tau)^2
    sigma^2 = (as fused)^2 + (max(alpha, 1 - alpha) doubt)^2

level, gain, zero: `level_factor`, `gain_factor`, `zero_factor` of the section, above 1: errors that the slow states take for
friction or for a zero, and the priors of gain and friction, which take a part of a zero, hide a part. n: `gain_sigmas`: a joint that
is always driven shows friction and a gain alike, and what may be neither is on ordinary days no doubt.

The status is lowered by a doubt of LOWER_SIGMAS sigmas and LEAST_SHARE of the rated torque; where the file says what ordinary days
have (`lowered_nm`), by more than that, counting of the gain only what is surely one, |g| - SURE_SIGMAS sigma_g: a joint that is
always driven, or always back-driven, shows friction and a gain alike.

**Waves over the motor's turn** tell another joint sooner than levels can: errors of gear and motor encoder and waves of friction are
fixed to the motor's angle, and hardly differ from day to day. What the runs of the fit have of them in the difference of the
views is in the file (`fused.agreement.turn`): w_k, filtered cos and sin of 1, 2 and 4 times the motor's angle, each with

    c_k + l_k loss + u_k v + q_k v^2      kinematic errors; friction; lags; the motor encoder's error, taken for an acceleration

The rest, r = tau_t - tau_c - sum_k w_k (c_k + ...), has waves a by least squares with forgetting, r and w less their trends:

    a = (sum w w' + LEAST_S 1)^-1 sum w r,        square = a' C^-1 a

C: covariance of a over the runs of the fit. Beyond the file's `limit` the status is lowered; sigma does not know of it.

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
    early_factor,
    fill_zeros,
    known_nm2,
    left_behind_nm,
    restart_zeros,
    update_zeros,
)

from jtqd.estimator.zeros import ONE_WAY

TREND_S: Final = 0.1
UP_S: Final = 0.15
DOWN_S: Final = 5.0
LOWER_SIGMAS: Final = 4.0
LEAST_SHARE: Final = 0.02
"""The status is lowered where the doubt is this many times the estimate's own sigma, and this part of the rated torque."""
SURE_SIGMAS: Final = 2.0
"""So many of its own standard deviations a gain is in doubt to be one, for the status."""

TURN_ORDERS: Final = (1, 2, 4)
"""Of the motor's turn."""
TURNING_RAD_S: Final = 0.1
"""Slower, a wave of the motor's angle looks like a change of friction."""
TURN_TREND_S: Final = 0.05
TURN_MEMORY_S: Final = 1.0
"""Time of motion within which waves over the motor's turn are forgotten."""
LEAST_S: Final = 0.02
"""What is believed of no waves at all, as time of motion times the square of a wave: they start from there."""
TURN_SETTLE_S: Final = 0.05
"""After a start of the observer: ten of its time constants."""
EVERY: Final = 4
TURN_BLOCK: Final = 16
"""Every fourth sample counts, and after so many of them the waves are judged: 64 ms at 1 kHz."""

cdef double INVERSE_TREND = 1.0 / TREND_S, INVERSE_UP = 1.0 / UP_S, INVERSE_DOWN = 1.0 / DOWN_S
cdef double SLOWEST_TURN = TURNING_RAD_S, ONE_SIDED = ONE_WAY
cdef double INVERSE_TURN_TREND = 1.0 / TURN_TREND_S, INVERSE_MEMORY = 1.0 / TURN_MEMORY_S, LEAST = LEAST_S
cdef double SETTLE = TURN_SETTLE_S
cdef int TAKEN_EVERY = EVERY, TAKEN_BLOCK = TURN_BLOCK
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
    law.zero_square, law.gain_sigmas = agreement.zero_factor**2, agreement.gain_sigmas
    if agreement.turn is not None:
        fill_turn(law, agreement.turn)
    return 0


cdef int fill_turn(AgreementLaw *law, turn) except -1:
    """Set what the views differ by over the motor's turn."""
    law.turned, law.turn_limit = True, turn.limit
    rows = np.column_stack((turn.constant_nm, turn.loss_share, turn.viscous_nms_per_rad, turn.quadratic_nms2_per_rad2))
    root = np.zeros((TURN_WAVES, TURN_WAVES))
    root[np.tril_indices(TURN_WAVES)] = [value for row in turn.root() for value in row]
    lower = np.linalg.inv(root)
    for k in range(TURN_WAVES):
        for n in range(TURN_PARTS):
            law.own[k][n] = rows[k, n]
    for k, value in enumerate(lower[np.tril_indices(TURN_WAVES)]):
        law.whitening[k] = value
    return 0


cdef void restart_agreement(AgreementState *s) noexcept nogil:
    """Forget all: the views agree."""
    memset(s, 0, sizeof(AgreementState))


cdef double _level(double level, double square, double dt) noexcept nogil:
    return level + (square - level) * (1.0 - exp(-dt * (INVERSE_UP if square > level else INVERSE_DOWN)))


cdef double _less(double gain, double gain_variance, double sigmas) noexcept nogil:
    """Return what of a gain is beyond so many of its own standard deviations."""
    return fmax(0.0, fabs(gain) - sigmas * sqrt(gain_variance))


cdef void follow_agreement(
    const AgreementLaw *law,
    AgreementState *s,
    double innovation,
    double dt,
    double gain,
    double gain_variance,
    double left_nm,
) noexcept nogil:
    """Take the innovation [Nm] of a block of length dt [s], the gain, and the zero that is not taken off [Nm]."""
    cdef double rest
    s.trend += (innovation - s.trend) * (1.0 - exp(-dt * INVERSE_TREND))
    rest = innovation - s.trend
    s.slow = _level(s.slow, s.trend * s.trend, dt)
    s.fast = _level(s.fast, rest * rest, dt)
    s.doubt = law.level_square * (fmax(0.0, s.slow - law.slow) + fmax(0.0, s.fast - law.fast))
    s.doubt += law.zero_square * fmax(0.0, left_nm * left_nm - law.zero)
    s.gain_doubt = law.gain_factor * fmax(0.0, _less(gain, gain_variance, law.gain_sigmas) - law.gain)


cdef void pause_turn(AgreementState *s) noexcept nogil:
    """Take the next sample for the first one of a motion: trends start there."""
    s.turn.going = False


cdef void unsettle_turn(AgreementState *s) noexcept nogil:
    """Wait: the observer starts, perhaps in the middle of an acceleration that its motor path does not know yet."""
    s.turn.going, s.turn.settle_s = False, SETTLE


cdef void follow_turn(
    const AgreementLaw *law,
    AgreementState *s,
    double dt,
    double apart,
    double direction,
    double velocity,
    double loss,
    const double *wave,
) noexcept nogil:
    """Take a sample in motion: difference of the views and loss [Nm], and the waves, as old as they are.

    Near a reversal friction changes within a part of a turn: trends start again behind it.
    """
    cdef TurnState *t = &s.turn
    cdef double rest = apart, square = velocity * velocity, way
    cdef double x[TURN_WAVES]
    cdef int k, n, i = 0
    if fabs(velocity) < SLOWEST_TURN or fabs(direction) < ONE_SIDED:
        t.going = False
        return
    if t.settle_s > 0.0:
        t.settle_s -= dt
        return
    t.dt += dt
    t.skipped += 1
    if t.going and t.skipped < TAKEN_EVERY:
        return
    for k in range(TURN_WAVES):
        rest -= wave[k] * (
            law.own[k][0] + law.own[k][1] * loss + law.own[k][2] * velocity + law.own[k][3] * square
        )
    dt = t.dt
    t.dt, t.skipped = 0.0, 0
    if not t.going:
        t.going = True
        for k in range(TURN_WAVES):
            t.trend[k] = wave[k]
        t.trend[TURN_WAVES] = rest
        return
    way = 1.0 - exp(-dt * INVERSE_TURN_TREND)
    t.trend[TURN_WAVES] += way * (rest - t.trend[TURN_WAVES])
    rest = dt * (rest - t.trend[TURN_WAVES])
    for k in range(TURN_WAVES):
        t.trend[k] += way * (wave[k] - t.trend[k])
        x[k] = wave[k] - t.trend[k]
        t.z[k] += rest * x[k]
        for n in range(k + 1):
            t.m[i] += dt * x[k] * x[n]
            i += 1
    t.moved += dt
    t.taken += 1
    if t.taken == TAKEN_BLOCK:
        _judge_turn(law, t)


cdef void _solve_turn(const TurnState *t, double *a) noexcept nogil:
    """Set a [Nm] to the waves of the sums so far, by Cholesky's decomposition."""
    cdef double lower[TURN_SUMS]
    cdef double sum
    cdef int k, n, j, row = 0, other
    for k in range(TURN_WAVES):
        other = 0
        for n in range(k + 1):
            sum = t.m[row + n]
            for j in range(n):
                sum -= lower[row + j] * lower[other + j]
            if n == k:
                lower[row + n] = sqrt(sum + LEAST)
            else:
                lower[row + n] = sum / lower[other + n]
            other += n + 1
        sum = t.z[k]
        for j in range(k):
            sum -= lower[row + j] * a[j]
        a[k] = sum / lower[row + k]
        row += k + 1
    for k in range(TURN_WAVES - 1, -1, -1):
        row -= k + 1
        a[k] /= lower[row + k]
        for j in range(k):
            a[j] -= lower[row + j] * a[k]


cdef void _judge_turn(const AgreementLaw *law, TurnState *t) noexcept nogil:
    """Compare the waves of a complete block, and those before, with what the file has of them; then forget a part."""
    cdef double part, kept = exp(-t.moved * INVERSE_MEMORY)
    cdef int k, n, i = 0
    _solve_turn(t, t.a)
    t.square = 0.0
    for k in range(TURN_WAVES):
        part = 0.0
        for n in range(k + 1):
            part += law.whitening[i] * t.a[n]
            t.m[i] *= kept
            i += 1
        t.z[k] *= kept
        t.square += part * part
    t.moved, t.taken = 0.0, 0


cdef bint turns_otherwise(const AgreementLaw *law, const AgreementState *s) noexcept nogil:
    """Return whether the views differ over the motor's turn as those of the file's joint do on no ordinary day."""
    return law.turned and s.turn.square > law.turn_limit


def turn_waves(turn, dt_s, apart_nm, direction, velocity_rad_s, loss_nm, waves):
    """Return (waves [blocks, 6] in Nm, square [blocks]) of a run from its start beyond `fused.agreement.turn`.

    Arrays [n] of samples in motion: apart_nm: torsion less current path; waves [n, 6]: filtered cos and sin of TURN_ORDERS
    times the motor's angle.
    """
    columns = (dt_s, apart_nm, direction, velocity_rad_s, loss_nm)
    cdef const double[:, ::1] x = np.ascontiguousarray(np.column_stack(columns), np.float64)
    cdef const double[:, ::1] w = np.ascontiguousarray(waves, np.float64)
    cdef AgreementLaw law
    cdef AgreementState s
    cdef Py_ssize_t k
    cdef bint last
    if w.shape[0] != x.shape[0] or w.shape[1] != TURN_WAVES:
        raise ValueError(f"found waves of shape {waves.shape}, expected {(x.shape[0], TURN_WAVES)}")
    memset(&law, 0, sizeof(AgreementLaw))
    fill_turn(&law, turn)
    restart_agreement(&s)
    found, squares = [], []
    for k in range(x.shape[0]):
        last = s.turn.taken == TAKEN_BLOCK - 1
        follow_turn(&law, &s, x[k, 0], x[k, 1], x[k, 2], x[k, 3], x[k, 4], &w[k, 0])
        if last and s.turn.taken == 0:
            found.append([s.turn.a[n] for n in range(TURN_WAVES)])
            squares.append(s.turn.square)
    return np.array(found, np.float64).reshape(-1, TURN_WAVES), np.array(squares, np.float64)


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
    """Return (slow, fast, gain, |left|, doubt) after each block of a run, arrays [blocks] in Nm^2, Nm^2, 1, Nm, Nm; zeros tracked.

    gain: |g| less `gain_sigmas` of its standard deviations; doubt: of the torsion, with what is surely a gain, beyond the
    levels of `fused.agreement`; 0 where that is None.
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
            follow_agreement(&usual, &s, innovation, dt, zeros.x[4], zeros.p[4][4], left)
            doubt = sqrt(_sure(&usual, &s, zeros.x[4], zeros.p[4][4], torsion))
            gain = _less(zeros.x[4], zeros.p[4][4], usual.gain_sigmas)
            found.append((s.slow, s.fast, gain, fabs(left), doubt))
    return tuple(np.array(found, np.float64).reshape(-1, 5).T)


def followed(
    fused, rated_nm, dt_s, apart_nm, direction, velocity_rad_s, torsion_nm, variance_nm2, slope, stiffness, bint tracked=True
):
    """Return (torsion, current, known, doubt, gain, early) of a run from its start: what the service adds to values and sigma.

    torsion, current: what tracked zeros add to both paths [Nm]; known: what they take off s_t^2 [Nm^2]; doubt [Nm^2] and its
    gain, as of `doubt_of`; early: factor of the spread, 1 without zeros of the days. Arrays [n] of samples in motion:
    apart_nm: torsion less current path; variance_nm2: of that; slope: dL/draw of the loss; stiffness: d tau_t/d d of the
    spring [Nm/rad]. tracked: zeros are taken off.
    """
    columns = (dt_s, apart_nm, direction, velocity_rad_s, torsion_nm, variance_nm2, slope, stiffness)
    cdef const double[:, ::1] x = np.ascontiguousarray(np.column_stack(columns), np.float64)
    out = np.zeros((6, x.shape[0]))
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
        to[5, k] = early_factor(&law, to[2, k])
        if completes(&s, x[k, 0], x[k, 1] + link - current, x[k, 2], x[k, 3], x[k, 4] + link, x[k, 5] - law.spread_nm):
            dt = s.block.dt
            innovation = update_zeros(&law, &s, x[k, 7], x[k, 6])
            if usual.used:
                follow_agreement(&usual, &agreement, innovation, dt, s.x[4], s.p[4][4], left_behind_nm(&law, &s))
    return tuple(out)
