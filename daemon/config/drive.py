"""Drive of a joint in section `joint_N`: objects (`objects`), TPDOs (`tpdos`), values of absent objects (`given`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, fields
from typing import Annotated, Any, Final

from jtqd.drivers.drive import (
    AT_JOINT,
    BY_TORQUE,
    CIA_402,
    SCALES,
    SHAFTS,
    DriveObject,
    DriveObjects,
    LayoutError,
    Temperature,
    drive_layout,
    map_of,
    select_tpdos,
)
from jtqd.drivers.pdo import ACYCLIC, PdoError, PdoMap, Tpdo
from jtqd.drivers.sdo import Key, label, parse_key
from jtqd.estimator.decoder import FieldError, Text, below, choice, limits
from jtqd.estimator.errors import Verbatim, range_text

_PDO_BITS: Final = 64
_TYPES: Final = {"I16": (16, True), "I32": (32, True), "U16": (16, False), "U32": (32, False)}
_TORQUE: Final = 0x6077
"""In 1/1000 of 6076h."""
_Index = Annotated[int, limits(ge=0x1000, le=0xFFFF)]
_SubIndex = Annotated[int, limits(ge=0, le=254)]


@dataclass(frozen=True)
class _Object:
    """One object in section `joint_N.objects`; a key left out is as in CiA 402."""

    index: _Index | None = None
    sub: _SubIndex | None = None
    type: Annotated[str, choice(_TYPES)] | None = None
    sign: Annotated[int, limits(ge=-1, le=1)] = 1
    factor: Annotated[float, limits(gt=0.0)] | None = None
    """SI units (rad, rad/s, A) per unit; without it the drive's scaling objects count."""
    by: Text | None = None
    """Which scaling object; `drivers/drive.py` has those of each quantity."""
    shaft: Annotated[str, choice(SHAFTS)] | None = None
    """Where the drive counts by 6092h, 60A8h, 60A9h."""

    def __post_init__(self) -> None:
        if self.sign == 0:
            raise FieldError("object", "sign", 0, "1 or -1")

    def of_drive(self, standard: DriveObject) -> DriveObject:
        """Return the object of the drive; `standard` is that of CiA 402."""
        bits, signed = _TYPES[self.type] if self.type else (standard.bits, standard.signed)
        return DriveObject(
            standard.index if self.index is None else self.index,
            (standard.subindex if self.index is None else 0) if self.sub is None else self.sub,
            bits,
            signed,
            self.sign,
            self.factor,
            BY_TORQUE if self.by is None and self.factor is None and self.index == _TORQUE else self.by or "",
            self.shaft or AT_JOINT,
        )

    def check(self, name: str, standard: DriveObject) -> None:
        """Raise FieldError for an object that cannot be mapped or scaled."""
        chosen = self.of_drive(standard)

        def wrong(key: str, problem: str) -> FieldError:
            return FieldError("object", key, None, "", problem)

        if name == "statusword":
            if chosen.bits != standard.bits or self.sign != 1 or self.factor or self.by or self.shaft:
                raise wrong("", "expected an object of type U16, no sign, no factor")
            return
        scales = SCALES[name]
        another = (chosen.index, chosen.subindex) != (standard.index, standard.subindex)
        if self.by is not None and self.by not in scales:
            raise FieldError("object", "by", self.by, f"one of {', '.join(scales)}")
        if self.by is not None and self.factor is not None:
            raise wrong("by", "found both by and factor, expected one of them")
        if another and chosen.factor is None and not chosen.by:
            unit = "A" if name == "current" else "rad/s" if "velocity" in name else "rad"
            alone = f"CiA 402 scales {label(standard.index, standard.subindex)} alone"
            raise FieldError("object", "factor", MISSING, f"{unit} per unit, or 'by': {alone}")
        if self.shaft is not None and not (self.by and scales[self.by].at_shaft and name.startswith("motor")):
            raise wrong("shaft", "expected only for the motor by 6092h, 60A8h or 60A9h")
        if "position" in name and (chosen.bits, chosen.signed) != (32, True):
            raise wrong("type", "expected I32: a position rolls over at 32 bits")


@dataclass(frozen=True)
class _Temperature:
    """The joint's temperature in section `joint_N.objects`: another object than 3001h, 16 bits, signed."""

    index: _Index
    factor: Annotated[float, limits(gt=0.0, le=1000.0)]
    """Degrees Celsius per unit."""
    sub: _SubIndex = 0


