"""Torque observers in exact discrete form: the paper's (Eqs. 4 and 7), and that of method `fused`.

Symbols: i current [A], w motor velocity [rad/s], Kt torque constant, J rotor inertia (motor side), G gear ratio,
g bandwidth [rad/s], theta_m and theta_l motor and link position [rad].

    tau_raw = [ g/(s+g) (i Kt + J g w) - J g w ] G            = G LPF(i Kt - J dw/dt), without any loss
    v       = g/(s+g) w/G                                     velocity of the same age as tau_raw

Discretisation: z' = g (u - z) is integrated exactly for an input that is linear between samples (first-order hold),
with the measured step dt:

    z_k = a z_(k-1) + b0 u_k + b1 u_(k-1),   a = exp(-g dt),  b0 = 1 - (1-a)/(g dt),  b1 = (1-a)/(g dt) - a

The state starts at the first input, so a joint at rest or at constant speed has no start transient. A ramp is followed
with a lag of exactly 1/g: the group delay at DC (5 ms at 200 rad/s).

The link velocity is the derivative of the link position through p/(s+p), exact for a position that is linear between
samples: r_k = exp(-p dt) r_(k-1) + (1 - exp(-p dt)) (q_k - q_(k-1))/dt.
"""

from __future__ import annotations

from math import cos, expm1, isinf, nan, sin, tanh
from typing import Final, NamedTuple

from jtqd.estimator.guard import RAW_LIMIT
from jtqd.estimator.joint import Joint, Torsion
from jtqd.estimator.losses import DIRECTION_VELOCITY_RAD_S, FrictionModel

_new: Final = tuple.__new__  # a NamedTuple's own constructor costs twice as much


class Observed(NamedTuple):
    """Outputs of one step of `Observer`; torques [Nm, joint side], velocities [rad/s, joint side]."""

    raw_nm: float
    tob_nm: float
    joint_velocity_rad_s: float
    link_velocity_rad_s: float


def first_order_hold(rate_rad_s: float, dt_s: float) -> tuple[float, float, float]:
    """Return (a, b0, b1) of the recursion for one step dt_s > 0; expm1 keeps tiny steps exact."""
    x = rate_rad_s * dt_s
    gone = -expm1(-x)
    share = gone / x
    return 1.0 - gone, 1.0 - share, share - 1.0 + gone


class Observer:
    """The paper's observer of one joint, sample by sample: plain floats, no allocation but its result.

        tau_tob = tau_raw - g/(s+g) tau_f                         Eq. (4), tau_f = G f_m [Nm, joint side]

    joint: parameters; bandwidth_rad_s: g; link_bandwidth_rad_s: p of the link velocity.
    """

    __slots__ = (
        "_friction",
        "_friction_last",
        "_gear",
        "_inertia_rate",
        "_inverse_gear",
        "_kt",
        "_link",
        "_link_rate",
        "_link_velocity",
        "_rate",
        "_u",
        "_v",
        "_z",
        "_z_friction",
        "_z_v",
    )

    def __init__(self, joint: Joint, bandwidth_rad_s: float, link_bandwidth_rad_s: float) -> None:
        self._friction: Final = FrictionModel(joint.friction).torque
        self._gear: Final = joint.gear_ratio
        self._inverse_gear: Final = 1.0 / joint.gear_ratio
        self._kt: Final = joint.torque_constant_nm_per_a
        self._inertia_rate: Final = joint.rotor_inertia_kgm2 * bandwidth_rad_s
        self._rate: Final = bandwidth_rad_s
        self._link_rate: Final = link_bandwidth_rad_s
        self._u = self._z = self._v = self._z_v = self._friction_last = self._z_friction = 0.0
        self._link = self._link_velocity = 0.0

    def start(
        self,
        current_a: float,
        motor_position_rad: float,
        motor_velocity_rad_s: float,
        link_position_rad: float,
    ) -> Observed:
        """Set the states of a joint that has always moved at this speed, without acceleration."""
        v = motor_velocity_rad_s * self._inverse_gear
        u = current_a * self._kt + self._inertia_rate * motor_velocity_rad_s
        self._u = self._z = u
        self._v = self._z_v = v
        self._friction_last = self._z_friction = self._friction(v)
        self._link = link_position_rad
        self._link_velocity = v
        raw = (u - self._inertia_rate * motor_velocity_rad_s) * self._gear
        return Observed(raw, raw - self._z_friction, v, v)

    def step(
        self,
        dt_s: float,
        current_a: float,
        motor_position_rad: float,
        motor_velocity_rad_s: float,
        link_position_rad: float,
    ) -> Observed:
        """Advance by dt_s > 0 to the sample given and return the outputs at that sample."""
        x = self._rate * dt_s
        gone = -expm1(-x)
        share = gone / x
        a = 1.0 - gone
        b0 = 1.0 - share
        b1 = share - a
        spin = self._inertia_rate * motor_velocity_rad_s
        u = current_a * self._kt + spin
        v = motor_velocity_rad_s * self._inverse_gear
        friction = self._friction(v)
        self._z = z = a * self._z + b0 * u + b1 * self._u
        self._z_v = z_v = a * self._z_v + b0 * v + b1 * self._v
        self._z_friction = z_f = a * self._z_friction + b0 * friction + b1 * self._friction_last
        self._u = u
        self._v = v
        self._friction_last = friction
        gone = -expm1(-self._link_rate * dt_s)
        slope = (link_position_rad - self._link) / dt_s
        self._link_velocity = r = self._link_velocity + gone * (slope - self._link_velocity)
        self._link = link_position_rad
        raw = (z - spin) * self._gear
        return _new(Observed, (raw, raw - z_f, z_v, r))


