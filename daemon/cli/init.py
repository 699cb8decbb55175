"""`jtq init`: write a first configuration and joint files for a bench, and list every guess in them.

The devices are read on the bus (nothing is written to them) or from EDS files; a value that neither has is an option, or a
question on a terminal. The files use method `tob`, which needs no fitted data, and are read as jtqd does before they stay.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from jtqd.daemon.bus.boot import bus_load_of
from jtqd.daemon.cli.proposal import (
    OPTIONS,
    JointProposal,
    MissingValueError,
    UsageError,
    Wanted,
    config_text,
    description,
    eds_survey,
    family_of,
    joint_text,
    merged,
    sensor_problems,
    surveyed,
)
from jtqd.daemon.config import MAX_NODE_ID, load_config
from jtqd.daemon.profiles import names as profile_names
from jtqd.drivers import nmt
from jtqd.drivers.boot import Heard, interval_us, listen
from jtqd.drivers.bus_load import LIMIT, BusLoadError
from jtqd.drivers.drive import drive_layout
from jtqd.drivers.frame_socket import BusError
from jtqd.drivers.object_dictionary import EdsError, read_eds
from jtqd.drivers.pdo import EVERY_SYNC, SYNC_COB_ID, TPDO_BASES, Tpdo
from jtqd.drivers.survey import DRIVE, SENSOR, BusSurvey, Survey
from jtqd.estimator.command_line import command_parser, count, seconds
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.files import write_whole
from jtqd.estimator.text import counted

MAX_JOINTS = 4
_PERIODS_US = (1000, 2000, 4000, 5000, 10_000)
_EXAMPLES = """examples:
  jtq init --bus can0 --out arm                        look on the bus, ask for missing values
  jtq init --bus can0 --out arm --node 5 --gear-ratio 101 --rated-torque 28
  jtq init --from-eds drive.eds --node 5 --node 6 --gear-ratio 101 --out arm     before the bus is there
  jtq init --bus can0 --out arm --gear-ratio 101 --gear-ratio 51                 one value for each joint
  jtq init --bus can0 --listen 10 --from-eds drive.dcf --gear-ratio 101 --out arm     beside a master: only listen
  jtq init --from-csv swing_*.csv                      no bus: column map and joint file for jtq diagnose

Options about joints may be given once for all joints, or once for each in the order of --node.
Nothing is written to a device. A bus with SYNC is refused without --listen: its master reads by SDO, too.

