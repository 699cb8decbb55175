"""Torque observers in exact discrete form: the paper's (Eqs. 4 and 7), the one of method `fused`, and the guard of both.

Symbols: i current [A], w motor velocity [rad/s], Kt torque constant, J rotor inertia (motor side), G gear ratio,
g bandwidth [rad/s], theta_m and theta_l motor and link position [rad].

    tau_raw = [ g/(s+g) (i Kt + J g w) - J g w ] G            = G LPF(i Kt - J dw/dt), without any loss
    v       = g/(s+g) w/G                                     velocity, delayed like tau_raw

Discretisation: z' = g (u - z) is integrated exactly for an input that is linear between samples (first-order hold),
with the measured step dt:

    z_k = a z_(k-1) + b0 u_k + b1 u_(k-1),   a = exp(-g dt),  b0 = 1 - (1-a)/(g dt),  b1 = (1-a)/(g dt) - a

The state starts at the first input, so a joint at rest or at constant speed has no start transient. A ramp is followed
with a lag of exactly 1/g: the group delay at DC (5 ms at 200 rad/s).

The link velocity is the derivative of the link position through p/(s+p), exact for a position that is linear between
samples: r_k = exp(-p dt) r_(k-1) + (1 - exp(-p dt)) (q_k - q_(k-1))/dt.

The guard decides on starts, gaps, values that are not finite, and standstill, sample by sample:

| sample | status and effect |
|---|---|
| not finite | INVALID, restart at the next good sample |
| the first, dt <= 0, dt too long | STARTING: the observer starts at this sample, nothing is published |
| implausible motor torque or speed | INVALID and restart: one absurd sample must not decay into the next |
| abs(v) below the threshold | STANDSTILL, until it is above twice the threshold |
| else | VALID |
"""

from libc.math cimport INFINITY, NAN, copysign, cos, expm1, fabs, fmax, fmin, isfinite, isinf, sin

from jtqd.estimator.losses cimport FrictionModel, direction_of, friction_torque

from typing import Final

import numpy as np

from jtqd.estimator import status as st
from jtqd.estimator.settings import tracking_of

RAW_LIMIT: Final = 10.0
"""Largest |tau_raw| in rated torques: more than the motor can give and friction can hide."""

LINK_SPEED_LIMIT_RAD_S: Final = 1e3
"""Largest plausible speed of a joint-side encoder."""

RIPPLE_ORDERS: Final = (2, 4)
"""Per motor revolution: twice the wave generator's turn, and its first harmonic."""

cdef double LINK_SPEED_LIMIT = LINK_SPEED_LIMIT_RAD_S
cdef int STARTING = st.STARTING, VALID = st.VALID, STANDSTILL = st.STANDSTILL, INVALID = st.INVALID


def columns(*arrays):
    """Return columns of a run as one array [columns, n], None as NaN; ValueError for different lengths."""
    given = [np.asarray(each, np.float64) for each in arrays if each is not None]
    if len({each.shape for each in given}) != 1 or given[0].ndim != 1:
        raise ValueError(f"found arrays of shapes {[each.shape for each in given]}, expected all of one length")
    laid = np.full((len(arrays), len(given[0])), NAN)
    for k, each in enumerate(arrays):
        if each is not None:
            laid[k] = each
    return laid


# First-order hold -----------------------------------------------------------------------------------------------------

def low_pass(values, dt_s, double bandwidth_rad_s):
    """Return values [n] through g/(s+g), exact for values linear between samples.

    dt_s [n], dt_s[k] the step that ends at sample k (dt_s[0] is not used); a step <= 0 passes its sample on unfiltered.
    """
    out = np.array(values, np.float64)
    cdef const double[::1] x = np.array(values, np.float64)
    cdef const double[::1] dt = np.ascontiguousarray(dt_s, np.float64)
    cdef double[::1] z = out
    cdef Hold h
    cdef Py_ssize_t k
    if x.shape[0] != dt.shape[0]:
        raise ValueError(f"found {x.shape[0]} values and {dt.shape[0]} steps, expected as many")
    for k in range(1, x.shape[0]):
        if dt[k] > 0.0:
            h = hold(bandwidth_rad_s, dt[k])
            z[k] = filtered(&h, z[k - 1], x[k], x[k - 1])
    return out


