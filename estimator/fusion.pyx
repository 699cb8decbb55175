"""The two torque paths of method `fused`, motor current less loss and torsion: their fusion, and their difference.

**Fusion** of two independent measurements of one torque by their variances:

    tau_c = tau_raw - loss                 follows fast changes and any load; errors: friction
    tau_t = K d + K3 d^3 + D d' + H z      independent of friction; errors: hysteresis, encoders
    alpha = s_c^2/(s_c^2 + s_t^2)          physics = tau_c + alpha (tau_t - tau_c)
    s_c^2 = a^2 + (b v)^2 + (c tau_raw)^2 + half^2      half: half width of the friction interval near v = 0
    s_t^2 = e^2 + (f tau_t)^2 + open^2     open: half width of the slip's unknown torque, until its bounds meet
    sigma^2 = s_c^2 s_t^2/(s_c^2 + s_t^2) + reference^2      reference: of the sensor in a comparison, 0 for the torque itself

A, b, c, e, f, reference: section `fused.sigma`. Towards standstill `half` grows to the half width of the friction interval and
the torsion takes over: continuous, and the value at rest does not depend on the direction of friction. Of a standing joint
the half width of the interval is

    k sd + alpha open + (1 - alpha) half   k: `fused.standstill`; sd: sigma without `half` and `open`, with the same alpha

A disagreement of the paths widens sigma by max(alpha, 1 - alpha) (|tau_t - tau_c| - half - DISAGREE_SIGMAS sqrt(s_c^2 - half^2
+ s_t^2)), where that is above 0: which path is wrong is not known, so the worse case counts. Near standstill `half` is a bound.

**Proof.** The offset of the torsion is any value up to the rated torque until the paths have shown a smaller one. U: what the
torsion may be off by, a bound of 3 standard deviations in sigma:

    U <= |tau_t - tau_c| + half + BOUNDING sqrt(s_c^2 + s_t^2)         at every sample
    U' = -U/PROVING_S                                                  where the paths agree and friction is one-sided
    U >= |tau_t - tau_c|                                               where they disagree
    U >= min(range of tau_t, range of tau_t - tau_raw) > tolerance     at rest: the torsion changed, and the current did not

An offset of the link encoder that is beyond DAYS spreads of ordinary days may be one of the current: it counts like U. What the
torsion has changed by since the sample that the current path is as old as is not compared yet: it counts while U does.

**Behind.** Of two readings in a row the tracking filter leaves r and r'. Noise is not in both alike, what the torque is behind by is:
r r' K^2 is added to sigma^2 where it is above 0. On four healthy plants r and the error correlate by -0.5; of 740 000 samples 64
were more than 2 Nm and 4 sigma off, at peaks of the load, where what the torsion is ahead by is 0; with r r' none.

**Offsets** of the link encoder and of the current on one day are states of a small Kalman filter, whose measurement is the
difference of the torsion path tau_t and the current path tau_c:

    y = tau_t - tau_c = -K(d) e - G Kt (1 - dL/draw) i0 - s f - v u + tau_t g + noise

| state | what it is | its part of y |
|---|---|---|
| e | offset of the link encoder [rad] | even: the same in both directions, more where the spring is stiffer |
| i0 | offset of the current [A] | even: less when driving than when back-driven |
| f | friction of the day less the file's [Nm] | odd: with the direction s of the motion |
| u | viscous friction of the day less the file's [Nms/rad] | odd: with the velocity |
| g | gain of the current against the stiffness | with the torque |

States f, u and g only keep friction and gains out of the offsets; nothing is corrected by them. A load is in both paths alike
and not in y. Friction and an offset are separable only after motion in both directions: until then the covariance of e is as
wide as that of f, and nothing is corrected. E and i0 differ little: what both explain is split by their prior variances, and
the standard deviation of e is bounded below by the uncertainty of i0.

Samples count in motion with one-sided friction: |v| > MOVING_RAD_S, |s| > ONE_WAY. They are averaged over blocks of BLOCK
samples. A block counts as length/CORRELATION_S of an independent sample of variance s_c^2 + s_t^2, because ripple and encoder
errors are not white.

The correction is x w(|x|/sigma_x) with firm shrinkage (Gao and Bruce 1997): w is 0 below SHRUNK_BELOW standard deviations (sigma_e
includes COVERED of the torsion's sigma), 1 above KEPT_ABOVE, linear between. Without a significant offset nothing is changed. The
correction follows with time constant SLEW_S, because the estimate must not jump.

Where the joint file has the spread of the offset from day to day (`fused.zeros`: S, as a torque S_nm), the part
k = S^2/(S^2 + sigma_d^2) of x_d is corrected in any case (Wiener), in addition w - k of x where that is positive, and the
variance of the torsion in the fusion is s_t^2 - known, known = k S_nm^2. The day's part of sigma^2 has no scale, and no less
weight where the paths agree: they may share an error of the day. The spread is that of the rest:

    day^2 = min(S_nm^2 - known, alpha S_nm^2),   spread^2 = alpha (s_t^2 - S_nm^2)

X_d and sigma_d are those of a second filter with the noise on the days of the fit (`correlation_s`). The first filter has noise that
includes the day's friction, so that it learns more slowly; it judges what exceeds ordinary days, and the agreement of the paths.

**Nothing is learned from a fault.** The estimate of the offsets, states and covariance, is kept once the paths have agreed by it for
CALM_S of motion. What was learned since goes back to it where that is contradicted: an encoder is out of order (then, and a second
longer, nothing is learned); the paths agree by the kept estimate alone for AGAIN_S; or they disagree for JUMP_S: the link encoder has
slipped, and its offset is unknown.

**Agreement** of the paths over seconds: differences beyond those on the runs of the fit count as a mismatch of the joint file.
A changed stiffness, hysteresis, encoder error or friction shows in the difference long before a single sample is implausible.
The innovation r of a block is split by time scale; each level follows fast upwards and slowly downwards:

    trend' = (r - trend)/TREND_S
    slow, fast = levels of trend^2 and (r - trend)^2, time constants UP_S and DOWN_S

Slow: friction, hysteresis, the spring's law, errors over the link encoder's turn. Fast: errors over the motor's turn. Besides
them count the gain state g and the offset of the link encoder that is not corrected. Section `fused.agreement` has the level of
each (index 0) that held-out runs of the fit did not exceed:

    mismatch^2 = level^2 ([slow - slow_0]+ + [fast - fast_0]+) + zero^2 [offset^2 - offset_0^2]+
                 + (gain [|g| - n sigma_g - g_0]+ tau)^2 + waves^2
    sigma^2 = (as fused)^2 + (max(alpha, 1 - alpha) mismatch)^2

Waves: below. Level, gain, zero: `level_factor`, `gain_factor`, `zero_factor`, above 1, because states and priors absorb a part of an error.
N: `gain_sigmas`, because a joint that is always driven cannot separate friction from a gain. Which path is wrong is not known:
the larger weight counts.

The status is degraded by a mismatch above 4 sigmas and LEAST_SHARE of the rated torque; where the file has the
mismatch of ordinary days (`lowered_nm`), above that too, with only the significant part of the gain, |g| - SURE_SIGMAS sigma_g.

**Waves over the motor's turn** identify another joint faster than levels: errors of gear and motor encoder and waves of friction
are fixed to the motor's angle and hardly change from day to day. Section `fused.agreement.turn` has those of the runs of the fit:
w_k, filtered cos and sin of 1, 2 and 4 times the motor's angle, each with

    c_k + l_k loss + u_k v + q_k v^2      kinematic errors; friction; delays; motor encoder errors measured as acceleration

The remainder r = tau_t - tau_c - sum_k w_k (c_k + ...) has waves a by least squares with forgetting, r and w without trend:

    a = (sum w w' + LEAST_S 1)^-1 sum w r,        square = a' C^-1 a

C: covariance of a over the runs of the fit, so that square is 6 on average. Above the file's `limit` the status is degraded.
Sigma is widened by the waves as far as they are not those of ordinary days (James and Stein 1961, positive part):

    waves^2 = a'a/2 [1 - 6/square]+

An error that both paths share (gear ratio of both encoders, external load) is not in the difference.
"""

