"""Run one `jtq` command over groups of logs and keep each result by its content, so that a batch resumes.

    OUT/results/KEY.json     a finished task: parameters, hashes of its logs, what the command printed
    OUT/results/KEY/         what the command wrote beside (a report)

KEY is a hash of the command, of version and code of jtqd, of the parameters and of the content of the logs. Files are put
in place whole. Every task is a process of its own, so that one that runs out of memory or hangs is only a failed group.
"""

from __future__ import annotations

import hashlib
import json
import os
import queue
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError, Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

import jtqd

SCHEMA: Final = "jtq.batch.result/1"
DONE, KEPT, FAILED = "done", "kept", "failed"
"""State of a group: done now; finished by an earlier batch; failed, and tried again by the next batch."""
BY_RUN, BY_DIRECTORY, BY_FILE = "run", "directory", "file"
WAYS: Final = (BY_RUN, BY_DIRECTORY, BY_FILE)
_UNFINISHED: Final = ".mcap.active"
_PART: Final = re.compile(r"-\d{4,}(?=\.mcap$)", re.ASCII)
_CODE: Final = (".py", ".j2", ".css", ".eds")
_THREADS: Final = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
_CONNECT_S: Final = 10.0
_RUNNING: Final[set[subprocess.Popen[bytes]]] = set()
_ENDING: Final = threading.Event()


class BatchError(Exception):
    """The batch cannot start or go on; finished results are kept. One line."""


class GroupError(ValueError):
    """No logs to work on; one line: what was named, found, expected."""


@dataclass(frozen=True)
class Group:
    """Logs of one task, in the order of their names; `name` is unique in a batch."""

    name: str
    files: tuple[Path, ...]


@dataclass(frozen=True)
class Task:
    """One command of jtq on one group.

    Attributes:
        command: of jtq.
        files: absolute paths of the logs.
        arguments: of the command, besides the logs, --json and --out.
        writes: the command takes --out DIR; what it writes there is part of the result.
        timeout_s: longest duration; None: no limit.
    """

    command: str
    files: tuple[str, ...] = ()
    arguments: tuple[str, ...] = ()
    writes: bool = False
    timeout_s: float | None = None


@dataclass(frozen=True)
class Outcome:
    """What a task returned: JSON result and written files by name, or one line of error; tool: `tool_version()` there."""

    exit_status: int | None
    result: dict[str, Any] | None
    error: str
    seconds: float
    tool: str
    files: dict[str, bytes] = field(default_factory=dict)


@dataclass(frozen=True)
class Row:
    """State of one group at the end; content: the stored result, None where it failed."""

    group: Group
    state: str
    key: str | None
    content: Mapping[str, Any] | None
    error: str
    seconds: float


def find_groups(
    named: Sequence[Path], by: str, kinds: Sequence[Sequence[str]]
) -> tuple[list[Group], list[Path]]:
    """Find the logs among and below `named`; return the groups by name, and the logs left out as still being written.

    Of each directory the files of the first kind that it has are taken: a campaign's directory holds the log of every run
    beside its table, and a run must not count twice.

    Args:
        named: files and directories.
        by: one of `WAYS`: parts of one run, one directory, or one file make a group.
        kinds: endings of file names, by kind.

    Raises:
        GroupError: a path does not exist, or no log is there.
        OSError: a directory cannot be read.
    """
    files: set[Path] = set()
    active: list[Path] = []
    for path in named:
        if not path.exists():
            raise GroupError(
                f"{path}: found no such file or directory, expected a log or a directory of logs"
            )
        inside = [each for each in path.rglob("*") if each.is_file()] if path.is_dir() else [path]
        unfinished = sorted(each for each in inside if each.name.endswith(_UNFINISHED))
        wanted = _first_kind(inside, kinds)
        if not wanted and not unfinished:
            kind = "no log in it" if path.is_dir() else f"a file ending in {path.suffix!r}"
            endings = ", ".join(ending for kind in kinds for ending in kind)
            raise GroupError(f"{path}: found {kind}, expected names ending in {endings}")
        files |= {Path(os.path.abspath(each)) for each in wanted}
        active += unfinished
    if not files:
        raise GroupError(f"{active[0]}: still being written (`jtq recover` ends it), and no other log found")
    grouped: dict[str, list[Path]] = {}
    for path in sorted(files):
        run = path.with_name(_PART.sub("", path.name))
        grouped.setdefault(str({BY_DIRECTORY: path.parent, BY_RUN: run}.get(by, path)), []).append(path)
    top = os.path.commonpath([path.parent for path in files])
    names = {key: os.path.relpath(key, top) for key in grouped}
    groups = [
        Group(os.path.basename(top) or "logs" if names[key] == "." else names[key], tuple(paths))
        for key, paths in sorted(grouped.items())
    ]
    return groups, active


