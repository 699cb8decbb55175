"""The figures to reach: each one computed from the evaluation, beside the paper's and the goal. Pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Final, NamedTuple

from sysid.efficiency_report import TITLES as QUADRANT_TITLES
from sysid.evaluate import constant, intervals, outside
from sysid.evaluate.crossings import LIMIT_NM, Jump
from sysid.evaluate.loop_time import LoopTime
from sysid.evaluate.methods import OURS, PAPERS, TITLES
from sysid.evaluate.score import ratio
from sysid.evaluate.variable import PAPER_MSE_NM2, Row

if TYPE_CHECKING:
    from sysid.evaluate.evaluation import Evaluation

TOB_RANGE_NM2: Final = (7.0, 14.0)
"""MSE of the classical TOB from which on, and up to which, the emulated bench is as hard as the paper's."""
TOB_TO_PAPER: Final = 46.0
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
    """Return the table of the figures to reach."""
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
        ("how hard the bench is, not how good the estimate",),
    )


def _tob_to_paper(result: Evaluation) -> Target:
    tested, both = (
        ratio(mse(one, "tob"), mse(one, PAPERS)) for one in (result.variable.tested, result.variable.both)
    )
    return Target(
        "tob_to_paper",
        "MSE ratio TOB : paper's chain, velocity mode",
        f"{PAPER_MSE_NM2['tob'] / PAPER_MSE_NM2['network']:.0f}",
        f"at least {TOB_TO_PAPER:g}",
        _number(tested, ".1f"),
        None if tested is None else tested >= TOB_TO_PAPER,
        (f"all joints: {_number(both, '.1f')}",),
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
    return Target(
        "every_run",
        "runs in which ours is worse than its physics",
        "-",
        "none",
        f"{len(worse)} of {len(judged)}" if judged else "not known",
        not worse if judged else None,
        tuple(
            f"{run} j{number}: {ours:.4f} against {physics:.4f} Nm²" for run, number, ours, physics in worse
        ),
    )


def _back_drive(plateaus: Sequence[constant.PlateauScore]) -> Target:
    hard = constant.hardest(plateaus)
    ours = constant.worst(hard, OURS, constant.PlateauScore.rated_percent)
    tob = constant.worst(hard, "tob", constant.PlateauScore.percent)
    details = [f"{len(hard)} plateaus at 2.4 to 2.6 rad/s and 25 to 35 Nm, back-driven"]
    if tob is not None:
        details.append(f"classical TOB {tob[0]:.1f} % of the torque, {_place(tob[1])}")
    if ours is not None:
        details.append(f"ours worst in {_place(ours[1])}")
    return Target(
        "back_drive",
        "worst error at 2.5 rad/s, 30 Nm, back drive",
        f"{constant.PAPER_WORST_PERCENT:g} % of torque (TOB)",
        f"at most {BACK_DRIVE_PERCENT:g} % of rated",
        "not known" if ours is None else f"{ours[0]:.2f} % of rated",
        None if ours is None else ours[0] <= BACK_DRIVE_PERCENT,
        tuple(details),
    )


def _coverage(variable: intervals.IntervalTables | None, every: intervals.IntervalTables | None) -> Target:
    low, high = (100.0 * share for share in intervals.ALLOWED)
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


def _outside(found: Sequence[outside.Outside]) -> tuple[Target, Target]:
    worst = max(found, key=lambda each: each.ours.rmse_nm / each.physics.rmse_nm, default=None)
    flagged = min((each.flagged for each in found), default=None)
    goal = 100.0 * outside.FLAGGED
    return (
        Target(
            "outside_rmse",
            "RMSE ours : physics, outside the envelope",
            "-",
            f"at most {_NO_WORSE:g}",
            "not asked (--outside)" if worst is None else f"{worst.ours.rmse_nm / worst.physics.rmse_nm:.4f}",
            None
            if worst is None
            else all(each.ours.rmse_nm <= _NO_WORSE * each.physics.rmse_nm for each in found),
            tuple(
                f"j{each.number}: {each.ours.rmse_nm:.3f} against {each.physics.rmse_nm:.3f} Nm, "
                f"{each.samples} samples outside"
                for each in found
            ),
        ),
        Target(
            "outside_flagged",
            "flagged degraded outside the envelope",
            "-",
            f"at least {goal:g} %",
            "not asked (--outside)" if flagged is None else f"{100.0 * flagged:.2f} %",
            None if flagged is None else flagged >= outside.FLAGGED,
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


def _place(plateau: constant.PlateauScore) -> str:
    return f"{plateau.run} j{plateau.number} at {plateau.velocity_rad_s:.2f} rad/s and {plateau.torque_nm:.1f} Nm"


def _number(value: float | None, form: str) -> str:
    return "not known" if value is None else format(value, form)
