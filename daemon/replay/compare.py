"""How far a replay is from what was logged, and each of them from the torque sensor. Pure, in arrays."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from jtqd.daemon.replay.logged import ADDED, Steps
from jtqd.daemon.replay.rows import fields
from jtqd.daemon.shared.cycle_record import FLAG_CONTACT, FLAG_CONTACT_KNOWN
from jtqd.estimator.arrays import BoolArray, FloatArray, RecordArray
from jtqd.estimator.observer import reference_of
from jtqd.estimator.status import NAMES


@dataclass(frozen=True)
class StatusChange:
    """Number of cycles with status `logged` in the log and `replayed` in the replay."""

    logged: str
    replayed: str
    cycles: int


@dataclass(frozen=True)
class Comparison:
    """One joint over n cycles; NaN where nothing was to be compared.

    Attributes:
        joint: from 1 on.
        cycles: compared.
        pdo_equal: cycles whose torque, sigma and status in the estimate PDO are the same.
        both: cycles with a torque in log and replay.
        rms_nm, max_nm, max_cycle: of the difference of the two, and where it is largest.
        sensor_cycles: cycles of these with a torque sensor beside them.
        sensor_logged_nm, sensor_replayed_nm: RMSE against the sensor as old as each estimate, over the same cycles.
        sigma_logged_nm, sigma_replayed_nm: mean of sigma over `both`.
        status_changed: cycles whose status is another.
        changes: largest first.
    """

    joint: int
    cycles: int
    pdo_equal: int
    both: int
    rms_nm: float
    max_nm: float
    max_cycle: int | None
    sensor_cycles: int
    sensor_logged_nm: float
    sensor_replayed_nm: float
    sigma_logged_nm: float
    sigma_replayed_nm: float
    status_changed: int
    changes: tuple[StatusChange, ...]


def compare(
    number: int,
    logged: RecordArray,
    replayed: RecordArray,
    taken: BoolArray,
    bandwidths_rad_s: tuple[float, float],
) -> Comparison:
    """Compare joint `number` over the cycles `taken` [n]; each estimate with the sensor of its own age.

    bandwidths_rad_s: of the estimate in the log, and of the replay (`jtqd.estimator.age`).
    """
    sensors = [
        reference_of(logged["sensor_torque_nm"], logged["dt_s"], each)[taken] for each in bandwidths_rad_s
    ]
    logged, replayed = logged[taken], replayed[taken]
    both = np.isfinite(logged["torque_nm"]) & np.isfinite(replayed["torque_nm"])
    apart = np.abs(replayed["torque_nm"][both] - logged["torque_nm"][both])
    beside = np.logical_and.reduce([both, *map(np.isfinite, sensors)])
    errors = [
        estimates["torque_nm"][beside] - sensor[beside]
        for estimates, sensor in zip((logged, replayed), sensors, strict=True)
    ]
    at = int(np.argmax(apart)) if len(apart) else None
    changed = logged["status"] != replayed["status"]
    return Comparison(
        joint=number,
        cycles=len(logged),
        pdo_equal=int(pdo_equal(logged, replayed).sum()),
        both=int(both.sum()),
        rms_nm=_rms(apart),
        max_nm=np.nan if at is None else float(apart[at]),
        max_cycle=None if at is None else int(logged["cycle"][both][at]),
        sensor_cycles=int(beside.sum()),
        sensor_logged_nm=_rms(errors[0]),
        sensor_replayed_nm=_rms(errors[1]),
        sigma_logged_nm=float(logged["sigma_nm"][both].mean()) if both.any() else np.nan,
        sigma_replayed_nm=float(replayed["sigma_nm"][both].mean()) if both.any() else np.nan,
        status_changed=int(changed.sum()),
        changes=_changes(logged["status"][changed].tolist(), replayed["status"][changed].tolist()),
    )


def pdo_equal(logged: RecordArray, replayed: RecordArray) -> BoolArray:
    """Return whether a joint's fields of the estimate PDO are the same [n]."""
    one, two = (
        np.array(fields(each["torque_nm"], each["sigma_nm"], each["status"].astype(np.uint16)))
        for each in (logged, replayed)
    )
    return np.asarray((one == two).all(axis=0))


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else np.nan


