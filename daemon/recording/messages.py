"""Topics of the recorded MCAP files: definitions (ros2msg, with every nested one) and the CDR bytes of every message. Pure.

Names, fields and units are what Foxglove, PlotJuggler, Rerun, rosbags and `ros2 bag` show.

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
from collections.abc import Callable, Iterator, Mapping, Sequence
from enum import IntEnum
from itertools import accumulate
from typing import NamedTuple

from mcap.records import Channel, Schema

from jtqd.daemon.shared import cycle_record as cycle
from jtqd.daemon.shared.cycle_record import MOST_JOINTS, PAIR, SHADOW_FIELDS, layout_of
from jtqd.daemon.shared.snapshot import PAST_WORDS, View
from jtqd.estimator.status import NAMES, PAST_LAYOUT, STANDSTILL, STARTING, VALID, Zeros
from jtqd.estimator.text import counted

# ---- definitions and topics ----

STATUS_NAMES = {code: name.upper() for code, name in NAMES.items()}
"""Status codes of the estimate PDO; the same names are constants of the JointEstimate definition."""


class EventKind(IntEnum):
    """Kinds of events; the names are constants of the Event definition."""

    RECORDER_STARTED = 1
    RECORDER_STOPPED = 2
    RECORDS_LOST = 3
    STATUS_CHANGED = 4
    SLOTS_MISSED = 5
    WRITE_FAILED = 6
    SPACE_LOW = 7
    FILE_RETIRED = 8
    FILE_REMOVED = 9
    FILE_REPAIRED = 10
    FLIGHT_SAVED = 11
    NOTICE = 12


_TIME = "int32 sec\nuint32 nanosec\n"
_HEADER = "builtin_interfaces/Time stamp\nstring frame_id\n"

_STATUS_CONSTANTS = "".join(f"uint16 {name}={code}\n" for code, name in STATUS_NAMES.items())
_EVENT_CONSTANTS = "".join(f"uint8 {kind.name}={kind}\n" for kind in EventKind)

_JOINT_ESTIMATE = f"""\
# One joint in one cycle: the inputs in SI units and every stage of the torque estimate.
# Torques act on the joint side of the gear, positive along the joint's own positive current.
# NaN: the input did not come in this cycle, or the stage was not computed.

# Bits of `input_flags`: the input is of this cycle
uint16 INPUT_TPDO1=1
uint16 INPUT_TPDO2=2
uint16 INPUT_SENSOR=4
uint16 INPUT_TEMPERATURE=8  # not of this cycle: it was told at most 2 s ago
uint16 NETWORK_SKIPPED=16  # no time for the network
uint16 FAULT_LATCHED=32
uint16 CONTACT_KNOWN=64  # contacts are watched, and known in this cycle
uint16 CONTACT=128
# ... and why there is no torque: faults of this cycle, of one not long ago, or latched
uint16 FAULT_NOT_FINITE=256
uint16 FAULT_OUT_OF_RANGE=512
uint16 FAULT_MOTOR_JUMP=1024
uint16 FAULT_LINK_JUMP=2048
uint16 FAULT_VELOCITY_MISMATCH=4096
uint16 FAULT_TORSION=8192
uint16 FAULT_CURRENT_FROZEN=16384
uint16 FAULT_DEVIATION=32768

# Bits of `cycle_flags`
uint8 COMPLETE=1           # every expected input came before its deadline
uint8 PUBLISHED=2          # the estimate PDO was handed to the socket
uint8 BEFORE_NEXT_SYNC=4   # ... before the next SYNC was due
uint8 SYNC_CONFIRMED=8     # header.stamp is the send time of the SYNC on the wire, not the time of the call
uint8 WITHDRAWN=16         # the estimate was not ready before the next SYNC
uint8 LATCHES_RESET=32     # latched faults were reset before this cycle
uint8 UNCHECKED=64         # as a guest: status at most degraded, as nobody has checked the drive's identity
uint8 FIRST_CYCLES=128     # as a guest: one of the first cycles with SYNC

