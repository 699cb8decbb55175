"""Drives (CiA 402): states, objects that jtqd maps, TPDOs that carry them, and their scaling to SI.

Units of a drive's numbers, by the scaling object that is configured for each quantity:

| quantity | by | SI per unit |
|---|---|---|
| motor position, motor velocity | 608Fh | 2 pi 608Fh:2 / 608Fh:1 (counts; counts per second) |
| motor velocity | 6090h | 2 pi 6090h:2 / 6090h:1 (units of their own per second) |
| link position | 60E6h | 2 pi 60EBh:1 / 60E6h:1 |
| motor position, motor velocity, link position | 6092h | 2 pi 6092h:2 / 6092h:1 (units per turn of the driving shaft) |
| positions; motor velocity | 60A8h; 60A9h | of the unit that the word names (CiA 303-2) |
| current | 6075h | 6075h / 10^6 (1/1000 of the rated current in mA) |
| current | 6076h | 6076h / 10^6 / torque constant (1/1000 of the rated torque in mNm: 6077h) |

Unit codes: CiA DR-303-2, tables 4.1, 4.2 and 4.4, as github.com/heig-vd-iai/canopen-stack has them
(generator/validation/helpers.py): radian 10h, degree 41h, second 03h, minute 47h. The revolution B4h is that of 60A9h in the
manuals of Synapticon and Nanotec (B4h 47h is rpm); increments B5h are those of maxon's and Nanotec's.

6092h, 60A8h and 60A9h count at the driving shaft, behind the gear of 6091h (CiA 402-2): the motor's quantities are
6091h:1 / 6091h:2 times as large, unless the drive counts at the motor's shaft.

Scaling objects are read from the drive, or given by the configuration where a drive lacks one or has a wrong one. jtqd maps
the quantities into TPDO1 and TPDO2 (`drive_layout`). A drive with a fixed mapping has them in any of its four TPDOs, in any
order, among objects that jtqd does not use (`select_tpdos`, `places`). Pure.

>>> state_of(0x1637).value, state_of(0x0218).value
('operation enabled', 'fault')
>>> maps = [map_of(1, tpdo, CIA_402) for tpdo in (Tpdo(1, 0x181, (0x60410010, 0x60640020)),
...     Tpdo(2, 0x281, (0x606C0020, 0x60780010)), Tpdo(4, 0x481, (0x60E40120,)))]
>>> [pdo.number for pdo in select_tpdos(CIA_402, maps)]
[1, 2, 4]
>>> places(CIA_402, maps)["current"]
Place(pdo=1, entry=1)
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from enum import Enum
from itertools import combinations
from typing import Any, Final, NamedTuple

from jtqd.drivers.object_dictionary import ANY_IDENTITY, Identity
from jtqd.drivers.pdo import TPDO_BASES, MappedObject, PdoError, PdoMap, Tpdo, split_word
from jtqd.drivers.sdo import Key, label

# State by statusword (CiA 402-2, table "statusword bits by state")


class State(Enum):
    """State of the drive; the value is its name in CiA 402."""

    NOT_READY = "not ready to switch on"
    SWITCH_ON_DISABLED = "switch on disabled"
    READY = "ready to switch on"
    SWITCHED_ON = "switched on"
    OPERATION_ENABLED = "operation enabled"
    QUICK_STOP = "quick stop active"
    FAULT_REACTION = "fault reaction active"
    FAULT = "fault"
    UNKNOWN = "unknown"


_BY_SIX_BITS: Final = {
    0x21: State.READY,
    0x23: State.SWITCHED_ON,
    0x27: State.OPERATION_ENABLED,
    0x07: State.QUICK_STOP,
}
"""By mask 6Fh: codes in which bit 5 (quick stop) counts."""
_BY_FIVE_BITS: Final = {
    0x00: State.NOT_READY,
    0x40: State.SWITCH_ON_DISABLED,
    0x0F: State.FAULT_REACTION,
    0x08: State.FAULT,
}
"""By mask 4Fh."""
STATE_MASK: Final = 0x7F
"""Bits of a statusword that code the state, and bit 4, which does not."""
STATES: Final = tuple(
    _BY_SIX_BITS.get(bits & 0x6F) or _BY_FIVE_BITS.get(bits & 0x4F, State.UNKNOWN)
    for bits in range(STATE_MASK + 1)
)
"""By `statusword & STATE_MASK`."""


def state_of(statusword: int) -> State:
    """Return the state that a statusword (6041h) codes."""
    return STATES[statusword & STATE_MASK]


# Scaling objects

DRIVE_SCALING_OBJECTS: dict[Key, tuple[str, int]] = {
    (0x608F, 1): ("position encoder increments", 2**31),
    (0x608F, 2): ("position encoder motor revolutions", 2**31),
    (0x6090, 1): ("velocity encoder increments per second", 2**31),
    (0x6090, 2): ("velocity encoder motor revolutions per second", 2**31),
    (0x60E6, 1): ("additional encoder increments", 2**31),
    (0x60EB, 1): ("additional encoder revolutions", 2**31),
    (0x6091, 1): ("gear ratio motor shaft revolutions", 2**31),
    (0x6091, 2): ("gear ratio driving shaft revolutions", 2**31),
    (0x6075, 0): ("motor rated current in mA", 1_000_000),
}
"""Objects that scale a drive's numbers unless configured otherwise: name, largest plausible value. The smallest is 1."""
OTHER_SCALING_OBJECTS: dict[Key, tuple[str, int]] = {
    (0x6076, 0): ("motor rated torque in mNm", 1_000_000_000),
    (0x6092, 1): ("feed constant, position units", 2**31),
    (0x6092, 2): ("feed constant, driving shaft revolutions", 2**31),
    (0x60A8, 0): ("SI unit position", 0xFFFF_FFFF),
    (0x60A9, 0): ("SI unit velocity", 0xFFFF_FFFF),
}
"""Objects that scale them where the configuration asks for it."""
EVERY_SCALING_OBJECT = DRIVE_SCALING_OBJECTS | OTHER_SCALING_OBJECTS
GEAR: tuple[Key, Key] = ((0x6091, 1), (0x6091, 2))
AT_JOINT, AT_MOTOR = "joint", "motor"
SHAFTS = (AT_JOINT, AT_MOTOR)
TURN = 2.0 * math.pi
_ANGLES = {0x10: 1.0, 0x41: math.pi / 180.0, 0xB4: TURN}
"""Radian, degree, revolution."""
SECOND = 0x03
_TIMES = {SECOND: 1.0, 0x47: 60.0}
"""Second, minute."""
INCREMENTS = 0xB5
"""Increments of the encoder: code of the numerator in 60A8h and 60A9h of maxon and Nanotec drives."""
_ANGLE_TEXT = "0xXX100000 (rad), 0xXX410000 (degree) or 0xXXB40000 (revolution)"
_SPEED_TEXT = "0xXX10, 0xXX41 or 0xXXB4 (rad, degree, revolution), then 0300 or 4700 (per second, per minute)"

