"""Proposed configuration and joint files of a bench: values of devices and operator, and guesses that are marked."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields, replace
from fractions import Fraction
from pathlib import Path
from typing import Any, Final

from jtqd.daemon.config import ObjectsSection
from jtqd.daemon.profiles import INIT, Family, named, of_vendor
from jtqd.drivers.drive import (
    AT_JOINT,
    AT_MOTOR,
    CIA_402,
    EVERY_SCALING_OBJECT,
    GEAR,
    SECOND,
    DriveObjects,
    DriveProfile,
    LayoutError,
    ScalingError,
    drive_layout,
    is_increments,
    map_of,
    select_tpdos,
    si_per_unit,
    unit_of_position,
    unit_of_velocity,
)
from jtqd.drivers.own_objects import COMMANDER_NODE, JTQD_NODE
from jtqd.drivers.pdo import ACYCLIC, EVERY_SYNC, PdoError, Tpdo
from jtqd.drivers.sdo import Key, label, parse_key
from jtqd.drivers.survey import (
    DRIVE,
    IDENTITY,
    MAPPED,
    RATED_CURRENT,
    RATED_TORQUE,
    SENSOR,
    TORQUE,
    BusSurvey,
    Survey,
    survey_of_eds,
)
from jtqd.estimator.decoder import decode

_POSITION_UNIT, _VELOCITY_UNIT = (0x60A8, 0), (0x60A9, 0)
_FEED: tuple[Key, Key] = ((0x6092, 1), (0x6092, 2))
_UNIT_OBJECT: Mapping[str, Key] = {
    "60A8h": _POSITION_UNIT,
    "60A9h": _VELOCITY_UNIT,
    "608Fh": _VELOCITY_UNIT,  # increments per second
    "6092h": _FEED[0],
}
"""Object whose value decides that a quantity is scaled by 60A8h, 60A9h, 608Fh or 6092h."""
_COMPARE: Final = "turn the joint by a known angle and compare jtq status"
_AGE_MS: Final = 100
"""Longest age of an acyclic frame, where the drive has no event timer."""


class UsageError(Exception):
    """Options that contradict each other or the devices, or too few of them."""


# ---- survey ----


def family_of(survey: Survey | None, name: str | None) -> Family | None:
    """Return the profile by name ("none": no profile), else by the drive's vendor-ID. Raises ConfigError."""
    if name is not None:
        return None if name == "none" else named(name)
    if survey is None or survey.profile != DRIVE:
        return None
    return of_vendor(survey.numbers.get(IDENTITY["vendor"]))


def quantities_by(family: Family | None) -> dict[str, Key]:
    """Return the object of each quantity, with a profile or without."""
    standard = {each.name: getattr(CIA_402, each.name) for each in fields(CIA_402)}
    keys = {name: (each.index, each.subindex) for name, each in standard.items()}
    return keys if family is None else {name: family.mapped(name, key) for name, key in keys.items()}


def _needed(family: Family) -> tuple[Key, ...]:
    """Objects of a drive that its profile scales with, and those that jtqd maps."""
    return *family.objects, *quantities_by(family).values()


def surveyed(reader: BusSurvey, node: int, profile: str | None) -> Survey | None:
    """Survey one node, with the objects that its profile needs; None when it does not answer. Raises ConfigError."""
    found = reader.read(node)
    if found is None:
        return None
    found = replace(found, tpdos=reader.tpdos(node))
    family = family_of(found, profile)
    if family is None:
        return found
    wanted = set(_needed(family))
    numbers = {**found.numbers, **reader.numbers(node, wanted - set(found.numbers))}
    return replace(found, numbers=numbers, missing=found.missing | (wanted - set(numbers)))


def eds_survey(path: Path, node: int, profile: str | None) -> Survey:
    """Return the survey by an EDS, with the objects that its profile needs. Raises EdsError, ConfigError."""
    found = survey_of_eds(path, node)
    family = family_of(found, profile)
    return found if family is None else survey_of_eds(path, node, _needed(family))


def merged(eds: Survey, bus: Survey | None, path: Path) -> Survey:
    """Return the values of the bus with what the EDS (of the file `path`) cannot map or write.

    Raises UsageError for the EDS of another vendor's device, or of another kind.
    """
    if bus is None:
        return eds
    expected, found = (each.numbers.get(IDENTITY["vendor"]) for each in (eds, bus))
    if expected and found and expected != found:
        raise UsageError(
            f"{path}: is of vendor {expected:08X}h, but node {bus.node} has {found:08X}h (1018h:1)"
        )
    if eds.profile != bus.profile:
        raise UsageError(
            f"{path}: is of profile {eds.profile}, but node {bus.node} has {bus.profile} (1000h)"
        )
    fixed = {each.number: (each.mapping_fixed, each.type_fixed) for each in eds.tpdos}
    tpdos = []
    for each in bus.tpdos:
        mapping_fixed, type_fixed = fixed.get(each.number, (each.mapping_fixed, each.type_fixed))
        tpdos.append(replace(each, mapping_fixed=mapping_fixed, type_fixed=type_fixed))
    return replace(bus, unmappable=eds.unmappable, tpdos=tuple(tpdos))


