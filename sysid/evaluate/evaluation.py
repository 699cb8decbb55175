"""Evaluation of all methods on all runs: every table of the report, the targets, and the time of a step. No file.

Time of a step, each method's part of jtqd's loop: every step is timed alone on samples of an evaluated run, with the loop's
own estimators and networks. The methods take turns in short blocks, so that a busy machine affects all alike, and the median
drops the steps in which the machine did something else. One process in a tight loop: caches are warmer than in a loop that
sleeps between its cycles.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from time import perf_counter_ns
from typing import Final, NamedTuple

import numpy as np

from jtqd.estimator.estimator import make_estimator
from jtqd.estimator.joint import Envelope
from jtqd.estimator.network import PathNetwork
from jtqd.estimator.settings import recommended
from jtqd.estimator.text import counted
from jtqd.sysid.evaluate.inputs import (
    OURS,
    PAPERS,
    TITLES,
    EvaluatedRun,
    JointModels,
    Samples,
    take_samples,
)
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
    shown,
    standstill,
    truth_tables,
    worst_plateau,
)
from jtqd.sysid.fit.efficiency import QUADRANT_TITLES
from jtqd.sysid.fit.plateaus import Plateau
from jtqd.sysid.progress import progress
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
        took: dict[str, list[int]] = {method: [] for method in TIMED}
        steps = {
            method: make_estimator(each.joint, recommended(method), each.networks.get(method)).step
            for method in TIMED
        }
        for begin in range(0, len(rows), _BLOCK):
            for method, step in steps.items():
                for row in rows[begin : begin + _BLOCK]:
                    began = clock_ns()
                    step(*row)
                    took[method].append(clock_ns() - began)
        for method, times in took.items():
            total[method] += float(np.median(times)) * 1e-3
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
    warm = np.full(len(time_s), np.nan) if columns.temperature_c is None else columns.temperature_c
    steps = np.diff(time_s)[begin - 1 : begin - 1 + SAMPLES].tolist()
    return list(zip(steps, *values, warm[at].tolist(), strict=True))


# Tables ------------------------------------------------------------------------------------------------------------------

NO_VALUE_SHARE: Final = 0.01
"""Share of the moving samples without a value of a method from which on that is a finding."""


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
    plateaus: tuple[list[Plateau], ...]


def evaluate(
    runs: Sequence[EvaluatedRun], outside: Sequence[EvaluatedRun], models: Sequence[JointModels]
) -> Evaluation:
    """Score all methods on runs, and ours outside its envelope on the runs `outside`.

    Raises ConfigError when a joint and its networks do not fit, ValueError when no run has a sample to score.
    """
    findings: list[RunIssue] = []
    estimated = _estimate(progress(runs, "estimating"), models, findings)
    outer = _estimate(progress(outside, "estimating outside"), models, findings)
    if not estimated:
        raise ValueError("found no run with a moving sample that every method has a value for, expected one")
    by_kind: dict[str, list[_Estimated]] = {"constant": [], "variable": [], "outside": outer}
    for each in estimated:
        kind = "constant" if any(map(is_constant, each.plateaus, each.samples)) else "variable"
        by_kind[kind].append(each)
    scored: list[PlateauScore] = []
    for each in by_kind["constant"]:
        for plateaus, samples in zip(each.plateaus, each.samples, strict=True):
            found, lost = plateau_scores(plateaus, samples)
            scored += found
            findings += [RunIssue("plateau_lost", text) for text in lost]
    every = _samples(estimated)
    parts = {kind: _samples(by_kind[kind]) for kind in ("variable", "constant")} | {"all": every}
    modes = {each.run.name: each.run.velocity_joint for each in estimated}
    tables = {kind: error_tables(parts[kind], modes) for kind in ("variable", "constant")}
    methods = [method for method in TITLES if any(method in each.methods for each in models)]
    intervals = {
        name: interval_tables([for_intervals(each) for each in part]) for name, part in parts.items()
    }
    tested = [each for each in parts["variable"] if modes.get(each.run) == each.number]
    result = Evaluation(
        models=tuple(models),
        runs=tuple(_record(each, kind, tables.get(kind)) for kind, part in by_kind.items() for each in part),
        findings=tuple(findings),
        plateaus=tuple(scored),
        variable=tables["variable"],
        constant_tables=tables["constant"],
        intervals={name: table for name, table in intervals.items() if table is not None},
        standstill=standstill([for_intervals(each) for each in every]),
        jumps={m: jump for m in methods if (jump := largest_jump(every, m))},
        passages={m: jump for m in methods if (jump := largest_jump(every, m, passage=True))},
        outside=tuple(outside_scores(_samples(outer), _envelopes(models))),
        picture=median_run(tested or parts["variable"]),  # of the joint in velocity mode, as in the paper
        loop_time=loop_time(runs, models),
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
            findings += _without_value(one)
            if one.scored.any():
                samples.append(one)
                plateaus.append(plateaus_of(run.name, run.table.time_s, columns, each.joint))
        if samples:
            estimated.append(_Estimated(run, tuple(samples), tuple(plateaus)))
    return estimated


def _without_value(samples: Samples) -> list[RunIssue]:
    """Return why nothing is scored, or which methods had no value where the joint moved."""
    where = f"{samples.run}: j{samples.number}"
    if not samples.scored.any():
        why = "found no sample at which every method has a value, expected most of them: not scored"
        if samples.standing.any():
            share = 100.0 * float(samples.standing.mean())
            why = (
                f"found standstill in {share:.0f} % of the samples and no moving sample with a value of every method: "
                "not scored"
            )
        return [RunIssue("nothing_to_score", f"{where}: {why}")]
    moving = samples.scored | samples.missing
    share = float(np.count_nonzero(samples.missing)) / float(np.count_nonzero(moving))
    if share <= NO_VALUE_SHARE:
        return []
    names = [
        TITLES[method]
        for method, value in samples.estimate_nm.items()
        if np.isnan(value[samples.missing]).mean() > NO_VALUE_SHARE
    ]
    text = (
        f"{where}: found no value of {', '.join(names)} in {100.0 * share:.1f} % of the moving samples: these samples are "
        "scored for no method"
    )
    return [RunIssue("no_value", text)]


def _samples(estimated: Iterable[_Estimated]) -> list[Samples]:
    return [samples for each in estimated for samples in each.samples]


def _envelopes(models: Iterable[JointModels]) -> dict[int, Envelope]:
    """Return the envelope of each joint: of the fit, and without torsion of the network of the current path."""
    found = {}
    for each in models:
        network = each.networks.get(OURS)
        fitted = None if each.joint.fused is None else each.joint.fused.envelope
        found[each.number] = (
            network.envelope if fitted is None and isinstance(network, PathNetwork) else fitted
        )
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
_UNKNOWN: Final = "not known"
_NOT_EVALUATED: Final = "not evaluated (--outside)"


def mse(one: Row, method: str) -> float | None:
    """Return the mean square error of a method in a row [Nm^2], None where it is not there."""
    return one[method].mse_nm2 if method in one else None


def mse_ratio(one: Row, a: str, b: str) -> float | None:
    """Return the ratio of the mean square errors of two methods in a row; None where one is missing."""
    return ratio(mse(one, a), mse(one, b))


Pair = tuple[str, int, float, float]
"""Run, joint, MSE of ours, MSE of its physics [Nm^2]."""


def against_physics(runs: Mapping[tuple[str, int], Row]) -> tuple[list[Pair], list[Pair]]:
    """Return the runs that have ours and its physics, and those of them in which ours is worse."""
    pairs = [
        (*key, one[OURS].mse_nm2, one["physics"].mse_nm2)
        for key, one in runs.items()
        if {OURS, "physics"} <= set(one)
    ]
    return pairs, [each for each in pairs if each[2] > each[3] * (1.0 + _SAME)]


def targets(result: Evaluation) -> tuple[Target, ...]:
    """Return the targets, each with the paper's figure and ours."""
    return (
        *_error_targets(result),
        _back_drive(result.plateaus),
        _coverage(result.intervals),
        *_outside(result.outside),
        _jump(result, OURS, "ours", LIMIT_NM),
        _jump(result, PAPERS, "the paper's chain"),
        _extra_time(result.loop_time),
    )