exit status: 0 the files are there and jtqd can use them, 1 failure, 2 usage or something missing,
3 the files are there, and the devices lack what this version of jtqd needs"""


def node_id(text: str) -> int:
    """Parse a node-ID. Raises argparse.ArgumentTypeError."""
    if not text.isdecimal() or not 1 <= int(text) <= MAX_NODE_ID:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected a node-ID from 1 to {MAX_NODE_ID}")
    return int(text)


def _name(text: str) -> str:
    if not re.fullmatch(r"\w[\w.-]*", text) or text.startswith("joint_"):
        raise argparse.ArgumentTypeError(
            f"found {text!r}, expected letters, digits, . _ -, and not joint_..."
        )
    return text


def _sensor(text: str) -> int:
    return 0 if text == "none" else node_id(text)


def _positive(text: str) -> float:
    with suppress(ValueError):
        if 0.0 < (value := float(text)) < 1e9:
            return value
    raise argparse.ArgumentTypeError(f"found {text!r}, expected a number above 0")


def _count(text: str) -> int:
    """Return a whole number that fits an object of 32 bits."""
    number = count(text)
    if number >= 2**31:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected a whole number below {2**31}")
    return number


_VALUES: Mapping[str, tuple[Callable[[str], float], str, str]] = {
    "gear_ratio": (_positive, "G", "motor revolutions per joint revolution"),
    "rated_torque_nm": (_positive, "NM", "rated torque of the joint [Nm]"),
    "torque_constant_nm_per_a": (_positive, "KT", "of the motor [Nm/A]"),
    "rated_current_a": (_positive, "A", "of the motor [A], for 6075h"),
    "encoder_counts": (_count, "N", "counts per revolution of the motor, all edges"),
    "link_encoder_counts": (_count, "N", "counts per revolution of the joint, at the link"),
}
"""Field of `Wanted` -> type, metavar and help of its option."""
_OF_JOINT_FILE = ("rated_torque_nm", "torque_constant_nm_per_a")


def parser() -> argparse.ArgumentParser:
    """Return the arguments of `jtq init`."""
    made = command_parser(
        "jtq init",
        "Write a first configuration and joint files that run at once, and list the guesses in them.",
        _EXAMPLES,
    )
    add = made.add_argument
    add("--bus", metavar="BUS", help="look at the devices on this bus: can0, or unix:PATH")
    tables = "no bus: propose a column map and joint files for these tables (its own options: --from-csv FILE --help)"
    add("--from-csv", type=Path, nargs="+", metavar="FILE", help=tables)
    eds = "EDS or DCF of the drives (one for all, or one for each)"
    add("--from-eds", type=Path, action="append", metavar="FILE", help=eds)
    node = (
        f"node-ID of a drive; again for the next joint, at most {MAX_JOINTS} (default: drives on the bus; with files alone "
        "that of a DCF, else 1, 2 as a guess)"
    )
    text = "with --bus: send nothing, listen for S seconds; for role guest beside another master"
    add("--listen", type=seconds, metavar="S", help=text)
    add("--node", type=node_id, action="append", metavar="N", help=node)
    add("--sensor", type=_sensor, metavar="N|none", help="node-ID of the torque sensor (default: as found)")
    of_sensor = "joint whose torque the sensor measures (default: all)"
    add("--sensor-joint", type=int, action="append", metavar="J", help=of_sensor)
    add_values(made, action="append")
    bitrate = "of the bus [bit/s] (default: that of a DCF, else 1000000)"
    add("--bitrate", type=_count, metavar="B", help=bitrate)
    add(
        "--name",
        type=_name,
        default="jtqd",
        help="of the configuration: NAME.yaml (default jtqd; can0 for jtqd@can0)",
    )
    profile = "profile of the drives' family (default: by their vendor-ID; docs/bus.md)"
    add("--profile", choices=[*profile_names(), "none"], help=profile)
    add("--out", type=Path, required=True, metavar="DIR", help="directory for the files")
    add("--force", action="store_true", help="replace files that are there")
    add("--no-questions", action="store_true", help="ask nothing, also on a terminal")
    add("--json", action="store_true", help="print as JSON; asks nothing")
    return made


def add_values(made: argparse.ArgumentParser, *, action: str = "store", of_joint: bool = True) -> None:
    """Add the options for values that a drive does not have (`Wanted`); of_joint: also those of the joint file."""
    for name, (kind, metavar, text) in _VALUES.items():
        if of_joint or name not in _OF_JOINT_FILE:
            made.add_argument(OPTIONS[name], dest=name, type=kind, action=action, metavar=metavar, help=text)
    encoders = "the joints have no link encoder (default: as the drives have 60E4h:1)"
    made.add_argument("--one-encoder", action="store_true", help=encoders)


def main(argv: list[str]) -> int:
    """Write the files; returns the exit status."""
    options = parser().parse_args(argv)
    try:
        if options.from_csv:  # `jtq` calls another module for it
            raise UsageError("--from-csv: write it in full, without options of a bus")
        return _run(options)
    except (UsageError, MissingValueError) as error:
        print(f"jtq init: {error}", file=sys.stderr)
        return 2
    except (BusError, EdsError, ConfigError, BusLoadError, ValueError) as error:
        print(f"jtq init: {error}", file=sys.stderr)
        return 1


def _run(options: argparse.Namespace) -> int:
    for name in (f"{options.name}.yaml", *(f"joint_{number}.yaml" for number in range(1, MAX_JOINTS + 1))):
        if not options.force and (options.out / name).exists():
            raise UsageError(f"{options.out / name}: exists; --force replaces it")
    found = _devices(options)
    options.bitrate = found.bitrate
    joints = _joints(options, found)
    sensor = None if found.sensor is None else found.surveys.get(found.sensor)
    text = partial(
        config_text,
        joints,
        bus=options.bus or "a bus that was not surveyed",
        bitrate=options.bitrate,
        sensor_node=found.sensor,
        sensor=sensor,
        measured=_measured(options, found),
        taken={cob_id & 0x7F for cob_id in found.heard},
    )
    if found.heard:
        fixed_us = 50 * round((interval_us(found.heard[SYNC_COB_ID]) or 0.0) / 50)
        files, period_us = _write(
            options,
            joints,
            lambda period_us: _guest_text(options, found, text(period_us=period_us)),
            (fixed_us,),
        )
    else:
        files, period_us = _write(options, joints, text)
    report = {
        "files": [str(each) for each in files],
        "period_us": period_us,
        "notes": [*found.notes, *(note for joint in joints for note in _notes(joint))],
        "guesses": [each for joint in joints for each in joint.guesses],
        "problems": [
            *(each for joint in joints for each in joint.problems),
            *sensor_problems(sensor),
            *(each for each in found.notes if "DOES NOT FIT" in each),
        ],
        "next": f"jtqd --bus {options.bus or 'can0'} --config {files[-1]} --record logs",
    }
    print(json.dumps(report) if options.json else _text(report))
    return 3 if report["problems"] else 0


def _notes(joint: JointProposal) -> list[str]:
    """Return one line for each quantity and TPDO that differs from jtqd's own."""
    notes = [f"objects.{name}: {each.text} ({each.origin})" for name, each in joint.objects.items()]
    if joint.kept.tpdos:
        notes.append(
            f"tpdos: {counted(len(joint.kept.tpdos), 'TPDO')} of the drive ({joint.kept.why}); "
            "without this section jtqd maps its own, where the drive lets it"
        )
    return [f"joint {joint.number}: {note}" for note in notes]


