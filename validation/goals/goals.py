"""The goals: four plants, our estimate and its baselines against the torque that only a plant knows, and the targets.

The true torque is that of now, and as old as each estimate. Samples of a run share its day and are right or wrong together,
so errors of figures are those of ratios over whole runs (Cochran 1977, section 6.4); both joints of a run count as one.

python -m validation goals --quick                 few days: large standard errors
python -m validation goals --json goals.json       as many days as the docs' table
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Final, NamedTuple

import numpy as np

from jtqd.estimator.arrays import BoolArray, FloatArray, QuadrantArray, StatusArray
from jtqd.estimator.command_line import count, natural
from jtqd.estimator.estimator import estimate_columns, quadrants
from jtqd.estimator.fusion import GAUSS
from jtqd.estimator.joint import QUADRANTS
from jtqd.estimator.network import load_network
from jtqd.estimator.observer import low_pass
from jtqd.estimator.run import JointColumns
from jtqd.estimator.settings import EstimatorSettings, bandwidth_of, recommended
from jtqd.estimator.status import DEGRADED, STANDSTILL, VALID
from jtqd.sysid.evaluate.inputs import OURS, PAPERS, SETTLE_S
from jtqd.sysid.planner.campaigns import seed_of
from jtqd.sysid.planner.plan import Run
from validation.goals.identify import (
    BASELINES,
    CHANGES,
    FEW,
    FIT_SEED,
    FULL,
    JUDGE_SEED,
    OF_BASELINES,
    QUICK,
    TINY,
    Driven,
    Identified,
    PlantFile,
    Sizes,
    drive,
    identify,
    judging_runs,
    nominal_joints,
    observed,
    one_encoder,
    outside,
    the_four,
)
from validation.goals.situations import ONE as ONE_ENCODER
from validation.goals.situations import TWO as BOTH
from validation.goals.situations import Situations, situations
from validation.study import Report, Table, UsageError, in_processes

ZEROS: Final = "ours_zeros"
LOW_PASS: Final = "ours_low_pass"
"""As ZEROS, but with the low pass of the torsion in place of its tracking filter: 1/800 s old."""
ONE: Final = "one_encoder"
"""As ZEROS, fitted and run without the link encoder: the current path alone."""
TITLES: Final = {
    OURS: "ours",
    ZEROS: "ours, zeros tracked",
    ONE: "ours, one encoder",
    LOW_PASS: "ours, zeros tracked, torsion through the low pass",
    **{name: baseline.title for name, baseline in BASELINES.items()},
    PAPERS: "the paper's chain",
    "efficiency": "TOB with efficiency",
    "tob": "classical TOB, friction of the joint file",
}
"""Methods in the order of the table: ours, the baselines, the paper's."""
OWN: Final = (OURS, ZEROS)
Link = Callable[[FloatArray, FloatArray], FloatArray]


class Result(NamedTuple):
    """A method over a run, arrays [n]: torque, its sigma and status (None where it has none), the true torque as old."""

    torque_nm: FloatArray
    aligned_nm: FloatArray
    sigma_nm: FloatArray | None = None
    status: StatusArray | None = None

    @property
    def error_nm(self) -> FloatArray:
        """Estimate less the true torque of the same age [n]."""
        return self.torque_nm - self.aligned_nm

    def inside(self, sigmas: float) -> BoolArray:
        """Return where value +- sigmas holds the torque [n]."""
        if self.sigma_nm is None:
            raise ValueError("found a method without sigma")
        result: BoolArray = np.abs(self.error_nm) <= sigmas * self.sigma_nm
        return result


@dataclass(frozen=True)
class Judged:
    """One joint in one run, arrays [n]: moving, standing: for all methods alike; beyond: outside of what was driven."""

    run: str
    number: int
    rated_nm: float
    true_nm: FloatArray
    moving: BoolArray
    standing: BoolArray
    beyond: BoolArray
    quadrant: QuadrantArray
    results: Mapping[str, Result]


