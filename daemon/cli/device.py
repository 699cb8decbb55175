"""What the section of a drive says because the drive, or its EDS, tells it: units of numbers, and TPDOs as they are. Pure.

Units (CiA 402-2): 60A8h and 60A9h name them, and 6092h says how many of them are one turn of the driving shaft. All count
behind the gear that the drive knows (6091h); a drive whose 6091h is 1:1 counts at the motor's shaft. A word 0, and a feed
constant of 1, are those of a drive that was not told any unit: then the objects of `devices.CIA_402` scale it.

TPDOs: those that are sent at each SYNC and carry every quantity were set up for that, and are kept. Those that an EDS says
cannot be written are kept whatever they are.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from jtqd.daemon.profiles import Family, named, of_vendor
from jtqd.drivers.devices import CIA_402, DriveObjects, drive_layout
from jtqd.drivers.layout import BY_ITSELF, EVERY_SYNC, LayoutError, chosen, pdo_of_words
from jtqd.drivers.pdo import PdoError
from jtqd.drivers.sdo import Key, label
from jtqd.drivers.survey import DRIVE, IDENTITY, MAPPED, BusSurvey, Survey, Tpdo, survey_of_eds
from jtqd.drivers.units import (
    AT_JOINT,
    AT_MOTOR,
    GEAR,
    SECOND,
    UnitError,
    is_increments,
    si_per_unit,
    unit_of_position,
    unit_of_velocity,
)

_POSITION_UNIT, _VELOCITY_UNIT = (0x60A8, 0), (0x60A9, 0)
_FEED: tuple[Key, Key] = ((0x6092, 1), (0x6092, 2))
_TOLD_BY: Mapping[str, Key] = {
    "60A8h": _POSITION_UNIT,
    "60A9h": _VELOCITY_UNIT,
    "608Fh": _VELOCITY_UNIT,  # increments per second
    "6092h": _FEED[0],
}
"""What has told by which object a quantity is scaled."""
_COMPARE = "turn the joint by a known angle and compare jtq status"
_AGE_MS = 100
"""For how long a frame counts that is sent by itself, where the drive has no event timer."""


class UsageError(Exception):
    """Options that contradict each other, or too few of them."""


def family_of(survey: Survey | None, name: str | None) -> Family | None:
    """Return the profile by name ("none": no profile), else by the drive's vendor-ID. Raises ConfigError."""
    if name is not None:
        return None if name == "none" else named(name)
    if survey is None or survey.profile != DRIVE:
        return None
    return of_vendor(survey.numbers.get(IDENTITY["vendor"]))


def mapped_by(family: Family | None) -> tuple[Key, ...]:
    """Return the objects that jtqd maps, with a profile or without."""
    return MAPPED[DRIVE] if family is None else tuple(quantities_by(family).values())


def quantities_by(family: Family | None) -> dict[str, Key]:
    """Return the object of each quantity, with a profile or without."""
    standard = {each.name: getattr(CIA_402, each.name) for each in fields(CIA_402)}
    keys = {name: (each.index, each.subindex) for name, each in standard.items()}
    return keys if family is None else {name: family.mapped(name, key) for name, key in keys.items()}


def surveyed(reader: BusSurvey, node: int, profile: str | None) -> Survey | None:
    """Survey one node, with the objects that its profile needs; None when it does not answer. Raises ConfigError."""
    found = reader.read(node)
    if found is not None:
        found = replace(found, tpdos=reader.tpdos(node))
    if found is None or (family := family_of(found, profile)) is None:
        return found
    wanted = {*family.objects, *mapped_by(family)}
    numbers = {**found.numbers, **reader.numbers(node, wanted - set(found.numbers))}
    return replace(found, numbers=numbers, missing=found.missing | (wanted - set(numbers)))


def eds_survey(path: Path, node: int, profile: str | None) -> Survey:
    """Return the survey by an EDS, with the objects that its profile needs. Raises EdsError, ConfigError."""
    found = survey_of_eds(path, node)
    family = family_of(found, profile)
    return found if family is None else survey_of_eds(path, node, (*family.objects, *mapped_by(family)))


def merged(eds: Survey, bus: Survey | None, path: Path) -> Survey:
    """A device on the bus knows its values; its EDS knows what can be mapped, and what cannot be written.

    Raises UsageError for the EDS of another vendor's device, or of another kind.
    """
    if bus is None:
        return eds
    vendor = IDENTITY["vendor"]
    told, found = eds.numbers.get(vendor), bus.numbers.get(vendor)
    if told and found and told != found:
        raise UsageError(f"{path}: is of vendor {told:08X}h, but node {bus.node} says {found:08X}h (1018h:1)")
    if eds.profile != bus.profile:
        raise UsageError(
            f"{path}: is of profile {eds.profile}, but node {bus.node} says {bus.profile} (1000h)"
        )
    known = {each.number: each for each in eds.tpdos}
    tpdos = tuple(
        replace(
            each, mapping_fixed=known[each.number].mapping_fixed, type_fixed=known[each.number].type_fixed
        )
        if each.number in known
        else each
        for each in bus.tpdos
    )
    return replace(bus, unmappable=eds.unmappable, tpdos=tpdos)


