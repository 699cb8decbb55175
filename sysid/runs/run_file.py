"""A run as read of a file, and the error for one that cannot be used."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from jtqd.estimator.run import RunTable


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
