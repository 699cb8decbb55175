"""A run as read from a file, the columns of a file before they are checked, and the error for a file that cannot be used.

Time stamps of a recording: repeated and rounded stamps, restarts and gaps; the run table of each segment between them.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.errors import OneLineError
from jtqd.estimator.files import read_file
from jtqd.estimator.run import COLUMN_NAMES, JointColumns, RunTable, RunTableError
from jtqd.estimator.text import counted
from jtqd.sysid.runs.column_map import JOINTS, QUIET, SHARP, TIME, ColumnMap


class RunError(OneLineError):
    """A run file cannot be used; the message is one line: file, place, found, expected."""


class NoColumnError(RunError):
    """It lacks a column."""


@dataclass(frozen=True)
class RunFile:
    """A run as read: name for messages, unique among the runs read together; file, its kind ("csv", "parquet", "mcap") and
    SHA-256 (hex); columns (the segments of one recording keep its time); what is suspicious, one line each; joints whose
    torque is a known load's or a model's, and no sensor's; known parts [n, Nm] of loads on an unknown arm, by joint.
    """

    name: str
    path: Path
    source: str
    sha256: str
    table: RunTable
    notes: tuple[str, ...] = ()
    known_loads: tuple[int, ...] = ()
    known_parts: Mapping[int, FloatArray] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"RunFile({self.name}, {self.source}, {self.table!r})"


@dataclass(frozen=True)
class Content:
    """Columns of a file: targets and further sources [n] by key, and their lines [n] for messages (None: sample numbers)."""

    path: Path
    source: str
    sha256: str
    values: Mapping[str, FloatArray]
    lines: Sequence[int] | None = None
    notes: tuple[str, ...] = ()
    columns: ColumnMap | None = None


def file_bytes(path: Path) -> tuple[bytes, str]:
    """Return the content of a file and its SHA-256. Raises RunError."""
    try:
        data = read_file(path)
    except OSError as error:
        raise RunError(f"{path}: cannot be read: {error.strerror or error}") from None
    if not data:
        raise RunError(f"{path}: found an empty file, expected a run")
    return data, hashlib.sha256(data).hexdigest()


def header_place(path: Path) -> str:
    """Return the line of a table's header for messages; only text has lines."""
    return " line 1:" if ".csv" in path.name.lower() else ""


LONGEST_GAP: Final = 10.0
"""Median steps: a longer step separates two segments. A reader of whole runs refuses it, because a fit or an observer would
take the jump for a measurement; `read_runs(.., segments=True)` splits the run there. Shorter gaps are notes."""
BRIDGED_S: Final = 0.025
"""When a run is split, a gap this short is bridged: `time_base.on_even_steps` interpolates it."""
SHORTEST_SEGMENT_S: Final = 1.0
"""Also the least step back of the time that begins a new run; a smaller one is a wrong stamp."""
GAP_NOTED: Final = 1.5
_MOST_ALIKE: Final = 3
"""Equal stamps in a row that rounding can make."""
_LEAST_STEP: Final = 0.9995
"""Least mean step, in usual steps, of stamps that were rounded; below it there are rows too many."""
DEAD_ROWS: Final = 100
"""A channel without a single non-zero value over this many rows is dead, not quiet."""