Values = Mapping[Key, int]


class ScalingError(ValueError):
    """An object whose value scales nothing; `name`: the object in words."""

    def __init__(self, key: Key, name: str, *, expected: str, found: str) -> None:
        super().__init__(f"expected {expected}, found {found}")
        self.key, self.name, self.expected, self.found = key, name, expected, found


def _unit_error(key: Key, expected: str, word: int) -> ScalingError:
    return ScalingError(key, OTHER_SCALING_OBJECTS[key][0], expected=expected, found=f"0x{word:08X}")


def unit_of_position(word: int) -> float:
    """Return rad per unit of 60A8h: prefix (signed exponent of ten), numerator, 0, 0. Raises ScalingError."""
    if word >> 16 & 0xFF not in _ANGLES or word & 0xFFFF:
        raise _unit_error((0x60A8, 0), _ANGLE_TEXT, word)
    return si_prefix(word) * _ANGLES[word >> 16 & 0xFF]


def unit_of_velocity(word: int) -> float:
    """Return rad/s per unit of 60A9h: prefix, numerator, denominator, 0. Raises ScalingError."""
    angle, time = word >> 16 & 0xFF, word >> 8 & 0xFF
    if angle not in _ANGLES or time not in _TIMES or word & 0xFF:
        raise _unit_error((0x60A9, 0), _SPEED_TEXT, word)
    return si_prefix(word) * _ANGLES[angle] / _TIMES[time]


def is_increments(word: int, denominator: int = 0) -> bool:
    """Return whether a word of 60A8h, or of 60A9h with the code of its time, means increments: scaled by 608Fh."""
    return word == INCREMENTS << 16 | denominator << 8


def si_prefix(word: int) -> float:
    """Return the power of ten in the first byte of a unit word (CiA 303-2)."""
    return float(10.0 ** int.from_bytes([word >> 24], signed=True))


class Scale(NamedTuple):
    """How a quantity is scaled: objects that are read, SI per unit of their values, whether at the driving shaft."""

    keys: tuple[Key, ...]
    factor: Callable[[Values], float]
    at_shaft: bool = False


