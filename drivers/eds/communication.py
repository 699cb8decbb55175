"""Objects of the communication profile that the sheets share (CiA 301, 1000h..1FFFh)."""

from __future__ import annotations

from collections.abc import Sequence

from jtqd.drivers.eds.sheet import ARRAY, RECORD, TEXT, U8, U16, U32, Entries, Objects, Var, array, record
from jtqd.drivers.pdo import INVALID as PDO_INVALID
from jtqd.drivers.pdo import NO_RTR

SYNC_PRODUCER = 0x4000_0000  # bit 30 of 1005h


def device(device_type: int, name: str, hardware: str, software: str) -> Objects:
    """Describe device type, error register and names."""
    return {
        0x1000: Var("Device type", U32, "ro", device_type),
        0x1001: Var("Error register", U8, "ro", 0, pdo=True),
        0x1008: Var("Manufacturer device name", TEXT, "const", name),
        0x1009: Var("Manufacturer hardware version", TEXT, "const", hardware),
        0x100A: Var("Manufacturer software version", TEXT, "const", software),
    }


def identity(vendor: int, product: int, revision: int) -> Objects:
    """Describe 1018h; the serial number is each device's own."""
    members = [
        ("Vendor-ID", vendor),
        ("Product code", product),
        ("Revision number", revision),
        ("Serial number", 0),
    ]
    return {0x1018: record("Identity object", *(Var(name, U32, "ro", value) for name, value in members))}


def errors(behaviour_access: str = "rw", behaviour: int = 0, inhibit: int = 0) -> Objects:
    """Describe error history, EMCY and error behaviour."""
    history = {i: Var(f"Standard error field {i}", U32, "ro", 0) for i in range(1, 9)}
    return {
        0x1003: Entries(
            "Pre-defined error field", ARRAY, history, Var("Number of errors", U8, "rw", 0, low=0, high=8)
        ),
        0x1014: Var("COB-ID EMCY", U32, "const", "$NODEID+0x80"),
        0x1015: Var("Inhibit time EMCY", U16, "rw", inhibit, comment="100 us"),
        0x1029: array("Error behaviour", U8, behaviour_access, [("Communication error", behaviour)]),
    }


def verify_configuration(access: str) -> Objects:
    """Describe 1020h, the master's signature of the configuration; 0: changed since, or never written."""
    names = ("Configuration date", "Configuration time")
    return {0x1020: array("Verify configuration", U32, access, [(name, 0) for name in names])}


def heartbeat(producer_ms: int = 0, consumed: int = 1) -> Objects:
    """Describe the heartbeats consumed (the master's first) and the one produced."""
    watched = [(f"Consumer heartbeat time {n}", 0) for n in range(1, consumed + 1)]
    return {
        0x1016: array("Consumer heartbeat time", U32, "rw", watched),
        0x1017: Var("Producer heartbeat time", U16, "rw", producer_ms, comment="ms"),
    }


def sync_consumer() -> Objects:
    """Describe SYNC as its receiver sees it; 1019h: whether a counter byte is expected."""
    return {
        0x1005: Var("COB-ID SYNC message", U32, "const", 0x80),
        0x1019: Var("Synchronous counter overflow value", U8, "rw", 0, low=0, high=240),
    }


def sdo_server() -> Objects:
    """Describe the default SDO channel."""
    to_server = Var("COB-ID client to server", U32, "ro", "$NODEID+0x600")
    to_client = Var("COB-ID server to client", U32, "ro", "$NODEID+0x580")
    return {0x1200: record("SDO server parameter", to_server, to_client)}


def rpdo(number: int, base: int, mapping: Sequence[int]) -> Objects:
    """Describe RPDO `number` (1..4), valid from power-on, event-driven."""
    communication = record(
        "RPDO communication parameter",
        Var("COB-ID used by RPDO", U32, "rw", f"$NODEID+0x{base:X}"),
        Var("Transmission type", U8, "rw", 255),
    )
    return {0x1400 + number - 1: communication, 0x1600 + number - 1: _mapping("RPDO", mapping, "rw")}


def tpdo(
    number: int,
    base: int,
    mapping: Sequence[int],
    *,
    transmission: int = 255,
    fixed: bool = False,
    off: bool = False,
    event_ms: int = 0,
) -> Objects:
    """Describe TPDO `number` (1..4), valid from power-on unless `off`. Sub-index 4 is reserved and absent."""
    access = "const" if fixed else "rw"
    cob_id = NO_RTR + base + (PDO_INVALID if off else 0)
    members = {
        1: Var("COB-ID used by TPDO", U32, "ro" if off else access, f"$NODEID+0x{cob_id:08X}"),
        2: Var("Transmission type", U8, access, transmission),
        3: Var("Inhibit time", U16, access, 0, comment="100 us"),
        5: Var("Event timer", U16, access, event_ms, comment="ms"),
        6: Var("SYNC start value", U8, access, 0, low=0, high=240),
    }
    communication = Entries("TPDO communication parameter", RECORD, members)
    return {0x1800 + number - 1: communication, 0x1A00 + number - 1: _mapping("TPDO", mapping, access)}


def _mapping(kind: str, mapping: Sequence[int], access: str) -> Entries:
    present = len(mapping) if access == "const" else 8
    words = [*mapping, *[0] * (present - len(mapping))]
    entries = {i: Var(f"Mapping entry {i}", U32, access, word) for i, word in enumerate(words, 1)}
    count = Var("Number of mapped objects", U8, access, len(mapping), low=0, high=8)
    return Entries(f"{kind} mapping parameter", RECORD, entries, count)