def runs_of(content: Content, *, whole: bool) -> list[RunFile]:
    """Check time and columns of a file and make its run table, or one for each of its segments. Raises RunError."""
    if not whole:
        content = _with_spread_stamps(_with_even_stamps(_without_repeated_rows(content)))
    time_s, path = content.values[TIME], content.path
    if len(time_s) < 2:
        raise RunError(f"{path}: found {counted(len(time_s), 'sample')}, expected at least 2")
    starts = [] if whole else _restarts(time_s)
    runs = [slice(a, b) for a, b in pairwise([0, *starts, len(time_s)])]
    notes = list(content.notes)
    for number, run in enumerate(runs, 1):
        found = _check_time(content, run, whole=whole)
        notes += [f"run {number}: {note}" if starts else note for note in found]
    cuts = [[run] if whole else _between_gaps(time_s, run) for run in runs]
    count = sum(map(len, cuts))

    def length_s(cut: slice) -> float:
        return float(time_s[cut.stop - 1] - time_s[cut.start])

    long = [[cut for cut in each if count == 1 or length_s(cut) >= SHORTEST_SEGMENT_S] for each in cuts]
    if not any(long):
        longest = max(length_s(cut) for each in cuts for cut in each)
        raise RunError(
            f"{path}: found {count} segments between gaps, the longest of {longest:.3g} s, expected one of at least "
            f"{SHORTEST_SEGMENT_S:g} s"
        )
    used = sum(map(len, long))
    if starts:
        notes.append(f"the time starts again {counted(len(starts), 'time')}: {len(runs)} runs in one file")
    if count > len(runs):
        used_s = sum(length_s(cut) for each in long for cut in each)
        whole_s = sum(map(length_s, runs))
        notes.append(
            f"{counted(count - len(runs), 'gap')} of more than {BRIDGED_S:g} s: used as {counted(used, 'segment')} of "
            f"{'one recording' if len(runs) == 1 else 'these runs'}, {used_s:.3g} s of {whole_s:.3g} s"
        )
    elif used < count:
        notes.append(f"{counted(count - used, 'run')} of less than {SHORTEST_SEGMENT_S:g} s left out")
    if content.columns is not None:
        if count > 1:
            what = "its turns in the gaps are unknown: an angle of later segments may be off by whole periods"
            sources = content.columns.sources().items()
            notes += [f"{key} is unwrapped, {what}" for key, column in sources if "unwrap(" in column.name]
        notes += content.columns.remarks()
    read: list[RunFile] = []
    for number, each in enumerate(long, 1):
        name = f"{path.name} (run {number} of {len(runs)})" if starts else path.name
        for k, cut in enumerate(each, 1):
            full_name = f"{name} ({k} of {len(each)})" if len(each) > 1 else name
            read.append(_segment(content, cut, full_name, [] if read else notes, SHARP if whole else QUIET))
    return read


def _without_repeated_rows(content: Content) -> Content:
    """Return the content without rows that were written twice in a row, and a note. Two rows that share only their stamp
    stay, to be refused.
    """
    columns = np.array(list(content.values.values()))
    again = np.concatenate(([False], np.all(columns[:, 1:] == columns[:, :-1], axis=0)))
    if not again.any():
        return content
    lines = None if content.lines is None else [content.lines[int(k)] for k in np.flatnonzero(~again)]
    note = f"{int(again.sum())} of {counted(len(again), 'row')} left out: they are the row before once more"
    values = {key: value[~again] for key, value in content.values.items()}
    return replace(content, values=values, lines=lines, notes=(*content.notes, note))


def _with_even_stamps(content: Content) -> Content:
    """Return the content with the stamps between two gaps on the equal steps that they are rounded from (`even_stamps`), and
    a note where that moves one by a part of a step.
    """
    time_s = content.values[TIME].copy()
    if len(time_s) < 2:
        return content
    steps = np.diff(time_s)
    cuts = np.flatnonzero((steps > _longest_step(steps)) | (steps <= -SHORTEST_SEGMENT_S)) + 1
    moved, worst = 0.0, 0.0
    for a, b in pairwise([0, *(int(cut) for cut in cuts), len(time_s)]):
        even = even_stamps(time_s[a:b])
        if even is None:
            continue
        off = float(np.max(np.abs(even - time_s[a:b])))
        part = off / float(np.min(np.diff(even)))
        if part > _STAMP_CHANGES:
            moved, worst = max(moved, part), max(worst, off)
            time_s[a:b] = even
    if moved > _STAMP_MATTERS:
        note = f"stamps are those of equal steps as printed, off by up to {worst:.2g} s: equal steps used"
        content = replace(content, notes=(*content.notes, note))
    return replace(content, values={**content.values, TIME: time_s})


