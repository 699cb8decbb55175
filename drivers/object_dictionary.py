"""Object dictionary of a node, typed and guarded by its EDS (CiA 301, CiA 306), its EDS, and its SDO server.

`read` and `write` are those of a remote SDO client: access rights, lengths and limits hold, and a refusal is an `SdoAbort`
with the code of CiA 301 table 22. `number`, `set_number`, `set_text` are the device's own access to the same values,
without rights. `SdoServer` answers requests by expedited and segmented transfers (CiA 301, 7.2.4.3.3 to 7.2.4.3.8); it has
no block transfer. No bus and no clock.
"""

from __future__ import annotations

import io
import logging
import struct
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
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
            entries = read_eds(entries, node_id)
        self.entries: dict[tuple[int, int], Entry] = {(each.index, each.subindex): each for each in entries}
        self._indices: set[int] = {index for index, _ in self.entries}
        self._values = {key: entry.default for key, entry in self.entries.items()}
        self._on_read: dict[tuple[int, int], ReadHook] = {}
        self._on_write: dict[tuple[int, int], WriteHook] = {}

    # Access of a remote client ------------------------------------------------------------------------

    def entry(self, index: int, subindex: int) -> Entry:
        """Return the description of an object. Raises SdoAbort 06020000h or 06090011h when there is none."""
        found = self.entries.get((index, subindex))
        if found is None:
            raise SdoAbort(NO_SUBINDEX if index in self._indices else NO_OBJECT)
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
    """An EDS file that cannot be read; the message is one line with its path."""


def read_eds(eds: Path | str, node_id: int) -> list[Entry]:
    """Read the entries of an EDS file, with $NODEID filled in.

    The parser is canopen's. It is loaded here and not with this module: it takes 20 MB, and a process that is
    given its entries as JSON (`entries_to_json`, `entries_from_json`) does without. Raises EdsError.
    """
    from canopen.objectdictionary import eds as parser

    name = str(eds) if str(eds).isprintable() else repr(str(eds))
    text = _eds_text(eds)
    logger = logging.getLogger(parser.__name__)
    level = logger.level
    logger.setLevel(logging.CRITICAL)  # an EdsError has the reason in one line
    entries = []
    try:
        for parsed in parser.import_eds(io.StringIO(text), node_id).values():
            if parsed.index >= _FIRST_REAL_INDEX:
                members = parsed.subindices.values() if hasattr(parsed, "subindices") else [parsed]
                entries += [_entry(member) for member in members]
    except Exception as error:  # the parser has no exception class of its own
        reason = " ".join(str(error).split())[:200]
        raise EdsError(f"{name}: not a readable EDS: {type(error).__name__}: {reason}") from None
    finally:
        logger.setLevel(level)
    return entries


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


def _entry(variable: Any) -> Entry:
    """Return one variable of a parsed EDS, or member of an array or record."""
    data_type, of_dcf = int(variable.data_type), getattr(variable, "value_raw", "")  # as it is configured
    default = variable.default if variable.value is None else variable.value
    layout = _LAYOUTS.get(data_type)
    if layout is not None:
        if of_dcf and variable.value is None:
            raise ValueError(f"ParameterValue={of_dcf} of {variable.name}, expected a number")
        default = layout.pack(default if default is not None else 0)
    elif not isinstance(default, bytes):
        default = b"" if default is None else str(default).encode("ascii")
    return Entry(
        index=variable.index,
        subindex=variable.subindex,
        name=variable.name if variable.subindex == 0 else f"{variable.parent.name}: {variable.name}",
        data_type=data_type,
        access=variable.access_type,
        mappable=bool(variable.pdo_mappable),
        low=variable.min,
        high=variable.max,
        default=default,
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
