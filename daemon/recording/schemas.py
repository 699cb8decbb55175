"""Message definitions and topics of the recorded MCAP files: ros2msg texts with every nested definition.

Names, fields and units here are what Foxglove, PlotJuggler, Rerun, rosbags and `ros2 bag` show. The bytes
that follow these definitions are made in `jtqd.daemon.recording.messages`; the tests decode them by these texts alone.
"""

from __future__ import annotations

from typing import NamedTuple

from mcap.records import Channel, Schema

from jtqd.daemon.shared.cycle_record import MOST_JOINTS, PAIR, layout_of
from jtqd.daemon.shared.snapshot import PAST_WORDS
from jtqd.estimator.status import NAMES

STATUS_NAMES = {code: name.upper() for code, name in NAMES.items()}
"""Status codes of the estimate PDO; the same names are constants of the JointEstimate definition."""

EVENT_NAMES = dict(
    enumerate(
        (
            "RECORDER_STARTED",
            "RECORDER_STOPPED",
            "RECORDS_LOST",
            "STATUS_CHANGED",
            "SLOTS_MISSED",
            "WRITE_FAILED",
            "SPACE_LOW",
            "FILE_RETIRED",
            "FILE_REMOVED",
            "FILE_REPAIRED",
            "FLIGHT_SAVED",
            "NOTICE",
        ),
        start=1,
    )
)
"""Kinds of events; the same names are constants of the Event definition."""
RECORDER_STARTED, RECORDER_STOPPED, RECORDS_LOST, STATUS_CHANGED, SLOTS_MISSED, WRITE_FAILED = range(1, 7)
SPACE_LOW, FILE_RETIRED, FILE_REMOVED, FILE_REPAIRED, FLIGHT_SAVED, NOTICE = range(7, 13)

_TIME = "int32 sec\nuint32 nanosec\n"
_HEADER = "builtin_interfaces/Time stamp\nstring frame_id\n"

_STATUS_CONSTANTS = "".join(f"uint16 {name}={code}\n" for code, name in STATUS_NAMES.items())
_EVENT_CONSTANTS = "".join(f"uint8 {name}={code}\n" for code, name in EVENT_NAMES.items())

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


def _complete(text: str, *nested: tuple[str, str]) -> str:
    """Return a definition followed by those it uses, in the notation of `rosidl`."""
    return text + "".join(f"{'=' * 80}\nMSG: {name}\n{body}" for name, body in nested)


ZEROS_SCHEMA = "jtqd_msgs/msg/Zeros"
_NESTED_HEADER = (("std_msgs/Header", _HEADER), ("builtin_interfaces/Time", _TIME))


def schemas_of(joints: int) -> dict[str, str]:
    """Return the definitions in the log of a bus with so many joints, by name."""
    capacity = layout_of(joints).frame_capacity
    frames = _CAN_FRAMES % {"capacity": capacity}
    event = _EVENT % {"numbers": "1 or 2" if joints == 2 else "from 1 on"}
    return {
        "jtqd_msgs/msg/JointEstimate": _complete(_JOINT_ESTIMATE, *_NESTED_HEADER),
        frames_name(joints): _complete(frames, *_NESTED_HEADER, ("jtqd_msgs/CanFrame", _CAN_FRAME)),
        "sensor_msgs/msg/JointState": _complete(_JOINT_STATE, *_NESTED_HEADER),
        "diagnostic_msgs/msg/DiagnosticArray": _complete(
            "std_msgs/Header header\ndiagnostic_msgs/DiagnosticStatus[] status\n",
            *_NESTED_HEADER,
            ("diagnostic_msgs/DiagnosticStatus", _DIAGNOSTIC_STATUS),
            ("diagnostic_msgs/KeyValue", "string key\nstring value\n"),
        ),
        "jtqd_msgs/msg/Event": _complete(event, *_NESTED_HEADER),
        "rcl_interfaces/msg/Log": _complete(_LOG, ("builtin_interfaces/Time", _TIME)),
        ZEROS_SCHEMA: _complete(_ZEROS, *_NESTED_HEADER),
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
JOINT_1, JOINT_2 = JOINTS[:2]
CAN_FRAMES = Topic(3, "/can/frames", frames_name(2))
JOINT_STATES = Topic(4, "/joint_states", "sensor_msgs/msg/JointState")
DIAGNOSTICS = Topic(5, "/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
EVENTS = Topic(6, "/events", "jtqd_msgs/msg/Event")
LOG = Topic(7, "/log", "rcl_interfaces/msg/Log")
_OTHERS = (JOINT_STATES, DIAGNOSTICS, EVENTS, LOG)
ZEROS = tuple(Topic(9 + joint, f"/joint/{joint}/zeros", ZEROS_SCHEMA) for joint in range(1, MOST_JOINTS + 1))
"""Of the joints that a bus may have; without a message where nothing is tracked."""


def joint_topics(joints: int) -> tuple[Topic, ...]:
    """Return /joint/1/state, /joint/2/state, ... of a bus with so many joints."""
    return JOINTS[:joints]


def topics_of(joints: int) -> tuple[Topic, ...]:
    """Return all topics in the log of a bus with so many joints."""
    frames = CAN_FRAMES._replace(schema=frames_name(joints))
    return *joint_topics(joints), frames, *_OTHERS, *ZEROS[:joints]


TOPICS = topics_of(2)


def definitions(joints: int = 2) -> tuple[list[Schema], list[Channel]]:
    """Return the schema and channel records of every topic."""
    texts = schemas_of(joints)
    numbers = {name: number for number, name in enumerate(texts, start=1)}
    records = [Schema(numbers[name], text.encode(), "ros2msg", name) for name, text in texts.items()]
    return records, [
        Channel(topic.number, topic.name, "cdr", {}, numbers[topic.schema]) for topic in topics_of(joints)
    ]
