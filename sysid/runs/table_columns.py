"""From columns of a table, CSV or Parquet, to those of a run table: which are read, rows with blank cells, scales."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.estimator.checked import counted
from jtqd.sysid.runs.column_map import TIME, Column, ColumnMap, targets
from jtqd.sysid.runs.content import header_place
from jtqd.sysid.runs.expressions import Expression, ExpressionError
from jtqd.sysid.runs.run_file import RunError


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
