"""`grid`: jtqd's loop for minutes beside three bare loops on the same core at the same time, missed slots of all four.

bare sleep     sleeps and looks at the clock: what it misses, nothing on this core could have kept
bare, twice    sleeps a second time in each slot and computes for as long as a cycle of jtqd takes: a core that is taken
               away costs it a slot at either sleep and during the work, as it does jtqd
bare, waking   wakes a process on the other core in each slot and takes its answers, as SYNC does on a unix bus

All lie on one grid of a millisecond, none at the time of another, and change places from round to round: how late a loop
wakes depends on what ran before it. They begin and end a round together, since what one does before and after it takes
the core from the others.

A machine that is shared takes a core away for milliseconds, now and then, from all loops alike. So a figure is the mean
of the differences of two loops in the same round, and its standard error is that of these differences from round to
round: without it a count of some hundred clustered misses says nothing. What jtqd misses beyond the bare sleep is all
that it adds; beyond the one that sleeps twice, what is not the form of a cycle that sends, waits and computes.
"""

from __future__ import annotations

import statistics
import time
from dataclasses import dataclass, field
from math import nan, sqrt
from typing import Any

from tests.benchmarks import host
from tests.benchmarks.contender import Process, Task, python
from tests.benchmarks.fixture import Fixture
from tests.benchmarks.measure import quantile
from tests.benchmarks.table import mark_beside_error, table

BEYOND_LIMIT = 50.0
"""Missed slots per million above those of the bare sleep beside it."""
_ROUND_S = 60.0
"""Results are collected every minute, so that a long run needs no more memory than a short one."""
_FEWEST_ROUNDS = 6
"""... or more often: fewer differences have no standard error worth the name. Always an even number (`_PLACES_US`)."""
JTQD, BARE, TWICE, WAKING = "jtqd", "bare sleep", "bare, twice", "bare, waking"
_READY_NS = 500_000_000
"""From the order to the first slot."""
_PLACES_US = {JTQD: (0, 125), TWICE: (125, 0), WAKING: (250, 750), BARE: (750, 250)}
"""Where in the millisecond the slots of a loop begin, in rounds in turns; the first two wake again 500 us later."""
_PAIRS = ((JTQD, BARE), (JTQD, TWICE), (TWICE, BARE), (WAKING, BARE))


@dataclass
class Loop:
    """Rounds of one loop."""

    slots: int = 0
    missed: list[int] = field(default_factory=list)
    late_us: list[float] = field(default_factory=list)

    def add(self, cycles: int, result: dict[str, Any]) -> None:
        """Take in one round."""
        self.slots += cycles
        self.missed.append(result["missed"])
        self.late_us += [value * 1e-3 for value in result["late_ns"]]

    def figures(self) -> dict[str, Any]:
        """Counts and quantiles."""
        return {
            "slots": self.slots,
            "missed": sum(self.missed),
            "missed_by_round": self.missed,
            "late_median_us": quantile(self.late_us, 0.5),
            "late_p99_us": quantile(self.late_us, 0.99),
            "late_p999_us": quantile(self.late_us, 0.999),
            "late_max_us": max(self.late_us, default=nan),
        }


def beyond(one: list[int], other: list[int], slots: int) -> dict[str, float]:
    """Return by how much one loop misses more than another per million slots, and the standard error of that.

    one, other: missed slots of each round, in which both ran at the same time; slots: of a round. Of one round: NaN.
    """
    differences = [1e6 * (a - b) / slots for a, b in zip(one, other, strict=True)]
    error = statistics.stdev(differences) / sqrt(len(differences)) if len(differences) > 1 else nan
    return {"per_million": statistics.fmean(differences), "error": error}


def run(fixture: Fixture, *, minutes: float) -> dict[str, Any]:
    """Run all for `minutes`, as the machine is: no core is kept awake."""
    where = host.cpus()
    traffic = host.traffic(fixture.directory, where)
    task = Task(f"unix:{fixture.directory / 'bus'}", fixture.directory, where.loop)
    answering = [] if where.traffic is None else [str(where.traffic)]
    processes = {
        JTQD: Process(python("contender_jtqd", task.to_json()), JTQD),
        BARE: Process(python("sleeper", task.to_json(), "once"), "the sleeper"),
        TWICE: Process(python("sleeper", task.to_json(), "twice"), "the sleeper of two sleeps"),
        WAKING: Process(python("sleeper", task.to_json(), "waking", *answering), "the waking sleeper"),
    }
    loops = {name: Loop() for name in processes}
    load = host.OtherLoad()
    rounds = max(_FEWEST_ROUNDS, 2 * round(minutes * 30.0 / _ROUND_S))
    cycles = max(1, round(minutes * 60_000 / rounds))
    try:
        for k in range(rounds):
            first_ns = time.monotonic_ns() + _READY_NS
            for name, process in processes.items():
                process.start(cycles, first_ns + 1000 * _PLACES_US[name][k % 2])
            for name, process in processes.items():
                loops[name].add(cycles, process.result())
    finally:
        for process in (*processes.values(), traffic):
            process.end()
    return {
        "minutes": minutes,
        "rounds": rounds,
        "beyond": {
            f"{one} beyond {other}": beyond(loops[one].missed, loops[other].missed, cycles)
            for one, other in _PAIRS
        },
        "cpus_busy": load.cpus_busy(),
        "loops": {name: loop.figures() for name, loop in loops.items()},
    }


def text(result: dict[str, Any]) -> str:
    """All loops side by side, and what one misses beyond another."""
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
    title = (
        f"1 kHz for {result['minutes']:g} min, all on one core at the same time, {result['cpus_busy']:.1f} CPUs busy; "
        f"errors from {result['rounds']} rounds"
    )
    lines = []
    for (one, other), each in zip(_PAIRS, result["beyond"].values(), strict=True):
        value, error = each["per_million"], each["error"]
        line = f"{one + ' beyond ' + other:<28}{value:6.0f} +- {error:.0f} per million"
        if (one, other) == (JTQD, BARE):
            line += f"  {mark_beside_error(value, error, BEYOND_LIMIT)}"
        lines.append(line)
    return f"{title}\n\n{table(head, rows)}\n\n" + "\n".join(lines)
