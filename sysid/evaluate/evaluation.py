"""Evaluate all methods on all runs: samples of every run and joint, every table of the report, and the targets.

No file and no clock: a pure function of runs and models.

Measure the time of one step of each method on samples of an evaluated run: its part of jtqd's loop.

Every step is timed alone, as the loop would call it, with the loop's own estimators and networks; the methods take turns
in short blocks, so that a busy machine affects all alike, and the median leaves out the steps in which the machine did
something else. One process in a tight loop: caches are warmer than in a loop that sleeps between its cycles.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from time import perf_counter_ns
from typing import Final, NamedTuple, TypeVar

import numpy as np

from jtqd.estimator.joint import Envelope
from jtqd.estimator.methods import make_estimator
from jtqd.estimator.network import FusedNetwork
from jtqd.estimator.settings import recommended
from jtqd.estimator.text import counted
from jtqd.sysid.evaluate.inputs import JudgedRun
from jtqd.sysid.evaluate.methods import OURS, PAPERS, TITLES, JointModels, Samples, take_samples
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

METHODS: Final = ("tob", PAPERS, OURS)
SAMPLES: Final = 3000
"""Steps per joint and method, from the middle of the run: it moves there."""
_BLOCK: Final = 100


class LoopTime(NamedTuple):
    """Median cost of a step [us] by method, summed over the joints that have all of METHODS; run: of the samples."""

    step_us: Mapping[str, float]
    joints: int
    samples: int
    run: str

    def extra_us(self, over: str) -> float:
        """Return what ours costs more than another method [us], all joints together."""
        return self.step_us[OURS] - self.step_us[over]


def loop_time(
    runs: Sequence[JudgedRun],
    models: Sequence[JointModels],
    clock_ns: Callable[[], int] = perf_counter_ns,
) -> LoopTime | None:
    """Return what steps cost on the first run that holds every such joint; None where no joint has all of METHODS."""
    whole = [each for each in models if set(METHODS) <= set(each.methods)]
    run = next((run for run in runs if whole and all(each.number in run.columns for each in whole)), None)
    if run is None:
        return None
    total = dict.fromkeys(METHODS, 0.0)
    for each in whole:
        rows = _rows(run, each)
        for method, cost in _costs_us(each, rows, clock_ns).items():
            total[method] += cost
    return LoopTime(total, len(whole), len(rows), run.name)


_Row = tuple[float, float, float, float, float]


def _rows(run: JudgedRun, models: JointModels) -> list[tuple[_Row, float]]:
    """Return ((dt, current, motor position, motor velocity, link position), temperature) of the middle of the run."""
    columns = run.columns[models.number]
    time_s = run.table.time_s
    begin = max((len(time_s) - SAMPLES) // 2, 1)
    at = slice(begin, begin + SAMPLES)
    names = ("current_a", "motor_position_rad", "motor_velocity_rad_s", "link_position_rad")
    values = [np.asarray(getattr(columns, name))[at].tolist() for name in names]
    warm = columns.temperature_c
    known = np.full(len(time_s), np.nan) if warm is None else np.asarray(warm)
    rows = zip(np.diff(time_s)[begin - 1 : begin - 1 + SAMPLES].tolist(), *values, strict=True)
    return list(zip(rows, known[at].tolist(), strict=True))


def _costs_us(
    models: JointModels, rows: list[tuple[_Row, float]], clock_ns: Callable[[], int]
) -> dict[str, float]:
    """Return the median cost of a step [us] by method."""
    steps = {
        method: make_estimator(models.joint, recommended(method), models.networks.get(method)).step
        for method in METHODS
    }
    took: dict[str, list[int]] = {method: [] for method in METHODS}
    for begin in range(0, len(rows), _BLOCK):
        for method, step in steps.items():
            times = took[method]
            for row, temperature_c in rows[begin : begin + _BLOCK]:
                began = clock_ns()
                step(*row, temperature_c)
                times.append(clock_ns() - began)
    return {method: float(np.median(times)) * 1e-3 for method, times in took.items()}


SILENT_SHARE: Final = 0.01
"""Share of the moving samples that a method may leave without a value and not be named for it."""

T = TypeVar("T")
Progress = Callable[[Sequence[T], str], Iterable[T]]


class RunRecord(NamedTuple):
    """What a run was: kind constant, variable or outside; joints: by number, (share scored, share standing)."""

    name: str
    sha256: str
    kind: str
    duration_s: float
    velocity_joint: int | None
    velocity_joint_by: str
    joints: Mapping[int, tuple[float, float]]


@dataclass(frozen=True)
class Evaluation:
    """Every table of the report.

    plateaus: of runs at constant velocity; variable, constant_tables: errors over the samples of runs of either kind;
    intervals: of ours, under "variable", "constant" and "all"; jumps, passages: largest ones by method; picture: the run
    of the figure like the paper's Fig. 16; loop_time: what steps cost, None where it was not measured;
    truth: against the true torque, None where no run has it.
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
    targets: tuple[Target, ...] = field(default=())

    @property
    def methods(self) -> tuple[str, ...]:
        """Methods that at least one joint has, in TITLES' order."""
        return tuple(method for method in TITLES if any(method in each.methods for each in self.models))


