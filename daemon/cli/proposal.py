"""First configuration and joint files of somebody's own bench: what is known, from where, and what is a guess. Pure.

    Wanted          what the operator gave, per joint
    draft_joint     Wanted + Survey -> JointDraft: every value with its origin
    joint_text      the joint file
    config_text     the configuration; `drive_lines`, `sensor_lines`: a section of it

A guess is scaled from the shipped bench by the rated torque: orders of magnitude of a harmonic-drive joint, no more.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from jtqd.daemon.cli.device import (
    Instead,
    Layout,
    layout_told,
    quantities_by,
    tpdo_lines,
    unit_problems,
    units_told,
)
from jtqd.daemon.config import ObjectsSection
from jtqd.daemon.profiles import INIT, Family
from jtqd.drivers.devices import (
    COMMANDER_NODE,
    EVERY_SCALING_OBJECT,
    JTQD_NODE,
    DriveObjects,
    DriveProfile,
    parse_key,
)
from jtqd.drivers.sdo import Key, label
from jtqd.drivers.survey import (
    IDENTITY,
    MAPPED,
    RATED_CURRENT,
    RATED_TORQUE,
    SENSOR,
    TORQUE,
    Survey,
)
from jtqd.drivers.units import GEAR
from jtqd.estimator.decoder import decode

EFFICIENCY = 0.7
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


class DraftError(ValueError):
    """Something that cannot be guessed is missing; the message names the option."""


@dataclass(frozen=True)
class Wanted:
    """What the operator gave about one joint; None: not given."""

    gear_ratio: float | None = None
    rated_torque_nm: float | None = None
    torque_constant_nm_per_a: float | None = None
    rated_current_a: float | None = None
    encoder_counts: int | None = None
    link_encoder_counts: int | None = None
    one_encoder: bool = False
    """The joint has no link encoder, whatever the drive has objects for."""


@dataclass(frozen=True)
class Value:
    """A number, where it is from, and how it is measured where it is a guess."""

    number: float
    origin: str
    better: str = ""

    @property
    def guess(self) -> bool:
        """Whether nobody has given or told it."""
        return bool(self.better)


NO_NODE = "an EDS knows no node-ID: --node, or --bus"


@dataclass(frozen=True)
class JointDraft:
    """One joint: `values` by the keys of the joint file, objects of the drive that the configuration gives instead."""

    number: int
    node: int
    survey: Survey | None
    values: Mapping[str, Value]
    given: Mapping[Key, Value]
    problems: tuple[str, ...]
    """Why this version of jtqd does not work with this drive."""
    family: Family | None = None
    """Profile that the configuration names."""
    own: Mapping[str, Value] = field(default_factory=dict)
    """What the profile leaves to the drive and the operator: keys of the section, such as "objects.current.factor"."""
    instead: Mapping[str, Instead] = field(default_factory=dict)
    """Quantities that the drive does not have, or does not scale, as CiA 402 or its profile has them."""
    layout: Layout = field(default_factory=Layout)
    """TPDOs that stay as they are."""
    node_guessed: bool = False
    """Nobody said which node-ID the drive has."""

    @property
    def guesses(self) -> list[str]:
        """One line per guess: what, how much, what to do."""
        named = [(f"joint_{self.number}.yaml: {name}", value) for name, value in self.values.items()]
        named += [(f"joint_{self.number}.given: {label(*key)}", value) for key, value in self.given.items()]
        found = [f"joint_{self.number}: node = {self.node} ({NO_NODE})"] if self.node_guessed else []
        found += [
            f"{name} = {plain(value.number)} ({value.origin}): {value.better}"
            for name, value in named
            if value.guess
        ]
        found += [
            f"joint_{self.number}.objects: {name} = {each.text} ({each.why}): {each.better}"
            for name, each in self.instead.items()
            if each.better
        ]
        if self.layout.max_age_ms is not None:
            age = f"joint_{self.number}: max_age_ms = {self.layout.max_age_ms}"
            found.append(
                f"{age}: the longest time between two frames of the drive at rest, and a little more"
            )
        return found


def _guess(number: float, origin: str, better: str) -> Value:
    """Return a guess: three digits are more than it is worth."""
    return Value(float(f"{number:.3g}"), origin, better)


def plain(number: float) -> str:
    """Return a number of at most six digits as YAML reads it.

    >>> plain(100.0), plain(0.0000712), plain(0.00001), plain(0.062)
    ('100.0', '7.12e-05', '1.0e-05', '0.062')
    """
    mantissa, exponential, exponent = repr(float(f"{number:.6g}")).partition("e")
    if exponential and "." not in mantissa:  # YAML 1.1 takes 1e-05 for a text
        mantissa += ".0"
    return mantissa + exponential + exponent


def _instead(survey: Survey | None, wanted: Wanted, family: Family | None) -> dict[str, Instead]:
    """Return what a drive with fewer objects is told to jtqd as: one encoder, a derived velocity, torque for current."""
    found: dict[str, Instead] = {}
    if wanted.one_encoder:
        found["link_position"] = Instead(None, "--one-encoder")
    if survey is None:
        return found

    def lacks(key: Key) -> str:
        if key in survey.missing:
            return f"no {label(*key)}, by {survey.source}"
        return f"{label(*key)} cannot be mapped, by {survey.source}" if key in survey.unmappable else ""

    keys = quantities_by(family)
    for name in ("link_position", "motor_velocity"):
        if name not in found and (why := lacks(keys[name])):
            found[name] = Instead(None, why)
    if family is None and (why := lacks(keys["current"])) and TORQUE in survey.numbers:
        found["current"] = Instead({"index": TORQUE[0]}, f"{why}: torque by 6076h")
    return found


def draft_joint(
    number: int, node: int, survey: Survey | None, wanted: Wanted, family: Family | None = None
) -> JointDraft:
    """Return what is known and guessed of a joint; `family`: profile of the drive. Raises DraftError."""
    given: dict[Key, Value] = {}
    instead = _instead(survey, wanted, family)
    problems = _problems(node, survey, family, instead)
    filled: dict[str, Value] = {}
    if family is not None:
        filled = _filled(number, node, survey, wanted, family, instead)
        survey = _translated(survey, filled)
    gear = _gear(number, node, survey, wanted, given)
    if family is None:
        scaled = {"motor_position", "motor_velocity"} if wanted.encoder_counts is not None else set()
        scaled |= {"link_position"} if wanted.link_encoder_counts is not None else set()
        there = [name for name in quantities_by(None) if name not in instead]
        instead |= units_told(survey, gear.number, there, scaled)
        if wanted.encoder_counts is None:
            problems += tuple(unit_problems(node, survey))
    current_a = _rated_current(survey, wanted, given)
    motor_mnm = None if survey is None else survey.number(RATED_TORQUE)
    rated = _rated_torque(number, wanted, gear, None if motor_mnm is None else 1e-3 * motor_mnm, survey)
    constant = _torque_constant(
        number, wanted=wanted, gear=gear, rated=rated, current_a=current_a, motor_mnm=motor_mnm, survey=survey
    )
    _encoders(node, survey, wanted, given, family, instead)
    for key, value in filled.items():
        if key.startswith("given."):
            given.setdefault(parse_key(key.removeprefix("given.")), value)
    if "current" in instead or (family is not None and family.scales("current")):
        given.pop(RATED_CURRENT, None)
    torque, origin = rated.number, "shipped bench scaled by the rated torque"
    stiffness = STIFFNESS_PER_RAD * torque
    values = {
        "gear_ratio": gear,
        "torque_constant_nm_per_a": constant,
        "rated_torque_nm": rated,
        "rotor_inertia_kgm2": _guess(
            INERTIA_S2 * torque / gear.number**2, origin, "data sheet of the motor, or jtq diagnose"
        ),
        "stiffness_nm_per_rad": _guess(stiffness, origin, "data sheet of the gear (K2)"),
        "damping_nms_per_rad": _guess(DAMPING_S * stiffness, origin, "jtq diagnose"),
        "link_inertia_kgm2": _guess(LINK_INERTIA_S2 * torque, origin, "your CAD"),
        "coulomb_nm": _guess(COULOMB * torque, origin, "jtq fit friction"),
        "viscous_nms_per_rad": _guess(VISCOUS * torque, origin, "jtq fit friction"),
    }
    own = {key: value for key, value in filled.items() if key.startswith("objects.")}
    objects = _objects(family, instead, own)
    layout = layout_told(node, survey, objects)
    problems += (*_implausible(node, survey, objects, given), *layout.problems)
    return JointDraft(number, node, survey, values, given, problems, family, own, instead, layout)


def _objects(family: Family | None, instead: Mapping[str, Instead], own: Mapping[str, Value]) -> DriveObjects:
    """Return the objects of a drive as its section will say."""
    section: dict[str, Any] = {} if family is None else dict(family.section().get("objects", {}))
    for key, value in own.items():
        _, quantity, name = key.split(".")
        section[quantity] = {**section.get(quantity, {}), name: value.number}
    for quantity, each in instead.items():
        section[quantity] = False if each.keys is None else {**section.get(quantity, {}), **each.keys}
    return decode(ObjectsSection, section, "jtq init").of_drive("joint_N", Path("jtq init"))


def _filled(  # noqa: PLR0917
    number: int,
    node: int,
    survey: Survey | None,
    wanted: Wanted,
    family: Family,
    instead: Mapping[str, Instead],
) -> dict[str, Value]:
    """Return what a profile leaves to the drive and to the operator. Raises DraftError."""
    options: dict[str, float] = {}
    if wanted.gear_ratio is not None:
        numerator, denominator = ratio(wanted.gear_ratio)
        options = {"gear_ratio_numerator": numerator, "gear_ratio_denominator": denominator}
    for name in ("encoder_counts", "link_encoder_counts"):
        if (counts := getattr(wanted, name)) is not None:
            options[name] = counts
    found = family.filled({} if survey is None else survey.numbers, options)
    unused = tuple(f"objects.{name}." for name in instead)
    found = {key: value for key, value in found.items() if not key.startswith(unused)}
    for line in family.lines:
        if line.open and line.key not in found and not (line.key or "").startswith(unused):
            where = f"joint {number} (node {node}): profile {family.name}"
            if line.option is None:
                raise DraftError(f"{where}: {line.read} has no value ({line.why})")
            option = "gear-ratio" if line.option.startswith("gear_ratio") else line.option.replace("_", "-")
            raise DraftError(f"{where} needs what no object of the drive tells: give --{option}")
    return {key: Value(value, origin) for key, (value, origin) in found.items()}


def _translated(survey: Survey | None, filled: Mapping[str, Value]) -> Survey | None:
    """Return the survey of a drive as if it had the objects of CiA 402 for what its profile has elsewhere."""
    if survey is None:
        return None
    numbers = dict(survey.numbers)
    for name, value in filled.items():
        prefix, _, key = name.partition(".")
        if prefix in ("given", INIT.removesuffix(".")):
            numbers[parse_key(key)] = round(value.number)
    return replace(survey, numbers=numbers, missing=survey.missing - set(numbers))


def _told(survey: Survey | None, key: Key) -> str:
    return f"{label(*key)}, {survey.source}" if survey is not None else ""


def _gear(number: int, node: int, survey: Survey | None, wanted: Wanted, given: dict[Key, Value]) -> Value:
    turns = [None if survey is None else survey.number(key) for key in GEAR]
    told = turns[0] / turns[1] if turns[0] is not None and turns[1] is not None else None
    if wanted.gear_ratio is None:
        if told is None:
            raise DraftError(f"joint {number} (node {node}): no 6091h is known: give --gear-ratio")
        if told == 1.0:
            raise DraftError(
                f"joint {number} (node {node}): 6091h says 1:1, as drives do that do not know their gear: give --gear-ratio"
            )
        return Value(told, _told(survey, GEAR[0]))
    if survey is not None and told != wanted.gear_ratio:
        why = "the drive has none" if told is None else f"the drive says {told:g}"
        numerator, denominator = ratio(wanted.gear_ratio)
        given[GEAR[0]] = Value(numerator, f"--gear-ratio; {why}")
        given[GEAR[1]] = Value(denominator, f"--gear-ratio; {why}")
    return Value(wanted.gear_ratio, "--gear-ratio")


def ratio(value: float) -> tuple[int, int]:
    """Return numerator and denominator of a gear ratio of up to six decimals.

    >>> ratio(100.0), ratio(50.5)
    ((100, 1), (101, 2))
    """
    from fractions import Fraction

    found = Fraction(value).limit_denominator(1_000_000)
    return found.numerator, found.denominator


def _rated_current(survey: Survey | None, wanted: Wanted, given: dict[Key, Value]) -> float | None:
    told = None if survey is None else survey.number(RATED_CURRENT)
    if wanted.rated_current_a is None:
        return None if told is None else 1e-3 * told
    milliampere = round(1000 * wanted.rated_current_a)
    if survey is not None and told != milliampere:
        why = "the drive has none" if told is None else f"the drive says {told} mA"
        given[RATED_CURRENT] = Value(milliampere, f"--rated-current; {why}")
    return wanted.rated_current_a


def _rated_torque(
    number: int, wanted: Wanted, gear: Value, motor_nm: float | None, survey: Survey | None
) -> Value:
    if wanted.rated_torque_nm is not None:
        return Value(wanted.rated_torque_nm, "--rated-torque")
    if motor_nm is None:
        raise DraftError(
            f"joint {number}: the motor's rated torque (6076h) is not known: give --rated-torque"
        )
    origin = f"{EFFICIENCY:g} x gear ratio x rated torque of the motor ({_told(survey, RATED_TORQUE)})"
    return _guess(EFFICIENCY * gear.number * motor_nm, origin, "data sheet of the gear or joint")


def _torque_constant(
    number: int,
    *,
    wanted: Wanted,
    gear: Value,
    rated: Value,
    current_a: float | None,
    motor_mnm: int | None,
    survey: Survey | None,
) -> Value:
    if wanted.torque_constant_nm_per_a is not None:
        return Value(wanted.torque_constant_nm_per_a, "--torque-constant")
    if current_a is None:
        if survey is None:
            raise DraftError(f"joint {number}: give --torque-constant, or --rated-current")
        raise DraftError(f"joint {number}: the rated current (6075h) is not known: give --rated-current")
    better = "data sheet of the motor (per ampere as 6078h counts it: peak or RMS), or jtq diagnose"
    if motor_mnm is not None:
        return Value(
            1e-3 * motor_mnm / current_a, f"6076h / 6075h, {survey.source if survey else ''}", better
        )
    constant = rated.number / (EFFICIENCY * gear.number * current_a)
    return _guess(constant, f"rated torque / ({EFFICIENCY:g} x gear ratio x rated current)", better)


def _encoders(  # noqa: PLR0917
    node: int,
    survey: Survey | None,
    wanted: Wanted,
    given: dict[Key, Value],
    family: Family | None,
    instead: Mapping[str, Instead],
) -> None:
    """Give what the drive does not tell, or tells otherwise; not what a profile scales. Raises DraftError."""

    def give(keys: tuple[Key, Key], counts: int | None, option: str) -> None:
        told = [None if survey is None else survey.number(key) for key in keys]
        if counts is None:
            if survey is not None and not all(survey.tells(key) for key in keys):
                raise DraftError(f"node {node}: {label(*keys[0])} is not known: give {option}")
        elif survey is not None and told != [counts, 1]:
            given[keys[0]] = Value(counts, option)
            given[keys[1]] = Value(1, option)

    def by_cia_402(quantity: str) -> bool:
        return quantity not in instead and (family is None or not family.scales(quantity))

    if by_cia_402("motor_position"):
        give(POSITION, wanted.encoder_counts, "--encoder-counts")
    untold = survey is not None and not all(survey.tells(key) for key in VELOCITY)
    if by_cia_402("motor_velocity") and untold and survey is not None:
        for ours, of_position in zip(VELOCITY, POSITION, strict=True):
            number = given[of_position].number if of_position in given else survey.number(of_position)
            better = "turn the motor at a known speed and compare jtq status; 606Ch may be in rpm"
            given[ours] = Value(number or 1, "606Ch taken for encoder counts per second: no 6090h", better)
    if by_cia_402("link_position"):
        give(LINK, wanted.link_encoder_counts, "--link-encoder-counts")


def _problems(
    node: int, survey: Survey | None, family: Family | None, instead: Mapping[str, Instead]
) -> tuple[str, ...]:
    if survey is None:
        return ()
    mapped = [key for name, key in quantities_by(family).items() if name not in instead]
    found = [
        f"node {node} ({survey.title}): has no {label(*key)}, which jtqd maps"
        for key in mapped
        if key in survey.missing
    ]
    found += [
        f"node {node} ({survey.title}): {label(*key)} cannot be mapped, by {survey.source}"
        for key in mapped
        if key in survey.unmappable
    ]
    if family is not None:
        found += [
            f"node {node} ({survey.title}): profile {family.name}: {text}"
            for text in family.findings(survey.numbers)
        ]
    return tuple(found)


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


def joint_text(draft: JointDraft) -> str:
    """Return the joint file."""
    values = draft.values
    friction = ("coulomb_nm", "viscous_nms_per_rad")
    lines = [
        f"# Joint {draft.number}, node {draft.node}. Written by jtq init. A GUESS is an order of magnitude: replace it.",
        "# SI units. Torque constant and rotor inertia are motor side; all else is joint side.",
        f"name: joint{draft.number}",
        *(_line(name, value) for name, value in values.items() if name not in friction),
        "friction:",
        *(_line(name, values[name], "  ") for name in friction),
        "",
    ]
    return "\n".join(lines)


def _line(name: str, value: Value, indent: str = "") -> str:
    comment = f"GUESS, {value.origin}; better: {value.better}" if value.guess else value.origin
    return f"{f'{indent}{name}: {plain(value.number)}':<42}# {comment}"


@dataclass(frozen=True)
class ConfigDraft:
    """All of a configuration. `joint_of_sensor`: joints whose torque the sensor measures."""

    bus: str
    bitrate: int
    period_us: int
    joints: Sequence[JointDraft]
    sensor: Survey | None
    sensor_node: int | None
    joints_of_sensor: Sequence[int] = ()
    budget_mb: int = 2000

    @property
    def node_id(self) -> int:
        """jtqd's own node-ID: 20h, or the next that no node has."""
        used = [*(each.node for each in self.joints), self.sensor_node, COMMANDER_NODE]
        free: list[int] = [each for each in (JTQD_NODE, *range(JTQD_NODE + 2, 128)) if each not in used]
        return free[0]


