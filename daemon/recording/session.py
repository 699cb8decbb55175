"""Everything of one recording put together from its request: files or flight recorder, journal, diagnostics, repair."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from daemon.recording import schemas
from daemon.recording.chunk import ChunkBuilder
from daemon.recording.definitions import definitions
from daemon.recording.diagnostics import Diagnostics, RecorderState
from daemon.recording.flight import Flight
from daemon.recording.journal import INFO, WARN, Journal
from daemon.recording.mcap_file import Head
from daemon.recording.messages import BLOCK_PARTS, JointStateMessage, diagnostics
from daemon.recording.naming import free_run, own_files
from daemon.recording.parts import Parts, Rules
from daemon.recording.progress import Account
from daemon.recording.recording import Recording
from daemon.recording.request import RecorderRequest
from daemon.recording.space import MEGABYTE, sized
from daemon.shared.notices import NoticesError, NoticesReader
from daemon.shared.snapshot import SnapshotReader
from daemon.supervisor.children import Child, ChildError

_REPEAT_EVERY, _REPEAT_EVERY_IN_MEMORY = 60, 10
"""Chunks after which schemas and channels are repeated; a flight recording begins with any chunk."""
_QUANTILES = (0.5, 0.99, 1.0)


class Session:
    """One recorder's work, driven by `daemon.recording.recorder`.

    Args:
        request: what to do.
        account: of an earlier recorder of the same run, or a new one.
        say: takes one line for the operator.

    Raises:
        SnapshotError: the request names a snapshot that is none.
    """

    def __init__(self, request: RecorderRequest, account: Account, say: Callable[[str], None]) -> None:
        self._request = request
        self.account = account
        now_ns = time.time_ns()
        self.run = request.run or free_run(request.directory, request.prefix, now_ns)
        attachments, problems = request.load_attachments()
        for problem in problems:
            say(problem)
        self._say = say
        schema_records, channel_records = definitions(request.channel_metadata)
        head = Head(schema_records, channel_records, attachments)
        in_flight = request.flight_recorder_s is not None
        repeat = _REPEAT_EVERY_IN_MEMORY if in_flight else _REPEAT_EVERY
        builder = ChunkBuilder(schema_records, channel_records, BLOCK_PARTS, repeat)
        self.journal = Journal(builder, say)
        self.parts = Parts(_rules(request, self.run), head, self.journal, account)
        self._flight: Flight | None = None
        if request.flight_recorder_s is not None:
            self._flight = Flight(self.parts, self.journal, account, request.flight_recorder_s)
        overview = JointStateMessage(request.joint_names, request.gear_ratios)
        sink = self._flight or self.parts
        self.recording = Recording(self.journal, sink, overview, int(request.chunk_s * 1e9), account)
        self._snapshot = None if request.snapshot is None else SnapshotReader(request.snapshot)
        self._diagnostics = Diagnostics(request.bus, request.joint_names, request.nodes)
        self._notices: NoticesReader | None = None
        self._repair: Child | None = None
        self._repair_due = request.repair
        self.journal.note(schemas.RECORDER_STARTED, "recorder started", level=INFO, time_ns=now_ns)
        if self._flight is None:
            earlier = any(each.run == self.run for each in own_files(request.directory, request.prefix))
            self.parts.open("the recorder was started again" if earlier else "start")

    def save(self, why: str) -> None:
        """Write the flight recording; without a flight recorder: begin the next part, so that this one can be had."""
        self.recording.flush()
        if self._flight is None:
            self.parts.rotate(why)
        else:
            self._flight.save(why)

    def renew(self, request: RecorderRequest) -> None:
        """Other files are in force in the loop: they are attached to the part that begins now, and to all after it."""
        attachments, problems = request.load_attachments()
        for problem in problems:
            self._say(problem)
        self.recording.flush()
        self.parts.attach(attachments)
        if self._flight is None:
            self.parts.rotate("other files in force")

    def fault(self, why: str) -> None:
        """Something failed: a flight recorder saves."""
        if self._flight is not None:
            self.save(why)

    def look_round(self) -> None:
        """After each round of records: faults, notices of the supervisor, files left behind."""
        fault, self.recording.fault = self.recording.fault, ""
        if fault:
            self.fault(fault)
        self._read_notices()
        self._look_after_repair()

    def diagnose(self, backlog: int, cpu_percent: float) -> None:
        """The once-per-second /diagnostics."""
        now_ns = time.time_ns()
        parts, flight, request = self.parts, self._flight, self._request
        mode = "recording" if flight is None else "saving" if flight.saving else "in memory"
        state = RecorderState(
            mode="waiting" if parts.obstacle else mode,
            obstacle=parts.obstacle,
            backlog=backlog,
            cpu_percent=cpu_percent,
            events_left_out=self.journal.left_out,
            part=parts.part,
            part_bytes=parts.size,
            total_bytes=parts.total_size,
            free=parts.free_bytes,
            reserve=round(request.reserve_mb * MEGABYTE),
            budget=-1 if request.budget_mb is None else round(request.budget_mb * MEGABYTE),
            memory_bytes=0 if flight is None else flight.memory_bytes,
            memory_s=0.0 if flight is None else flight.memory_s,
        )
        snapshot = self._snapshot
        nothing = [float("nan")] * len(_QUANTILES)
        work = nothing if snapshot is None else snapshot.work_us(*_QUANTILES)
        late = nothing if snapshot is None else snapshot.late_us(*_QUANTILES)
        view = None if snapshot is None else snapshot.read()
        statuses = self._diagnostics.statuses(
            view, self.account, state, work_us=work, late_us=late, now_ns=now_ns
        )
        self.journal.builder.add(schemas.DIAGNOSTICS.number, now_ns, diagnostics(now_ns, statuses))

    def finish(self) -> dict[str, Any]:
        """End everything; what there is to say of it."""
        account = self.account
        text = f"recorder stopped: {account.cycles} cycles seen, {account.lost} lost"
        self.journal.note(schemas.RECORDER_STOPPED, text, level=INFO, time_ns=time.time_ns())
        self._read_notices()
        self.recording.flush()
        if self._flight is None:
            self.parts.end()
        else:
            self._flight.finish()
        if self._repair is not None:
            self._repair.process.kill()  # it may be interrupted anywhere, and goes on at the next start
            self._repair.process.wait()
        files = sized(
            [
                each
                for each in own_files(self._request.directory, self._request.prefix)
                if each.run == self.run
            ]
        )  # one that could not be ended among them
        paths = [each.file.path for each in files]
        return {
            "path": str(paths[-1]) if paths else None,
            "paths": [str(path) for path in paths],
            "run": self.run,
            "cycles": account.cycles,
            "written": account.written,
            "lost": account.lost,
            "lost_overwritten": account.overwritten,
            "lost_unwritten": account.unwritten,
            "let_go": account.let_go,
            "flight_recordings": None if self._flight is None else self._flight.saved,
            "bytes": sum(each.size for each in files),
        }

    def _read_notices(self) -> None:
        path = self._request.notices
        if self._notices is None:
            if path is None or not path.exists():
                return
            try:
                self._notices = NoticesReader(path)
            except NoticesError:
                return
        news, _ = self._notices.read()
        for notice in news:
            self.journal.note(
                schemas.NOTICE,
                notice.text,
                level=notice.level,
                time_ns=notice.realtime_ns,
                count=notice.node,
            )

    def _look_after_repair(self) -> None:
        """Start it once something has been recorded, and pass on what it says."""
        request = self._request
        if self._repair_due and self._has_begun():
            self._repair_due = False
            files = own_files(request.directory, request.prefix)
            current = self.parts.part if self.parts.is_open else 0
            if any(each.active and (each.run, each.part) != (self.run, current) for each in files):
                arguments = [str(request.directory), request.prefix]
                self._repair = Child("daemon.recording.leftovers", arguments, name="the repair")
        if self._repair is None:
            return
        ended = not self._repair.alive()
        try:
            answer = self._repair.poll_answer()
        except ChildError as error:
            answer = {"text": str(error), "lossy": True}
        if answer is not None:
            level = WARN if answer["lossy"] else INFO
            self.journal.tell(schemas.FILE_REPAIRED, str(answer["text"]), level=level)
        elif ended:
            self._repair = None

    def _has_begun(self) -> bool:
        """A chunk has been through; a repair delays nothing any more."""
        return self.account.written > 0 or self.account.let_go > 0 or bool(self.parts.obstacle)


def _rules(request: RecorderRequest, run: str) -> Rules:
    return Rules(
        directory=request.directory,
        prefix=request.prefix,
        run=run,
        rotate_ns=round(request.rotate_s * 1e9),
        rotate_bytes=round(request.rotate_mb * MEGABYTE),
        budget=None if request.budget_mb is None else round(request.budget_mb * MEGABYTE),
        keep_run=request.keep_run,
        reserve=round(request.reserve_mb * MEGABYTE),
    )
