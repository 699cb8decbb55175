"""Devices on the bus: identity, PDOs and scaling of a drive (CiA 402) and of a torque sensor (CiA 404), PDO of jtqd.

Scaling is computed from the devices' own objects. An object a device does not have, or has wrong, is given
by the configuration instead ("608Fh:1" -> number); no factor is a constant of this code.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from jtqd.drivers.pdo import MappedObject, PdoMap
from jtqd.drivers.sdo import Key, label
from jtqd.drivers.units import (
    AT_JOINT,
    GEAR,
    OTHER_SCALING_OBJECTS,
    SCALES,
    ScalingError,
    scale_of,
    si_per_unit,
)

JTQD_NODE = 0x20
COMMANDER_NODE = 0x21
"""Node that may command the drives beside jtqd; they watch its heartbeat by 1016h:2."""
SYNC_COB_ID = 0x080
ESTIMATE_BASES = (0x180, 0x280)
CONTACT_BASES = (0x380, 0x480)
"""Of jtqd's PDOs with the estimates of joints 1 and 2, and of joints 3 and 4."""

# Objects that scale a drive's numbers, with the largest value that makes sense. All must be at least 1.
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
EVERY_SCALING_OBJECT = DRIVE_SCALING_OBJECTS | OTHER_SCALING_OBJECTS
UNIT_OBJECT, DECIMALS_OBJECT, OPERATING_MODE_OBJECT = 0x6131, 0x6132, 0x6112
JOULE = 0x23  # CiA 303-2 code of J = Nm; the table has none of the newton metre that could be verified
MAX_DECIMALS = 9
SENSOR_SCALING_OBJECTS: dict[Key, tuple[str, int]] = {
    (index, channel): (f"{name} of channel {channel}", highest)
    for channel in (1, 2)
    for index, name, highest in (
        (UNIT_OBJECT, "physical unit", 0xFFFF_FFFF),
        (DECIMALS_OBJECT, "decimal digits", MAX_DECIMALS),
    )
}
"""Objects that scale a sensor's channels, with their largest value."""

TEMPERATURE_C_PER_UNIT = 0.1
"""Of 3001h."""
NOT_MEASURED = -0x8000
"""Temperature of a drive that has the object and no sensor behind it."""
EVENT_MS = 500
"""Event timer and inhibit time of an event-driven TPDO: at least, and at most, one in this time."""
EVENT_DRIVEN = (254, 255)
"""Transmission types of a PDO that its producer sends by itself."""


@dataclass(frozen=True)
class Identity:
    """Expected 1018h and software version; None: not checked."""

    vendor: int | None = None
    product: int | None = None
    revision: int | None = None
    serial: int | None = None
    software: str | None = None
    """100Ah."""