from libc.math cimport INFINITY, exp, fabs, fmax, fmin, sqrt
from libc.string cimport memset

from typing import Final, NamedTuple

import numpy as np

from jtqd.estimator.status import BEYOND, LEARNED, TRACKED, Zeros

HOLD_S: Final = 0.05
"""Time constant with which the friction interval is forgotten after a reversal."""
DISAGREE_SIGMAS: Final = 3.0
"""Distance of the two paths in its own standard deviations up to which it is noise."""
FOREIGN_SIGMAS: Final = 4.0
"""Distance from which the status is lowered: at least one of the paths contradicts the joint file."""
GAUSS: Final = 1.6448536269514722
"""Half width of a normal distribution's 90 % interval in standard deviations: the interval is value +- GAUSS sigma."""

cdef double HOLD = HOLD_S, DISAGREE = DISAGREE_SIGMAS, FOREIGN = FOREIGN_SIGMAS, INTERVAL = 1.0 / GAUSS
cdef double BOUNDING = 3.0, PER_BOUND = 1.0 / BOUNDING**2  # standard deviations of a bound
cdef double PROVING_S = 0.1  # in which paths that agree prove the torsion
cdef double RESTING_SHARE = 0.025  # of the rated torque, by which the torsion changes at rest from noise
cdef double DAYS = 2.0, DOUBTED = 1.5**2  # spreads of the link's offset; beyond, half of it is sigma: another sensor may be off
cdef double LEAST_VARIANCE = 0.05  # part of the torsion's variance that remains, however well its offset is known


# Fusion ---------------------------------------------------------------------------------------------------------------

cdef double fading(double half, double before, double dt) noexcept nogil:
    """Return the friction interval's half width [Nm] with that of the sample before, dt [s] ago, fading.

    Between rest and motion the weight moves from one path to the other. Their errors differ, so it must not move within
    a few milliseconds: the interval at a reversal counts for HOLD_S longer.
    """
    cdef double faded = before * (HOLD / (HOLD + dt))
    return half if half >= faded else faded


def faded(half_nm, dt_s, running):
    """Return half widths [n] with their memory (`fading`), which starts again after every sample that is not `running`."""
    cdef const double[::1] half = np.ascontiguousarray(half_nm, np.float64)
    cdef const double[::1] dt = np.ascontiguousarray(dt_s, np.float64)
    cdef const unsigned char[::1] on = np.ascontiguousarray(running, np.bool_).view(np.uint8)
    out = np.empty(len(half))
    cdef double[::1] to = out
    cdef double memory = 0.0
    cdef Py_ssize_t k
    for k in range(half.shape[0]):
        memory = fading(half[k], memory, dt[k]) if on[k] else 0.0
        to[k] = memory
    return out


cdef int fill_fusion(FusionLaw *law, sigma, bint with_torsion) except -1:
    law.current = sigma.current_nm**2
    law.viscous = sigma.viscous_nms_per_rad**2
    law.load = sigma.load**2
    law.torsion = sigma.torsion_nm**2
    law.torsion_load = sigma.torsion_load**2
    law.reference = sigma.reference_nm**2
    law.with_torsion = with_torsion
    return 0


cdef Fused fuse_paths(
    const FusionLaw *law, double raw, double loss, double half, double v, double torsion, double open_nm
) noexcept nogil:
    """Return share of the torsion, value and standard deviation [Nm] of the fused physics."""
    cdef double c = law.current + law.viscous * v * v + law.load * raw * raw + half * half
    cdef double value = raw - loss
    cdef double t, alpha
    if not law.with_torsion:
        return Fused(0.0, value, sqrt(c + law.reference), 0.0, 1.0, 0.0)
    t = law.torsion + law.torsion_load * torsion * torsion + open_nm * open_nm
    alpha = c / (c + t)
    return Fused(alpha, value + alpha * (torsion - value), sqrt(alpha * t + law.reference), torsion - value, c + t, half)


cdef void reweigh(Fused *fused, double known, double day) noexcept nogil:
    """Weigh with a torsion whose variance is less by `known` [Nm^2]; `variance` stays, `sigma` is without `day` [Nm^2] of it."""
    cdef double c = fused.alpha * fused.variance, t = fused.variance - c, least = LEAST_VARIANCE * t, alpha
    alpha = c / (c + fmax(t - known, least))
    fused.value += (alpha - fused.alpha) * fused.difference
    fused.alpha, fused.sigma = alpha, sqrt(alpha * fmax(t - day, least))