# Reference torque of a sensor ----------------------------------------------------------------------------------------

cdef double SETTLED = 5.0  # in 1/g: exp(-5) of the start remains


cdef void restart_reference(Reference *r) noexcept nogil:
    r.since = INFINITY
    r.last = r.z = r.settled = 0.0


cdef double follow_reference(Reference *r, double rate, double max_gap, double dt, double now) noexcept nogil:
    """Return a sensor's value, dt after the last sample, delayed like an estimate of this bandwidth; NaN where unknown.

    A missing value (NaN) is bridged by a straight line, up to max_gap. After a longer gap, at the first value, and after a
    step <= 0 it restarts, and is unknown until 5/g later.
    """
    cdef Hold h
    r.since = r.since + dt if dt > 0.0 else INFINITY
    if now != now:
        return NAN
    if r.since <= max_gap:
        h = hold(rate, r.since)
        r.z = filtered(&h, r.z, now, r.last)
        r.settled += r.since
    else:
        r.z, r.settled = now, 0.0
    r.last, r.since = now, 0.0
    return r.z if r.settled * rate >= SETTLED else NAN


def reference_of(sensor_nm, dt_s, double bandwidth_rad_s, double max_gap_s=0.05):
    """Return a sensor's torque [n] delayed like estimates of this bandwidth, as the loop forms it; NaN where unknown.

    dt_s [n]: as given to the estimator, since the last sample with inputs; NaN at samples without inputs, which are
    skipped. Raises ValueError for arrays of different length.
    """
    cdef const double[::1] x = np.ascontiguousarray(sensor_nm, np.float64)
    cdef const double[::1] dt = np.ascontiguousarray(dt_s, np.float64)
    out = np.full(len(sensor_nm), NAN)
    cdef double[::1] to = out
    cdef Reference r
    cdef Py_ssize_t k
    if x.shape[0] != dt.shape[0]:
        raise ValueError(f"found {x.shape[0]} values and {dt.shape[0]} steps, expected as many")
    restart_reference(&r)
    for k in range(x.shape[0]):
        if dt[k] == dt[k]:
            to[k] = follow_reference(&r, bandwidth_rad_s, max_gap_s, dt[k], x[k])
    return out


# The paper's observer -------------------------------------------------------------------------------------------------

cdef void _start(const ObserverLaw *law, ObserverState *s, const Sample *x, Observed *out) noexcept nogil:
    """Set the states of a joint in steady motion at this speed."""
    cdef double spin = law.inertia_rate * x.motor_velocity_rad_s
    s.u = s.z = x.current_a * law.kt + spin
    s.v = s.z_v = x.motor_velocity_rad_s * law.inverse_gear
    s.friction = s.z_friction = friction_torque(&law.friction, s.v)
    s.link = x.link_position_rad
    s.link_velocity = s.v
    out.raw_nm = (s.z - spin) * law.gear
    out.tob_nm = out.raw_nm - s.z_friction
    out.joint_velocity_rad_s = out.link_velocity_rad_s = s.v


cdef void _step(const ObserverLaw *law, ObserverState *s, const Sample *x, Observed *out) noexcept nogil:
    cdef Hold h = hold(law.rate, x.dt_s)
    cdef double spin = law.inertia_rate * x.motor_velocity_rad_s
    cdef double u = x.current_a * law.kt + spin
    cdef double v = x.motor_velocity_rad_s * law.inverse_gear
    cdef double friction = friction_torque(&law.friction, v)
    s.z = filtered(&h, s.z, u, s.u)
    s.z_v = filtered(&h, s.z_v, v, s.v)
    s.z_friction = filtered(&h, s.z_friction, friction, s.friction)
    s.u, s.v, s.friction = u, v, friction
    cdef double decay = h.decay if law.link_rate == law.rate else -expm1(-law.link_rate * x.dt_s)
    s.link_velocity += decay * ((x.link_position_rad - s.link) / x.dt_s - s.link_velocity)
    s.link = x.link_position_rad
    out.raw_nm = (s.z - spin) * law.gear
    out.tob_nm = out.raw_nm - s.z_friction
    out.joint_velocity_rad_s = s.z_v
    out.link_velocity_rad_s = s.link_velocity


