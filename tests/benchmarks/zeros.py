r"""What tracking the zeros changes: error and interval against the true torque, run by run, with and without it.

    python -m jtqd.sysid.campaign.emulated --plant models/plants/typical.yaml --runs 36 --seconds 8 \
        --hold 1.0 --seed 9311 --out days
    python -m tests.benchmarks.zeros MODELS days [--link-zero 1e-4]
    python -m tests.benchmarks.zeros MODELS --push 10 --plant models/plants/typical.yaml --seed 9312 [--link-zero 1e-4]
    python -m tests.benchmarks.zeros --world 9403 9404 9405 [--link-zero 1e-4] [--day-zeros 6e-5]

MODELS has joint1.yaml and joint2.yaml with section `fused`, fitted on the same plant; a run has its true torques beside it.
Settings are those of new configurations; estimate and truth are of one age. `--link-zero` adds a zero [rad] to the link
encoder from the first sample on. `--push` has runs of its own: the other joint pushes with so many Nm more from PUSH_S on,
and the zero that is found is compared with that of the same day and noise without the push. `--world` draws joints and runs
of a bench that shares no code with ours (tests/worlds, MuJoCo): fitted on some runs of each seed, scored on the others
against its torque sensor without that sensor's zero of the day. Its own link zeros are within 5 µrad; `--day-zeros` adds to
every run, fitted or scored, one drawn within so much.
"""

from __future__ import annotations

import argparse
import math
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from jtqd.estimator.age import aligned
from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.estimator import FusedEstimator
from jtqd.estimator.fusion import GAUSS
from jtqd.estimator.joint import Joint
from jtqd.estimator.methods import make_estimator
from jtqd.estimator.run import RunTable
from jtqd.estimator.settings import recommended
from jtqd.estimator.status import DEGRADED, VALID
from jtqd.models.files import load_joint
from jtqd.sim_can.emulated_run import JointCommand, emulate
from jtqd.sim_can.plants import load_any_plant
from jtqd.sysid.runs.files import read_run
from jtqd.sysid.runs.truth import read_truth
from tests.worlds.judge import write
from tests.worlds.mujoco_bench import MujocoBench
from tests.worlds.recorder import Recorder

SETTLED_S, LATE_S = 0.1, 2.5
NO_WORSE = 1.001
PUSH_S, PUSHED_S, PUSHED_DAYS = 4.0, 12.0, 8


WORLD_RUNS, WORLD_FITTED, WORLD_SECONDS = 16, 10, 10.0


class Figures(NamedTuple):
    """Of one joint in one run, in motion: RMSE [Nm], share inside the 90 % interval, share degraded; both after LATE_S."""

    rmse_nm: float
    covered: float
    degraded: float
    late_rmse_nm: float
    late_covered: float


class Estimated(NamedTuple):
    """Error against the truth of the same age [n], sigma, status, and the zero of the link encoder at the end [rad]."""

    error_nm: FloatArray
    sigma_nm: FloatArray
    status: FloatArray
    link_rad: float
    link_sigma_rad: float


def estimated(  # noqa: PLR0917 - a run and how it is estimated
    joint: Joint, table: RunTable, number: int, truth_nm: FloatArray, link_zero_rad: float, track: bool
) -> Estimated:
    """Estimate one joint of a run."""
    settings = replace(recommended("fused"), track_zeros=track)
    columns = table.joint(number, joint.gear_ratio)
    _, current, motor, velocity, link = table.estimator_inputs(number, joint.gear_ratio)
    estimator = make_estimator(joint, settings)
    assert isinstance(estimator, FusedEstimator)
    got = estimator.run(table.dt_s, current, motor, velocity, link + link_zero_rad, columns.temperature_c)
    error = got.torque_nm - aligned(truth_nm, table.dt_s, joint, settings)
    zeros = estimator.zeros
    found = (math.nan, math.nan) if zeros is None else (zeros.link_rad, zeros.link_sigma_rad)
    return Estimated(error, got.sigma_nm, got.status, *found)