cdef Rest at_rest(
    const FusionLaw *law, double alpha, double raw, double half, double v, double torsion, double open_nm
) noexcept nogil:
    """Return standard deviation and bound [Nm] of the fused value of a standing joint.

    The friction interval and the unknown slip are no errors that are small on most days: a push from outside changes the torque
    and not the current, and a joint may have stopped at the end of its hysteresis. Both are bounds, counted by their weights.
    """
    cdef double rest = 1.0 - alpha
    cdef double c = law.current + law.viscous * v * v + law.load * raw * raw
    cdef double t = law.torsion + law.torsion_load * torsion * torsion if law.with_torsion else 0.0
    return Rest(sqrt(alpha * alpha * t + rest * rest * c + law.reference), alpha * open_nm + rest * half)


cdef double reach(const Fused *fused, double sigmas) noexcept nogil:
    """Return how far the paths are apart [Nm] at so many standard deviations, with the bound of friction near standstill."""
    return fused.half + sigmas * sqrt(fmax(fused.variance - fused.half * fused.half, 0.0))


cdef double apart_nm2(const Fused *fused, double uncorrected_nm) noexcept nogil:
    """Return what a disagreement of the paths adds to sigma^2 [Nm^2]; uncorrected_nm: known offset that is not corrected yet.

    The offset is an error of a known size, not of a known variance: the 90 % interval, not sigma, is to hold it.
    """
    cdef double more = fmax(fabs(fused.difference) - reach(fused, DISAGREE), 0.0) * fmax(fused.alpha, 1.0 - fused.alpha)
    cdef double offset = INTERVAL * fused.alpha * uncorrected_nm
    return more * more + offset * offset


cdef double possible_error(const Fused *fused) noexcept nogil:
    """Return how far the torsion may be from the torque [Nm], by the current path."""
    return fabs(fused.difference) + reach(fused, BOUNDING)


cdef int fill_proof(ProofLaw *law, double rated_nm, fused) except -1:
    law.most, law.tolerance = rated_nm, RESTING_SHARE * rated_nm
    law.stiffness = law.day = 0.0
    if fused.torsion is None:
        law.most = 0.0
        return 0
    law.stiffness = fused.torsion.stiffness_nm_per_rad
    law.day = (DAYS * max(fused.sigma.torsion_nm, 0.0 if fused.zeros is None else fused.zeros.spread_nm)) ** 2
    return 0


cdef void restart_proof(const ProofLaw *law, ProofState *s) noexcept nogil:
    s.unproven = law.most
    _move(s)


cdef void _move(ProofState *s) noexcept nogil:
    s.low = s.torsion_low = INFINITY
    s.high = s.torsion_high = -INFINITY


cdef double prove(
    const ProofLaw *law, ProofState *s, const Fused *fused, const FusedObserved *seen, double dt, bint standing, bint in_order
) noexcept nogil:
    """Take a sample; return what the torsion may be off by [Nm]; in_order: of the readings."""
    cdef double balance = seen.torsion_nm - seen.raw_nm, torsion = seen.torsion_nm, most, now = 0.0
    if standing:
        s.low, s.high = fmin(s.low, balance), fmax(s.high, balance)
        s.torsion_low, s.torsion_high = fmin(s.torsion_low, torsion), fmax(s.torsion_high, torsion)
        now = fmin(s.high - s.low, s.torsion_high - s.torsion_low)
        s.unproven = fmax(s.unproven, now if now > law.tolerance else 0.0)
        balance, torsion = balance + seen.ahead_nm, torsion + seen.ahead_nm
        now = fmin(fmax(s.high, balance) - fmin(s.low, balance), fmax(s.torsion_high, torsion) - fmin(s.torsion_low, torsion))
    else:
        _move(s)
    if fabs(fused.difference) > reach(fused, DISAGREE):
        s.unproven = fmax(s.unproven, fabs(fused.difference))
    elif fabs(seen.direction) > ONE_SIDED and in_order and not standing:
        s.unproven *= PROVING_S / (PROVING_S + dt)
    most = fmin(law.most, possible_error(fused))
    s.unproven = fmin(s.unproven, most)
    if not standing:  # what is ahead has not been compared, either
        return s.unproven + fabs(seen.ahead_nm) * fmin(s.unproven / law.tolerance, 1.0)
    return fmax(s.unproven, fmin(now, most + fabs(seen.ahead_nm))) if now > law.tolerance else s.unproven


cdef double unproven_nm2(const ProofLaw *law, double unproven, double alpha, double link_rad, double behind_nm2) noexcept nogil:
    """Return what is not proven as an addition to sigma^2 [Nm^2] of a value with this share of the torsion.

    unproven: as `prove`; link_rad: correction of the link encoder; behind_nm2: what the tracking filter leaves of two readings.
    """
    cdef double beyond = fmax((law.stiffness * link_rad) ** 2 - law.day, 0.0)
    return alpha * alpha * (unproven * unproven + DOUBTED * beyond) * PER_BOUND + fmax(behind_nm2, 0.0)


class FusedPaths(NamedTuple):
    """Fused physics of a run, arrays [n]: share of the torsion, value and standard deviation [Nm], variance of the paths'
    difference [Nm^2]."""

    alpha: object
    value_nm: object
    sigma_nm: object
    variance_nm2: object


