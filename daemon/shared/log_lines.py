"""Lines about the bus, for the operator and for the log: one call says a line and puts it among the notices."""

from __future__ import annotations

import os
import sys
import time
from collections import deque
from collections.abc import Callable, Mapping
from math import inf
from typing import TextIO

from jtqd.daemon.shared.notices import ERROR as NOTICE_ERROR
from jtqd.daemon.shared.notices import INFO as NOTICE_INFO
from jtqd.daemon.shared.notices import WARNING as NOTICE_WARNING
from jtqd.daemon.shared.notices import Notices

# Few lines, however much happens: each kind of line once in a while, and not many lines together. Pure.


QUIET_S = 5.0
"""Between two lines of the same kind."""
_BURST = 6
"""Lines of all kinds within that time."""


class RateLimit:
    """Asked before a line is said; what it refuses it counts."""

    def __init__(self, quiet_s: float = QUIET_S, burst: int = _BURST) -> None:
        self._quiet_s, self._burst = quiet_s, burst
        self._not_before: dict[object, float] = {}
        self._said: deque[float] = deque(maxlen=burst)
        self._refused = 0

    def may_say(self, kind: object, now_s: float) -> int | None:
        """None: not now. Otherwise how many have been refused since the last line."""
        window = self._said[0] if len(self._said) == self._burst else -inf
        if now_s < self._not_before.get(kind, -inf) or now_s < window + self._quiet_s:
            self._refused += 1
            return None
        # Only kinds that were said are remembered, so the table is bounded by the burst.
        self._not_before = {each: until for each, until in self._not_before.items() if until > now_s}
        self._not_before[kind] = now_s + self._quiet_s
        self._said.append(now_s)
        refused, self._refused = self._refused, 0
        return refused


# Lines for the operator: on standard error, and in the journal with their priority.
#
# Under systemd standard error is the journal's (JOURNAL_STREAM): a line then begins with <N>, its priority as in sd-
# daemon(3) (`SyslogLevelPrefix=yes`), without the program's name, which the journal has. Each kind of line comes at most
# `BURST` times in `WINDOW_S`; the next one says how many were held back. Errors are never held back.


ERROR, WARNING, NOTICE, INFO = 3, 4, 5, 6
"""Priorities of syslog(3)."""
_PRIORITIES = {NOTICE_INFO: NOTICE, NOTICE_WARNING: WARNING, NOTICE_ERROR: ERROR}
"""Of the levels of a notice."""
BURST, WINDOW_S = 5, 30.0


def in_journal(stream: TextIO, environment: Mapping[str, str] = os.environ) -> bool:
    """True where `stream` goes to the journal itself: device and inode are those that JOURNAL_STREAM tells."""
    device, _, inode = environment.get("JOURNAL_STREAM", "").partition(":")
    if not (device.isdigit() and inode.isdigit()):
        return False
    try:
        found = os.fstat(stream.fileno())
    except (OSError, ValueError):
        return False
    return (found.st_dev, found.st_ino) == (int(device), int(inode))


class Say:
    """Says lines.

    Args:
        stream: where to; standard error by default.
        journal: with priorities; None: find out.
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
        self._said: dict[str, deque[float]] = {}
        self._held_back: dict[str, int] = {}

    def __call__(self, text: str, priority: int = INFO, kind: str = "") -> bool:
        """Say one line; False where it was held back. `kind`: lines that are limited together; "": never limited."""
        more = ""
        if kind and priority > ERROR:
            now = self._clock()
            said = self._said.setdefault(kind, deque(maxlen=BURST))
            if len(said) == BURST and now - said[0] < WINDOW_S:
                self._held_back[kind] = self._held_back.get(kind, 0) + 1
                return False
            said.append(now)
            count = self._held_back.pop(kind, 0)
            more = f" ({count} lines like this one were held back)" if count else ""
        for line in (text + more).splitlines():
            self._write(f"<{priority}>{line}" if self._journal else f"jtqd: {line}")
        return True

    def _write(self, line: str) -> None:
        try:
            print(line, file=self._stream or sys.stderr, flush=True)
        except OSError:  # whoever read it has gone; the loop goes on
            pass


class Teller:
    """Says lines. `notices` may be set later: before it, lines are only said."""

    def __init__(self, say: Say) -> None:
        self._say = say
        self.notices: Notices | None = None

    def __call__(self, topic: str, node: int, line: str, kind: str = "", level: int = NOTICE_WARNING) -> None:
        """One line; `topic`, `node` and `level` as in `notices.Notice`, `kind` as in `Say`."""
        self._say(line, _PRIORITIES[level], kind)
        if self.notices is not None:
            self.notices.add(level, topic, node, line)
