"""Run files: CSV, gzipped CSV and Parquet tables and jtqd's MCAP logs as run tables; a run table as CSV.

A table has one header row; its columns are those of the run table (`time_s`, `j1.current_a`, ...) or, with a column map,
whatever the map names. Only the columns asked for are parsed: garbage in the others cannot hurt. Anything wrong in the
ones asked for is refused in one line that names file, line, column, found and expected. What is suspicious but usable is
returned as notes; a torque channel that is exactly zero in every row is dead and comes back as None, never as zeros.
`jN.enabled` (0: power stage off, else 1) is optional; without it nothing is known of the power stage.

Cheap to import: numpy and the estimator's values. Parquet (pyarrow) and MCAP (`jtqd.sysid.runs.logs`) are imported when a
file of that kind is read.
"""

from __future__ import annotations

import csv
import gzip
import hashlib
import importlib.util
import io
import math
import os
import re
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice, pairwise
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np

from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.estimator.checked import counted
from jtqd.estimator.run import COLUMN_NAMES, JointColumns, RunTable, RunTableError
from jtqd.sysid.progress import progress
from jtqd.sysid.runs.column_map import JOINTS, TIME, Column, ColumnMap, targets
from jtqd.sysid.runs.expressions import Expression, ExpressionError
from jtqd.sysid.runs.same_run import Stretches, same_run, stretches

TABLES: Final = (".csv", ".csv.gz", ".parquet")
LOGS: Final = (".mcap",)
_PART: Final = re.compile(r"(?P<run>.+-\d{8}T\d{6}Z(?:_\d+)?)-\d{4,}\.mcap", re.ASCII)
"""Name of a part of a run: PREFIX-RUN-PART.mcap."""
LONGEST_GAP: Final = 10.0
"""Median steps: a longer step means that the run consists of pieces. A reader of whole runs refuses it, because a fit or an
observer would take the jump for a measurement; `read_runs(.., in_pieces=True)` takes it apart. Shorter gaps (lost cycles)
are notes."""
BRIDGED_S: Final = 0.025
"""Taking apart, a gap this short is no end of a piece: what lies in it is interpolated (`time_base.on_even_steps`)."""
SHORTEST_PIECE_S: Final = 1.0
"""Also the least by which the time must step back for a new run to begin there, and no stamp to be wrong."""
GAP_NOTED: Final = 1.5
_MOST_ALIKE: Final = 3
"""Stamps in a row that rounding makes one number of."""
_ROOM: Final = 0.9995
"""Of the usual step, that the time has for each row at least if none is too many."""
_BLANK: Final = ("", "nan")
DEAD_ROWS: Final = 100
"""A channel without a single non-zero value over this many rows is dead, not quiet."""


class RunError(ValueError):
    """A run file cannot be used; the message is one line: file, place, found, expected."""


@dataclass(frozen=True)
class RunFile:
    """A run as read.

    Attributes:
        name: for messages; unique among runs that were read together.
        path, source: the file, and what it is: "csv", "parquet" or "mcap".
        sha256: of the file on disk (hex).
        table: its columns. The pieces of one recording keep its time.
        notes: what is suspicious about it, one line each.
        piece: number of this piece of its run in the file, and how many there are.
    """

    name: str
    path: Path
    source: str
    sha256: str
    table: RunTable
    notes: tuple[str, ...] = ()
    piece: tuple[int, int] = (1, 1)


def run_paths(arguments: Sequence[Path]) -> list[Path]:
    """Return the run files meant: a file is itself; a directory the tables in it, or the logs when it has no table.

    A campaign's directory holds the log of every run beside its table: read once, not twice.

    Raises RunError for a path that does not exist, or a directory without a run.
    """
    paths: list[Path] = []
    for argument in arguments:
        if not argument.is_dir():
            if not argument.exists():
                raise RunError(
                    f"{argument}: found no such file or directory, expected a run file or a directory of runs"
                )
            paths.append(argument)
            continue
        names = sorted(p for p in argument.iterdir() if p.is_file() and not p.name.startswith("."))
        inside = [p for p in names if p.name.endswith(TABLES)] or [p for p in names if p.name.endswith(LOGS)]
        if not inside:
            raise RunError(
                f"{argument}: found no run file in it, expected names ending in {', '.join(TABLES + LOGS)}"
            )
        paths += inside
    return paths


