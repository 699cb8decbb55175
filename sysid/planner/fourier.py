"""Excitation motions as finite Fourier series: Eq. (10) of the paper for a joint, and its like for a current.

A trajectory must begin and end at rest. The paper adds a fifth-order polynomial to the series, which has just enough
coefficients for position, velocity and acceleration at both ends. For a current that would be of no use: the same
polynomial through the ends of a constant is that constant, so it would swallow the offset. The current is therefore
multiplied by a fifth-order polynomial that rises from 0 to 1 at its beginning and falls back at its end.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated, Any, Final, NamedTuple

import numpy as np
from numpy.polynomial.polynomial import polyder, polyval
from numpy.typing import ArrayLike

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.checked import ConfigError
from jtqd.estimator.decoder import FieldError, limits, parsed

RAMP_SHARE: Final = 0.1
"""Part of a current series' duration in which it rises from zero, and in which it falls back to zero."""
MAX_HARMONICS: Final = 50


class EndState(NamedTuple):
    """Where a trajectory begins or ends: position [rad], velocity [rad/s], acceleration [rad/s^2], joint side."""

    position_rad: float = 0.0
    velocity_rad_s: float = 0.0
    acceleration_rad_s2: float = 0.0


REST: Final = EndState()


def quintic_coefficients(start: EndState, end: EndState, duration_s: float) -> FloatArray:
    """Return c_1..c_6 of sum c_j t^(j-1): the one polynomial of fifth order with these two ends, t in [0, duration_s].

    In u = t/T the first three coefficients are the start itself; the other three follow from the end in closed form.
    """
    T = duration_s
    d0, d1, d2 = start.position_rad, start.velocity_rad_s * T, 0.5 * start.acceleration_rad_s2 * T * T
    # what is left for u^3, u^4, u^5 to do at u = 1: value, first and second derivative
    p = end.position_rad - (d0 + d1 + d2)
    v = end.velocity_rad_s * T - (d1 + 2.0 * d2)
    a = end.acceleration_rad_s2 * T * T - 2.0 * d2
    d3, d4, d5 = 10.0 * p - 4.0 * v + 0.5 * a, -15.0 * p + 7.0 * v - a, 6.0 * p - 3.0 * v + 0.5 * a
    scaled: FloatArray = np.array([d0, d1, d2, d3, d4, d5]) / T ** np.arange(6.0)
    return scaled


