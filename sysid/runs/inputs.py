"""What every `jtq fit` starts from: run files or directories of them, the joint file, and which joint is meant."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple, TypeVar

from jtqd.estimator.checked import ConfigError
from jtqd.estimator.joint import Joint
from jtqd.estimator.run import RunTable
from jtqd.sysid.fit.plateaus import Plateau, PlateauError, PlateauRules, find_plateaus
from jtqd.sysid.runs.checks import RunIssue, check_channels
from jtqd.sysid.runs.files import ColumnMap, RunError, RunFile, read_run

RUN_ENDINGS = (".csv", ".csv.gz")
T = TypeVar("T")


class InputRun(NamedTuple):
    """One run file as read: name for messages, table, what the reader noted, SHA-256 of the file."""

    name: str
    table: RunTable
    notes: tuple[str, ...]
    sha256: str


def run_paths(arguments: Sequence[Path]) -> list[Path]:
    """Return the run files meant: a file is itself, a directory the .csv and .csv.gz in it, by name.

    Raises:
        RunError: a path that does not exist, or a directory without a run.
    """
    paths: list[Path] = []
    for argument in arguments:
        if not argument.is_dir():
            if not argument.exists():
                raise RunError(f"{argument}: found nothing there, expected a run file or a directory of runs")
            paths.append(argument)
            continue
        inside = sorted(
            p for p in argument.iterdir() if p.name.endswith(RUN_ENDINGS) and not p.name.startswith(".")
        )
        if not inside:
            raise RunError(f"{argument}: found no run file in it, expected names ending in .csv or .csv.gz")
        paths += inside
    return paths


def read_runs(arguments: Sequence[Path], columns: Path | None = None) -> list[InputRun]:
    """Read all runs; a progress bar on a terminal.

    Raises:
        RunError: as `read_run` and `run_paths`, or the same data given twice, which would count it twice.
        ConfigError: the column map cannot be used.
    """
    mapping = None if columns is None else ColumnMap.load(columns)
    return each_once(run_paths(arguments), lambda path: read_run(path, mapping))


def each_once(paths: Sequence[Path], read: Callable[[Path], RunFile]) -> list[InputRun]:
    """Read every path; names are unique; a progress bar on a terminal.

    Raises RunError as `read`, and for the same data given twice, which would count it twice.
    """
    runs: list[InputRun] = []
    for path in progress(paths, "reading runs"):
        file = read(path)
        same = [run.name for run in runs if run.sha256 == file.sha256]
        if same:
            raise RunError(f"{path}: found the same data as in {same[0]}, expected every run once")
        name = path.name if all(path.name != run.name for run in runs) else str(path)
        runs.append(InputRun(name, file.table, file.notes, file.sha256))
    return runs


def joint_number(option: int | None, joint: Joint, runs: Sequence[InputRun]) -> int:
    """Return the number of the joint meant: the option, else the number its name ends in, else the only one there is.

    Raises:
        ConfigError: nothing says which.
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


def plateaus_of(
    runs: Sequence[InputRun], number: int, joint: Joint, rules: PlateauRules | None = None
) -> list[Plateau]:
    """Return the plateaus of one joint in all runs; a run without any is named on standard error.

    Raises:
        PlateauError: of the first run, when no run has a plateau. RunTableError: a run does not have the joint.
    """
    found: list[Plateau] = []
    unsettled = []
    for run in progress(runs, "finding plateaus"):
        columns = run.table.joint(number, joint.gear_ratio)
        try:
            found += find_plateaus(run.table.time_s, columns, joint, run.name, rules)
        except PlateauError as error:
            unsettled.append(error)
    if not found:
        raise unsettled[0]
    for reason in unsettled:
        print(f"jtq fit: {reason}", file=sys.stderr)
    return found


def channel_findings(runs: Sequence[InputRun], number: int, joint: Joint) -> list[RunIssue]:
    """Return what is wrong with the joint's channels in any run, what the reader has called dead included."""
    found = []
    for run in runs:
        found += [
            RunIssue("dead_channel", f"{run.name}: {note}") for note in run.notes if f"j{number}." in note
        ]
        if number in run.table.joints:
            found += check_channels(
                run.table.time_s, run.table.joints[number], joint, f"{run.name}: j{number}"
            )
    return found


def progress(items: Sequence[T], text: str) -> Iterable[T]:
    """Pass the items through, with a bar on standard error where that is a terminal."""
    if not sys.stderr.isatty():
        return items
    from rich.console import Console
    from rich.progress import track

    return track(items, description=text, console=Console(stderr=True), transient=True)
