"""Boot of one node by SDO, in the order of CiA 302-2: device type, identity, configuration, heartbeat.

Written against `SdoAccess`, so that a node in memory boots as one on a wire does. Every value written is read
back and compared; the values found make the node's configuration hash.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Protocol

from drivers.boot_error import BootError, mismatch, no_answer, refused
from drivers.devices import (
    EVENT_DRIVEN,
    EVENT_MS,
    OPERATING_MODE_OBJECT,
    TEMPERATURE,
    DriveProfile,
    DriveScaling,
    Key,
    SensorProfile,
    SensorScaling,
    drive_scaling,
    sensor_scaling,
)
from drivers.pdo import PdoMap
from drivers.pdo_parameters import CAN_ID, INVALID, NO_RTR
from drivers.sdo_abort import NO_OBJECT, NO_SUBINDEX, SdoAbort

Profile = DriveProfile | SensorProfile
_IDENTITY = (
    ("vendor", "vendor-ID", "D"),
    ("product", "product code", "M"),
    ("revision", "revision number", "N"),
    ("serial", "serial number", "O"),
)
_TPDO_COUNT = 4  # TPDOs of the predefined connection set: those not used are switched off
_ABSENT = (NO_OBJECT, NO_SUBINDEX)
_INHIBIT_TIME, _EVENT_TIMER = 3, 5  # sub-indices of a PDO's communication parameter


class SdoSilence(Exception):  # noqa: N818  (not an error of this side)
    """No answer within the waiting time."""

    def __init__(self, waited_s: float) -> None:
        super().__init__(f"no answer within {waited_s:g} s")
        self.waited_s = waited_s


class SdoAccess(Protocol):
    """SDO client of one node. Both raise SdoAbort (the node refused) and SdoSilence."""

    def read(self, index: int, subindex: int) -> bytes:
        """Upload."""

    def write(self, index: int, subindex: int, data: bytes) -> None:
        """Download."""


@dataclass(frozen=True)
class BusSettings:
    """What all nodes are told. `counter_overflow` is 1019h (0: SYNC without counter), None: left alone."""

    master_node: int
    master_timeout_ms: int = 500
    heartbeat_ms: int = 100
    sync_cob_id: int = 0x080
    counter_overflow: int | None = None


@dataclass(frozen=True)
class BootedNode:
    """What a node said and now holds. `gear_ratio` is None for a sensor."""

    node_id: int
    name: str
    device_type: int
    serial: int
    scaling: DriveScaling | SensorScaling
    gear_ratio: float | None
    tpdos: tuple[PdoMap, ...]
    configuration_sha256: str


class NodeBoot:
    """The procedure for one node. Each step raises BootError with its own letter."""

    def __init__(self, access: SdoAccess, profile: Profile, settings: BusSettings) -> None:
        self._access, self._profile, self._settings = access, profile, settings
        self._node = profile.node_id
        self._found: dict[Key, int] = {}

    def run(self, device_type: int) -> BootedNode:
        """All steps between `check_device_type`, whose result it takes, and error control and NMT start."""
        serial = self.check_identity()
        self.check_temperature()
        self.configure_pdos()
        self.configure_sync()
        self.configure_heartbeat()
        scaling, gear_ratio = self.read_scaling()
        name = self._optional((0x1008, 0)) or b""
        return BootedNode(
            node_id=self._node,
            name=name.rstrip(b"\0").decode("ascii", "replace"),
            device_type=device_type,
            serial=serial,
            scaling=scaling,
            gear_ratio=gear_ratio,
            tpdos=self._profile.tpdos,
            configuration_sha256=self._hash(),
        )

    def check_device_type(self) -> int:
        """1000h: the low word is the number of the device profile (402, 404)."""
        found = self._number((0x1000, 0), 4, letter="B")
        number = self._profile.profile_number
        if found & 0xFFFF != number:
            expected = f"profile {number} (0x....{number:04X})"
            raise mismatch(
                self._node, (0x1000, 0), "device type", expected=expected, found=f"0x{found:08X}", letter="C"
            )
        return found

    def check_identity(self) -> int:
        """1018h:1..4 against what is expected; returns the serial number (0: the device has none)."""
        serial = 0
        for subindex, (field, name, letter) in enumerate(_IDENTITY, 1):
            expected = getattr(self._profile.identity, field)
            if expected is None and field != "serial":
                continue
            raw = self._optional((0x1018, subindex))
            if raw is None and expected is None:
                continue
            found = -1 if raw is None else int.from_bytes(raw[:4], "little")
            if expected is not None and found != expected:
                said = "no such object" if raw is None else f"0x{found:08X}"
                key = (0x1018, subindex)
                raise mismatch(self._node, key, name, expected=f"0x{expected:08X}", found=said, letter=letter)
            self._found[0x1018, subindex] = serial = found
        return serial

    def check_temperature(self) -> None:
        """3001h of a drive that shall tell its joint's temperature; the value does not matter here."""
        profile = self._profile
        if isinstance(profile, DriveProfile) and profile.temperature and self._optional(TEMPERATURE) is None:
            expected = "a value (the configuration asks for it)"
            what = "joint temperature"
            raise mismatch(
                self._node, TEMPERATURE, what, expected=expected, found="no such object", letter="J"
            )

    def configure_pdos(self) -> None:
        """The profile's TPDOs, each written in the order of CiA 301; other TPDOs of 1..4 are switched off."""
        wanted = {(pdo.cob_id - 0x80) // 0x100: pdo for pdo in self._profile.tpdos}
        for number in range(1, _TPDO_COUNT + 1):
            pdo = wanted.get(number)
            if pdo is None:
                self._switch_off(0x1800 + number - 1)
            else:
                self._configure_pdo(0x1800 + number - 1, pdo)

    def _switch_off(self, communication: int) -> None:
        raw = self._optional((communication, 1))
        if raw is None:
            return
        cob_id = int.from_bytes(raw[:4], "little")
        self._found[communication, 1] = cob_id
        if not cob_id & INVALID:
            self._put((communication, 1), cob_id | INVALID, 4, "COB-ID")

    def _configure_pdo(self, communication: int, pdo: PdoMap) -> None:
        mapping = communication + 0x200
        cob_id = self._number((communication, 1), 4)
        self._write((communication, 1), cob_id | INVALID, 4)
        self._write((mapping, 0), 0, 1)
        for entry, word in enumerate(pdo.words, 1):
            self._write((mapping, entry), word, 4)
        self._write((mapping, 0), len(pdo.words), 1)
        self._write((communication, 2), pdo.transmission_type, 1)
        if pdo.transmission_type in EVENT_DRIVEN:
            self._configure_timer(communication)
        # the device's own RTR bit is kept: some accept one value only
        enabled = cob_id & NO_RTR | pdo.cob_id & CAN_ID
        self._write((communication, 1), enabled, 4)
        # read back at the end and not after each write: a later write may undo an earlier one
        self._compare((mapping, 0), len(pdo.words), 1, "number of mapped objects")
        for entry, word in enumerate(pdo.words, 1):
            self._compare((mapping, entry), word, 4, "mapping entry")
        self._compare((communication, 2), pdo.transmission_type, 1, "transmission type")
        self._compare((communication, 1), enabled, 4, "COB-ID")

    def _configure_timer(self, communication: int) -> None:
        """Event timer, and inhibit time where the node has one: a value that flickers must not fill the bus."""
        if self._optional((communication, _INHIBIT_TIME)) is not None:
            self._put((communication, _INHIBIT_TIME), 10 * EVENT_MS, 2, "inhibit time in 100 us")
        self._put((communication, _EVENT_TIMER), EVENT_MS, 2, "event timer in ms")

    def configure_sync(self) -> None:
        """1005h must be the SYNC that jtqd sends; 1019h tells a node that has it of the counter byte."""
        found = self._number((0x1005, 0), 4)
        wanted = self._settings.sync_cob_id
        if found & CAN_ID != wanted:
            raise mismatch(
                self._node, (0x1005, 0), "COB-ID SYNC", expected=f"{wanted:03X}h", found=f"0x{found:08X}"
            )
        overflow = self._settings.counter_overflow
        if overflow is not None and self._optional((0x1019, 0)) is not None:
            self._put((0x1019, 0), overflow, 1, "SYNC counter overflow")

    def configure_heartbeat(self) -> None:
        """The node's heartbeat, and on drives the supervision of the master's: its loss must stop them."""
        settings = self._settings
        if isinstance(self._profile, DriveProfile):
            consumer = settings.master_node << 16 | settings.master_timeout_ms
            self._put((0x1016, 1), consumer, 4, "consumer heartbeat time")
        self._put((0x1017, 0), settings.heartbeat_ms, 2, "producer heartbeat time")

    def read_scaling(self) -> tuple[DriveScaling | SensorScaling, float | None]:
        """Scaling objects, checked for plausibility; (scaling, gear ratio)."""
        profile = self._profile
        values = {key: self._number(key, 4) for key in profile.scaling_objects}
        if isinstance(profile, DriveProfile):
            return drive_scaling(profile, values)
        for channel in profile.channels:
            self._check_channel((OPERATING_MODE_OBJECT, channel))
        return sensor_scaling(profile, values), None

    def _check_channel(self, key: Key) -> None:
        mode = self._optional(key)
        if mode is not None and mode[:1] != b"\x01":
            found = str(int.from_bytes(mode, "little"))
            raise mismatch(
                self._node, key, "channel operating mode", expected="1 (normal operation)", found=found
            )

    # SDO with the node's name on it -------------------------------------------------------------------------

    def _read(self, key: Key, letter: str) -> bytes:
        try:
            return self._access.read(*key)
        except SdoSilence as silence:
            raise no_answer(self._node, key, silence.waited_s, letter) from silence

    def _number(self, key: Key, size: int, letter: str = "") -> int:
        try:
            raw = self._read(key, letter)
        except SdoAbort as abort:
            raise refused(self._node, key, "read", abort.code, letter) from abort
        self._found[key] = int.from_bytes(raw[:size], "little")
        return self._found[key]

    def _optional(self, key: Key) -> bytes | None:
        """None when the device does not have the object."""
        try:
            return self._read(key, "")
        except SdoAbort as abort:
            if abort.code in _ABSENT:
                return None
            raise refused(self._node, key, "read", abort.code) from abort

    def _write(self, key: Key, value: int, size: int) -> None:
        try:
            self._access.write(*key, value.to_bytes(size, "little"))
        except SdoSilence as silence:
            raise no_answer(self._node, key, silence.waited_s, "J") from silence
        except SdoAbort as abort:
            what = f"write of 0x{value:0{2 * size}X}"
            raise refused(self._node, key, what, abort.code, "J") from abort

    def _compare(self, key: Key, wanted: int, size: int, name: str) -> None:
        found = self._number(key, size, letter="J")
        if found != wanted:
            digits = 2 * size
            raise mismatch(
                self._node,
                key,
                f"{name} read back",
                expected=f"0x{wanted:0{digits}X}",
                found=f"0x{found:0{digits}X}",
                letter="J",
            )

    def _put(self, key: Key, value: int, size: int, name: str) -> None:
        self._write(key, value, size)
        self._compare(key, value, size, name)

    def _hash(self) -> str:
        """SHA-256 over every value found, in the order of the objects."""
        lines = [
            f"{index:04X}h:{subindex}={value}\n" for (index, subindex), value in sorted(self._found.items())
        ]
        return hashlib.sha256("".join(lines).encode()).hexdigest()


def reset_during_boot(node: int) -> BootError:
    """The node sent a boot-up message after it had been configured: its mapping is the default one again."""
    detail = "it restarted during boot (boot-up message): its configuration is lost"
    return BootError(node, "1000h:0", expected="no restart", found="boot-up message", detail=detail)
