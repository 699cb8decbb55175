"""Noise of the channels: white, and as dense as the slow part of what is left.

What a model leaves is slow for the most part, and small where it is quick. That it is small there proves neither that the
model is right there to the same part nor that the noise is: whitening would let the quick errors of a simulation decide
which slow cause is named. So every row of a channel has the same weight, as under independence, and its variance is that
which sums over a second have per row: estimates are those of least squares, and intervals are as wide as correlation in
time makes them (Liang and Zeger 1986, Biometrika 73: independence as the working covariance).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np

from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.sysid.diagnosis.regressors import RunData
from jtqd.sysid.diagnosis.signals import Channel

ORDER: Final = 24
_LITTLE: Final = 1e-6
_BLOCK_S: Final = 1.0


class Noise(NamedTuple):
    """Noise of the channels: standard deviation of each [Nm]; inflation: how many rows count as one, of all."""

    sigma: Mapping[Channel, float]
    inflation: float


def noise_of_channels(
    residuals: Mapping[Channel, Sequence[FloatArray]], step_s: float, least_nm: float = 0.0
) -> Noise:
    """Return the noise of all channels from what is left of them [run][n], NaN where not valid, at least least_nm: what the
    equations are exact to. With an inflation of its own a channel that is fitted badly would weigh little, and stay so.
    """
    block = max(1, round(_BLOCK_S / step_s))
    sigma = {
        channel: max(float(np.sqrt(np.nanmean(np.concatenate(parts) ** 2))), least_nm, 1e-12)
        for channel, parts in residuals.items()
    }
    slow = [_slowness(parts, sigma[channel], block) for channel, parts in residuals.items()]
    return Noise(sigma, max(1.0, float(np.mean(slow))))


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


class Sums(NamedTuple):
    """Normal equations of one run in units of noise: gram [P + Q + 1, P + Q + 1] over effects' columns, nuisances, residual;
    rows: how many independent measurements.
    """

    gram: FloatArray
    rows: float


def run_sums(run: RunData, noise: Noise, columns: int, nuisances: int) -> Sums:
    """Return the normal equations of one run in units of noise."""
    width = columns + nuisances + 1
    gram = np.zeros((width, width))
    rows = 0.0
    for channel, d in run.channels.items():
        block = np.column_stack((d.regressors, d.nuisances, d.residual))[d.valid]
        places = np.concatenate((d.index, columns + d.families, [width - 1])).astype(np.intp)
        gram[np.ix_(places, places)] += block.T @ block / (noise.sigma[channel] ** 2 * noise.inflation)
        rows += len(block) / noise.inflation
    return Sums(gram, rows)


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


def autoregression(stretches: Sequence[FloatArray], order: int = ORDER) -> FloatArray:
    """Return a [order]: x_t = sum a_k x_{t-k} + e, by Yule-Walker over series with NaN for gaps (Levinson)."""
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
    c[0] *= 1.0 + _LITTLE
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