_STAMP_CHANGES, _STAMP_MATTERS = 1e-6, 0.01
"""Parts of a step: less is none; a note."""
_FEWEST_STAMPS: Final = 20
_MOST_DECIMALS: Final = 9
_NOMINAL_DIGITS: Final = 7
_SLIPS: Final = 5
"""Of steps that are a lost row or a slip of the last digit fewer are lost rows; so many are slips where a rate has them."""
_PRINTED: Final = 0.6
"""Of the last printed digit, by which a stamp may be off: half by rounding, and what a fit is off."""


def even_stamps(time_s: FloatArray) -> FloatArray | None:
    """Return the equal steps [n] t0 + k T that these stamps [n], not falling, are rounded from to their printed digits; None
    where no such steps are within the digits of every stamp. Lost rows are steps of several T.

    Digits are those of the stamps of one power of ten: fixed decimals, or significant digits. Of all T within them the one
    with fewest digits, as a rate or as a period, is taken.
    """
    steps = np.diff(time_s)
    if len(time_s) < _FEWEST_STAMPS or np.any(steps < 0.0):
        return None
    digit = _last_digit(time_s)
    if digit is None:
        return None
    most = np.maximum(digit[1:], digit[:-1])
    usual = float(np.mean(steps[steps <= 3.0 * np.median(steps) + 2.0 * most]))
    if not usual > 0.0:
        return None
    cycles = np.maximum(np.round(steps / usual), 1.0)
    surely = np.where(steps > GAP_NOTED * usual + most, cycles, 1.0)
    ways = [cycles, surely]
    if np.count_nonzero(cycles != surely) >= _SLIPS:  # the rate is not quite that of the digits
        ways.reverse()
    for each in ways:
        k = np.concatenate(([0.0], np.cumsum(each)))
        step = float(np.polyfit(k, time_s, 1, w=1.0 / digit)[0])
        for candidate in _nominal(step):
            apart = time_s - candidate * k
            low, high = float(np.max(apart - _PRINTED * digit)), float(np.min(apart + _PRINTED * digit))
            if low <= high:
                return np.asarray(0.5 * (low + high) + candidate * k)
    return None


def _nominal(step: float) -> list[float]:
    """Return steps near this one, those of few digits first, as rates and as periods; itself last."""
    digits = range(1, _NOMINAL_DIGITS + 1)
    return [s for n in digits for s in (1.0 / float(f"{1.0 / step:.{n}g}"), float(f"{step:.{n}g}"))] + [step]


def _last_digit(time_s: FloatArray) -> FloatArray | None:
    """Return the size of the last digit of each stamp [n], that of all of its power of ten; None: too many digits."""
    power = np.floor(np.log10(np.maximum(np.abs(time_s), 1e-12)))
    out = np.zeros(len(time_s))
    for each in np.unique(power):
        there = power == each
        for decimals in range(_MOST_DECIMALS + 1):
            scaled = time_s[there] * 10.0**decimals
            rounding = 4.0 * float(np.finfo(np.float64).eps) * float(np.max(np.abs(scaled)))
            if rounding > 0.1:
                return None
            if np.all(np.abs(scaled - np.round(scaled)) <= 1e-3 + rounding):
                out[there] = 10.0**-decimals
                break
        else:
            return None
    return out


def _with_spread_stamps(content: Content) -> Content:
    """Return the content with stamps that are not after all before them, rounded or late by less than a step, spread between
    their neighbours, and a note; unchanged where there are more rows than the time can hold.
    """
    steps = np.diff(time_s := content.values[TIME])
    least = np.min(steps, initial=np.inf)
    usual = np.median(steps[steps > 0.0]) if np.any(steps > 0.0) else 0.0
    if least > 0.0 or least <= -usual:
        return content
    rows = np.flatnonzero(np.append(True, time_s[1:] > np.maximum.accumulate(time_s)[:-1]))
    full = least == 0.0 and np.mean(steps) < _LEAST_STEP * usual  # of what jitters, no usual step is so sure
    if full or rows[-1] + 1 < len(time_s) or np.max(np.diff(rows)) > _MOST_ALIKE:
        return content
    spread = np.interp(np.arange(len(time_s)), rows, time_s[rows])
    note = f"{counted(len(time_s) - len(rows), 'stamp')} not after the one before: spread between neighbours"
    return replace(content, values={**content.values, TIME: spread}, notes=(*content.notes, note))


