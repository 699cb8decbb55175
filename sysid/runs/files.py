"""Run files: which are meant, which of them are one recording, and the runs in them. CSV, gzipped CSV and Parquet tables and
jtqd's MCAP logs as run tables.

A table has one header row; its columns are those of the run table (`time_s`, `j1.current_a`, ...) or, with a column map,
whatever the map names. Only the columns asked for are parsed: garbage in the others cannot hurt. Anything wrong in the
ones asked for is refused in one line that names file, line, column, found and expected. What is suspicious but usable is
returned as notes; a torque channel that is exactly zero in every row is dead and comes back as None, never as zeros.
`jN.enabled` (0: power stage off, else 1) is optional; without it nothing is known of the power stage.

A file becomes `content.Content` by its kind (`csv_table`, `parquet_table`, `log_content`), that becomes runs in `pieces`.

Cheap to import: numpy and the estimator's values. Parquet (pyarrow) and MCAP (`jtqd.sysid.runs.logs`) are imported when a
file of that kind is read.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from jtqd.sysid.progress import progress
from jtqd.sysid.runs.column_map import ColumnMap
from jtqd.sysid.runs.content import Content
from jtqd.sysid.runs.csv_table import read_csv
from jtqd.sysid.runs.log_content import read_log
from jtqd.sysid.runs.parquet_table import read_parquet
from jtqd.sysid.runs.pieces import runs_of
from jtqd.sysid.runs.run_file import RunError, RunFile
from jtqd.sysid.runs.same_run import Stretches, same_run, stretches

TABLES: Final = (".csv", ".csv.gz", ".parquet")
LOGS: Final = (".mcap",)
_PART: Final = re.compile(r"(?P<run>.+-\d{8}T\d{6}Z(?:_\d+)?)-\d{4,}\.mcap", re.ASCII)
"""Name of a part of a run: PREFIX-RUN-PART.mcap."""


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
            read = runs_of(read_log(path, *parts, joints=joints), whole=False)
        else:
            read = runs_of(_content(path, mapping, joints, blanks=in_pieces), whole=not in_pieces)
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
    [run] = runs_of(_content(Path(path), columns, joints), whole=True)
    return run


def read_pieces(path: Path | str, columns: ColumnMap | None = None) -> list[RunFile]:
    """Read one file as `read_run`, taken apart where its time starts again, at its gaps and rows with a blank cell; pieces
    shorter than SHORTEST_PIECE_S are left out and noted, and so are rows written twice.

    Raises RunError, also where no piece is long enough.
    """
    return runs_of(_content(Path(path), columns, blanks=True), whole=False)


def _recordings(paths: Sequence[Path]) -> list[tuple[Path, ...]]:
    """Return the files of each recording: jtqd ends a log and begins the next part after a while (docs/recording.md)."""
    groups: dict[object, list[Path]] = {}
    for path in paths:
        run = _PART.fullmatch(path.name)
        key = path if run is None else (path.parent, run["run"])
        groups.setdefault(key, []).append(path)
    return [tuple(sorted(group)) for group in groups.values()]


def _content(
    path: Path, columns: ColumnMap | None, joints: Sequence[int] | None = None, *, blanks: bool = False
) -> Content:
    """Read a file; blanks: rows of a table with a blank cell are left out, else refused."""
    if not path.is_file():
        found = "something that is no file" if path.exists() else "no such file"
        found = "a directory" if path.is_dir() else found
        raise RunError(f"{path}: found {found}, expected a run file ({', '.join(TABLES + LOGS)})")
    if path.name.endswith(LOGS):
        return read_log(path, joints=joints)
    if path.name.endswith(".parquet"):
        return read_parquet(path, columns, blanks=blanks)
    if path.name.endswith(TABLES):
        return read_csv(path, columns, blanks=blanks)
    raise RunError(f"{path}: found a file ending in '{path.suffix}', expected {', '.join(TABLES + LOGS)}")
