"""Uncertainty of an estimate: fusion of both torque paths, standard deviations, weights of the networks.

**Fusion** of two independent measurements of one torque by their variances, motor current less loss and torsion:

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

A disagreement of the paths widens sigma by max(alpha, 1 - alpha) (|tau_t - tau_c| - DISAGREE_SIGMAS sqrt(s_c^2 + s_t^2)),
where that is above 0: which path is wrong is not known, so the worse case counts.

**Standard deviation** of the paper's methods in motion and at standstill: u_f, u_l, floor from the settings,

    moving        sigma^2 = load^2 + (u_f tau_f(v))^2 + floor^2
                  load: the efficiency table's RMSE as a torque; for the classical observer u_l |tau_raw|
    standstill    tau_j in [tau_raw - loss(+), tau_raw - loss(-)]
                  value: the middle; sigma: half the width, wider by u_f, + floor

**Weight of a network**, 1 where it alone counts and 0 where only physics does, continuous in all arguments:

    network       1 inside the training range of every feature and near physics, 0 at a margin beside a range, or at the limit
                  of the distance to physics
    fused         a table over (v, tau_raw), 1 in cells that several training runs have visited and 0 in others, bilinear
                  between cell centres (a range per feature would count fast and heavy as known when the data has only fast or
                  heavy); times 1 inside the training range of temperature and of |tau_t - tau_c|, falling to 0 beside it
"""

from libc.math cimport INFINITY, NAN, fabs, fmax, fmin, isnan, sqrt
from libc.string cimport memset

from jtqd.estimator.losses cimport (
    EfficiencyLaw,
    Interval,
    efficiency_rmse,
    efficiency_standstill,
    friction_torque,
)

from typing import Final, NamedTuple

import numpy as np

from jtqd.estimator.joint import MAX_CELLS

if MAX_CELLS + 2 > MOST_CELLS:
    raise ImportError(f"{MAX_CELLS} cells may be in an envelope, the compiled map has room for {MOST_CELLS - 2}")

SLOW_RAD_S: Final = 0.05
FAST_RAD_S: Final = 0.2
"""The fused network fades in between these speeds: at lower ones a wave of the motor angle looks like an offset."""

HOLD_S: Final = 0.05
"""Time constant with which the friction interval is forgotten after a reversal."""

DISAGREE_SIGMAS: Final = 3.0
"""Distance of the two paths in its own standard deviations up to which it is noise."""

FOREIGN_SIGMAS: Final = 4.0
"""Distance from which the status is lowered: at least one of the paths contradicts the joint file."""

GAUSS: Final = 1.6448536269514722
"""Half width of a normal distribution's 90 % interval in standard deviations: the interval is value +- GAUSS sigma."""

LEAST_TORSION: Final = 0.05
"""Part of the torsion's variance that remains, however well its offset is known."""

FADE_START: Final = 0.75
"""Part of the network's limit from which it fades into physics; at the limit only physics is used."""

TEMPERATURE_MARGIN_K: Final = 1.0
"""Distance to the range of temperatures over which the weight falls to 0."""

DISTANCE_MARGIN: Final = 0.25
"""The same of the distance between torsion and current, as a part of its range."""

cdef double SLOW = SLOW_RAD_S, FAST = FAST_RAD_S, HOLD = HOLD_S
cdef double DISAGREE = DISAGREE_SIGMAS, INTERVAL = 1.0 / GAUSS
cdef double LEAST = LEAST_TORSION
cdef double INVERSE_RANGE = 1.0 / (FAST_RAD_S - SLOW_RAD_S)
cdef double PER_KELVIN = 1.0 / TEMPERATURE_MARGIN_K


# Fusion ---------------------------------------------------------------------------------------------------------------


cdef double network_share(double v) noexcept nogil:
    """Return the fused network's share at this speed, 0 to 1."""
    cdef double a = fabs(v)
    if a >= FAST:
        return 1.0
    return (a - SLOW) * INVERSE_RANGE if a > SLOW else 0.0


def network_shares(velocity_rad_s):
    """Return the fused network's shares at these speeds [n], 0 to 1."""
    cdef const double[::1] v = np.ascontiguousarray(velocity_rad_s, np.float64)
    out = np.empty(len(v))
    cdef double[::1] to = out
    cdef Py_ssize_t k
    for k in range(v.shape[0]):
        to[k] = network_share(v[k])
    return out


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


cdef void reweigh(Fused *fused, double known) noexcept nogil:
    """Weigh with a torsion whose variance is less by `known` [Nm^2]; `variance` stays that of the file. For a reference of 0."""
    cdef double c = fused.alpha * fused.variance, t = fused.variance - c, alpha
    t = fmax(t - known, LEAST * t)
    alpha = c / (c + t)
    fused.value += (alpha - fused.alpha) * fused.difference
    fused.alpha, fused.sigma = alpha, sqrt(alpha * t)


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


cdef double disagreement(const Fused *fused, double uncorrected_nm) noexcept nogil:
    """Return what a disagreement of the paths adds to sigma [Nm]; uncorrected_nm: known offset that is not corrected yet.

    Both are errors of a known size, not of a known variance: the 90 % interval, not sigma, is to hold them.
    """
    cdef double more = fabs(fused.difference) - DISAGREE * sqrt(fused.variance)
    cdef double offset = fused.alpha * uncorrected_nm
    if more > 0.0:
        more *= fmax(fused.alpha, 1.0 - fused.alpha)
        return INTERVAL * sqrt(more * more + offset * offset)
    return INTERVAL * offset


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
                reweigh(&fused, x[6, k])
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


# Standard deviation of the paper's methods ----------------------------------------------------------------------------


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
    """Return sigma of a moving joint; i: current without acceleration, tau_raw/(G Kt)."""
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


# Weight of the paper's network ---------------------------------------------------------------------------------------


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


def network_weights(low, high, double margin, double limit_nm, features, difference_nm):
    """Return the weights [n] of the paper's network for features [n, 6] and network minus physics [n] (NaN gives 0).

    low, high: training range per feature; margin: part of the span beside a range over which the weight falls to 0; limit_nm:
    largest |network - physics|, the weight falls from FADE_START of it.
    """
    cdef const double[:, ::1] x = np.ascontiguousarray(features, np.float64)
    cdef const double[::1] difference = np.ascontiguousarray(difference_nm, np.float64)
    cdef TrustLaw law
    fill_trust(&law, low, high, margin, limit_nm)
    return np.array([trust(&law, &x[k, 0], difference[k]) for k in range(x.shape[0])])


# Weight of a fused network -------------------------------------------------------------------------------------------


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
    """Return the weight; raw: motor torque; distance: torsion less current path; as `envelope_weights`."""
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


def envelope_weights(envelope, velocity_rad_s, raw_nm, distance_nm=0.0, temperature_c=None):
    """Return the weights [n] in an envelope, by velocity, motor torque, torsion less current path and temperature, arrays [n].

    temperature_c: None: not looked at; NaN: not known, hence 0 where the data had one. The others must be finite.
    """
    columns = (velocity_rad_s, raw_nm, distance_nm, NAN if temperature_c is None else temperature_c)
    cdef const double[:, ::1] x = np.ascontiguousarray(np.broadcast_arrays(*columns), np.float64)
    cdef FusedTrustLaw law
    fill_fused_trust(&law, envelope)
    if temperature_c is None:
        law.with_temperature = False
    return np.array([fused_trust(&law, x[0, k], x[1, k], x[2, k], x[3, k]) for k in range(x.shape[1])])