def figures(models: Path, link_zero_rad: float, run: tuple[Path, int]) -> tuple[Figures, Figures] | None:
    """Return the figures without and with zeros, None for a joint that hardly moves."""
    path, number = run
    joint, table = load_joint(models / f"joint{number}.yaml"), read_run(path).table
    return compared(joint, table, number, read_truth(path)[number], link_zero_rad)


def compared(
    joint: Joint,
    table: RunTable,
    number: int,
    truth_nm: FloatArray,
    link_zero_rad: float,
) -> tuple[Figures, Figures] | None:
    """Return the same of one joint of a run."""
    time_s = table.time_s - table.time_s[0]
    found = []
    for on in (False, True):
        got = estimated(joint, table, number, truth_nm, link_zero_rad, on)
        inside = np.abs(got.error_nm) <= GAUSS * got.sigma_nm
        moving = np.isin(got.status, (VALID, DEGRADED)) & (time_s > SETTLED_S)
        late = moving & (time_s > LATE_S)
        if np.count_nonzero(late) < len(time_s) // 20:
            return None
        rmse, later = (float(np.sqrt(np.mean(got.error_nm[part] ** 2))) for part in (moving, late))
        degraded = float(np.mean(got.status[moving] == DEGRADED))
        found.append(Figures(rmse, float(inside[moving].mean()), degraded, later, float(inside[late].mean())))
    return found[0], found[1]


def table_of(models: Path, runs: Path, link_zero_rad: float) -> None:
    """Print two rows: without and with zeros, and in how many runs it is worse."""
    every = [(path, number) for path in sorted(runs.glob("*.csv.gz")) for number in (1, 2)]
    with ProcessPoolExecutor(2) as pool:
        report(list(pool.map(partial(figures, models, link_zero_rad), every)))


def report(found: list[tuple[Figures, Figures] | None]) -> None:
    """Print the table of these."""
    pairs = np.array([pair for pair in found if pair is not None])
    print(f"{len(pairs)} joints in runs     RMSE  covered  degraded | after {LATE_S:g} s: RMSE  covered")
    for name, part in (("without", pairs[:, 0]), ("with zeros", pairs[:, 1])):
        rmse, later = (np.sqrt(np.mean(part[:, k] ** 2)) for k in (0, 3))
        covered, degraded, covered_later = (100.0 * part[:, k].mean() for k in (1, 2, 4))
        print(
            f"{name:20} {rmse:6.3f} Nm {covered:5.1f} % {degraded:6.2f} % | {later:12.3f} Nm {covered_later:5.1f} %"
        )
    worse = pairs[:, 1, 0] > NO_WORSE * pairs[:, 0, 0]
    most = (pairs[:, 1, 0] - pairs[:, 0, 0]).max()
    print(f"worse with zeros: {np.count_nonzero(worse)} of {len(pairs)}; RMSE at most {most:+.3f} Nm")


class WorldRun(NamedTuple):
    """One joint in a run of the bench of others that it was not fitted on, and its true torque [n]."""

    joint: Joint
    number: int
    table: RunTable
    truth_nm: FloatArray


def world_runs(seed: int, day_zeros_rad: float = 0.0) -> list[WorldRun]:
    """Return the runs of one seed that its joints were not fitted on; to each link encoder is added a zero of its day."""
    bench = MujocoBench(WORLD_RUNS, WORLD_SECONDS)
    drawn, days = bench.draw(seed), bench.days(seed)
    source = np.random.default_rng([seed, len("zeros")])
    for columns in drawn.runs:
        for number in drawn.joints:
            key = f"j{number}.link_position_rad"
            columns[key] = columns[key] + day_zeros_rad * source.uniform(-1.0, 1.0)
    found = []
    with TemporaryDirectory() as directory:
        paths, files = write(Path(directory), drawn.runs, drawn.joints, Recorder(), seed)
        for number, file in files.items():
            fitted = file.with_name(f"fitted{number}.yaml")
            command = [
                "fit",
                "losses",
                *map(str, paths[:WORLD_FITTED]),
                "--joint",
                str(file),
                "--out",
                str(fitted),
            ]
            subprocess.run(
                [sys.executable, "-m", "jtqd.daemon.jtq", *command], check=True, capture_output=True
            )
            joint = load_joint(fitted)
            for path, day in zip(paths[WORLD_FITTED:], days[WORLD_FITTED:], strict=True):
                table = read_run(path).table
                sensor = table.joints[number].torque_nm
                assert sensor is not None
                found.append(WorldRun(joint, number, table, sensor - day.sensor_nm))
    return found


