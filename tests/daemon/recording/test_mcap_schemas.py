"""Every recorded message against its ros2msg text: an independent decoder must get back what went in."""

import math
import random
import struct

import pytest

from jtqd.daemon.recording import messages
from jtqd.daemon.shared import cycle_record as cr
from jtqd.daemon.shared import faults
from tests.daemon import ring_records as rr
from tests.daemon.recording.cdr_decoder import Definition

DEFINITIONS = {name: Definition(name, text) for name, text in messages.SCHEMAS.items()}
JOINT = DEFINITIONS["jtqd_msgs/msg/JointEstimate"]
FRAMES = DEFINITIONS["jtqd_msgs/msg/CanFrames"]
NOW = 1_700_000_000_123_456_789
HEAD = struct.Struct("<BQHIQQ")
CYCLES = messages.CycleMessages(2)


def random_record(seed):
    """A record with random content everywhere, and its header and joints as they were put in."""
    rng = random.Random(seed)
    count = rng.randrange(rr.FRAME_CAPACITY + 1)
    header = (
        rng.getrandbits(64),
        rng.getrandbits(62),
        NOW + rng.getrandbits(40),
        rng.getrandbits(32),
        rng.getrandbits(32),
        rng.getrandbits(32) - 2**31,
        rng.getrandbits(32),
        rng.getrandbits(8),
        count,
        *(rng.getrandbits(8) for _ in range(6)),
    )
    joints = [
        (*(rng.gauss(0, 100) for _ in range(16)), *(rng.getrandbits(16) for _ in range(4))) for _ in "12"
    ]
    record = bytearray(rng.randbytes(rr.RECORD_SIZE))  # what an earlier lap left behind counts as random
    cr.PAIR.head.pack_into(record, 0, *header, *joints[0], *joints[1])
    return bytes(record), cr.Header(*header), [cr.JointRecord(*joint) for joint in joints]


def block_of(record, header):
    return CYCLES.block(
        record,
        header.cycle,
        header.sync_realtime_ns,
        flags=header.flags,
        sync_counter=header.sync_counter,
        frames=header.frame_count,
    )


def split(block):
    """The three MCAP Message records: (channel, sequence, log time, publish time, payload)."""
    found, at = [], 0
    while at < len(block):
        opcode, length, *rest = HEAD.unpack_from(block, at)
        assert opcode == 0x05
        found.append((*rest, block[at + HEAD.size : at + 9 + length]))
        at += 9 + length
    return found


