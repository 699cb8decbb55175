"""Zeros of the link encoder and of the current of one day, from the difference of the two views: a small Kalman filter.

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
"""

from libc.math cimport fabs, fmax, sqrt
from libc.string cimport memset

from typing import Final

import numpy as np

from jtqd.estimator.learned import BEYOND, LEARNED, TRACKED, Zeros

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
