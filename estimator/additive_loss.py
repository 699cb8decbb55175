"""Additive loss of the joint, dependent on load, speed, direction and temperature: ours, in place of an efficiency.

    tau_j = tau_raw - loss(tau_raw, v, T)                      tau_raw = G Kt i_eff, v = omega_m/G
    L_d(x, a) = c_d(x) + Fs_d exp(-(a/vs)^2) + f_d(x) a + q_d(x) a^2 + h(T) a >= 0
                d = sign(v), a = |v|, x = d tau_raw (load along the motion)
    h(T) = Fv (exp(-b (T - T0)) - 1)                       the lubricant's viscosity against that of the fit
    loss = (1+s)/2 L_+ - (1-s)/2 L_-,   s = tanh(v/w0)

c, f and q are linear between load nodes. In contrast to a quotient eta = tau_j/tau_raw nothing is singular at zero
current, and the value is continuous over all quadrants: in the load by its nodes, in the direction by s. At v = 0 the
result is the middle of what friction can hold, [tau_raw - L_+, tau_raw + L_-], and (L_+ + L_-)/2 is half its width.
"""

from __future__ import annotations

from bisect import bisect_right
from math import exp, tanh
from typing import Final

import numpy as np

from estimator.friction import DIRECTION_VELOCITY_RAD_S, FloatArray
from estimator.fused_parameters import AdditiveLoss, LossSide

_ONE_SIDED: Final = 0.9999
"""|s| from which the other direction no longer counts: |v| > 0.1 rad/s."""


class _Side:
    """L_d of one direction as lines between nodes; beyond the outer nodes c goes on, f and q are held."""

    __slots__ = ("_nodes", "_rows", "_stribeck", "constant", "quadratic", "viscous")

    def __init__(self, nodes: tuple[float, ...], side: LossSide) -> None:
        c, f, q = side.constant_nm, side.viscous_nms_per_rad, side.quadratic_nms2_per_rad2
        self._nodes: Final = nodes
        self._stribeck: Final = side.stribeck_nm
        self.constant: Final = np.array(c)
        self.viscous: Final = np.array(f)
        self.quadratic: Final = np.array(q)
        # index n: the interval that ends at node n; 0 and len(nodes) lie outside
        rows = []
        last = len(nodes) - 1
        for n in range(len(nodes) + 1):
            k = min(max(n - 1, 0), last - 1)
            inside = 0 < n <= last
            width = nodes[k + 1] - nodes[k]
            start = k if n <= last else last
            rows.append(
                (
                    nodes[start],
                    c[start],
                    (c[k + 1] - c[k]) / width,
                    f[start],
                    (f[k + 1] - f[k]) / width if inside else 0.0,
                    q[start],
                    (q[k + 1] - q[k]) / width if inside else 0.0,
                )
            )
        self._rows: Final = tuple(rows)

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
        nodes = np.array(self._nodes)
        n = np.searchsorted(nodes, load, side="right")
        rows = np.array(self._rows)[n]
        x = load - rows[:, 0]
        loss = (
            rows[:, 1]
            + rows[:, 2] * x
            + self._stribeck * stribeck
            + speed * (rows[:, 3] + rows[:, 4] * x + thermal + speed * (rows[:, 5] + rows[:, 6] * x))
        )
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
        """Return h(T) [Nms/rad]; 0 for NaN. Bounded to 40 K either way: no fit reaches further."""
        difference = temperature_c - self._t0
        if difference != difference:  # NaN: not known
            return 0.0
        return self._viscous * (exp(-self._per_k * min(max(difference, -40.0), 40.0)) - 1.0)

    def loss(self, raw_nm: float, velocity_rad_s: float, thermal: float) -> tuple[float, float]:
        """Return (loss, half) [Nm]: the loss, and half the width that friction leaves open at this speed."""
        v = velocity_rad_s
        a = v if v >= 0.0 else -v
        a = min(a, self._vmax)
        s = tanh(v * self._inverse_w0)
        y = a * self._inverse_vs
        stribeck = exp(-y * y)
        if s > _ONE_SIDED:
            return self._positive.value(raw_nm, a, stribeck, thermal), 0.0
        if s < -_ONE_SIDED:
            return -self._negative.value(-raw_nm, a, stribeck, thermal), 0.0
        p = 0.5 * self._positive.value(raw_nm, a, stribeck, thermal)
        n = 0.5 * self._negative.value(-raw_nm, a, stribeck, thermal)
        return (1.0 + s) * p - (1.0 - s) * n, (p + n) * (1.0 - s * s)

    def loss_many(
        self, raw_nm: FloatArray, velocity_rad_s: FloatArray, temperature_c: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Vectorised twin of `loss` [n], temperature instead of its factor."""
        v = velocity_rad_s
        a = np.minimum(np.abs(v), self._vmax)
        s = np.tanh(v * self._inverse_w0)
        stribeck = np.exp(-((a * self._inverse_vs) ** 2))
        difference = np.clip(temperature_c - self._t0, -40.0, 40.0)
        thermal = self._viscous * np.expm1(-self._per_k * np.where(np.isnan(difference), 0.0, difference))
        p = self._positive.value_many(raw_nm, a, stribeck, thermal)
        n = self._negative.value_many(-raw_nm, a, stribeck, thermal)
        both = 0.5 * ((1.0 + s) * p - (1.0 - s) * n)
        loss = np.where(s > _ONE_SIDED, p, np.where(s < -_ONE_SIDED, -n, both))
        half = np.where(np.abs(s) > _ONE_SIDED, 0.0, 0.5 * (p + n) * (1.0 - s * s))
        return loss, half