def read_runs(
    arguments: Sequence[Path],
    columns: ColumnMap | Path | None = None,
    *,
    in_pieces: bool = False,
    joints: Sequence[int] | None = None,
) -> list[RunFile]:
    """Read all runs of files and directories (`run_paths`); a progress bar on a terminal.

    columns: a column map or its file. Names are unique: the file's, or its path where two files share a name.
    in_pieces: a recording with gaps gives one run for each piece between them, "a.csv (1 of 3)", not an error; rows with a
    blank cell are gaps, and a table whose time starts again is several runs, "a.csv (run 1 of 2)"; the parts of one run of
    jtqd are one recording.
    joints: numbers of those that are wanted of a log, where a row needs the inputs of all of them; None: all that it has. A
    table gives the joints that it has.

    Raises:
        RunError: as `read_run` and `run_paths`, or one run given twice, which would count it twice: the same data, or a
            log and the table of it (`same_run`).
        ConfigError: the column map cannot be used.
    """
    mapping = ColumnMap.load(columns) if isinstance(columns, Path) else columns
    runs: list[RunFile] = []
    known: list[tuple[str, Stretches]] = []
    paths = run_paths(arguments)
    twice = next((path for path in paths if paths.count(path) > 1), None)
    if twice is not None:
        raise RunError(f"{twice}: found it twice, expected every run once")
    groups = _recordings(paths) if in_pieces else [(path,) for path in paths]
    for path, *parts in progress(groups, "reading runs"):
        if parts:
            read = _checked(_read_log(path, *parts, joints=joints), whole=False)
        else:
            read = _checked(_content(path, mapping, joints, blanks=in_pieces), whole=not in_pieces)
        same = next((other.name for other in runs if other.sha256 == read[0].sha256), None)
        if same is not None:
            raise RunError(f"{path}: found the same data as in {same}, expected every run once")
        taken = {other.name for other in runs}
        read = [
            replace(run, name=run.name.replace(path.name, str(path), 1)) if run.name in taken else run
            for run in read
        ]
        for run in read:
            found = stretches(run.table)
            same = next((name for name, each in known if same_run(each, found)), None)
            if same is not None:
                raise RunError(
                    f"{path}: found the same run{f' ({run.name})' if len(read) > 1 else ''} as in {same} (position and "
                    "current agree), expected every run once"
                )
            known.append((run.name, found))
        if runs and mapping is not None:  # what holds for every file is said once
            said = set(mapping.remarks())
            read[0] = replace(read[0], notes=tuple(note for note in read[0].notes if note not in said))
        runs += read
    return runs


def read_run(
    path: Path | str, columns: ColumnMap | None = None, *, joints: Sequence[int] | None = None
) -> RunFile:
    """Read one run by the ending of its name; without a column map a table must use the run table's own column names.

    columns: for tables; a log of jtqd has its own names. joints: of a log, as in `read_runs`. Raises RunError, also for a
    recording with gaps.
    """
    [run] = _checked(_content(Path(path), columns, joints), whole=True)
    return run


def read_pieces(path: Path | str, columns: ColumnMap | None = None) -> list[RunFile]:
    """Read one file as `read_run`, taken apart where its time starts again, at its gaps and rows with a blank cell; pieces
    shorter than SHORTEST_PIECE_S are left out and noted, and so are rows written twice.

    Raises RunError, also where no piece is long enough.
    """
    return _checked(_content(Path(path), columns, blanks=True), whole=False)


def _recordings(paths: Sequence[Path]) -> list[tuple[Path, ...]]:
    """Return the files of each recording: jtqd ends a log and begins the next part after a while (docs/recording.md)."""
    groups: dict[object, list[Path]] = {}
    for path in paths:
        run = _PART.fullmatch(path.name)
        key = path if run is None else (path.parent, run["run"])
        groups.setdefault(key, []).append(path)
    return [tuple(sorted(group)) for group in groups.values()]


