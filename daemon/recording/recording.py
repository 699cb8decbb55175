"""Turns cycle records into spans of messages: each cycle, the 50 Hz overview, events, and the account of cycles.

Spans go to a sink: the files of the run, or the flight recorder (`jtqd.daemon.recording.parts`). Nothing raises for a disk
that fails.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from jtqd.daemon.recording import schemas
from jtqd.daemon.recording.mcap_file import ChunkBuilder, Span
from jtqd.daemon.recording.messages import CycleMessages, JointStateMessage, event, log
from jtqd.daemon.recording.run_files import Account
from jtqd.daemon.shared import cycle_record as cycle
from jtqd.estimator.status import DRIVE_FAULT, INVALID, STALE, STANDSTILL, STARTING, VALID

_NS = 1_000_000_000

# ---- events ----

INFO, WARN, ERROR = 20, 30, 40
_PER_SPAN = 50
"""A status that flaps every cycle must not fill the disk; what is left out is counted."""
_BOUNDED = (schemas.STATUS_CHANGED, schemas.SLOTS_MISSED, schemas.NOTICE)
_GOOD = (STARTING, VALID, STANDSTILL)
"""Statuses that a healthy joint goes through."""


class EventLog:
    """Makes a message on /events and one on /log of every occurrence.

    Args:
        add: takes channel, log time [ns] and payload of each message.
        warn: takes one line for the operator.

    Attributes:
        newest: index and CLOCK_REALTIME [ns] of the newest cycle.
        left_out: events beyond the number that a span may hold.
    """

    def __init__(self, add: Callable[[int, int, bytes], None], warn: Callable[[str], None] = print) -> None:
        self._add = add
        self.warn = warn
        self.newest = (0, 0)
        self.left_out = 0
        self._in_span = 0
        self.forget()

    def forget(self) -> None:
        """Take the next cycle as the first one: its status and missed slots are no change."""
        self._statuses: tuple[int, ...] | None = None
        self._missed: int | None = None

    def new_span(self) -> None:
        """Reset the number of events for a new span."""
        self._in_span = 0

    def note(
        self,
        kind: int,
        text: str,
        *,
        level: int,
        time_ns: int | None = None,
        count: int = 0,
        joint: int = 0,
        change: tuple[int, int] = (0, 0),
    ) -> None:
        """Write an event, and its text to /log; the time is the newest cycle's unless one is given."""
        self._in_span += 1
        if self._in_span > _PER_SPAN and kind in _BOUNDED:
            self.left_out += 1
            return
        index, newest = self.newest
        when = newest if time_ns is None else time_ns
        payload = event(when, kind, text, index=index, count=count, joint=joint, change=change)
        self._add(schemas.EVENTS.number, when, payload)
        self._add(schemas.LOG.number, when, log(when, level, text))

    def report(self, kind: int, text: str, *, level: int, count: int = 0) -> None:
        """Note an event and report its text to the operator."""
        self.warn(text)
        self.note(kind, text, level=level, count=count)

    def cycle(self, statuses: tuple[int, ...], missed: int) -> bool:
        """Note what differs from the cycle before; returns whether a status does."""
        before, self._statuses = self._statuses, statuses
        if statuses != before:
            for joint, (old, new) in enumerate(zip(before or statuses, statuses, strict=True), start=1):
                if old != new:
                    names = [schemas.STATUS_NAMES.get(code, str(code)) for code in (old, new)]
                    text = f"joint {joint}: {names[0]} -> {names[1]}"
                    level = INFO if new in _GOOD else WARN
                    self.note(schemas.STATUS_CHANGED, text, level=level, joint=joint, change=(old, new))
        if missed != self._missed:
            slots = missed - (missed if self._missed is None else self._missed)
            self._missed = missed
            if slots > 0:
                text = f"the loop missed {slots} {'slot' if slots == 1 else 'slots'}"
                self.note(schemas.SLOTS_MISSED, text, level=WARN, count=slots)
        return statuses != before


