"""Proposed configuration and joint files of a bench: values of devices and operator, and guesses that are marked.

    surveyed, eds_survey   device -> Survey, with the objects that its profile needs
    JointProposal          Survey + Wanted -> every value of a joint, with its origin
    joint_text, config_text, drive_lines, sensor_lines     files and sections

Units (CiA 402-2): 60A8h and 60A9h name them; 6092h is their number per turn of the driving shaft. All count behind the gear
that the drive knows (6091h); a drive whose 6091h is 1:1 counts at the motor's shaft. A word 0 and a feed constant of 1 are
those of a drive without configured units: then the objects of `drive.CIA_402` scale it.

TPDOs that are sent at each SYNC and carry every quantity are kept, and those that cannot be written by the EDS.

A guess is scaled from the shipped bench by the rated torque: the order of magnitude of a harmonic-drive joint.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
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

EFFICIENCY: Final = 0.7
"""Of a harmonic drive near its rated torque (catalogues: 0.6 to 0.8): joint torque of a motor's rated torque."""
COULOMB, VISCOUS = 0.075, 0.05
"""Friction by rated torque: Coulomb, and viscous per rad/s of the joint. Shipped bench: 3.0 Nm and 2.0 Nms/rad of 40 Nm."""
STIFFNESS_PER_RAD, DAMPING_S = 300.0, 1 / 1500
"""Stiffness by rated torque, damping by stiffness. Shipped bench: 12 000 Nm/rad, 8 Nms/rad."""
INERTIA_S2, LINK_INERTIA_S2 = 0.0175, 2e-4
"""Rotor's inertia at the joint and the link's own one, by rated torque. Shipped bench: 0.7 and 0.008 kg m2."""

_POSITION: tuple[Key, Key] = ((0x608F, 1), (0x608F, 2))
_VELOCITY: tuple[Key, Key] = ((0x6090, 1), (0x6090, 2))
_LINK: tuple[Key, Key] = ((0x60E6, 1), (0x60EB, 1))
_FEED: tuple[Key, Key] = ((0x6092, 1), (0x6092, 2))
_POSITION_UNIT, _VELOCITY_UNIT = (0x60A8, 0), (0x60A9, 0)
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
_NO_NODE: Final = "an EDS knows no node-ID: --node, or --bus"
OPTIONS: Final = {
    "gear_ratio": "--gear-ratio",
    "rated_torque_nm": "--rated-torque",
    "torque_constant_nm_per_a": "--torque-constant",
    "rated_current_a": "--rated-current",
    "encoder_counts": "--encoder-counts",
    "link_encoder_counts": "--link-encoder-counts",
}
"""Field of `Wanted` -> option of `jtq init`."""


class UsageError(Exception):
    """Options that contradict each other or the devices, or too few of them."""


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
    """A number, the keys of a quantity in section `objects`, or None for a quantity that the drive does not have.

    origin: of the value; verify: how a guess is measured, "" for what operator or drive has given.
    """

    value: Any
    origin: str
    verify: str = ""

    @property
    def text(self) -> str:
        """As YAML.

        >>> Value(0.00001, "").text, Value({"by": "60A8h", "shaft": "motor"}, "").text, Value(None, "").text
        ('1.0e-05', '{by: 60A8h, shaft: motor}', 'false')
        """
        if isinstance(self.value, Mapping):
            return "{" + ", ".join(f"{key}: {_key_text(key, each)}" for key, each in self.value.items()) + "}"
        if isinstance(self.value, float):
            return plain(self.value)
        return "false" if self.value is None else str(self.value)

    def commented(self, entry: str, width: int) -> str:
        """Return a line of a file: the entry, and the origin as a comment from column `width` on."""
        better = (
            f"; better: {self.verify}" if self.verify and not isinstance(self.value, Mapping | int) else ""
        )
        return f"{entry:<{width}} # {'GUESS, ' * bool(self.verify)}{self.origin}{better}"


def _key_text(key: str, value: Any) -> str:
    if key == "index":
        return f"0x{value:04X}"
    return f"{value:.10e}" if isinstance(value, float) else str(value)


