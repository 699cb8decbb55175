"""Layout of the cycle record, byte by byte: three programs share it through memory."""

import math
import struct

import pytest

from jtqd.daemon.shared import cycle_record as cr
from tests.daemon import ring_records as rr

HEADER = (7, 1_000, 1_700_000_000_123_456_789, 0xF, 50_000, -3, 2, 240, 2, 255, 1, 2, 3, 4, 0)
JOINT_1 = (*(0.5 + n for n in range(16)), 0x1237, 2, 0x80, 7)
JOINT_2 = (*(-0.25 * n for n in range(13)), math.nan, -3.5, 4.5, 0x0250, 15, 0, 1)
SYNC = bytes.fromhex("80000000 01 000000 f000000000000000")
TPDO = bytes.fromhex("81010000 08 000000 0102030405060708")


def sample():
    record = bytearray(rr.RECORD_SIZE)
    cr.PAIR.head.pack_into(record, 0, *HEADER, *JOINT_1, *JOINT_2)
    record[cr.PAIR.frames_offset : cr.PAIR.frames_offset + 32] = SYNC + TPDO
    struct.pack_into("<2q", record, cr.PAIR.stamps_offset, 11, 22)
    cr.TAIL.pack_into(record, cr.PAIR.tail_offset, HEADER[0])
    return bytes(record)


def test_offsets():
    """48 bytes of header, two joints of 136, 16 frames of 16, 16 stamps of 8, the index."""
    assert cr.HEADER.size == 48
    assert cr.JOINT.size == 136
    assert cr.PAIR.head.size == 320 == cr.PAIR.frames_offset
    assert cr.PAIR.stamps_offset == 576
    assert cr.PAIR.tail_offset == 704
    assert rr.RECORD_SIZE == 712


def test_bytes_of_the_header():
    expected = (
        (7).to_bytes(8, "little")
        + (1_000).to_bytes(8, "little")
        + (1_700_000_000_123_456_789).to_bytes(8, "little")
        + bytes.fromhex("0f000000 50c30000 fdffffff 02000000")
        + bytes.fromhex("f0 02 ff 01 02 03 04 00")
    )
    assert sample()[:48] == expected


def test_joint_blocks_lie_at_48_and_184():
    record = sample()
    assert record[48:176] == struct.pack("<16d", *JOINT_1[:16])
    assert record[176:184] == bytes.fromhex("3712 0200 8000 0700")
    assert record[184:312] == struct.pack("<16d", *JOINT_2[:16])
    assert record[312:320] == bytes.fromhex("5002 0f00 0000 0100")


def test_fields_by_name():
    record = sample()
    header = cr.header_of(record)
    assert (header.cycle, header.sync_monotonic_ns, header.sync_realtime_ns) == HEADER[:3]
    assert (header.work_ns, header.late_ns, header.missed, header.sync_counter) == (50_000, -3, 2, 240)
    assert (header.frame_count, header.frames_left_out, header.stale_inputs) == (2, 255, 1)
    assert (header.late_frames, header.duplicate_frames, header.rejected_frames) == (2, 3, 4)
    one, two = cr.joint_of(record, 1), cr.joint_of(record, 2)
    assert (one.current_a, one.sensor_torque_nm, one.temperature_c) == (0.5, 4.5, 5.5)
    assert (one.torque_nm, one.network_nm, one.dt_s) == (6.5, 10.5, 11.5)
    assert (one.statusword, one.status, one.sensor_status, one.input_flags) == (0x1237, 2, 0x80, 7)
    assert (two.motor_position_rad, two.status) == (-0.25, 15)
    assert (one.reference_nm, one.age_ms) == (12.5, 13.5)
    assert math.isnan(two.age_ms)
    assert (one.torque_rate_nm_s, one.contact_nm, two.contact_nm) == (14.5, 15.5, 4.5)


def test_a_selection_of_fields_is_that_of_the_whole_record():
    record = sample()
    wanted = ("frame_count", "cycle", "late_ns")  # in any order: the record's own is kept
    picked = cr.selection(wanted, ("status", "age_ms"), 2).unpack_from(record)
    header, one, two = cr.header_of(record), cr.joint_of(record, 1), cr.joint_of(record, 2)
    assert picked[:5] == (header.cycle, header.late_ns, header.frame_count, one.age_ms, one.status)
    assert math.isnan(picked[5])
    assert picked[6:] == (two.status,)
    everything = cr.selection(cr.Header._fields, cr.JointRecord._fields, 2)
    assert everything.size == cr.PAIR.head.size
    assert everything.unpack_from(record)[:-7] == cr.PAIR.head.unpack_from(record)[:-7]


def test_a_selection_refuses_fields_that_are_not_there():
    with pytest.raises(ValueError, match="found nonsense, expected fields"):
        cr.selection(("cycle", "nonsense"), (), 2)


def test_frames_in_order_with_stamps():
    assert rr.frames_of(sample()) == [(SYNC, 11), (TPDO, 22)]
