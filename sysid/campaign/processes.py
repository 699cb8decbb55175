"""The processes that a campaign starts: jtqd for every run, and the emulated bench for all of them."""

from __future__ import annotations

import ctypes
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final

from jtqd.drivers.bus_socket import PREFIX
from jtqd.drivers.filters import exact
from jtqd.drivers.frame_socket import BusError, open_frame_socket

READY_S: Final = 60.0
"""Longest time until a process is at work; a small controller loads its libraries from a slow card."""
END_S: Final = 30.0
_MARGIN_S: Final = 60.0
"""jtqd ends by itself so long after a run at the latest: nobody may be left to end it."""
_POLL_S: Final = 0.1
_BENCH_PRIORITY: Final = 40
_COMMANDER_PRIORITY: Final = 30
_PR_SET_PDEATHSIG: Final = 1
_LIBC: Final = ctypes.CDLL(None)


class ProcessError(Exception):
    """A process did not start, or ended by a failure; one line with its last message."""


class Interrupted(Exception):  # noqa: N818 - an order, not an error
    """SIGINT or SIGTERM came between two motions."""


StopAsked = Callable[[], bool]


def _die_with_parent() -> None:
    _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)


def _start(module: str, arguments: Sequence[str], messages: Path, **streams: Any) -> subprocess.Popen[bytes]:
    """Return a Python module as a process; its standard error goes to the file `messages`.

    It has a session of its own: Ctrl-C on a terminal must reach the commander alone, which needs the SYNC of jtqd to
    bring both joints to rest. It gets SIGTERM when we die, however we die.
    """
    with messages.open("wb") as log:
        return subprocess.Popen(
            [sys.executable, "-P", "-m", module, *arguments],
            stdin=subprocess.DEVNULL,
            stderr=log,
            start_new_session=True,
            preexec_fn=_die_with_parent,  # noqa: PLW1509 - there are no threads here
            **streams,
        )


def _end(process: subprocess.Popen[bytes]) -> int:
    """SIGTERM, wait, SIGKILL if it must be; its exit status."""
    if process.poll() is None:
        process.terminate()
    try:
        return process.wait(END_S)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()


def last_line(path: Path) -> str:
    """Last line of what a process wrote, for a message of one line."""
    try:
        lines = path.read_text(errors="replace").strip().splitlines()
    except OSError:
        lines = []
    return lines[-1] if lines else "no message"


class EmulatedBench:
    """The emulated bench as one process for the whole campaign, at rest until it is commanded; a context manager.

    Args:
        bus: where it is put; a unix bus is made if there is none.
        folder: for its messages. plant: plant file, None for the one of campaigns. seed: of its noise and its days.
        drives, sensor: what is on it; drives 1 and 2, and 3 and 4, are coupled.
    """

    def __init__(  # noqa: PLR0917
        self, bus: str, folder: Path, plant: Path | None, seed: int, drives: int = 2, sensor: bool = True
    ) -> None:
        arguments = ["--bus", bus, "--profile", "rest", "--seed", str(seed)]
        arguments += [] if plant is None else ["--plant", str(plant)]
        arguments += ["--drives", str(drives), *([] if sensor else ["--no-sensor"])]
        self._messages = folder / "bench.log"
        self._process = _start("jtqd.sim_can", arguments, self._messages, stdout=subprocess.DEVNULL)

    def __enter__(self) -> EmulatedBench:
        """Wait until it is ready. Raises ProcessError."""
        deadline = time.monotonic() + READY_S
        while b"bench ready" not in self._messages.read_bytes():
            self.check()
            if time.monotonic() > deadline:
                self.__exit__()
                raise ProcessError(f"the emulated bench: not ready within {READY_S:g} s")
            time.sleep(_POLL_S / 10)
        _prefer(self._process.pid)
        return self

    def __exit__(self, *_: object) -> None:
        _end(self._process)

    def check(self) -> None:
        """Raises ProcessError when it is no longer there."""
        if self._process.poll() is not None:
            raise ProcessError(
                f"the emulated bench ended with exit status {self._process.returncode}: {last_line(self._messages)}"
            )


