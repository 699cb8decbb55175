"""The recorder process: `python -m daemon.recorder REQUEST.json` turns the ring of cycles into one MCAP file.

It runs beside the loop and can only read what the loop leaves in shared memory, so that nothing it meets (a
full disk, a stop, a kill) reaches the loop. It ends on SIGTERM or when its parent has gone: it then reads on
until the loop writes no more, ends the file and prints one line of JSON on stdout.

Exit status: 0 every cycle is in the file, 1 there is no ring, 2 the request is wrong, 3 cycles were lost or
the file could not be ended.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from contextlib import suppress
from pathlib import Path

from mcap.records import Channel, Schema

from daemon import cycle_record
from daemon import mcap_schemas as schemas
from daemon.mcap_messages import BLOCK_PARTS, JointStateMessage
from daemon.mcap_writer import McapFile
from daemon.recorder_progress import Account, ProgressFile
from daemon.recorder_request import RecorderRequest, RequestError
from daemon.recording import INFO, Recording
from daemon.ring import RingError, RingReader
from daemon.snapshot import SnapshotError, SnapshotReader

POLL_S = 0.05
QUIET_S = 0.15
"""After the order to end: the loop is taken to have ended when it has written nothing for this long."""
DRAIN_LIMIT_S = 5.0
"""... and a loop that goes on all the same is left after this long."""
_NICE = 5


def _say(text: str) -> None:
    with suppress(OSError):
        print(f"recorder: {text}", file=sys.stderr, flush=True)


def definitions(metadata: dict[str, dict[str, str]] | None) -> tuple[list[Schema], list[Channel]]:
    """Schema and channel records of every topic; `metadata` adds to a topic's own."""
    numbers = {name: number for number, name in enumerate(schemas.SCHEMAS, start=1)}
    channels = [
        Channel(
            id=topic.number,
            topic=topic.name,
            message_encoding="cdr",
            metadata={str(key): str(text) for key, text in (metadata or {}).get(topic.name, {}).items()},
            schema_id=numbers[topic.schema],
        )
        for topic in schemas.TOPICS
    ]
    return [
        Schema(id=numbers[name], name=name, encoding="ros2msg", data=text.encode())
        for name, text in schemas.SCHEMAS.items()
    ], channels


