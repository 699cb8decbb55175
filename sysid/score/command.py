"""Errors of a joint file on runs: what its simulation and its estimators get wrong, against the torque that was measured.

    simulation  residuals of the motor and the torsion balance with all effects of the file, averaged over
                5 ms and without what the resolution of the positions makes of the acceleration, both as in a diagnosis,
                rms in motion; the torsion's without its mean in each run, whose zero differs
    free run    error of the simulated velocity and position in half a second alone (`free_run`)
    estimators  estimate less sensor, the sensor passed through the same low-pass, rms over the samples in motion

Nothing is fitted. A method that needs what a joint file does not have (efficiency, section `fused`), or a run does not
have (both encoders, for a torsion), is left out.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.estimator.command_line import command_parser
from jtqd.estimator.corrections import with_effects_applied
from jtqd.estimator.effects.effect import MOTOR as BALANCE_MOTOR
from jtqd.estimator.effects.effect import TORSION as BALANCE_TORSION
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.estimator import estimate_columns
from jtqd.estimator.joint import Joint
from jtqd.estimator.observer import low_pass
from jtqd.estimator.run import RunTable
from jtqd.estimator.settings import METHODS, bandwidth_of, recommended
from jtqd.estimator.text import finite
from jtqd.estimator.text import table_lines as aligned
from jtqd.models.files import load_joint
from jtqd.sysid.progress import progress
from jtqd.sysid.runs.checks import check_run
from jtqd.sysid.runs.column_map import ColumnMap
from jtqd.sysid.runs.files import read_runs
from jtqd.sysid.runs.options import (
    add_columns,
    add_number,
    add_runs,
    joint_for_runs,
    joint_number,
    only,
    with_joint,
)
from jtqd.sysid.runs.run_file import RunError, RunFile

if TYPE_CHECKING:  # scipy, which --help does not need
    from jtqd.sysid.diagnosis.smoothing import Smoother

SCHEMA: Final = "jtq.score/1"
MOTOR: Final = "simulation, motor balance"
TORSION: Final = "simulation, torsion balance"
FREE: Final = "simulation, free run"
FREE_POSITION: Final = "simulation, free run, position"
ESTIMATORS: Final = {
    name: f"estimator {name}{', without network' if method.network else ''}"
    for name, method in METHODS.items()
    if not method.network_required
}
"""Method of jtqd -> name of its row. Networks are no part of a joint file (`jtq evaluate` scores them)."""
UNITS: Final = {FREE: "rad/s", FREE_POSITION: "rad"}
SETTLE_S: Final = 0.1
"""From the first sample on for so long the filters' starts are in the estimates."""


@dataclass(frozen=True)
class RunErrors:
    """Rms errors of one joint file on one run by what is wrong (NaN: not measurable), and the time in motion."""

    run: str
    errors: Mapping[str, float]
    moving_s: float


@dataclass(frozen=True)
class Row:
    """One row of the table: what, run ("all" for all of them), its error with each joint file, unit."""

    what: str
    run: str
    errors: tuple[float, ...]
    unit: str

    @property
    def change(self) -> float:
        """Relative change from the first file to the last; NaN with one file."""
        first, last = self.errors[0], self.errors[-1]
        return last / first - 1.0 if len(self.errors) > 1 and first > 0.0 else math.nan


def visible_on(name: str, table: RunTable, number: int, joint: Joint) -> Smoother:
    """Return what of a balance of this joint the resolution of a run lets through. Raises SignalsError."""
    from jtqd.sysid.diagnosis.signals import BaseLoss, joint_signals

    return joint_signals(name, table, number, joint, BaseLoss(joint)).visible