@dataclass(frozen=True)
class _Content:
    """What was read of a file: target columns and further sources [n] by key, lines [n] for messages (None: samples)."""

    path: Path
    source: str
    sha256: str
    values: Mapping[str, FloatArray]
    lines: Sequence[int] | None = None
    notes: tuple[str, ...] = ()
    columns: ColumnMap | None = None


def _content(
    path: Path, columns: ColumnMap | None, joints: Sequence[int] | None = None, *, blanks: bool = False
) -> _Content:
    """Read a file; blanks: rows of a table with a blank cell are left out, else refused."""
    if not path.is_file():
        found = "something that is no file" if path.exists() else "no such file"
        found = "a directory" if path.is_dir() else found
        raise RunError(f"{path}: found {found}, expected a run file ({', '.join(TABLES + LOGS)})")
    if path.name.endswith(LOGS):
        return _read_log(path, joints=joints)
    if path.name.endswith(".parquet"):
        return _read_parquet(path, columns, blanks=blanks)
    if path.name.endswith(TABLES):
        return _read_csv(path, columns, blanks=blanks)
    raise RunError(f"{path}: found a file ending in '{path.suffix}', expected {', '.join(TABLES + LOGS)}")


# From columns to a run table, whatever the file.


def _wanted_columns(header: Sequence[str], path: Path, columns: ColumnMap | None) -> ColumnMap:
    """Return the map, or for none one of the run table's own names that are there."""
    if columns is not None:
        return columns
    if TIME not in header:
        raise RunError(
            f"{path}:{_header_place(path)} found no column '{TIME}' (first columns: {list(header[:4])}), "
            "expected the run table's names or a column map"
        )
    return ColumnMap({name: Column(name) for name in targets() if name in header}, {})


def _expressions(header: Sequence[str], path: Path, columns: ColumnMap) -> dict[str, Expression]:
    try:
        return columns.parsed(list(header), f"{path}:{_header_place(path)}")
    except ExpressionError as error:
        raise RunError(str(error)) from None


def _names(wanted: Mapping[str, Expression]) -> list[str]:
    """Return the columns of the file that are read, each once."""
    return list(dict.fromkeys(name for each in wanted.values() for name in each.names))


def _header_place(path: Path) -> str:
    """Only text has lines."""
    return " line 1:" if ".csv" in path.suffixes else ""


def _scaled(
    cells: Mapping[str, FloatArray], wanted: Mapping[str, Expression], columns: ColumnMap
) -> dict[str, FloatArray]:
    sources = columns.sources()
    with np.errstate(over="ignore", invalid="ignore"):  # the table refuses what is not finite
        return {
            key: sources[key].scale * each.value(cells) + sources[key].offset for key, each in wanted.items()
        }