std_msgs/Header header          # send time of the cycle's SYNC, CLOCK_REALTIME
uint64 cycle                    # cycles since the start, missed slots included
int64 sync_monotonic_ns         # [ns] send time of the SYNC, CLOCK_MONOTONIC
float64 current_a               # [A] motor current
float64 motor_position_rad      # [rad] motor side of the gear
float64 motor_velocity_rad_s    # [rad/s] motor side of the gear
float64 link_position_rad       # [rad] joint side of the gear
float64 sensor_torque_nm        # [Nm] torque sensor (reference)
float64 temperature_c           # [degC] joint temperature that the estimator was given; NaN where it is not known
float64 torque_nm               # [Nm] the estimate that was published
float64 sigma_nm                # [Nm] its standard deviation; half the interval at standstill
float64 tob_nm                  # [Nm] stage: classical observer
float64 physics_nm              # [Nm] stage: physics: observer with losses, before any network
float64 network_nm              # [Nm] stage: network
float64 dt_s                    # [s] time step that the observer used
float64 reference_nm            # [Nm] the torque sensor through the estimator's filter: as old as torque_nm
float64 age_ms                  # [ms] age of torque_nm: group delay of the estimator's filter at low frequency
float64 torque_rate_nm_s        # [Nm/s] of the torsion
float64 contact_nm              # [Nm] torque from outside on the link that neither motion nor slow changes explain
uint16 statusword               # 6041h of the drive
# Values of `status`: viewers give a field the names of the constants that stand right before it
{_STATUS_CONSTANTS}uint16 status
uint16 sensor_status            # 6150h of the sensor
uint16 input_flags              # see the constants
uint8 sync_counter              # 1..240, the sequence of the estimate PDO
uint8 cycle_flags               # see the constants
"""

_CAN_FRAMES = """\
# The frames of one cycle in order of arrival, and the cycle's timing.
# Only the first `frame_count` entries of `frames` and `stamps_ns` are meant; the others are zero.

std_msgs/Header header          # send time of the cycle's SYNC, CLOCK_REALTIME
uint64 cycle                    # cycles since the start, missed slots included
int64 sync_monotonic_ns         # [ns] send time of the SYNC, CLOCK_MONOTONIC
uint32 flags                    # bits: see jtqd_msgs/JointEstimate, cycle_flags
uint32 work_ns                  # [ns] from the wake-up for the inputs to the end of the cycle's work
int32 late_ns                   # [ns] send time of the SYNC minus its slot on the grid
uint32 missed                   # slots missed so far
uint8 sync_counter              # 1..240
uint8 frame_count               # frames stored here
uint8 frames_left_out           # frames of this cycle that did not fit; 255: that many or more
uint8 stale_inputs
uint8 late_frames
uint8 duplicate_frames
uint8 rejected_frames           # our identifiers with a wrong length, or 29-bit or remote frames
uint8 reserved
jtqd_msgs/CanFrame[%(capacity)d] frames
int64[%(capacity)d] stamps_ns             # [ns] receive time of each frame by the kernel, CLOCK_REALTIME
"""

_CAN_FRAME = """\
# struct can_frame of Linux
uint32 id                       # with 0x80000000: 29-bit, 0x40000000: remote, 0x20000000: error frame
uint8 length                    # [byte] 0..8
uint8[3] reserved
uint8[8] data
"""

_JOINT_STATE = """\
# Overview at 50 Hz.
std_msgs/Header header
string[] name
float64[] position              # [rad] link position
float64[] velocity              # [rad/s] motor velocity / gear ratio; NaN where the gear ratio is not known
float64[] effort                # [Nm] estimated torque
"""

_DIAGNOSTIC_STATUS = """\
byte OK=0
byte WARN=1
byte ERROR=2
byte STALE=3
byte level
string name
string message
string hardware_id
diagnostic_msgs/KeyValue[] values
"""

_EVENT = f"""\
# What happened, once per occurrence.

