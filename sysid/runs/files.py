"""Run files on disk: which files a command line names, which of them are one recording, and which are duplicates.

A table's columns are those of the run table (`time_s`, `j1.current_a`, ...) or, with a column map, those that the map names.
Only these are parsed. An error names file, line, column, found and expected in one line. What is suspicious but usable is a
note. A torque channel that is exactly zero in every row is dead and becomes None, never zeros. `jN.enabled` (0: power stage
off, else 1) is optional.

Two runs of one motion never agree in the noise of position and current over many samples in a row. Two files that do are
the same run, e.g. a log and the table exported from it, or a part of it. Stamps are not compared: an export begins at zero.
A joint at rest without noise is the same in every run, so equal windows count once, and a run with few different windows is
not judged.

Cheap to import: Parquet (pyarrow) and MCAP (`jtqd.sysid.runs.logs`) are imported when such a file is read.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.run import JointColumns, RunTable
from jtqd.sysid.progress import progress
from jtqd.sysid.runs.checks import may_leave_out
from jtqd.sysid.runs.column_map import ColumnMap
from jtqd.sysid.runs.run_file import Content, NoColumnError, RunError, RunFile, runs_of
from jtqd.sysid.runs.tables import read_csv, read_parquet

TABLES: Final = (".csv", ".csv.gz", ".parquet")
LEFT_OUT: Final = "another recording is left out"
LOGS: Final = (".mcap",)
NO_RUNS: Final = (".", "next_experiment.")  # first part of a name: hidden, or written by a diagnosis
_PART: Final = re.compile(r"(?P<run>.+-\d{8}T\d{6}Z(?:_\d+)?)-\d{4,}\.mcap", re.ASCII)
"""Name of a part of a run: PREFIX-RUN-PART.mcap."""


def ends_in(path: Path, endings: tuple[str, ...]) -> bool:
    """Return whether a file's name has one of the endings; recorders write LOG001.CSV as well."""
    return path.name.lower().endswith(endings)


def run_paths(arguments: Sequence[Path | str] | Path | str) -> list[Path]:
    """Return the run files: a file is itself; a directory stands for its tables, or its logs where it has no table. Raises
    RunError.
    """
    paths: list[Path] = []
    for argument in map(Path, [arguments] if isinstance(arguments, Path | str) else arguments):
        if not argument.is_dir():
            if not argument.exists():
                raise RunError(f"{argument}: found no such file or directory, expected a run or a directory")
            paths.append(argument)
            continue
        names = sorted(p for p in argument.iterdir() if p.is_file() and not p.name.startswith(NO_RUNS))
        inside = [p for p in names if ends_in(p, TABLES)] or [p for p in names if ends_in(p, LOGS)]
        if not inside:
            raise RunError(f"{argument}: found no run file in it, expected any of {', '.join(TABLES + LOGS)}")
        paths += inside
    if wrong := next((p for p in map(str, paths) if p != p.encode(errors="ignore").decode()), None):
        raise RunError(f"{wrong!r}: found a name that is not UTF-8, expected a file of another name")
    return paths


def read_runs(
    arguments: Sequence[Path | str] | Path | str,
    columns: ColumnMap | Path | str | None = None,
    *,
    segments: bool = False,
    joints: Sequence[int] | None = None,
) -> list[RunFile]:
    """Read all runs of files and directories (`run_paths`), each with a name of its own; a progress bar on a terminal.

    segments: a recording with gaps gives one run for each segment between them, "a.csv (1 of 3)"; rows with a blank cell
    are gaps; a table whose time starts again is several runs, "a.csv (run 1 of 2)"; the parts of one log are one recording.
    Segments shorter than SHORTEST_SEGMENT_S and rows written twice are left out, with a note. joints: numbers of those
    wanted of a log, where a row needs the inputs of all of them; None: all.

    Raises RunError, also for one run given twice (the same data, or a log and its table); ConfigError for the column map.
    """
    mapping = ColumnMap.load(columns) if isinstance(columns, Path | str) else columns
    runs: list[RunFile] = []
    said: set[str] = set()
    known: list[tuple[str, Windows]] = []
    lacking: list[str] = []
    paths = run_paths(arguments)
    twice = next((path for path in paths if paths.count(path) > 1), None)
    if twice is not None:
        raise RunError(f"{twice}: found it twice, expected every run once")
    recordings = _recordings(paths) if segments else [(p,) for p in paths]
    for path, *parts in progress(recordings, "reading runs"):
        try:
            content = _content(path, *parts, columns=mapping, joints=joints, blanks=segments)
        except NoColumnError as error:
            lacking.append(str(error))
            if not segments or not may_leave_out(len(lacking), len(recordings)):
                raise
            continue
        read = runs_of(content, whole=not segments)
        same = next((other.name for other in runs if other.sha256 == read[0].sha256), None)
        if same is not None:
            raise RunError(f"{path}: found the same data as in {same}, expected every run once")
        taken = {other.name for other in runs}
        read = [
            replace(run, name=run.name.replace(path.name, str(path), 1)) if run.name in taken else run
            for run in read
        ]
        for run in read:
            found = windows(run.table)
            same = next((name for name, each in known if same_run(each, found)), None)
            if same is not None:
                raise RunError(
                    f"{path}: found the same run{f' ({run.name})' if len(read) > 1 else ''} as in {same} (position and "
                    "current agree), expected every run once"
                )
            known.append((run.name, found))
        if content.columns is not None:  # a remark on the map stands in the notes of the first run only
            read[0] = replace(read[0], notes=tuple(note for note in read[0].notes if note not in said))
            said |= set(content.columns.remarks())
        runs += read
    runs[0] = replace(runs[0], notes=(*runs[0].notes, *(f"{LEFT_OUT}: {error}" for error in lacking)))
    return runs