def plain(number: float) -> str:
    """Return a number of at most six digits as YAML reads it.

    >>> plain(100.0), plain(0.0000712), plain(0.00001), plain(0.062)
    ('100.0', '7.12e-05', '1.0e-05', '0.062')
    """
    mantissa, exponential, exponent = repr(float(f"{number:.6g}")).partition("e")
    if exponential and "." not in mantissa:  # YAML 1.1 takes 1e-05 for a text
        mantissa += ".0"
    return mantissa + exponential + exponent


def _guess(number: float, origin: str, verify: str) -> Value:
    return Value(float(f"{number:.3g}"), origin, verify)


# ---- survey ----


def family_of(survey: Survey | None, name: str | None) -> Family | None:
    """Return the profile by name ("none": no profile), else by the drive's vendor-ID. Raises ConfigError."""
    if name is not None:
        return None if name == "none" else named(name)
    if survey is None or survey.profile != DRIVE:
        return None
    return of_vendor(survey.numbers.get(IDENTITY["vendor"]))


def _quantities(family: Family | None) -> dict[str, Key]:
    """Return the object of each quantity, with a profile or without."""
    standard = {each.name: getattr(CIA_402, each.name) for each in fields(CIA_402)}
    keys = {name: (each.index, each.subindex) for name, each in standard.items()}
    return keys if family is None else {name: family.mapped(name, key) for name, key in keys.items()}


def _needed(family: Family) -> tuple[Key, ...]:
    """Return the objects that the profile scales with, and those that jtqd maps."""
    return *family.objects, *_quantities(family).values()


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
    by_eds = {each.number: each for each in eds.tpdos}
    tpdos = []
    for each in bus.tpdos:
        known = by_eds.get(each.number, each)
        tpdos.append(replace(each, mapping_fixed=known.mapping_fixed, type_fixed=known.type_fixed))
    return replace(bus, unmappable=eds.unmappable, tpdos=tuple(tpdos), eds_notes=eds.eds_notes)


def description(survey: Survey) -> str:
    """Return a device in one line: name, versions, vendor, profile, source."""
    texts = [text for name in ("hardware", "software") if (text := survey.texts.get(name))]
    vendor = survey.numbers.get(IDENTITY["vendor"])
    parts = [survey.title, *texts, *([f"vendor {vendor:08X}h"] if vendor else [])]
    return f"{', '.join(parts)} (profile {survey.profile or 'unknown'}, by {survey.source})"


# ---- units ----


def unit_problems(survey: Survey | None) -> list[str]:
    """Return one line for each unit word that names no angle, or no speed."""
    found: list[str] = []
    if survey is None:
        return found
    for key, what, unit_of in (
        (_POSITION_UNIT, "positions", _position_unit),
        (_VELOCITY_UNIT, "velocities", _velocity_unit),
    ):
        try:
            unit_of(survey)
        except ScalingError as error:
            found.append(
                f"node {survey.node} ({survey.title}): {label(*key)}, the unit of {what}: {error}; "
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
) -> dict[str, Value]:
    """Return how a drive's positions and velocity are scaled, where other objects do so than those of `drive.CIA_402`.

    gear_ratio: of the joint. quantities: those that the drive has. by_options: those that the operator has scaled.
    """
    found: dict[str, Value] = {}
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
    if by != "6092h" or any(survey.number(key) is None for key in _POSITION):
        return False
    values = {**survey.numbers, **({GEAR[0]: 1, GEAR[1]: 1} if _own_gear(survey) is None else {})}
    feed, counts = (si_per_unit("motor_position", each, AT_JOINT, values, 0.0) for each in (by, "608Fh"))
    return math.isclose(feed, counts, rel_tol=1e-6)


def _own_gear(survey: Survey | None) -> float | None:
    """Return the gear ratio that the drive itself counts with; None: it has none."""
    turns = [None if survey is None else survey.number(key) for key in GEAR]
    return turns[0] / turns[1] if turns[0] is not None and turns[1] is not None else None


