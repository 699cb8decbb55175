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
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations
from typing import Final

import numpy as np

from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.estimator.joint import Joint
from jtqd.estimator.run import COLUMN_NAMES, RunTable
from jtqd.estimator.text import counted
from jtqd.sysid.runs.channels import STUCK_S, Channels, RunIssue

_FURTHER: Final = 10.0
_MOST: Final = 1e-3
"""Part of the rows that may be outliers, one at least: more are a fault of the channel."""
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
"""Least deviation of an outlier, by column."""


def without_outliers(
    table: RunTable, joints: Mapping[int, Joint], where: str
) -> tuple[RunTable, list[RunIssue]]:
    """Return the run without rows in which a channel of these joints has an outlier, and a note for each such channel."""
    outliers = np.zeros(len(table.time_s), np.bool_)
    notes: list[RunIssue] = []
    for number in sorted(set(joints) & set(table.joints)):
        for name, least in _LEAST.items():
            column = getattr(table.joints[number], name)
            if column is None or not (rows := outlier_rows(column, least(joints[number]))).any():
                continue
            outliers |= rows
            first, count = int(np.argmax(rows)), int(rows.sum())
            text = (
                f"{where}: j{number}.{name}: found {counted(count, 'outlier sample')}, {column[first]:.4g} at "
                f"{table.time_s[first]:.4g} s{' first' if count > 1 else ''}, expected a value like its neighbours: "
                f"{'the row is' if count == 1 else 'these rows are'} left out: spike"
            )
            notes.append(RunIssue(f"{name}_outlier", text))
    if not notes:
        return table, []
    joints_kept = {
        number: replace(
            columns,
            **{name: x[~outliers] for name in COLUMN_NAMES if (x := getattr(columns, name)) is not None},
        )
        for number, columns in table.joints.items()
    }
    return RunTable(table.time_s[~outliers], joints_kept), notes


def outlier_rows(column: FloatArray, least: float) -> BoolArray:
    """Return the rows [n] of a column that are outliers, off by more than `least`."""
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


