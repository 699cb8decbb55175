"""Derivatives, noise and filters of recorded signals; all look ahead, none delays.

**Resolution.** Recorders keep seven significant digits, single precision, fixed decimals or counts. A motor position beyond
1000 rad with seven digits has steps of 1 mrad; their second difference is noise of some newton metres at the joint. Steps of
digits and of single precision grow with the value, so they are estimated from the values, for each magnitude by itself.
Where the acceleration would be coarse, both balances are judged below a cutoff: residuals and regressors pass one filter.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import signal

from jtqd.estimator.arrays import BoolArray, FloatArray


def below(x: FloatArray, step_s: float, hz: float) -> FloatArray:
    """Return x [.., n] without what is quicker than hz, without delay."""
    reach = min(x.shape[-1] - 1, max(12, round(1.0 / (hz * step_s))))
    sections, state = _low_pass(min(hz * step_s, _HIGHEST))
    state = state.reshape(len(state), *[1] * (x.ndim - 1), 2)
    # odd extension at both ends, forward and backward: `signal.sosfiltfilt` with the initial state of its steps kept
    ends = 2.0 * x[..., :1] - x[..., reach:0:-1], 2.0 * x[..., -1:] - x[..., -2 : -reach - 2 : -1]
    out = np.concatenate((ends[0], x, ends[1]), axis=-1)
    for _ in range(2):
        out = signal.sosfilt(sections, out, zi=state * out[..., :1])[0][..., ::-1]
    return np.asarray(out[..., reach:-reach])


def mean_ahead(time_s: FloatArray, x: FloatArray, span_s: float) -> FloatArray:
    """Return the mean of x from each time to span_s later [n]; the last value goes on after the end, the first before."""
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
    """Return the second derivative [n]: eighth order on even steps, so that a wave of a sixth of the sampling rate keeps its
    size to 0.1 % (fourth order would take 1.3 % of it); plain differences where steps are uneven; ends held.
    """
    step = _even_step(time)
    if step is None:
        return np.asarray(np.gradient(np.gradient(x, time), time))
    inner = SECOND[0] * x[REACH:-REACH]
    for k, weight in enumerate(SECOND[1:], 1):
        inner = inner + weight * (x[REACH + k : len(x) - REACH + k] + x[REACH - k : len(x) - REACH - k])
    return np.pad(inner / (step * step), REACH, mode="edge")


def first_difference(x: FloatArray, time: FloatArray) -> FloatArray:
    """Return the first derivative [n], as `second_difference`."""
    step = _even_step(time)
    if step is None:
        return np.asarray(np.gradient(x, time))
    inner = np.zeros(len(x) - 2 * REACH)
    for k, weight in enumerate(FIRST, 1):
        inner += weight * (x[REACH + k : len(x) - REACH + k] - x[REACH - k : len(x) - REACH - k])
    return np.pad(inner / step, REACH, mode="edge")


def _even_step(time: FloatArray) -> float | None:
    """Return the step of these times, None where they are uneven or too few for a difference of eighth order."""
    steps = np.diff(time)
    step = float(np.median(steps))
    return step if len(time) > 2 * REACH and float(np.max(np.abs(steps - step))) <= 0.05 * step else None


FIRST: Final = 4 / 5, -1 / 5, 4 / 105, -1 / 280
"""Weights of the eighth order by distance, from one step on: of differences."""
SECOND: Final = -205 / 72, 8 / 5, -1 / 5, 8 / 315, -1 / 560
"""The same from none on: of sums."""
REACH: Final = 4
"""Samples that they reach to both sides."""
_SAME: Final = 1e-8
"""Values closer than this part of the largest are one: double precision, or twelve digits of a count."""
_DIGITS: Final = 9
"""Significant digits from which a decimal is as good as none."""
_ON_GRID: Final = 0.95
"""Part of the distances between values that are whole steps, on a grid."""
_COARSE: Final = 0.25
"""Part of a grid's step to which a distance must be known, to show it."""
_FEW: Final = 12
"""Steps of a grid that the least distance between values may be."""
_OFF: Final = 0.02
"""Part of a step by which they may be off it."""
_OFTEN: Final = 1.25
"""Mean times of a value that comes more than once."""
_SHOWN: Final = 8
"""Values that show a step."""
_SEGMENT: Final = 64
"""Samples of a spectrum."""
_SLOW: Final = 0.125
"""Part of the sampling rate below which all is motion."""
_BANDS: Final = 6
"""Above it; motion and lines leave one of them."""
_CALMEST: Final = 0.3
"""Quantile over the segments: in fewer of them a joint reverses or is pushed."""
_OF_NOISE: Final = 0.587
"""This quantile of a band's energy, in white noise of unit variance."""
_ALIKE: Final = 20.0
"""Over the root of the samples: by this part the densities of white noise in two bands may differ by chance."""
_ORDER: Final = 3
_SLOWEST_HZ: Final = 8.0
"""No cutoff is lower: there is the motion itself."""
_LITTLE: Final = 0.3
"""Part of a run that may be finer than the rest without bins as short as its own."""
_STEP: Final = 1.25
"""Cutoffs that differ by less are one."""
_HIGHEST: Final = 0.45
"""Part of the sampling rate up to which there are cutoffs."""


