"""Noise of the channels: coloured in time and correlated between channels. Residuals become whitened sums.

Each channel's noise is an autoregression (Yule-Walker over the valid stretches, Levinson's recursion); what is left is
correlated between channels, because one sensor serves all of them, and is weighted by the inverse of its covariance.
Rows where a channel is not valid are left out of that channel alone. After both steps every row counts as one measurement
of unit variance. The effective number of samples is the number of rows times the information that each still has.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.sysid.diagnosis.regressors import ChannelData, Index, RunData
from jtqd.sysid.diagnosis.signals import Channel

ORDER: Final = 24
_LITTLE: Final = 1e-6
_BLOCK_S: Final = 1.0


@dataclass(frozen=True)
class Noise:
    """Model of all channels: AR coefficients, innovation variances, correlation of innovations, and `inflation`: how
    much more the sums over blocks of a second scatter than white noise would.
    """

    channels: tuple[Channel, ...]
    ar: Mapping[Channel, FloatArray]
    sigma: FloatArray
    correlation: FloatArray
    inflation: float


def saturated_residuals(
    runs: Sequence[RunData], channel: Channel, leave: Collection[int] = ()
) -> list[FloatArray]:
    """Return what no effect and no change from run to run explains, per run [n], NaN where not valid.

    leave: columns not to use. The residual is a sum of measured terms (current, friction, acceleration, sensor); with a
    regressor for each of them it would be explained completely by taking all of them away.
    """
    data = [run.channels[channel] for run in runs if channel in run.channels]
    keep = np.flatnonzero(~np.isin(data[0].index, list(leave)))
    q = data[0].nuisances.shape[1]
    p = len(keep)
    total = p + q * len(data)
    gram, right = np.zeros((total, total)), np.zeros(total)
    blocks = []
    for r, d in enumerate(data):
        x = np.hstack((d.regressors[:, keep], d.nuisances))[d.valid]
        places = np.concatenate((np.arange(p), p + q * r + np.arange(q)))
        gram[np.ix_(places, places)] += x.T @ x
        right[places] += x.T @ d.residual[d.valid]
        blocks.append(places)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(gram), 1e-30))
    scaled = gram * scale[:, None] * scale[None, :]
    solution = scale * np.linalg.solve(scaled + 1e-7 * np.eye(total), scale * right)
    out = []
    for places, d in zip(blocks, data, strict=True):
        rest = d.residual - np.hstack((d.regressors[:, keep], d.nuisances)) @ solution[places]
        out.append(np.where(d.valid, rest, np.nan))
    return out


def autoregression(stretches: Sequence[FloatArray], order: int = ORDER, white: float = _LITTLE) -> FloatArray:
    """Return a [order]: x_t = sum a_k x_{t-k} + e, by Yule-Walker over series with NaN for gaps (Levinson); white: variance
    of white noise on top of them, in theirs.
    """
    covariance = np.zeros(order + 1)
    for x in stretches:
        good = np.isfinite(x)
        y = np.where(good, x, 0.0)
        for lag in range(min(order + 1, len(y))):
            covariance[lag] += float(y[lag:] @ y[: len(y) - lag])
    counts = np.array(
        [
            sum(int(np.sum(np.isfinite(x[k:]) & np.isfinite(x[: len(x) - k]))) for x in stretches)
            for k in range(order + 1)
        ],
        np.float64,
    )
    c = covariance / np.maximum(counts, 1.0)
    c[0] *= 1.0 + white
    a = np.zeros(order)
    error = c[0]
    for k in range(order):
        if error <= 0.0:
            break
        reflection = (c[k + 1] - float(a[:k] @ c[k:0:-1])) / error
        if abs(reflection) >= 1.0:
            break
        a[:k], a[k] = a[:k] - reflection * a[:k][::-1], reflection
        error *= 1.0 - reflection * reflection
    return a


def whiten(x: FloatArray, a: FloatArray) -> FloatArray:
    """Return x_t - sum a_k x_{t-k} along axis 0; the first rows, whose past is unknown, take it as zero."""
    out = x.copy()
    for k, weight in enumerate(a, 1):
        if weight != 0.0:
            out[k:] -= weight * x[:-k]
    return out


def past_valid(valid: BoolArray, order: int) -> BoolArray:
    """Return where a row and its `order` predecessors are valid."""
    run = np.concatenate(([0], np.cumsum(valid)))
    out = np.zeros(len(valid), bool)
    if len(valid) > order:
        out[order:] = run[order + 1 :] - run[: -order - 1] == order + 1
    return out


def noise_model(
    runs: Sequence[RunData],
    residuals: Mapping[Channel, list[FloatArray]],
    step_s: float,
    floor: float = 0.0,
) -> Noise:
    """Return the noise of all channels from what nothing explains.

    floor: white noise on top, as part of the density of what is slow, at most of the mean. A model errs at frequencies at
    which its data hold little, and a small residual there is no small noise: with a floor of 1 nothing quick has more weight
    than what is slow (diagonal loading: Carlson 1988, IEEE Trans. Aerosp. Electron. Syst. 24).
    """
    channels = tuple(residuals)
    block = max(1, round(_BLOCK_S / step_s))
    rms = {c: max(float(np.sqrt(np.nanmean(np.concatenate(residuals[c]) ** 2))), 1e-12) for c in channels}
    on_top = {c: max(floor * min(_slowness(residuals[c], rms[c], block), 1.0), _LITTLE) for c in channels}
    ar = {c: autoregression(residuals[c], white=on_top[c]) for c in channels}
    white: list[list[FloatArray]] = []
    for c in channels:
        mine = []
        for x in residuals[c]:
            good = past_valid(np.isfinite(x), ORDER)
            mine.append(np.where(good, whiten(np.nan_to_num(x), ar[c]), np.nan))
        white.append(mine)
    sigma = np.array([max(float(np.sqrt(np.nanmean(np.concatenate(w) ** 2))), 1e-12) for w in white])
    sigma = np.sqrt(sigma**2 + [on_top[c] * rms[c] ** 2 * (1.0 + float(ar[c] @ ar[c])) for c in channels])
    stacked = np.array([np.concatenate(w) / s for w, s in zip(white, sigma, strict=True)])
    count = len(channels)
    correlation = np.eye(count)
    for a in range(count):
        for b in range(a):
            both = np.isfinite(stacked[a]) & np.isfinite(stacked[b])
            if both.sum() > 100:
                correlation[a, b] = correlation[b, a] = float(np.mean(stacked[a, both] * stacked[b, both]))
    correlation = _definite(correlation)
    return Noise(channels, ar, sigma, correlation, _inflation(white, sigma, block))


def white_noise(
    runs: Sequence[RunData], residuals: Mapping[Channel, list[FloatArray]], step_s: float
) -> Noise:
    """Return all that residuals [run][n] hold as white noise, with what their means over seconds scatter more: too much is
    harmless as a first noise, too little is not.
    """
    channels = tuple(residuals)
    sigma = np.array(
        [max(float(np.sqrt(np.nanmean(np.concatenate(residuals[c]) ** 2))), 1e-12) for c in channels]
    )
    white = [residuals[c] for c in channels]
    inflation = _inflation(white, sigma, max(1, round(_BLOCK_S / step_s)))
    return Noise(channels, {c: np.zeros(ORDER) for c in channels}, sigma, np.eye(len(channels)), inflation)


def _definite(correlation: FloatArray) -> FloatArray:
    """Return the nearest correlation matrix with eigenvalues of at least 1e-3: pairs come from different rows."""
    values, vectors = np.linalg.eigh(correlation)
    fixed = (vectors * np.maximum(values, 1e-3)) @ vectors.T
    scale = 1.0 / np.sqrt(np.diag(fixed))
    result: FloatArray = fixed * scale[:, None] * scale[None, :]
    return result


def _inflation(white: Sequence[Sequence[FloatArray]], sigma: FloatArray, block: int) -> float:
    """Return how much more than white noise all channels scatter over blocks, at least 1."""
    ratios = [_slowness(runs, float(s), block) for runs, s in zip(white, sigma, strict=True)]
    return max(1.0, float(np.mean(ratios)))


def _slowness(series: Sequence[FloatArray], sigma: float, block: int) -> float:
    """Return the mean square of sums over blocks against that of white noise, 1 where no block is long enough."""
    ratios = []
    for x in series:
        count = len(x) // block
        parts = x[: count * block].reshape(count, block)
        many = np.isfinite(parts).sum(axis=1)
        use = many > block // 4
        if use.any():
            ratios.append(float(np.mean(np.nansum(parts[use], axis=1) ** 2 / many[use])) / sigma**2)
    return float(np.mean(ratios)) if ratios else 1.0


@dataclass(frozen=True)
class Sums:
    """Normal equations of one run, whitened: gram [P + Q + 1, P + Q + 1] over effects' columns, nuisances, residual;
    rows: how many measurements.
    """

    gram: FloatArray
    rows: int


def run_sums(run: RunData, noise: Noise, columns: int, nuisances: int) -> Sums:
    """Return the whitened normal equations of one run."""
    width = columns + nuisances + 1
    gram = np.zeros((width, width))
    rows = 0
    for at, there, white, weight in _whitened(run, noise):
        rows += len(at) * len(there)
        places = [_places(run.channels[c], columns, width) for c in there]
        gram += _pattern_gram(white, places, weight, width)
    return Sums(gram / noise.inflation, rows)


def _whitened(
    run: RunData, noise: Noise
) -> Iterator[tuple[Index, list[Channel], list[FloatArray], FloatArray]]:
    """Yield per pattern of valid channels its bins, the channels, their whitened columns (regressors, nuisances, residual)
    and the inverse covariance between them.
    """
    present = [c for c in noise.channels if c in run.channels]
    white: dict[Channel, FloatArray] = {}
    pattern = np.zeros(len(run.time_s), np.intp)
    for bit, c in enumerate(present):
        d = run.channels[c]
        block = np.column_stack((d.regressors, d.nuisances, d.residual))
        white[c] = whiten(block, noise.ar[c]) / noise.sigma[noise.channels.index(c)]
        pattern += past_valid(d.valid, ORDER).astype(np.intp) << bit
    for value in np.unique(pattern):
        there = [c for bit, c in enumerate(present) if value >> bit & 1]
        if there:
            at = np.flatnonzero(pattern == value)
            places = [noise.channels.index(c) for c in there]
            weight = np.asarray(np.linalg.inv(noise.correlation[np.ix_(places, places)]), np.float64)
            yield at, there, [white[c][at] for c in there], weight


def _places(d: ChannelData, columns: int, width: int) -> Index:
    return np.concatenate((d.index, columns + d.families, [width - 1])).astype(np.intp)


def _pattern_gram(
    white: Sequence[FloatArray], places: Sequence[Index], weight: FloatArray, width: int
) -> FloatArray:
    """Return sum over channel pairs of inverse covariance times cross products, at the global places."""
    out = np.zeros((width, width))
    for a in range(len(white)):
        for b in range(a + 1):
            product = weight[a, b] * (white[a].T @ white[b])
            out[np.ix_(places[a], places[b])] += product  # places are unique within a channel
            if a != b:
                out[np.ix_(places[b], places[a])] += product.T
    return out
