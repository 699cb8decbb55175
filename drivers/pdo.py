"""PDO mappings as precompiled `struct.Struct`, and the rules for changing those of a node (CiA 301, 7.2.2, 7.4.7, 7.5.2).

`PdoMap` is made once from the mapping; afterwards a PDO is one `layout.unpack_from` or `layout.pack`, little endian. Only
whole objects of 8, 16, 32 or 64 bits are mapped: a partial object is where other decoders read the wrong number, so it is
refused when the map is made. `PdoParameters` guards 14xxh to 1Axxh of an object dictionary and reads the maps in force.

>>> position = PdoMap(0x181, (MappedObject(0x6064, 0, 32, True, "position"),))
>>> position.layout.unpack(position.layout.pack(-1000))
(-1000,)
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass, field

from jtqd.drivers.frame import CAN_EFF_MASK
from jtqd.drivers.object_dictionary import EdsError, ObjectStore
from jtqd.drivers.sdo import DEVICE_STATE, NOT_MAPPABLE, PDO_TOO_LONG, VALUE_RANGE, Key, SdoAbort, label

MAX_PDO_BYTES = 8
LOWEST_PDO_ID, HIGHEST_PDO_ID = 0x181, 0x57F
"""Identifiers that a PDO may have (CiA 301, 7.3.5); others are restricted or belong to other services."""
LAST_SYNC_TYPE = 240
"""Transmission types 1..240: every n-th SYNC."""
SYNC_COB_ID = 0x080
SYNC_LISTEN_S = 0.12
"""Within this a SYNC arrives where there is a producer: a little more than the longest period of jtqd."""
TPDO_COUNT = 4
TPDO_BASES = (0x180, 0x280, 0x380, 0x480)
"""COB-IDs of a node's TPDOs 1 to 4 in the predefined connection set (CiA 301, 7.3.5), without the node-ID."""
EVERY_SYNC = 1
"""Transmission type of a TPDO that is sent at each SYNC."""
ACYCLIC = (0, 254, 255)
"""Transmission types of a TPDO whose frames belong to no SYNC: sent on a change, at the next SYNC (0) or at once."""
EVENT_DRIVEN = (254, 255)
"""Transmission types of a PDO that its producer sends by itself."""

_SIGNED_LETTERS = {8: "b", 16: "h", 32: "i", 64: "q"}


class PdoError(ValueError):
    """A mapping that is impossible or not supported."""


@dataclass(frozen=True)
class MappedObject:
    """One whole object in a PDO; `bits` is its own length. The name takes no part in comparison."""

    index: int
    subindex: int
    bits: int
    signed: bool
    name: str = field(default="", compare=False)

    def __post_init__(self) -> None:
        if not (0x1000 <= self.index <= 0xFFFF and 0 <= self.subindex <= 0xFF):
            raise PdoError(f"{self.label}: no such object can be mapped")
        if self.bits not in _SIGNED_LETTERS:
            raise PdoError(
                f"{self.label}: {self.bits} bits mapped, expected whole objects of 8, 16, 32 or 64 bits"
            )

    @property
    def label(self) -> str:
        """The object as "6064h:0"."""
        return label(self.index, self.subindex)

    @property
    def word(self) -> int:
        """The mapping entry 0xIIIISSLL of 1600h/1A00h."""
        return self.index << 16 | self.subindex << 8 | self.bits

    @property
    def letter(self) -> str:
        """The `struct` format character."""
        letter = _SIGNED_LETTERS[self.bits]
        return letter if self.signed else letter.upper()


@dataclass(frozen=True)
class PdoMap:
    """What one PDO carries. Raises PdoError when empty, longer than a frame, or on no identifier of a PDO.

    given_number: of the TPDO (1: 1800h) where it is not that of its COB-ID in the predefined connection set.
    """

    cob_id: int
    objects: tuple[MappedObject, ...]
    transmission_type: int = 1
    given_number: int | None = field(default=None, compare=False)
    layout: struct.Struct = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not LOWEST_PDO_ID <= self.cob_id <= HIGHEST_PDO_ID:
            raise PdoError(f"COB-ID {self.cob_id:X}h is not one of a PDO (181h..57Fh)")
        if not (
            0 <= self.transmission_type <= LAST_SYNC_TYPE or self.transmission_type in (252, 253, 254, 255)
        ):
            raise PdoError(f"PDO {self.cob_id:X}h: transmission type {self.transmission_type} is reserved")
        if not self.objects:
            raise PdoError(f"PDO {self.cob_id:X}h maps no object")
        layout = struct.Struct("<" + "".join(mapped.letter for mapped in self.objects))
        if layout.size > MAX_PDO_BYTES:
            raise PdoError(f"PDO {self.cob_id:X}h: {layout.size} bytes mapped, a frame holds {MAX_PDO_BYTES}")
        object.__setattr__(self, "layout", layout)

    @property
    def number(self) -> int:
        """Return the number of the TPDO: 1 for 1800h and 1A00h."""
        return (self.cob_id - 0x80) // 0x100 if self.given_number is None else self.given_number

    @property
    def tpdo(self) -> Tpdo:
        """Its parameters as a TPDO."""
        return Tpdo(self.number, self.cob_id, self.words, self.transmission_type)

    @property
    def length(self) -> int:
        """Bytes of the PDO."""
        return self.layout.size

    @property
    def words(self) -> tuple[int, ...]:
        """The mapping entries 0xIIIISSLL, in order."""
        return tuple(mapped.word for mapped in self.objects)

    @property
    def names(self) -> tuple[str, ...]:
        """The objects' names, in the order `layout` unpacks them."""
        return tuple(mapped.name for mapped in self.objects)