def _target(  # noqa: PLR0917
    key: str,
    figure: str,
    found: float | tuple[float, ...] | str | None,
    form: str,
    limits: tuple[float, float] | None = None,
    goal: str = "-",
    *,
    paper: str = "-",
    details: Iterable[str] = (),
) -> Target:
    """Return a row: `form` of what was found (a text: why it is unknown), reached where all lies within the limits."""
    reached = None
    if found is None:
        ours = _UNKNOWN
    elif isinstance(found, str):
        ours = found
    else:
        values = found if isinstance(found, tuple) else (found,)
        ours = form.format(*values)
        if limits is not None:
            reached = all(limits[0] <= value <= limits[1] for value in values)
    return Target(key, figure, paper, goal, ours, reached, tuple(details))


def _up_to(limit: float) -> tuple[float, float]:
    return -math.inf, limit


def _error_targets(e: Evaluation) -> Iterator[Target]:
    tested, both = e.variable.tested, e.variable.both
    low, high = TOB_RANGE_NM2
    yield _target(
        "tob_mse",
        "MSE of the classical TOB, velocity mode",
        mse(tested, "tob"),
        "{:.2f} Nm²",
        TOB_RANGE_NM2,
        f"{low:g} to {high:g} Nm²",
        paper=f"{PAPER_MSE_NM2['tob']:g} Nm²",
        details=["property of the bench, not of the estimate"],
    )
    alike = shown(mse_ratio(both, "tob", PAPERS), ".1f", _UNKNOWN)
    yield _target(
        "tob_to_paper",
        "MSE ratio TOB : paper's chain, velocity mode",
        mse_ratio(tested, "tob", PAPERS),
        "{:.1f}",
        paper=f"{PAPER_MSE_NM2['tob'] / PAPER_MSE_NM2['network']:.0f}",
        details=[f"all joints: {alike}; it mostly rewards a baseline without load friction"],
    )
    ratios = [mse_ratio(one, OURS, PAPERS) for one in (tested, both)]
    one, all_ = (shown(each, ".3f", _UNKNOWN) for each in ratios)
    yield _target(
        "ours_to_paper",
        "MSE ratio ours : paper's chain",
        max((each for each in ratios if each is not None), default=None),
        "{:.3f}",
        _up_to(OURS_TO_PAPER),
        f"at most {OURS_TO_PAPER:g}",
        details=[f"joint in velocity mode {one}, all joints {all_}; the larger one counts"],
    )
    pairs, worse = against_physics(e.run_scores)
    # a network of share 0 is no network: that ours is not worse then means nothing
    distinct = any(ours != physics for _, _, ours, physics in pairs)
    found: float | str | None = None
    if distinct:
        found = len(worse)
    elif pairs:
        found = "none: they are one number"
    yield _target(
        "every_run",
        "runs in which ours is worse than its physics",
        found,
        f"{{}} of {len(pairs)}",
        (0, 0),
        "none" if distinct else "-",
        details=[f"{run} j{n}: {ours:.4f} against {physics:.4f} Nm²" for run, n, ours, physics in worse],
    )


