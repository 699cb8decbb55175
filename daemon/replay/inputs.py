"""Inputs of a replay: raw frames of a log as the integers of each cycle's input PDOs.

The frames of a record are in order of arrival, late ones of the cycle before first. Of an input that counted, the last frame
with its identifier and length is therefore the one that was used (see `core.intake`); whether it counted is in the log's
`input_flags`. Where a record had no room for all frames, the integers come from the SI values beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from jtqd.daemon.core.input_pdos import InputPdo, JointInputs, input_pdos, joint_temperatures
from jtqd.daemon.replay.logged import Setup
from jtqd.daemon.shared.cycle_record import FLAG_MOTION, FLAG_POSITION, FLAG_SENSOR
from jtqd.drivers.own_objects import estimate_tpdos
from jtqd.estimator.arrays import BoolArray, FloatArray, IntegerArray, RecordArray

_HALF, _FULL = 1 << 31, 1 << 32


@dataclass(frozen=True)
class Pdo:
    """One input PDO over n cycles: integers by the order of its mapping, and whether it counted."""

    values: tuple[IntegerArray, ...]
    fresh: BoolArray


@dataclass(frozen=True)
class Inputs:
    """Inputs of n cycles, and the estimate PDOs beside them.

    Attributes:
        pdos: in the order of `input_pdos`.
        temperatures: of each joint that has one: (cycle row, frame as `struct can_frame`) in order of arrival.
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


def decode(setup: Setup, records: RecordArray, joints: Sequence[RecordArray]) -> Inputs:
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
    return Inputs(
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
    """Whole ranges [counts] that motor and link position had rolled over by `row`: from the log."""
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
