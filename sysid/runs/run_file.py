"""A run as read from a file, the columns of a file before they are checked, and the error for a file that cannot be used."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.run import RunTable
from jtqd.sysid.runs.column_map import ColumnMap


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


@dataclass(frozen=True)
class Content:
    """What was read of a file: target columns and further sources [n] by key, lines [n] for messages (None: samples)."""

    path: Path
    source: str
    sha256: str
    values: Mapping[str, FloatArray]
    lines: Sequence[int] | None = None
    notes: tuple[str, ...] = ()
    columns: ColumnMap | None = None


def file_bytes(path: Path) -> tuple[bytes, str]:
    """Return the content of a file and its SHA-256."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise RunError(f"{path}: cannot be read: {error.strerror or error}") from None
    if not data:
        raise RunError(f"{path}: found an empty file, expected a run")
    return data, hashlib.sha256(data).hexdigest()


def header_place(path: Path) -> str:
    """Only text has lines."""
    return " line 1:" if ".csv" in path.suffixes else ""
