"""The record of one cycle as it lies in shared memory: one fixed-size struct, written by the loop, read by the recorder.

Little endian, no padding decided by a compiler; how long it is depends on the number of joints (`Layout`):

    header   index, times, flags and counters of the cycle
    joints   one block for each joint: inputs in SI units and every stage of the estimate
    frames   frames as `struct can_frame` with their kernel stamps, in order of arrival: up to 16 where there are one or two
             joints (712 bytes with two), up to 32 where there are more
    shadow   one block for each joint, where there are shadow methods
    tail     the index again: a reader that finds head and tail different has met a half-written record

Quantities are NaN where they are not known in that cycle (an input that did not come, a stage that was not computed).

The ring of records: `Ring`.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Collection
from functools import cache
from pathlib import Path
from typing import Final, NamedTuple

from jtqd.daemon.shared.runtime_dir import SharedMemoryError, mapped, new_memory

MOST_JOINTS: Final = 4
"""Joints of one bus: two estimate PDOs of two each."""

JOINT_FORMAT = "16d4H"
HEADER_FORMAT = "QqqIIiI8B"

SHADOW_METHODS: Final = ("tob", "efficiency", "network", "fused")
"""Those of the registry, `estimator.settings.METHODS`: compared with it when `core/record.pyx` is imported."""
SHADOW_QUANTITIES: Final = ("torque_nm", "sigma_nm", "reference_nm", "age_ms")
"""Of each shadow method; reference_nm: the torque sensor as old as its torque. NaN for a method that is not computed."""
SHADOW_FIELDS: Final = (
    *(f"{method}_{quantity}" for method in SHADOW_METHODS for quantity in SHADOW_QUANTITIES),
    *(f"{method}_status" for method in SHADOW_METHODS),
)

HEADER = struct.Struct("<" + HEADER_FORMAT)
JOINT = struct.Struct("<" + JOINT_FORMAT)
SHADOW = struct.Struct(f"<{len(SHADOW_METHODS) * len(SHADOW_QUANTITIES)}d{len(SHADOW_METHODS)}H")
TAIL = struct.Struct("<Q")


class Layout(NamedTuple):
    """Where the parts of a record lie; see `layout_of`."""

    joints: int
    head: struct.Struct
    """Header and all joints in one call: packing them together costs a third of packing them apart."""
    frame_capacity: int
    """Frames that a record holds."""
    frames_offset: int
    stamps_offset: int
    shadow_offset: int
    tail_offset: int
    size: int
    """Bytes of a record."""


@cache
def layout_of(joints: int, shadow: bool = False) -> Layout:
    """Return the layout for a number of joints, with or without shadow methods. Raises ValueError for any but 1..4."""
    if not 1 <= joints <= MOST_JOINTS:
        raise ValueError(f"found {joints} joints, expected 1 to {MOST_JOINTS}")
    head = struct.Struct("<" + HEADER_FORMAT + joints * JOINT_FORMAT)
    capacity = 16 if joints <= 2 else 32
    stamps = head.size + 16 * capacity
    shadows = stamps + 8 * capacity
    tail = shadows + joints * SHADOW.size * shadow
    return Layout(joints, head, capacity, head.size, stamps, shadows, tail, tail + TAIL.size)


PAIR: Final = layout_of(2)
"""The layout of two joints."""

FLAG_COMPLETE = 0x01
"""Every expected input of this cycle arrived before its deadline."""
FLAG_PUBLISHED = 0x02
"""The estimate PDO of this cycle was handed to the socket."""
FLAG_BEFORE_NEXT_SYNC = 0x04
"""... and that happened before the next SYNC was due."""
FLAG_SYNC_CONFIRMED = 0x08
"""The SYNC's own echo came back, so `sync_realtime_ns` is its send time on the wire and not the time of the call."""
FLAG_WITHDRAWN = 0x10
"""The estimate was not ready before the next SYNC was due: all joints were stale (`JointCycle.withdraw`)."""
FLAG_RESET = 0x20
"""Latched faults were reset just before this cycle's estimate (`JointCycle.reset_latch`)."""
FLAG_UNCHECKED, FLAG_STARTING = 0x40, 0x80
"""As a guest: status at most degraded (of joint n from 0 on; in the header bit 8 + n); one of the first cycles with SYNC."""

