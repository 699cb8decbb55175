"""Loss torque of a joint [Nm, joint side]: what friction takes between motor and link, tau_j = tau_raw - loss.

tau_raw = G Kt i is the motor's torque at the joint, v = omega_m/G the velocity. Three laws, for estimator and emulated
plant alike; each opposes the motion and is continuous everywhere:

| law | depends on | used by |
|---|---|---|
| `FrictionModel` | velocity | method `tob`, and wherever the other two have no data |
| `LossModel` | current and velocity: the four-quadrant efficiency of the paper's Eq. (8) | `efficiency`, `network` |
| `AdditiveLossModel` | load, velocity, direction, temperature | `fused` |

Methods with the suffix _many are vectorised twins for whole runs.
"""

from __future__ import annotations

from bisect import bisect_right
from math import exp, expm1, isnan, tanh
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import AdditiveLoss, Efficiency, Friction, Joint, LossSide, QuadrantPolynomial

DIRECTION_VELOCITY_RAD_S: Final = 0.02
"""w0: velocity of the joint side over which the direction of every loss turns.

Twice the standstill threshold: below it the direction of friction is not known anyway; above 0.1 rad/s tanh(v/w0) is +-1
to 1e-4.
"""


def static_friction(friction: Friction) -> float:
    """Return the torque [Nm, joint side] below which the joint may stand still: Fc + Fs."""
    return friction.coulomb_nm + friction.stribeck_nm


class FrictionModel:
    """Additive friction: Coulomb + Stribeck + viscous, with a smooth direction; odd in v.

    tau_f(v) = tanh(v/w0) (Fc + Fs exp(-(v/vs)^2)) + Fv v
    """

    __slots__ = ("coulomb", "inverse_stribeck", "inverse_w0", "static", "stribeck", "viscous")

    def __init__(self, friction: Friction) -> None:
        self.coulomb: Final = friction.coulomb_nm
        self.stribeck: Final = friction.stribeck_nm
        self.viscous: Final = friction.viscous_nms_per_rad
        self.inverse_stribeck: Final = 1.0 / friction.stribeck_velocity_rad_s
        self.inverse_w0: Final = 1.0 / DIRECTION_VELOCITY_RAD_S
        self.static: Final = static_friction(friction)

    def torque(self, velocity_rad_s: float) -> float:
        """Return friction [Nm, joint side] at a joint-side velocity [rad/s]; its sign is the velocity's."""
        v = velocity_rad_s
        x = v * self.inverse_stribeck
        return tanh(v * self.inverse_w0) * (self.coulomb + self.stribeck * exp(-x * x)) + self.viscous * v

    def torque_many(self, velocity_rad_s: FloatArray) -> FloatArray:
        """Vectorised twin of `torque`, any shape."""
        v = velocity_rad_s
        x = v * self.inverse_stribeck
        result: FloatArray = (
            np.tanh(v * self.inverse_w0) * (self.coulomb + self.stribeck * np.exp(-x * x)) + self.viscous * v
        )
        return result


VELOCITY_RANGE_RAD_S: Final = (0.2, 3.0)
DRIVING_CURRENT_MAX_A: Final = 7.0
BACKDRIVING_CURRENT_MAX_A: Final = 5.0
DRIVING_ETA: Final = (0.05, 1.0)
BACKDRIVING_ETA: Final = (1.0, 4.0)
BLEND_CURRENT_A: Final = 0.35
_SLOWEST, _FASTEST = VELOCITY_RANGE_RAD_S
_NO_BLEND_A: Final = 6.1 * BLEND_CURRENT_A  # the weight is below 1e-16 from here on

# c00, c10, c01, c20, c11, c02 in |i| and |v|; eta low, eta high, |i| max, rmse
_Quadrant = tuple[float, float, float, float, float, float, float, float, float, float]


def _quadrant(p: QuadrantPolynomial, sign_i: float, sign_v: float, reciprocal: bool) -> _Quadrant:
    """Rewrite one quadrant in |i| and |v| and attach its bounds (in the polynomial's own convention)."""
    driving = sign_i == sign_v
    low, high = DRIVING_ETA if driving else BACKDRIVING_ETA
    if reciprocal:
        low, high = 1.0 / high, 1.0 / low
    i_max = DRIVING_CURRENT_MAX_A if driving else BACKDRIVING_CURRENT_MAX_A
    signed = (p.p00, p.p10 * sign_i, p.p01 * sign_v, p.p20, p.p11 * sign_i * sign_v, p.p02)
    return (*signed, low, high, i_max, p.rmse)


