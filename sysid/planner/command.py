"""`jtq excitation`: design excitation runs and write them as a plan for `jtq campaign`."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, fields
from pathlib import Path
from typing import Final

import numpy as np

from jtqd.estimator.checked import ConfigError, count, natural, seconds
from jtqd.estimator.joint import Joint
from jtqd.models.files import load_joint, shipped
from jtqd.sysid.planner.design import FINAL_RATE_HZ, STARTS, Bench, Design, ExcitationLimits, design
from jtqd.sysid.planner.plan import DEFAULT_LIMITS, Fourier, Plan, Rest, Run, check_plan

EVALUATIONS: Final = 2000
_LARGEST: Final = 1e4
"""Of any limit, in its unit: beyond it nothing is a limit of a joint, and the search loses its digits."""
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
    made = argparse.ArgumentParser(
        prog="jtq excitation",
        description="Design Fourier trajectories of velocity and driving current to identify the losses of a joint\n"
        "(D-optimality, differential evolution).",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    made.add_argument("--count", type=count, metavar="N", help="runs (default 8)")
    made.add_argument(
        "--duration", type=seconds, default=20.0, metavar="S", help="length of a run (default 20)"
    )
    made.add_argument("--harmonics", type=count, default=5, metavar="N", help="of each series (default 5)")
    made.add_argument("--seed", type=natural, default=0, metavar="N", help="same seed, same runs (default 0)")
    made.add_argument(
        "--evaluations",
        type=count,
        metavar="N",
        default=EVALUATIONS,
        help=f"motions evaluated by a search (default {EVALUATIONS})",
    )
    made.add_argument(
        "--starts",
        type=count,
        metavar="N",
        help=f"searches per run, of which the best is used (default {STARTS})",
    )
    made.add_argument(
        "--joints",
        type=Path,
        nargs=2,
        metavar="FILE",
        help="joint files of velocity joint and driving joint (default: the shipped ones)",
    )
    made.add_argument(
        "--velocity-joint", type=int, choices=(1, 2), default=1, help="joint in velocity mode (default 1)"
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


REST_S: Final = 1.0
"""Rest before and after each motion; two in a row make the 2 s of the paper's section III."""


def main(argv: list[str]) -> int:
    """Design the runs; exit status 0 done, 1 failure, 2 usage."""
    options = parser().parse_args(argv)
    try:
        limits = ExcitationLimits(
            **{one.name: getattr(options, one.name) for one in fields(ExcitationLimits)}
        )
        return _design(options, limits, _joints(options))
    except ConfigError as error:
        print(f"jtq excitation: {error}", file=sys.stderr)
    except OSError as error:
        print(
            f"jtq excitation: {error.filename or options.out or 'output'}: {error.strerror or error}",
            file=sys.stderr,
        )
    return 1


def _joints(options: argparse.Namespace) -> tuple[Joint, Joint]:
    """Return the velocity joint, driving joint."""
    if options.joints is not None:
        one, two = options.joints
    else:
        both = [shipped("joint1.yaml"), shipped("joint2.yaml")]
        one, two = both if options.velocity_joint == 1 else both[::-1]
    return load_joint(one), load_joint(two)


def _design(options: argparse.Namespace, limits: ExcitationLimits, joints: tuple[Joint, Joint]) -> int:
    number, evaluations = options.count or 8, options.evaluations
    if options.out is not None:
        _require_within_campaign(limits)
        options.out.parent.mkdir(parents=True, exist_ok=True)
    with _progress("designing", number * (options.starts or STARTS) * evaluations) as advance:
        designs = design(
            limits,
            count=number,
            duration_s=options.duration,
            harmonics=options.harmonics,
            seed=options.seed,
            evaluations=evaluations,
            starts=options.starts,
            joints=joints,
            on_progress=advance,
        )
    if options.out is not None:
        plan = as_plan(designs, options.velocity_joint)
        check_plan(plan)
        options.out.write_text(plan.to_yaml(), encoding="utf-8")
        print(f"jtq excitation: wrote {options.out}", file=sys.stderr)
    peaks = [peaks_of(one, joints) for one in designs]
    if options.json:
        runs = [
            {"segment": one.to_mapping(), "information_log_det": one.information_log_det, "peaks": peak}
            for one, peak in zip(designs, peaks, strict=True)
        ]
        print(json.dumps({"schema": "jtq.excitation/1", "limits": asdict(limits), "runs": runs}))
        return 0
    print(
        "peaks computed from the joint files; -log det of the information of all runs so far (lower is better)"
    )
    print("  run   rad/s  rad/s2     rad       A      Nm  -log det")
    for k, (one, peak) in enumerate(zip(designs, peaks, strict=True), 1):
        cells = "".join(f"{peak[name]:8.2f}" for name in peak)
        print(f"{k:>5}{cells}{-one.information_log_det:>10.2f}")
    return 0


def _require_within_campaign(limits: ExcitationLimits) -> None:
    """A plan stops the bench at the limits that it holds: no run in it may be allowed more. Raises ConfigError."""
    for name in LIMIT_OPTIONS:
        shared = "current_a" if name == "joint_current_a" else name
        highest = getattr(DEFAULT_LIMITS, shared, math.inf)
        if getattr(limits, name) > highest:
            raise ConfigError(
                f"{LIMIT_OPTIONS[name][0]}: found {getattr(limits, name):g}, expected at most {highest:g} in a plan: "
                "a campaign stops beyond it"
            )


def peaks_of(one: Design, joints: tuple[Joint, Joint]) -> dict[str, float]:
    """Largest magnitudes of a run at its set-points, by the names of the limits; torque by the joint files."""
    duration = one.velocity.duration_s
    time_s = np.linspace(0.0, duration, round(duration * FINAL_RATE_HZ) + 1)
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


def as_plan(designs: tuple[Design, ...], velocity_joint: int) -> Plan:
    """Return a plan with one run per design, at rest before and after, within the campaigns' own limits."""
    runs = tuple(
        Run(
            f"excitation_{k:02d}",
            velocity_joint,
            (Rest(REST_S, 0.0), Fourier(one.velocity, one.current), Rest(REST_S, 0.0)),
        )
        for k, one in enumerate(designs, 1)
    )
    return Plan("excitation", DEFAULT_LIMITS, runs)


@contextmanager
def _progress(text: str, total: int) -> Iterator[Callable[[int], None]]:
    """Yield a bar on standard error, on a terminal only."""
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(text, total=total)
        yield lambda number: bar.advance(task, number)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
