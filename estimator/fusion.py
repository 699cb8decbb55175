"""Fusion of two independent measurements of one torque by their variances: motor current less loss, and torsion.

    tau_c = tau_raw - loss                 knows fast changes and any load; fails with friction
    tau_t = K d + K3 d^3 + D d' + H z      knows nothing of friction; fails with hysteresis and encoder errors
    alpha = s_c^2/(s_c^2 + s_t^2)          physics = tau_c + alpha (tau_t - tau_c)
    s_c^2 = a^2 + (b v)^2 + (c tau_raw)^2 + half^2        half: what friction leaves open near v = 0
    s_t^2 = e^2 + (f tau_t)^2 + open^2     open: what the slip leaves open until its bounds have met
    sigma^2 = s_c^2 s_t^2/(s_c^2 + s_t^2) + reference^2

Towards standstill `half` grows to the half width of the friction interval and the torsion takes over: continuous,
and the value there no longer depends on which way friction happens to point.
"""

from __future__ import annotations

from math import sqrt
from typing import Final

import numpy as np

from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.estimator.joint import FusedSigma
from jtqd.estimator.whole_observers import fading_maximum

SLOW_RAD_S: Final = 0.05
FAST_RAD_S: Final = 0.2
"""The network fades in between these speeds: slower, a wave of the motor angle looks like an offset."""

_LONG: Final = 2000
"""Samples from which on arrays pay."""

HOLD_S: Final = 0.05
"""Time constant with which the friction interval is forgotten after a reversal."""


def turning(velocity_rad_s: float) -> float:
    """Return the network's share at this speed, 0 to 1."""
    a = velocity_rad_s if velocity_rad_s >= 0.0 else -velocity_rad_s
    if a >= FAST_RAD_S:
        return 1.0
    return (a - SLOW_RAD_S) * (1.0 / (FAST_RAD_S - SLOW_RAD_S)) if a > SLOW_RAD_S else 0.0


def turning_many(velocity_rad_s: FloatArray) -> FloatArray:
    """Vectorised twin of `turning`."""
    return np.clip((np.abs(velocity_rad_s) - SLOW_RAD_S) * (1.0 / (FAST_RAD_S - SLOW_RAD_S)), 0.0, 1.0)


def held(half_nm: float, before_nm: float, dt_s: float) -> float:
    """Return `half` [Nm] with the memory of the sample before, dt_s [s] ago.

    Between rest and motion the weight moves from one path to the other. Their errors differ, so it must not move within
    a few milliseconds: what friction left open at a reversal counts for HOLD_S longer.
    """
    faded = before_nm * (HOLD_S / (HOLD_S + dt_s))
    return half_nm if half_nm >= faded else faded


def held_many(half_nm: FloatArray, dt_s: FloatArray, running: BoolArray) -> FloatArray:
    """Vectorised twin of `held` [n]; the memory starts again after every sample that is not `running`."""
    out = np.zeros_like(half_nm)
    steps = dt_s[running]
    if len(steps) > _LONG and steps.min() >= 0.0 and steps.max() <= HOLD_S:
        edges = np.flatnonzero(np.diff(running, prepend=False, append=False)).tolist()
        for first, end in zip(edges[::2], edges[1::2], strict=True):
            kept = HOLD_S / (HOLD_S + dt_s[first:end])
            out[first:end] = fading_maximum(half_nm[first:end], kept)
        return out
    memory = 0.0
    for k, (half, dt, on) in enumerate(zip(half_nm.tolist(), dt_s.tolist(), running.tolist(), strict=True)):
        memory = held(half, memory, dt) if on else 0.0
        out[k] = memory
    return out


class Fusion:
    """Value and standard deviation of the fused physics [Nm, joint side].

    with_torsion False: the current path alone, whatever the torsion.
    """

    __slots__ = ("_current", "_load", "_reference", "_torsion", "_torsion_load", "_viscous", "_with_torsion")

    def __init__(self, sigma: FusedSigma, with_torsion: bool) -> None:
        self._current: Final = sigma.current_nm**2
        self._viscous: Final = sigma.viscous_nms_per_rad**2
        self._load: Final = sigma.load**2
        self._torsion: Final = sigma.torsion_nm**2
        self._torsion_load: Final = sigma.torsion_load**2
        self._reference: Final = sigma.reference_nm**2
        self._with_torsion: Final = with_torsion

    def fuse(  # noqa: PLR0917 - the two paths and what each leaves open
        self,
        raw_nm: float,
        loss_nm: float,
        half_nm: float,
        velocity_rad_s: float,
        torsion_nm: float,
        open_nm: float = 0.0,
    ) -> tuple[float, float]:
        """Return (physics, sigma) [Nm]; half_nm: `AdditiveLossModel.loss`; open_nm: `FusedObserved`."""
        c = (
            self._current
            + self._viscous * velocity_rad_s * velocity_rad_s
            + self._load * raw_nm * raw_nm
            + half_nm * half_nm
        )
        value = raw_nm - loss_nm
        if not self._with_torsion:
            return value, sqrt(c + self._reference)
        t = self._torsion + self._torsion_load * torsion_nm * torsion_nm + open_nm * open_nm
        alpha = c / (c + t)
        return value + alpha * (torsion_nm - value), sqrt(alpha * t + self._reference)

    def fuse_many(  # noqa: PLR0917
        self,
        raw_nm: FloatArray,
        loss_nm: FloatArray,
        half_nm: FloatArray,
        velocity_rad_s: FloatArray,
        torsion_nm: FloatArray,
        open_nm: FloatArray | float = 0.0,
    ) -> tuple[FloatArray, FloatArray]:
        """Vectorised twin of `fuse`, arrays [n]."""
        alpha, sigma = self.weigh_many(raw_nm, half_nm, velocity_rad_s, torsion_nm, open_nm)
        value = raw_nm - loss_nm
        return value + alpha * (torsion_nm - value), sigma

    def weigh_many(
        self,
        raw_nm: FloatArray,
        half_nm: FloatArray,
        velocity_rad_s: FloatArray,
        torsion_nm: FloatArray,
        open_nm: FloatArray | float = 0.0,
    ) -> tuple[FloatArray, FloatArray]:
        """Return (alpha, sigma), arrays [n]: share of the torsion, and standard deviation of the fused value [Nm]."""
        c = self._current + self._viscous * velocity_rad_s**2 + self._load * raw_nm**2 + half_nm**2
        if not self._with_torsion:
            return np.zeros_like(c), np.sqrt(c + self._reference)
        t = self._torsion + self._torsion_load * torsion_nm**2 + np.square(open_nm)
        alpha = c / (c + t)
        return alpha, np.sqrt(alpha * t + self._reference)
