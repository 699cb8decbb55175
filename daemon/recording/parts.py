"""The files ("parts") of one run: rotation, disk budget, reserve, full disk; and the flight recorder in front of them.

A file that cannot go on is ended with its summary; its cycles from then on are counted as lost, the obstacle is reported
once, and another part is begun as soon as that is possible. Nothing here raises for a disk that fails.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from jtqd.daemon.recording.mcap_file import ChunkBuilder, Head, McapFile, NamedData, Span
from jtqd.daemon.recording.messages import ERROR, INFO, STATUS_NAMES, WARN, EventKind, EventLog
from jtqd.daemon.recording.run_files import (
    ACTIVE,
    MEGABYTE,
    Account,
    free_bytes,
    part_files,
    part_name,
    to_remove,
)
from jtqd.estimator.status import DRIVE_FAULT, INVALID, STALE

_RETRY_NS = 900_000_000
"""An attempt to begin a file costs little: at most this, and what was being collected, is lost when the disk is back."""
_ROOM_AGAIN = 1.25
"""Times the reserve: a disk at its limit must not begin a file every second."""


@dataclass(frozen=True)
class Rules:
    """Where the files go and how large they get; sizes in bytes, None for no budget."""

    directory: Path
    prefix: str
    run: str
    rotate_ns: int
    rotate_bytes: int
    budget: int | None
    keep_run: bool
    reserve: int


class Parts:
    """Writes spans, or counts their cycles as lost.

    Args:
        rules: of this run; kept as an attribute.
        head: beginning of every part.
        builder: of the spans: a part begins with the definitions, and may end with a span of its own.
        events: takes what must be noted.
        account: kept up to date.

    Attributes:
        part: number of the newest part; 0 before the first.
        obstacle: why nothing is being written; empty while a file is.
        all_ended: every part got its summary and its name.
    """

    def __init__(
        self, rules: Rules, head: Head, builder: ChunkBuilder, events: EventLog, account: Account
    ) -> None:
        self.rules = rules
        self._head = head
        self._builder = builder
        self._events = events
        self._account = account
        self._file: McapFile | None = None
        self.part = 0
        self._previous = ""
        self._began_ns: int | None = None
        self._cycles = 0
        self._others = 0
        self._over_budget = False
        self._now_ns, self._retry_ns = 0, 0
        self._missed = 0
        self.obstacle = ""
        self.all_ended = True

    @property
    def size(self) -> int:
        """Bytes of the file being written."""
        return 0 if self._file is None else self._file.size

    @property
    def total_size(self) -> int:
        """Bytes of all files of the prefix, as far as they were looked at."""
        return self._others + self.size

    @property
    def free_bytes(self) -> int:
        """Free space; -1 where it is unknown."""
        try:
            return free_bytes(self.rules.directory) if self._file is None else self._file.free_bytes
        except OSError:
            return -1

    @property
    def is_open(self) -> bool:
        """Return whether a file is open."""
        return self._file is not None

    # ---- begin and end ----

    def open(self, why: str) -> bool:
        """Begin the next part; if that fails, report it once and return False."""
        rules = self.rules
        try:
            if free_bytes(rules.directory) < rules.reserve * (_ROOM_AGAIN if self.obstacle else 1.0):
                return self._no_room()
            rules.directory.mkdir(parents=True, exist_ok=True)
            earlier = [each for each in part_files(rules.directory, rules.prefix) if each.run == rules.run]
            part = max([self.part, *(each.part for each in earlier)]) + 1
            name = part_name(rules.prefix, rules.run, part)
            previous = part_name(rules.prefix, rules.run, earlier[-1].part) if earlier else ""
            previous = self._previous or previous
            metadata = {"run": rules.run, "part": str(part), "previous": previous}
            metadata |= {"prefix": rules.prefix, "reason": why}
            path = rules.directory / (name + ACTIVE)
            self._file = McapFile(path, self._head, metadata, time.time_ns())
        except OSError as error:
            self._stop_for(f"cannot record to {rules.directory}: {error.strerror or error}")
            return False
        self.part, self._previous = part, name
        self._began_ns, self._cycles = self._now_ns or None, 0
        self._builder.restart()
        self._enforce_budget()
        return True

    def end(self) -> None:
        """End the part with its summary."""
        file, self._file = self._file, None
        if file is None:
            return
        if file.removed:
            self._gone(file)
            return
        if not file.chunks:
            file.abandon(remove=True)
            return
        try:
            file.finish(part_name(self.rules.prefix, self.rules.run, self.part))
        except OSError as error:
            self.all_ended = False
            self._events.warn(
                f"part {self.part} could not be ended and keeps its name {ACTIVE}: {error.strerror or error}"
            )

    def attach(self, attachments: Sequence[NamedData]) -> None:
        """Attach these files from the next part on."""
        self._head = self._head._replace(attachments=attachments)

    def rotate(self, why: str) -> None:
        """End the part and begin the next."""
        if self._file is not None and self._file.chunks:
            self.end()
            self.open(why)

    # ---- spans ----

    def write(self, span: Span, at_ns: int) -> None:
        """Write a span, or count its cycles as lost; `at_ns` is the CLOCK_MONOTONIC time of its last cycle."""
        self._now_ns = at_ns
        if self._file is None and not self._try_again():
            self._miss(span.cycles)
            return
        # A file that was removed, or must not grow: the next one may do.
        if not self._append(span) and not (
            self.open("the previous part could not be continued") and self._append(span)
        ):
            self._miss(span.cycles)
        file = self._file
        if file is None:
            return
        if self._began_ns is None:
            self._began_ns = at_ns
        budget = self.rules.budget
        if budget is not None and not self._over_budget and self._others + file.size > budget:
            self._enforce_budget()
        if 0 <= self.free_bytes < self.rules.reserve:
            self._no_room()
        elif at_ns - self._began_ns >= self.rules.rotate_ns:
            self.rotate("time")
        elif file.size >= self.rules.rotate_bytes:
            self.rotate("size")

    def _append(self, span: Span) -> bool:
        """Append a span; return False if it failed and the file was ended."""
        file = self._file
        assert file is not None
        try:
            file.append(span)
        except OSError as error:
            removed = file.removed
            self.end()
            if not removed:
                self._stop_for(f"recording fails: {error.strerror or error}")
            return False
        self._account.written += span.cycles
        self._cycles += span.cycles
        if self.obstacle:
            self._went_on()
        return True

    def _miss(self, cycles: int) -> None:
        self._account.unwritten += cycles
        self._missed += cycles

    def _gone(self, file: McapFile) -> None:
        """Handle a removed file: its cycles are lost."""
        file.abandon()
        count, self._cycles = self._cycles, 0
        self._account.written -= count
        self._account.unwritten += count
        text = f"part {self.part} was removed while it was being written: cycles lost with it: {count}"
        self._events.report(EventKind.FILE_REMOVED, text, level=ERROR, count=count)

    # ---- obstacles ----

    def _no_room(self) -> bool:
        """Handle a disk below the reserve. Always False."""
        free, reserve = self.free_bytes / MEGABYTE, self.rules.reserve / MEGABYTE
        text = (
            f"recording pauses: {free:.4g} MB are free in {self.rules.directory}, {reserve:.4g} MB stay free"
        )
        if not self.obstacle and self._file is not None:
            self._events.note(EventKind.SPACE_LOW, text, level=ERROR)
            last = self._builder.seal()
            with suppress(OSError):
                if last is not None:
                    self._file.append(last)
        self._stop_for(text)
        self.end()
        return False

    def _stop_for(self, obstacle: str) -> None:
        """Report an obstacle once, and wait a little before the next attempt."""
        if not self.obstacle:
            self._events.warn(f"{obstacle}; cycles are counted as lost until it continues")
        self.obstacle = obstacle
        self._retry_ns = self._now_ns + _RETRY_NS

    def _try_again(self) -> bool:
        if self.obstacle and self._now_ns < self._retry_ns:
            return False
        return self.open("recording continues" if self.part else "start")

    def _went_on(self) -> None:
        self.obstacle = ""
        count, self._missed = self._missed, 0
        text = f"recording continues in part {self.part}; cycles not written: {count}"
        self._events.report(EventKind.WRITE_FAILED, text, level=ERROR if count else WARN, count=count)

    # ---- budget ----

    def _enforce_budget(self) -> None:
        """Remove files to meet the budget, oldest first."""
        rules = self.rules
        active = part_name(rules.prefix, rules.run, self.part) + ACTIVE
        found = [each for each in part_files(rules.directory, rules.prefix) if each.path.name != active]
        if rules.budget is not None:
            for each in to_remove(found, rules.budget, self.size, rules.run, keep_run=rules.keep_run):
                try:
                    each.path.unlink()
                except OSError as error:
                    self._events.warn(f"{each.path} cannot be removed: {error.strerror}")
                    continue
                found.remove(each)
                text = f"removed {each.path.name}: budget of {rules.budget / MEGABYTE:g} MB"
                self._events.report(EventKind.FILE_RETIRED, text, level=INFO)
        self._others = sum(each.size for each in found)
        over = rules.budget is not None and self.total_size > rules.budget
        if over and not self._over_budget:
            text = "the budget is exceeded by files that are not removed; recording continues"
            self._events.report(EventKind.FILE_RETIRED, text, level=WARN)
        self._over_budget = over


# ---- flight recorder ----

STALE_S = 1.0


class FaultTrigger:
    """Trigger of the flight recorder by a joint's status, once per occurrence. Pure.

    joints: number of them.
    """

    def __init__(self, joints: int = 2) -> None:
        self._statuses = (0,) * joints
        self._stale_since: list[int | None] = [None] * joints

    def changed(self, statuses: tuple[int, ...], at_ns: int) -> str:
        """Take new statuses; returns why to save, or nothing."""
        before, self._statuses = self._statuses, statuses
        why = ""
        for n, (old, new) in enumerate(zip(before, statuses, strict=True)):
            if new != old:
                self._stale_since[n] = at_ns if new == STALE else None
                if new in (DRIVE_FAULT, INVALID):
                    why = f"joint {n + 1}: {STATUS_NAMES[new]}"
        return why

    def passed(self, at_ns: int) -> str:
        """Take the time; returns why to save, or nothing."""
        for n, since in enumerate(self._stale_since):
            if since is not None and at_ns - since > STALE_S * _NS:
                self._stale_since[n] = None
                return f"joint {n + 1}: STALE for more than {STALE_S:g} s"
        return ""


AFTER_S = 5.0
_NOTICED_S = 0.1
"""An occurrence is noticed within one poll of the recorder."""
_NS = 1_000_000_000


class FlightRecorder:
    """Flight recorder: keeps the last seconds in memory, as spans, and writes them on a trigger.

    Around an occurrence: everything that memory holds before it, and `AFTER_S` behind it; another occurrence in that time
    prolongs it. What falls out of memory unwritten counts as let go, and so does what memory holds.

    Occurrences: a joint becomes DRIVE_FAULT or INVALID, or is STALE for longer than `STALE_S` (`FaultTrigger`), the loop
    ends in an error, jtqd goes away without ending the recorder, or a request (SIGUSR1, `jtq control save`).

    Args:
        parts: writes the files.
        keep_s: how much memory holds.
    """

    def __init__(self, parts: Parts, events: EventLog, account: Account, keep_s: float) -> None:
        self._parts = parts
        self._events = events
        self._account = account
        self._keep_ns = round((keep_s + _NOTICED_S) * _NS)
        self._memory: deque[tuple[Span, int]] = deque()
        self._until_ns: int | None = None
        self._newest_ns = 0
        self.saved = 0
        """Recordings begun so far."""

    @property
    def saving(self) -> bool:
        """Return whether a file is being written."""
        return self._until_ns is not None

    @property
    def memory_bytes(self) -> int:
        """Bytes of the spans in memory."""
        return sum(span.size for span, _ in self._memory)

    @property
    def memory_s(self) -> float:
        """Recorded time in memory [s]."""
        return (self._memory[-1][1] - self._memory[0][1]) / _NS if self._memory else 0.0

    def write(self, span: Span, at_ns: int) -> None:
        """Keep a span in memory, or write it while saving."""
        self._newest_ns = max(self._newest_ns, at_ns)
        if self._until_ns is not None:
            self._parts.write(span, at_ns)
            if at_ns >= self._until_ns:
                self._until_ns = None
                self._parts.end()
            return
        self._memory.append((span, at_ns))
        self._account.let_go += span.cycles
        while self._memory[0][1] < at_ns - self._keep_ns:
            self._memory.popleft()

    def save(self, why: str) -> None:
        """Write what is in memory and what comes in the next `AFTER_S`."""
        begun, self._until_ns = self._until_ns is None, self._newest_ns + round(AFTER_S * _NS)
        if not begun:
            return
        self.saved += 1
        self._events.report(EventKind.FLIGHT_SAVED, f"flight recording: {why}", level=WARN)
        self._parts.open(why)
        while self._memory:
            span, at_ns = self._memory.popleft()
            self._account.let_go -= span.cycles
            self._parts.write(span, at_ns)

    def end(self) -> None:
        """End the file if one is being written."""
        self._until_ns = None
        self._parts.end()
