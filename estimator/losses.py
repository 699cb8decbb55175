"""Loss torque of the joint from the four-quadrant efficiency of Eq. (8), bounded and continuous.

In steady state tau_j = G Kt i - loss(i, v), v = omega_m/G. Inside a quadrant loss = G Kt i (1 - eta(i, v)),
eta = tau_j/(G Kt i). What the paper leaves open is decided here, for estimator and emulated plant alike:

- Range. eta is evaluated at |v| in [0.2, 3] rad/s and |i| <= 7 A driving, <= 5 A back-driving (where the
  quadratics turn; beyond the measured points they rise or fall without reason). Outside, eta is held.
- Bounds. Driving 0.05 <= eta <= 1, back-driving 1 <= eta <= 4: the loss dissipates, sign(loss) = sign(v).
- Reversal. The loss of the side of v is scaled by |tanh(v/w0)|, w0 = 0.02 rad/s: continuous, zero at v = 0,
  and never feeding energy in, which a plain average of two unequal sides would.
- Zero current. eta is 0/0 there. With weight exp(-(i/i_b)^2), i_b = 0.35 A, the loss turns into the additive
  friction: at i = 0 it is that friction, at 1 A the weight is 3e-4.

A joint without efficiency has the additive friction alone.
"""

from __future__ import annotations

from math import exp, tanh
from typing import Final

import numpy as np

from estimator.friction import FloatArray, FrictionModel
from estimator.parameters import Efficiency, Joint, QuadrantPolynomial

VELOCITY_RANGE_RAD_S: Final = (0.2, 3.0)
DRIVING_CURRENT_MAX_A: Final = 7.0
BACKDRIVING_CURRENT_MAX_A: Final = 5.0
DRIVING_ETA: Final = (0.05, 1.0)
BACKDRIVING_ETA: Final = (1.0, 4.0)
BLEND_CURRENT_A: Final = 0.35
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
    """loss(i, v) of one joint in plain floats, its vectorised twin, and what its uncertainty needs."""

    __slots__ = ("_friction", "_inverse_blend", "_quadrants", "_reciprocal", "_table", "torque_per_ampere")

    def __init__(self, joint: Joint) -> None:
        self.torque_per_ampere: Final = joint.gear_ratio * joint.torque_constant_nm_per_a
        self._friction: Final = FrictionModel(joint.friction)
        self._inverse_blend: Final = 1.0 / BLEND_CURRENT_A
        e: Efficiency | None = joint.efficiency
        self._reciprocal: Final = e is not None and e.convention == "motor_over_joint"
        # index: 2 when v < 0, plus 1 when i < 0
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
        """False when the joint file gives friction only."""
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
        w = min(max(abs(v), 0.2), 3.0)
        e = min(max(c00 + (c10 + c20 * a + c11 * w) * a + (c01 + c02 * w) * w, low), high)
        return 1.0 / e if self._reciprocal else e

    def loss(self, current_a: float, joint_velocity_rad_s: float) -> float:
        """Return the loss [Nm, joint side] with the sign of v; current [A], joint-side velocity [rad/s].

        This runs in the plant and in the loop: branches instead of min/max, which cost a call each.
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
        y = 0.2 if w < 0.2 else (w if w < 3.0 else 3.0)
        e = c00 + (c10 + c20 * x + c11 * y) * x + (c01 + c02 * y) * y
        if e < low:
            e = low
        elif e > high:
            e = high
        if self._reciprocal:
            e = 1.0 / e
        size = self.torque_per_ampere * a * (1.0 - e if e < 1.0 else e - 1.0)
        if w < 0.5:  # tanh(25) is 1 in float64
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
        y = np.minimum(np.maximum(np.abs(v), 0.2), 3.0)
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