def _scaled(survey: Survey, quantity: str, by: str, gear_ratio: float, verify: str = "") -> Value:
    """Return the entry by an object; by a factor where the drive counts behind another gear than the joint's."""
    key = _UNIT_OBJECT[by]
    word = survey.numbers[key]
    origin = f"{label(*key)} is {word if by == '6092h' else f'0x{word:08X}'}, by {survey.source}"
    gear = _own_gear(survey)
    if by == "608Fh" or not quantity.startswith("motor") or gear == gear_ratio:
        return Value({"by": by}, origin, verify)
    if gear is None or gear == 1.0:
        return Value({"by": by, "shaft": AT_MOTOR}, f"{origin}; the drive knows no gear", verify)
    factor = si_per_unit(quantity, by, AT_JOINT, survey.numbers, 0.0)
    return Value({"factor": factor}, f"{origin}, behind the drive's own gear of {gear:g}", verify or _COMPARE)


def _per_second(survey: Survey, position: str, gear_ratio: float) -> Value:
    """Return the velocity of a drive without 60A9h: in the unit of its positions per second."""
    verify = f"no 60A9h: 606Ch taken for {position} per second; turn the motor at a known speed and compare jtq status"
    if position == "6092h":
        return _scaled(survey, "motor_velocity", position, gear_ratio, verify)
    motor = unit_of_position(survey.numbers[_POSITION_UNIT]) * (_own_gear(survey) or 1.0)
    return Value({"factor": motor}, f"60A8h, by {survey.source}", verify)


# ---- TPDOs ----


@dataclass(frozen=True)
class KeptTpdos:
    """TPDOs for section `tpdos` (none: jtqd maps its own), longest age of an acyclic frame, reason, problems."""

    tpdos: tuple[Tpdo, ...] = ()
    max_age_ms: int | None = None
    why: str = ""
    problems: tuple[str, ...] = ()

    def lines(self) -> list[str]:
        """Return sections `tpdos` and `max_age_ms` of a joint."""
        if not self.tpdos:
            return []
        lines = [f"  tpdos:                  # {self.why}; without it jtqd maps its own"]
        for each in self.tpdos:
            kind = f", type: {each.transmission_type}" if _is_acyclic(each) else ""
            words = ", ".join(f"0x{word:08X}" for word in each.words)
            lines.append(
                f"    - {{number: {each.number}, cob_id: 0x{each.cob_id:03X}{kind}, objects: [{words}]}}"
            )
        if self.max_age_ms is not None:
            age = f"  max_age_ms: {self.max_age_ms}"
            lines.append(f"{age:<26}# GUESS, for how long a frame that the drive sends by itself counts")
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
    acyclic = [each for each in used if _is_acyclic(each)]
    if not acyclic and {(pdo.cob_id, pdo.words) for pdo in own} == {(pdo.cob_id, pdo.words) for pdo in used}:
        return KeptTpdos()
    for each in used:
        if each.type_fixed and each.transmission_type not in (EVERY_SYNC, *ACYCLIC):
            problem = (
                f"{device}: TPDO{each.number} has transmission type {each.transmission_type}, "
                "which cannot be written, by its EDS: expected 1, 0, 254 or 255"
            )
            return KeptTpdos(problems=(problem,))
    why = "their mapping is fixed, by the EDS" if fixed else f"as they are, by {survey.source}"
    return KeptTpdos(used, _age_ms(acyclic), why)


