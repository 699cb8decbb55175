"""What of a run may be used: `check_run`, one set of checks for fits, campaigns, evaluation and diagnosis.

Every check of a joint's channels against each other holds for every use (`channels`). A diagnosis takes every column at
its word, so a thorough check asks more: length and time base (`time_base`), single samples that are none (`wild`), channels
of one value, units (`units`), energy, held and clipped stretches, spikes, skew, columns exchanged between two joints
(`swapped`). A joint of a run whose columns contradict each other (unit,
sign, dead, another joint's file or columns) is left out with one line; a channel that is only not needed (temperature, link
encoder) is left out alone; what is usable but odd (short stuck stretches, clipping, spikes, uneven time) is a note.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from jtqd.estimator.checked import counted
from jtqd.estimator.joint import Joint
from jtqd.estimator.run import JointColumns, RunTable
from jtqd.sysid.runs.bad_samples import Limits, check_held, clip_limits, without_wild_samples
from jtqd.sysid.runs.channels import (
    RunIssue,
    check_channels,
    check_energy,
    check_spikes,
    one_value,
    swapped_columns,
)
from jtqd.sysid.runs.run_file import RunFile
from jtqd.sysid.runs.segments import SHORTEST_PIECE_S
from jtqd.sysid.runs.time_base import (
    SKEW_NOTED_S,
    SKEW_REFUSED_S,
    check_rate,
    on_even_steps,
    skew_s,
    unwrapped,
)
from jtqd.sysid.runs.units import temperature_issue, unit_issues

__all__ = [
    "CheckedRun",
    "CheckedRuns",
    "RunIssue",
    "channel_findings",
    "check_channels",
    "check_run",
    "check_runs",
]

_REFUSING: Final = ("_dead", "_sign", "_scale", "_unit")
_REFUSING_KINDS: Final = ("gear_ratio", "joint_file")
_MOTION: Final = ("motor_position_rad", "motor_velocity_rad_s", "link_position_rad", "link_velocity_rad_s")
_SPARE: Final = {
    "link_position_rad_stuck": ("link_position_rad", "link_velocity_rad_s"),
    "motor_position_rad_stuck": ("motor_position_rad",),
}
"""Columns that a diagnosis can do without when they are stuck."""


@dataclass(frozen=True)
class CheckedRun:
    """Result of `check_run`.

    Attributes:
        table: what may be used; None: nothing.
        refused: why joints (or the whole run) are left out. notes: what is odd about the rest.
    """

    table: RunTable | None
    refused: tuple[RunIssue, ...] = ()
    notes: tuple[RunIssue, ...] = ()


@dataclass(frozen=True)
class CheckedRuns:
    """Result of `check_runs`.

    Attributes:
        runs: (name, table) with what may be used.
        notes, refused: as those of `CheckedRun`, one line each. lost: joints of which nothing is left.
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

    thorough: as a diagnosis needs it; only then are columns changed (rows with a wild sample left out, positions that roll
    over made continuous, uneven steps made even, channels that are not needed left out when they are wrong). limits: where
    channels clip in other runs.
    """
    notes: list[RunIssue] = []
    if thorough:
        unfit = _too_short(table, name) or check_rate(table.time_s, name)
        if unfit:
            return CheckedRun(None, tuple(unfit))
        table, wild = without_wild_samples(table, joints, name)
        standing, still = _of_one_value(table, joints, name)
        if standing:
            return CheckedRun(None, tuple(standing), tuple(wild))
        table, rolled = unwrapped(table, name)
        table, uneven = on_even_steps(table, name)
        notes += wild + still + rolled + uneven
    refused: list[RunIssue] = []
    usable: dict[int, JointColumns] = {}
    exchanged = swapped_columns(table, joints, name) if thorough else []
    refused += [issue for _, _, issue in exchanged]
    for number in sorted(set(joints) & set(table.joints) - {n for a, b, _ in exchanged for n in (a, b)}):
        where = f"{name}: j{number}" if name else f"j{number}"
        if thorough:
            columns, why, odd = _checked_joint(
                table, number, joints[number], where, (limits or {}).get(number)
            )
            notes += odd
        else:
            columns = table.joints[number]
            why = check_channels(table.time_s, columns, joints[number], where)
        refused += why
        if columns is not None and not why:
            usable[number] = columns
    if thorough:
        opposite = _opposite_sensors(usable, name)
        if opposite:
            refused += opposite
            del usable[2]
    return CheckedRun(RunTable(table.time_s, usable) if usable else None, tuple(refused), tuple(notes))


def check_runs(runs: Sequence[tuple[str, RunTable]], joints: Mapping[int, Joint]) -> CheckedRuns:
    """Return what of the runs can be used for a diagnosis of `joints` (joint file by number)."""
    limits = clip_limits((without_wild_samples(table, joints, name)[0] for name, table in runs), joints)
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
    """Return what is wrong with one joint's channels in any run, those included that the reader has called dead."""
    issues: list[RunIssue] = []
    for run in runs:
        issues += [
            RunIssue("dead_channel", f"{run.name}: {note}") for note in run.notes if f"j{number}." in note
        ]
        issues += check_run(run.table, {number: joint}, run.name).refused
    return issues


