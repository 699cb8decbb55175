"""What is measured in a contender's process, the figures made of it, and plain text tables."""

from __future__ import annotations

import ctypes
import os
import resource
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from math import isnan
from typing import Any

SETTLE_CYCLES = 200
"""Cycles at the beginning of a round that do not count: a cold cache is not what a loop lives with."""


def punctual(cpu: int | None, priority: int) -> bool:
    """Give this process, and the threads it will start, what realtime.prepare gives jtqd's loop; False without FIFO."""
    ctypes.CDLL(None).prctl(29, ctypes.c_ulong(1), 0, 0, 0)  # PR_SET_TIMERSLACK
    if cpu is not None:
        os.sched_setaffinity(0, {cpu})
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError:
        return False
    return True


@dataclass
class CycleMeter:
    """CPU of the whole process (all threads, user and kernel) at the end of each cycle, and when the estimate was sent."""

    cpu_ns: list[int] = field(default_factory=list)
    answer_ns: list[int] = field(default_factory=list)
    after_last_ns: list[int] = field(default_factory=list)
    """From the last input's stamp until the estimate was sent; -1 where an input was missing, empty where nobody looks."""
    late_ns: list[int] = field(default_factory=list)
    published: int = 0

    def __post_init__(self) -> None:
        self._switches = resource.getrusage(resource.RUSAGE_SELF).ru_nvcsw

    def sent(self, sync_ns: int) -> None:
        """The estimate of the SYNC sent at `sync_ns` (CLOCK_MONOTONIC) has been handed to the socket."""
        self.answer_ns.append(time.monotonic_ns() - sync_ns)

    def cycle_done(self) -> None:
        """The cycle has ended; CLOCK_PROCESS_CPUTIME_ID is read here, 0.7 us that count for every contender alike."""
        self.cpu_ns.append(time.process_time_ns())

    def result(self, missed: int) -> dict[str, Any]:
        return {
            "cpu_ns": self.cpu_ns,
            "answer_ns": self.answer_ns,
            "after_last_ns": self.after_last_ns,
            "late_ns": self.late_ns,
            "published": self.published,
            "missed": missed,
            "switches": resource.getrusage(resource.RUSAGE_SELF).ru_nvcsw - self._switches,
        }


@dataclass
class Samples:
    """Cycles of one contender over all rounds."""

    cpu_us: list[float] = field(default_factory=list)
    answer_us: list[float] = field(default_factory=list)
    after_last_us: list[float] = field(default_factory=list)
    medians_us: list[float] = field(default_factory=list)
    cycles: int = 0
    published: int = 0
    missed: int = 0
    switches: int = 0

    def add(self, result: dict[str, Any]) -> None:
        ends = result["cpu_ns"][SETTLE_CYCLES:]
        costs = [(after - before) * 1e-3 for before, after in pairwise(ends)]
        self.cpu_us += costs
        self.medians_us.append(quantile(costs, 0.5))
        self.answer_us += [value * 1e-3 for value in result["answer_ns"][SETTLE_CYCLES:]]
        after = result.get("after_last_ns", [])[SETTLE_CYCLES:]
        self.after_last_us += [value * 1e-3 for value in after if value >= 0]
        self.cycles += len(result["cpu_ns"])
        self.published += result["published"]
        self.missed += result["missed"]
        self.switches += result["switches"]

    def figures(self) -> dict[str, float]:
        cycles = max(self.cycles, 1)
        return {
            "cpu_median_us": quantile(self.cpu_us, 0.5),
            "cpu_p99_us": quantile(self.cpu_us, 0.99),
            "cpu_mean_us": sum(self.cpu_us) / max(len(self.cpu_us), 1),
            "round_median_low_us": min(self.medians_us, default=float("nan")),
            "round_median_high_us": max(self.medians_us, default=float("nan")),
            "answer_median_us": quantile(self.answer_us, 0.5),
            "answer_p99_us": quantile(self.answer_us, 0.99),
            "after_last_median_us": quantile(self.after_last_us, 0.5),
            "after_last_p99_us": quantile(self.after_last_us, 0.99),
            "cycles": self.cycles,
            "with_torque_percent": 100.0 * self.published / cycles,
            "published": self.published,
            "missed": self.missed,
            "switches_per_cycle": self.switches / cycles,
        }


def quantile(values: list[float], share: float) -> float:
    """Value below which `share` of the values lie; NaN without values."""
    if not values:
        return float("nan")
    return sorted(values)[min(int(share * len(values)), len(values) - 1)]


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Columns as wide as they must be; the first one to the left, the others to the right."""
    lines = [list(head), *map(list, rows)]
    widths = [max(len(line[n]) for line in lines) for n in range(len(head))]

    def text(line: Sequence[str]) -> str:
        cells = [
            cell.ljust(w) if n == 0 else cell.rjust(w)
            for n, (cell, w) in enumerate(zip(line, widths, strict=True))
        ]
        return "  ".join(cells).rstrip()

    return "\n".join([text(lines[0]), "  ".join("-" * w for w in widths), *map(text, lines[1:])])


def mark(value: float, limit: float, *, at_least: bool = False) -> str:
    if isnan(value):
        return "not measured"
    good = value >= limit if at_least else value <= limit
    wrong = "under" if at_least else "over"
    return f"{'PASS' if good else wrong} ({'>=' if at_least else '<='} {limit:g})"


def mark_beside_error(value: float, error: float, limit: float) -> str:
    """PASS or over only where the limit is more than two standard errors away, else that the two cannot be told apart."""
    if isnan(value) or isnan(error):
        return "not measured"
    if abs(value - limit) <= 2.0 * error:
        return f"cannot be told from {limit:g}"
    return mark(value, limit)
