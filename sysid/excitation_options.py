"""Options of `jtq excitation`."""

from __future__ import annotations

import argparse
import math
from dataclasses import fields
from pathlib import Path
from typing import Final

from estimator.arguments import count, natural, seconds
from sysid.excitation_design import STARTS, ExcitationLimits

EVALUATIONS: Final = 2000
COMPARED_EVALUATIONS: Final = 4000
LIMIT_OPTIONS: Final = {
    "velocity_rad_s": ("--velocity", "rad/s", "peak velocity, joint side"),
    "acceleration_rad_s2": ("--acceleration", "rad/s2", "peak acceleration, joint side"),
    "travel_rad": ("--travel", "rad", "largest distance from the start"),
    "current_a": ("--current", "A", "peak current of the driving joint"),
    "joint_current_a": ("--joint-current", "A", "peak current that the velocity joint may need"),
    "torque_nm": ("--torque", "Nm", "peak torque between the joints"),
}
_EXAMPLES: Final = """examples:
  jtq excitation --out excitation.plan.yaml     then: jtq campaign excitation.plan.yaml --bus sim --out DIR
  jtq excitation --count 4 --velocity 0.3 --seed 1 --json
  jtq excitation --compare
  jtq excitation --trial"""


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected a number > 0")
    return value


def parser() -> argparse.ArgumentParser:
    """Options of `jtq excitation`."""
    made = argparse.ArgumentParser(
        prog="jtq excitation",
        description="Design Fourier trajectories of velocity and driving current that tell the losses of a joint best "
        "(genetic algorithm, D-optimality); --compare sets it beside other ways to find them.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    made.add_argument("--count", type=count, metavar="N", help="runs (default 8; --compare 1; --trial 4)")
    made.add_argument(
        "--duration", type=seconds, default=20.0, metavar="S", help="length of a run (default 20)"
    )
    made.add_argument("--harmonics", type=count, default=5, metavar="N", help="of each series (default 5)")
    made.add_argument("--seed", type=natural, default=0, metavar="N", help="same seed, same runs (default 0)")
    made.add_argument(
        "--evaluations",
        type=count,
        metavar="N",
        help=f"motions a search tries (default {EVALUATIONS}; --compare {COMPARED_EVALUATIONS})",
    )
    made.add_argument(
        "--starts", type=count, metavar="N", help=f"searches per run, the best counts (default {STARTS})"
    )
    made.add_argument(
        "--joints",
        type=Path,
        nargs=2,
        metavar="FILE",
        help="joint files of velocity joint and driving joint (default: those that ship)",
    )
    made.add_argument(
        "--velocity-joint", type=int, choices=(1, 2), default=1, help="joint in velocity mode (default 1)"
    )
    made.add_argument(
        "--compare", action="store_true", help="table of genetic algorithm, scipy's DE and random"
    )
    made.add_argument(
        "--trial",
        action="store_true",
        help="fit designed and drawn runs on the emulated bench, and judge them",
    )
    made.add_argument(
        "--seeds", type=count, metavar="N", help="with --compare and --trial: seeds to try (default 5)"
    )
    made.add_argument(
        "--out", type=Path, metavar="FILE", help="write the runs as a plan (jtq.plan/1) to this file"
    )
    made.add_argument("--json", action="store_true", help="print the result as JSON")
    group = made.add_argument_group("limits that no run exceeds")
    for one in fields(ExcitationLimits):
        option, unit, text = LIMIT_OPTIONS[one.name]
        group.add_argument(
            option,
            dest=one.name,
            type=_positive,
            default=one.default,
            metavar="X",
            help=f"{text} [{unit}] (default {one.default:g})",
        )
    return made


def problem_of(options: argparse.Namespace) -> str:
    """What is wrong with the combination of options; empty when nothing is."""
    if options.compare and options.trial:
        return "--trial does not go with --compare"
    kind = "--compare" if options.compare else "--trial" if options.trial else ""
    for name in ("out", "starts"):
        if kind and getattr(options, name) is not None:
            return f"--{name} does not go with {kind}"
    if options.trial and options.velocity_joint != 1:
        return "--velocity-joint 2 does not go with --trial, where joint 1 is in velocity mode"
    if options.seeds is not None and not kind:
        return "--seeds belongs to --compare and --trial"
    return ""
