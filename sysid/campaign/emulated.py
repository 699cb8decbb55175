"""`python -m jtqd.sysid.campaign.emulated`: runs of a campaign on the emulated bench without a bus, faster than real time.

It writes the run tables and marks of a campaign, each run on a day of its own, and the true torques (NAME.truth.npz). There
is no jtqd and no missing cycle: for questions that need hundreds of days, such as the coverage of an interval.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Final

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.command_line import count, natural, seconds
from jtqd.estimator.decoder import read_json
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.files import write_whole
from jtqd.estimator.run import RunTable
from jtqd.estimator.text import counted
from jtqd.models.files import load_joint, shipped
from jtqd.sim_can.emulated_run import EmulatedRun, JointCommand, TimeFunction, emulate
from jtqd.sim_can.plant_source import AnyPlant, load_any_plant
from jtqd.sysid.planner.campaigns import KINDS, Scale, make_plan
from jtqd.sysid.planner.plan import Plan, Run, expand, marks_of
from jtqd.sysid.progress import progress
from jtqd.sysid.runs.tables import write_run, write_truth

PLANT: Final = "campaign_plant.yaml"
_RECIPE: Final = "emulated_runs.json"
_HZ: Final = 1000.0
_EXAMPLE = (
    "example: python -m jtqd.sysid.campaign.emulated --runs 384 --seconds 8 --hold 1.6 --seed 7 --out days"
)


def emulated(plan: Plan, plant: Path, seed: int) -> dict[str, RunTable]:
    """Return the run tables of a plan on the bench of `plant`, each on a day of its own. Raises ConfigError."""
    bench = load_any_plant(plant)
    return {run.name: emulated_run(bench, seed, day, run) for day, run in enumerate(plan.runs)}


def emulated_run(bench: AnyPlant, seed: int, day: int, run: Run) -> RunTable:
    """Return the table of one run on this day of the seed."""
    return emulated_with_truth(bench, seed, day, run).table


def emulated_with_truth(bench: AnyPlant, seed: int, day: int, run: Run) -> EmulatedRun:
    """Return one run on this day of the seed, with the true torques.

    A joint that is moved alone is joint 1 of the bench and turns joint 2, which has no current, as in `jtq sim --drives 1`;
    its table has its own columns only. Any other pair than joints 1 and 2 takes their places.
    """
    points = expand(run)
    commands = (
        JointCommand.velocity(_sampled(points.velocity_rad_s)),
        JointCommand.current(_sampled(points.current_a)),
    )
    first = points.velocity_joint == points.joints[0]
    one, two = commands if first else (commands[1], commands[0])
    made = emulate(bench, (one, two), len(points) / _HZ, seed, day=day)
    joints = {number: made.table.joints[place] for place, number in enumerate(points.joints, 1)}
    return made._replace(table=replace(made.table, joints=joints))


def _sampled(values: FloatArray) -> TimeFunction:
    """Return the command of a drive as a function of time, one value per millisecond."""
    each: list[float] = values.tolist()
    return lambda time_s: each[round(_HZ * time_s)]


def _write_run_files(out: Path, plant: Path, seed: int, numbered: tuple[int, Run]) -> str:
    day, run = numbered
    made = emulated_with_truth(load_any_plant(plant), seed, day, run)
    path = out / f"{run.name}.csv.gz"
    write_run(path, made.table)
    write_truth(path, {number: made.joint_torque_nm[:, place] for place, number in enumerate(run.joints)})
    write_whole(out / f"{run.name}.json", f"{json.dumps(marks_of(run, expand(run)), indent=1)}\n".encode())
    return run.name


def main(arguments: list[str] | None = None) -> int:
    """Write the runs of a validation campaign. Returns the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m jtqd.sysid.campaign.emulated", description=__doc__, epilog=_EXAMPLE
    )
    add = parser.add_argument
    add("--out", type=Path, required=True, metavar="DIR", help="output directory; created or continued")
    add("--kind", choices=KINDS, default="validate", help="kind of campaign (default validate)")
    add("--plant", type=Path, default=shipped(PLANT), help=f"bench (default {PLANT})")
    add("--runs", type=count, metavar="N", help="Fourier runs (default 24)")
    add("--seconds", type=seconds, metavar="S", help="length of a Fourier run (default 12)")
    add("--hold", type=seconds, metavar="S", help="hold of a constant point (default 2.1)")
    add("--evaluations", type=count, metavar="N", help="of each search of an excitation (default 1000)")
    add("--quick", action="store_true", help="a small campaign of the kind")
    add("--seed", type=natural, default=0, help="of trajectories and days (default 0)")
    options = parser.parse_args(arguments)
    joints = (load_joint(shipped("joint1.yaml")), load_joint(shipped("joint2.yaml")))
    try:
        scale = Scale(
            runs=options.runs,
            seconds=options.seconds,
            hold_s=options.hold,
            seed=options.seed,
            evaluations=options.evaluations,
            quick=options.quick,
            joints=joints,
        )
        plan = make_plan(options.kind, scale)
        load_any_plant(options.plant)
        _claim(options.out, plan, options.plant, options.seed)
        _emulate(options.out, plan, options.plant, options.seed)
    except (ConfigError, OSError) as error:
        print(f"emulated_runs: {error}", file=sys.stderr)
        return 1
    print(f"{counted(len(plan.runs), 'run')} in {options.out}")
    return 0


def _emulate(out: Path, plan: Plan, plant: Path, seed: int) -> None:
    """Write the runs that are not there yet, on all processors."""
    missing = [(day, run) for day, run in enumerate(plan.runs) if not (out / f"{run.name}.json").exists()]
    with ProcessPoolExecutor() as pool:
        made: Iterable[str] = pool.map(partial(_write_run_files, out, plant, seed), missing)
        for _ in zip(progress(missing, "runs"), made, strict=True):
            pass


def _claim(out: Path, plan: Plan, plant: Path, seed: int) -> None:
    """Make the directory, or check that it holds runs of the same recipe. Raises ConfigError, OSError."""
    recipe = {"plan": plan.sha256, "plant": hashlib.sha256(plant.read_bytes()).hexdigest(), "seed": seed}
    file = out / _RECIPE
    if file.is_file():
        try:
            same = read_json(file) == recipe
        except ValueError:
            same = False
        if not same:
            raise ConfigError(f"{out}: found runs of another plan, bench or seed, expected a new directory")
        return
    out.mkdir(parents=True)
    write_whole(file, f"{json.dumps(recipe, indent=1)}\n".encode())


if __name__ == "__main__":
    sys.exit(main())