FLAG_POSITION, FLAG_MOTION, FLAG_SENSOR, FLAG_TEMPERATURE = 1, 2, 4, 8
"""`input_flags` of record and snapshot: TPDO1, TPDO2 and the sensor's PDO are of this cycle; the temperature is known."""
FLAG_NETWORK_SKIPPED, FLAG_LATCHED = 0x10, 0x20
FLAG_CONTACT_KNOWN, FLAG_CONTACT = 0x40, 0x80
"""... no time for the network; a fault is latched; contacts are watched and known; there is one."""
TEMPERATURE_LIFE_S = 2.0
"""Four frames in a row are missing then; a joint needs minutes to become noticeably warmer."""


class Header(NamedTuple):
    """Times in integer ns; `cycle` counts cycles since the start, missed slots included."""

    cycle: int
    sync_monotonic_ns: int
    sync_realtime_ns: int
    flags: int
    work_ns: int
    """CPU and wall time from the wake-up for the inputs to the end of the cycle's work [ns]."""
    late_ns: int
    """SYNC's send time minus its slot on the grid [ns]."""
    missed: int
    """Slots missed so far."""
    sync_counter: int
    frame_count: int
    """Frames stored in this record."""
    frames_left_out: int
    """Frames of this cycle that did not fit (255 = that many or more)."""
    stale_inputs: int
    late_frames: int
    duplicate_frames: int
    rejected_frames: int
    """Frames with our identifiers and a wrong length, or 29-bit or remote frames."""
    spare: int


class JointRecord(NamedTuple):
    """SI units, signs of docs/architecture.md; joint side unless the name states motor."""

    current_a: float
    motor_position_rad: float
    motor_velocity_rad_s: float
    link_position_rad: float
    sensor_torque_nm: float
    temperature_c: float
    """Of the joint, as its drive sent it last; NaN where it sent none for 2 s."""
    torque_nm: float
    sigma_nm: float
    tob_nm: float
    physics_nm: float
    network_nm: float
    dt_s: float
    reference_nm: float
    """`sensor_torque_nm` through the estimator's filter: as old as `torque_nm`; NaN until it has settled."""
    age_ms: float
    """Group delay of the estimate at low frequency; NaN where no joint file is known."""
    torque_rate_nm_s: float
    """Of the torsion, through its own filter (docs/estimator.md); NaN without torsion."""
    contact_nm: float
    """Torque from outside on the link that neither motion nor slow changes explain; NaN where contacts are not watched or
    not known in this cycle."""
    statusword: int
    status: int
    sensor_status: int
    input_flags: int
    """The flags FLAG_POSITION to FLAG_CONTACT; bits 8 to 15: the faults (`faults.py`) for which there is no torque: of this
    cycle, of one not long ago, or latched."""


def selection(header: Collection[str], joint: Collection[str], joints: int) -> struct.Struct:
    """Return a layout that unpacks only these fields of a record: those of the header, then of joint 1 to `joints`.

    The values come in the order of the record. Raises ValueError for a field that the record does not have.
    """
    unknown = {*header} - {*Header._fields} | {*joint} - {*JointRecord._fields}
    if unknown:
        raise ValueError(f"found {', '.join(sorted(unknown))}, expected fields of Header and JointRecord")
    one_joint = _selected(JOINT_FORMAT, JointRecord._fields, joint)
    return struct.Struct("<" + _selected(HEADER_FORMAT, Header._fields, header) + joints * one_joint)


def _selected(layout: str, names: tuple[str, ...], wanted: Collection[str]) -> str:
    """Return the same layout with padding in place of what is not wanted."""
    codes = "".join(int(count or 1) * code for count, code in re.findall(r"(\d*)(\D)", layout))
    return "".join(
        code if name in wanted else f"{struct.calcsize('<' + code)}x"
        for code, name in zip(codes, names, strict=True)
    )


def header_of(record: bytes | memoryview) -> Header:
    """Return the header of one record."""
    return Header._make(HEADER.unpack_from(record, 0))


