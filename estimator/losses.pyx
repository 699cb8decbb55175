"""Loss torque of a joint [Nm, joint side]: what friction takes between motor and link, tau_j = tau_raw - loss.

tau_raw = G Kt i is the motor's torque at the joint, v = omega_m/G the velocity. Three laws, for estimator and emulated
plant alike; each opposes the motion and is continuous everywhere:

| law | depends on | used by |
|---|---|---|
| `FrictionModel` | velocity | method `tob`, and wherever the other two have no data |
| `LossModel` | current and velocity: the four-quadrant efficiency of the paper's Eq. (8) | `efficiency`, `network` |
| `AdditiveLossModel` | load, velocity, direction, temperature | `fused` |

The functions on parameter blocks are what runs in a cycle; the classes give them to Python, for one value or (suffix
_many) for arrays of any shape. numpy is loaded where an array comes: the emulated bench has none.

**Standard deviation** of the paper's methods in motion and at standstill: u_f, u_l, floor from the settings,

    moving        sigma^2 = load^2 + (u_f tau_f(v))^2 + floor^2
                  load: the efficiency table's RMSE as a torque; for the classical observer u_l |tau_raw|
    standstill    tau_j in [tau_raw - loss(+), tau_raw - loss(-)]
                  value: the middle; sigma: half the width, wider by u_f, + floor
"""

from libc.math cimport NAN, exp, expm1, fabs, fmax, fmin, isnan, sqrt, tanh

from typing import Final

from jtqd.estimator.joint import MAX_NODES
from jtqd.estimator.settings import METHODS

if MAX_NODES > MOST_NODES:
    raise ImportError(f"{MAX_NODES} load nodes may be in a joint file, the compiled law has room for {MOST_NODES}")

DIRECTION_VELOCITY_RAD_S: Final = 0.02
"""w0: velocity of the joint side over which the direction of every loss turns.

Twice the standstill threshold: below it the direction of friction is not known anyway; above 0.1 rad/s tanh(v/w0) is +-1
to 1e-4.
"""

VELOCITY_RANGE_RAD_S: Final = (0.2, 3.0)
DRIVING_CURRENT_MAX_A: Final = 7.0
BACKDRIVING_CURRENT_MAX_A: Final = 5.0
DRIVING_ETA: Final = (0.05, 1.0)
BACKDRIVING_ETA: Final = (1.0, 4.0)
BLEND_CURRENT_A: Final = 0.35

cdef double INVERSE_W0 = 1.0 / DIRECTION_VELOCITY_RAD_S
cdef double SETTLED = 20.0 * DIRECTION_VELOCITY_RAD_S  # tanh(20) is 1 in float64
cdef double SLOWEST = VELOCITY_RANGE_RAD_S[0]
cdef double FASTEST = VELOCITY_RANGE_RAD_S[1]
cdef double INVERSE_BLEND = 1.0 / BLEND_CURRENT_A
cdef double NO_BLEND = 6.1 * BLEND_CURRENT_A  # the weight is below 1e-16 from here on
cdef double ONE_SIDED = 1.0 - 1e-9  # |s| from which the other direction no longer counts: 0.1 s after a reversal
cdef double FARTHEST = 40.0  # K; temperatures farther from the fit's count as so far: no fit reaches beyond


def static_friction(friction):
    """Return the torque [Nm, joint side] below which the joint may stand still: Fc + Fs."""
    return friction.coulomb_nm + friction.stribeck_nm


cdef double direction_of(double v) noexcept nogil:
    """Return s = tanh(v/w0), the direction of friction."""
    if v > SETTLED:
        return 1.0
    if v < -SETTLED:
        return -1.0
    return tanh(v * INVERSE_W0)


# Additive friction ----------------------------------------------------------------------------------------------------

cdef double friction_torque(const FrictionLaw *law, double v) noexcept nogil:
    """Return tau_f(v) = tanh(v/w0) (Fc + Fs exp(-(v/vs)^2)) + Fv v."""
    cdef double x = v * law.inverse_stribeck
    return direction_of(v) * (law.coulomb + law.stribeck * exp(-x * x)) + law.viscous * v


