"""Where the tasks run: this machine, or a dask cluster; both as a `concurrent.futures.Executor`."""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

from jtqd.sysid.batch.task import allow_running, end_running

_CONNECT_S = 10.0
_RETRIES = 0
"""A task that raised is not run again; one whose worker died is, by the scheduler itself (three times)."""


class ClusterError(Exception):
    """The cluster cannot be used; one line."""


@contextmanager
def executor(scheduler: str | None, jobs: int | None) -> Iterator[tuple[Executor, str]]:
    """The executor, and what it is in a few words.

    Args:
        scheduler: address of a dask scheduler; None: this machine.
        jobs: processes at a time on this machine; None: one per processor that we may use.

    Raises:
        ClusterError: dask is not installed, or nobody answers there.
    """
    if scheduler is None:
        count = jobs or len(os.sched_getaffinity(0))
        # A thread waits for each process: `jtqd.sysid.batch.task` gives every task one of its own.
        local = ThreadPoolExecutor(count)
        try:
            yield local, f"this machine, {count} at a time"
        finally:
            local.shutdown(wait=False, cancel_futures=True)
            end_running()
            local.shutdown(wait=True)
            allow_running()
        return
    client = _client(scheduler)
    try:
        workers = len(client.scheduler_info(n_workers=-1)["workers"])
        yield client.get_executor(retries=_RETRIES), f"{scheduler}, {workers} workers"
    finally:
        client.close(timeout=_CONNECT_S)


def _client(scheduler: str) -> Any:
    try:
        from distributed import Client
    except ImportError:
        raise ClusterError("--scheduler needs dask.distributed: pip install 'jtqd[cluster]'") from None
    try:
        return Client(scheduler, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ClusterError(
            f"{scheduler}: no dask scheduler answers: {error or type(error).__name__}"
        ) from None
