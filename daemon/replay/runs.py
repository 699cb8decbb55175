"""Runs of jtqd out of their logs: states and raw frames, cycle by cycle, and where the state of an estimator is known.

Two logs are parts of one run when their configuration, joint files and networks are the same and their cycles lie on one
grid: cycle numbers and the monotonic clock advance together. A long run comes in stretches, so that memory holds one of them
whatever the length of the log.

The time step that a joint used (`Steps`) is the time since its last inputs. A step of 0 is a start: from there on everything
about the joint is known. A step that is not the time since the last inputs *in the log* shows that inputs are missing from
the log: it begins in the middle of a run, or has lost cycles.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import reduce
from pathlib import Path

import numpy as np
import numpy.typing as npt

from jtqd.daemon.config import Config
from jtqd.daemon.logs import LogError, iter_messages, iter_topics, log_parts, read_attachments
from jtqd.daemon.recording.schemas import CAN_FRAMES, ZEROS, joint_topics
from jtqd.daemon.replay.logged import (
    FRAMES,
    JOINT,
    NO_STATES,
    EstimatorStates,
    Inputs,
    Setup,
    check_fields,
    decode,
    read_setup,
    states_of,
)
from jtqd.daemon.shared.cycle_record import FLAG_MOTION, FLAG_POSITION
from jtqd.estimator.arrays import RecordArray

# ---- where the state of an estimator is known ----

_BOTH = FLAG_POSITION | FLAG_MOTION
BEGINS, LOST = "the log begins in the middle of the run", "cycles are missing from the log"


@dataclass(frozen=True)
class Steps:
    """Time steps of one joint over n cycles.

    Attributes:
        used: cycles with both inputs [n].
        dt_ns: time since the last inputs, by the log [n]; 0: a start, or not used.
        begins: rows where it started.
        breaks: rows before which inputs are missing, with the reason.
    """

    used: npt.NDArray[np.bool_]
    dt_ns: npt.NDArray[np.int64]
    begins: npt.NDArray[np.intp]
    breaks: tuple[tuple[int, str], ...]

    def part(self, first: int, end: int) -> Steps:
        """Return the same of rows `first` to `end` only, counted from `first`."""
        begins = self.begins[(self.begins >= first) & (self.begins < end)] - first
        breaks = tuple((row - first, why) for row, why in self.breaks if first <= row < end)
        return Steps(self.used[first:end], self.dt_ns[first:end], begins, breaks)


def steps_of(records: RecordArray, config: Config) -> Steps:
    """Return the time steps of one joint's states (/joint/N/state), in the order of the cycles."""
    used = (records["input_flags"] & _BOTH) == _BOTH
    rows = np.flatnonzero(used)
    dt_ns = np.zeros(len(records), np.int64)
    dt = np.rint(records["dt_s"][rows] * 1e9)
    dt_ns[rows] = np.where(np.isfinite(dt), dt, 0.0).astype(np.int64)
    begins = rows[dt_ns[rows] == 0]
    if not len(rows):
        return Steps(used, dt_ns, begins, ())
    breaks: list[tuple[int, str]] = []
    if dt_ns[rows[0]] != 0:
        breaks.append((int(rows[0]), BEGINS))
        dt_ns[rows[0]] = 0
    # The call that sends a SYNC may be late, the other clock may be stepped: the step was measured by one of them.
    between = np.diff(records["sync_monotonic_ns"][rows])
    stamps = np.diff(stamps_ns(records)[rows])
    here = dt_ns[rows[1:]]
    apart = np.minimum(np.abs(between - here), np.abs(stamps - here)) > config.period_ns // 2
    holes = np.diff(np.cumsum(_holes(records, config))[rows]) > 0
    for at in np.flatnonzero((here != 0) & apart & holes).tolist():
        row = int(rows[at + 1])
        breaks.append((row, LOST))
        dt_ns[row] = max(int(between[at]), 0)
    return Steps(used, dt_ns, begins, tuple(breaks))


def stamps_ns(records: RecordArray) -> npt.NDArray[np.int64]:
    """Return the send time of each SYNC [ns], CLOCK_REALTIME [n]."""
    stamp = records["header"]["stamp"]
    seconds: npt.NDArray[np.int64] = stamp["sec"].astype(np.int64)
    return seconds * 1_000_000_000 + stamp["nanosec"].astype(np.int64)


