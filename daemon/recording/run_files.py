"""What a run leaves: the names and sizes of its files ("parts"), a disk budget for them, and the account of its cycles.

A file is named PREFIX-RUN-PART.mcap, with `.active` behind it while it is being written. RUN is the time at which the run
began, `YYYYmmddTHHMMSSZ` (UTC), with `_2`, `_3` ... where another run of that prefix has it already; PART counts from 0001.
A file with another name is neither repaired nor removed.
"""

from __future__ import annotations

import mmap
import os
import re
import stat
import struct
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import NamedTuple

from jtqd.estimator.files import read_file, trusted_users

ACTIVE = ".active"
_RUN = r"(?P<stamp>\d{8}T\d{6}Z)(?:_(?P<again>[1-9]\d*))?"
RUN_PATTERN = re.compile(_RUN, re.ASCII)
PART_PATTERN = re.compile(
    rf"(?P<prefix>.+)-(?P<run>{_RUN})-(?P<part>\d{{4,}})\.mcap(?P<active>{re.escape(ACTIVE)})?", re.ASCII
)
"""Name of a part, of any prefix."""
MEGABYTE = 1_000_000


class PartFile(NamedTuple):
    """One part; parts sort in the order of their writing, as long as no run began before the clock was set back.

    again: number of the run among those of the same second, 1 for the first.
    size: [byte].
    """

    stamp: str
    again: int
    part: int
    active: bool
    path: Path
    run: str
    size: int = 0


def part_name(prefix: str, run: str, part: int) -> str:
    """Return the name of a finished part."""
    return f"{prefix}-{run}-{part:04d}.mcap"


def parse_part(prefix: str, path: Path) -> PartFile | None:
    """Return the part of this name; None for another file."""
    found = PART_PATTERN.fullmatch(path.name)
    if found is None or found["prefix"] != prefix:
        return None
    again, part = int(found["again"] or 1), int(found["part"])
    return PartFile(found["stamp"], again, part, bool(found["active"]), path, found["run"])


def part_files(directory: Path, prefix: str) -> list[PartFile]:
    """Return the parts in a directory, oldest first, regular files only; empty if it cannot be read."""
    found = []
    with suppress(OSError):
        for path in directory.iterdir():
            part = parse_part(prefix, path)
            with suppress(OSError):
                status = path.lstat() if part is not None else None
                if part is not None and status is not None and stat.S_ISREG(status.st_mode):
                    found.append(part._replace(size=status.st_size))
    return sorted(found)


def free_run(directory: Path, prefix: str, time_ns: int) -> str:
    """Return an unused name for a run that begins at this time."""
    stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime(time_ns // 1_000_000_000))
    taken = [each.again for each in part_files(directory, prefix) if each.stamp == stamp]
    return f"{stamp}_{max(taken) + 1}" if taken else stamp


# ---- disk space ----


def to_remove(
    files: Sequence[PartFile], budget: int, growing: int, run: str, *, keep_run: bool
) -> list[PartFile]:
    """Return the files to remove for a budget; the budget may stay exceeded. Pure.

    Only finished files, those of earlier runs first, the oldest first. Of the run being written finished parts go only where
    `keep_run` is false, after all others, and never the newest of them.

    Args:
        files: all parts, oldest first, without the file being written.
        budget: all together [byte].
        growing: the file being written [byte].
        run: the run being written.
    """
    excess = sum(each.size for each in files) + growing - budget
    others = [each for each in files if each.run != run and not each.active]
    own = [each for each in files if each.run == run and not each.active]
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


# ---- the account of a run's cycles ----

_LAYOUT = struct.Struct("<QQQQQ")


@dataclass
class Account:
    """Every cycle of the ring up to a position is written, lost, or let go: `written + lost + let_go == cycles`.

    Attributes:
        written: on the disk, in all files of this run.
        overwritten: lost because the ring went round before they were read.
        unwritten: lost because the disk did not take them, or because another program removed the file.
        let_go: not written because nothing had happened (flight recorder only); those in its memory are among them.
    """

    cycles: int = 0
    written: int = 0
    overwritten: int = 0
    unwritten: int = 0
    let_go: int = 0

    @property
    def lost(self) -> int:
        """Cycles that are in no file."""
        return self.overwritten + self.unwritten


class ProgressFile:
    """The `Account` of what is settled, in shared memory: another recorder continues where one died. Raises OSError."""

    def __init__(self, path: Path) -> None:
        with open(path, "a+b") as file:
            os.posix_fallocate(file.fileno(), 0, _LAYOUT.size)  # a full tmpfs refuses here, not by SIGBUS
            self._memory = mmap.mmap(file.fileno(), _LAYOUT.size)

    def load(self) -> Account:
        """Return what was stored last."""
        return Account(*_LAYOUT.unpack_from(self._memory, 0))

    def store(self, settled: Account) -> None:
        """Replace it."""
        self._memory[:] = _LAYOUT.pack(*astuple(settled))


def read_account(path: Path) -> Account | None:
    """Return what was stored last; None where there is no such file, or it cannot be read."""
    try:
        return Account(*_LAYOUT.unpack_from(read_file(path, _LAYOUT.size, owners=trusted_users())))
    except (OSError, struct.error):
        return None
