"""Delay of the detection of a push, and rate of false contacts: `python -m tests.benchmarks.contact DIR`.

On the paper's Table I and on the two harder benches (docs/testing.md), as emulated runs with the joint files that were
identified on each bench. Practice days set the threshold: MARGIN times the largest residual of their quiet runs. Everything
that is printed is of other days.
DIR keeps the identified joint files; what is there is not made again.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import math
import random
import sys
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jtqd.estimator.arrays import CodeArray, FloatArray
from jtqd.estimator.detection import detect_contacts
from jtqd.estimator.estimator import FusedEstimator
from jtqd.estimator.joint import Joint
from jtqd.estimator.settings import recommended
from jtqd.estimator.status import CONTACT_PRESENT
from jtqd.models.files import load_joint, shipped
from jtqd.sim_can.emulated_run import EmulatedRun, JointCommand, Push, emulate
from jtqd.sim_can.plant_source import AnyPlant, load_any_plant
from jtqd.sysid.campaign import emulated as campaign
from jtqd.sysid.fit import command as fit
from jtqd.sysid.planner.campaigns import Scale, make_plan
from jtqd.sysid.planner.plan import Run, expand

BENCHES = {
    "Table I": "campaign_plant.yaml",
    "typical": "plants/typical.yaml",
    "bad day": "plants/bad_day.yaml",
}
PRACTICE, REPORTED, PUSHED = 100, 3300, 3900
"""First seeds of the days: of the threshold, of the false alarms, of the pushes."""
MARGIN = 1.2
RUNS, RUN_S, HOLD_S = 12, 8.0, 0.6
PERIOD_MS = 1.0
LATE_MS = 100.0
SETTINGS = replace(recommended("fused"), track_zeros=False)


class Watched(NamedTuple):
    """Residual and code [n]: opposed, then joint 1 alone."""

    opposed: tuple[FloatArray, CodeArray]
    alone: tuple[FloatArray, CodeArray]


class Days(NamedTuple):
    """Quiet days: seconds, largest residual of each run opposed and alone, alarms."""

    seconds: float
    largest: list[float]
    largest_alone: list[float]
    alarms: int
    alarms_alone: int


def identified(bench: str, directory: Path) -> Path:
    """Return the folder of the joint files of a bench; identified there from 11 short runs, as docs/estimator.md does."""
    if bench == "Table I":
        return shipped("trained/joint1.yaml").parent
    folder = directory / bench.replace(" ", "_")
    runs, models = folder / "fit", folder / "models"
    if not (models / "joint2.yaml").is_file():
        kind = [
            "--kind",
            "excitation",
            "--plant",
            str(shipped(BENCHES[bench])),
            "--runs",
            "12",
            "--seconds",
            "10",
        ]
        models.mkdir(parents=True, exist_ok=True)
        with contextlib.redirect_stdout(io.StringIO()):
            campaign.main([*kind, "--evaluations", "60", "--seed", "1", "--out", str(runs)])
            files = [str(path) for path in sorted(runs.glob("*.csv.gz")) if "_02" not in path.name]
            for n in (1, 2):
                joint = str(shipped(f"joint{n}.yaml"))
                if fit.main(["losses", *files, "--joint", joint, "--out", str(models / f"joint{n}.yaml")]):
                    raise SystemExit(f"contact: {bench}: joint {n} was not identified")
    return models


@cache
def planned(seed: int) -> tuple[Run, ...]:
    """Return the runs of a seed: constant speeds and loads with their ramps and reversals, and drawn Fourier motions."""
    joints = (load_joint(shipped("joint1.yaml")), load_joint(shipped("joint2.yaml")))
    return make_plan("validate", Scale(RUNS, RUN_S, HOLD_S, seed, 1000, False, joints=joints)).runs


@cache
def world(bench: str, models: Path) -> tuple[AnyPlant, tuple[Joint, Joint]]:
    return load_any_plant(shipped(BENCHES[bench])), (
        load_joint(models / "joint1.yaml"),
        load_joint(models / "joint2.yaml"),
    )


def emulated(plant: AnyPlant, seed: int, day: int, pushes: Iterable[Push] = ()) -> EmulatedRun:
    run = planned(seed)[day]
    points = expand(run)
    speed, current = points.velocity_rad_s.tolist(), points.current_a.tolist()
    moved = JointCommand.velocity(lambda t: speed[round(1e3 * t)])
    loading = JointCommand.current(lambda t: current[round(1e3 * t)])
    both = (moved, loading) if points.velocity_joint == 1 else (loading, moved)
    return emulate(plant, both, len(points) * 1e-3, seed, day=day, pushes=list(pushes))


def watched(joints: tuple[Joint, Joint], made: EmulatedRun, threshold_nm: float, alone_nm: float) -> Watched:
    time_s, loads = made.table.time_s, []
    dt = np.diff(time_s, prepend=time_s[0])
    for number, joint in enumerate(joints, start=1):
        c = made.table.joint(number, joint.gear_ratio)
        inputs = c.current_a, c.motor_position_rad, c.motor_velocity_rad_s, c.link_position_rad
        loads.append(FusedEstimator(joint, SETTINGS).run(dt, *inputs).load_nm)  # type: ignore[arg-type]
    angle = made.table.joints[1].motor_position_rad
    assert angle is not None
    return Watched(
        detect_contacts(loads[1] - loads[0], angle, threshold_nm), detect_contacts(-loads[0], angle, alone_nm)
    )


def begun(codes: CodeArray) -> int:
    there = codes == CONTACT_PRESENT
    return int(np.count_nonzero(there[1:] & ~there[:-1]))


def quiet(bench: str, models: Path, thresholds: tuple[float, float], seed: int) -> Days:
    plant, joints = world(bench, models)
    found = [watched(joints, emulated(plant, seed, day), *thresholds) for day in range(len(planned(seed)))]
    return Days(
        sum(len(each.opposed[1]) for each in found) * 1e-3,
        [float(np.nanmax(np.abs(each.opposed[0]))) for each in found],
        [float(np.nanmax(np.abs(each.alone[0]))) for each in found],
        sum(begun(each.opposed[1]) for each in found),
        sum(begun(each.alone[1]) for each in found),
    )


def drawn(
    run: Run, rng: random.Random, torque_nm: float, rise_ms: int
) -> list[tuple[float, float, list[Push]]]:
    """Return pushes at random times and phases, 0.15 to 0.25 s long: beginning, torque, steps."""
    found, at = [], 0.5
    while at < run.duration_s - 0.5:
        begin, torque = at + rng.random() * 1e-3, rng.choice((1.0, -1.0)) * torque_nm
        rising = [Push(begin + 1e-3 * k, torque * (k + 1) / (rise_ms + 1)) for k in range(rise_ms + 1)]
        end = begin + 0.15 + 0.1 * rng.random()
        found.append((begin, torque, [*rising, Push(end, 0.0)]))
        at = end + 0.3 + 0.1 * rng.random()
    return found


def pushed(bench: str, models: Path, threshold_nm: float, shape: tuple[float, int], seed: int) -> list[float]:
    """Return after how long [ms] each push of a seed's runs was detected at the SYNC of its inputs; inf: not within LATE_MS.

    shape: torque [Nm] and rise [ms] of the pushes.
    """
    plant, joints = world(bench, models)
    rng, found = random.Random(seed), []
    for day, run in enumerate(planned(seed)):
        pushes = drawn(run, rng, *shape)
        made = emulated(plant, seed, day, [step for _, _, steps in pushes for step in steps])
        residual, codes = watched(joints, made, threshold_nm, math.inf).opposed
        for begin, torque, _ in pushes:
            first = math.floor(1e3 * begin) + 1
            rows = slice(first, first + round(LATE_MS))
            hit = np.flatnonzero((codes[rows] == CONTACT_PRESENT) & (residual[rows] * torque > 0.0))
            found.append(first + float(hit[0]) - 1e3 * begin if len(hit) else math.inf)
    return found


def main(arguments: list[str]) -> int:
    """Print the table; exit status 0 done, 2 usage."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.contact", description=__doc__)
    parser.add_argument("directory", type=Path, metavar="DIR", help="where identified joint files are kept")
    parser.add_argument(
        "--hours", type=float, default=3.0, help="of quiet days per bench, for false alarms (default 3)"
    )
    parser.add_argument("--practice", type=float, default=1.0, help="hours of practice days (default 1)")
    parser.add_argument(
        "--pushes", type=int, default=4, help="seeds of runs with about 270 pushes each (default 4)"
    )
    parser.add_argument("--torque", type=float, default=3.0, help="of a push [Nm] (default 3)")
    parser.add_argument("--rise-ms", type=int, default=0, help="in which it comes (default 0: a step)")
    parser.add_argument("--bench", choices=BENCHES, action="append", help="only this one; may be repeated")
    options = parser.parse_args(arguments)
    print(
        f"push of {options.torque:g} Nm within {options.rise_ms} ms, detected after [ms]: at the SYNC of its inputs; "
        "on the bus at the latest: 1 ms more"
    )
    print(
        "bench    threshold [Nm]  pushes  median    99 %     all  3 ms on the bus  5 ms   quiet [h]  alarms"
        "  alone: alarms/h at it, at"
    )
    hour = sum(run.duration_s for run in planned(PRACTICE)) / 3600.0
    with ProcessPoolExecutor(2) as pool:
        for bench in options.bench or BENCHES:
            models = identified(bench, options.directory)

            def days(first: int, hours: float, thresholds: tuple[float, float]) -> Days:
                seeds = range(first, first + max(1, math.ceil(hours / hour)))
                parts = list(pool.map(partial(quiet, bench, models, thresholds), seeds))  # noqa: B023 - called at once
                return Days(
                    sum(each.seconds for each in parts),
                    [one for each in parts for one in each.largest],
                    [one for each in parts for one in each.largest_alone],
                    sum(each.alarms for each in parts),
                    sum(each.alarms_alone for each in parts),
                )

            practice = days(PRACTICE, options.practice, (math.inf, math.inf))
            threshold = math.ceil(MARGIN * max(practice.largest) * 20.0) / 20.0
            alone = MARGIN * max(practice.largest_alone)
            reported = days(REPORTED, options.hours, (threshold, threshold))
            seeds = range(PUSHED, PUSHED + options.pushes)
            delays = partial(pushed, bench, models, threshold, (options.torque, options.rise_ms))
            after = np.array([each for one in pool.map(delays, seeds) for each in one])
            hours = reported.seconds / 3600.0
            shares = [100.0 * np.mean(after + PERIOD_MS <= limit) for limit in (3.0, 5.0)]
            print(
                f"{bench:8} {threshold:14.2f}  {len(after):6}  {np.median(after):6.2f}  "
                f"{np.quantile(after, 0.99, method='higher'):6.2f}  {after.max():6.2f}  "
                f"{shares[0]:13.1f} %  {shares[1]:.1f} %  {hours:7.2f}  {reported.alarms:6}  "
                f"{reported.alarms_alone / hours:8.0f}, {alone:.0f} Nm",
                flush=True,
            )
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