def _holes(records: RecordArray, config: Config) -> npt.NDArray[np.int64]:
    """Cycles that are missing before each row [n].

    The cycle numbers count every slot, the SYNC counter only those with a SYNC, in rounds; the step `dt_s` of a row spans
    the slots without SYNC just before it. The missing cycles are as many as fit between both: exact while fewer slots than
    one round have passed without SYNC elsewhere in the hole. Where the step is not known (0), whole rounds do not show.
    """
    overflow = config.sequence_overflow
    counter: npt.NDArray[np.int64] = records["sync_counter"].astype(np.int64)
    cycle: npt.NDArray[np.int64] = records["cycle"].astype(np.int64)
    found = np.zeros(len(records), np.int64)
    slots = cycle[1:] - cycle[:-1]
    lost = np.remainder(counter[1:] - counter[:-1] - 1, overflow)
    step = np.rint(np.nan_to_num(records["dt_s"][1:]) * (1e9 / config.period_ns)).astype(np.int64)
    most = slots - np.maximum(step, 1)
    exact = most - np.remainder(most - lost, overflow)
    least = np.where(slots > overflow, np.maximum(lost, 1), np.minimum(lost, slots - 1))
    found[1:] = np.where((step > 0) & (exact >= 0), exact, least)
    return found


def lost_cycles(records: RecordArray, config: Config) -> int:
    """Return cycles that are missing between those in the log (joint states), by cycle number and SYNC counter."""
    return int(_holes(records, config).sum())


# ---- runs ----

STRETCH_CYCLES = 650_000
"""Longest stretch: one part of ten minutes at 1 kHz with something to spare."""
_KEPT_ROWS = 5_000
"""Of the stretch before: no time step depends on what was earlier."""
_FIRST_TOPIC = joint_topics(1)[0].name
"""Of the joint that every log has."""

Progress = Callable[[str, int, int], None]
"""Called with what is being done, how much of it is done, and of how much."""


@dataclass(frozen=True)
class Run:
    """States of one run, cycle by cycle; of a long run one stretch.

    Attributes:
        logs: all parts of the run, in their order.
        setup: of the first part; the others have the same.
        joints: states of each joint, of the same cycles.
        states: of each joint's estimator.
        number: the stretches of one run have the same.
        before: last states of the stretch before, none for the first one.
    """

    logs: tuple[Path, ...]
    setup: Setup
    joints: tuple[RecordArray, ...]
    states: tuple[EstimatorStates, ...]
    number: int = 0
    before: tuple[RecordArray, ...] | None = None

    @property
    def cycles(self) -> int:
        """Return the number of cycles."""
        return len(self.joints[0])

    def steps(self) -> tuple[Steps, ...]:
        """Return the time steps of all joints; the first ones follow from the stretch before."""
        config = self.setup.config
        if self.before is None:
            return tuple(steps_of(each, config) for each in self.joints)
        kept = len(self.before[0])
        every = [np.concatenate(each) for each in zip(self.before, self.joints, strict=True)]
        return tuple(steps_of(each, config).part(kept, len(each)) for each in every)


def read_runs(
    paths: Sequence[Path],
    directory: Path,
    progress: Progress = lambda *_: None,
    stretch: int = STRETCH_CYCLES,
) -> Iterator[tuple[Run, Inputs]]:
    """Yield the runs of the logs, in stretches of about `stretch` cycles, each with the inputs of its cycles.

    A directory stands for the logs in it. The files that the logs have attached go to `directory`, which must be empty and
    nobody else's. Cycles that two parts of a run have, after a crash of the recorder, are taken once.

    Raises:
        LogError: one line; a log cannot be used, is given twice, or differs from another one in a cycle.
        OSError: a file cannot be read.
    """
    logs = [log for path in paths for log in log_parts(path)]
    for number, (setup, parts) in enumerate(_runs(logs, directory, progress)):
        before = None
        for joints, inputs, states in _stretches(setup, parts, stretch):
            run = Run(tuple(parts), setup, joints, states, number, before)
            before = tuple(each[-_KEPT_ROWS:].copy() for each in joints)
            del joints  # most of the memory
            yield run, inputs
            del run, inputs


def _runs(logs: Sequence[Path], directory: Path, progress: Progress) -> list[tuple[Setup, list[Path]]]:
    """Return setup and parts of each run, in the order of their first cycles."""
    found: list[tuple[Setup, list[Path], int]] = []
    starts = [_start(log) if len(logs) > 1 else (0, 0) for log in logs]
    ordered = sorted(zip(starts, logs, strict=True), key=lambda each: each[0])
    for n, ((first_ns, cycle), log) in enumerate(ordered):
        if logs.count(log) > 1:
            raise LogError(f"{log}: found the log given twice, expected once")
        progress("reading", n, len(logs))
        place = directory / str(n)
        place.mkdir(mode=0o700)
        setup = read_setup(log, read_attachments(log), place)
        begin_ns = first_ns - cycle * setup.config.period_ns
        for other, parts, other_ns in found:
            same = other.hashes == setup.hashes and other.inputs == setup.inputs
            if same and abs(begin_ns - other_ns) <= setup.config.period_ns:
                parts.append(log)
                break
        else:
            found.append((setup, [log], begin_ns))
    return [(setup, parts) for setup, parts, _ in found]