def config_text(draft: ConfigDraft) -> str:
    """Return the configuration."""
    lines = [
        f"# jtqd on {draft.bus}. Written by jtq init; docs/deployment.md says what other keys there are.",
        f"node_id: {draft.node_id:<17}# jtqd's own; its estimate PDO is {0x180 + draft.node_id:X}h",
        f"bitrate: {draft.bitrate:<17}# as the interface is set up: ip -details link show",
        f"sync: {{period_us: {draft.period_us}}}",
        "estimator: {method: tob}  # until runs against a torque sensor have been fitted: docs/first_joint.md",
    ]
    for joint in draft.joints:
        lines += _joint_section(joint, draft)
    if draft.sensor_node is not None:
        lines += sensor_lines(draft.sensor_node, draft.sensor)
    lines += [
        "realtime: {priority: 80, lock_memory: true}",
        f"recording: {{budget_mb: {draft.budget_mb}, keep_run: false}}  # of --record DIR: the oldest logs are removed",
        "",
    ]
    return "\n".join(lines)


def _joint_section(joint: JointDraft, draft: ConfigDraft) -> list[str]:
    lines = drive_lines(joint)
    if joint.number in draft.joints_of_sensor:
        lines.append("  sensor_channel: 1       # the torque sensor measures this joint's torque")
    return lines


