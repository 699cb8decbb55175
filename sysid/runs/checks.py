"""Which channels of a run may be used: one set of checks for fits, campaigns, evaluation and diagnosis (`check_run`).

Comparing a joint's channels with each other (`channels`) serves every use. A diagnosis relies on every column, so a thorough
check adds: length and time base (`time_base`), outliers and held values (`bad_samples`), constant channels, units (`units`),
energy, spikes, skew, and columns exchanged between two joints.

A joint whose columns contradict each other (unit, sign, dead, another joint's file or columns) is left out of the run with
one line. A faulty channel that is not needed (temperature, link encoder) is left out alone. What is usable but suspicious
(short stuck stretches, saturation, spikes, uneven time) is a note.

Time base of a run for a diagnosis: sample rate, resampling of uneven steps, unwrapping of positions, skew of channels.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.estimator.joint import Joint
from jtqd.estimator.run import JointColumns, RunTable
from jtqd.estimator.text import counted
from jtqd.sysid.runs.bad_samples import (
    Limits,
    are_even,
    check_held,
    on_a_cubic,
    row_times,
    saturation_limits,
    without_outliers,
)
from jtqd.sysid.runs.channels import (
    MOTION,
    MOVING_RAD_S,
    Channels,
    RunIssue,
    check_channels,
    check_energy,
    check_spikes,
    constant_channels,
    swapped_columns,
    temperature_issue,
    unit_issues,
)
from jtqd.sysid.runs.run_file import SHORTEST_SEGMENT_S, RunFile

SLOWEST_HZ: Final = 50.0
"""Below it accelerations and reversals are not in the data, and ripple of slow motion is aliased."""
_NOTED: Final = 0.05
"""Part of a step by which stamps are off equal steps, to be noted."""
SKEW_NOTED_S: Final = 0.02
"""Less is left to the effect channel_delay."""
SKEW_REFUSED_S: Final = 0.1
_SKEW_LONGEST_S: Final = 0.6
_SKEW_STEP_S: Final = 0.005
_SKEW_GAIN: Final = 0.5
"""Part of the residual energy that a shift must take away to be accepted."""
_SKEW_MATTERS: Final = 0.005
"""Part of the torque's variance that it must take away: a regression that leaves almost nothing is bent by stiction."""
_TURN_PER_ROW: Final = 0.25
"""Part of a turn from one row to the next up to which a roll-over can be distinguished from motion."""
_POSITIONS: Final = ("motor_position_rad", "link_position_rad")


def check_rate(time_s: FloatArray, where: str) -> list[RunIssue]:
    """Return an issue when the run is sampled too slowly for a diagnosis."""
    step = float(np.median(np.diff(time_s)))
    if 1.0 / step >= SLOWEST_HZ:
        return []
    text = (
        f"{where}: time_s: found {1.0 / step:.4g} Hz (steps of {step:.4g} s), expected at least {SLOWEST_HZ:g} Hz: "
        f"recorded too slowly for friction and ripple{', or time in milliseconds' if step >= 0.5 else ''}"
    )
    return [RunIssue("sample_rate", text)]


def on_even_steps(table: RunTable, where: str) -> tuple[RunTable, list[RunIssue]]:
    """Return the run on equal steps, and a note where its stamps are off them.

    Samples may be taken at the times that their stamps say, or at equal times that the stamps of a computer's clock, or of
    few digits, jitter about. Both are tried: positions are smooth over the right ones. Values between two rows lie on a
    cubic: linear interpolation would put two steps into the acceleration at every lost cycle.
    """
    steps = np.diff(table.time_s)
    median = float(np.median(steps))
    apart = np.abs(steps - median)
    if are_even(table.time_s):
        return table, []
    positions = [getattr(columns, name) for columns in table.joints.values() for name in _POSITIONS]
    rows, step, jitters = row_times(table.time_s, [x for x in positions if x is not None])
    out = _resampled(table, rows, step)
    if np.max(apart) <= _NOTED * median:
        return table if jitters else out, []
    count, longest = int(np.count_nonzero(apart > _NOTED * median)), float(np.max(steps))
    off = f"off the median of {median:.4g} s by more than {_NOTED:.0%} (up to {longest:.4g} s)"
    found = f"{where}: time_s: found {count} of {len(steps)} steps {off}"
    if not jitters or np.max(np.abs(table.time_s - rows)) <= _NOTED * median:
        return out, [RunIssue("time_uneven", f"{found}: resampled to equal steps")]
    text = f"{found}, but positions are smooth over equal steps: the stamps jitter, not the samples; equal steps used"
    return out, [RunIssue("time_jitter", text)]