def of_the_world(
    link_zero_rad: float, day_zeros_rad: float, seed: int
) -> list[tuple[Figures, Figures] | None]:
    """Return the figures of the runs of one seed that its joints were not fitted on."""
    return [
        compared(run.joint, run.table, run.number, run.truth_nm, link_zero_rad)
        for run in world_runs(seed, day_zeros_rad)
    ]


def pushed(  # noqa: PLR0917 - of a process pool
    models: Path, plant: Path, seed: int, link_zero_rad: float, push_nm: float, day: int
) -> list[tuple[float, float]]:
    """Return, of each joint on one day, what the push moved the zero by, as torque [Nm], and its standard deviation."""
    bench = load_any_plant(plant)
    source = np.random.default_rng([seed, day])
    speed, rate, load, phase = source.uniform((0.6, 1.5, 1.0, 0.0), (1.4, 3.0, 3.0, 6.0))
    joints = [load_joint(models / f"joint{number}.yaml") for number in (1, 2)]
    per_nm = 1.0 / (joints[1].gear_ratio * joints[1].torque_constant_nm_per_a)
    found = []
    for more in (0.0, push_nm):
        commands = (
            JointCommand.velocity(lambda t: speed * math.sin(rate * t + phase)),
            JointCommand.current(
                lambda t, more=more: load * math.sin(1.1 * t) + (more * per_nm if t > PUSH_S else 0.0)
            ),
        )
        table, truth = emulate(bench, commands, PUSHED_S, seed, day=day)
        found.append(
            [
                estimated(joint, table, number, truth[:, number - 1], link_zero_rad, track=True)
                for number, joint in enumerate(joints, start=1)
            ]
        )
    return [
        (
            joint.fused.torsion.stiffness_nm_per_rad * (b.link_rad - a.link_rad),  # type: ignore[union-attr]
            joint.fused.torsion.stiffness_nm_per_rad * b.link_sigma_rad,
        )  # type: ignore[union-attr]
        for joint, a, b in zip(joints, *found, strict=True)
    ]


def main() -> None:
    """Print the table of the runs, or of the pushes."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("models", type=Path, nargs="?")
    parser.add_argument("runs", type=Path, nargs="?")
    parser.add_argument("--link-zero", type=float, default=0.0, metavar="RAD")
    parser.add_argument("--day-zeros", type=float, default=0.0, metavar="RAD")
    parser.add_argument("--push", type=float, metavar="NM")
    parser.add_argument("--plant", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--world", type=int, nargs="+", metavar="SEED")
    options = parser.parse_args()
    if options.world is not None:
        with ProcessPoolExecutor(2) as pool:
            drawn = pool.map(partial(of_the_world, options.link_zero, options.day_zeros), options.world)
            report([each for seed in drawn for each in seed])
        return
    if options.models is None:
        parser.error("found no directory of joint files")
    if options.push is None:
        if options.runs is None:
            parser.error("found no runs, expected a directory of runs or --push")
        table_of(options.models, options.runs, options.link_zero)
        return
    if options.plant is None:
        parser.error("found --push without --plant")
    with ProcessPoolExecutor(2) as pool:
        call = partial(pushed, options.models, options.plant, options.seed, options.link_zero, options.push)
        moved = np.array([each for day in pool.map(call, range(PUSHED_DAYS)) for each in day])
    print(
        f"{len(moved)} joints, push of {options.push:g} Nm: the zero moved by {np.sqrt(np.mean(moved[:, 0] ** 2)):.3f} Nm"
        f" (RMS), {np.abs(moved[:, 0]).max():.3f} Nm at most; its own sigma {moved[:, 1].mean():.3f} Nm"
    )


if __name__ == "__main__":
    main()