def _per_turn(units: Key, turns: Key, *, at_shaft: bool = False) -> Scale:
    """Scale by two objects: so many units in so many turns."""
    return Scale((units, turns), lambda values: TURN * values[turns] / values[units], at_shaft)


_COUNTS = _per_turn((0x608F, 1), (0x608F, 2))
_FEED = _per_turn((0x6092, 1), (0x6092, 2), at_shaft=True)
_SI_POSITION = Scale(((0x60A8, 0),), lambda v: unit_of_position(v[0x60A8, 0]), True)
SCALES: dict[str, dict[str, Scale]] = {
    "motor_position": {"608Fh": _COUNTS, "6092h": _FEED, "60A8h": _SI_POSITION},
    "motor_velocity": {
        "6090h": _per_turn((0x6090, 1), (0x6090, 2)),
        "608Fh": _COUNTS,
        "6092h": _FEED,
        "60A9h": Scale(((0x60A9, 0),), lambda v: unit_of_velocity(v[0x60A9, 0]), True),
    },
    "link_position": {
        "60E6h": _per_turn((0x60E6, 1), (0x60EB, 1)),
        "6092h": _FEED,
        "60A8h": _SI_POSITION,
    },
    "current": {
        # 6078h is 1/1000 of 6075h, which is in mA; 6077h of 6076h, which is in mNm
        "6075h": Scale(((0x6075, 0),), lambda v: v[0x6075, 0] * 1e-3 * 1e-3),
        "6076h": Scale(((0x6076, 0),), lambda v: v[0x6076, 0] * 1e-3 * 1e-3),
    },
}
"""By quantity of `DriveObjects` and index; the first one is that of CIA_402."""
BY_TORQUE = "6076h"


def scale_of(quantity: str, by: str) -> Scale:
    """Return how a quantity is scaled by an object; by "": the first one of the quantity."""
    every = SCALES[quantity]
    return every[by or next(iter(every))]


def si_per_unit(quantity: str, by: str, shaft: str, values: Values, torque_constant_nm_per_a: float) -> float:
    """Return SI (rad, rad/s, A) per unit of a quantity; `quantity` and `by` as in SCALES, `shaft`: where it counts.

    Raises ScalingError: a unit word is neither an angle nor a speed.
    """
    scale = scale_of(quantity, by)
    factor = scale.factor(values)
    if by == BY_TORQUE:
        return factor / torque_constant_nm_per_a
    if scale.at_shaft and shaft == AT_JOINT and quantity.startswith("motor"):
        return factor * values[GEAR[0]] / values[GEAR[1]]
    return factor


# Objects

TEMPERATURE_C_PER_UNIT = 0.1
"""Of 3001h."""
NOT_MEASURED = -0x8000
"""Temperature of a drive that has the object and no sensor behind it."""


@dataclass(frozen=True)
class DriveObject:
    """Which object of a drive holds a quantity.

    Attributes:
        index, subindex, bits, signed: the object; it is mapped as a whole.
        sign: -1 where the drive counts in the opposite direction.
        factor: SI units per unit; None: by the scaling objects of the drive.
        by: which of them (`SCALES`); "": those of CIA_402.
        shaft: where it counts, for those that count at a shaft (`SHAFTS`).
    """

    index: int
    subindex: int = 0
    bits: int = 32
    signed: bool = True
    sign: int = 1
    factor: float | None = None
    by: str = ""
    shaft: str = AT_JOINT


@dataclass(frozen=True)
class DriveObjects:
    """Objects of a drive's synchronous TPDOs; those of CiA 402 unless the configuration names others.

    None: the drive has no such object, for example only one encoder. Where jtqd maps them (`drive_layout`) the first PDO
    holds the positions, of 32 bits each; the second one velocity, current and statusword, together 8 bytes at most.
    """

    motor_position: DriveObject = DriveObject(0x6064)
    link_position: DriveObject | None = DriveObject(0x60E4, 1)
    motor_velocity: DriveObject | None = DriveObject(0x606C)
    current: DriveObject = DriveObject(0x6078, bits=16)
    statusword: DriveObject = DriveObject(0x6041, bits=16, signed=False)

    def quantities(self) -> dict[str, DriveObject]:
        """Return the quantities that the drive has, by name."""
        found = {each.name: getattr(self, each.name) for each in fields(self)}
        return {name: each for name, each in found.items() if each is not None}


CIA_402 = DriveObjects()


@dataclass(frozen=True)
class Temperature:
    """Object of a drive with the temperature of its joint, 16 bits, signed; `NOT_MEASURED` for none."""

    index: int = 0x3001
    subindex: int = 0
    c_per_unit: float = TEMPERATURE_C_PER_UNIT

    @property
    def key(self) -> Key:
        """Index and sub-index."""
        return self.index, self.subindex


