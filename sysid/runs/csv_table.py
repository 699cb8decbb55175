"""Tables in CSV, gzipped or not: UTF-8, one header row, cells between commas, semicolons or tabs."""

from __future__ import annotations

import csv
import gzip
import io
import math
import zlib
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import Final, Protocol

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.checked import counted
from jtqd.sysid.runs.column_map import ColumnMap
from jtqd.sysid.runs.content import Content, file_bytes
from jtqd.sysid.runs.run_file import RunError
from jtqd.sysid.runs.table_columns import (
    names_read,
    scaled,
    wanted_columns,
    wanted_expressions,
    without_blanks,
)

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
