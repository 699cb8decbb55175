"""`jtq sim`: the emulated bench on a bus."""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

from jtqd.drivers.devices import SYNC_COB_ID, drive_tpdo1, drive_tpdo2, sensor_tpdo1
from jtqd.drivers.pdo import PdoMap
from jtqd.estimator.checked import ConfigError, count, natural, seconds
from jtqd.sim_can.bench import Bench
from jtqd.sim_can.eds_entries import EdsChild
from jtqd.sim_can.plant_file import PROFILES, PlantParameters
from jtqd.sim_can.plant_source import PlantSource
from jtqd.sim_can.source import Source

# What the bench costs: CPU time of a plant step and of a whole SYNC, measured in this process.


CYCLE_NS = 1_000_000
BLOCK = 50


@dataclass(frozen=True)
class Cost:
    """CPU time in microseconds per 1 ms cycle, medians over blocks of 50 cycles."""

    plant_step_us: float  # both joints with their drives' control loops
    source_us: float  # plant step with encoders, noise and sensor
    sync_us: float  # everything a SYNC does: source, state machines, five TPDOs packed
    substeps: int
    cycles: int

    def as_json(self) -> dict[str, float | int]:
        """Plain mapping for `--json`."""
        return asdict(self)


def map_pdos(bench: Bench) -> None:
    """Give the nodes the mapping that jtqd writes at boot, by SDO, and start them."""
    maps = [(node, pdo) for node in (1, 2) for pdo in (drive_tpdo1(node), drive_tpdo2(node))]
    for node, pdo in [*maps, (3, sensor_tpdo1(3))]:
        number = (pdo.cob_id - 0x80) // 0x100 - 1
        for index, subindex, value, size in _mapping_writes(0x1800 + number, pdo):
            request = bytes([0x23 | (4 - size) << 2]) + index.to_bytes(2, "little") + bytes([subindex])
            bench.on_frame(0x600 + node, request + value.to_bytes(4, "little"), 0, 0)
    bench.on_frame(0x000, b"\x01\x00", 0, 0)


def _mapping_writes(index: int, pdo: PdoMap) -> list[tuple[int, int, int, int]]:
    entries = [(index + 0x200, entry, word, 4) for entry, word in enumerate(pdo.words, 1)]
    return [
        (index, 1, 0xC000_0000 | pdo.cob_id, 4),
        (index + 0x200, 0, 0, 1),
        *entries,
        (index + 0x200, 0, len(pdo.words), 1),
        (index, 2, pdo.transmission_type, 1),
        (index, 1, 0x4000_0000 | pdo.cob_id, 4),
    ]


def measure(parameters: PlantParameters, cycles: int = 4000) -> Cost:
    """Run the demo motion for `cycles` SYNCs and measure; three benches, so that no part is a difference of
    two others.
    """
    full = Bench(PlantSource(parameters))
    map_pdos(full)
    stamps = [0]

    def sync() -> None:
        stamps[0] += CYCLE_NS
        full.on_frame(SYNC_COB_ID, b"\x01", stamps[0], stamps[0])

    whole = _median_us(sync, cycles)
    source = PlantSource(parameters)
    for drive, moving in enumerate(full.drives):
        source.command(drive, *moving._command())
    reading = _median_us(lambda: source.advance(0.001), cycles)
    plant = source.plant
    stepping = _median_us(lambda: plant.step(0.001), cycles)
    substeps = round(0.001 / plant.substep_s)
    return Cost(stepping, reading, whole, substeps, cycles)


