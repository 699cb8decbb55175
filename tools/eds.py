"""Electronic data sheets (CiA 306) that ship: `python -m tools.eds` writes drivers/eds/*.eds from the tables of this module.

The files are what ships and what a configuration tool reads; a test compares them with the tables.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from jtqd.daemon.shared.counters import OBJECT_2200
from jtqd.drivers import object_dictionary
from jtqd.drivers.own_objects import (
    BUS_FIELDS,
    CONTACT_BASES,
    ESTIMATE_BASES,
    JOINT_PARAMETERS,
    PARAMETERS,
    ROOM,
    VERSION,
    ZERO_FIELDS,
    ZEROS,
    contact_tpdos,
    estimate_tpdos,
    own_sheet,
)
from jtqd.drivers.pdo import INVALID as PDO_INVALID
from jtqd.drivers.pdo import NO_RTR

FOLDER = Path(object_dictionary.__file__).parent / "eds"
REVISION = 0x0001_0000  # major 1 (CANopen behaviour), minor 0
FOUR_JOINTS = 0x0002_0000  # of jtqd with a second estimate PDO

VENDOR = 0x07A1
"""Of an emulation, not one that CiA has assigned: a real drive or sensor brings its own EDS."""
I8, I16, I32, U8, U16, U32, REAL32, TEXT = 0x02, 0x03, 0x04, 0x05, 0x06, 0x07, 0x08, 0x09
VAR, ARRAY, RECORD = 7, 8, 9
BIT_RATES = (10, 20, 50, 125, 250, 500, 800, 1000)
MANDATORY = (0x1000, 0x1001, 0x1018)


@dataclass(frozen=True)
class Var:
    """One variable: a whole object or a sub-index.

    Attributes:
        access: ro, wo, rw, rwr, rww or const (CiA 306, 4.6.3).
        default: a number, or text such as "$NODEID+0x80".
        pdo: it may be mapped.
        comment: unit or meaning, written as a comment line above its section.
    """

    name: str
    data_type: int
    access: str
    default: int | float | str | None = None
    pdo: bool = False
    low: int | None = None
    high: int | None = None
    comment: str = ""


@dataclass(frozen=True)
class Entries:
    """An array or a record; sub-index 0 holds the highest sub-index present, unless `sub0` is given."""

    name: str
    object_type: int
    members: dict[int, Var]
    sub0: Var | None = None

    @property
    def first(self) -> Var:
        """Sub-index 0."""
        return self.sub0 or Var("Highest sub-index supported", U8, "const", max(self.members))


Objects = dict[int, Var | Entries]
"""Of a device, by index."""


@dataclass(frozen=True)
class Sheet:
    """One EDS file; `comments` are its [Comments] lines."""

    file_name: str
    description: str
    product_name: str
    product_number: int
    revision_number: int
    order_code: str
    objects: Objects
    comments: Sequence[str] = ()
    vendor_name: str = "jtqd emulation"
    vendor_number: int = VENDOR


def array(
    name: str,
    data_type: int,
    access: str,
    members: Sequence[tuple[str, int | float | str | None]],
    pdo: bool = False,
) -> Entries:
    """Describe an array of one type; `members` are (name, default) of sub-index 1 onwards."""
    return Entries(name, ARRAY, {i: Var(n, data_type, access, d, pdo) for i, (n, d) in enumerate(members, 1)})


def record(name: str, *members: Var) -> Entries:
    """Describe a record whose sub-indices run without a gap."""
    return Entries(name, RECORD, dict(enumerate(members, 1)))


# Objects of the communication profile that the sheets share (CiA 301, 1000h..1FFFh)

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


# The sheets


def drive() -> Sheet:
    """Return the sheet of a CiA 402 servo drive with encoders on both sides of the gear."""
    objects: Objects = {
        **device(0x0002_0192, "emulated joint drive", "1.0", "1.0"),
        **errors(),
        **heartbeat(consumed=2),  # the master's, and that of a node which commands beside it
        **verify_configuration("rw"),
        **identity(VENDOR, 0x402, REVISION),
        **sync_consumer(),
        **sdo_server(),
        **rpdo(1, 0x200, [0x6040_0010, 0x6071_0010]),
        **rpdo(2, 0x300, [0x60FF_0020]),
        **tpdo(1, 0x180, [0x6041_0010]),
        **tpdo(2, 0x280, [0x6064_0020, 0x606C_0020]),
        **tpdo(3, 0x380, [0x3001_0010], event_ms=500),
        0x3001: Var("Joint temperature", I16, "ro", 0, pdo=True, comment="0.1 degC; 8000h: not measured"),
        0x603F: Var("Error code", U16, "ro", 0, pdo=True),
        0x6040: Var("Controlword", U16, "rww", 0, pdo=True),
        0x6041: Var("Statusword", U16, "ro", 0, pdo=True),
        0x6060: Var("Modes of operation", I8, "rww", 0, pdo=True),
        0x6061: Var("Modes of operation display", I8, "ro", 0, pdo=True),
        0x6064: Var(
            "Position actual value", I32, "ro", 0, pdo=True, comment="increments of 608Fh, motor side"
        ),
        0x606C: Var("Velocity actual value", I32, "ro", 0, pdo=True, comment="units of 6090h, motor side"),
        0x6071: Var("Target torque", I16, "rww", 0, pdo=True, comment="1/1000 of 6076h"),
        0x6075: Var("Motor rated current", U32, "rw", 5000, low=1, comment="mA"),
        0x6076: Var("Motor rated torque", U32, "rw", 500, low=1, comment="mNm, motor side"),
        0x6077: Var("Torque actual value", I16, "ro", 0, pdo=True, comment="1/1000 of 6076h"),
        0x6078: Var("Current actual value", I16, "ro", 0, pdo=True, comment="1/1000 of 6075h"),
        0x608F: array(
            "Position encoder resolution",
            U32,
            "ro",
            [("Encoder increments", 65536), ("Motor revolutions", 1)],
        ),
        0x6090: array(
            "Velocity encoder resolution",
            U32,
            "ro",
            [("Encoder increments per second", 65536), ("Motor revolutions per second", 1)],
        ),
        0x6091: array(
            "Gear ratio", U32, "ro", [("Motor shaft revolutions", 100), ("Driving shaft revolutions", 1)]
        ),
        0x60C2: record(
            "Interpolation time period",
            Var("Interpolation time period value", U8, "rw", 1, low=1, high=255),
            Var("Interpolation time index", I8, "rw", -3, low=-128, high=63),
        ),
        0x60E4: array("Additional position actual value", I32, "ro", [("Link position", 0)], pdo=True),
        0x60E6: array(
            "Additional position encoder resolution - encoder increments",
            U32,
            "ro",
            [("Link encoder increments", 524288)],
        ),
        0x60EB: array(
            "Additional position encoder resolution - motor revolutions", U32, "ro", [("Link revolutions", 1)]
        ),
        0x60FF: Var("Target velocity", I32, "rww", 0, pdo=True, comment="units of 6090h, motor side"),
        0x6502: Var("Supported drive modes", U32, "ro", 0x300, comment="csv (bit 8), cst (bit 9)"),
    }
    note = "Defaults of TPDO1 and TPDO2 are not those jtqd uses: it writes its own mapping at boot."
    return Sheet(
        "drive.eds",
        "CiA 402 joint drive",
        "emulated joint drive",
        0x402,
        REVISION,
        "JTQ-DRIVE",
        objects,
        [note],
    )


def torque_sensor() -> Sheet:
    """Return the sheet of a CiA 404 measuring device with two torque channels."""

    def channels(name: str, data_type: int, access: str, *defaults: int, pdo: bool = False) -> Entries:
        return array(
            name, data_type, access, [(f"{name} {n}", d) for n, d in enumerate(defaults, 1)], pdo=pdo
        )

    objects: Objects = {
        **device(0x0002_0194, "emulated torque sensor", "1.0", "1.0"),
        **errors(),
        **heartbeat(),
        **identity(VENDOR, 0x404, REVISION),
        **sync_consumer(),
        **sdo_server(),
        **tpdo(1, 0x180, [0x7130_0110]),
        **tpdo(2, 0x280, [0x7130_0210]),
        0x6110: channels("AI sensor type", U16, "rw", 0, 0),
        0x6112: channels("AI operating mode", U8, "rw", 1, 1),
        0x6114: channels("AI ADC sample rate", U32, "rw", 1000, 1000),
        0x6125: Entries(
            "AI autozero",
            ARRAY,
            {n: Var(f"AI autozero {n}", U32, "wo", comment='write 0x6F72657A ("zero")') for n in (1, 2)},
        ),
        # SI prefix 10^0, numerator 23h joule = Nm, no denominator (CiA 303-2)
        0x6131: channels("AI physical unit process value", U32, "rw", 0x0023_0000, 0x0023_0000),
        # Two digits keep the second channel's 16-bit value within +-327 Nm
        0x6132: channels("AI decimal digits process value", U8, "rw", 3, 2),
        0x6150: channels("AI status", U8, "ro", 0, 0, pdo=True),
        0x7130: channels("AI input process value 16-bit", I16, "ro", 0, 0, pdo=True),
        0x9130: channels("AI input process value 32-bit", I32, "ro", 0, 0, pdo=True),
    }
    note = "Default TPDOs are not those jtqd uses: it writes its own mapping at boot."
    return Sheet(
        "torque_sensor.eds",
        "CiA 404 torque sensor, two channels",
        "emulated torque sensor",
        0x404,
        REVISION,
        "JTQ-SENSOR",
        objects,
        [note],
    )


def jtqd_node(room: int = ROOM[0]) -> Sheet:
    """Return the sheet of the daemon's own node: SYNC producer with the estimates of up to `room` joints as its PDOs."""
    revision = REVISION if room == ROOM[0] else FOUR_JOINTS
    objects = {
        **_own_communication(room, revision),
        **_own_pdos(room),
        **_mapped_objects(room),
        **_sdo_objects(room),
    }
    note = [
        "2100h in 0.01 Nm, 8000h: no estimate. 2101h in 0.05 Nm, 255: more or unknown.",
        "2104h: bits 0 not finite, 1 out of range, 2 motor jump, 3 link jump, 4 velocity mismatch,",
        "5 torsion, 6 current frozen, 7 deviation, 8 drive fault, 9 stale, 10 repeated. 2110h: 1 releases them.",
        "2106h in 32 Nm/s, 80h: no rate. 2107h: 0 not watched, 1 unknown, 2 none, 3 positive, 4 negative.",
        "1802h:1 (and 1803h:1) valid where contacts are sent.",
        "2205h:1 0 error active, 1 warning, 2 passive, 3 bus-off, 4 interface down.",
        "2206h: NMT state, heartbeat (1 awaited, 2 heard, 3 lost), configured, node-ID; from the lowest byte.",
        "2207h: error code (2 bytes), error register, number of messages.",
        "220Eh: bits 0 tracked, 1 learned, 2 beyond its limit, 3 not yet taken off, 4 current and torsion disagree.",
    ]
    return Sheet(
        own_sheet(room), "joint torque estimator daemon", "jtqd", 0x001, revision, "JTQD", objects, note
    )