def drive_lines(joint: JointDraft) -> list[str]:
    """Return the section of a joint as far as its drive is concerned."""
    survey = joint.survey
    title = f"{survey.title}, by {survey.source}" if survey is not None else "not looked at"
    lines = [
        f"joint_{joint.number}:{'':18}# {title}",
        f"  node: {joint.node}"
        if not joint.node_guessed
        else f"{f'  node: {joint.node}':<26}# GUESS, {NO_NODE}",
        f"  file: joint_{joint.number}.yaml",
    ]
    lines += _identity(survey)
    if joint.given:
        lines.append("  given:                  # instead of what the drive says")
        for key, value in joint.given.items():
            entry = f'    "{label(*key)}": {round(value.number)}'
            lines.append(f"{entry:<25} # {'GUESS, ' * value.guess}{value.origin}")
    if joint.family is not None:
        lines.append(f"  profile: {joint.family.name:<15}# docs/profiles.md")
    rest = "CiA 402" if joint.family is None else "the profile"
    if joint.own or joint.instead:
        lines.append(f"  objects:                # of this drive; all else is as in {rest}")
    for name, each in joint.instead.items():
        guess = "GUESS, " if each.better else ""
        lines.append(f"{f'    {name}: {each.text}':<25} # {guess}{each.why}")
    return [*lines, *_own_lines(joint.own), *(f"  {line}" for line in tpdo_lines(joint.layout))]


