"""What the difference of the two torque paths shows: zeros of link encoder and current, and whether the joint is that of its file.

**Zeros.** Zeros of the link encoder and of the current of one day, from the difference of the two views: a small Kalman filter.

    y = tau_t - tau_c = -K(d) e - G Kt (1 - dL/draw) i0 - s f - v u + tau_t g + noise

| state | what it is | its part of y |
|---|---|---|
| e | zero of the link encoder [rad] | even: the same in both directions, more where the spring is stiffer |
| i0 | zero of the current [A] | even: less when driving than when back-driven |
| f | friction of the day against the file [Nm] | odd: with the direction s of the motion |
| u | viscous friction of the day [Nms/rad] | odd: with the velocity |
| g | gain of the current against the stiffness | with the torque |

f, u and g are there so that they are not taken for a zero; nothing is corrected by them. A load, whatever its size, is in
both views alike: it is not in y. Friction cannot be told from a zero before the joint has moved in both directions: until
then the covariance of e stays as wide as f, and nothing is corrected (below). e and i0 are told apart by little: what is
common to both goes by their prior widths, and the standard deviation of e never falls below what i0 leaves open.

Samples count in motion only, with the friction on one side: |v| > MOVING_RAD_S, |s| > ONE_WAY. They are averaged over
blocks of BLOCK samples, and a block counts as its length/CORRELATION_S of an independent sample of variance s_c^2 + s_t^2:
ripple and errors of the encoders are not white.

What is taken off the readings is x w(|x|/sigma_x): nothing below DOUBT standard deviations (of the link zero: and of COVERED
of the torsion's sigma), all of it above SURE, linear between (firm shrinkage, Gao and Bruce 1997): on a day without a zero worth it nothing is changed. It follows with SLEW_S:
the estimate must not jump.

Where the joint file says how far zeros differ from day to day (`fused.zeros`: S, and as a torque S_nm), the part
k = S^2/(S^2 + sigma_d^2) of x_d is taken off in any case, the mean of what is then known of the day's zero (Wiener), w - k
of x where that is above 0, and what is known leaves the variance of the torsion in the fusion: s_t^2 - k S_nm^2, with S as
large as before where nothing is known. The spread of the fused value is then
1 + (early - 1) (1 - known/S_nm^2) times as wide, known: what is taken off s_t^2: before a zero is known, more is unknown than
the zero. x_d, sigma_d: of a second filter with the noise that the states leave on the days of
the fit (`correlation_s` of the file). The variance of both paths holds the day's friction, which is a state here, and is no
noise for so long: the first filter learns more slowly than an ordinary day allows. It judges what is beyond ordinary days,
and the agreement of the views: a joint that has changed, or friction's law on a plateau, is no noise of the fit.

**Agreement.** Agreement of the two views over seconds: what is beyond that of the runs of the fit counts as doubt of the joint file.

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

from jtqd.estimator.status import BEYOND, LEARNED, TRACKED, Zeros

# Zeros ----------------------------------------------------------------------------------------------------------------

MOVING_RAD_S: Final = 0.05
ONE_WAY: Final = 0.9
BLOCK: Final = 16
"""Samples of a block."""
CORRELATION_S: Final = 0.3
"""So long the difference of the views keeps its error; chosen, with the rest, on runs that no figure is reported on."""
DOUBT: Final = 2.0
SURE: Final = 4.0
COVERED: Final = 0.5
"""Part of the torsion's sigma in the joint file that counts as doubt of a link zero, however long it is seen: the paths have
errors of model, not of noise, and what the file's sigma covers need not be taken off."""
SLEW_S: Final = 0.25
LARGEST_LINK: Final = 0.3
"""Prior standard deviation of the link zero as a torque, part of the rated one."""
CURRENT_SHARE: Final = 0.2
"""Prior standard deviation of the current zero as a torque, part of the current path's: the rest is friction."""
LEAST_GAIN: Final = 0.03
"""Prior standard deviation of the gain, where the paths' sigmas say less."""
FRICTION_SHARE: Final = 0.2
"""Prior standard deviation of the day's friction, part of the joint file's without load, beside what the path's sigma says: grease that
is cold must not be taken for a zero."""
DRIFT_S: Final = 600.0
"""In so long a zero or a friction may change by a tenth of its prior width: grease warms, encoders do not."""
JUMP: Final = 4.0
JUMP_S: Final = 0.3
"""Views that are apart by more than JUMP standard deviations for so long: the encoder has slipped, its zero is unknown again."""
KNOWN_SHARE: Final = 0.5
"""Part of the variance of the day's friction below which the variance of the link zero counts as learned: what one
direction of motion alone never reaches."""

