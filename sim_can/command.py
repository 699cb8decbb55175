"""`jtq sim`: the emulated bench on a bus."""

from __future__ import annotations

import argparse
import json
import os
import sys
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from jtqd.estimator.command_line import command_parser, count, natural, seconds
from jtqd.estimator.errors import ConfigError
from jtqd.sim_can.eds_entries import EdsChild

if TYPE_CHECKING:
    from jtqd.sim_can.plant_source import AnyPlant
    from jtqd.sim_can.source import Source

# what needs numpy is imported in functions: the EDS child reads meanwhile, and --help is quick

PROFILES = ("demo", "rest")  # those of `plant_file`, which would import numpy
PLANT = "campaign_plant.yaml"
"""The bench that the shipped models were identified on."""
PRIORITY = 40
"""Of SCHED_FIFO, where it is granted: the nodes stand for hardware, and come before everything but jtqd's loop (80)."""

EXAMPLES = """examples:
  jtq sim --bus vcan0                              two joints and a sensor on SocketCAN
  jtq sim --bus vcan0 --drives 4                   two such pairs side by side
  jtq sim --bus unix:/tmp/bench --bitrate 1000000  the same on a unix bus with a modelled wire
  jtq sim --bus vcan0 --play models/kinova_gen3/RunTrajectory1.csv.gz --joints 2,4
  jtq sim --cost                                   CPU time of one cycle on this machine
"""


def _joints(text: str) -> tuple[int, int]:
    try:
        first, second = (int(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not two joint numbers like 2,4") from None
    return first, second


def parser() -> argparse.ArgumentParser:
    """Return the options of `jtq sim`."""
    description = (
        "Emulated bench: two drives (nodes 1, 2) and a torque sensor (node 3) on a CAN bus, "
        "or one to four drives (nodes 1 to 4; with more than two the sensor is node 5)."
    )
    made = command_parser("jtq sim", description, EXAMPLES)
    made.add_argument(
        "--bus", help="SocketCAN interface (vcan0) or unix:PATH; without a hub on PATH the bench starts one"
    )
    made.add_argument(
        "--plant",
        type=Path,
        metavar="FILE",
        help=f"plant file (default: {PLANT}), bench file, or a joint file for two ideal joints",
    )
    made.add_argument(
        "--drives",
        type=int,
        choices=(1, 2, 3, 4),
        default=2,
        metavar="N",
        help="1 to 4 (default 2): pairs around a channel of the sensor; one without a partner turns a passive load",
    )
    made.add_argument("--no-sensor", action="store_true", help="a bench without torque sensor")
    made.add_argument(
        "--seed", type=natural, default=0, metavar="N", help="seed of noise and days (default 0)"
    )
    made.add_argument(
        "--profile",
        choices=PROFILES,
        help="motion until a master commands the drives (default: that of the plant file)",
    )
    made.add_argument("--play", type=Path, metavar="RUN", help="play a measured run instead of the plant")
    made.add_argument(
        "--columns", type=Path, metavar="FILE", help="column map of the run (default: columns.yaml beside it)"
    )
    made.add_argument(
        "--joints",
        type=_joints,
        metavar="A,B",
        help="joints of the run for drives 1, 2 (default: those with a joint file in the column map, else 1,2)",
    )
    made.add_argument(
        "--bitrate",
        type=count,
        metavar="B",
        help="bit rate of the wire modelled by the bench's hub [bit/s]",
    )
    made.add_argument("--duration", type=seconds, metavar="S", help="end after S seconds")
    made.add_argument("--cost", action="store_true", help="print the CPU time of one cycle and exit")
    made.add_argument("--json", action="store_true", help="with --cost: print JSON")
    return made


def main(argv: list[str] | None = None) -> int:
    """Run `jtq sim`. Returns 0 done, 1 failure, 2 usage; bad input is one line on stderr."""
    from jtqd.drivers.frame_socket import BusError

    try:
        options = parser().parse_args(argv)
    except SystemExit as leave:
        return int(leave.code or 0)
    problem = _usage(options)
    if problem:
        print(f"jtq sim: {problem}", file=sys.stderr)
        return 2
    try:
        return _run(options)
    except (ConfigError, BusError) as error:
        print(f"jtq sim: {error}", file=sys.stderr)
        return 1
    except OSError as error:
        print(f"jtq sim: {error.filename or options.bus}: {error.strerror or error}", file=sys.stderr)
        return 1


def _usage(options: argparse.Namespace) -> str:
    """Return what is wrong with the combination of options; empty when nothing is."""
    if options.cost:
        return ""
    if options.bus is None:
        return "--bus is missing, for example --bus vcan0 or --bus unix:/tmp/bench"
    if options.play is None:
        if options.columns is not None or options.joints is not None:
            return "--columns and --joints require --play RUN"
    elif options.plant is not None or options.profile is not None or options.drives != 2:
        return "--plant, --profile and --drives cannot be used with --play RUN"
    return ""


def _run(options: argparse.Namespace) -> int:
    if options.cost:
        return _print_cost(options, _plant(options))
    child = EdsChild(options.drives)  # it reads while this process loads numpy and makes the plant
    try:
        if options.play is not None:
            sources, profile = [_played(options)], "rest"
        else:
            from jtqd.sim_can.plant_source import sources_of

            parameters = _plant(options)
            sources = sources_of(parameters, options.seed, options.drives)
            profile = options.profile or parameters.profile
    except BaseException:
        child.stop()
        raise
    child.take()
    from jtqd.sim_can.bench import Bench, run

    bench = Bench(sources[0], profile, sources[1:], with_sensor=not options.no_sensor)
    with suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    return run(options.bus, bench, options.bitrate, options.duration)


def _plant(options: argparse.Namespace) -> AnyPlant:
    from jtqd.models.files import shipped
    from jtqd.sim_can.plant_source import load_any_plant

    return load_any_plant(options.plant or shipped(PLANT))


def _played(options: argparse.Namespace) -> Source:
    from jtqd.sim_can.play import columns_beside, open_play

    source = open_play(options.play, options.columns or columns_beside(options.play), options.joints)
    for note in source.notes:
        print(f"jtq sim: {note}", file=sys.stderr)
    return source


def _print_cost(options: argparse.Namespace, parameters: AnyPlant) -> int:
    from jtqd.sim_can.bench import measure

    cost = measure(parameters)
    if options.json:
        print(json.dumps(asdict(cost)))
        return 0
    rows = (
        (f"plant step of 1 ms: two joints, drives' loops, {cost.substeps} substeps", cost.plant_step_us),
        ("  with encoders, noise and sensor", cost.source_us),
        ("whole SYNC: the above, state machines, five TPDOs packed", cost.sync_us),
    )
    for text, microseconds in rows:
        print(f"{text:66}{microseconds:7.1f} us")
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