def _own_communication(room: int, revision: int) -> Objects:
    """Describe jtqd as CiA 301 sees it: producer of SYNC, consumer of the heartbeats of drives and sensor."""
    nodes = [(f"Node {n}", 0) for n in range(1, len(_nodes(room)) + 1)]
    return {
        **device(0, "jtqd", "none", VERSION),
        **errors(behaviour_access="const", behaviour=1, inhibit=100),
        0x1005: Var("COB-ID SYNC message", U32, "const", SYNC_PRODUCER + 0x80),
        0x1006: Var("Communication cycle period", U32, "const", 1000, comment="us"),
        0x1016: array("Consumer heartbeat time", U32, "ro", nodes),
        0x1017: Var("Producer heartbeat time", U16, "const", 100, comment="ms"),
        **identity(VENDOR, 0x001, revision),
        0x1019: Var("Synchronous counter overflow value", U8, "const", 240, low=0, high=240),
        **verify_configuration("ro"),
        **sdo_server(),
    }


def _own_pdos(room: int) -> Objects:
    """Describe the estimate PDOs (TPDO1, TPDO2) and the contact PDOs (TPDO3, TPDO4), which are off until they are wanted."""
    found: Objects = {}
    for number, (pdo, base) in enumerate(zip(estimate_tpdos(room), ESTIMATE_BASES, strict=False), start=1):
        found |= tpdo(number, base, pdo.words, transmission=1, fixed=True)
    for number, (pdo, base) in enumerate(zip(contact_tpdos(room), CONTACT_BASES, strict=False), start=3):
        found |= tpdo(number, base, pdo.words, transmission=1, fixed=True, off=True)
    return found


