"""Quantiles of errors over runs that a fit had not seen: what a new run's samples are covered with.

Split conformal prediction by runs (Vovk et al. 2005): runs are what is exchangeable, not samples. Every run is weighted
alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray, QuadrantArray
from jtqd.estimator.fusion import GAUSS

COVERAGE: Final = 0.9
FEWEST: Final = 50
"""Samples of a run that a part of it needs for the run to count there."""
_LEAST_SCALE: Final = 0.05
_BEYOND: Final = 0.3
"""Part of what is left out that a level may leave out at least: the largest of few says nothing."""
_STEPS: Final = 200
"""Points of a run's distribution that the level is sought with: 0.25 % of a run between two of them at most."""


def conformal_scale(
    errors: Sequence[FloatArray],
    sigmas: Sequence[FloatArray],
    quadrants: Sequence[QuadrantArray],
    coverage: float = COVERAGE,
) -> tuple[float, float, float, float]:
    """Return the factor per quadrant that makes value +- GAUSS sigma cover this share of unseen samples.

    One array per run each. Runs count alike in a quadrant, whatever their length; a quadrant in which no run has 50
    samples takes the factor of all. Raises ValueError where there are no samples at all.
    """
    ratios = [np.abs(e) / s for e, s in zip(errors, sigmas, strict=True)]
    if not any(map(len, ratios)):
        raise ValueError("found no samples to calibrate sigma with, expected some")
    every = quantile_by_runs(ratios, coverage)
    scales = []
    for q in range(4):
        inside = [ratio[quadrant == q] for ratio, quadrant in zip(ratios, quadrants, strict=True)]
        inside = [part for part in inside if len(part) >= FEWEST]
        scales.append((quantile_by_runs(inside, coverage) if inside else every) / GAUSS)
    a, b, c, d = (max(scale, _LEAST_SCALE) for scale in scales)
    return a, b, c, d


def quantile_by_runs(parts: Sequence[FloatArray], coverage: float = COVERAGE) -> float:
    """Return the quantile of the samples of all parts, each part with the same weight, that covers a new part so far."""
    values = np.concatenate(parts)
    weights = np.concatenate([np.full(len(part), 1.0 / max(len(part), 1)) for part in parts])
    order = np.argsort(values)
    share = np.cumsum(weights[order])
    level = unbiased_level(parts, coverage)
    at = min(int(np.searchsorted(share, level * share[-1] * (1.0 - 1e-12))), len(values) - 1)
    return float(values[order][at])


def unbiased_level(parts: Sequence[FloatArray], coverage: float = COVERAGE) -> float:
    """Return the level at which the quantile of all parts but one covers this share of that one, on average over all.

    Runs are what is exchangeable, not samples. Where runs are all alike the level is the coverage; where each run is one
    error of its own, coverage (n + 1)/n, the mean of split conformal prediction without its rounding up (Lei et al.
    2018, which guarantees at least COVERAGE and so covers more on average). Real runs lie in between, and leaving out
    one run after the other tells where (Barber et al. 2021). At most a level that leaves out _BEYOND of what the
    coverage leaves out.
    """
    grid = (np.arange(_STEPS) + 0.5) / _STEPS
    rows = np.array([np.quantile(part, grid) for part in parts if len(part)])
    highest = 1.0 - _BEYOND * (1.0 - coverage)
    if len(rows) < 2:
        return highest
    run = np.repeat(np.arange(len(rows)), _STEPS)
    order = np.argsort(rows, axis=None, kind="stable")
    values, run = rows.ravel()[order], run[order]
    others = np.array([values[run != k] for k in range(len(rows))])

    def covered(level: float) -> float:
        ends = others[:, min(int(level * others.shape[1]), others.shape[1] - 1)]
        return float(np.mean(rows <= ends[:, None]))

    def root(target: float) -> float:
        low, high = 0.0, highest
        while high - low > 1e-4:
            middle = 0.5 * (low + high)
            low, high = (low, middle) if covered(middle) >= target else (middle, high)
        return high

    # a few runs of one error each are covered in steps, and a step may lie at the coverage itself: its middle
    return 0.5 * (root(coverage - 1e-9) + root(coverage + 1e-9))
