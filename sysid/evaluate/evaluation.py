"""Evaluation of all methods on all runs: every table of the report, the targets, and the time of a step. No file.

Time of a step, each method's part of jtqd's loop: every step is timed alone on samples of an evaluated run, with the loop's
own estimators and networks. The methods take turns in short blocks, so that a busy machine affects all alike, and the median
drops the steps in which the machine did something else. One process in a tight loop: caches are warmer than in a loop that
sleeps between its cycles.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from time import perf_counter_ns
from typing import Final, NamedTuple, TypeVar

import numpy as np

from jtqd.estimator.joint import Envelope
from jtqd.estimator.methods import make_estimator
from jtqd.estimator.network import FusedNetwork
from jtqd.estimator.settings import recommended
from jtqd.estimator.text import counted
from jtqd.sysid.evaluate.inputs import OURS, PAPERS, TITLES, EvaluatedRun, JointModels, Samples, take_samples
from jtqd.sysid.evaluate.scores import (
    ALLOWED,
    LIMIT_NM,
    PAPER_MSE_NM2,
    PAPER_WORST_PERCENT,
    ErrorTables,
    IntervalTables,
    Jump,
    Outside,
    PlateauScore,
    Row,
    Standstill,
    TruthTables,
    error_tables,
    for_intervals,
    hardest_plateaus,
    interval_tables,
    is_constant,
    largest_jump,
    median_run,
    outside_scores,
    plateau_scores,
    plateaus_of,
    ratio,
    standstill,
    truth_tables,
    worst_plateau,
)
from jtqd.sysid.fit.efficiency import QUADRANT_TITLES
from jtqd.sysid.fit.plateaus import Plateau
from jtqd.sysid.runs.channels import RunIssue

# Time of a step ----------------------------------------------------------------------------------------------------------

TIMED: Final = ("tob", PAPERS, OURS)
SAMPLES: Final = 3000
"""Steps per joint and method, from the middle of the run: it moves there."""
_BLOCK: Final = 100


@dataclass(frozen=True)
class LoopTime:
    """Median cost of a step [us] by method, summed over the joints that have all of TIMED; run: of the samples."""

    step_us: Mapping[str, float]
    joints: int
    samples: int
    run: str

    def extra_us(self, over: str) -> float:
        """Return the cost of ours beyond that of another method [us], all joints together."""
        return self.step_us[OURS] - self.step_us[over]


def loop_time(
    runs: Sequence[EvaluatedRun],
    models: Sequence[JointModels],
    clock_ns: Callable[[], int] = perf_counter_ns,
) -> LoopTime | None:
    """Return the cost of steps on the first run that holds every such joint; None where no joint has all of TIMED."""
    whole = [each for each in models if set(TIMED) <= set(each.methods)]
    run = next((run for run in runs if whole and all(each.number in run.columns for each in whole)), None)
    if run is None:
        return None
    total = dict.fromkeys(TIMED, 0.0)
    for each in whole:
        rows = _rows(run, each)
        for method, cost in _costs_us(each, rows, clock_ns).items():
            total[method] += cost
    return LoopTime(total, len(whole), len(rows), run.name)


_Step = tuple[float, float, float, float, float, float]
"""dt, current, motor position, motor velocity, link position, temperature."""


def _rows(run: EvaluatedRun, models: JointModels) -> list[_Step]:
    """Return the inputs of the middle of the run."""
    columns, time_s = run.columns[models.number], run.table.time_s
    begin = max((len(time_s) - SAMPLES) // 2, 1)
    at = slice(begin, begin + SAMPLES)
    names = ("current_a", "motor_position_rad", "motor_velocity_rad_s", "link_position_rad")
    values = [np.asarray(getattr(columns, name))[at].tolist() for name in names]
    warm = columns.temperature_c
    known = np.full(len(time_s), np.nan) if warm is None else np.asarray(warm)
    steps = np.diff(time_s)[begin - 1 : begin - 1 + SAMPLES].tolist()
    return list(zip(steps, *values, known[at].tolist(), strict=True))


def _costs_us(models: JointModels, rows: list[_Step], clock_ns: Callable[[], int]) -> dict[str, float]:
    """Return the median cost of a step [us] by method."""
    steps = {
        method: make_estimator(models.joint, recommended(method), models.networks.get(method)).step
        for method in TIMED
    }
    took: dict[str, list[int]] = {method: [] for method in TIMED}
    for begin in range(0, len(rows), _BLOCK):
        for method, step in steps.items():
            times = took[method]
            for row in rows[begin : begin + _BLOCK]:
                began = clock_ns()
                step(*row)
                times.append(clock_ns() - began)
    return {method: float(np.median(times)) * 1e-3 for method, times in took.items()}


# Tables ------------------------------------------------------------------------------------------------------------------

NO_VALUE_SHARE: Final = 0.01
"""Share of the moving samples without a value of a method from which on that is a finding."""

T = TypeVar("T")
Progress = Callable[[Sequence[T], str], Iterable[T]]


@dataclass(frozen=True)
class RunJoint:
    """One joint of a run: shares scored and standing, scores by method (None: of a run outside)."""

    scored: float
    standing: float
    errors: Row | None


@dataclass(frozen=True)
class RunRecord:
    """One run; kind: constant, variable or outside."""

    name: str
    sha256: str
    kind: str
    duration_s: float
    velocity_joint: int | None
    velocity_joint_by: str
    joints: Mapping[int, RunJoint]


@dataclass(frozen=True)
class Target:
    """One row: figure, the paper's, the goal, ours as text, whether reached (None: not known), and the details."""

    key: str
    figure: str
    paper: str
    goal: str
    ours: str
    reached: bool | None
    details: tuple[str, ...] = ()


