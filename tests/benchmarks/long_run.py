"""`grid`: jtqd's loop for minutes, a bare sleeping loop on the same core at the same time, missed slots of both."""

from __future__ import annotations

from typing import Any

from tests.benchmarks import host
from tests.benchmarks.contender import Process, Task, python
from tests.benchmarks.fixture import Fixture
from tests.benchmarks.measure import quantile
from tests.benchmarks.table import mark, table

BEYOND_LIMIT = 50.0
"""Missed slots per million above those of the bare loop beside it."""
_ROUND_S = 60.0
"""Results are collected every minute, so that a long run needs no more memory than a short one."""


def run(fixture: Fixture, *, minutes: float) -> dict[str, Any]:
    """Run both for `minutes`, as the machine is: no core is kept awake."""
    where = host.cpus()
    traffic = host.traffic(fixture.directory, where)
    task = Task(f"unix:{fixture.directory / 'bus'}", fixture.directory, where.loop)
    loops = {
        "jtqd": Process(python("contender_jtqd", task.to_json()), "jtqd"),
        "bare sleep": Process(python("sleeper", task.to_json()), "the sleeper"),
    }
    totals: dict[str, dict[str, Any]] = {name: {"slots": 0, "missed": 0, "late_us": []} for name in loops}
    load = host.OtherLoad()
    left = minutes * 60.0
    try:
        while left > 1e-3:
            cycles = round(min(left, _ROUND_S) * 1000)
            left -= cycles * 1e-3
            for process in loops.values():
                process.start(cycles)
            for name, process in loops.items():
                result = process.result()
                totals[name]["slots"] += cycles
                totals[name]["missed"] += result["missed"]
                totals[name]["late_us"] += [value * 1e-3 for value in result["late_ns"]]
    finally:
        for process in (*loops.values(), traffic):
            process.end()
    beyond = [1e6 * each["missed"] / each["slots"] for each in totals.values()]
    return {
        "minutes": minutes,
        "missed_beyond_per_million": beyond[0] - beyond[1],
        "cpus_busy": load.cpus_busy(),
        "loops": {name: _figures(**total) for name, total in totals.items()},
    }


def _figures(slots: int, missed: int, late_us: list[float]) -> dict[str, float]:
    return {
        "slots": slots,
        "missed": missed,
        "late_median_us": quantile(late_us, 0.5),
        "late_p99_us": quantile(late_us, 0.99),
        "late_p999_us": quantile(late_us, 0.999),
        "late_max_us": max(late_us, default=float("nan")),
    }


def text(result: dict[str, Any]) -> str:
    """Both loops side by side."""
    rows = [
        [
            name,
            f"{f['slots']:.0f}",
            f"{f['missed']:.0f}",
            f"{1e6 * f['missed'] / f['slots']:.0f}",
            f"{f['late_median_us']:.0f}",
            f"{f['late_p99_us']:.0f}",
            f"{f['late_p999_us']:.0f}",
            f"{f['late_max_us']:.0f}",
        ]
        for name, f in result["loops"].items()
    ]
    head = ["", "slots", "missed", "per million", "late us median", "p99", "p99.9", "max begun"]
    title = f"1 kHz for {result['minutes']:g} min, both on one core at the same time, {result['cpus_busy']:.1f} CPUs busy"
    beyond = result["missed_beyond_per_million"]
    verdict = f"missed beyond the bare loop's {beyond:6.0f} per million  {mark(beyond, BEYOND_LIMIT)}"
    return f"{title}\n\n{table(head, rows)}\n\n{verdict}"
