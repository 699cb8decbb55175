"""Torque sensors (CiA 404): objects that jtqd maps, their TPDOs, and their scaling to Nm. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from jtqd.drivers.drive import ScalingError, si_prefix
from jtqd.drivers.object_dictionary import ANY_IDENTITY, Identity
from jtqd.drivers.pdo import MappedObject, PdoMap
from jtqd.drivers.sdo import Key

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


@dataclass(frozen=True)
class SensorProfile:
    """A CiA 404 torque sensor as jtqd configures it.

    Attributes:
        channels: those in use, (1,) or (1, 2).
        given: scaling objects by the configuration, which are then not read.
        unit_words: Nm per unit of a vendor's own 6131h words.
    """

    node_id: int
    identity: Identity = ANY_IDENTITY
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


@dataclass(frozen=True)
class SensorScaling:
    """Nm per unit of 9130h/7130h, by channel."""

    nm_per_unit: Mapping[int, float]


def sensor_tpdo1(node: int) -> PdoMap:
    """180h+n: first channel, 32 bits, and its status."""
    torque = MappedObject(0x9130, 1, 32, True, "torque_1")
    return PdoMap(0x180 + node, (torque, MappedObject(0x6150, 1, 8, False, "torque_status_1")))


def sensor_tpdo2(node: int) -> PdoMap:
    """280h+n: second channel in 16 bits (so that the bus stays below 95 %), and its status."""
    torque = MappedObject(0x7130, 2, 16, True, "torque_2")
    return PdoMap(0x280 + node, (torque, MappedObject(0x6150, 2, 8, False, "torque_status_2")))


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
    return si_prefix(word)
