"""Run tables as files: CSV, gzipped CSV and Parquet are read, CSV and gzipped CSV are written.

A table has one header row, UTF-8, cells between commas, semicolons or tabs; lines of comment (#, %, //) may stand anywhere.
Its numbers have decimal points, or all of them decimal commas.
pyarrow is imported when a Parquet file is read.
The true torques of an emulated run, which no instrument measures, are NAME.truth.npz beside NAME.csv.gz.
"""

from __future__ import annotations

import csv
import gzip
import hashlib
import importlib.util
import io
import math
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain, combinations, islice
from pathlib import Path
from typing import Any, Final
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.files import whole_file, write_whole
from jtqd.estimator.run import COLUMN_NAMES, RunTable
from jtqd.estimator.text import counted
from jtqd.sysid.runs.column_map import NO_COLUMN, TIME, ColumnMap, Expression, ExpressionError
from jtqd.sysid.runs.run_file import Content, NoColumnError, RunError, file_bytes, header_place

_BLANK: Final = ("", "nan", "nan(ind)", "nan(snan)", "1.#ind", "1.#qnan", "null", "none", "na", "n/a", "#n/a")
"""What recorders write for no value, in lower case and without a sign."""
_COMMENT: Final = ("#", "%", "//")


def read_csv(path: Path, columns: ColumnMap | None, *, blanks: bool = False) -> Content:
    """Read a table; blanks: rows with a blank cell are left out, and so is a last row that was cut; else refused."""
    data, sha256 = file_bytes(path)
    header, rows, notes, number = _table(path, data, cut=blanks)
    wanted = _Wanted.of(header, path, columns)
    source = {name: header.index(name) for name in wanted.names}
    cells: dict[str, list[float]] = {name: [] for name in source}
    lines: list[int] = []
    for line, row in rows:
        for name, index in source.items():
            value = number(row[index])
            if not math.isfinite(value) and not (blanks and _is_blank(row[index])):
                mark = "comma" if number is _comma_number else "point" if "," in row[index] else ""
                raise RunError(
                    f"{path}: line {line}, column {name!r}: found {row[index][:40]!r}, expected a finite number"
                    f"{mark and f' with a decimal {mark}'}"
                )
            cells[name].append(value)
        lines.append(line)
    if len(lines) < 2:
        raise RunError(f"{path}: found {counted(len(lines), 'sample')} below the header, expected at least 2")
    arrays = {name: np.array(column) for name, column in cells.items()}
    return wanted.content("csv", sha256, arrays, lines, notes)


def read_columns(path: Path) -> tuple[dict[str, FloatArray], dict[str, str]]:
    """Return all columns of a table by name: numbers [n], NaN where blank, and the first text of those that hold text.

    Raises RunError.
    """
    data, _ = file_bytes(path)
    numbers: dict[str, FloatArray] = {}
    texts: dict[str, str] = {}
    number: Callable[[str], float] = _number
    if path.name.lower().endswith(".parquet"):
        with _parquet(path, data) as file:
            table = file.read()
        cells = {name: table.column(name).to_pylist() for name in table.column_names}
    else:
        header, rows, _, number = _table(path, data, cut=True)
        columns = zip(*(row for _, row in rows), strict=True)
        cells = {name: list(column) for name, column in zip(header, columns, strict=False) if name}
    for name, column in cells.items():
        shown = ["" if cell is None else str(cell).strip() for cell in column]
        values = np.array([number(cell) for cell in shown])
        wrong = next((k for k in np.flatnonzero(np.isnan(values)) if not _is_blank(shown[k])), None)
        if wrong is None:
            numbers[name] = values
        else:
            texts[name] = shown[wrong][:40]
    if not cells or len(next(iter(cells.values()))) < 2:
        raise RunError(f"{path}: found fewer than 2 rows below the header, expected a recording")
    if not numbers:
        found = f"no column of numbers (column {next(iter(texts))[:40]!r} has {next(iter(texts.values()))!r})"
        expected = "numbers from the row below the header on, cells between commas, semicolons or tabs"
        raise RunError(f"{path}: found {found}, expected {expected}")
    return numbers, texts


