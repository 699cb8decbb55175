"""The recorder process: `python -m jtqd.daemon.recording.recorder REQUEST.json` turns the ring of cycles into MCAP files.

It runs beside the loop and can only read what the loop leaves in shared memory, so that nothing it meets (a full disk, a
stop, a kill) reaches the loop. It ends on SIGTERM or when its parent has gone: it then reads on until the loop writes no
more, ends the file and prints one line of JSON on stdout. SIGUSR1: write the flight recording, or begin the next part;
SIGUSR2: the loop has failed; SIGHUP: the attachments of REQUEST.json have changed.

Exit status: 0 every cycle is in a file (or let go by the flight recorder), 1 shared memory is not there, 2 the request
is wrong, 3 cycles were lost or a file could not be ended.
"""

from __future__ import annotations

import base64
import json
import math
import os
import signal
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Protocol

from jtqd.daemon.recording import messages
from jtqd.daemon.recording.diagnostics import Diagnostics, Node
from jtqd.daemon.recording.mcap_file import ChunkBuilder, Head, NamedData, Span
from jtqd.daemon.recording.messages import (
    ERROR,
    INFO,
    SCANNED,
    WARN,
    CycleMessages,
    EventKind,
    EventLog,
    JointStateMessage,
    diagnostics,
    zeros_of,
)
from jtqd.daemon.recording.parts import FaultTrigger, FlightRecorder, Parts, Rules
from jtqd.daemon.recording.run_files import (
    MEGABYTE,
    RUN_PATTERN,
    Account,
    PartFile,
    ProgressFile,
    free_run,
    part_files,
)
from jtqd.daemon.shared import cycle_record as cycle
from jtqd.daemon.shared.cycle_record import MOST_JOINTS, RingReader, layout_of
from jtqd.daemon.shared.events import NoticesReader
from jtqd.daemon.shared.processes import Child, ChildError
from jtqd.daemon.shared.runtime_dir import SharedMemoryError
from jtqd.estimator.text import counted

_REPEAT_EVERY, _REPEAT_EVERY_IN_MEMORY = 60, 10
"""Spans after which schemas and channels are repeated; a flight recording begins with any span."""

# ---- the request ----

_SOURCES = {"path", "text", "base64"}
_PATHS = ("ring", "directory", "progress", "snapshot", "notices")
_LISTS = ("attachments", "joint_names", "gear_ratios")


class RequestError(ValueError):
    """The request cannot be used; the message is one line."""


