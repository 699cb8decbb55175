"""The torsion tracked against its low pass: on a bench that shares no code with ours, or on recorded runs.

    python -m tests.benchmarks.tracking 9541 9542
    python -m tests.benchmarks.tracking --recorded reproduction/campaigns/validate [--models models/trained]

Joints of the MuJoCo bench (tests/worlds) are fitted on some runs of each seed and judged on the others, as `zeros --world`
does it: against the torque now, in motion. Zeros are tracked. Recorded runs, as `jtq campaign` leaves them, are judged
against their torque sensor now, less the mean error of the run: the sensor's zero of the day.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.fusion import GAUSS
from jtqd.estimator.joint import Joint
from jtqd.estimator.methods import make_estimator
from jtqd.estimator.run import RunTable
from jtqd.estimator.settings import recommended
from jtqd.estimator.status import DEGRADED, VALID
from jtqd.models.files import shipped
from jtqd.sysid.evaluate.methods import load_models
from jtqd.sysid.runs.files import read_run
from tests.benchmarks.zeros import SETTLED_S, WorldRun, world_runs


def judged(run: WorldRun, track: bool, *, zero: bool = False) -> list[float] | None:
    """Return mean square error now, square of the noise from sample to sample, share inside, mean sigma; None at rest.

    zero: the mean error is taken off first.
    """
    settings = replace(recommended("fused"), track_torsion=track)
    _, current, motor, velocity, link = run.table.estimator_inputs(run.number, run.joint.gear_ratio)
    temperature = run.table.joint(run.number, run.joint.gear_ratio).temperature_c
    got = make_estimator(run.joint, settings).run(run.table.dt_s, current, motor, velocity, link, temperature)
    moving = np.isin(got.status, (VALID, DEGRADED)) & (run.table.time_s - run.table.time_s[0] > SETTLED_S)
    error = got.torque_nm - run.truth_nm
    moving &= np.isfinite(error)
    if np.count_nonzero(moving) < len(moving) // 20:
        return None
    if zero:
        error -= error[moving].mean()
    rough = np.diff(got.torque_nm if zero else error, 2)[moving[2:] & moving[1:-1] & moving[:-2]]
    inside = np.abs(error[moving]) <= GAUSS * got.sigma_nm[moving]
    return [
        float(np.mean(error[moving] ** 2)),
        float(np.mean(rough**2)) / 6.0,
        float(inside.mean()),
        float(got.sigma_nm[moving].mean()),
    ]


def recorded(directory: Path, models: Path) -> Iterator[WorldRun]:
    """Yield the joints of recorded runs, with the sensor as truth."""
    joints: dict[int, Joint] = {each.number: each.joint for each in load_models(models)}
    for path in sorted(directory.glob("*.csv.gz")):
        table: RunTable = read_run(path).table
        for number in table.joints:
            joint = joints[number]
            sensor: FloatArray | None = table.joint(number, joint.gear_ratio).torque_nm
            if sensor is not None:
                yield WorldRun(joint, number, table, sensor)


def main() -> None:
    """Print one line for each filter."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("seeds", type=int, nargs="*", metavar="SEED")
    parser.add_argument("--recorded", type=Path, metavar="DIR", help="runs of a campaign")
    parser.add_argument(
        "--models", type=Path, default=shipped("bench.yaml").parent / "trained", metavar="DIR"
    )
    options = parser.parse_args()
    if bool(options.seeds) == bool(options.recorded):
        parser.error("expected seeds, or --recorded DIR")
    if options.recorded:
        runs = list(recorded(options.recorded, options.models))
    else:
        runs = [run for seed in options.seeds for run in world_runs(seed)]
    without = sum(run.joint.fused is None or run.joint.fused.tracking is None for run in runs)
    print(f"{len(runs)} joints in runs, {without} of them with a joint file without fused.tracking")
    for track, name in ((False, "low pass, 800 rad/s"), (True, "torsion tracked")):
        found = (judged(run, track, zero=options.recorded is not None) for run in runs)
        rows = np.array([row for row in found if row is not None])
        square, rough, inside, sigma = rows.mean(axis=0)
        print(
            f"{name:20} {len(rows):3} | RMSE now {square**0.5:.3f} Nm, noise {rough**0.5:.3f} Nm, "
            f"inside {100 * inside:.1f} %, sigma {sigma:.3f} Nm"
        )


if __name__ == "__main__":
    main()