class _Judged(NamedTuple):
    run: JudgedRun
    samples: tuple[Samples, ...]
    plateaus: tuple[tuple[Plateau, ...], ...]
    """Of each of `samples`."""


def evaluate(
    runs: Sequence[JudgedRun],
    outside: Sequence[JudgedRun],
    models: Sequence[JointModels],
    progress: Progress[JudgedRun] = lambda items, text: items,
    measured: LoopTime | None = None,
) -> Evaluation:
    """Score all methods on runs, and ours outside its envelope on the runs `outside`; measured: the cost of their steps.

    Raises ConfigError when a joint and its networks do not fit, ValueError when no run has a sample to score.
    """
    findings: list[RunIssue] = []
    judged = _judge(progress(runs, "estimating"), models, findings)
    beyond = _judge(progress(outside, "estimating outside"), models, findings)
    if not judged:
        raise ValueError("found no run with a moving sample that every method has a value for, expected one")
    constant: list[_Judged] = []
    variable: list[_Judged] = []
    for each in judged:
        (constant if any(map(is_constant, each.plateaus, each.samples)) else variable).append(each)
    scored: list[PlateauScore] = []
    for each in constant:
        for plateaus, samples in zip(each.plateaus, each.samples, strict=True):
            found, lost = plateau_scores(plateaus, samples)
            scored += found
            findings += [RunIssue("plateau_lost", text) for text in lost]
    every = _samples(judged)
    parts = {"variable": _samples(variable), "constant": _samples(constant), "all": every}
    modes = {each.run.name: each.run.velocity_joint for each in judged}
    methods = [method for method in TITLES if any(method in each.methods for each in models)]
    result = Evaluation(
        models=tuple(models),
        runs=tuple(
            _record(each, kind)
            for kind, part in (("constant", constant), ("variable", variable), ("outside", beyond))
            for each in part
        ),
        findings=tuple(findings),
        plateaus=tuple(scored),
        variable=error_tables(parts["variable"], modes),
        constant_tables=error_tables(parts["constant"], modes),
        intervals={
            name: table
            for name, part in parts.items()
            if (table := interval_tables([for_intervals(each) for each in part])) is not None
        },
        standstill=standstill([for_intervals(each) for each in every]),
        jumps={method: jump for method in methods if (jump := largest_jump(every, method)) is not None},
        passages={
            method: jump
            for method in methods
            if (jump := largest_jump(every, method, passage=True)) is not None
        },
        outside=tuple(outside_scores(_samples(beyond), _envelopes(models))),
        picture=_picture(parts["variable"], modes),
        loop_time=measured,
        truth=truth_tables(every),
    )
    return replace(result, targets=targets(result))


def _judge(
    runs: Iterable[JudgedRun], models: Sequence[JointModels], findings: list[RunIssue]
) -> list[_Judged]:
    judged = []
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
            findings += _silent(one)
            samples.append(one)
            plateaus.append(tuple(plateaus_of(run.name, run.table.time_s, columns, each.joint)))
        if samples:
            judged.append(_Judged(run, tuple(samples), tuple(plateaus)))
    return judged