def _resampled(table: RunTable, time_s: FloatArray, step_s: float) -> RunTable:
    """Return the run on steps of step_s, its rows at these times [n]."""
    grid = np.arange(time_s[0], time_s[-1] + 1e-9, step_s)
    joints = {
        number: columns.map(lambda _, column: on_a_cubic(grid, time_s, column))
        for number, columns in table.joints.items()
    }
    return RunTable(grid, joints)


def unwrapped(table: RunTable, where: str) -> tuple[RunTable, list[RunIssue]]:
    """Return the run with positions that roll over made continuous, and a note for each."""
    joints: dict[int, JointColumns] = {}
    notes: list[RunIssue] = []
    for number, columns in table.joints.items():
        changed: dict[str, Any] = {}
        for name in _POSITIONS:
            position = getattr(columns, name)
            turn = None if position is None else _turn(position)
            if turn is None:
                continue
            changed[name] = np.unwrap(position, period=turn)
            rolls = int(np.count_nonzero(np.abs(np.diff(position)) > 0.5 * turn))
            found = f"found it rolling over by {turn:.4g} rad {counted(rolls, 'time')}: made continuous"
            notes.append(RunIssue("position_rollover", f"{where}: j{number}.{name}: {found}"))
        joints[number] = replace(columns, **changed) if changed else columns
    return (RunTable(table.time_s, joints) if notes else table), notes


def _turn(position: FloatArray) -> float | None:
    """Return the period of a position that rolls over by 2 pi (or by 360, before degrees are found), else None."""
    steps = np.abs(np.diff(position))
    for period in (2.0 * math.pi, 360.0):
        jumps = steps > 0.5 * period
        if not jumps.any() or jumps.all():
            continue
        usual = float(np.quantile(steps[~jumps], 0.99))
        if usual < _TURN_PER_ROW * period and np.all(np.abs(steps[jumps] - period) < 0.1 * period + usual):
            return period
    return None


def skew_s(table: RunTable, number: int, joint: Joint) -> float | None:
    """Return the seconds by which the sensor's torque is late (early: negative) against current and motion; None: unknown.

    The torque is shifted over the regression on motor torque, acceleration, friction's sign, velocity and a constant, over
    the rows in which the joint moves: in one that stands stiction holds any torque. The channels are in step where the
    residual is smallest. Friction would bias a plain cross-correlation.
    """
    columns = table.joint(number, joint.gear_ratio)
    torque, current, velocity = columns.torque_nm, columns.current_a, columns.motor_velocity_rad_s
    if torque is None or current is None or velocity is None:
        return None
    dt = float(np.median(np.diff(table.time_s)))
    width = max(1, round(_SKEW_STEP_S / dt))
    whole = len(torque) // width * width
    tau, i, w = (x[:whole].reshape(-1, width).mean(axis=1) for x in (torque, current, velocity))
    step = dt * width
    reach = round(_SKEW_LONGEST_S / step)
    v = w / joint.gear_ratio
    inside = slice(reach, len(v) - reach)
    moving = np.abs(v[inside]) > MOVING_RAD_S
    if len(v) < 6 * reach or np.count_nonzero(moving) < 100:
        return None
    x = np.column_stack((i, np.gradient(w, step), np.sign(v), v, np.ones(len(v))))[inside]
    size = np.linalg.norm(x, axis=0)
    q = np.zeros_like(x)
    q[moving], _ = np.linalg.qr((x / np.where(size > 0.0, size, 1.0))[moving])
    residual = _residual_shares(q, moving, tau - np.mean(tau), 2 * reach + 1)
    best = int(np.argmin(residual))
    if residual[reach] - residual[best] < _SKEW_MATTERS:
        return 0.0
    at_end = best in (0, 2 * reach)
    if residual[best] > (1.0 - _SKEW_GAIN) * residual[reach] or residual[best] > 0.5 or at_end:
        return 0.0 if best == reach else None
    return (best - reach) * step


def _residual_shares(q: FloatArray, rows: BoolArray, y: FloatArray, shifts: int) -> FloatArray:
    """Return the part of the variance of y[k : k + n][rows] that q does not explain, k = 0 .. shifts - 1.

    q [n, p]: orthonormal, its span has the constant, and it is zero outside of rows [n]. All shifts at once: sums of
    products are correlations, by FFT.
    """
    size = 1 << (len(y) + len(q)).bit_length()
    spectra = [np.conj(np.fft.rfft(x, size, axis=0)) for x in (q, rows[:, None])]
    products, total, energy = (
        np.fft.irfft(np.fft.rfft(x, size)[:, None] * spectrum, size, axis=0)[:shifts]
        for x, spectrum in ((y, spectra[0]), (y, spectra[1]), (y * y, spectra[1]))
    )
    constant = total[:, 0] ** 2 / np.count_nonzero(rows)
    variance = np.maximum(energy[:, 0] - constant, 1e-30)
    result: FloatArray = 1.0 - (np.sum(products**2, axis=1) - constant) / variance
    return result


