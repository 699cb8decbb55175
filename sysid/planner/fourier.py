"""Motions as finite Fourier series: Eq. (10) of the paper for a joint, and a windowed series for a current.

A trajectory begins and ends at rest. Eq. (10) adds a polynomial of fifth order to the series of the velocity, which has
enough coefficients for position, velocity and acceleration at both ends. For a current the same polynomial would cancel the
offset: a constant is its own polynomial. The current is therefore multiplied by a smooth step up at its beginning and down
at its end.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, Final

import numpy as np
from numpy.polynomial.polynomial import polyder, polyval
from numpy.typing import ArrayLike

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.decoder import FieldError, below, check, limits, parsed

RAMP_SHARE: Final = 0.1
"""Part of a current series' duration in which it rises from zero, and in which it falls back to zero."""
MAX_HARMONICS: Final = 50
_AMPLITUDES: Final = f"a list of 1 to {MAX_HARMONICS} finite numbers"


def _amplitudes(value: Any) -> tuple[float, ...]:
    if not isinstance(value, list | tuple) or not 1 <= len(value) <= MAX_HARMONICS:
        raise FieldError("fourier", "", value, _AMPLITUDES)
    for item in value:
        if isinstance(item, bool) or not isinstance(item, int | float) or not math.isfinite(item):
            raise FieldError("fourier", "", item, _AMPLITUDES)
    return tuple(float(item) for item in value)


Amplitudes = Annotated[tuple[float, ...], parsed(_amplitudes, _AMPLITUDES)]


@dataclass(frozen=True)
class Series:
    """Amplitudes a, b of sines and cosines of omega_rad_s [rad/s] and its multiples; length duration_s [s].

    Raises FieldError (a ConfigError): a number that is not finite, omega or duration not positive, none or too many or
    unequally many amplitudes.
    """

    omega_rad_s: Annotated[float, limits("rad/s", gt=0.0)]
    a: Amplitudes
    b: Amplitudes
    duration_s: Annotated[float, limits("s", gt=0.0)]

    def __post_init__(self) -> None:
        check(self, "fourier")
        for key in ("a", "b"):
            with below(key):
                _amplitudes(getattr(self, key))
        if len(self.a) != len(self.b):
            raise FieldError("fourier", "b", list(self.b), f"as many numbers as in 'a', {len(self.a)}")

    def to_mapping(self) -> dict[str, Any]:
        """Return the series as it stands in a plan, in Python's own numbers; the duration belongs to the segment."""
        return {
            "omega_rad_s": float(self.omega_rad_s),
            "a": [float(x) for x in self.a],
            "b": [float(x) for x in self.b],
        }


class FourierTrajectory(Series):
    """Motion of a joint by Eq. (10), joint side, from rest at position 0 to rest at position 0; a, b [rad/s].

        theta(t) = sum_k [a_k/(k w) sin(k w t) - b_k/(k w) cos(k w t)] + sum_j c_j t^(j-1),   k = 1..N, j = 1..6

    with velocity and acceleration as its derivatives. Outside of [0, duration_s] it rests. The motion is linear in (a, b).
    """

    @cached_property
    def polynomial(self) -> FloatArray:
        """c_1..c_6 [rad/s^(j-1)] that take position, velocity and acceleration to zero at both ends.

        In u = t/T the first three coefficients are the start itself; the other three follow from the end in closed form.
        """
        T = self.duration_s
        (p0, v0, a0), (p1, v1, a1) = (
            (0.0 - float(s) for s in self._series(np.float64(time))) for time in (0.0, T)
        )
        d0, d1, d2 = p0, v0 * T, 0.5 * a0 * T * T
        # what remains for u^3, u^4, u^5 at u = 1: value, first and second derivative
        p = p1 - (d0 + d1 + d2)
        v = v1 * T - (d1 + 2.0 * d2)
        a = a1 * T * T - 2.0 * d2
        d3, d4, d5 = 10.0 * p - 4.0 * v + 0.5 * a, -15.0 * p + 7.0 * v - a, 6.0 * p - 3.0 * v + 0.5 * a
        return np.asarray(np.array([d0, d1, d2, d3, d4, d5]) / T ** np.arange(6.0))

    def _series(self, t: Any) -> tuple[Any, Any, Any]:
        """Return position, velocity and acceleration of the bare series at t (scalar or array)."""
        position, velocity, acceleration = 0.0 * t, 0.0 * t, 0.0 * t
        for k, (a, b) in enumerate(zip(self.a, self.b, strict=True), 1):
            w = k * self.omega_rad_s
            sine, cosine = np.sin(w * t), np.cos(w * t)
            position = position + (a * sine - b * cosine) / w
            velocity = velocity + (a * cosine + b * sine)
            acceleration = acceleration + (b * cosine - a * sine) * w
        return position, velocity, acceleration

    def motion(self, time_s: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return position [rad], velocity [rad/s] and acceleration [rad/s^2], joint side, at time_s [s], any shape."""
        t = np.clip(np.asarray(time_s, dtype=np.float64), 0.0, self.duration_s)
        position, velocity, acceleration = (
            np.asarray(series + polyval(t, polyder(self.polynomial, order)))
            for order, series in enumerate(self._series(t))
        )
        return position, velocity, acceleration


@dataclass(frozen=True)
class FourierSeries(Series):
    """Current of the driving joint, zero with zero slope and curvature at both ends; a, b, offset_a [A].

        i(t) = r(t) (offset + sum_k [a_k cos(k w t) + b_k sin(k w t)])

    r is a `smooth_step` up over the first RAMP_SHARE of the duration and down over the last. Outside of [0, duration_s] the
    current is zero. Linear in (offset, a, b).
    """

    offset_a: Annotated[float, limits("A")] = 0.0

    def value(self, time_s: ArrayLike) -> FloatArray:
        """Return the current [A] at time_s [s], any shape."""
        t = np.asarray(time_s, dtype=np.float64)
        x = np.clip(np.minimum(t, self.duration_s - t) / (RAMP_SHARE * self.duration_s), 0.0, 1.0)
        series = np.full_like(t, self.offset_a)
        for k, (a, b) in enumerate(zip(self.a, self.b, strict=True), 1):
            phase = k * self.omega_rad_s * t
            series = series + (a * np.cos(phase) + b * np.sin(phase))
        return np.asarray(series * smooth_step(x))

    def to_mapping(self) -> dict[str, Any]:
        """Return the series as it stands in a plan."""
        return super().to_mapping() | {"offset_a": float(self.offset_a)}


def smooth_step(x: FloatArray) -> FloatArray:
    """10 x^3 - 15 x^4 + 6 x^5: from 0 to 1 over x in 0..1 with first and second derivative zero at both ends."""
    result: FloatArray = x * x * x * (10.0 + x * (-15.0 + 6.0 * x))
    return result
