"""What is recorded of the cycles: messages of each cycle, the overview, events, diagnostics, and the account.

Pure but for the file it is given: records and times come in, messages go to `McapFile`. It never raises for a
disk that fails: the chunk is counted as not written, said once, and the next one is tried.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

from daemon import cycle_record as cycle
from daemon import mcap_schemas as schemas
from daemon.mcap_messages import JointStateMessage, cycle_block, diagnostics, event, log
from daemon.mcap_writer import McapFile
from daemon.recorder_progress import Account

OVERVIEW_PERIOD_NS = 20_000_000
"""/joint_states comes at 50 Hz."""
MAX_CHUNK_BYTES = 2_000_000
"""A backlog that is caught up at once still becomes chunks of bounded size."""
_EVENTS_PER_CHUNK = 50
"""A status that flaps every cycle must not fill the disk; what is left out is counted."""
INFO, WARN, ERROR = 20, 30, 40

_SCAN = cycle.selection(
    ("cycle", "sync_monotonic_ns", "sync_realtime_ns", "flags", "missed", "sync_counter", "frame_count"),
    ("status",),
)


class Recording:
    """One run of the loop on its way into one file.

    Args:
        file: None when it could not be created: everything is then counted as lost.
        overview: makes /joint_states.
        chunk_ns: length of a chunk in recorded time [ns].
        report: called with one line when writing fails, once for a row of failures.
        account: of an earlier recorder of the same run, None for a new one.
    """

    def __init__(
        self,
        file: McapFile | None,
        overview: JointStateMessage,
        chunk_ns: int,
        report: Callable[[str], None],
        account: Account | None = None,
    ) -> None:
        self.account = account or Account()
        self._file = file
        self._overview = overview
        self._chunk_ns = chunk_ns
        self._report = report
        self._pending = 0
        self._chunk_end_ns: int | None = None
        self._overview_slot = -1
        self._statuses: tuple[int, int] | None = None
        self._missed: int | None = None
        self._last = (0, 0)  # index and CLOCK_REALTIME of the newest cycle
        self._events_in_chunk = 0
        self.events_left_out = 0
        self.failing = False
        self._failed_cycles = 0

    def add(self, record: bytes) -> None:
        """One cycle record. Costs about 3 us: this is the path of every cycle."""
        self.account.cycles += 1
        file = self._file
        if file is None:
            self.account.unwritten += 1
            return
        index, monotonic, realtime, flags, missed, counter, count, status_1, status_2 = _SCAN.unpack_from(
            record
        )
        realtime = max(realtime, 0)
        file.add_block(
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
        self._last = (index, realtime)
        statuses = (status_1, status_2)
        if statuses != self._statuses:
            self._status_events(statuses)
        if missed != self._missed:
            self._missed_event(missed)
        slot = monotonic // OVERVIEW_PERIOD_NS
        if slot != self._overview_slot:
            self._overview_slot = slot
            file.add(schemas.JOINT_STATES.number, realtime, self._overview.payload(record, realtime))
        if self._chunk_end_ns is None:
            self._chunk_end_ns = monotonic + self._chunk_ns
        elif monotonic >= self._chunk_end_ns or file.pending >= MAX_CHUNK_BYTES:
            self.flush()

    @property
    def progress(self) -> Account:
        """What is settled: cycles that wait for the end of their chunk are not."""
        account = self.account
        settled = account.cycles - self._pending
        return Account(settled, account.written, account.overwritten, account.unwritten)

    def _status_events(self, statuses: tuple[int, int]) -> None:
        before, self._statuses = self._statuses, statuses
        if before is None:
            return
        for joint in (1, 2):
            old, new = before[joint - 1], statuses[joint - 1]
            if old != new:
                names = [schemas.STATUS_NAMES.get(code, str(code)) for code in (old, new)]
                self.note(
                    schemas.STATUS_CHANGED,
                    f"joint {joint}: {names[0]} -> {names[1]}",
                    level=INFO if new in (1, 2, 6) else WARN,
                    joint=joint,
                    change=(old, new),
                )

    def _missed_event(self, missed: int) -> None:
        before, self._missed = self._missed, missed
        if before is not None and missed > before:
            count = missed - before
            self.note(schemas.SLOTS_MISSED, f"the loop missed {count} slots", level=WARN, count=count)

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
        if self._file is None:
            return
        self._events_in_chunk += 1
        if self._events_in_chunk > _EVENTS_PER_CHUNK and kind in (
            schemas.STATUS_CHANGED,
            schemas.SLOTS_MISSED,
        ):
            self.events_left_out += 1
            return
        index, newest = self._last
        when = newest if time_ns is None else time_ns
        payload = event(when, kind, text, index=index, count=count, joint=joint, change=change)
        self._file.add(schemas.EVENTS.number, when, payload)
        self._file.add(schemas.LOG.number, when, log(when, level, text))

    def lose(self, count: int, time_ns: int) -> None:
        """Count cycles that the ring overwrote before they were read."""
        self.account.cycles += count
        self.account.overwritten += count
        text = f"{count} cycles overwritten before the recorder read them"
        self.note(schemas.RECORDS_LOST, text, level=ERROR, time_ns=time_ns, count=count)

    def diagnose(
        self, time_ns: int, backlog: int, cpu_percent: float, loop: Mapping[str, int] = MappingProxyType({})
    ) -> None:
        """Write the once-per-second /diagnostics; `loop` are the loop's own counters by name."""
        if self._file is None:
            return
        account, missed = self.account, self._missed or 0
        level, text = 0, "recording"
        if missed or self.events_left_out:
            level, text = 1, "the loop missed slots" if missed else "more events than are recorded"
        if account.lost:
            level, text = 2, "cycles were lost"
        values: dict[str, float] = {
            "recorder.backlog": backlog,
            "recorder.cycles": account.cycles,
            "recorder.written": account.written,
            "recorder.lost_overwritten": account.overwritten,
            "recorder.lost_unwritten": account.unwritten,
            "recorder.events_left_out": self.events_left_out,
            "recorder.bytes": self._file.size,
            "recorder.chunks": self._file.chunks,
            "recorder.cpu_percent": cpu_percent,
            "loop.cycle": self._last[0],
            **{f"loop.{name}": count for name, count in loop.items()},
            "loop.missed": missed,
        }
        self._file.add(schemas.DIAGNOSTICS.number, time_ns, diagnostics(time_ns, level, text, values))

    def flush(self) -> None:
        """Bring what has been added to the disk; what the disk does not take is counted."""
        if self._file is None:
            return
        pending, self._pending = self._pending, 0
        self._chunk_end_ns, self._events_in_chunk = None, 0
        try:
            self._file.flush()
        except OSError as error:
            self.account.unwritten += pending
            self._failed_cycles += pending
            if not self.failing:
                self._report(f"recording fails, cycles are being lost: {error.strerror or error}")
            self.failing = True
            return
        self.account.written += pending
        if self.failing:
            self.failing = False
            count, self._failed_cycles = self._failed_cycles, 0
            text = f"{count} cycles could not be written; recording goes on"
            self._report(text)
            self.note(schemas.WRITE_FAILED, text, level=ERROR, count=count)

    def finish(self) -> bool:
        """End the file. False when it has no summary or is not there any more."""
        self.flush()
        if self._file is None:
            return False
        try:
            removed = self._file.removed
            self._file.finish()
        except OSError as error:
            if not self.failing:
                self._report(f"the file could not be ended: {error.strerror or error}")
            removed = removed or isinstance(error, FileNotFoundError)
            complete = False
        else:
            complete = True
        if removed:
            self.account.unwritten += self.account.written
            self.account.written = 0
        return complete and not removed
