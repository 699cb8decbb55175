"""Channels of the runs before a diagnosis: what cannot be right is left out and named, what is odd is noted. Pure.

A diagnosis takes every column at its word. So a joint of a run whose columns contradict each other (unit, sign, dead,
another joint's file) is left out with one line; a channel that is only not needed (temperature, link encoder) is left out
alone; what is usable but odd (short stuck stretches, clipping, spikes, uneven time) is a note.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import Joint
from jtqd.estimator.losses import FrictionModel
from jtqd.estimator.run import JointColumns, RunTable
from jtqd.sysid.runs.checks import MOVING_RAD_S, STUCK_S, RunIssue, check_channels
from jtqd.sysid.runs.time_base import SKEW_NOTED_S, SKEW_REFUSED_S, evened, rate_problem, skew_s, unwrapped
from jtqd.sysid.runs.units import temperature_finding, unit_findings

HELD_SHARE: Final = 0.02
"""Of the moving time: a channel that is stuck or clipped for longer spoils what is fitted to the rest."""
_REFUSING: Final = ("_dead", "_sign", "_scale", "_unit")
_SPARE: Final = {
    "link_position_rad_stuck": ("link_position_rad", "link_velocity_rad_s"),
    "motor_position_rad_stuck": ("motor_position_rad",),
}
_CLIPPED_ROWS: Final = 5
_SPIKE: Final = 12.0
"""Times the usual step of the channel from row to row, and more than _SPIKE_RATED of rated torque."""
_SPIKE_RATED: Final = 0.1
_ENERGY: Final = -0.3
"""Losses below this part of the file's friction power mean that motion and torque have not the same sign."""


@dataclass(frozen=True)
class Checked:
    """runs: (name, table) with what may be used; notes: one line each; refused: why joints of runs were left out;
    lost: joints of which nothing is left.
    """

    runs: tuple[tuple[str, RunTable], ...]
    notes: tuple[str, ...]
    refused: tuple[str, ...]
    lost: tuple[int, ...]


def check_runs(runs: Sequence[tuple[str, RunTable]], joints: Mapping[int, Joint]) -> Checked:
    """Return what of the runs can be used for a diagnosis of `joints` (joint file by number)."""
    usable, notes, refused = [], [], []
    for name, original in runs:
        problem = rate_problem(original.time_s, name)
        if problem is not None:
            refused.append(problem)
            continue
        table, rolled = unwrapped(original, name)
        table, stretched = evened(table, name)
        notes += rolled + stretched
        good: dict[int, JointColumns] = {}
        for number in sorted(set(joints) & set(table.joints)):
            kept, why, odd = _judged(table, number, joints[number], f"{name}: j{number}")
            notes += odd
            refused += why
            if kept is not None:
                good[number] = kept
        opposite = _opposite_sensors(good, name)
        if opposite is not None:
            refused.append(opposite)
            del good[2]
        if good:
            usable.append((name, RunTable(table.time_s, good)))
    left = {number for _, table in usable for number in table.joints}
    recorded = {number for _, table in runs for number in table.joints}
    lost = tuple(sorted(number for number in joints if number in recorded - left))
    return Checked(tuple(usable), tuple(notes), tuple(refused), lost)


def _judged(
    table: RunTable, number: int, joint: Joint, where: str
) -> tuple[JointColumns | None, list[str], list[str]]:
    """Columns that may be used (None: the joint is left out of this run), why not, and notes."""
    columns = table.joints[number]
    missing = _missing(columns, where)
    if missing is not None:
        return None, [missing], []
    notes = []
    hot = temperature_finding(table.time_s, columns, where)
    if hot is not None:
        notes.append(hot.text)
        columns = replace(columns, temperature_c=None)
    units = unit_findings(table.time_s, columns, joint, where)
    found = units or check_channels(table.time_s, columns, joint, where)
    found = found or _energy(table.time_s, columns, joint, where)
    refusing = [item.text for item in found if item.kind.endswith(_REFUSING) or item.kind in _WHOLE]
    if refusing:
        return None, refusing, notes
    columns, spared = _spared(columns, found)
    notes += spared
    why, odd = _held_and_clipped(table.time_s, columns, joint, where)
    notes += odd + _spikes(columns, joint, where)
    if why:
        return None, why, notes
    late = skew_s(replace_joint(table, number, columns), number, joint)
    if late is not None and abs(late) >= SKEW_NOTED_S:
        text = (
            f"{where}.torque_nm: found it {abs(late):.3g} s {'behind' if late > 0.0 else 'ahead of'} current and motion, "
            "expected channels in step: skew"
        )
        if abs(late) >= SKEW_REFUSED_S:
            return None, [text], notes
        notes.append(text)
    return columns, [], notes