def judge(
    run: Driven, one: Identified, link: Link | None = None, methods: tuple[str, ...] = tuple(TITLES)
) -> Judged:
    """Estimate one joint of a run by methods of TITLES; link: what is changed in the link's position."""
    joint, time_s = one.joint, run.table.time_s
    columns = _changed(run.columns(one.number, joint), link, joint.gear_ratio)
    dt = np.diff(time_s, prepend=time_s[0])
    true = np.ascontiguousarray(run.true_nm[:, one.number - 1])
    seen = observed(run, columns, joint)
    settled = time_s - time_s[0] >= SETTLE_S
    results = {}
    for name in methods:
        if name in BASELINES:
            baseline = BASELINES[name]
            settings = OF_BASELINES
            rate = settings.own_torsion_bandwidth_rad_s if baseline.young else settings.bandwidth_rad_s
            torque = baseline.estimate(seen, one.baselines[name])
            results[name] = Result(torque, low_pass(true, dt, rate))
            continue
        settings = settings_of(name)
        network = load_network(PAPERS, one.network) if name == PAPERS else None
        file, inputs = joint, columns
        if name == ONE:
            if one.one_encoder is None:
                raise ValueError("found no fit of one encoder")
            file, inputs = one.one_encoder, one_encoder(columns, joint)
        found = estimate_columns(file, settings, network, time_s, inputs)
        aligned = low_pass(true, dt, bandwidth_of(file, settings))
        results[name] = Result(found.torque_nm, aligned, found.sigma_nm, found.status)
    published = settled & np.logical_and.reduce([np.isfinite(each.torque_nm) for each in results.values()])
    return Judged(
        run.name,
        one.number,
        joint.rated_torque_nm,
        true,
        published & (seen.status == VALID),
        published & (seen.status == STANDSTILL),
        _beyond(columns, true, one),
        quadrants(seen.raw_nm, seen.velocity_rad_s),
        results,
    )


def settings_of(name: str) -> EstimatorSettings:
    """Return the settings of a new configuration for a method of the estimator."""
    if name in (*OWN, ONE, LOW_PASS):
        return replace(recommended(OURS), track_zeros=name != OURS, track_torsion=name != LOW_PASS)
    return recommended(name)


def _changed(columns: JointColumns, link: Link | None, gear_ratio: float) -> JointColumns:
    position, motor = columns.link_position_rad, columns.motor_position_rad
    if link is None or position is None or motor is None:
        return columns
    return replace(columns, link_position_rad=link(position, motor / gear_ratio))


ROOM: Final = 1.05
ROOM_K: Final = 5.0
"""So far beyond the campaign's range a sample is outside of it."""


def _beyond(columns: JointColumns, true_nm: FloatArray, one: Identified) -> BoolArray:
    """Return which samples [n] lie beyond what the campaign has driven: true torque, speed, temperature of the housing."""
    assert columns.motor_velocity_rad_s is not None
    assert columns.temperature_c is not None
    low, high = one.driven.temperature_c
    speed = np.abs(columns.motor_velocity_rad_s) / one.joint.gear_ratio
    result: BoolArray = (
        (np.abs(true_nm) > ROOM * one.driven.torque_nm)
        | (speed > ROOM * one.driven.velocity_rad_s)
        | (columns.temperature_c > high + ROOM_K)
        | (columns.temperature_c < low - ROOM_K)
    )
    return result


def flagged(result: Result) -> BoolArray:
    """Return where a method reports that it is degraded, or has no value [n]."""
    if result.status is None:
        raise ValueError("found a method without status")
    found: BoolArray = (result.status == DEGRADED) | ~np.isfinite(result.torque_nm)
    return found


REGRESSION: Final = "regression"
_FEWEST: Final = 500
"""Samples of a cell (joint, quadrant) that a share is given for."""


@dataclass(frozen=True)
class Figure:
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


@dataclass(frozen=True)
class Interval:
    """Share [%] of the 90 % interval that holds the true torque: lowest and highest cell (joint, quadrant), and of all."""

    low: Figure
    high: Figure
    all: Figure


@dataclass(frozen=True)
class Standstill:
    """Share [%] of the standstill interval that holds the true torque, and its mean half width [Nm]."""

    inside: Figure
    half_nm: float


@dataclass(frozen=True)
class Changed:
    """One thing changed: RMSE [Nm] against the true torque as old as the estimate, share [%] inside, degraded [%], and not
    degraded but further off than 3 sigma [%].
    """

    rmse_nm: Figure
    inside: Figure
    degraded: Figure
    beyond: Figure


@dataclass(frozen=True)
class Outside:
    """Share [%] flagged degraded of the samples outside, by what is beyond, and of those inside of the judging runs."""

    flagged: Mapping[str, Figure]
    falsely: Figure

    @property
    def least(self) -> Figure:
        return min(self.flagged.values(), key=lambda figure: figure.value)