def errors_on(
    name: str, table: RunTable, number: int, joint: Joint, visible: Smoother | None = None
) -> RunErrors:
    """Return the errors of one joint file on one run.

    visible: of the file that it is compared with, so that both are judged by the same part of the run; None: its own.

    Raises SignalsError for a run without what a simulation needs, ConfigError for a joint file that an estimator refuses.
    """
    from jtqd.sysid.diagnosis.dataset import without_known_effects
    from jtqd.sysid.diagnosis.regressors import all_in_bin, bin_samples, binned
    from jtqd.sysid.diagnosis.signals import BaseLoss, about_zero, joint_signals
    from jtqd.sysid.score.free_run import free_run

    plain = with_effects_applied(joint)
    base = BaseLoss(plain)
    raw = joint_signals(name, table, number, plain, base)
    if visible is not None:
        raw = replace(raw, visible=visible)
    [signals] = about_zero([raw], {number: base})
    signals = without_known_effects(signals)
    moving = signals.moving
    samples = bin_samples([signals])

    def judged(balance: str, residual: FloatArray) -> FloatArray:
        whole = all_in_bin(moving & signals.usable(balance), samples)
        return binned(signals.visible(residual), samples)[whole]

    errors = {MOTOR: _rms(judged(BALANCE_MOTOR, signals.motor_nm))}
    if signals.torsion_nm is not None:
        rest = judged(BALANCE_TORSION, signals.torsion_nm)
        errors[TORSION] = _rms(rest - rest.mean()) if len(rest) else math.nan
    errors[FREE] = errors[FREE_POSITION] = math.nan
    if moving.any():
        free = free_run(raw, plain)
        errors[FREE], errors[FREE_POSITION] = free.rmse_rad_s, free.rmse_rad
    columns = table.joint(number, joint.gear_ratio)
    assert columns.torque_nm is not None
    settled = moving & (table.time_s - table.time_s[0] >= SETTLE_S)
    dt = table.dt_s
    for method, title in ESTIMATORS.items():
        kind = METHODS[method]
        if any(getattr(joint, section) is None for section in kind.sections) or (
            kind.with_torsion and needs_torsion(table, number, joint)
        ):
            continue
        # it is the joint file that is scored: one age for all files, also of before the torsion was tracked
        settings = replace(recommended(method), track_zeros=False, track_torsion=False)
        estimate = estimate_columns(joint, settings, None, table.time_s, columns).torque_nm
        sensor = low_pass(columns.torque_nm, dt, bandwidth_of(joint, settings))
        errors[title] = _rms((estimate - sensor)[settled])
    return RunErrors(name, errors, int(np.count_nonzero(moving)) * signals.step_s)


def needs_torsion(table: RunTable, number: int, joint: Joint) -> bool:
    """Return whether the joint's method fused estimates from a torsion that this run does not have: one encoder."""
    torsion = joint.fused is not None and joint.fused.torsion is not None
    return torsion and not table.joints[number].two_encoders(joint.gear_ratio)


def rows_of(scored: Sequence[Sequence[RunErrors]]) -> list[Row]:
    """Return the table of [file][run]: for each row that every file has all runs together, then each run.

    All runs together: root of the mean square, weighted by the time in motion.
    """
    rows = []
    for what in (MOTOR, TORSION, FREE, FREE_POSITION, *ESTIMATORS.values()):
        each = [[run.errors.get(what, math.nan) for run in runs] for runs in scored]
        if not any(math.isfinite(error) for errors in each for error in errors):
            continue
        unit = UNITS.get(what, "Nm")
        weights = np.array([run.moving_s for run in scored[0]], np.float64)
        rows.append(Row(what, "all", tuple(_together(np.array(errors), weights) for errors in each), unit))
        rows += [
            Row(what, run.run, tuple(errors[k] for errors in each), unit) for k, run in enumerate(scored[0])
        ]
    return rows


def to_mapping(
    rows: Sequence[Row], *, joint: int, files: Sequence[str], notes: Sequence[str]
) -> dict[str, Any]:
    """Return the table for programs; what has no value is null."""
    table = [
        {
            "what": row.what,
            "run": row.run,
            "unit": row.unit,
            "rmse": [finite(error) for error in row.errors],
            "change": finite(row.change),
        }
        for row in rows
    ]
    return {"schema": SCHEMA, "joint": joint, "files": list(files), "rows": table, "notes": list(notes)}


def table_lines(rows: Sequence[Row], files: Sequence[str]) -> list[str]:
    """Return the table as lines of text."""
    two = len(files) > 1
    names = ["before", "after"] if two else ["rmse"]
    lines = [["error, rms", "run", *names, "unit", *(["change"] if two else [])]]
    for row in rows:
        what = row.what if row.run == "all" else ""
        errors = [f"{error:.4g}" if math.isfinite(error) else "-" for error in row.errors]
        change = f"{100.0 * row.change:+.0f} %" if math.isfinite(row.change) else "-"
        lines.append([what, row.run, *errors, row.unit, *([change] if two else [])])
    return aligned(lines, (0, 1, len(names) + 2), rule=True)


def _rms(values: FloatArray) -> float:
    good = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(good * good))) if len(good) else math.nan


def _together(errors: FloatArray, weights: FloatArray) -> float:
    good: BoolArray = np.isfinite(errors) & (weights > 0.0)
    if not good.any():
        return math.nan
    return float(np.sqrt(np.sum(weights[good] * errors[good] ** 2) / np.sum(weights[good])))