cdef class FrictionModel:
    """Additive friction: Coulomb + Stribeck + viscous, with a smooth direction; odd in v.

    tau_f(v) = tanh(v/w0) (Fc + Fs exp(-(v/vs)^2)) + Fv v
    """

    def __init__(self, friction):
        self.law.coulomb = friction.coulomb_nm
        self.law.stribeck = friction.stribeck_nm
        self.law.viscous = friction.viscous_nms_per_rad
        self.law.inverse_stribeck = 1.0 / friction.stribeck_velocity_rad_s
        self.law.static = static_friction(friction)

    def torque(self, double velocity_rad_s):
        """Return friction [Nm, joint side] at a joint-side velocity [rad/s]; its sign is the velocity's."""
        return friction_torque(&self.law, velocity_rad_s)

    def torque_many(self, velocity_rad_s):
        import numpy as np

        shape, v = _flat(velocity_rad_s)
        out = np.empty(len(v))
        cdef const double[::1] of = v
        cdef double[::1] to = out
        cdef Py_ssize_t k
        with nogil:
            for k in range(of.shape[0]):
                to[k] = friction_torque(&self.law, of[k])
        return out.reshape(shape)


# Four-quadrant efficiency ---------------------------------------------------------------------------------------------

cdef double _eta(const EfficiencyLaw *law, double i, double v) noexcept nogil:
    """Return the bounded eta = tau_j/(G Kt i) of the quadrant, whatever the file's convention."""
    cdef const Quadrant *q = &law.quadrants[2 * (v < 0.0) + (i < 0.0)]
    cdef double a = fmin(fabs(i), q.current_max)
    cdef double w = fmin(fmax(fabs(v), SLOWEST), FASTEST)
    cdef double e = q.c00 + (q.c10 + q.c20 * a + q.c11 * w) * a + (q.c01 + q.c02 * w) * w
    e = fmin(fmax(e, q.low), q.high)
    return 1.0 / e if law.reciprocal else e


cdef double efficiency_loss(const EfficiencyLaw *law, double i, double v) noexcept nogil:
    """Return the loss [Nm, joint side] with the sign of v; see `LossModel`."""
    if not law.has_efficiency:
        return friction_torque(&law.friction, v)
    cdef double a = fabs(i), w = fabs(v)
    cdef double size = law.torque_per_ampere * a * fabs(1.0 - _eta(law, i, v)) * direction_of(w)
    cdef double r
    if a < NO_BLEND:
        r = a * INVERSE_BLEND
        size += exp(-r * r) * (friction_torque(&law.friction, w) - size)
    return -size if v < 0.0 else size


cdef double efficiency_rmse(const EfficiencyLaw *law, double i, double v) noexcept nogil:
    """Return the table's RMSE as a torque [Nm]: rmse G Kt |i|, times eta^2 if it is motor over joint."""
    cdef double e, size
    if not law.has_efficiency:
        return 0.0
    size = law.quadrants[2 * (v < 0.0) + (i < 0.0)].rmse * law.torque_per_ampere * fabs(i)
    if law.reciprocal:
        e = _eta(law, i, v)
        size *= e * e
    return size


cdef Interval efficiency_standstill(const EfficiencyLaw *law, double i) noexcept nogil:
    """Return the losses [Nm] just before moving; the joint torque lies between G Kt i minus the one and the other."""
    cdef Interval loss
    cdef double static = law.friction.static, raw, r, weight
    if not law.has_efficiency:
        loss.forward, loss.backward = static, -static
        return loss
    raw = law.torque_per_ampere * fabs(i)
    r = i * INVERSE_BLEND
    weight = exp(-r * r)
    loss.forward = raw * fabs(1.0 - _eta(law, i, 0.0))
    loss.backward = raw * fabs(1.0 - _eta(law, i, -1e-300))
    loss.forward = loss.forward + weight * (static - loss.forward)
    loss.backward = -(loss.backward + weight * (static - loss.backward))
    return loss


