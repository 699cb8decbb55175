"""The PDOs that the loop waits for, and those that it takes when they come, by configuration."""

from __future__ import annotations

import struct
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from math import nan
from typing import NamedTuple

from jtqd.daemon.config import Config
from jtqd.daemon.shared.snapshot import InputView
from jtqd.drivers.devices import (
    NOT_MEASURED,
    TEMPERATURE_C_PER_UNIT,
    drive_tpdo1,
    drive_tpdo2,
    drive_tpdo3,
    sensor_tpdo1,
    sensor_tpdo2,
)
from jtqd.drivers.emcy import PDO_LONG, PDO_SHORT, PDO_TIMEOUT
from jtqd.drivers.pdo import PdoMap

# What the intake knows of one synchronous input PDO: its frame of this cycle, its debt, and when it usually comes. Pure.


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


# Temperature of one joint: what its drive told last by TPDO3, for as long as that is worth something. Pure.
#
# TPDO3 comes by an event timer, not with SYNC, so it belongs to no cycle: a value holds from the cycle that took its frame
# until the next one, or until it is LIFE_S old. Its age is counted in slots and not by stamps, because CLOCK_REALTIME may be
# stepped, and so that the frames and cycle numbers of a log alone say what each cycle had.


LIFE_S = 2.0
"""Four frames in a row are missing then; a joint needs minutes to become noticeably warmer."""
_NEVER = 1 << 62
_FIELD = struct.Struct("<h")


class JointTemperature:
    """Last temperature of a joint.

    Args:
        cob_id: of TPDO3.
        node_id: of its drive.
        name: as it appears in counters and lines, e.g. "381h drive 1 TPDO3".
        life_cycles: slots after which a value is forgotten.

    Attributes:
        celsius: what the cycle may use; NaN where it is not known.
        lost: how often a value was forgotten because no other came.
        rejected: frames with this identifier and a wrong length, or 29-bit or remote frames.
    """

    __slots__ = ("_life", "_news", "_until", "celsius", "cob_id", "lost", "name", "node_id", "rejected")

    def __init__(self, cob_id: int, node_id: int, name: str, life_cycles: int) -> None:
        self.cob_id, self.node_id, self.name = cob_id, node_id, name
        self._life = life_cycles
        self._news = False
        self._until = _NEVER
        self.celsius = nan
        self.lost = self.rejected = 0

    def receive(self, frames: bytearray, offset: int) -> bool:
        """Take the frame (`struct can_frame`) at `offset`; False for a wrong length."""
        if frames[offset + 4] != _FIELD.size:
            self.rejected += 1
            return False
        (raw,) = _FIELD.unpack_from(frames, offset + 8)
        self.celsius = nan if raw == NOT_MEASURED else raw * TEMPERATURE_C_PER_UNIT
        self._news = True
        return True

    def at(self, cycle: int) -> None:
        """The inputs of slot number `cycle` have been taken: what is too old by then is not known any more."""
        if self._news:
            self._news = False
            self._until = cycle + self._life
        elif cycle > self._until:
            self._until = _NEVER
            self.celsius = nan
            self.lost += 1


UNKNOWN = JointTemperature(0, 0, "none", 0)
"""Of a joint whose drive tells none."""


# Deadline and length of each input PDO, from the loop's counts: errors 8250h, 8210h and 8220h, each by itself. Pure.
#
# The loop decides per cycle; this says what lasts. A PDO has timed out (8250h) when it brought no valid input for
# `TIMEOUT_CYCLES` cycles in a row, and is back with the next valid one. A frame of a wrong length is never used: a short
# one cannot be (8210h), and of a longer one CiA 301 allows to take the first bytes (8220h), but a node that sends another
# length than was configured has lost its mapping, and then the first bytes are not what we think they are. These errors
# are over when none came for `LENGTH_S`.


TIMEOUT_CYCLES = 20
LENGTH_S = 1.0


class WatchedPdo(NamedTuple):
    """One input PDO: identifier, producer, name for people, and the joints that need it (bit 0 joint 1, bit 1 joint 2)."""

    cob_id: int
    node: int
    name: str
    joints: int


class PdoEvent(NamedTuple):
    """An error has come (`present`) or gone."""

    code: int
    pdo: WatchedPdo
    present: bool


