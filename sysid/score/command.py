"""`jtq score`: errors of a joint file's simulation and estimators on runs, and what another joint file changes."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from jtqd.estimator.checked import ConfigError
from jtqd.estimator.joint import Joint
from jtqd.estimator.run import RunTableError
from jtqd.models.files import load_joint
from jtqd.sysid.diagnosis.signals import SignalsError
from jtqd.sysid.progress import progress
from jtqd.sysid.runs.checks import check_run
from jtqd.sysid.runs.column_map import ColumnMap
from jtqd.sysid.runs.files import read_runs
from jtqd.sysid.runs.joints import joint_number, only, with_joint
from jtqd.sysid.runs.run_file import RunError, RunFile
from jtqd.sysid.score.score import (
    RunErrors,
    errors_on,
    needs_torsion,
    rows_of,
    table_lines,
    to_mapping,
    visible_on,
)

BY: Final = "jtq score"


def main(argv: list[str]) -> int:
    """Score; exit status 0 done, 1 failure, 2 usage, 3 done, but a run or joint could not be used."""
    options = parser().parse_args(argv)
    files = [options.joint, *([options.after] if options.after else [])]
    try:
        joints = [load_joint(path) for path in files]
        if len(joints) > 1 and joints[0].gear_ratio != joints[1].gear_ratio:
            raise ConfigError(
                f"--after {options.after}: found gear_ratio {joints[1].gear_ratio:g}, expected "
                f"{joints[0].gear_ratio:g} as in {options.joint}: files of the same joint"
            )
        columns = None if options.columns is None else ColumnMap.load(options.columns)
        runs = read_runs(options.runs, columns, in_pieces=True, joints=only(options.number))
        number = joint_number(options.number, joints[0], runs)
        runs = with_joint(runs, number)
        notes = [f"{run.name}: {note}" for run in runs for note in run.notes]
        scored, refused, less = _scored(runs, number, joints)
        notes += less
        for line in (*notes, *refused):
            print(f"{BY}: {line}", file=sys.stderr)
        if not scored[0]:
            raise RunError(f"found no run in which joint {number} can be scored")
    except (ConfigError, RunError, RunTableError, OSError) as error:
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
        checked = check_run(run.table, {number: joints[0]}, run.name, thorough=True)
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
        except (SignalsError, ValueError) as error:
            refused.append(str(error))
            continue
        for each, one in zip(scored, errors, strict=True):
            each.append(one)
    return scored, refused, less


def parser() -> argparse.ArgumentParser:
    """Return the arguments of `jtq score`."""
    parser = argparse.ArgumentParser(
        prog=BY,
        description="Print the error of a joint file's simulation and of each of its estimators on runs that have a torque "
        "reference;\nwith --after the same for a second file. Nothing is fitted.",
        epilog=(
            "examples:\n"
            "  jtq score joint3.yaml new_run.csv --columns columns.yaml --number 3\n"
            "  jtq score joint3.yaml new_*.csv --columns columns.yaml --number 3 --after diagnosis/extended.joint.yaml\n\n"
            "Exit status: 0 done; 1 failure; 2 usage; 3 done, but a run could not be used."
        ),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("joint", type=Path, metavar="JOINT.yaml", help="joint file")
    parser.add_argument(
        "runs",
        nargs="+",
        type=Path,
        metavar="RUN",
        help="run files (.csv, .csv.gz, .parquet, .mcap) or directories of them",
    )
    parser.add_argument(
        "--after",
        type=Path,
        metavar="FILE",
        help="a second file of the same joint, to compare with the first",
    )
    parser.add_argument(
        "--number",
        type=int,
        choices=range(1, 8),
        metavar="N",
        help="number of the joint in the runs (default: the one that its name ends in, or the only one)",
    )
    parser.add_argument(
        "--columns", type=Path, metavar="FILE", help="column map for other names, units and signs"
    )
    parser.add_argument("--json", action="store_true", help="print the table as JSON (jtq.score/1)")
    return parser