cdef int SAMPLES = BLOCK
cdef double CORRELATION = CORRELATION_S, INVERSE_SLEW = 1.0 / SLEW_S
cdef double SLOWEST = MOVING_RAD_S, ONE_SIDED = ONE_WAY
cdef double JUMP_SIGMAS = JUMP, LONGEST_S = JUMP_S
cdef int IS_TRACKED = TRACKED, IS_LEARNED = LEARNED, IS_BEYOND = BEYOND
cdef double LOW = DOUBT, HIGH = SURE, INVERSE_RANGE = 1.0 / (SURE - DOUBT)


cdef (double, double) _friction(loss):
    """Return constant [Nm] and viscous [Nms/rad] part of a loss without load, mean of both directions."""
    nodes, sides = loss.load_nodes_nm, (loss.positive, loss.negative)
    return (
        max(0.0, sum(np.interp(0.0, nodes, side.constant_nm) for side in sides) / 2.0),
        max(0.0, sum(np.interp(0.0, nodes, side.viscous_nms_per_rad) for side in sides) / 2.0),
    )


cdef int fill_zeros(
    ZerosLaw *law, double torque_per_ampere, double rated_nm, fused, bint used, bint watched
) except -1:
    """Set the parameters from section `fused` of a joint; used: zeros are taken off; watched: they are told apart at least.

    A joint without torsion has no two views: nothing is watched.
    """
    cdef double constant, viscous
    memset(law, 0, sizeof(ZerosLaw))
    sigma, torsion = fused.sigma, fused.torsion
    law.used, law.watched = used and torsion is not None, (used or watched) and torsion is not None
    if not law.watched:
        return 0
    constant, viscous = _friction(fused.loss)
    law.stiffness = torsion.stiffness_nm_per_rad
    law.torque_per_ampere = torque_per_ampere
    law.limit = torsion.zero_limit_rad
    law.floor = (COVERED * sigma.torsion_nm / law.stiffness) ** 2
    law.known = KNOWN_SHARE * (sigma.current_nm / law.stiffness) ** 2
    if law.used and fused.zeros is not None:
        law.correlation = fused.zeros.correlation_s or CORRELATION_S
        law.spread, law.spread_nm = fused.zeros.spread_rad**2, fused.zeros.spread_nm**2
        law.early = (fused.zeros.early - 1.0) / law.spread_nm
    law.prior[0] = (LARGEST_LINK * rated_nm / law.stiffness) ** 2
    law.prior[1] = (CURRENT_SHARE * sigma.current_nm / law.torque_per_ampere) ** 2
    law.prior[2] = sigma.current_nm**2 + (FRICTION_SHARE * constant) ** 2
    law.prior[3] = sigma.viscous_nms_per_rad**2 + (FRICTION_SHARE * viscous) ** 2
    law.prior[4] = sigma.load**2 + sigma.torsion_load**2 + LEAST_GAIN**2
    # the link's prior is as wide as a zero may be; it drifts like the rest of its path
    law.drift[0] = (0.1 * sigma.torsion_nm / law.stiffness) ** 2 / DRIFT_S
    for n in range(1, ZERO_STATES):
        law.drift[n] = 0.01 * law.prior[n] / DRIFT_S
    return 0


cdef void restart_zeros(const ZerosLaw *law, ZerosState *s) noexcept nogil:
    """Forget all: nothing is known of the zeros."""
    cdef int n
    memset(s, 0, sizeof(ZerosState))
    for n in range(ZERO_STATES):
        s.p[n][n] = s.day_p[n][n] = law.prior[n]


cdef void drop_block(ZerosState *s) noexcept nogil:
    """Forget the samples of a block that is not complete: one of them does not count."""
    if s.block.samples:
        memset(&s.block, 0, sizeof(Gathered))