def _back_drive(plateaus: Sequence[PlateauScore]) -> Target:
    hard = hardest_plateaus(plateaus)
    ours, tob = worst_plateau(hard, OURS, "rated_percent"), worst_plateau(hard, "tob", "percent")

    def place(plateau: PlateauScore) -> str:
        at = f"{plateau.velocity_rad_s:.2f} rad/s and {plateau.torque_nm:.1f} Nm"
        return f"{plateau.run} j{plateau.number} at {at}"

    return _target(
        "back_drive",
        "worst error at 2.5 rad/s, 30 Nm, back drive",
        None if ours is None else ours[0],
        "{:.2f} % of rated",
        _up_to(BACK_DRIVE_PERCENT),
        f"at most {BACK_DRIVE_PERCENT:g} % of rated",
        paper=f"{PAPER_WORST_PERCENT:g} % of torque (TOB)",
        details=[
            f"{counted(len(hard), 'plateau')} at 2.4 to 2.6 rad/s and 25 to 35 Nm, back-driven",
            *([f"classical TOB {tob[0]:.1f} % of the torque, {place(tob[1])}"] if tob else []),
            *([f"ours worst in {place(ours[1])}"] if ours else []),
        ],
    )


def _coverage(intervals: Mapping[str, IntervalTables]) -> Target:
    low, high = (100.0 * share for share in ALLOWED)
    rows = intervals["variable"].quadrants if "variable" in intervals else {}
    cells = {f"j{n} {QUADRANT_TITLES[name]}": one for n, row in rows.items() for name, one in row.items()}
    shares = [100.0 * one.share for one in cells.values()]
    details = [f"{where}: {one}" for where, one in cells.items() if not low <= 100.0 * one.share <= high]
    if "all" in intervals:
        share = 100.0 * intervals["all"].overall.share
        details.append(f"runs at variable velocity; with those at constant velocity {share:.1f} % overall")
    return _target(
        "coverage",
        "90 % interval of ours, joints and quadrants",
        (min(shares), max(shares)) if shares else None,
        "{:.1f} to {:.1f} %",
        (low, high),
        f"covers {low:g} to {high:g} %",
        details=details,
    )