_WHOLE: Final = ("gear_ratio", "joint_file")


def replace_joint(table: RunTable, number: int, columns: JointColumns) -> RunTable:
    """The run with other columns of one joint."""
    return RunTable(table.time_s, {**table.joints, number: columns})


def _missing(columns: JointColumns, where: str) -> str | None:
    """What a joint cannot be judged without."""
    if columns.torque_nm is None or not np.any(columns.torque_nm):
        return f"{where}.torque_nm: found no torque sensor channel (or a dead one), expected the reference of a diagnosis"
    if columns.current_a is None:
        return f"{where}.current_a: found no such column, expected the motor current"
    motion = ("motor_position_rad", "motor_velocity_rad_s", "link_position_rad", "link_velocity_rad_s")
    if all(getattr(columns, name) is None for name in motion):
        return f"{where}: found no position and no velocity, expected at least one of them"
    return None


def _spared(columns: JointColumns, found: Sequence[RunIssue]) -> tuple[JointColumns, list[str]]:
    """Columns without the stuck ones that a diagnosis can do without."""
    notes = []
    for item in found:
        gone = _SPARE.get(item.kind)
        if gone is not None:
            empty: dict[str, Any] = dict.fromkeys(gone)
            columns = replace(columns, **empty)
            notes.append(f"{item.text}; not used")
    return columns, notes


def _energy(time_s: FloatArray, run: JointColumns, joint: Joint, where: str) -> list[RunIssue]:
    """Friction takes energy out of motion; where motion gains it, velocity and torque are of opposite signs."""
    velocity = run.derived(time_s, joint.gear_ratio).motor_velocity_rad_s
    if velocity is None or run.current_a is None or run.torque_nm is None:
        return []
    v = velocity / joint.gear_ratio
    lost = (joint.gear_ratio * joint.torque_constant_nm_per_a * run.current_a - run.torque_nm) * v
    friction = FrictionModel(joint.friction).torque_many(v) * v
    moving = np.abs(v) > MOVING_RAD_S
    if np.count_nonzero(moving) < 100 or not float(np.sum(friction[moving])) > 0.0:
        return []
    share = float(np.sum(lost[moving]) / np.sum(friction[moving]))
    if share > _ENERGY:
        return []
    return [
        RunIssue(
            "motion_sign",
            f"{where}: found {-share:.2g} times the friction power of {joint.name} gained instead of lost, expected a loss: "
            "swapped sign of positions and velocities, or of current and torque_nm",
        )
    ]


