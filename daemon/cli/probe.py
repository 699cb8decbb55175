"""`jtq probe`: read a device on the bus: its objects, what jtqd lacks in it, and its section of the configuration.

Only objects are read; nothing is written and no node is started. Only an EDS (`--eds`) has which objects can be mapped.
"""

from __future__ import annotations

import argparse
import json
import sys
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

from jtqd.daemon.cli.init import MAX_JOINTS, add_values, node_id
from jtqd.daemon.cli.proposal import (
    OPTIONS,
    JointProposal,
    MissingValueError,
    UsageError,
    Wanted,
    description,
    drive_lines,
    eds_survey,
    family_of,
    merged,
    sensor_lines,
    sensor_problems,
    surveyed,
    unit_problems,
)
from jtqd.daemon.profiles import Family
from jtqd.daemon.profiles import names as profile_names
from jtqd.drivers.drive import EVERY_SCALING_OBJECT, drive_layout
from jtqd.drivers.frame_socket import BusError
from jtqd.drivers.object_dictionary import EdsError
from jtqd.drivers.sdo import Key, label
from jtqd.drivers.sensor import SENSOR_SCALING_OBJECTS, sensor_tpdo1
from jtqd.drivers.survey import DRIVE, IDENTITY, SENSOR, TORQUE, BusSurvey, Survey, SurveyError
from jtqd.estimator.command_line import command_parser

_EXAMPLES = """examples:
  jtq probe --bus can0                      which nodes are there
  jtq probe --bus can0 --node 5             identity, scaling, TPDOs, section of the configuration
  jtq probe --bus can0 --node 5 --eds drive.eds --json
  jtq probe --bus can0 --node 6 --joint 2 --gear-ratio 101 --section >> arm/jtqd.yaml

exit status: 0 jtqd can use it, 1 failure or no answer, 2 usage, 3 it lacks what this version of jtqd needs"""
NOTHING = Wanted()
"""No option was given."""
_ANY = Wanted(1.0, 1.0, 1.0, 1.0, 1, 1)
"""Values that do not matter where only the objects of the drive are judged."""
_CODES = {0x1018: 8, 0x6041: 4, 0x60A8: 8, 0x60A9: 8, 0x6131: 8}
"""Objects whose values are codes (identity, statusword, units), with their hexadecimal digits."""
_NAMES: dict[Key, str] = {
    **{key: name for key, (name, _) in (EVERY_SCALING_OBJECT | SENSOR_SCALING_OBJECTS).items()},
    **{key: name for name, key in IDENTITY.items()},
    **{
        (each.index, each.subindex): each.name.replace("_", " ")
        for pdo in (*drive_layout(1), sensor_tpdo1(1))
        for each in pdo.objects
    },
    TORQUE: "torque",
}
"""Names of the objects that are read."""


def parser() -> argparse.ArgumentParser:
    """Return the arguments of `jtq probe`."""
    made = command_parser(
        "jtq probe",
        "Read a device on the bus, and print its section of the configuration. Nothing is written to it.",
        _EXAMPLES,
    )
    add = made.add_argument
    add("--bus", required=True, help="can0, or unix:PATH")
    add("--node", type=node_id, metavar="N", help="node-ID (default: list the nodes)")
    add("--eds", type=Path, metavar="FILE", help="its EDS, which has the objects that can be mapped")
    profile = "profile of its family (default: by its vendor-ID; docs/bus.md)"
    add("--profile", choices=[*profile_names(), "none"], help=profile)
    joint = "number of the joint in the section (default 1)"
    add("--joint", type=int, choices=range(1, MAX_JOINTS + 1), default=1, metavar="J", help=joint)
    add_values(made, of_joint=False)
    add("--section", action="store_true", help="print the section of the configuration alone")
    add("--json", action="store_true", help="print as JSON")
    return made


def main(argv: list[str]) -> int:
    """Read and print; returns the exit status."""
    options = parser().parse_args(argv)
    for name in ("eds", "section"):
        if getattr(options, name) and options.node is None:
            print(f"jtq probe: --{name} needs --node", file=sys.stderr)
            return 2
    try:
        with closing(BusSurvey(options.bus)) as bus:
            return _list(options, bus) if options.node is None else _one(options, bus)
    except UsageError as error:
        print(f"jtq probe: {error}", file=sys.stderr)
        return 2
    except (BusError, EdsError, ValueError) as error:  # ConfigError and SurveyError are, too
        print(f"jtq probe: {error}", file=sys.stderr)
        return 1


def _list(options: argparse.Namespace, bus: BusSurvey) -> int:
    found: list[Survey] = []
    silent = False
    for node in bus.nodes():
        try:
            if (each := bus.read(node)) is not None:
                found.append(each)
        except SurveyError as error:
            print(f"jtq probe: {error}", file=sys.stderr)
            silent = True
    if options.json:
        print(json.dumps([content(each, [])["device"] for each in found]))
    else:
        print("\n".join(f"node {each.node}: {description(each)}" for each in found) or "no node answers")
    return 0 if found and not silent else 1


