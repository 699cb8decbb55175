"""Processes of the daemon: the supervisor's children, those beside the loop, and messages to systemd (sd_notify).

A child is started lean, gets and sends JSON lines, and is ended in order. A side process (live view, ROS 2 publisher) only
reads the loop's shared memory, and the loop does not feel it fail: the supervisor's side starts it, reports its answer and
restarts it when it dies; the process prints one line of JSON: how it began, or {"failed": why}.
"""

from __future__ import annotations

import ctypes
import json
import os
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from types import FrameType
from typing import Any


class ChildError(Exception):
    """A child process ended or kept silent where an answer was due; the message is for the operator."""


class ChildSilence(ChildError):  # noqa: N818  (not an error of this side)
    """The child runs and has not answered yet."""


_LIBC = ctypes.CDLL(None)
_PR_SET_PDEATHSIG = 1
_REQUESTS = (signal.SIGHUP, signal.SIGUSR1, signal.SIGUSR2)
"""A child that has not set up its handlers yet must not be ended by one of them."""


_QUIET_LIBRARIES = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MALLOC_ARENA_MAX": "2"}
"""numpy's linear algebra would start a thread per CPU, and none of our processes needs one."""


_LONGEST_WAIT_S = 0.2
"""How long `answer` waits at a stretch: a process may end without closing its output, if one of its own holds it."""


def _die_with_parent() -> None:
    _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
    for number in _REQUESTS:
        signal.signal(number, signal.SIG_IGN)


class Child:
    """A Python module as a process of its own, with JSON lines on its standard input and output; its standard error is ours.

    It gets SIGTERM when we die, however we die.
    """

    def __init__(self, module: str, arguments: Sequence[str] = (), *, name: str | None = None) -> None:
        self.name = name or module
        self.process = subprocess.Popen(
            # -P: no file of the working directory may stand in for one of our packages.
            [sys.executable, "-P", "-m", module, *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**_QUIET_LIBRARIES, **os.environ},
            # Ctrl-C on a terminal is the supervisor's: it ends its children in order.
            start_new_session=True,
            preexec_fn=_die_with_parent,  # noqa: PLW1509 - the supervisor has no threads
        )
        assert self.process.stdout is not None
        os.set_blocking(self.process.stdout.fileno(), False)
        self._pending = b""
        self._closed = False

    @property
    def outputs(self) -> list[int]:
        """File descriptor of its standard output, for select; none once it is closed, as it would always be readable."""
        assert self.process.stdout is not None
        return [] if self._closed else [self.process.stdout.fileno()]

    @property
    def pid(self) -> int:
        """Process-ID."""
        return self.process.pid

    def alive(self) -> bool:
        """Return True while the process runs."""
        return self.process.poll() is None

    def send(self, message: Any) -> None:
        """Send one JSON line; that a child has gone shows when its answer is waited for."""
        assert self.process.stdin is not None
        with suppress(BrokenPipeError, ValueError):
            self.process.stdin.write(json.dumps(message).encode() + b"\n")
            self.process.stdin.flush()

    def end_of_input(self) -> None:
        """Close its standard input: nothing more will be sent."""
        assert self.process.stdin is not None
        with suppress(BrokenPipeError):
            self.process.stdin.close()

    def poll_answer(self) -> dict[str, Any] | None:
        """Return the next JSON line, if any."""
        assert self.process.stdout is not None
        chunk = self.process.stdout.read()
        if chunk:
            self._pending += chunk
        self._closed = chunk == b""
        line, newline, rest = self._pending.partition(b"\n")
        if not newline:
            return None
        self._pending = rest
        answer = json.loads(line)
        if not isinstance(answer, dict):
            raise ChildError(f"{self.name} answered {line[:80]!r}")
        return answer

    def answer(self, timeout_s: float) -> dict[str, Any]:
        """Wait for the next JSON line. Raises ChildSilence when the time is up, ChildError when the process has ended."""
        deadline = time.monotonic() + timeout_s
        while True:
            ended = not self.alive()  # asked first: its last answer is then in the pipe
            found = self.poll_answer()
            if found is not None:
                return found
            if ended:
                raise ChildError(f"{self.name} ended with exit status {self.process.returncode}")
            left = deadline - time.monotonic()
            if left <= 0:
                raise ChildSilence(f"{self.name} did not answer within {timeout_s:g} s")
            longest_s = min(left, _LONGEST_WAIT_S)
            if self._closed:
                with suppress(subprocess.TimeoutExpired):
                    self.process.wait(longest_s)
            else:
                select.select(self.outputs, [], [], longest_s)

    def end(self, timeout_s: float = 5.0) -> int | None:
        """SIGTERM, wait, SIGKILL if it must be; returns the exit status (None if it had to be killed)."""
        if self.alive():
            self.process.send_signal(signal.SIGTERM)
            # A stopped process would sleep through its SIGTERM.
            self.process.send_signal(signal.SIGCONT)
        try:
            return self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
            return None


# Beside the loop ------------------------------------------------------------------------------------------------------

_STARTS = 5
"""One that dies more often than this in a minute is not started again."""
_PAUSE_S = 1.0
_NICE = 10

StartChild = Callable[[str, list[str], str], Child]