def description(survey: Survey) -> str:
    """Return a device in one line: name, versions, vendor, profile, source."""
    texts = [text for name in ("hardware", "software") if (text := survey.texts.get(name))]
    vendor = survey.numbers.get(IDENTITY["vendor"])
    parts = [survey.title, *texts, *([f"vendor {vendor:08X}h"] if vendor else [])]
    return f"{', '.join(parts)} (profile {survey.profile or 'unknown'}, by {survey.source})"


# ---- units ----


@dataclass(frozen=True)
class ObjectEntry:
    """Keys of a quantity in section `objects` (None: the drive does not have it), reason, and how to verify a guess."""

    keys: Mapping[str, Any] | None
    why: str
    verify: str = ""

    @property
    def text(self) -> str:
        """As YAML.

        >>> ObjectEntry({"by": "60A8h", "shaft": "motor"}, "").text, ObjectEntry(None, "").text
        ('{by: 60A8h, shaft: motor}', 'false')
        """
        if self.keys is None:
            return "false"
        return "{" + ", ".join(f"{name}: {_yaml(name, value)}" for name, value in self.keys.items()) + "}"


def _yaml(name: str, value: Any) -> str:
    if name == "index":
        return f"0x{value:04X}"
    return f"{value:.10e}" if isinstance(value, float) else str(value)


def unit_problems(node: int, survey: Survey | None) -> list[str]:
    """Return one line for each unit word that names no angle, or no speed."""
    found = []
    if survey is not None:
        for key, what, unit_of in (
            (_POSITION_UNIT, "positions", _position_unit),
            (_VELOCITY_UNIT, "velocities", _velocity_unit),
        ):
            try:
                unit_of(survey)
            except ScalingError as error:
                found.append(
                    f"node {node} ({survey.title}): {label(*key)}, the unit of {what}: {error}; "
                    "with a factor of your own in joint_N.objects it can be used"
                )
    return found


def _position_unit(survey: Survey) -> str:
    """Return the object that scales positions: "60A8h", "6092h", or "608Fh" (counts). Raises ScalingError."""
    word = survey.number(_POSITION_UNIT)
    if word is not None:
        if is_increments(word):
            return "608Fh"
        unit_of_position(word)
        return "60A8h"
    feed = [survey.number(key) for key in _FEED]
    return "608Fh" if None in feed or feed[0] == feed[1] else "6092h"


def _velocity_unit(survey: Survey) -> str:
    """Return the object that scales velocities: "60A9h", "608Fh" (counts per second), "". Raises ScalingError."""
    word = survey.number(_VELOCITY_UNIT)
    if word is None:
        return ""
    if is_increments(word, SECOND):
        return "608Fh"
    unit_of_velocity(word)
    return "60A9h"


def reported_units(
    survey: Survey | None, gear_ratio: float, quantities: Iterable[str], by_options: Iterable[str]
) -> dict[str, ObjectEntry]:
    """Return how a drive's positions and velocity are scaled, where other objects do so than those of `drive.CIA_402`.

    gear_ratio: of the joint. quantities: those that the drive has. by_options: those that the operator has scaled.
    """
    found: dict[str, ObjectEntry] = {}
    velocity = ""
    if survey is None:
        return found
    with suppress(ScalingError):
        position = _position_unit(survey)
        if position != "608Fh" and not _is_counts(survey, position):
            found["motor_position"] = _scaled(survey, "motor_position", position, gear_ratio)
            verify = f"60E4h:1 is in the unit of 6064h by CiA 402; {_COMPARE}"
            found["link_position"] = _scaled(survey, "link_position", position, gear_ratio, verify)
            if survey.number(_VELOCITY_UNIT) is None:
                found["motor_velocity"] = _per_second(survey, position, gear_ratio)
    with suppress(ScalingError):
        if velocity := _velocity_unit(survey):
            found["motor_velocity"] = _scaled(survey, "motor_velocity", velocity, gear_ratio)
    excluded = set(by_options)
    if velocity == "608Fh":  # counts of that option, per second
        excluded.discard("motor_velocity")
    return {name: found[name] for name in quantities if name in found and name not in excluded}


def _is_counts(survey: Survey, by: str) -> bool:
    """Whether 6092h scales positions as counts."""
    if by != "6092h" or any(survey.number(key) is None for key in ((0x608F, 1), (0x608F, 2))):
        return False
    values = {**survey.numbers, **({GEAR[0]: 1, GEAR[1]: 1} if _own_gear(survey) is None else {})}
    feed, counts = (si_per_unit("motor_position", each, AT_JOINT, values, 0.0) for each in (by, "608Fh"))
    return math.isclose(feed, counts, rel_tol=1e-6)


