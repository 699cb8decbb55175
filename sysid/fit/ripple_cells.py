"""A run cut into cells of whole ripple periods, and the means over them: what is left when the ripple is averaged out.

A harmonic drive's ripple has 2 periods per motor revolution. A mean over whole periods does not contain it, however long
or short they are; a mean over a fixed time does, by an amount that depends on where it began.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jtqd.estimator.arrays import FloatArray
from jtqd.sysid.runs.channels import integral


class Cells(NamedTuple):
    """Consecutive cells: means [n, m] of m signals, edges [n] in s, and whether a cell may be used [n].

    Not usable: cells of a joint so slow that a ripple period takes longer than it may; they are cut by time instead.
    """

    means: FloatArray
    start_s: FloatArray
    end_s: FloatArray
    usable: NDArray[np.bool_]


def cut_cells(
    time_s: FloatArray,
    signals: Sequence[FloatArray],
    motor_velocity_rad_s: FloatArray,
    *,
    shortest_s: float,
    longest_s: float,
    periods_per_motor_rev: float,
) -> Cells:
    """Cut a run [n] into cells of as many whole ripple periods as take at least `shortest_s`.

    time_s rising, steps may be uneven; the angle is the motor velocity's integral, so that positions that roll over or
    are not measured do not matter.
    """
    distance = integral(time_s, np.abs(motor_velocity_rad_s))
    periods = distance * periods_per_motor_rev / math.tau
    starts, ends, usable = [], [], []
    start, last = float(time_s[0]), float(time_s[-1])
    while start + shortest_s <= last:
        at, ahead = np.interp((start, start + shortest_s), time_s, periods).tolist()
        end = _time_of(at + max(1, math.ceil(ahead - at - 1e-9)), time_s, periods)
        good = end - start <= longest_s
        if not good:
            end = start + shortest_s
        starts.append(start)
        ends.append(end)
        usable.append(good)
        start = end
    edges = np.array(starts), np.array(ends)
    means = np.array([means_between(time_s, signal, *edges) for signal in signals])
    return Cells(means.T, *edges, np.array(usable, np.bool_))


def means_between(
    time_s: FloatArray, signal: FloatArray, start_s: FloatArray, end_s: FloatArray
) -> FloatArray:
    """Return the means [m] of a signal [n] over [start, end] (each [m]), samples at the ends taken in part."""
    area = integral(time_s, signal)
    result: FloatArray = np.interp(end_s, time_s, area) - np.interp(start_s, time_s, area)
    return result / (end_s - start_s)


def _time_of(period: float, time_s: FloatArray, periods: FloatArray) -> float:
    """When the given number of ripple periods has passed; infinity if it never does."""
    index = int(np.searchsorted(periods, period))
    if index >= len(periods):
        return math.inf
    share = (period - periods[index - 1]) / (periods[index] - periods[index - 1])
    return float(time_s[index - 1] + share * (time_s[index] - time_s[index - 1]))
