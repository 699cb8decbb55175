"""Samples that are no measurement: outlier samples, saturated channels and held values.

Outlier samples are wrong cells of the recorder, not spikes of the joint. Each channel is judged by itself: a few samples
that lie ten times further from the median than all others, or ten times further off both neighbours than any other, and by
more than a joint can move (`_LEAST`). The whole row is left out, like a lost row.

Held values are rows in which torque or current of a moving joint repeats a number:

- Saturated: an end of the channel's range, held while its partner changes, and left again. A channel that saturates in one
  run does so in all: every row at a limit counts.
- Stuck: any other number that is held for STUCK_S while the partner changes.
- Stuck: a number repeated so often that the channel's noise right before and after rules it out. This needs no change of
  the partner. A current of exactly zero, or without power, may be free of noise.

Only a moving joint shows that a number is stuck. A channel that is stuck in motion stays so until its number changes, at
rest or not. A diagnosis leaves such rows out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, fields
from typing import Final

import numpy as np

from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.estimator.checked import counted
from jtqd.estimator.joint import Joint
from jtqd.estimator.run import JointColumns, RunTable
from jtqd.sysid.runs.channels import MOVING_RAD_S, STUCK_S, RunIssue

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


Limits = Mapping[str, Collection[float]]
"""Sizes at which the columns of a joint clip."""

LONGEST_HELD: Final = 0.5
"""Of the moving time: a run of which less than the rest is measured is no recording of this joint."""
_MOVED: Final = {"torque_nm": 0.1, "current_a": 0.5}
"""Part of the rated torque by which the partner must have changed. A commanded current is constant for good reasons, and
friction may vary beside it: only much counts there.
"""
_REPEATED: Final = 5
"""Rows of one number from which on a stretch is looked at."""
_BESIDE: Final = 100
"""Rows before and after a stretch, at least, that show the channel's noise."""
_NOISE: Final = 3.0
"""Least noise, in steps of the channel: median second difference from row to row."""
_CHANCE: Final = 1e-9
"""Of a stretch by the channel's own repetitions."""
_MOMENTS: Final = 6


@dataclass(frozen=True)
class Held:
    """clipped, stuck: rows of one channel [n]; apart: what they are from the straight line between the rows before and
    after, in the unit of the channel, 0 elsewhere [n].
    """

    clipped: BoolArray
    stuck: BoolArray
    apart: FloatArray

    @property
    def rows(self) -> BoolArray:
        """Rows that are no measurement [n]."""
        return np.asarray(self.clipped | self.stuck, np.bool_)


def clip_limits(tables: Iterable[RunTable], joints: Mapping[int, Joint]) -> dict[int, Limits]:
    """Return by joint where channels clip in any of these runs; a limit of the torque column is one of all joints."""
    out: dict[int, dict[str, set[float]]] = {number: {} for number in joints}
    for table in tables:
        for number in set(joints) & set(table.joints):
            run = table.joints[number]
            for name, held in held_rows(table.time_s, run, joints[number]).items():
                values = getattr(run, name)[held.clipped]
                for each in joints if name == "torque_nm" else (number,):
                    out[each].setdefault(name, set()).update(np.unique(np.abs(values)).tolist())
    return dict(out)


def held_rows(
    time_s: FloatArray, run: JointColumns, joint: Joint, limits: Limits | None = None
) -> dict[str, Held]:
    """Return per column what of it is held, from where the joint moved on; columns without such rows are left out. limits:
    those of other runs.
    """
    velocity = run.derived(time_s, joint.gear_ratio).motor_velocity_rad_s
    if velocity is None or run.current_a is None or run.torque_nm is None:
        return {}
    moving = np.abs(velocity) / joint.gear_ratio > MOVING_RAD_S
    motor = joint.gear_ratio * joint.torque_constant_nm_per_a * run.current_a
    powered = run.current_a != 0.0
    if run.enabled is not None:
        powered &= run.enabled >= 0.5
    out = {}
    for name, values, partner, noisy in (
        ("torque_nm", run.torque_nm, motor, np.ones_like(moving)),
        ("current_a", run.current_a, run.torque_nm, powered),
    ):
        moved = _MOVED[name] * joint.rated_torque_nm
        stuck, clipped = _while_partner_moves(time_s, values, partner, moving, moved)
        for limit in (limits or {}).get(name, ()):
            clipped |= np.abs(values) == limit
        noiseless = _without_noise(values, noisy, moving)
        ends = [v for v in (np.min(values), np.max(values)) if v != values[-1]]
        clipped |= np.isin(values, np.unique(values[noiseless & np.isin(values, ends)]))
        stuck |= noiseless
        if stuck.any() or clipped.any():
            out[name] = Held(clipped, stuck & ~clipped, _apart(values, stuck | clipped))
    return out


def _apart(values: FloatArray, rows: BoolArray) -> FloatArray:
    """Return what `Held.apart` is."""
    out = np.zeros(len(values))
    if not rows.all():
        at = np.arange(len(values))
        out[rows] = values[rows] - np.interp(at[rows], at[~rows], values[~rows])
    return out


