"""What a worker does: hash files, and run one `jtq` command on one group. Functions of their arguments alone.

The command is a process of its own, whatever the executor is: it may need all the memory there is, be killed for it, or
crash, and takes neither the worker nor another task with it; and a worker may have as many threads as it likes.
What the command writes comes back as bytes, so that a worker needs to read the logs and nothing else.

Only the standard library is imported here: a worker loads this module, the command's process loads the rest.
"""

from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from jtqd.sysid.batch.tool import tool_version

_ENDED_WELL: Final = (0, 3)
_THREADS: Final = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
_LONGEST_ERROR: Final = 400
_JSON: Final = ".json"
_RUNNING: Final[set[subprocess.Popen[bytes]]] = set()
_ENDING: Final = threading.Event()


@dataclass(frozen=True)
class Task:
    """One command on one group.

    Attributes:
        command: of jtq.
        files: absolute paths of the logs.
        arguments: of the command, besides the logs, --json and --out.
        writes: the command takes --out DIR; what it writes there comes back.
        timeout_s: how long it may take; None: for ever.
    """

    command: str
    files: tuple[str, ...]
    arguments: tuple[str, ...]
    writes: bool
    timeout_s: float | None = None


@dataclass(frozen=True)
class Outcome:
    """What became of a task.

    Attributes:
        exit_status: of the command; negative: the signal that ended it; None: it took too long.
        result: what it printed, where it ended well.
        error: one line, empty where it ended well.
        seconds: how long it took.
        tool: version and code of jtqd that did it (`jtqd.sysid.batch.tool`).
        files: what it wrote, by name.
    """

    exit_status: int | None
    result: dict[str, Any] | None
    error: str
    seconds: float
    tool: str
    files: dict[str, bytes] = field(default_factory=dict)


def hash_files(paths: Sequence[str]) -> list[str]:
    """SHA-256 of each file's content. Raises OSError."""
    found = []
    for path in paths:
        with open(path, "rb") as file:
            found.append(hashlib.file_digest(file, "sha256").hexdigest())
    return found


def run_task(task: Task) -> Outcome:
    """Run the command; everything that can go wrong with it is in the outcome."""
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="jtq-batch-") as scratch:
        out = Path(scratch) / "out"
        arguments = [task.command, *task.files, *task.arguments, "--json"]
        arguments += ["--out", str(out)] if task.writes else []
        try:
            status, stdout, stderr = _run(arguments, task.timeout_s)
        except subprocess.TimeoutExpired:
            return _failed(None, f"took longer than {task.timeout_s:g} s", began)
        if status not in _ENDED_WELL:
            return _failed(status, _why(task, status, stderr), began)
        try:
            result = json.loads(stdout)
        except ValueError:
            return _failed(status, f"jtq {task.command} printed no JSON", began)
        written = sorted(each for each in out.rglob("*") if each.is_file()) if task.writes else []
        files = {str(each.relative_to(out)): each.read_bytes() for each in written if each.suffix != _JSON}
        return Outcome(status, result, "", _since(began), tool_version(), files)


def _run(arguments: Sequence[str], timeout_s: float | None) -> tuple[int, bytes, bytes]:
    """Exit status, standard output and standard error. Raises subprocess.TimeoutExpired."""
    with subprocess.Popen(
        [sys.executable, "-P", "-m", "jtqd.sysid.batch.child", str(os.getpid()), *arguments],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=dict.fromkeys(_THREADS, "1") | dict(os.environ),
    ) as process:
        _RUNNING.add(process)
        if _ENDING.is_set():  # between the start of the process and its entry here
            process.kill()
        try:
            stdout, stderr = process.communicate(timeout=timeout_s)
        finally:
            process.kill()
            _RUNNING.discard(process)
    return process.returncode, stdout, stderr


def allow_running() -> None:
    """Commands may be started in this process again."""
    _ENDING.clear()


def end_running() -> None:
    """End the commands that this process has started, and those that it is about to start."""
    _ENDING.set()
    for process in tuple(_RUNNING):
        process.kill()


def _since(began: float) -> float:
    return round(time.monotonic() - began, 3)


def _failed(status: int | None, error: str, began: float) -> Outcome:
    return Outcome(status, None, error, _since(began), tool_version())


def _why(task: Task, status: int, stderr: bytes) -> str:
    """The command's own last line; where a signal ended it, which."""
    if status < 0:
        reason = " (out of memory?)" if -status == signal.SIGKILL else ""
        return f"was ended by {signal.Signals(-status).name}{reason}"
    lines = [line.strip() for line in stderr.decode(errors="replace").splitlines() if line.strip()]
    if not lines:
        return f"ended with exit status {status} and said nothing"
    return lines[-1].removeprefix(f"jtq {task.command}: ")[:_LONGEST_ERROR]