RIPPLE_ORDERS: Final = (2, 4)
"""Per motor revolution: twice the wave generator's turn, and its first harmonic."""


class FusedObserved(NamedTuple):
    """Outputs of one step of `FusedObserver`; torques [Nm, joint side], velocities [rad/s, joint side], filtered waves.

    raw_nm is NaN where the torsion is impossible: the guard then starts again, as for an impossible motor torque.
    open_nm: half width of what the torsion's slip leaves open, 0 once the slip is known and where there is none.
    """

    raw_nm: float
    joint_velocity_rad_s: float
    link_velocity_rad_s: float
    torsion_nm: float
    cos2: float
    sin2: float
    cos4: float
    sin4: float
    direction: float
    open_nm: float = 0.0


_Inputs = tuple[float, float, float, float, float, float, float, float]
"""What the filter takes: u = i Kt + J g w, v, deflection d, cos 2, sin 2, cos 4, sin 4, direction."""

_INVERSE_W0: Final = 1.0 / DIRECTION_VELOCITY_RAD_S
_SETTLED_RAD_S: Final = 20.0 * DIRECTION_VELOCITY_RAD_S  # tanh(20) is 1 in float64


class FusedObserver:
    """Observer of method `fused` for one joint: motor torque, velocity, torsion torque and ripple angles of one age.

        d       = g/(s+g) (theta_m/G - theta_l - zero - e(theta_m))          e: kinematic error
        tau_t   = K d + K3 d^3 + D d' + H z,   z = (lo + hi)/2,   open = H (hi - lo)/2
        dlo = dhi = dd/travel, each held in [-1, 1]          Maxwell slip, between bounds: -1 and 1 at each start
        c_n, s_n = g/(s+g) cos(n theta_m), g/(s+g) sin(n theta_m)     n = RIPPLE_ORDERS
        direction = g/(s+g) tanh(w/(G w0))                   of friction, as tau_raw knows it

    All pass the same filter, so a torque ripple A cos(n theta_m + phi), which reaches tau_raw through that filter, is
    exactly linear in c_n and s_n at every speed, and friction that turns with the motion is linear in `direction`,
    however fast the reversal. The slip follows the filtered deflection: an element that slips would rectify the
    encoder's noise. Where it was when the observer started is not known: its bounds meet after twice its travel in one
    direction, and until then `open` is what it may hold to either side of the middle.

    torsion None: its torque is always 0.
    """

    __slots__ = (
        "_cos2",
        "_cos4",
        "_cubic",
        "_d",
        "_damping",
        "_gear",
        "_high",
        "_hysteresis",
        "_inertia_rate",
        "_inverse_gear",
        "_inverse_travel",
        "_kt",
        "_last",
        "_link",
        "_link_rate",
        "_link_velocity",
        "_low",
        "_others",
        "_rate",
        "_sin2",
        "_sin4",
        "_state",
        "_stiffness",
        "_torsion_limit",
        "_zero",
    )

    def __init__(
        self, joint: Joint, torsion: Torsion | None, bandwidth_rad_s: float, link_bandwidth_rad_s: float
    ) -> None:
        self._gear: Final = joint.gear_ratio
        self._inverse_gear: Final = 1.0 / joint.gear_ratio
        self._kt: Final = joint.torque_constant_nm_per_a
        self._inertia_rate: Final = joint.rotor_inertia_kgm2 * bandwidth_rad_s
        self._rate: Final = bandwidth_rad_s
        self._link_rate: Final = link_bandwidth_rad_s
        self._stiffness: Final = 0.0 if torsion is None else torsion.stiffness_nm_per_rad
        self._cubic: Final = 0.0 if torsion is None else torsion.cubic_nm_per_rad3
        self._zero: Final = 0.0 if torsion is None else torsion.zero_rad
        self._damping: Final = 0.0 if torsion is None else torsion.damping_nms_per_rad
        self._hysteresis: Final = 0.0 if torsion is None else torsion.hysteresis_nm
        self._inverse_travel: Final = 0.0 if torsion is None else 1.0 / torsion.hysteresis_travel_rad
        self._low, self._high = -1.0, 1.0
        self._d = 0.0
        self._torsion_limit: Final = RAW_LIMIT * joint.rated_torque_nm
        waves = [] if torsion is None else _waves(torsion)
        # a kinematic error of the ripple orders costs no further cos and sin
        two = [wave for wave in waves if wave[0] == RIPPLE_ORDERS[0]]
        four = [wave for wave in waves if wave[0] == RIPPLE_ORDERS[1]]
        self._cos2: Final = sum(c for _, c, _ in two)
        self._sin2: Final = sum(s for _, _, s in two)
        self._cos4: Final = sum(c for _, c, _ in four)
        self._sin4: Final = sum(s for _, _, s in four)
        self._others: Final = tuple(wave for wave in waves if wave[0] not in RIPPLE_ORDERS)
        self._last: _Inputs = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        self._state: _Inputs = self._last
        self._link = self._link_velocity = 0.0

    def _inputs(
        self,
        current_a: float,
        motor_position_rad: float,
        motor_velocity_rad_s: float,
        link_position_rad: float,
    ) -> _Inputs:
        angle = motor_position_rad
        c = cos(angle)  # of the angle itself: a multiple of a finite angle need not be finite
        s = sin(angle)
        c2 = c * c - s * s
        s2 = 2.0 * c * s
        c4 = c2 * c2 - s2 * s2
        s4 = 2.0 * c2 * s2
        d = (
            angle * self._inverse_gear
            - link_position_rad
            - self._zero
            - self._cos2 * c2
            - self._sin2 * s2
            - self._cos4 * c4
            - self._sin4 * s4
        )
        if self._others:
            d -= self._other_waves(angle)
        v = motor_velocity_rad_s * self._inverse_gear
        if v > _SETTLED_RAD_S:
            direction = 1.0
        elif v < -_SETTLED_RAD_S:
            direction = -1.0
        else:
            direction = tanh(v * _INVERSE_W0)
        return (
            current_a * self._kt + self._inertia_rate * motor_velocity_rad_s,
            v,
            d,
            c2,
            s2,
            c4,
            s4,
            direction,
        )

    def _other_waves(self, angle: float) -> float:
        """Return the part [rad] of the kinematic error whose orders are not RIPPLE_ORDERS."""
        error = 0.0
        for order, c, s in self._others:
            a = order * angle
            if isinf(a):
                return nan
            error += c * cos(a) + s * sin(a)
        return error

    def _torsion(self, d: float, dt_s: float) -> tuple[float, float]:
        """Move the slip to the filtered deflection d [rad], dt_s after the last one; return (torque, open) [Nm] there."""
        step = d - self._d
        self._d = d
        torsion = d * (self._stiffness + self._cubic * d * d) + self._damping * step / dt_s
        if not self._hysteresis:
            return torsion, 0.0
        step *= self._inverse_travel
        low = self._low + step
        high = self._high + step
        if high > 1.0:
            high = 1.0
            low = min(low, 1.0)
        elif low < -1.0:
            low = -1.0
            high = max(high, -1.0)
        self._low, self._high = low, high
        half = 0.5 * self._hysteresis
        return torsion + half * (low + high), half * (high - low)

    def start(
        self,
        current_a: float,
        motor_position_rad: float,
        motor_velocity_rad_s: float,
        link_position_rad: float,
    ) -> FusedObserved:
        """Set the states of a joint that has always moved at this speed with this torsion; the slip is unknown."""
        self._low, self._high = -1.0, 1.0
        now = self._inputs(current_a, motor_position_rad, motor_velocity_rad_s, link_position_rad)
        self._last = self._state = now
        self._link = link_position_rad
        self._link_velocity = now[1]
        self._d = now[2]
        torsion, open_nm = self._torsion(now[2], 1.0)
        raw = (now[0] - self._inertia_rate * motor_velocity_rad_s) * self._gear
        return FusedObserved(raw, now[1], now[1], torsion, *now[3:], open_nm)

    def step(
        self,
        dt_s: float,
        current_a: float,
        motor_position_rad: float,
        motor_velocity_rad_s: float,
        link_position_rad: float,
    ) -> FusedObserved:
        """Advance by dt_s > 0 to the sample given and return the outputs at that sample."""
        x = self._rate * dt_s
        gone = -expm1(-x)
        share = gone / x
        a = 1.0 - gone
        b0 = 1.0 - share
        b1 = share - a
        now = self._inputs(current_a, motor_position_rad, motor_velocity_rad_s, link_position_rad)
        u, v, d, c2, s2, c4, s4, s = now
        u_, v_, d_, c2_, s2_, c4_, s4_, s_ = self._last
        zu, zv, zd, zc2, zs2, zc4, zs4, zs = self._state
        zu = a * zu + b0 * u + b1 * u_
        zv = a * zv + b0 * v + b1 * v_
        zd = a * zd + b0 * d + b1 * d_
        zc2 = a * zc2 + b0 * c2 + b1 * c2_
        zs2 = a * zs2 + b0 * s2 + b1 * s2_
        zc4 = a * zc4 + b0 * c4 + b1 * c4_
        zs4 = a * zs4 + b0 * s4 + b1 * s4_
        zs = a * zs + b0 * s + b1 * s_
        self._last = now
        self._state = (zu, zv, zd, zc2, zs2, zc4, zs4, zs)
        if self._link_rate != self._rate:
            gone = -expm1(-self._link_rate * dt_s)
        slope = (link_position_rad - self._link) / dt_s
        self._link_velocity = r = self._link_velocity + gone * (slope - self._link_velocity)
        self._link = link_position_rad
        raw = (zu - self._inertia_rate * motor_velocity_rad_s) * self._gear
        torsion, open_nm = self._torsion(zd, dt_s)
        if not -self._torsion_limit <= torsion <= self._torsion_limit:  # NaN included
            raw = nan
        return _new(FusedObserved, (raw, zv, r, torsion, zc2, zs2, zc4, zs4, zs, open_nm))


def _waves(torsion: Torsion) -> list[tuple[float, float, float]]:
    """Return (order, cos, sin) of the kinematic error."""
    return list(zip(torsion.orders_per_motor_rev, torsion.cos_rad, torsion.sin_rad, strict=True))
