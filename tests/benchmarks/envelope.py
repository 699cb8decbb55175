r"""What lowers the status on runs that a joint file was not fitted to: temperature, speed and load, or views that disagree.

    python -m tests.benchmarks.envelope 9431 9432 9433 9434

Joints and runs of a bench that shares no code with ours (tests/worlds, MuJoCo): of each seed ten runs are fitted and six
judged. The joints warm up by 2.5 K from run to run. `last`: the six last runs are judged, all warmer than what was fitted;
`mixed`: six from among them. Of the samples in motion: how many are degraded, and beyond what; the share inside the 90 %
interval among those that are degraded and those that are not, against the torque sensor without its zero of the day.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from jtqd.estimator.age import aligned
from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.estimator.envelope import Envelope
from jtqd.estimator.fusion import GAUSS
from jtqd.estimator.joint import Joint
from jtqd.estimator.methods import make_estimator
from jtqd.estimator.run import RunTable
from jtqd.estimator.settings import recommended
from jtqd.estimator.status import DEGRADED, VALID
from jtqd.models.files import load_joint
from jtqd.sysid.runs.files import read_run
from tests.benchmarks.zeros import WorldRun
from tests.worlds.judge import write
from tests.worlds.mujoco_bench import MujocoBench
from tests.worlds.recorder import Recorder

RUNS, SECONDS, SETTLED_S = 16, 10.0, 0.1
JUDGED = {"last": (10, 11, 12, 13, 14, 15), "mixed": (2, 5, 7, 10, 13, 15)}
COLUMNS = (
    "degraded",
    "temperature",
    "speed, load",
    "apart",
    "RMSE/sigma",
    "inside: degraded",
    "not degraded",
)


def known(envelope: Envelope, velocity_rad_s: FloatArray, raw_nm: FloatArray) -> BoolArray:
    """Return whether samples [n] are in a known cell."""
    table = np.pad(np.array(envelope.known, bool), 1)
    middle = np.array(table.shape) // 2
    at = (
        np.rint(velocity_rad_s / envelope.velocity_step_rad_s).astype(int) + middle[0],
        np.rint(raw_nm / envelope.torque_step_nm).astype(int) + middle[1],
    )
    found: BoolArray = table[np.clip(at[0], 0, table.shape[0] - 1), np.clip(at[1], 0, table.shape[1] - 1)]
    return found


def judged(joint: Joint, table: RunTable, number: int, truth_nm: FloatArray) -> list[float]:
    """Return the COLUMNS of one joint in one run; NaN where there is no such sample."""
    assert joint.fused is not None
    envelope = joint.fused.envelope
    assert envelope is not None
    assert envelope.temperature_c is not None
    assert envelope.load_nm is not None
    settings = replace(recommended("fused"), track_zeros=False)
    columns = table.joint(number, joint.gear_ratio)
    _, current, motor, velocity, link = table.estimator_inputs(number, joint.gear_ratio)
    got = make_estimator(joint, settings).run(
        table.dt_s, current, motor, velocity, link, columns.temperature_c
    )
    moving = np.isin(got.status, (VALID, DEGRADED)) & (table.time_s - table.time_s[0] > SETTLED_S)
    error = (got.torque_nm - aligned(truth_nm, table.dt_s, joint, settings))[moving] / got.sigma_nm[moving]
    seen, low = got.features[moving], got.status[moving] == DEGRADED
    assert columns.temperature_c is not None
    celsius = columns.temperature_c[moving]
    inside = np.abs(error) <= GAUSS
    return [
        low.mean(),
        ((celsius < envelope.temperature_c[0]) | (celsius > envelope.temperature_c[1])).mean(),
        (
            ~known(envelope, seen[:, 0], seen[:, 1]) | (np.abs(got.physics_nm[moving]) > envelope.load_nm)
        ).mean(),
        (np.abs(seen[:, 2]) > envelope.distance_nm).mean(),
        float(np.sqrt(np.mean(error**2))),
        inside[low].mean() if low.any() else np.nan,
        inside[~low].mean() if not low.all() else np.nan,
    ]


def judging_runs(which: str, seed: int) -> list[WorldRun]:
    """Return every judged joint in a run of a seed, with its file fitted to the others and its true torque."""
    bench = MujocoBench(RUNS, SECONDS)
    drawn, days = bench.draw(seed), bench.days(seed)
    found = []
    with TemporaryDirectory() as directory:
        paths, files = write(Path(directory), drawn.runs, drawn.joints, Recorder(), seed)
        fit = [str(path) for n, path in enumerate(paths) if n not in JUDGED[which]]
        for number, file in files.items():
            out = file.with_name(f"fitted{number}.yaml")
            command = ["fit", "losses", *fit, "--joint", str(file), "--out", str(out)]
            subprocess.run(
                [sys.executable, "-m", "jtqd.daemon.jtq", *command], check=True, capture_output=True
            )
            joint = load_joint(out)
            for n in JUDGED[which]:
                table = read_run(paths[n]).table
                sensor = table.joints[number].torque_nm
                assert sensor is not None
                found.append(WorldRun(joint, number, table, sensor - days[n].sensor_nm))
    return found


def of_the_world(which: str, seed: int) -> list[list[float]]:
    """Return the COLUMNS of every judged joint and run of a seed."""
    return [judged(run.joint, run.table, run.number, run.truth_nm) for run in judging_runs(which, seed)]


def main() -> None:
    """Print a row for each choice of the judged runs."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("seeds", type=int, nargs="+", metavar="SEED")
    seeds = parser.parse_args().seeds
    print(f"{'judged':8}" + "".join(f"{name:>18}" for name in COLUMNS))
    with ProcessPoolExecutor(2) as pool:
        for which in JUDGED:
            rows = np.array([row for seed in pool.map(partial(of_the_world, which), seeds) for row in seed])
            print(f"{which:8}" + "".join(f"{value:18.3f}" for value in np.nanmean(rows, axis=0)), flush=True)


if __name__ == "__main__":
    main()