cdef class Fusion:
    """Fusion of whole runs; sigma: `joint.FusedSigma`; with_torsion False: the current path alone, whatever the torsion."""

    def __init__(self, sigma, bint with_torsion):
        fill_fusion(&self.law, sigma, with_torsion)

    def fuse(self, raw_nm, half_nm, velocity_rad_s, torsion_nm, open_nm=0.0, loss_nm=0.0, known_nm2=None):
        """Return the `FusedPaths` of arrays [n] (or numbers for all n).

        half_nm: `AdditiveLossModel.loss_many`; open_nm: `ObservedRun`; known_nm2: part of the torsion's variance that is known.
        """
        given = (raw_nm, loss_nm, half_nm, velocity_rad_s, torsion_nm, open_nm, 0.0 if known_nm2 is None else known_nm2)
        laid = np.ascontiguousarray(np.broadcast_arrays(*given), np.float64)
        out = np.empty((4, laid.shape[1]))
        cdef bint known = known_nm2 is not None
        cdef const double[:, ::1] x = laid
        cdef double[:, ::1] to = out
        cdef Fused fused
        cdef Py_ssize_t k
        for k in range(x.shape[1]):
            fused = fuse_paths(&self.law, x[0, k], x[1, k], x[2, k], x[3, k], x[4, k], x[5, k])
            if known:
                reweigh(&fused, x[6, k], x[6, k])
                fused.sigma = sqrt(fused.sigma * fused.sigma + self.law.reference)
            to[0, k], to[1, k], to[2, k], to[3, k] = fused.alpha, fused.value, fused.sigma, fused.variance
        return FusedPaths(*out)

    def at_rest(self, raw_nm, half_nm, velocity_rad_s, torsion_nm, open_nm=0.0):
        """Return (standard deviation, bound) [Nm] of the value of a standing joint, arrays [n]."""
        alpha = self.fuse(raw_nm, half_nm, velocity_rad_s, torsion_nm, open_nm).alpha
        columns = (alpha, raw_nm, half_nm, velocity_rad_s, torsion_nm, open_nm)
        cdef const double[:, ::1] x = np.ascontiguousarray(np.broadcast_arrays(*columns), np.float64)
        out = np.empty((2, x.shape[1]))
        cdef double[:, ::1] to = out
        cdef Rest rest
        cdef Py_ssize_t k
        for k in range(x.shape[1]):
            rest = at_rest(&self.law, x[0, k], x[1, k], x[2, k], x[3, k], x[4, k], x[5, k])
            to[0, k], to[1, k] = rest.spread, rest.bound
        return out[0], out[1]


# Offsets --------------------------------------------------------------------------------------------------------------

MOVING_RAD_S: Final = 0.05
ONE_WAY: Final = 0.9
CORRELATION_S: Final = 0.3
"""Correlation time of the difference's error; chosen, as the other constants, on runs that no reported figure uses."""

cdef int BLOCK = 16  # samples of a block
cdef double CORRELATION = CORRELATION_S, SLOWEST = MOVING_RAD_S, ONE_SIDED = ONE_WAY
cdef double SHRUNK_BELOW = 2.0, KEPT_ABOVE = 4.0, INVERSE_RANGE = 1.0 / (KEPT_ABOVE - SHRUNK_BELOW)
# part of the torsion's sigma in the joint file that is added to sigma_e: model errors do not average out, and an offset within
# the file's sigma needs no correction
cdef double COVERED = 0.5
cdef double SLEW_S = 0.25, INVERSE_SLEW = 1.0 / SLEW_S
cdef double CALM_S = 1.0, AGAIN_S = 0.5  # of paths that agree by what was learned; that agree by what was kept alone; after faults sigma is 0.06 to 0.2 Nm less with each
cdef double LARGEST_LINK = 0.3  # prior standard deviation of the link offset as a torque, part of the rated torque
cdef double CURRENT_SHARE = 0.2  # of the current offset as a torque, part of the current path's: the rest is friction
cdef double LEAST_GAIN = 0.03  # least one of the gain
# prior standard deviation of the day's friction as a part of the file's without load, in addition to the path's sigma: cold
# grease must not be taken for an offset
cdef double FRICTION_SHARE = 0.2
cdef double DRIFT_S = 600.0  # in which a state may change by a tenth of its prior standard deviation: grease warms, encoders do not
# paths that differ by more than JUMP standard deviations for JUMP_S: the encoder has slipped, its offset is unknown again
cdef double JUMP = 4.0, JUMP_S = 0.3
# part of the variance of the day's friction below which the link offset counts as learned: motion in one direction alone does
# not reach it
cdef double KNOWN_SHARE = 0.5
cdef int IS_TRACKED = TRACKED, IS_LEARNED = LEARNED, IS_BEYOND = BEYOND


cdef (double, double) _friction(loss):
    """Return constant [Nm] and viscous [Nms/rad] part of a loss without load, mean of both directions."""
    nodes, sides = loss.load_nodes_nm, (loss.positive, loss.negative)
    return (
        max(0.0, sum(np.interp(0.0, nodes, side.constant_nm) for side in sides) / 2.0),
        max(0.0, sum(np.interp(0.0, nodes, side.viscous_nms_per_rad) for side in sides) / 2.0),
    )


cdef int fill_offsets(
    OffsetLaw *law, double torque_per_ampere, double rated_nm, fused, bint used, bint estimated
) except -1:
    """Set the parameters from section `fused` of a joint; used: offsets are corrected; estimated: they are estimated at least.

    A joint without torsion has one path: nothing is estimated.
    """
    cdef double constant, viscous
    memset(law, 0, sizeof(OffsetLaw))
    sigma, torsion = fused.sigma, fused.torsion
    law.corrected, law.estimated = used and torsion is not None, (used or estimated) and torsion is not None
    if not law.estimated:
        return 0
    constant, viscous = _friction(fused.loss)
    law.stiffness = torsion.stiffness_nm_per_rad
    law.torque_per_ampere = torque_per_ampere
    law.limit = torsion.zero_limit_rad
    law.floor = (COVERED * sigma.torsion_nm / law.stiffness) ** 2
    law.known = KNOWN_SHARE * (sigma.current_nm / law.stiffness) ** 2
    if law.corrected and fused.zeros is not None:
        law.correlation = fused.zeros.correlation_s or CORRELATION_S
        law.spread, law.spread_nm = fused.zeros.spread_rad**2, fused.zeros.spread_nm**2
    law.prior[0] = (LARGEST_LINK * rated_nm / law.stiffness) ** 2
    law.prior[1] = (CURRENT_SHARE * sigma.current_nm / law.torque_per_ampere) ** 2
    law.prior[2] = sigma.current_nm**2 + (FRICTION_SHARE * constant) ** 2
    law.prior[3] = sigma.viscous_nms_per_rad**2 + (FRICTION_SHARE * viscous) ** 2
    law.prior[4] = sigma.load**2 + sigma.torsion_load**2 + LEAST_GAIN**2
    # the link's prior is as wide as an offset may be; it drifts like the rest of its path
    law.drift[0] = (0.1 * sigma.torsion_nm / law.stiffness) ** 2 / DRIFT_S
    for n in range(1, OFFSET_STATES):
        law.drift[n] = 0.01 * law.prior[n] / DRIFT_S
    return 0