@dataclass(frozen=True)
class Evaluation:
    """Every table of the report.

    plateaus: of runs at constant velocity. variable, constant_tables: errors over the samples of runs of either kind.
    intervals: of ours, under "variable", "constant" and "all". jumps, passages: largest ones by method. picture: the run of
    the figure like the paper's Fig. 16. loop_time: None where it was not measured. truth: None where no run has it.
    """

    models: tuple[JointModels, ...]
    runs: tuple[RunRecord, ...]
    findings: tuple[RunIssue, ...]
    plateaus: tuple[PlateauScore, ...]
    variable: ErrorTables
    constant_tables: ErrorTables
    intervals: Mapping[str, IntervalTables]
    standstill: Mapping[int, Standstill]
    jumps: Mapping[str, Jump]
    passages: Mapping[str, Jump]
    outside: tuple[Outside, ...]
    picture: Samples | None
    loop_time: LoopTime | None = None
    truth: TruthTables | None = None
    targets: tuple[Target, ...] = ()

    @property
    def methods(self) -> tuple[str, ...]:
        """Methods that at least one joint has, in TITLES' order."""
        return tuple(method for method in TITLES if any(method in each.methods for each in self.models))

    @property
    def run_scores(self) -> dict[tuple[str, int], Row]:
        """Scores by (run, joint number), of both kinds of runs."""
        return {**self.variable.runs, **self.constant_tables.runs}


class _Estimated(NamedTuple):
    """A run with the samples of its joints, and the plateaus of each of them."""

    run: EvaluatedRun
    samples: tuple[Samples, ...]
    plateaus: tuple[tuple[Plateau, ...], ...]


