"""Object dictionary of a node, typed and guarded by its EDS (CiA 301, CiA 306), its EDS, and its SDO server.

`read` and `write` are those of a remote SDO client: access rights, lengths and limits hold, and a refusal is an `SdoAbort`
with the code of CiA 301 table 22. `number`, `set_number`, `set_text` are the device's own access to the same values,
without rights. `SdoServer` answers requests by expedited and segmented transfers (CiA 301, 7.2.4.3.3 to 7.2.4.3.8); it has
no block transfer. No bus and no clock.
"""

from __future__ import annotations

import logging
import re
import struct
from collections.abc import Callable, Iterable, Mapping
from configparser import NoOptionError, RawConfigParser
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from jtqd.drivers.sdo import (
    HEADER,
    INITIATE,
    LENGTH_MISMATCH,
    LENGTH_TOO_HIGH,
    LENGTH_TOO_LOW,
    NO_OBJECT,
    NO_SUBINDEX,
    OUT_OF_MEMORY,
    READ_OF_WRITE_ONLY,
    TOGGLE,
    TOGGLE_NOT_ALTERNATED,
    UNKNOWN_COMMAND,
    VALUE_RANGE,
    WRITE_OF_READ_ONLY,
    Key,
    SdoAbort,
    abort_frame,
    label,
)
from jtqd.estimator.errors import ConfigError, OneLineError
from jtqd.estimator.files import read_regular

# Data types (CiA 301, 7.4.7)
BOOLEAN, REAL32, VISIBLE_STRING, REAL64 = 0x01, 0x08, 0x09, 0x11
_INTEGERS = {
    BOOLEAN: "B",
    0x02: "b",
    0x03: "h",
    0x04: "i",
    0x05: "B",
    0x06: "H",
    0x07: "I",
    0x15: "q",
    0x1B: "Q",
}
"""Struct letters; a BOOLEAN takes a byte in an SDO."""
_LETTERS = {**_INTEGERS, REAL32: "f", REAL64: "d"}
_LAYOUTS = {data_type: struct.Struct("<" + letter) for data_type, letter in _LETTERS.items()}
_SIGNED = frozenset({0x02, 0x03, 0x04, 0x15})
_DOMAIN, _VAR = 2, 7  # object types of a single variable (CiA 301, 7.4.3)
_FIRST_REAL_INDEX = 0x1000  # below: dummy entries of [DummyUsage], which are types and not objects
_LARGEST_EDS = 16_000_000
"""Bytes; those of large drives have one million."""


@dataclass(frozen=True)
class Identity:
    """Expected 1018h and software version; None: not checked."""

    vendor: int | None = None
    product: int | None = None
    revision: int | None = None
    serial: int | None = None
    software: str | None = None
    """100Ah."""


ANY_IDENTITY = Identity()


ReadHook = Callable[[], "bytes | float"]
WriteHook = Callable[[bytes], None]


@dataclass(frozen=True)
class Entry:
    """One (index, sub-index) of the EDS. `access` is one of ro, wo, rw, rwr, rww, const (CiA 306 4.6.3)."""

    index: int
    subindex: int
    name: str
    data_type: int
    access: str
    mappable: bool
    low: int | None
    high: int | None
    default: bytes
    fault: str = ""
    """Why it cannot be read, with file, line and section; "" where it can. Its data type is then 0, or its default zero."""

    @property
    def layout(self) -> struct.Struct | None:
        """Of its bytes; None for strings and domains."""
        return _LAYOUTS.get(self.data_type)

    @property
    def title(self) -> str:
        """The object and its name, for messages."""
        return f"{label(self.index, self.subindex)} {self.name}"

    @property
    def readable(self) -> bool:
        """Whether a client may upload it."""
        return self.access != "wo"

    @property
    def writable(self) -> bool:
        """Whether a client may download it."""
        return self.access in ("wo", "rw", "rwr", "rww")

    @property
    def is_integer(self) -> bool:
        """Whether it is a whole number of 8..64 bits, which a PDO may map."""
        return self.data_type in _INTEGERS and self.data_type != BOOLEAN

    @property
    def signed(self) -> bool:
        """Whether the number is a two's complement one."""
        return self.data_type in _SIGNED

    @property
    def bits(self) -> int:
        """Length of the object; 0 for strings and domains, which have none of their own."""
        return self.layout.size * 8 if self.layout else 0


