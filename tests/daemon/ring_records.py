"""Records of the ring in tests: read a record of any layout, and append one as the loop does."""

from __future__ import annotations

import struct

from jtqd.daemon.shared.cycle_record import MOST_JOINTS, PAIR, Ring, header_of, layout_of

RECORD_SIZE, FRAME_CAPACITY = PAIR.size, PAIR.frame_capacity
_BY_SIZE = {layout_of(joints).size: layout_of(joints) for joints in range(1, MOST_JOINTS + 1)}


def frames_of(record: bytes | memoryview) -> list[tuple[bytes, int]]:
    """Frames of one record as (16 bytes of `struct can_frame`, CLOCK_REALTIME stamp in ns), in order of arrival."""
    count, layout = header_of(record).frame_count, _BY_SIZE[len(record)]
    stamps = struct.unpack_from(f"<{count}q", record, layout.stamps_offset)
    view, start = memoryview(record), layout.frames_offset
    return [(bytes(view[start + 16 * n : start + 16 * n + 16]), stamp) for n, stamp in enumerate(stamps)]


def append(ring: Ring, record: bytes | bytearray | memoryview) -> None:
    """Write a record into the next slot, then publish it."""
    ring.append(record)