def tpdo_parameters(number: int) -> tuple[int, int]:
    """Return the indices of the communication and the mapping parameter of a TPDO: 1800h and 1A00h of TPDO1."""
    return _TPDO + number - 1, _TPDO + _MAPPING_OFFSET + number - 1


@dataclass(frozen=True)
class Tpdo:
    """One TPDO as it is configured in a device.

    Attributes:
        words: its mapping entries 0xIIIISSLL.
        on: it is valid (bit 31 of its COB-ID is clear).
        extended: its COB-ID has 29 bits.
        timer_ms: its event timer (1800h:5); 0: none, or not read.
        mapping_fixed, type_fixed: by its EDS they cannot be written; on a bus this is not known.
        bit_7: the length of an entry has bit 7 set, which `words` have not.
        fault: why its EDS cannot be read there; it is then as if switched off.
    """

    number: int
    cob_id: int
    words: tuple[int, ...]
    transmission_type: int = EVERY_SYNC
    on: bool = True
    extended: bool = False
    timer_ms: int = 0
    mapping_fixed: bool = False
    type_fixed: bool = False
    bit_7: bool = False
    fault: str = ""

    @property
    def note(self) -> str:
        """What is odd in its mapping and does not matter; "" for nothing."""
        text = f"TPDO{self.number}: taken as {', '.join(self.objects)}, without bit 7 of a length"
        return text if self.bit_7 else ""

    @property
    def objects(self) -> tuple[str, ...]:
        """Its objects as "6064h:0/32" (bits)."""
        return tuple(f"{label(*split_word(each)[:2])}/{each & 0xFF}" for each in self.words)


def read_tpdos(number_of: Callable[[Key], int | None]) -> list[Tpdo]:
    """Read the TPDOs of the predefined connection set that a device has; `number_of`: value of an object, None: absent."""
    found = []
    for number in range(1, TPDO_COUNT + 1):
        communication, mapping = tpdo_parameters(number)
        try:
            cob_id = number_of((communication, 1))
            if cob_id is None:
                continue
            kind, count = ((number_of(key) or 0) & 0xFF for key in ((communication, 2), (mapping, 0)))
            subs = range(1, min(count, 8 * MAX_PDO_BYTES) + 1)
            read = tuple(number_of((mapping, sub)) or 0 for sub in subs)
        except EdsError as error:
            found.append(Tpdo(number, 0, (), on=False, fault=str(error)))
            continue
        extended = bool(cob_id & EXTENDED)
        identifier = cob_id & (CAN_EFF_MASK if extended else CAN_ID)
        words = tuple(map(whole_entry, read))
        on, bit_7 = not cob_id & INVALID, words != read
        found.append(Tpdo(number, identifier, words, kind, on, extended, bit_7=bit_7))
    return found


def split_word(word: int) -> tuple[int, int, int]:
    """Return (index, subindex, bits) of a mapping entry 0xIIIISSLL."""
    return word >> 16 & 0xFFFF, word >> 8 & 0xFF, word & 0xFF


def whole_entry(word: int) -> int:
    """Return a mapping entry without bit 7 of its length where that is above 64 bits: some drives set it for a sign."""
    return word & ~0x80 if word & 0xFF > 8 * MAX_PDO_BYTES else word


# PDO parameters of an object dictionary ---------------------------------------------------------------------------

INVALID = 0x8000_0000  # COB-ID bit 31: the PDO does not exist
EXTENDED = 0x2000_0000  # COB-ID bit 29: 29-bit identifier, not supported here
NO_RTR = 0x4000_0000  # COB-ID bit 30 of a TPDO
CAN_ID = 0x7FF
_RPDO, _TPDO = 0x1400, 0x1800
_MAPPING_OFFSET = 0x200  # 1400h -> 1600h, 1800h -> 1A00h
_TPDO_ACCESS = ("ro", "rw", "rwr", "const")
_RPDO_ACCESS = ("wo", "rw", "rww")
# Sub-indices of the communication parameter that may change only while the PDO does not exist
_INHIBIT_TIME, _SYNC_START = 3, 6