@dataclass(frozen=True)
class RecorderRequest:
    """Paths and constants of one recording; megabytes are of 1 000 000 bytes. The supervisor writes it as JSON.

    Attributes:
        ring: file of the ring of cycle records (`jtqd.daemon.shared.cycle_record`).
        directory: where the MCAP files go; made when it does not exist.
        prefix: beginning of their names (`jtqd.daemon.recording.run_files`).
        run: name of the run; another recorder of the same run goes on with its numbers. None: a new one.
        chunk_s: length of a chunk [s]; a crash costs at most this and 0.1 s.
        rotate_s, rotate_mb, budget_mb, keep_run, reserve_mb, flight_recorder_s: see `jtqd.daemon.config`.
        wait_s: how long to wait for the ring to appear [s].
        repair: recover the unfinished files of earlier runs.
        attachments: each {"name", "media_type", and one of "path", "text" and "base64"}.
        progress: `ProgressFile`; an older recorder's account in it is carried on. None: none.
        snapshot: the loop's `jtqd.daemon.shared.snapshot`, for /diagnostics. None: without it.
        notices: the supervisor's `jtqd.daemon.shared.events`, for /events and /log. None: without them.
        bus: name of the bus, for /diagnostics.
        nodes: [node-ID, name] of those in /diagnostics.
        joint_names: of the joints, joint 1 first, for /joint_states; there are as many joints as names.
        gear_ratios: of the joints; null where not known.
        shadow: there are shadow methods.
    """

    ring: Path
    directory: Path
    prefix: str = "jtqd"
    run: str | None = None
    chunk_s: float = 0.5
    rotate_s: float = 600.0
    rotate_mb: float = 1000.0
    budget_mb: float | None = None
    keep_run: bool = True
    reserve_mb: float = 0.0
    flight_recorder_s: float | None = None
    wait_s: float = 10.0
    repair: bool = True
    attachments: tuple[dict[str, str], ...] = ()
    progress: Path | None = None
    snapshot: Path | None = None
    notices: Path | None = None
    bus: str = ""
    nodes: tuple[Node, ...] = ()
    joint_names: tuple[str, ...] = ("joint_1", "joint_2")
    gear_ratios: tuple[float | None, ...] = (None, None)
    shadow: bool = False

    def __post_init__(self) -> None:
        checks = [
            ("chunk_s", 0.01 <= self.chunk_s <= 60.0, "0.01 to 60 s"),
            ("prefix", self.prefix and "/" not in self.prefix, "the beginning of a file name"),
            ("run", self.run is None or RUN_PATTERN.fullmatch(self.run), "YYYYmmddTHHMMSSZ"),
        ]
        for key in ("rotate_s", "rotate_mb", "budget_mb", "reserve_mb", "flight_recorder_s"):
            value = getattr(self, key)
            checks.append((key, value is None or 0.0 <= value < math.inf, "a number from 0 on"))
        for key, good, expected in checks:
            if not good:
                raise RequestError(f"{key}: found {getattr(self, key)!r}, expected {expected}")
        if not 1 <= len(self.gear_ratios) == self.joints <= MOST_JOINTS:
            raise RequestError(f"joint_names and gear_ratios: expected 1 to {MOST_JOINTS}, as many of each")
        for ratio in self.gear_ratios:
            if ratio is not None and not (math.isfinite(ratio) and ratio != 0.0):
                raise RequestError(f"gear_ratios: found {ratio!r}, expected a number other than 0, or null")
        for item in self.attachments:
            if not isinstance(item, dict) or "name" not in item or len(_SOURCES & item.keys()) != 1:
                raise RequestError(f"attachment {item!r:.200}: expected a name and a path, a text or base64")

    @property
    def joints(self) -> int:
        """Return the number of joints."""
        return len(self.joint_names)

    @classmethod
    def from_file(cls, path: Path) -> RecorderRequest:
        """Read a request.

        Raises:
            RequestError: unreadable, not JSON, an unknown or missing key, a value of the wrong kind.
        """
        try:
            content: Any = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise RequestError(f"{path}: cannot be read as JSON: {error}") from None
        try:
            return cls._of(content)
        except RequestError as error:
            raise RequestError(f"{path}: {error}") from None
        except (TypeError, ValueError, KeyError, AttributeError) as error:
            raise RequestError(f"{path}: {type(error).__name__}: {error}") from None

    @classmethod
    def _of(cls, content: Any) -> RecorderRequest:
        if not isinstance(content, dict):
            raise RequestError("expected a mapping")
        unknown = content.keys() - {field.name for field in fields(cls)}
        if unknown:
            raise RequestError(f"unknown key {sorted(unknown)[0]!r}")
        for key in ("ring", "directory"):
            if not isinstance(content.get(key), str):
                raise RequestError(f"key {key!r}: expected a path")
        values = content | {key: Path(content[key]) for key in _PATHS if content.get(key) is not None}
        values |= {key: tuple(content[key]) for key in _LISTS if key in content}
        values["nodes"] = tuple(Node(int(number), str(name)) for number, name in content.get("nodes", ()))
        return cls(**values)

    def load_attachments(self, warn: Callable[[str], None]) -> list[NamedData]:
        """Return the attachments; one that cannot be read is a line for the operator, and does not end a recording."""
        loaded = []
        for item in self.attachments:
            try:
                if "base64" in item:
                    data = base64.b64decode(item["base64"], validate=True)
                else:
                    data = item["text"].encode() if "text" in item else Path(item["path"]).read_bytes()
            except OSError as error:
                warn(f"attachment {item['name']}: {error.strerror}: {item['path']}")
            except ValueError as error:
                warn(f"attachment {item['name']}: its base64: {error}")
            else:
                media_type = item.get("media_type", "application/octet-stream")
                loaded.append(NamedData(item["name"], media_type, data))
        return loaded

    def rules(self, run: str) -> Rules:
        """Return the rules of the files of this run."""
        return Rules(
            directory=self.directory,
            prefix=self.prefix,
            run=run,
            rotate_ns=round(self.rotate_s * 1e9),
            rotate_bytes=round(self.rotate_mb * MEGABYTE),
            budget=None if self.budget_mb is None else round(self.budget_mb * MEGABYTE),
            keep_run=self.keep_run,
            reserve=round(self.reserve_mb * MEGABYTE),
        )


# ---- cycles ----