def _median_us(call: object, cycles: int) -> float:
    assert callable(call)
    blocks = []
    for _ in range(max(1, cycles // BLOCK)):
        start = time.process_time_ns()
        for _ in range(BLOCK):
            call()
        blocks.append((time.process_time_ns() - start) / (BLOCK * 1000.0))
    return sorted(blocks)[len(blocks) // 2]


PLANT = "campaign_plant.yaml"
"""The bench that the shipped models were identified on."""

EXAMPLES = """examples:
  jtq sim --bus vcan0                              two joints and a sensor on SocketCAN
  jtq sim --bus unix:/tmp/bench --bitrate 1000000  the same on a unix bus with the wire modelled
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
    """Options of `jtq sim`."""
    made = argparse.ArgumentParser(
        prog="jtq sim",
        description="Emulated bench: two drives (nodes 1, 2) and a torque sensor (node 3) on a CAN bus.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    made.add_argument(
        "--bus", help="SocketCAN interface (vcan0) or unix:PATH; a unix bus without a hub gets one"
    )
    made.add_argument(
        "--plant",
        type=Path,
        metavar="FILE",
        help=f"plant file (default: {PLANT}), or a joint.yaml for two ideal joints",
    )
    made.add_argument("--seed", type=natural, default=0, metavar="N", help="seed of the noise (default 0)")
    made.add_argument(
        "--profile", choices=PROFILES, help="motion while no master commands (default: the plant file's)"
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
    made.add_argument("--bitrate", type=count, metavar="B", help="model the wire of an own hub, bit/s")
    made.add_argument("--duration", type=seconds, metavar="S", help="end after so many seconds")
    made.add_argument("--cost", action="store_true", help="measure the CPU time of one cycle and leave")
    made.add_argument("--json", action="store_true", help="with --cost: result as JSON")
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
    """What is wrong with the combination of options; empty when nothing is."""
    if options.cost:
        return ""
    if options.bus is None:
        return "--bus is missing, for example --bus vcan0 or --bus unix:/tmp/bench"
    if options.play is None:
        if options.columns is not None or options.joints is not None:
            return "--columns and --joints belong to --play RUN"
    elif options.plant is not None or options.profile is not None:
        return "--plant and --profile belong to the emulated plant, not to --play RUN"
    return ""


def _run(options: argparse.Namespace) -> int:
    from jtqd.models.files import shipped
    from jtqd.sim_can.plant_file import load_plant

    if options.cost:
        return _print_cost(options, load_plant(options.plant or shipped(PLANT)))
    child = EdsChild()  # reads while this process loads numpy and makes the plant
    try:
        if options.play is not None:
            source: Source = _played(options)
            profile = "rest"
        else:
            from jtqd.sim_can.plant_source import PlantSource

            parameters = load_plant(options.plant or shipped(PLANT))
            source = PlantSource(parameters, options.seed)
            profile = options.profile or parameters.profile
    except BaseException:
        child.stop()
        raise
    child.take()
    return _serve(options, source, profile)


def _played(options: argparse.Namespace) -> Source:
    from jtqd.sim_can.play import columns_beside, open_play
    from jtqd.sysid.runs.files import RunError

    try:
        source = open_play(options.play, options.columns or columns_beside(options.play), options.joints)
    except RunError as error:
        raise ConfigError(str(error)) from None
    for note in getattr(source, "notes", ()):
        print(f"jtq sim: {note}", file=sys.stderr)
    return source


def _serve(options: argparse.Namespace, source: Source, profile: str) -> int:
    from jtqd.sim_can.bench import Bench
    from jtqd.sim_can.bench_loop import run

    return run(options.bus, Bench(source, profile), options.bitrate, options.duration)


def _print_cost(options: argparse.Namespace, parameters: object) -> int:
    from jtqd.sim_can.plant_file import PlantParameters

    assert isinstance(parameters, PlantParameters)
    cost = measure(parameters)
    if options.json:
        print(json.dumps(cost.as_json()))
        return 0
    rows = (
        (f"plant step of 1 ms: two joints, drives' loops, {cost.substeps} substeps", cost.plant_step_us),
        ("  with encoders, noise and sensor", cost.source_us),
        ("whole SYNC: the above, state machines, five TPDOs packed", cost.sync_us),
    )
    for text, microseconds in rows:
        print(f"{text:66}{microseconds:7.1f} us")
    return 0
