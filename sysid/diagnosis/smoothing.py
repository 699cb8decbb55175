"""Signals and their derivatives as regressors have them: with little of the noise that the same sample has in a residual.

Currents and torques are smoothed over a few milliseconds (`calm`), because their noise is also in the residual, and would be
explained by itself at the frequencies where there is nothing else. Samples too far apart for smoothing are interpolated from
their neighbours. Derivatives are central differences, which look ahead: this is for recorded runs.
"""

from __future__ import annotations

import functools
from typing import Final

import numpy as np
from scipy import signal

from jtqd.estimator.arrays import FloatArray

_SMOOTH_S: Final = 0.005
_RATE_SMOOTH: Final = 0.4
"""Part of _SMOOTH_S over which a torque is smoothed before its rate is taken."""
_CUBIC_S: Final = 0.014
"""So long is the part of a current that is taken for a cubic before its rate is taken."""
_ENOUGH: Final = 5
"""Samples within _SMOOTH_S from which an average of them holds little of each one's own noise."""
_NEAR_S: Final = 0.008
"""So far away are the neighbours that tell what a sample is, where there are fewer; two on either side at least."""


def calm(x: FloatArray, step_s: float) -> FloatArray:
    """Return x [n], sampled every step_s, as regressors have it: with little of the noise that the same sample has in a
    residual.

    Smoothed over _SMOOTH_S where that is enough samples. An average of fewer keeps half of each sample's own noise and more,
    at 250 Hz all of it: a gain of that channel is then found by the noise beside the signal, and noise of a torsion moves
    what slips with it. There each sample is the value of the cubic through its neighbours, with none of its own noise. That
    keeps 0.98 of what swings at 25 Hz and 0.7 of 50 Hz, at 250 Hz as at 500. The noise of the neighbours is in residuals as
    well, but of both signs: where all frequencies count alike it adds up to nothing.
    """
    wide = _smoothed_samples(step_s)
    if wide >= _ENOUGH:
        return smooth(x, wide)
    weights = _neighbours(max(2, round(_NEAR_S / step_s)))
    result: FloatArray = np.convolve(np.pad(x, len(weights) // 2, mode="edge"), weights, "valid")
    return result


def reach_of_calm(step_s: float) -> float:
    """Return how far away samples are, s, of which `calm` makes one."""
    return _SMOOTH_S if _smoothed_samples(step_s) >= _ENOUGH else max(_NEAR_S, 2.0 * step_s)


def _smoothed_samples(step_s: float) -> int:
    return max(1, round(_SMOOTH_S / max(step_s, 1e-9)))


@functools.lru_cache(maxsize=16)
def _neighbours(reach: int) -> FloatArray:
    """Return the weights [2 reach + 1] that give the middle of a cubic through the others (least squares)."""
    at = np.arange(-reach, reach + 1)
    others = at[at != 0]
    weights = np.zeros(len(at))
    weights[at != 0] = np.linalg.pinv(np.vander(others / reach, 4, increasing=True))[0]
    return weights


def sensor_rate(x: FloatArray, time: FloatArray) -> FloatArray:
    """Return the derivative [n] of the sensor's torque as regressors have it.

    The noise of a difference has little part in that of the same sample, so less is smoothed than in the signal itself
    (`calm`), which has 0.8 of what swings at 50 Hz: a delay would be found larger by as much. Samples that are too far apart
    for that are not smoothed at all; a difference of second order over 8 ms would have 0.84 of 40 Hz.
    """
    wide = _smoothed_samples(float(np.median(np.diff(time))))
    return first_difference(smooth(x, round(_RATE_SMOOTH * wide)) if wide >= _ENOUGH else x, time)


def current_rate(x: FloatArray, time: FloatArray) -> FloatArray:
    """Return the derivative [n] of a current as regressors have it.

    Its noise is a tenth and more of its rate, and makes a delay smaller than it is, where little is smoothed: by a third on
    a bench with slow motions. Cubics through _CUBIC_S of samples take as much of the noise as `calm` does and leave 0.9 of
    what swings at 50 Hz. Samples that are far apart are interpolated from their neighbours.
    """
    step = float(np.median(np.diff(time)))
    if _smoothed_samples(step) < _ENOUGH:
        return np.asarray(np.gradient(calm(x, step), time))
    wide = 2 * round(0.5 * _CUBIC_S / step) + 1
    if len(x) < wide:
        return first_difference(x, time)
    return first_difference(signal.savgol_filter(x, wide, 3, mode="nearest"), time)


def slow(x: FloatArray, step_s: float) -> FloatArray:
    """Return x [n] without what is too quick for the second difference of a torque to be known."""
    return smooth(x, _smoothed_samples(step_s))


def smooth(x: FloatArray, samples: int) -> FloatArray:
    """Return x twice averaged over `samples` (odd or even, centred together), ends held."""
    out = x
    for before in (samples // 2, samples - 1 - samples // 2):
        padded = np.pad(out, (before, samples - 1 - before), mode="edge")
        total = np.cumsum(np.concatenate(([0.0], padded)))
        out = (total[samples:] - total[:-samples]) / samples
    result: FloatArray = out
    return result


def mean_ahead(time_s: FloatArray, x: FloatArray, span_s: float) -> FloatArray:
    """Return the mean of x from each time to span_s later [n]; the last value goes on after the end, the first before.

    All samples between are in it, so that it has the noise of a difference over the span where x is a rate.
    """
    steps = np.diff(time_s)
    sums = np.concatenate(([0.0], np.cumsum(0.5 * (x[1:] + x[:-1]) * steps)))
    later = time_s + span_s
    inside = np.clip(later, time_s[0], time_s[-1])
    k = np.clip(np.searchsorted(time_s, inside, "right") - 1, 0, len(steps) - 1)
    u = inside - time_s[k]
    # x in straight lines from sample to sample
    ahead = sums[k] + u * (x[k] + 0.5 * u * (x[k + 1] - x[k]) / steps[k])
    ahead += np.maximum(later - time_s[-1], 0.0) * x[-1] - np.maximum(time_s[0] - later, 0.0) * x[0]
    return np.asarray((ahead - sums) / span_s)


def second_difference(x: FloatArray, time: FloatArray) -> FloatArray:
    """Return the second derivative [n]: fourth order on even steps, so that a ripple of 80 Hz at 1 kHz keeps its size
    (two central differences would take 8 % of it); plain differences where steps are uneven; ends held.
    """
    steps = np.diff(time)
    step = float(np.median(steps))
    if len(x) < 5 or float(np.max(np.abs(steps - step))) > 0.05 * step:
        return np.asarray(np.gradient(np.gradient(x, time), time))
    inner = (16.0 * (x[3:-1] + x[1:-3]) - x[4:] - x[:-4] - 30.0 * x[2:-2]) / (12.0 * step * step)
    return np.pad(inner, 2, mode="edge")


def first_difference(x: FloatArray, time: FloatArray) -> FloatArray:
    """Return the first derivative [n], as `second_difference`."""
    steps = np.diff(time)
    step = float(np.median(steps))
    if len(x) < 5 or float(np.max(np.abs(steps - step))) > 0.05 * step:
        return np.asarray(np.gradient(x, time))
    inner = (8.0 * (x[3:-1] - x[1:-3]) - (x[4:] - x[:-4])) / (12.0 * step)
    return np.pad(inner, 2, mode="edge")
