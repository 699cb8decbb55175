"""The recorder process: `python -m daemon.recording.recorder REQUEST.json` turns the ring of cycles into MCAP files.

It runs beside the loop and can only read what the loop leaves in shared memory, so that nothing it meets (a
full disk, a stop, a kill) reaches the loop. It ends on SIGTERM or when its parent has gone: it then reads on
until the loop writes no more, ends the file and prints one line of JSON on stdout. SIGUSR1: write the flight
recording, or begin the next part; SIGUSR2: the loop has failed; SIGHUP: the attachments of REQUEST.json have changed.

Exit status: 0 every cycle is in a file (or let go by the flight recorder), 1 shared memory is not there, 2 the request
is wrong, 3 cycles were lost or a file could not be ended.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from contextlib import suppress
from pathlib import Path

from daemon.recording.progress import Account, ProgressFile
from daemon.recording.request import RecorderRequest, RequestError
from daemon.recording.session import Session
from daemon.shared import cycle_record
from daemon.shared.ring import RingError, RingReader
from daemon.shared.snapshot import SnapshotError

POLL_S = 0.05
QUIET_S = 0.15
"""After the order to end: the loop is taken to have ended when it has written nothing for this long."""
DRAIN_LIMIT_S = 5.0
"""... and a loop that goes on all the same is left after this long."""
_NICE = 5


def _say(text: str) -> None:
    with suppress(OSError):
        print(f"recorder: {text}", file=sys.stderr, flush=True)


class _Signals:
    """What was asked for, by signals or by the end of the parent."""

    def __init__(self) -> None:
        self._parent = os.getppid()
        self._stop = False
        self.save = False
        self.failed = False
        self.renew = False
        signal.signal(signal.SIGHUP, self._on_signal)
        signal.signal(signal.SIGTERM, self._on_signal)
        signal.signal(signal.SIGUSR1, self._on_signal)
        signal.signal(signal.SIGUSR2, self._on_signal)
        # Ctrl-C reaches every process of the terminal; the supervisor ends the loop, then sends SIGTERM.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})  # `Keeper` starts us with it blocked

    def _on_signal(self, number: int, _frame: object) -> None:
        self._stop |= number == signal.SIGTERM
        self.save |= number == signal.SIGUSR1
        self.failed |= number == signal.SIGUSR2
        self.renew |= number == signal.SIGHUP

    @property
    def orphaned(self) -> bool:
        return os.getppid() != self._parent

    @property
    def stop(self) -> bool:
        return self._stop or self.orphaned


def _open_ring(request: RecorderRequest, signals: _Signals) -> RingReader:
    deadline = time.monotonic() + request.wait_s
    while True:
        try:
            return RingReader(request.ring, cycle_record.RECORD_SIZE)
        except RingError:
            if time.monotonic() >= deadline or signals.stop:
                raise
        time.sleep(POLL_S)


class Recorder:
    """The polling loop around one `Session`."""

    def __init__(
        self,
        reader: RingReader,
        session: Session,
        *,
        chunk_s: float,
        signals: _Signals,
        progress: ProgressFile | None,
        request_path: Path | None = None,
    ) -> None:
        self._reader = reader
        self._session = session
        self._recording = session.recording
        self._chunk_s = chunk_s
        self._signals = signals
        self._request_path = request_path
        self._progress = progress

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
            self.settle()

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
            self._answer_signals()
            self._session.look_round()
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
                    self._session.fault("jtqd has gone")
            if now - last_diagnosis >= 1.0:
                used = time.process_time()
                percent = round(100.0 * (used - cpu) / (now - last_diagnosis), 2)
                self._session.diagnose(backlog, percent)
                last_diagnosis, cpu = now, used
            # Chunks end by recorded time; this is for a loop that stands still.
            if taken:
                last_flush = now
            elif now - last_flush >= self._chunk_s:
                self._recording.flush()
                last_flush = now
            self.settle()
            time.sleep(POLL_S)

    def _answer_signals(self) -> None:
        signals = self._signals
        if signals.failed:
            signals.failed = False
            self._session.fault("the loop failed")
        if signals.save:
            signals.save = False
            self._session.save("on request")
        if signals.renew:
            signals.renew = False
            self._renew()

    def _renew(self) -> None:
        if self._request_path is None:
            return
        try:
            request = RecorderRequest.from_file(self._request_path)
        except RequestError as error:
            _say(str(error))
            return
        self._session.renew(request)

    def settle(self) -> None:
        """Leave word of how far we are."""
        if self._progress is not None:
            self._progress.store(self._recording.progress)


def record(request: RecorderRequest, request_path: Path | None = None) -> int:
    """Record one run; returns the exit status and prints the summary. SIGHUP reads `request_path` again.

    Raises:
        RingError: no ring at that path within `wait_s`.
        SnapshotError: no snapshot where the request says.
        OSError: the file of the progress cannot be made.
    """
    signals = _Signals()
    with suppress(OSError):
        os.nice(_NICE)
    reader = _open_ring(request, signals)
    progress = None if request.progress is None else ProgressFile(request.progress)
    account = Account() if progress is None else progress.load()
    session = Session(request, account, _say)
    recorder = Recorder(
        reader,
        session,
        chunk_s=request.chunk_s,
        signals=signals,
        progress=progress,
        request_path=request_path,
    )
    recorder.run()
    summary = session.finish()
    recorder.settle()
    try:
        print(json.dumps(summary), flush=True)
    except OSError:  # whoever read it has gone, and the interpreter would say so at its end
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 0 if session.parts.all_ended and not account.lost else 3


def main(arguments: list[str] | None = None) -> int:
    """Command line of the process."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if len(arguments) != 1 or arguments[0].startswith("-"):
        _say("usage: python -m daemon.recording.recorder REQUEST.json (see docs/recording.md)")
        return 2
    try:
        path = Path(arguments[0])
        return record(RecorderRequest.from_file(path), path)
    except RequestError as error:
        _say(str(error))
        return 2
    except (RingError, SnapshotError) as error:
        _say(str(error))
        return 1
    except OSError as error:  # of the progress: files of the log have their own way
        _say(f"{error.filename or path}: {error.strerror or error}")
        return 1


if __name__ == "__main__":
    sys.exit(main())
