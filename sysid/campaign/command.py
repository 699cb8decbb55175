"""`jtq campaign`: options, the plan, the dry run, and the campaign itself (docs/fit.md)."""

from __future__ import annotations

import argparse
import hashlib
import json
import logging
import math
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from jtqd.drivers.bus_load import LIMIT, BusLoad
from jtqd.estimator.command_line import command_parser, count, natural, seconds
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.joint import Joint
from jtqd.estimator.text import counted, table_lines
from jtqd.models.files import shipped
from jtqd.sysid.campaign.bench import (
    EXACT_TIME,
    EXACT_TIME_BUS,
    Bench,
    BenchConfig,
    ExactTimeError,
    ProcessError,
    emulated_bench,
    exact_time_ready,
    in_exact_time,
    run_in_exact_time,
    unix_bus,
)
from jtqd.sysid.campaign.runner import (
    BETWEEN_RUNS_S,
    LONGEST_INTERPOLATED_S,
    Outcome,
    Reporter,
    attempt,
    clock_text,
    go_through,
)
from jtqd.sysid.campaign.state import DONE, CampaignDirectory, StateError
from jtqd.sysid.motion.setpoints import Limits, Setpoints, Timing
from jtqd.sysid.motion.shell import stop_signals
from jtqd.sysid.planner.campaigns import (
    KINDS,
    OnTried,
    Pair,
    Scale,
    Unit,
    check_joints,
    make_plan_of,
    parsed_limits,
    range_of,
    seed_of,
    tightest,
    unit_lines,
    units_of,
    with_limits,
)
from jtqd.sysid.planner.plan import DEFAULT_LIMITS, Plan, check_plan, load_plan, travel_rad
from jtqd.sysid.progress import bar

EMULATED: Final = "sim"
PLANT: Final = "campaign_plant.yaml"
EMULATED_TIMING: Final = Timing(
    sync_lost_s=LONGEST_INTERPOLATED_S, late_s=LONGEST_INTERPOLATED_S, stale_cycles=50
)
"""Nothing can break on the emulated bench: the motion goes on over gaps that can be interpolated."""
LIMIT_NAMES: Final = tuple(item.name for item in fields(Limits) if item.name != "position_rad")
_SCALING: Final = ("runs", "seconds", "hold_s", "seed", "evaluations", "quick")
_LONG_SEARCH: Final = 20_000
"""Motions evaluated in about 4 s."""
_LATE: Final = (
    "runs were lost because this machine was late: give it SCHED_FIFO (root, or ulimit -r 80); see jtq doctor"
)
_TOO_BUSY: Final = f"{_LATE}; or in exact time, however busy the machine is: --bus {EXACT_TIME}"
_MASTER_GONE: Final = "fault 8130h"
"""Drives watch jtqd's heartbeat (1016h:1): after jtqd's end with the run before they stand in this fault, powered off."""
_EXAMPLES: Final = """examples:
  jtq campaign efficiency --dry-run
  jtq campaign efficiency --bus sim --out campaigns/efficiency
  jtq campaign excitation --bus can0 --config arm.yaml --out campaigns/excitation
  jtq campaign my.plan.yaml --bus can0 --config arm.yaml --out campaigns/mine
  jtq campaign excitation --bus can2 --config arm.yaml --limits 3:travel_rad=-1:1,velocity_rad_s=1 --out campaigns/arm"""