cdef Quadrant _quadrant(p, double sign_i, double sign_v, bint reciprocal) except *:
    """Rewrite one quadrant in |i| and |v| and attach its bounds (in the polynomial's own convention)."""
    cdef Quadrant q
    driving = sign_i == sign_v
    low, high = DRIVING_ETA if driving else BACKDRIVING_ETA
    if reciprocal:
        low, high = 1.0 / high, 1.0 / low
    q.low, q.high = low, high
    q.current_max = DRIVING_CURRENT_MAX_A if driving else BACKDRIVING_CURRENT_MAX_A
    q.c00, q.c10, q.c01 = p.p00, p.p10 * sign_i, p.p01 * sign_v
    q.c20, q.c11, q.c02 = p.p20, p.p11 * sign_i * sign_v, p.p02
    q.rmse = p.rmse
    return q


cdef class LossModel:
    """Loss by the four-quadrant efficiency of Eq. (8), bounded and continuous; additive friction for a joint without.

    Inside a quadrant loss = G Kt i (1 - eta(i, v)), eta = tau_j/(G Kt i). What the paper leaves open is decided here:

    - Range. eta is evaluated at |v| in [0.2, 3] rad/s and |i| <= 7 A driving, <= 5 A back-driving (where the
      quadratics turn; beyond the measured points they rise or fall without reason). Outside, eta is held.
    - Bounds. Driving 0.05 <= eta <= 1, back-driving 1 <= eta <= 4: the loss dissipates.
    - Reversal. The loss of the side of v is scaled by |tanh(v/w0)|: continuous, zero at v = 0, and never feeding
      energy in, which a plain average of two unequal sides would.
    - Zero current. eta is 0/0 there. With weight exp(-(i/i_b)^2), i_b = 0.35 A, the loss turns into the additive
      friction: at i = 0 it is that friction, at 1 A the weight is 3e-4.
    """

    def __init__(self, joint):
        e = joint.efficiency
        self.law.torque_per_ampere = joint.gear_ratio * joint.torque_constant_nm_per_a
        self.law.friction = (<FrictionModel>FrictionModel(joint.friction)).law
        self.law.has_efficiency = e is not None
        self.law.reciprocal = e is not None and e.convention == "motor_over_joint"
        if e is not None:
            self.law.quadrants[0] = _quadrant(e.i_pos_w_pos, 1.0, 1.0, self.law.reciprocal)
            self.law.quadrants[1] = _quadrant(e.i_neg_w_pos, -1.0, 1.0, self.law.reciprocal)
            self.law.quadrants[2] = _quadrant(e.i_pos_w_neg, 1.0, -1.0, self.law.reciprocal)
            self.law.quadrants[3] = _quadrant(e.i_neg_w_neg, -1.0, -1.0, self.law.reciprocal)

    @property
    def torque_per_ampere(self):
        """G Kt [Nm/A]."""
        return self.law.torque_per_ampere

    @property
    def quadrants(self):
        """Parameters of Eq. (8) as evaluated, in |i| and |v|: c00, c10, c01, c20, c11, c02, eta low and high, |i| max, rmse.

        Four of them: i > 0, v > 0; i < 0, v > 0; i > 0, v < 0; i < 0, v < 0.
        """
        return tuple(
            (q.c00, q.c10, q.c01, q.c20, q.c11, q.c02, q.low, q.high, q.current_max, q.rmse)
            for q in self.law.quadrants
        )

    def eta(self, double current_a, double joint_velocity_rad_s):
        """Return the bounded eta = tau_j/(G Kt i) of the quadrant, whatever the file's convention.

        Raises ValueError for a joint without efficiency.
        """
        if not self.law.has_efficiency:
            raise ValueError("the joint has no efficiency")
        return _eta(&self.law, current_a, joint_velocity_rad_s)

    def loss(self, double current_a, double joint_velocity_rad_s):
        """Return the loss [Nm, joint side] with the sign of v; current [A], joint-side velocity [rad/s]."""
        return efficiency_loss(&self.law, current_a, joint_velocity_rad_s)

    def loss_many(self, current_a, joint_velocity_rad_s):
        import numpy as np

        current_a, joint_velocity_rad_s = np.broadcast_arrays(current_a, joint_velocity_rad_s)
        shape, i = _flat(current_a)
        _, v = _flat(joint_velocity_rad_s)
        out = np.empty(len(i))
        cdef const double[::1] currents = i
        cdef const double[::1] velocities = v
        cdef double[::1] to = out
        cdef Py_ssize_t k
        with nogil:
            for k in range(to.shape[0]):
                to[k] = efficiency_loss(&self.law, currents[k], velocities[k])
        return out.reshape(shape)



