"""What a busy machine takes from a run: pieces that are driven again, and lost cycles that are interpolated. Pure.

When the whole run was lost for want of time only, its pieces are driven one by one (NAME~1, NAME~2, ...), and only those
that are lost again are repeated. They stay separate tables: the joints stood elsewhere in between, and a table has no jump.
"""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.run import JointColumns, RunTable
from jtqd.sysid.campaign.plan import Off, Plateau, Rest, Run, Segment, expand, samples, travel_rad
from jtqd.sysid.motion.setpoints import PERIOD_S, path
from jtqd.sysid.runs.logs import LoggedRun

LONGEST_FILLED_S: Final = 0.0505
"""Longest time between two rows that is interpolated: 50 periods of 1 ms. The trajectories' harmonics lie below 1 Hz."""
BACK_RAD: Final = 0.005
"""A joint that is moved alone has come back where it is no further than this from where it began."""
FILLED_SHARE: Final = 0.005
"""Largest part of a table that may be interpolated."""


def pieces_of(run: Run) -> tuple[Run, ...]:
    """Return the pieces of a run, each from rest to rest; the run itself where it cannot be cut.

    A run is cut in the middle of the rests between its motions; a joint that is moved alone must have come back there to
    where it began. A run of one direction, which does not rest, is cut between its plateaus, each with the ramps of
    the run's own ends. A piece never goes further from its start than the run does.
    """
    if any(isinstance(each, Off) for each in run.segments):
        return (run,)
    moving = [place for place, each in enumerate(run.segments) if not isinstance(each, Rest)]
    if len(moving) < 2:
        return (run,)
    found = _of_one_direction(run, moving) or _between_rests(run)
    pieces = [
        replace(run, name=f"{run.name}~{number}", segments=tuple(each))
        for number, each in enumerate(found, 1)
    ]
    far = travel_rad(expand(run)) + BACK_RAD
    if len(pieces) < 2 or any(travel_rad(expand(piece)) > far for piece in pieces):
        return (run,)
    return tuple(pieces)


def _between_rests(run: Run) -> list[list[Segment]]:
    """Cut in the middle of each rest behind a motion that another one follows."""
    pieces: list[list[Segment]] = [[]]
    ends = _ends(run)
    last = max(place for place, each in enumerate(run.segments) if not isinstance(each, Rest))
    moved = False
    for place, each in enumerate(run.segments):
        home = run.current_joint is not None or abs(ends[place]) <= BACK_RAD
        if isinstance(each, Rest) and moved and place < last and home:
            before = isinstance(run.segments[place - 1], Plateau)  # which the rest ramps down
            ramp_s = each.ramp_s if before else 0.0
            half_s = 0.5 * (each.duration_s - ramp_s)
            pieces[-1].append(Rest(half_s, ramp_s))
            pieces.append([Rest(half_s, 0.0)])
            moved = False
            continue
        moved = moved or not isinstance(each, Rest)
        pieces[-1].append(each)
    return pieces


def _ends(run: Run) -> FloatArray:
    """Return the position [rad] of the velocity joint at the end of each segment, from where the run begins."""
    ends = np.cumsum([samples(each.duration_s) for each in run.segments])
    whole = path(expand(run))
    found: FloatArray = whole[np.minimum(ends, len(whole)) - 1]
    return found


def _of_one_direction(run: Run, moving: list[int]) -> list[list[Segment]]:
    """Cut a run of plateaus of one direction on a towing bench; nothing for any other run."""
    plateaus = [each for each in run.segments if isinstance(each, Plateau)]
    first, last = run.segments[0], run.segments[-1]
    if run.current_joint is None or len(plateaus) != len(moving) or moving[-1] - moving[0] + 1 != len(moving):
        return []
    if not isinstance(first, Rest) or not isinstance(last, Rest):
        return []
    if not (all(p.velocity_rad_s > 0.0 for p in plateaus) or all(p.velocity_rad_s < 0.0 for p in plateaus)):
        return []
    ramp_s = max(each.ramp_s for each in (plateaus[0], last))
    ends = Rest(first.duration_s, 0.0), Rest(last.hold_s, ramp_s)
    return [[ends[0], replace(each, ramp_s=max(ramp_s, each.ramp_s)), ends[1]] for each in plateaus]


def gaps_of(time_s: FloatArray, longest_gap_s: float) -> list[list[float]]:
    """Return the last row before and the first behind [s] of each step that is longer than longest_gap_s."""
    places = np.flatnonzero(np.diff(time_s) > longest_gap_s)
    return [[round(float(time_s[place]), 6), round(float(time_s[place + 1]), 6)] for place in places]


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
