"""The link tracked against the torsion's low pass, on a bench that shares no code with ours.

    python -m tests.benchmarks.tracking 9531 9532

Joints of the MuJoCo bench (tests/worlds) are fitted on some runs of each seed and judged on the others, as `zeros --world`
does it: against the torque now, in motion. Zeros are tracked.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from jtqd.estimator.methods import make_estimator
from jtqd.estimator.settings import recommended
from jtqd.estimator.status import DEGRADED, VALID
from jtqd.sysid.fit.fused import GAUSS
from tests.benchmarks.zeros import SETTLED_S, WorldRun, world_runs


def judged(run: WorldRun, track: bool) -> list[float] | None:
    """Return mean square error now, square of the noise from sample to sample, share inside, mean sigma; None at rest."""
    settings = replace(recommended("fused"), track_link=track)
    _, current, motor, velocity, link = run.table.estimator_inputs(run.number, run.joint.gear_ratio)
    temperature = run.table.joint(run.number, run.joint.gear_ratio).temperature_c
    got = make_estimator(run.joint, settings).run(run.table.dt_s, current, motor, velocity, link, temperature)
    moving = np.isin(got.status, (VALID, DEGRADED)) & (run.table.time_s - run.table.time_s[0] > SETTLED_S)
    if np.count_nonzero(moving) < len(moving) // 20:
        return None
    error = got.torque_nm - run.truth_nm
    rough = np.diff(error, 2)[moving[2:] & moving[1:-1] & moving[:-2]]
    inside = np.abs(error[moving]) <= GAUSS * got.sigma_nm[moving]
    return [
        float(np.mean(error[moving] ** 2)),
        float(np.mean(rough**2)) / 6.0,
        float(inside.mean()),
        float(got.sigma_nm[moving].mean()),
    ]


def main() -> None:
    """Print one line for each filter."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("seeds", type=int, nargs="+", metavar="SEED")
    runs = [run for seed in parser.parse_args().seeds for run in world_runs(seed)]
    without = sum(run.joint.fused is None or run.joint.fused.tracking is None for run in runs)
    print(f"{len(runs)} joints in runs, {without} of them with a joint file without fused.tracking")
    for track, name in ((False, "low pass, 800 rad/s"), (True, "link tracked")):
        rows = np.array([row for run in runs if (row := judged(run, track)) is not None])
        square, rough, inside, sigma = rows.mean(axis=0)
        print(
            f"{name:20} {len(rows):3} | RMSE now {square**0.5:.3f} Nm, noise {rough**0.5:.3f} Nm, "
            f"inside {100 * inside:.1f} %, sigma {sigma:.3f} Nm"
        )


if __name__ == "__main__":
    main()