BY: Final = "jtq score"


def main(argv: list[str]) -> int:
    """Score; exit status 0 done, 1 failure, 2 usage, 3 done, but a run or joint could not be used."""
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # of NumPy, not for a user
        return _main(argv)


def _main(argv: list[str]) -> int:
    options = parser().parse_args(argv)
    files = [options.joint, *([options.after] if options.after else [])]
    try:
        joints = [load_joint(path, elastic=False) for path in files]
        if len(joints) > 1 and joints[0].gear_ratio != joints[1].gear_ratio:
            raise ConfigError(
                f"--after {options.after}: found gear_ratio {joints[1].gear_ratio:g}, expected "
                f"{joints[0].gear_ratio:g} as in {options.joint}: files of the same joint"
            )
        columns = None if options.columns is None else ColumnMap.load(options.columns)
        runs = read_runs(options.runs, columns, segments=True, joints=only(options.number))
        number = joint_number(options.number, joints[0], runs)
        runs = with_joint(runs, number)
        joints = [joint_for_runs(path, runs, number) for path in files]
        notes = [f"{run.name}: {note}" for run in runs for note in run.notes]
        scored, refused, less = _scored(runs, number, joints)
        notes += less
        for line in (*notes, *refused):
            print(f"{BY}: {line}", file=sys.stderr)
        if not scored[0]:
            raise RunError(f"found no run in which joint {number} can be scored")
    except (ValueError, OSError) as error:
        print(f"{BY}: {error}", file=sys.stderr)
        return 1
    rows = rows_of(scored)
    names = [str(path) for path in files]
    if options.json:
        made = to_mapping(rows, joint=number, files=names, notes=[*notes, *refused])
        print(json.dumps(made, indent=1, allow_nan=False))
    else:
        labels = ("before", "after") if len(names) > 1 else ("file",)
        print("\n".join(f"{label}: {name}" for label, name in zip(labels, names, strict=True)))
        print("\n".join(["", *table_lines(rows, names)]))
    return 3 if refused else 0


def _scored(
    runs: Sequence[RunFile], number: int, joints: Sequence[Joint]
) -> tuple[list[list[RunErrors]], list[str], list[str]]:
    """Return the errors [file][run] of the runs that can be used, why others cannot, and what is not scored of those."""
    scored: list[list[RunErrors]] = [[] for _ in joints]
    refused: list[str] = []
    less: list[str] = []
    for run in progress(runs, "scoring"):
        checked = check_run(
            run.table, {number: joints[0]}, run.name, thorough=True, known_loads=run.known_loads
        )
        refused += [issue.text for issue in checked.refused]
        if checked.table is None:
            if not checked.refused:
                refused.append(f"{run.name}: found no columns of j{number}")
            continue
        if any(needs_torsion(checked.table, number, joint) for joint in joints):
            less.append(
                f"{run.name}: j{number}: found one encoder: method fused, which estimates from the torsion, is not scored"
            )
        try:
            visible = visible_on(run.name, checked.table, number, joints[0])
            errors = [errors_on(run.name, checked.table, number, joint, visible) for joint in joints]
        except ValueError as error:  # of signals that are missing, too
            refused.append(str(error))
            continue
        for each, one in zip(scored, errors, strict=True):
            each.append(one)
    return scored, refused, less


def parser() -> argparse.ArgumentParser:
    """Return the arguments of `jtq score`."""
    parser = command_parser(
        BY,
        "Print the error of a joint file's simulation and of each of its estimators on runs that have a torque "
        "reference;\nwith --after the same for a second file. Nothing is fitted.",
        "examples:\n"
        "  jtq score joint3.yaml new_run.csv --columns columns.yaml --number 3\n"
        "  jtq score joint3.yaml new_*.csv --columns columns.yaml --number 3 --after diagnosis/extended.joint.yaml\n\n"
        "Exit status: 0 done; 1 failure; 2 usage; 3 done, but a run could not be used.",
    )
    parser.add_argument("joint", type=Path, metavar="JOINT.yaml", help="joint file")
    add_runs(parser)
    parser.add_argument(
        "--after",
        type=Path,
        metavar="FILE",
        help="a second file of the same joint, to compare with the first",
    )
    add_number(parser)
    add_columns(parser)
    parser.add_argument("--json", action="store_true", help="print the table as JSON (jtq.score/1)")
    return parser


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