cdef bint completes(
    ZerosState *s, double dt, double y, double direction, double velocity, double torsion, double variance
) noexcept nogil:
    """Add a sample in motion to the block; return whether it is complete and `update_zeros` is due.

    y: tau_t - tau_c [Nm]; variance: of y [Nm^2]. A sample that does not count, near a reversal, drops the block.
    """
    cdef Gathered *b = &s.block
    if fabs(velocity) < SLOWEST or fabs(direction) < ONE_SIDED:
        drop_block(s)
        return False
    b.dt += dt
    b.y += y
    b.direction += direction
    b.velocity += velocity
    b.torsion += torsion
    b.variance += variance
    b.samples += 1
    return b.samples == SAMPLES


cdef double local_stiffness(const FusedObserverLaw *law, double d) noexcept nogil:
    """Return d tau_t/d d [Nm/rad] of the spring at a deflection [rad], without slips."""
    cdef double stiffness = law.stiffness + 3.0 * law.cubic * d * d
    cdef int k
    for k in range(law.hardenings):
        if fabs(d) > law.hardening[k].deflection:
            stiffness += law.hardening[k].stiffness
    return stiffness


cdef double _share(const ZerosLaw *law, const ZerosState *s) noexcept nogil:
    """Return the part of the day's link zero that is known, 0 to 1; 0 where the file does not say how far days differ."""
    return law.spread / (law.spread + s.day_p[0][0]) if law.spread > 0.0 else 0.0


cdef double _used(double x, double variance, double least) noexcept nogil:
    """Return what is taken off of a zero x by firm shrinkage, beyond the part `least` that is in any case."""
    cdef double w = (fabs(x) / sqrt(variance) - LOW) * INVERSE_RANGE
    if w >= 1.0:
        w = 1.0
    return x * (w - least) if w > least else 0.0


cdef double _link_used(const ZerosLaw *law, const ZerosState *s) noexcept nogil:
    """Return what is to be taken off of the link's zero [rad]."""
    cdef double share = _share(law, s), used = _used(s.x[0], s.p[0][0] + law.floor, share)
    return used + share * s.day_x[0] if share > 0.0 else used


cdef double _innovation(const double *h, const double *x, double seen) noexcept nogil:
    """Return what a difference of the views [Nm] is beyond that of the states x."""
    cdef int n
    for n in range(ZERO_STATES):
        seen -= h[n] * x[n]
    return seen


cdef void _take(
    const double *h, double *x, double (*p)[ZERO_STATES], double innovation, double variance
) noexcept nogil:
    """Update states and covariance by an innovation [Nm] with noise of this variance."""
    cdef double ph[ZERO_STATES]
    cdef double gain
    cdef int m, n
    for n in range(ZERO_STATES):
        ph[n] = 0.0
        for m in range(ZERO_STATES):
            ph[n] += p[n][m] * h[m]
        variance += h[n] * ph[n]
    for n in range(ZERO_STATES):
        gain = ph[n] / variance
        x[n] += gain * innovation
        for m in range(n + 1):
            p[n][m] -= gain * ph[m]
            p[m][n] = p[n][m]


cdef void _forget_link(const ZerosLaw *law, double (*p)[ZERO_STATES]) noexcept nogil:
    """Make the link's zero unknown in a covariance."""
    cdef int n
    for n in range(ZERO_STATES):
        p[0][n] = p[n][0] = 0.0
    p[0][0] = law.prior[0]