std_msgs/Header header
uint64 cycle                    # cycle in which it was seen
uint64 count                    # cycles: RECORDS_LOST, WRITE_FAILED, FILE_REMOVED; SLOTS_MISSED: slots; NOTICE: node
uint16 before                   # STATUS_CHANGED: status before
uint16 after                    # STATUS_CHANGED: status after
# Values of `kind`
{_EVENT_CONSTANTS}uint8 kind
uint8 joint                     # %(numbers)s; 0: none in particular
string text
"""

_LOG = """\
byte DEBUG=10
byte INFO=20
byte WARN=30
byte ERROR=40
byte FATAL=50
builtin_interfaces/Time stamp
uint8 level
string name
string msg
string file
string function
uint32 line
"""


_ZEROS = f"""\
# What the estimator of one joint has learned of its encoder's and its current's zero, and its whole state: once a second.
# `past` is the state just after `cycle`: a replay of a log that begins in the middle of a run goes on from there.

# Bits of `flags`
uint32 TRACKED=1            # the zeros are tracked
uint32 LEARNED=2            # the link zero is known better than friction of the day alone would let it be
uint32 BEYOND=4             # the link zero is beyond limit_rad
uint32 LEFT=8               # what is known of it is not yet taken off
uint32 APART=16             # current and torsion disagree beyond their sigmas

std_msgs/Header header          # send time of the cycle's SYNC, CLOCK_REALTIME
uint64 cycle                    # cycles since the start, missed slots included
float64 link_rad                # [rad] what the link encoder's reading is off by
float64 link_sigma_rad          # [rad] its standard deviation
float64 link_used_rad           # [rad] what is taken off the reading
float64 current_a               # [A] the same of the current
float64 current_sigma_a         # [A]
float64 current_used_a          # [A]
float64 limit_rad               # [rad] of a plausible link zero, by the joint file
uint64 jumps                    # how often the link zero has jumped
uint32 flags                    # see the constants
uint16 past_layout              # number of the layout of `past`
uint16 past_bytes               # of `past` that are meant; the others are zero
uint64[{PAST_WORDS}] past               # state of the estimator, as it lies in memory
"""


_SHADOW_MEANINGS = {
    "torque_nm": "[Nm] estimate of this method; NaN where it has none",
    "sigma_nm": "[Nm] its standard deviation",
    "reference_nm": "[Nm] the torque sensor as old as this estimate",
    "age_ms": "[ms] age of this estimate; NaN: the method is not computed",
    "status": "of this estimator, before the checks of the loop",
}
_SHADOW = """\
# Shadow methods of one joint in one cycle: estimates from the same inputs that are compared and never sent.
# tob: observer less friction; efficiency: observer with efficiency lookup; network: the paper's chain, efficiency and
# network; fused: current path and torsion of the gear.

