"""The 16-byte `struct can_frame` of linux/can.h and the length of a frame on the wire.

Bit counts are those of classic CAN (ISO 11898-1) with the three bits of intermission. Pure.
"""

import struct

CAN_EFF_FLAG = 0x80000000  # 29-bit identifier
CAN_RTR_FLAG = 0x40000000  # remote frame
CAN_ERR_FLAG = 0x20000000  # error message of the driver, never on the wire
CAN_SFF_MASK = 0x000007FF
CAN_EFF_MASK = 0x1FFFFFFF

FRAME = struct.Struct("<IB3x8s")
"""can_id with its flags, length 0..8, three bytes of padding, data filled up with zeros."""
FRAME_SIZE = FRAME.size
MAX_LENGTH = 8

ECHO_BIT = 1
"""Bit 0 of byte 5 (padding): on a unix bus the sender asks the hub for an echo of this frame."""

# Fixed bits outside the stuffed part: CRC delimiter 1, ACK slot and delimiter 2, EOF 7, intermission 3.
_TAIL_BITS = 13
_CRC_POLYNOMIAL = 0x4599
_CRC_BITS = 15


def pack(can_id: int, data: bytes = b"") -> bytes:
    """Return the 16 bytes of a frame; `can_id` carries its flags.

    Raises ValueError for more than 8 bytes of data or an identifier that does not fit its format.
    """
    if len(data) > MAX_LENGTH:
        raise ValueError(f"a CAN frame holds at most 8 bytes, not {len(data)}")
    if not is_valid_id(can_id):
        raise ValueError(f"not a CAN identifier: {can_id:#x}")
    return FRAME.pack(can_id, len(data), data)


def is_valid_id(can_id: int) -> bool:
    """Return whether `can_id` fits 32 bits and, without CAN_EFF_FLAG, has no bits above the 11th."""
    if not 0 <= can_id <= 0xFFFFFFFF:
        return False
    return bool(can_id & (CAN_EFF_FLAG | CAN_ERR_FLAG)) or not can_id & CAN_EFF_MASK & ~CAN_SFF_MASK


def arbitration_key(can_id: int) -> int:
    """Return the arbitration field as 32 bits on the wire: the smaller key wins the bus.

    Standard: ID 11, RTR, IDE = 0. Extended: base ID 11, SRR = 1, IDE = 1, ID 18, RTR. So a data frame wins
    against the remote frame of the same identifier, and both win against any extended frame of the same base.
    """
    rtr = 1 if can_id & CAN_RTR_FLAG else 0
    if can_id & CAN_EFF_FLAG:
        identifier = can_id & CAN_EFF_MASK
        return (identifier >> 18) << 21 | 0b11 << 19 | (identifier & 0x3FFFF) << 1 | rtr
    return (can_id & CAN_SFF_MASK) << 21 | rtr << 20


def unstuffed_bits(length: int, extended: bool = False) -> int:
    """Return the bits of a data frame of `length` bytes without any stuff bit: 47 + 8n (29-bit: 67 + 8n)."""
    return (67 if extended else 47) + 8 * length


def worst_case_bits(length: int, extended: bool = False) -> int:
    """Return the longest data frame of `length` bytes: 55 + 10n (29-bit: 80 + 10n).

    A stuff bit after every fourth bit of the stuffed part (Davis et al. 2007, Real-Time Systems 35:239).
    """
    return (80 if extended else 55) + 10 * length


def _crc_table() -> tuple[int, ...]:
    """Return the CRC-15 of each byte, for eight bits at a time."""
    table = []
    for byte in range(256):
        crc = byte << (_CRC_BITS - 8)
        for _ in range(8):
            crc = (crc << 1 ^ _CRC_POLYNOMIAL if crc & 0x4000 else crc << 1) & 0x7FFF
        table.append(crc)
    return tuple(table)


def _stuff_table() -> tuple[tuple[tuple[int, int], ...], ...]:
    """Return table[state][byte] = (stuff bits in this byte, next state); state = 5 * last bit + run - 1."""
    table = []
    for state in range(10):
        row = []
        for byte in range(256):
            last, run = divmod(state, 5)
            run += 1
            stuffed = 0
            for shift in range(7, -1, -1):
                bit = byte >> shift & 1
                run = run + 1 if bit == last else 1
                last = bit
                if run == 5:  # the complement follows and is the first bit of the next run
                    stuffed += 1
                    last = 1 - bit
                    run = 1
            row.append((stuffed, 5 * last + run - 1))
        table.append(tuple(row))
    return tuple(table)


_CRC = _crc_table()
_STUFF = _stuff_table()
_ONE_RECESSIVE = 5  # state: last bit 1, run 1


def stuffed_bits(can_id: int, data: bytes = b"") -> int:
    """Return the exact length in bits of this frame on the wire: CRC, stuff bits and intermission included.

    A remote frame carries the length of `data` and no data. Eight bits at a time from tables; the plain version,
    one bit at a time, is in the tests.
    """
    remote = 1 if can_id & CAN_RTR_FLAG else 0
    if can_id & CAN_EFF_FLAG:
        identifier = can_id & CAN_EFF_MASK  # SOF 0, base 11, SRR 1, IDE 1, ID 18, RTR, r1 0, r0 0, DLC 4
        header = (identifier >> 18) << 27 | 0b11 << 25 | (identifier & 0x3FFFF) << 7 | remote << 6 | len(data)
        bits = 39
    else:  # SOF 0, ID 11, RTR, IDE 0, r0 0, DLC 4
        header = (can_id & CAN_SFF_MASK) << 7 | remote << 6 | len(data)
        bits = 19
    if not remote:
        header = header << 8 * len(data) | int.from_bytes(data, "big")
        bits += 8 * len(data)
    crc = 0  # leading zeros leave a CRC that starts at 0 as it is
    for byte in header.to_bytes((bits + 7) // 8, "big"):
        crc = (crc << 8 ^ _CRC[crc >> 7 ^ byte]) & 0x7FFF
    bits += _CRC_BITS
    # Fill the front up to whole bytes with 01..01: it holds no run and ends recessive, as the idle bus does.
    front = -bits % 8
    sequence = (0x55 & (1 << front) - 1) << bits | header << _CRC_BITS | crc
    total = bits + _TAIL_BITS
    state = _ONE_RECESSIVE
    for byte in sequence.to_bytes((bits + front) // 8, "big"):
        stuffed, state = _STUFF[state][byte]
        total += stuffed
    return total