@dataclass(frozen=True)
class Column:
    """Every figure of one plant; by method (a name of `TITLES`), by change where there is one.

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
    situations: Situations | None = None

    def to_chain(self, method: str) -> float:
        """Return the MSE of a method to that of the paper's chain."""
        return self.mse_nm2[method].value / self.mse_nm2[PAPERS].value

    def to_regression(self, method: str) -> float:
        """Return the MSE of a method to that of least squares on torsion and current."""
        return self.mse_nm2[method].value / self.mse_nm2[REGRESSION].value

    def worst_change(self, method: str) -> tuple[str, Changed]:
        """Return the change after which a method's interval holds the torque least often."""
        return min(self.changed[method].items(), key=lambda item: item[1].inside.value)

    def worst_beyond(self, method: str) -> tuple[str, Changed]:
        """Return the change after which a method is not degraded but further off than 3 sigma most often."""
        return max(self.changed[method].items(), key=lambda item: item[1].beyond.value)


def column(plant: PlantFile, sizes: Sizes, fit_seed: int = FIT_SEED, seed: int = JUDGE_SEED) -> Column:
    """Identify a plant's joints, drive the runs that judge, and return the plant's column. Raises as `identify`."""
    models = identify(plant, sizes, fit_seed)
    joints = nominal_joints(plant)
    runs = judging_runs(sizes, joints, seed)
    days = drive(plant.bench(), runs, seed)
    judged = [judge(run, one) for run in days for one in models]
    beyond = judged_beyond(outside(plant, sizes, joints, seed), models)
    return Column(
        name=plant.name,
        runs=len(days),
        now_percent={name: _percent(judged, name) for name in TITLES},
        mse_nm2={
            name: _squares(judged, lambda one, name=name: one.results[name].error_nm, False)  # type: ignore[misc]
            for name in TITLES
        },
        interval={name: interval(judged, name) for name in (*OWN, ONE)},
        standstill={name: standstill(judged, name) for name in (*OWN, ONE)},
        changed=_changes(plant, models, runs, sizes, seed),
        worse={name: _worse(judged, name) for name in OWN},
        outside={name: _outside(judged, beyond, name) for name in OWN},
        samples_outside={
            kind: sum(int(np.count_nonzero(one.moving & one.beyond)) for one in parts)
            for kind, parts in beyond.items()
        },
        situations=situations(plant, models, days, sizes, seed),
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
                _beyond_sigma(judged, method),
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


def _beyond_sigma(judged: Sequence[Judged], method: str) -> Figure:
    if judged[0].results[method].status is None:
        return Figure(math.nan)
    return share(
        (one.run, ~flagged(one.results[method]) & ~one.results[method].inside(3.0), one.moving)
        for one in judged
    )


def _outside(judged: Sequence[Judged], beyond: Mapping[str, Sequence[Judged]], method: str) -> Outside:
    def rate(parts: Sequence[Judged], outside: bool) -> Figure:
        return share(
            (one.run, flagged(one.results[method]), one.moving & (one.beyond == outside)) for one in parts
        )

    return Outside({kind: rate(parts, True) for kind, parts in beyond.items()}, rate(judged, False))


def judged_beyond(
    driven: Mapping[str, Sequence[Driven]], models: Sequence[Identified]
) -> dict[str, list[Judged]]:
    """Judge the runs outside of what a campaign has driven, by what is beyond it."""
    return {
        kind: [judge(run, one, None, OWN) for run in runs for one in models] for kind, runs in driven.items()
    }


SIZES: Final = {"full": FULL, "few": FEW, "quick": QUICK, "tiny": TINY}
_WITH: Final = {OURS: "ours", "ours_zeros": "ours, zeros tracked"}


PLANTS: Final = ("Table I", "typical", "bad day", "coarse")
"""Order of the targets."""
Targets = tuple[float, float, float, float]


class Row(NamedTuple):
    """A figure of the table: its name, targets (by plant, empty for none), text of a column, and whether it is reached."""

    name: str
    targets: tuple[str, ...]
    text: Callable[[Column], str]
    reached: Callable[[Column, int], bool] | None = None


def _number(figure: Figure, digits: int) -> str:
    if not math.isfinite(figure.value):
        return "-"
    beside = f" ± {figure.se:.{digits}f}" if math.isfinite(figure.se) else ""
    return f"{figure.value:.{digits}f}{beside}"


_NONE: Final = ("",) * len(PLANTS)
_NOW: Final = (0.25, 0.4, 0.9, 0.6)
_RATIO: Final = (0.15, 0.2, 0.3, 0.3)
_LOW: Final = (87.0, 86.0, 85.0, 85.0)
_HIGH: Final = (93.0, 94.0, 95.0, 95.0)
_CHANGED: Final = 85.0
_BEYOND: Final = 2.0
_REST: Final = (2.5, 2.5, 3.0, 3.0)
_FALSELY: Final = (2.0, 2.0, 3.0, 3.0)


def _goals(method: str) -> list[Row]:
    """Return the rows of the goals for ours, zeros tracked or not."""
    name = _WITH[method]

    def interval(column: Column) -> str:
        one = column.interval[method]
        return f"{_number(one.low, 1)} to {_number(one.high, 1)}; all {_number(one.all, 1)}"

    def rest(column: Column) -> str:
        one = column.standstill[method]
        return f"{_number(one.inside, 1)}; {one.half_nm:.2f}"

    def changed(column: Column) -> str:
        what, one = column.worst_change(method)
        return f"{_number(one.inside, 1)} ({what})"

    def beyond(column: Column) -> str:
        what, one = column.worst_beyond(method)
        return f"{_number(one.beyond, 1)} ({what})"

    def flagged(column: Column) -> str:
        one = column.outside[method]
        kinds = ", ".join(f"{kind} {_number(figure, 1)}" for kind, figure in one.flagged.items())
        return f"{kinds}; {_number(one.falsely, 1)}"

    return [
        Row(
            f"RMSE in motion against the true torque now, % of rated: {name}",
            _texts(_NOW),
            lambda column: _number(column.now_percent[method], 2),
            lambda column, k: column.now_percent[method].value <= _NOW[k],
        ),
        Row(
            f"MSE to that of the paper's chain identified on the same runs: {name}",
            _texts(_RATIO),
            lambda column: f"{column.to_chain(method):.3f}",
            lambda column, k: column.to_chain(method) <= _RATIO[k],
        ),
        Row(
            f"MSE to that of least squares on torsion and current: {name}",
            _NONE,
            lambda column: f"{column.to_regression(method):.3f}",
        ),
        Row(
            f"90 % interval holds the true torque, %, worst and best of joints and quadrants: {name}",
            tuple(f"{low:g} to {high:g}" for low, high in zip(_LOW, _HIGH, strict=True)),
            interval,
            lambda column, k: (
                column.interval[method].low.value >= _LOW[k]
                and column.interval[method].high.value <= _HIGH[k]
            ),
        ),
        Row(
            f"the same with one thing changed, %, worst change: {name}",
            (f"{_CHANGED:g}",) * len(PLANTS),
            changed,
            lambda column, k: column.worst_change(method)[1].inside.value >= _CHANGED,
        ),
        Row(
            f"the same, not degraded and beyond 3 sigma, %, worst change: {name}",
            (f"{_BEYOND:g}",) * len(PLANTS),
            beyond,
            lambda column, k: column.worst_beyond(method)[1].beyond.value <= _BEYOND,
        ),
        Row(
            f"standstill interval holds the true torque, %; mean half width, Nm: {name}",
            tuple(f"90; {half:g}" for half in _REST),
            rest,
            lambda column, k: (
                column.standstill[method].inside.value >= 90.0
                and column.standstill[method].half_nm <= _REST[k]
            ),
        ),
        Row(
            f"outside, flagged, %; inside, falsely flagged, %: {name}",
            tuple(f"95; {each:g}" for each in _FALSELY),
            flagged,
            lambda column, k: (
                column.outside[method].least.value >= 95.0
                and column.outside[method].falsely.value <= _FALSELY[k]
            ),
        ),
        Row(
            f"joints in runs worse than least squares on torsion and current, %: {name}",
            _NONE,
            lambda column: _number(column.worse[method], 1),
        ),
    ]


def _texts(values: Targets) -> tuple[str, ...]:
    return tuple(f"{value:g}" for value in values)


_NOT_HERE: Final = (
    Row("joints in runs worse than physics, %", ("2",) * len(PLANTS), lambda column: "none: no network"),
    Row(
        "contact of 3 Nm reported within, ms; false alarms per hour",
        ("3; 1", "3; 1", "5; 1", ""),
        lambda column: "docs/estimator.md",
    ),
)


_ONE_NOW: Final = {"Table I": 1.85, "typical": 2.81, "bad day": 6.44, "coarse": 3.95}
"""RMSE in motion, % of rated, of one encoder at commit 1c3be2e, by plant (`--few`, seeds 1 and 7020)."""
_ONE_SHARE: Final = 0.35
_ONE_REST: Final = 85.0


def _of_one_encoder() -> tuple[Row, ...]:
    def interval(column: Column) -> str:
        one = column.interval[ONE]
        return f"{_number(one.low, 1)} to {_number(one.high, 1)}; all {_number(one.all, 1)}"

    def rest(column: Column) -> str:
        one = column.standstill[ONE]
        return f"{_number(one.inside, 1)}; {one.half_nm:.2f}"

    most = tuple(_ONE_SHARE * _ONE_NOW[name] for name in PLANTS)
    return (
        Row(
            "RMSE in motion against the true torque now, % of rated: one encoder",
            tuple(f"{each:.2f}" for each in most),
            lambda column: _number(column.now_percent[ONE], 2),
            lambda column, k: column.now_percent[ONE].value <= most[k],
        ),
        Row(
            "90 % interval holds the true torque, %, worst and best of joints and quadrants: one encoder",
            _NONE,
            interval,
        ),
        Row(
            "standstill interval holds the true torque, %; mean half width, Nm: one encoder",
            (f"{_ONE_REST:g}",) * len(PLANTS),
            rest,
            lambda column, k: column.standstill[ONE].inside.value >= _ONE_REST,
        ),
    )


_SIGMAS: Final = 6.0
_BEFORE: Final = 85.0
_CREEPING: Final = 60.0
_SLOW: Final[Mapping[str, float]] = {"coarse": 0.41}
"""Half of the slow difference of both views at commit 1c3be2e [Nm] (`--few`), by plant that has a target."""


def _of_situations() -> tuple[Row, ...]:
    """Return the rows of `situations`; a column without them has "-"."""

    def row(
        name: str,
        targets: tuple[str, ...],
        text: Callable[[Situations], str],
        reached: Callable[[Situations, int], bool],
    ) -> Row:
        def of(column: Column) -> str:
            return "-" if column.situations is None else text(column.situations)

        def judged(column: Column, k: int) -> bool:
            return column.situations is None or reached(column.situations, k)

        return Row(name, targets, of, judged)

    def both(values: Mapping[str, float], digits: int) -> str:
        return "; ".join(f"{value:.{digits}f}" for value in values.values())

    def before(one: Situations) -> str:
        what, value = min(one.before_motion.items(), key=lambda item: item[1])
        return f"{value:.1f} ({what})"

    size, slow = len(PLANTS), tuple(_SLOW.get(name, math.nan) for name in PLANTS)
    return (
        row(
            "quick reversals, RMSE now in motion, Nm: both encoders; one",
            ("one at most both",) * size,
            lambda one: both(one.quick_nm, 2),
            lambda one, k: one.quick_nm[ONE_ENCODER] <= one.quick_nm[BOTH],
        ),
        row(
            "steps of current at rest, RMSE now at rest, Nm: both encoders; one",
            ("one at most both",) * size,
            lambda one: both(one.steps_nm, 2),
            lambda one, k: one.steps_nm[ONE_ENCODER] <= one.steps_nm[BOTH],
        ),
        row(
            "in these, largest error over sigma where valid or at standstill: both encoders; one",
            (f"{_SIGMAS:g}",) * size,
            lambda one: both(one.sigmas, 1),
            lambda one, k: max(one.sigmas.values()) <= _SIGMAS,
        ),
        row(
            "standstill interval before the first motion, %, worst change",
            (f"{_BEFORE:g}",) * size,
            before,
            lambda one, k: min(one.before_motion.values()) >= _BEFORE,
        ),
        row(
            "creeping, worst joint in a run, interval holds, %: both encoders; one",
            (f"{_CREEPING:g}",) * size,
            lambda one: both(one.creeping, 1),
            lambda one, k: min(one.creeping.values()) >= _CREEPING,
        ),
        row(
            "slow difference of one encoder and both, 95 % quantile, Nm",
            tuple(f"{each:.2f}" if math.isfinite(each) else "" for each in slow),
            lambda one: f"{one.slow_nm:.2f}",
            lambda one, k: one.slow_nm <= slow[k],
        ),
    )


def goal_rows() -> tuple[Row, ...]:
    pairs = zip(*(_goals(method) for method in OWN), strict=True)
    return (*(row for pair in pairs for row in pair), *_of_one_encoder(), *_of_situations(), *_NOT_HERE)


def method_table(columns: Sequence[Column]) -> Table:
    """Return the table of methods: RMSE now in % of rated, and MSE [Nm^2] as old as the estimate."""

    def cells(name: str) -> list[str]:
        return [f"{_number(c.now_percent[name], 2)}; {_number(c.mse_nm2[name], 3)}" for c in columns]

    ratios = [f"{c.mse_nm2['tob'].value / c.mse_nm2[PAPERS].value:.1f}" for c in columns]
    return Table(
        ["method: RMSE now, % of rated; MSE aligned, Nm²", *(c.name for c in columns)],
        [
            *([title, *cells(name)] for name, title in TITLES.items()),
            ["the paper's ratio, classical TOB to its chain (46)", *ratios],
        ],
    )


def change_table(columns: Sequence[Column]) -> Table:
    """Return the table of changes: RMSE [Nm] and share inside [%] of ours without and with zeros; RMSE of least squares."""
    head = [
        "changed after identification: RMSE Nm, inside %, degraded %, not degraded and beyond 3 sigma %: ours / zeros "
        "tracked / RMSE of least squares",
        *(column.name for column in columns),
    ]
    names = list(dict.fromkeys(name for column in columns for name in column.changed[OURS]))
    return Table(head, [[name, *(_change(column, name) for column in columns)] for name in names])


def _change(column: Column, name: str) -> str:
    if name not in column.changed[OURS]:
        return "-"

    def text(one: Changed) -> str:
        return f"{one.rmse_nm.value:.2f}, {one.inside.value:.1f}, {one.degraded.value:.1f}, {one.beyond.value:.1f}"

    parts = [text(column.changed[method][name]) for method in OWN]
    return " / ".join((*parts, f"{column.changed[REGRESSION][name].rmse_nm.value:.2f}"))


def goal_table(columns: Sequence[Column]) -> tuple[Table, bool]:
    """Return the table of the goals, each column beside its targets, and whether all targets are reached."""
    rows, every = [], True
    for row in goal_rows():
        cells = [row.name]
        for each in columns:
            k = PLANTS.index(each.name)
            reached = row.reached(each, k) if row.reached is not None and row.targets[k] else None
            every = every and reached is not False
            verdict = {None: "", True: " ok", False: " missed"}[reached]
            cells += [row.text(each), f"{row.targets[k]}{verdict}"]
        rows.append(cells)
    return Table(["figure", *(text for c in columns for text in (c.name, "target"))], rows), every


def options(parser: argparse.ArgumentParser) -> None:
    size = parser.add_mutually_exclusive_group()
    size.add_argument(
        "--few", action="store_const", const="few", dest="size", help="whole campaigns, an eighth of the days"
    )
    size.add_argument("--quick", action="store_const", const="quick", dest="size", help="a sixth of the runs")
    size.add_argument("--tiny", action="store_const", const="tiny", dest="size", help="to test the steps")
    parser.add_argument(
        "--seed",
        type=natural,
        default=JUDGE_SEED,
        help="of the days and motions that judge (default %(default)s)",
    )
    parser.add_argument(
        "--fit-seed", type=natural, default=FIT_SEED, help="of the campaigns (default %(default)s)"
    )
    parser.add_argument(
        "--plant",
        action="append",
        choices=[_word(name) for name in PLANTS],
        help="judge on this plant alone; may be repeated (default: all)",
    )
    parser.add_argument("--jobs", type=count, default=1, metavar="N", help="plants at a time (default 1)")


def _word(name: str) -> str:
    return name.lower().replace(" ", "_")


def _timed(sizes: Sizes, fit_seed: int, seed: int, plant: PlantFile) -> tuple[Column, float]:
    before = time.process_time()
    return column(plant, sizes, fit_seed, seed), time.process_time() - before


def run(options: argparse.Namespace) -> Report:
    if options.seed == options.fit_seed:
        raise UsageError(
            f"--seed, --fit-seed: found {options.seed} for both, expected two: the same days would fit and judge"
        )
    name = options.size or "full"
    work = partial(_timed, SIZES[name], options.fit_seed, options.seed)
    plants = [each for each in the_four() if not options.plant or _word(each.name) in options.plant]
    done = list(in_processes(work, plants, options.jobs, "plants"))
    columns = [each for each, _ in done]
    goals, reached = goal_table(columns)
    cpu = sum(each for _, each in done)
    note = f"{name}: {columns[0].runs} runs of two joints judge each plant; {cpu:.0f} s of CPU"
    seeds = {"judge": options.seed, "fit": options.fit_seed}
    tables = [goals, method_table(columns), change_table(columns)]
    return Report(tables, seeds, [note], {"size": name, "columns": columns}, reached)
