"""One thing changed after identification, on a bench that shares no code with ours: does the interval still hold the torque?

    python -m tests.benchmarks.changed 9406 9407 9408

Joints of the MuJoCo bench (tests/worlds) are fitted on some runs of each seed and judged on the others, as `zeros --world`
does it. A change acts on the recorded position of the link, which nothing there is controlled by. Each joint file is judged
as it was written and without its section `fused.agreement`; zeros are tracked.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from jtqd.estimator.age import aligned
from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.fusion import GAUSS
from jtqd.estimator.joint import Joint
from jtqd.estimator.methods import make_estimator
from jtqd.estimator.settings import recommended
from jtqd.estimator.status import DEGRADED, VALID
from tests.benchmarks.zeros import SETTLED_S, WorldRun, world_runs

Change = Callable[[FloatArray, FloatArray, float], FloatArray]
"""Link position of (link position, motor's share motor/G, gear ratio), all joint side [rad]."""

CHANGES: Final[dict[str, Change]] = {
    "nothing": lambda link, motor, ratio: link,
    "stiffness -5 %": lambda link, motor, ratio: motor - 1.05 * (motor - link),
    "spring hardens: the torsion saturates": lambda link, motor, ratio: motor - _saturated(motor - link),
    "kinematic error +110 urad, 2 per motor turn": lambda link, motor, ratio: (
        link + 110e-6 * np.sin(2.0 * ratio * motor + 0.5)
    ),
    "link eccentricity 60 urad": lambda link, motor, ratio: link + 60e-6 * np.sin(link + 1.0),
    "link zero 100 urad": lambda link, motor, ratio: link + 100e-6,
    "gear ratio +0.02 %": lambda link, motor, ratio: link - 2e-4 * motor,
}


def _saturated(torsion: FloatArray) -> FloatArray:
    """Return what a spring that is harder by a fifth at the largest torsion of the run leaves of it."""
    most = float(np.abs(torsion - np.median(torsion)).max())
    return torsion - 0.2 / 3.0 * torsion**3 / most**2


class Row(NamedTuple):
    """Of one joint in one run, in motion: mean square of the error, share inside, share degraded, mean sigma."""

    square_nm2: float
    inside: float
    degraded: float
    sigma_nm: float


def judged(run: WorldRun, joint: Joint, change: Change) -> Row | None:
    """Return the row of one joint in one run; None where it hardly moves."""
    settings = replace(recommended("fused"), track_zeros=True)
    _, current, motor, velocity, link = run.table.estimator_inputs(run.number, joint.gear_ratio)
    changed = change(link, motor / joint.gear_ratio, joint.gear_ratio)
    temperature = run.table.joint(run.number, joint.gear_ratio).temperature_c
    got = make_estimator(joint, settings).run(run.table.dt_s, current, motor, velocity, changed, temperature)
    error = got.torque_nm - aligned(run.truth_nm, run.table.dt_s, joint, settings)
    moving = np.isin(got.status, (VALID, DEGRADED)) & (run.table.time_s - run.table.time_s[0] > SETTLED_S)
    if np.count_nonzero(moving) < len(error) // 20:
        return None
    error, sigma = error[moving], got.sigma_nm[moving]
    return Row(
        float(error @ error) / len(error),
        float(np.mean(np.abs(error) <= GAUSS * sigma)),
        float(np.mean(got.status[moving] == DEGRADED)),
        float(sigma.mean()),
    )


def of_seed(seed: int) -> dict[tuple[str, bool], list[Row]]:
    """Return the rows of one seed by change, and whether the file's section `fused.agreement` counts."""
    found: dict[tuple[str, bool], list[Row]] = {(name, on): [] for name in CHANGES for on in (False, True)}
    for run in world_runs(seed):
        assert run.joint.fused is not None
        without = replace(run.joint, fused=replace(run.joint.fused, agreement=None))
        for name, change in CHANGES.items():
            for on, joint in ((False, without), (True, run.joint)):
                row = judged(run, joint, change)
                if row is not None:
                    found[name, on].append(row)
    return found


def main() -> None:
    """Print one line for each change."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("seeds", type=int, nargs="+", metavar="SEED")
    with ProcessPoolExecutor(2) as pool:
        seeds = list(pool.map(of_seed, parser.parse_args().seeds))
    print(f"{'changed':44} runs | without: RMSE  inside  degraded  sigma | with agreement: the same")
    for name in CHANGES:
        parts = []
        for on in (False, True):
            rows = np.array([row for seed in seeds for row in seed[name, on]])
            square, inside, degraded, sigma = rows.mean(axis=0)
            parts.append(
                f"{np.sqrt(square):6.3f} Nm {100 * inside:5.1f} % {100 * degraded:5.1f} % {sigma:6.3f} Nm"
            )
        print(f"{name:44} {len(rows):4} | {' | '.join(parts)}")


if __name__ == "__main__":
    main()