def _checked(content: _Content, *, whole: bool) -> list[RunFile]:
    """Check time and columns of a file and make its run table, or one for each of its pieces."""
    if not whole:
        content = _with_rounded_stamps(_without_repeated_rows(content))
    time_s, path = content.values[TIME], content.path
    if len(time_s) < 2:
        raise RunError(f"{path}: found {counted(len(time_s), 'sample')}, expected at least 2")
    starts = [] if whole else _new_runs(time_s)
    runs = [slice(a, b) for a, b in pairwise([0, *starts, len(time_s)])]
    notes = list(content.notes)
    for number, run in enumerate(runs, 1):
        found = _check_time(time_s, content.lines, path, run=run, whole=whole)
        notes += [f"run {number}: {note}" if starts else note for note in found]
    cuts = [[run] if whole else _pieces(time_s, run) for run in runs]
    count = sum(map(len, cuts))
    long = [
        [cut for cut in each if count == 1 or _length_s(time_s, cut) >= SHORTEST_PIECE_S] for each in cuts
    ]
    if not any(long):
        longest = max(_length_s(time_s, cut) for each in cuts for cut in each)
        raise RunError(
            f"{path}: found {count} pieces between gaps, the longest of {longest:.3g} s, expected one of at least "
            f"{SHORTEST_PIECE_S:g} s"
        )
    if starts:
        notes.append(f"the time starts again {counted(len(starts), 'time')}: {len(runs)} runs in one file")
    if count > len(runs):
        kept = sum(_length_s(time_s, cut) for each in long for cut in each)
        whole_s = sum(_length_s(time_s, run) for run in runs)
        pieces = counted(sum(map(len, long)), "piece")
        notes.append(
            f"{counted(count - len(runs), 'gap')} of more than {BRIDGED_S:g} s: used as {pieces} of "
            f"{'one recording' if len(runs) == 1 else 'these runs'}, {kept:.3g} s of {whole_s:.3g} s"
        )
    elif sum(map(len, long)) < count:
        notes.append(
            f"{counted(count - sum(map(len, long)), 'run')} of less than {SHORTEST_PIECE_S:g} s left out"
        )
    if count > 1:
        notes += _unwrapped_over_gaps(content)
    if content.columns is not None:
        notes += content.columns.remarks()
    read: list[RunFile] = []
    for number, each in enumerate(long, 1):
        name = f"{path.name} (run {number} of {len(runs)})" if starts else path.name
        for k, cut in enumerate(each, 1):
            read.append(_piece(content, cut, name, [] if read else notes, (k, len(each))))
    return read


def _piece(content: _Content, cut: slice, name: str, notes: Sequence[str], place: tuple[int, int]) -> RunFile:
    """Make the run table of the rows of one piece; name: of its run."""
    path, notes = content.path, list(notes)
    values = {key: value[cut] for key, value in content.values.items()}
    if content.columns is not None:
        values = content.columns.completed(values)
    joints: dict[int, JointColumns] = {}
    for joint in JOINTS:
        parts = {q: values.get(f"j{joint}.{q}") for q in COLUMN_NAMES}
        if all(part is None for part in parts.values()):
            continue
        torque = parts["torque_nm"]
        if torque is not None and len(torque) >= DEAD_ROWS and not np.any(torque):
            notes.append(
                f"j{joint}.torque_nm is exactly zero in all {len(torque)} rows: dead channel, not used"
            )
            parts["torque_nm"] = None
        joints[joint] = JointColumns(**parts)
    if not joints:
        raise RunError(
            f"{path}:{_header_place(path)} found no joint's columns, expected at least one of j1.current_a, ..."
        )
    try:
        table = RunTable(time_s=values[TIME], joints=joints)
    except RunTableError as error:  # a scale of the column map that leaves the range of a float
        raise RunError(f"{path}: {error}") from None
    name = name if place[1] == 1 else f"{name} ({place[0]} of {place[1]})"
    return RunFile(name, path, content.source, content.sha256, table, tuple(notes), place)


def _without_repeated_rows(content: _Content) -> _Content:
    """Return the content without rows that were written twice, one after the other, and a note. Two rows that share only
    their stamp stay, to be refused: one of their times is wrong.
    """
    columns = np.array(list(content.values.values()))
    again = np.concatenate(([False], np.all(columns[:, 1:] == columns[:, :-1], axis=0)))
    if not again.any():
        return content
    lines = None if content.lines is None else [content.lines[int(k)] for k in np.flatnonzero(~again)]
    note = f"{int(again.sum())} of {counted(len(again), 'row')} left out: they are the row before once more"
    values = {key: value[~again] for key, value in content.values.items()}
    return replace(content, values=values, lines=lines, notes=(*content.notes, note))


def _with_rounded_stamps(content: _Content) -> _Content:
    """Return the content with stamps that equal the one before put between their neighbours, and a note, where there are no
    more rows than the time has room for: stamps that were rounded, not rows that are too many.
    """
    time_s = content.values[TIME]
    steps = np.diff(time_s)
    if len(steps) < 2 or not np.all(steps >= 0.0) or np.all(steps > 0.0):
        return content
    new = np.concatenate(([True], steps > 0.0))
    rows = np.flatnonzero(new)
    many = np.max(np.diff(rows)) > _MOST_ALIKE or not new[-1]
    if many or np.mean(steps) < _ROOM * np.median(steps[steps > 0.0]):
        return content
    spread = np.interp(np.arange(len(time_s)), rows, time_s[rows])
    note = f"{counted(int(np.sum(~new)), 'stamp')} like the one before: rounded, spread between those around"
    return replace(content, values={**content.values, TIME: spread}, notes=(*content.notes, note))


