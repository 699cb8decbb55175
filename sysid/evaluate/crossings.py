"""Jumps of the estimate where a joint changes its quadrant: at v = 0 and at tau = 0. Pure.

    jump = R(estimate) - max R(sensor),      R: max - min over 20 ms

What the torque itself does in that time is not held against the estimate, and a spike that comes and goes is not missed.
The maximum is over the sensor's windows shifted by up to 10 ms: the torque of a reversing joint swings by 10 Nm in 20 ms,
and an estimate that follows it 2 ms late is late and does not jump. `unshifted_nm` is without that allowance.

`at` the crossing: the 20 ms around it. Over the `passage`: the largest of any 20 ms of the whole passage through
|v| <= 0.02 rad/s (or |tau| <= 0.3 Nm), entry and exit of the standstill status included, however long the joint rested.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from estimator.friction import FloatArray
from sysid.evaluate.samples import Samples

WINDOW_S: Final = 0.02
LIMIT_NM: Final = 0.2
VELOCITY_BAND_RAD_S: Final = 0.02
"""Twice the standstill threshold: outside of it the joint moves for every method."""
TORQUE_BAND_NM: Final = 0.3
"""Above the sensor's noise: its zero is crossed once, not twenty times."""


class Crossing(NamedTuple):
    """A change of sign: sample `start` is the first within the band, `at` the first that is for good on the other side
    of zero, `end` the first beyond the band.
    """

    start: int
    at: int
    end: int


class Jump(NamedTuple):
    """The largest jump [Nm] of one method and where it was; median over all `crossings`; largest one unshifted.

    elsewhere_nm: what one in `crossings` windows anywhere in motion exceeds: as much is noise and dynamics, not crossing.
    """

    nm: float
    run: str
    number: int
    time_s: float
    of: str
    crossings: int
    median_nm: float
    unshifted_nm: float
    elsewhere_nm: float


def crossings(values: FloatArray, band: float) -> list[Crossing]:
    """Return the changes of sign of values [n], with a hysteresis of +-band."""
    side = np.where(values > band, 1, np.where(values < -band, -1, 0))
    outside = np.flatnonzero(side)
    changed = np.flatnonzero(side[outside[:-1]] != side[outside[1:]])
    found = []
    for before, after in zip(outside[changed], outside[changed + 1], strict=True):
        inside = values[before : after + 1]
        last = np.flatnonzero(inside * side[before] >= 0.0)[-1]  # after it the old side is not seen again
        found.append(Crossing(int(before) + 1, int(before + last) + 1, int(after)))
    return found


def jumps_around(estimate_nm: FloatArray, sensor_nm: FloatArray, width: int, shift: int = 0) -> FloatArray:
    """Return the jump over the `width` samples around each sample [n]; NaN at the ends and where the estimate has gaps.

    width: odd; shift: samples by which the sensor's window may lie to either side.
    """
    jump = np.full(len(estimate_nm), np.nan)
    if len(estimate_nm) < width:
        return jump
    own, allowed = (np.ptp(sliding_window_view(each, width), axis=1) for each in (estimate_nm, sensor_nm))
    if shift:
        allowed = sliding_window_view(np.pad(allowed, shift, mode="edge"), 2 * shift + 1).max(axis=1)
    jump[width // 2 : width // 2 + len(own)] = own - allowed
    return jump


def largest_jump(samples: Iterable[Samples], method: str, *, passage: bool = False) -> Jump | None:
    """Return the largest jump of a method over all crossings of all runs; None where nothing is crossed."""
    found: list[tuple[float, Samples, int, str]] = []
    unshifted, elsewhere = [], []
    for each in samples:
        if method not in each.estimate_nm:
            continue
        reach = round(0.5 * WINDOW_S / float(np.median(np.diff(each.time_s))))
        estimate = each.estimate_nm[method]
        jump = jumps_around(estimate, each.sensor_nm, 2 * reach + 1, reach)
        strict = jumps_around(estimate, each.sensor_nm, 2 * reach + 1)
        elsewhere.append(jump[each.scored & np.isfinite(jump)])
        for of, one in _all_crossings(each):
            inside = slice(one.at, one.at + 1)
            if passage:
                inside = slice(max(one.start - reach, 0), one.end + reach + 1)
            if np.isfinite(jump[inside]).any():
                at = inside.start + int(np.nanargmax(jump[inside]))
                found.append((float(jump[at]), each, at, of))
                unshifted.append(float(np.nanmax(strict[inside])))
    if not found:
        return None
    size, each, at, of = max(found, key=lambda item: item[0])
    median = float(np.median([item[0] for item in found]))
    anywhere = np.concatenate(elsewhere)
    beyond = float(np.quantile(anywhere, 1.0 - 1.0 / len(found))) if len(anywhere) else np.nan
    time_s = float(each.time_s[at])
    return Jump(size, each.run, each.number, time_s, of, len(found), median, max(unshifted), beyond)


def _all_crossings(samples: Samples) -> list[tuple[str, Crossing]]:
    """The crossings of both quantities; where the observer was not running the velocity counts as zero."""
    velocity = np.nan_to_num(samples.velocity_rad_s)
    return [
        *(("v = 0", one) for one in crossings(velocity, VELOCITY_BAND_RAD_S)),
        *(("tau = 0", one) for one in crossings(samples.sensor_nm, TORQUE_BAND_NM)),
    ]