def evaluate(
    runs: Sequence[EvaluatedRun],
    outside: Sequence[EvaluatedRun],
    models: Sequence[JointModels],
    progress: Progress[EvaluatedRun] = lambda items, text: items,
    measured: LoopTime | None = None,
) -> Evaluation:
    """Score all methods on runs, and ours outside its envelope on the runs `outside`; measured: the cost of their steps.

    Raises ConfigError when a joint and its networks do not fit, ValueError when no run has a sample to score.
    """
    findings: list[RunIssue] = []
    estimated = _estimate(progress(runs, "estimating"), models, findings)
    outer = _estimate(progress(outside, "estimating outside"), models, findings)
    if not estimated:
        raise ValueError("found no run with a moving sample that every method has a value for, expected one")
    constant: list[_Estimated] = []
    variable: list[_Estimated] = []
    for each in estimated:
        (constant if any(map(is_constant, each.plateaus, each.samples)) else variable).append(each)
    scored: list[PlateauScore] = []
    for each in constant:
        for plateaus, samples in zip(each.plateaus, each.samples, strict=True):
            found, lost = plateau_scores(plateaus, samples)
            scored += found
            findings += [RunIssue("plateau_lost", text) for text in lost]
    every = _samples(estimated)
    parts = {"variable": _samples(variable), "constant": _samples(constant), "all": every}
    modes = {each.run.name: each.run.velocity_joint for each in estimated}
    tables = {kind: error_tables(parts[kind], modes) for kind in ("variable", "constant")}
    methods = [method for method in TITLES if any(method in each.methods for each in models)]
    jumps = {method: largest_jump(every, method) for method in methods}
    passages = {method: largest_jump(every, method, passage=True) for method in methods}
    intervals = {
        name: interval_tables([for_intervals(each) for each in part]) for name, part in parts.items()
    }
    tested = [each for each in parts["variable"] if modes.get(each.run) == each.number]
    kinds = (("constant", constant), ("variable", variable), ("outside", outer))
    result = Evaluation(
        models=tuple(models),
        runs=tuple(_record(each, kind, tables.get(kind)) for kind, part in kinds for each in part),
        findings=tuple(findings),
        plateaus=tuple(scored),
        variable=tables["variable"],
        constant_tables=tables["constant"],
        intervals={name: table for name, table in intervals.items() if table is not None},
        standstill=standstill([for_intervals(each) for each in every]),
        jumps={method: jump for method, jump in jumps.items() if jump is not None},
        passages={method: jump for method, jump in passages.items() if jump is not None},
        outside=tuple(outside_scores(_samples(outer), _envelopes(models))),
        picture=median_run(tested or parts["variable"]),  # of the joint in velocity mode, as in the paper
        loop_time=measured,
        truth=truth_tables(every),
    )
    return replace(result, targets=targets(result))


def _estimate(
    runs: Iterable[EvaluatedRun], models: Sequence[JointModels], findings: list[RunIssue]
) -> list[_Estimated]:
    estimated = []
    for run in runs:
        samples, plateaus = [], []
        for each in models:
            if each.number not in run.columns:
                continue
            columns = run.columns[each.number]
            one = take_samples(run.name, each, run.table.time_s, columns, run.truth.get(each.number))
            if not one.scored.any():
                findings.append(
                    RunIssue("nothing_to_score", f"{run.name}: j{each.number}: {_why_nothing(one)}")
                )
                continue
            findings += _without_value(one)
            samples.append(one)
            plateaus.append(tuple(plateaus_of(run.name, run.table.time_s, columns, each.joint)))
        if samples:
            estimated.append(_Estimated(run, tuple(samples), tuple(plateaus)))
    return estimated


def _without_value(samples: Samples) -> list[RunIssue]:
    """Name methods that had no value where the joint moved: these samples are in no score."""
    moving = samples.scored | samples.missing
    share = float(np.count_nonzero(samples.missing)) / float(np.count_nonzero(moving))
    if share <= NO_VALUE_SHARE:
        return []
    names = [
        TITLES[method]
        for method, value in samples.estimate_nm.items()
        if np.isnan(value[samples.missing]).mean() > NO_VALUE_SHARE
    ]
    return [
        RunIssue(
            "no_value",
            f"{samples.run}: j{samples.number}: found no value of {', '.join(names)} in {100.0 * share:.1f} % of the "
            "moving samples: these samples are scored for no method",
        )
    ]