_REFUSING: Final = ("_dead", "_sign", "_scale", "_unit")
_REFUSING_KINDS: Final = ("gear_ratio", "joint_file")
_SPARE: Final = {
    "link_position_rad_stuck": ("link_position_rad", "link_velocity_rad_s"),
    "motor_position_rad_stuck": ("motor_position_rad",),
}
"""Columns that a diagnosis can do without when they are stuck."""


@dataclass(frozen=True)
class CheckedRun:
    """Columns that may be used (None: nothing), why joints or the whole run are left out, and what is suspicious about the
    rest.
    """

    table: RunTable | None
    refused: tuple[RunIssue, ...] = ()
    notes: tuple[RunIssue, ...] = ()


@dataclass(frozen=True)
class CheckedRuns:
    """(name, table) of the runs with the columns that may be used, lines as of `CheckedRun`, and joints left out of every
    run.
    """

    runs: tuple[tuple[str, RunTable], ...]
    notes: tuple[str, ...]
    refused: tuple[str, ...]
    lost: tuple[int, ...]


def check_run(
    table: RunTable,
    joints: Mapping[int, Joint],
    name: str = "",
    *,
    thorough: bool = False,
    limits: Mapping[int, Limits] | None = None,
    known_loads: Collection[int] = (),
) -> CheckedRun:
    """Check the joints of one run that have a joint file; `name` begins every line. limits: where channels saturate in
    other runs. known_loads: joints whose torque is computed and no sensor's (`RunFile.known_loads`).

    thorough: as a diagnosis needs it; only then are columns changed (rows with an outlier left out, positions that roll
    over unwrapped, uneven steps resampled, faulty channels that are not needed left out).
    """
    if thorough:
        return _thorough(table, joints, name, limits or {}, known_loads)
    refused: list[RunIssue] = []
    usable: dict[int, JointColumns] = {}
    for number in sorted(set(joints) & set(table.joints)):
        issues = check_channels(_channels(table, number, joints, name, known_loads))
        refused += issues
        if not issues:
            usable[number] = table.joints[number]
    return CheckedRun(RunTable(table.time_s, usable) if usable else None, tuple(refused))


def check_runs(
    runs: Sequence[tuple[str, RunTable]], joints: Mapping[int, Joint], known_loads: Collection[int] = ()
) -> CheckedRuns:
    """Return what of the runs can be used for a diagnosis of `joints` (joint file by number); known_loads as `check_run`."""
    clean = (without_outliers(table, joints, name)[0] for name, table in runs)
    limits = saturation_limits(clean, joints, known_loads)
    each = [
        (name, check_run(table, joints, name, thorough=True, limits=limits, known_loads=known_loads))
        for name, table in runs
    ]
    usable = tuple((name, run.table) for name, run in each if run.table is not None)
    left = {number for _, table in usable for number in table.joints}
    recorded = {number for _, table in runs for number in table.joints}
    return CheckedRuns(
        usable,
        tuple(issue.text for _, run in each for issue in run.notes),
        tuple(issue.text for _, run in each for issue in run.refused),
        tuple(sorted(number for number in joints if number in recorded - left)),
    )


def may_leave_out(out: int, of: int) -> bool:
    """Return whether so many of the recordings may be left out: fewer than half, so that no minority is judged alone."""
    return 2 * out < of


def channel_findings(runs: Sequence[RunFile], number: int, joint: Joint) -> list[RunIssue]:
    """Return what is wrong with one joint's channels in any run, including those that the reader found dead."""
    issues: list[RunIssue] = []
    for run in runs:
        issues += [
            RunIssue("dead_channel", f"{run.name}: {note}")
            for note in run.notes
            if f"j{number}." in note and "dead channel" in note
        ]
        issues += check_run(run.table, {number: joint}, run.name, known_loads=run.known_loads).refused
    return issues


def _channels(
    table: RunTable, number: int, joints: Mapping[int, Joint], name: str, known_loads: Collection[int]
) -> Channels:
    where = f"{name}: j{number}" if name else f"j{number}"
    return Channels(table.time_s, table.joints[number], joints[number], where, number in known_loads)


