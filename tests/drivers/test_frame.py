"""Frames: layout, arbitration order, and length on the wire against can-utils' vectors and a plain twin."""

import random
import struct

import pytest

from jtqd.drivers.frame import (
    CAN_EFF_FLAG,
    CAN_EFF_MASK,
    CAN_RTR_FLAG,
    FRAME,
    arbitration_key,
    pack,
    stuffed_bits,
    unstuffed_bits,
    worst_case_bits,
)

SEED = 20261121


def wire_sequence(can_id: int, data: bytes) -> list[int]:
    """SOF to CRC of a frame, one bit per entry, written field by field from ISO 11898-1."""

    def field(value: int, width: int) -> list[int]:
        return [value >> i & 1 for i in reversed(range(width))]

    rtr = 1 if can_id & CAN_RTR_FLAG else 0
    bits = [0]
    if can_id & CAN_EFF_FLAG:
        identifier = field(can_id & CAN_EFF_MASK, 29)
        bits += [*identifier[:11], 1, 1, *identifier[11:], rtr, 0, 0]
    else:
        bits += [*field(can_id & 0x7FF, 11), rtr, 0, 0]
    bits += field(len(data), 4)
    if not rtr:
        for byte in data:
            bits += field(byte, 8)
    crc = 0
    for bit in bits:
        feedback = bit ^ (crc >> 14)
        crc = crc << 1 & 0x7FFF
        if feedback:
            crc ^= 0x4599
    return bits + field(crc, 15)


def plain_stuffed_bits(can_id: int, data: bytes) -> int:
    """The twin: put every stuff bit into a list and count."""
    sent: list[int] = []
    for bit in wire_sequence(can_id, data):
        sent.append(bit)
        # a sixth equal bit cannot follow: its place is stuffed
        if len(sent) >= 5 and len(set(sent[-5:])) == 1:
            sent.append(1 - bit)
    return len(sent) + 1 + 2 + 7 + 3  # CRC delimiter, ACK, EOF, intermission


@pytest.mark.parametrize(
    ("can_id", "data", "bits"),
    [  # can-utils cfl_exact
        (0x080, b"", 51),
        (0x080, b"\x00", 58),
        (0x080, b"\x01", 59),
        (0x701, b"\x05", 58),
        (0x181, b"\x00" * 8, 126),
        (0x181, b"\xff" * 8, 124),
        (0x02F, b"\x3c" * 8, 131),
        (0x040, b"\x87" * 7, 123),
        (0x000, b"", 53),
    ],
)
def test_stuffed_bits_of_known_frames(can_id, data, bits):
    assert stuffed_bits(can_id, data) == bits
    assert plain_stuffed_bits(can_id, data) == bits


def test_stuffed_bits_equal_the_plain_twin_on_random_frames():
    rng = random.Random(SEED)
    print("seed", SEED)
    for _ in range(4000):
        # Bytes with long runs stuff most; uniform ones would hardly reach the carry from byte to byte.
        pool = rng.choice([bytes(range(256)), b"\x00\xff\x0f\xf0\x1f\xf8\x3c\x87\x07\xe0"])
        data = bytes(rng.choice(pool) for _ in range(rng.randrange(9)))
        extended = rng.random() < 0.5
        can_id = rng.getrandbits(29) | CAN_EFF_FLAG if extended else rng.getrandbits(11)
        if rng.random() < 0.2:
            can_id |= CAN_RTR_FLAG
        bits = stuffed_bits(can_id, data)
        assert bits == plain_stuffed_bits(can_id, data), (hex(can_id), data.hex())
        carried = 0 if can_id & CAN_RTR_FLAG else len(data)
        assert unstuffed_bits(carried, extended) <= bits <= worst_case_bits(carried, extended)


def test_bounds_of_the_length():
    assert [unstuffed_bits(n) for n in range(9)] == [47, 55, 63, 71, 79, 87, 95, 103, 111]
    assert [worst_case_bits(n) for n in range(9)] == [55, 65, 75, 85, 95, 105, 115, 125, 135]
    for n in range(9):
        assert worst_case_bits(n) == unstuffed_bits(n) + (34 + 8 * n - 1) // 4
        assert worst_case_bits(n, True) == unstuffed_bits(n, True) + (54 + 8 * n - 1) // 4


def test_pack_is_struct_can_frame():
    # can_id little endian, len, 3 bytes of padding, data filled up with zeros
    assert pack(0x181, b"\x01\x02\x03") == bytes.fromhex("81010000 03 000000 0102030000000000")
    assert pack(0x12345678 | CAN_EFF_FLAG) == bytes.fromhex("78563492 00 000000 0000000000000000")
    assert FRAME.unpack(pack(0x80, b"\x07")) == (0x80, 1, b"\x07" + bytes(7))
    assert FRAME.size == struct.calcsize("=IB3x8s") == 16


@pytest.mark.parametrize(("can_id", "data"), [(0x80, bytes(9)), (0x800, b""), (-1, b""), (1 << 32, b"")])
def test_pack_refuses_what_no_frame_can_hold(can_id, data):
    with pytest.raises(ValueError, match=r"8 bytes|identifier"):
        pack(can_id, data)


def test_arbitration_order_is_that_of_the_bits_on_the_wire():
    """The sender whose first differing bit up to RTR/IDE is dominant (0) wins."""
    rng = random.Random(SEED)
    base = 0x155
    ids = [
        base,  # standard data
        base | CAN_RTR_FLAG,  # standard remote
        base << 18 | CAN_EFF_FLAG,  # extended of the same base
        base << 18 | CAN_EFF_FLAG | CAN_RTR_FLAG,
        base << 18 | 1 | CAN_EFF_FLAG,
        base + 1,
    ]
    assert sorted(ids, key=arbitration_key) == ids
    for _ in range(2000):
        pair = [
            rng.getrandbits(29) | CAN_EFF_FLAG if rng.random() < 0.5 else rng.getrandbits(11)
            for _ in range(2)
        ]
        if rng.random() < 0.5:  # same base in both formats
            pair[1] = (
                (pair[0] & CAN_EFF_MASK) >> 18 if pair[0] & CAN_EFF_FLAG else pair[0] << 18 | CAN_EFF_FLAG
            )
        pair = [each | (CAN_RTR_FLAG if rng.random() < 0.3 else 0) for each in pair]
        if pair[0] != pair[1]:
            by_bits = sorted(pair, key=lambda each: wire_sequence(each, b"")[:33])
            assert sorted(pair, key=arbitration_key) == by_bits, [hex(each) for each in pair]
