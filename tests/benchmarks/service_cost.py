"""`service`: what systemd and a reload cost the loop in its pauses: watchdog, orders, the steps of a swap of estimators."""

from __future__ import annotations

import hashlib
import socket
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from jtqd.daemon.config import SafetySettings, load_config
from jtqd.daemon.core.cycle import Cycle
from jtqd.daemon.loop.process import Duties, build_estimator
from jtqd.daemon.reload.block_file import encoded
from jtqd.daemon.reload.order import Order
from jtqd.daemon.reload.prepare import write
from jtqd.daemon.reload.swap import Swap
from jtqd.daemon.shared.cycle_record import RECORD_SIZE
from jtqd.daemon.shared.ring import RingReader
from jtqd.daemon.shared.systemd import LoopWatchdog, Notifier
from tests.daemon.loop.cycle_helpers import inputs, make, turn

LIMIT_NS = 1_000.0
"""Of the duties, on average per cycle."""
WATCHDOG_S = 2.0
PERIOD_NS = 1_000_000
BEHIND = 100
"""Cycles that the new estimators have not seen when the loop takes them."""
SLEEP_S = 900e-6


def run(directory: Path, *, rounds: int = 9, cycles: int = 4000) -> dict[str, Any]:
    """Times in us: one datagram to the manager, the duties of a cycle (ns), and the steps of a swap."""
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
    reports: list[dict[str, Any]] = []
    swap = Swap(cycle, directory / "ring", SafetySettings(), lambda **report: reports.append(report))
    duties = Duties(cycle, LoopWatchdog(notifier, PERIOD_NS, WATCHDOG_S), swap)
    per_cycle = min(_per_call_ns(duties, manager, cycles) for _ in range(rounds))
    return {"datagram_us": sent, "duties_ns": per_cycle} | _swap(directory, cycle, swap, reports)


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


def _swap(
    directory: Path, cycle: Cycle, swap: Swap, reports: list[dict[str, Any]], count: int = 20
) -> dict[str, Any]:
    """Swaps to the shipped estimators, BEHIND cycles behind, one step after each sleep of most of a period."""
    config = load_config(None)
    new = [build_estimator(config, joint) for joint in config.joints]
    swap.rehearse(new)
    steps: dict[str, list[float]] = {}
    for _ in range(count):
        position = RingReader(directory / "ring", RECORD_SIZE).backlog
        content = encoded(new, position)
        write(directory / "estimators", content)
        turn(cycle, BEHIND)
        swap.begin(Order(directory / "estimators", len(content), hashlib.sha256(content).hexdigest()))
        while swap.active:
            time.sleep(SLEEP_S)
            name, began = swap.next_step, time.perf_counter_ns()
            swap.take_step()
            steps.setdefault(name, []).append((time.perf_counter_ns() - began) / 1000)
    assert all("swapped" in each for each in reports), reports
    return {
        "file_bytes": len(content),
        "steps_us": {name: [statistics.median(each), max(each)] for name, each in steps.items()},
        "steps": {name: len(each) / count for name, each in steps.items()},
    }


def text(result: dict[str, Any]) -> str:
    """The table."""
    verdict = "PASS" if result["duties_ns"] <= LIMIT_NS else "over"
    return "\n".join(
        (
            "service: in the pauses of the loop",
            f"  duties, watchdog every {WATCHDOG_S * 0.1:g} s   {result['duties_ns']:8.0f} ns per cycle   "
            f"(at most {LIMIT_NS:.0f}: {verdict})",
            f"  one datagram to systemd        {result['datagram_us']:8.1f} us",
            f"  swap of both estimators ({result['file_bytes']} bytes, {BEHIND} cycles behind), steps after a sleep:",
            *(
                f"    {name:8} {result['steps'][name]:6.0f} times  median {median:6.0f} us  longest {longest:6.0f} us"
                for name, (median, longest) in result["steps_us"].items()
            ),
        )
    )