def _text(report: dict[str, Any]) -> str:
    lines = [
        *report["notes"],
        f"wrote {', '.join(report['files'])}: method tob, {1e6 / report['period_us']:g} Hz",
    ]
    for title, key in (("still a guess:", "guesses"), ("jtqd does not work with it yet:", "problems")):
        if report[key]:
            lines += [title, *(f"  {line}" for line in report[key])]
    return "\n".join([*lines, f"next: {report['next']}"])


# ---- devices ----


class _Devices(NamedTuple):
    """Node-IDs of the drives in the order of the joints (guessed: those for which there is but an EDS), of the sensor."""

    nodes: list[int]
    sensor: int | None
    surveys: dict[int, Survey]
    notes: list[str]
    guessed: set[int]
    heard: Heard
    bitrate: int


def _devices(options: argparse.Namespace) -> _Devices:
    """Return the devices by options, bus and EDS. Raises UsageError, BusError, EdsError."""
    nodes, guessed, bitrate = _of_files(options)
    if len(set(nodes)) != len(nodes):
        raise UsageError(f"--node: {nodes} names a node twice")
    surveys: dict[int, Survey] = {}
    notes: list[str] = []
    sensor = options.sensor
    heard: Heard = {}
    if options.listen is not None:
        heard, nodes = _listen(options)
    elif options.bus is not None:
        surveys = _on_the_bus(options.bus, nodes, sensor, options.profile)
        drives = [node for node, each in surveys.items() if each.profile == DRIVE]
        notes += [f"node {node}: {description(each)}" for node, each in surveys.items()]
        if sensor is None:
            sensor = next((node for node, each in surveys.items() if each.profile == SENSOR), None)
        if not nodes:
            nodes = drives[:MAX_JOINTS]
            notes += [f"node {node}: left out, give --node to choose" for node in drives[MAX_JOINTS:]]
        for node in nodes:
            if node not in surveys and not options.from_eds:
                raise UsageError(f"node {node} does not answer on {options.bus}{_others(surveys)}")
    if not nodes:
        where = f"no CiA 402 drive answers on {options.bus}" if options.bus else "no drive is known"
        raise UsageError(f"{where}: give --node{_others(surveys)}")
    if len(nodes) > MAX_JOINTS:
        raise UsageError(f"--node: {len(nodes)} drives, this version of jtqd has at most {MAX_JOINTS} joints")
    for node, path in zip(nodes, _each("--from-eds", options.from_eds, len(nodes)), strict=True):
        if path is not None:
            eds = eds_survey(path, node, options.profile)
            surveys[node] = merged(eds, surveys.get(node), path)
            notes.append(f"node {node}: {description(eds)}")
    if sensor and options.bus is not None and not heard and sensor not in surveys:
        raise UsageError(f"--sensor: node {sensor} does not answer on {options.bus}{_others(surveys)}")
    _check_profiles(nodes, sensor, surveys)
    notes += dict.fromkeys(note for each in surveys.values() for note in each.notes)
    notes += [
        f"node {node}: profile {family.name} ({family.title})"
        for node in nodes
        if (family := family_of(surveys.get(node), options.profile))
    ]
    notes += _heard_lines(heard, surveys)
    return _Devices(nodes, sensor or None, surveys, notes, guessed, heard, bitrate)


