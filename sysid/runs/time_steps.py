"""Steps of a file's time: where it starts again, the gaps between pieces, and time that is refused. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.sysid.runs.run_file import RunError

LONGEST_GAP: Final = 10.0
"""Median steps: a longer step means that the run consists of pieces. A reader of whole runs refuses it, because a fit or an
observer would take the jump for a measurement; `read_runs(.., in_pieces=True)` takes it apart. Shorter gaps (lost cycles)
are notes."""
BRIDGED_S: Final = 0.025
"""Taking apart, a gap this short is no end of a piece: what lies in it is interpolated (`time_base.on_even_steps`)."""
SHORTEST_PIECE_S: Final = 1.0
"""Also the least by which the time must step back for a new run to begin there, and no stamp to be wrong."""
GAP_NOTED: Final = 1.5


def new_runs(time_s: FloatArray) -> list[int]:
    """Return the rows at which the time starts again and goes on from there; a single wrong stamp is none."""
    steps = np.diff(time_s)
    longest = _longest_step(steps)
    rows = np.flatnonzero(steps[:-1] <= -SHORTEST_PIECE_S) + 1
    return [int(row) for row in rows if 0.0 < steps[row] <= longest]


def between_gaps(time_s: FloatArray, run: slice) -> list[slice]:
    """Return the rows between the gaps of a run; its time rises."""
    steps = np.diff(time_s[run])
    ends = [0, *(np.flatnonzero(steps > _longest_step(steps)) + 1), run.stop - run.start]
    return [slice(run.start + int(a), run.start + int(b)) for a, b in pairwise(ends)]


def _longest_step(steps: FloatArray) -> float:
    return max(LONGEST_GAP * float(np.median(steps)), BRIDGED_S)


def length_s(time_s: FloatArray, cut: slice) -> float:
    """Return the time from the first to the last row of a piece."""
    return float(time_s[cut.stop - 1] - time_s[cut.start])


def check_time(
    time_s: FloatArray, lines: Sequence[int] | None, path: Path, *, run: slice, whole: bool
) -> list[str]:
    """Refuse time of a run that stands or runs back, and in a whole one long gaps; note the short gaps."""

    def at(row: int) -> str:
        return f"sample {run.start + row}" if lines is None else f"line {lines[run.start + row]}"

    time_s = time_s[run]
    steps = np.diff(time_s)
    if not np.all(steps > 0.0):
        row = int(np.argmax(steps <= 0.0)) + 1
        several = (
            ": one run in a file here (`jtq diagnose` takes several apart)" if row in new_runs(time_s) else ""
        )
        raise RunError(
            f"{path}: {at(row)}: found time {time_s[row]:.6g} s after {time_s[row - 1]:.6g} s, "
            f"expected rising time{several}"
        )
    median = float(np.median(steps))
    longest = int(np.argmax(steps))
    if whole and steps[longest] > LONGEST_GAP * median:
        raise RunError(
            f"{path}: {at(longest + 1)}: found a gap of {steps[longest]:.6g} s, "
            f"expected steps of about {median:.6g} s"
        )
    gaps = int(np.count_nonzero(steps > GAP_NOTED * median))
    are = "step is" if gaps == 1 else "steps are"
    return [f"{gaps} {are} longer than {GAP_NOTED} times the median of {median:.6g} s"] if gaps else []