def _first_kind(inside: Sequence[Path], kinds: Sequence[Sequence[str]]) -> list[Path]:
    """Return the files of each directory that are of the first kind it has, without hidden ones."""
    by_directory: dict[Path, list[Path]] = {}
    for path in inside:
        if not path.name.startswith("."):
            by_directory.setdefault(path.parent, []).append(path)
    found: list[Path] = []
    for paths in by_directory.values():
        of_kinds = ([path for path in paths if path.name.endswith(tuple(kind))] for kind in kinds)
        found += next((chosen for chosen in of_kinds if chosen), [])
    return found


def sha256(path: Path) -> str:
    """Return the hash of a file's content. Raises OSError."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def tool_version() -> str:
    """Return version and code hash of jtqd here and now, e.g. "0.1.0+code.3fa9c1d2e4b7"; takes 0.1 s."""
    found = hashlib.sha256()
    for root in sorted(path for top in jtqd.__path__ for path in Path(top).iterdir() if path.is_dir()):
        for path in sorted(root.rglob("*")):
            if path.suffix in _CODE and path.is_file():
                found.update(f"{root.name}/{path.relative_to(root)} ".encode() + path.read_bytes())
    return f"{version('jtqd')}+code.{found.hexdigest()[:12]}"


def key_of(command: str, tool: str, parameters: Mapping[str, Any], hashes: Sequence[str]) -> str:
    """Return the name of a result: the same logs, parameters and tool give the same, wherever the logs are."""
    content = [SCHEMA, command, tool, dict(parameters), list(hashes)]
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:32]


def run_task(task: Task) -> Outcome:
    """Run the command as a process of its own; every failure is in the outcome."""
    began = time.monotonic()

    def outcome(
        status: int | None, result: Any, error: str, files: dict[str, bytes] | None = None
    ) -> Outcome:
        return Outcome(status, result, error, round(time.monotonic() - began, 3), tool_version(), files or {})

    with tempfile.TemporaryDirectory(prefix="jtq-batch-") as scratch:
        out = Path(scratch) / "out"
        arguments = [task.command, *task.files, *task.arguments, "--json"]
        arguments += ["--out", str(out)] if task.writes else []
        try:
            status, stdout, stderr = _jtq(arguments, task.timeout_s)
        except subprocess.TimeoutExpired:
            return outcome(None, None, f"took longer than {task.timeout_s:g} s")
        if status < 0:
            reason = " (out of memory?)" if -status == signal.SIGKILL else ""
            return outcome(status, None, f"ended by {signal.Signals(-status).name}{reason}")
        if status not in (0, 3):
            lines = stderr.decode(errors="replace").strip().splitlines() or [f"exit status {status}"]
            text = lines[-1].removeprefix(f"jtq {task.command}: ")
            for path in task.files:
                text = text.replace(path, os.path.basename(path))
            return outcome(status, None, text[:400])
        try:
            result = json.loads(stdout)
        except ValueError:
            return outcome(status, None, f"jtq {task.command} printed no JSON")
        written = [path for path in out.rglob("*") if path.is_file() and path.suffix != ".json"]
        return outcome(status, result, "", {str(p.relative_to(out)): p.read_bytes() for p in written})


def _jtq(arguments: Sequence[str], timeout_s: float | None) -> tuple[int, bytes, bytes]:
    """Return exit status, standard output and standard error. Raises subprocess.TimeoutExpired."""
    with subprocess.Popen(
        [sys.executable, "-P", "-m", "jtqd.daemon.jtq", *arguments],
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


@contextmanager
def executor(scheduler: str | None, jobs: int | None) -> Iterator[tuple[Executor, str]]:
    """Yield the executor of the tasks and its description.

    Args:
        scheduler: address of a dask scheduler; None: this machine, a pool of threads that each wait for one process.
        jobs: tasks at a time on this machine; None: one per usable processor.

    Raises:
        BatchError: dask is not installed, or no scheduler answers there.
    """
    if scheduler is None:
        count = jobs or len(os.sched_getaffinity(0))
        local = ThreadPoolExecutor(count)
        try:
            yield local, f"this machine, {count} at a time"
        finally:
            local.shutdown(wait=False, cancel_futures=True)
            _ENDING.set()
            for process in tuple(_RUNNING):
                process.kill()
            local.shutdown(wait=True)
            _ENDING.clear()
        return
    try:
        from distributed import Client
    except ImportError:
        raise BatchError("--scheduler needs dask.distributed: pip install 'jtqd[cluster]'") from None
    try:
        client = Client(scheduler, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise BatchError(f"{scheduler}: no dask scheduler answers: {error or type(error).__name__}") from None
    try:
        workers = len(client.scheduler_info(n_workers=-1)["workers"])
        yield client.get_executor(retries=0), f"{scheduler}, {workers} worker{'s' if workers != 1 else ''}"
    finally:
        client.close(timeout=_CONNECT_S)


def stored(out: Path, key: str) -> dict[str, Any] | None:
    """Return the finished result `key`, None where there is none, or half of one."""
    try:
        content = json.loads((out / "results" / f"{key}.json").read_bytes())
    except (OSError, ValueError):
        return None
    good = isinstance(content, dict) and (content.get("schema"), content.get("key")) == (SCHEMA, key)
    return content if good else None


def store(out: Path, key: str, content: Mapping[str, Any], files: Mapping[str, bytes]) -> dict[str, Any]:
    """Keep a result: first the files written beside, then the JSON that marks it as finished. Raises OSError."""
    place = out / "results" / key
    shutil.rmtree(place, ignore_errors=True)
    for name, data in files.items():
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        (place / name).write_bytes(data)
    whole = {"schema": SCHEMA, "key": key, **content, "files": sorted(files)}
    write_whole(place.with_suffix(".json"), json.dumps(whole, indent=1, allow_nan=False))
    return whole


def write_whole(path: Path, text: str) -> None:
    """Put a file in place that is there whole or not at all; nothing is left of one that fails. Raises OSError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        temporary.write_text(text, encoding="utf-8")
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def run_batch(
    base: Task,
    parameters: Mapping[str, Any],
    groups: Sequence[Group],
    out: Path,
    workers: Executor,
    *,
    again: bool = False,
    progress: Callable[[Row], None] = lambda row: None,
) -> list[Row]:
    """Run the command on every group whose result is not kept yet; return one row per group, in their order.

    Args:
        base: the task without files.
        parameters: its arguments with files replaced by their hashes.
        groups: of logs; those with the same content are worked on once.
        out: directory of the results.
        workers: run the tasks.
        again: run finished groups again.
        progress: called with each row when it is complete.

    Raises:
        BatchError: the executor takes or returns no more tasks.
        OSError: a result cannot be kept.
    """
    tool = tool_version()
    rows: dict[str, Row] = {}
    waiting: dict[str, tuple[list[Group], list[str]]] = {}
    running: dict[Future[Outcome], str] = {}
    finished: queue.SimpleQueue[Future[Outcome]] = queue.SimpleQueue()

    def end(row: Row) -> None:
        rows[row.group.name] = row
        progress(row)

    try:
        for group in groups:
            try:
                hashes = [sha256(path) for path in group.files]
            except OSError as error:
                end(Row(group, FAILED, None, None, f"{error.filename}: {error.strerror}", 0.0))
                continue
            key = key_of(base.command, tool, parameters, hashes)
            content = None if again else stored(out, key)
            if content is not None:
                end(Row(group, KEPT, key, content, "", content["seconds"]))
            elif key in waiting:
                waiting[key][0].append(group)
            else:
                waiting[key] = ([group], hashes)
                future = workers.submit(run_task, replace(base, files=tuple(map(str, group.files))))
                running[future] = key
                future.add_done_callback(finished.put)
        while running:
            future = finished.get()
            key = running.pop(future)
            outcome = _outcome(future, tool)
            content = None
            if not outcome.error:
                made = {
                    "command": base.command,
                    "tool": outcome.tool,
                    "parameters": dict(parameters),
                    "logs_sha256": waiting[key][1],
                    "exit_status": outcome.exit_status,
                    "seconds": outcome.seconds,
                    "result": outcome.result,
                }
                content = store(out, key, made, outcome.files)
            for group in waiting[key][0]:
                state = DONE if content is not None else FAILED
                end(Row(group, state, key, content, outcome.error, outcome.seconds))
    except RuntimeError as error:  # the executor was shut down
        raise BatchError(f"no more tasks are taken: {error}") from None
    finally:
        for future in running:
            future.cancel()
    return [rows[group.name] for group in groups]


def _outcome(future: Future[Outcome], here: str) -> Outcome:
    """Return what the task returned, or one line for what its worker raised; another tool than `here` is an error.

    Raises BatchError when the scheduler is gone.
    """
    try:
        outcome = future.result()
    except CancelledError:
        raise BatchError("the scheduler has ended or lost the tasks") from None
    except Exception as error:
        lines = str(error).strip().splitlines() or ["no reason given"]
        died = type(error).__name__ == "KilledWorker"
        text = "the workers that tried it died" if died else f"{type(error).__name__}: {lines[0]}"
        return Outcome(None, None, text, 0.0, here)
    if not outcome.error and outcome.tool != here:
        return replace(outcome, error=f"the worker has jtqd {outcome.tool}, expected {here} as here")
    return outcome