class ObjectStore:
    """Values of one node. A client is refused by SdoAbort; ValueError: a number does not fit its object."""

    def __init__(self, entries: Path | str | Iterable[Entry], node_id: int) -> None:
        """Take the entries of an EDS file, or those that were read from one (see `read_eds`)."""
        if not 1 <= node_id <= 127:
            raise ValueError(f"node id {node_id}, expected 1..127")
        self.node_id = node_id
        if isinstance(entries, Path | str):
            entries = read_eds(entries, node_id).entries
        self.entries: dict[tuple[int, int], Entry] = {(each.index, each.subindex): each for each in entries}
        self._indices: set[int] = {index for index, _ in self.entries}
        self._values = {key: entry.default for key, entry in self.entries.items()}
        self._on_read: dict[tuple[int, int], ReadHook] = {}
        self._on_write: dict[tuple[int, int], WriteHook] = {}

    # Access of a remote client ------------------------------------------------------------------------

    def entry(self, index: int, subindex: int) -> Entry:
        """Return the description of an object. Raises SdoAbort 06020000h or 06090011h when there is none, EdsError."""
        found = self.entries.get((index, subindex))
        if found is None:
            raise SdoAbort(NO_SUBINDEX if index in self._indices else NO_OBJECT)
        if found.fault:
            raise EdsError(found.fault)
        return found

    def read(self, index: int, subindex: int) -> bytes:
        """Return the value for an SDO upload. Raises SdoAbort when absent or write-only."""
        entry = self.entry(index, subindex)
        if not entry.readable:
            raise SdoAbort(READ_OF_WRITE_ONLY)
        return self._value(entry)

    def write(self, index: int, subindex: int, data: bytes) -> None:
        """Store an SDO download after rights, length, limits and hook, which may refuse it too. Raises SdoAbort."""
        entry = self.check_write(index, subindex, len(data))
        if entry.layout is not None:
            (value,) = entry.layout.unpack(data)
            below = entry.low is not None and value < entry.low
            if below or (entry.high is not None and value > entry.high):
                raise SdoAbort(VALUE_RANGE)
        hook = self._on_write.get((index, subindex))
        if hook is not None:
            hook(data)
        self._values[index, subindex] = data

    def check_write(self, index: int, subindex: int, length: int | None) -> Entry:
        """Refuse a write before its data: absent, not writable, wrong length (None: not announced). Raises SdoAbort."""
        entry = self.entry(index, subindex)
        if not entry.writable:
            raise SdoAbort(WRITE_OF_READ_ONLY)
        if entry.layout is not None and length is not None and length != entry.layout.size:
            if length == 0:
                raise SdoAbort(LENGTH_MISMATCH)
            raise SdoAbort(LENGTH_TOO_HIGH if length > entry.layout.size else LENGTH_TOO_LOW)
        return entry

    # Access of the device itself ----------------------------------------------------------------------

    def number(self, index: int, subindex: int = 0) -> int:
        """Return an integer, regardless of rights; a read hook is called."""
        entry = self.entry(index, subindex)
        if entry.data_type not in _INTEGERS or entry.layout is None:
            raise ValueError(f"{entry.title} is not an integer")
        (value,) = entry.layout.unpack(self._value(entry))
        return int(value)

    def set_number(self, index: int, subindex: int, value: float) -> None:
        """Set a number (integer or REAL32/64). No hook is called. Raises ValueError when it does not fit."""
        entry = self.entry(index, subindex)
        if entry.layout is None:
            raise ValueError(f"{entry.title} is not a number")
        try:
            self._values[index, subindex] = entry.layout.pack(value)
        except (struct.error, OverflowError) as error:
            raise ValueError(f"{entry.title}: {value!r} does not fit: {error}") from error

    def set_text(self, index: int, subindex: int, text: str) -> None:
        """Set a VISIBLE_STRING."""
        entry = self.entry(index, subindex)
        if entry.data_type != VISIBLE_STRING:
            raise ValueError(f"{entry.title} is not a string")
        self._values[index, subindex] = text.encode("ascii")

    def on_read(self, index: int, subindex: int, hook: ReadHook) -> None:
        """Call `hook()` for the value at each read: bytes, or a number that is packed to the object's type."""
        self.entry(index, subindex)
        self._on_read[index, subindex] = hook

    def on_write(self, index: int, subindex: int, hook: WriteHook) -> None:
        """Call `hook(data)` before a download is stored; an SdoAbort from it refuses the value."""
        self.entry(index, subindex)
        self._on_write[index, subindex] = hook

    def has(self, index: int, subindex: int = 0) -> bool:
        """Return whether the object exists."""
        return (index, subindex) in self.entries

    def restore(self, first: int = _FIRST_REAL_INDEX, last: int = 0xFFFF) -> None:
        """Restore power-on values: 1000h..1FFFh at NMT reset communication, all at reset node (CiA 301, 7.3.2.2)."""
        for key, entry in self.entries.items():
            if first <= entry.index <= last:
                self._values[key] = entry.default

    def keep_as_default(self, index: int, subindex: int) -> None:
        """Make the present value, such as a serial number, the power-on value."""
        entry = self.entry(index, subindex)
        self.entries[index, subindex] = replace(entry, default=self._values[index, subindex])

    def _value(self, entry: Entry) -> bytes:
        hook = self._on_read.get((entry.index, entry.subindex))
        if hook is None:
            return self._values[entry.index, entry.subindex]
        value = hook()
        if isinstance(value, bytes):
            return value
        if entry.layout is None:
            raise ValueError(f"{entry.title}: hook returned a number for a string")
        return entry.layout.pack(value)