def description(survey: Survey) -> str:
    """Return a device in one line: name, versions, vendor, profile, source."""
    texts = [text for name in ("hardware", "software") if (text := survey.texts.get(name))]
    vendor = survey.numbers.get((0x1018, 1))
    parts = [survey.title, *texts, *([f"vendor {vendor:08X}h"] if vendor else [])]
    return f"{', '.join(parts)} (profile {survey.profile or 'unknown'}, by {survey.source})"


@dataclass(frozen=True)
class Instead:
    """What section `objects` says of a quantity (None: the drive has none), why, and how to make sure of a guess."""

    keys: Mapping[str, Any] | None
    why: str
    better: str = ""

    @property
    def text(self) -> str:
        """As YAML.

        >>> Instead({"by": "60A8h", "shaft": "motor"}, "").text, Instead(None, "").text
        ('{by: 60A8h, shaft: motor}', 'false')
        """
        if self.keys is None:
            return "false"
        return "{" + ", ".join(f"{name}: {_yaml(name, value)}" for name, value in self.keys.items()) + "}"


def _yaml(name: str, value: Any) -> str:
    if name == "index":
        return f"0x{value:04X}"
    return f"{value:.10e}" if isinstance(value, float) else str(value)


# ---- units ----


def unit_problems(node: int, survey: Survey | None) -> list[str]:
    """Return one line for each unit word that names no angle, or no speed."""
    if survey is None:
        return []
    found = []
    for key, told in ((_POSITION_UNIT, _position), (_VELOCITY_UNIT, _velocity)):
        try:
            told(survey)
        except UnitError as error:
            found.append(
                f"node {node} ({survey.title}): {label(*key)}, the unit of "
                f"{'positions' if key == _POSITION_UNIT else 'velocities'}: {error}; "
                "with a factor of your own in joint_N.objects it can be used"
            )
    return found


def _position(survey: Survey) -> str:
    """Return which object tells the unit of positions: "60A8h", "6092h", or "608Fh" (counts). Raises UnitError."""
    word = survey.number(_POSITION_UNIT)
    if word is not None:
        if is_increments(word):
            return "608Fh"
        unit_of_position(word)
        return "60A8h"
    feed = [survey.number(key) for key in _FEED]
    return "608Fh" if None in feed or feed[0] == feed[1] else "6092h"


def _velocity(survey: Survey) -> str:
    """Return which object tells the unit of velocities: "60A9h", "608Fh" (counts per second), "". Raises UnitError."""
    word = survey.number(_VELOCITY_UNIT)
    if word is None:
        return ""
    if is_increments(word, SECOND):
        return "608Fh"
    unit_of_velocity(word)
    return "60A9h"


def units_told(
    survey: Survey | None, gear_ratio: float, quantities: Iterable[str], by_options: Iterable[str]
) -> dict[str, Instead]:
    """Return by which objects a drive's positions and velocity are scaled, where not by those of `devices.CIA_402`.

    gear_ratio: of the joint. quantities: those that the drive has. by_options: those that the operator has scaled.
    """
    found: dict[str, Instead] = {}
    velocity = ""
    if survey is None:
        return found
    with suppress(UnitError):
        position = _position(survey)
        if position != "608Fh" and not _is_counts(survey, position):
            found["motor_position"] = _scaled(survey, "motor_position", position, gear_ratio)
            found["link_position"] = _scaled(
                survey,
                "link_position",
                position,
                gear_ratio,
                better=f"60E4h:1 is in the unit of 6064h by CiA 402; {_COMPARE}",
            )
            if survey.number(_VELOCITY_UNIT) is None:
                found["motor_velocity"] = _per_second(survey, position, gear_ratio)
    with suppress(UnitError):
        if velocity := _velocity(survey):
            found["motor_velocity"] = _scaled(survey, "motor_velocity", velocity, gear_ratio)
    unless = set(by_options)
    if velocity == "608Fh":  # counts of that option, per second
        unless.discard("motor_velocity")
    return {name: found[name] for name in quantities if name in found and name not in unless}


def _is_counts(survey: Survey, by: str) -> bool:
    """Whether 6092h says no more than that the positions are in counts."""
    if by != "6092h" or any(survey.number(key) is None for key in ((0x608F, 1), (0x608F, 2))):
        return False
    gear = _gear(survey)
    values = {**survey.numbers, **({GEAR[0]: 1, GEAR[1]: 1} if gear is None else {})}
    feed, counts = (si_per_unit("motor_position", each, AT_JOINT, values, 0.0) for each in (by, "608Fh"))
    return math.isclose(feed, counts, rel_tol=1e-6)


def _gear(survey: Survey) -> float | None:
    """The ratio that the drive itself counts with; None: it has none."""
    turns = [survey.number(key) for key in GEAR]
    return turns[0] / turns[1] if turns[0] is not None and turns[1] is not None else None


