"""Estimates of a replay: raw frames of a log to inputs of each cycle, and these through the loop's own code.

What comes out is bit for bit what the loop had, or something differs. Taken from the log is what only the loop could know:
which inputs counted, how long a step was, that an estimate was ready too late. Everything else (positions that roll over,
temperatures and their age, estimate, status, the bytes of the estimate PDO) is computed from the raw frames again.

The frames of a record are in order of arrival, late ones of the cycle before first. Of an input that counted, the last frame
with its identifier and length is therefore the one that was used (see `core.intake`); whether it counted is what the
log's `input_flags` say. Where a record had no room for all frames, the integers come from the SI values beside it.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from jtqd.daemon.core.contact import contacts_of
from jtqd.daemon.core.input_pdos import InputPdo, JointInputs, input_pdos, joint_temperatures
from jtqd.daemon.core.intake import Intake
from jtqd.daemon.core.joint import JointCycle
from jtqd.daemon.core.joint_safety import JointSafety
from jtqd.daemon.replay.logged import NO_STATES, SAMPLE, EstimatorStates, Setup
from jtqd.daemon.replay.rows import CycleRows
from jtqd.daemon.replay.runs import Steps
from jtqd.daemon.shared import cycle_record as cr
from jtqd.daemon.shared.counters import COUNTERS
from jtqd.daemon.shared.cycle_record import (
    FLAG_MOTION,
    FLAG_NETWORK_SKIPPED,
    FLAG_POSITION,
    FLAG_SENSOR,
    FLAG_TEMPERATURE,
)
from jtqd.drivers.own_objects import estimate_tpdos
from jtqd.estimator.arrays import BoolArray, FloatArray, IntegerArray, RecordArray
from jtqd.estimator.joint import Joint
from jtqd.estimator.methods import AnyEstimator, AnyNetwork
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.status import learner_of

# ---- inputs ----

_HALF, _FULL = 1 << 31, 1 << 32


@dataclass(frozen=True)
class Pdo:
    """One input PDO over n cycles: integers by the order of its mapping, and whether it counted."""

    values: tuple[IntegerArray, ...]
    fresh: BoolArray


@dataclass(frozen=True)
class Frames:
    """Content of the raw frames of n cycles.

    Attributes:
        pdos: in the order of `input_pdos`.
        temperatures: of each joint that tells one: (cycle row, frame as `struct can_frame`) in order of arrival.
        estimate: estimate PDOs one after the other [n, 8 * PDOs]; recorded: they are in the record [n].
        from_si: inputs whose frame may not be in the record.
    """

    pdos: tuple[Pdo, ...]
    temperatures: tuple[tuple[tuple[int, bytes], ...], ...]
    estimate: npt.NDArray[np.uint8]
    recorded: BoolArray
    from_si: int


class _Table:
    """All frames of the records [n, capacity], those that are not there masked."""

    def __init__(self, records: RecordArray) -> None:
        frames = records["frames"]
        self.count, self.capacity = frames.shape
        there = np.arange(self.capacity) < records["frame_count"][:, None]
        self.ids = np.where(there, frames["id"], np.uint32(0xFFFF_FFFF))
        self.lengths, self.data = frames["length"], frames["data"]

    def last(self, cob_id: int, length: int) -> tuple[BoolArray, npt.NDArray[np.uint8]]:
        """Return whether a cycle has the frame [n], and the data of its last one [n, 8]."""
        match = (self.ids == cob_id) & (self.lengths == length)
        place = self.capacity - 1 - np.argmax(match[:, ::-1], axis=1)
        return match.any(axis=1), self.data[np.arange(self.count), place]

    def every(self, cob_id: int) -> tuple[tuple[int, bytes], ...]:
        """(row, frame) of each frame with this identifier, whatever its length."""
        rows, places = np.nonzero(self.ids == cob_id)
        return tuple(
            (row, cob_id.to_bytes(4, "little") + bytes((length, 0, 0, 0)) + data.tobytes())
            for row, length, data in zip(
                rows.tolist(), self.lengths[rows, places].tolist(), self.data[rows, places], strict=True
            )
        )


def decode(setup: Setup, records: RecordArray, joints: Sequence[RecordArray]) -> Frames:
    """Return what the raw frames `records` (/can/frames) say, beside the joints' states of the same cycles."""
    table = _Table(records)
    left_out = records["frames_left_out"] > 0
    pdos, from_si = [], 0
    for index, pdo in enumerate(input_pdos(setup.config)):
        fresh = _fresh(index, setup.inputs, joints)
        there, data = table.last(pdo.cob_id, pdo.length)
        if pdo.age_ns:
            there, data = _held(there, left_out, data)
        values = [*_unpack(pdo, data)]
        absent = fresh & (~there | left_out)
        if absent.any():
            from_si += int(absent.sum())
            for entry, known in _counts(index, setup.inputs, joints).items():
                values[entry][absent] = known[absent]
        pdos.append(Pdo(tuple(values), fresh))
    pairs = [
        table.last(pdo.cob_id, pdo.length)
        for pdo in estimate_tpdos(len(setup.config.joints), setup.config.node_id)
    ]
    recorded: BoolArray = np.logical_and.reduce([there for there, _ in pairs])
    estimate = np.concatenate([data for _, data in pairs], axis=1)
    return Frames(
        tuple(pdos),
        tuple(table.every(each.cob_id) for each in joint_temperatures(setup.config)),
        estimate,
        recorded,
        from_si,
    )


