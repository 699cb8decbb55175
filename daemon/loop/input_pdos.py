"""Input PDOs of a configuration: those that the loop waits for, and temperatures that come in between.

Pure: frames and cycle numbers in, values out.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from math import nan

from jtqd.daemon.config import Config
from jtqd.daemon.shared.cycle_record import TEMPERATURE_LIFE_S
from jtqd.drivers.devices import (
    NOT_MEASURED,
    TEMPERATURE_C_PER_UNIT,
    drive_tpdo1,
    drive_tpdo2,
    drive_tpdo3,
    sensor_tpdo1,
    sensor_tpdo2,
)
from jtqd.drivers.pdo import PdoMap

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
    """State of one synchronous PDO in the intake: frame of this cycle, missing frames, usual arrival.

    With slots, because five of them are touched in every cycle.
    """

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
        """Count a frame of `length` bytes, which differs from the mapping (CiA 301: 8210h shorter, 8220h longer)."""
        self.rejected += 1
        if length < self.length:
            self.short += 1
        else:
            self.long += 1

    def usual(self, delay_ns: int) -> bool:
        """Return whether the delay of a frame shows that it is this cycle's own, while an earlier one is missing."""
        low, high = self.band_low_ns, self.band_high_ns
        return (
            delay_ns >= 0
            and high - low <= _NARROW_NS
            and low - _BAND_MARGIN_NS <= delay_ns <= high + _BAND_MARGIN_NS
        )

    def learn(self, delay_ns: int) -> None:
        """Learn the arrival band: widen at once, narrow slowly."""
        if delay_ns < self.band_low_ns:
            self.band_low_ns = delay_ns
        else:
            self.band_low_ns += int((delay_ns - self.band_low_ns) * _BAND_LEAK)
        if delay_ns > self.band_high_ns:
            self.band_high_ns = delay_ns
        else:
            self.band_high_ns -= int((self.band_high_ns - delay_ns) * _BAND_LEAK)


_NEVER = 1 << 62
_FIELD = struct.Struct("<h")


class JointTemperature:
    """Temperature of a joint: what its drive sent last by TPDO3, for as long as that is worth something.

    TPDO3 comes by an event timer, not with SYNC, so it belongs to no cycle: a value holds from the cycle that took its
    frame until the next one, or until it is TEMPERATURE_LIFE_S old. Its age is counted in slots and not by stamps, because
    CLOCK_REALTIME may be stepped, and so that the frames and cycle numbers of a log alone say what each cycle had.

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
        """Decode the frame (`struct can_frame`) at `offset`; return False for a wrong length."""
        if frames[offset + 4] != _FIELD.size:
            self.rejected += 1
            return False
        (raw,) = _FIELD.unpack_from(frames, offset + 8)
        self.celsius = nan if raw == NOT_MEASURED else raw * TEMPERATURE_C_PER_UNIT
        self._news = True
        return True

    def at(self, cycle: int) -> None:
        """Discard a value that is too old at slot number `cycle`."""
        if self._news:
            self._news = False
            self._until = cycle + self._life
        elif cycle > self._until:
            self._until = _NEVER
            self.celsius = nan
            self.lost += 1


UNKNOWN = JointTemperature(0, 0, "none", 0)
"""Of a joint whose drive sends none."""


def input_pdos(config: Config) -> list[InputPdo]:
    """Return the expected PDOs: both TPDOs of each drive, then one per sensor channel in use."""

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


def sensor_index(config: Config, channel: int | None) -> int | None:
    """Return the index of a sensor channel's PDO; None without channel or sensor."""
    if channel is None or config.sensor is None:
        return None
    return 2 * len(config.joints) + config.sensor.channels.index(channel)


def joint_temperatures(config: Config) -> list[JointTemperature]:
    """Return the temperatures of the joints whose drive sends one, in joint order; all unknown at first."""
    life = round(TEMPERATURE_LIFE_S * 1e9 / config.period_ns)
    return [
        JointTemperature(cob_id, node, f"{cob_id:03X}h drive {node} TPDO3", life)
        for node, cob_id in (
            (j.node_id, drive_tpdo3(j.node_id).cob_id) for j in config.joints if j.temperature
        )
    ]
