"""Units of a drive's numbers: from its scaling objects to SI, for each quantity by the objects that are named.

| quantity | by | SI per unit |
|---|---|---|
| motor position, motor velocity | 608Fh | 2 pi 608Fh:2 / 608Fh:1 (counts; counts per second) |
| motor velocity | 6090h | 2 pi 6090h:2 / 6090h:1 (units of their own per second) |
| link position | 60E6h | 2 pi 60EBh:1 / 60E6h:1 |
| motor position, motor velocity, link position | 6092h | 2 pi 6092h:2 / 6092h:1 (units per turn of the driving shaft) |
| positions; motor velocity | 60A8h; 60A9h | of the unit that the word names (CiA 303-2) |
| current | 6075h | 6075h / 10^6 (1/1000 of the rated current in mA) |
| current | 6076h | 6076h / 10^6 / torque constant (1/1000 of the rated torque in mNm: 6077h) |

Unit codes: CiA DR-303-2, tables 4.1, 4.2 and 4.4 (not at hand themselves; github.com/heig-vd-iai/canopen-stack,
generator/validation/helpers.py, has them): radian 10h, degree 41h, second 03h, minute 47h. The revolution B4h is that of
60A9h in the manuals of Synapticon and Nanotec (B4h 47h is rpm); increments B5h are those of maxon's and Nanotec's.

6092h, 60A8h and 60A9h count at the driving shaft, behind the gear of 6091h (CiA 402-2): the motor's quantities are
6091h:1 / 6091h:2 times as large, unless the drive counts at the motor's shaft. Pure.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

from jtqd.drivers.sdo import Key

TURN = 2.0 * math.pi
AT_JOINT, AT_MOTOR = "joint", "motor"
SHAFTS = (AT_JOINT, AT_MOTOR)
GEAR: tuple[Key, Key] = ((0x6091, 1), (0x6091, 2))
OTHER_SCALING_OBJECTS: dict[Key, tuple[str, int]] = {
    (0x6076, 0): ("motor rated torque in mNm", 1_000_000_000),
    (0x6092, 1): ("feed constant, position units", 2**31),
    (0x6092, 2): ("feed constant, driving shaft revolutions", 2**31),
    (0x60A8, 0): ("SI unit position", 0xFFFF_FFFF),
    (0x60A9, 0): ("SI unit velocity", 0xFFFF_FFFF),
}
"""Objects that scale a drive's numbers where the configuration says so, with the largest value that makes sense."""

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


class Scale(NamedTuple):
    """How a quantity is scaled: objects that are read, SI per unit of their values, whether at the driving shaft."""

    keys: tuple[Key, ...]
    factor: Callable[[Values], float]
    at_shaft: bool = False


def unit_of_position(word: int) -> float:
    """Return rad per unit of 60A8h: prefix (signed exponent of ten), numerator, 0, 0. Raises ScalingError."""
    if word >> 16 & 0xFF not in _ANGLES or word & 0xFFFF:
        raise _unit_error((0x60A8, 0), _ANGLE_TEXT, word)
    return _prefix(word) * _ANGLES[word >> 16 & 0xFF]


def unit_of_velocity(word: int) -> float:
    """Return rad/s per unit of 60A9h: prefix, numerator, denominator, 0. Raises ScalingError."""
    angle, time = word >> 16 & 0xFF, word >> 8 & 0xFF
    if angle not in _ANGLES or time not in _TIMES or word & 0xFF:
        raise _unit_error((0x60A9, 0), _SPEED_TEXT, word)
    return _prefix(word) * _ANGLES[angle] / _TIMES[time]


def is_increments(word: int, denominator: int = 0) -> bool:
    """Return whether a word of 60A8h, or of 60A9h with the code of its time, names increments: scaled by 608Fh."""
    return word == INCREMENTS << 16 | denominator << 8


def _prefix(word: int) -> float:
    exponent = int.from_bytes([word >> 24], signed=True)
    return float(10.0**exponent)


_COUNTS = Scale(((0x608F, 1), (0x608F, 2)), lambda v: TURN * v[0x608F, 2] / v[0x608F, 1])
_FEED = Scale(((0x6092, 1), (0x6092, 2)), lambda v: TURN * v[0x6092, 2] / v[0x6092, 1], True)
_SI_POSITION = Scale(((0x60A8, 0),), lambda v: unit_of_position(v[0x60A8, 0]), True)
SCALES: dict[str, dict[str, Scale]] = {
    "motor_position": {"608Fh": _COUNTS, "6092h": _FEED, "60A8h": _SI_POSITION},
    "motor_velocity": {
        "6090h": Scale(((0x6090, 1), (0x6090, 2)), lambda v: TURN * v[0x6090, 2] / v[0x6090, 1]),
        "608Fh": _COUNTS,
        "6092h": _FEED,
        "60A9h": Scale(((0x60A9, 0),), lambda v: unit_of_velocity(v[0x60A9, 0]), True),
    },
    "link_position": {
        "60E6h": Scale(((0x60E6, 1), (0x60EB, 1)), lambda v: TURN * v[0x60EB, 1] / v[0x60E6, 1]),
        "6092h": _FEED,
        "60A8h": _SI_POSITION,
    },
    "current": {
        # 6078h is 1/1000 of 6075h, which is in mA; 6077h of 6076h, which is in mNm
        "6075h": Scale(((0x6075, 0),), lambda v: v[0x6075, 0] * 1e-3 * 1e-3),
        "6076h": Scale(((0x6076, 0),), lambda v: v[0x6076, 0] * 1e-3 * 1e-3),
    },
}
"""By quantity of `devices.DriveObjects` and index; the first one is that of CIA_402."""
BY_TORQUE = "6076h"


def scale_of(quantity: str, by: str) -> Scale:
    """Return how a quantity is scaled by an object; by "": the first one of the quantity."""
    every = SCALES[quantity]
    return every[by or next(iter(every))]


def si_per_unit(quantity: str, by: str, shaft: str, values: Values, torque_constant_nm_per_a: float) -> float:
    """Return SI (rad, rad/s, A) per unit of a quantity. Raises ScalingError.

    shaft: where 6092h, 60A8h and 60A9h count. torque_constant_nm_per_a: of the motor, for a current by its torque.
    """
    scale = scale_of(quantity, by)
    factor = scale.factor(values)
    if by == BY_TORQUE:
        return factor / torque_constant_nm_per_a
    if scale.at_shaft and shaft == AT_JOINT and quantity.startswith("motor"):
        return factor * values[GEAR[0]] / values[GEAR[1]]
    return factor
