"""Uncertainty of an estimate: fusion of both paths by their variances, standard deviations, trust in networks.

Fusion of two independent measurements of one torque by their variances: motor current less loss, and torsion.

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

How far an estimate can be trusted: standard deviations, standstill, and where a network was trained.

| class | gives | method |
|---|---|---|
| `Uncertainty` | sigma of the physics in motion, value and sigma at standstill | `tob`, `efficiency`, `network` |
| `Trust` | weight of the network: a range per feature, and the distance to physics | `network` |
| `FusedTrust` | weight of the network: a map over speed and motor torque (`Envelope`) | `fused` |

A weight is 1 where the network is alone in charge and 0 where nothing of it is left.
"""

from libc.math cimport INFINITY, NAN, fabs, fmax, fmin, isnan, sqrt
from libc.string cimport memset

from jtqd.estimator.losses cimport (
    EfficiencyLaw,
    Interval,
    LossModel,
    efficiency_rmse,
    efficiency_standstill,
    friction_torque,
)

from typing import Final

import numpy as np

from jtqd.estimator.joint import MAX_CELLS

# Fusion ---------------------------------------------------------------------------------------------------------------

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


if MAX_CELLS + 2 > MOST_CELLS:
    raise ImportError(f"{MAX_CELLS} cells may be in an envelope, the compiled map has room for {MOST_CELLS - 2}")

FADE_START: Final = 0.75
"""Part of the network's limit from which it fades into physics; at the limit nothing of it is left."""

TEMPERATURE_MARGIN_K: Final = 1.0
"""Beside the range of temperatures over which trust is lost."""

DISTANCE_MARGIN: Final = 0.25
"""Part of the range beyond which a larger distance between torsion and current counts as unknown."""

cdef double PER_KELVIN = 1.0 / TEMPERATURE_MARGIN_K


# Uncertainty of the physics -------------------------------------------------------------------------------------------


cdef int fill_uncertainty(UncertaintyLaw *law, joint, settings, bint has_efficiency) except -1:
    """Set the parameters from joint and settings."""
    law.floor = settings.sigma_floor * joint.rated_torque_nm
    law.u_friction = settings.friction_uncertainty
    # what friction can hold is itself known to that part only
    law.widened = 1.0 + settings.friction_uncertainty
    law.load = settings.load_uncertainty
    # without an efficiency the physics is the classical observer's whatever the method
    law.with_efficiency = settings.method != "tob" and has_efficiency
    return 0


cdef double sigma_moving(const UncertaintyLaw *law, const EfficiencyLaw *losses, double raw, double i, double v) noexcept nogil:
    """Return sigma of a moving joint; i: acceleration-corrected current tau_raw/(G Kt)."""
    cdef double load = efficiency_rmse(losses, i, v) if law.with_efficiency else law.load * raw
    cdef double friction = law.u_friction * friction_torque(&losses.friction, v)
    return sqrt(load * load + friction * friction + law.floor * law.floor)


cdef Spread standing(const UncertaintyLaw *law, const EfficiencyLaw *losses, double raw, double i) noexcept nogil:
    """Return value and sigma of a standing joint: middle and half width of what friction can hold."""
    cdef Interval loss
    if not law.with_efficiency:
        return Spread(raw, law.widened * losses.friction.static + law.floor)
    loss = efficiency_standstill(losses, i)
    return Spread(
        raw - 0.5 * (loss.forward + loss.backward), 0.5 * law.widened * (loss.forward - loss.backward) + law.floor
    )


cdef class Uncertainty:
    """Standard deviations and standstill intervals of the physics estimates of one joint [Nm, joint side].

    moving        sigma^2 = load^2 + (u_f tau_f(v))^2 + floor^2
                  load: the efficiency table's RMSE as a torque; for the classical observer u_l |tau_raw|
    standstill    tau_j in [tau_raw - loss(+), tau_raw - loss(-)]
                  value: the middle; sigma: half the width, wider by u_f, + floor
    """

    def __init__(self, joint, settings, LossModel losses):
        self.losses = losses.law
        fill_uncertainty(&self.law, joint, settings, losses.law.has_efficiency)

    def moving(self, double raw_nm, double current_a, double velocity_rad_s):
        """Return sigma of a moving joint; current_a is the acceleration-corrected current tau_raw/(G Kt)."""
        return sigma_moving(&self.law, &self.losses, raw_nm, current_a, velocity_rad_s)

    def standing(self, double raw_nm, double current_a):
        """Return (value, sigma) of a standing joint: middle and half width of what friction can hold."""
        cdef Spread spread = standing(&self.law, &self.losses, raw_nm, current_a)
        return spread.value, spread.sigma


# Trust in the paper's network -----------------------------------------------------------------------------------------


cdef int fill_trust(TrustLaw *law, low, high, double margin, double limit) except -1:
    """Set the parameters from a network's ranges."""
    if len(low) != FEATURES or len(high) != FEATURES:
        raise ValueError(f"found ranges of {len(low)} and {len(high)} features, expected {FEATURES}")
    for n, (a, b) in enumerate(zip(low, high, strict=True)):
        law.low[n], law.high[n] = a, b
        # a feature that was constant in training, or no margin at all: a step of rounding size instead of 1/0
        law.inverse_margin[n] = 1.0 / max(margin * (b - a), 1e-9 * max(1.0, abs(a), abs(b)))
    law.limit = limit
    law.fade = FADE_START * limit
    law.inverse_fade = 1.0 / max(limit - law.fade, 1e-12)
    return 0