def _restarts(time_s: FloatArray) -> list[int]:
    """Return the rows at which the time starts again and goes on from there; a single wrong stamp is none."""
    steps = np.diff(time_s)
    rows = np.flatnonzero(steps[:-1] <= -SHORTEST_SEGMENT_S) + 1
    return [int(row) for row in rows if 0.0 < steps[row] <= _longest_step(steps)]


def _between_gaps(time_s: FloatArray, run: slice) -> list[slice]:
    """Return the rows between the gaps of a run; its time rises."""
    steps = np.diff(time_s[run])
    ends = [0, *(np.flatnonzero(steps > _longest_step(steps)) + 1), run.stop - run.start]
    return [slice(run.start + int(a), run.start + int(b)) for a, b in pairwise(ends)]


def _longest_step(steps: FloatArray) -> float:
    return max(LONGEST_GAP * float(np.median(steps)), BRIDGED_S)


def _check_time(content: Content, run: slice, *, whole: bool) -> list[str]:
    """Refuse time of a run that stands or runs back, and in a whole one long gaps; return notes of the short gaps."""
    time_s, path, lines = content.values[TIME][run], content.path, content.lines

    def at(row: int) -> str:
        return f"sample {run.start + row}" if lines is None else f"line {lines[run.start + row]}"

    steps = np.diff(time_s)
    if not np.all(steps > 0.0):
        row = int(np.argmax(steps <= 0.0)) + 1
        several = row in _restarts(time_s)
        raise RunError(
            f"{path}: {at(row)}: found time {time_s[row]:.6g} s after {time_s[row - 1]:.6g} s, expected rising time"
            f"{': one run in a file here (`jtq diagnose` takes several apart)' if several else ''}"
        )
    median = float(np.median(steps))
    longest = int(np.argmax(steps))
    if whole and steps[longest] > LONGEST_GAP * median:
        raise RunError(
            f"{path}: {at(longest + 1)}: found a gap of {steps[longest]:.6g} s, "
            f"expected steps of about {median:.6g} s"
        )
    gaps = int(np.count_nonzero(steps > GAP_NOTED * median))
    are = "step is" if gaps == 1 else "steps are"
    return [f"{gaps} {are} longer than {GAP_NOTED} times the median of {median:.6g} s"] if gaps else []


def _segment(content: Content, cut: slice, name: str, notes: Sequence[str], quiet: float) -> RunFile:
    """Return the run table of the rows of one segment."""
    path, notes = content.path, list(notes)
    known_loads = () if content.columns is None else content.columns.known_loads
    values = {key: value[cut] for key, value in content.values.items()}
    if content.columns is not None:
        values = content.columns.completed(values, quiet)
    joints: dict[int, JointColumns] = {}
    for joint in JOINTS:
        columns = {q: values.get(f"j{joint}.{q}") for q in COLUMN_NAMES}
        if all(column is None for column in columns.values()):
            continue
        torque = columns["torque_nm"]
        zero = torque is not None and len(torque) >= DEAD_ROWS and not np.any(torque)
        if torque is not None and zero and joint not in known_loads:
            notes.append(f"j{joint}.torque_nm is exactly zero in every row: dead channel, not used")
            columns["torque_nm"] = None
        joints[joint] = JointColumns(**columns)
    if not joints:
        raise RunError(f"{path}:{header_place(path)} found no joint's columns, expected j1.current_a, ...")
    try:
        table = RunTable(time_s=values[TIME], joints=joints)
    except RunTableError as error:  # a scale of the column map that leaves the range of a float
        raise RunError(f"{path}: {error}") from None
    parts = {n: values[f"j{n}.load"] for n in known_loads if f"j{n}.torque_nm" not in values}
    return RunFile(name, path, content.source, content.sha256, table, tuple(notes), known_loads, parts)
