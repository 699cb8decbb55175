"""`python -m jtqd.sysid.evaluate.bandwidths`: noise of the fused estimate against its age, by the bandwidth of its torsion.

One row per bandwidth, over emulated runs with their true torque: what a controller meets (error against the torque now,
in motion), what is left when the age is no error, the noise from sample to sample, and the share of samples in motion
inside the 90 % interval.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from jtqd.estimator.age import age_ms, aligned
from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.checked import ConfigError
from jtqd.estimator.fusion import GAUSS
from jtqd.estimator.joint import Joint
from jtqd.estimator.methods import estimate_columns
from jtqd.estimator.run import JointColumns, RunTableError
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.status import DEGRADED, VALID
from jtqd.sysid.evaluate.methods import OURS, SETTLE_S, load_models
from jtqd.sysid.runs.files import RunError, read_runs
from jtqd.sysid.runs.truth import read_truth

BANDWIDTHS_RAD_S: Final = (200.0, 300.0, 400.0, 600.0, 800.0, 1200.0, 1600.0)
_EXAMPLE: Final = "example: python -m jtqd.sysid.evaluate.bandwidths days --models models/trained"


@dataclass(frozen=True)
class Tradeoff:
    """One bandwidth [rad/s]: age [ms], errors and noise in % of rated torque (RMS), coverage in %; over all runs."""

    bandwidth_rad_s: float
    age_ms: float
    now_percent: float
    aligned_percent: float
    noise_percent: float
    inside_percent: float


@dataclass(frozen=True)
class TrueRun:
    """One joint of a run: columns and the true torque [n]."""

    joint: Joint
    time_s: FloatArray
    columns: JointColumns
    true_nm: FloatArray


def tradeoff(runs: Sequence[TrueRun], bandwidth_rad_s: float) -> Tradeoff:
    """Score one bandwidth of the torsion over runs of joints with torsion. Raises ValueError without samples in motion."""
    settings = EstimatorSettings(method=OURS, torsion_bandwidth_rad_s=bandwidth_rad_s)
    now, fair, noise, inside = [], [], [], []
    for run in runs:
        found = estimate_columns(run.joint, settings, None, run.time_s, run.columns)
        dt = np.diff(run.time_s, prepend=run.time_s[0])
        moving = np.isin(found.status, (VALID, DEGRADED)) & (run.time_s - run.time_s[0] >= SETTLE_S)
        error = found.torque_nm - aligned(run.true_nm, dt, run.joint, settings)
        rated = run.joint.rated_torque_nm
        now.append((found.torque_nm - run.true_nm)[moving] / rated)
        fair.append(error[moving] / rated)
        # a second difference knows nothing of slow errors; of white noise it is sqrt(6) times as large
        noise.append(np.diff(error, 2)[moving[2:] & moving[1:-1] & moving[:-2]] / (rated * 6.0**0.5))
        inside.append((np.abs(error) <= GAUSS * found.sigma_nm)[moving])
    if not sum(map(len, now)):
        raise ValueError("found no samples in motion, expected some")
    joint = runs[0].joint
    return Tradeoff(
        bandwidth_rad_s,
        age_ms(joint, settings),
        _rms_percent(now),
        _rms_percent(fair),
        _rms_percent(noise),
        100.0 * float(np.mean(np.concatenate(inside))),
    )


def _rms_percent(parts: Sequence[FloatArray]) -> float:
    return 100.0 * float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))


def true_runs(paths: Sequence[Path], models: Path, link_noise_urad: float, seed: int) -> list[TrueRun]:
    """Return all joints of runs with their true torque; white noise of this RMS is added to the link positions.

    Raises RunError, RunTableError, ConfigError, and ValueError for a run without true torque.
    """
    noise = np.random.default_rng(seed)
    found = []
    joints = {each.number: each.joint for each in load_models(models)}
    for file in read_runs(paths, None):
        truth = read_truth(file.path)
        for number, joint in joints.items():
            if number not in truth:
                raise ValueError(
                    f"{file.name}: found no true torque of joint {number}, expected NAME.truth.npz beside it"
                )
            columns = file.table.joint(number, joint.gear_ratio)
            if link_noise_urad and columns.link_position_rad is not None:
                added = 1e-6 * link_noise_urad * noise.standard_normal(len(file.table.time_s))
                columns = replace(columns, link_position_rad=columns.link_position_rad + added)
            found.append(TrueRun(joint, file.table.time_s, columns, truth[number]))
    return found


def lines(rows: Sequence[Tradeoff]) -> list[str]:
    """Return the table as text."""
    head = "torsion [rad/s]  age [ms]  RMSE now [%]  aligned [%]  noise [%]  inside 90 % [%]"
    return [
        head,
        *(
            f"{row.bandwidth_rad_s:15.0f}  {row.age_ms:8.2f}  {row.now_percent:12.2f}  {row.aligned_percent:11.2f}  "
            f"{row.noise_percent:9.3f}  {row.inside_percent:15.1f}"
            for row in rows
        ),
    ]


def main(argv: list[str]) -> int:
    """Print the table; exit status 0 done, 1 failure, 2 usage."""
    parser = argparse.ArgumentParser(
        prog="python -m jtqd.sysid.evaluate.bandwidths",
        description="Noise against age: the fused estimate by the bandwidth of its torsion, in % of rated torque.",
        epilog=_EXAMPLE,
    )
    parser.add_argument(
        "runs", type=Path, nargs="+", metavar="RUNS", help="emulated runs, or directories of them"
    )
    parser.add_argument(
        "--models", type=Path, required=True, metavar="DIR", help="joint files with section fused"
    )
    parser.add_argument(
        "--link-noise", type=float, default=0.0, metavar="URAD", help="added to the link encoder"
    )
    parser.add_argument("--seed", type=int, default=0, help="of that noise")
    options = parser.parse_args(argv)
    try:
        runs = true_runs(options.runs, options.models, options.link_noise, options.seed)
        print("\n".join(lines([tradeoff(runs, bandwidth) for bandwidth in BANDWIDTHS_RAD_S])))
    except (ConfigError, RunError, RunTableError, ValueError, OSError) as error:
        print(f"bandwidths: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