class PdoParameters:
    """PDO parameters of `store`: the rules for changing them (CiA 301, 7.5.2.33 to 7.5.2.38), and the maps in force.

    Re-mapping goes: COB-ID bit 31 set (the PDO is destroyed), number of entries 0, entries, number of entries n, COB-ID with
    bit 31 clear. A write out of that order is refused with 08000022h, an object that is not there with 06020000h, one that
    may not be mapped with 06040041h, more than 8 bytes with 06040042h, an impossible COB-ID or transmission type with
    06090030h.

    Attributes:
        generation: grows with each accepted write; maps read before are out of date when it differs.
    """

    def __init__(self, store: ObjectStore) -> None:
        self._store = store
        self.generation = 0
        self.tpdo_indices = _communication_indices(store, _TPDO)
        self.rpdo_indices = _communication_indices(store, _RPDO)
        for index in (*self.tpdo_indices, *self.rpdo_indices):
            self._guard(index)

    def tpdos(self) -> list[PdoMap]:
        """Return the TPDOs that exist and map something, in the order of their number."""
        return [pdo for index in self.tpdo_indices if (pdo := self.active_map(index))]

    def rpdos(self) -> list[PdoMap]:
        """Return the RPDOs that exist and map something."""
        return [pdo for index in self.rpdo_indices if (pdo := self.active_map(index))]

    def active_map(self, communication_index: int) -> PdoMap | None:
        """Return the map of one PDO (1400h.., 1800h..); None when it is switched off or empty."""
        store = self._store
        cob_id = store.number(communication_index, 1)
        mapping = communication_index + _MAPPING_OFFSET
        count = store.number(mapping, 0)
        if cob_id & INVALID or count == 0:
            return None
        mapped = []
        for number in range(1, count + 1):
            index, subindex, bits = split_word(store.number(mapping, number))
            entry = store.entry(index, subindex)
            mapped.append(MappedObject(index, subindex, bits, entry.signed, entry.name))
        return PdoMap(cob_id & CAN_ID, tuple(mapped), store.number(communication_index, 2))

    def _guard(self, index: int) -> None:
        self._hook(index, 1, lambda value: self._check_cob_id(index, value))
        self._hook(index, 2, self._check_transmission)
        for subindex in (_INHIBIT_TIME, _SYNC_START):
            if self._store.has(index, subindex):
                self._hook(index, subindex, lambda _value: self._require_destroyed(index))
        mapping = index + _MAPPING_OFFSET
        access = _TPDO_ACCESS if index >= _TPDO else _RPDO_ACCESS
        self._hook(mapping, 0, lambda count: self._check_count(index, count))
        for subindex in range(1, 256):
            if not self._store.has(mapping, subindex):
                break
            self._hook(mapping, subindex, lambda word: self._check_entry(index, word, access))

    def _hook(self, index: int, subindex: int, check: Callable[[int], None]) -> None:
        def on_write(data: bytes) -> None:
            check(int.from_bytes(data, "little"))
            self.generation += 1

        self._store.on_write(index, subindex, on_write)

    def _check_cob_id(self, index: int, value: int) -> None:
        present = self._store.number(index, 1)
        if value & EXTENDED or not LOWEST_PDO_ID <= value & CAN_ID <= HIGHEST_PDO_ID or value & 0x1FFF_F800:
            raise SdoAbort(VALUE_RANGE)
        both_exist = not (present | value) & INVALID
        if both_exist and (present ^ value) & CAN_ID:
            raise SdoAbort(VALUE_RANGE)  # bits 0..29 may not change while the PDO exists

    def _check_transmission(self, value: int) -> None:
        if value > LAST_SYNC_TYPE and value not in EVENT_DRIVEN:  # 252, 253: RTR-only, not offered
            raise SdoAbort(VALUE_RANGE)

    def _require_destroyed(self, index: int) -> None:
        if not self._store.number(index, 1) & INVALID:
            raise SdoAbort(DEVICE_STATE)

    def _check_count(self, index: int, count: int) -> None:
        self._require_destroyed(index)
        mapping = index + _MAPPING_OFFSET
        bits = 0
        for entry in range(1, count + 1):
            if not self._store.has(mapping, entry):
                raise SdoAbort(PDO_TOO_LONG)
            word = self._store.number(mapping, entry)
            if word == 0:
                raise SdoAbort(NOT_MAPPABLE)
            bits += word & 0xFF
        if bits > 8 * MAX_PDO_BYTES:
            raise SdoAbort(PDO_TOO_LONG)

    def _check_entry(self, index: int, word: int, access: tuple[str, ...]) -> None:
        self._require_destroyed(index)
        if self._store.number(index + _MAPPING_OFFSET, 0) != 0:
            raise SdoAbort(DEVICE_STATE)
        if word == 0:
            return
        mapped_index, subindex, bits = split_word(word)
        entry = self._store.entry(mapped_index, subindex)  # aborts 06020000h or 06090011h when absent
        if not entry.mappable or not entry.is_integer or entry.access not in access or entry.bits != bits:
            raise SdoAbort(NOT_MAPPABLE)


def _communication_indices(store: ObjectStore, base: int) -> tuple[int, ...]:
    return tuple(index for index in range(base, base + _MAPPING_OFFSET) if store.has(index, 1))