# PDOs into which jtqd maps them

EVENT_MS = 500
"""Event timer and inhibit time of TPDO3: one frame in this time, no more and no fewer."""


def drive_layout(node: int, objects: DriveObjects = CIA_402) -> tuple[PdoMap, ...]:
    """Return the TPDOs into which jtqd maps a drive's quantities."""
    return drive_tpdo1(node, objects), drive_tpdo2(node, objects)


def drive_tpdo1(node: int, objects: DriveObjects = CIA_402) -> PdoMap:
    """180h+n: motor position, link position."""
    return PdoMap(0x180 + node, _mapped(objects, "motor_position", "link_position"))


def drive_tpdo2(node: int, objects: DriveObjects = CIA_402) -> PdoMap:
    """280h+n: motor velocity, current, statusword."""
    return PdoMap(0x280 + node, _mapped(objects, "motor_velocity", "current", "statusword"))


def _mapped(objects: DriveObjects, *names: str) -> tuple[MappedObject, ...]:
    return tuple(
        MappedObject(each.index, each.subindex, each.bits, each.signed, name)
        for name, each in objects.quantities().items()
        if name in names
    )


def drive_tpdo3(node: int, temperature: Temperature = Temperature()) -> PdoMap:
    """380h+n: joint temperature, sent when the event timer runs out (transmission type 255)."""
    return PdoMap(0x380 + node, (MappedObject(*temperature.key, 16, True, "temperature"),), 255)


def drive_rpdo1(node: int) -> PdoMap:
    """200h+n: controlword, target torque; taken when it arrives (transmission type 255)."""
    control = MappedObject(0x6040, 0, 16, False, "controlword")
    return PdoMap(0x200 + node, (control, MappedObject(0x6071, 0, 16, True, "target_torque")), 255)


def drive_rpdo2(node: int) -> PdoMap:
    """300h+n: target velocity; taken when it arrives (transmission type 255)."""
    return PdoMap(0x300 + node, (MappedObject(0x60FF, 0, 32, True, "target_velocity"),), 255)


# TPDOs as a drive has them


class LayoutError(ValueError):
    """The TPDOs lack a quantity; the message names it, and what they carry."""


class Place(NamedTuple):
    """Where a quantity is: which of the PDOs, which entry of its mapping; both from 0."""

    pdo: int
    entry: int


def map_of(node: int, tpdo: Tpdo, objects: DriveObjects) -> PdoMap:
    """Return the map of a drive's TPDO.

    Entries that carry a quantity have its name and sign, the others neither. Raises PdoError for an identifier that is not
    one of the node's four, for a quantity that is mapped with another length, and for what no `PdoMap` can be.
    """
    if tpdo.fault:
        raise PdoError(tpdo.fault)
    if tpdo.cob_id - node not in TPDO_BASES:
        known = ", ".join(f"{base + node:03X}h" for base in TPDO_BASES)
        raise PdoError(f"TPDO{tpdo.number} has COB-ID {tpdo.cob_id:03X}h, expected one of {known}")
    named = {(each.index, each.subindex): (name, each) for name, each in objects.quantities().items()}
    entries = []
    for word in tpdo.words:
        index, subindex, bits = split_word(word)
        name, wanted = named.get((index, subindex), ("", None))
        if wanted is not None and wanted.bits != bits:
            raise PdoError(f"{label(index, subindex)} is mapped with {bits} bits, expected {wanted.bits}")
        entries.append(MappedObject(index, subindex, bits, wanted is not None and wanted.signed, name))
    return PdoMap(tpdo.cob_id, tuple(entries), tpdo.transmission_type, tpdo.number)


def select_tpdos(objects: DriveObjects, maps: Sequence[PdoMap]) -> tuple[PdoMap, ...]:
    """Return the fewest PDOs that carry every quantity, in their order; of equally many, the first. Raises LayoutError."""
    wanted = set(objects.quantities())
    for count in range(1, len(maps) + 1):
        for some in combinations(maps, count):
            if wanted <= {name for pdo in some for name in pdo.names}:
                return some
    missing = wanted - {name for pdo in maps for name in pdo.names}
    raise _layout_error(objects, missing, maps)


def places(objects: DriveObjects, maps: Sequence[PdoMap]) -> dict[str, Place]:
    """Return where each quantity is, the first place of several. Raises LayoutError for one that is nowhere."""
    found: dict[str, Place] = {}
    for at, pdo in enumerate(maps):
        for entry, name in enumerate(pdo.names):
            found.setdefault(name, Place(at, entry))
    wanted = objects.quantities()
    if missing := wanted.keys() - found.keys():
        raise _layout_error(objects, missing, maps)
    return {name: found[name] for name in wanted}


