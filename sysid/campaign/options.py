"""Options of `jtq campaign`, and the plan that they ask for."""

from __future__ import annotations

import argparse
import hashlib
import math
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, Final

from estimator.arguments import count, natural, seconds
from estimator.parameters import Joint
from sysid.campaign.fourier_runs import Tried
from sysid.campaign.plan import DEFAULT_LIMITS, Plan, load_plan
from sysid.campaign.plans import KINDS, Scale, make_plan
from sysid.motion.limits import Limits

EMULATED: Final = "sim"
PLANT: Final = "campaign_plant.yaml"
LIMIT_NAMES: Final = tuple(item.name for item in fields(Limits))
_SCALING: Final = ("runs", "seconds", "hold_s", "seed", "evaluations", "quick")
_EXAMPLES: Final = """examples:
  jtq campaign efficiency --dry-run
  jtq campaign efficiency --bus sim --out campaigns/efficiency
  jtq campaign excitation --bus can0 --config arm.yaml --out campaigns/excitation
  jtq campaign my.plan.yaml --bus can0 --config arm.yaml --out campaigns/mine"""


def parser() -> argparse.ArgumentParser:
    """All options; what goes together with what is the matter of `misuse`."""
    made = argparse.ArgumentParser(
        prog="jtq campaign",
        description="Drive both joints through a campaign of runs, record and check each; go on where it was interrupted.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = made.add_argument
    add("plan", metavar="PLAN", help="efficiency, excitation, validate, or a plan file (jtq.plan/1)")
    add("--bus", help="can0, unix:PATH, sim (the emulated bench), or sim:BUS (the same on that bus)")
    add("--out", type=Path, metavar="DIR", help="the campaign's directory; made if missing")
    add("--dry-run", action="store_true", help="print the plan, its length and the bus load; move nothing")
    add(
        "--config",
        "--joint-config",
        type=Path,
        metavar="FILE",
        help="configuration of jtqd: nodes and joint files (default: the bench that ships)",
    )
    add(
        "--limit",
        action="append",
        type=_limit,
        default=[],
        metavar="NAME=VALUE",
        help=f"another limit than the plan's: {', '.join(LIMIT_NAMES)} (temperature_c=none: not supervised)",
    )
    add("--keep-going", action="store_true", help="go on with the next run after a limit was exceeded")
    add("--json", action="store_true", help="print the result (or the plan) as JSON")
    add("--plant", type=Path, metavar="FILE", help=f"with --bus sim: bench to emulate (default {PLANT})")
    size = made.add_argument_group("size of a campaign that is not a file").add_argument
    size("--quick", action="store_true", help="a small one: every kind of run, few of each")
    size("--runs", type=count, metavar="N", help="Fourier runs (default 24)")
    size("--seconds", type=seconds, metavar="S", help="length of a Fourier run (default 24; validate 12)")
    size("--hold", dest="hold_s", type=seconds, metavar="S", help="hold of a constant point (default 2.1)")
    size(
        "--seed", type=natural, default=0, metavar="N", help="of trajectories and emulated bench (default 0)"
    )
    size("--evaluations", type=count, metavar="N", help="of the genetic algorithm, per trajectory")
    return made


def misuse(options: argparse.Namespace) -> str:
    """What is wrong with the combination of options; empty when nothing is."""
    if options.plan not in KINDS:
        if not options.plan.endswith((".yaml", ".yml")):
            return f"found plan {options.plan!r}, expected {', '.join(KINDS)} or a .yaml file"
        given = [name for name in _SCALING if name != "seed" and getattr(options, name) not in (None, False)]
        if given:
            return f"--{given[0].removesuffix('_s')} belongs to {', '.join(KINDS)}, not to a plan file"
    if options.plant is not None and not emulated(options.bus):
        return "--plant belongs to --bus sim"
    if not options.dry_run and (options.bus is None or options.out is None):
        missing = "--bus" if options.bus is None else "--out"
        return f"{missing} is missing, for example --bus sim --out campaigns/{Path(options.plan).stem}"
    return ""


def emulated(bus: str | None) -> bool:
    """Whether the campaign brings its own bench."""
    return bus is not None and (bus == EMULATED or bus.startswith(f"{EMULATED}:"))


def recipe(options: argparse.Namespace, joints: tuple[Joint, Joint]) -> dict[str, Any]:
    """What the plan is made from, as plain values; the same recipe is the same plan. Raises ConfigError."""
    limits = {name: None if math.isinf(value) else value for name, value in options.limit}
    if options.plan not in KINDS:
        return {"plan_sha256": load_plan(Path(options.plan)).sha256, "limits": limits}
    return {
        "kind": options.plan,
        **{name: getattr(options, name) for name in _SCALING},
        "limits": limits,
        "joints_sha256": hashlib.sha256(repr(joints).encode()).hexdigest(),
    }


def scale_of(options: argparse.Namespace, joints: tuple[Joint, Joint]) -> Scale:
    """Size of a campaign that is not a file."""
    scale = {name: getattr(options, name) for name in _SCALING}
    return Scale(**scale, limits=replace(DEFAULT_LIMITS, **dict(options.limit)), joints=joints)


def wanted_plan(
    options: argparse.Namespace, joints: tuple[Joint, Joint], on_progress: Tried | None = None
) -> Plan:
    """Read or make the plan; `joints` are those of the bench. Raises ConfigError."""
    if options.plan not in KINDS:
        plan = load_plan(Path(options.plan))
        return replace(plan, limits=replace(plan.limits, **dict(options.limit)))
    return make_plan(options.plan, scale_of(options, joints), on_progress)


def _limit(text: str) -> tuple[str, float]:
    """NAME=VALUE. Raises argparse.ArgumentTypeError."""
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