class EdsError(OneLineError):
    """An EDS file, or an entry of it, that cannot be read; the message is one line with its path."""


@dataclass(frozen=True)
class Eds:
    """An EDS, or a DCF with the values of a configured device.

    Attributes:
        entries: sorted; one that cannot be read has a `fault`.
        notes: a line for each line and entry that cannot be read, with section and line of the file.
        configured: it has values in use (ParameterValue) beside defaults.
        node, bitrate: node-ID, and bit rate [bit/s], of the configured device; None: it has none.
    """

    entries: tuple[Entry, ...]
    notes: tuple[str, ...]
    configured: bool
    node: int | None
    bitrate: int | None


def read_eds(eds: Path | str, node_id: int) -> Eds:
    """Read an EDS or DCF, with $NODEID filled in. An entry that cannot be read refuses none of the others.

    An entry becomes a variable by canopen's parser. It is loaded here and not with this module: it takes 20 MB, and a
    process that is given its entries as JSON (`entries_to_json`, `entries_from_json`) does without. Raises EdsError for a
    file without an object.
    """
    name = str(eds) if str(eds).isprintable() else repr(str(eds))
    sections, odd = _sections(_eds_text(eds), name)
    _expand_compact(sections)
    entries = _entries(sections, node_id)
    if not entries:
        raise EdsError(f"{name}: found no object in it, expected an EDS or DCF (CiA 306)")
    setup = sections.get("DEVICECOMISSIONING") or sections.get("DEVICECOMMISSIONING") or _Section(name, "", 0)
    node, kilobit = setup.number("NodeID", 127), setup.number("Baudrate", 1000)
    odd += [(each.line, each.fault) for each in sections.values() if each.fault]
    notes = list(dict.fromkeys(text for _, text in sorted(odd)))
    if len(notes) > _MOST_NOTES:
        notes[_MOST_NOTES:] = [f"{name}: {len(notes) - _MOST_NOTES} more lines that cannot be read"]
    if node not in (None, node_id):
        notes.append(f"{name}: of node {node} by its NodeID, read for node {node_id}")
    return Eds(
        tuple(sorted(entries, key=lambda each: (each.index, each.subindex))),
        tuple(notes),
        any("parametervalue" in each.values for each in sections.values()),
        node,
        None if kilobit is None else 1000 * kilobit,
    )


_OBJECT = re.compile(r"([0-9A-F]{1,4})(?:sub([0-9A-F]{1,2})|(NAME|VALUE))?")
_MOST_NOTES = 8
_DESCRIBING = ("DataType", "AccessType", "PDOMapping", "ObjectType", "CompactSubObj")
_DECIDING = {each.lower(): each for each in (*_DESCRIBING, "DefaultValue", "ParameterValue")}
"""Keys by which an entry is what it is."""


