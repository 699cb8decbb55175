"""CDR bytes of every recorded message, by the definitions of `jtqd.daemon.recording.schemas`. Pure.

A CDR payload is the encapsulation header 00 01 00 00 (plain CDR, little endian) followed by the fields, each
aligned to its own size counted from the first byte after that header (OMG DDSI-RTPS, section 10; DDS-XTypes,
section 7.4). Every topic's messages have one constant size: strings are filled up with spaces, so that a
reader may take a whole chunk as one array of records.

The three messages of every cycle are made by one `struct` call. The definitions were laid out for that: whole
stretches of the cycle record go into the message as they lie in memory (see `jtqd.daemon.shared.cycle_record`).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from jtqd.daemon.recording import schemas
from jtqd.daemon.shared import cycle_record as cycle

CDR_HEADER = b"\x00\x01\x00\x00"
_NS = 1_000_000_000
_MASK = 0xFFFF_FFFF

EVENT_TEXT_LENGTH = 80
LOG_TEXT_LENGTH = 160
_DIAGNOSTIC_TEXT_LENGTH = 64
_DIAGNOSTIC_VALUE_LENGTH = 20


def _text(value: str) -> bytes:
    """Return a CDR string: length with the closing NUL, characters, NUL."""
    data = value.encode() + b"\0"
    return struct.pack("<I", len(data)) + data


def fit(value: str, length: int) -> str:
    """Exactly `length` characters of ASCII: cut, or filled up with spaces."""
    return value.encode("ascii", "replace").decode()[:length].ljust(length)


class CdrBuilder:
    """Writes one payload field by field and aligns it. For the slow topics and for constant parts."""

    def __init__(self) -> None:
        self._data = bytearray()

    def align(self, size: int) -> CdrBuilder:
        """Fill up with zeros to a multiple of `size`."""
        self._data += bytes(-len(self._data) % size)
        return self

    def put(self, code: str, *values: float) -> CdrBuilder:
        """Return numbers of one `struct` code, aligned to their size."""
        self.align(struct.calcsize("<" + code))
        self._data += struct.pack(f"<{len(values)}{code}", *values)
        return self

    def text(self, value: str) -> CdrBuilder:
        """Return one string."""
        self.align(4)
        self._data += _text(value)
        return self

    def stamp(self, time_ns: int) -> CdrBuilder:
        """builtin_interfaces/Time."""
        seconds, nanoseconds = divmod(time_ns, _NS)
        return self.put("I", seconds & _MASK, nanoseconds)

    def body(self) -> bytes:
        """Return the fields without the encapsulation header."""
        return bytes(self._data)

    def payload(self) -> bytes:
        """Return the whole message."""
        return CDR_HEADER + bytes(self._data)


# ---- the three messages of every cycle ----

_RECORD_HEAD = struct.Struct("<BQHIQQ")
"""MCAP Message record: opcode 05h, length of the rest, channel, sequence, log time, publish time [ns]."""
_START = struct.Struct("<BQH")
_OPCODE_MESSAGE = 0x05
_RECORD_REST = 22
"""Bytes of a Message record between its length field and the payload."""

_INDEX_AND_MONOTONIC = slice(0, 16)
_TIMING_AND_COUNTERS = slice(24, cycle.HEADER.size)
_JOINT_1_BLOCK = slice(cycle.HEADER.size, cycle.HEADER.size + cycle.JOINT.size)
_JOINT_2_BLOCK = slice(cycle.HEADER.size + cycle.JOINT.size, cycle.FRAMES_OFFSET)

_JOINT_CODE = f"4sII16s16s{cycle.JOINT.size}sBB"
"""header.stamp, frame_id with its padding, cycle, sync_monotonic_ns, all of JointRecord, counter, flags."""
_FRAMES_CODE = (
    f"4sII8s16s{cycle.HEADER.size - 24}s{16 * cycle.FRAME_CAPACITY}s{8 * cycle.FRAME_CAPACITY}s"
    # `s` fills up with zeros what a cycle with fewer frames leaves empty.
)
JOINT_ESTIMATE_SIZE = struct.calcsize("<" + _JOINT_CODE)
CAN_FRAMES_SIZE = struct.calcsize("<" + _FRAMES_CODE)

_BLOCK = struct.Struct("<" + 2 * ("11sIqq" + _JOINT_CODE) + "11sIqq" + _FRAMES_CODE)
BLOCK_SIZE = _BLOCK.size
BLOCK_PARTS = (
    (schemas.JOINT_1.number, 0),
    (schemas.JOINT_2.number, _RECORD_HEAD.size + JOINT_ESTIMATE_SIZE),
    (schemas.CAN_FRAMES.number, 2 * (_RECORD_HEAD.size + JOINT_ESTIMATE_SIZE)),
)
"""Channel and start of each of the three MCAP Message records within the bytes of `cycle_block`."""


def _start_of(topic: schemas.Topic, size: int) -> bytes:
    return _START.pack(_OPCODE_MESSAGE, _RECORD_REST + size, topic.number)


_START_1 = _start_of(schemas.JOINT_1, JOINT_ESTIMATE_SIZE)
_START_2 = _start_of(schemas.JOINT_2, JOINT_ESTIMATE_SIZE)
_START_FRAMES = _start_of(schemas.CAN_FRAMES, CAN_FRAMES_SIZE)
_FRAME_ID_1 = _text("joint_1") + bytes(4)
_FRAME_ID_2 = _text("joint_2") + bytes(4)
_FRAME_ID_CAN = _text("can")


def cycle_block(
    record: bytes, index: int, realtime_ns: int, *, flags: int, sync_counter: int, frames: int
) -> bytes:
    """Both joint messages and the frames message of one cycle: three MCAP Message records in a row.

    Args:
        record: the cycle record, `cycle_record.RECORD_SIZE` bytes.
        index, realtime_ns, flags, sync_counter, frames: of its header, which the caller has read already.
    """
    seconds, nanoseconds = divmod(realtime_ns, _NS)
    seconds &= _MASK
    sequence = index & _MASK
    flags &= 0xFF
    head = record[_INDEX_AND_MONOTONIC]
    return _BLOCK.pack(
        # joint 1
        _START_1,
        sequence,
        realtime_ns,
        realtime_ns,
        CDR_HEADER,
        seconds,
        nanoseconds,
        _FRAME_ID_1,
        head,
        record[_JOINT_1_BLOCK],
        sync_counter,
        flags,
        # joint 2
        _START_2,
        sequence,
        realtime_ns,
        realtime_ns,
        CDR_HEADER,
        seconds,
        nanoseconds,
        _FRAME_ID_2,
        head,
        record[_JOINT_2_BLOCK],
        sync_counter,
        flags,
        # frames
        _START_FRAMES,
        sequence,
        realtime_ns,
        realtime_ns,
        CDR_HEADER,
        seconds,
        nanoseconds,
        _FRAME_ID_CAN,
        head,
        record[_TIMING_AND_COUNTERS],
        record[cycle.FRAMES_OFFSET : cycle.FRAMES_OFFSET + 16 * frames],
        record[cycle.STAMPS_OFFSET : cycle.STAMPS_OFFSET + 8 * frames],
    )


# ---- the slow topics ----


class JointStateMessage:
    """sensor_msgs/msg/JointState of the two joints.

    Args:
        names: of joint 1 and 2.
        gear_ratios: motor revolutions per joint revolution; None: velocity is NaN.
    """

    def __init__(self, names: Sequence[str], gear_ratios: Sequence[float | None]) -> None:
        constant = CdrBuilder().put("I", 0, 0).text("").put("I", len(names))
        for name in names:
            constant.text(name)
        # position's length must end at a multiple of 8, where its first float64 begins
        self._constant = constant.align(4).body()[8:]
        padding = -(8 + len(self._constant) + 4) % 8
        self._pack = struct.Struct(f"<4sII{len(self._constant)}sI{padding}x2dI4x2dI4x2d").pack
        self._per_gear = [1.0 / ratio if ratio else math.nan for ratio in gear_ratios]

    def payload(self, record: bytes, realtime_ns: int) -> bytes:
        """Message from one cycle record."""
        one, two = cycle.joint_of(record, 1), cycle.joint_of(record, 2)
        seconds, nanoseconds = divmod(realtime_ns, _NS)
        return self._pack(
            CDR_HEADER,
            seconds & _MASK,
            nanoseconds,
            self._constant,
            2,
            one.link_position_rad,
            two.link_position_rad,
            2,
            one.motor_velocity_rad_s * self._per_gear[0],
            two.motor_velocity_rad_s * self._per_gear[1],
            2,
            one.torque_nm,
            two.torque_nm,
        )


def event(
    time_ns: int,
    kind: int,
    text: str,
    *,
    index: int = 0,
    count: int = 0,
    joint: int = 0,
    change: tuple[int, int] = (0, 0),
) -> bytes:
    """jtqd_msgs/msg/Event. `change` is (before, after) of a status."""
    builder = (
        CdrBuilder()
        .stamp(time_ns)
        .text("jtqd")
        .put("Q", index, count)
        .put("H", *change)
        .put("B", kind, joint)
    )
    return builder.text(fit(text, EVENT_TEXT_LENGTH)).payload()


def log(time_ns: int, level: int, text: str) -> bytes:
    """rcl_interfaces/msg/Log; `level` 20 information, 30 warning, 40 error."""
    builder = CdrBuilder().stamp(time_ns).put("B", level).text("jtqd").text(fit(text, LOG_TEXT_LENGTH))
    return builder.text("").text("").put("I", 0).payload()


class Status(NamedTuple):
    """One diagnostic_msgs/DiagnosticStatus; `level` 0 good, 1 warning, 2 error, 3 stale."""

    name: str
    hardware_id: str
    level: int
    text: str
    values: Mapping[str, float | str]


def diagnostics(time_ns: int, statuses: Sequence[Status]) -> bytes:
    """diagnostic_msgs/msg/DiagnosticArray; of one size as long as names, hardware and keys stay the same."""
    builder = CdrBuilder().stamp(time_ns).text("").put("I", len(statuses))
    for status in statuses:
        builder.put("B", status.level).text(status.name).text(fit(status.text, _DIAGNOSTIC_TEXT_LENGTH))
        builder.text(status.hardware_id).put("I", len(status.values))
        for key, value in status.values.items():
            shown = f"{value:.6g}" if isinstance(value, float) else str(value)
            builder.text(key).text(fit(shown, _DIAGNOSTIC_VALUE_LENGTH))
    return builder.payload()
