"""How much disk the logs may take: what a budget removes, and when there is room to record."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from daemon.recording.naming import OwnFile

MEGABYTE = 1_000_000


class Sized(NamedTuple):
    """One of our files with its length [byte]."""

    file: OwnFile
    size: int


def sized(files: Sequence[OwnFile]) -> list[Sized]:
    """The files that are still there, with their lengths."""
    found = []
    for file in files:
        with suppress(OSError):
            found.append(Sized(file, file.path.stat().st_size))
    return found


def to_remove(files: Sequence[Sized], budget: int, growing: int, run: str, *, keep_run: bool) -> list[Sized]:
    """Files whose removal brings the rest within a budget; the budget may stay exceeded. Pure.

    Only finished files, those of earlier runs first, the oldest first. Of the run being written finished parts go only where
    `keep_run` is false, after all others, and never the newest of them.

    Args:
        files: all of ours, oldest first, without the file being written.
        budget: all together [byte].
        growing: the file being written [byte].
        run: the run being written.
    """
    excess = sum(each.size for each in files) + growing - budget
    others = [each for each in files if each.file.run != run and not each.file.active]
    own = [each for each in files if each.file.run == run and not each.file.active]
    chosen = []
    for each in [*others, *([] if keep_run else own[:-1])]:
        if excess <= 0:
            break
        chosen.append(each)
        excess -= each.size
    return chosen


def free_bytes(directory: Path) -> int:
    """Free space where the directory is, or would be made, without what is for root only. Raises OSError."""
    while not directory.exists() and directory != directory.parent:
        directory = directory.parent
    found = os.statvfs(directory)
    return found.f_bavail * found.f_frsize