class _State:
    def __init__(self) -> None:
        self.missed = -1  # nothing has been read yet
        self.in_a_row = 0
        self.short = self.long = 0
        self.timed_out = False
        self.until = {PDO_SHORT: 0.0, PDO_LONG: 0.0}
        self.present = {PDO_SHORT: False, PDO_LONG: False}


class PdoWatch:
    """Call `events` with each reading of the snapshot; `pdos` in the order of the snapshot's inputs."""

    def __init__(self, pdos: Sequence[WatchedPdo]) -> None:
        self._pdos = [(pdo, _State()) for pdo in pdos]

    def events(self, inputs: Sequence[InputView], absent: Collection[int], now_s: float) -> list[PdoEvent]:
        """What has come or gone; PDOs of `absent` nodes (optional ones) are not missed."""
        told: list[PdoEvent] = []
        for (pdo, state), seen in zip(self._pdos, inputs, strict=False):
            # A loss between two readings, over by now, counts too, with what the last reading saw of it.
            missed = 0 if state.missed < 0 else seen.missed - state.missed
            if missed:
                missed += state.in_a_row
            state.missed, state.in_a_row = seen.missed, seen.in_a_row
            expected = pdo.node not in absent
            timed_out = seen.in_a_row >= TIMEOUT_CYCLES and expected
            if timed_out != state.timed_out:
                told.append(PdoEvent(PDO_TIMEOUT, pdo, timed_out))
            elif not timed_out and missed - seen.in_a_row >= TIMEOUT_CYCLES and expected:
                told += [PdoEvent(PDO_TIMEOUT, pdo, True), PdoEvent(PDO_TIMEOUT, pdo, False)]
            state.timed_out = timed_out
            for code, count, before in (
                (PDO_SHORT, seen.short, state.short),
                (PDO_LONG, seen.long, state.long),
            ):
                if count != before:
                    state.until[code] = now_s + LENGTH_S
                present = now_s < state.until[code]
                if present != state.present[code]:
                    told.append(PdoEvent(code, pdo, present))
                    state.present[code] = present
            state.short, state.long = seen.short, seen.long
        return told


def input_pdos(config: Config) -> list[InputPdo]:
    """Expected PDOs: both TPDOs of each drive, then one per sensor channel in use."""

    def pdo(pdo_map: PdoMap, node: int, what: str) -> InputPdo:
        return InputPdo(pdo_map.cob_id, pdo_map.length, pdo_map.layout, node, f"{pdo_map.cob_id:03X}h {what}")

    pdos = []
    for joint in config.joints:
        pdos.append(pdo(drive_tpdo1(joint.node_id), joint.node_id, f"drive {joint.node_id} TPDO1"))
        pdos.append(pdo(drive_tpdo2(joint.node_id), joint.node_id, f"drive {joint.node_id} TPDO2"))
    if config.sensor is not None:
        node = config.sensor.node_id
        for channel in config.sensor.channels:
            pdo_map = sensor_tpdo1(node) if channel == 1 else sensor_tpdo2(node)
            pdos.append(pdo(pdo_map, node, f"sensor {node} channel {channel}"))
    return pdos


def watched_pdos(config: Config) -> list[WatchedPdo]:
    """The same PDOs as `input_pdos`, in the same order, with the joints that cannot do without."""
    joints = {joint.node_id: 1 << n for n, joint in enumerate(config.joints)}
    return [
        WatchedPdo(pdo.cob_id, pdo.node_id, pdo.name, joints.get(pdo.node_id, 0))
        for pdo in input_pdos(config)
    ]


def sensor_index(config: Config, channel: int | None) -> int | None:
    """Index of a sensor channel's PDO among them; None without channel or sensor."""
    if channel is None or config.sensor is None:
        return None
    return 2 * len(config.joints) + config.sensor.channels.index(channel)


def joint_temperatures(config: Config) -> list[JointTemperature]:
    """Temperature of each joint whose drive tells one, in the order of the joints; all unknown yet."""
    life = round(LIFE_S * 1e9 / config.period_ns)
    return [
        JointTemperature(cob_id, node, f"{cob_id:03X}h drive {node} TPDO3", life)
        for node, cob_id in (
            (j.node_id, drive_tpdo3(j.node_id).cob_id) for j in config.joints if j.temperature
        )
    ]
