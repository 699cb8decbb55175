"""`service`: what the loop pays for being looked at and watched: snapshots in shared memory, systemd's watchdog."""

from __future__ import annotations

import socket
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from jtqd.daemon.core.cycle import Cycle
from jtqd.daemon.loop.process import Duties
from jtqd.daemon.shared.processes import LoopWatchdog, Notifier
from tests.benchmarks.measure import mark
from tests.daemon.loop.cycle_helpers import inputs, make, turn

LIMIT_NS = 1_000.0
"""Of the duties, and of the snapshot, on average per cycle; the counters of each cycle are not in it."""
EVERY = 8
"""Cycles between two snapshots."""
WATCHDOG_S = 2.0
PERIOD_NS = 1_000_000


def run(directory: Path, *, rounds: int = 9, cycles: int = 4000) -> dict[str, Any]:
    """Return the time of one datagram to the service manager [us] and of the duties of a cycle [ns]."""
    manager = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    manager.bind(str(directory / "notify"))
    manager.setblocking(False)
    notifier = Notifier({"NOTIFY_SOCKET": str(directory / "notify")})
    cycle, _, _ = make(directory, lambda _: inputs(), slots=4096)
    turn(cycle, 50)

    def datagram() -> None:
        notifier.send("WATCHDOG=1")
        manager.recv(64)

    # Sending alone: the manager's side is not ours.
    sent = _median_us(datagram, 500, only=lambda: notifier.send("WATCHDOG=1"), after=lambda: manager.recv(64))
    duties = Duties(cycle, LoopWatchdog(notifier, PERIOD_NS, WATCHDOG_S))
    per_cycle = min(_per_call_ns(duties, manager, cycles) for _ in range(rounds))
    snapshot_ns = min(_snapshot_ns(cycle, 20_000) for _ in range(rounds))
    return {"datagram_us": sent, "duties_ns": per_cycle, "snapshot_ns": snapshot_ns}


def _snapshot_ns(cycle: Cycle, count: int) -> float:
    start = time.thread_time_ns()
    for _ in range(count):
        cycle.write_snapshot()
    return (time.thread_time_ns() - start) / count


def _per_call_ns(duties: Duties, manager: socket.socket, cycles: int) -> float:
    began = time.process_time_ns()
    for _ in range(cycles):
        duties()
    used = (time.process_time_ns() - began) / cycles
    while True:  # its queue must not fill
        try:
            manager.recv(64)
        except BlockingIOError:
            return used


def _median_us(
    call: Callable[[], Any], count: int, *, only: Callable[[], Any], after: Callable[[], Any]
) -> float:
    call()
    times = []
    for _ in range(count):
        began = time.perf_counter_ns()
        only()
        times.append(time.perf_counter_ns() - began)
        after()
    return statistics.median(times) / 1000


def text(result: dict[str, Any]) -> str:
    snapshot_ns, average_ns = result["snapshot_ns"], result["snapshot_ns"] / EVERY
    return "\n".join(
        (
            "service: in the pauses of the loop",
            f"  duties, watchdog every {WATCHDOG_S * 0.1:g} s   {result['duties_ns']:8.0f} ns per cycle   "
            f"{mark(result['duties_ns'], LIMIT_NS)}",
            f"  snapshot, {snapshot_ns:.0f} ns every {EVERY}th cycle  {average_ns:8.0f} ns per cycle   "
            f"{mark(average_ns, LIMIT_NS)}",
            f"  one datagram to systemd        {result['datagram_us']:8.1f} us",
        )
    )
