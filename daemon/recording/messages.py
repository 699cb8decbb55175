"""CDR bytes of every recorded message, by the definitions of `jtqd.daemon.recording.schemas`. Pure.

A CDR payload is the encapsulation header 00 01 00 00 (plain CDR, little endian) followed by the fields, each
aligned to its own size counted from the first byte after that header (OMG DDSI-RTPS, section 10; DDS-XTypes,
section 7.4). Every topic's messages have one constant size: strings are filled up with spaces, so that a
reader may take a whole chunk as one array of records.

The messages of every cycle are made by one `struct` call. The definitions were laid out for that: whole
stretches of the cycle record go into the message as they lie in memory (see `jtqd.daemon.shared.cycle_record`).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

from jtqd.daemon.recording import schemas
from jtqd.daemon.shared import cycle_record as cycle
from jtqd.daemon.shared.snapshot import PAST_WORDS, View
from jtqd.estimator.status import PAST_LAYOUT, Zeros

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


# ---- the messages of every cycle ----

_RECORD_HEAD = struct.Struct("<BQHIQQ")
"""MCAP Message record: opcode 05h, length of the rest, channel, sequence, log time, publish time [ns]."""
_START = struct.Struct("<BQH")
_OPCODE_MESSAGE = 0x05
_RECORD_REST = 22
"""Bytes of a Message record between its length field and the payload."""

_INDEX_AND_MONOTONIC = slice(0, 16)
_TIMING_AND_COUNTERS = slice(24, cycle.HEADER.size)
_JOINT_CODE = f"4sII16s16s{cycle.JOINT.size}sBB"
"""header.stamp, frame_id with its padding, cycle, sync_monotonic_ns, all of JointRecord, counter, flags."""
JOINT_ESTIMATE_SIZE = struct.calcsize("<" + _JOINT_CODE)
_FRAME_ID_CAN = _text("can")


def _start_of(topic: schemas.Topic, size: int) -> bytes:
    return _START.pack(_OPCODE_MESSAGE, _RECORD_REST + size, topic.number)


class CycleMessages:
    """The messages of every cycle: one of each joint, and the frames; as MCAP Message records in a row.

    joints: number of them.

    Attributes:
        parts: channel and start of each Message record within the bytes of `block`.
    """

    def __init__(self, joints: int) -> None:
        layout = cycle.layout_of(joints)
        capacity = self._capacity = layout.frame_capacity
        self._frames, self._stamps = layout.frames_offset, layout.stamps_offset
        # `s` fills up with zeros what a cycle with fewer frames leaves empty.
        frames_code = f"4sII8s16s{cycle.HEADER.size - 24}s{16 * capacity}s{8 * capacity}s"
        self.frames_size = struct.calcsize("<" + frames_code)
        packed = struct.Struct("<" + joints * ("11sIqq" + _JOINT_CODE) + "11sIqq" + frames_code)
        self._pack = packed.pack
        topics = schemas.joint_topics(joints)
        step = _RECORD_HEAD.size + JOINT_ESTIMATE_SIZE
        self.parts = tuple((topic.number, n * step) for n, topic in enumerate((*topics, schemas.CAN_FRAMES)))
        self._joints = [
            (
                _start_of(topic, JOINT_ESTIMATE_SIZE),
                _text(f"joint_{n + 1}") + bytes(4),
                slice(
                    cycle.HEADER.size + n * cycle.JOINT.size, cycle.HEADER.size + (n + 1) * cycle.JOINT.size
                ),
            )
            for n, topic in enumerate(topics)
        ]
        self._start_frames = _start_of(schemas.CAN_FRAMES, self.frames_size)

    def block(
        self, record: bytes, index: int, realtime_ns: int, *, flags: int, sync_counter: int, frames: int
    ) -> bytes:
        """Joint messages and frames message of one cycle: MCAP Message records in a row.

        Args:
            record: the cycle record.
            index, realtime_ns, flags, sync_counter, frames: of its header, which the caller has read already; more frames
                than there is room for are left out.
        """
        seconds, nanoseconds = divmod(realtime_ns, _NS)
        frames = min(frames, self._capacity)
        stamp = (index & _MASK, realtime_ns, realtime_ns, CDR_HEADER, seconds & _MASK, nanoseconds)
        head, end = record[_INDEX_AND_MONOTONIC], (sync_counter, flags & 0xFF)
        values: list[bytes | int] = []
        for start, frame_id, joint in self._joints:
            values += (start, *stamp, frame_id, head, record[joint], *end)
        return self._pack(
            *values,
            self._start_frames,
            *stamp,
            _FRAME_ID_CAN,
            head,
            record[_TIMING_AND_COUNTERS],
            record[self._frames : self._frames + 16 * frames],
            record[self._stamps : self._stamps + 8 * frames],
        )

    def payloads(self, block: bytes) -> Iterator[tuple[int, bytes]]:
        """Yield channel and payload of each message of a block."""
        ends = [start for _, start in self.parts[1:]] + [len(block)]
        for (channel, start), end in zip(self.parts, ends, strict=True):
            yield channel, block[start + _RECORD_HEAD.size : end]


# ---- the slow topics ----


class JointStateMessage:
    """sensor_msgs/msg/JointState of all joints.

    Args:
        names: of the joints, joint 1 first.
        gear_ratios: motor revolutions per joint revolution; None: velocity is NaN.
    """

    def __init__(self, names: Sequence[str], gear_ratios: Sequence[float | None]) -> None:
        constant = CdrBuilder().put("I", 0, 0).text("").put("I", len(names))
        for name in names:
            constant.text(name)
        # position's length must end at a multiple of 8, where its first float64 begins
        self._constant = constant.align(4).body()[8:]
        padding = -(8 + len(self._constant) + 4) % 8
        count = self.joints = len(names)
        layout = f"<4sII{len(self._constant)}sI{padding}x{count}dI4x{count}dI4x{count}d"
        self._pack = struct.Struct(layout).pack
        self._per_gear = [1.0 / ratio if ratio else math.nan for ratio in gear_ratios]

    def payload(self, record: bytes, realtime_ns: int) -> bytes:
        """Message from one cycle record."""
        count = self.joints
        joints = [cycle.joint_of(record, n) for n in range(1, count + 1)]
        seconds, nanoseconds = divmod(realtime_ns, _NS)
        return self._pack(
            CDR_HEADER,
            seconds & _MASK,
            nanoseconds,
            self._constant,
            count,
            *(joint.link_position_rad for joint in joints),
            count,
            *(
                joint.motor_velocity_rad_s * per_gear
                for joint, per_gear in zip(joints, self._per_gear, strict=True)
            ),
            count,
            *(joint.torque_nm for joint in joints),
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


def zeros(time_ns: int, joint: int, index: int, seen: Zeros, past: bytes) -> bytes:
    """jtqd_msgs/msg/Zeros of joint `joint`, from 1 on; index: of the cycle after which `past` is its estimator's state."""
    return (
        CdrBuilder()
        .stamp(time_ns)
        .text(f"joint_{joint}")
        .put("Q", index)
        .put("d", *seen[:7])
        .put("Q", seen.jumps)
        .put("I", seen.flags)
        .put("H", PAST_LAYOUT, len(past))
        .put("Q", *struct.unpack(f"<{PAST_WORDS}Q", past.ljust(8 * PAST_WORDS, b"\0")))
        .payload()
    )


def zeros_of(view: View) -> Iterator[tuple[schemas.Topic, bytes]]:
    """Yield topic and message of each joint that tracks its zeros, from one reading of the snapshot."""
    for number, (seen, past) in enumerate(zip(view.zeros, view.pasts, strict=True), start=1):
        if seen.tracked:
            yield schemas.ZEROS[number - 1], zeros(view.sync_realtime_ns, number, view.cycle, seen, past)


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