def parser() -> argparse.ArgumentParser:
    """Return the options; `_usage_error` checks their combination."""
    made = command_parser(
        "jtq campaign",
        "Drive the joints of a bus through a campaign of runs, record and check each; continue an interrupted\n"
        "campaign. Joints on a towing bench drive each other, any other joint is moved alone while the rest is held.",
        _EXAMPLES,
    )
    add = made.add_argument
    add("plan", metavar="PLAN", help="efficiency, excitation, validate, or a plan file (jtq.plan/1)")
    add(
        "--bus",
        help="can0, unix:PATH, sim (the emulated bench), sim:BUS (the same on that bus), or exact (the same in exact time, "
        "however busy this machine is)",
    )
    add("--out", type=Path, metavar="DIR", help="the campaign's directory; created if missing")
    add("--dry-run", action="store_true", help="print the plan, its length and the bus load, without motion")
    add(
        "--config",
        "--joint-config",
        type=Path,
        metavar="FILE",
        help="configuration of jtqd: nodes and joint files (default: the shipped bench)",
    )
    add(
        "--limit",
        action="append",
        type=_limit,
        default=[],
        metavar="NAME=VALUE",
        help=f"another limit than the plan's: {', '.join(LIMIT_NAMES)} (temperature_c=none: not supervised)",
    )
    add(
        "--limits",
        action="append",
        type=_motion_limits,
        default=[],
        metavar="[N:]NAME=VALUE,...",
        help="where joint N (default: each) may go when it is moved alone: travel_rad=LOW:HIGH, velocity_rad_s, "
        "acceleration_rad_s2, torque_nm (default: motion_limits of the joint file)",
    )
    add(
        "--towing",
        action="append",
        type=_pair,
        default=[],
        metavar="A,B",
        help="joints A and B are coupled on a towing bench (default: those that share a channel of the torque sensor)",
    )
    add("--keep-going", action="store_true", help="continue with the next run after a limit was exceeded")
    add("--json", action="store_true", help="print the result (or the plan) as JSON")
    add("--plant", type=Path, metavar="FILE", help=f"with --bus sim: bench to emulate (default {PLANT})")
    size = made.add_argument_group("size of a named campaign").add_argument
    size("--quick", action="store_true", help="small campaign: every kind of run, few of each")
    size("--runs", type=count, metavar="N", help="Fourier runs (default 24)")
    size("--seconds", type=seconds, metavar="S", help="length of a Fourier run (default 24; validate 12)")
    size("--hold", dest="hold_s", type=seconds, metavar="S", help="hold of a constant point (default 2.1)")
    size(
        "--seed", type=natural, default=0, metavar="N", help="of trajectories and emulated bench (default 0)"
    )
    size("--evaluations", type=count, metavar="N", help="motions evaluated by each search, per trajectory")
    return made


def _usage_error(options: argparse.Namespace) -> str:
    """Return the error in the combination of options, or "". Raises ConfigError for a plan file that cannot be read."""
    if options.plan not in KINDS:
        if not options.plan.endswith((".yaml", ".yml")):
            return f"found plan {options.plan!r}, expected {', '.join(KINDS)} or a .yaml file"
        given = [name for name in _SCALING if name != "seed" and getattr(options, name) not in (None, False)]
        if given:
            return f"--{given[0].removesuffix('_s')} belongs to {', '.join(KINDS)}, not for a plan file"
    if options.plant is not None and not emulated(options.bus):
        return "--plant requires --bus sim"
    if options.plan not in KINDS:
        load_plan(Path(options.plan))
    if not options.dry_run and (options.bus is None or options.out is None):
        missing = "--bus" if options.bus is None else "--out"
        return f"{missing} is missing, for example --bus sim --out campaigns/{Path(options.plan).stem}"
    return ""


def emulated(bus: str | None) -> bool:
    """Return whether the campaign runs on the emulated bench."""
    return bus is not None and (bus in (EMULATED, EXACT_TIME) or bus.startswith(f"{EMULATED}:"))


def recipe(options: argparse.Namespace, joints: Sequence[Joint]) -> dict[str, Any]:
    """Return the inputs of the plan as plain values: the same recipe is the same plan. Raises ConfigError."""
    limits = {name: None if math.isinf(value) else value for name, value in options.limit}
    towing = {"towing": [list(pair) for pair in options.towing]} if options.towing else {}
    files = {"joints_sha256": hashlib.sha256(repr(tuple(joints)).encode()).hexdigest()}
    if options.plan not in KINDS:
        plan = load_plan(Path(options.plan))
        alone = any(run.current_joint is None for run in plan.runs)  # limits from the joint files
        return {"plan_sha256": plan.sha256, "limits": limits, **towing, **(files if alone else {})}
    return {
        "kind": options.plan,
        **{name: getattr(options, name) for name in _SCALING},
        "limits": limits,
        **files,
        **towing,
    }


def _scale_of(options: argparse.Namespace) -> Scale:
    scale = {name: getattr(options, name) for name in _SCALING}
    return Scale(**scale, limits=replace(DEFAULT_LIMITS, **dict(options.limit)))