def _why_nothing(samples: Samples) -> str:
    if samples.standing.any():
        share = 100.0 * float(samples.standing.mean())
        return (
            f"found standstill in {share:.0f} % of the samples and no moving sample with a value of every method: "
            "not scored"
        )
    return "found no sample at which every method has a value, expected most of them: not scored"


def _samples(estimated: Iterable[_Estimated]) -> list[Samples]:
    return [samples for each in estimated for samples in each.samples]


def _envelopes(models: Iterable[JointModels]) -> dict[int, Envelope]:
    """Return the envelope of each joint: of the network of ours, or without one of the fit."""
    found = {}
    for each in models:
        network = each.networks.get(OURS)
        fitted = None if each.joint.fused is None else each.joint.fused.envelope
        found[each.number] = network.envelope if isinstance(network, FusedNetwork) else fitted
    return {number: envelope for number, envelope in found.items() if envelope is not None}


def _record(estimated: _Estimated, kind: str, tables: ErrorTables | None) -> RunRecord:
    run = estimated.run
    joints = {
        each.number: RunJoint(
            float(each.scored.mean()),
            float(each.standing.mean()),
            None if tables is None else tables.runs[run.name, each.number],
        )
        for each in estimated.samples
    }
    duration = float(run.table.time_s[-1] - run.table.time_s[0])
    return RunRecord(run.name, run.sha256, kind, duration, run.velocity_joint, run.by, joints)


# Targets -----------------------------------------------------------------------------------------------------------------

TOB_RANGE_NM2: Final = (7.0, 14.0)
"""MSE of the classical TOB from which on, and up to which, the emulated bench is as hard as the paper's."""
OURS_TO_PAPER: Final = 0.5
BACK_DRIVE_PERCENT: Final = 2.0
EXTRA_US: Final = 15.0
"""Of a step, all joints together."""
_SAME: Final = 1e-9
"""Relative difference of two mean squares that is rounding: a network that is faded out leaves the physics as it is."""
_NO_WORSE: Final = 1.001
"""Ratio of two RMSE that still counts as no worse: at the rim of the envelope a share of the network is active."""


def targets(result: Evaluation) -> tuple[Target, ...]:
    """Return the targets, each with the paper's figure and ours."""
    variable = result.variable
    return (
        _tob(variable.tested),
        _tob_to_paper(variable),
        _ours_to_paper(variable),
        _every_run(result.run_scores),
        _back_drive(result.plateaus),
        _coverage(result.intervals.get("variable"), result.intervals.get("all")),
        *_outside(result.outside),
        _jump(OURS, "ours", result.jumps.get(OURS), result.passages.get(OURS)),
        _jump(PAPERS, "the paper's chain", result.jumps.get(PAPERS), result.passages.get(PAPERS)),
        _loop_time(result.loop_time),
    )


def worse_runs(runs: Mapping[tuple[str, int], Row]) -> list[tuple[str, int, float, float]]:
    """Return (run, joint, MSE of ours, MSE of the physics) of runs in which ours is worse than its physics [Nm^2]."""
    both = [(*key, mse(one, OURS), mse(one, "physics")) for key, one in runs.items()]
    return [
        (run, number, ours, physics)
        for run, number, ours, physics in both
        if ours is not None and physics is not None and ours > physics * (1.0 + _SAME)
    ]


def mse(one: Row, method: str) -> float | None:
    """Return the mean square error of a method in a row [Nm^2], None where it is not there."""
    return one[method].mse_nm2 if method in one else None


def mse_ratio(one: Row, a: str, b: str) -> float | None:
    """Return the ratio of the mean square errors of two methods in a row; None where one is missing."""
    return ratio(mse(one, a), mse(one, b))