cdef int fill_observer(ObserverLaw *law, joint, settings) except -1:
    law.gear = joint.gear_ratio
    law.inverse_gear = 1.0 / joint.gear_ratio
    law.kt = joint.torque_constant_nm_per_a
    law.inertia_rate = joint.rotor_inertia_kgm2 * settings.bandwidth_rad_s
    law.rate, law.link_rate = settings.bandwidth_rad_s, settings.link_bandwidth_rad_s
    law.friction = (<FrictionModel>FrictionModel(joint.friction)).law
    return 0


# The observer of method fused -----------------------------------------------------------------------------------------
#
#     d       = g/(s+g) (theta_m/G - theta_l - zero - e(theta_m))          e: kinematic error
#     tau_t   = K d + K3 d^3 + D d' + H z,   z = (lo + hi)/2,   open = H (hi - lo)/2      and more slips, a spring that
#                                                                                         hardens: joint.Torsion
#     dlo = dhi = dd/travel, each limited to [-1, 1]       Maxwell slip, between bounds: -1 and 1 at each start
#     c_n, s_n = g/(s+g) cos(n theta_m), g/(s+g) sin(n theta_m)     n = RIPPLE_ORDERS
#     direction = g/(s+g) tanh(w/(G w0))                   of friction, delayed like tau_raw
#
# All pass the same filter. A torque ripple A cos(n theta_m + phi) therefore reaches tau_raw exactly linear in c_n and s_n
# at every speed, and friction that changes sign with the motion is linear in `direction`, however fast the reversal. The
# slip follows the filtered deflection: an element that slips would rectify the encoder's noise. Its state at the start is
# unknown: its bounds meet after twice its travel in one direction, and until then `open` is what it may carry to either
# side of the middle.
#
# With a bandwidth g_t of its own the torsion, spring and slip included, is formed from the deflection through
# g_t/(s+g_t). `torsion_nm` is then that torque through [g/(s+g)]/[g_t/(s+g_t)], delayed by 1/g like all other outputs, and
# `ahead_nm` the torque delayed by 1/g_t less it. With the torsion tracked, deflection and d' are those of a filter without
# delay (`tracked`), and `torsion_nm` is that torque through g/(s+g).


cdef double _sum_of_waves(const Wave *wave, int count, double angle) noexcept nogil:
    """Return the sum of waves over an angle [rad]: kinematic error of orders other than RIPPLE_ORDERS, error of the link encoder."""
    cdef double error = 0.0, a
    cdef int n
    for n in range(count):
        a = wave[n].order * angle
        if isinf(a):
            return NAN
        error += wave[n].cos * cos(a) + wave[n].sin * sin(a)
    return error


cdef Inputs _inputs(const FusedObserverLaw *law, const Sample *x) noexcept nogil:
    """Return the inputs of the filter at a sample."""
    cdef Inputs to
    cdef double c = cos(x.motor_position_rad)  # of the angle itself: a multiple of a finite angle need not be finite
    cdef double s = sin(x.motor_position_rad)
    to.cos1, to.sin1 = c, s
    to.cos2 = c * c - s * s
    to.sin2 = 2.0 * c * s
    to.cos4 = to.cos2 * to.cos2 - to.sin2 * to.sin2
    to.sin4 = 2.0 * to.cos2 * to.sin2
    to.d = (
        x.motor_position_rad * law.inverse_gear
        - x.link_position_rad
        - law.zero
        - law.two.cos * to.cos2
        - law.two.sin * to.sin2
        - law.four.cos * to.cos4
        - law.four.sin * to.sin4
    )
    if law.others:
        to.d -= _sum_of_waves(law.other, law.others, x.motor_position_rad)
    if law.link_waves:
        to.d -= _sum_of_waves(law.link_wave, law.link_waves, x.link_position_rad)
    to.u = x.current_a * law.kt + law.inertia_rate * x.motor_velocity_rad_s
    to.v = x.motor_velocity_rad_s * law.inverse_gear
    to.direction = direction_of(to.v)
    return to