def wanted_plan(
    options: argparse.Namespace,
    joints: Sequence[Joint],
    units: Sequence[Unit],
    on_progress: OnTried | None = None,
) -> Plan:
    """Read or make the plan; `joints`, `units` are those of the bench. Raises ConfigError."""
    if options.plan in KINDS:
        return make_plan_of(options.plan, units, joints, _scale_of(options), on_progress)
    plan = load_plan(Path(options.plan))
    plan = replace(plan, limits=replace(plan.limits, **dict(options.limit)))
    try:
        check_joints(plan, units)
        alone = {}
        for number in sorted({run.velocity_joint for run in plan.runs if run.current_joint is None}):
            own = range_of(number, joints[number - 1], plan.limits).limits
            alone[number] = tightest(plan.alone[number], own) if number in plan.alone else own
    except ConfigError as error:
        raise ConfigError(f"{options.plan}: {error}") from None
    return replace(plan, alone=alone)


def _bench_of(options: argparse.Namespace) -> tuple[BenchConfig, tuple[Unit, ...]]:
    """Return the bench with --limits in its joints, and the units of joints that move together. Raises ConfigError."""
    config = BenchConfig.load(options.config)
    joints = list(config.joints)
    for number, given in options.limits:
        if number is not None and number > len(joints):
            raise ConfigError(f"--limits {number}: found no joint {number} in {config.path}")
        for place in range(len(joints)) if number is None else (number - 1,):
            joints[place] = with_limits(joints[place], given)
    units = units_of(config.channels, config.sensor is not None, options.towing)
    return replace(config, joints=tuple(joints)), units


# Types of the options, which raise argparse.ArgumentTypeError


def _motion_limits(text: str) -> tuple[int | None, dict[str, Any]]:
    """[N:]NAME=VALUE,..."""
    head, colon, rest = text.partition(":")
    number = int(head) if colon and head.isdecimal() else None
    if number == 0:
        raise argparse.ArgumentTypeError("found joint 0, expected 1 to 4")
    try:
        return number, parsed_limits(text if number is None else rest)
    except ConfigError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _pair(text: str) -> Pair:
    """A,B"""
    one, _, two = text.partition(",")
    if not (one.isdecimal() and two.isdecimal()) or int(one) == int(two):
        raise argparse.ArgumentTypeError(f"found {text!r}, expected two joints like 1,2")
    return int(one), int(two)


def _limit(text: str) -> tuple[str, float]:
    """NAME=VALUE"""
    name, _, value = text.partition("=")
    if name not in LIMIT_NAMES:
        raise argparse.ArgumentTypeError(f"found {name!r}, expected one of {', '.join(LIMIT_NAMES)}")
    if name == "temperature_c" and value == "none":
        return name, math.inf
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if not 0.0 < number < math.inf:
        raise argparse.ArgumentTypeError(f"found {name}={value}, expected a number > 0")
    return name, number


def plan_notes(options: argparse.Namespace, units: Sequence[Unit], plan: Plan) -> list[str]:
    """Return lines on the runs of each unit, or why it has none; nothing for the measured towing bench of joints 1 and 2."""
    if [unit.joints for unit in units] == [(1, 2)] and units[0].measured:
        return []
    kind = options.plan if options.plan in KINDS else ""
    moved = {run.joints for run in plan.runs}
    lines = unit_lines(
        [unit for unit in units if kind or unit.joints in moved],
        lambda unit: (kind and unit.refusal(kind)) or unit.purpose,
    )
    for number, limits in sorted(plan.alone.items()):
        low, high = limits.position_rad
        most = f"{limits.velocity_rad_s:g} rad/s, {limits.current_a:g} A, {limits.torque_nm:g} Nm"
        lines.append(
            f"joint {number} alone: {low:g} to {high:g} rad, {most}; a run that does not fit where it stands begins at "
            f"{0.5 * (low + high):g} rad; the other joints are held"
        )
    if plan.alone:
        lines.append(
            "after each run and every stop all drives are off: a joint that carries a load needs a brake"
        )
    return lines