def _tob(tested: Row) -> Target:
    low, high = TOB_RANGE_NM2
    found = mse(tested, "tob")
    return Target(
        "tob_mse",
        "MSE of the classical TOB, velocity mode",
        f"{PAPER_MSE_NM2['tob']:g} Nm²",
        f"{low:g} to {high:g} Nm²",
        _number(found, ".2f", " Nm²"),
        None if found is None else low <= found <= high,
        ("property of the bench, not of the estimate",),
    )


def _tob_to_paper(tables: ErrorTables) -> Target:
    tested, both = (mse_ratio(one, "tob", PAPERS) for one in (tables.tested, tables.both))
    return Target(
        "tob_to_paper",
        "MSE ratio TOB : paper's chain, velocity mode",
        f"{PAPER_MSE_NM2['tob'] / PAPER_MSE_NM2['network']:.0f}",
        "-",
        _number(tested, ".1f"),
        None,
        (f"all joints: {_number(both, '.1f')}; it mostly rewards a baseline without load friction",),
    )


def _ours_to_paper(tables: ErrorTables) -> Target:
    tested, both = (mse_ratio(one, OURS, PAPERS) for one in (tables.tested, tables.both))
    largest = max((value for value in (tested, both) if value is not None), default=None)
    return Target(
        "ours_to_paper",
        "MSE ratio ours : paper's chain",
        "-",
        f"at most {OURS_TO_PAPER:g}",
        _number(largest, ".3f"),
        None if largest is None else largest <= OURS_TO_PAPER,
        (
            f"joint in velocity mode {_number(tested, '.3f')}, all joints {_number(both, '.3f')}; the larger one counts",
        ),
    )


def _every_run(runs: Mapping[tuple[str, int], Row]) -> Target:
    pairs = [
        (one[OURS].mse_nm2, one["physics"].mse_nm2) for one in runs.values() if {OURS, "physics"} <= set(one)
    ]
    worse = worse_runs(runs)
    # a network of share 0 is no network: that ours is not worse then means nothing
    distinct = any(ours != physics for ours, physics in pairs)
    text = "not known"
    if pairs:
        text = f"{len(worse)} of {len(pairs)}" if distinct else "none: they are one number"
    return Target(
        "every_run",
        "runs in which ours is worse than its physics",
        "-",
        "none" if distinct else "-",
        text,
        not worse if distinct else None,
        tuple(
            f"{run} j{number}: {ours:.4f} against {physics:.4f} Nm²" for run, number, ours, physics in worse
        ),
    )


def _back_drive(plateaus: Sequence[PlateauScore]) -> Target:
    hard = hardest_plateaus(plateaus)
    ours = worst_plateau(hard, OURS, "rated_percent")
    tob = worst_plateau(hard, "tob", "percent")
    details = [f"{counted(len(hard), 'plateau')} at 2.4 to 2.6 rad/s and 25 to 35 Nm, back-driven"]
    if tob is not None:
        details.append(f"classical TOB {tob[0]:.1f} % of the torque, {_place(tob[1])}")
    if ours is not None:
        details.append(f"ours worst in {_place(ours[1])}")
    return Target(
        "back_drive",
        "worst error at 2.5 rad/s, 30 Nm, back drive",
        f"{PAPER_WORST_PERCENT:g} % of torque (TOB)",
        f"at most {BACK_DRIVE_PERCENT:g} % of rated",
        _number(None if ours is None else ours[0], ".2f", " % of rated"),
        None if ours is None else ours[0] <= BACK_DRIVE_PERCENT,
        tuple(details),
    )


