"""`jtq excitation`: designs excitation runs and writes them as a plan, or compares the ways to get them."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, fields
from typing import Any, Final

import numpy as np

from estimator.checked import ConfigError
from estimator.parameters import Joint
from models.files import load_joint, shipped
from sim_can.plant_parameters import load_plant
from sysid.campaign.plan import DEFAULT_LIMITS, Fourier, Plan, Rest, Run
from sysid.campaign.segments import check_plan
from sysid.excitation_compare import Row, compare, deviation_ratio, table_lines
from sysid.excitation_design import FINAL_RATE_HZ, STARTS, Design, design
from sysid.excitation_model import Bench, ExcitationLimits
from sysid.excitation_options import COMPARED_EVALUATIONS, EVALUATIONS, LIMIT_OPTIONS, parser, problem_of
from sysid.excitation_trial import HEADING, JUDGES, trial

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
