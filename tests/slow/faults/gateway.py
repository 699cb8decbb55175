"""A gateway between the nodes and jtqd: it takes what the nodes answer to a SYNC and passes on what a fault makes of it.

It shares no code with jtqd. Process data as docs/bus.md has them, little endian:

    180h + n   TPDO1 of drive n   motor position I32, link position I32
    280h + n   TPDO2 of drive n   motor velocity I32, current I16, statusword U16
    380h + n   TPDO3 of drive n   temperature I16 (0.1 degC)
    183h       TPDO1 of the sensor   torque I32, status U8
    700h + n   heartbeat U8

A fault is a function of the cycles since its begin and the traffic of this cycle, which it changes in place. Every draw is
from a generator of the case: the same seed gives the same frames.
"""

from __future__ import annotations

import math
import random
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

SENSOR_NODE: Final = 3
HEARTBEAT: Final = 0x700
BOOT_UP, STOPPED, OPERATIONAL, PRE_OPERATIONAL = 0x00, 0x04, 0x05, 0x7F
SWITCHED_OFF, FAULT_WORD = 0x0040, 0x0008
"""Statuswords of CiA 402: switch on disabled; fault."""


class Field(NamedTuple):
    """A number in a PDO: base of the COB-ID, offset in bytes, format."""

    base: int
    offset: int
    format: str

    @property
    def range(self) -> tuple[int, int]:
        """Return the smallest and the largest number."""
        bits = 8 * struct.calcsize(self.format)
        return (0, (1 << bits) - 1) if self.format.isupper() else (-(1 << bits - 1), (1 << bits - 1) - 1)


FIELDS: Final = {
    "motor position": Field(0x180, 0, "i"),
    "link position": Field(0x180, 4, "i"),
    "motor velocity": Field(0x280, 0, "i"),
    "current": Field(0x280, 4, "h"),
    "statusword": Field(0x280, 6, "H"),
    "temperature": Field(0x380, 0, "h"),
    "sensor": Field(0x180, 0, "i"),
    "sensor status": Field(0x180, 4, "B"),
}


@dataclass
class Message:
    """A frame on its way: when it ends on the wire, after SYNC [us]; of which cycle its content is, COB-ID, data."""

    at_us: float
    cob_id: int
    data: bytes

    def get(self, field: Field) -> int:
        return int(struct.unpack_from("<" + field.format, self.data, field.offset)[0])

    def put(self, field: Field, value: int) -> None:
        """Set a number; one that does not fit rolls over, as in the counter of an encoder."""
        size = struct.calcsize(field.format)
        raw = (value & ((1 << 8 * size) - 1)).to_bytes(size, "little")
        self.data = self.data[: field.offset] + raw + self.data[field.offset + size :]


class Traffic:
    """What the nodes send in one cycle.

    Attributes:
        messages: on their way to jtqd; a fault changes them.
        cycle: since the start.
        at: what the nodes sent in a cycle (`at(cycle)`), whatever became of it.
    """

    def __init__(
        self, cycle: int, messages: list[Message], at: Callable[[int], Sequence[tuple[float, int, bytes]]]
    ) -> None:
        self.cycle, self.messages, self.at = cycle, messages, at

    def of(self, *cob_ids: int) -> list[Message]:
        """Return the messages with one of these COB-IDs; without any, all process data."""
        return [
            each
            for each in self.messages
            if (each.cob_id in cob_ids if cob_ids else 0x180 < each.cob_id < 0x400)
        ]

    def drop(self, *cob_ids: int) -> None:
        gone = self.of(*cob_ids)
        self.messages = [each for each in self.messages if each not in gone]

    def sent(self, cob_id: int, ago: int) -> bytes | None:
        """Return the data of a COB-ID as its node sent it some cycles ago; None: it sent none."""
        found = [data for _, other, data in self.at(max(self.cycle - ago, 0)) if other == cob_id]
        return found[0] if found else None


Act = Callable[[int, Traffic], None]
"""Change the traffic, so many cycles after the begin of the fault."""
Change = Callable[[int, int, Traffic], int]
"""Return what a number becomes: cycles since the begin, the number, the traffic."""


def of_field(name: str, node: int, change: Change) -> Act:
    """Change one number of one node wherever it is sent."""
    field = FIELDS[name]

    def act(n: int, traffic: Traffic) -> None:
        for message in traffic.of(field.base + node):
            if len(message.data) >= field.offset + struct.calcsize(field.format):
                message.put(field, change(n, message.get(field), traffic))

    return act


# What becomes of a number ----------------------------------------------------------------------------------------------


def frozen() -> Change:
    first: list[int] = []

    def change(n: int, value: int, traffic: Traffic) -> int:
        first.append(value) if not first else None
        return first[0]

    return change


