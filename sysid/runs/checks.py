"""Which channels of a run may be used: one set of checks for fits, campaigns, evaluation and diagnosis (`check_run`).

Comparing a joint's channels with each other (`channels`) serves every use. A diagnosis relies on every column, so a thorough
check adds: length and time base (`time_base`), outliers and held values (`bad_samples`), constant channels, units (`units`),
energy, spikes, skew, and columns exchanged between two joints.

A joint whose columns contradict each other (unit, sign, dead, another joint's file or columns) is left out of the run with
one line. A faulty channel that is not needed (temperature, link encoder) is left out alone. What is usable but suspicious
(short stuck stretches, saturation, spikes, uneven time) is a note.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from jtqd.estimator.joint import Joint
from jtqd.estimator.run import JointColumns, RunTable
from jtqd.estimator.text import counted
from jtqd.sysid.runs.bad_samples import Limits, check_held, saturation_limits, without_outliers
from jtqd.sysid.runs.channels import (
    MOTION,
    Channels,
    RunIssue,
    check_channels,
    check_energy,
    check_spikes,
    constant_channels,
    swapped_columns,
)
from jtqd.sysid.runs.run_file import RunFile
from jtqd.sysid.runs.segments import SHORTEST_SEGMENT_S
from jtqd.sysid.runs.time_base import (
    SKEW_NOTED_S,
    SKEW_REFUSED_S,
    check_rate,
    on_even_steps,
    skew_s,
    unwrapped,
)
from jtqd.sysid.runs.units import temperature_issue, unit_issues

_REFUSING: Final = ("_dead", "_sign", "_scale", "_unit")
_REFUSING_KINDS: Final = ("gear_ratio", "joint_file")
_SPARE: Final = {
    "link_position_rad_stuck": ("link_position_rad", "link_velocity_rad_s"),
    "motor_position_rad_stuck": ("motor_position_rad",),
}
"""Columns that a diagnosis can do without when they are stuck."""


@dataclass(frozen=True)
class CheckedRun:
    """Result of `check_run`.

    Attributes:
        table: columns that may be used; None: nothing.
        refused: why joints (or the whole run) are left out. notes: what is suspicious about the rest.
    """

    table: RunTable | None
    refused: tuple[RunIssue, ...] = ()
    notes: tuple[RunIssue, ...] = ()


@dataclass(frozen=True)
class CheckedRuns:
    """Result of `check_runs`.

    Attributes:
        runs: (name, table) with the columns that may be used.
        notes, refused: as those of `CheckedRun`, one line each. lost: joints that are left out of every run.
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
) -> CheckedRun:
    """Check the joints of one run that have a joint file; `name` begins every line.

    thorough: as a diagnosis needs it; only then are columns changed (rows with an outlier left out, positions that roll over
    unwrapped, uneven steps resampled, faulty channels that are not needed left out). limits: where channels saturate in
    other runs.
    """
    if thorough:
        return _thorough(table, joints, name, limits or {})
    refused: list[RunIssue] = []
    usable: dict[int, JointColumns] = {}
    for number in sorted(set(joints) & set(table.joints)):
        issues = check_channels(_channels(table, number, joints, name))
        refused += issues
        if not issues:
            usable[number] = table.joints[number]
    return CheckedRun(RunTable(table.time_s, usable) if usable else None, tuple(refused))


def check_runs(runs: Sequence[tuple[str, RunTable]], joints: Mapping[int, Joint]) -> CheckedRuns:
    """Return what of the runs can be used for a diagnosis of `joints` (joint file by number)."""
    limits = saturation_limits((without_outliers(table, joints, name)[0] for name, table in runs), joints)
    each = [(name, check_run(table, joints, name, thorough=True, limits=limits)) for name, table in runs]
    usable = tuple((name, run.table) for name, run in each if run.table is not None)
    left = {number for _, table in usable for number in table.joints}
    recorded = {number for _, table in runs for number in table.joints}
    return CheckedRuns(
        usable,
        tuple(issue.text for _, run in each for issue in run.notes),
        tuple(issue.text for _, run in each for issue in run.refused),
        tuple(sorted(number for number in joints if number in recorded - left)),
    )


def channel_findings(runs: Sequence[RunFile], number: int, joint: Joint) -> list[RunIssue]:
    """Return what is wrong with one joint's channels in any run, including those that the reader found dead."""
    issues: list[RunIssue] = []
    for run in runs:
        issues += [
            RunIssue("dead_channel", f"{run.name}: {note}") for note in run.notes if f"j{number}." in note
        ]
        issues += check_run(run.table, {number: joint}, run.name).refused
    return issues


def _channels(table: RunTable, number: int, joints: Mapping[int, Joint], name: str) -> Channels:
    where = f"{name}: j{number}" if name else f"j{number}"
    return Channels(table.time_s, table.joints[number], joints[number], where)


def _thorough(
    table: RunTable, joints: Mapping[int, Joint], name: str, limits: Mapping[int, Limits]
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
        columns, why, odd = _checked_joint(table, number, joints, name, limits.get(number))
        notes += odd
        refused += why
        if columns is not None:
            usable[number] = columns
    if opposite := _opposite_sensors(usable, name):
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
    table: RunTable, number: int, joints: Mapping[int, Joint], name: str, limits: Limits | None
) -> tuple[JointColumns | None, list[RunIssue], list[RunIssue]]:
    """Return columns that may be used (None: the joint is left out of this run), why not, and notes."""
    c = _channels(table, number, joints, name)
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
    late = skew_s(RunTable(table.time_s, {**table.joints, number: c.run}), number, joints[number])
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
    if torque is None or not np.any(torque):
        text = (
            "found no valid torque sensor channel, expected the reference of a diagnosis: a sensor, or a known load or a "
            "model's torque (jN.load of a column map)"
        )
        return c.issue("torque_nm", "missing", text)
    motion = [column for name in MOTION if (column := getattr(c.run, name)) is not None]
    if np.ptp(torque) == 0.0 and any(np.ptp(column) > 0.0 for column in motion):
        text = (
            f"found {torque[0]:.4g} Nm in the whole run while the joint moves, expected a measurement that changes: dead "
            "channel"
        )
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
    text = (
        f"{name}: j2.torque_nm: found the opposite of j1.torque_nm, expected the same (positive along each joint's own "
        "positive current): the columns of one joint are in the frame of the other"
    )
    return [RunIssue("torque_nm_frame", text)]