def _held(
    there: BoolArray, left_out: BoolArray, data: npt.NDArray[np.uint8]
) -> tuple[BoolArray, npt.NDArray[np.uint8]]:
    """Return whether the last frame up to each cycle is known [n], and its data: it counts until the next one."""
    last = np.maximum.accumulate(np.where(there | left_out, np.arange(len(there)), -1))
    known: BoolArray = (last >= 0) & ~left_out[last]
    return known, data[last]


def _fresh(index: int, inputs: Sequence[JointInputs], joints: Sequence[RecordArray]) -> BoolArray:
    """Return whether PDO `index` counted, by the flags of the joints that use it [n]."""
    fresh: BoolArray = np.zeros(len(joints[0]), np.bool_)
    for each, records in zip(inputs, joints, strict=True):
        for used, flag in (
            (each.positions, FLAG_POSITION),
            (each.motion, FLAG_MOTION),
            ({each.sensor}, FLAG_SENSOR),
        ):
            if index in used:
                fresh |= (records["input_flags"] & flag) != 0
    return fresh


def _unpack(pdo: InputPdo, data: npt.NDArray[np.uint8]) -> list[IntegerArray]:
    """Mapped integers of frames [n, 8], one array per object."""
    letters = pdo.layout.format.lstrip("<")
    layout = np.dtype([(f"f{n}", f"<{letter}") for n, letter in enumerate(letters)])
    rows = np.ascontiguousarray(data[:, : pdo.length]).view(layout)[:, 0]
    return [rows[name].astype(np.int64) for name in layout.names or ()]


def _counts(
    index: int, inputs: Sequence[JointInputs], joints: Sequence[RecordArray]
) -> dict[int, IntegerArray]:
    """Entries of PDO `index` by the SI values that the log has beside the frames; nobody reads the others."""
    found: dict[int, IntegerArray] = {}
    for each, records in zip(inputs, joints, strict=True):
        for name, place in each.places.items():
            if place.pdo == index:
                found[place.entry] = _counted(name, each, records)
        if index == each.sensor:
            found[0] = _whole(records["sensor_torque_nm"], each.sensor_nm_per_unit)
            found[1] = records["sensor_status"].astype(np.int64)
    return found


def _counted(name: str, each: JointInputs, records: RecordArray) -> IntegerArray:
    """Integers of a quantity of the drive."""
    if name == "motor_position":
        return _rolled(_whole(records["motor_position_rad"], each.motor_rad_per_count))
    if name == "link_position":
        return _rolled(_whole(records["link_position_rad"], each.link_rad_per_count))
    if name == "motor_velocity":
        return _whole(records["motor_velocity_rad_s"], each.motor_rad_s_per_unit)
    if name == "current":
        return _whole(records["current_a"], each.ampere_per_unit)
    return records["statusword"].astype(np.int64)