def joint_of(record: bytes | memoryview, joint: int) -> JointRecord:
    """Return the block of joint `joint`, from 1 on, of one record."""
    return JointRecord._make(JOINT.unpack_from(record, HEADER.size + (joint - 1) * JOINT.size))


# The ring of records ----

_MAGIC = 0x4A54_5144_5249_4E47  # "JTQDRING"
_HEADER_SIZE = 4096
COUNT_WORD = 8
"""64-bit word of the count, on a cache line of its own: the reader polls it while records are written."""
_LAYOUT = struct.Struct("<QQQ")


class Ring:
    """Writer's side: memory of `slots` records that the loop fills (`daemon/core/record.pyx`), in a new file on a tmpfs.

    The file holds a header page (64-bit `words`) and the `records`. The writer fills the slot of record n and then stores n
    + 1 as the count; it overwrites the oldest record when the reader is slow or gone.
    """

    def __init__(self, path: Path, slots: int, record_size: int, mode: int = 0o600) -> None:
        head = _LAYOUT.pack(_MAGIC, slots, record_size)
        view = memoryview(new_memory(path, _HEADER_SIZE + slots * record_size, head, mode))
        # One 8-byte store. `struct.pack_into` writes zeros first: the reader would at times see a count of 0.
        self.words = view[:_HEADER_SIZE].cast("Q")
        self.records = view[_HEADER_SIZE:]
        self.size = slots

    def append(self, record: bytes | bytearray | memoryview) -> None:
        """Write a whole record; the loop fills the slot in place."""
        start = self.words[COUNT_WORD] % self.size * len(record)
        self.records[start : start + len(record)] = record
        self.words[COUNT_WORD] += 1


class Batch(NamedTuple):
    """Result of one `RingReader.read`: whole records in order, and the number overwritten unread."""

    records: list[bytes]
    lost: int


class RingReader:
    """Reader's side: copies whole records and counts those it has missed; starts at the oldest one still there.

    Each record begins and ends with its index, larger from record to record. Where stores become visible out of order (ARM)
    the count can be seen before the record: a copy whose two ends differ is torn, and one whose index is not larger than
    the last is what lay in the slot a lap ago. Both are dropped and counted.

    Raises:
        SharedMemoryError: the file is no ring, or of another record size.
    """

    def __init__(self, path: Path, record_size: int) -> None:
        self._memory = mapped(path, "cannot be read as a ring")
        long_enough = len(self._memory) >= _HEADER_SIZE
        magic, slots, size = _LAYOUT.unpack_from(self._memory, 0) if long_enough else (0, 0, 0)
        if magic != _MAGIC or size != record_size or len(self._memory) != _HEADER_SIZE + slots * size:
            raise SharedMemoryError(
                f"{path}: not a ring of {record_size}-byte records (found record size {size})"
            )
        self._words = memoryview(self._memory)[:_HEADER_SIZE].cast("Q")
        self._slots, self._record_size, self._newest = slots, record_size, -1
        self.position: int = max(0, self._count() - slots)

    def _count(self) -> int:
        return self._words[COUNT_WORD]

    @property
    def backlog(self) -> int:
        """Return the number of records written and not yet read."""
        return self._count() - self.position

    def read(self, limit: int = 1024) -> Batch:
        """Copy at most `limit` records; count those that were overwritten before they could be copied."""
        count = self._count()
        lost = max(0, count - self._slots - self.position)
        self.position += lost
        first, last = self.position, min(count, self.position + limit)
        size, memory = self._record_size, self._memory
        offsets = (_HEADER_SIZE + n % self._slots * size for n in range(first, last))
        copies = [memory[offset : offset + size] for offset in offsets]
        # The writer may be filling slot `count % slots` right now: that record is overwritten too.
        overwritten = min(len(copies), max(0, self._count() + 1 - self._slots - first))
        good = []
        for record in copies[overwritten:]:
            index = int.from_bytes(record[:8], "little")
            if record[:8] == record[-8:] and index > self._newest:
                good.append(record)
                self._newest = index
        self.position = last
        return Batch(good, lost + len(copies) - len(good))
