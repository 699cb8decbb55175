"""Flight recorder: the last seconds stay in memory, compressed, and go to a file when something happens.

Around an occurrence: everything that memory holds before it, and `AFTER_S` behind it; another occurrence in that time
prolongs it. What falls out of memory unwritten counts as let go, and so does what memory holds.

Occurrences: a joint becomes DRIVE_FAULT or INVALID, a joint is STALE for longer than `STALE_S`, the loop ends in an error,
jtqd goes away without ending the recorder, or somebody asks (SIGUSR1, `jtq control save`).
"""

from __future__ import annotations

from collections import deque

from daemon.recording import schemas
from daemon.recording.chunk import SealedChunk
from daemon.recording.journal import WARN, Journal
from daemon.recording.parts import Parts
from daemon.recording.progress import Account

AFTER_S = 5.0
_NOTICED_S = 0.1
"""An occurrence is noticed within one poll of the recorder."""
STALE_S = 1.0
_NS = 1_000_000_000
_AT_ONCE = [code for code, name in schemas.STATUS_NAMES.items() if name in ("DRIVE_FAULT", "INVALID")]
_STALE = next(code for code, name in schemas.STATUS_NAMES.items() if name == "STALE")


class FaultWatch:
    """Says when a joint's status is worth a recording: once when it begins. Pure."""

    def __init__(self) -> None:
        self._statuses = (0, 0)
        self._stale_since: list[int | None] = [None, None]

    def changed(self, statuses: tuple[int, int], at_ns: int) -> str:
        """The statuses are new; why to save, or nothing."""
        before, self._statuses = self._statuses, statuses
        why = ""
        for n, (old, new) in enumerate(zip(before, statuses, strict=True)):
            if new != old:
                self._stale_since[n] = at_ns if new == _STALE else None
                if new in _AT_ONCE:
                    why = f"joint {n + 1}: {schemas.STATUS_NAMES[new]}"
        return why

    def passed(self, at_ns: int) -> str:
        """It is that late; why to save, or nothing."""
        for n, since in enumerate(self._stale_since):
            if since is not None and at_ns - since > STALE_S * _NS:
                self._stale_since[n] = None
                return f"joint {n + 1}: STALE for more than {STALE_S:g} s"
        return ""


class Flight:
    """Takes sealed chunks as `Parts` does, and hands them on around an occurrence only.

    Args:
        parts: writes the files.
        keep_s: how much memory holds.
    """

    def __init__(self, parts: Parts, journal: Journal, account: Account, keep_s: float) -> None:
        self._parts = parts
        self._journal = journal
        self._account = account
        self._keep_ns = round((keep_s + _NOTICED_S) * _NS)
        self._memory: deque[tuple[SealedChunk, int]] = deque()
        self._until_ns: int | None = None
        self._newest_ns = 0
        self.saved = 0
        """Recordings begun so far."""

    @property
    def saving(self) -> bool:
        """A file is being written."""
        return self._until_ns is not None

    @property
    def memory_bytes(self) -> int:
        """Bytes of the chunks in memory."""
        return sum(len(chunk.data) for chunk, _ in self._memory)

    @property
    def memory_s(self) -> float:
        """Recorded time in memory [s]."""
        return (self._memory[-1][1] - self._memory[0][1]) / _NS if self._memory else 0.0

    def write(self, chunk: SealedChunk, at_ns: int) -> None:
        """Keep a chunk, or have it on the disk while saving."""
        self._newest_ns = max(self._newest_ns, at_ns)
        if self._until_ns is not None:
            self._parts.write(chunk, at_ns)
            if at_ns >= self._until_ns:
                self._until_ns = None
                self._parts.end()
            return
        self._memory.append((chunk, at_ns))
        self._account.let_go += chunk.cycles
        while self._memory[0][1] < at_ns - self._keep_ns:
            self._memory.popleft()

    def save(self, why: str) -> None:
        """Write what is in memory and what comes in the next `AFTER_S`."""
        begun, self._until_ns = self._until_ns is None, self._newest_ns + round(AFTER_S * _NS)
        if not begun:
            return
        self.saved += 1
        self._journal.tell(schemas.FLIGHT_SAVED, f"flight recording: {why}", level=WARN)
        self._parts.open(why)
        while self._memory:
            chunk, at_ns = self._memory.popleft()
            self._account.let_go -= chunk.cycles
            self._parts.write(chunk, at_ns)

    def finish(self) -> None:
        """End the file if one is being written."""
        self._until_ns = None
        self._parts.end()