@dataclass
class _Section:
    """A section of a file: its values by lower-case key with the line of each, and why its entry cannot be read."""

    file: str
    title: str
    line: int
    values: dict[str, str] = field(default_factory=dict)
    lines: dict[str, int] = field(default_factory=dict)
    fault: str = ""

    def at(self, line: int, what: str) -> str:
        """Return a note on a line."""
        return f"{self.file}: line {line}, [{self.title}]: {what}"

    def refuse(self, key: str, what: str) -> None:
        """Make it a fault that cannot be read, the first one for all."""
        self.fault = self.fault or self.at(self.lines.get(key.lower(), self.line), what)

    def number(self, key: str, most: int) -> int | None:
        """Return a number from 1 on; None where there is none, which is a fault for a text that is no such number."""
        text = self.values.get(key.lower(), "")
        value = _whole(text)
        if value is not None and 1 <= value <= most:
            return value
        if text and value != 0:
            self.refuse(key, f"{key}={_shown(text)}, expected 1..{most}")
        return None


def _sections(text: str, name: str) -> tuple[dict[str, _Section], list[tuple[int, str]]]:
    """Return the sections by name (1018sub1, 1018; all else in capitals), and what is odd in them: line and note."""
    section = _Section(name, "", 0)
    sections: dict[str, _Section] = {}
    odd: list[tuple[int, str]] = []
    for number, whole in enumerate(re.split(r"\r\n?|\n", text), 1):
        line = re.split(r"(?:^|\s);|^\s*#", whole, maxsplit=1)[0].strip()
        if line.startswith("["):
            written = line.strip("[] \t")
            title = written.upper().replace("SUB", "sub")
            if found := _OBJECT.fullmatch(title):
                title = f"{int(found[1], 16):X}" + (
                    f"sub{int(found[2], 16):X}" if found[2] else found[3] or ""
                )
            section = sections.setdefault(title, _Section(name, _shown(written), number))
            continue
        key, equals, value = (each.strip() for each in line.partition("="))
        own, what = key.lower(), f"found {_shown(line)}"
        if line and not (key and equals):
            odd.append((number, section.at(number, f"{what}, expected KEY=VALUE")))
            decides = re.split(r"\W", own, maxsplit=1)[0] in _DECIDING
            section.fault = section.fault or (odd[-1][1] if decides else "")
        elif value and section.values.setdefault(own, value) != value:
            before = f"line {section.lines[own]} has {_shown(section.values[own])}"
            odd.append((number, section.at(number, f"{what}, {before}")))
            section.fault = section.fault or (odd[-1][1] if own in _DECIDING else "")
        elif value:
            section.lines[own] = number
    return sections, odd


def _shown(text: str) -> str:
    """Return text of a file as a line can show it; of a binary file nothing."""
    return text[:40] if text.isprintable() else "bytes that are no text"


def _expand_compact(sections: dict[str, _Section]) -> None:
    """Give the members that an object has in its own section (CompactSubObj) theirs, with name and value in use."""
    for title, section in list(sections.items()):
        if not (found := _OBJECT.fullmatch(title)) or found[2] or found[3]:
            continue
        count = section.number("CompactSubObj", 254) or (254 if section.fault else 0)
        names, values = (sections.get(f"{title}{each}", section).values for each in ("NAME", "VALUE"))
        first = {"parametername": "Number of entries", "datatype": "5", "accesstype": "ro"}
        for sub in range(count + 1 if "compactsubobj" in section.values and count else 0):
            own = {"parametername": names.get(str(sub), f"Member {sub}")}
            if str(sub) in values:
                own["parametervalue"] = values[str(sub)]
            content = {**section.values, **own} if sub else {**first, "defaultvalue": str(count)}
            made = _Section(section.file, section.title, section.line, content, section.lines, section.fault)
            sections.setdefault(f"{title}sub{sub:X}", made)


def _whole(text: str) -> int | None:
    """Return a whole number as CiA 306 writes it; None for other text, and for digits that are another number in octal."""
    try:
        return int(text, 0)
    except ValueError:
        return int(text) if re.fullmatch("0+[1-7]", text) else None


