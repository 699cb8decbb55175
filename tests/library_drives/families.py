"""Nodes with the object layouts of drive families, as their makers' data sheets and manuals have them (docs/bus.md).

They show that a profile configures such a layout, and scales it right. They are no drives: what a data sheet does not say is
as in `StrictDrive`. `Millidegrees` and `Feed` are of no maker: drives of CiA 402 in other units.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar

from canopen.objectdictionary import INTEGER16, INTEGER32, UNSIGNED8, UNSIGNED16, UNSIGNED32

from tests.library_drives.nodes import GEAR, LINK_COUNTS, Manners, StrictDrive

Numbers = dict[tuple[int, int], tuple[int, Any, str]]
RATED_MA = 4760
PULSES = 16384
_U8, _U16, _U32, _I16, _I32 = UNSIGNED8, UNSIGNED16, UNSIGNED32, INTEGER16, INTEGER32


def _identity(vendor: int, product: int) -> Numbers:
    return {(0x1018, 1): (_U32, vendor, "ro"), (0x1018, 2): (_U32, product, "ro")}


def _motion(now: float) -> tuple[float, float, float]:
    """Turns of the motor, its revolutions per second, and amperes: as of `StrictDrive`."""
    phase = 2.0 * math.pi * 0.2 * now
    return math.sin(phase), 2.0 * math.pi * 0.2 * math.cos(phase), math.sin(phase)


class Epos4(StrictDrive):
    """No 608Fh, 6075h, 6078h, 6091h, 1006h, 1019h: rpm, 1/1000 of the rated torque, gear in 3003h, encoders in 60E4h."""

    lacks = (0x1006, 0x1009, 0x100A, 0x1019)
    process: ClassVar[Numbers] = {
        **_identity(0xFB, 0x65520000),
        (0x3001, 0): (_U8, 5, "ro"),
        (0x3001, 1): (_U32, RATED_MA, "rw"),
        (0x3001, 5): (_U32, 107746, "rw"),
        (0x3003, 0): (_U8, 2, "ro"),
        (0x3003, 1): (_U32, GEAR, "rw"),
        (0x3003, 2): (_U32, 1, "rw"),
        (0x3010, 0): (_U8, 1, "ro"),
        (0x3010, 1): (_U32, PULSES, "rw"),
        (0x6007, 0): (_I16, 3, "rw"),
        (0x6041, 0): (_U16, 0x1237, "ro"),
        (0x6064, 0): (_I32, 0, "ro"),
        (0x606C, 0): (_I32, 0, "ro"),
        (0x6076, 0): (_U32, 512871, "rw"),
        (0x6077, 0): (_I16, 0, "ro"),
        (0x60A8, 0): (_U32, 0x00B50000, "rw"),
        (0x60A9, 0): (_U32, 0x00B44700, "rw"),
        (0x60E4, 0): (_U8, 3, "const"),
        (0x60E4, 1): (_I32, 0, "ro"),
        (0x60E4, 2): (_I32, 0, "ro"),
        (0x60E4, 3): (_I32, 0, "ro"),
        (0x60E5, 0): (_U8, 2, "const"),
        (0x60E5, 1): (_I32, 0, "ro"),
        (0x60E5, 2): (_I32, 0, "ro"),
    }

    def value(self, index: int, subindex: int, now: float) -> int:
        turns, per_s, amperes = _motion(now)
        return {
            (0x6041, 0): 0x1237,
            (0x6064, 0): round(LINK_COUNTS * turns / GEAR),  # a dual loop: the main sensor is at the load
            (0x606C, 0): round(60 * per_s / GEAR),
            (0x6077, 0): round(1000 * amperes / (1e-3 * RATED_MA)),
            (0x60E4, 1): round(4 * PULSES * turns),
            (0x60E4, 2): round(LINK_COUNTS * turns / GEAR),
            (0x60E5, 1): round(60 * per_s),
        }[index, subindex]


class ElmoGold(StrictDrive):
    """608Fh, 6090h, 6091h at 1:1, 60E4h that cannot be mapped, 20A0h for the second encoder, no 1005h."""

    lacks = (0x1005, 0x1019)
    unmappable = frozenset({(0x60E4, 0)})
    process: ClassVar[Numbers] = {
        **_identity(0x9A, 0x00030923),
        (0x1029, 1): (_U8, 1, "rw"),
        (0x20A0, 0): (_I32, 0, "ro"),
        (0x6041, 0): (_U16, 0x1237, "ro"),
        (0x6064, 0): (_I32, 0, "ro"),
        (0x606C, 0): (_I32, 0, "ro"),
        (0x6075, 0): (_U32, RATED_MA, "rw"),
        (0x6076, 0): (_U32, 500, "rw"),
        (0x6077, 0): (_I16, 0, "ro"),
        (0x6078, 0): (_I16, 0, "ro"),
        **{(index, 0): (_U8, 2, "const") for index in (0x608F, 0x6090, 0x6091)},
        **{(index, sub): (_U32, 1, "rw") for index in (0x608F, 0x6090, 0x6091) for sub in (1, 2)},
        (0x60E4, 0): (_I32, 0, "ro"),
    }

    def value(self, index: int, subindex: int, now: float) -> int:
        turns, per_s, amperes = _motion(now)
        return {
            0x20A0: round(LINK_COUNTS * turns / GEAR),
            0x6041: 0x1237,
            0x6064: round(4 * PULSES * turns),
            0x606C: round(4 * PULSES * per_s),
            0x6078: round(1000 * amperes / (1e-3 * RATED_MA)),
        }[index]


class Nanotec(StrictDrive):
    """Tenths of a degree, rpm, 1/1000 of the rated torque, 60E4h:1 without a sensor, 6091h at 1:1."""

    lacks = (0x1019,)
    process: ClassVar[Numbers] = {
        **_identity(0x26C, 0x1),
        (0x203B, 0): (_U8, 1, "const"),
        (0x203B, 1): (_U32, RATED_MA, "rw"),
        (0x6041, 0): (_U16, 0x1237, "ro"),
        (0x6064, 0): (_I32, 0, "ro"),
        (0x606C, 0): (_I32, 0, "ro"),
        (0x6077, 0): (_I16, 0, "ro"),
        (0x608F, 0): (_U8, 2, "const"),
        (0x608F, 1): (_U32, 2000, "rw"),
        (0x608F, 2): (_U32, 1, "rw"),
        (0x6091, 0): (_U8, 2, "const"),
        (0x6091, 1): (_U32, 1, "rw"),
        (0x6091, 2): (_U32, 1, "rw"),
        (0x60A8, 0): (_U32, 0xFF410000, "rw"),
        (0x60A9, 0): (_U32, 0x00B44700, "rw"),
        (0x60E4, 0): (_U8, 3, "const"),
        (0x60E4, 1): (_I32, 0, "ro"),
        (0x60E4, 2): (_I32, 0, "ro"),
        (0x60E4, 3): (_I32, 0, "ro"),
    }

    def value(self, index: int, subindex: int, now: float) -> int:
        turns, per_s, amperes = _motion(now)
        return {
            (0x6041, 0): 0x1237,
            (0x6064, 0): round(3600 * turns),
            (0x606C, 0): round(60 * per_s),
            (0x6077, 0): round(1000 * amperes / (1e-3 * RATED_MA)),
            (0x60E4, 3): round(3600 * turns / GEAR),
        }[index, subindex]


class Millidegrees(StrictDrive):
    """Thousandths of a degree of the joint, and these per second: 60A8h and 60A9h, beside the encoders' resolutions."""

    process: ClassVar[Numbers] = {
        **StrictDrive.process,
        (0x60A8, 0): (_U32, 0xFD410000, "rw"),
        (0x60A9, 0): (_U32, 0xFD410300, "rw"),
    }

    def value(self, index: int, subindex: int, now: float) -> int:
        turns, per_s, _ = _motion(now)
        reported = {0x6064: 360_000 * turns, 0x606C: 360_000 * per_s, 0x60E4: 360_000 * turns}
        return round(reported[index] / GEAR) if index in reported else super().value(index, subindex, now)


