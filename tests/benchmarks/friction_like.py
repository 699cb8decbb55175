r"""Can the difference of the two views tell whether friction has changed, or the spring?

    python -m tests.benchmarks.friction_like table typical --fit-seed 2 --seed 500

One thing is changed in a plant after its joints were fitted, as for the goals' table. Of the difference of the views in
motion (torsion less current, low-passed at 10 rad/s) by run: its RMS, the part of its mean square that friction explains
(direction, velocity, direction times motor torque), that a zero and a spring explain (constant, torque, its cube), and in
how many stretches of 2 s friction alone explains more than 70 %. Least squares, every run by itself.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.observer import low_pass
from jtqd.estimator.settings import EstimatorSettings
from jtqd.sysid.fit.fused import path_residuals
from jtqd.sysid.fit.signals import run_signals
from jtqd.sysid.goals.identify import (
    QUICK,
    Driven,
    Identified,
    drive,
    identify_physics,
    judging_runs,
    nominal_joints,
)
from jtqd.sysid.goals.judge import Link
from jtqd.sysid.goals.plants import CHANGES, PlantFile, the_three

RUNS: Final = 6
EVERY: Final = 20
STRETCH: Final = 100
"""Samples of 2 s of motion, of every EVERY-th."""
SETTINGS: Final = EstimatorSettings(method="fused")  # as `jtq fit losses`


def explained(y: FloatArray, *regressors: FloatArray) -> float:
    """Return the part of the mean square of y [n] that least squares on regressors [n] explain."""
    x = np.column_stack(regressors)
    rest = y - x @ np.linalg.lstsq(x, y, rcond=None)[0]
    return float(1.0 - (rest @ rest) / (y @ y))


def row(run: Driven, one: Identified, link: Link | None) -> tuple[float, float, float, float]:
    """Return mean square [Nm^2], parts by friction and by spring, share of stretches, of one joint in one run."""
    joint, columns = one.joint, run.columns(one.number, one.joint)
    if link is not None:
        assert columns.link_position_rad is not None
        assert columns.motor_position_rad is not None
        changed = link(columns.link_position_rad, columns.motor_position_rad / joint.gear_ratio)
        columns = replace(columns, link_position_rad=changed)
    assert joint.fused is not None
    seen = path_residuals(
        run_signals(run.name, joint, SETTINGS, run.table.time_s, columns),
        joint.fused.loss,
        joint.fused.torsion,
    )
    apart = low_pass(seen.torsion_error_nm - seen.current_error_nm, seen.dt_s, 10.0)
    y, s, v, raw, tau = (
        each[::EVERY] for each in (apart, seen.direction, seen.velocity_rad_s, seen.raw_nm, seen.torsion_nm)
    )
    starts = range(0, len(y) - STRETCH, STRETCH)
    alike = [
        explained(y[part], s[part], (s * np.abs(raw))[part]) > 0.7
        for part in (slice(k, k + STRETCH) for k in starts)
    ]
    return (
        float(y @ y) / len(y),
        explained(y, s, v, s * np.abs(raw)),
        explained(y, np.ones_like(y), tau, tau**3),
        float(np.mean(alike)),
    )


def of_plant(fit_seed: int, seed: int, plant: PlantFile) -> list[str]:
    """Return the lines of one plant."""
    models, _ = identify_physics(plant, QUICK._replace(evaluations=60), fit_seed)
    runs = judging_runs(QUICK, nominal_joints(plant), seed)
    motions = [run for run in runs if run.name.startswith("variable")][:RUNS]
    found = [plant.name]
    for change in CHANGES:
        if change.possible(plant):
            days = drive(change.bench(plant), motions, seed)
            rows = np.array([row(run, one, change.link) for run in days for one in models])
            square, friction, spring, alike = rows.mean(axis=0)
            found.append(
                f"  {change.name:34} RMS {np.sqrt(square):5.2f} Nm; friction explains {100 * friction:3.0f} %, at most "
                f"{100 * rows[:, 1].max():3.0f} %; zero and spring {100 * spring:3.0f} %; stretches {100 * alike:3.0f} %"
            )
    return found


def main() -> None:
    """Print the lines of each plant."""
    named = dict(zip(("table", "typical", "bad_day"), the_three(), strict=True))
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("plants", nargs="+", choices=list(named))
    parser.add_argument("--fit-seed", type=int, default=2)
    parser.add_argument("--seed", type=int, default=500)
    options = parser.parse_args()
    with ProcessPoolExecutor(2) as pool:
        work = partial(of_plant, options.fit_seed, options.seed)
        for found in pool.map(work, [named[name] for name in options.plants]):
            print("\n".join(found), flush=True)


if __name__ == "__main__":
    main()
