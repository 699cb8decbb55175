"""Ring of fixed-size records in shared memory: one writer that never waits, a reader that learns its losses.

The file holds a header page and `slots` records. The writer fills the slot of record `n` and then stores
`n + 1` as the count; it overwrites the oldest record when the reader is slow or gone. The reader copies what
lies between its own position and the count, reads the count again, and drops (and counts) whatever may have
been overwritten meanwhile.

Each record begins and ends with its index, 8 bytes, larger from record to record. Where stores become visible
out of order (ARM) the count can be seen before the record: a copy whose two ends differ is torn, and one
whose index is not larger than the last is what lay in the slot a lap ago. Both are dropped and counted.
"""

from __future__ import annotations

import mmap
import os
import struct
from pathlib import Path
from typing import NamedTuple

_MAGIC = 0x4A54_5144_5249_4E47  # "JTQDRING"
_HEADER_SIZE = 4096
COUNT_WORD = 8
"""64-bit word of the count, on a cache line of its own: the reader polls it while records are written."""
_LAYOUT = struct.Struct("<QQQ")


class RingError(Exception):
    """The file is not a ring of this layout."""


class Ring:
    """Writer's side: memory that the loop fills (`daemon/core/record.pyx`).

    Args:
        path: new file on a tmpfs; an older one is replaced, and its reader keeps the old memory.
        slots: number of records kept.
        record_size: bytes of one record.

    Attributes:
        words: 64-bit words of the header page.
        records: memory of all records.
        size: number of records kept.
    """

    def __init__(self, path: Path, slots: int, record_size: int) -> None:
        self._memory = _created(path, slots, record_size)
        view = memoryview(self._memory)
        # One 8-byte store. `struct.pack_into` writes zeros first: the reader would at times see a count of 0.
        self.words = view[:_HEADER_SIZE].cast("Q")
        self.records = view[_HEADER_SIZE:]
        self.size = slots


def _created(path: Path, slots: int, record_size: int) -> mmap.mmap:
    temporary = path.with_name(path.name + ".new")
    with open(temporary, "w+b") as file:
        os.fchmod(file.fileno(), 0o600)
        # A full tmpfs refuses here, and not by SIGBUS in the middle of a cycle.
        os.posix_fallocate(file.fileno(), 0, _HEADER_SIZE + slots * record_size)
        memory = mmap.mmap(file.fileno(), 0)
    _LAYOUT.pack_into(memory, 0, _MAGIC, slots, record_size)
    os.replace(temporary, path)
    return memory


class Batch(NamedTuple):
    """Result of one `RingReader.read`: whole records in order, and the number overwritten unread."""

    records: list[bytes]
    lost: int


class RingReader:
    """Reader's side; starts at the oldest record still there.

    Raises:
        RingError: the file is no ring, or of another record size.
    """

    def __init__(self, path: Path, record_size: int) -> None:
        try:
            with open(path, "rb") as file:
                self._memory = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        except (OSError, ValueError) as error:
            raise RingError(f"{path}: cannot be read as a ring of cycles: {error}") from None
        magic, slots, size = (
            _LAYOUT.unpack_from(self._memory, 0) if len(self._memory) >= _HEADER_SIZE else (0, 0, 0)
        )
        if magic != _MAGIC or size != record_size or len(self._memory) != _HEADER_SIZE + slots * size:
            raise RingError(f"{path}: not a ring of {record_size}-byte records (found record size {size})")
        self._words = memoryview(self._memory)[:_HEADER_SIZE].cast("Q")
        self._slots = slots
        self._record_size = record_size
        self._newest = -1
        self.position: int = max(0, self._count() - slots)

    def _count(self) -> int:
        return self._words[COUNT_WORD]

    @property
    def backlog(self) -> int:
        """Return the number of records written and not yet read."""
        return self._count() - self.position

    def read(self, limit: int = 1024) -> Batch:
        """Copy at most `limit` records; count those that were overwritten before they could be copied."""
        count = self._count()
        lost = max(0, count - self._slots - self.position)
        self.position += lost
        first, last = self.position, min(count, self.position + limit)
        size, memory = self._record_size, self._memory
        copies = []
        for n in range(first, last):
            offset = _HEADER_SIZE + (n % self._slots) * size
            copies.append(memory[offset : offset + size])
        # The writer may be filling slot `count % slots` right now: that record is overwritten too.
        overwritten = min(len(copies), max(0, self._count() + 1 - self._slots - first))
        good, newest = [], self._newest
        for record in copies[overwritten:]:
            index = int.from_bytes(record[:8], "little")
            if record[:8] == record[-8:] and index > newest:
                good.append(record)
                newest = index
        self._newest = newest
        self.position = last
        return Batch(good, lost + len(copies) - len(good))
