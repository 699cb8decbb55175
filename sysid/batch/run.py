"""Drive the tasks of a batch through an executor: hash, skip what is finished, run the rest, keep each result."""

from __future__ import annotations

import queue
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import CancelledError, Executor, Future
from dataclasses import dataclass
from typing import Any, Final

from jtqd.sysid.batch.groups import Group
from jtqd.sysid.batch.store import Store, key_of
from jtqd.sysid.batch.task import Outcome, Task, hash_files, run_task

DONE, KEPT, FAILED = "done", "kept", "failed"
"""Done now; finished by an earlier batch; failed, and tried again the next time."""
_KILLED: Final = "KilledWorker"


class BatchError(Exception):
    """The batch cannot go on; what is finished is kept. One line."""


@dataclass(frozen=True)
class Job:
    """What is to be done with every group.

    Attributes:
        command: of jtq.
        arguments: of the command, besides the logs, --json and --out.
        parameters: the same with files replaced by their hashes: part of a result's name.
        writes: the command takes --out DIR.
        tool: version and code of jtqd (`jtqd.sysid.batch.tool`).
        timeout_s: of one task; None: none.
        again: do it again although it is finished.
    """

    command: str
    arguments: tuple[str, ...]
    parameters: Mapping[str, Any]
    writes: bool
    tool: str
    timeout_s: float | None = None
    again: bool = False


@dataclass(frozen=True)
class Row:
    """What became of one group. `content` is the stored result (`jtqd.sysid.batch.store`), None where it failed."""

    group: Group
    state: str
    key: str | None
    content: Mapping[str, Any] | None
    error: str
    seconds: float


class Batch:
    """One run over all groups.

    Args:
        job: what to do.
        groups: with what.
        store: of results.
        executor: of the tasks.
        progress: called with each row as it is finished.
    """

    def __init__(
        self,
        job: Job,
        groups: Sequence[Group],
        store: Store,
        executor: Executor,
        progress: Callable[[Row], None] = lambda _: None,
    ) -> None:
        self._job = job
        self._groups = groups
        self._store = store
        self._executor = executor
        self._progress = progress
        self._rows: dict[str, Row] = {}
        self._finished: queue.SimpleQueue[Future[Any]] = queue.SimpleQueue()
        self._hashing: dict[Future[Any], Group] = {}
        self._running: dict[Future[Any], str] = {}
        self._waiting: dict[str, list[Group]] = {}
        self._hashes: dict[str, list[str]] = {}

    def run(self) -> list[Row]:
        """Rows in the order of the groups.

        Raises:
            BatchError: the executor takes or gives no more; what is finished is in the store.
            OSError: a result cannot be kept.
        """
        try:
            for group in self._groups:
                hashes = self._store.hashes(group.files)
                if hashes is None:
                    names = [str(path) for path in group.files]
                    self._hashing[self._submit(hash_files, names)] = group
                else:
                    self._known(group, hashes)
            while self._hashing or self._running:
                self._take(self._finished.get())
        finally:
            for future in (*self._hashing, *self._running):
                future.cancel()
            self._store.save()
        return [self._rows[group.name] for group in self._groups]

    def _submit(self, function: Callable[..., Any], argument: Any) -> Future[Any]:
        try:
            future: Future[Any] = self._executor.submit(function, argument)
        except RuntimeError as error:  # it was shut down
            raise BatchError(f"no more tasks are taken: {error}") from None
        future.add_done_callback(self._finished.put)
        return future

    def _take(self, future: Future[Any]) -> None:
        if future.cancelled():
            raise BatchError("the scheduler has gone, or has forgotten the tasks")
        group = self._hashing.pop(future, None)
        try:
            value = future.result()
        except CancelledError:
            raise BatchError("the scheduler has gone, or has forgotten the tasks") from None
        except Exception as error:
            text = _words(error)
            if group is not None:
                self._end(group, FAILED, None, error=text)
            else:
                self._end_all(self._running.pop(future), FAILED, None, error=text)
            return
        if group is not None:
            self._store.learn(group.files, value)
            self._known(group, value)
        else:
            self._settle(self._running.pop(future), value)

    def _known(self, group: Group, hashes: Sequence[str]) -> None:
        """The group's content is known: finished before, being worked on for another group, or to be done."""
        job = self._job
        key = key_of(job.command, job.tool, job.parameters, hashes)
        content = None if job.again else self._store.get(key)
        if content is not None:
            self._end(group, KEPT, key, content, seconds=content["seconds"])
        elif key in self._waiting:
            self._waiting[key].append(group)
        elif job.again and any(row.key == key for row in self._rows.values()):
            before = next(row for row in self._rows.values() if row.key == key)
            self._end(group, before.state, key, before.content, error=before.error, seconds=before.seconds)
        else:
            self._waiting[key], self._hashes[key] = [group], list(hashes)
            names = tuple(str(path) for path in group.files)
            task = Task(job.command, names, job.arguments, job.writes, job.timeout_s)
            self._running[self._submit(run_task, task)] = key

    def _settle(self, key: str, outcome: Outcome) -> None:
        job = self._job
        error = outcome.error
        if not error and outcome.tool != job.tool:
            error = f"the worker has jtqd {outcome.tool}, expected {job.tool} as here"
        if error:
            self._end_all(key, FAILED, None, error=error, seconds=outcome.seconds)
            return
        content = self._store.put(
            key,
            {
                "command": job.command,
                "tool": outcome.tool,
                "parameters": dict(job.parameters),
                "logs_sha256": self._hashes[key],
                "exit_status": outcome.exit_status,
                "seconds": outcome.seconds,
                "result": outcome.result,
            },
            outcome.files,
        )
        self._end_all(key, DONE, content, seconds=outcome.seconds)

    def _end_all(
        self,
        key: str,
        state: str,
        content: Mapping[str, Any] | None,
        *,
        error: str = "",
        seconds: float = 0.0,
    ) -> None:
        for group in self._waiting.pop(key):
            self._end(group, state, key, content, error=error, seconds=seconds)

    def _end(
        self,
        group: Group,
        state: str,
        key: str | None,
        content: Mapping[str, Any] | None = None,
        *,
        error: str = "",
        seconds: float = 0.0,
    ) -> None:
        row = Row(group, state, key, content, error, seconds)
        self._rows[group.name] = row
        self._progress(row)


def _words(error: Exception) -> str:
    """One line for what a worker raised."""
    if type(error).__name__ == _KILLED:
        return "the workers that tried it died"
    if isinstance(error, OSError) and error.filename:
        return f"{error.filename}: {error.strerror}"
    text = str(error).strip().splitlines()
    return f"{type(error).__name__}: {text[0] if text else 'no reason given'}"