def _own_lines(own: Mapping[str, Value]) -> list[str]:
    """Return what a profile leaves to the drive as lines of `objects` of the section."""
    lines = []
    for key, value in own.items():
        _, quantity, name = key.split(".")
        lines.append(f"    {quantity}: {{{name}: {value.number:.10e}}}  # {value.origin}")
    return lines


def _identity(survey: Survey | None) -> list[str]:
    """Refuse another device at this node-ID; serial numbers change with every repair, so they are left out."""
    known = {
        name: survey.numbers[key]
        for name, key in IDENTITY.items()
        if survey is not None and name in ("vendor", "product") and survey.numbers.get(key)
    }
    inside = ", ".join(f"{name}: 0x{value:08X}" for name, value in known.items())
    return [f"  identity: {{{inside}}}"] if known else []


def sensor_lines(node: int, survey: Survey | None) -> list[str]:
    """Return the section of the torque sensor."""
    title = f"{survey.title}, by {survey.source}" if survey is not None else "not looked at"
    return [
        f"sensor:                   # {title}",
        f"  node: {node}",
        *_identity(survey),
        "  channels: 1",
    ]


def sensor_problems(node: int, survey: Survey | None) -> list[str]:
    """Why this version of jtqd does not work with this sensor."""
    if survey is None:
        return []
    return [
        f"node {node} ({survey.title}): has no {label(*key)}"
        for key in MAPPED[SENSOR]
        if key in survey.missing
    ]