def _changes(before: list[int], after: list[int]) -> tuple[StatusChange, ...]:
    counts = sorted(Counter(zip(before, after, strict=True)).items())
    found = [StatusChange(NAMES.get(a, str(a)), NAMES.get(b, str(b)), n) for (a, b), n in counts]
    return tuple(sorted(found, key=lambda each: -each.cycles))


# ---- contacts (docs/estimator.md) ----

CONTACT_FLAGS = FLAG_CONTACT | FLAG_CONTACT_KNOWN
"""Of `input_flags`: whether there is a contact, and whether that is known."""


@dataclass(frozen=True)
class Contacts:
    """One joint over n cycles.

    Attributes:
        joint: from 1 on.
        known: cycles of the log in which it is known whether there is a contact.
        logged, replayed: contacts that begin.
        different: cycles with other flags, or another residual, bit for bit.
        first_cycle: of them; None without any.
        largest_nm: difference of the residuals where both are known; 0 without any.
        excused: the detector's state at the beginning was not known: its waves remember seconds.
    """

    joint: int
    known: int
    logged: int
    replayed: int
    different: int
    first_cycle: int | None
    largest_nm: float
    excused: bool

    @property
    def explained(self) -> bool:
        """Return whether the replay has the contacts of the log, or the log lacks the state that it would need."""
        return self.excused or not self.different


def contacts(
    logged: Sequence[RecordArray], replayed: Sequence[RecordArray], *, excused: bool
) -> tuple[Contacts, ...]:
    """Compare the joints [n each]; nothing for a joint whose contacts neither of the two knows."""
    found = []
    for number, (one, two) in enumerate(zip(logged, replayed, strict=True), start=1):
        before, after = one["input_flags"] & CONTACT_FLAGS, two["input_flags"] & CONTACT_FLAGS
        if not (before | after).any():
            continue
        different: BoolArray = before != after
        largest = 0.0
        if "contact_nm" in (one.dtype.names or ()):
            both = ((before & after) & FLAG_CONTACT_KNOWN) != 0
            apart = np.abs(np.where(both, one["contact_nm"] - two["contact_nm"], 0.0))
            different |= ~(apart == 0.0)
            largest = float(apart.max(initial=0.0))
        rows = np.flatnonzero(different)
        found.append(
            Contacts(
                joint=number,
                known=int(((before & FLAG_CONTACT_KNOWN) != 0).sum()),
                logged=_beginnings(before),
                replayed=_beginnings(after),
                different=len(rows),
                first_cycle=int(one["cycle"][rows[0]]) if len(rows) else None,
                largest_nm=largest,
                excused=excused,
            )
        )
    return tuple(found)


def _beginnings(flags: npt.NDArray[np.integer[Any]]) -> int:
    there = (flags & FLAG_CONTACT) != 0
    return int((there & ~np.concatenate(([False], there[:-1]))).sum())


# ---- identity with the log: bit for bit, and where not, from which cycle on and why ----

SETTLED_CYCLES = 200
"""So many cycles with inputs in a row that are identical: the unknown state has faded (40 time constants of the observer at
200 rad/s), and a later difference has another reason."""
_FIELDS = ("torque_nm", "status", "sigma_nm", "physics_nm", "network_nm", "tob_nm")
"""In this order a difference is named by the first that shows it."""


@dataclass(frozen=True)
class Unknown:
    """Cycles of one joint with unknown state: `cycles` of them from `first_cycle` on, until convergence.

    `until_end`: the replay did not become identical before the log or the next such place came.
    """

    joint: int
    first_cycle: int
    cycles: int
    reason: str
    until_end: bool


@dataclass(frozen=True)
class Difference:
    """First unexplained difference of one joint, and how many of its cycles differ; joint 0: the estimate PDOs."""

    joint: int
    cycle: int
    cycles: int
    field: str
    logged: float = np.nan
    replayed: float = np.nan
    largest_nm: float = 0.0


