"""What is recorded of the cycles: messages of each cycle, the overview, events, diagnostics, and the account.

Records and times come in, sealed chunks go to the files (`daemon.recording.parts`) or to the flight recorder. It never
raises for a disk that fails.
"""

from __future__ import annotations

from typing import Protocol

from daemon.recording import schemas
from daemon.recording.chunk import SealedChunk
from daemon.recording.flight import FaultWatch
from daemon.recording.journal import ERROR, INFO, WARN, Journal
from daemon.recording.messages import JointStateMessage, cycle_block
from daemon.recording.progress import Account
from daemon.shared import cycle_record as cycle

OVERVIEW_PERIOD_NS = 20_000_000
"""/joint_states comes at 50 Hz."""
MAX_CHUNK_BYTES = 2_000_000
"""A backlog that is caught up at once still becomes chunks of bounded size."""

_SCAN = cycle.selection(
    ("cycle", "sync_monotonic_ns", "sync_realtime_ns", "flags", "missed", "sync_counter", "frame_count"),
    ("status",),
)


class Sink(Protocol):
    """Where sealed chunks go."""

    def write(self, chunk: SealedChunk, at_ns: int) -> None:
        """Take a chunk whose last cycle is of CLOCK_MONOTONIC `at_ns`; count its cycles as written or lost."""


class Recording:
    """One run of the loop on its way into files.

    Args:
        journal: with the builder of the chunks.
        sink: takes them.
        overview: makes /joint_states.
        chunk_ns: length of a chunk in recorded time [ns].
        account: of an earlier recorder of the same run, or a new one; shared with the sink.

    Attributes:
        fault: why a flight recording is wanted; empty for no reason. Whoever reads it empties it.
    """

    def __init__(
        self,
        journal: Journal,
        sink: Sink,
        overview: JointStateMessage,
        chunk_ns: int,
        account: Account,
    ) -> None:
        self.account = account
        self.journal = journal
        self.fault = ""
        self._builder = journal.builder
        self._sink = sink
        self._overview = overview
        self._chunk_ns = chunk_ns
        self._pending = 0
        self._chunk_end_ns: int | None = None
        self._newest_ns = 0
        self._overview_slot = -1
        self._statuses: tuple[int, int] | None = None
        self._faults = FaultWatch()
        self.missed: int | None = None
        """Slots missed as the newest cycle says; None before the first."""

    def add(self, record: bytes) -> None:
        """One cycle record. Costs about 3 us: this is the path of every cycle."""
        self.account.cycles += 1
        builder = self._builder
        index, monotonic, realtime, flags, missed, counter, count, status_1, status_2 = _SCAN.unpack_from(
            record
        )
        realtime = max(realtime, 0)
        builder.add_block(
            cycle_block(
                record,
                index,
                realtime,
                flags=flags,
                sync_counter=counter,
                frames=min(count, cycle.FRAME_CAPACITY),
            ),
            realtime,
        )
        self._pending += 1
        self._newest_ns = monotonic
        self.journal.newest = (index, realtime)
        statuses = (status_1, status_2)
        if statuses != self._statuses:
            self._status_events(statuses, monotonic)
        if missed != self.missed:
            self._missed_event(missed)
        slot = monotonic // OVERVIEW_PERIOD_NS
        if slot != self._overview_slot:
            self._overview_slot = slot
            builder.add(schemas.JOINT_STATES.number, realtime, self._overview.payload(record, realtime))
        if self._chunk_end_ns is None:
            self._chunk_end_ns = monotonic + self._chunk_ns
        elif monotonic >= self._chunk_end_ns or builder.pending >= MAX_CHUNK_BYTES:
            self.flush()

    @property
    def progress(self) -> Account:
        """What is settled: cycles that wait for the end of their chunk are not."""
        account = self.account
        settled = account.cycles - self._pending
        return Account(settled, account.written, account.overwritten, account.unwritten, account.let_go)

    def _status_events(self, statuses: tuple[int, int], monotonic: int) -> None:
        before, self._statuses = self._statuses, statuses
        self.fault = self._faults.changed(statuses, monotonic) or self.fault
        if before is None:
            return
        for joint in (1, 2):
            old, new = before[joint - 1], statuses[joint - 1]
            if old != new:
                names = [schemas.STATUS_NAMES.get(code, str(code)) for code in (old, new)]
                self.journal.note(
                    schemas.STATUS_CHANGED,
                    f"joint {joint}: {names[0]} -> {names[1]}",
                    level=INFO if new in (1, 2, 6) else WARN,
                    joint=joint,
                    change=(old, new),
                )

    def _missed_event(self, missed: int) -> None:
        before, self.missed = self.missed, missed
        if before is not None and missed > before:
            count = missed - before
            text = f"the loop missed {count} slots"
            self.journal.note(schemas.SLOTS_MISSED, text, level=WARN, count=count)

    def lose(self, count: int, time_ns: int) -> None:
        """Count cycles that the ring overwrote before they were read."""
        self.account.cycles += count
        self.account.overwritten += count
        text = f"{count} cycles overwritten before the recorder read them"
        self.journal.note(schemas.RECORDS_LOST, text, level=ERROR, time_ns=time_ns, count=count)

    def flush(self) -> None:
        """End the chunk and hand it on."""
        self.fault = self._faults.passed(self._newest_ns) or self.fault
        self._chunk_end_ns, self._pending = None, 0
        self.journal.new_chunk()
        chunk = self._builder.seal()
        if chunk is not None:
            self._sink.write(chunk, self._newest_ns)
