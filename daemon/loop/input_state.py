"""What the intake knows of one synchronous input PDO: its frame of this cycle, its debt, and when it usually comes. Pure."""

from __future__ import annotations

import struct
from dataclasses import dataclass

_BAND_MARGIN_NS = 50_000
"""Allowance around the learned delays: one frame of 135 bits may have been in the way less than twice."""
_NARROW_NS = 200_000
"""A band wider than this cannot tell a late frame from one in time."""
_BAND_LEAK = 1.0 / 1024.0
"""The band shrinks towards what is seen now with a time constant of about a second at 1 kHz."""


@dataclass(frozen=True)
class InputPdo:
    """One synchronous TPDO that the loop waits for.

    Attributes:
        cob_id: 11-bit identifier.
        length: bytes of its mapping; any other length is rejected (CiA 301: 8210h).
        layout: precompiled unpacking of the mapped objects.
        node_id: its producer.
        name: as it appears in counters and events, e.g. "181h drive 1 TPDO1".
    """

    cob_id: int
    length: int
    layout: struct.Struct
    node_id: int
    name: str


class InputState:
    """What is known of one PDO; slots because five of them are touched in every cycle."""

    __slots__ = (
        "band_high_ns",
        "band_low_ns",
        "conflict",
        "data",
        "debt",
        "duplicates",
        "fresh",
        "in_a_row",
        "late",
        "length",
        "long",
        "lost",
        "missed",
        "pdo",
        "probation",
        "quarantine",
        "rejected",
        "short",
        "stamp_ns",
        "unpack",
        "values",
        "wanted",
    )

    def __init__(self, pdo: InputPdo) -> None:
        self.pdo = pdo
        self.length = pdo.length
        self.unpack = pdo.layout.unpack_from
        self.values: tuple[int, ...] = (0,) * len(pdo.layout.unpack(bytes(pdo.length)))
        self.data = b""
        self.fresh = False
        self.conflict = False
        self.debt = 0
        self.probation = False
        self.quarantine = 0
        self.stamp_ns = 0
        self.band_low_ns = 1 << 62
        self.band_high_ns = 0
        self.late = self.lost = self.duplicates = self.rejected = 0
        self.missed = self.in_a_row = self.short = self.long = 0
        self.wanted = 1
        """0 while its node is absent or not configured: nobody waits for it then."""

    def wrong_length(self, length: int) -> None:
        """A frame of `length` bytes, which is not that of the mapping (CiA 301: 8210h shorter, 8220h longer)."""
        self.rejected += 1
        if length < self.length:
            self.short += 1
        else:
            self.long += 1

    def usual(self, delay_ns: int) -> bool:
        """One frame came while an earlier one is missing: does its delay tell that it is this cycle's own?"""
        low, high = self.band_low_ns, self.band_high_ns
        return (
            delay_ns >= 0
            and high - low <= _NARROW_NS
            and low - _BAND_MARGIN_NS <= delay_ns <= high + _BAND_MARGIN_NS
        )

    def learn(self, delay_ns: int) -> None:
        """Follow the arrivals: at once outwards, slowly inwards."""
        if delay_ns < self.band_low_ns:
            self.band_low_ns = delay_ns
        else:
            self.band_low_ns += int((delay_ns - self.band_low_ns) * _BAND_LEAK)
        if delay_ns > self.band_high_ns:
            self.band_high_ns = delay_ns
        else:
            self.band_high_ns -= int((self.band_high_ns - delay_ns) * _BAND_LEAK)