# Standard deviation of the paper's methods -----------------------------------------------------------------------------

cdef int fill_uncertainty(UncertaintyLaw *law, joint, settings) except -1:
    law.floor = settings.sigma_floor * joint.rated_torque_nm
    law.u_friction = settings.friction_uncertainty
    # what friction can hold is itself known to that part only
    law.widened = 1.0 + settings.friction_uncertainty
    law.load = settings.load_uncertainty
    # without an efficiency the physics is the classical observer's whatever the method
    law.with_efficiency = "efficiency" in METHODS[settings.method].sections and joint.efficiency is not None
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


# Loss by load, speed, direction and temperature -----------------------------------------------------------------------

cdef double _side(const AdditiveLaw *law, const SideLaw *side, double load, double a, double stribeck, double thermal) noexcept nogil:
    """Return L_d [Nm] of one direction; stribeck: exp(-(a/vs)^2); thermal: h(T) [Nms/rad]."""
    cdef int n = 0
    while n < law.nodes and law.node[n] <= load:
        n += 1
    cdef const LoadRow *row = &side.rows[n]
    cdef double x = load - row.node
    cdef double loss = (
        row.c
        + row.dc * x
        + side.stribeck * stribeck
        + a * (row.f + row.df * x + thermal + a * (row.q + row.dq * x))
    )
    return loss if loss > 0.0 else 0.0


cdef double thermal_friction(const AdditiveLaw *law, double temperature) noexcept nogil:
    """Return h(T) [Nms/rad]; 0 for a temperature that is not known (NaN)."""
    cdef double difference = temperature - law.t0
    if isnan(difference):
        return 0.0
    return law.viscous * expm1(-law.per_k * fmin(fmax(difference, -FARTHEST), FARTHEST))


cdef Loss additive_loss(const AdditiveLaw *law, double raw, double v, double thermal, double s) noexcept nogil:
    """Return the loss and what friction leaves open; s: direction of friction, -1 to 1. See `AdditiveLossModel`."""
    cdef double a = fmin(fabs(v), law.vmax)
    cdef double y = a * law.inverse_vs
    cdef double stribeck = exp(-y * y)
    cdef double p, n
    cdef Loss loss
    if s > ONE_SIDED:
        loss.nm, loss.half = _side(law, &law.positive, raw, a, stribeck, thermal), 0.0
    elif s < -ONE_SIDED:
        loss.nm, loss.half = -_side(law, &law.negative, -raw, a, stribeck, thermal), 0.0
    else:
        p = 0.5 * _side(law, &law.positive, raw, a, stribeck, thermal)
        n = 0.5 * _side(law, &law.negative, -raw, a, stribeck, thermal)
        loss.nm, loss.half = (1.0 + s) * p - (1.0 - s) * n, (p + n) * (1.0 - s * s)
    return loss


cdef int _fill_side(SideLaw *side, nodes, given) except -1:
    """Lay one direction out as one line per interval of the load; beyond the outer nodes c goes on, f and q are held."""
    cdef LoadRow *row
    last = len(nodes) - 1
    c, f, q = given.constant_nm, given.viscous_nms_per_rad, given.quadratic_nms2_per_rad2
    for n in range(last + 2):
        k = min(max(n - 1, 0), last - 1)  # the interval whose slope counts
        start = last if n > last else k
        inside = 0 < n <= last
        width = nodes[k + 1] - nodes[k]
        row = &side.rows[n]
        row.node, row.c, row.f, row.q = nodes[start], c[start], f[start], q[start]
        row.dc = (c[k + 1] - c[k]) / width
        row.df = (f[k + 1] - f[k]) / width if inside else 0.0
        row.dq = (q[k + 1] - q[k]) / width if inside else 0.0
    side.stribeck = given.stribeck_nm
    return 0