def _silent(samples: Samples) -> list[RunIssue]:
    """Name methods that had no value where the joint moved: what they miss is in no score."""
    moving = samples.scored | samples.missing
    share = float(np.count_nonzero(samples.missing)) / float(np.count_nonzero(moving))
    if share <= SILENT_SHARE:
        return []
    silent = [
        TITLES[method]
        for method, value in samples.estimate_nm.items()
        if np.isnan(value[samples.missing]).mean() > SILENT_SHARE
    ]
    return [
        RunIssue(
            "no_value",
            f"{samples.run}: j{samples.number}: found no value of {', '.join(silent)} in {100.0 * share:.1f} % of the "
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


def _samples(judged: Iterable[_Judged]) -> list[Samples]:
    return [samples for each in judged for samples in each.samples]


def _envelopes(models: Iterable[JointModels]) -> dict[int, Envelope]:
    """Return where each joint was known to the network of ours, or without one to the fit."""
    found = {}
    for each in models:
        network = each.networks.get(OURS)
        fitted = None if each.joint.fused is None else each.joint.fused.envelope
        found[each.number] = network.envelope if isinstance(network, FusedNetwork) else fitted
    return {number: envelope for number, envelope in found.items() if envelope is not None}


def _picture(samples: Sequence[Samples], modes: Mapping[str, int | None]) -> Samples | None:
    """Return the median run, of the joint in velocity mode where that is known, as in the paper's Fig. 16."""
    tested = [each for each in samples if modes.get(each.run) == each.number]
    return median_run(tested or samples)


def _record(judged: _Judged, kind: str) -> RunRecord:
    run = judged.run
    joints = {
        each.number: (float(each.scored.mean()), float(each.standing.mean())) for each in judged.samples
    }
    duration = float(run.table.time_s[-1] - run.table.time_s[0])
    return RunRecord(run.name, run.sha256, kind, duration, run.velocity_joint, run.by, joints)


TOB_RANGE_NM2: Final = (7.0, 14.0)
"""MSE of the classical TOB from which on, and up to which, the emulated bench is as hard as the paper's."""
OURS_TO_PAPER: Final = 0.5
BACK_DRIVE_PERCENT: Final = 2.0
EXTRA_US: Final = 15.0
"""Of a step, all joints together."""
_SAME: Final = 1e-9
"""Relative difference of two mean squares that is rounding: a network that is out of charge leaves the physics as it is."""
_NO_WORSE: Final = 1.001
"""Ratio of two RMSE that still counts as no worse: at the rim of the envelope a share of the network is left."""


class Target(NamedTuple):
    """One row: what, the paper's figure, the goal, ours as text, whether reached (None: not known), and the details."""

    key: str
    figure: str
    paper: str
    goal: str
    ours: str
    reached: bool | None
    details: tuple[str, ...] = ()


def targets(result: Evaluation) -> tuple[Target, ...]:
    """Return the targets, each beside the paper's figure and ours."""
    return (
        _tob(result.variable.tested),
        _tob_to_paper(result),
        _ours_to_paper(result),
        _every_run({**result.variable.runs, **result.constant_tables.runs}),
        _back_drive(result.plateaus),
        _coverage(result.intervals.get("variable"), result.intervals.get("all")),
        *_outside(result.outside),
        _jump(OURS, "ours", result.jumps.get(OURS), result.passages.get(OURS)),
        _jump(PAPERS, "the paper's chain", result.jumps.get(PAPERS), result.passages.get(PAPERS)),
        _loop_time(result.loop_time),
    )


def worse_runs(runs: Mapping[tuple[str, int], Row]) -> list[tuple[str, int, float, float]]:
    """Return (run, joint, MSE of ours, MSE of the physics) of runs in which ours is worse than its physics [Nm^2]."""
    worse = []
    for (run, number), one in runs.items():
        if OURS in one and "physics" in one:
            ours, physics = one[OURS].mse_nm2, one["physics"].mse_nm2
            if ours > physics * (1.0 + _SAME):
                worse.append((run, number, ours, physics))
    return worse


def mse(one: Row, method: str) -> float | None:
    """Return the mean square error of a method in a row [Nm^2], None where it is not there."""
    return one[method].mse_nm2 if method in one else None


def _tob(tested: Row) -> Target:
    low, high = TOB_RANGE_NM2
    found = mse(tested, "tob")
    return Target(
        "tob_mse",
        "MSE of the classical TOB, velocity mode",
        f"{PAPER_MSE_NM2['tob']:g} Nm²",
        f"{low:g} to {high:g} Nm²",
        "not known" if found is None else f"{found:.2f} Nm²",
        None if found is None else low <= found <= high,
        ("property of the bench, not of the estimate",),
    )


def _tob_to_paper(result: Evaluation) -> Target:
    tested, both = (
        ratio(mse(one, "tob"), mse(one, PAPERS)) for one in (result.variable.tested, result.variable.both)
    )
    return Target(
        "tob_to_paper",
        "MSE ratio TOB : paper's chain, velocity mode",
        f"{PAPER_MSE_NM2['tob'] / PAPER_MSE_NM2['network']:.0f}",
        "-",
        _number(tested, ".1f"),
        None,
        (f"all joints: {_number(both, '.1f')}; it mostly rewards a baseline without load friction",),
    )


def _ours_to_paper(result: Evaluation) -> Target:
    tested, both = (
        ratio(mse(one, OURS), mse(one, PAPERS)) for one in (result.variable.tested, result.variable.both)
    )
    known = [value for value in (tested, both) if value is not None]
    return Target(
        "ours_to_paper",
        "MSE ratio ours : paper's chain",
        "-",
        f"at most {OURS_TO_PAPER:g}",
        _number(max(known, default=None), ".3f"),
        max(known) <= OURS_TO_PAPER if known else None,
        (
            f"joint in velocity mode {_number(tested, '.3f')}, all joints {_number(both, '.3f')}; the larger one counts",
        ),
    )


def _every_run(runs: Mapping[tuple[str, int], Row]) -> Target:
    judged = [key for key, one in runs.items() if OURS in one and "physics" in one]
    worse = worse_runs(runs)
    # a network of share 0 is no network: that ours is not worse then says nothing
    told = any(runs[key][OURS].mse_nm2 != runs[key]["physics"].mse_nm2 for key in judged)
    return Target(
        "every_run",
        "runs in which ours is worse than its physics",
        "-",
        "none" if told else "-",
        "none: they are one number"
        if judged and not told
        else f"{len(worse)} of {len(judged)}"
        if judged
        else "not known",
        not worse if told else None,
        tuple(
            f"{run} j{number}: {ours:.4f} against {physics:.4f} Nm²" for run, number, ours, physics in worse
        ),
    )


def _back_drive(plateaus: Sequence[PlateauScore]) -> Target:
    hard = hardest_plateaus(plateaus)
    ours = worst_plateau(hard, OURS, PlateauScore.rated_percent)
    tob = worst_plateau(hard, "tob", PlateauScore.percent)
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
        "not known" if ours is None else f"{ours[0]:.2f} % of rated",
        None if ours is None else ours[0] <= BACK_DRIVE_PERCENT,
        tuple(details),
    )


def _coverage(variable: IntervalTables | None, every: IntervalTables | None) -> Target:
    low, high = (100.0 * share for share in ALLOWED)
    cells = (
        {}
        if variable is None
        else {
            f"j{number} {QUADRANT_TITLES[name]}": one
            for number, row in variable.quadrants.items()
            for name, one in row.items()
        }
    )
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
    return (
        Target(
            "outside_rmse",
            "RMSE ours : physics, outside the envelope",
            "-",
            f"at most {_NO_WORSE:g}",
            f"{max(ratios):.4f}"
            if ratios
            else "no network: ours is its physics"
            if found
            else "not evaluated (--outside)",
            max(ratios) <= _NO_WORSE if ratios else None,
            tuple(
                f"j{each.number}: {each.ours.rmse_nm:.3f} "
                + ("" if each.physics is None else f"against {each.physics.rmse_nm:.3f} ")
                + f"Nm, {each.samples} samples outside"
                for each in found
            ),
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
        "not known" if at is None else f"{at.nm:.2f} Nm",
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


def _number(value: float | None, form: str) -> str:
    return "not known" if value is None else format(value, form)
