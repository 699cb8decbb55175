"""Logs as runs: the parts of one run of jtqd in their order, with where they come from.

Two logs are parts of one run when their configuration, joint files and networks are the same and their cycles lie on one
grid: cycle numbers and the monotonic clock advance together. Files with other models are a run of their own.

The time step that a joint used (`Steps`) is the time since its last inputs. A step of 0 says that it began anew: from there
on everything about it is known. A step that is not the time since the last inputs *in the log* says that inputs are missing
from the log: it begins in the middle of a run, or has lost cycles.

A long run comes in stretches, one after the other, so that memory holds one of them whatever the length of the log.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce
from pathlib import Path

import numpy as np
import numpy.typing as npt
from numpy.lib.recfunctions import repack_fields

from jtqd.daemon.config import Config
from jtqd.daemon.logs import (
    LogError,
    LogFile,
    iter_messages,
    iter_topics,
    read_attachments,
    read_topic,
    read_topics,
)
from jtqd.daemon.recording.schemas import joint_topics
from jtqd.daemon.replay.logged import (
    FRAMES,
    JOINT,
    EstimatorStates,
    Setup,
    check_fields,
    joined,
    read_setup,
    read_states,
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
        dt_ns: time since the last inputs, by the log [n]; 0: began anew or not used.
        begins: rows where it began anew.
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
    stamps = np.diff(_stamps(records)[rows])
    here = dt_ns[rows[1:]]
    apart = np.minimum(np.abs(between - here), np.abs(stamps - here)) > config.period_ns // 2
    holes = np.diff(np.cumsum(_holes(records, config))[rows]) > 0
    for at in np.flatnonzero((here != 0) & apart & holes).tolist():
        row = int(rows[at + 1])
        breaks.append((row, LOST))
        dt_ns[row] = max(int(between[at]), 0)
    return Steps(used, dt_ns, begins, tuple(breaks))


def _stamps(records: RecordArray) -> npt.NDArray[np.int64]:
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


FIRST_TOPIC = joint_topics(1)[0].name
"""Of the joint that every log has."""
FRAMES_TOPIC = "/can/frames"

STRETCH_CYCLES = 650_000
"""Longest stretch of several parts: one part of ten minutes at 1 kHz with something to spare."""
_KEPT_ROWS = 5_000
"""Of the stretch before: whatever the estimator remembers of its inputs, it has forgotten after so many cycles."""
_LEAST_BYTES = 200
"""Of a cycle in a log: ours take 300."""


@dataclass(frozen=True)
class Part:
    """One log, or a piece of a long one: its states of its joints, cycle by cycle, all of the same cycles."""

    path: Path
    setup: Setup
    joints: tuple[RecordArray, ...]
    pasts: tuple[EstimatorStates, ...] = ()
    """States of the estimators that the log holds."""
    piece: bool = False

    def frames(self) -> RecordArray:
        """Return messages of /can/frames of the same cycles. Raises LogError, OSError."""
        cycles = self.joints[0]["cycle"]
        if self.piece:
            records = _frames_between(self.path, int(cycles[0]), int(cycles[-1]))
        else:
            records = read_topic(self.path, FRAMES_TOPIC)
            check_fields(records, FRAMES, self.path, FRAMES_TOPIC)
        if len(records) == len(cycles) and np.array_equal(records["cycle"], cycles):
            return records
        _, here, _ = np.intersect1d(records["cycle"], cycles, return_indices=True)
        if len(here) != len(cycles):
            raise LogError(
                f"{self.path}: {FRAMES_TOPIC}: found {len(here)} of the {len(cycles)} cycles, expected all"
            )
        return records[here]


@dataclass(frozen=True)
class Run:
    """Parts of one run in their order; of a long run one stretch.

    Attributes:
        parts: their states are views of `joints`.
        joints: states of each joint over all parts.
        number: the stretches of one run have the same.
        before: last states of the stretch before, none for the first one.
        pasts: states of the estimators, of each joint; those of the stretch before among them.
    """

    parts: tuple[Part, ...]
    joints: tuple[RecordArray, ...]
    number: int = 0
    before: tuple[RecordArray, ...] | None = None
    pasts: tuple[EstimatorStates, ...] = ()

    @classmethod
    def of(
        cls,
        parts: Sequence[Part],
        number: int = 0,
        before: tuple[RecordArray, ...] | None = None,
        pasts: Sequence[EstimatorStates] = (),
    ) -> Run:
        """Run, or stretch, of parts that follow one another; `pasts`: of the stretch before."""
        joints = tuple(_joined(states) for states in zip(*(part.joints for part in parts), strict=True))
        ends = np.cumsum([len(part.joints[0]) for part in parts]).tolist()
        spans = [slice(begin, end) for begin, end in zip([0, *ends[:-1]], ends, strict=True)]
        views = [
            replace(part, joints=tuple(each[at] for each in joints))
            for part, at in zip(parts, spans, strict=True)
        ]
        every = [list(each) for each in zip(*(part.pasts for part in parts), strict=True)]
        merged = [joined([*each, *pasts[n : n + 1]]) for n, each in enumerate(every)]
        return cls(tuple(views), joints, number, before, tuple(merged))

    @property
    def setup(self) -> Setup:
        """Return the setup of the first part; the others have the same."""
        return self.parts[0].setup

    @property
    def cycles(self) -> int:
        """Return the number of cycles in the logs."""
        return len(self.joints[0])

    def widened(self) -> tuple[tuple[RecordArray, ...], tuple[Steps, ...], int]:
        """States with those kept of the stretch before in front of them, their time steps, and how many those are."""
        kept = self.before or tuple(each[:0] for each in self.joints)
        joints = tuple(
            _joined([old, new] if len(old) else [new]) for old, new in zip(kept, self.joints, strict=True)
        )
        return joints, tuple(steps_of(each, self.setup.config) for each in joints), len(kept[0])

    def steps(self) -> tuple[Steps, ...]:
        """Return the time steps of all joints over all parts."""
        records, steps, kept = self.widened()
        return tuple(each.part(kept, len(records[0])) for each in steps)


def topics_of(setup: Setup) -> tuple[str, ...]:
    """Return the topics of the joints that a log has."""
    return tuple(topic.name for topic in joint_topics(len(setup.config.joints)))


def _joined(every: Sequence[RecordArray]) -> RecordArray:
    return every[0] if len(every) == 1 else np.concatenate(every)


def read_part(path: Path, directory: Path) -> Part:
    """Read one log; its files go to `directory`, which must be empty. Raises LogError, OSError."""
    setup = read_setup(path, read_attachments(path), directory)
    topics = topics_of(setup)
    return _part(path, setup, read_topics(path, topics), read_states(path, len(topics)))


def read_pieces(path: Path, directory: Path, limit: int = STRETCH_CYCLES) -> Iterator[Part]:
    """As `read_part`, but a log of more than `limit` cycles in pieces of about so many. Raises LogError, OSError."""
    if _most_cycles(path) <= limit:
        yield read_part(path, directory)
        return
    setup = read_setup(path, read_attachments(path), directory)
    topics = topics_of(setup)
    kept: dict[str, list[RecordArray]] = {topic: [] for topic in topics}
    pasts = read_states(path, len(topics))
    count, made = 0, False
    for found in iter_topics(path, topics):
        for topic, messages in found.items():
            kept[topic].append(messages.records.copy())  # without the room for more
        count += len(found[FIRST_TOPIC].records) if FIRST_TOPIC in found else 0
        if count >= limit and all(kept.values()):
            yield _piece(path, setup, kept, pasts)
            count, made = 0, True
    if all(kept.values()) or not made:
        yield _piece(path, setup, kept, pasts)


def _most_cycles(path: Path) -> int:
    """Return cycles in a log as its summary says; without one as many as it may have by its size."""
    with LogFile(path) as log:
        counts = [log.counts.get(n, 0) for n, each in log.channels.items() if each.topic == FIRST_TOPIC]
        return max(counts) if log.counts and counts else path.stat().st_size // _LEAST_BYTES


def _piece(
    path: Path, setup: Setup, kept: dict[str, list[RecordArray]], pasts: tuple[EstimatorStates, ...]
) -> Part:
    """A part of what was kept; what one joint has of a cycle whose others are in the next chunk stays."""
    whole = {}
    for topic, chunks in kept.items():
        if not chunks:
            raise LogError(f"{path}: found no message on {topic}, expected one per cycle")
        whole[topic] = _joined(chunks)
        check_fields(whole[topic], JOINT, path, topic)
    last = min(records["cycle"][-1] for records in whole.values())
    for topic, records in whole.items():
        behind = records["cycle"] > last
        kept[topic] = [records[behind]] if behind.any() else []
        whole[topic] = records[~behind]
    return replace(_part(path, setup, whole, pasts), piece=True)


def _frames_between(path: Path, first: int, last: int) -> RecordArray:
    """Return messages of /can/frames of these cycles."""
    found = []
    for messages in iter_messages(path, FRAMES_TOPIC):
        records = messages.records
        check_fields(records, FRAMES, path, FRAMES_TOPIC)
        inside = (records["cycle"] >= first) & (records["cycle"] <= last)
        if inside.any():
            found.append(records[inside])
    if not found:
        raise LogError(f"{path}: {FRAMES_TOPIC}: found none of the cycles {first} to {last}, expected all")
    return _joined(found)


def _part(
    path: Path, setup: Setup, found: dict[str, RecordArray], pasts: tuple[EstimatorStates, ...]
) -> Part:
    for topic, records in found.items():
        check_fields(records, JOINT, path, topic)
    joints = tuple(found[topic] for topic in topics_of(setup))
    cycles = joints[0]["cycle"]
    if not all(np.array_equal(each["cycle"], cycles) for each in joints):
        shared = reduce(np.intersect1d, [each["cycle"] for each in joints])
        joints = tuple(each[np.intersect1d(each["cycle"], shared, return_indices=True)[1]] for each in joints)
    if not len(joints[0]):
        raise LogError(f"{path}: found no cycle with every joint, expected one at least")
    if np.any(np.diff(joints[0]["cycle"].astype(np.int64)) <= 0):
        raise LogError(f"{path}: found cycles that do not increase, expected the order of the run")
    first, last = int(joints[0]["cycle"][0]), int(joints[0]["cycle"][-1])
    return Part(path, setup, joints, tuple(each.within(first, last) for each in pasts))


def in_order(logs: Sequence[Path]) -> list[Path]:
    """Logs in the order of their first cycles. Raises LogError, OSError."""
    return list(logs) if len(logs) < 2 else sorted(logs, key=_first_ns)


def _first_ns(path: Path) -> int:
    """CLOCK_MONOTONIC of the first cycle; 0 where there is none: reading it says so."""
    found = next(iter_messages(path, FIRST_TOPIC), None)
    known = found is not None and "sync_monotonic_ns" in (found.records.dtype.names or ())
    return int(found.records["sync_monotonic_ns"][0]) if found is not None and known else 0


@dataclass
class _Open:
    """Run under construction."""

    number: int
    parts: list[Part]
    before: tuple[RecordArray, ...] | None = field(default=None)
    pasts: tuple[EstimatorStates, ...] = ()

    def close(self, *following: Part) -> Run:
        """Return the stretch so far; the next one begins with `following`."""
        run = Run.of(self.parts, self.number, self.before, self.pasts)
        self.before = tuple(records[-_KEPT_ROWS:].copy() for records in run.joints)
        first = int(self.before[0]["cycle"][0])
        self.pasts = tuple(each.within(first, int(run.joints[0]["cycle"][-1])) for each in run.pasts)
        self.parts = list(following)
        return run


def stretches(parts: Iterable[Part], limit: int = STRETCH_CYCLES) -> Iterator[Run]:
    """Yield runs of the parts, which come in the order of their time; cycles that two parts have are taken once.

    A run of more than `limit` cycles comes in several stretches of whole parts, each as soon as it is complete; what is
    shorter comes at the end, in the order of time.

    Raises LogError where two logs say different things of one cycle, or one is given twice.
    """
    begun: list[_Open] = []
    for part in parts:
        run = next((each for each in begun if _goes_on(each.parts[-1], part)), None)
        if run is None:
            begun.append(_Open(len(begun), [part]))
            continue
        new = _behind(run.parts[-1], part)
        if sum(len(each.joints[0]) for each in run.parts) + len(new.joints[0]) > limit:
            yield run.close(new)
        else:
            run.parts.append(new)
    while begun:
        yield begun.pop(0).close()


def _goes_on(before: Part, part: Part) -> bool:
    """Return whether `part` is a later part of the run of `before`; the pieces of one log always are."""
    if part.piece and part.path == before.path:
        return True
    if before.setup.hashes != part.setup.hashes or before.setup.inputs != part.setup.inputs:
        return False
    last, first = before.joints[0][-1], part.joints[0][0]
    period_ns = before.setup.config.period_ns
    begun = [int(row["sync_monotonic_ns"]) - int(row["cycle"]) * period_ns for row in (last, first)]
    return abs(begun[1] - begun[0]) <= period_ns


def _behind(before: Part, part: Part) -> Part:
    """`part` from the end of `before` on: after a crash of the recorder a chunk may be in both. Raises LogError."""
    last, first = int(before.joints[0]["cycle"][-1]), int(part.joints[0]["cycle"][0])
    if first > last:
        return part
    new = part.joints[0]["cycle"] > last
    for one, other in zip(before.joints, part.joints, strict=True):
        if not new.any() or _packed(one[one["cycle"] >= first]) != _packed(other[~new]):
            raise LogError(
                f"{part.path}: found cycle {first}, which {before.path} has too: is it given twice?"
            )
    return replace(part, joints=tuple(each[new] for each in part.joints))


def _packed(records: RecordArray) -> bytes:
    """Bits of all fields; what lies between them is not copied along by numpy and says nothing."""
    packed: RecordArray = repack_fields(records, recurse=True)
    return packed.tobytes()
