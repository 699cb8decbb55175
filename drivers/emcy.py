"""EMCY messages (CiA 301, 7.2.7): the eight bytes, the codes in words, and the history 1003h. Pure."""

from __future__ import annotations

import struct
from typing import NamedTuple

from jtqd.drivers.object_dictionary import ObjectStore
from jtqd.drivers.sdo import VALUE_RANGE, SdoAbort

EMCY_BASE = 0x080
"""COB-ID of a node's messages, less its node-ID."""
EMCY = struct.Struct("<HB5s")
"""Error code, error register (1001h), manufacturer's field."""
NO_ERROR = 0x0000
NO_SYNC, CAN_OVERRUN, CAN_PASSIVE, HEARTBEAT_LOST, BUS_OFF_RECOVERED = 0x8100, 0x8110, 0x8120, 0x8130, 0x8140
COB_ID_COLLISION = 0x8150
JOINT_FAULT, FAULT_LATCHED, NODE_CHANGED = 0xFF01, 0xFF02, 0xFF03
"""Of jtqd: a joint has no torque because of a fault; a latched fault waits for its reset; a node is not configured as at its
boot. The detail is the node-ID."""
PDO_SHORT, PDO_LONG, SYNC_LENGTH, PDO_TIMEOUT = 0x8210, 0x8220, 0x8240, 0x8250
GENERIC, COMMUNICATION = 0x01, 0x10
"""Bits of 1001h."""

_EXACT = {
    0x2310: "continuous overcurrent",
    0x2320: "short circuit or earth leakage",
    0x2340: "short circuit, motor side",
    0x3110: "mains overvoltage",
    0x3120: "mains undervoltage",
    0x3210: "DC link overvoltage",
    0x3220: "DC link undervoltage",
    0x4210: "excess temperature of the device",
    0x4310: "excess temperature of the drive",
    0x5441: "contactor, motor blocked",
    0x6010: "software reset by watchdog",
    0x7121: "motor blocked",
    0x7305: "incremental sensor 1",
    0x7306: "incremental sensor 2",
    0x7310: "speed",
    0x7320: "position",
    CAN_OVERRUN: "CAN overrun, objects lost",
    CAN_PASSIVE: "CAN in error passive mode",
    HEARTBEAT_LOST: "life guard or heartbeat",
    BUS_OFF_RECOVERED: "recovered from bus-off",
    COB_ID_COLLISION: "transmit COB-ID collision",
    PDO_SHORT: "PDO not processed due to length error",
    PDO_LONG: "PDO length exceeded",
    0x8230: "DAM MPDO not processed",
    SYNC_LENGTH: "unexpected length of SYNC",
    PDO_TIMEOUT: "RPDO timeout",
    JOINT_FAULT: "joint fault",
    FAULT_LATCHED: "fault latched",
    NODE_CHANGED: "configuration of a node changed",
    0x8311: "excess torque",
    0x8400: "speed control",
    0x8500: "position control",
    0x8611: "following error",
    0x8612: "reference limit",
}
_BY_HIGH_BYTE = {
    0x00: "no error",
    0x10: "generic error",
    0x20: "current",
    0x21: "current, device input side",
    0x22: "current inside the device",
    0x23: "current, device output side",
    0x30: "voltage",
    0x31: "mains voltage",
    0x32: "voltage inside the device",
    0x33: "output voltage",
    0x40: "temperature",
    0x41: "ambient temperature",
    0x42: "device temperature",
    0x43: "drive temperature",
    0x44: "supply temperature",
    0x50: "device hardware",
    0x60: "device software",
    0x61: "internal software",
    0x62: "user software",
    0x63: "data set",
    0x70: "additional modules",
    0x71: "power",
    0x72: "measurement circuit",
    0x73: "sensor",
    0x80: "monitoring",
    0x81: "communication",
    0x82: "protocol error",
    0x83: "torque control",
    0x84: "velocity speed controller",
    0x85: "position controller",
    0x86: "positioning controller",
    0x90: "external error",
    0xF0: "additional functions",
    0xFF: "device specific",
}
_REGISTER = (
    "generic",
    "current",
    "voltage",
    "temperature",
    "communication",
    "profile",
    "reserved",
    "manufacturer",
)


class Emergency(NamedTuple):
    """One received message; what a short frame leaves out is zero, and `length` is that of the frame."""

    code: int
    register: int
    manufacturer: bytes
    length: int = 8


def parse(data: bytes) -> Emergency:
    """Decode any frame of 0..8 bytes under an EMCY identifier; a short one as far as it goes, never an error."""
    code, register, manufacturer = EMCY.unpack(bytes(data[:8]).ljust(8, b"\0"))
    return Emergency(code, register, manufacturer, len(data))


def name_of(code: int) -> str:
    """Return the code in words: its own name, or that of its group (CiA 301 table 26, CiA 402)."""
    if code in _EXACT:
        return _EXACT[code]
    group = _BY_HIGH_BYTE.get(code >> 8) or _BY_HIGH_BYTE.get(code >> 8 & 0xF0)
    return group or "unknown group"


def register_text(register: int) -> str:
    """Return the bits of 1001h in words."""
    return ", ".join(name for bit, name in enumerate(_REGISTER) if register >> bit & 1) or "none"


def describe(emergency: Emergency) -> str:
    """Return one line: "EMCY 2310h (continuous overcurrent), register 03h (generic, current)"."""
    code, register, manufacturer, length = emergency
    text = f"EMCY {code:04X}h ({name_of(code)}), register {register:02X}h ({register_text(register)})"
    if any(manufacturer):
        text += f", {manufacturer.hex(' ')}"
    return text if length == 8 else f"{text}, a frame of {length} bytes"


HISTORY_INDEX = 0x1003


class ErrorHistory:
    """Pre-defined error field 1003h of a store (CiA 301, 7.5.2.4): newest error first, cleared by writing 0.

    Its depth is the number of sub-indices that the EDS gives it.
    """

    def __init__(self, store: ObjectStore) -> None:
        self._store = store
        self._depth = max(subindex for index, subindex in store.entries if index == HISTORY_INDEX)
        store.on_write(HISTORY_INDEX, 0, self._clear)

    def push(self, error: int) -> None:
        """Put an error first (EMCY code in the low word); the oldest falls out when the field is full."""
        count = self._store.number(HISTORY_INDEX, 0)
        kept = [self._store.number(HISTORY_INDEX, subindex) for subindex in range(1, count + 1)]
        recent = [error, *kept][: self._depth]
        for subindex, value in enumerate(recent, 1):
            self._store.set_number(HISTORY_INDEX, subindex, value)
        self._store.set_number(HISTORY_INDEX, 0, len(recent))

    def _clear(self, data: bytes) -> None:
        if data != b"\0":
            raise SdoAbort(VALUE_RANGE)
        for subindex in range(1, self._depth + 1):
            self._store.set_number(HISTORY_INDEX, subindex, 0)