@pytest.mark.parametrize("seed", range(20))
def test_cycle_block_decodes_to_the_record(seed):
    print(f"seed {seed}")
    record, header, joints = random_record(seed)
    parts = split(block_of(record, header))
    assert [part[0] for part in parts] == [1, 2, 3]
    stamp = {"sec": header.sync_realtime_ns // 10**9, "nanosec": header.sync_realtime_ns % 10**9}
    for part in parts:
        assert part[1] == header.cycle & 0xFFFF_FFFF
        assert part[2] == part[3] == header.sync_realtime_ns
    for number in (1, 2):
        message = JOINT.decode(parts[number - 1][4])
        assert message.pop("header") == {"stamp": stamp, "frame_id": f"joint_{number}"}
        assert message.pop("cycle") == header.cycle
        assert message.pop("sync_monotonic_ns") == header.sync_monotonic_ns
        assert message.pop("sync_counter") == header.sync_counter
        assert message.pop("cycle_flags") == header.flags & 0xBF | (header.flags >> 7 + number & 1) << 6
        assert message == joints[number - 1]._asdict()
    message = FRAMES.decode(parts[2][4])
    assert message["header"] == {"stamp": stamp, "frame_id": "can"}
    for name in header._fields[3:-1]:
        assert message[name] == getattr(header, name), name
    assert (message["cycle"], message["sync_monotonic_ns"]) == header[:2]
    expected = rr.frames_of(record)
    for n in range(rr.FRAME_CAPACITY):
        frame = message["frames"][n]
        raw = struct.pack(
            "<IB3s8s", frame["id"], frame["length"], bytes(frame["reserved"]), bytes(frame["data"])
        )
        assert (raw, message["stamps_ns"][n]) == (expected[n] if n < len(expected) else (bytes(16), 0))


def test_sizes_are_constant_and_as_stated():
    sizes = {tuple(len(part[4]) for part in split(block_of(*random_record(seed)[:2]))) for seed in range(20)}
    assert sizes == {(182, 182, 444)}
    assert (messages.JOINT_ESTIMATE_SIZE, CYCLES.frames_size) == (182, 444)
    assert CYCLES.parts == ((1, 0), (2, 213), (3, 426))


def test_joint_message_literally():
    """The first bytes by hand, so that encoder and decoder cannot be wrong together."""
    record, _, _ = random_record(1)
    record = bytes.fromhex("0807060504030201 1100000000000000") + record[16:]
    block = CYCLES.block(record, 1, 3_000_000_005, flags=0x10F, sync_counter=240, frames=0)
    payload = split(block)[0][4]
    assert payload[:28] == bytes.fromhex(
        "00010000"  # plain CDR, little endian
        "03000000 05000000"  # 3 s, 5 ns
        "08000000 6a6f696e745f3100"  # 8 characters: joint_1, NUL
        "00000000"  # to a multiple of 8
    )
    assert payload[28:44] == bytes.fromhex("0807060504030201 1100000000000000")
    assert payload[-2:] == bytes.fromhex("f0 4f")


@pytest.mark.parametrize(
    "names", [("joint_1", "joint_2"), ("a", "shoulder pitch"), ("abc", ""), ("abcd", "abcde")]
)
def test_joint_state_for_names_of_every_length(names):
    record, _, (one, two) = random_record(5)
    payload = messages.JointStateMessage(names, (50.0, None)).payload(record, NOW)
    message = DEFINITIONS["sensor_msgs/msg/JointState"].decode(payload)
    assert message["header"] == {"stamp": {"sec": 1_700_000_000, "nanosec": 123_456_789}, "frame_id": ""}
    assert message["name"] == list(names)
    assert message["position"] == [one.link_position_rad, two.link_position_rad]
    assert message["velocity"][0] == pytest.approx(one.motor_velocity_rad_s / 50.0, rel=1e-15)
    assert math.isnan(message["velocity"][1])
    assert message["effort"] == [one.torque_nm, two.torque_nm]


def test_event():
    texts = ["", "joint 1: VALID -> STALE", "x" * 500, "Größe"]
    payloads = [
        messages.event(
            NOW, messages.EventKind.STATUS_CHANGED, text, index=2**40, count=5, joint=1, change=(2, 4)
        )
        for text in texts
    ]
    assert len({len(payload) for payload in payloads}) == 1
    definition = DEFINITIONS["jtqd_msgs/msg/Event"]
    message = definition.decode(payloads[1])
    assert message["kind"] == definition.constants["STATUS_CHANGED"]
    assert (message["cycle"], message["count"], message["joint"]) == (2**40, 5, 1)
    assert (message["before"], message["after"]) == (2, 4)
    assert message["text"].rstrip() == texts[1]
    assert definition.decode(payloads[3])["text"].rstrip() == "Gr??e"


def test_log():
    short, long = messages.log(NOW, 20, "hello"), messages.log(NOW, 40, "y" * 1000)
    assert len(short) == len(long)
    definition = DEFINITIONS["rcl_interfaces/msg/Log"]
    message = definition.decode(short)
    assert (message["level"], message["name"], message["msg"].rstrip()) == (
        definition.constants["INFO"],
        "jtqd",
        "hello",
    )
    assert message["stamp"] == {"sec": 1_700_000_000, "nanosec": 123_456_789}


def test_diagnostics():
    def message(level, text, backlog, cpu):
        first = messages.Status("recorder", "can0", level, text, {"backlog": backlog, "cpu": cpu})
        return messages.diagnostics(NOW, [first, messages.Status("x", "", 0, "", {"mode": text})])

    small, large = message(0, "recording", 0, 0.5), message(2, "cycles were lost " * 9, 10**15, 1e300)
    assert len(small) == len(large)
    status = DEFINITIONS["diagnostic_msgs/msg/DiagnosticArray"].decode(large)["status"]
    assert [each["name"] for each in status] == ["recorder", "x"]
    assert (status[0]["level"], status[0]["hardware_id"]) == (2, "can0")
    assert status[0]["message"].startswith("cycles were lost cycles")
    values = {entry["key"]: float(entry["value"]) for entry in status[0]["values"]}
    assert values == {"backlog": 1e15, "cpu": 1e300}


def test_status_constants_are_those_of_the_pdo():
    expected = {
        "OFF": 0,
        "STARTING": 1,
        "VALID": 2,
        "DEGRADED": 3,
        "STALE": 4,
        "DRIVE_FAULT": 5,
        "STANDSTILL": 6,
    }
    expected["INVALID"] = 15
    assert expected.items() <= JOINT.constants.items()
    flags = {"COMPLETE": cr.FLAG_COMPLETE, "PUBLISHED": cr.FLAG_PUBLISHED}
    flags |= {"BEFORE_NEXT_SYNC": cr.FLAG_BEFORE_NEXT_SYNC, "SYNC_CONFIRMED": cr.FLAG_SYNC_CONFIRMED}
    inputs = ("POSITION", "MOTION", "SENSOR", "TEMPERATURE")
    names = ("INPUT_TPDO1", "INPUT_TPDO2", "INPUT_SENSOR", "INPUT_TEMPERATURE")
    flags |= {name: getattr(cr, f"FLAG_{part}") for name, part in zip(names, inputs, strict=True)}
    flags |= {"WITHDRAWN": cr.FLAG_WITHDRAWN, "LATCHES_RESET": cr.FLAG_RESET}
    flags |= {"UNCHECKED": cr.FLAG_UNCHECKED, "FIRST_CYCLES": cr.FLAG_STARTING}
    flags |= {
        "NETWORK_SKIPPED": cr.FLAG_NETWORK_SKIPPED,
        "FAULT_LATCHED": cr.FLAG_LATCHED,
    }
    flags |= {f"FAULT_{faults.NAMES[bit].upper()}": bit << 8 for bit in faults.COUNTED}
    assert flags.items() <= JOINT.constants.items()


def test_every_topic_has_a_complete_schema():
    assert {topic.schema for topic in messages.TOPICS} == set(messages.SCHEMAS)
    assert len({topic.number for topic in messages.TOPICS}) == len(messages.TOPICS)
    for definition in DEFINITIONS.values():
        for fields, _ in definition.types.values():
            for _, kind, _ in fields:
                assert "/" not in kind or kind in definition.types, f"{definition.name} lacks {kind}"
