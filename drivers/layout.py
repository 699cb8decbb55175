"""Which TPDOs of a drive carry its quantities, and where in them: wanted by the configuration, or found in the drive.

jtqd maps the quantities of `DriveObjects` into TPDO1 and TPDO2. A drive whose mapping is fixed carries them elsewhere: in
any of its four TPDOs, in any order, among objects that nobody needs. Both are `PdoMap`s; `chosen` picks the fewest that
carry all quantities, `places` tells where each of them lies. Pure.

>>> from jtqd.drivers.devices import CIA_402
>>> maps = [pdo_of_words(1, number, base + 1, words, 1, CIA_402) for number, base, words in (
...     (1, 0x180, (0x60410010, 0x60640020)), (2, 0x280, (0x606C0020, 0x60780010)), (4, 0x480, (0x60E40120,)))]
>>> [pdo.number for pdo in chosen(CIA_402, maps)]
[1, 2, 4]
>>> places(CIA_402, maps)["current"]
Place(pdo=1, entry=1)
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from itertools import combinations
from typing import Any, NamedTuple

from jtqd.drivers.devices import DriveObject, DriveObjects
from jtqd.drivers.pdo import MappedObject, PdoError, PdoMap, split_word
from jtqd.drivers.sdo import label

TPDO_BASES = (0x180, 0x280, 0x380, 0x480)
"""COB-IDs of a node's TPDOs 1 to 4 in the predefined connection set (CiA 301, 7.3.5), without the node-ID."""
EVERY_SYNC = 1
"""Transmission type of a TPDO that is sent at each SYNC."""
BY_ITSELF = (0, 254, 255)
"""Transmission types of a TPDO whose frames belong to no SYNC: sent on a change, at the next SYNC (0) or at once."""


class LayoutError(ValueError):
    """The TPDOs do not carry what is needed; the message says what is missing, and what they carry."""


class Place(NamedTuple):
    """Where a quantity lies: which of the PDOs, which entry of its mapping; both from 0."""

    pdo: int
    entry: int


def quantities(objects: DriveObjects) -> dict[str, DriveObject]:
    """Return the quantities that the drive has, by name, in the order of `DriveObjects`."""
    found = {each.name: getattr(objects, each.name) for each in fields(objects)}
    return {name: each for name, each in found.items() if each is not None}


def pdo_of_words(  # noqa: PLR0917 - a communication and a mapping parameter
    node: int, number: int, cob_id: int, words: Iterable[int], transmission_type: int, objects: DriveObjects
) -> PdoMap:
    """Return the map of TPDO `number` of a drive by its mapping entries 0xIIIISSLL.

    Entries that carry a quantity have its name and sign, the others neither. Raises PdoError for an identifier that is not
    one of the node's four, for a quantity that is mapped with another length, and for what no `PdoMap` can be.
    """
    if cob_id - node not in TPDO_BASES:
        known = ", ".join(f"{base + node:03X}h" for base in TPDO_BASES)
        raise PdoError(f"TPDO{number} has COB-ID {cob_id:03X}h, expected one of {known}")
    named = {(each.index, each.subindex): (name, each) for name, each in quantities(objects).items()}
    entries = []
    for word in words:
        index, subindex, bits = split_word(word)
        name, wanted = named.get((index, subindex), ("", None))
        if wanted is not None and wanted.bits != bits:
            raise PdoError(f"{label(index, subindex)} is mapped with {bits} bits, expected {wanted.bits}")
        entries.append(MappedObject(index, subindex, bits, wanted is not None and wanted.signed, name))
    return PdoMap(cob_id, tuple(entries), transmission_type, number)


def chosen(objects: DriveObjects, maps: Sequence[PdoMap]) -> tuple[PdoMap, ...]:
    """Return the fewest PDOs that carry every quantity, in their order; of equally many, the first. Raises LayoutError."""
    wanted = set(quantities(objects))
    for count in range(1, len(maps) + 1):
        for some in combinations(maps, count):
            if wanted <= {name for pdo in some for name in pdo.names}:
                return some
    carried = {name for pdo in maps for name in pdo.names}
    missing = [
        f"{label(each.index, each.subindex)} ({name.replace('_', ' ')})"
        for name, each in quantities(objects).items()
        if name not in carried
    ]
    raise LayoutError(f"no TPDO carries {', '.join(missing)}; {_carried(maps)}")


def _carried(maps: Sequence[PdoMap]) -> str:
    said = (f"TPDO{pdo.number} carries {', '.join(f'0x{word:08X}' for word in pdo.words)}" for pdo in maps)
    return "; ".join(said) or "none of its TPDOs can be used"


def places(objects: DriveObjects, maps: Sequence[PdoMap]) -> dict[str, Place]:
    """Return where each quantity lies, the first place of several. Raises LayoutError for one that lies nowhere."""
    found: dict[str, Place] = {}
    for at, pdo in enumerate(maps):
        for entry, name in enumerate(pdo.names):
            if name:
                found.setdefault(name, Place(at, entry))
    wanted = quantities(objects)
    if missing := wanted.keys() - found.keys():
        raise LayoutError(f"no TPDO carries {', '.join(sorted(missing))}; {_carried(maps)}")
    return {name: found[name] for name in wanted}


def tpdos_as_json(maps: Iterable[PdoMap]) -> list[dict[str, Any]]:
    """Return the TPDOs for a request or a report."""
    return [
        {
            "number": pdo.number,
            "cob_id": pdo.cob_id,
            "transmission_type": pdo.transmission_type,
            "words": list(pdo.words),
        }
        for pdo in maps
    ]


def maps_of_json(node: int, tpdos: Iterable[Mapping[str, Any]], objects: DriveObjects) -> tuple[PdoMap, ...]:
    """Return the maps of `tpdos_as_json`. Raises PdoError, or KeyError and TypeError for what is none.

    A TPDO without a number (logs of jtqd before 0.2.0) has that of its COB-ID.
    """
    return tuple(
        pdo_of_words(
            node,
            each.get("number", (each["cob_id"] - 0x80) // 0x100),
            each["cob_id"],
            each["words"],
            each["transmission_type"],
            objects,
        )
        for each in tpdos
    )