def _outside(found: Sequence[Outside]) -> Iterator[Target]:
    ratios = [each.ours.rmse_nm / each.physics.rmse_nm for each in found if each.physics is not None]
    largest: float | str = _NOT_EVALUATED
    if ratios:
        largest = max(ratios)
    elif found:
        largest = "no network: ours is its physics"
    yield _target(
        "outside_rmse",
        "RMSE ours : physics, outside the envelope",
        largest,
        "{:.4f}",
        _up_to(_NO_WORSE),
        f"at most {_NO_WORSE:g}",
        details=[
            f"j{each.number}: {each.ours.rmse_nm:.3f} "
            + ("" if each.physics is None else f"against {each.physics.rmse_nm:.3f} ")
            + f"Nm, {each.samples} samples outside"
            for each in found
        ],
    )
    yield _target(
        "outside_flagged",
        "flagged degraded outside the envelope of network or fit",
        100.0 * min(each.flagged for each in found) if found else _NOT_EVALUATED,
        "{:.2f} %",
        details=[
            "by definition: 'python -m validation goals' counts flags outside of what a campaign has driven"
        ],
    )


def _jump(e: Evaluation, method: str, name: str, limit_nm: float | None = None) -> Target:
    at, passage, details = e.jumps.get(method), e.passages.get(method), []
    if at is not None:
        details += [
            f"at {at.of} in {at.run} j{at.number}, {at.time_s:.2f} s; median {at.median_nm:.2f} Nm of {at.crossings} "
            f"crossings; {at.unshifted_nm:.2f} Nm without allowance for a shift in time",
            f"of as many windows anywhere in motion one exceeds {at.elsewhere_nm:.2f} Nm",
        ]
    if passage is not None:
        where = f"{passage.run} j{passage.number}"
        details.append(f"over whole passages, standstill included: {passage.nm:.2f} Nm ({where})")
    return _target(
        f"jump_{method}",
        f"jump at a change of quadrant, {name}",
        None if at is None else at.nm,
        "{:.2f} Nm",
        None if limit_nm is None else _up_to(limit_nm),
        "-" if limit_nm is None else f"at most {limit_nm:g} Nm",
        details=details,
    )


def _extra_time(found: LoopTime | None) -> Target:
    details = ["'python -m tests.benchmarks stages' measures it in the whole loop"]
    if found is not None:
        costs = ", ".join(f"{TITLES[method]} {cost:.1f}" for method, cost in found.step_us.items())
        details.insert(
            0,
            f"steps on this machine, {found.joints} joints together, median of {found.samples} samples of {found.run}: "
            f"{costs} us; over the classical TOB {found.extra_us('tob'):.1f} us",
        )
    return _target(
        "loop_time",
        "extra time of ours in the loop, over the paper's",
        "not measured" if found is None else found.extra_us(PAPERS),
        "{:.1f} us",
        _up_to(EXTRA_US),
        f"at most {EXTRA_US:g} us, median",
        details=details,
    )