def _scaled(survey: Survey, quantity: str, by: str, gear_ratio: float, better: str = "") -> Instead:
    """Return the entry by an object; by a factor where the drive counts behind another gear than the joint's."""
    key = _TOLD_BY[by]
    word = survey.numbers[key]
    why = f"{label(*key)} is {word if by == '6092h' else f'0x{word:08X}'}, by {survey.source}"
    gear = _gear(survey)
    if by == "608Fh" or not quantity.startswith("motor") or gear == gear_ratio:
        return Instead({"by": by}, why, better)
    if gear is None or gear == 1.0:
        return Instead({"by": by, "shaft": AT_MOTOR}, f"{why}; the drive knows no gear", better)
    factor = si_per_unit(quantity, by, AT_JOINT, survey.numbers, 0.0)
    return Instead({"factor": factor}, f"{why}, behind the drive's own gear of {gear:g}", better or _COMPARE)


def _per_second(survey: Survey, position: str, gear_ratio: float) -> Instead:
    """Return the velocity of a drive that tells no unit of it: that of its positions per second."""
    better = f"no 60A9h: 606Ch taken for {position} per second; turn the motor at a known speed and compare jtq status"
    if position == "6092h":
        return _scaled(survey, "motor_velocity", position, gear_ratio, better)
    motor = unit_of_position(survey.numbers[_POSITION_UNIT]) * (_gear(survey) or 1.0)
    return Instead({"factor": motor}, f"60A8h, by {survey.source}", better)


# ---- TPDOs ----


@dataclass(frozen=True)
class Layout:
    """TPDOs for section `tpdos` (none: jtqd's own), with how long a frame counts, and what is wrong."""

    tpdos: tuple[Tpdo, ...] = ()
    max_age_ms: int | None = None
    why: str = ""
    problems: tuple[str, ...] = ()


def layout_told(node: int, survey: Survey | None, objects: DriveObjects) -> Layout:
    """Return the TPDOs of a drive that are kept as they are, where they are not those into which jtqd maps."""
    if survey is None or not survey.tpdos:
        return Layout()
    own = drive_layout(node, objects)
    needed = {pdo.number for pdo in own}
    fixed = any(each.mapping_fixed for each in survey.tpdos if each.number in needed)
    usable = [each for each in survey.tpdos if fixed or (each.on and each.transmission_type == EVERY_SYNC)]
    maps, unusable = [], []
    for each in usable:
        try:
            maps.append(pdo_of_words(node, each.number, each.cob_id, each.words, EVERY_SYNC, objects))
        except PdoError as error:
            unusable.append(f"TPDO{each.number}: {error}")
    try:
        numbers = [pdo.number for pdo in chosen(objects, maps)]
    except LayoutError as error:
        told = "; ".join((str(error), *unusable))
        problem = f"node {node} ({survey.title}): its mapping is fixed, by its EDS: {told}"
        return Layout(problems=(problem,) if fixed else ())
    used = tuple(each for each in usable if each.number in numbers)
    if not _by_itself(used) and {(pdo.cob_id, pdo.words) for pdo in own} == {
        (pdo.cob_id, pdo.words) for pdo in used
    }:
        return Layout()
    wrong = [
        each for each in used if each.type_fixed and each.transmission_type not in (EVERY_SYNC, *BY_ITSELF)
    ]
    if wrong:
        problem = (
            f"node {node} ({survey.title}): TPDO{wrong[0].number} has transmission type "
            f"{wrong[0].transmission_type}, which cannot be written, by its EDS: expected 1, 0, 254 or 255"
        )
        return Layout(problems=(problem,))
    why = "their mapping is fixed, by the EDS" if fixed else f"as they are, by {survey.source}"
    return Layout(used, _age_ms(_by_itself(used)), why)


def _by_itself(tpdos: Sequence[Tpdo]) -> list[Tpdo]:
    return [each for each in tpdos if each.type_fixed and each.transmission_type in BY_ITSELF]


def _age_ms(tpdos: Sequence[Tpdo]) -> int | None:
    """For how long a frame counts: the longest event timer, and half as much again."""
    if not tpdos:
        return None
    timer_ms = max(each.timer_ms for each in tpdos)
    return min(1000, timer_ms * 3 // 2) or _AGE_MS


def tpdo_lines(layout: Layout) -> list[str]:
    """Return sections `tpdos` and `max_age_ms`, without the indent of a section."""
    if not layout.tpdos:
        return []
    lines = [f"tpdos:                  # {layout.why}; without it jtqd maps its own"]
    for each in layout.tpdos:
        kind = f", type: {each.transmission_type}" if each in _by_itself(layout.tpdos) else ""
        words = ", ".join(f"0x{word:08X}" for word in each.words)
        lines.append(f"  - {{number: {each.number}, cob_id: 0x{each.cob_id:03X}{kind}, objects: [{words}]}}")
    if layout.max_age_ms is not None:
        age = f"max_age_ms: {layout.max_age_ms}"
        lines.append(f"{age:<24}# GUESS, for how long a frame that the drive sends by itself counts")
    return lines
