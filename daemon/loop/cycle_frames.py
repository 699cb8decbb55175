"""Frames of a cycle, copied into its record as they came: 16 bytes each beside their stamps."""

from __future__ import annotations

import struct
from collections.abc import Collection, Sequence

from daemon.shared import cycle_record as cr


class CycleFrames:
    """Fills the frame part of one record after the other.

    Attributes:
        slot: record of the current cycle in the ring.
        count: frames stored in it.
        left_out: frames of the cycle that found no room.
    """

    def __init__(self, slot: memoryview) -> None:
        self.slot = slot
        self.count = self.left_out = 0
        self._held: list[tuple[bytes, int]] = []
        self._stamps = [struct.Struct(f"<{n}q") for n in range(cr.FRAME_CAPACITY + 1)]

    def begin(self, slot: memoryview) -> None:
        """The next frames belong to this record."""
        self.slot = slot
        self.count = self.left_out = 0
        if self._held:
            for frame, stamp_ns in self._held:
                self.keep_one(frame, stamp_ns)
            self._held.clear()

    def hold(
        self, frames: bytearray, stamps_ns: Sequence[int], count: int, identifiers: Collection[int]
    ) -> None:
        """Keep frames of a slot without a record for the next one that has one: those with these identifiers."""
        for n in range(count):
            frame = bytes(frames[16 * n : 16 * n + 16])
            if int.from_bytes(frame[:4], "little") in identifiers:
                self._held.append((frame, stamps_ns[n]))

    def keep(self, frames: bytearray, stamps_ns: Sequence[int], count: int) -> None:
        """Copy `count` received frames; `stamps_ns` are CLOCK_REALTIME."""
        stored = self.count
        room = cr.FRAME_CAPACITY - stored
        if count > room:
            self.left_out += count - room
            count = room
        if count <= 0:
            return
        start = cr.FRAMES_OFFSET + 16 * stored
        self.slot[start : start + 16 * count] = memoryview(frames)[: 16 * count]
        self._stamps[count].pack_into(self.slot, cr.STAMPS_OFFSET + 8 * stored, *stamps_ns[:count])
        self.count = stored + count

    def keep_one(self, frame: bytes, stamp_ns: int) -> None:
        """Copy one frame; of our own, `stamp_ns` (CLOCK_REALTIME) is when it was handed to the socket."""
        stored = self.count
        if stored >= cr.FRAME_CAPACITY:
            self.left_out += 1
            return
        start = cr.FRAMES_OFFSET + 16 * stored
        self.slot[start : start + 16] = frame
        self._stamps[1].pack_into(self.slot, cr.STAMPS_OFFSET + 8 * stored, stamp_ns)
        self.count = stored + 1