def _new_runs(time_s: FloatArray) -> list[int]:
    """Return the rows at which the time starts again and goes on from there; a single wrong stamp is none."""
    steps = np.diff(time_s)
    longest = _longest_step(steps)
    rows = np.flatnonzero(steps[:-1] <= -SHORTEST_PIECE_S) + 1
    return [int(row) for row in rows if 0.0 < steps[row] <= longest]


def _longest_step(steps: FloatArray) -> float:
    return max(LONGEST_GAP * float(np.median(steps)), BRIDGED_S)


def _pieces(time_s: FloatArray, run: slice) -> list[slice]:
    """Return the rows between the gaps of a run; its time rises."""
    steps = np.diff(time_s[run])
    ends = [0, *(np.flatnonzero(steps > _longest_step(steps)) + 1), run.stop - run.start]
    return [slice(run.start + int(a), run.start + int(b)) for a, b in pairwise(ends)]


def _unwrapped_over_gaps(content: _Content) -> list[str]:
    if content.columns is None:
        return []
    named = [key for key, column in content.columns.sources().items() if "unwrap(" in column.name]
    what = "its turns in the gaps are not known: an angle of a later piece may be off by whole periods"
    return [f"{key} is unwrapped, {what}" for key in named]


def _length_s(time_s: FloatArray, cut: slice) -> float:
    return float(time_s[cut.stop - 1] - time_s[cut.start])


def _check_time(
    time_s: FloatArray, lines: Sequence[int] | None, path: Path, *, run: slice, whole: bool
) -> list[str]:
    """Refuse time of a run that stands or runs back, and in a whole one long gaps; note the short gaps."""

    def at(row: int) -> str:
        return f"sample {run.start + row}" if lines is None else f"line {lines[run.start + row]}"

    time_s = time_s[run]
    steps = np.diff(time_s)
    if not np.all(steps > 0.0):
        row = int(np.argmax(steps <= 0.0)) + 1
        several = (
            ": one run in a file here (`jtq diagnose` takes several apart)"
            if row in _new_runs(time_s)
            else ""
        )
        raise RunError(
            f"{path}: {at(row)}: found time {time_s[row]:.6g} s after {time_s[row - 1]:.6g} s, "
            f"expected rising time{several}"
        )
    median = float(np.median(steps))
    longest = int(np.argmax(steps))
    if whole and steps[longest] > LONGEST_GAP * median:
        raise RunError(
            f"{path}: {at(longest + 1)}: found a gap of {steps[longest]:.6g} s, "
            f"expected steps of about {median:.6g} s"
        )
    gaps = int(np.count_nonzero(steps > GAP_NOTED * median))
    are = "step is" if gaps == 1 else "steps are"
    return [f"{gaps} {are} longer than {GAP_NOTED} times the median of {median:.6g} s"] if gaps else []


