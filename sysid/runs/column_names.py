"""What the name of a column states: quantity, unit, number of the joint, words. Tables of units and words.

    name = words of a quantity [number of the joint] [unit], split at separators, brackets and changes of case

What is in brackets, else the longest end of the name, is the unit where it is one of the quantity. A word may be of several
quantities ("t": time, torque, temperature): the unit decides. A unit of none of them contradicts the name.
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
UNITS: Final = (
    (TIME, "s", 1.0, "s sec secs second seconds"),
    (TIME, "ms", 1e-3, "ms msec millis milliseconds"),
    (TIME, "us", 1e-6, "us usec micros microseconds"),
    (TIME, "ns", 1e-9, "ns nsec nanos nanosec nanoseconds"),
    (ANGLE, "rad", 1.0, "rad radian radians"),
    (ANGLE, "mrad", 1e-3, "mrad"),
    (ANGLE, "deg", math.radians(1.0), "deg degree degrees"),
    (ANGLE, "rev", _TURN, "rev revs turn turns revolutions"),
    (ANGLE, COUNTS, math.nan, "counts count cnt cnts ticks tick inc increments lsb pulses"),
    (SPEED, "rad/s", 1.0, "rad_s rad_sec rad_second radians_second rads radps radsec"),
    (SPEED, "mrad/s", 1e-3, "mrad_s mrad_sec mrads"),
    (SPEED, "deg/s", math.radians(1.0), "deg_s deg_sec deg_second degrees_second degs degps degsec dps"),
    (SPEED, "rev/s", _TURN, "rev_s rev_sec turns_s turn_s rps hz"),
    (SPEED, "rpm", _TURN / 60.0, "rpm 1_min r_min rev_min"),
    (CURRENT, "A", 1.0, "a amp amps ampere amperes"),
    (CURRENT, "mA", 1e-3, "ma milliamps"),
    (TORQUE, "Nm", 1.0, "nm n_m newtonmeter"),
    (TORQUE, "mNm", 1e-3, "mnm mn_m nmm n_mm"),
    (TORQUE, "Ncm", 1e-2, "ncm n_cm"),
    (TORQUE, "kNm", 1e3, "knm kn_m"),
    (VOLTAGE, "V", 1.0, "v volt volts"),
    (VOLTAGE, "mV", 1e-3, "mv millivolts"),
    (TEMPERATURE, "degC", 1.0, "c degc deg_c celsius deg degrees"),
    ("", "rad/s2", math.nan, "rad_s2 rad_s_2 deg_s2 deg_s_2"),
)
"""Quantity, unit, SI units per unit (NaN: not known), its spellings."""
_SPELLINGS: Final[Mapping[str, list[tuple[str, str, float]]]] = {
    spelling: [unit[:3] for unit in UNITS if spelling in unit[3].split()]
    for spelling in " ".join(unit[3] for unit in UNITS).split()
}
_WORDS: Final[Mapping[str, tuple[str, ...]]] = {
    word: (*kinds.split(),) or ("",)
    for kinds, words in (
        ("time", "time timestamp stamp elapsed clock"),
        ("time torque temperature", "t"),
        ("time torque", "ts"),
        ("position velocity", "position pos angle ang q theta phi enc encoder"),
        ("velocity", "velocity vel speed omega w dot"),
        ("current", "current cur curr i iq"),
        ("torque", "torque tau tq trq moment mz tz loadcell cell"),
        ("torque current", "effort"),
        ("voltage", "voltage u uq"),
        ("duty", "duty dutycycle pwm"),
        ("temperature", "temperature temp winding"),
        ("enabled", "enabled enable"),
        ("", "acc accel acceleration ddot force status error err fault id index seq"),
    )
    for word in words.split()
}
"""Word of a name -> what it may be of; the last such word holds ("torque current" is a current). "": of no use here."""
COMMAND, MOTOR, LINK, SENSOR, SUPPLY = (
    frozenset(words.split())
    for words in (
        "cmd command commanded des desired ref reference target setpoint sp goal demand demanded set estimate sigma",
        "motor mot m rotor input hs fast",
        "link joint l output out load arm lever abs absolute secondary ls",
        "sensor ft measured meas loadcell cell transducer ts",
        "bus battery bat supply vbus dc board mcu logic",
    )
)
"""Words that state what a column is of."""
_TOKEN: Final = re.compile(r"\d+|[A-Z]+(?![^\W\d_A-Z])|[A-Z]?[^\W\d_A-Z]+")


class Name(NamedTuple):
    """kind, unit: "" where none is stated (a unit without a kind contradicts the name); factor: SI units per unit (NaN: not
    known); number: the last one, of a joint; words: without the unit; others: what it may be of as well.
    """

    column: str
    kind: str
    unit: str
    factor: float
    number: int | None
    words: frozenset[str]
    others: tuple[str, ...] = ()


def read_name(column: str) -> Name:
    """Return what the name of a column states.

    >>> read_name("Motor Angle [deg]")[1:3], read_name("j2_iq_mA")[1:5]
    (('position', 'deg'), ('current', 'mA', 0.001, 2))
    """
    text = re.sub(r"(?i)(?<![^\W_])i_q", "iq", column)
    stated = [x for x in re.findall(r"[\[(][^\[\]()]*[\])]", text) if _spelling(_tokens(x)) in _SPELLINGS]
    for bracket in stated:
        text = text.replace(bracket, " ")
    tokens = _tokens(text)
    plain = [token for token, _ in tokens]
    last = max((k for k, token in enumerate(plain, 1) if not token.isdigit()), default=0)
    stops = (len(plain), last) if _kinds(plain) else range(len(plain), 0, -1)
    spans = [(start, stop) for stop in stops for start in range(max(0, stop - 3), stop)]
    units = [(plain, plain, _spelling(_tokens(bracket))) for bracket in stated]
    units += [(plain[:a], plain[:a] + plain[b:], _spelling(tokens[a:b])) for a, b in spans]
    contradicts = ""
    for k, (head, rest, spelling) in enumerate(units):
        kinds = {kind for word in head for kind in _kinds([word])} if k < len(stated) else {*_kinds(head)}
        for kind, unit, factor in _SPELLINGS.get(spelling, ()):
            alone = len(spelling) > 1 or k < len(stated)
            if kind in kinds or (not kinds and alone):
                return Name(column, kind, unit, factor, _number(rest), frozenset(rest))
            if alone and not {DUTY, ENABLED} & kinds:
                contradicts = contradicts or unit
    kind, *others = (not contradicts and _kinds(plain)) or ("",)
    return Name(column, kind, contradicts, math.nan, _number(plain), frozenset(plain), tuple(others))


def _tokens(text: str) -> list[tuple[str, bool]]:
    """Return the words and numbers of a text in lower case, and whether a separator stands before them."""
    text = re.sub("[µμ]", "u", text.replace("°", "deg"))
    parts = [_TOKEN.findall(part) for part in re.findall(r"[^\W_]+", text)]
    return [(x.lower(), k == 0) for part in parts for k, x in enumerate(part) if x.lower() != "per"]


def _spelling(tokens: list[tuple[str, bool]]) -> str:
    return "".join(f"{'_' if apart else ''}{token}" for token, apart in tokens).lstrip("_")


def _kinds(words: list[str]) -> tuple[str, ...]:
    """Return what the last known word is of; d and dot make derivatives of angles: dq, qd, qdot, ddq."""
    for word in reversed(words):
        if word in _WORDS:
            return _WORDS[word]
        made = re.fullmatch(r"(d*)(.+?)(d*)(ot)?", word)
        if made and (order := len(made[1] + made[3])) and _WORDS.get(made[2], ("",))[0] == ANGLE:
            return (SPEED,) if order == 1 else ("",)
    return ()


def _number(words: list[str]) -> int | None:
    return next((int(each) for each in reversed(words) if each.isdigit() and len(each) <= 2), None)


def quoted(column: str) -> str:
    """Return a column as an expression has it."""
    return column if re.fullmatch(r"[^\W\d]\w*(\.[^\W\d]\w*)*", column) else f"`{column}`"
