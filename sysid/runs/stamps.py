"""Mistakes of a recorder that can be put right before the time is checked: rows written twice, rounded stamps. Pure."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from jtqd.estimator.checked import counted
from jtqd.sysid.runs.column_map import TIME
from jtqd.sysid.runs.content import Content

_MOST_ALIKE: Final = 3
"""Stamps in a row that rounding makes one number of."""
_ROOM: Final = 0.9995
"""Of the usual step, that the time has for each row at least if none is too many."""


def without_repeated_rows(content: Content) -> Content:
    """Return the content without rows that were written twice, one after the other, and a note. Two rows that share only
    their stamp stay, to be refused: one of their times is wrong.
    """
    columns = np.array(list(content.values.values()))
    again = np.concatenate(([False], np.all(columns[:, 1:] == columns[:, :-1], axis=0)))
    if not again.any():
        return content
    lines = None if content.lines is None else [content.lines[int(k)] for k in np.flatnonzero(~again)]
    note = f"{int(again.sum())} of {counted(len(again), 'row')} left out: they are the row before once more"
    values = {key: value[~again] for key, value in content.values.items()}
    return replace(content, values=values, lines=lines, notes=(*content.notes, note))


def with_rounded_stamps(content: Content) -> Content:
    """Return the content with stamps that equal the one before put between their neighbours, and a note, where there are no
    more rows than the time has room for: stamps that were rounded, not rows that are too many.
    """
    time_s = content.values[TIME]
    steps = np.diff(time_s)
    if len(steps) < 2 or not np.all(steps >= 0.0) or np.all(steps > 0.0):
        return content
    new = np.concatenate(([True], steps > 0.0))
    rows = np.flatnonzero(new)
    many = np.max(np.diff(rows)) > _MOST_ALIKE or not new[-1]
    if many or np.mean(steps) < _ROOM * np.median(steps[steps > 0.0]):
        return content
    spread = np.interp(np.arange(len(time_s)), rows, time_s[rows])
    note = f"{counted(int(np.sum(~new)), 'stamp')} like the one before: rounded, spread between those around"
    return replace(content, values={**content.values, TIME: spread}, notes=(*content.notes, note))