def _start(log: Path) -> tuple[int, int]:
    """Return CLOCK_MONOTONIC [ns] and number of the first cycle of a log; 0, 0 for one without: reading it is an error."""
    for messages in iter_messages(log, _FIRST_TOPIC):
        check_fields(messages.records, JOINT, log, _FIRST_TOPIC)
        first = messages.records[0]
        return int(first["sync_monotonic_ns"]), int(first["cycle"])
    return 0, 0


def _stretches(
    setup: Setup, logs: Sequence[Path], least: int
) -> Iterator[tuple[tuple[RecordArray, ...], Inputs, tuple[EstimatorStates, ...]]]:
    """Yield joints, inputs and states of the estimators of a run, stretch by stretch. Raises LogError, OSError."""
    count = len(setup.config.joints)
    joints, zeros = [each.name for each in joint_topics(count)], [each.name for each in ZEROS[:count]]
    needed = {**dict.fromkeys(joints, JOINT), CAN_FRAMES.name: FRAMES}
    pending: dict[str, list[RecordArray]] = {}
    last, made = -1, False
    spans = iter_topics(logs, [*needed, *zeros], least=least)
    while (found := next(spans, None)) is not None:
        for topic, fields in needed.items():
            if topic in found:
                check_fields(found[topic].records, fields, logs[0], topic)
                pending.setdefault(topic, []).append(found[topic].records)
        states = tuple(
            states_of(found[topic].records, logs[0], topic) if topic in found else NO_STATES
            for topic in zeros
        )
        del found  # most of the memory, as below
        if len(pending) < len(needed):
            continue
        last, tables = _complete(pending, last, logs[0])
        whole = _common([tables[topic] for topic in joints])
        frames = _of_cycles(tables.pop(CAN_FRAMES.name), whole[0]["cycle"], logs[0])
        inputs = decode(setup, frames, whole)
        del tables, frames
        if len(whole[0]):
            made = True
            yield whole, inputs, states
        del whole, inputs
    missing = [topic for topic in needed if topic not in pending]
    if not made and missing:
        raise LogError(f"{logs[0]}: found no message on {missing[0]}, expected one per cycle")
    if not made:
        raise LogError(f"{logs[0]}: found no cycle with every joint, expected one at least")
    if missing == [CAN_FRAMES.name]:
        cycle = int(pending[joints[0]][0]["cycle"][0])
        raise LogError(f"{logs[-1]}: {CAN_FRAMES.name}: found none from cycle {cycle} on, expected all")


def _complete(
    pending: dict[str, list[RecordArray]], last: int, log: Path
) -> tuple[int, dict[str, RecordArray]]:
    """Take out of `pending` what follows cycle `last`, up to the last cycle of all topics; returns it and that cycle.

    A chunk may end within a cycle: what other topics have of it is in the next one, and the rest stays pending.
    """
    tables = {topic: each[0] if len(each) == 1 else np.concatenate(each) for topic, each in pending.items()}
    end = min(int(records["cycle"][-1]) for records in tables.values())
    pending.clear()
    for topic, records in tables.items():
        cycle = records["cycle"].astype(np.int64)
        wrong = np.flatnonzero(np.diff(cycle, prepend=last) <= 0)
        if len(wrong):
            raise LogError(
                f"{log}: {topic}: found cycle {cycle[wrong[0]]} after a later one or a second time, expected "
                "increasing cycles: is a log given twice, or do two differ?"
            )
        count = int(np.searchsorted(cycle, end, side="right"))
        tables[topic] = records[:count]
        if count < len(records):
            pending[topic] = [records[count:].copy()]
    return end, tables


def _common(joints: Sequence[RecordArray]) -> tuple[RecordArray, ...]:
    """Return the states of the cycles that every joint has."""
    first = joints[0]["cycle"]
    if all(np.array_equal(each["cycle"], first) for each in joints):
        return tuple(joints)
    shared = reduce(np.intersect1d, [each["cycle"] for each in joints])
    return tuple(each[np.isin(each["cycle"], shared)] for each in joints)


def _of_cycles(frames: RecordArray, cycles: npt.NDArray[np.uint64], log: Path) -> RecordArray:
    """Return the messages of /can/frames of these cycles. Raises LogError where one has none."""
    if not np.array_equal(frames["cycle"], cycles):
        frames = frames[np.isin(frames["cycle"], cycles)]
    if len(frames) != len(cycles):
        raise LogError(
            f"{log}: {CAN_FRAMES.name}: found {len(frames)} of the {len(cycles)} cycles, expected all"
        )
    return frames
