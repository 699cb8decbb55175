"""What a run file holds, whatever its kind: columns of a run table that are not checked yet, and the hash of the file."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from jtqd.estimator.arrays import FloatArray
from jtqd.sysid.runs.column_map import ColumnMap
from jtqd.sysid.runs.run_file import RunError


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
