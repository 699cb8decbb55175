"""How far an estimate can be trusted: standard deviations, standstill, and where a network was trained.

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

from jtqd.estimator.envelope import MAX_CELLS

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
