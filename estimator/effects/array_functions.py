"""Elementwise functions for the hooks of effects over whole runs: `effect.ScalarFunctions` for arrays."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray


class ArrayFunctions:
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
        # a plain loop: 0.1 us per sample, and the very numbers of `ScalarFunctions`
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