def _own_gear(survey: Survey) -> float | None:
    """Return the gear ratio that the drive itself counts with; None: it has none."""
    turns = [survey.number(key) for key in GEAR]
    return turns[0] / turns[1] if turns[0] is not None and turns[1] is not None else None


def _scaled(survey: Survey, quantity: str, by: str, gear_ratio: float, verify: str = "") -> ObjectEntry:
    """Return the entry by an object; by a factor where the drive counts behind another gear than the joint's."""
    key = _UNIT_OBJECT[by]
    word = survey.numbers[key]
    why = f"{label(*key)} is {word if by == '6092h' else f'0x{word:08X}'}, by {survey.source}"
    gear = _own_gear(survey)
    if by == "608Fh" or not quantity.startswith("motor") or gear == gear_ratio:
        return ObjectEntry({"by": by}, why, verify)
    if gear is None or gear == 1.0:
        return ObjectEntry({"by": by, "shaft": AT_MOTOR}, f"{why}; the drive knows no gear", verify)
    factor = si_per_unit(quantity, by, AT_JOINT, survey.numbers, 0.0)
    why += f", behind the drive's own gear of {gear:g}"
    return ObjectEntry({"factor": factor}, why, verify or _COMPARE)


def _per_second(survey: Survey, position: str, gear_ratio: float) -> ObjectEntry:
    """Return the velocity of a drive without 60A9h: in the unit of its positions per second."""
    verify = f"no 60A9h: 606Ch taken for {position} per second; turn the motor at a known speed and compare jtq status"
    if position == "6092h":
        return _scaled(survey, "motor_velocity", position, gear_ratio, verify)
    motor = unit_of_position(survey.numbers[_POSITION_UNIT]) * (_own_gear(survey) or 1.0)
    return ObjectEntry({"factor": motor}, f"60A8h, by {survey.source}", verify)


# ---- TPDOs ----


@dataclass(frozen=True)
class KeptTpdos:
    """TPDOs for section `tpdos` (none: jtqd maps its own), longest age of an acyclic frame, reason, problems."""

    tpdos: tuple[Tpdo, ...] = ()
    max_age_ms: int | None = None
    why: str = ""
    problems: tuple[str, ...] = ()

    def lines(self) -> list[str]:
        """Return sections `tpdos` and `max_age_ms`, without the indent of a section."""
        if not self.tpdos:
            return []
        lines = [f"tpdos:                  # {self.why}; without it jtqd maps its own"]
        for each in self.tpdos:
            kind = f", type: {each.transmission_type}" if each in _acyclic(self.tpdos) else ""
            words = ", ".join(f"0x{word:08X}" for word in each.words)
            lines.append(
                f"  - {{number: {each.number}, cob_id: 0x{each.cob_id:03X}{kind}, objects: [{words}]}}"
            )
        if self.max_age_ms is not None:
            age = f"max_age_ms: {self.max_age_ms}"
            lines.append(f"{age:<24}# GUESS, for how long a frame that the drive sends by itself counts")
        return lines


def kept_tpdos(node: int, survey: Survey | None, objects: DriveObjects) -> KeptTpdos:
    """Return the TPDOs of a drive that are kept as they are, where they are not those that jtqd maps."""
    if survey is None or not survey.tpdos:
        return KeptTpdos()
    own = drive_layout(node, objects)
    needed = {pdo.number for pdo in own}
    device = f"node {node} ({survey.title})"
    fixed = any(each.mapping_fixed for each in survey.tpdos if each.number in needed)
    usable = [each for each in survey.tpdos if fixed or (each.on and each.transmission_type == EVERY_SYNC)]
    maps, errors = [], []
    for each in usable:
        try:
            maps.append(map_of(node, replace(each, transmission_type=EVERY_SYNC), objects))
        except PdoError as error:
            errors.append(f"TPDO{each.number}: {error}")
    try:
        numbers = [pdo.number for pdo in select_tpdos(objects, maps)]
    except LayoutError as error:
        problem = f"{device}: its mapping is fixed, by its EDS: {'; '.join((str(error), *errors))}"
        return KeptTpdos(problems=(problem,) if fixed else ())
    used = tuple(each for each in usable if each.number in numbers)
    as_jtqd_maps = {(pdo.cob_id, pdo.words) for pdo in own} == {(pdo.cob_id, pdo.words) for pdo in used}
    if as_jtqd_maps and not _acyclic(used):
        return KeptTpdos()
    for each in used:
        if each.type_fixed and each.transmission_type not in (EVERY_SYNC, *ACYCLIC):
            problem = (
                f"{device}: TPDO{each.number} has transmission type {each.transmission_type}, "
                "which cannot be written, by its EDS: expected 1, 0, 254 or 255"
            )
            return KeptTpdos(problems=(problem,))
    why = "their mapping is fixed, by the EDS" if fixed else f"as they are, by {survey.source}"
    return KeptTpdos(used, _age_ms(_acyclic(used)), why)


