"""Additive loss of the joint, dependent on load, speed, direction and temperature: ours, in place of an efficiency.

    tau_j = tau_raw - loss(tau_raw, v, T)                      tau_raw = G Kt i_eff, v = omega_m/G
    L_d(x, a) = c_d(x) + Fs_d exp(-(a/vs)^2) + f_d(x) a + q_d(x) a^2 + h(T) a >= 0
                d = sign(v), a = |v|, x = d tau_raw (load along the motion)
    h(T) = Fv (exp(-b (T - T0)) - 1)                       the lubricant's viscosity against that of the fit
    loss = (1+s)/2 L_+ - (1-s)/2 L_-,   s = tanh(v/w0), or the observer's: the same through the filter of tau_raw

c, f and q are linear between load nodes. In contrast to a quotient eta = tau_j/tau_raw nothing is singular at zero
current, and the value is continuous over all quadrants: in the load by its nodes, in the direction by s. At v = 0 the
result is the middle of what friction can hold, [tau_raw - L_+, tau_raw + L_-], and (L_+ + L_-)/2 is half its width.

At a fast reversal friction turns within a millisecond, tau_raw follows through the observer's filter, and the filtered
v crosses zero later still. A direction that took its sign from that v would be wrong by twice the friction meanwhile;
the direction at the motor, through the same filter as tau_raw, is not.
"""

from __future__ import annotations

from bisect import bisect_right
from math import exp, expm1, isnan, tanh
from typing import Final

import numpy as np

from estimator.friction import DIRECTION_VELOCITY_RAD_S, FloatArray
from estimator.fused_parameters import AdditiveLoss, LossSide

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
    """The loss with its constants at hand. temperature NaN (unknown) counts as the fit's own."""

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
        """Return (loss, half) [Nm]: the loss, and half the width that friction leaves open at this speed.

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
