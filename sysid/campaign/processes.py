"""Processes of a campaign: jtqd for every run, the emulated bench, and the campaign itself in the bench kernel (exact time).

In exact time the clock waits for the processes (docs/testing.md): the same jtqd, commander and emulated drives on SocketCAN
miss no cycle, however busy the machine is.
"""

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
from types import FrameType
from typing import Any, Final, NoReturn

from jtqd.drivers.bus_socket import PREFIX
from jtqd.drivers.filters import exact
from jtqd.drivers.frame_socket import BusError, open_frame_socket
from jtqd.sim_can.bench_kernel import build, guest, packages

EXACT_TIME: Final = "exact"
"""As `--bus`: the emulated bench in exact time."""
EXACT_TIME_BUS: Final = "sim:vcan0"
"""The same inside the bench kernel."""
READY_S: Final = 60.0
"""Longest start of a process; a small controller loads its libraries from a slow card."""
_END_S: Final = 30.0
_MARGIN_S: Final = 60.0
"""jtqd ends by itself this long after a run, if the campaign cannot end it."""
_POLL_S: Final = 0.1
_BENCH_PRIORITY: Final = 40
_PR_SET_PDEATHSIG: Final = 1
_LIBC: Final = ctypes.CDLL(None)


class ProcessError(Exception):
    """A process did not start, or ended by a failure; one line with its last message."""


class ExactTimeError(ProcessError):
    """The bench kernel cannot be built or booted; one line."""


class Interrupted(Exception):  # noqa: N818 - an order, not an error
    """SIGINT or SIGTERM came between two motions."""


StopAsked = Callable[[], bool]


def unix_bus(folder: Path) -> str:
    """Return the address of a unix bus in a folder."""
    return f"{PREFIX}{folder / 'bus'}"


def _die_with_parent() -> None:
    _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)


def _start(module: str, arguments: Sequence[str], messages: Path, stdout: Any) -> subprocess.Popen[bytes]:
    """Start a Python module as a process, its standard error in the file `messages`.

    It has a session of its own: Ctrl-C on a terminal must reach the commander alone, which needs the SYNC of jtqd to bring
    the joints to rest. It gets SIGTERM when this process dies.
    """
    with messages.open("wb") as log:
        return subprocess.Popen(
            [sys.executable, "-P", "-m", module, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=stdout,
            stderr=log,
            start_new_session=True,
            preexec_fn=_die_with_parent,  # noqa: PLW1509 - there are no threads here
        )


def _end(process: subprocess.Popen[bytes]) -> int:
    """Send SIGTERM, and SIGKILL to a process that does not end; return its exit status."""
    process.terminate()
    try:
        return process.wait(_END_S)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()


def _wait_for(
    process: subprocess.Popen[bytes], seen: Callable[[], bool], messages: Path, name: str, late: str
) -> None:
    """Wait until `seen()`, which blocks for a moment itself.

    Raises ProcessError where the process ends, or is `late` after READY_S.
    """
    deadline = time.monotonic() + READY_S
    while not seen():
        if process.poll() is not None:
            raise ProcessError(f"{name} ended with exit status {process.returncode}: {last_line(messages)}")
        if time.monotonic() > deadline:
            raise ProcessError(f"{name}{late} within {READY_S:g} s")


def last_line(path: Path) -> str:
    """Return the last line that a process wrote to a file."""
    try:
        lines = path.read_text(errors="replace").strip().splitlines()
    except OSError:
        lines = []
    return lines[-1] if lines else "no message"


@contextmanager
def emulated_bench(
    bus: str, folder: Path, plant: Path, seed: int, drives: int, *, sensor: bool
) -> Iterator[None]:
    """Run the emulated bench as a process, at rest until it is commanded.

    Args:
        bus: where it is put; a unix bus is made if there is none. folder: for its messages. seed: of its noise and days.
        drives, sensor: what is on it; drives 1 and 2, and 3 and 4, are coupled.

    Raises ProcessError when it does not start.
    """
    arguments = ["--bus", bus, "--profile", "rest", "--seed", str(seed), "--plant", str(plant)]
    arguments += ["--drives", str(drives), *([] if sensor else ["--no-sensor"])]
    messages = folder / "bench.log"
    process = _start("jtqd.sim_can", arguments, messages, subprocess.DEVNULL)

    def ready() -> bool:
        time.sleep(_POLL_S / 10)
        return b"bench ready" in messages.read_bytes()

    try:
        _wait_for(process, ready, messages, "the emulated bench", ": not ready")
        with suppress(PermissionError):  # it stands for hardware: before everything but jtqd's loop
            os.sched_setscheduler(process.pid, os.SCHED_FIFO, os.sched_param(_BENCH_PRIORITY))
        yield
    finally:
        _end(process)


class Jtqd:
    """jtqd during one run: a context manager that waits for its first estimate, and ends it in order.

    Args:
        bus, config: as for jtqd. folder: of the run; its log goes to folder/log, its messages to folder/jtqd.log.
        duration_s: of the motion.
        estimate_cob_id: of the PDO that jtqd publishes.
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
        self._status = 0

    def __enter__(self) -> Jtqd:
        """Start and wait for the first estimate. Raises ProcessError, Interrupted."""
        try:
            socket = open_frame_socket(self._bus, [exact(self._cob_id)])
        except BusError as error:
            raise ProcessError(str(error)) from None
        with self._output.open("wb") as output:
            self._process = _start("jtqd.daemon.jtqd", self._arguments, self.messages, output)

        def published() -> bool:
            if socket.wait(_POLL_S):
                return True
            if self._stop_asked():
                raise Interrupted
            return False

        try:
            _wait_for(self._process, published, self.messages, "jtqd", " published nothing")
        except BaseException:
            _end(self._process)
            raise
        finally:
            socket.close()
        return self

    def __exit__(self, *_: object) -> None:
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


def in_exact_time() -> bool:
    """Return whether this process runs in the bench kernel."""
    return os.environ.get(guest.TIME_TRAVEL_MARK) == "1"


def exact_time_ready() -> bool:
    """Return whether the bench kernel is there, and this process is not in it."""
    try:
        return not in_exact_time() and build.find() is not None and not packages.missing(packages.GUEST)
    except RuntimeError:
        return False


def run_in_exact_time(argv: Sequence[str], out: Path) -> int:
    """Run `jtq campaign` with these arguments in the bench kernel; return its exit status.

    Raises:
        ExactTimeError: the kernel cannot be built or booted.
        ProcessError: a signal ended it.
    """
    command = [sys.executable, "-P", "-m", "jtqd.daemon.jtq", "campaign", *argv, "--bus", EXACT_TIME_BUS]
    sys.stdout.flush()
    before = signal.signal(signal.SIGTERM, _terminated)
    try:
        result = guest.run(
            command, time_travel=True, out_dir=out, sinks=(sys.stdout.buffer, sys.stderr.buffer)
        )
    except RuntimeError as error:  # every error of the bench kernel is one
        raise ExactTimeError(f"exact time: {error}") from None
    except KeyboardInterrupt:
        raise ProcessError("ended by a signal; the same command continues with the remaining runs") from None
    finally:
        signal.signal(signal.SIGTERM, before)
    return result.returncode


def _terminated(number: int, frame: FrameType | None) -> NoReturn:
    raise KeyboardInterrupt
