"""Lines for the operator: on standard error, and in the journal with their priority.

Under systemd standard error is the journal's (JOURNAL_STREAM): a line then begins with <N>, its priority as in sd-daemon(3)
(`SyslogLevelPrefix=yes`), without the program's name, which the journal has. Each kind of line comes at most `BURST` times
in `WINDOW_S`; the next one says how many were held back. Errors are never held back.
"""

from __future__ import annotations

import os
import sys
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import TextIO

ERROR, WARNING, NOTICE, INFO = 3, 4, 5, 6
"""Priorities of syslog(3)."""
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
