"""How far the recorder has come, in shared memory: another one can go on where it died, and losses are seen at once."""

from __future__ import annotations

import mmap
import os
import struct
from pathlib import Path
from typing import NamedTuple

_LAYOUT = struct.Struct("<QQQQ")


class Progress(NamedTuple):
    """Accounts up to a position of the ring: `written + overwritten + unwritten == position`.

    Attributes:
        position: cycles of the ring that are settled: on the disk, or counted as lost.
        written: cycles on the disk, in all files of this run.
        overwritten, unwritten: cycles lost because the ring went round, or because the disk did not take them.
    """

    position: int = 0
    written: int = 0
    overwritten: int = 0
    unwritten: int = 0

    @property
    def lost(self) -> int:
        """Cycles that are in no file."""
        return self.overwritten + self.unwritten


class ProgressFile:
    """The file that holds a `Progress`; made empty when it does not exist. Raises OSError."""

    def __init__(self, path: Path) -> None:
        with open(path, "a+b") as file:
            os.posix_fallocate(file.fileno(), 0, _LAYOUT.size)  # a full tmpfs refuses here, not by SIGBUS
            self._memory = mmap.mmap(file.fileno(), _LAYOUT.size)

    def load(self) -> Progress:
        """What was stored last."""
        return Progress._make(_LAYOUT.unpack_from(self._memory, 0))

    def store(self, progress: Progress) -> None:
        """Replace it."""
        self._memory[:] = _LAYOUT.pack(*progress)
