"""Which joint of a run was in velocity mode, the paper's tested joint: by the campaign's marks, else by the data. Pure.

A velocity loop turns its current over by twice the friction within milliseconds wherever the joint reverses, and follows
every ripple; a current drive follows a smooth command. The second difference of the current over cells of 10 ms is 10 to
50 times larger in velocity mode on the emulated bench.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from estimator.friction import FloatArray
from estimator.run import RunTable

_CELL_S: Final = 0.01
_CLEAR: Final = 3.0
"""Ratio of the two joints' roughness from which on the rougher one is called the velocity joint."""


def by_marks(marks: Any) -> int | None:
    """Return the velocity joint that the marks of a campaign name (NAME.json), None where they do not."""
    number = marks.get("velocity_joint") if isinstance(marks, dict) else None
    return number if isinstance(number, int) and not isinstance(number, bool) else None


def by_data(table: RunTable) -> int | None:
    """Return the velocity joint of a run of two joints by their currents, None where the data do not tell."""
    rough = {
        number: _roughness(table.time_s, columns.current_a)
        for number, columns in table.joints.items()
        if columns.current_a is not None
    }
    if len(rough) != 2:
        return None
    (_, low), (number, high) = sorted(rough.items(), key=lambda item: item[1])
    return number if high > _CLEAR * low else None


def _roughness(time_s: FloatArray, current_a: FloatArray) -> float:
    """Root mean square [A] of the second difference of the current's means over cells of 10 ms."""
    size = max(1, round(_CELL_S / float(np.median(np.diff(time_s)))))
    cells = current_a[: len(current_a) // size * size].reshape(-1, size).mean(axis=1)
    if len(cells) < 3:
        return 0.0
    return float(np.sqrt(np.mean(np.diff(cells, n=2) ** 2)))