cdef double _inside(const TrustLaw *law, const double *x) noexcept nogil:
    """Return the weight by the features alone."""
    cdef double weight = 1.0, part
    cdef int n
    for n in range(FEATURES):
        if law.low[n] <= x[n] <= law.high[n]:
            continue
        part = 1.0 - fmax(law.low[n] - x[n], x[n] - law.high[n]) * law.inverse_margin[n]
        if not part > 0.0:  # NaN included
            return 0.0
        weight = fmin(weight, part)
    return weight


cdef double trust(const TrustLaw *law, const double *x, double difference) noexcept nogil:
    """Return the weight for features x and network minus physics; a difference of NaN gives 0."""
    cdef double distance = fabs(difference)
    if distance <= law.fade:
        return _inside(law, x)
    if distance < law.limit:
        return fmin((law.limit - distance) * law.inverse_fade, _inside(law, x))
    return 0.0


cdef class Trust:
    """Weight of the network in [0, 1]: 1 inside its envelope and near physics, 0 far from either, continuous.

    low, high: training range per feature (6 each); margin: part of the span over which the weight falls to
    0 outside; limit_nm: largest |network - physics|; the weight falls from FADE_START of it.
    """

    def __init__(self, low, high, double margin, double limit_nm):
        fill_trust(&self.law, low, high, margin, limit_nm)

    def weight(self, *values):
        """Return the weight for FEATURES x0..x5 and network minus physics; a difference of NaN gives 0."""
        cdef double x[FEATURES]
        *features, difference_nm = values
        for n in range(FEATURES):
            x[n] = features[n]
        return trust(&self.law, x, difference_nm)


# Trust in a fused network ---------------------------------------------------------------------------------------------


cdef int fill_fused_trust(FusedTrustLaw *law, envelope) except -1:
    """Set the parameters from a network's envelope."""
    rows = envelope.known
    if max(len(rows), len(rows[0])) > MAX_CELLS:
        raise ValueError(f"found a map of {len(rows)} by {len(rows[0])} cells, expected at most {MAX_CELLS} each")
    law.inverse_velocity = 1.0 / envelope.velocity_step_rad_s
    law.inverse_torque = 1.0 / envelope.torque_step_nm
    # a frame of zeros: the interpolation needs no border, and beyond the map nothing is known
    memset(law.known, 0, sizeof(law.known))
    for m, row in enumerate(rows):
        for n, cell in enumerate(row):
            law.known[m + 1][n + 1] = cell
    law.velocity_last = len(rows) + 1
    law.torque_last = len(rows[0]) + 1
    law.velocity_0 = law.velocity_last / 2.0
    law.torque_0 = law.torque_last / 2.0
    law.distance = envelope.distance_nm
    law.inverse_fade = 1.0 / (DISTANCE_MARGIN * envelope.distance_nm)
    law.with_temperature = envelope.temperature_c is not None
    law.low, law.high = envelope.temperature_c or (0.0, 0.0)
    law.load = INFINITY if envelope.load_nm is None else envelope.load_nm
    return 0


cdef double fused_trust(const FusedTrustLaw *law, double v, double raw, double distance, double temperature) noexcept nogil:
    """Return the weight; a temperature of NaN is unknown, hence 0 where the data had one.

    raw: motor torque; distance: torsion less current path; finite both, as is the velocity.
    """
    cdef double x = v * law.inverse_velocity + law.velocity_0
    cdef double y = raw * law.inverse_torque + law.torque_0
    cdef double a, b, weight
    cdef int m, n
    if not (0.0 <= x < law.velocity_last and 0.0 <= y < law.torque_last):
        return 0.0
    m, n = <int>x, <int>y
    x -= m
    y -= n
    a = law.known[m][n] + y * (<double>law.known[m][n + 1] - law.known[m][n])
    b = law.known[m + 1][n] + y * (<double>law.known[m + 1][n + 1] - law.known[m + 1][n])
    weight = a + x * (b - a)
    if fabs(distance) > law.distance:
        weight *= fmax(0.0, 1.0 - (fabs(distance) - law.distance) * law.inverse_fade)
    if not law.with_temperature or law.low <= temperature <= law.high:
        return weight
    if isnan(temperature):
        return 0.0
    return weight * fmax(0.0, 1.0 - fmax(law.low - temperature, temperature - law.high) * PER_KELVIN)


cdef class FusedTrust:
    """Weight of a fused network in [0, 1], continuous in all arguments.

    A box per feature would count fast and heavy as known when the data has only fast or heavy. So the weight is a table
    over (v, tau_raw), 1 in cells that several training runs have visited and 0 in others, bilinear between cell centres;
    times 1 inside the training range of temperature and of the distance between torsion and current, falling to 0 beside
    it.
    """

    def __init__(self, envelope):
        fill_fused_trust(&self.law, envelope)

    def weight(self, double velocity_rad_s, double raw_nm, double distance_nm, double temperature_c):
        """Return the weight; a temperature of NaN is unknown, hence 0 where the data had one.

        raw_nm: motor torque; distance_nm: torsion less current path; finite both, as is the velocity.
        """
        return fused_trust(&self.law, velocity_rad_s, raw_nm, distance_nm, temperature_c)

    def weigh_map(self, velocity_rad_s, raw_nm):
        """Return the weights [n] by speed and motor torque alone."""
        cdef const double[::1] v = np.ascontiguousarray(velocity_rad_s, np.float64)
        cdef const double[::1] raw = np.ascontiguousarray(raw_nm, np.float64)
        cdef FusedTrustLaw law = self.law
        law.with_temperature = False
        out = np.empty(len(v))
        cdef double[::1] to = out
        cdef Py_ssize_t k
        for k in range(v.shape[0]):
            to[k] = fused_trust(&law, v[k], raw[k], 0.0, NAN)
        return out
