"""Steps of the start and of the end: bench, boot of the nodes, answers of children; all end early when the operator says."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from daemon.config import Config
from daemon.master.boot_request import boot_request
from daemon.master.bus_load import bus_load_of
from daemon.master.bus_service import nodes_of
from daemon.master.returning_nodes import gear_ratio_error
from daemon.supervisor.children import Child, ChildSilence
from drivers.bus_load import BusLoad, BusLoadError, check_bus_load
from drivers.errors import BusError
from drivers.frame import pack

_WARM_UP_TIMEOUT_S = 60.0
"""Generous: a controller that loads its libraries from a slow card may take its time; nothing is published meanwhile."""
_BENCH_PRIORITY = 40
_NMT_PRE_OPERATIONAL = 0x80

StartChild = Callable[[str, list[str], str], Child]
Stopped = Callable[[], bool]


class SupervisorError(Exception):
    """The daemon cannot start; the message is one line for the operator."""


def checked_load(config: Config) -> BusLoad:
    """Worst bus load of a configuration. Raises SupervisorError: it does not fit."""
    try:
        return check_bus_load(bus_load_of(config))
    except BusLoadError as error:
        raise SupervisorError(f"{config.path}: {error}") from None


def log_directory(record: str | None) -> Path | None:
    """Where logs go, from the option `--record`, made where it is missing; None: nowhere.

    A disk that is full, read-only or closed to us now may not be so later: that is the recorder's to say and to wait for.

    Raises:
        SupervisorError: the path can be no directory, whatever becomes of the disk.
    """
    if record == "none":
        return None
    if record is None:
        record = os.environ.get("LOGS_DIRECTORY", "").split(":")[0] or "logs"
    if not record:
        raise SupervisorError("--record '': expected a directory for logs, or none")
    directory = Path(record)
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise SupervisorError(
            f"--record {record}: found a file there, expected a directory for logs"
        ) from None
    except FileNotFoundError:  # the way there exists, and takes none: /proc, a link that leads nowhere
        raise SupervisorError(f"--record {record}: no directory can be made there") from None
    except OSError:
        pass
    return directory


def start_bench(config: Config, bus: str, start_child: StartChild) -> Child:
    """The emulated bench on `bus` ("unix:PATH"). Raises SupervisorError."""
    path = Path(bus.removeprefix("unix:"))
    path.unlink(missing_ok=True)
    bench = start_child("sim_can", ["--bus", bus], "the emulated bench")
    deadline = time.monotonic() + _WARM_UP_TIMEOUT_S
    while not path.exists():
        if not bench.alive():
            raise SupervisorError(f"the emulated bench ended with exit status {bench.process.returncode}")
        if time.monotonic() > deadline:
            raise SupervisorError("the emulated bench did not open its bus")
        time.sleep(0.01)
    if config.realtime.priority > _BENCH_PRIORITY:
        # The emulated nodes stand for hardware: they come before everything but the loop.
        with suppress(PermissionError):
            os.sched_setscheduler(bench.pid, os.SCHED_FIFO, os.sched_param(_BENCH_PRIORITY))
    return bench


def boot_nodes(config: Config, bus: str, start_child: StartChild, stopped: Stopped) -> dict[str, Any] | None:
    """Boot all nodes; the report holds their scaling. None when we were told to stop. Raises SupervisorError."""
    child = start_child("drivers.boot", [], "the boot")
    child.tell(boot_request(config, bus))
    child.end_of_input()
    report = wait_for(child, stopped)
    if report is None:
        return None
    if not report["ok"]:
        raise SupervisorError(report["error"]["message"])
    return report


def check_gears(config: Config, report: dict[str, Any]) -> str | None:
    """What is wrong with a gear ratio that a device tells; None where all fit."""
    for number, booted in report["nodes"].items():
        wrong = gear_ratio_error(config, int(number), booted.get("gear_ratio"))
        if wrong is not None:
            return wrong
    return None


def wait_for(child: Child, stopped: Stopped) -> dict[str, Any] | None:
    """The child's next answer; None when we were told to stop.

    Raises:
        ChildError: it ended, or kept silent for too long.
        SupervisorError: it says that it has failed.
    """
    deadline = time.monotonic() + _WARM_UP_TIMEOUT_S
    while not stopped():
        try:
            answer = child.answer(0.25)
        except ChildSilence:
            if time.monotonic() > deadline:
                raise
            continue
        if "failed" in answer:
            raise SupervisorError(str(answer["failed"]))
        return None if stopped() else answer
    return None


def put_back(config: Config, send: Callable[[bytes], bool]) -> None:
    """The SYNC has ended, or never begun: the nodes that were started are pre-operational again."""
    for node in nodes_of(config):
        try:
            send(pack(0x000, bytes((_NMT_PRE_OPERATIONAL, node))))
        except BusError:
            return
