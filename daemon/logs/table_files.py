"""Tables into files, block by block: CSV (packed where the name ends in .gz) and Parquet."""

from __future__ import annotations

import csv
import gzip
import io
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jtqd.daemon.logs.errors import LogError

Columns = Mapping[str, NDArray[Any]]
"""Name -> values, all of one length."""
_ROWS, _GROUP_ROWS = 20_000, 60_000


class Size(NamedTuple):
    """Of a table that was written."""

    rows: int
    columns: int


@contextmanager
def whole_file(path: Path) -> Iterator[IO[bytes]]:
    """A file that is there when it is complete, or not at all; packed where its name ends in .gz.

    A link is followed, and what is no file (a pipe, /dev/stdout) is written to as it is, never replaced. Raises OSError.
    """
    target = Path(os.path.realpath(path))
    beside = not target.exists() or target.is_file()
    partial = target.with_name(target.name + f".{os.getpid()}.part") if beside else target
    try:
        with open(partial, "wb") as plain:
            if path.suffix == ".gz":
                # Without name and time: equal content makes equal files.
                with gzip.GzipFile("", "wb", 6, plain, mtime=0) as packed:
                    yield packed  # type: ignore[misc]
            else:
                yield plain
        if beside:
            os.replace(partial, target)
    except OSError as error:
        if error.filename in (None, str(partial)):
            error.filename = str(path)
        raise
    finally:
        if beside:
            with suppress(OSError):
                partial.unlink()


def write_csv(path: Path, blocks: Iterable[Columns]) -> Size:
    """Numbers as the shortest text that reads back the same; NaN is an empty cell. Raises OSError."""
    rows = 0
    names: tuple[str, ...] = ()
    with whole_file(path) as file:
        text = io.TextIOWrapper(file, encoding="utf-8", newline="", write_through=False)
        writer = csv.writer(text, lineterminator="\n")
        try:
            for block in blocks:
                if not names:
                    names = tuple(block)
                    writer.writerow(names)
                rows += _length(block)
                for begin in range(0, _length(block), _ROWS):
                    parts = [_cells(values[begin : begin + _ROWS]) for values in block.values()]
                    writer.writerows(zip(*parts, strict=True))
            text.flush()
        finally:
            text.detach()
    return Size(rows, len(names))


def _cells(values: NDArray[Any]) -> list[Any]:
    cells: list[Any] = values.tolist()
    if values.dtype.kind == "f" and np.isnan(values).any():
        return ["" if value != value else value for value in cells]  # noqa: PLR0124
    return cells


def write_parquet(path: Path, blocks: Iterable[Columns]) -> Size:
    """Columns with their types, packed by zstd. Raises LogError where pyarrow is not installed, OSError."""
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError:
        raise LogError("found no pyarrow, expected it for Parquet: pip install 'jtqd[parquet]'") from None
    rows, columns, writer = 0, 0, None
    with whole_file(path) as file:
        try:
            for block in _gathered(blocks):
                table = pa.table({name: pa.array(np.ascontiguousarray(v)) for name, v in block.items()})
                writer = writer or parquet.ParquetWriter(file, table.schema, compression="zstd")
                writer.write_table(table)
                rows, columns = rows + _length(block), len(block)
        finally:
            if writer is not None:
                writer.close()
    return Size(rows, columns)


def _gathered(blocks: Iterable[Columns]) -> Iterator[Columns]:
    """Blocks of at least `_GROUP_ROWS`, but for the last: Parquet packs each on its own."""
    kept: list[Columns] = []
    for block in blocks:
        kept.append(block)
        if sum(map(_length, kept)) >= _GROUP_ROWS:
            yield _joined(kept)
            kept = []
    if kept:
        yield _joined(kept)


def _joined(blocks: list[Columns]) -> Columns:
    return {name: np.concatenate([block[name] for block in blocks]) for name in blocks[0]}


def _length(block: Columns) -> int:
    return len(next(iter(block.values())))
