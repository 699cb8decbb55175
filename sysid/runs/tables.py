"""Run tables as files: CSV, gzipped CSV and Parquet are read, CSV and gzipped CSV are written.

A table has one header row, UTF-8, cells between commas, semicolons or tabs. pyarrow is imported when a Parquet file is read.
"""

from __future__ import annotations

import csv
import gzip
import hashlib
import importlib.util
import io
import math
import os
import zlib
from collections.abc import Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, Final, Protocol
from zipfile import BadZipFile

import numpy as np

from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.estimator.checked import counted
from jtqd.estimator.run import COLUMN_NAMES, RunTable
from jtqd.sysid.runs.column_map import TIME, Column, ColumnMap, Expression, ExpressionError, targets
from jtqd.sysid.runs.run_file import Content, RunError, file_bytes, header_place


def wanted_columns(header: Sequence[str], path: Path, columns: ColumnMap | None) -> ColumnMap:
    """Return the map, or for none one of the run table's own names that are there."""
    if columns is not None:
        return columns
    if TIME not in header:
        raise RunError(
            f"{path}:{header_place(path)} found no column '{TIME}' (first columns: {list(header[:4])}), "
            "expected the run table's names or a column map"
        )
    return ColumnMap({name: Column(name) for name in targets() if name in header}, {})


def wanted_expressions(header: Sequence[str], path: Path, columns: ColumnMap) -> dict[str, Expression]:
    """Return what is read for each target and further source, parsed; RunError where the file cannot give it."""
    try:
        return columns.parsed(list(header), f"{path}:{header_place(path)}")
    except ExpressionError as error:
        raise RunError(str(error)) from None


def names_read(wanted: Mapping[str, Expression]) -> list[str]:
    """Return the columns of the file that are read, each once."""
    return list(dict.fromkeys(name for each in wanted.values() for name in each.names))


def without_blanks(
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
    used = names_read(there)
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


def scaled(
    cells: Mapping[str, FloatArray], wanted: Mapping[str, Expression], columns: ColumnMap
) -> dict[str, FloatArray]:
    """Return the values [n] of targets and further sources, by scale and offset of the map."""
    sources = columns.sources()
    with np.errstate(over="ignore", invalid="ignore"):  # the table refuses what is not finite
        return {
            key: sources[key].scale * each.value(cells) + sources[key].offset for key, each in wanted.items()
        }


_BLANK: Final = ("", "nan")


class _Rows(Protocol):
    """What csv.reader returns."""

    line_num: int

    def __next__(self) -> list[str]: ...


def read_csv(path: Path, columns: ColumnMap | None, *, blanks: bool = False) -> Content:
    """Read a table; blanks: rows with a blank cell are left out, and so is a last row that was cut; else refused."""
    data, sha256 = file_bytes(path)
    text = _text(path, data)
    separator = _separator(text)
    text, cut = _without_cut_row(text, separator) if blanks else (text, ())
    rows = csv.reader(io.StringIO(text, newline=""), delimiter=separator)
    header = _header(rows, path)
    columns = wanted_columns(header, path, columns)
    wanted = wanted_expressions(header, path, columns)
    cells, lines = _cells_of_text(rows, path, header, names_read(wanted), blanks=blanks)
    cells, keep, wanted, notes = without_blanks(path, cells, wanted, columns)
    lines = [line for line, kept in zip(lines, keep, strict=True) if kept]
    return Content(path, "csv", sha256, scaled(cells, wanted, columns), lines, (*cut, *notes), columns)


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


def read_parquet(path: Path, columns: ColumnMap | None, *, blanks: bool = False) -> Content:
    """Read a table; blanks: rows with a blank cell are left out, else refused."""
    data, sha256 = file_bytes(path)
    if importlib.util.find_spec("pyarrow") is None:
        raise RunError(f"{path}: reading Parquet needs pyarrow, which is not installed: pip install pyarrow")
    import pyarrow as pa  # type: ignore[import-not-found,import-untyped,unused-ignore]
    import pyarrow.parquet as pq  # type: ignore[import-not-found,import-untyped,unused-ignore]

    try:
        file = pq.ParquetFile(pa.BufferReader(data))
        header = list(file.schema_arrow.names)
        columns = wanted_columns(header, path, columns)
        wanted = wanted_expressions(header, path, columns)
        table = file.read(columns=names_read(wanted))
    except (pa.ArrowException, OSError, ValueError) as error:
        if isinstance(error, RunError):
            raise
        raise RunError(f"{path}: not a readable Parquet file: {' '.join(str(error).split())}") from None
    cells = {
        name: _cells_of_arrow(path, name, table.column(name), blanks=blanks) for name in table.column_names
    }
    cells, _, wanted, notes = without_blanks(path, cells, wanted, columns)
    return Content(path, "parquet", sha256, scaled(cells, wanted, columns), None, notes, columns)


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


ENDING: Final = ".truth.npz"


def truth_path(run: Path) -> Path:
    """Return where the true torques of a run file lie: NAME.truth.npz beside NAME.csv.gz."""
    return run.with_name(run.name.removesuffix(".gz").removesuffix(".csv") + ENDING)


def write_truth(run: Path, torque_nm: Mapping[int, FloatArray]) -> None:
    """Write the true torque [n] of each joint of a run. Raises OSError."""
    arrays = {f"j{number}": values for number, values in torque_nm.items()}
    np.savez_compressed(truth_path(run), **arrays)  # type: ignore[arg-type]


def read_truth(run: Path) -> dict[int, FloatArray]:
    """Return the true torque [n] by joint; empty where the run has none. Raises ValueError for a file that is none."""
    path = truth_path(run)
    if not path.is_file():
        return {}
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return {
                int(name.removeprefix("j")): np.asarray(arrays[name], np.float64) for name in arrays.files
            }
    except (OSError, ValueError, KeyError, BadZipFile) as error:
        raise ValueError(f"{path}: found no arrays j1, j2, ... ({error}), expected true torques") from None
