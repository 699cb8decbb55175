"""`service`: what systemd and a reload cost the loop in the pause after a cycle: watchdog, orders, telling, taking over."""

from __future__ import annotations

import json
import socket
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from jtqd.daemon.core.cycle import Cycle
from jtqd.daemon.loop.process import Duties
from jtqd.daemon.reload import handover
from jtqd.daemon.reload.carry import Fill, Walk
from jtqd.daemon.reload.handover import Giver
from jtqd.daemon.shared.systemd import LoopWatchdog, Notifier
from tests.daemon.loop.cycle_helpers import inputs, make, turn

LIMIT_NS = 1_000.0
"""Of the duties, on average per cycle."""
WATCHDOG_S = 2.0
PERIOD_NS = 1_000_000


def run(directory: Path, *, rounds: int = 9, cycles: int = 4000) -> dict[str, Any]:
    """Times in us: one datagram to the manager, the duties of a cycle (ns), and the steps of a hand-over."""
    manager = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    manager.bind(str(directory / "notify"))
    manager.setblocking(False)
    notifier = Notifier({"NOTIFY_SOCKET": str(directory / "notify")})
    for name in ("a", "b"):
        (directory / name).mkdir()
    one, _, _ = make(directory / "a", lambda _: inputs())
    other, _, _ = make(directory / "b", lambda _: inputs())
    turn(one, 50)

    def datagram() -> None:
        notifier.send("WATCHDOG=1")
        manager.recv(64)

    # Sending alone: the manager's side is not ours.
    sent = _median_us(datagram, 500, only=lambda: notifier.send("WATCHDOG=1"), after=lambda: manager.recv(64))
    duties = Duties(
        one,
        LoopWatchdog(notifier, PERIOD_NS, WATCHDOG_S),
        Giver(one, directory / "handover"),
        lambda why: None,
    )
    per_cycle = min(_per_call_ns(duties, manager, cycles) for _ in range(rounds))
    return {"datagram_us": sent, "duties_ns": per_cycle} | _hand_over(one, other)


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


def _hand_over(one: Cycle, other: Cycle, count: int = 200) -> dict[str, float]:
    walk, fill = Walk(one), Fill(other)
    listing = []
    while walk.left:
        began = time.perf_counter_ns()
        found = json.dumps({"found": walk.step(6)})
        listing.append(time.perf_counter_ns() - began)
        fill.learn(json.loads(found)["found"])
    whole = []
    for _ in range(count):
        again = Walk(one)
        while again.step(6):
            pass
        began = time.perf_counter_ns()
        json.dumps({"state": handover.state_of(one, again), "end_ns": None}).encode()
        whole.append(time.perf_counter_ns() - began)
    handover.install(other, fill, json.loads(json.dumps(handover.state_of(one, walk))))
    tell, take = [], []
    for _ in range(count):
        turn(one, 1)
        began = time.perf_counter_ns()
        message = json.dumps({"state": handover.state_of(one, walk), "end_ns": None}).encode()
        told = time.perf_counter_ns()
        handover.install(other, fill, json.loads(message)["state"])
        tell.append(told - began)
        take.append(time.perf_counter_ns() - told)
    return {
        "list_us": max(listing) / 1000,
        "whole_us": statistics.median(whole) / 1000,
        "tell_us": statistics.median(tell) / 1000,
        "take_us": statistics.median(take) / 1000,
        "message_bytes": len(message),
    }


def text(result: dict[str, Any]) -> str:
    """The table."""
    verdict = "PASS" if result["duties_ns"] <= LIMIT_NS else "over"
    return "\n".join(
        (
            "service: in the pause after a cycle",
            f"  duties, watchdog every {WATCHDOG_S * 0.1:g} s   {result['duties_ns']:8.0f} ns per cycle   "
            f"(at most {LIMIT_NS:.0f}: {verdict})",
            f"  one datagram to systemd        {result['datagram_us']:8.1f} us",
            f"  hand-over: list, longest step  {result['list_us']:8.0f} us, once per cycle, a few cycles",
            f"  hand-over: tell what changed   {result['tell_us']:8.0f} us ({result['message_bytes']} bytes), "
            f"{result['tell_us'] / result['whole_us']:.2f} of what telling everything takes",
            f"  hand-over: take                {result['take_us']:8.0f} us, in the new loop",
        )
    )