def _prefer(pid: int) -> None:
    """The emulated nodes stand for hardware: they come before everything but jtqd's loop, where that is permitted."""
    with suppress(PermissionError):
        os.sched_setscheduler(pid, os.SCHED_FIFO, os.sched_param(_BENCH_PRIORITY))


@contextmanager
def on_time() -> Iterator[None]:
    """This process at a real-time priority while it commands, where permitted; below jtqd's loop and the drives."""
    before, priority = os.sched_getscheduler(0), os.sched_getparam(0)
    with suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_COMMANDER_PRIORITY))
    try:
        yield
    finally:
        with suppress(PermissionError):
            os.sched_setscheduler(0, before, priority)


class Jtqd:
    """jtqd during one run; a context manager that is entered when it publishes, and ends it in order.

    Args:
        bus, config: as for jtqd. folder: of the run; its log goes to folder/log, its messages to folder/jtqd.log.
        duration_s: of the motion.
        estimate_cob_id: seen on the bus, jtqd is publishing.
        stop_asked: asked while waiting.
    """

    def __init__(
        self,
        bus: str,
        config: Path | None,
        folder: Path,
        duration_s: float,
        *,
        estimate_cob_id: int,
        stop_asked: StopAsked,
    ) -> None:
        self.messages: Final = folder / "jtqd.log"
        self._bus, self._cob_id, self._stop_asked = bus, estimate_cob_id, stop_asked
        self._arguments = ["--bus", bus, "--record", str(folder / "log"), "--json"]
        self._arguments += ["--duration", f"{duration_s + _MARGIN_S:.1f}"]
        self._arguments += [] if config is None else ["--config", str(config)]
        self._output = folder / "jtqd.json"
        self._status: int | None = None

    def __enter__(self) -> Jtqd:
        """Start and wait for the first estimate. Raises ProcessError, Interrupted."""
        try:
            socket = open_frame_socket(self._bus, [exact(self._cob_id)])
        except BusError as error:
            raise ProcessError(str(error)) from None
        with self._output.open("wb") as output:
            self._process = _start("jtqd.daemon.jtqd", self._arguments, self.messages, stdout=output)
        try:
            self._wait(socket.wait)
        except BaseException:
            self.end()
            raise
        finally:
            socket.close()
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def end(self) -> None:
        """SIGTERM and wait for its summary; once."""
        if self._status is None:
            self._status = _end(self._process)

    def log(self) -> tuple[tuple[Path, ...], dict[str, Any]]:
        """Return parts of the log in their order, and the summary, after the end.

        Raises:
            ProcessError: it ended by a failure, or recorded nothing.
        """
        if self._status not in (0, 3):  # 3: done, with cycles missing in the log
            raise ProcessError(f"jtqd ended with exit status {self._status}: {last_line(self.messages)}")
        try:
            summary = json.loads(self._output.read_text())
        except ValueError:
            raise ProcessError(f"jtqd ended without a summary: {last_line(self.messages)}") from None
        recording = summary.get("recording") or {}
        if not recording.get("path"):
            raise ProcessError(f"jtqd recorded nothing: {recording.get('error') or 'no reason given'}")
        return tuple(map(Path, recording.get("paths") or [recording["path"]])), summary

    def _wait(self, seen: Callable[[float], bool]) -> None:
        deadline = time.monotonic() + READY_S
        while not seen(_POLL_S):
            if self._stop_asked():
                raise Interrupted
            if self._process.poll() is not None:
                raise ProcessError(
                    f"jtqd ended with exit status {self._process.returncode}: {last_line(self.messages)}"
                )
            if time.monotonic() > deadline:
                raise ProcessError(f"jtqd published nothing within {READY_S:g} s")


def unix_bus(folder: Path) -> str:
    """Address of a unix bus in a folder."""
    return f"{PREFIX}{folder / 'bus'}"
