"""Elementwise functions for the hooks of effects: `Scalar` sample by sample in the loop, `Whole` for runs.

The Maxwell slip is the friction of one elastic contact (Al-Bender, Lampaert, Swevers 2005, IEEE Trans. Automatic
Control 50): z follows the deflection d, dz = dd/travel, and slips at -1 and 1.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from jtqd.estimator.arrays import FloatArray


class Scalar:
    """Functions of floats. `slip` remembers: one instance per effect and joint; at the first d the state is 0."""

    __slots__ = ("_last", "_z")

    def __init__(self) -> None:
        self._z = 0.0
        self._last = math.nan

    @property
    def memory(self) -> tuple[float, ...]:
        """What it remembers from sample to sample."""
        return self._z, self._last

    @memory.setter
    def memory(self, values: tuple[float, ...]) -> None:
        self._z, self._last = values

    sin: Final = staticmethod(math.sin)
    cos: Final = staticmethod(math.cos)
    tanh: Final = staticmethod(math.tanh)

    @staticmethod
    def exp(a: float) -> float:
        """Return e^a, infinite where a float cannot hold it (as numpy)."""
        return math.exp(a) if a < 709.0 else math.inf

    @staticmethod
    def clip(a: float, low: float, high: float) -> float:
        """Return a held within low..high; NaN stays."""
        return low if a < low else high if a > high else a

    def slip(self, d: float, travel: float) -> float:
        """Return the state, -1 to 1, after the deflection went on to d; NaN: it stays where it was."""
        if d != d:  # noqa: PLR0124 - NaN, without a call
            return self._z
        step = (d - self._last) / travel
        self._last = d
        if step == step:  # noqa: PLR0124
            z = self._z + step
            self._z = 1.0 if z > 1.0 else -1.0 if z < -1.0 else z
        return self._z


class Whole:
    """Functions of arrays [n] in order of time. It remembers nothing: every array starts with z = 0."""

    __slots__ = ()

    sin: Final = np.sin
    cos: Final = np.cos
    tanh: Final = np.tanh
    clip: Final = staticmethod(np.clip)

    @staticmethod
    def exp(a: FloatArray) -> FloatArray:
        """Return e^a, infinite without a warning where a float cannot hold it."""
        with np.errstate(over="ignore"):
            result: FloatArray = np.exp(a)
        return result

    @staticmethod
    def slip(d: FloatArray, travel: float) -> FloatArray:
        """Return the states [n] of deflections d [n]; NaN: the state stays where it was."""
        last, z = math.nan, 0.0
        out: list[float] = []
        add = out.append
        # a plain loop: 0.1 us per sample, and the very numbers of `Scalar`
        for now in np.asarray(d, np.float64).tolist():
            step = (now - last) / travel
            if step == step:  # noqa: PLR0124
                z += step
                if z > 1.0:
                    z = 1.0
                elif z < -1.0:
                    z = -1.0
                last = now
            elif now == now:  # noqa: PLR0124
                last = now
            add(z)
        return np.array(out)