def _layout_error(objects: DriveObjects, missing: set[str], maps: Sequence[PdoMap]) -> LayoutError:
    lacking = ", ".join(
        f"{label(each.index, each.subindex)} ({name.replace('_', ' ')})"
        for name, each in objects.quantities().items()
        if name in missing
    )
    carried = [f"TPDO{pdo.number} carries {', '.join(f'0x{word:08X}' for word in pdo.words)}" for pdo in maps]
    return LayoutError(f"no TPDO carries {lacking}; {'; '.join(carried) or 'none of its TPDOs can be used'}")


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

    A TPDO without a number, as in logs of jtqd 0.1, has that of its COB-ID.
    """
    maps = []
    for each in tpdos:
        number = each.get("number", (each["cob_id"] - TPDO_BASES[0]) // 0x100 + 1)
        tpdo = Tpdo(number, each["cob_id"], tuple(each["words"]), each["transmission_type"])
        maps.append(map_of(node, tpdo, objects))
    return tuple(maps)


# Configuration of a drive, and its scaling


@dataclass(frozen=True)
class DriveProfile:
    """A CiA 402 drive as jtqd configures it.

    Attributes:
        objects: which of its objects are mapped.
        given: scaling objects by the configuration, which are then not read.
        temperature: object that it sends by TPDO3; None: it sends none.
        torque_constant_nm_per_a: of the motor, for a drive that reports torque instead of current; 0: not known.
        acyclic: its TPDOs may have transmission types 0, 254, 255.
        layout: TPDOs that carry its quantities; empty: TPDO1 and TPDO2 as jtqd maps them.
    """

    node_id: int
    identity: Identity = ANY_IDENTITY
    given: Mapping[Key, int] = field(default_factory=dict)
    temperature: Temperature | None = None
    objects: DriveObjects = CIA_402
    layout: tuple[PdoMap, ...] = ()
    torque_constant_nm_per_a: float = 0.0
    acyclic: bool = False
    profile_number = 402

    @property
    def tpdos(self) -> tuple[PdoMap, ...]:
        """TPDOs of the quantities, and TPDO3 with the temperature."""
        node, objects = self.node_id, self.objects
        layout = self.layout or drive_layout(node, objects)
        return layout if self.temperature is None else (*layout, drive_tpdo3(node, self.temperature))

    @property
    def scaling_objects(self) -> tuple[Key, ...]:
        """Objects that the boot must read."""
        used = self.used_scaling
        return tuple(key for key in EVERY_SCALING_OBJECT if key in used and key not in self.given)

    @property
    def counts_at_shaft(self) -> bool:
        """Whether 6091h scales a quantity."""
        scaled = ((name, each) for name, each in self.objects.quantities().items() if name in SCALES)
        return any(not each.factor and scale_of(name, each.by).at_shaft for name, each in scaled)

    @property
    def used_scaling(self) -> set[Key]:
        """Scaling objects on which this drive's numbers depend, read or given."""
        used = set(GEAR)
        for name, each in self.objects.quantities().items():
            if name in SCALES and not each.factor:
                used |= set(scale_of(name, each.by).keys)
        return used


@dataclass(frozen=True)
class DriveScaling:
    """Factors from a drive's numbers to SI: 6064h, 606Ch (motor side), 60E4h:1 (joint side), 6078h; 0 for none."""

    motor_rad_per_count: float
    motor_rad_s_per_unit: float
    link_rad_per_count: float
    ampere_per_unit: float


def drive_scaling(profile: DriveProfile, read: Mapping[Key, int]) -> tuple[DriveScaling, float]:
    """Return (scaling, gear ratio) from the objects read and given. Raises ScalingError."""
    values = {**read, **profile.given}
    used = profile.used_scaling
    for key, (name, highest) in EVERY_SCALING_OBJECT.items():
        if key in used and not 1 <= values[key] <= highest:
            raise ScalingError(key, name, expected=f"1..{highest}", found=str(values[key]))

    def factor(name: str) -> float:
        each: DriveObject | None = getattr(profile.objects, name)
        if each is None:
            return 0.0
        if each.factor is not None:
            return each.sign * each.factor
        constant = profile.torque_constant_nm_per_a
        return each.sign * si_per_unit(name, each.by, each.shaft, values, constant)

    scaling = DriveScaling(
        factor("motor_position"), factor("motor_velocity"), factor("link_position"), factor("current")
    )
    return scaling, values[GEAR[0]] / values[GEAR[1]]
