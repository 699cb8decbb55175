"""`status`: what it costs the loop that others can look at it: counters, inputs, nodes and the estimate in shared memory."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from tests.daemon.loop.cycle_helpers import inputs, make, turn

EVERY = 8
"""Cycles between two snapshots."""
LIMIT_NS = 1_000.0
"""Of a snapshot, on average per cycle; the counters of each cycle are not in it."""


def run(directory: Path, *, rounds: int = 9, count: int = 20_000) -> dict[str, Any]:
    """Return the CPU time of one snapshot [ns], least of `rounds`, and on average per cycle."""
    cycle, _, _ = make(directory, lambda _: inputs())
    turn(cycle, 50)
    times = []
    for _ in range(rounds):
        start = time.thread_time_ns()
        for _ in range(count):
            cycle.write_snapshot()
        times.append((time.thread_time_ns() - start) / count)
    return {"snapshot_ns": min(times), "average_ns": min(times) / EVERY, "limit_ns": LIMIT_NS}


def text(result: dict[str, Any]) -> str:
    """The same for people."""
    mark = "PASS" if result["average_ns"] < LIMIT_NS else "over"
    return (
        f"status: a snapshot takes {result['snapshot_ns']:.0f} ns, every {EVERY}th cycle: "
        f"{result['average_ns']:.0f} ns per cycle on average ({mark}, below {LIMIT_NS:.0f})"
    )