def _whole(values: FloatArray, unit: float) -> IntegerArray:
    """Counts of SI values; 0 for those that are not known."""
    with np.errstate(all="ignore"):
        counts = np.rint(values / unit)
    return np.where(np.isfinite(counts), counts, 0.0).astype(np.int64)


def _rolled(counts: IntegerArray) -> IntegerArray:
    """Convert to a 32-bit position with roll-over."""
    return (counts + _HALF) % _FULL - _HALF


def offsets(pdos: Sequence[Pdo], records: RecordArray, each: JointInputs, row: int) -> tuple[int, int]:
    """Whole ranges [counts] that motor and link position had rolled over by `row`: the log says where they were."""
    found = []
    for quantity, name, unit in (
        ("motor_position", "motor_position_rad", each.motor_rad_per_count),
        ("link_position", "link_position_rad", each.link_rad_per_count),
    ):
        place = each.places.get(quantity)
        if place is None:
            found.append(0)
            continue
        column = pdos[place.pdo].values[place.entry]
        counts = int(_whole(records[name][row : row + 1], unit)[0])
        found.append(round((counts - int(column[row])) / _FULL) * _FULL)
    return found[0], found[1]


# ---- estimates ----

_TOLD = 1 << 14
"""Cycles between two calls of `progress`."""


@dataclass
class _Counters:
    """Counters of the loop in shared memory; not read here."""

    counters: array[int] = field(default_factory=lambda: array("Q", [0] * len(COUNTERS)))
    errors: array[float] = field(default_factory=lambda: array("d", [0.0] * 3 * cr.MOST_JOINTS))


@dataclass(frozen=True)
class Replayed:
    """Result over n cycles.

    Attributes:
        joints: of each joint, `SAMPLE` [n].
        estimate: bytes of the estimate PDOs, one after the other [n, 8 * PDOs].
        temperatures_from_log: cycles whose temperature the frames alone do not tell.
        pasts_differ: (joint from 1 on, cycle) after which the log has another state of the estimator than the replay.
    """

    joints: tuple[RecordArray, ...]
    estimate: npt.NDArray[np.uint8]
    temperatures_from_log: int
    pasts_differ: tuple[tuple[int, int], ...] = ()


