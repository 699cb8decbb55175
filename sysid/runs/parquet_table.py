"""Tables in Parquet. Cheap to import: pyarrow is imported when a file is read."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np

from jtqd.estimator.arrays import FloatArray
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