cdef double FADE_S = 0.2  # the wave of the tracking filter is forgotten within it; chosen with its rates, docs/estimator.md
cdef int WAVE_ORDER = RIPPLE_ORDERS[0]


cdef void _start_track(TorsionTrack *t, double ramp, double d) noexcept nogil:
    """Set the filter to one reading of a constant torsion."""
    t.level = d
    t.rate = t.wave = t.quarter = 0.0
    t.p00 = t.p22 = t.p33 = 1.0
    t.p11 = ramp * ramp
    t.p01 = t.p02 = t.p03 = t.p12 = t.p13 = t.p23 = 0.0


cdef inline double _track(
    TorsionTrack *t, double ramp, double wave, double dt, double c, double s, double d
) noexcept nogil:
    """Take a deflection d as read, dt after the last; return it without noise.

    Kalman filter of a level with a rate and of a wave over the motor's angle, whose phase moved by atan2(s, c) in this step;
    the rate of the level and the wave are random walks, the wave fades within FADE_S (bounded at rest, where wave
    and level look alike). Only ratios of variances count: noise of a reading 1, of the rate (ramp dt)^4/dt^2, of the wave
    (wave dt)^2 a step, so `ramp` and `wave` are about the rates [rad/s] at which it follows them.
    """
    cdef double g = FADE_S / (FADE_S + dt)
    cdef double x = ramp * dt, y = wave * dt
    cdef double a, b, h0, h1, h2, h3, e
    c *= g
    s *= g
    # prediction: state, then covariance, blocks (level, rate), cross, (wave, quarter)
    t.level += dt * t.rate
    a = t.wave
    t.wave = c * a - s * t.quarter
    t.quarter = s * a + c * t.quarter
    t.p00 += dt * (2.0 * t.p01 + dt * t.p11)
    t.p01 += dt * t.p11
    t.p11 += x * x * ramp * ramp
    a, b = t.p02 + dt * t.p12, t.p03 + dt * t.p13
    t.p02, t.p03 = c * a - s * b, s * a + c * b
    a, b = t.p12, t.p13
    t.p12, t.p13 = c * a - s * b, s * a + c * b
    a, b, e = t.p22, t.p23, t.p33
    h0 = 2.0 * c * s * b
    t.p22 = c * c * a - h0 + s * s * e + y * y
    t.p33 = s * s * a + h0 + c * c * e + y * y
    t.p23 = c * s * (a - e) + (c * c - s * s) * b
    # update by the reading
    h0, h1, h2, h3 = t.p00 + t.p02, t.p01 + t.p12, t.p02 + t.p22, t.p03 + t.p23
    a = 1.0 / (h0 + h2 + 1.0)
    e = (d - t.level - t.wave) * a
    t.level += h0 * e
    t.rate += h1 * e
    t.wave += h2 * e
    t.quarter += h3 * e
    b = a * h0
    t.p00 -= b * h0
    t.p01 -= b * h1
    t.p02 -= b * h2
    t.p03 -= b * h3
    b = a * h1
    t.p11 -= b * h1
    t.p12 -= b * h2
    t.p13 -= b * h3
    b = a * h2
    t.p22 -= b * h2
    t.p23 -= b * h3
    t.p33 -= a * h3 * h3
    return t.level + t.wave


cdef inline double _track_rate(const TorsionTrack *t, double motor_velocity) noexcept nogil:
    """Return the rate [rad/s] of the filtered deflection; motor_velocity [rad/s] turns the wave."""
    return t.rate - WAVE_ORDER * motor_velocity * t.quarter