@dataclass(frozen=True)
class FourierTrajectory:
    """Motion of a joint by Eq. (10), joint side, from `start` to `end` within `duration_s`.

        theta(t) = sum_k [a_k/(k w) sin(k w t) - b_k/(k w) cos(k w t)] + sum_j c_j t^(j-1),   k = 1..N, j = 1..6

    with velocity and acceleration as its derivatives, and c_j computed so that both ends are the wanted ones. Before 0
    and after duration_s the values of the ends are held. The motion is linear in (a, b) when both ends are at rest at 0.

    Attributes:
        omega_rad_s: fundamental angular frequency w [rad/s], > 0. a, b: amplitudes of the velocity [rad/s], equal number.
        duration_s: length [s], > 0. start, end: wanted states of the ends.

    Raises:
        ConfigError: a number that is not finite, w or duration not positive, none or too many or unequal amplitudes.
    """

    omega_rad_s: float
    a: tuple[float, ...]
    b: tuple[float, ...]
    duration_s: float
    start: EndState = field(default=REST)
    end: EndState = field(default=REST)

    def __post_init__(self) -> None:
        _check("velocity", self.omega_rad_s, self.a, self.b, self.duration_s, *self.start, *self.end)

    def to_mapping(self) -> dict[str, Any]:
        """Return the plan's `velocity`; the duration belongs to the segment."""
        return _plain(self.omega_rad_s, self.a, self.b)

    @cached_property
    def polynomial(self) -> FloatArray:
        """c_1..c_6 [rad/s^(j-1)]: wanted ends less the ends of the series."""
        start, end = (
            EndState(*(w - float(s) for w, s in zip(wanted, self._series(np.float64(time)), strict=True)))
            for wanted, time in ((self.start, 0.0), (self.end, self.duration_s))
        )
        c = quintic_coefficients(start, end, self.duration_s)
        c.flags.writeable = False
        return c

    def _series(self, t: Any) -> tuple[Any, Any, Any]:
        """Position, velocity and acceleration of the bare series at t (scalar or array)."""
        position, velocity, acceleration = 0.0 * t, 0.0 * t, 0.0 * t
        for k, (a, b) in enumerate(zip(self.a, self.b, strict=True), 1):
            w = k * self.omega_rad_s
            sine, cosine = np.sin(w * t), np.cos(w * t)
            position = position + (a * sine - b * cosine) / w
            velocity = velocity + (a * cosine + b * sine)
            acceleration = acceleration + (b * cosine - a * sine) * w
        return position, velocity, acceleration

    def motion(self, time_s: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Position [rad], velocity [rad/s] and acceleration [rad/s^2], joint side, at time_s [s], any shape."""
        t = np.clip(np.asarray(time_s, dtype=np.float64), 0.0, self.duration_s)
        c = self.polynomial
        position, velocity, acceleration = (
            np.asarray(series + polyval(t, polyder(c, order))) for order, series in enumerate(self._series(t))
        )
        return position, velocity, acceleration

    def position(self, time_s: ArrayLike) -> FloatArray:
        """Position [rad, joint side] at time_s [s], any shape."""
        return self.motion(time_s)[0]

    def velocity(self, time_s: ArrayLike) -> FloatArray:
        """Return the velocity [rad/s, joint side] at time_s [s], any shape."""
        return self.motion(time_s)[1]

    def acceleration(self, time_s: ArrayLike) -> FloatArray:
        """Acceleration [rad/s^2, joint side] at time_s [s], any shape."""
        return self.motion(time_s)[2]


@dataclass(frozen=True)
class FourierSeries:
    """Current of the driving joint: offset and harmonics, zero with zero slope and curvature at both ends.

        i(t) = r(t) (offset + sum_k [a_k cos(k w t) + b_k sin(k w t)])

    r rises as 10 x^3 - 15 x^4 + 6 x^5 over the first RAMP_SHARE of the duration and falls so over the last. Outside of
    [0, duration_s] the current is zero. Linear in (offset, a, b).

    Attributes:
        omega_rad_s: fundamental angular frequency [rad/s]. a, b: amplitudes [A]. duration_s: length [s].
        offset_a: constant part [A].

    Raises:
        ConfigError: as FourierTrajectory.
    """

    omega_rad_s: float
    a: tuple[float, ...]
    b: tuple[float, ...]
    duration_s: float
    offset_a: float = 0.0

    def __post_init__(self) -> None:
        _check("current", self.omega_rad_s, self.a, self.b, self.duration_s, self.offset_a)

    def to_mapping(self) -> dict[str, Any]:
        """Return the plan's `current`; the duration belongs to the segment."""
        return {**_plain(self.omega_rad_s, self.a, self.b), "offset_a": float(self.offset_a)}

    def value(self, time_s: ArrayLike) -> FloatArray:
        """Current [A] at time_s [s], any shape."""
        t = np.asarray(time_s, dtype=np.float64)
        x = np.clip(np.minimum(t, self.duration_s - t) / (RAMP_SHARE * self.duration_s), 0.0, 1.0)
        series = np.full_like(t, self.offset_a)
        for k, (a, b) in enumerate(zip(self.a, self.b, strict=True), 1):
            phase = k * self.omega_rad_s * t
            series = series + (a * np.cos(phase) + b * np.sin(phase))
        return np.asarray(series * (x * x * x * (10.0 + x * (-15.0 + 6.0 * x))))


def _plain(omega: float, a: tuple[float, ...], b: tuple[float, ...]) -> dict[str, Any]:
    """Python's own numbers, whatever came in: YAML knows no others."""
    return {"omega_rad_s": float(omega), "a": [float(x) for x in a], "b": [float(x) for x in b]}


def _amplitudes(value: Any) -> tuple[float, ...]:
    if not isinstance(value, list | tuple) or not 1 <= len(value) <= MAX_HARMONICS:
        raise ValueError("found another number of amplitudes")
    for item in value:
        if isinstance(item, bool) or not isinstance(item, int | float) or not math.isfinite(item):
            raise FieldError("fourier", "", item, _AMPLITUDES)
    return tuple(float(item) for item in value)


_AMPLITUDES: Final = f"a list of 1 to {MAX_HARMONICS} finite numbers"


@dataclass(frozen=True)
class SeriesFile:
    """`velocity` and `current` of a plan's fourier segment: amplitudes in rad/s or A; offset_a of a current alone."""

    omega_rad_s: Annotated[float, limits("rad/s", gt=0.0)]
    a: Annotated[tuple[float, ...], parsed(_amplitudes, _AMPLITUDES)]
    b: Annotated[tuple[float, ...], parsed(_amplitudes, _AMPLITUDES)]

    def __post_init__(self) -> None:
        if len(self.a) != len(self.b):
            raise FieldError("fourier", "b", list(self.b), f"as many numbers as in 'a', {len(self.a)}")


@dataclass(frozen=True)
class CurrentFile(SeriesFile):
    """`current` of a plan's fourier segment."""

    offset_a: Annotated[float, limits("A")] = 0.0


def _check(
    name: str, omega: float, a: tuple[float, ...], b: tuple[float, ...], duration_s: float, *others: float
) -> None:
    if not all(math.isfinite(x) for x in (omega, duration_s, *a, *b, *others)):
        raise ConfigError(f"fourier {name}: found a number that is not finite")
    if omega <= 0.0 or duration_s <= 0.0:
        raise ConfigError(
            f"fourier {name}: found omega_rad_s {omega:g} and duration {duration_s:g} s, expected both > 0"
        )
    if not 1 <= len(a) <= MAX_HARMONICS or len(a) != len(b):
        raise ConfigError(
            f"fourier {name}: found {len(a)} numbers in a and {len(b)} in b, expected 1 to {MAX_HARMONICS}, equally many"
        )
