"""A column of the table: every figure of one plant, each with its standard error from run to run.

Samples of a run share its day and are right or wrong together, so errors of figures are those of ratios over whole runs
(Cochran 1977, section 6.4); both joints of a run count as one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np

from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.estimator.joint import QUADRANTS
from jtqd.estimator.uncertainty import GAUSS
from jtqd.sysid.evaluate.methods import PAPERS
from jtqd.sysid.planner.campaigns import seed_of
from jtqd.sysid.planner.plan import Run
from validation.goals.identify import (
    FIT_SEED,
    JUDGE_SEED,
    Driven,
    Identified,
    Sizes,
    drive,
    identify,
    judging_runs,
    nominal_joints,
    outside,
)
from validation.goals.judge import OWN, TITLES, Judged, flagged, judge
from validation.goals.plants import CHANGES, PlantFile

REGRESSION: Final = "regression"
_FEWEST: Final = 500
"""Samples of a cell (joint, quadrant) that a share is told of."""


class Figure(NamedTuple):
    """A number and its standard error; NaN where there is none."""

    value: float
    se: float = math.nan


def ratio(parts: Iterable[tuple[str, float, float]]) -> Figure:
    """Return the sum of the second over that of the third of (run, upper, lower), its error over whole runs."""
    sums: dict[str, FloatArray] = {}
    for run, upper, lower in parts:
        sums[run] = sums.get(run, np.zeros(2)) + np.array((upper, lower))
    if not sums:
        return Figure(math.nan)
    pairs = np.array(list(sums.values()))
    upper, lower = pairs.sum(axis=0)
    if not lower > 0.0:
        return Figure(math.nan)
    off = pairs[:, 0] - upper / lower * pairs[:, 1]
    n = len(pairs)
    se = math.sqrt(float(off @ off) * n / (n - 1)) / lower if n > 1 else math.nan
    return Figure(float(upper / lower), float(se))


def root(square: Figure) -> Figure:
    """Return the root of a figure, its error to first order."""
    value = math.sqrt(square.value) if square.value >= 0.0 else math.nan
    return Figure(value, square.se / (2.0 * value) if value > 0.0 else math.nan)


def share(parts: Iterable[tuple[str, BoolArray, BoolArray]]) -> Figure:
    """Return how often (run, good [n], counted [n]) is good where it counts, in %."""
    found = ratio(
        (run, float(np.count_nonzero(good & counted)), float(np.count_nonzero(counted)))
        for run, good, counted in parts
    )
    return Figure(100.0 * found.value, 100.0 * found.se)


def _squares(parts: Sequence[Judged], errors: Callable[[Judged], FloatArray], relative: bool) -> Figure:
    def each(one: Judged) -> tuple[str, float, float]:
        error = errors(one)[one.moving] / (one.rated_nm if relative else 1.0)
        return one.run, float(error @ error), float(len(error))

    return ratio(map(each, parts))


class Interval(NamedTuple):
    """Share [%] of the 90 % interval that holds the true torque: lowest and highest cell (joint, quadrant), and of all."""

    low: Figure
    high: Figure
    all: Figure


class Standstill(NamedTuple):
    """Share [%] of the standstill interval that holds the true torque, and its mean half width [Nm]."""

    inside: Figure
    half_nm: float


class Changed(NamedTuple):
    """One thing changed: RMSE [Nm] against the true torque as old as the estimate, share [%] inside, degraded [%]."""

    rmse_nm: Figure
    inside: Figure
    degraded: Figure


class Outside(NamedTuple):
    """Share [%] flagged degraded of the samples outside, by what is beyond, and of those inside of the judging runs."""

    flagged: Mapping[str, Figure]
    falsely: Figure

    @property
    def least(self) -> Figure:
        """The kind that is flagged least."""
        return min(self.flagged.values(), key=lambda figure: figure.value)


@dataclass(frozen=True)
class Column:
    """Every figure of one plant; by method (a name of `judge.TITLES`), by change where there is one.

    now_percent: RMSE in motion against the true torque at the same instant, % of rated; mse_nm2: against the true torque as
    old as the estimate; better: share [%] of joints in runs in which a method's MSE is above that of least squares.
    """

    name: str
    runs: int
    now_percent: Mapping[str, Figure]
    mse_nm2: Mapping[str, Figure]
    interval: Mapping[str, Interval]
    standstill: Mapping[str, Standstill]
    changed: Mapping[str, Mapping[str, Changed]]
    outside: Mapping[str, Outside]
    worse: Mapping[str, Figure]
    samples_outside: Mapping[str, int] = field(default_factory=dict)

    def to_chain(self, method: str) -> float:
        """Return the MSE of a method to that of the paper's chain."""
        return self.mse_nm2[method].value / self.mse_nm2[PAPERS].value

    def to_regression(self, method: str) -> float:
        """Return the MSE of a method to that of least squares on torsion and current."""
        return self.mse_nm2[method].value / self.mse_nm2[REGRESSION].value

    def worst_change(self, method: str) -> tuple[str, Changed]:
        """Return the change after which a method's interval holds the torque least often."""
        return min(self.changed[method].items(), key=lambda item: item[1].inside.value)