def _eds_text(eds: Path | str) -> str:
    """Return the text of a regular file that is not too large. Raises EdsError.

    CiA 306 wants ASCII; makers write units and names in the code page of their machines.
    """
    try:
        data = read_regular(eds, _LARGEST_EDS, "an EDS")
    except ConfigError as error:
        raise EdsError(str(error)) from None
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("cp1252", "replace")


def entries_to_json(entries: Iterable[Entry]) -> Any:
    """Return entries as plain data for JSON."""
    import msgspec

    return msgspec.to_builtins(list(entries))


def entries_from_json(rows: Any) -> list[Entry]:
    """Return the entries of `entries_to_json`."""
    import msgspec

    return msgspec.convert(rows, list[Entry])


def _entries(sections: Mapping[str, _Section], node_id: int) -> list[Entry]:
    """Return the entries of all objects, with what cannot be read of them as their fault."""
    from canopen.objectdictionary import eds as parser

    found = {title: match for title in sections if (match := _OBJECT.fullmatch(title)) and not match[3]}
    file = RawConfigParser()
    file.read_dict({title: {"parametername": "", **sections[title].values} for title in found})
    level = parser.logger.level
    parser.logger.setLevel(logging.CRITICAL)  # a fault has the reason in one line
    try:
        return [
            _entry(file, title, sections[title], (index, int(match[2] or "0", 16)), node_id)
            for title, match in found.items()
            if (index := int(match[1], 16)) >= _FIRST_REAL_INDEX
            and (match[2] or _whole(sections[title].values.get("objecttype", "7")) in (_DOMAIN, _VAR, None))
        ]
    finally:
        parser.logger.setLevel(level)


def _entry(file: RawConfigParser, title: str, section: _Section, key: Key, node_id: int) -> Entry:
    from canopen.objectdictionary import eds as parser

    index, subindex = key
    parent = file.get(f"{index:X}", "parametername", fallback="") if subindex else ""
    name = ": ".join(filter(None, (parent, section.values.get("parametername", ""))))
    try:
        variable = parser.build_variable(file, title, node_id, index, subindex)
    except Exception as error:  # the parser has no exception class of its own
        what = " ".join(str(error).split())[:80]
        if isinstance(error, NoOptionError):
            what = f"no {_DECIDING.get(error.option, error.option)}"
        section.refuse("", what if what.isprintable() else type(error).__name__)
        return Entry(index, subindex, name, 0, "", False, None, None, b"", section.fault)
    in_use = "parametervalue" in section.values  # of a DCF
    name_of_value, value = (
        ("ParameterValue", variable.value) if in_use else ("DefaultValue", variable.default)
    )
    text = section.values.get(name_of_value.lower(), "")
    layout = _LAYOUTS.get(variable.data_type)
    if layout is None:
        data = value if isinstance(value, bytes) else str(value or "").encode("ascii", "replace")
    else:
        value, bits = _whole(text or "0") if value is None else value, 8 * layout.size
        if variable.data_type in _SIGNED and text[:2] in ("0x", "0X") and (value or 0) >> bits - 1:
            value -= 2**bits  # written as its two's complement
        try:
            data = layout.pack(value)
        except (struct.error, OverflowError):
            data = bytes(layout.size)
            section.refuse(name_of_value, f"{name_of_value}={_shown(text)}, expected a number of {bits} bits")
    return Entry(
        index=index,
        subindex=subindex,
        name=name,
        data_type=variable.data_type,
        access=variable.access_type,
        mappable=bool(variable.pdo_mappable),
        low=variable.min,
        high=variable.max,
        default=data,
        fault=section.fault,
    )


# SDO server

MAX_DOWNLOAD_BYTES = 4096
"""Bounds the memory that a client takes which never ends its transfer."""

# Client command specifiers, bits 7..5 of byte 0
_DOWNLOAD_SEGMENT, _DOWNLOAD_INITIATE, _UPLOAD_INITIATE, _UPLOAD_SEGMENT, _ABORT = range(5)


@dataclass
class _Transfer:
    """A segmented transfer under way; `size` is what was announced in a download, None when it was not."""

    index: int
    subindex: int
    upload: bool
    data: bytearray
    size: int | None = None
    toggle: int = 0


