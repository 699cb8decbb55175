"""An electronic data sheet: the description of its objects, and the writer of the file (CiA 306)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

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
