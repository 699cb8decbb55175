"""Measure the time of one step of each method on samples of an evaluated run: its part of jtqd's loop.

Every step is timed alone, as the loop would call it, with the loop's own estimators and networks; the methods take turns
in short blocks, so that a busy machine affects all alike, and the median leaves out the steps in which the machine did
something else. One process in a tight loop: caches are warmer than in a loop that sleeps between its cycles.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from time import perf_counter_ns
from typing import Final, NamedTuple

import numpy as np

from jtqd.estimator.methods import make_estimator
from jtqd.estimator.settings import recommended
from jtqd.sysid.evaluate.inputs import JudgedRun
from jtqd.sysid.evaluate.methods import OURS, PAPERS, JointModels

METHODS: Final = ("tob", PAPERS, OURS)
SAMPLES: Final = 3000
"""Steps per joint and method, from the middle of the run: it moves there."""
_BLOCK: Final = 100


class LoopTime(NamedTuple):
    """Median cost of a step [us] by method, summed over the joints that have all of METHODS; run: of the samples."""

    step_us: Mapping[str, float]
    joints: int
    samples: int
    run: str

    def extra_us(self, over: str) -> float:
        """Return what ours costs more than another method [us], all joints together."""
        return self.step_us[OURS] - self.step_us[over]


def loop_time(
    runs: Sequence[JudgedRun],
    models: Sequence[JointModels],
    clock_ns: Callable[[], int] = perf_counter_ns,
) -> LoopTime | None:
    """Return what steps cost on the first run that holds every such joint; None where no joint has all of METHODS."""
    whole = [each for each in models if set(METHODS) <= set(each.methods)]
    run = next((run for run in runs if whole and all(each.number in run.columns for each in whole)), None)
    if run is None:
        return None
    total = dict.fromkeys(METHODS, 0.0)
    for each in whole:
        rows = _rows(run, each)
        for method, cost in _costs_us(each, rows, clock_ns).items():
            total[method] += cost
    return LoopTime(total, len(whole), len(rows), run.name)


_Row = tuple[float, float, float, float, float]


def _rows(run: JudgedRun, models: JointModels) -> list[tuple[_Row, float]]:
    """Return ((dt, current, motor position, motor velocity, link position), temperature) of the middle of the run."""
    columns = run.columns[models.number]
    time_s = run.table.time_s
    begin = max((len(time_s) - SAMPLES) // 2, 1)
    at = slice(begin, begin + SAMPLES)
    names = ("current_a", "motor_position_rad", "motor_velocity_rad_s", "link_position_rad")
    values = [np.asarray(getattr(columns, name))[at].tolist() for name in names]
    warm = columns.temperature_c
    known = np.full(len(time_s), np.nan) if warm is None else np.asarray(warm)
    rows = zip(np.diff(time_s)[begin - 1 : begin - 1 + SAMPLES].tolist(), *values, strict=True)
    return list(zip(rows, known[at].tolist(), strict=True))


def _costs_us(
    models: JointModels, rows: list[tuple[_Row, float]], clock_ns: Callable[[], int]
) -> dict[str, float]:
    """Return the median cost of a step [us] by method."""
    steps = {
        method: make_estimator(models.joint, recommended(method), models.networks.get(method)).step
        for method in METHODS
    }
    took: dict[str, list[int]] = {method: [] for method in METHODS}
    for begin in range(0, len(rows), _BLOCK):
        for method, step in steps.items():
            times = took[method]
            for row, temperature_c in rows[begin : begin + _BLOCK]:
                began = clock_ns()
                step(*row, temperature_c)
                times.append(clock_ns() - began)
    return {method: float(np.median(times)) * 1e-3 for method, times in took.items()}
