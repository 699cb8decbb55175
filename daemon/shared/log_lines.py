"""Lines for the operator: on standard error or in the journal, and as events in the log; few of them, however much happens.

Under systemd standard error is the journal's (JOURNAL_STREAM): a line then begins with <N>, its priority as in sd-daemon(3)
(`SyslogLevelPrefix=yes`), without the program's name, which the journal has.
"""

from __future__ import annotations

import os
import sys
import time
from collections import deque
from collections.abc import Callable, Mapping
from math import inf
from typing import TextIO

from jtqd.daemon.shared import notices
from jtqd.daemon.shared.notices import Notices

ERROR, WARNING, NOTICE, INFO = 3, 4, 5, 6
"""Priorities of syslog(3)."""
BURST, WINDOW_S = 5, 30.0
"""Lines of one kind within that time; errors are never held back."""
QUIET_S = 5.0
"""Of a `RateLimit`: between two lines of the same kind."""
_BURST = 6
"""Of a `RateLimit`: lines of all kinds within that time."""
_PRIORITIES = {notices.INFO: NOTICE, notices.WARNING: WARNING, notices.ERROR: ERROR}
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
    """Write lines to standard error or the journal.

    Lines of one kind come at most `BURST` times in `WINDOW_S`; the next one says how many were held back.

    Args:
        stream: where to; standard error by default.
        journal: with priorities; None: where the stream is the journal's.
        clock: CLOCK_MONOTONIC [s].
    """

    def __init__(
        self,
        stream: TextIO | None = None,
        *,
        journal: bool | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._stream = stream
        self._journal = in_journal(stream or sys.stderr) if journal is None else journal
        self._clock = clock
        self._written: dict[str, deque[float]] = {}
        self._held_back: dict[str, int] = {}

    def __call__(self, text: str, priority: int = INFO, kind: str = "") -> bool:
        """Write one line; False where it was held back. `kind`: lines that are limited together; "": never limited."""
        more = ""
        if kind and priority > ERROR:
            now = self._clock()
            written = self._written.setdefault(kind, deque(maxlen=BURST))
            if len(written) == BURST and now - written[0] < WINDOW_S:
                self._held_back[kind] = self._held_back.get(kind, 0) + 1
                return False
            written.append(now)
            count = self._held_back.pop(kind, 0)
            lines = "similar line was" if count == 1 else "similar lines were"
            more = f" ({count} {lines} suppressed)" if count else ""
        for line in (text + more).splitlines():
            self._write(f"<{priority}>{line}" if self._journal else f"jtqd: {line}")
        return True

    def _write(self, line: str) -> None:
        try:
            print(line, file=self._stream or sys.stderr, flush=True)
        except OSError:  # whoever read it has gone; the loop goes on
            pass


class EventLog:
    """Write lines to the operator and to the notices, from which they get into the log's /events and /log.

    Attributes:
        notices: may be set later; before it, lines are only for the operator.
    """

    def __init__(self, log: OperatorLog) -> None:
        self._log = log
        self.notices: Notices | None = None

    def __call__(
        self, topic: str, node: int, line: str, kind: str = "", level: int = notices.WARNING
    ) -> None:
        """Write one line; `topic`, `node` and `level` as in `notices.Notice`, `kind` as in `OperatorLog`."""
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
