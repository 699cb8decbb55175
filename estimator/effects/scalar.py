"""Elementwise functions for the hooks of effects, sample by sample: in the loop and in the emulated bench. No numpy.

The Maxwell slip is the friction of one elastic contact (Al-Bender, Lampaert, Swevers 2005, IEEE Trans. Automatic
Control 50): z follows the deflection d, dz = dd/travel, and slips at -1 and 1.
"""

from __future__ import annotations

import math
from typing import Final


class Scalar:
    """Functions of floats. `slip` remembers: one instance per effect and joint; at the first d the state is 0."""

    __slots__ = ("_last", "_z")

    def __init__(self) -> None:
        self._z = 0.0
        self._last = math.nan

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