def tracked(
    deflection_rad, motor_position_rad, motor_velocity_rad_s, dt_s, double rate_rad_s, double wave_rad_s, max_gap_s=0.05
):
    """Return (deflection [n], rate [n]) of torsion angles as read [n], through the tracking filter.

    dt_s [n]: step that ends at the sample; after one <= 0 or longer than max_gap_s the filter restarts.
    Raises ValueError for arrays of different length.
    """
    rows = [np.asarray(each, np.float64) for each in (deflection_rad, motor_position_rad, motor_velocity_rad_s, dt_s)]
    if len({len(each) for each in rows}) != 1:
        found = ", ".join(str(len(each)) for each in rows)
        raise ValueError(f"found {found} deflections, positions, velocities and steps, expected as many")
    d, rate = rows[0].copy(), np.zeros(len(rows[0]))
    angle = WAVE_ORDER * rows[1]
    cdef const double[::1] x = np.ascontiguousarray(rows[0])
    cdef const double[::1] c = np.cos(angle)
    cdef const double[::1] s = np.sin(angle)
    cdef const double[::1] w = np.ascontiguousarray(rows[2])
    cdef const double[::1] dt = np.ascontiguousarray(rows[3])
    cdef double[::1] to = d
    cdef double[::1] v = rate
    cdef double gap = max_gap_s
    cdef TorsionTrack t
    cdef Py_ssize_t k
    for k in range(x.shape[0]):
        if k > 0 and 0.0 < dt[k] <= gap:
            to[k] = _track(
                &t, rate_rad_s, wave_rad_s, dt[k], c[k] * c[k - 1] + s[k] * s[k - 1], s[k] * c[k - 1] - c[k] * s[k - 1], x[k]
            )
            v[k] = _track_rate(&t, w[k])
        else:
            _start_track(&t, rate_rad_s, x[k])
    return d, rate


cdef void _torsion(
    const FusedObserverLaw *law, FusedObserverState *s, double d, double damped_nm, FusedObserved *out
) noexcept nogil:
    """Move the slip to the filtered deflection d [rad] and set the torsion's outputs there; damped_nm: D d'."""
    cdef double step = d - s.d, size = fabs(d), beyond = 0.0
    cdef int k
    s.d = d
    out.torsion_nm = d * (law.stiffness + law.cubic * d * d) + damped_nm
    for k in range(law.hardenings):
        beyond += law.hardening[k].stiffness * fmax(size - law.hardening[k].deflection, 0.0)
    if law.hardenings:
        out.torsion_nm += copysign(beyond, d)
    out.open_nm = 0.0
    for k in range(law.slips):
        _slip(&law.slip[k], &s.bounds[k], step, out)


cdef void _delay_torsion(const FusedObserverLaw *law, FusedObserverState *s, const Hold *h, FusedObserved *out) noexcept nogil:
    """Delay the torsion like the motor path, and set by how much the less delayed one is ahead of it.

    g/(s+g) over g_t/(s+g_t) is r + (1 - r) g/(s+g) with r = g/g_t: linear in the torque, whatever the spring. The torsion that is
    tracked has no delay: r = 0.
    """
    cdef double early = out.torsion_nm
    s.torsion_z = filtered(h, s.torsion_z, early, s.torsion)
    s.torsion = early
    out.torsion_nm = s.torsion_z + law.torsion_share * (early - s.torsion_z)
    out.ahead_nm = early - out.torsion_nm


cdef void _slip(const Slip *law, Bounds *z, double step, FusedObserved *out) noexcept nogil:
    """Move a slip by a step of the deflection [rad]; add its torque, and half the width of its bounds."""
    step *= law.inverse_travel
    z.low += step
    z.high += step
    if z.high > 1.0:
        z.high = 1.0
        z.low = fmin(z.low, 1.0)
    elif z.low < -1.0:
        z.low = -1.0
        z.high = fmax(z.high, -1.0)
    out.torsion_nm += law.half_nm * (z.low + z.high)
    out.open_nm += law.half_nm * (z.high - z.low)


