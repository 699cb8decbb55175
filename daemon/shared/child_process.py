"""The supervisor's child processes: started lean, spoken to in JSON lines, ended in order."""

from __future__ import annotations

import ctypes
import json
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
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
    """A Python module as a process of its own, with JSON lines on its standard input and output.

    Its standard error is ours. It gets SIGTERM when we die, however we die.
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
        """File descriptor of its standard output, for select; none once it is closed.

        A closed one is always readable: a wait on it for the end of the process would spin.
        """
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
        try:
            self.process.stdin.write(json.dumps(message).encode() + b"\n")
            self.process.stdin.flush()
        except (BrokenPipeError, ValueError):
            pass

    def end_of_input(self) -> None:
        """Close its standard input: nothing more will be sent."""
        assert self.process.stdin is not None
        try:
            self.process.stdin.close()
        except BrokenPipeError:
            pass

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
        """Wait for the next JSON line.

        Raises:
            ChildSilence: the time is up.
            ChildError: the process ended without one.
        """
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
            self._rest(min(left, _LONGEST_WAIT_S))

    def _rest(self, longest_s: float) -> None:
        """Wait until there is output or, after the end of output, until the process has ended."""
        if not self._closed:
            select.select(self.outputs, [], [], longest_s)
            return
        with suppress(subprocess.TimeoutExpired):
            self.process.wait(longest_s)

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