def _of_files(options: argparse.Namespace) -> tuple[list[int], set[int], int]:
    """Return nodes, those of them that are a guess, and the bit rate, by options and DCFs. Raises UsageError, EdsError."""
    nodes: list[int] = options.node or []
    files = [read_eds(path, 1) for path in options.from_eds or ()]
    rates = {each.bitrate for each in files if each.bitrate}
    if len(rates) > 1 and options.bitrate is None:
        raise UsageError(f"--from-eds: found bit rates {sorted(rates)}, expected one, or --bitrate")
    guessed: set[int] = set()
    if not nodes and options.bus is None:
        nodes = [each.node or number for number, each in enumerate(files, 1)]
        guessed = {node for node, each in zip(nodes, files, strict=True) if each.node is None}
    return nodes, guessed, options.bitrate or max(rates, default=1_000_000)


def _listen(options: argparse.Namespace) -> tuple[Heard, list[int]]:
    """Return what is heard on the bus, and the drives: as given, or all that send PDOs. Raises UsageError, BusError."""
    if options.bus is None:
        raise UsageError("--listen: expected with --bus")
    heard = listen(options.bus, options.listen)
    if interval_us(heard.get(SYNC_COB_ID, [])) is None:
        silent = f"no SYNC on {options.bus} within {options.listen:g} s"
        raise UsageError(f"--listen: {silent}: expected a bus in service, with its master")
    senders = sorted({cob_id & 0x7F for cob_id in heard if cob_id & 0x780 in TPDO_BASES})
    nodes = options.node or [node for node in senders if _fits(options, node, heard)]
    if not options.from_eds:
        print("\n".join(_heard_lines(heard, {})))
        raise UsageError(
            "--listen: the objects in a PDO cannot be heard: give --from-eds with the drives' DCF"
        )
    if not nodes:
        raise UsageError(
            f"--from-eds: it fits none of the nodes that send PDOs: {', '.join(map(str, senders))}"
        )
    return heard, nodes