@dataclass(frozen=True)
class Identity:
    """Identity of a log and its replay.

    Attributes:
        cycles: replayed.
        identical: of these, bit for bit in every number of all joints and in the bytes of the estimate PDOs.
        pdos, pdos_equal: estimate PDOs in the frames of the log, and those of the same bytes.
        unknown: where the state was not known.
        differences: without a reason.
        from_cycle: all cycles from this one on are identical; None where the last one is not.
        network_nm: numbers that a network is part of and that differ by no more count as identical in all of this but
            `identical`, where it was evaluated otherwise when the log was recorded; 0: bits.
        contacts: of each joint that is watched; they are in no other count.
    """

    cycles: int
    identical: int
    pdos: int
    pdos_equal: int
    unknown: tuple[Unknown, ...]
    differences: tuple[Difference, ...]
    from_cycle: int | None
    network_nm: float = 0.0
    contacts: tuple[Contacts, ...] = ()

    @property
    def whole(self) -> bool:
        """Return whether every cycle is identical."""
        return self.identical == self.cycles

    @property
    def explained(self) -> bool:
        """Return whether all differences come from an unknown start state and then disappear."""
        unsettled = any(each.until_end for each in self.unknown)
        return not self.differences and not unsettled and all(each.explained for each in self.contacts)


def bits_equal(logged: npt.NDArray[Any], replayed: npt.NDArray[Any]) -> BoolArray:
    """Return whether values are equal bit for bit [n]; NaN equals NaN."""
    if logged.dtype.kind != "f":
        return np.asarray(logged == replayed)
    same = np.ascontiguousarray(logged).view(np.int64) == np.ascontiguousarray(replayed).view(np.int64)
    return np.asarray(same | (np.isnan(logged) & np.isnan(replayed)))


def identity(
    logged: Sequence[RecordArray],
    replayed: Sequence[RecordArray],
    steps: Sequence[Steps],
    estimate: tuple[npt.NDArray[np.uint8], npt.NDArray[np.uint8], BoolArray] | None = None,
    states: Sequence[tuple[int, int]] = (),
    *,
    network_nm: float = 0.0,
) -> Identity:
    """Compare n cycles of all joints, all fields of `replayed`.

    Args:
        logged, replayed, steps: of each joint.
        estimate: bytes of the estimate PDOs [n, 8 PDOs] in the frames and replayed, and whether they are logged [n]; None:
            the frames were not read.
        states: (joint, cycle) of the estimators' states in the log that are not the replay's.
        network_nm: largest effect of another evaluation of the networks on their share, in cycles where that share differs.
    """
    cycle = logged[0]["cycle"].astype(np.int64)
    same = bits = [_same(one, two) for one, two in zip(logged, replayed, strict=True)]
    if network_nm:
        same = [
            each | (_same(one, two, network_nm) & ~bits_equal(one["network_nm"], two["network_nm"]))
            for each, one, two in zip(bits, logged, replayed, strict=True)
        ]
    recorded: BoolArray = np.zeros(len(cycle), np.bool_)
    pdo: BoolArray = ~recorded
    if estimate is not None:
        sent, made, recorded = estimate
        pdo = ~recorded | (sent == made).all(axis=1)
    unknown: list[Unknown] = []
    differences: list[Difference] = []
    for n, (one, two) in enumerate(zip(logged, replayed, strict=True)):
        wrong = []
        for first, end, reason in _segments(len(cycle), steps[n]):
            settled = first
            if reason:
                settled = _settled(same[n], steps[n].used, first, end)
                after = cycle[settled] if settled < end else cycle[end - 1] + 1
                count = int(after - cycle[first])
                unknown.append(Unknown(n + 1, int(cycle[first]), count, reason, settled >= end))
            wrong += (np.flatnonzero(~same[n][settled:end]) + settled).tolist()
        if wrong:
            differences.append(_difference(n, one, two, wrong))
    numbers: BoolArray = np.logical_and.reduce(same)
    if (numbers & ~pdo).any():
        row = int(np.argmax(numbers & ~pdo))
        differences.insert(0, Difference(0, int(cycle[row]), int((~pdo).sum()), "estimate PDO"))
    last = np.flatnonzero(~(numbers & pdo))
    start = int(last[-1]) + 1 if len(last) else 0
    return Identity(
        len(cycle),
        int((np.logical_and.reduce(bits) & pdo).sum()),
        int(recorded.sum()),
        int((recorded & pdo).sum()),
        tuple(sorted(unknown, key=lambda each: (each.first_cycle, each.joint))),
        (*differences, *_state_differences(states, unknown)),
        int(cycle[start]) if start < len(cycle) else None,
        network_nm,
        contacts(logged, replayed, excused=bool(unknown)),
    )