def _one(options: argparse.Namespace, bus: BusSurvey) -> int:
    found = surveyed(bus, options.node, options.profile)
    if found is None:
        raise ValueError(f"node {options.node} does not answer on {options.bus}")
    if options.eds is not None:
        found = merged(eds_survey(options.eds, options.node, options.profile), found, options.eds)
    family = family_of(found, options.profile)
    problems = problems_of(found, family)
    values = {field: getattr(options, field, None) for field in OPTIONS}
    wanted = Wanted(**values, one_encoder=options.one_encoder)
    if options.json:
        print(json.dumps(content(found, problems, family)))
    elif options.section:
        if found.profile not in (DRIVE, SENSOR):
            raise UsageError(f"node {found.node} is neither a drive (402) nor a sensor (404)")
        try:
            print("\n".join(section(found, family, wanted, options.joint)))
        except MissingValueError as error:
            raise UsageError(str(error)) from None
        for problem in problems:
            print(f"jtq probe: {problem}", file=sys.stderr)
    else:
        print(text(found, problems, family, wanted, options.joint))
    return 3 if problems else 0


def problems_of(survey: Survey, family: Family | None = None) -> list[str]:
    """Return why this version of jtqd does not work with a device."""
    if survey.profile == SENSOR:
        return sensor_problems(survey)
    if survey.profile != DRIVE:
        return [f"node {survey.node}: {description(survey)}: neither a drive (402) nor a sensor (404)"]
    try:
        found = JointProposal(1, survey.node, survey, _ANY, family).problems
        return list(dict.fromkeys((*found, *(unit_problems(survey) if family is None else ()))))
    except MissingValueError as error:
        return [str(error)]


def section(
    survey: Survey, family: Family | None = None, wanted: Wanted = NOTHING, joint: int = 1
) -> list[str]:
    """Return its section of the configuration; wanted: values by options. Raises MissingValueError."""
    if survey.profile == SENSOR:
        return sensor_lines(survey.node, survey)
    known = replace(wanted, rated_torque_nm=1.0, torque_constant_nm_per_a=1.0)  # of the joint file alone
    return drive_lines(JointProposal(joint, survey.node, survey, known, family))


def content(survey: Survey, problems: list[str], family: Family | None = None) -> dict[str, Any]:
    """Return everything for a program."""
    identity = {name: survey.numbers.get(key) for name, key in IDENTITY.items()}
    tpdos = [
        {
            "number": each.number,
            "cob_id": f"{each.cob_id:X}h",
            "on": each.on,
            "type": each.transmission_type,
            "objects": list(each.objects),
        }
        for each in survey.tpdos
    ]
    return {
        "schema": "jtq.probe/1",
        "device": {"node": survey.node, "profile": survey.profile, **survey.texts, **identity},
        "objects": {label(*key): value for key, value in sorted(survey.numbers.items())},
        "missing": [label(*key) for key in sorted(survey.missing)],
        "unmappable": [label(*key) for key in sorted(survey.unmappable)],
        "tpdos": tpdos,
        "notes": survey.notes,
        "problems": problems,
        "family": None if family is None else family.name,
    }


def _object(key: Key, value: str) -> str:
    return f"  {label(*key):<8} {value:<12} {_NAMES.get(key, '')}".rstrip()


def _value(key: Key, value: int) -> str:
    """Return a number; a code in hexadecimal."""
    return f"{value:0{_CODES[key[0]]}X}h" if key[0] in _CODES else str(value)


def text(
    survey: Survey,
    problems: list[str],
    family: Family | None = None,
    wanted: Wanted = NOTHING,
    joint: int = 1,
) -> str:
    """Return everything for people."""
    lines = [f"node {survey.node}: {description(survey)}", *survey.notes]
    if family is not None:
        lines.append(f"profile {family.name}: {family.title} (docs/bus.md)")
    lines += [_object(key, _value(key, value)) for key, value in sorted(survey.numbers.items())]
    lines += [_object(key, "not there") for key in sorted(survey.missing)]
    lines.append("TPDOs as they are now (jtqd writes its own mapping at its start, where the drive lets it)")
    for each in survey.tpdos:
        kind = f"type {each.transmission_type}" if each.on else "off"
        lines.append(f"  {each.number}  {each.cob_id:X}h  {kind:<8}  {', '.join(each.objects) or 'nothing'}")
    if survey.profile in (DRIVE, SENSOR):
        try:
            own = section(survey, family, wanted, joint)
            lines += ["section of the configuration", *(f"  {line}" for line in own)]
        except MissingValueError as error:
            lines.append(f"no section of the configuration yet: {error}")
    if problems:
        lines += ["jtqd does not work with it yet:", *(f"  {line}" for line in problems)]
    return "\n".join(lines)


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