cdef void restart_offsets(const OffsetLaw *law, OffsetState *s) noexcept nogil:
    cdef int n
    memset(s, 0, sizeof(OffsetState))
    for n in range(OFFSET_STATES):
        s.now.p[n][n] = s.now.day_p[n][n] = law.prior[n]
    s.kept, s.parted_nm = s.now, INFINITY


cdef void go_back(OffsetState *s) noexcept nogil:
    """Go back to the estimate that was kept."""
    s.now = s.kept
    s.agreed_s, s.parted_nm = 0.0, INFINITY
    drop_block(s)


cdef void keep_offsets(
    const OffsetLaw *law, OffsetState *s, AgreementState *a, const Fused *fused, double load, double dt
) noexcept nogil:
    """Take a sample in motion: keep the estimate that the paths agree by, go back to the kept one where they agree by it alone.

    A mismatch that the paths do not show, under at least the smallest load [Nm] that they were far apart at, is not in agreement
    either: a joint that has changed shows it there.
    """
    cdef double change = law.stiffness * (s.kept.link_rad - s.now.link_rad), apart = reach(fused, DISAGREE)
    cdef double square = FOREIGN * FOREIGN * fused.variance
    cdef bint by_kept
    change += law.torque_per_ampere * (s.kept.current_a - s.now.current_a)
    by_kept = fabs(fused.difference + change) <= apart
    if fused.difference * fused.difference > square:
        s.parted_nm = fmin(s.parted_nm, load)
    if fabs(fused.difference) <= apart and (a.mismatch <= square or not by_kept):
        s.agreed_s += dt
    elif not by_kept:
        s.agreed_s = 0.0
    elif load >= s.parted_nm:
        s.agreed_s = fmin(s.agreed_s, 0.0) - dt
    if s.agreed_s > CALM_S:
        s.kept, s.agreed_s, s.parted_nm = s.now, 0.0, INFINITY
    elif s.agreed_s < -AGAIN_S:
        go_back(s)
        a.trend = a.slow = a.fast = a.mismatch = a.gain_mismatch = a.turn.square = 0.0
        memset(a.turn.z, 0, sizeof(a.turn.z))  # X'X is of the motion, not of the difference


cdef void drop_block(OffsetState *s) noexcept nogil:
    """Drop an incomplete block, because one of its samples does not count."""
    if s.block.samples:
        memset(&s.block, 0, sizeof(Block))


cdef bint gather(
    OffsetState *s, double dt, double y, double direction, double velocity, double torsion, double variance
) noexcept nogil:
    """Add a sample in motion to the block; return whether it is complete and `update_difference` is due.

    y: tau_t - tau_c [Nm]; variance: of y [Nm^2]. A sample near a reversal drops the block.
    """
    cdef Block *b = &s.block
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
    return b.samples == BLOCK


cdef double local_stiffness(const FusedObserverLaw *law, double d) noexcept nogil:
    """Return d tau_t/d d [Nm/rad] of the spring at a deflection [rad], without slips."""
    cdef double stiffness = law.stiffness + 3.0 * law.cubic * d * d
    cdef int k
    for k in range(law.hardenings):
        if fabs(d) > law.hardening[k].deflection:
            stiffness += law.hardening[k].stiffness
    return stiffness


cdef double _share(const OffsetLaw *law, const OffsetState *s) noexcept nogil:
    """Return the known part of the day's link offset, 0 to 1; 0 where the file has no spread over the days."""
    return law.spread / (law.spread + s.now.day_p[0][0]) if law.spread > 0.0 else 0.0


cdef double _shrunk(double x, double variance, double least) noexcept nogil:
    """Return the correction of an offset x by firm shrinkage, in addition to the part `least`."""
    cdef double w = (fabs(x) / sqrt(variance) - SHRUNK_BELOW) * INVERSE_RANGE
    if w >= 1.0:
        w = 1.0
    return x * (w - least) if w > least else 0.0


cdef double _link_correction(const OffsetLaw *law, const OffsetState *s) noexcept nogil:
    """Return the correction of the link encoder [rad] before its slew."""
    cdef double share = _share(law, s), used = _shrunk(s.now.x[0], s.now.p[0][0] + law.floor, share)
    return used + share * s.now.day_x[0] if share > 0.0 else used


cdef double _innovation(const double *h, const double *x, double measured) noexcept nogil:
    """Return the difference of the paths [Nm] less that of the states x."""
    cdef int n
    for n in range(OFFSET_STATES):
        measured -= h[n] * x[n]
    return measured


cdef void _update(
    const double *h, double *x, double (*p)[OFFSET_STATES], double innovation, double variance
) noexcept nogil:
    """Update states and covariance by an innovation [Nm] with noise of this variance."""
    cdef double ph[OFFSET_STATES]
    cdef double gain
    cdef int m, n
    for n in range(OFFSET_STATES):
        ph[n] = 0.0
        for m in range(OFFSET_STATES):
            ph[n] += p[n][m] * h[m]
        variance += h[n] * ph[n]
    for n in range(OFFSET_STATES):
        gain = ph[n] / variance
        x[n] += gain * innovation
        for m in range(n + 1):
            p[n][m] -= gain * ph[m]
            p[m][n] = p[n][m]


cdef void _forget_link(const OffsetLaw *law, double (*p)[OFFSET_STATES]) noexcept nogil:
    cdef int n
    for n in range(OFFSET_STATES):
        p[0][n] = p[n][0] = 0.0
    p[0][0] = law.prior[0]


