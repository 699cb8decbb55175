"""From the content of a file to its checked runs: one run table of the whole, or one for each piece between gaps. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Final

import numpy as np

from jtqd.estimator.checked import counted
from jtqd.estimator.run import COLUMN_NAMES, JointColumns, RunTable, RunTableError
from jtqd.sysid.runs.column_map import JOINTS, TIME
from jtqd.sysid.runs.content import Content, header_place
from jtqd.sysid.runs.run_file import RunError, RunFile
from jtqd.sysid.runs.stamps import with_rounded_stamps, without_repeated_rows
from jtqd.sysid.runs.time_steps import (
    BRIDGED_S,
    SHORTEST_PIECE_S,
    between_gaps,
    check_time,
    length_s,
    new_runs,
)

DEAD_ROWS: Final = 100
"""A channel without a single non-zero value over this many rows is dead, not quiet."""


def runs_of(content: Content, *, whole: bool) -> list[RunFile]:
    """Check time and columns of a file and make its run table, or one for each of its pieces."""
    if not whole:
        content = with_rounded_stamps(without_repeated_rows(content))
    time_s, path = content.values[TIME], content.path
    if len(time_s) < 2:
        raise RunError(f"{path}: found {counted(len(time_s), 'sample')}, expected at least 2")
    starts = [] if whole else new_runs(time_s)
    runs = [slice(a, b) for a, b in pairwise([0, *starts, len(time_s)])]
    notes = list(content.notes)
    for number, run in enumerate(runs, 1):
        found = check_time(time_s, content.lines, path, run=run, whole=whole)
        notes += [f"run {number}: {note}" if starts else note for note in found]
    cuts = [[run] if whole else between_gaps(time_s, run) for run in runs]
    count = sum(map(len, cuts))
    long = [[cut for cut in each if count == 1 or length_s(time_s, cut) >= SHORTEST_PIECE_S] for each in cuts]
    if not any(long):
        longest = max(length_s(time_s, cut) for each in cuts for cut in each)
        raise RunError(
            f"{path}: found {count} pieces between gaps, the longest of {longest:.3g} s, expected one of at least "
            f"{SHORTEST_PIECE_S:g} s"
        )
    if starts:
        notes.append(f"the time starts again {counted(len(starts), 'time')}: {len(runs)} runs in one file")
    if count > len(runs):
        kept = sum(length_s(time_s, cut) for each in long for cut in each)
        whole_s = sum(length_s(time_s, run) for run in runs)
        pieces = counted(sum(map(len, long)), "piece")
        notes.append(
            f"{counted(count - len(runs), 'gap')} of more than {BRIDGED_S:g} s: used as {pieces} of "
            f"{'one recording' if len(runs) == 1 else 'these runs'}, {kept:.3g} s of {whole_s:.3g} s"
        )
    elif sum(map(len, long)) < count:
        notes.append(
            f"{counted(count - sum(map(len, long)), 'run')} of less than {SHORTEST_PIECE_S:g} s left out"
        )
    if count > 1:
        notes += _unwrapped_over_gaps(content)
    if content.columns is not None:
        notes += content.columns.remarks()
    read: list[RunFile] = []
    for number, each in enumerate(long, 1):
        name = f"{path.name} (run {number} of {len(runs)})" if starts else path.name
        for k, cut in enumerate(each, 1):
            read.append(_piece(content, cut, name, [] if read else notes, (k, len(each))))
    return read


def _piece(content: Content, cut: slice, name: str, notes: Sequence[str], place: tuple[int, int]) -> RunFile:
    """Make the run table of the rows of one piece; name: of its run."""
    path, notes = content.path, list(notes)
    values = {key: value[cut] for key, value in content.values.items()}
    if content.columns is not None:
        values = content.columns.completed(values)
    joints: dict[int, JointColumns] = {}
    for joint in JOINTS:
        parts = {q: values.get(f"j{joint}.{q}") for q in COLUMN_NAMES}
        if all(part is None for part in parts.values()):
            continue
        torque = parts["torque_nm"]
        if torque is not None and len(torque) >= DEAD_ROWS and not np.any(torque):
            notes.append(
                f"j{joint}.torque_nm is exactly zero in all {len(torque)} rows: dead channel, not used"
            )
            parts["torque_nm"] = None
        joints[joint] = JointColumns(**parts)
    if not joints:
        raise RunError(
            f"{path}:{header_place(path)} found no joint's columns, expected at least one of j1.current_a, ..."
        )
    try:
        table = RunTable(time_s=values[TIME], joints=joints)
    except RunTableError as error:  # a scale of the column map that leaves the range of a float
        raise RunError(f"{path}: {error}") from None
    name = name if place[1] == 1 else f"{name} ({place[0]} of {place[1]})"
    return RunFile(name, path, content.source, content.sha256, table, tuple(notes), place)


def _unwrapped_over_gaps(content: Content) -> list[str]:
    if content.columns is None:
        return []
    named = [key for key, column in content.columns.sources().items() if "unwrap(" in column.name]
    what = "its turns in the gaps are not known: an angle of a later piece may be off by whole periods"
    return [f"{key} is unwrapped, {what}" for key in named]
