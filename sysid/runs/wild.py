"""Single samples that are no measurement: a wrong cell of the recorder, not a spike of the joint.

Asked of every channel by itself: a few samples that lie ten times further from its median than all others, or that stand ten
times further off both rows beside them than any other does, and by more than a joint can (`_LEAST`). The whole row is left
out, as one that the recorder lost. Spikes of the size of the torque are the matter of `channels.check_spikes` and the
diagnosis.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Final

import numpy as np

from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.estimator.checked import counted
from jtqd.estimator.joint import Joint
from jtqd.estimator.run import JointColumns, RunTable
from jtqd.sysid.runs.channels import RunIssue

_FURTHER: Final = 10.0
_MOST: Final = 1e-3
"""Part of the rows that may be wild, one at least: more are a fault of the channel."""
_FEWEST_ROWS: Final = 50
_PEAK: Final = 3.0
"""Times the rating: a controller may start with a kick of one cycle."""
_LEAST: Final[Mapping[str, Callable[[Joint], float]]] = {
    "torque_nm": lambda joint: _PEAK * joint.rated_torque_nm,
    "current_a": lambda joint: (
        _PEAK * joint.rated_torque_nm / (joint.gear_ratio * joint.torque_constant_nm_per_a)
    ),
    "motor_position_rad": lambda joint: 0.1 * joint.gear_ratio,
    "motor_velocity_rad_s": lambda joint: joint.gear_ratio,
    "link_position_rad": lambda _: 0.1,
    "link_velocity_rad_s": lambda _: 1.0,
    "temperature_c": lambda _: 20.0,
}
"""How far off a sample must be at least, by column."""


def without_wild_samples(
    table: RunTable, joints: Mapping[int, Joint], where: str
) -> tuple[RunTable, list[RunIssue]]:
    """Return the run without rows in which a channel of these joints is wild, and a note for each such channel."""
    wild = np.zeros(len(table.time_s), np.bool_)
    notes: list[RunIssue] = []
    for number in sorted(set(joints) & set(table.joints)):
        for name, least in _LEAST.items():
            column = getattr(table.joints[number], name)
            rows = None if column is None else wild_rows(column, least(joints[number]))
            if rows is None or not rows.any():
                continue
            wild |= rows
            first = int(np.argmax(rows))
            count = int(rows.sum())
            text = (
                f"{where}: j{number}.{name}: found {counted(count, 'wild sample')}, {column[first]:.4g} at "
                f"{table.time_s[first]:.4g} s{' first' if count > 1 else ''}, expected a value like those beside: "
                f"{'the row is' if count == 1 else 'these rows are'} left out: spike"
            )
            notes.append(RunIssue(f"{name}_wild", text))
    return (_rows(table, ~wild) if notes else table), notes


def wild_rows(column: FloatArray, least: float) -> BoolArray:
    """Return the rows [n] of a column that are wild and off by more than `least`."""
    out = np.zeros(len(column), np.bool_)
    if len(column) < _FEWEST_ROWS or np.ptp(column) <= least:
        return out
    middle = np.median(column[:: max(1, len(column) // 1000)])
    steps = np.abs(np.diff(column, prepend=column[0], append=column[-1]))  # an end has no two neighbours
    for off in (np.abs(column - middle), np.minimum(steps[:-1], steps[1:])):
        if np.max(off) <= least:
            continue
        most = max(1, int(_MOST * len(off)))
        top = np.partition(off, len(off) - most - 1)[-most - 1 :]
        top.sort()
        apart = np.flatnonzero(top[1:] > _FURTHER * np.maximum(top[:-1], least / _FURTHER))
        if len(apart):
            out |= off >= top[apart[0] + 1]
    return out


def _rows(table: RunTable, keep: BoolArray) -> RunTable:
    def kept(columns: JointColumns) -> JointColumns:
        values = {item.name: getattr(columns, item.name) for item in fields(columns)}
        return JointColumns(**{name: None if x is None else x[keep] for name, x in values.items()})

    return RunTable(table.time_s[keep], {number: kept(each) for number, each in table.joints.items()})