def _bytes(path: Path) -> tuple[bytes, str]:
    """Return the content of a file and its SHA-256."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise RunError(f"{path}: cannot be read: {error.strerror or error}") from None
    if not data:
        raise RunError(f"{path}: found an empty file, expected a run")
    return data, hashlib.sha256(data).hexdigest()


# CSV.


class _Rows(Protocol):
    """What csv.reader returns."""

    line_num: int

    def __next__(self) -> list[str]: ...


def _read_csv(path: Path, columns: ColumnMap | None, *, blanks: bool = False) -> _Content:
    data, sha256 = _bytes(path)
    text = _text(path, data)
    separator = _separator(text)
    text, cut = _without_cut_row(text, separator) if blanks else (text, ())
    rows = csv.reader(io.StringIO(text, newline=""), delimiter=separator)
    header = _header(rows, path)
    columns = _wanted_columns(header, path, columns)
    wanted = _expressions(header, path, columns)
    cells, lines = _cells_of_text(rows, path, header, _names(wanted), blanks=blanks)
    cells, keep, wanted, notes = _without_blanks(path, cells, wanted, columns)
    lines = [line for line, kept in zip(lines, keep, strict=True) if kept]
    return _Content(path, "csv", sha256, _scaled(cells, wanted, columns), lines, (*cut, *notes), columns)


def _without_cut_row(text: str, separator: str) -> tuple[str, tuple[str, ...]]:
    """Return the text without a last row that ends before its line does, in less cells than the row before, and a note: a
    recorder was ended while it wrote.
    """
    *before, row, last = ("", "", *text.rsplit("\n", 2))[-3:]
    if not last or last.count(separator) >= row.count(separator):
        return text, ()
    return "\n".join([*before, row, ""]), (f"the last row left out: it ends after {last[-20:]!r}",)


def _separator(text: str) -> str:
    """Return the mark by which the header and the row below have as many cells, the rarer one in names before the comma
    ("Zeit, ms;Weg, mm"); without such the first that the header has.
    """
    header = text.lstrip().split("\n", 1)[0]
    for mark in "\t;,":
        try:
            names, row = islice(csv.reader(io.StringIO(text.lstrip(), newline=""), delimiter=mark), 2)
        except (ValueError, csv.Error):  # no row below, or no CSV
            continue
        if len(names) == len(row) > 1:
            return mark
    return next((mark for mark in ",;\t" if mark in header), ",")


def _without_blanks(
    path: Path, cells: Mapping[str, FloatArray], wanted: Mapping[str, Expression], columns: ColumnMap
) -> tuple[dict[str, FloatArray], BoolArray, dict[str, Expression], tuple[str, ...]]:
    """Return cells [n] without rows in which one is blank (NaN), the rows kept [all], the targets that have a value at all,
    and notes. A column that is blank everywhere is absent. Raises RunError for one that cannot be.
    """
    blank = {name: np.isnan(cell) for name, cell in cells.items()}
    absent = {name for name, rows in blank.items() if len(rows) and rows.all()}
    made = {f"j{n}" for n in (*(columns.loads or {}), *(columns.drives or {}))}
    for key, each in wanted.items():
        name = next((name for name in each.names if name in absent), None)
        if name is not None and (key == TIME or key.partition(".")[0] in made):
            raise RunError(
                f"{path}: column {name!r}: found it blank in every row, expected numbers for {key}"
            )
    there = {key: each for key, each in wanted.items() if not absent & set(each.names)}
    used = _names(there)
    keep = ~np.any([blank[name] for name in used], axis=0)
    notes = [f"column {name!r} is blank in every row: taken as absent" for name in cells if name in absent]
    count = {name: int(blank[name].sum()) for name in used if blank[name].any()}
    if count:
        which = ", ".join(f"{name!r} in {rows}" for name, rows in count.items())
        notes.append(
            f"{int((~keep).sum())} of {counted(len(keep), 'row')} left out for a blank cell ({which})"
        )
    if count and np.count_nonzero(keep) < 2:
        raise RunError(
            f"{path}: {notes[-1]}: found {counted(int(keep.sum()), 'sample')}, expected at least 2"
        )
    return {name: cells[name][keep] for name in used}, keep, there, tuple(notes)


def _text(path: Path, data: bytes) -> str:
    try:
        text = (gzip.decompress(data) if path.suffix == ".gz" else data).decode("utf-8-sig")
    except (gzip.BadGzipFile, EOFError, zlib.error) as error:
        raise RunError(f"{path}: found a broken gzip stream ({error}), expected gzipped CSV") from None
    except UnicodeDecodeError as error:
        raise RunError(f"{path}: found byte {error.start} that is not UTF-8, expected CSV text") from None
    if not text.strip():
        raise RunError(f"{path}: found an empty file, expected a header row and samples")
    return text


def _header(rows: _Rows, path: Path) -> list[str]:
    header = [name.strip() for name in _next_row(rows, path) or []]
    seen: set[str] = set()
    for name in header:
        if name and name in seen:
            raise RunError(f"{path}: line 1: found column {name!r} twice, expected every name once")
        seen.add(name)
    return header


def _next_row(rows: _Rows, path: Path) -> list[str] | None:
    try:
        return next(rows)
    except StopIteration:
        return None
    except csv.Error as error:
        raise RunError(f"{path}: line {rows.line_num}: found text that is not CSV ({error})") from None


def _cells_of_text(
    rows: _Rows, path: Path, header: list[str], wanted: Sequence[str], *, blanks: bool
) -> tuple[dict[str, FloatArray], list[int]]:
    """Return columns of the file as arrays [n], n >= 2, all finite, and the line [n] on which each sample ends. blanks: a
    blank cell is NaN.
    """
    source = {name: header.index(name) for name in wanted}
    cells: dict[str, list[float]] = {name: [] for name in source}
    lines: list[int] = []
    while (row := _next_row(rows, path)) is not None:
        if not row:
            continue
        line = rows.line_num
        if len(row) != len(header):
            raise RunError(f"{path}: line {line}: found {counted(len(row), 'cell')}, expected {len(header)}")
        for name, index in source.items():
            try:
                value = float(row[index])
            except ValueError:
                value = math.nan
            if not math.isfinite(value) and not (blanks and row[index].strip().lower() in _BLANK):
                comma = " with a decimal point" if "," in row[index] else ""
                raise RunError(
                    f"{path}: line {line}, column {name!r}: found {row[index][:40]!r}, "
                    f"expected a finite number{comma}"
                )
            cells[name].append(value)
        lines.append(line)
    if len(lines) < 2:
        raise RunError(f"{path}: found {counted(len(lines), 'sample')} below the header, expected at least 2")
    return {name: np.array(column) for name, column in cells.items()}, lines


# Parquet and logs.


def _read_parquet(path: Path, columns: ColumnMap | None, *, blanks: bool = False) -> _Content:
    data, sha256 = _bytes(path)
    if importlib.util.find_spec("pyarrow") is None:
        raise RunError(f"{path}: reading Parquet needs pyarrow, which is not installed: pip install pyarrow")
    import pyarrow as pa  # type: ignore[import-not-found,import-untyped,unused-ignore]
    import pyarrow.parquet as pq  # type: ignore[import-not-found,import-untyped,unused-ignore]

    try:
        file = pq.ParquetFile(pa.BufferReader(data))
        header = list(file.schema_arrow.names)
        columns = _wanted_columns(header, path, columns)
        wanted = _expressions(header, path, columns)
        table = file.read(columns=_names(wanted))
    except (pa.ArrowException, OSError, ValueError) as error:
        if isinstance(error, RunError):
            raise
        raise RunError(f"{path}: not a readable Parquet file: {' '.join(str(error).split())}") from None
    cells = {
        name: _cells_of_arrow(path, name, table.column(name), blanks=blanks) for name in table.column_names
    }
    cells, _, wanted, notes = _without_blanks(path, cells, wanted, columns)
    return _Content(path, "parquet", sha256, _scaled(cells, wanted, columns), None, notes, columns)


def _cells_of_arrow(path: Path, name: str, column: Any, *, blanks: bool) -> FloatArray:
    """Return one column as float64 [n]; text that is no number, infinity and, unless blanks are allowed, empty cells and
    NaN: RunError with the first bad row.
    """
    values = column.to_numpy()
    try:
        cells: FloatArray = np.asarray(values, np.float64)
    except (TypeError, ValueError):
        row = next((k for k, value in enumerate(values) if not _is_number(value)), 0)
        raise RunError(
            f"{path}: row {row + 1}, column {name!r}: found {str(values[row])[:40]!r}, expected a finite number"
        ) from None
    good = ~np.isinf(cells) if blanks else np.isfinite(cells)
    if not good.all():
        row = int(np.argmin(good))
        raise RunError(
            f"{path}: row {row + 1}, column {name!r}: found {cells[row]}, expected a finite number"
        )
    return cells


def _is_number(value: object) -> bool:
    try:
        float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        return False
    return True


def _read_log(path: Path, *parts: Path, joints: Sequence[int] | None = None) -> _Content:
    """Read a log, or all parts of one run; the hash is that of all files one after another."""
    from jtqd.daemon.logs import LogError
    from jtqd.sysid.runs.logs import log_to_run

    sha256 = _bytes(path)[1]
    if parts:
        sha256 = hashlib.sha256(b"".join(_bytes(each)[0] for each in (path, *parts))).hexdigest()
    try:
        logged = log_to_run((path, *parts) if parts else path, joints=joints)
    except LogError as error:
        text = str(error)
        raise RunError(text if text.startswith(str(path)) else f"{path}: {text}") from None
    except OSError as error:
        raise RunError(f"{path}: cannot be read: {error.strerror or error}") from None
    notes = [f"{len(parts) + 1} parts of one run: {path.name} to {parts[-1].name}"] if parts else []
    notes += [f"joint {number} left out: {why}" for number, why in logged.left_out.items()]
    one = [n for n, columns in logged.table.joints.items() if columns.link_position_rad is None]
    if one:
        which = f"joint{'s' * (len(one) > 1)} {', '.join(map(str, one))}"
        notes.append(f"{which}: one encoder, no link position: nothing is known of the torsion of the gear")
    if logged.missed or logged.incomplete:
        by = ", ".join(f"{count} of {name}" for name, count in logged.incomplete_by.items() if count)
        notes.append(
            f"{counted(logged.missed, 'cycle')} missed and {logged.incomplete} incomplete{f' ({by})' if by else ''}: "
            f"{logged.lost_share:.2%} of the slots have no row"
        )
    values = {TIME: logged.table.time_s}
    for number, columns in logged.table.joints.items():
        for name in COLUMN_NAMES:
            column = getattr(columns, name)
            if column is not None:
                values[f"j{number}.{name}"] = column
    return _Content(path, "mcap", sha256, values, notes=tuple(notes))


# Writing.


DECIMALS: Final = 10
_COMPRESSION: Final = 6
_ROWS_AT_A_TIME: Final = 8192


def write_run(path: Path | str, table: RunTable) -> str:
    """Write `table` as .csv or .csv.gz, whole or not at all: an earlier file stays until the new one is complete.

    Returns the SHA-256 of the file (hex), as `read_run` does. The same table gives the same bytes.

    Columns: time_s, then those that each joint has, in the order of the joints' numbers and of COLUMN_NAMES. Numbers are
    written to 1e-10 of their unit, less than what any encoder, current or torque channel resolves and a third of the size
    that all 17 digits would take: reading gives every value back to 5e-11 (values above 1e5 to 1e-15 of themselves).

    Raises:
        ValueError: the name ends in neither .csv nor .csv.gz.
        OSError: it cannot be written.
    """
    path = Path(path)
    if not path.name.endswith((".csv", ".csv.gz")):
        raise ValueError(f"{path}: found a name ending in '{path.suffix}', expected .csv or .csv.gz")
    names, columns = ["time_s"], [table.time_s]
    for number in sorted(table.joints):
        for name in COLUMN_NAMES:
            column = getattr(table.joints[number], name)
            if column is not None:
                names.append(f"j{number}.{name}")
                columns.append(column)
    values = np.round(np.column_stack(columns), DECIMALS) + 0.0  # + 0.0: no "-0.0"
    lines = [",".join(names)]
    for start in range(0, len(values), _ROWS_AT_A_TIME):
        lines += [",".join(map(repr, row)) for row in values[start : start + _ROWS_AT_A_TIME].tolist()]
    data = ("\n".join(lines) + "\n").encode()
    if path.suffix == ".gz":
        data = gzip.compress(data, _COMPRESSION, mtime=0)
    temporary = path.with_name(f".{path.name}.part")
    try:
        with temporary.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    return hashlib.sha256(data).hexdigest()