def read_parquet(path: Path, columns: ColumnMap | None, *, blanks: bool = False) -> Content:
    """Read a table; blanks: rows with a blank cell are left out, else refused."""
    data, sha256 = file_bytes(path)
    with _parquet(path, data) as file:
        wanted = _Wanted.of(list(file.schema_arrow.names), path, columns)
        table = file.read(columns=wanted.names)
    cells = {
        name: _numbers(path, name, table.column(name).to_numpy(), blanks=blanks)
        for name in table.column_names
    }
    return wanted.content("parquet", sha256, cells)


@contextmanager
def _parquet(path: Path, data: bytes) -> Iterator[Any]:
    """Give the open Parquet file; what pyarrow cannot read is a RunError."""
    if importlib.util.find_spec("pyarrow") is None:
        raise RunError(f"{path}: reading Parquet needs pyarrow, which is not installed: pip install pyarrow")
    import pyarrow as pa  # type: ignore[import-not-found,import-untyped,unused-ignore]
    import pyarrow.parquet as pq  # type: ignore[import-not-found,import-untyped,unused-ignore]

    try:
        yield pq.ParquetFile(pa.BufferReader(data))
    except RunError:
        raise
    except (pa.ArrowException, OSError, ValueError) as error:
        raise RunError(f"{path}: not a readable Parquet file: {' '.join(str(error).split())}") from None


@dataclass(frozen=True)
class _Wanted:
    """What is read of a table: its column map, and the expression of each target and further source."""

    path: Path
    columns: ColumnMap
    expressions: Mapping[str, Expression]

    @classmethod
    def of(cls, header: Sequence[str], path: Path, columns: ColumnMap | None) -> _Wanted:
        """Parse the map for a file with these columns; None: the run table's own names. Raises RunError."""
        place = f"{path}:{header_place(path)}"
        if not (columns and columns.columns) and TIME not in header:
            raise NoColumnError(
                f"{place} found no column '{TIME}' (first columns: {list(header[:4])}), expected the run table's names "
                "or a column map"
            )
        try:
            columns = (columns or ColumnMap({}, {})).of_run(path, header)
        except ExpressionError as error:
            raise RunError(f"{place} {error}") from None
        try:
            return cls(path, columns, columns.parsed(list(header), place))
        except ExpressionError as error:
            kind = NoColumnError if NO_COLUMN in str(error) else RunError
            raise kind(str(error)) from None

    @property
    def names(self) -> list[str]:
        """Columns of the file that are read, each once."""
        return _names(self.expressions)

    def content(
        self,
        source: str,
        sha256: str,
        cells: Mapping[str, FloatArray],
        lines: Sequence[int] | None = None,
        notes: tuple[str, ...] = (),
    ) -> Content:
        """Return the targets of the cells [n] without rows in which one is blank (NaN); lines [n]: of the rows.

        A column that is blank everywhere is absent. Raises RunError for one that cannot be.
        """
        blank = {name: np.isnan(cell) for name, cell in cells.items()}
        absent = {name for name, rows in blank.items() if len(rows) and rows.all()}
        made = {f"j{n}" for n in (*(self.columns.loads or {}), *(self.columns.drives or {}))}
        for key, each in self.expressions.items():
            name = next((name for name in each.names if name in absent), None)
            if name is not None and (key == TIME or key.partition(".")[0] in made):
                raise RunError(f"{self.path}: column {name!r}: found it blank in every row, expected {key}")
        used = {key: each for key, each in self.expressions.items() if not absent & set(each.names)}
        names = _names(used)
        keep = ~np.any([blank[name] for name in names], axis=0)
        found = [f"column {n!r} is blank in every row: taken as absent" for n in cells if n in absent]
        count = {name: int(blank[name].sum()) for name in names if blank[name].any()}
        if count:
            which = ", ".join(f"{name!r} in {rows}" for name, rows in count.items())
            rows = counted(len(keep), "row")
            found.append(f"{int((~keep).sum())} of {rows} left out for a blank cell ({which})")
            if why := interleaved({name: ~blank[name] for name in names}):
                raise RunError(f"{self.path}: {why}")
            if np.count_nonzero(keep) < 2:
                kept = counted(int(keep.sum()), "sample")
                raise RunError(f"{self.path}: {found[-1]}: found {kept}, expected at least 2")
        if lines is not None:
            lines = [line for line, kept in zip(lines, keep, strict=True) if kept]
        kept_cells = {name: cells[name][keep] for name in names}
        sources = self.columns.sources()
        with np.errstate(over="ignore", invalid="ignore"):  # not finite: refused by the run table
            values = {
                key: sources[key].scale * each.value(kept_cells) + sources[key].offset
                for key, each in used.items()
            }
        return Content(self.path, source, sha256, values, lines, (*notes, *found), self.columns)


