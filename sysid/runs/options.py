"""Command-line options of the runs of one joint, and reading what they name: RUNS, --number, --columns."""

from __future__ import annotations

import argparse
from pathlib import Path

from jtqd.estimator.joint import Joint
from jtqd.sysid.runs.files import read_runs
from jtqd.sysid.runs.joints import joint_number, only, with_joint
from jtqd.sysid.runs.run_file import RunFile


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