class SdoServer:
    """SDO server of one `ObjectStore`. It never raises for what a client sends.

    It holds one transfer; a new initiate request ends the running one, as a client that lost its answer starts again.
    """

    def __init__(self, store: ObjectStore) -> None:
        self.store = store
        self._transfer: _Transfer | None = None

    def handle(self, request: bytes) -> bytes | None:
        """Answer one request; None when no answer is due (not 8 bytes, or the client's abort)."""
        if len(request) != 8:
            return None
        command, index, subindex = HEADER.unpack_from(request)
        specifier = command >> 5
        if specifier == _ABORT:
            self._transfer = None
            return None
        if specifier in (_DOWNLOAD_SEGMENT, _UPLOAD_SEGMENT):
            transfer = self._transfer
            index, subindex = (transfer.index, transfer.subindex) if transfer else (0, 0)
        try:
            return self._answer(specifier, command, index, subindex, request)
        except SdoAbort as abort:
            self._transfer = None
            return abort_frame(index, subindex, abort.code)

    def _answer(self, specifier: int, command: int, index: int, subindex: int, request: bytes) -> bytes:
        if specifier == _UPLOAD_INITIATE:
            return self._upload(index, subindex)
        if specifier == _DOWNLOAD_INITIATE:
            return self._download(command, index, subindex, request[4:])
        if specifier == _UPLOAD_SEGMENT:
            return self._upload_segment(command)
        if specifier == _DOWNLOAD_SEGMENT:
            return self._download_segment(command, request[1:])
        raise SdoAbort(UNKNOWN_COMMAND)  # block transfer (5, 6) and the reserved 7

    def _upload(self, index: int, subindex: int) -> bytes:
        self._transfer = None
        data = self.store.read(index, subindex)
        if 1 <= len(data) <= 4:  # expedited; it has no code for an empty object
            return HEADER.pack(0x43 | (4 - len(data)) << 2, index, subindex) + data.ljust(4, b"\0")
        self._transfer = _Transfer(index, subindex, True, bytearray(data))
        return INITIATE.pack(0x41, index, subindex, len(data))

    def _upload_segment(self, command: int) -> bytes:
        transfer = self._running(command, upload=True)
        segment = bytes(transfer.data[:7])
        del transfer.data[:7]
        last = not transfer.data
        reply = bytes([transfer.toggle | (7 - len(segment)) << 1 | last]) + segment.ljust(7, b"\0")
        transfer.toggle ^= TOGGLE
        if last:
            self._transfer = None
        return reply

    def _download(self, command: int, index: int, subindex: int, field: bytes) -> bytes:
        self._transfer = None
        expedited, sized = command & 2, command & 1
        if expedited:
            # without a size so many of the four bytes count as the object's type has
            own = self.store.entry(index, subindex).bits // 8 or 4
            length = 4 - (command >> 2 & 3) if sized else min(4, own)
            self.store.write(index, subindex, field[:length])
        else:
            size = int.from_bytes(field, "little") if sized else None
            self.store.check_write(index, subindex, size)
            if size is not None and size > MAX_DOWNLOAD_BYTES:
                raise SdoAbort(OUT_OF_MEMORY)
            self._transfer = _Transfer(index, subindex, False, bytearray(), size)
        return INITIATE.pack(0x60, index, subindex, 0)

    def _download_segment(self, command: int, payload: bytes) -> bytes:
        transfer = self._running(command, upload=False)
        transfer.data += payload[: 7 - (command >> 1 & 7)]
        limit = MAX_DOWNLOAD_BYTES if transfer.size is None else transfer.size
        if len(transfer.data) > limit:
            raise SdoAbort(OUT_OF_MEMORY if transfer.size is None else LENGTH_TOO_HIGH)
        reply = bytes([0x20 | transfer.toggle]).ljust(8, b"\0")
        transfer.toggle ^= TOGGLE
        if command & 1:  # last segment
            if transfer.size is not None and len(transfer.data) < transfer.size:
                raise SdoAbort(LENGTH_TOO_LOW)
            self._transfer = None
            self.store.write(transfer.index, transfer.subindex, bytes(transfer.data))
        return reply

    def _running(self, command: int, upload: bool) -> _Transfer:
        transfer = self._transfer
        if transfer is None or transfer.upload != upload:
            raise SdoAbort(UNKNOWN_COMMAND)
        if command & TOGGLE != transfer.toggle:
            raise SdoAbort(TOGGLE_NOT_ALTERNATED)
        return transfer
