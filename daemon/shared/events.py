"""Events that the supervisor reports: lines for the operator, and notices in shared memory for the log's /events and /log.

Under systemd standard error is the journal's (JOURNAL_STREAM): a line then begins with <N>, its priority as in sd-daemon(3)
(`SyslogLevelPrefix=yes`), without the program's name, which the journal has.

The file `notices` of the runtime directory is a ring of the last `CAPACITY` notices with one writer (the supervisor) and
any number of readers; one that comes late gets the number of those it has missed. Layout: head 32 bytes (magic u64,
capacity u64, count of notices written u64, reserved), then slots of 256 bytes: number u64 (1.. ; written last, so that a
torn slot shows), realtime_ns i64, level u8, node u8, length of topic u8, length of text u8, topic 20 bytes, text 212 bytes
(UTF-8, cut to fit).
"""

from __future__ import annotations

import os
import struct
import sys
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from enum import IntEnum
from math import inf
from pathlib import Path
from typing import NamedTuple, TextIO

from jtqd.daemon.shared.runtime_dir import SharedMemoryError, mapped, new_memory

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


class Notice(NamedTuple):
    """One notice, numbered 1, 2, ... in the order of writing."""

    number: int
    realtime_ns: int
    level: int
    """INFO, WARNING or ERROR."""
    node: int
    """Node-ID that it is about; 0 for none (the bus, the daemon)."""
    topic: str
    """"boot", "heartbeat", "emcy", "bus", "pdo", "nmt", "sync", "input", "fault", "loop", "recorder" or "machine"."""
    text: str


class Notices:
    """Writer's side, with a new file; a reader of the old one goes on reading that."""

    def __init__(self, path: Path, capacity: int = CAPACITY) -> None:
        head = _HEAD.pack(_MAGIC, capacity, 0)
        self._memory = new_memory(path, _HEAD.size + capacity * _SLOT.size, head)
        self._capacity, self._count = capacity, 0

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
    """Reader's side; starts with the oldest notice. Raises SharedMemoryError: nothing there, or of another layout."""

    def __init__(self, path: Path) -> None:
        self._memory = mapped(path, "no notices")
        magic, self._capacity, _ = _HEAD.unpack(self._memory[: _HEAD.size].ljust(_HEAD.size, b"\0"))
        if magic != _MAGIC or len(self._memory) != _HEAD.size + self._capacity * _SLOT.size:
            raise SharedMemoryError(f"{path}: no notices of this version")
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
        name, line = topic[:topic_length], text[:text_length]
        return Notice(
            number, realtime_ns, level, node, name.decode(errors="replace"), line.decode(errors="replace")
        )


def _cut(text: str, size: int) -> bytes:
    """UTF-8 bytes of at most `size`, no character cut in two."""
    raw = text.encode(errors="replace")
    return raw if len(raw) <= size else raw[:size].decode(errors="ignore").encode()


# Lines for the operator -------------------------------------------------------------------------------------------------


class Priority(IntEnum):
    """Priorities of syslog(3)."""

    ERROR = 3
    WARNING = 4
    NOTICE = 5
    INFO = 6


BURST, WINDOW_S = 5, 30.0
"""Lines of one kind within that time; errors are not limited."""
QUIET_S = 5.0
"""Of a `RateLimit`: between two lines of the same kind."""
_BURST = 6
"""Of a `RateLimit`: lines of all kinds within that time."""
_PRIORITIES = {INFO: Priority.NOTICE, WARNING: Priority.WARNING, ERROR: Priority.ERROR}
"""Of the levels of a notice."""


def in_journal(stream: TextIO, environment: Mapping[str, str] = os.environ) -> bool:
    """Return whether `stream` is the journal: device and inode are those of JOURNAL_STREAM."""
    device, _, inode = environment.get("JOURNAL_STREAM", "").partition(":")
    if not (device.isdigit() and inode.isdigit()):
        return False
    try:
        found = os.fstat(stream.fileno())
    except (OSError, ValueError):
        return False
    return (found.st_dev, found.st_ino) == (int(device), int(inode))


class OperatorLog:
    """Write lines to `stream` (None: standard error), with priorities where it is the journal's or `journal` is True.

    Lines of one kind come at most `BURST` times in `WINDOW_S`; the next one gives the number of suppressed ones.
    """

    def __init__(
        self,
        stream: TextIO | None = None,
        *,
        journal: bool | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._stream, self._clock = stream, clock
        self._journal = in_journal(stream or sys.stderr) if journal is None else journal
        self._written: dict[str, deque[float]] = {}
        self._suppressed: dict[str, int] = {}

    def __call__(self, text: str, priority: int = Priority.INFO, kind: str = "") -> bool:
        """Write one line; False where it was suppressed. `kind`: lines that are limited together; "": never limited."""
        more = ""
        if kind and priority > Priority.ERROR:
            now = self._clock()
            written = self._written.setdefault(kind, deque(maxlen=BURST))
            if len(written) == BURST and now - written[0] < WINDOW_S:
                self._suppressed[kind] = self._suppressed.get(kind, 0) + 1
                return False
            written.append(now)
            count = self._suppressed.pop(kind, 0)
            lines = "similar line was" if count == 1 else "similar lines were"
            more = f" ({count} {lines} suppressed)" if count else ""
        for line in (text + more).splitlines():
            with suppress(OSError):  # its reader has gone; the loop goes on
                shown = f"<{int(priority)}>{line}" if self._journal else f"jtqd: {line}"
                print(shown, file=self._stream or sys.stderr, flush=True)
        return True


class EventLog:
    """Write lines to the operator and to the `notices`, once these are set, for the log's /events and /log."""

    def __init__(self, log: OperatorLog) -> None:
        self._log = log
        self.notices: Notices | None = None

    def __call__(self, topic: str, node: int, line: str, kind: str = "", level: int = WARNING) -> None:
        """Write one line; `topic`, `node` and `level` as in `Notice`, `kind` as in `OperatorLog`."""
        self._log(line, _PRIORITIES[level], kind)
        if self.notices is not None:
            self.notices.add(level, topic, node, line)


class RateLimit:
    """Admit each kind of line once in a while, and not many lines together; count what is refused. Pure."""

    def __init__(self, quiet_s: float = QUIET_S, burst: int = _BURST) -> None:
        self._quiet_s, self._burst = quiet_s, burst
        self._not_before: dict[object, float] = {}
        self._admitted: deque[float] = deque(maxlen=burst)
        self._refused = 0

    def admit(self, kind: object, now_s: float) -> int | None:
        """Return None if refused, otherwise the number of refused lines since the last one."""
        window = self._admitted[0] if len(self._admitted) == self._burst else -inf
        if now_s < self._not_before.get(kind, -inf) or now_s < window + self._quiet_s:
            self._refused += 1
            return None
        # Only kinds that were admitted are remembered, so the table is bounded by the burst.
        self._not_before = {each: until for each, until in self._not_before.items() if until > now_s}
        self._not_before[kind] = now_s + self._quiet_s
        self._admitted.append(now_s)
        refused, self._refused = self._refused, 0
        return refused
