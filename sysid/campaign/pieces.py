"""What a busy machine takes from a run: pieces that are driven again, and lost cycles that are interpolated. Pure.

A run of Fourier trajectories is at rest between them, where it began: each is a run of its own right. When the whole run was
lost for want of time only, its pieces are driven one by one (NAME~1, NAME~2, ...), and only those that are lost again
are repeated. They stay separate tables: the joints stood elsewhere in between, and a table has no jump.
"""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.run import JointColumns, RunTable
from jtqd.sysid.campaign.plan import Fourier, Rest, Run, Segment
from jtqd.sysid.motion.setpoints import PERIOD_S
from jtqd.sysid.runs.logs import LoggedRun

LONGEST_FILLED_S: Final = 0.0505
"""Longest time between two rows that is interpolated: 50 periods of 1 ms. The trajectories' harmonics lie below 1 Hz."""
FILLED_SHARE: Final = 0.005
"""Largest part of a table that may be interpolated."""


def pieces_of(run: Run) -> tuple[Run, ...]:
    """Return the pieces of a run, each from rest to rest; the run itself where it cannot be cut.

    Only runs of Fourier trajectories are cut, in the middle of the rests between them. After plateaus the joints
    stand elsewhere than a later piece would begin.
    """
    moving = [place for place, each in enumerate(run.segments) if not isinstance(each, Rest)]
    if len(moving) < 2 or not all(isinstance(run.segments[place], Fourier) for place in moving):
        return (run,)
    pieces: list[tuple[Segment, ...]] = []
    ahead: list[Segment] = list(run.segments[: moving[0]])
    for place, following in zip(moving, [*moving[1:], len(run.segments)], strict=True):
        rests = [each for each in run.segments[place + 1 : following] if isinstance(each, Rest)]
        last = following == len(run.segments)
        before, after = (rests, []) if last else _halves(rests)
        pieces.append((*ahead, run.segments[place], *before))
        ahead = list(after)
    return tuple(
        replace(run, name=f"{run.name}~{number}", segments=each) for number, each in enumerate(pieces, 1)
    )


def _halves(rests: list[Rest]) -> tuple[list[Rest], list[Rest]]:
    """Return two rests of half of the time each; both begin at rest, so that nothing is ramped."""
    half = Rest(0.5 * sum(each.duration_s for each in rests), 0.0)
    return [half], [half]


def fill(logged: LoggedRun, longest_gap_s: float, period_s: float = PERIOD_S) -> tuple[LoggedRun, int]:
    """Interpolate the gaps that are longer than readers bear; returns the run and the number of rows made, period_s apart.

    The run as it was, and 0, where a gap is longer than LONGEST_FILLED_S, or more than FILLED_SHARE would be made.
    Values between two rows are linear in time.
    """
    time_s = logged.table.time_s
    steps = np.diff(time_s)
    places = np.flatnonzero(steps > longest_gap_s)
    if not len(places) or float(steps.max()) > LONGEST_FILLED_S:
        return logged, 0
    made = [
        time_s[place] + period_s * np.arange(1, round(float(steps[place]) / period_s)) for place in places
    ]
    added = np.concatenate(made)
    if len(added) > FILLED_SHARE * (len(added) + len(time_s)):
        return logged, 0
    whole: FloatArray = np.sort(np.concatenate((time_s, added)))
    table = RunTable(
        whole,
        {number: _interpolated(columns, time_s, whole) for number, columns in logged.table.joints.items()},
    )
    return replace(logged, table=table, longest_gap_s=float(np.diff(whole).max())), len(added)


def _interpolated(columns: JointColumns, time_s: FloatArray, whole: FloatArray) -> JointColumns:
    def column(name: str) -> FloatArray | None:
        values = getattr(columns, name)
        if values is None:
            return None
        found: FloatArray = np.interp(whole, time_s, values)
        return np.round(found) if name == "enabled" else found

    return JointColumns(**{item.name: column(item.name) for item in fields(JointColumns)})