@dataclass(frozen=True)
class DriveObject:
    """Which object of a drive holds a quantity.

    Attributes:
        index, subindex, bits, signed: the object; it is mapped as a whole.
        sign: -1 where the drive counts the other way.
        factor: SI units per unit; None: by the scaling objects of the drive.
        by: which of them (`units.SCALES`); "": those of CIA_402.
        shaft: where it counts, for those that count at a shaft (`units.SHAFTS`).
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

    def scaled_by(self) -> dict[str, tuple[Key, ...]]:
        """Return the scaling objects of each quantity that the drive has; none for one with a factor of its own."""
        found = {name: getattr(self, name) for name in SCALES}
        return {
            name: () if each.factor else scale_of(name, each.by).keys
            for name, each in found.items()
            if each is not None
        }


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


@dataclass(frozen=True)
class DriveProfile:
    """A CiA 402 drive as jtqd configures it.

    Attributes:
        objects: which of its objects are mapped.
        given: scaling objects by the configuration, which are then not read.
        temperature: object that it shall send by TPDO3; None: it sends none.
        torque_constant_nm_per_a: of the motor, for a drive that tells torque instead of current; 0: not known.
        by_itself: its TPDOs may have transmission types 0, 254, 255.
        layout: TPDOs that shall carry its quantities; empty: TPDO1 and TPDO2 as jtqd maps them.
    """

    node_id: int
    identity: Identity = Identity()
    given: Mapping[Key, int] = field(default_factory=dict)
    temperature: Temperature | None = None
    objects: DriveObjects = CIA_402
    layout: tuple[PdoMap, ...] = ()
    torque_constant_nm_per_a: float = 0.0
    by_itself: bool = False
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
    def used_scaling(self) -> set[Key]:
        """Scaling objects that mean something for this drive, read or given."""
        return {*GEAR, *(key for keys in self.objects.scaled_by().values() for key in keys)}


@dataclass(frozen=True)
class SensorProfile:
    """A CiA 404 torque sensor as jtqd configures it.

    Attributes:
        channels: those in use, (1,) or (1, 2).
        given: scaling objects by the configuration, which are then not read.
        unit_words: Nm per unit of a vendor's own 6131h words.
    """

    node_id: int
    identity: Identity = Identity()
    channels: tuple[int, ...] = (1,)
    given: Mapping[Key, int] = field(default_factory=dict)
    unit_words: Mapping[int, float] = field(default_factory=dict)
    profile_number = 404

    def __post_init__(self) -> None:
        if self.channels not in ((1,), (1, 2)):
            raise ValueError(f"sensor node {self.node_id}: channels {self.channels}, expected (1,) or (1, 2)")

    @property
    def tpdos(self) -> tuple[PdoMap, ...]:
        """TPDO1, and TPDO2 when the second channel is used."""
        both = sensor_tpdo1(self.node_id), sensor_tpdo2(self.node_id)
        return both[: len(self.channels)]

    @property
    def scaling_objects(self) -> tuple[Key, ...]:
        """Objects that the boot must read."""
        keys = [(index, channel) for channel in self.channels for index in (UNIT_OBJECT, DECIMALS_OBJECT)]
        return tuple(key for key in keys if key not in self.given)


Profile = DriveProfile | SensorProfile


@dataclass(frozen=True)
class DriveScaling:
    """Factors from a drive's numbers to SI: 6064h, 606Ch (motor side), 60E4h:1 (joint side), 6078h; 0 for none."""

    motor_rad_per_count: float
    motor_rad_s_per_unit: float
    link_rad_per_count: float
    ampere_per_unit: float


@dataclass(frozen=True)
class SensorScaling:
    """Nm per unit of 9130h/7130h, by channel."""

    nm_per_unit: Mapping[int, float]


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
    found = ((getattr(objects, name), name) for name in names)
    return tuple(
        MappedObject(each.index, each.subindex, each.bits, each.signed, name)
        for each, name in found
        if each is not None
    )


def drive_tpdo3(node: int, temperature: Temperature = Temperature()) -> PdoMap:
    """380h+n: joint temperature, not bound to SYNC: when the event timer runs out (transmission type 255)."""
    return PdoMap(0x380 + node, (MappedObject(*temperature.key, 16, True, "temperature"),), 255)


def drive_rpdo1(node: int) -> PdoMap:
    """200h+n: controlword, target torque; taken when it arrives (transmission type 255)."""
    control = MappedObject(0x6040, 0, 16, False, "controlword")
    return PdoMap(0x200 + node, (control, MappedObject(0x6071, 0, 16, True, "target_torque")), 255)


def drive_rpdo2(node: int) -> PdoMap:
    """300h+n: target velocity; taken when it arrives (transmission type 255)."""
    return PdoMap(0x300 + node, (MappedObject(0x60FF, 0, 32, True, "target_velocity"),), 255)


def sensor_tpdo1(node: int) -> PdoMap:
    """180h+n: first channel, 32 bits, and its status."""
    torque = MappedObject(0x9130, 1, 32, True, "torque_1")
    return PdoMap(0x180 + node, (torque, MappedObject(0x6150, 1, 8, False, "torque_status_1")))


def sensor_tpdo2(node: int) -> PdoMap:
    """280h+n: second channel in 16 bits (so that the bus stays below 95 %), and its status."""
    torque = MappedObject(0x7130, 2, 16, True, "torque_2")
    return PdoMap(0x280 + node, (torque, MappedObject(0x6150, 2, 8, False, "torque_status_2")))


