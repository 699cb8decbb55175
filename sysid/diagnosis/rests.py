"""What the current reads at rest: the one thing that tells an offset of the current from an asymmetric friction. Pure.

In motion the two are the same torque in every sample. At rest friction takes up anything, so nothing follows from the
balance; but a drive that is off, or told zero, carries no current, and what is read then is the offset. That it is so is
inferred only where the reading is the same at every rest: a loop that holds a joint still rests at another current each
time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from sysid.diagnosis.signals import JointSignals

_STILL_RAD_S: Final = 0.003
_REST_S: Final = 0.3
_FEWEST: Final = 4
_SAME: Final = 0.2
"""Rests whose means scatter by less than this part of the size in question are the same."""

_CLOSE: Final = 0.25


@dataclass(frozen=True)
class RestCurrent:
    """Mean of the current over rests [A], scatter of their means [A], how many rests."""

    mean_a: float
    scatter_a: float
    rests: int


def rest_current(signals: Sequence[Sequence[JointSignals]], number: int) -> RestCurrent | None:
    """Return what the current of a joint reads at rest; None with too few rests."""
    means = []
    for run in signals:
        for s in run:
            if s.number != number:
                continue
            step = float(np.median(np.diff(s.time_s)))
            still = np.abs(s.state.velocity_rad_s) < _STILL_RAD_S
            edges = np.flatnonzero(np.diff(np.concatenate(([0], still.astype(np.int8), [0]))))
            for first, last in zip(edges[::2], edges[1::2], strict=True):
                if (last - first) * step >= _REST_S:
                    # the first half of a rest still has the current that brought it there
                    means.append(float(np.mean(s.state.current_a[(first + last) // 2 : last])))
    if len(means) < _FEWEST:
        return None
    middle = float(np.median(means))
    scatter = 1.4826 * float(np.median(np.abs(np.array(means) - middle)))
    return RestCurrent(middle, scatter, len(means))


def offset_at_rest(rest: RestCurrent | None, offset_a: float) -> bool:
    """Return whether the readings at rest show the offset: the same at every rest, and what the motion asks for.

    offset_a: the current offset that would explain the motion [A]. A reading of zero proves nothing: a loop that takes
    the reading itself to zero hides its offset.
    """
    if rest is None or rest.scatter_a > _SAME * abs(offset_a):
        return False
    return abs(rest.mean_a - offset_a) < _CLOSE * abs(offset_a)