def read_run(
    path: Path | str, columns: ColumnMap | None = None, *, joints: Sequence[int] | None = None
) -> RunFile:
    """Read one run by the ending of its name; without a column map a table must use the run table's own column names.

    joints: of a log, as in `read_runs`. Raises RunError, also for a recording with gaps.
    """
    [run] = runs_of(_content(Path(path), columns=columns, joints=joints), whole=True)
    return run


def _recordings(paths: Sequence[Path]) -> list[tuple[Path, ...]]:
    """Return the files of each recording: jtqd splits a long log into parts."""
    groups: dict[object, list[Path]] = {}
    for path in paths:
        run = _PART.fullmatch(path.name)
        key = path if run is None else (path.parent, run["run"])
        groups.setdefault(key, []).append(path)
    return [tuple(sorted(group)) for group in groups.values()]


def _content(
    path: Path, *parts: Path, columns: ColumnMap | None, joints: Sequence[int] | None, blanks: bool = False
) -> Content:
    """Read a file, or all parts of a log; blanks: rows of a table with a blank cell are left out, else refused."""
    if not path.is_file():
        found = "something that is no file" if path.exists() else "no such file"
        found = "a directory" if path.is_dir() else found
        raise RunError(f"{path}: found {found}, expected a run file ({', '.join(TABLES + LOGS)})")
    if ends_in(path, LOGS):
        from jtqd.sysid.runs.logs import read_log

        return read_log(path, *parts, joints=joints)
    if ends_in(path, (".parquet",)):
        return read_parquet(path, columns, blanks=blanks)
    if ends_in(path, TABLES):
        return read_csv(path, columns, blanks=blanks)
    raise RunError(f"{path}: found a file ending in '{path.suffix}', expected {', '.join(TABLES + LOGS)}")


_WINDOW_ROWS: Final = 64
"""Samples in a row that must agree."""
_DIGITS: Final = np.uint64(0xFFFF_FFF0_0000_0000)
"""Bits of a number that are compared: five digits, as a table may have fewer than a log."""
_FEWEST: Final = 50
_OF_ALL: Final = 0.2
"""Different windows that a run must have to be judged: their number, and part of all its windows."""
_SAMPLE: Final = 400
_SHARE: Final = 0.5
"""Part of the windows of the shorter run that must be in the longer one."""
_FACTOR: Final = 0x9E37_79B9_7F4A_7C15
"""Odd, so that it has an inverse modulo 2^64; the fractional part of the golden ratio."""
_INVERSE: Final = pow(_FACTOR, -1, 2**64)

Hashes = npt.NDArray[np.uint64]
Windows = Mapping[int, Hashes]
"""Sorted hashes [n] of the different windows of a run, by joint."""


def windows(table: RunTable) -> Windows:
    """Return the hashes of the different windows of each joint; a joint that cannot be judged is left out."""
    found = {number: _hashes(columns) for number, columns in table.joints.items()}
    return {number: each for number, each in found.items() if each is not None}


def same_run(one: Windows, two: Windows) -> bool:
    """Return whether most of the shorter run is in the other one, for every joint that both have."""
    joints = one.keys() & two.keys()
    return bool(joints) and all(_common(one[joint], two[joint]) > _SHARE for joint in joints)


def _hashes(columns: JointColumns) -> Hashes | None:
    position, current = columns.motor_position_rad, columns.current_a
    if position is None or current is None or len(position) < _WINDOW_ROWS + _FEWEST:
        return None
    rows = _bits(position) * np.uint64(_FACTOR) ^ (_bits(current) >> np.uint64(7)) * np.uint64(_INVERSE)
    # window i = sum of rows[i + j] FACTOR^j over j, by the difference of two sums from the beginning
    sums = np.concatenate(
        [np.zeros(1, np.uint64), np.cumsum(rows * _powers(_FACTOR, len(rows)), dtype=np.uint64)]
    )
    every = (sums[_WINDOW_ROWS:] - sums[:-_WINDOW_ROWS]) * _powers(_INVERSE, len(sums) - _WINDOW_ROWS)
    different = np.unique(every)
    return different if len(different) >= max(_FEWEST, _OF_ALL * len(every)) else None


def _bits(numbers: FloatArray) -> Hashes:
    return (numbers + 0.0).view(np.uint64) & _DIGITS  # + 0.0: no negative zero


def _powers(factor: int, count: int) -> Hashes:
    factors = np.full(count, factor, np.uint64)
    factors[0] = 1
    return np.cumprod(factors, dtype=np.uint64)


def _common(one: Hashes, two: Hashes) -> float:
    """Return the share of a sample of the shorter one that is in the longer one; hashes are in no order of time."""
    short, long = sorted((one, two), key=len)
    sample = short[:_SAMPLE]
    at = np.minimum(np.searchsorted(long, sample), len(long) - 1)
    return float(np.mean(long[at] == sample))
