"""Runs that are segments of one recording: they share its offset, its friction of the day and its errors, and count once.

A run left out shows nothing while another piece of the same recording is still there. Pieces are known by their names
("a.csv (2 of 3)": the reader cuts a recording at its gaps), or because one begins where another ends: stamps, positions of
both sides, velocity and temperature. Where stamps begin at zero again, two runs are one recording only if the joint moves at
the cut: many runs begin and end at rest in the same place.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Final

import numpy as np

from jtqd.sysid.diagnosis.signals import SLOWEST_RAD_S, JointSignals

_NAMED: Final = re.compile(r"(?P<of>.+) \((?P<piece>\d+) of (?P<all>\d+)\)")
_STEPS: Final = 3.0
"""Sampling steps between two pieces that were cut apart without a loss."""
_LOST_S: Final = 1.0
"""Gap between stamps that go on, at most."""
_ALIKE: Final = 0.05
"""Part of the range of velocities by which it may change over a cut."""
_WARMER_K: Final = 0.6
_AT_MOST_RAD: Final = 2e-3
"""Joint side: by how much positions may differ from the integrated velocity."""


def recordings(runs: Sequence[Sequence[JointSignals]]) -> list[int]:
    """Return the number of the recording that each run [run][joint] belongs to, from 0 in order of their first pieces."""
    count = len(runs)
    root = list(range(count))
    for a in range(count):
        for b in range(count):
            names = runs[a][0].run, runs[b][0].run
            if a != b and (_same_name(*names) or (_may_follow(*names) and _goes_on(runs[a], runs[b]))):
                old, new = max(root[a], root[b]), min(root[a], root[b])
                root = [new if r == old else r for r in root]
    order = sorted(set(root))
    return [order.index(r) for r in root]


def piece_notes(runs: Sequence[Sequence[JointSignals]]) -> list[str]:
    """Return one line per recording that came in pieces."""
    numbers = recordings(runs)
    out = []
    for k in range(max(numbers, default=-1) + 1):
        names = [run[0].run for run, n in zip(runs, numbers, strict=True) if n == k]
        if len(names) > 1:
            out.append(f"{', '.join(names)}: pieces of one recording: they count as one run")
    return out


def _same_name(a: str, b: str) -> bool:
    one, two = _NAMED.fullmatch(a), _NAMED.fullmatch(b)
    return one is not None and two is not None and one["of"] == two["of"]


def _may_follow(a: str, b: str) -> bool:
    """Return whether run b may go on where a ends: of a recording in pieces only the last one ends, and the first begins."""
    one, two = _NAMED.fullmatch(a), _NAMED.fullmatch(b)
    ends = one is None or one["piece"] == one["all"]
    begins = two is None or two["piece"] == "1"
    return ends and begins


def _goes_on(before: Sequence[JointSignals], after: Sequence[JointSignals]) -> bool:
    """Return whether every joint of `after` begins where it ends in `before`."""
    step = float(np.median(np.diff(before[0].time_s)))
    gap = float(after[0].time_s[0] - before[0].time_s[-1])
    stamped = 0.0 < gap <= _LOST_S
    gap = gap if stamped else step
    moving = False
    for one, two in zip(before, after, strict=True):
        a, b = one.state, two.state
        speeds = [_mean(a.velocity_rad_s, -1), _mean(b.velocity_rad_s, 0)]
        reach = float(np.ptp(a.velocity_rad_s)) + float(np.ptp(b.velocity_rad_s))
        short = gap <= _STEPS * step
        if short and abs(speeds[1] - speeds[0]) > _ALIKE * reach:
            return False
        moving = moving or min(map(abs, speeds)) > SLOWEST_RAD_S
        travel = 0.5 * (speeds[0] + speeds[1]) * gap
        off = abs(float(b.link_position_rad[0] - a.link_position_rad[-1]) - travel)
        if off > _AT_MOST_RAD + 0.5 * abs(travel) + (0.0 if short else 0.25 * reach * gap):
            return False
        warm = float(b.temperature_c[0] - a.temperature_c[-1])
        if np.isfinite(warm) and abs(warm) > _WARMER_K:
            return False
    return stamped or moving


def _mean(x: np.ndarray[tuple[int, ...], np.dtype[np.float64]], end: int) -> float:
    """Return the mean of the first (0) or last (-1) five samples."""
    return float(np.mean(x[:5] if end == 0 else x[-5:]))
