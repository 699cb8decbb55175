"""`jtq excitation`: designs excitation runs and writes them as a plan, or compares the ways to get them."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, Final

import numpy as np

from jtqd.estimator.checked import ConfigError, count, natural, seconds
from jtqd.estimator.joint import Joint
from jtqd.models.files import load_joint, shipped
from jtqd.sim_can.plant_file import load_plant
from jtqd.sysid.campaign.plan import DEFAULT_LIMITS, Fourier, Plan, Rest, Run, check_plan
from jtqd.sysid.excitation.compare import HEADING, JUDGES, Row, compare, deviation_ratio, table_lines, trial
from jtqd.sysid.excitation.design import FINAL_RATE_HZ, STARTS, Design, design
from jtqd.sysid.excitation.model import Bench, ExcitationLimits

# Options of `jtq excitation`.


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


REST_S: Final = 1.0
"""Before and after each motion; two in a row make the 2 s at rest of the paper's section III."""


def main(argv: list[str]) -> int:
    """Design or compare; exit status 0 done, 1 failure, 2 usage."""
    options = parser().parse_args(argv)
    problem = problem_of(options)
    if problem:
        print(f"jtq excitation: {problem}", file=sys.stderr)
        return 2
    try:
        limits = ExcitationLimits(
            **{one.name: getattr(options, one.name) for one in fields(ExcitationLimits)}
        )
        joints = _joints(options)
        if options.compare:
            return _compare(options, limits, joints)
        if options.trial:
            return _trial(options, limits, joints)
        return _design(options, limits, joints)
    except ConfigError as error:
        print(f"jtq excitation: {error}", file=sys.stderr)
    except ImportError:
        print("jtq excitation: scipy is not installed: pip install 'jtqd[train]'", file=sys.stderr)
    except OSError as error:
        print(f"jtq excitation: {error.filename or options.out}: {error.strerror or error}", file=sys.stderr)
    return 1


def _joints(options: argparse.Namespace) -> tuple[Joint, Joint]:
    """Velocity joint, driving joint."""
    if options.joints is not None:
        one, two = options.joints
    else:
        both = [shipped("joint1.yaml"), shipped("joint2.yaml")]
        one, two = both if options.velocity_joint == 1 else both[::-1]
    return load_joint(one), load_joint(two)


def _compare(options: argparse.Namespace, limits: ExcitationLimits, joints: tuple[Joint, Joint]) -> int:
    number, seeds = options.count or 1, options.seeds or 5
    evaluations = options.evaluations or COMPARED_EVALUATIONS
    with _progress("comparing", number * seeds * (3 * evaluations + 1)) as advance:
        rows = compare(
            limits,
            count=number,
            duration_s=options.duration,
            harmonics=options.harmonics,
            seed=options.seed,
            seeds=seeds,
            evaluations=evaluations,
            joints=joints,
            on_progress=advance,
        )
    if options.json:
        print(json.dumps(_rows_mapping(rows, options, limits)))
        return 0
    runs = "one run" if number == 1 else f"{number} runs together"
    print(
        f"-log det of the scaled information of {runs} of {options.duration:g} s: median, best, worst of {seeds} "
        "seeds; lower is better.\nCondition of the scaled regressor; standard deviation of the coefficients "
        "against the first row; processor seconds per design."
    )
    print("\n".join(table_lines(rows)))
    return 0


def _rows_mapping(
    rows: tuple[Row, ...], options: argparse.Namespace, limits: ExcitationLimits
) -> dict[str, Any]:
    return {
        "schema": "jtq.excitation_comparison/1",
        "limits": asdict(limits),
        "duration_s": options.duration,
        "harmonics": options.harmonics,
        "rows": [
            {**asdict(row), "median": row.median, "deviation_ratio": deviation_ratio(row, rows[0])}
            for row in rows
        ],
    }


def _trial(options: argparse.Namespace, limits: ExcitationLimits, joints: tuple[Joint, Joint]) -> int:
    number, seeds = options.count or 4, options.seeds or 5
    with _progress("emulated runs", JUDGES + 2 * seeds * number) as advance:
        trials, floor_nm = trial(
            limits,
            load_plant(shipped("plant.yaml")),
            joints,
            count=number,
            duration_s=options.duration,
            harmonics=options.harmonics,
            seed=options.seed,
            seeds=seeds,
            evaluations=options.evaluations or EVALUATIONS,
            on_progress=advance,
        )
    if options.json:
        content = {"schema": "jtq.excitation_trial/1", "floor_nm": floor_nm}
        print(json.dumps({**content, "trials": [asdict(one) for one in trials]}))
        return 0
    print(
        f"error [Nm] of the loss on {JUDGES} drawn runs after a fit to so many others; median and worst of {seeds} "
        f"seeds\n(fitted to the judging runs themselves: {floor_nm:.2f})"
    )
    print("\n".join([HEADING, *(one.line() for one in trials)]))
    return 0


def _design(options: argparse.Namespace, limits: ExcitationLimits, joints: tuple[Joint, Joint]) -> int:
    number, evaluations = options.count or 8, options.evaluations or EVALUATIONS
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
    print("peaks by the joint files; -log det of the information of all runs so far, lower is better")
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
                "beyond it a campaign stops"
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
    """A plan with one run per design, at rest before and after, within the campaigns' own limits."""
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
    """A bar on standard error, on a terminal only."""
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(text, total=total)
        yield lambda number: bar.advance(task, number)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
