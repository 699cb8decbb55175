"""What a live view remembers of the last seconds (torque as a sparkline, slowest cycle), and its pages. Pure.

The counters of a daemon are those since its start: one slow cycle of yesterday would hide what happens now.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Final, TypeVar

Line = TypeVar("Line")
WINDOW_S: Final = 10.0
BLOCKS: Final = "▁▂▃▄▅▆▇█"
GAP: Final = " "
"""In a sparkline: no torque was published."""


def sparkline(values: Sequence[float], columns: int) -> str:
    """Return the newest values as at most `columns` blocks between their extremes; a gap for each that is no number.

    >>> sparkline([0.0, 1.0, float("nan"), 7.0], 8)
    '▁▂ █'
    """
    shown = list(values)[-columns:]
    known = [each for each in shown if isfinite(each)]
    if not known:
        return GAP * len(shown)
    low, span = min(known), max(known) - min(known)
    top = len(BLOCKS) - 1
    return "".join(
        BLOCKS[round(top * (each - low) / span) if span else 0] if isfinite(each) else GAP for each in shown
    )


def largest_bin(now: Sequence[int], before: Sequence[int]) -> int | None:
    """Return the last bin that has grown; None where none has (or the daemon began anew)."""
    return next((n for n in range(len(now) - 1, -1, -1) if now[n] > before[n]), None)


@dataclass(frozen=True)
class Moment:
    """One reading: time of the view [s], torques [Nm] (NaN: none), histograms of work and lateness, contacts until then."""

    time_s: float
    torques: tuple[float, ...]
    work: tuple[int, ...]
    late: tuple[int, ...]
    contacts: int = 0


class Recent:
    """Readings of the last WINDOW_S seconds."""

    def __init__(self) -> None:
        self._moments: deque[Moment] = deque()

    def add(self, moment: Moment) -> None:
        """Take a reading; older ones than the window go. A histogram that has shrunk is that of another daemon."""
        if self._moments and sum(moment.work) < sum(self._moments[-1].work):
            self._moments.clear()
        self._moments.append(moment)
        while moment.time_s - self._moments[0].time_s > WINDOW_S:
            self._moments.popleft()

    @property
    def seconds(self) -> float:
        """Length of what is remembered [s]."""
        return self._moments[-1].time_s - self._moments[0].time_s if self._moments else 0.0

    def torques(self, joint: int) -> list[float]:
        """Return the torques of a joint (0, 1, ...), oldest first."""
        return [each.torques[joint] for each in self._moments if joint < len(each.torques)]

    @property
    def contacts(self) -> int:
        """Return how many contacts have begun in the window."""
        return self._moments[-1].contacts - self._moments[0].contacts if self._moments else 0

    def largest_us(self, bin_us: float, *, late: bool) -> float | None:
        """Return the upper edge of the largest work time (or lateness) in the window [us]; None without a cycle."""
        if len(self._moments) < 2:
            return None
        first, last = self._moments[0], self._moments[-1]
        found = largest_bin(last.late, first.late) if late else largest_bin(last.work, first.work)
        return None if found is None else (found + 1) * bin_us


def page(lines: Sequence[Line], height: int, number: int) -> tuple[list[Line], int, int]:
    """Return one page of a picture, its number and how many there are; the last page is followed by the first.

    >>> page(["a", "b", "c"], 2, 3)
    (['c'], 1, 2)
    """
    height = max(height, 1)
    count = max(1, -(-len(lines) // height))
    number %= count
    return list(lines[number * height : (number + 1) * height]), number, count