def _too_short(table: RunTable, name: str) -> list[RunIssue]:
    seconds = float(table.time_s[-1] - table.time_s[0] + np.median(np.diff(table.time_s)))
    if seconds > (1.0 - 1e-6) * SHORTEST_PIECE_S:
        return []
    found = f"{counted(len(table.time_s), 'sample')}, {seconds:.3g} s"
    return [
        RunIssue("too_short", f"{name}: found {found}, expected a run of at least {SHORTEST_PIECE_S:g} s")
    ]


def _of_one_value(
    table: RunTable, joints: Mapping[int, Joint], name: str
) -> tuple[list[RunIssue], list[RunIssue]]:
    """Return why nothing was measured in a run whose joints stand with a constant current, else notes of joints that stand
    and of currents that never change in motion.
    """
    found = {n: one_value(table.joints[n], f"{name}: j{n}") for n in sorted(set(joints) & set(table.joints))}
    issues = [issue for each in found.values() for issue in each]
    dead = found and all(len(each) == 2 for each in found.values())
    return (issues, []) if dead else ([], issues)


def _checked_joint(
    table: RunTable, number: int, joint: Joint, where: str, limits: Limits | None
) -> tuple[JointColumns | None, list[RunIssue], list[RunIssue]]:
    """Return columns that may be used (None: the joint is left out of this run), why not, and notes."""
    columns = table.joints[number]
    missing = _missing(columns, where)
    if missing:
        return None, missing, []
    notes: list[RunIssue] = []
    hot = temperature_issue(table.time_s, columns, where)
    if hot is not None:
        notes.append(hot)
        columns = replace(columns, temperature_c=None)
    issues = (
        unit_issues(table.time_s, columns, joint, where)
        or check_channels(table.time_s, columns, joint, where)
        or check_energy(table.time_s, columns, joint, where)
    )
    refusing = [i for i in issues if i.kind.endswith(_REFUSING) or i.kind in _REFUSING_KINDS]
    if refusing:
        return None, refusing, notes
    columns, spared = _spared(columns, issues)
    notes += spared
    refusing, short = check_held(table.time_s, columns, joint, where, limits)
    notes += short + check_spikes(columns, joint, where)
    if refusing:
        return None, refusing, notes
    late = skew_s(RunTable(table.time_s, {**table.joints, number: columns}), number, joint)
    if late is not None and abs(late) >= SKEW_NOTED_S:
        skew = RunIssue(
            "torque_nm_skew",
            f"{where}.torque_nm: found it {abs(late):.3g} s {'behind' if late > 0.0 else 'ahead of'} current and motion, "
            "expected channels in step: skew",
        )
        if abs(late) >= SKEW_REFUSED_S:
            return None, [skew], notes
        notes.append(skew)
    return columns, [], notes


def _missing(columns: JointColumns, where: str) -> list[RunIssue]:
    """Return the first column that is missing or dead and without which a joint cannot be diagnosed."""
    if columns.torque_nm is None or not np.any(columns.torque_nm):
        return [
            RunIssue(
                "torque_nm_missing",
                f"{where}.torque_nm: found no valid torque sensor channel, expected the reference of a diagnosis: a sensor, "
                "or a known load or a model's torque (jN.load of a column map)",
            )
        ]
    if np.ptp(columns.torque_nm) == 0.0 and _moves(columns):
        text = (
            f"{where}.torque_nm: found {columns.torque_nm[0]:.4g} Nm in the whole run while the joint moves"
        )
        return [RunIssue("torque_nm_dead", f"{text}, expected a measurement that changes: dead channel")]
    if columns.current_a is None:
        text = f"{where}.current_a: found no such column, expected the motor current"
        return [RunIssue("current_a_missing", text)]
    if all(getattr(columns, name) is None for name in _MOTION):
        text = f"{where}: found no position and no velocity, expected at least one of them"
        return [RunIssue("motion_missing", text)]
    return []


def _moves(columns: JointColumns) -> bool:
    return any(np.ptp(column) > 0.0 for name in _MOTION if (column := getattr(columns, name)) is not None)


def _spared(columns: JointColumns, issues: Sequence[RunIssue]) -> tuple[JointColumns, list[RunIssue]]:
    """Return columns without the stuck ones that a diagnosis can do without."""
    notes = []
    for item in issues:
        unused = _SPARE.get(item.kind)
        if unused is not None:
            empty: dict[str, Any] = dict.fromkeys(unused)
            columns = replace(columns, **empty)
            notes.append(RunIssue(item.kind, f"{item.text}; not used"))
    return columns, notes


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
    return [
        RunIssue(
            "torque_nm_frame",
            f"{name}: j2.torque_nm: found the opposite of j1.torque_nm, expected the same (positive along each joint's own "
            "positive current): the columns of one joint are in the frame of the other",
        )
    ]
