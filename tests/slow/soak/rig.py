"""jtqd and the emulated bench as processes, on a hub of the bench's own or on a CAN interface."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections import deque
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

import yaml

from jtqd.daemon.shared.events import FILE as NOTICES
from jtqd.daemon.shared.events import NoticesReader
from jtqd.daemon.shared.snapshot import SnapshotReader
from tests.paths import ROOT
from tests.processes import of_module
from tests.shipped_bench import shipped_bench
from tests.slow.faults.listener import Ears

_NAMES = {"jtqd.daemon.loop.process": "loop", "jtqd.daemon.recording.recorder": "recorder"}
_MARKS = 200
OVERFLOW = 240
"""Of the counter in SYNC."""


class Rig:
    """Bench and daemon; context manager.

    Args:
        directory: for logs, runtime directory and what they say; short, as it holds a socket.
        interface: a CAN interface; None: a unix bus.
        record: write a log.
        listen: have an independent listener on the bus from before the daemon's start.

    Attributes:
        bus: name of the bus.
        ears: the listener, if one was asked for.
        runtime: directory of the running daemon: snapshot, progress of the recorder, `bus.json`.
        result: summary of the daemon as JSON, after `end`.
    """

    def __init__(
        self, directory: Path, interface: str | None = None, *, record: bool = True, listen: bool = False
    ) -> None:
        self.bus = interface or f"unix:{directory}/hub"
        self.directory, self.logs = directory, directory / "logs"
        self.result: dict[str, Any] = {}
        self.status: int | None = None
        (directory / "run").mkdir()
        environment = {**os.environ, "RUNTIME_DIRECTORY": str(directory / "run")}
        self.bench = subprocess.Popen(
            [sys.executable, "-m", "tests.slow.soak.bench", "--bus", self.bus, "--seed", "1"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=ROOT,
        )
        assert self.bench.stderr is not None
        line = self.bench.stderr.readline()
        assert "ready" in line, line + self.bench.stderr.read()
        self.ears = Ears(self.bus) if listen else None
        with suppress(PermissionError):  # as jtqd's own bench: its answers must not wait for other programs
            os.sched_setscheduler(self.bench.pid, os.SCHED_FIFO, os.sched_param(40))
        command = ["--bus", self.bus, "--json", "--record", str(self.logs) if record else "none"]
        command += ["--config", str(_configuration(directory))]
        with open(directory / "out", "w") as out, open(directory / "err", "w") as err:
            self.daemon = subprocess.Popen(
                [sys.executable, "-m", "jtqd.daemon.jtqd", *command], env=environment, stdout=out, stderr=err
            )
        self._err, self._said = open(directory / "err"), ""  # noqa: SIM115 - closed with the rig
        self._notices: NoticesReader | None = None
        self._marks: deque[tuple[float, int]] = deque(maxlen=_MARKS)
        deadline = time.monotonic() + 90.0
        while not self._running():
            assert self.daemon.poll() is None, self.said()
            assert time.monotonic() < deadline, self.said()
            time.sleep(0.05)

    def _running(self) -> bool:
        found = list((self.directory / "run").glob("*/snapshot"))
        if not found:
            return False
        self.reader, self.runtime = SnapshotReader(found[0]), found[0].parent
        if self.reader.read().counters["published"] <= 300:
            return False
        self._notices = NoticesReader(self.runtime / NOTICES)
        return True

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for process in (self.daemon, self.bench):
            if process.poll() is None:
                process.kill()
                process.wait()
        if self.ears is not None and self.ears.is_alive():
            self.ears.end()
        self._err.close()

    @property
    def listener(self) -> Ears:
        assert self.ears is not None
        return self.ears

    def said(self) -> str:
        """Standard error of the daemon, and its notices: they also hold the lines that came too often to be said."""
        self._said += self._err.read()
        if self._notices is not None:
            self._said += "".join(f"notice: {each.text}\n" for each in self._notices.read()[0])
        self._marks.append((time.monotonic(), len(self._said)))
        return self._said

    def said_lately(self, seconds: float) -> str:
        """What it has said within this time, and perhaps a little before."""
        since, text = time.monotonic() - seconds, self.said()
        return text[max((length for at, length in self._marks if at <= since), default=0) :]

    def bus_report(self) -> Any:
        """`bus.json`: what the daemon says of the bus."""
        return json.loads((self.runtime / "bus.json").read_text())

    def counters(self) -> dict[str, int]:
        return dict(self.reader.read().counters)

    def processes(self) -> dict[str, int]:
        """Process-ID of each process of the daemon, and of the bench, by name."""
        found = {"supervisor": self.daemon.pid, "bench": self.bench.pid}
        for module, name in _NAMES.items():
            if (pid := of_module(self.daemon.pid, module)) is not None:
                found[name] = pid
        return found

    def end(self) -> None:
        """SIGTERM to the daemon, then to the bench; `result` is there afterwards."""
        self.daemon.send_signal(signal.SIGTERM)
        self.status = self.daemon.wait(60)
        if self.ears is not None:  # before the bench, with which a unix bus goes
            self.ears.end()
        self.bench.terminate()
        self.bench.wait(20)
        text = (self.directory / "out").read_text().strip()
        self.result = json.loads(text.splitlines()[-1]) if text else {}


def _configuration(directory: Path) -> Path:
    """Write the shipped configuration with a counter in SYNC, by which the account knows what was not heard."""
    content = shipped_bench()
    content["sync"]["counter_overflow"] = OVERFLOW
    path = directory / "configuration.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


def rss_kb(pid: int | str = "self") -> int:
    """Resident memory of its own [kB]: without pages of files and shared memory, which are others' too."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("RssAnon:"):
            return int(line.split()[1])
    return 0