cdef double _update_offsets(const OffsetLaw *law, OffsetState *s, double stiffness, double slope) noexcept nogil:
    """Take the complete block; return its innovation [Nm].

    stiffness: local, of the spring; slope: dL/draw of the loss.
    """
    cdef Block b = s.block
    cdef double h[OFFSET_STATES]
    cdef double share = 1.0 / BLOCK, measured, innovation, way, remaining
    cdef int n
    memset(&s.block, 0, sizeof(Block))
    h[0], h[1] = -stiffness, -law.torque_per_ampere * (1.0 - slope)
    h[2], h[3], h[4] = -b.direction * share, -b.velocity * share, b.torsion * share
    # the paths were corrected: the correction belongs to the measurement
    measured = b.y * share + h[0] * s.now.link_rad + h[1] * s.now.current_a
    for n in range(OFFSET_STATES):
        s.now.p[n][n] += law.drift[n] * b.dt
        s.now.day_p[n][n] += law.drift[n] * b.dt
    innovation = _innovation(h, s.now.x, measured)
    s.disagreeing_s = s.disagreeing_s + b.dt if fabs(innovation) > JUMP * sqrt(b.variance * share) else 0.0
    if s.disagreeing_s > JUMP_S:
        s.jumps += s.now.p[0][0] < law.known
        s.now = s.kept
        _forget_link(law, s.now.p)
        _forget_link(law, s.now.day_p)
        s.disagreeing_s = 0.0
    _update(h, s.now.x, s.now.p, _innovation(h, s.now.x, measured), b.variance * share * CORRELATION / b.dt)
    if law.spread > 0.0:
        _update(h, s.now.day_x, s.now.day_p, _innovation(h, s.now.day_x, measured), b.variance * share * law.correlation / b.dt)
    if not law.corrected:
        return innovation
    way = b.dt * INVERSE_SLEW
    if way > 1.0:
        way = 1.0
    s.now.link_rad += way * (_link_correction(law, s) - s.now.link_rad)
    s.now.current_a += way * (_shrunk(s.now.x[1], s.now.p[1][1], 0.0) - s.now.current_a)
    # without the uncertainty of the offset: on average 0 for a joint without one
    remaining = s.now.x[0] - s.now.link_rad
    s.uncorrected_nm = law.stiffness * sqrt(fmax(0.0, remaining * remaining - s.now.p[0][0] - law.floor))
    return innovation


cdef double known_nm2(const OffsetLaw *law, const OffsetState *s) noexcept nogil:
    """Return the reduction of the torsion's variance [Nm^2] by the known and already corrected link offset."""
    cdef double share = _share(law, s), late
    if not share > 0.0:
        return 0.0
    late = law.stiffness * (_link_correction(law, s) - s.now.link_rad)
    return fmax(0.0, share * law.spread_nm - late * late)


cdef double day_nm2(const OffsetLaw *law, double known, double alpha) noexcept nogil:
    """Return what the day's offset is in sigma^2 [Nm^2]; known: of `known_nm2`; alpha: share of the torsion."""
    return fmin(law.spread_nm - known, alpha * law.spread_nm)


cdef double _uncorrected_torque(const OffsetLaw *law, const OffsetState *s) noexcept nogil:
    return law.stiffness * (s.now.x[0] - s.now.link_rad)


cdef bint implausible(const OffsetLaw *law, const OffsetState *s) noexcept nogil:
    """Return whether the link offset is significantly beyond the file's limit for a healthy joint."""
    return fabs(s.now.x[0]) > law.limit and fabs(s.now.x[0]) > KEPT_ABOVE * sqrt(s.now.p[0][0])


cdef void report_offsets(const OffsetLaw *law, const OffsetState *s, Learned *out) noexcept nogil:
    """Set `out` to the offsets and their standard deviations; no flag where they are not tracked."""
    memset(out, 0, sizeof(Learned))
    if not law.corrected:
        return
    out.link_rad, out.link_sigma_rad, out.link_used_rad = s.now.x[0], sqrt(s.now.p[0][0]), s.now.link_rad
    out.current_a, out.current_sigma_a, out.current_used_a = s.now.x[1], sqrt(s.now.p[1][1]), s.now.current_a
    out.limit_rad, out.jumps, out.flags = law.limit, s.jumps, IS_TRACKED
    if s.now.p[0][0] < law.known:
        out.flags |= IS_LEARNED
    if implausible(law, s):
        out.flags |= IS_BEYOND


cdef offsets_of(const OffsetLaw *law, const OffsetState *s):
    cdef Learned report
    report_offsets(law, s, &report)
    return Zeros(**report)


# Agreement ------------------------------------------------------------------------------------------------------------

DOWN_S: Final = 5.0
TURNING_RAD_S: Final = 0.1
"""At lower speeds a wave of the motor's angle looks like a change of friction."""
TURN_TREND_S: Final = 0.05
TURN_MEMORY_S: Final = 1.0
"""Time constant of forgetting, in time of motion."""
LEAST_S: Final = 0.02
"""Prior of no waves at all, as time of motion times the square of a wave."""
EVERY: Final = 4
TURN_BLOCK: Final = 16
"""Every fourth sample counts; after TURN_BLOCK of them the waves are compared with the file's: 64 ms at 1 kHz."""

cdef double TREND_S = 0.1, UP_S = 0.15
cdef double INVERSE_TREND = 1.0 / TREND_S, INVERSE_UP = 1.0 / UP_S, INVERSE_DOWN = 1.0 / DOWN_S
# the status is degraded by a mismatch of so many sigmas of the estimate, squared, and this part of the rated torque
cdef double LOWER_SQUARE = 4.0**2, LEAST_SHARE = 0.02
cdef double SURE_SIGMAS = 2.0  # standard deviations of a gain that do not count for the status
cdef double SLOWEST_TURN = TURNING_RAD_S, LEAST = LEAST_S
cdef double INVERSE_TURN_TREND = 1.0 / TURN_TREND_S, INVERSE_MEMORY = 1.0 / TURN_MEMORY_S
cdef double TURN_SETTLE_S = 0.05  # wait after a start of the observer: ten of its time constants
cdef int TAKEN_EVERY = EVERY, TAKEN_BLOCK = TURN_BLOCK


cdef int fill_agreement(AgreementLaw *law, agreement, double rated_nm) except -1:
    """Set the levels from section `fused.agreement` of a joint file; None: not known."""
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
    """Set the difference of the paths over the motor's turn from section `fused.agreement.turn`."""
    law.with_turn, law.turn_limit = True, turn.limit
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
    memset(s, 0, sizeof(AgreementState))


cdef double _level(double level, double square, double dt) noexcept nogil:
    return level + (square - level) * (1.0 - exp(-dt * (INVERSE_UP if square > level else INVERSE_DOWN)))