class SideProcess:
    """The supervisor's side of one such process in one run of jtqd.

    start_child: (module, arguments, name) -> child, which the supervisor ends; module: run with the request as its only
    argument; title: in the lines for the operator; began: key of the answer that tells how it began.
    """

    def __init__(self, start_child: StartChild, module: str, title: str, began: str) -> None:
        self._start_child = start_child
        self._module, self._title, self._began = module, title, began
        self._request: dict[str, Any] = {}
        self._child: Child | None = None
        self._starts: list[float] = []

    @property
    def pid(self) -> int | None:
        """Return the process-ID, or None."""
        return self._child.pid if self._child is not None and self._child.alive() else None

    def begin(self, request: dict[str, Any], warning: str = "") -> None:
        """Start the process with this request; `warning`: a line for the operator."""
        self._request = request
        if warning:
            _report(warning)
        self._run()

    def watch(self) -> None:
        """Report its output; restart it when it died, at most once a second and five times a minute."""
        if self._child is None:
            return
        ended = not self._child.alive()  # asked first: its last output is then in the pipe
        try:
            answer = self._child.poll_answer() or {}
        except (ChildError, ValueError) as error:
            answer = {"failed": str(error)}
        if self._began in answer:
            _report(f"{self._title}: {answer[self._began]}")
        if "failed" in answer:
            _report(f"no {self._title}: {answer['failed']}; the loop continues")
            self._child = None
        elif ended and time.monotonic() - self._starts[-1] > _PAUSE_S:
            how = f"the {self._title} ended with exit status {self._child.process.returncode}"
            if len(self._starts) > _STARTS:
                _report(f"{how}, too often; the loop continues without it")
                self._child = None
                return
            _report(f"{how}; restarted, the loop continues")
            self._run()

    def _run(self) -> None:
        now = time.monotonic()
        self._starts = [*(start for start in self._starts if now - start < 60.0), now]
        self._child = self._start_child(self._module, [json.dumps(self._request)], f"the {self._title}")


def _report(text: str) -> None:
    """Print a line for the operator."""
    print(f"jtqd: {text}", file=sys.stderr, flush=True)


# ... in the process


class Stop:
    """Set by SIGTERM and SIGINT. The process also gets SIGTERM when its parent has gone."""

    def __init__(self) -> None:
        self.requested = False
        signal.signal(signal.SIGTERM, self._on_signal)
        signal.signal(signal.SIGINT, self._on_signal)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self.requested = True


class CannotBegin(Exception):  # noqa: N818 - an answer, not an error of the program
    """The process cannot begin; the message is for the operator."""


def run_side_process(
    arguments: list[str] | None,
    began: str,
    begin: Callable[[dict[str, Any]], tuple[str, Callable[[Stop], int]]],
) -> int:
    """Run the process with the request in its command line; returns the exit status: 0 ended in order, 1 a failure.

    arguments: None: those of this process; began: key of the answer; begin: request -> (answer, serve until stopped), raises
    CannotBegin.
    """
    request = json.loads((sys.argv[1:] if arguments is None else arguments)[0])
    stop = Stop()
    with suppress(OSError):
        os.nice(_NICE)
    try:
        text, serve = begin(request)
    except CannotBegin as error:
        _answer({"failed": str(error)})
        return 1
    _answer({began: text})
    return serve(stop)


def _answer(content: dict[str, str]) -> None:
    with suppress(OSError):
        print(json.dumps(content), flush=True)


# systemd --------------------------------------------------------------------------------------------------------------

_FEED_SHARE = 0.1
"""The watchdog is fed ten times within its time: nine of these may be late."""


class Notifier:
    """Sends datagrams to $NOTIFY_SOCKET (a path, or @ and an abstract name), by a socket that is connected once."""

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        self._socket: socket.socket | None = None
        address = environment.get("NOTIFY_SOCKET", "")
        if address[:1] not in ("/", "@"):
            return
        sock = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC)
        try:
            sock.connect("\0" + address[1:] if address.startswith("@") else address)
        except OSError:
            sock.close()
            return
        self._socket = sock

    @property
    def connected(self) -> bool:
        """A service manager listens."""
        return self._socket is not None

    def send(self, *lines: str) -> bool:
        """Send assignments such as "READY=1"; False where nobody took them. Never blocks, never raises."""
        if self._socket is None:
            return False
        try:
            self._socket.send("\n".join(lines).encode())
        except OSError:
            return False
        return True


class LoopWatchdog:
    """Feeds systemd's watchdog from the loop: call `advanced` after some cycles; every n-th cycle sends one datagram.

    watchdog_s: after which the service manager takes the loop for dead; None: there is no watchdog.
    """

    def __init__(self, notifier: Notifier, period_ns: int, watchdog_s: float | None) -> None:
        self._notifier = notifier
        fed = notifier.connected and watchdog_s is not None
        self.every = max(1, round(_FEED_SHARE * (watchdog_s or 0.0) * 1e9 / period_ns)) if fed else 0
        """Cycles between two datagrams; 0: never."""
        self._left = self.every

    def advanced(self, cycles: int = 1) -> None:
        """Count completed cycles."""
        if self.every == 0:
            return
        self._left -= cycles
        if self._left <= 0:
            self._left = self.every
            self._notifier.send("WATCHDOG=1")


def watchdog_seconds(environment: Mapping[str, str] = os.environ) -> float | None:
    """Return the time of systemd's watchdog [s], None without one.

    WATCHDOG_PID names the main process; the loop is its child and feeds in its place (NotifyAccess=all).
    """
    text = environment.get("WATCHDOG_USEC", "")
    owner = environment.get("WATCHDOG_PID", "")
    if not text.isdigit() or int(text) == 0 or (owner and owner not in (str(os.getpid()), str(os.getppid()))):
        return None
    return int(text) * 1e-6