cdef double update_zeros(const ZerosLaw *law, ZerosState *s, double stiffness, double slope) noexcept nogil:
    """Take the complete block; return its innovation [Nm].

    stiffness: local, of the spring; slope: dL/draw of the loss.
    """
    cdef Gathered b = s.block
    cdef double h[ZERO_STATES]
    cdef double share = 1.0 / SAMPLES, seen, innovation, way, left, before = s.apart_s
    cdef int n
    memset(&s.block, 0, sizeof(Gathered))
    h[0], h[1] = -stiffness, -law.torque_per_ampere * (1.0 - slope)
    h[2], h[3], h[4] = -b.direction * share, -b.velocity * share, b.torsion * share
    # the views were corrected: what was taken off belongs to what is seen
    seen = b.y * share + h[0] * s.link_rad + h[1] * s.current_a
    for n in range(ZERO_STATES):
        s.p[n][n] += law.drift[n] * b.dt
        s.day_p[n][n] += law.drift[n] * b.dt
    innovation = _innovation(h, s.x, seen)
    s.apart_s = s.apart_s + b.dt if fabs(innovation) > JUMP_SIGMAS * sqrt(b.variance * share) else 0.0
    if s.apart_s > LONGEST_S:
        if before <= LONGEST_S and s.p[0][0] < law.known:
            s.jumps += 1
        _forget_link(law, s.p)
        _forget_link(law, s.day_p)
    _take(h, s.x, s.p, innovation, b.variance * share * CORRELATION / b.dt)
    if law.spread > 0.0:
        _take(h, s.day_x, s.day_p, _innovation(h, s.day_x, seen), b.variance * share * law.correlation / b.dt)
    if not law.used:
        return innovation
    way = b.dt * INVERSE_SLEW
    if way > 1.0:
        way = 1.0
    s.link_rad += way * (_link_used(law, s) - s.link_rad)
    s.current_a += way * (_used(s.x[1], s.p[1][1], 0.0) - s.current_a)
    # beyond what is doubt about the zero: of a joint without one nothing is left, on average
    left = s.x[0] - s.link_rad
    s.left_nm = law.stiffness * sqrt(fmax(0.0, left * left - s.p[0][0] - law.floor))
    return innovation


cdef double known_nm2(const ZerosLaw *law, const ZerosState *s) noexcept nogil:
    """Return what the variance of the torsion [Nm^2] is less by what is known of the link zero, and already taken off."""
    cdef double share = _share(law, s), late
    if not share > 0.0:
        return 0.0
    late = law.stiffness * (_link_used(law, s) - s.link_rad)
    return fmax(0.0, share * law.spread_nm - late * late)


cdef double early_factor(const ZerosLaw *law, double known) noexcept nogil:
    """Return what the spread of the estimate is wider by while only `known` [Nm^2], as of `known_nm2`, is: 1 to `early`."""
    return 1.0 + law.early * (law.spread_nm - known)


cdef double left_behind_nm(const ZerosLaw *law, const ZerosState *s) noexcept nogil:
    """Return what is believed of the link zero and not taken off, as torque [Nm]."""
    return law.stiffness * (s.x[0] - s.link_rad)


cdef bint beyond(const ZerosLaw *law, const ZerosState *s) noexcept nogil:
    """Return whether the link's zero is one that no healthy joint has: beyond the file's limit, and that for sure."""
    return fabs(s.x[0]) > law.limit and fabs(s.x[0]) > HIGH * sqrt(s.p[0][0])


cdef void tell_zeros(const ZerosLaw *law, const ZerosState *s, Learned *out) noexcept nogil:
    """Set `out` to what is known of the zeros; no flag where they are not tracked."""
    memset(out, 0, sizeof(Learned))
    if not law.used:
        return
    out.link_rad, out.link_sigma_rad, out.link_used_rad = s.x[0], sqrt(s.p[0][0]), s.link_rad
    out.current_a, out.current_sigma_a, out.current_used_a = s.x[1], sqrt(s.p[1][1]), s.current_a
    out.limit_rad, out.jumps, out.flags = law.limit, s.jumps, IS_TRACKED
    if s.p[0][0] < law.known:
        out.flags |= IS_LEARNED
    if beyond(law, s):
        out.flags |= IS_BEYOND


cdef zeros_of(const ZerosLaw *law, const ZerosState *s):
    cdef Learned told
    tell_zeros(law, s, &told)
    return Zeros(
        told.link_rad,
        told.link_sigma_rad,
        told.link_used_rad,
        told.current_a,
        told.current_sigma_a,
        told.current_used_a,
        told.limit_rad,
        told.flags,
        told.jumps,
    )

# Agreement ------------------------------------------------------------------------------------------------------------


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
cdef double SLOWEST_TURN = TURNING_RAD_S
cdef double INVERSE_TURN_TREND = 1.0 / TURN_TREND_S, INVERSE_MEMORY = 1.0 / TURN_MEMORY_S, LEAST = LEAST_S
cdef double SETTLE = TURN_SETTLE_S
cdef int TAKEN_EVERY = EVERY, TAKEN_BLOCK = TURN_BLOCK
cdef double LOWER_SQUARE = LOWER_SIGMAS**2, SURE_GAIN = SURE_SIGMAS


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
    cdef double by_gain = law.gain_factor * fmax(0.0, fabs(gain) - SURE_GAIN * sqrt(gain_variance) - law.gain) * torsion
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
