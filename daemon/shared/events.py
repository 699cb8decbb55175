"""Events that the supervisor reports: lines for the operator, and notices in shared memory for the log's /events and /log.

Under systemd standard error is the journal's (JOURNAL_STREAM): a line then begins with <N>, its priority as in sd-daemon(3)
(`SyslogLevelPrefix=yes`), without the program's name, which the journal has.

The file `notices` of the runtime directory is a ring of the last `CAPACITY` notices (`cycle_record.Ring`), written by the
supervisor: number u64 (1, 2, ..), realtime_ns i64, level u8, node u8, lengths of topic and text u8, topic 20 bytes, text 212
bytes (UTF-8, cut to fit), number u64.
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

from jtqd.daemon.shared.cycle_record import Ring, RingReader

FILE = "notices"
"""Name of the file in the runtime directory of a daemon."""
CAPACITY = 512
INFO, WARNING, ERROR = 20, 30, 40
"""Levels, as those of rcl_interfaces/Log and of Python's logging."""

_NOTICE = struct.Struct("<QqBBBB20s212s4xQ")
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
        # Of a ring's slots all but the one that is being written are sure.
        self._ring, self._count = Ring(path, capacity + 1, _NOTICE.size, 0o640), 0

    def add(self, level: int, topic: str, node: int, text: str) -> None:
        """Write one; the oldest is overwritten. `topic` and `text` are cut to their room."""
        name, line = _cut(topic, _TOPIC_BYTES), _cut(text, _TEXT_BYTES)
        self._count += 1
        values = (time.time_ns(), level, node & 0xFF, len(name), len(line), name, line)
        self._ring.append(_NOTICE.pack(self._count, *values, self._count))


class NoticesReader:
    """Reader's side; starts with the oldest notice. Raises SharedMemoryError: nothing there, or of another layout."""

    def __init__(self, path: Path) -> None:
        self._ring = RingReader(path, _NOTICE.size)

    def read(self) -> tuple[list[Notice], int]:
        """Return (notices since the last call, number of notices overwritten before they could be read)."""
        batch = self._ring.read()
        return [_notice(record) for record in batch.records], batch.lost


def _notice(record: bytes) -> Notice:
    number, realtime_ns, level, node, topic_length, text_length, topic, text, _ = _NOTICE.unpack(record)
    return Notice(
        number=number,
        realtime_ns=realtime_ns,
        level=level,
        node=node,
        topic=topic[:topic_length].decode(errors="replace"),
        text=text[:text_length].decode(errors="replace"),
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

    Lines of one kind come at most `BURST` times in `WINDOW_S`; the next one gives the number of suppressed ones. Events go
    to the `notices` as well, once these are set, for the log's /events and /log.
    """

    def __init__(
        self,
        stream: TextIO | None = None,
        *,
        journal: bool | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._stream, self._clock = stream, clock
        self.notices: Notices | None = None
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

    def event(self, topic: str, node: int, line: str, kind: str = "", level: int = WARNING) -> None:
        """Write one line and notice; `topic`, `node` and `level` as in `Notice`."""
        self(line, _PRIORITIES[level], kind)
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