# ---- faults ----

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
                    why = f"joint {n + 1}: {schemas.STATUS_NAMES[new]}"
        return why

    def passed(self, at_ns: int) -> str:
        """Take the time; returns why to save, or nothing."""
        for n, since in enumerate(self._stale_since):
            if since is not None and at_ns - since > STALE_S * _NS:
                self._stale_since[n] = None
                return f"joint {n + 1}: STALE for more than {STALE_S:g} s"
        return ""


# ---- cycles ----

OVERVIEW_PERIOD_NS = 20_000_000
"""/joint_states comes at 50 Hz."""
MAX_SPAN_BYTES = 2_000_000
"""A backlog that is caught up at once still becomes spans of bounded size."""

SCANNED = (
    ("cycle", "sync_monotonic_ns", "sync_realtime_ns", "flags", "missed", "sync_counter", "frame_count"),
    ("status",),
)
"""Fields of header and joints that are looked at in every record."""


class Sink(Protocol):
    """Target of spans."""

    def write(self, span: Span, at_ns: int) -> None:
        """Take a span whose last cycle is of CLOCK_MONOTONIC `at_ns`; count its cycles as written or lost."""


class Recording:
    """One run of the loop on its way into files.

    Args:
        builder: of the spans.
        events: what happens becomes messages of the span.
        sink: takes the spans.
        overview: makes /joint_states; it knows the number of joints.
        chunk_ns: length of a span in recorded time [ns].
        account: of an earlier recorder of the same run, or a new one; shared with the sink.

    Attributes:
        fault: why a flight recording is wanted, until a reader empties it; empty for no reason.
    """

    def __init__(
        self,
        builder: ChunkBuilder,
        events: EventLog,
        sink: Sink,
        overview: JointStateMessage,
        *,
        chunk_ns: int,
        account: Account,
    ) -> None:
        self.account = account
        self.events = events
        self.fault = ""
        self._builder = builder
        self._sink = sink
        self._overview = overview
        self._chunk_ns = chunk_ns
        self._pending = 0
        self._chunk_end_ns: int | None = None
        self._newest_ns = 0
        self._overview_slot = -1
        self._faults = FaultTrigger(overview.joints)
        self._block = CycleMessages(overview.joints).block
        self._scan = cycle.selection(*SCANNED, overview.joints).unpack_from

    def add(self, record: bytes) -> None:
        """Take one cycle record. Costs about 3 us: this is the path of every cycle."""
        self.account.cycles += 1
        builder = self._builder
        index, monotonic, realtime, flags, missed, counter, count, *statuses = self._scan(record)
        realtime = max(realtime, 0)
        builder.add_block(
            self._block(record, index, realtime, flags=flags, sync_counter=counter, frames=count), realtime
        )
        self._pending += 1
        self._newest_ns = monotonic
        self.events.newest = (index, realtime)
        found = tuple(statuses)
        if self.events.cycle(found, missed):
            self.fault = self._faults.changed(found, monotonic) or self.fault
        slot = monotonic // OVERVIEW_PERIOD_NS
        if slot != self._overview_slot:
            self._overview_slot = slot
            builder.add(schemas.JOINT_STATES.number, realtime, self._overview.payload(record, realtime))
        if self._chunk_end_ns is None:
            self._chunk_end_ns = monotonic + self._chunk_ns
        elif monotonic >= self._chunk_end_ns or builder.pending >= MAX_SPAN_BYTES:
            self.flush()

    @property
    def progress(self) -> Account:
        """Return the account of completed spans; cycles of the open span are not included."""
        account = self.account
        settled = account.cycles - self._pending
        return Account(settled, account.written, account.overwritten, account.unwritten, account.let_go)

    def count_lost(self, count: int, time_ns: int) -> None:
        """Count cycles that the ring overwrote before they were read."""
        self.account.cycles += count
        self.account.overwritten += count
        text = f"{count} cycle{'' if count == 1 else 's'} overwritten before the recorder read them"
        self.events.note(schemas.RECORDS_LOST, text, level=ERROR, time_ns=time_ns, count=count)

    def flush(self) -> None:
        """End the span and hand it on."""
        self.fault = self._faults.passed(self._newest_ns) or self.fault
        self._chunk_end_ns, self._pending = None, 0
        self.events.new_span()
        span = self._builder.seal()
        if span is not None:
            self._sink.write(span, self._newest_ns)