class Feed(StrictDrive):
    """36 000 units per turn of the shaft that the drive knows: the motor's, as its 6091h is 1:1; no 6090h, no 60A9h."""

    lacks = (0x6090,)
    process: ClassVar[Numbers] = {
        **StrictDrive.process,
        (0x6091, 1): (_U32, 1, "rw"),
        (0x6092, 0): (_U8, 2, "const"),
        (0x6092, 1): (_U32, 36_000, "rw"),
        (0x6092, 2): (_U32, 1, "rw"),
    }

    def value(self, index: int, subindex: int, now: float) -> int:
        turns, per_s, _ = _motion(now)
        reported = {0x6064: 36_000 * turns, 0x606C: 36_000 * per_s, 0x60E4: 36_000 * turns / GEAR}
        return round(reported[index]) if index in reported else super().value(index, subindex, now)


FAMILIES: dict[str, type[StrictDrive]] = {
    "standard": StrictDrive,
    "epos4": Epos4,
    "elmo_gold": ElmoGold,
    "nanotec": Nanotec,
    "millidegrees": Millidegrees,
    "feed": Feed,
}


def manners_of(family: str, manners: Manners) -> Manners:
    """The manners, and what the family lacks."""
    lacks = getattr(FAMILIES[family], "lacks", ())
    return Manners(
        manners.boot_ups, manners.sdo_s, (*manners.without, *lacks), manners.reset_s, manners.fixed
    )