std_msgs/Header header          # send time of the cycle's SYNC, CLOCK_REALTIME
uint64 cycle                    # cycles since the start, missed slots included
int64 sync_monotonic_ns         # [ns] send time of the SYNC, CLOCK_MONOTONIC
""" + "".join(
    f"{'uint16' if name.endswith('_status') else 'float64'} {name}".ljust(34)
    + f"# {_SHADOW_MEANINGS[name.partition('_')[2]]}\n"
    for name in SHADOW_FIELDS
)


def complete(text: str, *nested: tuple[str, str]) -> str:
    """Return a definition followed by those it uses, in the notation of `rosidl`."""
    return text + "".join(f"{'=' * 80}\nMSG: {name}\n{body}" for name, body in nested)


ZEROS_SCHEMA = "jtqd_msgs/msg/Zeros"
SHADOW_SCHEMA = "jtqd_msgs/msg/ShadowEstimate"
NESTED_HEADER = (("std_msgs/Header", _HEADER), ("builtin_interfaces/Time", _TIME))


def schemas_of(joints: int, *, shadow: bool = False) -> dict[str, str]:
    """Return the definitions in the log of a bus with so many joints, by name; shadow: there are shadow methods."""
    capacity = layout_of(joints).frame_capacity
    frames = _CAN_FRAMES % {"capacity": capacity}
    event = _EVENT % {"numbers": "1 or 2" if joints == 2 else "from 1 on"}
    return {
        "jtqd_msgs/msg/JointEstimate": complete(_JOINT_ESTIMATE, *NESTED_HEADER),
        frames_name(joints): complete(frames, *NESTED_HEADER, ("jtqd_msgs/CanFrame", _CAN_FRAME)),
        "sensor_msgs/msg/JointState": complete(_JOINT_STATE, *NESTED_HEADER),
        "diagnostic_msgs/msg/DiagnosticArray": complete(
            "std_msgs/Header header\ndiagnostic_msgs/DiagnosticStatus[] status\n",
            *NESTED_HEADER,
            ("diagnostic_msgs/DiagnosticStatus", _DIAGNOSTIC_STATUS),
            ("diagnostic_msgs/KeyValue", "string key\nstring value\n"),
        ),
        "jtqd_msgs/msg/Event": complete(event, *NESTED_HEADER),
        "rcl_interfaces/msg/Log": complete(_LOG, ("builtin_interfaces/Time", _TIME)),
        ZEROS_SCHEMA: complete(_ZEROS, *NESTED_HEADER),
        **({SHADOW_SCHEMA: complete(_SHADOW, *NESTED_HEADER)} if shadow else {}),
    }


def frames_name(joints: int) -> str:
    """Name of the definition of /can/frames: one with more frames is another type."""
    capacity = layout_of(joints).frame_capacity
    return "jtqd_msgs/msg/CanFrames" + ("" if capacity == PAIR.frame_capacity else str(capacity))


FRAMES_NAMES = (frames_name(2), frames_name(MOST_JOINTS))
"""Definitions of /can/frames: up to two joints, and more."""
SCHEMAS = schemas_of(2)


class Topic(NamedTuple):
    """One channel of the file. `number` is its channel identifier, the same in every file."""

    number: int
    name: str
    schema: str


JOINTS = tuple(
    Topic(number, f"/joint/{joint}/state", "jtqd_msgs/msg/JointEstimate")
    for joint, number in ((1, 1), (2, 2), (3, 8), (4, 9))
)
"""Of the joints that a bus may have."""
CAN_FRAMES = Topic(3, "/can/frames", frames_name(2))
JOINT_STATES = Topic(4, "/joint_states", "sensor_msgs/msg/JointState")
DIAGNOSTICS = Topic(5, "/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
EVENTS = Topic(6, "/events", "jtqd_msgs/msg/Event")
LOG = Topic(7, "/log", "rcl_interfaces/msg/Log")
ZEROS = tuple(Topic(9 + joint, f"/joint/{joint}/zeros", ZEROS_SCHEMA) for joint in range(1, MOST_JOINTS + 1))
"""Of the joints that a bus may have; without a message where nothing is tracked."""


SHADOWS = tuple(
    Topic(13 + joint, f"/joint/{joint}/shadow", SHADOW_SCHEMA) for joint in range(1, MOST_JOINTS + 1)
)
"""Of the joints that a bus may have, where there are shadow methods."""


def topics_of(joints: int, *, shadow: bool = False) -> tuple[Topic, ...]:
    """Return all topics in the log of a bus with so many joints; shadow: there are shadow methods."""
    frames = CAN_FRAMES._replace(schema=frames_name(joints))
    slow = JOINT_STATES, DIAGNOSTICS, EVENTS, LOG, *ZEROS[:joints]
    return *JOINTS[:joints], frames, *slow, *SHADOWS[: joints * shadow]


TOPICS = topics_of(2)


def definitions(joints: int = 2, *, shadow: bool = False) -> tuple[list[Schema], list[Channel]]:
    """Return the schema and channel records of every topic of a bus."""
    texts = schemas_of(joints, shadow=shadow)
    return records_of({each: texts[each.schema] for each in topics_of(joints, shadow=shadow)})


def records_of(texts: Mapping[Topic, str]) -> tuple[list[Schema], list[Channel]]:
    """Return the schema and channel records of topics with their definitions."""
    names = {each.schema: text.encode() for each, text in texts.items()}
    numbers = {name: number for number, name in enumerate(names, start=1)}
    schemas = [Schema(numbers[name], data, "ros2msg", name) for name, data in names.items()]
    return schemas, [Channel(each.number, each.name, "cdr", {}, numbers[each.schema]) for each in texts]


# ---- CDR ----

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
_SHADOW_CODE = f"4sII16s16s{cycle.SHADOW.size}s"
SHADOW_ESTIMATE_SIZE = struct.calcsize("<" + _SHADOW_CODE)
_FRAME_ID_CAN = _text("can")


def _start_of(topic: Topic, size: int) -> bytes:
    return _START.pack(_OPCODE_MESSAGE, _RECORD_REST + size, topic.number)


class CycleMessages:
    """The messages of every cycle: one or two of each joint, and the frames; as MCAP Message records in a row.

    joints: number of them; shadow: there are shadow methods.

    Attributes:
        parts: channel and start of each Message record within the bytes of `block`.
    """

    def __init__(self, joints: int, *, shadow: bool = False) -> None:
        layout = cycle.layout_of(joints, shadow)
        capacity = self._capacity = layout.frame_capacity
        self._frames, self._stamps = layout.frames_offset, layout.stamps_offset
        # `s` fills up with zeros what a cycle with fewer frames leaves empty.
        frames_code = f"4sII8s16s{cycle.HEADER.size - 24}s{16 * capacity}s{8 * capacity}s"
        self.frames_size = struct.calcsize("<" + frames_code)
        shadows = SHADOWS[: joints * shadow]
        codes = joints * [_JOINT_CODE] + len(shadows) * [_SHADOW_CODE] + [frames_code]
        self._pack = struct.Struct("<" + "".join("11sIqq" + code for code in codes)).pack
        topics = JOINTS[:joints]
        sizes = [_RECORD_HEAD.size + struct.calcsize("<" + code) for code in codes]
        starts = accumulate(sizes[:-1], initial=0)
        every = (*topics, *shadows, CAN_FRAMES)
        self.parts = tuple((topic.number, start) for topic, start in zip(every, starts, strict=True))

        def blocks(
            topics: Sequence[Topic], size: int, first: int, step: int
        ) -> list[tuple[bytes, bytes, slice]]:
            return [
                (_start_of(topic, size), _text(f"joint_{n + 1}") + bytes(4), slice(at, at + step))
                for n, topic in enumerate(topics)
                for at in (first + n * step,)
            ]

        self._joints = blocks(topics, JOINT_ESTIMATE_SIZE, cycle.HEADER.size, cycle.JOINT.size)
        self._shadows = blocks(shadows, SHADOW_ESTIMATE_SIZE, layout.shadow_offset, cycle.SHADOW.size)
        self._start_frames = _start_of(CAN_FRAMES, self.frames_size)

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
        head, common = record[_INDEX_AND_MONOTONIC], flags & 0xFF & ~cycle.FLAG_UNCHECKED
        values: list[bytes | int] = []
        for n, (start, frame_id, joint) in enumerate(self._joints, 2):
            own = common | flags >> n & cycle.FLAG_UNCHECKED
            values += (start, *stamp, frame_id, head, record[joint], sync_counter, own)
        for start, frame_id, block in self._shadows:
            values += (start, *stamp, frame_id, head, record[block])
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


def zeros_of(view: View) -> Iterator[tuple[Topic, bytes]]:
    """Yield topic and message of each joint that tracks its zeros, from one reading of the snapshot."""
    for number, (seen, past) in enumerate(zip(view.zeros, view.pasts, strict=True), start=1):
        if seen.tracked:
            yield ZEROS[number - 1], zeros(view.sync_realtime_ns, number, view.cycle, seen, past)


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


# ---- events ----

INFO, WARN, ERROR = 20, 30, 40
_PER_SPAN = 50
"""A status that flaps every cycle must not fill the disk; what is left out is counted."""
_BOUNDED = (EventKind.STATUS_CHANGED, EventKind.SLOTS_MISSED, EventKind.NOTICE)
_GOOD = (STARTING, VALID, STANDSTILL)
"""Statuses that a healthy joint goes through."""


class EventLog:
    """Makes a message on /events and one on /log of every occurrence.

    Args:
        add: takes channel, log time [ns] and payload of each message.
        warn: takes one line for the operator.

    Attributes:
        newest: index and CLOCK_REALTIME [ns] of the newest cycle.
        left_out: events beyond the number that a span may hold.
    """

    def __init__(self, add: Callable[[int, int, bytes], None], warn: Callable[[str], None] = print) -> None:
        self._add = add
        self.warn = warn
        self.newest = (0, 0)
        self.left_out = 0
        self._in_span = 0
        self.forget()

    def forget(self) -> None:
        """Take the next cycle as the first one: its status and missed slots are no change."""
        self._statuses: tuple[int, ...] | None = None
        self._missed: int | None = None

    def new_span(self) -> None:
        """Reset the number of events for a new span."""
        self._in_span = 0

    def note(
        self,
        kind: int,
        text: str,
        *,
        level: int,
        time_ns: int | None = None,
        count: int = 0,
        joint: int = 0,
        change: tuple[int, int] = (0, 0),
    ) -> None:
        """Write an event, and its text to /log; the time is the newest cycle's unless one is given."""
        self._in_span += 1
        if self._in_span > _PER_SPAN and kind in _BOUNDED:
            self.left_out += 1
            return
        index, newest = self.newest
        when = newest if time_ns is None else time_ns
        payload = event(when, kind, text, index=index, count=count, joint=joint, change=change)
        self._add(EVENTS.number, when, payload)
        self._add(LOG.number, when, log(when, level, text))

    def report(self, kind: int, text: str, *, level: int, count: int = 0) -> None:
        """Note an event and report its text to the operator."""
        self.warn(text)
        self.note(kind, text, level=level, count=count)

    def cycle(self, statuses: tuple[int, ...], missed: int) -> bool:
        """Note what differs from the cycle before; returns whether a status does."""
        before, self._statuses = self._statuses, statuses
        if statuses != before:
            for joint, (old, new) in enumerate(zip(before or statuses, statuses, strict=True), start=1):
                if old != new:
                    names = [STATUS_NAMES.get(code, str(code)) for code in (old, new)]
                    text = f"joint {joint}: {names[0]} -> {names[1]}"
                    level = INFO if new in _GOOD else WARN
                    self.note(EventKind.STATUS_CHANGED, text, level=level, joint=joint, change=(old, new))
        if missed != self._missed:
            slots = 0 if self._missed is None else missed - self._missed
            self._missed = missed
            if slots > 0:
                text = f"the loop missed {counted(slots, 'slot')}"
                self.note(EventKind.SLOTS_MISSED, text, level=WARN, count=slots)
        return statuses != before


SCANNED = (
    ("cycle", "sync_monotonic_ns", "sync_realtime_ns", "flags", "missed", "sync_counter", "frame_count"),
    ("status",),
)
"""Fields of header and joints that are looked at in every record."""