def slipped(d_rad, double travel_rad):
    """Return z [n] of a Maxwell-slip element that follows d [n], and half the width [n] of its bounds.

    Its start is unknown: z is the middle of its bounds, -1 and 1 at first and after each NaN, where z is 0.
    """
    cdef const double[::1] d = np.ascontiguousarray(d_rad, np.float64)
    middle, width = np.zeros(len(d)), np.zeros(len(d))
    cdef double[::1] z = middle, w = width
    cdef Slip law = Slip(0.5, 1.0 / travel_rad)
    cdef Bounds bounds
    cdef FusedObserved out
    cdef double last = NAN, step
    cdef Py_ssize_t k
    for k in range(d.shape[0]):
        step = d[k] - last
        last = d[k]
        out.torsion_nm = out.open_nm = 0.0
        if step != step:  # nothing observed at this sample or the last
            bounds, step = Bounds(-1.0, 1.0), 0.0
        _slip(&law, &bounds, step, &out)
        z[k], w[k] = out.torsion_nm, out.open_nm
    return middle, width


cdef void _set_outputs(const FusedObserverLaw *law, const FusedObserverState *s, FusedObserved *out) noexcept nogil:
    out.joint_velocity_rad_s = s.z.v
    out.link_velocity_rad_s = s.link_velocity
    out.cos1, out.sin1 = s.z.cos1, s.z.sin1
    out.cos2, out.sin2, out.cos4, out.sin4 = s.z.cos2, s.z.sin2, s.z.cos4, s.z.sin4
    out.direction = s.z.direction


cdef void _start_fused(const FusedObserverLaw *law, FusedObserverState *s, const Sample *x, FusedObserved *out) noexcept nogil:
    """Set the states of a joint in steady motion at this speed with this torsion; the slip is unknown."""
    cdef int k
    for k in range(law.slips):
        s.bounds[k] = Bounds(-1.0, 1.0)
    s.last = s.z = _inputs(law, x)
    s.link = x.link_position_rad
    s.link_velocity = s.z.v
    s.d = s.z.d
    s.d_rate = 0.0
    s.d_moved = 0.0
    _start_track(&s.track, law.tracking, s.z.d)
    _torsion(law, s, s.z.d, 0.0, out)
    s.torsion = s.torsion_z = out.torsion_nm
    out.ahead_nm = 0.0
    _set_outputs(law, s, out)
    out.raw_nm = (s.z.u - law.inertia_rate * x.motor_velocity_rad_s) * law.gear


