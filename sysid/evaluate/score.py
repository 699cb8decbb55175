"""Scores of errors and of intervals. Pure; nothing here knows what a run is.

Several blocks of samples (runs, joints) are pooled: every sample counts alike. Errors in percent are relative to each
block's own rated torque.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.friction import FloatArray
from sysid.sigma_fit import GAUSS

VELOCITY_EDGES_RAD_S: Final = (0.0, 0.05, 0.2, 0.5, 1.0, 2.0, math.inf)
"""Bins of |v|, joint side: creeping, the paper's slowest, slow, medium, fast, faster."""

LEVELS: Final = {0.5: 0.6744897501960817, 0.8: 1.2815515655446004, 0.9: GAUSS, 0.95: 1.959963984540054}
"""Nominal coverage -> half width in standard deviations, of the normal distribution that sigma stands for."""


class Score(NamedTuple):
    """Of `samples` errors: mean square [Nm^2], its root [Nm] and [% of rated torque], 95th percentile and largest [Nm]."""

    samples: int
    mse_nm2: float
    rmse_nm: float
    rmse_rated_percent: float
    p95_nm: float
    max_nm: float


class Block(NamedTuple):
    """Errors [n] of one run of one joint [Nm], and the rated torque of the joint."""

    error_nm: FloatArray
    rated_nm: float


def score(blocks: Sequence[Block]) -> Score | None:
    """Return the score of all samples of the blocks together; None when there are none."""
    filled = [block for block in blocks if len(block.error_nm)]
    if not filled:
        return None
    error = np.concatenate([block.error_nm for block in filled])
    share = np.concatenate([block.error_nm / block.rated_nm for block in filled])
    size = np.abs(error)
    mse = float(np.mean(error * error))
    return Score(
        len(error),
        mse,
        math.sqrt(mse),
        100.0 * math.sqrt(float(np.mean(share * share))),
        float(np.quantile(size, 0.95)),
        float(size.max()),
    )


class Coverage(NamedTuple):
    """Share of `samples` whose interval holds the sensor; se: standard error of it, from run to run, NaN for one run."""

    samples: int
    runs: int
    share: float
    se: float

    def __str__(self) -> str:
        """E.g. "91.3 % +- 1.2"; without the standard error where there is none."""
        beside = f" +- {100.0 * self.se:.1f}" if math.isfinite(self.se) else ""
        return f"{100.0 * self.share:.1f} %{beside}"


def coverage(inside: Sequence[NDArray[np.bool_]]) -> Coverage | None:
    """Return the coverage of runs, each an array [n] of whether a sample is inside; None when there is no sample.

    Samples of one run share its zero and its friction and are right or wrong together: the standard error is that of a
    ratio over whole runs (Cochran 1977, section 6.4), not sqrt(p (1 - p)/n).
    """
    runs = [each for each in inside if len(each)]
    if not runs:
        return None
    count = np.array([len(each) for each in runs], np.float64)
    good = np.array([np.count_nonzero(each) for each in runs], np.float64)
    share = float(good.sum() / count.sum())
    se = math.nan
    if len(runs) > 1:
        off = good - share * count
        se = math.sqrt(float(off @ off) * len(runs) / (len(runs) - 1)) / float(count.sum())
    return Coverage(int(count.sum()), len(runs), share, se)


def velocity_bins(velocity_rad_s: FloatArray) -> NDArray[np.intp]:
    """Return for each sample the index of its bin of |v| in VELOCITY_EDGES_RAD_S."""
    inner = np.array(VELOCITY_EDGES_RAD_S[1:-1])
    return np.searchsorted(inner, np.abs(velocity_rad_s), side="right")


def bin_name(index: int) -> str:
    """Return a bin's name, e.g. "0.2 to 0.5"."""
    low, high = VELOCITY_EDGES_RAD_S[index], VELOCITY_EDGES_RAD_S[index + 1]
    return f"above {low:g}" if math.isinf(high) else f"{low:g} to {high:g}"


def ratio(a: float | None, b: float | None) -> float | None:
    """Return a/b; None where one is missing or b is zero."""
    return None if a is None or b is None or b == 0.0 else a / b