class LossModel:
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

    __slots__ = ("_friction", "_inverse_blend", "_quadrants", "_reciprocal", "_table", "torque_per_ampere")

    def __init__(self, joint: Joint) -> None:
        self.torque_per_ampere: Final = joint.gear_ratio * joint.torque_constant_nm_per_a
        self._friction: Final = FrictionModel(joint.friction)
        self._inverse_blend: Final = 1.0 / BLEND_CURRENT_A
        e: Efficiency | None = joint.efficiency
        self._reciprocal: Final = e is not None and e.convention == "motor_over_joint"
        quadrants: tuple[_Quadrant, ...] | None = None
        if e is not None:  # index: 2 when v < 0, plus 1 when i < 0
            quadrants = (
                _quadrant(e.i_pos_w_pos, 1.0, 1.0, self._reciprocal),
                _quadrant(e.i_neg_w_pos, -1.0, 1.0, self._reciprocal),
                _quadrant(e.i_pos_w_neg, 1.0, -1.0, self._reciprocal),
                _quadrant(e.i_neg_w_neg, -1.0, -1.0, self._reciprocal),
            )
        self._quadrants: Final = quadrants
        self._table: Final[FloatArray | None] = None if quadrants is None else np.array(quadrants).T

    @property
    def has_efficiency(self) -> bool:
        """Whether the joint file has an efficiency, not friction alone."""
        return self._quadrants is not None

    def eta(self, current_a: float, joint_velocity_rad_s: float) -> float:
        """Return the bounded eta = tau_j/(G Kt i) of the quadrant, whatever the file's convention.

        Raises ValueError for a joint without efficiency.
        """
        if self._quadrants is None:
            raise ValueError("the joint has no efficiency")
        i, v = current_a, joint_velocity_rad_s
        c00, c10, c01, c20, c11, c02, low, high, i_max, _ = self._quadrants[2 * (v < 0.0) + (i < 0.0)]
        a = min(abs(i), i_max)
        w = min(max(abs(v), _SLOWEST), _FASTEST)
        e = min(max(c00 + (c10 + c20 * a + c11 * w) * a + (c01 + c02 * w) * w, low), high)
        return 1.0 / e if self._reciprocal else e

    def loss(self, current_a: float, joint_velocity_rad_s: float) -> float:
        """Return the loss [Nm, joint side] with the sign of v; current [A], joint-side velocity [rad/s].

        Called in every cycle: branches instead of min/max, which cost a call each.
        """
        quadrants = self._quadrants
        if quadrants is None:
            return self._friction.torque(joint_velocity_rad_s)
        v = joint_velocity_rad_s
        i = current_a
        if v < 0.0:
            if i < 0.0:
                a = -i
                c00, c10, c01, c20, c11, c02, low, high, i_max, _ = quadrants[3]
            else:
                a = i
                c00, c10, c01, c20, c11, c02, low, high, i_max, _ = quadrants[2]
            w = -v
        else:
            if i < 0.0:
                a = -i
                c00, c10, c01, c20, c11, c02, low, high, i_max, _ = quadrants[1]
            else:
                a = i
                c00, c10, c01, c20, c11, c02, low, high, i_max, _ = quadrants[0]
            w = v
        x = a if a < i_max else i_max
        y = 0.2 if w < 0.2 else (w if w < 3.0 else 3.0)  # VELOCITY_RANGE_RAD_S
        e = c00 + (c10 + c20 * x + c11 * y) * x + (c01 + c02 * y) * y
        if e < low:
            e = low
        elif e > high:
            e = high
        if self._reciprocal:
            e = 1.0 / e
        size = self.torque_per_ampere * a * (1.0 - e if e < 1.0 else e - 1.0)
        if w < 0.5:  # tanh(25) is 1 in float64; 50 is 1/w0
            size *= tanh(w * 50.0)
        if a < _NO_BLEND_A:
            r = a * self._inverse_blend
            weight = exp(-r * r)
            size += weight * (self._friction.torque(w) - size)
        return -size if v < 0.0 else size

    def loss_many(self, current_a: FloatArray, joint_velocity_rad_s: FloatArray) -> FloatArray:
        """Vectorised twin of `loss`: two arrays of one shape in, one out."""
        i, v = current_a, joint_velocity_rad_s
        if self._table is None:
            return self._friction.torque_many(v)
        a, w = np.abs(i), np.abs(v)
        e = self._eta_many(i, v)
        size = self.torque_per_ampere * a * np.abs(1.0 - e) * np.tanh(w * 50.0)
        weight = np.exp(-np.square(a * self._inverse_blend))
        size += weight * (self._friction.torque_many(w) - size)
        return np.where(v < 0.0, -size, size)

    def _eta_many(self, i: FloatArray, v: FloatArray) -> FloatArray:
        assert self._table is not None
        index = 2 * (v < 0.0) + (i < 0.0)
        c00, c10, c01, c20, c11, c02, low, high, i_max, _ = (row[index] for row in self._table)
        x = np.minimum(np.abs(i), i_max)
        y = np.minimum(np.maximum(np.abs(v), _SLOWEST), _FASTEST)
        e: FloatArray = c00 + (c10 + c20 * x + c11 * y) * x + (c01 + c02 * y) * y
        e = np.minimum(np.maximum(e, low), high)
        return 1.0 / e if self._reciprocal else e

    def standstill_bounds(self, current_a: float) -> tuple[float, float]:
        """Return the losses [Nm] just before moving in the positive (>= 0) and the negative direction (<= 0).

        The joint torque of a standing joint lies between G Kt i minus the one and G Kt i minus the other.
        """
        static = self._friction.static
        if self._quadrants is None:
            return static, -static
        i = current_a
        raw = self.torque_per_ampere * abs(i)
        r = i * self._inverse_blend
        weight = exp(-r * r)
        forward = raw * abs(1.0 - self.eta(i, 0.0))
        backward = raw * abs(1.0 - self.eta(i, -1e-300))
        return forward + weight * (static - forward), -(backward + weight * (static - backward))

    def standstill_bounds_many(self, current_a: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Vectorised twin of `standstill_bounds`."""
        i = current_a
        static = np.full_like(i, self._friction.static)
        if self._quadrants is None:
            return static, -static
        raw = self.torque_per_ampere * np.abs(i)
        weight = np.exp(-np.square(i * self._inverse_blend))
        forward = raw * np.abs(1.0 - self._eta_many(i, np.zeros_like(i)))
        backward = raw * np.abs(1.0 - self._eta_many(i, np.full_like(i, -1e-300)))
        return forward + weight * (static - forward), -(backward + weight * (static - backward))

    def rmse_torque(self, current_a: float, joint_velocity_rad_s: float) -> float:
        """Return the table's RMSE as a torque [Nm]: rmse G Kt |i|, times eta^2 if it is motor over joint."""
        quadrants = self._quadrants
        if quadrants is None:
            return 0.0
        i, v = current_a, joint_velocity_rad_s
        rmse = quadrants[2 * (v < 0.0) + (i < 0.0)][9]
        size = rmse * self.torque_per_ampere * abs(i)
        if self._reciprocal:
            e = self.eta(i, v)
            size *= e * e
        return size

    def rmse_torque_many(self, current_a: FloatArray, joint_velocity_rad_s: FloatArray) -> FloatArray:
        """Vectorised twin of `rmse_torque`."""
        i, v = current_a, joint_velocity_rad_s
        if self._table is None:
            return np.zeros_like(i)
        rmse = self._table[9][2 * (v < 0.0) + (i < 0.0)]
        size: FloatArray = rmse * self.torque_per_ampere * np.abs(i)
        return size * np.square(self._eta_many(i, v)) if self._reciprocal else size


_ONE_SIDED: Final = 1.0 - 1e-9
"""|s| from which the other direction no longer counts: a step of 1e-9 of the loss, 0.1 s after a reversal."""

_FARTHEST_K: Final = 40.0
"""Temperatures farther from the fit's count as so far: no fit reaches beyond."""

# load of a node, and c, f, q there, each with its slope per Nm to the next node
_Row = tuple[float, float, float, float, float, float, float]


def _rows(nodes: tuple[float, ...], side: LossSide) -> tuple[_Row, ...]:
    """Return one line per interval of the load; row n ends at node n, rows 0 and len(nodes) lie outside."""
    last = len(nodes) - 1
    rows = []
    for n in range(last + 2):
        k = min(max(n - 1, 0), last - 1)  # the interval whose slope counts
        start = last if n > last else k
        inside = 0 < n <= last
        width = nodes[k + 1] - nodes[k]
        c, f, q = side.constant_nm, side.viscous_nms_per_rad, side.quadratic_nms2_per_rad2
        slope_c, slope_f, slope_q = ((values[k + 1] - values[k]) / width for values in (c, f, q))
        if not inside:
            slope_f = slope_q = 0.0
        rows.append((nodes[start], c[start], slope_c, f[start], slope_f, q[start], slope_q))
    return tuple(rows)


class _Side:
    """L_d of one direction as lines between nodes; beyond the outer nodes c goes on, f and q are held."""

    __slots__ = ("_nodes", "_rows", "_stribeck")

    def __init__(self, nodes: tuple[float, ...], side: LossSide) -> None:
        self._nodes: Final = nodes
        self._rows: Final = _rows(nodes, side)
        self._stribeck: Final = side.stribeck_nm

    def value(self, load_nm: float, speed_rad_s: float, stribeck: float, thermal: float) -> float:
        """Return L_d [Nm]; stribeck: exp(-(a/vs)^2); thermal: h(T) [Nms/rad]."""
        node, c, dc, f, df, q, dq = self._rows[bisect_right(self._nodes, load_nm)]
        x = load_nm - node
        loss = (
            c
            + dc * x
            + self._stribeck * stribeck
            + speed_rad_s * (f + df * x + thermal + speed_rad_s * (q + dq * x))
        )
        return loss if loss > 0.0 else 0.0

    def value_many(
        self, load: FloatArray, speed: FloatArray, stribeck: FloatArray, thermal: FloatArray
    ) -> FloatArray:
        """Vectorised twin of `value`."""
        n = np.searchsorted(self._nodes, load, side="right")
        node, c, dc, f, df, q, dq = (column[n] for column in np.array(self._rows).T.copy())
        x = load - node
        loss = c + dc * x + self._stribeck * stribeck + speed * (f + df * x + thermal + speed * (q + dq * x))
        result: FloatArray = np.maximum(loss, 0.0)
        return result


class AdditiveLossModel:
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

    __slots__ = ("_inverse_vs", "_inverse_w0", "_negative", "_per_k", "_positive", "_t0", "_viscous", "_vmax")

    def __init__(self, loss: AdditiveLoss) -> None:
        self._positive: Final = _Side(loss.load_nodes_nm, loss.positive)
        self._negative: Final = _Side(loss.load_nodes_nm, loss.negative)
        self._inverse_vs: Final = 1.0 / loss.stribeck_velocity_rad_s
        self._inverse_w0: Final = 1.0 / DIRECTION_VELOCITY_RAD_S
        self._vmax: Final = loss.velocity_max_rad_s
        self._t0: Final = loss.temperature_c
        self._per_k: Final = loss.viscous_per_k
        self._viscous: Final = loss.thermal_viscous_nms_per_rad

    def thermal(self, temperature_c: float) -> float:
        """Return h(T) [Nms/rad]; 0 for a temperature that is not known (NaN)."""
        difference = temperature_c - self._t0
        if isnan(difference):
            return 0.0
        return self._viscous * expm1(-self._per_k * min(max(difference, -_FARTHEST_K), _FARTHEST_K))

    def loss(
        self, raw_nm: float, velocity_rad_s: float, thermal: float, direction: float | None = None
    ) -> tuple[float, float]:
        """Return (loss, half) [Nm]: the loss, and half the width of the interval that friction leaves open at this speed.

        thermal: h(T) [Nms/rad]; direction: s, -1 to 1, None for tanh(v/w0).
        """
        v = velocity_rad_s
        a = min(v if v >= 0.0 else -v, self._vmax)
        y = a * self._inverse_vs
        stribeck = exp(-y * y)
        s = tanh(v * self._inverse_w0) if direction is None else direction
        if s > _ONE_SIDED:
            return self._positive.value(raw_nm, a, stribeck, thermal), 0.0
        if s < -_ONE_SIDED:
            return -self._negative.value(-raw_nm, a, stribeck, thermal), 0.0
        p = 0.5 * self._positive.value(raw_nm, a, stribeck, thermal)
        n = 0.5 * self._negative.value(-raw_nm, a, stribeck, thermal)
        return (1.0 + s) * p - (1.0 - s) * n, (p + n) * (1.0 - s * s)

    def loss_many(
        self,
        raw_nm: FloatArray,
        velocity_rad_s: FloatArray,
        temperature_c: FloatArray,
        direction: FloatArray | None = None,
    ) -> tuple[FloatArray, FloatArray]:
        """Vectorised twin of `loss`, arrays [n]; temperature_c in place of h(T), NaN where not known."""
        v = velocity_rad_s
        a = np.minimum(np.abs(v), self._vmax)
        s = np.tanh(v * self._inverse_w0) if direction is None else direction
        s = np.where(np.abs(s) > _ONE_SIDED, np.sign(s), s)
        stribeck = np.exp(-((a * self._inverse_vs) ** 2))
        difference = np.clip(temperature_c - self._t0, -_FARTHEST_K, _FARTHEST_K)
        thermal = self._viscous * np.expm1(-self._per_k * np.where(np.isnan(difference), 0.0, difference))
        p = 0.5 * self._positive.value_many(raw_nm, a, stribeck, thermal)
        n = 0.5 * self._negative.value_many(-raw_nm, a, stribeck, thermal)
        return (1.0 + s) * p - (1.0 - s) * n, (p + n) * (1.0 - s * s)