def held(cycles: int) -> Change:
    """A new number in every so many cycles only."""
    kept = [0]

    def change(n: int, value: int, traffic: Traffic) -> int:
        if n % cycles == 0:
            kept[0] = value
        return kept[0]

    return change


def noise(rng: random.Random, size: int) -> Change:
    return lambda n, value, traffic: value + rng.randint(-size, size)


def spikes(rng: random.Random, size: int, every: int) -> Change:
    return lambda n, value, traffic: (
        value + (size if rng.random() < 0.5 else -size) * (n % every == every // 2)
    )


def step(size: int) -> Change:
    return lambda n, value, traffic: value + size


def ramp(size: int, cycles: int) -> Change:
    """Up to `size` in half of the cycles and back in the other half."""
    half = max(cycles // 2, 1)
    return lambda n, value, traffic: value + size * max(half - abs(n - half), 0) // half


def scaled(factor: float) -> Change:
    return lambda n, value, traffic: round(factor * value)


def saturated(span: int) -> Change:
    """It does not leave the neighbourhood of what it was at the begin."""
    first: list[int] = []

    def change(n: int, value: int, traffic: Traffic) -> int:
        first.append(value) if not first else None
        return min(max(value, first[0] - span), first[0] + span)

    return change


def losing(part: float) -> Change:
    """Of what it counts from now on it loses a part."""
    first: list[int] = []

    def change(n: int, value: int, traffic: Traffic) -> int:
        first.append(value) if not first else None
        return value - round(part * (value - first[0]))

    return change


def eccentric(size: int, waves: int, turn: float) -> Change:
    """An error of so many waves per turn, which has so many counts."""
    return lambda n, value, traffic: value + round(size * math.sin(2.0 * math.pi * waves * value / turn))


def swapped(name: str, node: int) -> Change:
    """The number of another field, or node, in its place."""
    field = FIELDS[name]

    def change(n: int, value: int, traffic: Traffic) -> int:
        data = traffic.sent(field.base + node, 0)
        return value if data is None else int(struct.unpack_from("<" + field.format, data, field.offset)[0])

    return change


def reversed_bytes(name: str) -> Change:
    letter = FIELDS[name].format
    low, high = FIELDS[name].range
    return lambda n, value, traffic: int(
        struct.unpack(">" + letter, struct.pack("<" + letter, min(max(value, low), high)))[0]
    )


def stuck_bits(mask: int, ones: bool) -> Change:
    return lambda n, value, traffic: value | mask if ones else value & ~mask


def flipped_bits(rng: random.Random, mask: int, share: float) -> Change:
    return lambda n, value, traffic: value ^ mask if rng.random() < share else value


def old(name: str, node: int, cycles: int) -> Change:
    """The number of so many cycles ago, in a frame that comes in time."""
    field = FIELDS[name]

    def change(n: int, value: int, traffic: Traffic) -> int:
        data = traffic.sent(field.base + node, cycles)
        return value if data is None else int(struct.unpack_from("<" + field.format, data, field.offset)[0])

    return change


# What becomes of frames ------------------------------------------------------------------------------------------------


def repeated(*cob_ids: int) -> Act:
    """Frames keep all bytes of their first one."""
    kept: dict[int, bytes] = {}

    def act(n: int, traffic: Traffic) -> None:
        for message in traffic.of(*cob_ids):
            message.data = kept.setdefault(message.cob_id, message.data)

    return act


def old_frames(cycles: int, *cob_ids: int) -> Act:
    """Frames in time with the content of so many cycles ago."""

    def act(n: int, traffic: Traffic) -> None:
        for message in traffic.of(*cob_ids):
            message.data = traffic.sent(message.cob_id, cycles) or message.data

    return act


def slow_clock(share: float, *cob_ids: int) -> Act:
    """The node samples by a clock of its own: what it sends gets older by this share of the time, up to a second."""

    def act(n: int, traffic: Traffic) -> None:
        for message in traffic.of(*cob_ids):
            message.data = traffic.sent(message.cob_id, min(int(n * share), 1000)) or message.data

    return act


def late(delay_us: float, *cob_ids: int) -> Act:
    def act(n: int, traffic: Traffic) -> None:
        for message in traffic.of(*cob_ids):
            message.at_us += delay_us

    return act


def jittered(rng: random.Random, most_us: float, *cob_ids: int) -> Act:
    def act(n: int, traffic: Traffic) -> None:
        for message in traffic.of(*cob_ids):
            message.at_us += rng.uniform(0.0, most_us)

    return act


def early(us: float, *cob_ids: int) -> Act:
    """Frames come so long before the SYNC that they belong to, with what was measured a cycle before."""

    def act(n: int, traffic: Traffic) -> None:
        for message in traffic.of(*cob_ids):
            message.at_us = 1000.0 - us

    return act


def doubled(ago: int, *cob_ids: int) -> Act:
    """Each frame comes again 20 us later, with the content of so many cycles ago (0: its own)."""

    def act(n: int, traffic: Traffic) -> None:
        for message in traffic.of(*cob_ids):
            again = traffic.sent(message.cob_id, ago)
            traffic.messages.append(
                Message(message.at_us + 20.0, message.cob_id, message.data if again is None else again)
            )

    return act


def lost(every: int, *cob_ids: int) -> Act:
    """One frame in so many is lost; 1: each."""

    def act(n: int, traffic: Traffic) -> None:
        if n % every == 0:
            traffic.drop(*cob_ids)

    return act


def replaced(data: bytes, *cob_ids: int) -> Act:
    def act(n: int, traffic: Traffic) -> None:
        for message in traffic.of(*cob_ids):
            message.data = data[: len(message.data)]

    return act


def cut_short(length: int, *cob_ids: int) -> Act:
    def act(n: int, traffic: Traffic) -> None:
        for message in traffic.of(*cob_ids):
            message.data = message.data[:length]

    return act


def exchanged(one: int, two: int) -> Act:
    """Two nodes have each other's node-ID."""
    other = {one: two, two: one}

    def act(n: int, traffic: Traffic) -> None:
        for message in traffic.messages:
            if message.cob_id & 0x7F in other:
                message.cob_id = message.cob_id & ~0x7F | other[message.cob_id & 0x7F]

    return act


def both_as(one: int, two: int) -> Act:
    """A second node sends with the node-ID of the first one as well."""

    def act(n: int, traffic: Traffic) -> None:
        for message in traffic.of(0x180 + two, 0x280 + two):
            cob_id = message.cob_id & ~0x7F | one
            traffic.messages.append(Message(message.at_us + 10.0, cob_id, message.data))

    return act


def silent(*nodes: int) -> Act:
    def act(n: int, traffic: Traffic) -> None:
        traffic.messages = [each for each in traffic.messages if each.cob_id & 0x7F not in nodes]

    return act


def restarted(node: int, cycles: int, from_zero: str | None = None) -> Act:
    """The node says boot-up, is silent for some cycles, then sends again; from_zero: a position that counts from 0 then."""
    first: list[int] = []
    field = None if from_zero is None else FIELDS[from_zero]

    def act(n: int, traffic: Traffic) -> None:
        if n < cycles:
            traffic.messages = [each for each in traffic.messages if each.cob_id & 0x7F != node]
            if n == 0:
                traffic.messages.append(Message(500.0, HEARTBEAT + node, bytes([BOOT_UP])))
            return
        if field is not None:
            for message in traffic.of(field.base + node):
                value = message.get(field)
                first.append(value) if not first else None
                message.put(field, value - first[0])

    return act


def heartbeat(state: int, node: int) -> Act:
    def act(n: int, traffic: Traffic) -> None:
        for message in traffic.of(HEARTBEAT + node):
            message.data = bytes([state])

    return act


def added(cob_id: int, data: bytes, at_us: float, every: int) -> Act:
    """A frame of somebody else, once in so many cycles."""

    def act(n: int, traffic: Traffic) -> None:
        if n % every == 0:
            traffic.messages.append(Message(at_us, cob_id, data))

    return act


# The gateway -----------------------------------------------------------------------------------------------------------


class Active(NamedTuple):
    """A fault from cycle `begin` up to `end`, which is not of it."""

    begin: int
    end: int
    act: Act


class Gateway:
    """Between the nodes (`at(cycle)`: delay [us], COB-ID and data of each frame) and jtqd."""

    def __init__(
        self, at: Callable[[int], Sequence[tuple[float, int, bytes]]], faults: Sequence[Active] = ()
    ) -> None:
        self._at, self._faults = at, tuple(faults)
        self._begin = min((each.begin for each in faults), default=1 << 62)
        self._end = max((each.end for each in faults), default=0)

    def answers(self, cycle: int) -> Sequence[tuple[float, int, bytes]]:
        """Return what reaches jtqd after the SYNC of this cycle."""
        if not self._begin <= cycle < self._end:
            return self._at(cycle)
        traffic = Traffic(cycle, [Message(*each) for each in self._at(cycle)], self._at)
        for fault in self._faults:
            if fault.begin <= cycle < fault.end:
                fault.act(cycle - fault.begin, traffic)
        return [(each.at_us, each.cob_id, each.data) for each in traffic.messages]
