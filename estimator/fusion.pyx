"""Fusion of two independent measurements of one torque by their variances: motor current less loss, and torsion.

    tau_c = tau_raw - loss                 knows fast changes and any load; fails with friction
    tau_t = K d + K3 d^3 + D d' + H z      knows nothing of friction; fails with hysteresis and encoder errors
    alpha = s_c^2/(s_c^2 + s_t^2)          physics = tau_c + alpha (tau_t - tau_c)
    s_c^2 = a^2 + (b v)^2 + (c tau_raw)^2 + half^2        half: what friction leaves open near v = 0
    s_t^2 = e^2 + (f tau_t)^2 + open^2     open: what the slip leaves open until its bounds have met
    sigma^2 = s_c^2 s_t^2/(s_c^2 + s_t^2) + reference^2      reference: of the sensor of a comparison; 0 for the torque itself
    at rest = k sd + alpha open + (1 - alpha) half      half the interval of a standing joint, k: `fused.standstill`; sd: as sigma,
                                           without `half` and `open`, with the weight as it is
    widened by max(alpha, 1 - alpha) (|tau_t - tau_c| - DISAGREE_SIGMAS sqrt(s_c^2 + s_t^2)) where that is above 0

Towards standstill `half` grows to the half width of the friction interval and the torsion takes over: continuous,
and the value there no longer depends on which way friction happens to point.
"""

from libc.math cimport fabs, fmax, sqrt

from typing import Final

import numpy as np

SLOW_RAD_S: Final = 0.05
FAST_RAD_S: Final = 0.2
"""The network fades in between these speeds: slower, a wave of the motor angle looks like an offset."""

HOLD_S: Final = 0.05
"""Time constant with which the friction interval is forgotten after a reversal."""

DISAGREE_SIGMAS: Final = 3.0
"""Distance of the two paths in its own standard deviations from which what is more counts as an error of the fusion."""

FOREIGN_SIGMAS: Final = 4.0
"""Distance from which the status is lowered: at least one of the paths is not what the joint file says."""

GAUSS: Final = 1.6448536269514722
"""Half width of a normal distribution's 90 % interval in standard deviations: the interval is value +- GAUSS sigma."""

LEAST_TORSION: Final = 0.05
"""Part of the torsion's variance that is left, whatever is known of its zero."""

cdef double SLOW = SLOW_RAD_S, FAST = FAST_RAD_S, HOLD = HOLD_S
cdef double DISAGREE = DISAGREE_SIGMAS, INTERVAL = 1.0 / GAUSS
cdef double LEAST = LEAST_TORSION
cdef double INVERSE_RANGE = 1.0 / (FAST_RAD_S - SLOW_RAD_S)


cdef double share_by_speed(double v) noexcept nogil:
    """Return the network's share at this speed, 0 to 1."""
    cdef double a = fabs(v)
    if a >= FAST:
        return 1.0
    return (a - SLOW) * INVERSE_RANGE if a > SLOW else 0.0


def turning(velocity_rad_s):
    """Return the network's share at these speeds [n], 0 to 1."""
    cdef const double[::1] v = np.ascontiguousarray(velocity_rad_s, np.float64)
    out = np.empty(len(v))
    cdef double[::1] to = out
    cdef Py_ssize_t k
    for k in range(v.shape[0]):
        to[k] = share_by_speed(v[k])
    return out


cdef double keep(double half, double before, double dt) noexcept nogil:
    """Return `half` [Nm] with the memory of the sample before, dt [s] ago.

    Between rest and motion the weight moves from one path to the other. Their errors differ, so it must not move within
    a few milliseconds: what friction left open at a reversal counts for HOLD_S longer.
    """
    cdef double faded = before * (HOLD / (HOLD + dt))
    return half if half >= faded else faded


def held(half_nm, dt_s, running):
    """Return `half_nm` [n] with its memory (`keep`), which starts again after every sample that is not `running`."""
    cdef const double[::1] half = np.ascontiguousarray(half_nm, np.float64)
    cdef const double[::1] dt = np.ascontiguousarray(dt_s, np.float64)
    cdef const unsigned char[::1] on = np.ascontiguousarray(running, np.bool_).view(np.uint8)
    out = np.empty(len(half))
    cdef double[::1] to = out
    cdef double memory = 0.0
    cdef Py_ssize_t k
    for k in range(half.shape[0]):
        memory = keep(half[k], memory, dt[k]) if on[k] else 0.0
        to[k] = memory
    return out


cdef int fill_fusion(FusionLaw *law, sigma, bint with_torsion) except -1:
    """Set the variances from section `fused.sigma` of a joint file."""
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
        return Fused(0.0, value, sqrt(c + law.reference), 0.0, 1.0)
    t = law.torsion + law.torsion_load * torsion * torsion + open_nm * open_nm
    alpha = c / (c + t)
    return Fused(alpha, value + alpha * (torsion - value), sqrt(alpha * t + law.reference), torsion - value, c + t)


cdef void sharpen(Fused *fused, double known) noexcept nogil:
    """Weigh anew with a torsion whose variance is less by `known` [Nm^2]; `variance` stays that of the file.

    For a reference of 0.
    """
    cdef double c = fused.alpha * fused.variance, t = fused.variance - c, alpha
    t = fmax(t - known, LEAST * t)
    alpha = c / (c + t)
    fused.value += (alpha - fused.alpha) * fused.apart
    fused.alpha, fused.sigma = alpha, sqrt(alpha * t)


