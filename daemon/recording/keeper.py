"""The supervisor's side of recording: start the recorder, restart it when it dies, account for every cycle."""

from __future__ import annotations

import json
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from jtqd.daemon.recording.parts import free_run, own_files
from jtqd.daemon.recording.progress import Account, ProgressFile
from jtqd.daemon.shared.child_process import Child, ChildError
from jtqd.daemon.shared.snapshot import SnapshotReader

_STARTS = 5
"""A recorder that has been started more often than this in a minute waits for `_LONG_PAUSE_S`."""
_PAUSE_S, _LONG_PAUSE_S = 1.0, 60.0
_END_LIMIT_S = 10.0


class Keeper:
    """The recorder child of one run of jtqd.

    Args:
        start_child: (module, arguments, name) -> child; the supervisor ends what it has started.
        runtime_directory: where request and progress lie.
        snapshot: the loop's counters.
    """

    def __init__(
        self, start_child: Callable[[str, list[str], str], Child], runtime_directory: Path, snapshot: Path
    ) -> None:
        self._start_child = start_child
        self._request = runtime_directory / "recorder.json"
        self.progress = runtime_directory / "recorded"
        self._snapshot = snapshot
        self._child: Child | None = None
        self._starts: list[float] = []
        self._waits = False
        self._directory: Path | None = None
        self._prefix = self._run_name = ""
        self._result: dict[str, Any] | None = None

    def start(self, request: dict[str, Any]) -> None:
        """Begin to record what `jtqd.daemon.recording.request.recording_request` asks for. Raises OSError."""
        self._directory, self._prefix = Path(request["directory"]), str(request["prefix"])
        self._run_name = free_run(self._directory, self._prefix, time.time_ns())
        request = request | {"run": self._run_name}
        self.progress.unlink(missing_ok=True)
        self._request.write_text(json.dumps(request), encoding="utf-8")
        self._run()

    @property
    def pid(self) -> int | None:
        """Process-ID of the recorder; None while there is none."""
        return self._child.pid if self._child is not None and self._child.alive() else None

    @property
    def lost(self) -> int:
        """Cycles lost so far."""
        return self._settled().lost

    def save(self) -> bool:
        """Have the flight recording written; False where there is no recorder."""
        if self.pid is None:
            return False
        assert self._child is not None
        self._child.process.send_signal(signal.SIGUSR1)
        return True

    def renew(self, request: dict[str, Any]) -> None:
        """Other files are in force: a new part begins, with them attached. Raises OSError."""
        if self._child is None:
            return
        temporary = self._request.with_name(self._request.name + ".new")
        temporary.write_text(json.dumps(request | {"run": self._run_name}), encoding="utf-8")
        temporary.replace(self._request)
        self._child.process.send_signal(signal.SIGHUP)

    def watch(self) -> None:
        """Start a recorder that died again: it goes on where it was.

        After a second; after a minute if it dies again and again. What the ring has overwritten by then is counted as lost.
        """
        if self._child is None or self._child.alive():
            return
        often = len(self._starts) > _STARTS
        if time.monotonic() - self._starts[-1] > (_LONG_PAUSE_S if often else _PAUSE_S):
            self._waits = False
            self._warn("started again, the loop goes on")
            self._run()
        elif often and not self._waits:
            self._waits = True
            self._warn(f"{len(self._starts)} times in a minute; the next try in {_LONG_PAUSE_S:.0f} s")

    def end(self, *, failed: bool = False) -> dict[str, Any] | None:
        """End the recorder; its account, or what is known of it. None where nothing was to be recorded.

        Args:
            failed: the loop ended in an error: a flight recorder saves what it has.
        """
        if self._child is not None:
            if failed:
                self._child.process.send_signal(signal.SIGUSR2)
            self._child.process.send_signal(signal.SIGTERM)
            self._child.process.send_signal(signal.SIGCONT)  # a stopped one would sleep through it
            try:
                self._result = self._child.answer(_END_LIMIT_S)
            except ChildError as error:
                self._result = self._account(str(error))
            self._child = None
        return None if self._result is None else self._result | {"left": self._leftovers()}

    def _warn(self, what: str) -> None:
        assert self._child is not None
        code = self._child.process.returncode
        print(f"jtqd: the recorder ended with exit status {code}; {what}", file=sys.stderr)

    def _run(self) -> None:
        now = time.monotonic()
        self._starts = [*(start for start in self._starts if now - start < 60.0), now]
        # Told to end before it has set up its handlers, it must still record what there is: it unblocks this by itself.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})
        try:
            self._child = self._start_child(
                "jtqd.daemon.recording.recorder", [str(self._request)], "the recorder"
            )
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)

    def _settled(self) -> Account:
        return ProgressFile(self.progress).load() if self.progress.exists() else Account()

    def _account(self, error: str) -> dict[str, Any]:
        """The account of a recorder that gave none itself; cycles that nobody wrote count as lost."""
        settled = self._settled()
        cycles = SnapshotReader(self._snapshot).read().counters["cycles"]
        return {
            "path": None,
            "cycles": cycles,
            "written": settled.written,
            "lost": cycles - settled.written,
            "error": error,
        }

    def _leftovers(self) -> list[str]:
        """Files of this run whose recorder died before it could end them."""
        if self._directory is None:
            return []
        files = own_files(self._directory, self._prefix)
        return [str(each.path) for each in files if each.active and each.run == self._run_name]
