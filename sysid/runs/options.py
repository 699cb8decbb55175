"""Command-line options of runs: RUNS, --columns, --number, and the joint files of --joint."""

from __future__ import annotations

import argparse
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from jtqd.estimator.errors import ConfigError
from jtqd.estimator.joint import Joint
from jtqd.models.files import load_joint
from jtqd.sysid.runs.column_map import ColumnMap
from jtqd.sysid.runs.files import read_runs
from jtqd.sysid.runs.run_file import RunFile

ALL_JOINTS: Final = 0
"""Key of the joint file that serves every joint of the runs."""
_JOINT: Final = re.compile(r"([1-7])=(.+)")


class UsageError(ValueError):
    """A wrong combination of options; one line."""


def joint_files(arguments: Sequence[str], columns: ColumnMap | None) -> dict[int, Path]:
    """Return the joint files by number, or {ALL_JOINTS: file}; without arguments those of the column map. Raises
    UsageError.
    """
    if not arguments:
        if columns is not None and columns.joint_files:
            return dict(columns.joint_files)
        raise UsageError("--joint: missing, expected FILE for all joints, or 1=FILE, 2=FILE, ...")
    files: dict[int, Path] = {}
    for text in arguments:
        match = _JOINT.fullmatch(text)
        name, equals, _ = text.partition("=")
        if not match and (not text or (equals and "/" not in name and not Path(text).exists())):
            raise UsageError(f"--joint {text!r}: expected FILE, or N=FILE with N from 1 to 7")
        number = int(match.group(1)) if match else ALL_JOINTS
        if number in files:
            which = "for all joints" if number == ALL_JOINTS else f"of joint {number}"
            raise UsageError(f"--joint: found two files {which}, expected one")
        files[number] = Path(match.group(2) if match else text)
    if ALL_JOINTS in files and len(files) > 1:
        raise UsageError("--joint: found a file for all joints beside one for one joint, expected either")
    return files


def named_joints(files: Mapping[int, Path]) -> list[int] | None:
    """Return the numbers of the joint files; None for a file that serves all joints."""
    return None if ALL_JOINTS in files else sorted(files)


def only(option: int | None) -> list[int] | None:
    """Return the joint of --number as the only one to be read from a log; None without the option."""
    return None if option is None else [option]


def check_joint_files(files: Mapping[int, Path]) -> None:
    """Load all joint files, before the runs are read; whether they need a stiffness, the runs show. Raises ConfigError."""
    for path in files.values():
        load_joint(path, elastic=False)


def joints_of(files: Mapping[int, Path], runs: Sequence[RunFile]) -> dict[int, Joint]:
    """Load the joint files of the joints that the runs have; with two encoders they need a stiffness. Raises ConfigError,
    also for a joint that no run has.
    """
    there = sorted({number for run in runs for number in run.table.joints})
    if ALL_JOINTS in files:
        return {number: joint_for_runs(files[ALL_JOINTS], runs, number) for number in there}
    have = ", ".join(f"j{number}" for number in there)
    for number, path in files.items():
        if number not in there:
            raise ConfigError(
                f"--joint {number}={path}: found no columns of j{number} in the runs, which have {have}"
            )
    return {number: joint_for_runs(path, runs, number) for number, path in sorted(files.items())}


def joint_for_runs(path: Path, runs: Sequence[RunFile], number: int) -> Joint:
    """Load the joint file of a joint of the runs. Raises ConfigError, also for a stiffness, damping or link inertia that is
    missing where a run has both encoders.
    """
    joint = load_joint(path, elastic=False)
    columns = [run.table.joints[number] for run in runs if number in run.table.joints]
    if any(each.two_encoders(joint.gear_ratio) for each in columns):
        return load_joint(path)
    return joint


def joint_number(option: int | None, joint: Joint, runs: Sequence[RunFile]) -> int:
    """Return the number of a joint: the option, else the one its name ends in, else the only one of the runs. Raises
    ConfigError.
    """
    if option is not None:
        return option
    ending = re.search(r"(\d+)$", joint.name)
    there = {number for run in runs for number in run.table.joints}
    if ending and int(ending.group(1)) in there:
        return int(ending.group(1))
    if len(there) == 1:
        return there.pop()
    have = ", ".join(f"j{number}" for number in sorted(there))
    raise ConfigError(
        f"--number: missing, expected the joint that {joint.name} is in the runs, which have {have}"
    )


def with_joint(runs: Sequence[RunFile], number: int) -> list[RunFile]:
    """Return the runs that have columns of the joint (a campaign of an arm has others too); all where none has."""
    found = [run for run in runs if number in run.table.joints]
    return found or list(runs)


def add_runs(parser: argparse.ArgumentParser) -> None:
    """Add the positional RUNS."""
    parser.add_argument(
        "runs",
        nargs="+",
        type=Path,
        metavar="RUNS",
        help="run files (.csv, .csv.gz, .parquet, .mcap) or directories of them",
    )


def add_columns(parser: argparse.ArgumentParser) -> None:
    """Add --columns."""
    parser.add_argument(
        "--columns", type=Path, metavar="FILE", help="column map for other names, units and signs"
    )


def add_number(parser: argparse.ArgumentParser) -> None:
    """Add --number."""
    parser.add_argument(
        "--number",
        type=int,
        choices=range(1, 8),
        metavar="N",
        help="number of the joint in the runs (default: the one that its name ends in, or the only one)",
    )


def runs_of_joint(
    options: argparse.Namespace, joint: Joint, *, segments: bool = False
) -> tuple[list[RunFile], int]:
    """Return the runs that have columns of the joint, and its number. Raises RunError, RunTableError, ConfigError."""
    runs = read_runs(options.runs, options.columns, segments=segments, joints=only(options.number))
    number = joint_number(options.number, joint, runs)
    return with_joint(runs, number), number
