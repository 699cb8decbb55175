"""A run table into a CSV file, gzipped when its name says so: what `jtqd.sysid.runs.files.read_run` reads back.

Numbers are written to 1e-10 of their unit: less than what any encoder, current or torque channel resolves, and
a third of the size that all 17 digits would take. The same table gives the same bytes, so that a hash of the file is a
hash of the data.
"""

from __future__ import annotations

import csv
import gzip
import hashlib
import io
import math
import os
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from jtqd.estimator.checked import Section
from jtqd.estimator.run import COLUMN_NAMES, JointColumns, RunTable, RunTableError
from jtqd.models.files import load_yaml

# Run tables from files: CSV and gzipped CSV, with a column map for anybody else's names, units and signs.
#
# A run file has one header row; the columns are those of the design's run table (`time_s`, `j1.current_a`,
# ...) or, with a column map, whatever the map names. Only the columns asked for are parsed: garbage in the
# others cannot hurt. Anything wrong in the ones asked for is refused in one line that names file, line,
# column, found and expected. What is suspicious but usable is returned as notes; a torque channel that is
# exactly zero in every row is dead and comes back as None, never as zeros. `jN.enabled` (0: power stage off, else 1) is
# optional; without it nothing is known of the power stage.


TIME = "time_s"
JOINTS = range(1, 8)
# A longer step than this many median steps means that the run consists of pieces: refused, because a fit or
# an observer would take the jump for a measurement. Shorter gaps (lost cycles) are notes.
LONGEST_GAP = 10.0
GAP_NOTED = 1.5
DEAD_ROWS = 100  # a channel without a single non-zero value over this many rows is dead, not quiet


class RunError(ValueError):
    """A run file cannot be used; the message is one line: file, place, found, expected."""


@dataclass(frozen=True)
class Column:
    """value = scale * cell + offset, in the target's SI unit. A negative scale flips the sign."""

    name: str
    scale: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class ColumnMap:
    """Where each target column comes from, and the joint files named by `jN.joint_file` (beside the map)."""

    columns: Mapping[str, Column]
    joint_files: Mapping[int, Path]

    @classmethod
    def from_mapping(cls, mapping: Mapping[str, object], where: str, folder: Path) -> ColumnMap:
        """Check a column map read from YAML.

        `TARGET: NAME` is short for `TARGET: {column: NAME, scale: 1.0, offset: 0.0}`. Raises ConfigError.
        """
        full = {
            key: {"column": value} if isinstance(value, str) and key in _targets() else value
            for key, value in mapping.items()
        }
        section = Section(full, where)
        columns: dict[str, Column] = {}
        for key in _targets():
            inner = section.section(key, optional=key != TIME and full.get(key, "") is not None)
            if inner is not None:
                columns[key] = _column(inner)
        files = {
            joint: folder / section.text(f"j{joint}.joint_file")
            for joint in JOINTS
            if f"j{joint}.joint_file" in full
        }
        section.finish()
        return cls(columns, files)

    @classmethod
    def load(cls, path: Path) -> ColumnMap:
        """Read a column map file. Raises ConfigError."""
        mapping, _ = load_yaml(path)
        return cls.from_mapping(mapping, str(path), path.parent)


@dataclass(frozen=True)
class RunFile:
    """A run as read: the table, what is suspicious about it, and the SHA-256 of the file on disk."""

    table: RunTable
    notes: tuple[str, ...]
    sha256: str


class _Rows(Protocol):
    """What csv.reader returns."""

    line_num: int

    def __next__(self) -> list[str]: ...


def read_run(path: Path | str, columns: ColumnMap | None = None) -> RunFile:
    """Read a CSV or gzipped CSV run; without a column map the file must use the design's own column names.

    Raises RunError.
    """
    path = Path(path)
    text, sha256 = _text(path)
    rows = csv.reader(io.StringIO(text, newline=""))
    header = _header(rows, path)
    values, lines = _parse(rows, path, header, wanted_columns(header, path, columns))
    return run_of_columns(path, values, lines, sha256)


def wanted_columns(header: list[str], path: Path, columns: ColumnMap | None) -> Mapping[str, Column]:
    """Where each target column comes from: the map's, or the design's own names that are there. Raises RunError."""
    wanted = columns.columns if columns is not None else _own_columns(header, path)
    for target, column in wanted.items():
        if column.name not in header:
            raise RunError(
                f"{path}:{_header_place(path)} found no column '{column.name}', expected it for {target}"
            )
    return wanted


def run_of_columns(
    path: Path, values: Mapping[str, NDArray[np.float64]], lines: list[int] | None, sha256: str
) -> RunFile:
    """Check the target columns [n] of a run and make its table; lines [n] are for the messages, None: sample numbers.

    Raises RunError.
    """
    if len(values[TIME]) < 2:
        raise RunError(f"{path}: found {len(values[TIME])} samples, expected at least 2")
    notes = _check_time(values[TIME], lines, path)
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
    return RunFile(table, tuple(notes), sha256)


def _header_place(path: Path) -> str:
    """Only text has lines."""
    return " line 1:" if ".csv" in path.suffixes else ""