def _held_and_clipped(
    time_s: FloatArray, run: JointColumns, joint: Joint, where: str
) -> tuple[list[str], list[str]]:
    """Stretches of one number while the joint moves and the partner changes: refused when long, else noted."""
    velocity = run.derived(time_s, joint.gear_ratio).motor_velocity_rad_s
    if velocity is None or run.current_a is None or run.torque_nm is None:
        return [], []
    moving = np.abs(velocity) / joint.gear_ratio > MOVING_RAD_S
    motor = joint.gear_ratio * joint.torque_constant_nm_per_a * run.current_a
    refused: list[str] = []
    notes: list[str] = []
    # A commanded current is constant for good reasons, and friction may vary beside it: only much counts there.
    for name, values, partner, moved in (
        ("torque_nm", run.torque_nm, motor, 0.1 * joint.rated_torque_nm),
        ("current_a", run.current_a, run.torque_nm, 0.5 * joint.rated_torque_nm),
    ):
        stuck, clipped = _held_rows(time_s, values, partner, moving, moved)
        rows = stuck | clipped
        share = float(np.count_nonzero(rows)) / max(1, int(np.count_nonzero(moving)))
        if not share:
            continue
        at = values[int(np.argmax(rows))]
        word = "stuck" if np.any(stuck & ~clipped) else "saturated or clipped"
        text = (
            f"{where}.{name}: found exactly {at:.6g} {'Nm' if name == 'torque_nm' else 'A'} held for {share:.2%} of the "
            f"moving time from {time_s[int(np.argmax(rows))]:.4g} s on while "
            f"{'the motor torque' if name == 'torque_nm' else 'the measured torque'} changed: {word} channel"
        )
        (refused if share > HELD_SHARE else notes).append(text)
    return refused, notes


def _held_rows(
    time_s: FloatArray,
    values: FloatArray,
    partner: FloatArray,
    moving: NDArray[np.bool_],
    moved: float,
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Rows [n] that are stuck for STUCK_S, and rows at the channel's limits for _CLIPPED_ROWS or more, often."""
    starts = np.flatnonzero(np.diff(values, prepend=math.nan) != 0.0)
    ends = np.append(starts[1:], len(values))
    long = (ends - starts) >= _CLIPPED_ROWS
    low, high = float(np.min(values)), float(np.max(values))
    stuck, clipped = np.zeros(len(values), np.bool_), np.zeros(len(values), np.bool_)
    at_limit: dict[float, list[tuple[int, int]]] = {low: [], high: []}
    for start, end in zip(starts[long], ends[long], strict=True):
        value = float(values[start])
        if value in at_limit:
            at_limit[value].append((int(start), int(end)))
        if not moving[start] or not moving[end - 1]:
            continue
        if time_s[end - 1] - time_s[start] >= STUCK_S and _moved(partner[start:end]) > moved:
            stuck[start:end] = True
    for value, parts in at_limit.items():
        there = sum(end - start for start, end in parts)
        # A quantised channel also meets its extreme now and then; a limit is held, and more than once.
        if len(parts) < 2 or there < 10 * _CLIPPED_ROWS or there < 0.8 * np.count_nonzero(values == value):
            continue
        if max(_moved(partner[start:end]) for start, end in parts) > 0.2 * moved:
            for start, end in parts:
                clipped[start:end] = True
    return stuck & moving, clipped & moving


def _moved(partner: FloatArray) -> float:
    """How far a channel went, single rows of noise averaged."""
    width = max(1, len(partner) // 8)
    whole = len(partner) // width * width
    return float(np.ptp(partner[:whole].reshape(-1, width).mean(axis=1)))


def _spikes(run: JointColumns, joint: Joint, where: str) -> list[str]:
    """Jumps of the sensor from one row to the next: a spike or a drop-out is two of them."""
    torque = run.torque_nm
    if torque is None:
        return []
    steps = np.abs(np.diff(torque))
    limit = max(_SPIKE * float(np.median(steps)), _SPIKE_RATED * joint.rated_torque_nm)
    count = int(np.count_nonzero(steps > limit))
    if not count:
        return []
    return [
        f"{where}.torque_nm: found {count} jumps of more than {limit:.3g} Nm from one row to the next: spikes or drop-outs"
    ]


def _opposite_sensors(good: Mapping[int, JointColumns], name: str) -> str | None:
    """On the bench both joints carry the one sensor, each positive along its own current: the same column twice."""
    if 1 not in good or 2 not in good:
        return None
    one, two = good[1].torque_nm, good[2].torque_nm
    assert one is not None
    assert two is not None
    size = float(np.std(one))
    if size == 0.0 or float(np.std(one + two)) > 0.2 * size:
        return None
    return (
        f"{name}: j2.torque_nm: found the opposite of j1.torque_nm, expected the same (positive along each joint's own "
        "positive current): one joint's columns are in the other's frame"
    )
