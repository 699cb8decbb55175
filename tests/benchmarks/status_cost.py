"""`status`: what it costs the loop that others can look at it: counters, inputs, nodes and the estimate in shared memory."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from jtqd.daemon.config import load_config
from jtqd.daemon.core.counters import LoopCounters
from jtqd.daemon.core.input_pdos import input_pdos
from jtqd.daemon.core.intake import Intake
from jtqd.daemon.shared import cycle_record as cr
from jtqd.daemon.shared.snapshot import STATUS_CODES, Snapshot

EVERY = 8
"""Cycles between two snapshots."""
LIMIT_NS = 1_000.0
"""Of what the status view needs, on average per cycle; the counters of each cycle are not among it."""
_REALTIME_NS = 1_700_000_000_000_000_000
_FLAGS = cr.FLAG_COMPLETE | cr.FLAG_PUBLISHED | cr.FLAG_BEFORE_NEXT_SYNC


class _Socket:
    tx_dropped = rx_dropped = 0


def run(directory: Path, *, rounds: int = 9, cycles: int = 20_000) -> dict[str, Any]:
    """CPU time in ns, least of `rounds`: `snapshot` one write with its flush, `statuses` and `counters` in each cycle."""
    intake = Intake(input_pdos(load_config(None)))
    for state in intake.views():
        state.fresh, state.stamp_ns = True, _REALTIME_NS + 300_000
    intake.sync_stamp_ns = _REALTIME_NS
    for node in (1, 2, 3):
        intake.nodes.heartbeat(node, 5, _REALTIME_NS)
    snapshot = Snapshot(directory / "snapshot", 1e-3, 0.8)
    counters = LoopCounters(snapshot, intake, _Socket())  # type: ignore[arg-type]
    view, sample = (1.0,) * 6 + (0x27, 2, 0, 7, 0), (1.0,) * 12 + (0x27, 2, 0, 7)

    def write(n: int) -> None:
        counters.flush(0, n)
        counters.last.write(n, 1, _REALTIME_NS, (view, view), sync_monotonic_ns=n, measured=(sample, sample))

    def statuses(n: int) -> None:
        spent = snapshot.status_cycles
        spent[2] += 1
        spent[STATUS_CODES + 2] += 1

    def count(n: int) -> None:
        counters.cycle(_FLAGS, 200_000, 20_000, 0)

    def nothing(n: int) -> None:
        pass

    times: dict[str, list[float]] = {"snapshot": [], "statuses": [], "counters": [], "call": []}
    for _ in range(rounds):
        for name, body in (
            ("snapshot", write),
            ("statuses", statuses),
            ("counters", count),
            ("call", nothing),
        ):
            start = time.thread_time_ns()
            for n in range(cycles):
                body(n)
            times[name].append((time.thread_time_ns() - start) / cycles)
    found = {name: min(each) for name, each in times.items()}
    call = found.pop("call")
    found = {f"{name}_ns": value - call for name, value in found.items()}
    return found | {"average_ns": found["snapshot_ns"] / EVERY + found["statuses_ns"], "limit_ns": LIMIT_NS}


def text(result: dict[str, Any]) -> str:
    """The same for people."""
    mark = "PASS" if result["average_ns"] < LIMIT_NS else "over"
    return (
        f"status: a snapshot takes {result['snapshot_ns']:.0f} ns, every {EVERY}th cycle, "
        f"statuses {result['statuses_ns']:.0f} ns in each:\n"
        f"        {result['average_ns']:.0f} ns per cycle on average ({mark}, below {LIMIT_NS:.0f}); "
        f"counters and histograms of each cycle {result['counters_ns']:.0f} ns"
    )