def _acyclic(tpdos: Sequence[Tpdo]) -> list[Tpdo]:
    """Return those that the drive sends by itself, of a type that cannot be written."""
    return [each for each in tpdos if each.type_fixed and each.transmission_type in ACYCLIC]


def _age_ms(tpdos: Sequence[Tpdo]) -> int | None:
    """Return 1.5 times the longest event timer, at most 1 s; None without a TPDO."""
    if not tpdos:
        return None
    return min(1000, max(each.timer_ms for each in tpdos) * 3 // 2) or _AGE_MS


EFFICIENCY: Final = 0.7
"""Of a harmonic drive near its rated torque (catalogues: 0.6 to 0.8): joint torque of a motor's rated torque."""
COULOMB, VISCOUS = 0.075, 0.05
"""Friction by rated torque: Coulomb, and viscous per rad/s of the joint. Shipped bench: 3.0 Nm and 2.0 Nms/rad of 40 Nm."""
STIFFNESS_PER_RAD, DAMPING_S = 300.0, 1 / 1500
"""Stiffness by rated torque, damping by stiffness. Shipped bench: 12 000 Nm/rad, 8 Nms/rad."""
INERTIA_S2, LINK_INERTIA_S2 = 0.0175, 2e-4
"""Rotor's inertia at the joint and the link's own one, by rated torque. Shipped bench: 0.7 and 0.008 kg m2."""

POSITION: tuple[Key, Key] = ((0x608F, 1), (0x608F, 2))
VELOCITY: tuple[Key, Key] = ((0x6090, 1), (0x6090, 2))
LINK: tuple[Key, Key] = ((0x60E6, 1), (0x60EB, 1))
NO_NODE: Final = "an EDS knows no node-ID: --node, or --bus"


OPTIONS: Final = {
    "gear_ratio": "--gear-ratio",
    "rated_torque_nm": "--rated-torque",
    "torque_constant_nm_per_a": "--torque-constant",
    "rated_current_a": "--rated-current",
    "encoder_counts": "--encoder-counts",
    "link_encoder_counts": "--link-encoder-counts",
}
"""Field of `Wanted` -> option of `jtq init`."""


class MissingValueError(ValueError):
    """A value that cannot be guessed: why, and the field of `Wanted` whose option gives it ("": none does)."""

    def __init__(self, why: str, field: str = "", alternative: str = "") -> None:
        super().__init__(f"{why}: give {OPTIONS[field]}{alternative}" if field else why)
        self.why, self.field = why, field


@dataclass(frozen=True)
class Wanted:
    """Values given by the operator for one joint; None: not given. one_encoder: no link encoder, whatever the drive has."""

    gear_ratio: float | None = None
    rated_torque_nm: float | None = None
    torque_constant_nm_per_a: float | None = None
    rated_current_a: float | None = None
    encoder_counts: int | None = None
    link_encoder_counts: int | None = None
    one_encoder: bool = False


@dataclass(frozen=True)
class Value:
    """A number and its origin; verify: how it is measured where it is a guess."""

    number: float
    origin: str
    verify: str = ""

    @property
    def guess(self) -> bool:
        """Whether neither operator nor drive has given it."""
        return bool(self.verify)


@dataclass(frozen=True)
class JointProposal:
    """One joint.

    Attributes:
        values: by the keys of the joint file.
        given: objects of the drive that the configuration gives instead.
        problems: why this version of jtqd does not work with this drive.
        family: profile that the configuration names.
        own: values that the profile leaves to drive and operator, by keys of the section ("objects.current.factor").
        objects: quantities that the drive does not have, or does not scale, as CiA 402 or its profile has them.
        kept: TPDOs that stay as they are.
        node_guessed: the node-ID is a guess.
    """

    number: int
    node: int
    survey: Survey | None
    values: Mapping[str, Value]
    given: Mapping[Key, Value]
    problems: tuple[str, ...]
    family: Family | None = None
    own: Mapping[str, Value] = field(default_factory=dict)
    objects: Mapping[str, ObjectEntry] = field(default_factory=dict)
    kept: KeptTpdos = field(default_factory=KeptTpdos)
    node_guessed: bool = False

    @property
    def guesses(self) -> list[str]:
        """One line per guess: name, value, how to verify it."""
        joint = f"joint_{self.number}"
        values = {f"{joint}.yaml: {name}": value for name, value in self.values.items()}
        values |= {f"{joint}.given: {label(*key)}": value for key, value in self.given.items()}
        found = [f"{joint}: node = {self.node} ({NO_NODE})"] if self.node_guessed else []
        found += [
            f"{name} = {plain(value.number)} ({value.origin}): {value.verify}"
            for name, value in values.items()
            if value.guess
        ]
        found += [
            f"{joint}.objects: {name} = {each.text} ({each.why}): {each.verify}"
            for name, each in self.objects.items()
            if each.verify
        ]
        if self.kept.max_age_ms is not None:
            found.append(
                f"{joint}: max_age_ms = {self.kept.max_age_ms}: the longest time between two frames of the drive at rest, "
                "and a little more"
            )
        return found


def _guess(number: float, origin: str, verify: str) -> Value:
    """Return a guess, rounded to three digits."""
    return Value(float(f"{number:.3g}"), origin, verify)


def plain(number: float) -> str:
    """Return a number of at most six digits as YAML reads it.

    >>> plain(100.0), plain(0.0000712), plain(0.00001), plain(0.062)
    ('100.0', '7.12e-05', '1.0e-05', '0.062')
    """
    mantissa, exponential, exponent = repr(float(f"{number:.6g}")).partition("e")
    if exponential and "." not in mantissa:  # YAML 1.1 takes 1e-05 for a text
        mantissa += ".0"
    return mantissa + exponential + exponent


def ratio(value: float) -> tuple[int, int]:
    """Return numerator and denominator of a gear ratio of up to six decimals.

    >>> ratio(100.0), ratio(50.5)
    ((100, 1), (101, 2))
    """
    found = Fraction(value).limit_denominator(1_000_000)
    return found.numerator, found.denominator


# ---- values of a joint ----


def propose_joint(
    number: int, node: int, survey: Survey | None, wanted: Wanted, family: Family | None = None
) -> JointProposal:
    """Return what is known and guessed of a joint; family: profile of the drive. Raises MissingValueError."""
    given: dict[Key, Value] = {}
    objects = _fewer_objects(survey, wanted, family)
    problems = _problems(node, survey, family, objects)
    filled: dict[str, Value] = {}
    if family is not None:
        filled = _filled((number, node), survey, wanted, family, objects)
        survey = _translated(survey, filled)
    gear = _gear(number, node, survey, wanted, given)
    if family is None:
        scaled = {"motor_position", "motor_velocity"} if wanted.encoder_counts is not None else set()
        scaled |= {"link_position"} if wanted.link_encoder_counts is not None else set()
        present = [name for name in quantities_by(None) if name not in objects]
        objects |= reported_units(survey, gear.number, present, scaled)
        if wanted.encoder_counts is None:
            problems += unit_problems(node, survey)
    values = _values(number, survey, wanted, gear, _rated_current(survey, wanted, given))
    by_standard = {
        name
        for name in ("motor_position", "motor_velocity", "link_position")
        if name not in objects and (family is None or not family.scales(name))
    }
    _encoders(node, survey, wanted, given, by_standard)
    for key, value in filled.items():
        if key.startswith("given."):
            given.setdefault(parse_key(key.removeprefix("given.")), value)
    if "current" in objects or (family is not None and family.scales("current")):
        given.pop(RATED_CURRENT, None)
    own = {key: value for key, value in filled.items() if key.startswith("objects.")}
    drive = _drive_objects(family, objects, own)
    kept = kept_tpdos(node, survey, drive)
    problems += [*_implausible(node, survey, drive, given), *kept.problems]
    return JointProposal(number, node, survey, values, given, tuple(problems), family, own, objects, kept)


def _fewer_objects(survey: Survey | None, wanted: Wanted, family: Family | None) -> dict[str, ObjectEntry]:
    """Return entries for a drive with fewer objects: one encoder, a derived velocity, torque for current."""
    found = {"link_position": ObjectEntry(None, "--one-encoder")} if wanted.one_encoder else {}
    if survey is None:
        return found

    def lacks(key: Key) -> str:
        if key in survey.missing:
            return f"no {label(*key)}, by {survey.source}"
        return f"{label(*key)} cannot be mapped, by {survey.source}" if key in survey.unmappable else ""

    keys = quantities_by(family)
    for name in ("link_position", "motor_velocity"):
        if name not in found and (why := lacks(keys[name])):
            found[name] = ObjectEntry(None, why)
    if family is None and (why := lacks(keys["current"])) and TORQUE in survey.numbers:
        found["current"] = ObjectEntry({"index": TORQUE[0]}, f"{why}: torque by 6076h")
    return found


def _filled(
    joint: tuple[int, int],
    survey: Survey | None,
    wanted: Wanted,
    family: Family,
    objects: Mapping[str, ObjectEntry],
) -> dict[str, Value]:
    """Return the values that a profile leaves to drive and operator; joint: number, node. Raises MissingValueError."""
    options: dict[str, float] = {}
    if wanted.gear_ratio is not None:
        numerator, denominator = ratio(wanted.gear_ratio)
        options = {"gear_ratio_numerator": numerator, "gear_ratio_denominator": denominator}
    for name in ("encoder_counts", "link_encoder_counts"):
        if (counts := getattr(wanted, name)) is not None:
            options[name] = counts
    unused = tuple(f"objects.{name}." for name in objects)
    found = {
        key: Value(value, origin)
        for key, (value, origin) in family.filled({} if survey is None else survey.numbers, options).items()
        if not key.startswith(unused)
    }
    for line in family.lines:
        if line.open and line.key not in found and not (line.key or "").startswith(unused):
            where = f"joint {joint[0]} (node {joint[1]}): profile {family.name}"
            if line.option is None:
                raise MissingValueError(f"{where}: {line.read} has no value ({line.why})")
            field = "gear_ratio" if line.option.startswith("gear_ratio") else line.option
            raise MissingValueError(f"{where} needs a value that no object of the drive has", field)
    return found


def _translated(survey: Survey | None, filled: Mapping[str, Value]) -> Survey | None:
    """Return the survey as if the drive had the objects of CiA 402 for those that its profile has elsewhere."""
    if survey is None:
        return None
    numbers = dict(survey.numbers)
    for name, value in filled.items():
        prefix, _, key = name.partition(".")
        if prefix in ("given", INIT.removesuffix(".")):
            numbers[parse_key(key)] = round(value.number)
    return replace(survey, numbers=numbers, missing=survey.missing - set(numbers))


def _gear(number: int, node: int, survey: Survey | None, wanted: Wanted, given: dict[Key, Value]) -> Value:
    turns = [None if survey is None else survey.number(key) for key in GEAR]
    own = turns[0] / turns[1] if turns[0] is not None and turns[1] is not None else None
    if wanted.gear_ratio is None:
        where = f"joint {number} (node {node})"
        if survey is None or own is None:
            raise MissingValueError(f"{where}: no 6091h is known", "gear_ratio")
        if own == 1.0:
            why = f"{where}: 6091h is 1:1, as of drives that do not know their gear"
            raise MissingValueError(why, "gear_ratio")
        return Value(own, f"{label(*GEAR[0])}, {survey.source}")
    if survey is not None and own != wanted.gear_ratio:
        origin = "--gear-ratio; " + ("the drive has none" if own is None else f"the drive has {own:g}")
        for key, turn in zip(GEAR, ratio(wanted.gear_ratio), strict=True):
            given[key] = Value(turn, origin)
    return Value(wanted.gear_ratio, "--gear-ratio")


def _rated_current(survey: Survey | None, wanted: Wanted, given: dict[Key, Value]) -> float | None:
    own = None if survey is None else survey.number(RATED_CURRENT)
    if wanted.rated_current_a is None:
        return None if own is None else 1e-3 * own
    milliampere = round(1000 * wanted.rated_current_a)
    if survey is not None and own != milliampere:
        why = "the drive has none" if own is None else f"the drive has {own} mA"
        given[RATED_CURRENT] = Value(milliampere, f"--rated-current; {why}")
    return wanted.rated_current_a


def _values(
    number: int, survey: Survey | None, wanted: Wanted, gear: Value, current_a: float | None
) -> dict[str, Value]:
    """Return the values of the joint file. Raises MissingValueError."""
    rated = _rated_torque(number, survey, wanted, gear)
    torque, origin = rated.number, "shipped bench scaled by the rated torque"
    stiffness, inertia = STIFFNESS_PER_RAD * torque, INERTIA_S2 * torque / gear.number**2
    return {
        "gear_ratio": gear,
        "torque_constant_nm_per_a": _torque_constant(
            number, survey, wanted, gear=gear, rated=rated, current_a=current_a
        ),
        "rated_torque_nm": rated,
        "rotor_inertia_kgm2": _guess(inertia, origin, "data sheet of the motor, or jtq diagnose"),
        "stiffness_nm_per_rad": _guess(stiffness, origin, "data sheet of the gear (K2)"),
        "damping_nms_per_rad": _guess(DAMPING_S * stiffness, origin, "jtq diagnose"),
        "link_inertia_kgm2": _guess(LINK_INERTIA_S2 * torque, origin, "your CAD"),
        "coulomb_nm": _guess(COULOMB * torque, origin, "jtq fit friction"),
        "viscous_nms_per_rad": _guess(VISCOUS * torque, origin, "jtq fit friction"),
    }


def _rated_torque(number: int, survey: Survey | None, wanted: Wanted, gear: Value) -> Value:
    if wanted.rated_torque_nm is not None:
        return Value(wanted.rated_torque_nm, "--rated-torque")
    motor_mnm = None if survey is None else survey.number(RATED_TORQUE)
    if survey is None or motor_mnm is None:
        why = f"joint {number}: the motor's rated torque (6076h) is not known"
        raise MissingValueError(why, "rated_torque_nm")
    source = f"{label(*RATED_TORQUE)}, {survey.source}"
    origin = f"{EFFICIENCY:g} x gear ratio x rated torque of the motor ({source})"
    return _guess(EFFICIENCY * gear.number * (1e-3 * motor_mnm), origin, "data sheet of the gear or joint")


def _torque_constant(
    number: int, survey: Survey | None, wanted: Wanted, *, gear: Value, rated: Value, current_a: float | None
) -> Value:
    if wanted.torque_constant_nm_per_a is not None:
        return Value(wanted.torque_constant_nm_per_a, "--torque-constant")
    if current_a is None:
        if survey is None:
            raise MissingValueError(f"joint {number}", "torque_constant_nm_per_a", ", or --rated-current")
        raise MissingValueError(f"joint {number}: the rated current (6075h) is not known", "rated_current_a")
    verify = "data sheet of the motor (per ampere as 6078h counts it: peak or RMS), or jtq diagnose"
    motor_mnm = None if survey is None else survey.number(RATED_TORQUE)
    if survey is not None and motor_mnm is not None:
        return Value(1e-3 * motor_mnm / current_a, f"6076h / 6075h, {survey.source}", verify)
    constant = rated.number / (EFFICIENCY * gear.number * current_a)
    return _guess(constant, f"rated torque / ({EFFICIENCY:g} x gear ratio x rated current)", verify)


def _encoders(
    node: int, survey: Survey | None, wanted: Wanted, given: dict[Key, Value], by_standard: set[str]
) -> None:
    """Add counts that the drive lacks, or has otherwise, to `given`. Raises MissingValueError.

    by_standard: quantities that objects of CiA 402 scale.
    """
    if survey is None:
        return

    def give(keys: tuple[Key, Key], field: str) -> None:
        counts = getattr(wanted, field)
        if counts is None:
            if not all(survey.scales_by(key) for key in keys):
                raise MissingValueError(f"node {node}: {label(*keys[0])} is not known", field)
        elif [survey.number(key) for key in keys] != [counts, 1]:
            given[keys[0]] = Value(counts, OPTIONS[field])
            given[keys[1]] = Value(1, OPTIONS[field])

    if "motor_position" in by_standard:
        give(POSITION, "encoder_counts")
    if "motor_velocity" in by_standard and not all(survey.scales_by(key) for key in VELOCITY):
        for ours, of_position in zip(VELOCITY, POSITION, strict=True):
            number = given[of_position].number if of_position in given else survey.number(of_position)
            verify = "turn the motor at a known speed and compare jtq status; 606Ch may be in rpm"
            given[ours] = Value(number or 1, "606Ch taken for encoder counts per second: no 6090h", verify)
    if "link_position" in by_standard:
        give(LINK, "link_encoder_counts")


def _drive_objects(
    family: Family | None, objects: Mapping[str, ObjectEntry], own: Mapping[str, Value]
) -> DriveObjects:
    """Return the objects of a drive by its proposed section."""
    section: dict[str, Any] = {} if family is None else dict(family.section().get("objects", {}))
    for key, value in own.items():
        _, quantity, name = key.split(".")
        section[quantity] = {**section.get(quantity, {}), name: value.number}
    for quantity, each in objects.items():
        section[quantity] = False if each.keys is None else {**section.get(quantity, {}), **each.keys}
    return decode(ObjectsSection, section, "jtq init").of_drive()


def _problems(
    node: int, survey: Survey | None, family: Family | None, objects: Mapping[str, ObjectEntry]
) -> list[str]:
    if survey is None:
        return []
    device = f"node {node} ({survey.title})"
    mapped = [key for name, key in quantities_by(family).items() if name not in objects]
    findings = [] if family is None else family.findings(survey.numbers)
    return [
        *(f"{device}: has no {label(*key)}, which jtqd maps" for key in mapped if key in survey.missing),
        *(
            f"{device}: {label(*key)} cannot be mapped, by {survey.source}"
            for key in mapped
            if key in survey.unmappable
        ),
        *(f"{device}: profile {family.name}: {text}" for text in findings if family is not None),
    ]


def _implausible(
    node: int, survey: Survey | None, objects: DriveObjects, given: Mapping[Key, Value]
) -> list[str]:
    """Return one line for each scaling object whose value the boot would refuse."""
    if survey is None or survey.defaults:
        return []
    read = DriveProfile(node, objects=objects, given=dict.fromkeys(given, 1)).scaling_objects
    return [
        f"node {node} ({survey.title}): {label(*key)} {name}: expected 1..{highest}, found {survey.numbers[key]}"
        for key in read
        for name, highest in (EVERY_SCALING_OBJECT[key],)
        if survey.numbers.get(key, 0) > highest
    ]


# ---- files ----


def joint_text(joint: JointProposal) -> str:
    """Return the joint file."""
    friction = ("coulomb_nm", "viscous_nms_per_rad")
    lines = [
        f"# Joint {joint.number}, node {joint.node}. Written by jtq init. A GUESS is an order of magnitude: replace it.",
        "# SI units. Torque constant and rotor inertia are motor side; all else is joint side.",
        f"name: joint{joint.number}",
        *(_line(name, value) for name, value in joint.values.items() if name not in friction),
        "friction:",
        *(_line(name, joint.values[name], "  ") for name in friction),
        "",
    ]
    return "\n".join(lines)


def _line(name: str, value: Value, indent: str = "") -> str:
    comment = f"GUESS, {value.origin}; better: {value.verify}" if value.guess else value.origin
    return f"{f'{indent}{name}: {plain(value.number)}':<42}# {comment}"


@dataclass(frozen=True)
class ConfigProposal:
    """A whole configuration. joints_of_sensor: joints whose torque the sensor measures."""

    bus: str
    bitrate: int
    period_us: int
    joints: Sequence[JointProposal]
    sensor: Survey | None
    sensor_node: int | None
    joints_of_sensor: Sequence[int] = ()

    @property
    def node_id(self) -> int:
        """Node-ID of jtqd: 20h, or the next that no node has."""
        used = [*(each.node for each in self.joints), self.sensor_node, COMMANDER_NODE]
        candidates: Iterable[int] = (JTQD_NODE, *range(JTQD_NODE + 2, 128))
        return next(node for node in candidates if node not in used)


def config_text(config: ConfigProposal) -> str:
    """Return the configuration."""
    lines = [
        f"# jtqd on {config.bus}. Written by jtq init; docs/deployment.md has all other keys.",
        f"node_id: {config.node_id:<17}# jtqd's own; its estimate PDO is {0x180 + config.node_id:X}h",
        f"bitrate: {config.bitrate:<17}# as the interface is set up: ip -details link show",
        f"sync: {{period_us: {config.period_us}}}",
        "estimator: {method: tob}  # until runs against a torque sensor have been fitted: docs/first_joint.md",
    ]
    for joint in config.joints:
        lines += drive_lines(joint)
        if joint.number in config.joints_of_sensor:
            lines.append("  sensor_channel: 1       # the torque sensor measures this joint's torque")
    if config.sensor_node is not None:
        lines += sensor_lines(config.sensor_node, config.sensor)
    lines += [
        "realtime: {priority: 80, lock_memory: true}",
        "recording: {budget_mb: 2000, keep_run: false}  # of --record DIR: the oldest logs are removed",
        "",
    ]
    return "\n".join(lines)


def drive_lines(joint: JointProposal) -> list[str]:
    """Return the section of a joint as far as its drive is concerned."""
    node = f"  node: {joint.node}"
    lines = [
        f"joint_{joint.number}:{'':18}# {_title(joint.survey)}",
        f"{node:<26}# GUESS, {NO_NODE}" if joint.node_guessed else node,
        f"  file: joint_{joint.number}.yaml",
        *_identity(joint.survey),
    ]
    if joint.given:
        lines.append("  given:                  # instead of the drive's own value")
    for key, value in joint.given.items():
        entry = f'    "{label(*key)}": {round(value.number)}'
        lines.append(f"{entry:<25} # {'GUESS, ' * value.guess}{value.origin}")
    if joint.family is not None:
        lines.append(f"  profile: {joint.family.name:<15}# docs/bus.md")
    if joint.own or joint.objects:
        others = "CiA 402" if joint.family is None else "the profile"
        lines.append(f"  objects:                # of this drive; all else is as in {others}")
    for name, each in joint.objects.items():
        lines.append(f"{f'    {name}: {each.text}':<25} # {'GUESS, ' * bool(each.verify)}{each.why}")
    for own, value in joint.own.items():
        _, quantity, name = own.split(".")
        lines.append(f"    {quantity}: {{{name}: {value.number:.10e}}}  # {value.origin}")
    return [*lines, *(f"  {line}" for line in joint.kept.lines())]


def _title(survey: Survey | None) -> str:
    return f"{survey.title}, by {survey.source}" if survey is not None else "not surveyed"


def _identity(survey: Survey | None) -> list[str]:
    """Refuse another device at this node-ID; serial numbers change with every repair, so they are not in it."""
    numbers = {} if survey is None else survey.numbers
    known = {name: value for name in ("vendor", "product") if (value := numbers.get(IDENTITY[name]))}
    inside = ", ".join(f"{name}: 0x{value:08X}" for name, value in known.items())
    return [f"  identity: {{{inside}}}"] if known else []


def sensor_lines(node: int, survey: Survey | None) -> list[str]:
    """Return the section of the torque sensor."""
    title = f"sensor:                   # {_title(survey)}"
    return [title, f"  node: {node}", *_identity(survey), "  channels: 1"]


def sensor_problems(node: int, survey: Survey | None) -> list[str]:
    """Return why this version of jtqd does not work with this sensor."""
    if survey is None:
        return []
    missing = [key for key in MAPPED[SENSOR] if key in survey.missing]
    return [f"node {node} ({survey.title}): has no {label(*key)}" for key in missing]