cdef void _step_fused(const FusedObserverLaw *law, FusedObserverState *s, const Sample *x, FusedObserved *out) noexcept nogil:
    cdef Hold h = hold(law.rate, x.dt_s)
    cdef Inputs now = _inputs(law, x)
    s.z.u = filtered(&h, s.z.u, now.u, s.last.u)
    s.z.v = filtered(&h, s.z.v, now.v, s.last.v)
    cdef Hold own
    cdef double damped, behind = s.last.d - s.z.d
    out.behind_rad2 = 0.0
    if law.tracking > 0.0:
        s.z.d = _track(
            &s.track,
            law.tracking,
            law.tracking_wave,
            x.dt_s,
            now.cos2 * s.last.cos2 + now.sin2 * s.last.sin2,
            now.sin2 * s.last.cos2 - now.cos2 * s.last.sin2,
            now.d,
        )
        out.behind_rad2 = behind * (now.d - s.z.d)
        s.d_rate = _track_rate(&s.track, x.motor_velocity_rad_s)
        s.d_moved = (now.d - s.last.d) / x.dt_s
        damped = law.damping * s.d_rate
    else:
        own = hold(law.torsion_rate, x.dt_s) if law.apart else h
        s.z.d = filtered(&own, s.z.d, now.d, s.last.d)
        damped = law.damping * (s.z.d - s.d) / x.dt_s
    s.z.cos1 = filtered(&h, s.z.cos1, now.cos1, s.last.cos1)
    s.z.sin1 = filtered(&h, s.z.sin1, now.sin1, s.last.sin1)
    s.z.cos2 = filtered(&h, s.z.cos2, now.cos2, s.last.cos2)
    s.z.sin2 = filtered(&h, s.z.sin2, now.sin2, s.last.sin2)
    s.z.cos4 = filtered(&h, s.z.cos4, now.cos4, s.last.cos4)
    s.z.sin4 = filtered(&h, s.z.sin4, now.sin4, s.last.sin4)
    s.z.direction = filtered(&h, s.z.direction, now.direction, s.last.direction)
    s.last = now
    cdef double decay = h.decay if law.link_rate == law.rate else -expm1(-law.link_rate * x.dt_s)
    s.link_velocity += decay * ((x.link_position_rad - s.link) / x.dt_s - s.link_velocity)
    s.link = x.link_position_rad
    _torsion(law, s, s.z.d, damped, out)
    out.ahead_nm = 0.0
    if law.apart:
        _delay_torsion(law, s, &h, out)
    _set_outputs(law, s, out)
    out.raw_nm = (s.z.u - law.inertia_rate * x.motor_velocity_rad_s) * law.gear
    if not -law.torsion_limit <= out.torsion_nm <= law.torsion_limit:  # NaN included
        out.raw_nm = NAN


cdef int fill_fused_observer(FusedObserverLaw *law, joint, torsion, settings) except -1:
    """Set the parameters; torsion: instead of the joint file's own, None: its torque is always 0."""
    cdef double bandwidth = settings.bandwidth_rad_s
    tracking = tracking_of(joint, settings)
    law.tracking = law.tracking_wave = 0.0
    if torsion is not None and tracking is not None:
        law.tracking, law.tracking_wave = tracking.rate_rad_s, tracking.wave_rad_s
    law.torsion_rate = settings.own_torsion_bandwidth_rad_s
    law.apart = torsion is not None and (law.torsion_rate != bandwidth or law.tracking > 0.0)
    law.torsion_share = 0.0 if law.tracking > 0.0 else bandwidth / law.torsion_rate
    law.gear = joint.gear_ratio
    law.inverse_gear = 1.0 / joint.gear_ratio
    law.kt = joint.torque_constant_nm_per_a
    law.inertia_rate = joint.rotor_inertia_kgm2 * bandwidth
    law.rate, law.link_rate = bandwidth, settings.link_bandwidth_rad_s
    law.torsion_limit = RAW_LIMIT * joint.rated_torque_nm
    law.stiffness = law.cubic = law.zero = law.damping = 0.0
    law.two = law.four = Wave(0.0, 0.0, 0.0)
    law.others = law.link_waves = law.hardenings = law.slips = 0
    if torsion is None:
        return 0
    law.stiffness = torsion.stiffness_nm_per_rad
    law.cubic = torsion.cubic_nm_per_rad3
    law.zero = torsion.zero_rad
    law.damping = torsion.damping_nms_per_rad
    for what, given, most in (
        ("slips", torsion.slips_nm, MOST_SLIPS - 1),
        ("hardenings of the spring", torsion.hardening_rad, MOST_HARDENINGS),
        ("orders of the link encoder's error", torsion.link_orders_per_rev, MOST_LINK_ORDERS),
        ("orders of the kinematic error", torsion.orders_per_motor_rev, MOST_NODES),
    ):
        if len(given) > most:
            raise ValueError(f"found {len(given)} {what}, expected at most {most}")
    slips = [(torsion.hysteresis_nm, torsion.hysteresis_travel_rad)] if torsion.hysteresis_nm else []
    for torque, travel in slips + list(zip(torsion.slips_nm, torsion.slips_travel_rad, strict=True)):
        law.slip[law.slips] = Slip(0.5 * torque, 1.0 / travel)
        law.slips += 1
    for deflection, stiffness in zip(torsion.hardening_rad, torsion.hardening_nm_per_rad, strict=True):
        law.hardening[law.hardenings] = Hardening(deflection, stiffness)
        law.hardenings += 1
    for order, c, s in zip(torsion.link_orders_per_rev, torsion.link_cos_rad, torsion.link_sin_rad, strict=True):
        law.link_wave[law.link_waves] = Wave(order, c, s)
        law.link_waves += 1
    for order, c, s in zip(torsion.orders_per_motor_rev, torsion.cos_rad, torsion.sin_rad, strict=True):
        if order == RIPPLE_ORDERS[0]:
            law.two = Wave(order, law.two.cos + c, law.two.sin + s)
        elif order == RIPPLE_ORDERS[1]:
            law.four = Wave(order, law.four.cos + c, law.four.sin + s)
        else:
            law.other[law.others] = Wave(order, c, s)
            law.others += 1
    return 0