def dry_run_content(
    plan: Plan, setpoints: Mapping[str, Setpoints], load: BusLoad, notes: Sequence[str]
) -> dict[str, Any]:
    """Return runs, times and bus load of a campaign (jtq.campaign_plan/1)."""
    motion_s = sum(points.duration_s for points in setpoints.values())
    return {
        "schema": "jtq.campaign_plan/1",
        "name": plan.name,
        "plan_sha256": plan.sha256,
        "runs": [
            {
                "run": run.name,
                "velocity_joint": run.velocity_joint,
                "current_joint": run.current_joint,
                "segments": len(run.segments),
                "seconds": round(points.duration_s, 3),
                "peak_velocity_rad_s": round(float(np.abs(points.velocity_rad_s).max()), 4),
                "peak_current_a": round(float(np.abs(points.current_a).max()), 4),
                "travel_rad": round(travel_rad(points), 4),
            }
            for run in plan.runs
            for points in [setpoints[run.name]]
        ],
        "motion_s": round(motion_s, 3),
        "expected_s": round(motion_s + BETWEEN_RUNS_S * len(setpoints), 1),
        "bus_load_worst": load.worst,
        "bus_load_limit": LIMIT,
        "units": list(notes),
    }


def dry_run_text(content: Mapping[str, Any], limits: Limits, load: BusLoad) -> str:
    """Return `dry_run_content` for people."""
    table = [["run", "velocity joint", "segments", "seconds", "peak rad/s", "peak A", "travel rad"]]
    table += [
        [
            row["run"],
            f"{row['velocity_joint']}{' alone' if row['current_joint'] is None else ''}",
            str(row["segments"]),
            f"{row['seconds']:.1f}",
            f"{row['peak_velocity_rad_s']:.2f}",
            f"{row['peak_current_a']:.2f}",
            f"{row['travel_rad']:.1f}",
        ]
        for row in content["runs"]
    ]
    warmest = f"{limits.temperature_c:g} °C" if math.isfinite(limits.temperature_c) else "not supervised"
    lines = [
        *table_lines(table),
        f"{counted(len(content['runs']), 'run')}, {clock_text(content['motion_s'])} of motion, about "
        f"{clock_text(content['expected_s'])} in all",
        f"limits: {limits.current_a:g} A, {limits.velocity_rad_s:g} rad/s, {limits.torque_nm:g} Nm, "
        f"{limits.travel_rad:g} rad, temperature {warmest}",
        f"bus load {load.worst:.1%} in the worst case, {load.worst * load.capacity_bits:.0f} of {load.capacity_bits:.0f} "
        f"bits in a cycle, limit {LIMIT:.0%}",
        *content["units"],
    ]
    return "\n".join(lines)


def main(argv: list[str]) -> int:
    """Plan and run; exit status 0 done, 1 failure or ended early, 2 usage, 3 done with findings."""
    options = parser().parse_args(argv)
    try:
        problem = _usage_error(options)
        if problem:
            print(f"jtq campaign: {problem}", file=sys.stderr)
            return 2
        return _dry_run(options) if options.dry_run else _campaign(options, argv)
    except (ConfigError, StateError, ProcessError) as error:
        print(f"jtq campaign: {error}", file=sys.stderr)
    except OSError as error:
        where = error.filename or options.out or "output"
        print(f"jtq campaign: {where}: {error.strerror or error}", file=sys.stderr)
    return 1


def _checked(plan: Plan, options: argparse.Namespace, config: BenchConfig) -> dict[str, Setpoints]:
    """Return the set-points of a plan that can be driven. Raises ConfigError."""
    try:
        setpoints = check_plan(plan)
    except ConfigError as error:
        raise ConfigError(f"{options.plan}: {error}") from None
    config.check_temperature(plan.limits.temperature_c)
    return setpoints


def _make_plan(options: argparse.Namespace, config: BenchConfig, units: Sequence[Unit]) -> Plan:
    """Return the plan; a search of trajectories shows its progress."""
    if options.plan != "excitation":
        return wanted_plan(options, config.joints, units)
    total = sum(len(unit.joints) == 2 for unit in units) * _scale_of(options).motions_tried
    if total > _LONG_SEARCH and not sys.stderr.isatty():
        print("jtq campaign: designing trajectories", file=sys.stderr, flush=True)
    with bar("designing trajectories", total) as advance:
        return wanted_plan(options, config.joints, units, advance)