cdef class AdditiveLossModel:
    """Loss by load, speed, direction and temperature: ours, in place of an efficiency.

        L_d(x, a) = c_d(x) + Fs_d exp(-(a/vs)^2) + f_d(x) a + q_d(x) a^2 + h(T) a >= 0
                    d = sign(v), a = |v|, x = d tau_raw (load along the motion)
        h(T) = Fv (exp(-b (T - T0)) - 1)                   the lubricant's viscosity against that of the fit
        loss = (1+s)/2 L_+ - (1-s)/2 L_-,   s = tanh(v/w0), or the observer's: the same through the filter of tau_raw

    c, f and q are linear between load nodes. In contrast to a quotient eta = tau_j/tau_raw nothing is singular at zero
    current. At v = 0 the result is the middle of what friction can hold, [tau_raw - L_+, tau_raw + L_-], and
    (L_+ + L_-)/2 is half its width.

    At a fast reversal friction turns within a millisecond, tau_raw follows through the observer's filter, and the
    filtered v crosses zero later still. A direction that took its sign from that v would be wrong by twice the friction
    meanwhile; the direction at the motor, through the same filter as tau_raw, is not.

    A temperature that is not known (NaN) counts as that of the fit.
    """

    def __init__(self, loss):
        nodes = loss.load_nodes_nm
        if len(nodes) > MOST_NODES:
            raise ValueError(f"found {len(nodes)} load nodes, expected at most {MOST_NODES}")
        self.law.nodes = len(nodes)
        for n, node in enumerate(nodes):
            self.law.node[n] = node
        _fill_side(&self.law.positive, nodes, loss.positive)
        _fill_side(&self.law.negative, nodes, loss.negative)
        self.law.inverse_vs = 1.0 / loss.stribeck_velocity_rad_s
        self.law.vmax = loss.velocity_max_rad_s
        self.law.t0 = loss.temperature_c
        self.law.per_k = loss.viscous_per_k
        self.law.viscous = loss.thermal_viscous_nms_per_rad

    def thermal(self, double temperature_c):
        """Return h(T) [Nms/rad]; 0 for a temperature that is not known (NaN)."""
        return thermal_friction(&self.law, temperature_c)

    def loss(self, double raw_nm, double velocity_rad_s, double thermal, direction=None):
        """Return (loss, half) [Nm]: the loss, and half the width of the interval that friction leaves open at this speed.

        thermal: h(T) [Nms/rad]; direction: s, -1 to 1, None for tanh(v/w0).
        """
        cdef double s = direction_of(velocity_rad_s) if direction is None else direction
        cdef Loss loss = additive_loss(&self.law, raw_nm, velocity_rad_s, thermal, s)
        return loss.nm, loss.half

    def loss_many(self, raw_nm, velocity_rad_s, temperature_c, direction=None):
        """Return the same for arrays [n]; temperature_c in place of h(T), NaN where not known."""
        import numpy as np

        _, raw = _flat(raw_nm)
        _, v = _flat(velocity_rad_s)
        _, temperature = _flat(np.broadcast_to(temperature_c, raw.shape))
        _, s = _flat(np.full(raw.shape, NAN) if direction is None else direction)
        out = np.empty((2, len(raw)))
        cdef const double[::1] raws = raw
        cdef const double[::1] velocities = v
        cdef const double[::1] temperatures = temperature
        cdef const double[::1] directions = s
        cdef double[:, ::1] to = out
        cdef double known = NAN, thermal = 0.0, turns
        cdef bint own = direction is None
        cdef Loss loss
        cdef Py_ssize_t k
        with nogil:
            for k in range(to.shape[1]):
                if temperatures[k] != known:
                    known = temperatures[k]
                    thermal = thermal_friction(&self.law, known)
                turns = direction_of(velocities[k]) if own else directions[k]
                loss = additive_loss(&self.law, raws[k], velocities[k], thermal, turns)
                to[0, k], to[1, k] = loss.nm, loss.half
        return out[0], out[1]


def _flat(values):
    """Return the shape of an array, and its values [n] as contiguous float64."""
    import numpy as np

    array = np.asarray(values, np.float64)
    return array.shape, np.ascontiguousarray(array).reshape(-1)