# Guard ----------------------------------------------------------------------------------------------------------------

cdef int fill_guard(GuardLaw *law, joint, settings) except -1:
    law.max_gap = settings.max_gap_s
    law.stop = settings.standstill_velocity_rad_s
    law.leave = 2.0 * settings.standstill_velocity_rad_s
    law.raw_limit = RAW_LIMIT * joint.rated_torque_nm
    return 0


cdef void restart_guard(GuardState *g) noexcept nogil:
    g.running = g.standing = False
    g.status = STARTING


cdef bint _garbage(GuardState *g, const Sample *x) noexcept nogil:
    """Return whether a sample is not finite; the observer then restarts at the next good one."""
    if isfinite(x.current_a + x.motor_position_rad + x.motor_velocity_rad_s + x.link_position_rad):
        return False
    g.running = False
    g.status = INVALID
    return True


cdef bint _starts(const GuardLaw *law, const GuardState *g, const Sample *x) noexcept nogil:
    return not g.running or not 0.0 < x.dt_s <= law.max_gap


cdef void _mark_started(const GuardLaw *law, GuardState *g, double v) noexcept nogil:
    g.running = True
    g.standing = fabs(v) < law.stop
    g.status = STARTING


cdef bint _judge(const GuardLaw *law, GuardState *g, double raw, double v, double link_velocity) noexcept nogil:
    """Set the status of an observed sample; False when it is implausible."""
    # written so that NaN fails too
    if not (-law.raw_limit <= raw <= law.raw_limit and -LINK_SPEED_LIMIT <= link_velocity <= LINK_SPEED_LIMIT):
        g.running = False
        g.status = INVALID
        return False
    if -law.leave <= v <= law.leave:
        if -law.stop < v < law.stop:
            g.standing = True
    else:
        g.standing = False
    g.status = STANDSTILL if g.standing else VALID
    return True


cdef bint observe(
    const GuardLaw *guard, GuardState *g, const ObserverLaw *law, ObserverState *s, const Sample *x, Observed *out
) noexcept nogil:
    """Take a sample; False: no output, and the guard's status is STARTING or INVALID."""
    if _garbage(g, x):
        return False
    if _starts(guard, g, x):
        _start(law, s, x, out)
        _mark_started(guard, g, out.joint_velocity_rad_s)
        return False
    _step(law, s, x, out)
    return _judge(guard, g, out.raw_nm, out.joint_velocity_rad_s, out.link_velocity_rad_s)


cdef bint observe_fused(
    const GuardLaw *guard, GuardState *g, const FusedObserverLaw *law, FusedObserverState *s, const Sample *x,
    FusedObserved *out
) noexcept nogil:
    """Take a sample as `observe`."""
    if _garbage(g, x):
        return False
    if _starts(guard, g, x):
        _start_fused(law, s, x, out)
        _mark_started(guard, g, out.joint_velocity_rad_s)
        return False
    _step_fused(law, s, x, out)
    return _judge(guard, g, out.raw_nm, out.joint_velocity_rad_s, out.link_velocity_rad_s)