def on_a_cubic(at: FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
    """Return y(at) [m] on a cubic Hermite spline through (x, y) [n], x rising; at within x."""
    slope = np.gradient(y, x)
    k = np.clip(np.searchsorted(x, at, side="right") - 1, 0, len(x) - 2)
    h = x[k + 1] - x[k]
    u = np.clip((at - x[k]) / h, 0.0, 1.0)
    w = 1.0 - u
    ends = w * w * (1.0 + 2.0 * u) * y[k] + u * u * (1.0 + 2.0 * w) * y[k + 1]
    result: FloatArray = ends + h * u * w * (w * slope[k] - u * slope[k + 1])
    return result


_EVEN: Final = 1e-6
"""Part of a step by which steps differ by rounding."""
_BESIDE: Final = 0, 1, 3, 4
_SMOOTHER: Final = 0.98
"""Part of the roughness over equal steps that positions have over the stamps, at most, where the samples were taken then."""
_ROWS_AHEAD: Final = 4
_FOLLOWED: Final = 0.05
"""Part of a stamp's distance by which the phase of the cycles follows it: a clock drifts, jitter does not last."""


def are_even(time_s: FloatArray) -> bool:
    """Whether the steps between these times [n] are equal but for rounding."""
    steps = np.diff(time_s)
    median = float(np.median(steps))
    return bool(np.max(np.abs(steps - median)) <= _EVEN * median)


def row_times(time_s: FloatArray, positions: Sequence[FloatArray]) -> tuple[FloatArray, float, bool]:
    """Return when the rows of these stamps were sampled [n], their usual step, and whether it is the stamps that jitter: as
    stamped or whole steps apart, whichever leaves the positions smoother.
    """
    equal, step = _equal_steps(time_s, float(np.median(np.diff(time_s))))
    jitters = _roughness(positions, time_s) >= _SMOOTHER * _roughness(positions, equal)
    return equal if jitters else time_s, step, jitters


def _equal_steps(time_s: FloatArray, step_s: float) -> tuple[FloatArray, float]:
    """Return times of the rows [n] that are whole steps apart, and the step that ends where the stamps do.

    A row belongs to a later cycle where it and the following rows are late against the mean phase of the rows before:
    jitter makes one row late, a lost row all that follow.
    """
    ahead = np.min(
        [np.append(time_s[k:], np.full(k, np.inf)) - k * step_s for k in range(_ROWS_AHEAD)], axis=0
    )
    cycles = np.zeros(len(time_s))
    phase = float(time_s[0])
    for row, (stamp, late) in enumerate(zip(time_s.tolist(), ahead.tolist(), strict=True)):
        if row:
            steps = max(1, round((late - phase) / step_s))
            cycles[row] = cycles[row - 1] + steps
            phase += steps * step_s
            phase += _FOLLOWED * (stamp - phase)
    step = float(time_s[-1] - time_s[0]) / float(cycles[-1])
    return time_s[0] + step * cycles, step


def _roughness(positions: Sequence[FloatArray], time_s: FloatArray) -> float:
    """Return the geometric mean, over the positions that move, of the rms by which a value is off the cubic through its four
    neighbours, with the rows at these times [n]; NaN without one.
    """
    n = len(time_s) - 4
    if n < 1:
        return math.nan
    near = np.column_stack([time_s[k : n + k] for k in _BESIDE]) - time_s[2:-2, None]
    weights = np.ones_like(near)
    for k, m in permutations(range(4), 2):  # Lagrange's, at 0
        weights[:, k] *= near[:, m] / (near[:, m] - near[:, k])
    moving = [x for x in positions if np.ptp(x) > 0.0]
    beside = [np.column_stack([x[k : n + k] for k in _BESIDE]) for x in moving]
    rough = [
        float(np.std(x[2:-2] - np.sum(weights * b, axis=1))) for x, b in zip(moving, beside, strict=True)
    ]
    return math.exp(float(np.mean(np.log(rough)))) if rough and min(rough) > 0.0 else math.nan


Limits = Mapping[str, Collection[float]]
"""Sizes at which the columns of a joint saturate."""

LONGEST_HELD: Final = 0.5
"""Of the moving time: a run of which less than the rest is measured is no recording of this joint."""
_MOVED: Final = {"torque_nm": 0.1, "current_a": 0.5}
"""Part of the rated torque by which the partner must change. A commanded current may be constant while friction varies."""
_REPEATED: Final = 5
"""Rows of one number from which on a stretch is judged."""
_NEIGHBOURS: Final = 100
"""Rows before and after a stretch, at least, that show the channel's noise."""
_NOISE: Final = 3.0
"""Least noise, in steps of the channel: median second difference from row to row."""
_CHANCE: Final = 1e-9
"""Of a stretch by the channel's own repetitions."""
_MOMENTS: Final = 6


@dataclass(frozen=True)
class Held:
    """Rows of one channel [n] that are saturated or stuck; deviation [n]: of these rows from the straight line between the
    rows before and after, 0 elsewhere.
    """

    saturated: BoolArray
    stuck: BoolArray
    deviation: FloatArray

    @property
    def rows(self) -> BoolArray:
        """Rows that are no measurement [n]."""
        return np.asarray(self.saturated | self.stuck, np.bool_)


def saturation_limits(
    tables: Iterable[RunTable], joints: Mapping[int, Joint], known_loads: Collection[int] = ()
) -> dict[int, Limits]:
    """Return by joint where channels saturate in any of these runs; a limit of the torque column is one of all joints."""
    out: dict[int, dict[str, set[float]]] = {number: {} for number in joints}
    for table in tables:
        for number in set(joints) & set(table.joints):
            run = table.joints[number]
            c = Channels(table.time_s, run, joints[number], "", number in known_loads)
            for name, held in held_values(c).items():
                values = np.unique(np.abs(getattr(run, name)[held.saturated])).tolist()
                for each in joints if name == "torque_nm" else (number,):
                    out[each].setdefault(name, set()).update(values)
    return dict(out)


def held_values(c: Channels, limits: Limits | None = None) -> dict[str, Held]:
    """Return the held rows by column; columns without any are left out, and a known load. limits: those of other runs."""
    torque, current, motor_nm = c.run.torque_nm, c.run.current_a, c.motor_nm
    if c.speed is None or torque is None or current is None or motor_nm is None:
        return {}
    powered = current != 0.0
    if c.run.enabled is not None:
        powered &= c.run.enabled >= 0.5
    out = {}
    for name, values, partner, noisy in (
        ("torque_nm", torque, motor_nm, np.ones_like(c.moving)),
        ("current_a", current, torque, powered),
    ):
        if name == "torque_nm" and c.known_load:
            continue
        stuck, saturated = _while_partner_moves(c, values, partner, _MOVED[name] * c.joint.rated_torque_nm)
        for limit in (limits or {}).get(name, ()):
            saturated |= np.abs(values) == limit
        noiseless = _without_noise(values, noisy, c.moving)
        ends = [v for v in (np.min(values), np.max(values)) if v != values[-1]]
        saturated |= np.isin(values, np.unique(values[noiseless & np.isin(values, ends)]))
        stuck |= noiseless
        rows = stuck | saturated
        if rows.any():
            deviation, at = np.zeros(len(values)), np.arange(len(values))
            if not rows.all():
                deviation[rows] = values[rows] - np.interp(at[rows], at[~rows], values[~rows])
            out[name] = Held(saturated, stuck & ~saturated, deviation)
    return out


def check_held(c: Channels, limits: Limits | None = None) -> tuple[list[RunIssue], list[RunIssue]]:
    """Return issues of held values: (for more than LONGEST_HELD of the moving time, for less). limits: of other runs."""
    long: list[RunIssue] = []
    short: list[RunIssue] = []
    for name, held in held_values(c, limits).items():
        share = float(np.count_nonzero(held.rows & c.moving)) / max(1, int(np.count_nonzero(c.moving)))
        saturated = bool(held.saturated.any())
        value = getattr(c.run, name)[int(np.argmax(held.saturated if saturated else held.stuck))]
        starts = np.flatnonzero(np.diff(held.rows.astype(np.int8), prepend=0) == 1)
        apart = starts[np.diff(c.time_s[starts], prepend=-math.inf) > STUCK_S]
        at = ", ".join(f"{t:.4g}" for t in c.time_s[apart[:_MOMENTS]])
        unit, partner = ("Nm", "motor") if name == "torque_nm" else ("A", "measured")
        text = (
            f"found exactly {value:.6g} {unit} held for {share:.2%} of the moving time, from "
            f"{at}{', ..' if len(apart) > _MOMENTS else ''} s on, expected it to follow the {partner} torque or to show "
            f"noise; not used there: {'saturated or clipped' if saturated else 'stuck'} channel"
        )
        issue = c.issue(name, "saturated" if saturated else "stuck", text)
        (long if share > LONGEST_HELD else short).append(issue)
    return long, short


def _while_partner_moves(
    c: Channels, values: FloatArray, partner: FloatArray, moved: float
) -> tuple[BoolArray, BoolArray]:
    """Return rows [n] that are stuck for STUCK_S, and rows at the channel's limits, in motion or not."""
    time_s, moving = c.time_s, c.moving
    low, high = float(np.min(values)), float(np.max(values))
    stuck = np.zeros(len(values), np.bool_)
    at_limit: dict[float, list[tuple[int, int]]] = {low: [], high: []}
    limits = set()
    for start, end in _stretches(values):
        value = float(values[start])
        if value in at_limit and (value != 0.0 or moving[start]):  # a load may be exactly zero at rest
            at_limit[value].append((start, end))
        if not moving[start] or not moving[end - 1]:
            continue
        if time_s[end - 1] - time_s[start] >= STUCK_S and _range(partner[start:end]) > moved:
            if value in at_limit and end < len(values):  # one that never moves again has reached none
                limits.add(value)
            else:
                stuck[start:end] = True
    for value, stretches in at_limit.items():
        rows = sum(end - start for start, end in stretches)
        # A quantised channel also meets its extreme now and then; a limit is held, and more than once.
        if len(stretches) < 2 or rows < 10 * _REPEATED or rows < 0.8 * np.count_nonzero(values == value):
            continue
        if max(_range(partner[start:end]) for start, end in stretches) > 0.2 * moved:
            limits.add(value)
    return stuck, np.isin(values, list(limits))


def _stretches(values: FloatArray) -> Iterator[tuple[int, int]]:
    """Yield first row and end of each stretch of one number, of _REPEATED rows or more."""
    starts = np.flatnonzero(np.diff(values, prepend=math.nan) != 0.0)
    ends = np.append(starts[1:], len(values))
    long = (ends - starts) >= _REPEATED
    return zip(starts[long].tolist(), ends[long].tolist(), strict=True)


def _range(partner: FloatArray) -> float:
    """Return the range of a channel, noise of single rows averaged."""
    width = max(1, len(partner) // 8)
    whole = len(partner) // width * width
    return float(np.ptp(partner[:whole].reshape(-1, width).mean(axis=1)))


def _without_noise(values: FloatArray, noisy: BoolArray, moving: BoolArray) -> BoolArray:
    """Return rows [n] that repeat one number where the rows around them have noise of several steps; noisy: rows that must
    have noise while the joint moves.
    """
    out = np.zeros(len(values), np.bool_)
    repeats = np.concatenate(([0, 0], np.cumsum(np.diff(values) == 0.0)))  # among rows before k
    for start, end in _stretches(values):
        seen = int(np.count_nonzero(moving[start:end]))
        if not seen or not noisy[start:end].all():
            continue
        wide = max(_NEIGHBOURS, end - start)
        sides = [(max(0, start - wide), start), (end, min(len(values), end + wide))]
        sides = [(a, b) for a, b in sides if b - a >= _NEIGHBOURS // 2]
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