def _thorough(
    table: RunTable,
    joints: Mapping[int, Joint],
    name: str,
    limits: Mapping[int, Limits],
    known_loads: Collection[int],
) -> CheckedRun:
    unfit = _too_short(table, name) or check_rate(table.time_s, name)
    if unfit:
        return CheckedRun(None, tuple(unfit))
    table, notes = without_outliers(table, joints, name)
    constant = {
        number: [*constant_channels(table.joints[number], f"{name}: j{number}")]
        for number in sorted(set(joints) & set(table.joints))
    }
    standing = [issue for each in constant.values() for issue in each]
    if constant and all(len(each) == 2 for each in constant.values()):  # neither motion nor current changes
        return CheckedRun(None, tuple(standing), tuple(notes))
    table, rolled = unwrapped(table, name)
    table, uneven = on_even_steps(table, name)
    notes += standing + rolled + uneven
    exchanged = swapped_columns(table, joints, name)
    refused = [issue for _, _, issue in exchanged]
    swapped = {number for a, b, _ in exchanged for number in (a, b)}
    usable: dict[int, JointColumns] = {}
    for number in sorted(set(joints) & set(table.joints) - swapped):
        c = _channels(table, number, joints, name, known_loads)
        columns, why, odd = _checked_joint(c, limits.get(number))
        notes += odd
        refused += why
        if columns is not None:
            usable[number] = columns
    sensors = {number: columns for number, columns in usable.items() if number not in known_loads}
    if opposite := _opposite_sensors(sensors, name):
        refused += opposite
        del usable[2]
    return CheckedRun(RunTable(table.time_s, usable) if usable else None, tuple(refused), tuple(notes))


def _too_short(table: RunTable, name: str) -> list[RunIssue]:
    seconds = float(table.time_s[-1] - table.time_s[0] + np.median(np.diff(table.time_s)))
    if seconds > (1.0 - 1e-6) * SHORTEST_SEGMENT_S:
        return []
    found = f"{counted(len(table.time_s), 'sample')}, {seconds:.3g} s"
    text = f"{name}: found {found}, expected a run of at least {SHORTEST_SEGMENT_S:g} s"
    return [RunIssue("too_short", text)]


def _checked_joint(
    c: Channels, limits: Limits | None
) -> tuple[JointColumns | None, list[RunIssue], list[RunIssue]]:
    """Return columns that may be used (None: the joint is left out of this run), why not, and notes."""
    if missing := _missing(c):
        return None, [missing], []
    notes: list[RunIssue] = []
    if (hot := temperature_issue(c)) is not None:
        notes.append(hot)
        c = replace(c, run=replace(c.run, temperature_c=None))
    issues = unit_issues(c) or check_channels(c) or [*check_energy(c)]
    refusing = [i for i in issues if i.kind.endswith(_REFUSING) or i.kind in _REFUSING_KINDS]
    if refusing:
        return None, refusing, notes
    for item in issues:
        if item.kind in _SPARE:
            unused: dict[str, Any] = dict.fromkeys(_SPARE[item.kind])
            c = replace(c, run=replace(c.run, **unused))
            notes.append(RunIssue(item.kind, f"{item.text}; not used"))
    refusing, short = check_held(c, limits)
    notes += [*short, *check_spikes(c)]
    if refusing:
        return None, refusing, notes
    late = None if c.known_load else skew_s(RunTable(c.time_s, {1: c.run}), 1, c.joint)
    if late is not None and abs(late) >= SKEW_NOTED_S:
        side = "behind" if late > 0.0 else "ahead of"
        text = f"found it {abs(late):.3g} s {side} current and motion, expected channels in step: skew"
        skew = c.issue("torque_nm", "skew", text)
        if abs(late) >= SKEW_REFUSED_S:
            return None, [skew], notes
        notes.append(skew)
    return c.run, [], notes


def _missing(c: Channels) -> RunIssue | None:
    """Return the first column that is missing or dead and without which a joint cannot be diagnosed."""
    torque = c.run.torque_nm
    if torque is None or not (np.any(torque) or c.known_load):
        text = "found no valid torque sensor channel, expected one, or a known load or a model's torque (jN.load)"
        return c.issue("torque_nm", "missing", text)
    motion = [column for name in MOTION if (column := getattr(c.run, name)) is not None]
    if not c.known_load and np.ptp(torque) == 0.0 and any(np.ptp(column) > 0.0 for column in motion):
        text = f"found {torque[0]:.4g} Nm in the whole run while the joint moves: dead channel"
        return c.issue("torque_nm", "dead", text)
    if c.run.current_a is None:
        return c.issue("current_a", "missing", "found no such column, expected the motor current")
    if not motion:
        text = f"{c.where}: found no position and no velocity, expected at least one of them"
        return RunIssue("motion_missing", text)
    return None


def _opposite_sensors(usable: Mapping[int, JointColumns], name: str) -> list[RunIssue]:
    """On the bench both joints carry the one sensor, each positive along its own current: the same column twice."""
    if 1 not in usable or 2 not in usable:
        return []
    one, two = usable[1].torque_nm, usable[2].torque_nm
    assert one is not None
    assert two is not None
    size = float(np.std(one))
    if size == 0.0 or float(np.std(one + two)) > 0.2 * size:
        return []
    text = f"{name}: j2.torque_nm: found the opposite of j1.torque_nm: columns of one joint in the frame of the other"
    return [RunIssue("torque_nm_frame", text)]