def _sync_directory(directory: Path) -> None:
    """Have a new or changed name on the disk, where the file system can do that."""
    with suppress(OSError):
        descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _open_file(request: RecorderRequest, time_ns: int) -> tuple[McapFile | None, Path]:
    """A new file under a free name; None, said on stderr, where that is not possible."""
    stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime(time_ns // 1_000_000_000))
    attachments, problems = request.load_attachments()
    for problem in problems:
        _say(problem)
    schema_records, channel_records = definitions(request.channel_metadata)
    final = request.directory / f"{request.prefix}-{stamp}.mcap"
    try:
        request.directory.mkdir(parents=True, exist_ok=True)
        for number in range(2, 1000):
            active = final.with_name(final.name + ".active")
            if not final.exists() and not active.exists():
                break
            final = request.directory / f"{request.prefix}-{stamp}-{number}.mcap"
        file = McapFile(
            active,
            schemas=schema_records,
            channels=channel_records,
            attachments=attachments,
            block_parts=BLOCK_PARTS,
            time_ns=time_ns,
        )
    except OSError as error:
        _say(f"cannot record to {request.directory}: {error.strerror}")
        return None, final
    _sync_directory(request.directory)
    return file, final


class _Stop:
    """SIGTERM came, or the parent has gone."""

    def __init__(self) -> None:
        self._parent = os.getppid()
        self._signalled = False
        signal.signal(signal.SIGTERM, self._on_signal)
        # Ctrl-C reaches every process of the terminal; the supervisor ends the loop, then sends SIGTERM.
        signal.signal(signal.SIGINT, signal.SIG_IGN)

    def _on_signal(self, _number: int, _frame: object) -> None:
        self._signalled = True

    @property
    def requested(self) -> bool:
        return self._signalled or os.getppid() != self._parent


def _open_ring(request: RecorderRequest, stop: _Stop) -> RingReader:
    deadline = time.monotonic() + request.wait_s
    while True:
        try:
            return RingReader(request.ring, cycle_record.RECORD_SIZE)
        except RingError:
            if time.monotonic() >= deadline or stop.requested:
                raise
        time.sleep(POLL_S)


class Recorder:
    """The polling loop around one `Recording`."""

    def __init__(  # noqa: PLR0917 - what it stands between
        self,
        reader: RingReader,
        recording: Recording,
        chunk_s: float,
        stop: _Stop,
        progress: ProgressFile | None,
        snapshot: SnapshotReader | None,
    ) -> None:
        self._reader = reader
        self._progress = progress
        self._snapshot = snapshot
        self._recording = recording
        self._chunk_s = chunk_s
        self._stop = stop

    def _take(self) -> int:
        """Everything that is in the ring now; returns how many cycles that were."""
        taken = 0
        while True:
            batch = self._reader.read()
            if batch.lost:
                self._recording.lose(batch.lost, time.time_ns())
            for record in batch.records:
                self._recording.add(record)
            taken += batch.lost + len(batch.records)
            if not self._reader.backlog or not batch.records:
                return taken

    def run(self) -> None:
        """Record until told to end, then until the loop is quiet."""
        settled = self._recording.account.cycles
        if self._reader.position > settled:
            self._recording.lose(self._reader.position - settled, time.time_ns())
        else:
            self._reader.position = settled
        now = time.monotonic()
        last_taken = last_flush = last_diagnosis = now
        cpu, asked = time.process_time(), None
        while True:
            backlog = self._reader.backlog
            taken = self._take()
            now = time.monotonic()
            if taken:
                last_taken = now
            if asked is not None and (
                now - max(last_taken, asked) >= QUIET_S or now - asked >= DRAIN_LIMIT_S
            ):
                return
            if asked is None and self._stop.requested:
                asked = now
            if now - last_diagnosis >= 1.0:
                used = time.process_time()
                percent = round(100.0 * (used - cpu) / (now - last_diagnosis), 2)
                counters = {} if self._snapshot is None else self._snapshot.read().counters
                self._recording.diagnose(time.time_ns(), backlog, percent, counters)
                last_diagnosis, cpu = now, used
            # Chunks end by recorded time; this is for a loop that stands still.
            if taken:
                last_flush = now
            elif now - last_flush >= self._chunk_s:
                self._recording.flush()
                last_flush = now
            self.settle()
            time.sleep(POLL_S)

    def settle(self) -> None:
        """Leave word of how far we are."""
        if self._progress is not None:
            self._progress.store(self._recording.progress)


def record(request: RecorderRequest) -> int:
    """Record one run; returns the exit status and prints the summary.

    Raises:
        RingError: no ring at that path within `wait_s`.
    """
    stop = _Stop()
    with suppress(OSError):
        os.nice(_NICE)
    reader = _open_ring(request, stop)
    started = time.time_ns()
    file, final = _open_file(request, started)
    overview = JointStateMessage(request.joint_names, request.gear_ratios)
    progress = None if request.progress is None else ProgressFile(request.progress)
    account = Account() if progress is None else progress.load()
    recording = Recording(file, overview, int(request.chunk_s * 1e9), _say, account)
    recording.note(schemas.RECORDER_STARTED, "recorder started", level=INFO, time_ns=started)
    snapshot = None if request.snapshot is None else SnapshotReader(request.snapshot)
    recorder = Recorder(reader, recording, request.chunk_s, stop, progress, snapshot)
    recorder.run()
    text = f"recorder stopped: {account.cycles} cycles seen, {account.lost} lost"
    recording.note(schemas.RECORDER_STOPPED, text, level=INFO, time_ns=time.time_ns())
    complete = recording.finish()
    recorder.settle()
    active = final.with_name(final.name + ".active")
    path: Path | None = active if active.exists() else None
    if complete:
        try:
            active.rename(final)
            path = final
            _sync_directory(request.directory)
        except OSError as error:
            _say(f"{active} keeps its name: {error.strerror}")
            complete = False
    summary = {
        "path": None if path is None else str(path),
        "cycles": account.cycles,
        "written": account.written,
        "lost": account.lost,
        "lost_overwritten": account.overwritten,
        "lost_unwritten": account.unwritten,
        "bytes": 0 if path is None else path.stat().st_size,
    }
    try:
        print(json.dumps(summary), flush=True)
    except OSError:  # whoever read it has gone
        os.dup2(
            os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno()
        )  # else the interpreter says so at its end
    return 0 if complete and not account.lost else 3


def main(arguments: list[str] | None = None) -> int:
    """Command line of the process."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if len(arguments) != 1 or arguments[0].startswith("-"):
        _say("usage: python -m daemon.recorder REQUEST.json (see docs/recording.md)")
        return 2
    try:
        return record(RecorderRequest.from_file(Path(arguments[0])))
    except RequestError as error:
        _say(str(error))
        return 2
    except (RingError, SnapshotError) as error:
        _say(str(error))
        return 1


if __name__ == "__main__":
    sys.exit(main())