@dataclass(frozen=True)
class ObjectsSection:
    """Section `joint_N.objects`; None (in the file: `false`) for a quantity that the drive does not have."""

    motor_position: _Object = _Object()
    link_position: _Object | None = _Object()
    motor_velocity: _Object | None = _Object()
    current: _Object = _Object()
    statusword: _Object = _Object()
    temperature: _Temperature | None = None

    def of_drive(self) -> DriveObjects:
        """Return the objects of the drive. Raises FieldError for an object that cannot be mapped or scaled."""
        found: dict[str, Any] = {}
        for each in fields(CIA_402):
            written: _Object | None = getattr(self, each.name)
            found[each.name] = None
            if written is not None:
                standard: DriveObject = getattr(CIA_402, each.name)
                with below(f"objects.{each.name}"):
                    written.check(each.name, standard)
                found[each.name] = written.of_drive(standard)
        return DriveObjects(**found)

    @property
    def of_joint(self) -> Temperature:
        """Return the object of the joint's temperature."""
        own = self.temperature
        return Temperature() if own is None else Temperature(own.index, own.sub, own.factor)


@dataclass(frozen=True)
class TpdoSection:
    """One TPDO in section `joint_N.tpdos`: parameters 1800h and 1A00h, 1801h and 1A01h, ..."""

    number: Annotated[int, limits(ge=1, le=4)]
    cob_id: Annotated[int, limits(ge=0x181, le=0x4FF)]
    objects: tuple[Annotated[int, limits(ge=0, le=0xFFFF_FFFF)], ...]
    """Mapping entries 0xIIIISSLL."""
    type: Annotated[int, limits(ge=0, le=255)] = 1
    """Transmission type: 1, or 0, 254, 255 with `max_age_ms`."""


def check_given(where: str, given: Mapping[str, float], known: Mapping[Key, tuple[str, int]]) -> None:
    """Raise FieldError for objects that scale nothing, and for values that they cannot have."""
    for name, value in given.items():
        try:
            key = parse_key(name)
        except ValueError:
            key = (0, 0)
        if key not in known:
            expected = "one of " + ", ".join(label(*each) for each in known)
            raise FieldError(where, f"given.{name}", Verbatim("that object"), expected)
        what, highest = known[key]
        if value != int(value) or not value <= highest:
            expected = f"{what}, {range_text('a whole number', 0, highest, None)}"
            raise FieldError(where, f"given.{name}", value, expected)


def tpdos_of(
    node: int, objects: DriveObjects, tpdos: Sequence[TpdoSection], *, acyclic: bool, temperature: bool
) -> tuple[PdoMap, ...]:
    """Return the TPDOs that carry the objects.

    acyclic: `max_age_ms` is given, so TPDOs of transmission type 0, 254 or 255 may be among them; temperature: TPDO3
    carries the temperature. Raises FieldError for TPDOs that are incomplete or contradict each other.
    """
    if not tpdos:
        second = (objects.motor_velocity, objects.current, objects.statusword)
        bits = sum(each.bits for each in second if each is not None)
        if bits > _PDO_BITS:
            found = Verbatim(f"{bits} bits of velocity, current and statusword")
            raise FieldError("joint", "objects", found, f"at most {_PDO_BITS}: one PDO")
        return drive_layout(node, objects)
    for each in tpdos:
        if each.type != 1 and each.type not in ACYCLIC:
            raise FieldError("joint", "tpdos", Verbatim(f"type {each.type}"), "1, 0, 254 or 255")
        if each.type in ACYCLIC and not acyclic:
            expected = f"ms because TPDO{each.number} has type {each.type}"
            raise FieldError("joint", "max_age_ms", MISSING, expected)
    try:
        maps = tuple(
            map_of(node, Tpdo(each.number, each.cob_id, each.objects, each.type), objects) for each in tpdos
        )
        used = select_tpdos(objects, maps)
    except (PdoError, LayoutError) as error:
        raise FieldError("joint", "tpdos", None, "", str(error)) from None
    for name, of_temperature in (("number", 3), ("cob_id", 0x380 + node)):
        values = [getattr(pdo, name) for pdo in maps]
        reserved = [of_temperature] if temperature else []
        if len({*values, *reserved}) != len(values) + len(reserved):
            shown = ", ".join(str(value) if name == "number" else f"{value:03X}h" for value in values)
            rule = ", TPDO3 is that of the temperature" if reserved else ""
            raise FieldError("joint", "tpdos", Verbatim(f"{name} {shown}"), f"each once{rule}")
    return used