def estimate_tpdos(joints: int, node: int = JTQD_NODE) -> tuple[PdoMap, ...]:
    """180h+20h: the estimate of joints 1 and 2; with more than two joints also 280h+20h: of joints 3 and 4.

    2100h..2103h and 2105h of jtqd.eds and jtqd4.eds. The second half of an odd joint's PDO says that there is none.
    """
    return tuple(
        _estimate_tpdo(pair, base + node)
        for pair, base in zip(range((joints + 1) // 2), ESTIMATE_BASES, strict=False)
    )


def contact_tpdos(joints: int, node: int = JTQD_NODE) -> tuple[PdoMap, ...]:
    """380h+20h: torque rate and contact of joints 1 and 2; with more than two joints also 480h+20h: of joints 3 and 4.

    2106h..2108h and 2103h of jtqd.eds and jtqd4.eds. Four bytes each: a bus of two joints with sensor has room for them.
    """
    return tuple(
        _contact_tpdo(pair, base + node)
        for pair, base in zip(range((joints + 1) // 2), CONTACT_BASES, strict=False)
    )


def _contact_tpdo(pair: int, cob_id: int) -> PdoMap:
    rates = [MappedObject(0x2106, n, 8, True, f"torque_rate_{n}") for n in (2 * pair + 1, 2 * pair + 2)]
    contact = MappedObject((0x2107, 0x2108)[pair], 0, 8, False, "contact")
    return PdoMap(cob_id, (*rates, contact, MappedObject(0x2103, 0, 8, False, "sequence")))


def _estimate_tpdo(pair: int, cob_id: int) -> PdoMap:
    numbers = (2 * pair + 1, 2 * pair + 2)
    torques = [MappedObject(0x2100, joint, 16, True, f"torque_{joint}") for joint in numbers]
    sigmas = [MappedObject(0x2101, joint, 8, False, f"sigma_{joint}") for joint in numbers]
    status = MappedObject((0x2102, 0x2105)[pair], 0, 8, False, "status")
    return PdoMap(cob_id, (*torques, *sigmas, status, MappedObject(0x2103, 0, 8, False, "sequence")))


def drive_scaling(profile: DriveProfile, read: Mapping[Key, int]) -> tuple[DriveScaling, float]:
    """Return (scaling, gear ratio) from the objects read and given. Raises ScalingError."""
    values = {**read, **profile.given}
    objects = profile.objects
    used = profile.used_scaling
    for key, (name, highest) in EVERY_SCALING_OBJECT.items():
        if key in used and not 1 <= values[key] <= highest:
            raise ScalingError(key, name, expected=f"1..{highest}", found=str(values[key]))

    def factor(name: str) -> float:
        each: DriveObject | None = getattr(objects, name)
        if each is None:
            return 0.0
        if each.factor is not None:
            return each.sign * each.factor
        constant = profile.torque_constant_nm_per_a
        return each.sign * si_per_unit(name, each.by, each.shaft, values, constant)

    scaling = DriveScaling(
        factor("motor_position"), factor("motor_velocity"), factor("link_position"), factor("current")
    )
    return scaling, values[0x6091, 1] / values[0x6091, 2]


def sensor_scaling(profile: SensorProfile, read: Mapping[Key, int]) -> SensorScaling:
    """Return Nm per unit of each used channel: unit word (CiA 303-2) over decimal digits. Raises ScalingError."""
    values = {**read, **profile.given}
    factors = {}
    for channel in profile.channels:
        decimals = values[DECIMALS_OBJECT, channel]
        if not 0 <= decimals <= MAX_DECIMALS:
            key, expected = (DECIMALS_OBJECT, channel), f"0..{MAX_DECIMALS}"
            raise ScalingError(key, "decimal digits", expected=expected, found=str(decimals))
        factors[channel] = _nm_of_unit(profile, channel, values[UNIT_OBJECT, channel]) / 10**decimals
    return SensorScaling(factors)


def _nm_of_unit(profile: SensorProfile, channel: int, word: int) -> float:
    """Decode 6131h: prefix exponent (signed byte), numerator, denominator, 0."""
    if word in profile.unit_words:
        return profile.unit_words[word]
    if word & 0x00FF_FFFF != JOULE << 16:
        expected = "0xXX230000 (J = Nm) or a word given in the configuration"
        key = UNIT_OBJECT, channel
        raise ScalingError(key, "physical unit", expected=expected, found=f"0x{word:08X}")
    exponent = int.from_bytes([word >> 24], signed=True)
    return 10.0**exponent


def parse_key(text: str) -> Key:
    """Return (index, sub-index) of "608Fh:1" or "6075h". Raises ValueError."""
    index, _, subindex = text.partition("h")
    key = int(index, 16), int(subindex.removeprefix(":") or "0")
    if text not in (label(*key), f"{key[0]:04X}h"):
        raise ValueError(f"{text!r} is not an object like 608Fh:1")
    return key
