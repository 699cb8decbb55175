"""`jtq excitation`: design excitation runs and write them as a plan for `jtq campaign`."""

from __future__ import annotations

import argparse
import json
import math
import sys
from dataclasses import asdict, fields
from pathlib import Path
from typing import Final

import numpy as np

from jtqd.estimator.command_line import command_parser, count, natural, seconds
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.files import write_whole
from jtqd.estimator.joint import Joint
from jtqd.models.files import load_joint, shipped
from jtqd.sysid.planner.design import FINAL_RATE_HZ, STARTS, Bench, ExcitationLimits, design, starts_of
from jtqd.sysid.planner.plan import DEFAULT_LIMITS, Fourier, Plan, check_plan, segment_mapping, trajectory_run
from jtqd.sysid.progress import bar

EVALUATIONS: Final = 2000
_LARGEST: Final = 1e4
"""Of any limit, in its unit: a larger one is no limit of a joint, and the search loses its digits."""
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
  jtq excitation --count 4 --velocity 0.3 --seed 1 --json"""


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value <= _LARGEST:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected a number > 0 and <= {_LARGEST:g}")
    return value


def parser() -> argparse.ArgumentParser:
    """Options of `jtq excitation`."""
    made = command_parser(
        "jtq excitation",
        "Design Fourier trajectories of velocity and driving current to identify the losses of a joint\n"
        "(D-optimality, differential evolution).",
        _EXAMPLES,
    )
    add = made.add_argument
    add("--count", type=count, default=8, metavar="N", help="runs (default 8)")
    add("--duration", type=seconds, default=20.0, metavar="S", help="length of a run (default 20)")
    add("--harmonics", type=count, default=5, metavar="N", help="of each series (default 5)")
    add("--seed", type=natural, default=0, metavar="N", help="same seed, same runs (default 0)")
    tried = f"motions evaluated by a search (default {EVALUATIONS})"
    add("--evaluations", type=count, metavar="N", default=EVALUATIONS, help=tried)
    starts = f"searches per run, of which the best is used (default {STARTS})"
    add("--starts", type=count, metavar="N", help=starts)
    files = "joint files of velocity joint and driving joint (default: the shipped ones)"
    add("--joints", type=Path, nargs=2, metavar="FILE", help=files)
    add("--velocity-joint", type=int, choices=(1, 2), default=1, help="joint in velocity mode (default 1)")
    add("--out", type=Path, metavar="FILE", help="write the runs as a plan (jtq.plan/1) to this file")
    add("--json", action="store_true", help="print the result as JSON")
    group = made.add_argument_group("limits that no run exceeds")
    for one in fields(ExcitationLimits):
        option, unit, text = LIMIT_OPTIONS[one.name]
        text += f" [{unit}] (default {one.default:g})"
        group.add_argument(option, dest=one.name, type=_positive, default=one.default, metavar="X", help=text)
    return made


def main(argv: list[str]) -> int:
    """Design the runs; exit status 0 done, 1 failure, 2 usage."""
    options = parser().parse_args(argv)
    try:
        _design(options)
    except ConfigError as error:
        print(f"jtq excitation: {error}", file=sys.stderr)
        return 1
    except OSError as error:
        where = error.filename or options.out or "output"
        print(f"jtq excitation: {where}: {error.strerror or error}", file=sys.stderr)
        return 1
    return 0


def _joints(options: argparse.Namespace) -> tuple[Joint, Joint]:
    """Return the velocity joint, driving joint."""
    both = options.joints or [shipped("joint1.yaml"), shipped("joint2.yaml")]
    if options.joints is None and options.velocity_joint == 2:
        both.reverse()
    return load_joint(both[0]), load_joint(both[1])


def _design(options: argparse.Namespace) -> None:
    limits = ExcitationLimits(**{one.name: getattr(options, one.name) for one in fields(ExcitationLimits)})
    joints = _joints(options)
    if options.out is not None:
        _require_within_campaign(limits)
        options.out.parent.mkdir(parents=True, exist_ok=True)
    starts = options.starts or starts_of(options.evaluations)
    with bar("designing", options.count * starts * options.evaluations) as advance:
        designs = design(
            limits,
            count=options.count,
            duration_s=options.duration,
            harmonics=options.harmonics,
            seed=options.seed,
            evaluations=options.evaluations,
            starts=starts,
            joints=joints,
            on_progress=advance,
        )
    if options.out is not None:
        runs = tuple(
            trajectory_run(f"excitation_{k:02d}", options.velocity_joint, one.segment)
            for k, one in enumerate(designs, 1)
        )
        plan = Plan("excitation", DEFAULT_LIMITS, runs)
        check_plan(plan)
        write_whole(options.out, plan.to_yaml().encode())
        print(f"jtq excitation: wrote {options.out}", file=sys.stderr)
    peaks = [_peaks(one.segment, joints) for one in designs]
    if options.json:
        found = [
            asdict(one) | {"segment": segment_mapping(one.segment), "peaks": peak}
            for one, peak in zip(designs, peaks, strict=True)
        ]
        print(json.dumps({"schema": "jtq.excitation/1", "limits": asdict(limits), "runs": found}))
        return
    print(
        "peaks computed from the joint files; -log det of the information of all runs so far (lower is better)"
    )
    print("  run   rad/s  rad/s2     rad       A      Nm  -log det")
    for k, (one, peak) in enumerate(zip(designs, peaks, strict=True), 1):
        cells = "".join(f"{peak[name]:8.2f}" for name in peak)
        print(f"{k:>5}{cells}{-one.information_log_det:>10.2f}")


def _require_within_campaign(limits: ExcitationLimits) -> None:
    """Refuse limits beyond those at which a campaign stops the bench. Raises ConfigError."""
    for name, (option, _, _) in LIMIT_OPTIONS.items():
        highest = getattr(DEFAULT_LIMITS, "current_a" if name == "joint_current_a" else name, math.inf)
        if getattr(limits, name) > highest:
            raise ConfigError(
                f"{option}: found {getattr(limits, name):g}, expected at most {highest:g} in a plan: "
                "a campaign stops beyond it"
            )


def _peaks(one: Fourier, joints: tuple[Joint, Joint]) -> dict[str, float]:
    """Return the largest magnitudes of a run at its set-points, by the names of the limits; torque by the joint files."""
    time_s = np.linspace(0.0, one.duration_s, round(one.duration_s * FINAL_RATE_HZ) + 1)
    position, velocity, acceleration = one.velocity.motion(time_s)
    current = one.current.value(time_s)
    values = {
        "velocity_rad_s": velocity,
        "acceleration_rad_s2": acceleration,
        "travel_rad": position,
        "current_a": current,
        "torque_nm": Bench(*joints).torque(current, velocity, acceleration),
    }
    return {name: float(np.abs(value).max()) for name, value in values.items()}


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