def interleaved(filled: Mapping[str, NDArray[np.bool_]]) -> str:
    """Return which columns [n] are not filled in the same rows; "" for none."""
    for one, two in combinations(filled, 2):
        rows, others = filled[one], filled[two]
        if 2 * np.count_nonzero(rows & others) < min(np.count_nonzero(rows), np.count_nonzero(others)):
            return (
                f"found columns {one!r} and {two!r} filled in different rows: topics with stamps of their own, expected one "
                "time base (resample one onto the stamps of the other)"
            )
    return ""


def _names(expressions: Mapping[str, Expression]) -> list[str]:
    return list(dict.fromkeys(name for each in expressions.values() for name in each.names))


def _text(path: Path, data: bytes) -> str:
    try:
        text = (gzip.decompress(data) if path.suffix.lower() == ".gz" else data).decode("utf-8-sig")
    except (gzip.BadGzipFile, EOFError, zlib.error) as error:
        raise RunError(f"{path}: found a broken gzip stream ({error}), expected gzipped CSV") from None
    except UnicodeDecodeError as error:
        raise RunError(f"{path}: found byte {error.start} that is not UTF-8, expected UTF-8 text") from None
    if not text.strip().strip("\0"):  # zeros: what a recorder without power has left
        raise RunError(f"{path}: found an empty file, expected a header row and samples")
    return text


def _table(
    path: Path, data: bytes, *, cut: bool
) -> tuple[list[str], Iterator[tuple[int, list[str]]], tuple[str, ...], Callable[[str], float]]:
    """Return the header of a table, its rows with the line of each, notes, and what reads the number of a cell (NaN: none);
    cut: a last row that was cut is left out.

    Raises RunError, also for a header of numbers, a name given twice, and a row of another length.
    """
    text = _text(path, data)
    above, text = _comments(text)
    separator = _separator(text)
    text, notes = _without_cut_row(text, separator) if cut else (text, ())
    rows = _rows(text, separator, path)
    line, names = next(rows, (1, []))
    header = [name.strip() for name in names]
    counting = header == [str(k) for k in range(len(header))]  # names that some libraries give
    if header and not counting and all(math.isfinite(_number(name)) for name in header):
        last = above[-1].lstrip("#%/ \t") if above else ""
        named = [name.strip() for name in last.split(separator)]
        if len(named) != len(header) or not any(named):
            raise RunError(
                f"{path}: line {line + len(above)}: found numbers, expected a header row with the name of every column"
            )
        header, rows = named, chain([(line, names)], rows)  # as numpy.savetxt writes it: "# t,position"
    twice = next((name for k, name in enumerate(header) if name and name in header[:k]), None)
    if twice is not None:
        raise RunError(
            f"{path}: line {line + len(above)}: found column {twice!r} twice, expected every name once"
        )

    first = list(islice(rows, _SHOWING))
    cells = [each for _, row in first for each in row]
    marks = {mark for each in cells for mark in _READ if mark in each and math.isfinite(_READ[mark](each))}
    number = _READ["," if marks == {","} else "."]
    notes += ("numbers have decimal commas",) * (number is _comma_number)

    def whole() -> Iterator[tuple[int, list[str]]]:
        for place, row in chain(first, rows):
            if not row or (row[0].lstrip().startswith(_COMMENT) and not _is_blank(row[0])):
                continue
            if len(row) != len(header):
                raise RunError(
                    f"{path}: line {place + len(above)}: found {counted(len(row), 'cell')}, expected {len(header)}"
                )
            yield place + len(above), row

    return header, whole(), notes, number