cdef double _excess(const OffsetState *offsets, double sigmas) noexcept nogil:
    """Return the magnitude of the gain less so many of its standard deviations, at least 0."""
    return fmax(0.0, fabs(offsets.now.x[4]) - sigmas * sqrt(offsets.now.p[4][4]))


cdef double _gain_mismatch(const AgreementLaw *law, const OffsetState *offsets, double sigmas) noexcept nogil:
    return law.gain_factor * fmax(0.0, _excess(offsets, sigmas) - law.gain)


cdef double _waves_beyond(const TurnState *t) noexcept nogil:
    """Return the mean square [Nm^2] of the waves, shrunk by what is usual (positive part, James and Stein 1961)."""
    cdef double sum = 0.0
    cdef int k
    for k in range(TURN_WAVES):
        sum += t.a[k] * t.a[k]
    return 0.5 * sum * (1.0 - TURN_WAVES / t.square)


cdef void _update_agreement(
    const AgreementLaw *law, AgreementState *s, const OffsetState *offsets, double uncorrected_nm, double innovation, double dt
) noexcept nogil:
    """Take the innovation [Nm] of a block of length dt [s], and the offset that is not corrected [Nm]."""
    cdef double rest
    s.trend += (innovation - s.trend) * (1.0 - exp(-dt * INVERSE_TREND))
    rest = innovation - s.trend
    s.slow = _level(s.slow, s.trend * s.trend, dt)
    s.fast = _level(s.fast, rest * rest, dt)
    s.mismatch = law.level_square * (fmax(0.0, s.slow - law.slow) + fmax(0.0, s.fast - law.fast))
    s.mismatch += law.zero_square * fmax(0.0, uncorrected_nm * uncorrected_nm - law.zero)
    if s.turn.square > TURN_WAVES:
        s.mismatch += _waves_beyond(&s.turn)
    s.gain_mismatch = _gain_mismatch(law, offsets, law.gain_sigmas)


cdef void update_difference(
    const OffsetLaw *offset_law, OffsetState *offsets, const AgreementLaw *law, AgreementState *s, double stiffness,
    double slope
) noexcept nogil:
    """Take the complete block into the offsets and the agreement; stiffness, slope: as `_update_offsets`."""
    cdef double dt = offsets.block.dt
    cdef double innovation = _update_offsets(offset_law, offsets, stiffness, slope)
    if law.used:
        _update_agreement(law, s, offsets, _uncorrected_torque(offset_law, offsets), innovation, dt)


cdef void pause_turn(AgreementState *s) noexcept nogil:
    """Let trends start at the next sample, the first one of a motion."""
    s.turn.going = False


cdef void restart_turn(AgreementState *s) noexcept nogil:
    """Wait for the observer, which starts perhaps in the middle of an acceleration."""
    s.turn.going, s.turn.settle_s = False, TURN_SETTLE_S


cdef void update_turn(
    const AgreementLaw *law, AgreementState *s, double dt, double difference, double direction, double velocity,
    double loss, const double *wave
) noexcept nogil:
    """Take a sample in motion: difference of the paths and loss [Nm], and waves of the same age.

    Near a reversal friction changes within a part of a turn: trends start again after it.
    """
    cdef TurnState *t = &s.turn
    cdef double rest = difference, square = velocity * velocity, way
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
        rest -= wave[k] * (law.own[k][0] + law.own[k][1] * loss + law.own[k][2] * velocity + law.own[k][3] * square)
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
        _compare_turn(law, t)


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


cdef void _compare_turn(const AgreementLaw *law, TurnState *t) noexcept nogil:
    """Compare the waves up to this complete block with the file's, then forget a part."""
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


cdef bint turn_differs(const AgreementLaw *law, const AgreementState *s) noexcept nogil:
    """Return whether the paths differ over the motor's turn by more than on any ordinary day."""
    return law.with_turn and s.turn.square > law.turn_limit


def turn_waves(turn, dt_s, difference_nm, direction, velocity_rad_s, loss_nm, waves):
    """Return (waves [blocks, 6] in Nm, square [blocks]) of a run from its start beyond `fused.agreement.turn`.

    Arrays [n] of samples in motion: difference_nm: torsion less current path; waves [n, 6]: filtered cos and sin of TURN_ORDERS
    times the motor's angle. Raises ValueError for waves of another shape.
    """
    columns = (dt_s, difference_nm, direction, velocity_rad_s, loss_nm)
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
        update_turn(&law, &s, x[k, 0], x[k, 1], x[k, 2], x[k, 3], x[k, 4], &w[k, 0])
        if last and s.turn.taken == 0:
            found.append([s.turn.a[n] for n in range(TURN_WAVES)])
            squares.append(s.turn.square)
    return np.array(found, np.float64).reshape(-1, TURN_WAVES), np.array(squares, np.float64)


cdef double _by_share(double alpha, double mismatch, double gain, double torsion) noexcept nogil:
    """Return the mismatch [Nm^2], with that of the gain at this torsion [Nm], by the larger weight of both paths."""
    cdef double share = fmax(alpha, 1.0 - alpha), by_gain = gain * torsion
    return share * share * (mismatch + by_gain * by_gain)


cdef double mismatch_variance(const AgreementState *s, double alpha, double torsion) noexcept nogil:
    """Return the addition to sigma^2 [Nm^2] of the fused value; alpha: share of the torsion [Nm] in it."""
    return _by_share(alpha, s.mismatch, s.gain_mismatch, torsion)


cdef bint degrades(
    const AgreementLaw *law, const AgreementState *s, const OffsetState *offsets, double mismatch, double sigma,
    double alpha, double torsion
) noexcept nogil:
    """Return whether a mismatch [Nm^2], as `mismatch_variance`, degrades the status beside the estimate's own sigma [Nm]."""
    cdef double most = fmax(LOWER_SQUARE * sigma * sigma, law.relevant)
    if not mismatch > most:
        return False
    if law.lowered == 0.0:
        return True
    return _by_share(alpha, s.mismatch, _gain_mismatch(law, offsets, SURE_SIGMAS), torsion) > fmax(most, law.lowered)


