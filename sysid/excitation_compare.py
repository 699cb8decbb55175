"""Is the genetic algorithm worth it? The same design task for it, for random coefficients and for scipy's DE."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from statistics import median
from typing import Final

import numpy as np

from estimator.checked import ConfigError
from estimator.parameters import Joint
from sysid.excitation_design import Problem, Search, sequence
from sysid.excitation_information import COLUMNS, condition
from sysid.excitation_model import ExcitationLimits
from sysid.genetic import Criterion, Found, minimise, random_genomes

DE_MEMBERS_PER_DIMENSION: Final = 4
"""Of scipy's population. Its default, 15, leaves a dozen generations for 4000 evaluations; 2, 4, 8 and 15 were tried,
and their medians lay within one unit of -log det."""
_BATCH: Final = 200


@dataclass(frozen=True)
class Row:
    """One method over all seeds.

    Attributes:
        method: its name. negative_log_det: one per seed, of all runs together; lower is better.
        condition: median condition number of the scaled regressor. seconds: median processor time of a design.
        evaluations: motions tried per run.
    """

    method: str
    negative_log_det: tuple[float, ...]
    condition: float
    seconds: float
    evaluations: int

    @property
    def median(self) -> float:
        """Median -log det over the seeds."""
        return median(self.negative_log_det)


def compare(
    limits: ExcitationLimits,
    *,
    count: int,
    duration_s: float,
    harmonics: int = 5,
    seed: int = 0,
    seeds: int = 5,
    evaluations: int = 4000,
    joints: tuple[Joint, Joint] | None = None,
    on_progress: Callable[[int], None] | None = None,
) -> tuple[Row, ...]:
    """Design `count` runs by every method with seeds seed, seed+1, ...; every search has `evaluations` per run.

    The genetic algorithm has one start only, so that all have the same number of evaluations. "one draw" is the first
    motion that is drawn: what one has without any search.

    Raises:
        ConfigError: fewer evaluations than three generations of differential evolution take.
        ImportError: scipy is not installed.
    """
    import scipy.optimize  # noqa: F401 - said now, not after minutes

    problem = Problem(
        limits, duration_s=duration_s, harmonics=harmonics, joints=joints, on_progress=on_progress
    )
    least = 3 * DE_MEMBERS_PER_DIMENSION * problem.dimension
    if evaluations < least:
        raise ConfigError(f"--evaluations: found {evaluations}, expected >= {least} to compare with")
    methods: tuple[tuple[str, Search, int], ...] = (
        ("genetic algorithm", _genetic, evaluations),
        ("differential evolution (scipy)", _differential_evolution, evaluations),
        ("random, best of all", _random, evaluations),
        ("random, one draw", _random, 1),
    )
    rows = []
    for name, search, number in methods:
        values, conditions, times = [], [], []
        for each in range(seed, seed + seeds):
            begin = time.process_time()
            designs, information = sequence(problem, search, count=count, seed=each, evaluations=number)
            times.append(time.process_time() - begin)
            values.append(-designs[-1].information_log_det)
            conditions.append(condition(information))
        rows.append(Row(name, tuple(values), median(conditions), median(times), number))
    return tuple(rows)


def deviation_ratio(row: Row, reference: Row) -> float:
    """Factor by which the standard deviations of the loss coefficients are larger, as their geometric mean.

    The covariance of the coefficients is the inverse information: its determinant is the product of p = 20 variances
    (of independent combinations), so a difference of x in -log det is exp(x / (2 p)) in a standard deviation.
    """
    return math.exp((row.median - reference.median) / (2.0 * COLUMNS))


def table_lines(rows: tuple[Row, ...]) -> list[str]:
    """Rows as text, with the deviation ratio to the first."""
    heads = ("evaluations", "-log det", "best", "worst", "condition", "deviation", "seconds")
    widths = (12, 10, 8, 8, 11, 11, 9)
    lines = [
        f"{'method':<32}" + "".join(f"{head:>{width}}" for head, width in zip(heads, widths, strict=True))
    ]
    for row in rows:
        values = (
            f"{row.evaluations}",
            f"{row.median:.2f}",
            f"{min(row.negative_log_det):.2f}",
            f"{max(row.negative_log_det):.2f}",
            f"{row.condition:.0f}",
            f"{deviation_ratio(row, rows[0]):.2f}x",
            f"{row.seconds:.2f}",
        )
        cells = "".join(f"{value:>{width}}" for value, width in zip(values, widths, strict=True))
        lines.append(f"{row.method:<32}{cells}")
    return lines


def _genetic(criterion: Criterion, dimension: int, evaluations: int, rng: np.random.Generator) -> Found:
    return minimise(criterion, dimension, evaluations=evaluations, rng=rng)


def _random(criterion: Criterion, dimension: int, evaluations: int, rng: np.random.Generator) -> Found:
    """The best of so many random genomes."""
    best: Found | None = None
    for first in range(0, evaluations, _BATCH):
        genomes = random_genomes(min(_BATCH, evaluations - first), dimension, rng)
        values = criterion(genomes)
        k = int(np.argmin(values))
        if best is None or values[k] < best.value:
            best = Found(genomes[k], float(values[k]))
    assert best is not None
    return best


def _differential_evolution(
    criterion: Criterion, dimension: int, evaluations: int, rng: np.random.Generator
) -> Found:
    """scipy's DE (best1bin) with its own settings but for the size of the population, without polishing.

    Its updating is "immediate", its default and here its better one, which asks for one motion at a time: that is why
    it takes longer for the same number of them.
    """
    from scipy.optimize import differential_evolution

    result = differential_evolution(
        lambda genome: float(criterion(genome[None, :])[0]),
        [(-1.0, 1.0)] * dimension,
        popsize=DE_MEMBERS_PER_DIMENSION,
        maxiter=evaluations // (DE_MEMBERS_PER_DIMENSION * dimension) - 1,
        tol=0.0,  # no early end
        polish=False,
        rng=rng,
    )
    return Found(np.asarray(result.x), float(result.fun))