def column(plant: PlantFile, sizes: Sizes, fit_seed: int = FIT_SEED, seed: int = JUDGE_SEED) -> Column:
    """Identify a plant's joints, drive the runs that judge, and return the plant's column. Raises as `identify`."""
    models = identify(plant, sizes, fit_seed)
    joints = nominal_joints(plant)
    runs = judging_runs(sizes, joints, seed)
    days = drive(plant.bench(), runs, seed)
    judged = [judge(run, one) for run in days for one in models]
    beyond = _beyond(outside(plant, sizes, joints, seed), models)
    return Column(
        name=plant.name,
        runs=len(days),
        now_percent={name: _percent(judged, name) for name in TITLES},
        mse_nm2={
            name: _squares(judged, lambda one, name=name: one.results[name].error_nm, False)  # type: ignore[misc]
            for name in TITLES
        },
        interval={name: interval(judged, name) for name in OWN},
        standstill={name: standstill(judged, name) for name in OWN},
        changed=_changes(plant, models, runs, sizes, seed),
        worse={name: _worse(judged, name) for name in OWN},
        outside={name: _outside(judged, beyond, name) for name in OWN},
        samples_outside={
            kind: sum(int(np.count_nonzero(one.moving & one.beyond)) for one in parts)
            for kind, parts in beyond.items()
        },
    )


def _percent(judged: Sequence[Judged], name: str) -> Figure:
    figure = root(_squares(judged, lambda one: one.results[name].torque_nm - one.true_nm, True))
    return Figure(100.0 * figure.value, 100.0 * figure.se)


def interval(judged: Sequence[Judged], method: str) -> Interval:
    """Return the coverage of a method's 90 % interval in motion."""

    def cell(number: int, quadrant: int) -> Figure | None:
        own = [one for one in judged if one.number == number]
        masks = [one.moving & (one.quadrant == quadrant) for one in own]
        if sum(map(np.count_nonzero, masks)) < _FEWEST:
            return None
        return share(
            (one.run, one.results[method].inside(GAUSS), mask) for one, mask in zip(own, masks, strict=True)
        )

    numbers = sorted({one.number for one in judged})
    cells = [
        figure
        for number in numbers
        for quadrant in range(len(QUADRANTS))
        if (figure := cell(number, quadrant)) is not None
    ]
    overall = share((one.run, one.results[method].inside(GAUSS), one.moving) for one in judged)
    if not cells:
        return Interval(overall, overall, overall)
    return Interval(
        min(cells, key=lambda figure: figure.value), max(cells, key=lambda figure: figure.value), overall
    )


def standstill(judged: Sequence[Judged], method: str) -> Standstill:
    """Return how often value +- sigma holds the true torque at rest, where the estimate is not degraded."""
    inside, widths = [], []
    for one in judged:
        result = one.results[method]
        resting = one.standing & ~flagged(result)
        inside.append((one.run, result.inside(1.0), resting))
        if result.sigma_nm is not None:
            widths.append(result.sigma_nm[resting])
    every = np.concatenate(widths)
    return Standstill(share(inside), float(every.mean()) if len(every) else math.nan)


def _worse(judged: Sequence[Judged], method: str) -> Figure:
    def each(one: Judged) -> tuple[str, float, float]:
        errors = [one.results[name].error_nm[one.moving] for name in (method, REGRESSION)]
        ours, other = (float(error @ error) for error in errors)
        return one.run, float(ours > 1.001 * other), 1.0

    figure = ratio(map(each, judged))
    return Figure(100.0 * figure.value, 100.0 * figure.se)


def _changes(
    plant: PlantFile, models: Sequence[Identified], runs: Sequence[Run], sizes: Sizes, seed: int
) -> dict[str, dict[str, Changed]]:
    """Judge a part of the runs, on the same days, with one thing changed."""
    motions = [run for run in runs if run.name.startswith("variable")][: sizes.changed_runs]
    found: dict[str, dict[str, Changed]] = {method: {} for method in (*OWN, REGRESSION)}
    seed = seed_of("changes", 0.0, seed)
    for change in CHANGES:
        if not change.possible(plant):
            continue
        days = drive(change.bench(plant), motions, seed)
        judged = [judge(run, one, change.link, tuple(found)) for run in days for one in models]
        for method, row in found.items():
            row[change.name] = Changed(
                root(_squares(judged, lambda one, name=method: one.results[name].error_nm, False)),  # type: ignore[misc]
                _inside(judged, method),
                _degraded(judged, method),
            )
    return found


def _inside(judged: Sequence[Judged], method: str) -> Figure:
    if judged[0].results[method].sigma_nm is None:
        return Figure(math.nan)
    return share((one.run, one.results[method].inside(GAUSS), one.moving) for one in judged)


def _degraded(judged: Sequence[Judged], method: str) -> Figure:
    if judged[0].results[method].status is None:
        return Figure(math.nan)
    return share((one.run, flagged(one.results[method]), one.moving) for one in judged)


def _outside(judged: Sequence[Judged], beyond: Mapping[str, Sequence[Judged]], method: str) -> Outside:
    def rate(parts: Sequence[Judged], outside: bool) -> Figure:
        return share(
            (one.run, flagged(one.results[method]), one.moving & (one.beyond == outside)) for one in parts
        )

    return Outside({kind: rate(parts, True) for kind, parts in beyond.items()}, rate(judged, False))


def _beyond(driven: Mapping[str, Sequence[Driven]], models: Sequence[Identified]) -> dict[str, list[Judged]]:
    return {
        kind: [judge(run, one, None, OWN) for run in runs for one in models] for kind, runs in driven.items()
    }