def check_held(
    time_s: FloatArray, run: JointColumns, joint: Joint, where: str, limits: Limits | None = None
) -> tuple[list[RunIssue], list[RunIssue]]:
    """Return what is held: (for more than LONGEST_HELD of the moving time, for less). limits: as for `held_rows`."""
    velocity = run.derived(time_s, joint.gear_ratio).motor_velocity_rad_s
    long: list[RunIssue] = []
    short: list[RunIssue] = []
    for name, held in held_rows(time_s, run, joint, limits).items():
        assert velocity is not None
        moving = np.abs(velocity) / joint.gear_ratio > MOVING_RAD_S
        share = float(np.count_nonzero(held.rows & moving)) / max(1, int(np.count_nonzero(moving)))
        values, unit = getattr(run, name), "Nm" if name == "torque_nm" else "A"
        word = "saturated or clipped" if held.clipped.any() else "stuck"
        first = int(np.argmax(held.clipped if held.clipped.any() else held.stuck))
        starts = np.flatnonzero(np.diff(held.rows.astype(np.int8), prepend=0) == 1)
        apart = starts[np.diff(time_s[starts], prepend=-math.inf) > STUCK_S]
        at = ", ".join(f"{t:.4g}" for t in time_s[apart[:_MOMENTS]]) + (
            ", .." if len(apart) > _MOMENTS else ""
        )
        text = (
            f"{where}.{name}: found exactly {values[first]:.6g} {unit} held for {share:.2%} of the moving time, from {at} s "
            f"on, expected it to follow {'the motor torque' if name == 'torque_nm' else 'the measured torque'} or to show "
            f"noise; not used there: {word} channel"
        )
        issue = RunIssue(f"{name}_{word.split(maxsplit=1)[0]}", text)
        (long if share > LONGEST_HELD else short).append(issue)
    return long, short


def _while_partner_moves(
    time_s: FloatArray,
    values: FloatArray,
    partner: FloatArray,
    moving: BoolArray,
    moved: float,
) -> tuple[BoolArray, BoolArray]:
    """Return rows [n] that are stuck for STUCK_S, and rows at the channel's limits, in motion or not."""
    starts, ends = _stretches(values)
    low, high = float(np.min(values)), float(np.max(values))
    stuck = np.zeros(len(values), np.bool_)
    at_limit: dict[float, list[tuple[int, int]]] = {low: [], high: []}
    limits = set()
    for start, end in zip(starts, ends, strict=True):
        value = float(values[start])
        if value in at_limit:
            at_limit[value].append((start, end))
        if not moving[start] or not moving[end - 1]:
            continue
        if time_s[end - 1] - time_s[start] >= STUCK_S and _moved(partner[start:end]) > moved:
            if value in at_limit and end < len(values):  # what never moves again has not reached a limit
                limits.add(value)
            else:
                stuck[start:end] = True
    for value, parts in at_limit.items():
        there = sum(end - start for start, end in parts)
        # A quantised channel also meets its extreme now and then; a limit is held, and more than once.
        if len(parts) < 2 or there < 10 * _REPEATED or there < 0.8 * np.count_nonzero(values == value):
            continue
        if max(_moved(partner[start:end]) for start, end in parts) > 0.2 * moved:
            limits.add(value)
    return stuck, np.isin(values, list(limits))


def _stretches(values: FloatArray) -> tuple[list[int], list[int]]:
    """Return first rows and ends of stretches of one number, of _REPEATED rows or more."""
    starts = np.flatnonzero(np.diff(values, prepend=math.nan) != 0.0)
    ends = np.append(starts[1:], len(values))
    long = (ends - starts) >= _REPEATED
    return starts[long].tolist(), ends[long].tolist()


def _moved(partner: FloatArray) -> float:
    """Return how far a channel went, single rows of noise averaged."""
    width = max(1, len(partner) // 8)
    whole = len(partner) // width * width
    return float(np.ptp(partner[:whole].reshape(-1, width).mean(axis=1)))


def _without_noise(values: FloatArray, noisy: BoolArray, moving: BoolArray) -> BoolArray:
    """Return rows [n] that repeat one number where the rows around them have noise of several steps; noisy: rows that must
    have noise, as far as the joint is moving.
    """
    out = np.zeros(len(values), np.bool_)
    repeats = np.concatenate(([0, 0], np.cumsum(np.diff(values) == 0.0)))  # among rows before k
    for start, end in zip(*_stretches(values), strict=True):
        seen = int(np.count_nonzero(moving[start:end]))
        if not seen or not noisy[start:end].all():
            continue
        wide = max(_BESIDE, end - start)
        sides = [(max(0, start - wide), start), (end, min(len(values), end + wide))]
        sides = [(a, b) for a, b in sides if b - a >= _BESIDE // 2]
        shares = [(repeats[b] - repeats[a + 1] + 1.0) / (b - a + 1.0) for a, b in sides]
        if not sides or (seen - 1) * math.log(max(shares)) > math.log(_CHANCE / len(values)):
            continue
        if all(_noise_in_steps(values[a:b]) > _NOISE for a, b in sides):
            out[start:end] = True
    return out


def _noise_in_steps(values: FloatArray) -> float:
    """Return the median second difference over the smallest step between rows."""
    steps = np.abs(np.diff(values))
    if not steps.any():
        return 0.0
    return float(np.median(np.abs(np.diff(values, 2))) / np.min(steps[steps > 0.0]))