def _mapped_objects(room: int) -> Objects:
    """Describe what the PDOs are made of."""
    names = _joint_names(room)

    def of_two(name: str, joint: int) -> Var:
        text = f"low nibble joint {joint}, high nibble joint {joint + 1}"
        return Var(name, U8, "ro", 0, pdo=True, comment=text)

    found: Objects = {
        0x2100: array("Estimated torque", I16, "ro", [(name, 0) for name in names], pdo=True),
        0x2101: array("Standard deviation", U8, "ro", [(name, 255) for name in names], pdo=True),
        0x2102: of_two("Estimate status", 1),
        0x2103: Var("Estimate sequence", U8, "ro", 0, pdo=True, comment="SYNC counter of the inputs, 1..240"),
        0x2106: array("Torque rate", I8, "ro", [(name, -128) for name in names], pdo=True),
        0x2107: of_two("Contact", 1),
    }
    if room > ROOM[0]:
        found[0x2105] = of_two("Estimate status of joints 3 and 4", 3)
        found[0x2108] = of_two("Contact of joints 3 and 4", 3)
    return found


def _sdo_objects(room: int) -> Objects:
    """Describe what is read by SDO, and the one object that is written: the reset of latched faults."""
    joints = [(name, 0) for name in _joint_names(room)]
    nodes = [(name, 0) for name in _nodes(room)]
    reset = Var("Reset latched faults", U8, "rw", 0, low=0, high=1, comment="write 1; read: 1 not done yet")
    found: Objects = {
        0x2104: array("Latched faults", U16, "ro", joints),
        0x2110: reset,
        0x2200: array("Counters", U32, "ro", [(name, 0) for name in OBJECT_2200]),
        0x2201: array("Cycle time", U32, "ro", [("p50_us", 0), ("p99_us", 0), ("max_us", 0)]),
        0x2204: Var("Configuration hash", TEXT, "ro", ""),
        0x2205: array("Bus state", U32, "ro", [(name, 0) for name in BUS_FIELDS]),
        0x2206: array("Nodes", U32, "ro", nodes),
        0x2207: array("Last EMCY of nodes", U32, "ro", nodes),
        0x220E: array("Zero flags", U8, "ro", joints),
        0x220F: array("Zero jumps", U32, "ro", joints),
    }
    for title, indices, fields in (
        ("Parameters", PARAMETERS, JOINT_PARAMETERS),
        ("Zeros", ZEROS, ZERO_FIELDS),
    ):
        for joint, index in enumerate(indices[:room], start=1):
            found[index] = array(f"{title} of joint {joint}", REAL32, "ro", [(name, 0.0) for name in fields])
    return found