OVERVIEW_PERIOD_NS = 20_000_000
"""/joint_states comes at 50 Hz."""
MAX_SPAN_BYTES = 2_000_000
"""A backlog that is caught up at once still becomes spans of bounded size."""


class Sink(Protocol):
    """Target of spans."""

    def write(self, span: Span, at_ns: int) -> None:
        """Take a span whose last cycle is of CLOCK_MONOTONIC `at_ns`; count its cycles as written or lost."""


class Recording:
    """Cycle records of one run of the loop on their way into spans: each cycle, the 50 Hz overview, events.

    Args:
        builder: of the spans.
        events: what happens becomes messages of the span.
        sink: takes the spans.
        overview: makes /joint_states; it knows the number of joints.
        shadow: there are shadow methods.
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
        shadow: bool = False,
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
        self._block = CycleMessages(overview.joints, shadow=shadow).block
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
            builder.add(messages.JOINT_STATES.number, realtime, self._overview.payload(record, realtime))
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
        text = f"{counted(count, 'cycle')} overwritten before the recorder read them"
        self.events.note(EventKind.RECORDS_LOST, text, level=ERROR, time_ns=time_ns, count=count)

    def flush(self) -> None:
        """End the span and hand it on."""
        self.fault = self._faults.passed(self._newest_ns) or self.fault
        self._chunk_end_ns, self._pending = None, 0
        self.events.new_span()
        span = self._builder.seal()
        if span is not None:
            self._sink.write(span, self._newest_ns)


# ---- one recording ----


class Session:
    """One recording, put together from its request: files or flight recorder, events, diagnostics, repair.

    Args:
        request: what to do.
        account: of an earlier recorder of the same run, or a new one.
        warn: takes one line for the operator.

    Raises:
        SharedMemoryError: the request names a snapshot that is none.
    """

    def __init__(self, request: RecorderRequest, account: Account, warn: Callable[[str], None]) -> None:
        self._request = request
        self._warn = warn
        self.account = account
        now_ns = time.time_ns()
        self.run = request.run or free_run(request.directory, request.prefix, now_ns)
        definitions, channels = messages.definitions(request.joints, shadow=request.shadow)
        parts = CycleMessages(request.joints, shadow=request.shadow).parts
        head = Head(definitions, channels, request.load_attachments(warn))
        keep_s = request.flight_recorder_s
        repeat = _REPEAT_EVERY if keep_s is None else _REPEAT_EVERY_IN_MEMORY
        self._builder = ChunkBuilder(definitions, channels, parts, repeat)
        self.events = EventLog(self._builder.add, warn)
        self.parts = Parts(request.rules(self.run), head, self._builder, self.events, account)
        self._flight = None if keep_s is None else FlightRecorder(self.parts, self.events, account, keep_s)
        self.recording = Recording(
            self._builder,
            self.events,
            self._flight or self.parts,
            JointStateMessage(request.joint_names, request.gear_ratios),
            chunk_ns=int(request.chunk_s * 1e9),
            account=account,
            shadow=request.shadow,
        )
        self._diagnostics = Diagnostics(request.snapshot, request.bus, request.joint_names, request.nodes)
        self._zeros_cycle = -1
        self._notices: NoticesReader | None = None
        self._repair: Child | None = None
        self._repair_due = request.repair
        self.events.note(EventKind.RECORDER_STARTED, "recorder started", level=INFO, time_ns=now_ns)
        if self._flight is None:
            self.parts.open("recorder restarted" if self._own_files() else "start")

    def save(self, why: str) -> None:
        """Write the flight recording; without a flight recorder begin the next part, so that this one is complete."""
        self.recording.flush()
        if self._flight is None:
            self.parts.rotate(why)
        else:
            self._flight.save(why)

    def renew(self, request: RecorderRequest) -> None:
        """Attach other files to the part that begins now, and to all after it."""
        attachments = request.load_attachments(self._warn)
        self.recording.flush()
        self.parts.attach(attachments)
        if self._flight is None:
            self.parts.rotate("new files in force")

    def fault(self, why: str) -> None:
        """Something failed: a flight recorder saves."""
        if self._flight is not None:
            self.save(why)

    def poll(self) -> None:
        """Handle, after each round of records, faults, notices of the supervisor and the repair of earlier files."""
        fault, self.recording.fault = self.recording.fault, ""
        if fault:
            self.fault(fault)
        self._read_notices()
        self._poll_repair()

    def diagnose(self, backlog: int, cpu_percent: float) -> None:
        """Write /diagnostics, once a second."""
        now_ns = time.time_ns()
        view, statuses = self._diagnostics.of_loop(now_ns)
        statuses += self._diagnostics.of_recorder(
            self.account,
            self.parts,
            self._flight,
            backlog=backlog,
            cpu_percent=cpu_percent,
            events_left_out=self.events.left_out,
        )
        self._builder.add(messages.DIAGNOSTICS.number, now_ns, diagnostics(now_ns, statuses))
        if view is not None and view.cycle != self._zeros_cycle:
            self._zeros_cycle = view.cycle
            for topic, message in zeros_of(view):
                self._builder.add(topic.number, now_ns, message)

    def finish(self) -> dict[str, Any]:
        """End everything; returns the summary of the run."""
        account, flight = self.account, self._flight
        text = f"recorder stopped: cycles {account.cycles}, lost {account.lost}"
        self.events.note(EventKind.RECORDER_STOPPED, text, level=INFO, time_ns=time.time_ns())
        self._read_notices()
        self.recording.flush()
        if flight is None:
            self.parts.end()
        else:
            flight.end()
        if self._repair is not None:
            self._repair.process.kill()  # it may be interrupted anywhere, and goes on at the next start
            self._repair.process.wait()
        own = self._own_files()  # one that could not be ended among them
        return {
            "path": str(own[-1].path) if own else None,
            "paths": [str(each.path) for each in own],
            "run": self.run,
            "cycles": account.cycles,
            "written": account.written,
            "lost": account.lost,
            "lost_overwritten": account.overwritten,
            "lost_unwritten": account.unwritten,
            "let_go": account.let_go,
            "flight_recordings": None if flight is None else flight.saved,
            "bytes": sum(each.size for each in own),
        }

    def _own_files(self) -> list[PartFile]:
        files = part_files(self._request.directory, self._request.prefix)
        return [each for each in files if each.run == self.run]

    def _read_notices(self) -> None:
        if self._notices is None and self._request.notices is not None:
            with suppress(SharedMemoryError):
                self._notices = NoticesReader(self._request.notices)
        if self._notices is None:
            return
        news, _ = self._notices.read()
        for each in news:
            self.events.note(
                EventKind.NOTICE, each.text, level=each.level, time_ns=each.realtime_ns, count=each.node
            )

    def _poll_repair(self) -> None:
        """Start the repair of earlier files once something has been recorded, and report its results."""
        request, account, parts = self._request, self.account, self.parts
        if self._repair_due and (account.written > 0 or account.let_go > 0 or parts.obstacle):
            self._repair_due = False
            files = part_files(request.directory, request.prefix)
            current = parts.part if parts.is_open else 0
            if any(each.active and (each.run, each.part) != (self.run, current) for each in files):
                arguments = [str(request.directory), request.prefix, str(parts.rules.reserve)]
                self._repair = Child("jtqd.daemon.logs.recover", arguments, name="the repair")
        if self._repair is None:
            return
        ended = not self._repair.alive()
        try:
            answer = self._repair.poll_answer()
        except ChildError as error:
            answer = {"text": str(error), "lossy": True}
        if answer is not None:
            level = WARN if answer["lossy"] else INFO
            self.events.report(EventKind.FILE_REPAIRED, str(answer["text"]), level=level)
        elif ended:
            self._repair = None


# ---- the process ----

POLL_S = 0.05
QUIET_S = 0.15
"""After the order to end: the loop is taken to have ended when it has written nothing for this long."""
DRAIN_LIMIT_S = 5.0
"""... and a loop that goes on all the same is left after this long."""
_NICE = 5


def _warn(text: str) -> None:
    with suppress(OSError):
        print(f"recorder: {text}", file=sys.stderr, flush=True)


class _Signals:
    """Requests by signals, or by the end of the parent."""

    def __init__(self) -> None:
        self._parent = os.getppid()
        self._received: set[int] = set()
        for number in (signal.SIGHUP, signal.SIGTERM, signal.SIGUSR1, signal.SIGUSR2):
            signal.signal(number, lambda number, _frame: self._received.add(number))
        # Ctrl-C reaches every process of the terminal; the supervisor ends the loop, then sends SIGTERM.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        # `launch.RecorderProcess` starts us with it blocked
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})

    def take(self, number: int) -> bool:
        """Return whether this signal came since the last call."""
        came = number in self._received
        self._received.discard(number)
        return came

    @property
    def orphaned(self) -> bool:
        return os.getppid() != self._parent

    @property
    def stop(self) -> bool:
        return signal.SIGTERM in self._received or self.orphaned


class Recorder:
    """The polling loop around one `Session`.

    Args:
        path: of the request; read again on SIGHUP.

    Raises:
        RequestError: the request is wrong.
        SharedMemoryError: no ring at that path within `wait_s`, or no snapshot at the path of the request.
        OSError: the file of the progress cannot be made.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        request = self._request = RecorderRequest.from_file(path)
        self._signals = _Signals()
        with suppress(OSError):
            os.nice(_NICE)
        self._reader = self._open_ring()
        self._progress = None if request.progress is None else ProgressFile(request.progress)
        account = Account() if self._progress is None else self._progress.load()
        self._session = Session(request, account, _warn)
        self._recording = self._session.recording

    def _open_ring(self) -> RingReader:
        deadline = time.monotonic() + self._request.wait_s
        size = layout_of(self._request.joints, self._request.shadow).size
        while True:
            try:
                return RingReader(self._request.ring, size)
            except SharedMemoryError:
                if time.monotonic() >= deadline or self._signals.stop:
                    raise
            time.sleep(POLL_S)

    def record(self) -> int:
        """Record one run; returns the exit status and prints the summary."""
        self._run()
        session = self._session
        summary = session.finish()
        self._settle()
        try:
            print(json.dumps(summary), flush=True)
        except OSError:  # its reader has gone, and the interpreter would report that at its end
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0 if session.parts.all_ended and not session.account.lost else 3

    def _run(self) -> None:
        """Record until an order to end, then until the loop is quiet."""
        settled = self._recording.account.cycles
        if self._reader.position > settled:
            self._recording.count_lost(self._reader.position - settled, time.time_ns())
        else:
            self._reader.position = settled
        now = time.monotonic()
        last_taken = last_flush = last_diagnosis = now
        cpu, asked = time.process_time(), None
        while True:
            backlog = self._reader.backlog
            taken = self._take()
            self._answer_signals()
            self._session.poll()
            now = time.monotonic()
            if taken:
                last_taken = now
            if asked is not None and (
                now - max(last_taken, asked) >= QUIET_S or now - asked >= DRAIN_LIMIT_S
            ):
                return
            if asked is None and self._signals.stop:
                asked = now
                if self._signals.orphaned:
                    self._session.fault("jtqd has ended")
            if now - last_diagnosis >= 1.0:
                used = time.process_time()
                percent = round(100.0 * (used - cpu) / (now - last_diagnosis), 2)
                self._session.diagnose(backlog, percent)
                last_diagnosis, cpu = now, used
            # Spans end by recorded time; this is for a loop that stands still.
            if taken:
                last_flush = now
            elif now - last_flush >= self._request.chunk_s:
                self._recording.flush()
                last_flush = now
            self._settle()
            time.sleep(POLL_S)

    def _take(self) -> int:
        """Take everything that is in the ring now; returns how many cycles that were."""
        taken = 0
        while True:
            batch = self._reader.read()
            if batch.lost:
                self._recording.count_lost(batch.lost, time.time_ns())
            for record in batch.records:
                self._recording.add(record)
            taken += batch.lost + len(batch.records)
            if not self._reader.backlog or not batch.records:
                return taken
            self._settle()

    def _answer_signals(self) -> None:
        signals = self._signals
        if signals.take(signal.SIGUSR2):
            self._session.fault("the loop failed")
        if signals.take(signal.SIGUSR1):
            self._session.save("on request")
        if signals.take(signal.SIGHUP):
            try:
                self._session.renew(RecorderRequest.from_file(self._path))
            except RequestError as error:
                _warn(str(error))

    def _settle(self) -> None:
        """Store how far the recording is."""
        if self._progress is not None:
            self._progress.store(self._recording.progress)


def main(arguments: list[str] | None = None) -> int:
    """Command line of the process."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if len(arguments) != 1 or arguments[0].startswith("-"):
        _warn("usage: python -m jtqd.daemon.recording.recorder REQUEST.json (see docs/logs.md)")
        return 2
    path = Path(arguments[0])
    try:
        return Recorder(path).record()
    except RequestError as error:
        _warn(str(error))
        return 2
    except SharedMemoryError as error:
        _warn(str(error))
        return 1
    except OSError as error:  # of the progress: files of the log have their own way
        _warn(f"{error.filename or path}: {error.strerror or error}")
        return 1


if __name__ == "__main__":
    sys.exit(main())
