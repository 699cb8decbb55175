"""Events and lines of the supervisor in a bounded ring of memory: for the log's /events and /log.

One writer (the supervisor), any number of readers (recorder, `jtq` tools). The file `notices` of the runtime directory holds
the last `CAPACITY` notices; a reader that comes late gets the number of those it has missed, and nobody waits for anybody.

    notices = Notices(directory / FILE)                       # writer
    notices.add(WARNING, "heartbeat", 3, "node 3: no heartbeat for 0.3 s")

    reader = NoticesReader(directory / FILE)                  # raises NoticesError: no such file, another layout
    news, lost = reader.read()                                # notices since the last call, and how many were overwritten

Layout: head 32 bytes (magic u64, capacity u64, count of notices written u64, reserved), then slots of 256 bytes: number u64
(1.. ; written last, so that a torn slot shows), realtime_ns i64, level u8, node u8, length of topic u8, length of text u8,
topic 20 bytes, text 212 bytes (UTF-8, cut to fit).
"""

from __future__ import annotations

import mmap
import os
import struct
import time
from pathlib import Path
from typing import NamedTuple

FILE = "notices"
"""Name of the file in the runtime directory of a daemon."""
CAPACITY = 512
INFO, WARNING, ERROR = 20, 30, 40
"""Levels, as those of rcl_interfaces/Log and of Python's logging."""

_MAGIC = 0x4A54_5144_4E4F_5401  # "JTQDNOT", layout 1
_HEAD = struct.Struct("<QQQ8x")
_SLOT = struct.Struct("<QqBBBB20s212s4x")
_COUNT_OFFSET = 16
_WORD = struct.Struct("<Q")
_TOPIC_BYTES, _TEXT_BYTES = 20, 212


class NoticesError(Exception):
    """No notices of this layout at the path."""


class Notice(NamedTuple):
    """One notice.

    Attributes:
        number: 1, 2, ... in the order of writing.
        realtime_ns: CLOCK_REALTIME when it was written.
        level: INFO, WARNING or ERROR.
        node: node-ID that it is about; 0 for none (the bus, the daemon).
        topic: what kind: "boot", "heartbeat", "emcy", "bus", "pdo", "nmt", "sync", "input",
            "fault", "loop", "recorder", "machine" (`jtqd.daemon.shared.conditions`).
        text: one line for the operator.
    """

    number: int
    realtime_ns: int
    level: int
    node: int
    topic: str
    text: str


class Notices:
    """Writer's side. The file is made anew; a reader of the old one goes on reading that."""

    def __init__(self, path: Path, capacity: int = CAPACITY) -> None:
        temporary = path.with_name(path.name + ".new")
        size = _HEAD.size + capacity * _SLOT.size
        with open(temporary, "w+b") as file:
            os.fchmod(file.fileno(), 0o640)  # the daemon's group may look
            os.posix_fallocate(file.fileno(), 0, size)  # a full tmpfs refuses here, not by SIGBUS
            self._memory = mmap.mmap(file.fileno(), 0)
        self._capacity, self._count = capacity, 0
        _HEAD.pack_into(self._memory, 0, _MAGIC, capacity, 0)
        os.replace(temporary, path)

    def add(self, level: int, topic: str, node: int, text: str) -> None:
        """Write one; the oldest is overwritten. `topic` and `text` are cut to their room."""
        name, line = _cut(topic, _TOPIC_BYTES), _cut(text, _TEXT_BYTES)
        self._count += 1
        offset = _HEAD.size + (self._count - 1) % self._capacity * _SLOT.size
        _WORD.pack_into(self._memory, offset, 0)
        values = (time.time_ns(), level, node & 0xFF, len(name), len(line), name, line)
        _SLOT.pack_into(self._memory, offset, 0, *values)
        _WORD.pack_into(self._memory, offset, self._count)
        _WORD.pack_into(self._memory, _COUNT_OFFSET, self._count)


class NoticesReader:
    """Reader's side; starts with the oldest notice that is still there.

    Raises:
        NoticesError: nothing to read at the path, or of another layout.
    """

    def __init__(self, path: Path) -> None:
        try:
            with open(path, "rb") as file:
                self._memory = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        except (OSError, ValueError) as error:
            raise NoticesError(f"{path}: no notices: {error}") from None
        if len(self._memory) < _HEAD.size:
            raise NoticesError(f"{path}: no notices of this version")
        magic, self._capacity, _ = _HEAD.unpack_from(self._memory, 0)
        if magic != _MAGIC or len(self._memory) != _HEAD.size + self._capacity * _SLOT.size:
            raise NoticesError(f"{path}: no notices of this version")
        self._read = 0

    def read(self) -> tuple[list[Notice], int]:
        """Return (notices since the last call, number of notices overwritten before they could be read)."""
        news: list[Notice] = []
        (count,) = _WORD.unpack_from(self._memory, _COUNT_OFFSET)
        lost = max(0, count - self._capacity - self._read)
        for number in range(self._read + lost + 1, count + 1):
            notice = self._slot(number)
            if notice is None:
                lost += 1  # overwritten while we were reading
            else:
                news.append(notice)
        self._read = count
        return news, lost

    def _slot(self, number: int) -> Notice | None:
        offset = _HEAD.size + (number - 1) % self._capacity * _SLOT.size
        raw = self._memory[offset : offset + _SLOT.size]
        written, realtime_ns, level, node, topic_length, text_length, topic, text = _SLOT.unpack(raw)
        if written != number or _WORD.unpack_from(self._memory, offset)[0] != number:
            return None
        name, line = (
            topic[:topic_length].decode(errors="replace"),
            text[:text_length].decode(errors="replace"),
        )
        return Notice(number, realtime_ns, level, node, name, line)


def _cut(text: str, size: int) -> bytes:
    """UTF-8 bytes of at most `size`, no character cut in two."""
    raw = text.encode(errors="replace")
    return raw if len(raw) <= size else raw[:size].decode(errors="ignore").encode()
