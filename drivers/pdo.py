"""PDO codec: a mapping becomes one precompiled little-endian `struct.Struct` (CiA 301, 7.4.7 and 7.2.2).

Made once from the mapping; afterwards a PDO is one `layout.unpack_from` or `layout.pack`. Only whole objects
of 8, 16, 32 or 64 bits are mapped: a partial object is where other decoders read the wrong number, so it is
refused when the map is made.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field

MAX_PDO_BYTES = 8
MAX_ENTRIES = 8  # whole bytes only: 8 entries fill a frame
LOWEST_PDO_ID = (
    0x181  # CiA 301, 7.3.5: 101h..180h, 581h.. and above are restricted or belong to other services
)
HIGHEST_PDO_ID = 0x57F
LAST_SYNC_TYPE = 240  # transmission types 1..240: every n-th SYNC

_SIGNED_LETTERS = {8: "b", 16: "h", 32: "i", 64: "q"}


class PdoError(ValueError):
    """A mapping that cannot be, or must not be, coded."""


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
                f"{self.label}: {self.bits} bits mapped, only whole objects of 8, 16, 32 or 64 bits are"
            )

    @property
    def label(self) -> str:
        """The object as "6064h:0"."""
        return f"{self.index:04X}h:{self.subindex}"

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
    """What one PDO carries. Raises PdoError when empty, longer than a frame, or on no identifier of a PDO."""

    cob_id: int
    objects: tuple[MappedObject, ...]
    transmission_type: int = 1
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


def split_word(word: int) -> tuple[int, int, int]:
    """(index, subindex, bits) of a mapping entry 0xIIIISSLL."""
    return word >> 16 & 0xFFFF, word >> 8 & 0xFF, word & 0xFF
