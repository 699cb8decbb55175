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

import gc
import os
import socket
import statistics
import sys
import time
from dataclasses import dataclass, field
from functools import partial
from math import nan, sqrt
from typing import Any

from jtqd.daemon.core.schedule import Grid
from tests.benchmarks import contender
from tests.benchmarks.contender import Process, Task, die_with_parent, python, serve
from tests.benchmarks.fixture import Fixture
from tests.benchmarks.measure import CycleMeter, mark_beside_error, punctual, quantile, table

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
        self.slots += cycles
        self.missed.append(result["missed"])
        self.late_us += [value * 1e-3 for value in result["late_ns"]]

    def figures(self) -> dict[str, Any]:
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
    where = contender.cpus()
    traffic = contender.traffic(fixture.directory, where)
    task = Task(f"unix:{fixture.directory / 'bus'}", fixture.directory, where.loop)
    answering = [] if where.traffic is None else [str(where.traffic)]
    processes = {
        JTQD: Process(python("contender_jtqd", task.to_json()), JTQD),
        BARE: Process(python("long_run", task.to_json(), "once"), "the sleeper"),
        TWICE: Process(python("long_run", task.to_json(), "twice"), "the sleeper of two sleeps"),
        WAKING: Process(python("long_run", task.to_json(), "waking", *answering), "the waking sleeper"),
    }
    loops = {name: Loop() for name in processes}
    load = contender.OtherLoad()
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
    form = "{slots:.0f} {missed:.0f} {rate:.0f} {late_median_us:.0f} {late_p99_us:.0f} {late_p999_us:.0f} {late_max_us:.0f}"
    rows = [
        [name, *form.format(rate=1e6 * f["missed"] / f["slots"], **f).split()]
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


# The bare loops, as processes: `python -m tests.benchmarks.long_run TASK once|twice|waking [CPU]`.

_PERIOD_NS = 1_000_000
_SECOND_SLEEP_NS = 500_000
_WORK_NS = 60_000
"""What a whole cycle of jtqd takes on the fixture (docs/results.md, stages)."""
_FRAME = bytes(16)
_ANSWERS = 5
_ANSWERING_PRIORITY = 50
"""As the traffic source that answers jtqd."""


class Sleeper:
    """Same grid, same scheduling, same rule for a missed slot as jtqd's loop."""

    def __init__(self, task: Task) -> None:
        punctual(task.cpu, task.priority)
        gc.freeze()
        gc.disable()

    def in_slot(self, slot_ns: int) -> None:
        """Do what belongs to a slot that was begun in time."""

    def run(self, cycles: int, first_slot_ns: int | None = None) -> dict[str, Any]:
        meter = CycleMeter()
        grid = Grid(first_slot_ns or time.monotonic_ns() + 2 * _PERIOD_NS, _PERIOD_NS)
        end_ns = grid.slot_ns + cycles * _PERIOD_NS
        while grid.slot_ns < end_ns:
            _sleep_until(grid.slot_ns)
            now = time.monotonic_ns()
            if grid.too_late(now):
                grid.missed += 1
            else:
                meter.late_ns.append(now - grid.slot_ns)
                self.in_slot(grid.slot_ns)
            meter.cycle_done()
            grid.advance(time.monotonic_ns())
        return meter.result(grid.missed)


def _sleep_until(until_ns: int) -> None:
    pause = until_ns - time.monotonic_ns()
    if pause > 0:
        time.sleep(pause * 1e-9)


class TwiceSleeper(Sleeper):
    """... and in each slot a second sleep, then work."""

    def in_slot(self, slot_ns: int) -> None:
        """Sleep where jtqd waits for its inputs, and compute for as long as its cycle does."""
        _sleep_until(slot_ns + _SECOND_SLEEP_NS)
        done_ns = time.monotonic_ns() + _WORK_NS
        while time.monotonic_ns() < done_ns:
            pass


class WakingSleeper(Sleeper):
    """... and in each slot one datagram to a process on another core, which answers with five."""

    def __init__(self, task: Task, answering_cpu: int | None) -> None:
        self._socket, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        if os.fork() == 0:
            die_with_parent()
            self._socket.close()
            _answer(other, answering_cpu)
        other.close()
        self._socket.setblocking(False)
        super().__init__(task)

    def in_slot(self, slot_ns: int) -> None:
        """Take what was answered to the datagram of the last slot, and send the next one."""
        try:
            for _ in range(_ANSWERS):
                self._socket.recv(len(_FRAME))
        except BlockingIOError:
            pass  # the other core was away as well: the next slot takes them
        self._socket.send(_FRAME)


def _answer(port: socket.socket, cpu: int | None) -> None:
    """Be the process that answers, until the other end has gone."""
    punctual(cpu, _ANSWERING_PRIORITY)
    while port.recv(len(_FRAME)):
        for _ in range(_ANSWERS):
            port.send(_FRAME)
    os._exit(0)


if __name__ == "__main__":
    kind, *cpu = sys.argv[2:]
    waking = partial(WakingSleeper, answering_cpu=int(cpu[0]) if cpu else None)
    sys.exit(serve({"once": Sleeper, "twice": TwiceSleeper, "waking": waking}[kind]))
