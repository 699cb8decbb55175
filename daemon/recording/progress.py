"""Account of recorded cycles in shared memory: another recorder can go on where one died, and losses are seen at once."""

from __future__ import annotations

import mmap
import os
import struct
from dataclasses import astuple, dataclass
from pathlib import Path

_LAYOUT = struct.Struct("<QQQQQ")


@dataclass
class Account:
    """Every cycle of the ring up to a position is written, lost, or let go: `written + lost + let_go == cycles`."""

    cycles: int = 0
    written: int = 0
    """On the disk, in all files of this run."""
    overwritten: int = 0
    """Lost because the ring went round before they were read."""
    unwritten: int = 0
    """Lost because the disk did not take them, or because somebody removed the file."""
    let_go: int = 0
    """Not written because nothing had happened (flight recorder only); those in its memory are among them."""

    @property
    def lost(self) -> int:
        """Cycles that are in no file."""
        return self.overwritten + self.unwritten


class ProgressFile:
    """The file that holds the `Account` of what is settled; made empty when it does not exist. Raises OSError."""

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
    """Return what was stored last, for those who only look; None where there is no such file, or it cannot be read."""
    try:
        return Account(*_LAYOUT.unpack_from(path.read_bytes()))
    except (OSError, struct.error):
        return None