def _targets() -> list[str]:
    return [TIME, *(f"j{joint}.{quantity}" for joint in JOINTS for quantity in COLUMN_NAMES)]


def _column(section: Section) -> Column:
    scale = section.number("scale", unit="target units per cell unit", default=1.0)
    if scale == 0.0:
        raise section.error("scale", scale, "a number other than 0")
    column = Column(
        section.text("column"),
        scale,
        section.number("offset", unit="target units", default=0.0),
    )
    section.finish()
    return column


def _text(path: Path) -> tuple[str, str]:
    """Content of the file as text and the SHA-256 of its bytes."""
    suffix = "".join(path.suffixes[-2:]) if path.suffix == ".gz" else path.suffix
    if suffix not in (".csv", ".csv.gz"):
        raise RunError(
            f"{path}: found a file ending in '{suffix}', expected .csv or .csv.gz (others are not read yet)"
        )
    try:
        data = path.read_bytes()
        content = gzip.decompress(data) if suffix == ".csv.gz" else data
        text = content.decode("utf-8-sig")
    except (gzip.BadGzipFile, EOFError, zlib.error) as error:
        raise RunError(f"{path}: found a broken gzip stream ({error}), expected gzipped CSV") from None
    except UnicodeDecodeError as error:
        raise RunError(f"{path}: found byte {error.start} that is not UTF-8, expected CSV text") from None
    except OSError as error:
        raise RunError(f"{path}: cannot be read: {error.strerror}") from None
    if not text.strip():
        raise RunError(f"{path}: found an empty file, expected a header row and samples")
    return text, hashlib.sha256(data).hexdigest()


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


def _own_columns(header: list[str], path: Path) -> dict[str, Column]:
    """The design's own names, for a file without a column map."""
    if TIME not in header:
        raise RunError(
            f"{path}:{_header_place(path)} found no column '{TIME}' (first columns: {header[:4]}), "
            "expected the run table's names or a column map"
        )
    return {name: Column(name) for name in _targets() if name in header}


def _parse(
    rows: _Rows, path: Path, header: list[str], wanted: Mapping[str, Column]
) -> tuple[dict[str, NDArray[np.float64]], list[int]]:
    """Target columns as float64 arrays [n], n >= 2, all finite, and the line [n] each sample ended on."""
    source = {column.name: header.index(column.name) for column in wanted.values()}
    cells: dict[str, list[float]] = {name: [] for name in source}
    lines: list[int] = []
    while (row := _next_row(rows, path)) is not None:
        if not row:
            continue
        line = rows.line_num
        if len(row) != len(header):
            raise RunError(f"{path}: line {line}: found {len(row)} cells, expected {len(header)}")
        for name, index in source.items():
            try:
                value = float(row[index])
            except ValueError:
                value = math.nan
            if not math.isfinite(value):
                raise RunError(
                    f"{path}: line {line}, column {name!r}: found {row[index][:40]!r}, "
                    "expected a finite number"
                )
            cells[name].append(value)
        lines.append(line)
    if len(lines) < 2:
        raise RunError(f"{path}: found {len(lines)} samples below the header, expected at least 2")
    arrays = {name: np.array(column) for name, column in cells.items()}
    with np.errstate(over="ignore"):  # the table refuses what is not finite
        values = {target: c.scale * arrays[c.name] + c.offset for target, c in wanted.items()}
    return values, lines


def _check_time(time_s: NDArray[np.float64], lines: list[int] | None, path: Path) -> list[str]:
    """Refuse time that stands, runs back or has long gaps; note the short gaps."""

    def at(row: int) -> str:
        return f"sample {row}" if lines is None else f"line {lines[row]}"

    steps = np.diff(time_s)
    if not np.all(steps > 0.0):
        row = int(np.argmax(steps <= 0.0)) + 1
        raise RunError(
            f"{path}: {at(row)}: found time {time_s[row]:.6g} s after {time_s[row - 1]:.6g} s, "
            "expected rising time"
        )
    median = float(np.median(steps))
    longest = int(np.argmax(steps))
    if steps[longest] > LONGEST_GAP * median:
        raise RunError(
            f"{path}: {at(longest + 1)}: found a gap of {steps[longest]:.6g} s, "
            f"expected steps of about {median:.6g} s"
        )
    gaps = int(np.count_nonzero(steps > GAP_NOTED * median))
    return [f"{gaps} steps are longer than {GAP_NOTED} times the median of {median:.6g} s"] if gaps else []


DECIMALS: Final = 10
_COMPRESSION: Final = 6
_ROWS_AT_A_TIME: Final = 8192


def write_run(path: Path | str, table: RunTable) -> str:
    """Write `table` as .csv or .csv.gz, whole or not at all: an earlier file stays until the new one is complete.

    Returns the SHA-256 of the file (hex), which `read_run` tells as well.

    Columns: time_s, then those that each joint has, in the order of the joints' numbers and of COLUMN_NAMES.
    Reading gives every value back to 5e-11 of its unit (values above 1e5 to 1e-15 of themselves).

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
