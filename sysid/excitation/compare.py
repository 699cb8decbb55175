"""Does a designed run give a better loss model? Designed and drawn runs on the emulated bench, fitted and judged alike.

The information that a design maximises is a promise about noise. On a bench whose loss is no polynomial it need not hold,
so this is tried: the loss model of `excitation_information` is fitted to the first runs of either kind and judged by its
error on further drawn runs. Needs the emulated bench only, no bus. Pure.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from statistics import median
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.checked import ConfigError
from jtqd.estimator.joint import Joint
from jtqd.sim_can.emulated_run import JointCommand, emulate_run
from jtqd.sim_can.plant_file import PlantParameters
from jtqd.sysid.excitation.design import (
    COLUMNS,
    Criterion,
    Design,
    Found,
    Problem,
    Search,
    condition,
    design,
    draw,
    loss_regressor,
    minimise,
    random_genomes,
    sequence,
)
from jtqd.sysid.excitation.model import ExcitationLimits

# Is the genetic algorithm worth it? The same design task for it, for random coefficients and for scipy's DE.


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


JUDGES: Final = 8
"""Drawn runs that nothing is fitted to."""
_AVERAGE: Final = 50
"""Set-points of 1 ms in an average: motor current, velocity and torque without ripple and ringing of the loops."""
_MOVING_RAD_S: Final = 0.02
_JUDGING_SEED: Final = 1_000_000
"""Far from the seeds of the runs that are fitted."""


@dataclass(frozen=True)
class Trial:
    """Error of the loss model on the judging runs [Nm], one per seed, after a fit to `runs` runs of one kind."""

    runs: int
    designed_nm: tuple[float, ...]
    drawn_nm: tuple[float, ...]

    def line(self) -> str:
        """Number of runs, then median and worst of either kind."""
        cells = "".join(f"{median(x):>10.2f}{max(x):>8.2f}" for x in (self.designed_nm, self.drawn_nm))
        return f"{self.runs:>5}{cells}"


HEADING: Final = f"{'runs':>5}{'designed':>10}{'worst':>8}{'drawn':>10}{'worst':>8}"


def trial(
    limits: ExcitationLimits,
    plant: PlantParameters,
    joints: tuple[Joint, Joint],
    *,
    count: int,
    duration_s: float,
    harmonics: int,
    seed: int,
    seeds: int,
    evaluations: int,
    on_progress: Callable[[int], None] | None = None,
) -> tuple[tuple[Trial, ...], float]:
    """Fit to 1, 2, .. `count` runs for each of `seeds` seeds; joint 1 is the velocity joint.

    Returns:
        One Trial per number of runs, and the error that the model makes when it is fitted to the judging runs
        themselves [Nm]: what its columns cannot express.
    """

    def measured(runs: tuple[Design, ...]) -> list[tuple[FloatArray, FloatArray]]:
        result = []
        for number, one in enumerate(runs):
            result.append(_loss_rows(one, plant, joints[0], number))
            if on_progress is not None:
                on_progress(1)
        return result

    def drawn(count: int, seed: int) -> tuple[Design, ...]:
        return draw(limits, count=count, duration_s=duration_s, harmonics=harmonics, seed=seed, joints=joints)

    def designed(count: int, seed: int) -> tuple[Design, ...]:
        return design(
            limits,
            count=count,
            duration_s=duration_s,
            harmonics=harmonics,
            seed=seed,
            evaluations=evaluations,
            joints=joints,
        )

    judges = measured(drawn(JUDGES, seed + _JUDGING_SEED))
    errors: dict[str, list[list[float]]] = {"designed": [], "drawn": []}
    for each in range(seed, seed + seeds):
        for kind, made in (("designed", designed(count, each)), ("drawn", drawn(count, each))):
            rows = measured(made)
            errors[kind].append([_error(_fit(rows[: k + 1]), judges) for k in range(count)])
    trials = tuple(
        Trial(k + 1, *(tuple(one[k] for one in errors[kind]) for kind in ("designed", "drawn")))
        for k in range(count)
    )
    return trials, _error(_fit(judges), judges)


def _loss_rows(one: Design, plant: PlantParameters, joint: Joint, seed: int) -> tuple[FloatArray, FloatArray]:
    """Play a run on the emulated bench; return regressor [n, 20] and loss [n] of joint 1, 50 ms apart, moving only."""
    duration_s = one.velocity.duration_s
    time_s = np.arange(round(duration_s * 1000) + 1) * 1e-3
    velocity, current = one.velocity.velocity(time_s).tolist(), one.current.value(time_s).tolist()
    table = emulate_run(
        plant,
        (
            JointCommand.velocity(lambda t: velocity[round(t * 1000)]),
            JointCommand.current(lambda t: current[round(t * 1000)]),
        ),
        duration_s,
        seed,
    )
    columns = table.joints[1]
    signals = (columns.motor_velocity_rad_s, columns.current_a, columns.torque_nm)
    average = np.full(_AVERAGE, 1.0 / _AVERAGE)
    omega, i, tau = (np.convolve(x, average, "valid") for x in signals if x is not None)  # none is missing
    G = joint.gear_ratio
    raw = G * (joint.torque_constant_nm_per_a * i - joint.rotor_inertia_kgm2 * np.gradient(omega, 1e-3))
    kept = np.flatnonzero(np.abs(omega) > G * _MOVING_RAD_S)[::_AVERAGE]
    return loss_regressor(omega[kept] / G, tau[kept]), (raw - tau)[kept]


def _fit(rows: list[tuple[FloatArray, FloatArray]]) -> FloatArray:
    """Least squares; where runs leave a combination open, its smallest solution."""
    X, y = (np.concatenate(parts) for parts in zip(*rows, strict=True))
    scale = np.sqrt(np.mean(np.square(X), axis=0)) + 1e-12
    solution: FloatArray = np.linalg.lstsq(X / scale, y, rcond=1e-6)[0] / scale
    return solution


def _error(coefficients: FloatArray, rows: list[tuple[FloatArray, FloatArray]]) -> float:
    """Root mean square over all runs [Nm]."""
    residual = np.concatenate([X @ coefficients - y for X, y in rows])
    return float(np.sqrt(np.mean(np.square(residual))))