class Replayer:
    """Replay cycle by cycle; keeps the joints from one part of a log to the next.

    Args:
        setup: configuration and scaling.
        estimators, safety: of each joint.
    """

    def __init__(
        self, setup: Setup, estimators: Sequence[AnyEstimator], safety: Sequence[JointSafety]
    ) -> None:
        config = setup.config
        self._setup = setup
        self._intake = Intake(input_pdos(config), joint_temperatures(config))
        counters = _Counters()
        self._joints = [
            JointCycle(
                n,
                inputs,
                estimator,
                intake=self._intake,
                snapshot=counters,
                period_ns=config.period_ns,
                safety=limits,
            )
            for n, (inputs, estimator, limits) in enumerate(
                zip(setup.inputs, estimators, safety, strict=True)
            )
        ]
        self._unknown = [True] * len(self._joints)
        self._pasts_differ: list[tuple[int, int]] = []
        self._contacts = contacts_of(config)
        self._time_ns = [1 << 60] * len(
            self._joints
        )  # any but 0, which would mean that there was no sample yet

    def run(
        self,
        joints: Sequence[RecordArray],
        frames: Frames,
        steps: Sequence[Steps],
        progress: Callable[[int], None] = lambda _: None,
        pasts: Sequence[EstimatorStates] = (),
    ) -> Replayed:
        """Replay the cycles of one part; `joints` are its states as logged. `progress` is called with the cycles done.

        pasts: of each joint, states of its estimator in the log. The first one after a place where the state was not known
        is gone on from; the others are compared.
        """
        count = len(joints[0])
        celsius, happens = self._temperatures(frames, joints)
        for n in range(len(self._joints)):
            known = pasts[n] if pasts else NO_STATES
            for row, marks in self._marks(n, joints[n], frames, steps[n], known).items():
                happens.setdefault(row, []).extend(marks)
        times = np.array(
            [start + np.cumsum(each.dt_ns) for start, each in zip(self._time_ns, steps, strict=True)]
        )
        rows = CycleRows(
            self._intake,
            self._joints,
            fresh=[each.fresh for each in frames.pdos],
            values=[each.values for each in frames.pdos],
            velocity=[each["motor_velocity_rad_s"] for each in joints],
            celsius=celsius,
            cycle=joints[0]["cycle"],
            counter=joints[0]["sync_counter"],
            sync_ns=times,
            wanted=[(each["input_flags"] & FLAG_NETWORK_SKIPPED) == 0 for each in joints],
            contacts=self._contacts,
            withdrawn=(joints[0]["cycle_flags"] & cr.FLAG_WITHDRAWN) != 0,
        )
        ends = sorted({*happens, *range(0, count, _TOLD), count})
        for first, end in pairwise(ends):
            for each in happens.get(first, ()):
                each()
            rows.go_on(first, end)
            progress(end)
        if count:
            self._time_ns = times[:, -1].tolist()
        samples = tuple(each.view(SAMPLE)[:, 0] for each in rows.samples)
        differ, self._pasts_differ = tuple(self._pasts_differ), []
        return Replayed(samples, rows.estimates, rows.temperatures_from_log, differ)

    def _temperatures(
        self, frames: Frames, joints: Sequence[RecordArray]
    ) -> tuple[list[FloatArray], dict[int, list[Callable[[], object]]]]:
        """Return each joint temperature as logged [n], and the frames to take before a row.

        A node that restarted is not believed until it is configured, and a frame may have found no room in its record: where
        the log says something else than the frames do, and there is such a reason, the log is right.
        """
        celsius: list[FloatArray] = []
        happens: dict[int, list[Callable[[], object]]] = {}
        for index, events in enumerate(frames.temperatures):
            number = next(n for n, inputs in enumerate(self._setup.inputs) if inputs.temperature == index)
            known = (joints[number]["input_flags"] & FLAG_TEMPERATURE) != 0
            celsius.append(np.where(known, joints[number]["temperature_c"], np.nan))
            for row, frame in events:
                happens.setdefault(row, []).append(partial(self._intake.receive_temperature, index, frame))
        return celsius, happens

    def _marks(
        self, number: int, records: RecordArray, frames: Frames, steps: Steps, pasts: EstimatorStates
    ) -> dict[int, list[Callable[[], object]]]:
        """Apply the events of one joint before a row: continuation after a gap in the log, reset of faults, restart."""
        joint, each = self._joints[number], self._setup.inputs[number]
        marks: dict[int, list[Callable[[], object]]] = {}
        for row, _ in steps.breaks:
            found = offsets(frames.pdos, records, each, row)
            marks.setdefault(row, []).append(partial(self._lose, number, found))
        for row, content in pasts.rows(records["cycle"]).items():
            marks.setdefault(row, []).append(
                partial(self._meet, number, int(records["cycle"][row]) - 1, content)
            )
        for row in np.flatnonzero(records["cycle_flags"] & cr.FLAG_RESET).tolist():
            marks.setdefault(row, []).append(joint.reset_latch)
        for row in steps.begins.tolist():
            marks.setdefault(row, []).append(partial(self._begin, number))
        return marks

    def _begin(self, number: int) -> None:
        """Go on where a joint began anew, so that all about it is known."""
        self._joints[number].begin_again()
        self._unknown[number] = False

    def _lose(self, number: int, offset: tuple[int, int]) -> None:
        """Go on behind cycles that are missing, with these roll-overs of the positions."""
        self._joints[number].resume(*offset)
        self._unknown[number] = True

    def _meet(self, number: int, cycle: int, content: bytes) -> None:
        """Compare the estimator's state with that of the log after `cycle`, and go on from the latter."""
        learner = learner_of(self._joints[number].estimator)
        if learner is None or learner.past == content:
            return
        if not self._unknown[number]:
            self._pasts_differ.append((number + 1, cycle))
        learner.past = content
        self._unknown[number] = False


@dataclass(frozen=True)
class Model:
    """Estimator model of one joint."""

    joint: Joint
    settings: EstimatorSettings
    network: AnyNetwork | None