def levels(fused, double rated_nm, dt_s, difference_nm, direction, velocity_rad_s, torsion_nm, variance_nm2, slope):
    """Return (slow, fast, gain, |offset|, mismatch) after each block of a run, arrays [blocks] in Nm^2, Nm^2, 1, Nm, Nm.

    Offsets are tracked. gain: |g| less `gain_sigmas` of its standard deviations; offset: not corrected, as torque; mismatch: of
    the torsion, with the significant part of the gain, beyond the levels of `fused.agreement`; 0 where that is None.
    Arrays [n] of samples in motion: difference_nm: torsion less current path; variance_nm2: of that; slope: dL/draw of the loss.
    """
    columns = (dt_s, difference_nm, direction, velocity_rad_s, torsion_nm, variance_nm2, slope)
    cdef const double[:, ::1] x = np.ascontiguousarray(np.column_stack(columns), np.float64)
    cdef OffsetLaw law
    cdef OffsetState offsets
    cdef AgreementLaw levels_law
    cdef AgreementState s
    cdef double dt, innovation, torsion, remaining
    cdef Py_ssize_t k
    # the current offset counts as a torque: its part of the difference does not depend on the torque per ampere
    fill_offsets(&law, 1.0, rated_nm, fused, True, True)
    fill_agreement(&levels_law, fused.agreement, rated_nm)
    restart_offsets(&law, &offsets)
    restart_agreement(&s)
    found = []
    for k in range(x.shape[0]):
        if gather(&offsets, x[k, 0], x[k, 1], x[k, 2], x[k, 3], x[k, 4], x[k, 5] - law.spread_nm):
            dt, torsion = offsets.block.dt, offsets.block.torsion / offsets.block.samples
            # these readings are not corrected, as `_update_offsets` expects them
            offsets.block.y += law.stiffness * offsets.now.link_rad * offsets.block.samples
            offsets.block.y += (1.0 - x[k, 6]) * offsets.now.current_a * offsets.block.samples
            innovation = _update_offsets(&law, &offsets, law.stiffness, x[k, 6])
            remaining = _uncorrected_torque(&law, &offsets)
            _update_agreement(&levels_law, &s, &offsets, remaining, innovation, dt)
            mismatch = sqrt(_by_share(1.0, s.mismatch, _gain_mismatch(&levels_law, &offsets, SURE_SIGMAS), torsion))
            found.append((s.slow, s.fast, _excess(&offsets, levels_law.gain_sigmas), fabs(remaining), mismatch))
    return tuple(np.array(found, np.float64).reshape(-1, 5).T)


def track_run(
    fused, rated_nm, dt_s, raw_nm, half_nm, velocity_rad_s, torsion_nm, open_nm, difference_nm, direction, slope, stiffness,
    ahead_nm, behind_nm2, resting, bint tracked=True
):
    """Return (alpha, torsion, current, spread, more, known) of a run from its start, as the estimator has them at each sample.

    alpha: share of the torsion; torsion, current: corrections of both paths [Nm]; spread: standard deviation of the value [Nm],
    scale 1; more: what widens it [Nm^2]; known: reduction of s_t^2 [Nm^2]. Arrays [n] of all samples, `fused` with a
    torsion. difference_nm: torsion less current path; slope: dL/draw of the loss; stiffness: d tau_t/d d of the spring
    [Nm/rad]; ahead: change of the torsion since the current path [Nm]; behind: what the tracking filter leaves of two readings
    [Nm^2]; resting: standing samples. tracked: offsets are corrected.
    """
    columns = (
        dt_s, raw_nm, half_nm, velocity_rad_s, torsion_nm, open_nm, difference_nm, direction, slope, stiffness,
        ahead_nm, behind_nm2
    )
    cdef const double[:, ::1] x = np.ascontiguousarray(np.column_stack(columns), np.float64)
    out = np.zeros((6, x.shape[0]))
    cdef const unsigned char[::1] rests = np.ascontiguousarray(resting, np.bool_).view(np.uint8)
    cdef double[:, ::1] to = out
    cdef FusionLaw paths
    cdef ProofLaw proof_law
    cdef ProofState proof
    cdef FusedObserved seen
    cdef OffsetLaw law
    cdef OffsetState s
    cdef AgreementLaw levels_law
    cdef AgreementState agreement
    cdef Fused physics
    cdef double raw, torsion, difference, known, unproven
    cdef Py_ssize_t k
    fill_fusion(&paths, fused.sigma, True)
    paths.reference = 0.0
    # the current offset counts as a torque: its part of the difference does not depend on the torque per ampere
    fill_offsets(&law, 1.0, rated_nm, fused, tracked, True)
    fill_agreement(&levels_law, fused.agreement, rated_nm)
    fill_proof(&proof_law, rated_nm, fused)
    restart_offsets(&law, &s)
    restart_agreement(&agreement)
    restart_proof(&proof_law, &proof)
    for k in range(x.shape[0]):
        to[1, k], to[2, k] = x[k, 9] * s.now.link_rad, -(1.0 - x[k, 8]) * s.now.current_a
        raw, torsion, difference = x[k, 1] - s.now.current_a, x[k, 4] + to[1, k], x[k, 6] + to[1, k] - to[2, k]
        physics = fuse_paths(&paths, raw, raw - torsion + difference, x[k, 2], x[k, 3], torsion, x[k, 5])
        seen.raw_nm, seen.torsion_nm, seen.direction, seen.ahead_nm = raw, torsion, x[k, 7], x[k, 10]
        unproven = prove(&proof_law, &proof, &physics, &seen, x[k, 0], rests[k], True)
        if rests[k]:
            drop_block(&s)
        elif gather(&s, x[k, 0], difference, x[k, 7], x[k, 3], torsion, physics.variance - law.spread_nm):
            update_difference(&law, &s, &levels_law, &agreement, x[k, 9], x[k, 8])
        known = known_nm2(&law, &s)
        if law.spread > 0.0:
            reweigh(&physics, known, law.spread_nm)
        to[0, k], to[3, k], to[5, k] = physics.alpha, physics.sigma, known
        to[4, k] = apart_nm2(&physics, 0.0 if levels_law.used else s.uncorrected_nm) + day_nm2(&law, known, physics.alpha)
        to[4, k] += unproven_nm2(&proof_law, unproven, physics.alpha, s.now.link_rad, x[k, 11])
        if levels_law.used:
            to[4, k] += mismatch_variance(&agreement, physics.alpha, torsion)
    return tuple(out)
