"""A process beside the loop that only reads its shared memory (live view, ROS 2 publisher): the loop does not feel it fail.

The supervisor's side starts it, reports its answer, and restarts it when it dies. The process prints one line of JSON on its
standard output: how it began, or {"failed": why}.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from types import FrameType
from typing import Any

from jtqd.daemon.shared.child_process import Child, ChildError

_STARTS = 5
"""One that dies more often than this in a minute is not started again."""
_PAUSE_S = 1.0
_NICE = 10

StartChild = Callable[[str, list[str], str], Child]


class SideProcess:
    """The supervisor's side of one such process in one run of jtqd.

    Args:
        start_child: (module, arguments, name) -> child; the supervisor ends what it has started.
        module: run with the request as its only argument.
        title: in the lines for the operator, such as "live view".
        began: key of the answer that tells how it began.
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


# ---- in the process ----


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

    Args:
        arguments: None: those of this process.
        began: key of the answer.
        begin: request -> (answer, serve until stopped). Raises CannotBegin.
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