def _coverage(variable: IntervalTables | None, every: IntervalTables | None) -> Target:
    low, high = (100.0 * share for share in ALLOWED)
    rows = {} if variable is None else variable.quadrants
    cells = {
        f"j{number} {QUADRANT_TITLES[name]}": one for number, row in rows.items() for name, one in row.items()
    }
    shares = [100.0 * one.share for one in cells.values()]
    details = [f"{where}: {one}" for where, one in cells.items() if not low <= 100.0 * one.share <= high]
    if every is not None:
        details.append(
            f"runs at variable velocity; with those at constant velocity {100.0 * every.overall.share:.1f} % overall"
        )
    return Target(
        "coverage",
        "90 % interval of ours, joints and quadrants",
        "-",
        f"covers {low:g} to {high:g} %",
        f"{min(shares):.1f} to {max(shares):.1f} %" if shares else "not known",
        all(low <= share <= high for share in shares) if shares else None,
        tuple(details),
    )


def _outside(found: Sequence[Outside]) -> tuple[Target, Target]:
    ratios = [each.ours.rmse_nm / each.physics.rmse_nm for each in found if each.physics is not None]
    flagged = min((each.flagged for each in found), default=None)
    text = "no network: ours is its physics" if found else "not evaluated (--outside)"
    details = [
        f"j{each.number}: {each.ours.rmse_nm:.3f} "
        + ("" if each.physics is None else f"against {each.physics.rmse_nm:.3f} ")
        + f"Nm, {each.samples} samples outside"
        for each in found
    ]
    return (
        Target(
            "outside_rmse",
            "RMSE ours : physics, outside the envelope",
            "-",
            f"at most {_NO_WORSE:g}",
            f"{max(ratios):.4f}" if ratios else text,
            max(ratios) <= _NO_WORSE if ratios else None,
            tuple(details),
        ),
        Target(
            "outside_flagged",
            "flagged degraded outside the envelope of network or fit",
            "-",
            "-",
            "not evaluated (--outside)" if flagged is None else f"{100.0 * flagged:.2f} %",
            None,
            (
                "by definition: 'python -m validation goals' counts flags outside of what a campaign has driven",
            ),
        ),
    )


def _jump(method: str, name: str, at: Jump | None, passage: Jump | None) -> Target:
    details = []
    if at is not None:
        details += [
            f"at {at.of} in {at.run} j{at.number}, {at.time_s:.2f} s; median {at.median_nm:.2f} Nm of {at.crossings} "
            f"crossings; {at.unshifted_nm:.2f} Nm without allowance for a shift in time",
            f"of as many windows anywhere in motion one exceeds {at.elsewhere_nm:.2f} Nm",
        ]
    if passage is not None:
        details.append(
            f"over whole passages, standstill included: {passage.nm:.2f} Nm ({passage.run} j{passage.number})"
        )
    return Target(
        f"jump_{method}",
        f"jump at a change of quadrant, {name}",
        "-",
        f"at most {LIMIT_NM:g} Nm" if method == OURS else "-",
        _number(None if at is None else at.nm, ".2f", " Nm"),
        None if at is None or method != OURS else at.nm <= LIMIT_NM,
        tuple(details),
    )


def _loop_time(found: LoopTime | None) -> Target:
    extra = None if found is None else found.extra_us(PAPERS)
    details = ["'python -m tests.benchmarks stages' measures it in the whole loop"]
    if found is not None:
        costs = ", ".join(f"{TITLES[method]} {cost:.1f}" for method, cost in found.step_us.items())
        details.insert(
            0,
            f"steps on this machine, {found.joints} joints together, median of {found.samples} samples of {found.run}: "
            f"{costs} us; over the classical TOB {found.extra_us('tob'):.1f} us",
        )
    return Target(
        "loop_time",
        "extra time of ours in the loop, over the paper's",
        "-",
        f"at most {EXTRA_US:g} us, median",
        "not measured" if extra is None else f"{extra:.1f} us",
        None if extra is None else extra <= EXTRA_US,
        tuple(details),
    )


def _place(plateau: PlateauScore) -> str:
    return f"{plateau.run} j{plateau.number} at {plateau.velocity_rad_s:.2f} rad/s and {plateau.torque_nm:.1f} Nm"


def _number(value: float | None, form: str, unit: str = "") -> str:
    return "not known" if value is None else format(value, form) + unit