def _state_differences(states: Sequence[tuple[int, int]], unknown: Sequence[Unknown]) -> Iterator[Difference]:
    """Yield one entry per joint with other states; after an unknown state they need as long to settle as the estimate."""
    wrong: dict[int, list[int]] = {}
    for joint, cycle in states:
        spans = [each for each in unknown if each.joint == joint]
        if not any(0 <= cycle - each.first_cycle < each.cycles + SETTLED_CYCLES for each in spans):
            wrong.setdefault(joint, []).append(cycle)
    for joint, cycles in sorted(wrong.items()):
        yield Difference(joint, min(cycles), len(cycles), "state")


def _compared(replayed: RecordArray) -> list[str]:
    """Return the fields whose identity counts, in the order of _FIELDS; those in ADDED follow from them."""
    names = [name for name in replayed.dtype.names or () if name not in ADDED]
    return sorted(names, key=lambda name: _FIELDS.index(name) if name in _FIELDS else len(_FIELDS))


def _same(logged: RecordArray, replayed: RecordArray, network_nm: float = 0.0) -> BoolArray:
    """Equal bit for bit [n]; `network_nm`: but for the network's share, by which the numbers may differ so much."""
    same = [
        _equal(logged, replayed, name, network_nm if name in ("network_nm", "torque_nm", "sigma_nm") else 0.0)
        for name in _compared(replayed)
    ]
    return np.asarray(np.logical_and.reduce(same))


def _equal(logged: RecordArray, replayed: RecordArray, name: str, tolerance: float = 0.0) -> BoolArray:
    """Equal bit for bit in this field, or, where there is a tolerance, numbers that are so near to each other [n]."""
    one, two = logged[name], replayed[name]
    if name == "input_flags":  # contacts are compared apart: their detectors' state fades more slowly
        one, two = one & ~np.uint16(CONTACT_FLAGS), two & ~np.uint16(CONTACT_FLAGS)
    same = bits_equal(one, two)
    if tolerance:
        with np.errstate(invalid="ignore"):
            same |= np.abs(one - two) <= tolerance
    return same


def _segments(count: int, steps: Steps) -> list[tuple[int, int, str]]:
    """(first row, row after the last, reason or "") between the places where a joint's state is known or lost."""
    places = {0: "", **{int(row): "" for row in steps.begins}, **dict(steps.breaks)}
    rows = sorted(places)
    return [(row, end, places[row]) for row, end in zip(rows, [*rows[1:], count], strict=True)]


def _settled(same: BoolArray, used: BoolArray, first: int, end: int) -> int:
    """Row after the last difference before SETTLED_CYCLES identical cycles with inputs in a row; `end`: never."""
    wrong = np.flatnonzero(~same[first:end]) + first
    if not len(wrong):
        return first
    counts = np.concatenate(([0], np.cumsum(used)))
    after = np.append(wrong[1:], end)
    long_enough = np.flatnonzero(counts[after] - counts[wrong + 1] >= SETTLED_CYCLES)
    if len(long_enough):
        return int(wrong[long_enough[0]]) + 1
    return int(wrong[-1]) + 1 if counts[end] > counts[wrong[-1] + 1] else end


def _difference(number: int, logged: RecordArray, replayed: RecordArray, wrong: list[int]) -> Difference:
    row = slice(wrong[0], wrong[0] + 1)
    field = next(name for name in _compared(replayed) if not _equal(logged[row], replayed[row], name)[0])
    with np.errstate(invalid="ignore"):
        apart = np.abs(logged["torque_nm"][wrong] - replayed["torque_nm"][wrong])
    return Difference(
        number + 1,
        int(logged["cycle"][row][0]),
        len(wrong),
        field,
        float(logged[field][row][0]),
        float(replayed[field][row][0]),
        float(np.nanmax(apart)) if np.isfinite(apart).any() else 0.0,
    )
