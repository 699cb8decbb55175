r"""What tracking the zeros changes: error and interval against the true torque, run by run, with and without it.

    python -m jtqd.sysid.campaign.emulated --plant models/plants/typical.yaml --runs 36 --seconds 8 \
        --hold 1.0 --seed 4101 --out days
    python -m tests.benchmarks.zeros MODELS days [--link-zero 1e-4]

MODELS has joint1.yaml and joint2.yaml with section `fused`, fitted on the same plant; a run has its true torques beside it.
`--link-zero` adds a zero [rad] to the link encoder from the first sample on.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jtqd.estimator.methods import make_estimator
from jtqd.estimator.observer import low_pass
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.status import DEGRADED, VALID
from jtqd.models.files import load_joint
from jtqd.sysid.fit.fused import GAUSS
from jtqd.sysid.runs.files import read_run
from jtqd.sysid.runs.truth import read_truth

SETTLED_S, LATE_S = 0.1, 2.5
NO_WORSE = 1.001


class Figures(NamedTuple):
    """Of one joint in one run, in motion: RMSE [Nm], share inside the 90 % interval, share degraded; both after LATE_S."""

    rmse_nm: float
    covered: float
    degraded: float
    late_rmse_nm: float
    late_covered: float


def figures(models: Path, link_zero_rad: float, run: tuple[Path, int]) -> tuple[Figures, Figures] | None:
    """Return the figures without and with zeros, None for a joint that hardly moves."""
    path, number = run
    joint = load_joint(models / f"joint{number}.yaml")
    table = read_run(path).table
    columns = table.joint(number, joint.gear_ratio)
    time_s = table.time_s - table.time_s[0]
    found = []
    for on in (False, True):
        settings = EstimatorSettings(method="fused", track_zeros=on)
        _, current, motor, velocity, link = table.estimator_inputs(number, joint.gear_ratio)
        got = make_estimator(joint, settings).run(
            table.dt_s, current, motor, velocity, link + link_zero_rad, columns.temperature_c
        )
        error = got.torque_nm - low_pass(read_truth(path)[number], table.dt_s, settings.bandwidth_rad_s)
        inside = np.abs(error) <= GAUSS * got.sigma_nm
        moving = np.isin(got.status, (VALID, DEGRADED)) & (time_s > SETTLED_S)
        late = moving & (time_s > LATE_S)
        if np.count_nonzero(late) < len(time_s) // 20:
            return None
        rmse, later = (float(np.sqrt(np.mean(error[part] ** 2))) for part in (moving, late))
        degraded = float(np.mean(got.status[moving] == DEGRADED))
        found.append(Figures(rmse, float(inside[moving].mean()), degraded, later, float(inside[late].mean())))
    return found[0], found[1]


def main() -> None:
    """Print two rows: without and with zeros, and the share of runs that are worse."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("models", type=Path)
    parser.add_argument("runs", type=Path)
    parser.add_argument("--link-zero", type=float, default=0.0, metavar="RAD")
    options = parser.parse_args()
    runs = [(path, number) for path in sorted(options.runs.glob("*.csv.gz")) for number in (1, 2)]
    with ProcessPoolExecutor(2) as pool:
        all_pairs = list(pool.map(partial(figures, options.models, options.link_zero), runs))
    pairs = np.array([pair for pair in all_pairs if pair is not None])
    print(f"{len(pairs)} joints in runs     RMSE  covered  degraded | after {LATE_S:g} s: RMSE  covered")
    for name, part in (("without", pairs[:, 0]), ("with zeros", pairs[:, 1])):
        rmse, later = (np.sqrt(np.mean(part[:, k] ** 2)) for k in (0, 3))
        covered, degraded, covered_later = (100.0 * part[:, k].mean() for k in (1, 2, 4))
        print(
            f"{name:20} {rmse:6.3f} Nm {covered:5.1f} % {degraded:6.2f} % | {later:12.3f} Nm {covered_later:5.1f} %"
        )
    worse = pairs[:, 1, 0] > NO_WORSE * pairs[:, 0, 0]
    print(f"worse with zeros: {np.count_nonzero(worse)} of {len(pairs)}")


if __name__ == "__main__":
    main()
