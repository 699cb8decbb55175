"""What the name of a column states: quantity, unit, number of the joint, words. Tables of units and words.

A unit in brackets holds ("Iq [mA]"), else the last words of the name where they fit its quantity ("motor_speed_rpm").
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Final, NamedTuple

TIME, ANGLE, SPEED, CURRENT, TORQUE, VOLTAGE, DUTY, TEMPERATURE, ENABLED = (
    *("time", "position", "velocity", "current", "torque", "voltage", "duty", "temperature", "enabled"),
)
"""Quantities."""
COUNTS: Final = "counts"
_TURN: Final = 2.0 * math.pi
UNITS: Final[Mapping[str, tuple[str, str, float]]] = {
    spelling: (kind, unit, factor)
    for kind, unit, factor, spellings in (
        (TIME, "s", 1.0, "s sec secs second seconds"),
        (TIME, "ms", 1e-3, "ms msec millis milliseconds"),
        (TIME, "us", 1e-6, "us µs μs usec micros microseconds"),
        (TIME, "ns", 1e-9, "ns nsec nanos nanosec nanoseconds"),
        (ANGLE, "rad", 1.0, "rad radian radians"),
        (ANGLE, "deg", math.radians(1.0), "deg degree degrees °"),
        (ANGLE, "rev", _TURN, "rev revs turn turns revolutions"),
        (ANGLE, COUNTS, math.nan, "counts count cnt cnts ticks tick inc increments lsb pulses"),
        (SPEED, "rad/s", 1.0, "rad/s rad_s rads rad_per_s radps rad_sec"),
        (SPEED, "deg/s", math.radians(1.0), "deg/s deg_s dps degps deg_per_s °/s deg_sec"),
        (SPEED, "rpm", _TURN / 60.0, "rpm 1/min r/min rev/min"),
        (SPEED, "rev/s", _TURN, "rev/s rev_s rps turns/s hz"),
        (CURRENT, "A", 1.0, "a amp amps ampere amperes"),
        (CURRENT, "mA", 1e-3, "ma milliamps"),
        (TORQUE, "Nm", 1.0, "nm n.m n·m n*m n_m newtonmeter"),
        (TORQUE, "mNm", 1e-3, "mnm nmm"),
        (TORQUE, "Ncm", 1e-2, "ncm"),
        (VOLTAGE, "V", 1.0, "v volt volts"),
        (VOLTAGE, "mV", 1e-3, "mv"),
        (TEMPERATURE, "degC", 1.0, "c °c degc deg_c celsius"),
    )
    for spelling in spellings.split()
}
"""Spelling in lower case -> kind, unit, SI units per unit (NaN: not known)."""
_WORDS: Final[Mapping[str, str]] = {
    word: kind
    for kind, words in (
        (TIME, "t time timestamp stamp ts elapsed clock secs nanosec"),
        (ANGLE, "position pos angle ang q theta phi enc encoder counts ticks"),
        (SPEED, "velocity vel speed omega w dq qd qdot dot rpm"),
        (CURRENT, "current cur curr i iq amps amp"),
        (TORQUE, "torque tau tq trq effort moment mz tz loadcell cell"),
        (VOLTAGE, "voltage volt volts u uq"),
        (DUTY, "duty dutycycle pwm"),
        (TEMPERATURE, "temperature temp winding"),
        (ENABLED, "enabled enable"),
        ("", "acc accel acceleration ddq qdd force status error err fault id index seq"),
    )
    for word in words.split()
}
"""Word of a name -> kind; the last such word of a name holds ("torque current" is a current). "": of no use here."""


def _set(text: str) -> frozenset[str]:
    return frozenset(text.split())


COMMAND: Final = _set(
    "cmd command commanded des desired ref reference target setpoint sp goal demand demanded set"
)
MOTOR: Final = _set("motor mot rotor input hs fast")
LINK: Final = _set("link joint output out load arm lever abs absolute secondary ls")
SENSOR: Final = _set("sensor ft measured meas loadcell cell transducer")
SUPPLY: Final = _set("bus battery bat supply vbus dc board mcu logic")
"""Words that state what a column is of."""


class Name(NamedTuple):
    """kind, unit: "" where none is stated; factor: SI units per unit (NaN: not known); number: the last one, of a joint."""

    column: str
    kind: str
    unit: str
    factor: float
    number: int | None
    words: frozenset[str]


def read_name(column: str) -> Name:
    """Return what the name of a column states.

    >>> read_name("Motor Angle [deg]")[1:3], read_name("j2_iq_ma")[1:5]
    (('position', 'deg'), ('current', 'mA', 0.001, 2))
    """
    text, bracket = column.strip(), ""
    match = re.fullmatch(r"(.*?)\s*[\[(]\s*([^\[\]()]*?)\s*[\])]\s*", text)
    if match and not match[2].isdigit():
        text, bracket = match[1], match[2].lower().replace(" ", "")
    text = re.sub(r"(?i)\bi_q", "iq", text)
    tokens = [
        each.lower() for each in re.findall(r"[^\W\d_]+|\d+", re.sub(r"(?<=[a-z])(?=[A-Z])", " ", text))
    ]
    kind = next((_WORDS[each] for each in reversed(tokens) if each in _WORDS), None)
    unit = UNITS.get(bracket)
    for count in (2, 1):
        last = UNITS.get("_".join(tokens[-count:])) if not bracket and len(tokens) >= count else None
        if unit is None and last and (last[0] == kind or (kind is None and len(tokens[-1]) > 1)):
            unit = last
    kind, name, factor = unit or (kind or "", "", math.nan)
    numbers = [int(each) for each in tokens if each.isdigit() and len(each) <= 2]
    return Name(column, kind, name, factor, numbers[-1] if numbers else None, frozenset(tokens))


def quoted(column: str) -> str:
    """Return a column as an expression has it."""
    return column if re.fullmatch(r"[^\W\d]\w*(\.[^\W\d]\w*)*", column) else f"`{column}`"