def _joint_names(room: int) -> list[str]:
    return [f"Joint {number}" for number in range(1, room + 1)]


def _nodes(room: int) -> list[str]:
    """Return the nodes that jtqd watches, in the order of its objects."""
    return [*_joint_names(room), "Sensor"]


# The file


def render(sheet: Sheet) -> str:
    """Return the text of the EDS file. Its date is fixed, so that the same tables give the same bytes."""
    indices = sorted(sheet.objects)
    mandatory = [i for i in indices if i in MANDATORY]
    manufacturer = [i for i in indices if 0x2000 <= i <= 0x5FFF]
    optional = [i for i in indices if i not in mandatory and i not in manufacturer]
    lines = [*_file_info(sheet), *_device_info(sheet, indices), *_section("DummyUsage", _dummies())]
    lines += _section(
        "Comments",
        [("Lines", len(sheet.comments)), *((f"Line{n}", c) for n, c in enumerate(sheet.comments, 1))],
    )
    for title, group in (("Mandatory", mandatory), ("Optional", optional), ("Manufacturer", manufacturer)):
        numbered = [(str(n), f"0x{i:04X}") for n, i in enumerate(group, 1)]
        lines += _section(f"{title}Objects", [("SupportedObjects", len(group)), *numbered])
        for index in group:
            lines += _object(index, sheet.objects[index])
    return "\n".join(lines)