def _age_ms(acyclic: Sequence[Tpdo]) -> int | None:
    """Return for how long a frame counts that the drive sends by itself: 1.5 times its timer, at most 1 s."""
    if not acyclic:
        return None
    return min(1000, max(each.timer_ms for each in acyclic) * 3 // 2) or _AGE_MS


def _is_acyclic(pdo: Tpdo) -> bool:
    """Whether the drive sends it by itself, by a type that cannot be written."""
    return pdo.type_fixed and pdo.transmission_type in ACYCLIC


# ---- values of a joint ----


class JointProposal:
    """What is known and guessed of a joint. Raises MissingValueError.

    Args:
        number, node: of the joint and its drive; node_guessed: the node-ID is a guess.
        survey: of the drive; None: not surveyed.
        wanted: values of the operator.
        family: profile of the drive.

    Attributes:
        values: by the keys of the joint file.
        given: objects of the drive that the configuration gives instead.
        objects: quantities that the drive does not have, or does not scale, as CiA 402 or its profile has them.
        own: keys of quantities that the profile leaves to drive and operator.
        kept: TPDOs that stay as they are.
        problems: why this version of jtqd does not work with this drive.
    """

    def __init__(
        self,
        number: int,
        node: int,
        survey: Survey | None,
        wanted: Wanted,
        family: Family | None = None,
        *,
        node_guessed: bool = False,
    ) -> None:
        self.number, self.node, self.survey, self.family = number, node, survey, family
        self.node_guessed, self._wanted = node_guessed, wanted
        self.given: dict[Key, Value] = {}
        self.objects = self._fewer_objects()
        self.problems = self._object_problems()
        filled = {} if family is None else self._filled(family)
        self._translate(filled)
        gear = self._gear()
        if family is None:
            by_options = ["motor_position", "motor_velocity"] if wanted.encoder_counts is not None else []
            by_options += ["link_position"] if wanted.link_encoder_counts is not None else []
            present = [name for name in _quantities(None) if name not in self.objects]
            self.objects |= reported_units(self.survey, gear.value, present, by_options)
            self.problems += unit_problems(self.survey) if wanted.encoder_counts is None else []
        self.values = self._joint_values(gear, self._rated_current())
        self._encoders()
        self.own: dict[str, Value] = {}
        for key, value in filled.items():
            section, _, name = key.partition(".")
            if section == "given":
                self.given.setdefault(parse_key(name), value)
            elif section == "objects":
                quantity, _, last = name.partition(".")
                others = self.own[quantity].value if quantity in self.own else {}
                self.own[quantity] = Value({**others, last: value.value}, value.origin)
        if "current" in self.objects or (family is not None and family.scales("current")):
            self.given.pop(RATED_CURRENT, None)
        drive = self._drive_objects()
        self.kept = kept_tpdos(node, self.survey, drive)
        self.problems += [*self._implausible(drive), *self.kept.problems]

    @property
    def guesses(self) -> list[str]:
        """One line per guess: name, value, how to verify it."""
        joint = f"joint_{self.number}"
        found = [f"{joint}: node = {self.node} ({_NO_NODE})"] if self.node_guessed else []
        entries = [
            *((f"{joint}.yaml: {name}", value) for name, value in self.values.items()),
            *((f"{joint}.given: {label(*key)}", value) for key, value in self.given.items()),
            *((f"{joint}.objects: {name}", value) for name, value in self.objects.items()),
        ]
        found += [
            f"{name} = {each.text} ({each.origin}): {each.verify}" for name, each in entries if each.verify
        ]
        if self.kept.max_age_ms is not None:
            found.append(
                f"{joint}: max_age_ms = {self.kept.max_age_ms}: the longest time between two frames of the drive at rest, "
                "and a little more"
            )
        return found

    def _number(self, key: Key) -> int | None:
        return None if self.survey is None else self.survey.number(key)

    def _lacks(self, key: Key) -> str:
        """Return why an object cannot be mapped, "" if it can."""
        survey = self.survey
        if survey is None:
            return ""
        if key in survey.missing:
            return f"no {label(*key)}, by {survey.source}"
        return f"{label(*key)} cannot be mapped, by {survey.source}" if key in survey.unmappable else ""

    def _fewer_objects(self) -> dict[str, Value]:
        """Return entries for a drive with fewer objects: one encoder, a derived velocity, torque for current."""
        found = {"link_position": Value(None, "--one-encoder")} if self._wanted.one_encoder else {}
        keys = _quantities(self.family)
        for name in ("link_position", "motor_velocity"):
            if name not in found and (why := self._lacks(keys[name])):
                found[name] = Value(None, why)
        has_torque = self.survey is not None and TORQUE in self.survey.numbers
        if self.family is None and has_torque and (why := self._lacks(keys["current"])):
            found["current"] = Value({"index": TORQUE[0]}, f"{why}: torque by 6076h")
        return found

    def _object_problems(self) -> list[str]:
        survey, family = self.survey, self.family
        if survey is None:
            return []
        mapped = [key for name, key in _quantities(family).items() if name not in self.objects]
        texts = [f"has no {label(*key)}, which jtqd maps" for key in mapped if key in survey.missing]
        texts += [self._lacks(key) for key in mapped if key in survey.unmappable - survey.missing]
        if family is not None:
            texts += [f"profile {family.name}: {text}" for text in family.findings(survey.numbers)]
        return [f"node {self.node} ({survey.title}): {text}" for text in texts]

    def _filled(self, family: Family) -> dict[str, Value]:
        """Return the values that a profile leaves to drive and operator, by key. Raises MissingValueError."""
        options: dict[str, float] = {}
        if self._wanted.gear_ratio is not None:
            numerator, denominator = _ratio(self._wanted.gear_ratio)
            options = {"gear_ratio_numerator": numerator, "gear_ratio_denominator": denominator}
        for name in ("encoder_counts", "link_encoder_counts"):
            if (counts := getattr(self._wanted, name)) is not None:
                options[name] = counts
        unused = tuple(f"objects.{name}." for name in self.objects)
        numbers = {} if self.survey is None else self.survey.numbers
        found = {
            key: Value(value, origin)
            for key, (value, origin) in family.filled(numbers, options).items()
            if not key.startswith(unused)
        }
        for line in family.lines:
            if line.open and line.key not in found and not (line.key or "").startswith(unused):
                where = f"joint {self.number} (node {self.node}): profile {family.name}"
                if line.option is None:
                    raise MissingValueError(f"{where}: {line.read} has no value ({line.why})")
                field = "gear_ratio" if line.option.startswith("gear_ratio") else line.option
                raise MissingValueError(f"{where} needs a value that no object of the drive has", field)
        return found

    def _translate(self, filled: Mapping[str, Value]) -> None:
        """Give the survey the objects of CiA 402 for those that its profile has elsewhere."""
        if self.survey is None or self.family is None:
            return
        numbers = dict(self.survey.numbers)
        for name, value in filled.items():
            prefix, _, key = name.partition(".")
            if prefix in ("given", INIT.removesuffix(".")):
                numbers[parse_key(key)] = round(value.value)
        self.survey = replace(self.survey, numbers=numbers, missing=self.survey.missing - set(numbers))

    def _gear(self) -> Value:
        own, wanted = _own_gear(self.survey), self._wanted.gear_ratio
        if wanted is None:
            where = f"joint {self.number} (node {self.node})"
            if self.survey is None or own is None:
                raise MissingValueError(f"{where}: no 6091h is known", "gear_ratio")
            if own == 1.0:
                why = f"{where}: 6091h is 1:1, as of drives that do not know their gear"
                raise MissingValueError(why, "gear_ratio")
            return Value(own, f"{label(*GEAR[0])}, {self.survey.source}")
        if self.survey is not None and own != wanted:
            origin = "--gear-ratio; " + ("the drive has none" if own is None else f"the drive has {own:g}")
            self.given |= {key: Value(turns, origin) for key, turns in zip(GEAR, _ratio(wanted), strict=True)}
        return Value(wanted, "--gear-ratio")

    def _rated_current(self) -> float | None:
        """Return the motor's rated current [A]."""
        own, wanted = self._number(RATED_CURRENT), self._wanted.rated_current_a
        if wanted is None:
            return None if own is None else 1e-3 * own
        if self.survey is not None and own != (milliampere := round(1000 * wanted)):
            why = "the drive has none" if own is None else f"the drive has {own} mA"
            self.given[RATED_CURRENT] = Value(milliampere, f"--rated-current; {why}")
        return wanted

    def _joint_values(self, gear: Value, current_a: float | None) -> dict[str, Value]:
        """Return the values of the joint file. Raises MissingValueError."""
        rated = self._rated_torque(gear.value)
        torque, origin = rated.value, "shipped bench scaled by the rated torque"
        stiffness, inertia = STIFFNESS_PER_RAD * torque, INERTIA_S2 * torque / gear.value**2
        return {
            "gear_ratio": gear,
            "torque_constant_nm_per_a": self._torque_constant(gear.value, torque, current_a),
            "rated_torque_nm": rated,
            "rotor_inertia_kgm2": _guess(inertia, origin, "data sheet of the motor, or jtq diagnose"),
            "stiffness_nm_per_rad": _guess(stiffness, origin, "data sheet of the gear (K2)"),
            "damping_nms_per_rad": _guess(DAMPING_S * stiffness, origin, "jtq diagnose"),
            "link_inertia_kgm2": _guess(LINK_INERTIA_S2 * torque, origin, "your CAD"),
            "coulomb_nm": _guess(COULOMB * torque, origin, "jtq fit friction"),
            "viscous_nms_per_rad": _guess(VISCOUS * torque, origin, "jtq fit friction"),
        }

    def _rated_torque(self, gear_ratio: float) -> Value:
        if self._wanted.rated_torque_nm is not None:
            return Value(self._wanted.rated_torque_nm, "--rated-torque")
        motor_mnm = self._number(RATED_TORQUE)
        if self.survey is None or motor_mnm is None:
            why = f"joint {self.number}: the motor's rated torque (6076h) is not known"
            raise MissingValueError(why, "rated_torque_nm")
        source = f"{label(*RATED_TORQUE)}, {self.survey.source}"
        origin = f"{EFFICIENCY:g} x gear ratio x rated torque of the motor ({source})"
        return _guess(EFFICIENCY * gear_ratio * (1e-3 * motor_mnm), origin, "data sheet of the gear or joint")

    def _torque_constant(self, gear_ratio: float, rated_nm: float, current_a: float | None) -> Value:
        wanted, where = self._wanted.torque_constant_nm_per_a, f"joint {self.number}"
        if wanted is not None:
            return Value(wanted, "--torque-constant")
        if current_a is None:
            if self.survey is None:
                raise MissingValueError(where, "torque_constant_nm_per_a", ", or --rated-current")
            raise MissingValueError(f"{where}: the rated current (6075h) is not known", "rated_current_a")
        verify = "data sheet of the motor (per ampere as 6078h counts it: peak or RMS), or jtq diagnose"
        motor_mnm = self._number(RATED_TORQUE)
        if self.survey is not None and motor_mnm is not None:
            return Value(1e-3 * motor_mnm / current_a, f"6076h / 6075h, {self.survey.source}", verify)
        constant = rated_nm / (EFFICIENCY * gear_ratio * current_a)
        return _guess(constant, f"rated torque / ({EFFICIENCY:g} x gear ratio x rated current)", verify)

    def _encoders(self) -> None:
        """Give the counts that the drive lacks, or has otherwise. Raises MissingValueError."""
        survey, family, given = self.survey, self.family, self.given
        if survey is None:
            return

        def by_standard(quantity: str) -> bool:
            return quantity not in self.objects and (family is None or not family.scales(quantity))

        def give(quantity: str, keys: tuple[Key, Key], field: str) -> None:
            if not by_standard(quantity):
                return
            counts = getattr(self._wanted, field)
            if counts is None and not all(survey.scales_by(key) for key in keys):
                raise MissingValueError(f"node {self.node}: {label(*keys[0])} is not known", field)
            if counts is not None and [survey.number(key) for key in keys] != [counts, 1]:
                given.update({keys[0]: Value(counts, OPTIONS[field]), keys[1]: Value(1, OPTIONS[field])})

        give("motor_position", _POSITION, "encoder_counts")
        if by_standard("motor_velocity") and not all(survey.scales_by(key) for key in _VELOCITY):
            verify = "turn the motor at a known speed and compare jtq status; 606Ch may be in rpm"
            origin = "606Ch taken for encoder counts per second: no 6090h"
            for ours, of_position in zip(_VELOCITY, _POSITION, strict=True):
                counts = given[of_position].value if of_position in given else survey.number(of_position)
                given[ours] = Value(counts or 1, origin, verify)
        give("link_position", _LINK, "link_encoder_counts")

    def _drive_objects(self) -> DriveObjects:
        """Return the objects of the drive by its proposed section."""
        section: dict[str, Any] = (
            {} if self.family is None else dict(self.family.section().get("objects", {}))
        )
        for quantity, each in {**self.own, **self.objects}.items():
            section[quantity] = False if each.value is None else {**section.get(quantity, {}), **each.value}
        return decode(ObjectsSection, section, "jtq init").of_drive()

    def _implausible(self, objects: DriveObjects) -> list[str]:
        """Return one line for each scaling object whose value the boot would refuse."""
        survey = self.survey
        if survey is None or survey.defaults:
            return []
        given = dict.fromkeys(self.given, 1)
        return [
            f"node {self.node} ({survey.title}): {label(*key)} {name}: expected 1..{highest}, found {survey.numbers[key]}"
            for key in DriveProfile(self.node, objects=objects, given=given).scaling_objects
            for name, highest in (EVERY_SCALING_OBJECT[key],)
            if survey.numbers.get(key, 0) > highest
        ]


def _ratio(value: float) -> tuple[int, int]:
    """Return numerator and denominator of a gear ratio of up to six decimals."""
    found = Fraction(value).limit_denominator(1_000_000)
    return found.numerator, found.denominator


# ---- files ----


def joint_text(joint: JointProposal) -> str:
    """Return the joint file."""
    friction = ("coulomb_nm", "viscous_nms_per_rad")
    values = {
        name: value.commented(f"{'  ' * (name in friction)}{name}: {value.text}", 41)
        for name, value in joint.values.items()
    }
    lines = [
        f"# Joint {joint.number}, node {joint.node}. Written by jtq init. A GUESS is an order of magnitude: replace it.",
        "# SI units. Torque constant and rotor inertia are motor side; all else is joint side.",
        f"name: joint{joint.number}",
        *(line for name, line in values.items() if name not in friction),
        "friction:",
        *(values[name] for name in friction),
        "",
    ]
    return "\n".join(lines)


def config_text(
    joints: Sequence[JointProposal],
    *,
    bus: str,
    bitrate: int,
    period_us: int,
    sensor_node: int | None = None,
    sensor: Survey | None = None,
    measured: Sequence[int] = (),
    taken: Collection[int] = (),
) -> str:
    """Return the configuration; jtqd has node-ID 20h, or the next that no node has. measured: joints with the sensor."""
    used = [*(each.node for each in joints), sensor_node, COMMANDER_NODE, *taken]
    node_id = next(node for node in (JTQD_NODE, *range(JTQD_NODE + 2, 128)) if node not in used)
    lines = [
        f"# jtqd on {bus}. Written by jtq init; docs/deployment.md has all other keys.",
        f"node_id: {node_id:<17}# jtqd's own; its estimate PDO is {0x180 + node_id:X}h",
        f"bitrate: {bitrate:<17}# as the interface is set up: ip -details link show",
        f"sync: {{period_us: {period_us}}}",
        "estimator: {method: tob}  # until runs against a torque sensor have been fitted: docs/first_joint.md",
    ]
    for joint in joints:
        lines += drive_lines(joint)
        if joint.number in measured:
            lines.append("  sensor_channel: 1       # the torque sensor measures this joint's torque")
    if sensor_node is not None:
        lines += sensor_lines(sensor_node, sensor)
    lines += [
        "realtime: {priority: 80, lock_memory: true}",
        "recording: {budget_mb: 2000, keep_run: false}  # of --record DIR: the oldest logs are removed",
        "",
    ]
    return "\n".join(lines)


def drive_lines(joint: JointProposal) -> list[str]:
    """Return the section of a joint as far as its drive is concerned."""
    node, others = f"  node: {joint.node}", "CiA 402" if joint.family is None else "the profile"
    lines = [
        f"joint_{joint.number}:{'':18}# {_title(joint.survey)}",
        f"{node:<26}# GUESS, {_NO_NODE}" if joint.node_guessed else node,
        f"  file: joint_{joint.number}.yaml",
        *_identity(joint.survey),
    ]
    if joint.given:
        lines.append("  given:                  # instead of the drive's own value")
    lines += [
        value.commented(f'    "{label(*key)}": {round(value.value)}', 25)
        for key, value in joint.given.items()
    ]
    if joint.family is not None:
        lines.append(f"  profile: {joint.family.name:<15}# docs/bus.md")
    objects = {**joint.objects, **joint.own}
    if objects:
        lines.append(f"  objects:                # of this drive; all else is as in {others}")
    lines += [value.commented(f"    {name}: {value.text}", 25) for name, value in objects.items()]
    return [*lines, *joint.kept.lines()]


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


def sensor_problems(survey: Survey | None) -> list[str]:
    """Return why this version of jtqd does not work with this sensor."""
    if survey is None:
        return []
    missing = [key for key in MAPPED[SENSOR] if key in survey.missing]
    return [f"node {survey.node} ({survey.title}): has no {label(*key)}" for key in missing]