def _dry_run(options: argparse.Namespace) -> int:
    config, units = _bench_of(options)
    load = config.load_with_commander()
    plan = _make_plan(options, config, units)
    setpoints = _checked(plan, options, config)
    content = dry_run_content(plan, setpoints, load, plan_notes(options, units, plan))
    print(json.dumps(content) if options.json else dry_run_text(content, plan.limits, load))
    return 0


def _campaign(options: argparse.Namespace, argv: Sequence[str], *, exact_too: bool = True) -> int:
    """Run the campaign; exact_too: runs that real time loses on the emulated bench may go on in exact time."""
    config, units = _bench_of(options)
    config.load_with_commander()  # refuses a configuration that does not fit the bus
    if options.bus == EXACT_TIME:
        if not in_exact_time():
            return run_in_exact_time(argv, options.out)
        options.bus = EXACT_TIME_BUS
    exact_next = exact_too and options.bus == EMULATED and exact_time_ready()
    made_from = recipe(options, config.joints)
    directory = CampaignDirectory(options.out)
    try:
        plan = directory.same_recipe(made_from) or _make_plan(options, config, units)
        setpoints = _checked(plan, options, config)
        directory.begin(plan, made_from)
        for line in plan_notes(options, units, plan):
            print(f"jtq campaign: {line}", file=sys.stderr)
        outcome = _run(options, config, plan, setpoints, directory, exact_next=exact_next)
    finally:
        directory.close()
    if outcome.late:
        print(
            f"jtq campaign: {outcome.ended}: this machine is too busy for real time; the remaining runs take place in "
            "exact time, in the bench kernel",
            file=sys.stderr,
            flush=True,
        )
        try:
            return run_in_exact_time(argv, options.out)
        except ExactTimeError as error:
            print(f"jtq campaign: {error}; in real time again", file=sys.stderr)
            return _campaign(options, argv, exact_too=False)
    print(json.dumps(outcome.content()) if options.json else outcome.text())
    if outcome.short_of_time:
        print(f"jtq campaign: {_TOO_BUSY if emulated(options.bus) else _LATE}", file=sys.stderr)
    return outcome.exit_status


def _run(
    options: argparse.Namespace,
    config: BenchConfig,
    plan: Plan,
    setpoints: dict[str, Setpoints],
    directory: CampaignDirectory,
    *,
    exact_next: bool,
) -> Outcome:
    to_do = [setpoints[run.name].duration_s for run in plan.runs if directory.runs[run.name].status != DONE]
    if not to_do:
        return Outcome(directory.runs)
    done, bus, timing = len(plan.runs) - len(to_do), options.bus, None
    with ExitStack() as stack:
        taken = stack.enter_context(stop_signals())
        if emulated(bus):
            # a short path: the address of a unix socket holds 107 bytes
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="jtq-campaign-")))
            bus = bus.removeprefix(EMULATED).removeprefix(":") or unix_bus(folder)
            plant = options.plant or shipped(PLANT)
            # days of its own for every campaign, and for the remaining runs of one: validation runs on other days
            # than those of the training
            seed = seed_of(f"bench/{plan.name}", float(done), options.seed)
            sensor = config.sensor is not None
            stack.enter_context(emulated_bench(bus, folder, plant, seed, len(config.drives), sensor=sensor))
            timing = EMULATED_TIMING
        reporter = stack.enter_context(Reporter(to_do, len(plan.runs), done))
        stack.enter_context(_commander_log(reporter))
        place = Bench(bus, options.config, config, timing)
        motion = place.play(plan.limits_of, reporter.on_progress)
        return go_through(
            plan,
            setpoints,
            directory,
            reporter,
            lambda run, points: attempt(
                run, points, place, directory.path, motion=motion, stop_asked=lambda: bool(taken)
            ),
            keep_going=options.keep_going,
            exact_next=exact_next,
        )


@contextmanager
def _commander_log(reporter: Reporter) -> Iterator[None]:
    """Write the commander's log to the reporter, without the fault that jtqd's own end causes in every run."""

    class Lines(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            text = record.getMessage()
            if _MASTER_GONE not in text:
                reporter.write_line(text)

    logger, handler = logging.getLogger("jtqd.sysid.motion"), Lines()
    logger.addHandler(handler)
    propagate, logger.propagate = logger.propagate, False
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.propagate = propagate


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
