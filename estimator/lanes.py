"""First-order recursions over long runs in arrays: many stretches of the run go forward side by side.

    z_k = a_k z_(k-1) + x_k                      |a_k| <= 1

A stretch begins WARM_UP time constants early with any state, and has forgotten it by the time it counts: e^-45 is
below what a float64 can tell apart. Each step of the loop is one operation on all stretches, so that a run of n samples
takes n/stretches steps. With a_k = 0 the recursion begins anew at sample k.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from estimator.friction import FloatArray

WARM_UP: Final = 45.0
_BLOCK: Final = 1 << 18
"""Samples that are laid out at a time: what they take in memory stays small."""
_STRETCH: Final = 512
_LEAST: Final = 2000
"""Shorter runs are over before this pays."""


def warm_up_steps(a: FloatArray) -> int | None:
    """Samples after which every state is forgotten, by the slowest a > 0; None when it takes too long to be worth it."""
    slow = a[a > 0.0]
    if len(a) < _LEAST or not len(slow):
        return None
    largest = float(slow.max())
    steps = int(np.ceil(-WARM_UP / np.log(largest))) + 1 if largest < 1.0 else len(a)
    return steps if steps <= len(a) // 8 else None


def recursion(a: FloatArray, x: FloatArray) -> FloatArray | None:
    """Return z [k, n] of a [n] and x [k, n], with z_(-1) = 0; None where a plain loop is as good (see `warm_up_steps`)."""
    warm = warm_up_steps(a)
    if warm is None:
        return None
    z = np.empty_like(x)
    state = np.zeros(len(x))
    for first in range(0, len(a), _BLOCK):
        end = min(first + _BLOCK, len(a))
        z[:, first:end] = _block(a[first:end], x[:, first:end], state, min(warm, end - first))
        state = z[:, end - 1]
    return z


def _block(a: FloatArray, x: FloatArray, state: FloatArray, warm: int) -> FloatArray:
    """z of one block; `state` is that before it."""
    rows, count = x.shape
    length = max(warm, _STRETCH)
    length += (9 - length) % 16  # columns a power of two apart would all meet in the same lines of the cache
    lanes = -(-count // length)
    # In front: nothing happens, so that the first lane keeps its state. Behind: zeros that nobody looks at.
    padded = np.zeros((rows + 1, warm + lanes * length))
    padded[0, :warm] = 1.0
    padded[0, warm : warm + count] = a
    padded[1:, warm : warm + count] = x
    step = padded.strides[1]
    view = np.lib.stride_tricks.as_strided(
        padded, (rows + 1, lanes, warm + length), (padded.strides[0], length * step, step), writeable=False
    )
    laid = np.ascontiguousarray(view.transpose(2, 0, 1))
    z = np.zeros((rows, lanes))
    z[:, 0] = state
    out = np.empty((length, rows, lanes))
    for now in laid[:warm]:
        np.multiply(z, now[0], out=z)
        np.add(z, now[1:], out=z)
    for now, there in zip(laid[warm:], out, strict=True):
        np.multiply(z, now[0], out=z)
        np.add(z, now[1:], out=z)
        there[...] = z
    return out.transpose(1, 2, 0).reshape(rows, lanes * length)[:, :count]


def bounded_sums(steps: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return z_k = clip(z_(k-1) + steps_k, -1, 1) [n] from z = -1 and from z = 1.

    What a stretch of steps does to any z is clip(z + sum, low, high), low and high being what it does to -1 and 1. So the
    stretches go side by side, each from there, and are put one after the other at the end.
    """
    count = len(steps)
    lanes = -(-count // (_STRETCH + 9))
    padded = np.zeros(lanes * (_STRETCH + 9))
    padded[:count] = steps
    laid = np.ascontiguousarray(padded.reshape(lanes, -1).T)
    total = np.cumsum(laid, axis=0)
    ends = np.empty((len(laid), 2, lanes))
    now = np.empty((2, lanes))
    now[0], now[1] = -1.0, 1.0
    for step, there in zip(laid, ends, strict=True):
        now += step
        np.maximum(now, -1.0, out=now)
        np.minimum(now, 1.0, out=now)
        there[...] = now
    first = np.empty((2, lanes))
    low, high = -1.0, 1.0
    sums, lows, highs = total[-1].tolist(), now[0].tolist(), now[1].tolist()
    for lane in range(lanes):
        first[:, lane] = low, high
        low = min(max(low + sums[lane], lows[lane]), highs[lane])
        high = min(max(high + sums[lane], lows[lane]), highs[lane])
    out = np.minimum(np.maximum(first + total[:, np.newaxis], ends[:, :1]), ends[:, 1:])
    low_all, high_all = out.transpose(1, 2, 0).reshape(2, -1)[:, :count]
    return low_all, high_all


def fading_maximum(values: FloatArray, kept: FloatArray) -> FloatArray:
    """Return m_k = max(values_k, kept_k m_(k-1)) [n] with m_(-1) = 0; values >= 0, 0 < kept <= 1."""
    out = np.empty_like(values)
    memory = 0.0
    for first in range(0, len(values), _STRETCH):
        part = slice(first, first + _STRETCH)
        product = np.cumprod(kept[part])  # 1e-154 at least, for the longest steps there are
        ratio = np.maximum.accumulate(values[part] / product)
        out[part] = product * np.maximum(ratio, memory)
        memory = float(out[part][-1])
    return out
