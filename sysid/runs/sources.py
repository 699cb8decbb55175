"""Run tables for a diagnosis from CSV, Parquet and jtqd's MCAP logs, and which joint file belongs to which joint."""

from __future__ import annotations

import hashlib
import importlib.util
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from jtqd.daemon.logs import LogError
from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.checked import ConfigError
from jtqd.estimator.joint import Joint
from jtqd.estimator.run import COLUMN_NAMES
from jtqd.models.files import load_joint
from jtqd.sysid.runs.files import ColumnMap, RunError, RunFile, read_run, run_of_columns, wanted_columns
from jtqd.sysid.runs.inputs import InputRun, each_once
from jtqd.sysid.runs.logs import log_to_run

TABLES: Final = (".csv", ".csv.gz", ".parquet")
LOGS: Final = (".mcap",)
_JOINT: Final = re.compile(r"([1-7])=(.+)")
BOTH: Final = 0
"""Key of the joint file that serves every joint of the runs."""


class UsageError(ValueError):
    """A command line that cannot be meant; one line."""


def run_paths(arguments: Sequence[Path]) -> list[Path]:
    """Return the run files meant: a file is itself; a directory the tables in it, or the logs when it has no table.

    A campaign's directory holds the log of every run beside its table: read once, not twice.

    Raises RunError for a path that does not exist, or a directory without a run.
    """
    paths: list[Path] = []
    for argument in arguments:
        if not argument.is_dir():
            if not argument.exists():
                raise RunError(f"{argument}: found nothing there, expected a run file or a directory of runs")
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


def read_all(arguments: Sequence[Path], columns: ColumnMap | None) -> list[InputRun]:
    """Read all runs; a progress bar on a terminal. Names are unique.

    Raises RunError, naming file and place; also for the same data given twice, which would count it twice.
    """
    return each_once(run_paths(arguments), lambda path: read_any(path, columns))


def read_any(path: Path, columns: ColumnMap | None = None) -> RunFile:
    """Read one run by the ending of its name. The column map is for tables; a log of jtqd has its own names.

    Raises RunError.
    """
    if path.name.endswith(LOGS):
        return _read_log(path)
    if path.name.endswith(".parquet"):
        return _read_parquet(path, columns)
    if not path.name.endswith(TABLES):
        raise RunError(f"{path}: found a file ending in '{path.suffix}', expected {', '.join(TABLES + LOGS)}")
    return read_run(path, columns)


def _bytes(path: Path) -> bytes:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise RunError(f"{path}: cannot be read: {error.strerror or error}") from None
    if not data:
        raise RunError(f"{path}: found an empty file, expected a run")
    return data


def _read_log(path: Path) -> RunFile:
    data = _bytes(path)
    try:
        logged = log_to_run(path)
    except LogError as error:
        text = str(error)
        raise RunError(text if text.startswith(str(path)) else f"{path}: {text}") from None
    except OSError as error:
        raise RunError(f"{path}: cannot be read: {error.strerror or error}") from None
    notes = []
    if logged.missed or logged.incomplete:
        by = ", ".join(f"{count} of {name}" for name, count in logged.incomplete_by.items() if count)
        notes.append(
            f"{logged.missed} cycles missed and {logged.incomplete} incomplete{f' ({by})' if by else ''}: "
            f"{logged.lost_share:.2%} of the slots are no rows"
        )
    table = logged.table
    values = {"time_s": table.time_s}
    for number, one in table.joints.items():
        values |= {
            f"j{number}.{name}": getattr(one, name) for name in COLUMN_NAMES if getattr(one, name) is not None
        }
    file = run_of_columns(path, values, None, hashlib.sha256(data).hexdigest())
    return RunFile(file.table, (*notes, *file.notes), file.sha256)


def _read_parquet(path: Path, columns: ColumnMap | None) -> RunFile:
    data = _bytes(path)
    if importlib.util.find_spec("pyarrow") is None:
        raise RunError(f"{path}: reading Parquet needs pyarrow, which is not installed: pip install pyarrow")
    import pyarrow as pa  # type: ignore[import-not-found,import-untyped,unused-ignore]
    import pyarrow.parquet as pq  # type: ignore[import-not-found,import-untyped,unused-ignore]

    try:
        file = pq.ParquetFile(pa.BufferReader(data))
        header = list(file.schema_arrow.names)
        wanted = wanted_columns(header, path, columns)
        table = file.read(columns=list(dict.fromkeys(column.name for column in wanted.values())))
    except (pa.ArrowException, OSError, ValueError) as error:
        if isinstance(error, RunError):
            raise
        raise RunError(f"{path}: not a readable Parquet file: {' '.join(str(error).split())}") from None
    cells = {name: _cells(path, name, table.column(name)) for name in table.column_names}
    with np.errstate(over="ignore", invalid="ignore"):
        values = {target: c.scale * cells[c.name] + c.offset for target, c in wanted.items()}
    return run_of_columns(path, values, None, hashlib.sha256(data).hexdigest())


def _cells(path: Path, name: str, column: Any) -> FloatArray:
    """One column as float64 [n]; text that is no number, empty cells, NaN: RunError with the first bad row."""
    values = column.to_numpy()
    try:
        cells: FloatArray = np.asarray(values, np.float64)
    except (TypeError, ValueError):
        row = next((k for k, value in enumerate(values) if not _is_number(value)), 0)
        raise RunError(
            f"{path}: row {row + 1}, column {name!r}: found {str(values[row])[:40]!r}, expected a finite number"
        ) from None
    good = np.isfinite(cells)
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


def joint_files(arguments: Sequence[str], columns: ColumnMap | None) -> dict[int, Path]:
    """Return the joint files by number, or {BOTH: file}; without arguments those that the column map names.

    Raises UsageError.
    """
    if not arguments:
        if columns is not None and columns.joint_files:
            return dict(columns.joint_files)
        raise UsageError("--joint: missing, expected FILE for both joints, or 1=FILE and 2=FILE")
    found: dict[int, Path] = {}
    for text in arguments:
        match = _JOINT.fullmatch(text)
        number = int(match.group(1)) if match else BOTH
        if number in found:
            which = "for all joints" if number == BOTH else f"of joint {number}"
            raise UsageError(f"--joint: found two files {which}, expected one")
        found[number] = Path(match.group(2) if match else text)
    if BOTH in found and len(found) > 1:
        raise UsageError(
            "--joint: found a file for all joints beside one for a single joint, expected either"
        )
    return found


def joints_of(files: Mapping[int, Path], runs: Sequence[InputRun]) -> dict[int, Joint]:
    """Load the joint files of the joints that the runs have.

    Raises ConfigError for a file that cannot be used, or a joint that no run has.
    """
    there = sorted({number for run in runs for number in run.table.joints})
    if BOTH in files:
        joint = load_joint(files[BOTH])
        return dict.fromkeys(there, joint)
    have = ", ".join(f"j{number}" for number in there)
    for number, path in files.items():
        if number not in there:
            raise ConfigError(
                f"--joint {number}={path}: found no columns of j{number} in the runs, which have {have}"
            )
    return {number: load_joint(path) for number, path in sorted(files.items())}