def steps_of(x: FloatArray) -> FloatArray:
    """Return the steps of the values near each sample [n], in units of x; 0 where they are finer than shows: of decimals
    (fixed, or significant digits), single precision, or counts, which are the same everywhere.
    """
    out, step = np.zeros(len(x)), 0.0
    decade = np.floor(np.log10(np.maximum(np.abs(x), 1e-30)))
    for there in (decade == e for e in np.unique(decade)):
        values, enough = np.unique(x[there]), min(_SHOWN, max(2, there.sum() // 2))
        if len(values) > enough:  # else at rest or commanded: they have that of the decade before
            step = _decimal(values, float(np.max(np.abs(values))))
        out[there] = step
    short = np.abs(x).astype(np.float32)
    if np.array_equal(short, np.abs(x)):
        out = np.maximum(out, np.spacing(short))
    values, first, times = np.unique(x, return_index=True, return_counts=True)
    return np.maximum(out, _counts(values, out[first], again=times.mean() > _OFTEN))


def described(x: FloatArray, unit: str) -> str:
    """Return the steps of the values in words: "steps of 1e-05 rad, 0.001 rad beyond 1000 rad"; "" without steps."""
    steps = steps_of(x)
    worst = float(np.max(steps, initial=0.0))
    if worst <= 0.0:
        return ""
    finest = float(np.min(steps))
    if finest > 0.7 * worst:
        return f"steps of {worst:.2g} {unit}"
    beyond = float(np.min(np.abs(x[steps > 0.7 * worst])))
    return f"steps of {worst:.2g} {unit} beyond {beyond:.3g} {unit}, finer ones below"


def noise_of(x: FloatArray) -> FloatArray:
    """Return the standard deviation of the white noise near each sample [n]: of the steps, and of as much beside them as the
    bands of least density show in their calmest moments.

    Of sixth differences, so that what is slow does not leak (Welch 1967, IEEE Trans. Audio Electroacoust. 15).
    """
    steps = np.asarray(steps_of(x) / math.sqrt(12.0))
    if len(x) < 2 * _SEGMENT:
        return steps
    hz, _, power = signal.spectrogram(np.diff(x, 6), 1.0, "hann", _SEGMENT, _SEGMENT // 2, detrend=False)
    high = (hz >= _SLOW) & (hz < 0.5)
    beside = hz[high, None] + np.array([-1.0, 0.0, 1.0]) / _SEGMENT  # as the window mixes them
    white = (2.0 * (2.0 * np.sin(np.pi * beside)) ** 12) @ np.array([[1.0], [4.0], [1.0]]) / 6.0
    bands = np.array_split(power[high] / (_OF_NOISE * white), _BANDS)
    least = np.array([np.quantile(band.mean(axis=0), _CALMEST) for band in bands])
    alike = least[least <= (1.0 + _ALIKE / math.sqrt(len(x))) * least.min()]
    return np.asarray(np.sqrt(steps**2 + max(float(alike.mean() - np.mean(steps**2)), 0.0)))


def known_below_hz(x: FloatArray, step_s: float) -> float:
    """Return the cutoff that leaves all of x [n], sampled every step_s, that has more power than its noise: twice the
    highest such frequency, as a filter is not steep; 0 where there is none.

    Of differences of x, so that what is slow does not leak (Welch 1967, IEEE Trans. Audio Electroacoust. 15).
    """
    segment = min(len(x) - 1, max(16, round(0.5 / step_s)))
    hz, power = signal.welch(np.diff(x), 1.0 / step_s, nperseg=segment)
    white = 2.0 * step_s * float(np.mean(noise_of(x) ** 2)) * 4.0 * np.sin(np.pi * hz * step_s) ** 2
    return 2.0 * float(hz[power > 2.0 * white].max(initial=0.0))


def _decimal(values: FloatArray, largest: float) -> float:
    """Return the power of ten of which all values are multiples, 0 where they have more digits than _DIGITS."""
    place = math.floor(math.log10(largest)) - _DIGITS
    for k in range(place, place + _DIGITS + 2):
        scaled = values * 10.0 ** (-k)
        if np.max(np.abs(scaled - np.round(scaled))) > 1e-6:
            return 10.0 ** (k - 1) if k > place else 0.0
    return 0.0


def _counts(values: FloatArray, printed: FloatArray, *, again: bool) -> float:
    """Return the step of the grid on which the values of a channel [m] are, ascending, 0 where there is none or too few show
    it; printed: step to which each is known; again: values came more than once.

    A channel has one grid, so what coarse digits or steady motions leave open other values tell. The least distance is a
    few steps; larger ones tell the step better and better. Of a steady motion all distances are alike, too.
    """
    apart, coarse = np.diff(values), np.maximum(printed[1:], printed[:-1])
    good = np.flatnonzero(apart > _SAME * max(float(np.max(np.abs(values))), 1e-12))
    order = good[np.argsort(apart[good])]
    apart, coarse = apart[order], coarse[order]
    seen = apart[coarse < _COARSE * apart]
    for few in range(1, _FEW + 1) if len(seen) else ():
        step = float(seen[0]) / few
        known = np.flatnonzero(coarse < _COARSE * step)
        for k in range(1, len(known).bit_length() + 1):
            least = apart[known[: 2**k]]
            times = np.round(least / step)
            step = float(times @ least) / max(float(times @ times), 1.0) or step
        times = np.round(apart[known] / step)
        on = (times > 0.0) & (np.abs(apart[known] / step - times) < _OFF + coarse[known] / step)
        if len(on) >= _SHOWN and (again or len(np.unique(times)) > 2) and on.mean() >= _ON_GRID:
            return step
    return 0.0


def acceleration_noise(
    sigma: FloatArray | float, step_s: float, hz: float, *, of_velocity: bool
) -> FloatArray:
    """Return the rms, below `hz`, of the acceleration taken from samples every step_s with white noise sigma: of a position,
    or of a velocity.
    """
    density = 2.0 * np.asarray(sigma, np.float64) ** 2 * step_s
    power, turn = (3, (2.0 * math.pi) ** 2) if of_velocity else (5, (2.0 * math.pi) ** 4)
    return np.sqrt(density * turn * hz**power / power)


def cutoff_hz(sigma: FloatArray, step_s: float, most: float, *, of_velocity: bool) -> FloatArray:
    """Return below which frequency the acceleration's noise is `most` [n]; at least _SLOWEST_HZ, inf without noise."""
    one = acceleration_noise(sigma, step_s, 1.0, of_velocity=of_velocity)
    power = 1.5 if of_velocity else 2.5
    with np.errstate(divide="ignore"):
        hz = (most / one) ** (1.0 / power)
    return np.maximum(hz, _SLOWEST_HZ)


@functools.lru_cache(maxsize=64)
def _low_pass(part: float) -> tuple[FloatArray, FloatArray]:
    """Return the sections of a Butterworth low-pass and their state after ones for ever; part: of the sampling rate."""
    sections = np.asarray(signal.butter(_ORDER, part, fs=1.0, output="sos"))
    return sections, np.asarray(signal.sosfilt_zi(sections))


@dataclass(frozen=True)
class Smoother:
    """A low-pass without delay whose cutoff depends on the sample: (cutoff [Hz], where it holds [n]) in `parts`; elsewhere
    the signal as it is.
    """

    step_s: float
    parts: tuple[tuple[float, BoolArray], ...] = ()

    @staticmethod
    def of(hz: FloatArray, step_s: float) -> Smoother:
        """Return the smoother of these cutoffs [n]; those about the highest frequency that samples hold are none."""
        level = np.where(
            hz < _HIGHEST / step_s, np.floor(np.log(np.minimum(hz, 1e9)) / math.log(_STEP)), np.inf
        )
        levels = np.unique(level[np.isfinite(level)])
        return Smoother(step_s, tuple((_STEP ** float(k), np.asarray(level == k)) for k in levels))

    @property
    def slowest_hz(self) -> float:
        """The lowest cutoff, inf without any."""
        return min((hz for hz, _ in self.parts), default=math.inf)

    @property
    def highest_hz(self) -> float:
        """The highest cutoff; inf where a part is not filtered that is more than _LITTLE."""
        if not self.parts:
            return math.inf
        count = sum(int(there.sum()) for _, there in self.parts)
        whole = len(self.parts[0][1])
        return max(hz for hz, _ in self.parts) if whole - count <= _LITTLE * whole else math.inf

    def __call__(self, x: FloatArray) -> FloatArray:
        """Return x [.., n] filtered, rows one by one."""
        if not self.parts:
            return x
        out = np.array(x, np.float64)
        for hz, there in self.parts:
            out[..., there] = below(x, self.step_s, hz)[..., there]
        return out