def _section(title: str, pairs: Sequence[tuple[str, object]]) -> list[str]:
    return [f"[{title}]", *(f"{key}={value}" for key, value in pairs), ""]


def _file_info(sheet: Sheet) -> list[str]:
    when = [("CreationTime", "09:00AM"), ("CreationDate", "01-05-2026"), ("CreatedBy", sheet.vendor_name)]
    changed = [
        ("ModificationTime", "09:00AM"),
        ("ModificationDate", "01-05-2026"),
        ("ModifiedBy", sheet.vendor_name),
    ]
    head = [("FileName", sheet.file_name), ("FileVersion", 1), ("FileRevision", 0), ("EDSVersion", "4.0")]
    return _section("FileInfo", [*head, ("Description", sheet.description), *when, *changed])


def _device_info(sheet: Sheet, indices: list[int]) -> list[str]:
    names: list[tuple[str, object]] = [
        ("VendorName", sheet.vendor_name),
        ("VendorNumber", f"0x{sheet.vendor_number:08X}"),
        ("ProductName", sheet.product_name),
        ("ProductNumber", f"0x{sheet.product_number:08X}"),
        ("RevisionNumber", f"0x{sheet.revision_number:08X}"),
        ("OrderCode", sheet.order_code),
    ]
    rates: list[tuple[str, object]] = [(f"BaudRate_{rate}", int(rate == 1000)) for rate in BIT_RATES]
    features: list[tuple[str, object]] = [
        ("SimpleBootUpMaster", 0),
        ("SimpleBootUpSlave", 1),
        ("Granularity", 8),  # PDO mapping in whole bytes
        ("DynamicChannelsSupported", 0),
        ("CompactPDO", 0),
        ("GroupMessaging", 0),
        ("NrOfRXPDO", sum(0x1400 <= i < 0x1600 for i in indices)),
        ("NrOfTXPDO", sum(0x1800 <= i < 0x1A00 for i in indices)),
        ("LSS_Supported", 0),
    ]
    return _section("DeviceInfo", [*names, *rates, *features])


def _dummies() -> list[tuple[str, object]]:
    return [(f"Dummy{number:04d}", 0) for number in range(1, 8)]


def _object(index: int, described: Var | Entries) -> list[str]:
    if isinstance(described, Var):
        return _variable(f"{index:04X}", described)
    members = {0: described.first, **described.members}
    head = [
        ("ParameterName", described.name),
        ("ObjectType", f"0x{described.object_type:X}"),
        ("SubNumber", len(members)),
    ]
    lines = _section(f"{index:04X}", head)
    for subindex, member in sorted(members.items()):
        lines += _variable(f"{index:04X}sub{subindex:X}", member)
    return lines


def _variable(title: str, variable: Var) -> list[str]:
    pairs: list[tuple[str, object]] = [
        ("ParameterName", variable.name),
        ("ObjectType", f"0x{VAR:X}"),
        ("DataType", f"0x{variable.data_type:04X}"),
        ("AccessType", variable.access),
    ]
    if variable.low is not None:
        pairs.append(("LowLimit", variable.low))
    if variable.high is not None:
        pairs.append(("HighLimit", variable.high))
    if variable.default is not None:
        pairs.append(("DefaultValue", _number(variable)))
    pairs.append(("PDOMapping", int(variable.pdo)))
    lines = _section(title, pairs)
    return [f"; {variable.comment}", *lines] if variable.comment else lines


def _number(variable: Var) -> str:
    default = variable.default
    if isinstance(default, int) and variable.data_type == U32 and default > 0xFFFF:
        return f"0x{default:08X}"
    return str(default)


SHEETS: tuple[Callable[[], Sheet], ...] = (drive, torque_sensor, *(partial(jtqd_node, room) for room in ROOM))


def main() -> int:
    """Write the files; there are no arguments."""
    if len(sys.argv) > 1:
        print("usage: python -m tools.eds   (writes the data sheets in drivers/eds)", file=sys.stderr)
        return 0 if sys.argv[1] in ("-h", "--help") else 2
    for sheet in (make() for make in SHEETS):
        (FOLDER / sheet.file_name).write_text(render(sheet), encoding="ascii", newline="\n")
        print(FOLDER / sheet.file_name, file=sys.stderr)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
