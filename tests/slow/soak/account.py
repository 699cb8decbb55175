"""Every cycle and every SYNC of a soak is accounted for: the log against what an independent listener has heard. Pure.

The counter of SYNC (1..240) says how many lie between two that were heard; the time between them says how many rounds of
it went by. So the listener knows what it has not heard. A SYNC that it has not heard was either never on the bus (then the
loop had no echo of it, and its record says so), or the listener lost it (then its socket has counted lost frames).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from jtqd.daemon.core.estimate_pdo import PUBLISHED_STATUSES
from jtqd.daemon.logs import iter_messages
from jtqd.daemon.shared.cycle_record import FLAG_SYNC_CONFIRMED
from tests.slow.faults.listener import Heard
from tests.slow.soak.rig import OVERFLOW

PERIOD_NS = 1_000_000
_APART_NS = 100_000_000
"""Stamps of one SYNC at two receivers differ by less, also behind the hub of a loaded machine. Its counter goes
round in 240 ms."""


@dataclass(frozen=True)
class Records:
    """What the log says of each cycle, in its order [n]; `double` cycles were in it twice."""

    cycle: NDArray[np.int64]
    counter: NDArray[np.int64]
    slot_ns: NDArray[np.int64]
    stamp_ns: NDArray[np.int64]
    missed: NDArray[np.int64]
    confirmed: NDArray[np.bool_]
    double: int


def read_records(paths: Iterable[Path]) -> Records:
    columns: list[NDArray[np.int64]] = []
    for path in paths:
        for found in iter_messages(path, "/can/frames"):
            rows = found.records
            monotonic_ns = rows["sync_monotonic_ns"].astype(np.int64)
            columns.append(
                np.stack(
                    [
                        rows["cycle"].astype(np.int64),
                        rows["sync_counter"].astype(np.int64),
                        monotonic_ns - rows["late_ns"],
                        found.log_times.astype(np.int64),
                        rows["missed"].astype(np.int64),
                        rows["flags"].astype(np.int64) & FLAG_SYNC_CONFIRMED,
                    ]
                )
            )
    table = np.concatenate(columns, axis=1) if columns else np.empty((6, 0), np.int64)
    _, first = np.unique(table[0], return_index=True)
    double = table.shape[1] - len(first)
    cycle, counter, slot_ns, stamp_ns, missed, confirmed = table[:, first]
    return Records(cycle, counter, slot_ns, stamp_ns, missed, confirmed != 0, double)


class SyncTally:
    """SYNCs of jtqd as the listener has heard them; feed it with everything heard, in order."""

    def __init__(self) -> None:
        self._counters: list[NDArray[np.int64]] = []
        self._stamps: list[NDArray[np.int64]] = []

    def add(self, heard: Heard) -> None:
        syncs = heard.syncs
        self._counters.append(heard.data[syncs, 0].astype(np.int64))
        self._stamps.append(heard.stamps_ns[syncs].copy())

    def ordinals(self) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """Number (0 is the first that jtqd sent), counter and stamp of each SYNC heard [n]."""
        counters = np.concatenate([np.empty(0, np.int64), *self._counters])
        stamps_ns = np.concatenate([np.empty(0, np.int64), *self._stamps])
        if not len(counters):
            return counters, counters, stamps_ns
        steps = (counters[1:] - counters[:-1]) % OVERFLOW
        slots = np.rint((stamps_ns[1:] - stamps_ns[:-1]) / PERIOD_NS)
        rounds = np.maximum(np.rint((slots - steps) / OVERFLOW), 0).astype(np.int64)
        first = counters[0] - 1
        return first + np.concatenate([[0], np.cumsum(steps + OVERFLOW * rounds)]), counters, stamps_ns


@dataclass(frozen=True)
class Account:
    """Result: counts by name and what does not add up."""

    counts: dict[str, int]
    wrong: tuple[str, ...]


def account(records: Records, tally: SyncTally, counters: dict[str, int], lost: int, dropped: int) -> Account:
    """Compare.

    Args:
        records: of the log.
        tally: of the listener.
        counters: of jtqd at its end: `cycles`, `missed`, `sync_gaps`.
        lost: cycles that are not in the log, as the recorder counts them.
        dropped: frames that the listener's socket has lost.
    """
    cycles, written = counters["cycles"], len(records.cycle)
    numbers, heard_counters, _ = tally.ordinals()
    heard, last = len(numbers), int(records.counter[-1]) if written else 0
    after = (last - int(heard_counters[-1])) % OVERFLOW if heard else 0
    not_heard = int(numbers[-1]) + 1 - heard + after if heard else 0
    counts = {
        "cycles": cycles,
        "written": written,
        "written twice": records.double,
        "lost, counted": lost,
        "missed slots": counters["missed"],
        "slots without SYNC": counters["sync_gaps"],
        "SYNCs heard": heard,
        "SYNCs not heard": not_heard,
    }
    wrong = []
    if written + lost != cycles:
        wrong.append(f"written {written} + lost {lost} != cycles {cycles}")
    if heard + not_heard != cycles:
        wrong.append(f"SYNCs heard {heard} + not heard {not_heard} != cycles {cycles}")
    if heard and len(np.unique(numbers)) != heard:
        wrong.append(f"{heard - len(np.unique(numbers))} SYNCs came twice")
    wrong += _slots(records, counters)
    if not lost and written == cycles and not wrong:
        wrong += _one_by_one(records, tally, counts, dropped)
    return Account(counts, tuple(wrong))


def _slots(records: Records, counters: dict[str, int]) -> list[str]:
    """Every slot of the grid was a cycle, was missed and counted, or was held back and counted."""
    if not len(records.cycle):
        return ["no cycle in the log"]
    span = records.slot_ns[-1] - records.slot_ns[0]
    slots = round(float(span) / PERIOD_NS) + 1 + int(records.cycle[0])
    passed = counters["cycles"] + int(records.missed[-1]) + counters["sync_gaps"]
    wrong = []
    if slots != passed:
        wrong.append(f"{slots} slots in the time of the run, but {passed} cycles, missed and held back")
    if int(records.cycle[-1]) + 1 != slots:
        wrong.append(f"the last cycle has number {records.cycle[-1]}, expected {slots - 1}")
    return wrong


def _one_by_one(records: Records, tally: SyncTally, counts: dict[str, int], dropped: int) -> list[str]:
    """Each SYNC heard is that of the record with its number; each that was not heard has its reason."""
    wrong, (numbers, heard_counters, stamps_ns) = [], tally.ordinals()
    if np.any(records.counter[numbers] != heard_counters):
        wrong.append("a SYNC on the bus has another counter than its record")
    confirmed = records.confirmed[numbers]
    apart = np.abs(records.stamp_ns[numbers] - stamps_ns)[confirmed]
    if len(apart) and apart.max() > _APART_NS:
        wrong.append(f"a SYNC on the bus is {apart.max() / 1e6:.1f} ms from its record")
    silent = np.ones(len(records.counter), bool)
    silent[numbers] = False
    missed_by_us = int(np.count_nonzero(records.confirmed & silent))
    counts["SYNCs never sent"] = int(np.count_nonzero(silent)) - missed_by_us
    counts["SYNCs lost by the listener"] = missed_by_us
    if missed_by_us > dropped:
        wrong.append(f"{missed_by_us} SYNCs not heard, but the listener's socket lost only {dropped} frames")
    return wrong


# Every estimate PDO, as the bus had it: no torque beside another status, none with an old sequence.

ESTIMATE = 0x1A0
_LAYOUT = np.dtype(
    [("torque", "<i2", 2), ("sigma", "u1", 2), ("status", "u1"), ("sequence", "u1")]
)  # as jtqd.daemon.core.estimate_pdo.LAYOUT
_NO_TORQUE = -0x8000


class EstimateTally:
    """Feed it with everything heard, in order.

    Attributes:
        count: estimates.
        valid: those with a torque, both joints.
        leaked: torques beside a status that has none.
        old: torques whose sequence is neither that of the last SYNC nor of the one before (it may come just after a SYNC).
    """

    def __init__(self) -> None:
        self.count = self.valid = self.leaked = self.old = 0
        self._last = 0

    def add(self, heard: Heard) -> None:
        syncs, at = heard.syncs, heard.at(ESTIMATE)
        counters = np.concatenate([[self._last], heard.data[syncs, 0]]).astype(np.int64)
        self._last = int(counters[-1])
        rows = np.ascontiguousarray(heard.data[at]).view(_LAYOUT).reshape(-1)
        ago = (counters[np.searchsorted(syncs, at)] - rows["sequence"]) % OVERFLOW
        self.count += len(rows)
        for n, status in enumerate((rows["status"] & 0x0F, rows["status"] >> 4)):
            valid = np.isin(status, list(PUBLISHED_STATUSES))
            self.valid += int(np.count_nonzero(valid))
            self.leaked += int(np.count_nonzero(~valid & (rows["torque"][:, n] != _NO_TORQUE)))
            self.old += int(np.count_nonzero(valid & (ago > 1)))