def _fits(options: argparse.Namespace, node: int, heard: Heard) -> bool:
    """Return whether the one EDS or DCF given describes a node: all PDOs heard, and those that it sends at each SYNC."""
    if not options.from_eds or len(options.from_eds) > 1:
        return False
    survey = eds_survey(options.from_eds[0], node, options.profile)
    tpdos = [each for each in survey.tpdos if each.on]
    lengths = {each.cob_id: sum(word & 0xFF for word in each.words) // 8 for each in tpdos}
    found = {
        cob_id: {length for _, length in frames}
        for cob_id, frames in heard.items()
        if cob_id & 0x7F == node and cob_id & 0x780 in TPDO_BASES
    }
    cyclic = {each.cob_id for each in _cyclic(survey)}
    return cyclic <= found.keys() and all(each == {lengths.get(cob_id)} for cob_id, each in found.items())


def _cyclic(survey: Survey) -> list[Tpdo]:
    """Return the TPDOs that a node sends at each SYNC."""
    return [each for each in survey.tpdos if each.on and each.transmission_type == EVERY_SYNC]


def _heard_lines(heard: Heard, surveys: Mapping[int, Survey]) -> list[str]:
    """Return one line for each COB-ID that was heard: length, rate, and what it carries by the node's EDS or DCF."""
    lines = []
    for cob_id, frames in sorted(heard.items()):
        lengths = "/".join(str(each) for each in sorted({length for _, length in frames}))
        interval = interval_us(frames)
        rate = "a few" if interval is None else f"{1e6 / interval:.4g} Hz"
        lines.append(f"{cob_id:03X}h: {lengths} bytes, {rate}: {_carried(cob_id, lengths, surveys)}")
    for node, survey in surveys.items() if heard else ():
        silent = [each for each in _cyclic(survey) if each.cob_id not in heard]
        lines += [
            f"{each.cob_id:03X}h: DOES NOT FIT: TPDO{each.number} of node {node} is not heard"
            for each in silent
        ]
    return lines


def _carried(cob_id: int, lengths: str, surveys: Mapping[int, Survey]) -> str:
    """Return what a COB-ID is in the predefined connection set, and the objects that fit there."""
    node, base = cob_id & 0x7F, cob_id & 0x780
    if base not in TPDO_BASES:
        names = {0x080: "EMCY", 0x580: "SDO answer", 0x600: "SDO request", nmt.HEARTBEAT_BASE: "heartbeat"}
        return {0: "NMT", SYNC_COB_ID: "SYNC"}.get(cob_id) or f"{names.get(base, 'RPDO')} of node {node}"
    survey = surveys.get(node)
    described = [each for each in survey.tpdos if each.on and each.cob_id == cob_id] if survey else []
    if not described:
        own = [each.length for each in drive_layout(node) if each.cob_id == cob_id]
        fits = (
            "as long as jtqd's own layout" if lengths in map(str, own) else "another layout than jtqd's own"
        )
        return f"TPDO of node {node}, not described: {fits}"
    bits = sum(word & 0xFF for word in described[0].words)
    fits = "" if lengths == str(bits // 8) else f", DOES NOT FIT: {bits // 8} bytes expected"
    return f"TPDO{described[0].number} of node {node}: {', '.join(described[0].objects)}{fits}"


def _guest_text(options: argparse.Namespace, found: _Devices, text: str) -> str:
    """Return a configuration as that of a guest: role, and the EDS or DCF of each joint."""
    for number, path in enumerate(_each("--from-eds", options.from_eds, len(found.nodes)), 1):
        line = f"  file: joint_{number}.yaml\n"
        text = text.replace(line, f"{line}  eds: {path.resolve()}\n")
    return text.replace(
        "\nbitrate:", "\nrole: guest               # another master sends SYNC: docs/bus.md\nbitrate:"
    )


def _check_profiles(nodes: Sequence[int], sensor: int | None, surveys: Mapping[int, Survey]) -> None:
    for node in nodes:
        if node in surveys and surveys[node].profile != DRIVE:
            raise UsageError(f"node {node} is no CiA 402 drive: {description(surveys[node])}")
    if sensor is not None and sensor in surveys and surveys[sensor].profile != SENSOR:
        raise UsageError(f"--sensor: node {sensor} is no CiA 404 sensor: {description(surveys[sensor])}")


def _on_the_bus(bus: str, nodes: Sequence[int], sensor: int | None, profile: str | None) -> dict[int, Survey]:
    with closing(BusSurvey(bus)) as reader:
        wanted = {*nodes, *([sensor] if sensor else [])}
        there = reader.nodes() if not nodes or sensor is None else sorted(wanted)
        read = {node: surveyed(reader, node, profile) for node in there}
    return {node: each for node, each in read.items() if each is not None}


def _others(surveys: dict[int, Survey]) -> str:
    if not surveys:
        return ""
    return f"; there are {', '.join(f'{node} ({each.title})' for node, each in surveys.items())}"


def _measured(options: argparse.Namespace, found: _Devices) -> list[int]:
    """Return the joints whose torque the sensor measures. Raises UsageError."""
    numbers = list(range(1, len(found.nodes) + 1))
    if options.sensor_joint is None:
        return numbers if found.sensor is not None else []
    if found.sensor is None:
        raise UsageError("--sensor-joint: there is no sensor")
    measured: list[int] = options.sensor_joint
    if not set(measured) <= set(numbers):
        raise UsageError(f"--sensor-joint: found {measured}, expected among {numbers}")
    return measured


# ---- joints ----


def _each(option: str, values: list[Any] | None, count: int) -> list[Any]:
    """Return one value per joint. Raises UsageError."""
    if values is None:
        return [None] * count
    if len(values) not in (1, count):
        raise UsageError(
            f"{option}: given {len(values)} times, expected once or {count} times (for each joint)"
        )
    return values * count if len(values) == 1 else values


def _joints(options: argparse.Namespace, found: _Devices) -> list[JointProposal]:
    """Return the proposals; on a terminal, ask for missing values. Raises UsageError, MissingValueError."""
    count = len(found.nodes)
    columns = {field: _each(option, getattr(options, field), count) for field, option in OPTIONS.items()}
    ask = sys.stdin.isatty() and not options.no_questions and not options.json
    joints: list[JointProposal] = []
    for n, node in enumerate(found.nodes):
        survey = found.surveys.get(node)
        family = family_of(survey, options.profile)
        values = {name: column[n] for name, column in columns.items()}
        wanted = Wanted(**values, one_encoder=options.one_encoder)
        while len(joints) == n:
            try:
                joints.append(
                    JointProposal(n + 1, node, survey, wanted, family, node_guessed=node in found.guessed)
                )
            except MissingValueError as error:
                if not ask or not error.field:
                    raise
                answer: Any = _answer(error.why, error.field)
                wanted = replace(wanted, **{error.field: answer})
    return joints


def _answer(why: str, field: str) -> float:
    """Ask until a number comes. Raises UsageError at the end of input."""
    kind, _, _ = _VALUES[field]
    print(why, file=sys.stderr)
    while True:
        question = OPTIONS[field].removeprefix("--").replace("-", " ")
        print(f"{question}? ", end="", file=sys.stderr, flush=True)
        line = sys.stdin.readline()
        if not line:
            raise UsageError(f"no answer: give {OPTIONS[field]}")
        try:
            return kind(line.strip())
        except argparse.ArgumentTypeError as error:
            print(error, file=sys.stderr)


# ---- files ----


def _write(
    options: argparse.Namespace,
    joints: Sequence[JointProposal],
    text: Callable[..., str],
    periods_us: Sequence[int] = _PERIODS_US,
) -> tuple[list[Path], int]:
    """Write the files with the shortest period whose bus load fits; returns paths and period [us].

    text: of the configuration, by `period_us`. Files are written to a temporary directory first: those that jtqd refuses
    replace nothing. Raises ConfigError, BusLoadError.
    """
    directory: Path = options.out
    directory.mkdir(parents=True, exist_ok=True)
    names = [*(f"joint_{joint.number}.yaml" for joint in joints), f"{options.name}.yaml"]
    with tempfile.TemporaryDirectory(dir=directory, prefix=".jtq-init-") as temporary:
        files = [Path(temporary, each) for each in names]
        for path, joint in zip(files, joints, strict=False):
            path.write_text(joint_text(joint), encoding="utf-8")
        try:
            period_us = _fitting_period_us(files[-1], options.bitrate, text, periods_us)
        except ConfigError as error:
            raise ConfigError(str(error).replace(temporary, str(directory))) from None
        for path in files:
            write_whole(directory / path.name, path.read_bytes())
    return [directory / each for each in names], period_us


def _fitting_period_us(path: Path, bitrate: int, text: Callable[..., str], periods_us: Sequence[int]) -> int:
    for period_us in periods_us:
        path.write_text(text(period_us=period_us), encoding="utf-8")
        if bus_load_of(load_config(path)).worst <= LIMIT:
            return period_us
    raise ConfigError(f"{path}: at {bitrate} bit/s not even {1e6 / periods_us[-1]:g} Hz fit the bus")


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
