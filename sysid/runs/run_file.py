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
        path, source: the file, and its kind: "csv", "parquet" or "mcap".
        sha256: of the file on disk (hex).
        table: its columns. The segments of one recording keep its time.
        notes: what is suspicious about it, one line each.
    """

    name: str
    path: Path
    source: str
    sha256: str
    table: RunTable
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Content:
    """Columns of a file: targets and further sources [n] by key, and their lines [n] for messages (None: sample numbers)."""

    path: Path
    source: str
    sha256: str
    values: Mapping[str, FloatArray]
    lines: Sequence[int] | None = None
    notes: tuple[str, ...] = ()
    columns: ColumnMap | None = None


def file_bytes(path: Path) -> tuple[bytes, str]:
    """Return the content of a file and its SHA-256. Raises RunError."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise RunError(f"{path}: cannot be read: {error.strerror or error}") from None
    if not data:
        raise RunError(f"{path}: found an empty file, expected a run")
    return data, hashlib.sha256(data).hexdigest()


def header_place(path: Path) -> str:
    """Return the line of a table's header for messages; only text has lines."""
    return " line 1:" if ".csv" in path.suffixes else ""
