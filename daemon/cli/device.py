"""A device as the bus and its EDS describe it: survey by its profile, units of its numbers, TPDOs that it keeps.

Units (CiA 402-2): 60A8h and 60A9h name them; 6092h is their number per turn of the driving shaft. All count behind the gear
that the drive knows (6091h); a drive whose 6091h is 1:1 counts at the motor's shaft. A word 0 and a feed constant of 1 are
those of a drive without configured units: then the objects of `drive.CIA_402` scale it.

TPDOs that are sent at each SYNC and carry every quantity are kept, and those that cannot be written by the EDS.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Final

from jtqd.daemon.profiles import Family, named, of_vendor
from jtqd.drivers.drive import (
    AT_JOINT,
    AT_MOTOR,
    CIA_402,
    GEAR,
    SECOND,
    DriveObjects,
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
from jtqd.drivers.pdo import ACYCLIC, EVERY_SYNC, PdoError, Tpdo
from jtqd.drivers.sdo import Key, label
from jtqd.drivers.survey import DRIVE, IDENTITY, BusSurvey, Survey, survey_of_eds

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