def _comments(text: str) -> tuple[list[str], str]:
    """Return the lines of comment and the blank lines above the header, and the text below them."""
    above: list[str] = []
    while text.startswith(_COMMENT) or (text and not text.split("\n", 1)[0].strip()):
        line, _, text = text.partition("\n")
        above.append(line.strip())
    return above, text


def _is_blank(cell: str) -> bool:
    return cell.strip().lower().lstrip("+-") in _BLANK


def _number(cell: str) -> float:
    """Return the number of a cell; NaN for anything else."""
    try:
        return float(cell)
    except ValueError:
        return math.nan


def _comma_number(cell: str) -> float:
    """Return the number of a cell with a decimal comma; NaN for anything else, also for a point."""
    return math.nan if "." in cell else _number(cell.replace(",", "."))


_READ: Final = {".": _number, ",": _comma_number}
_SHOWING: Final = 100
"""What reads a number by its decimal mark; rows that show the mark of a table."""


def _separator(text: str) -> str:
    """Return the mark that gives the header and the row below it equally many cells, else the first that the header has."""
    header = text.lstrip().split("\n", 1)[0]
    for mark in "\t;,":
        try:
            names, row = islice(csv.reader(io.StringIO(text.lstrip(), newline=""), delimiter=mark), 2)
        except (ValueError, csv.Error):  # no row below, or no CSV
            continue
        if len(names) == len(row) > 1:
            return mark
    return next((mark for mark in ",;\t" if mark in header), ",")


def _without_cut_row(text: str, separator: str) -> tuple[str, tuple[str, ...]]:
    """Return the text without a last row that has no line end and too few cells (the recorder was ended), and a note."""
    *before, row, last = ("", "", *text.rsplit("\n", 2))[-3:]
    if not last or last.count(separator) >= row.count(separator):
        return text, ()
    return "\n".join([*before, row, ""]), (f"the last row left out: it ends after {last[-20:]!r}",)


def _rows(text: str, separator: str, path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield the line on which each row ends, and its cells."""
    rows = csv.reader(io.StringIO(text, newline=""), delimiter=separator)
    try:
        for row in rows:
            yield rows.line_num, row
    except csv.Error as error:
        raise RunError(f"{path}: line {rows.line_num}: found text that is not CSV ({error})") from None


def _numbers(path: Path, name: str, values: Any, *, blanks: bool) -> FloatArray:
    """Return one column as float64 [n]. Raises RunError with the first row that is text, infinite, or blank where not
    allowed.
    """
    try:
        cells: FloatArray = np.asarray(values, np.float64)
        good = ~np.isinf(cells) if blanks else np.isfinite(cells)
        if good.all():
            return cells
        row = int(np.argmin(good))
        found = str(cells[row])
    except (TypeError, ValueError):
        row = next((k for k, value in enumerate(values) if not _is_number(value)), 0)
        found = repr(str(values[row])[:40])
    raise RunError(f"{path}: row {row + 1}, column {name!r}: found {found}, expected a finite number")


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
    """Write `table` as .csv or .csv.gz, whole or not at all; return the SHA-256 of the file (hex). Same table, same bytes.

    Columns: time_s, then those of each joint, by number, in the order of COLUMN_NAMES. Numbers are written to 1e-10 of
    their unit, below the resolution of any channel. Raises ValueError for another ending, OSError.
    """
    path = Path(path)
    if not path.name.endswith((".csv", ".csv.gz")):
        raise ValueError(f"{path}: found a name ending in '{path.suffix}', expected .csv or .csv.gz")
    names, columns = [TIME], [table.time_s]
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
    write_whole(path, data)
    return hashlib.sha256(data).hexdigest()


def truth_path(run: Path) -> Path:
    """Return the file of the true torques of a run file: NAME.truth.npz beside NAME.csv.gz."""
    return run.with_name(run.name.removesuffix(".gz").removesuffix(".csv") + ".truth.npz")


def write_truth(run: Path, torque_nm: Mapping[int, FloatArray]) -> None:
    """Write the true torque [n] of each joint of a run. Raises OSError."""
    arrays = {f"j{number}": values for number, values in torque_nm.items()}
    with whole_file(truth_path(run)) as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]


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