cdef Rest at_rest(
    const FusionLaw *law, double alpha, double raw, double half, double v, double torsion, double open_nm
) noexcept nogil:
    """Return standard deviation and bound [Nm] of the fused value of a standing joint.

    What friction and slip leave open is no error that is small on most days: a push from outside changes the torque and not
    the current, and a joint may have stopped at the end of its hysteresis. Both are bounds, counted by their weights.
    """
    cdef double rest = 1.0 - alpha
    cdef double c = law.current + law.viscous * v * v + law.load * raw * raw
    cdef double t = law.torsion + law.torsion_load * torsion * torsion if law.with_torsion else 0.0
    return Rest(sqrt(alpha * alpha * t + rest * rest * c + law.reference), alpha * open_nm + rest * half)


cdef double widening(const Fused *fused, double left_nm) noexcept nogil:
    """Return what a disagreement of the paths adds to sigma [Nm]; left_nm: known zero of the torsion that is not taken off.

    Which path is wrong is not known: the worse for the fused value counts. Both are errors of a known size, not of a
    known variance: the 90 % interval, not sigma, is to hold them.
    """
    cdef double more = fabs(fused.apart) - DISAGREE * sqrt(fused.variance)
    cdef double zero = fused.alpha * left_nm
    if more > 0.0:
        more *= fmax(fused.alpha, 1.0 - fused.alpha)
        return INTERVAL * sqrt(more * more + zero * zero)
    return INTERVAL * zero


cdef class Fusion:
    """Value and standard deviation of the fused physics [Nm, joint side].

    with_torsion False: the current path alone, whatever the torsion.
    """

    def __init__(self, sigma, bint with_torsion):
        fill_fusion(&self.law, sigma, with_torsion)

    def fuse(
        self,
        double raw_nm,
        double loss_nm,
        double half_nm,
        double velocity_rad_s,
        double torsion_nm,
        double open_nm=0.0,
    ):
        """Return (physics, sigma) [Nm]; half_nm: `AdditiveLossModel.loss`; open_nm: `FusedObservedSample`."""
        cdef Fused fused = fuse_paths(&self.law, raw_nm, loss_nm, half_nm, velocity_rad_s, torsion_nm, open_nm)
        return fused.value, fused.sigma

    def fuse_many(self, raw_nm, loss_nm, half_nm, velocity_rad_s, torsion_nm, open_nm=0.0):
        """Return the same for arrays [n]."""
        _, value, sigma, _ = self._run(raw_nm, loss_nm, half_nm, velocity_rad_s, torsion_nm, open_nm)
        return value, sigma

    def weigh_many(self, raw_nm, half_nm, velocity_rad_s, torsion_nm, open_nm=0.0):
        """Return (alpha, sigma), arrays [n]: share of the torsion, and standard deviation of the fused value [Nm]."""
        alpha, _, sigma, _ = self._run(raw_nm, 0.0, half_nm, velocity_rad_s, torsion_nm, open_nm)
        return alpha, sigma

    def variance_many(self, raw_nm, half_nm, velocity_rad_s, torsion_nm, open_nm=0.0):
        """Return the variance of the difference of the two paths [n], Nm^2."""
        return self._run(raw_nm, 0.0, half_nm, velocity_rad_s, torsion_nm, open_nm)[3]

    def weigh_known(self, raw_nm, half_nm, velocity_rad_s, torsion_nm, open_nm, known_nm2):
        """Return the same as `weigh_many` where known_nm2 [n] of the torsion's variance is known: `sharpen`."""
        alpha, _, sigma, variance = self._run(raw_nm, 0.0, half_nm, velocity_rad_s, torsion_nm, open_nm)
        known = np.ascontiguousarray(known_nm2, np.float64)
        cdef double[::1] share = alpha
        cdef double[::1] spread = sigma
        cdef const double[::1] whole = variance
        cdef const double[::1] less = known
        cdef Fused fused
        cdef Py_ssize_t k
        for k in range(share.shape[0]):
            fused = Fused(share[k], 0.0, 0.0, 0.0, whole[k])
            sharpen(&fused, less[k])
            share[k], spread[k] = fused.alpha, sqrt(fused.sigma * fused.sigma + self.law.reference)
        return alpha, sigma

    def rest_many(self, raw_nm, half_nm, velocity_rad_s, torsion_nm, open_nm=0.0):
        """Return (standard deviation, bound) [Nm] of the value of a standing joint, arrays [n]."""
        alpha = self._run(raw_nm, 0.0, half_nm, velocity_rad_s, torsion_nm, open_nm)[0]
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

    def _run(self, *columns):
        laid = np.ascontiguousarray(np.broadcast_arrays(*columns), np.float64)
        out = np.empty((4, laid.shape[1]))
        cdef const double[:, ::1] x = laid
        cdef double[:, ::1] to = out
        cdef Fused fused
        cdef Py_ssize_t k
        for k in range(x.shape[1]):
            fused = fuse_paths(&self.law, x[0, k], x[1, k], x[2, k], x[3, k], x[4, k], x[5, k])
            to[0, k], to[1, k], to[2, k], to[3, k] = fused.alpha, fused.value, fused.sigma, fused.variance
        return out
