"""`python -m jtqd.sysid.evaluate.bandwidths`: noise of the fused estimate against its age, by the filter of its torsion.

One row per bandwidth of the low pass, and per rate of the torsion's tracking filter (`+`), over emulated runs with their
true torque: what a controller meets (error against the torque now, in motion), what is left when the age is no error, the
noise from sample to sample in motion and at standstill, and the share of samples in motion inside the 90 % interval. Below
it, what the age of a low pass alone costs, and at what frequencies.
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
from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.estimator.checked import ConfigError
from jtqd.estimator.fusion import GAUSS
from jtqd.estimator.joint import Joint, Tracking
from jtqd.estimator.methods import estimate_columns
from jtqd.estimator.observer import low_pass
from jtqd.estimator.run import JointColumns, RunTableError
from jtqd.estimator.settings import TORSION_BANDWIDTH_RAD_S, EstimatorSettings
from jtqd.estimator.status import DEGRADED, STANDSTILL, VALID
from jtqd.sysid.evaluate.methods import OURS, SETTLE_S, load_models
from jtqd.sysid.fit.tracking import TRACKING_RAD_S, WAVE_RAD_S
from jtqd.sysid.runs.files import read_runs
from jtqd.sysid.runs.run_file import RunError
from jtqd.sysid.runs.truth import read_truth

BANDWIDTHS_RAD_S: Final = (200.0, 300.0, 400.0, 600.0, 800.0, 1200.0, 1600.0)
RATES_RAD_S: Final = (200.0, 300.0, 400.0, 500.0, 600.0)
"""Of the torsion's tracking filter; its wave's is in proportion."""
_MOVING_RAD_S: Final = 0.05
_PIECE: Final = 400
"""Samples of a spectrum: 2.5 Hz at 1 kHz."""
_RIPPLE_HZ: Final = (20.0, 100.0)
_EXAMPLE: Final = "example: python -m jtqd.sysid.evaluate.bandwidths days --models models/trained"


@dataclass(frozen=True)
class Tradeoff:
    """One filter: bandwidth or rate [rad/s], whether it tracks the torsion, age [ms], errors and noise in % of rated torque
    (RMS), coverage in %; over all runs.
    """

    bandwidth_rad_s: float
    tracks: bool
    age_ms: float
    now_percent: float
    aligned_percent: float
    noise_percent: float
    standing_percent: float
    inside_percent: float


@dataclass(frozen=True)
class TrueRun:
    """One joint of a run: columns and the true torque [n]."""

    joint: Joint
    time_s: FloatArray
    columns: JointColumns
    true_nm: FloatArray


def tradeoff(runs: Sequence[TrueRun], bandwidth_rad_s: float, *, tracks: bool = False) -> Tradeoff:
    """Score one filter over runs of joints with torsion. Raises ValueError without samples in motion.

    tracks: the torsion at this rate, in place of the low pass of this bandwidth; sigma is that of the joint file's rate.
    """
    settings = EstimatorSettings(method=OURS, track_torsion=True)
    if not tracks:
        settings = EstimatorSettings(method=OURS, torsion_bandwidth_rad_s=bandwidth_rad_s)
    now, fair, noise, standing, inside = [], [], [], [], []
    for run in runs:
        joint = _at_rate(run.joint, bandwidth_rad_s) if tracks else run.joint
        found = estimate_columns(joint, settings, None, run.time_s, run.columns)
        dt = np.diff(run.time_s, prepend=run.time_s[0])
        settled = run.time_s - run.time_s[0] >= SETTLE_S
        moving = settled & np.isin(found.status, (VALID, DEGRADED))
        error = found.torque_nm - aligned(run.true_nm, dt, joint, settings)
        rated = run.joint.rated_torque_nm
        now.append((found.torque_nm - run.true_nm)[moving] / rated)
        fair.append(error[moving] / rated)
        # a second difference knows nothing of slow errors; of white noise it is sqrt(6) times as large
        rough = np.diff(error, 2) / (rated * 6.0**0.5)
        noise.append(rough[_three(moving)])
        standing.append(rough[_three(settled & (found.status == STANDSTILL))])
        inside.append((np.abs(error) <= GAUSS * found.sigma_nm)[moving])
    if not sum(map(len, now)):
        raise ValueError("found no samples in motion, expected some")
    return Tradeoff(
        bandwidth_rad_s,
        tracks,
        age_ms(joint, settings),
        _rms_percent(now),
        _rms_percent(fair),
        _rms_percent(noise),
        _rms_percent(standing),
        100.0 * float(np.mean(np.concatenate(inside))),
    )


def _at_rate(joint: Joint, rate_rad_s: float) -> Joint:
    fused = joint.fused
    if fused is None:
        raise ValueError(f"joint {joint.name}: found no section fused, expected one")
    known = fused.tracking or Tracking(rate_rad_s, 0.0, 0.0)
    wave = rate_rad_s * WAVE_RAD_S / TRACKING_RAD_S
    at_rate = replace(known, rate_rad_s=rate_rad_s, wave_rad_s=wave)
    return replace(joint, fused=replace(fused, tracking=at_rate))


def _three(where: BoolArray) -> BoolArray:
    result: BoolArray = where[2:] & where[1:-1] & where[:-2]
    return result


def _rms_percent(parts: Sequence[FloatArray]) -> float:
    every = np.concatenate(parts)
    return 100.0 * float(np.sqrt(np.mean(every**2))) if len(every) else float("nan")


@dataclass(frozen=True)
class Cost:
    """What an age alone costs, of the true torque itself: RMS in % of rated; share [%] of its square within _RIPPLE_HZ."""

    percent: float
    ripple_percent: float


def cost_of_age(runs: Sequence[TrueRun], bandwidth_rad_s: float = TORSION_BANDWIDTH_RAD_S) -> Cost:
    """Return what a low pass takes off the true torque of moving joints. Raises ValueError without 0.4 s of motion."""
    square = ripple = count = 0.0
    for run in runs:
        dt = np.diff(run.time_s, prepend=run.time_s[0])
        error = (low_pass(run.true_nm, dt, bandwidth_rad_s) - run.true_nm) / run.joint.rated_torque_nm
        speed = run.columns.motor_velocity_rad_s
        assert speed is not None
        moving = np.abs(speed) > _MOVING_RAD_S * run.joint.gear_ratio
        hz = np.fft.rfftfreq(_PIECE, float(np.median(dt)))
        inside = (hz >= _RIPPLE_HZ[0]) & (hz <= _RIPPLE_HZ[1])
        for first in range(0, len(error) - _PIECE + 1, _PIECE):
            piece = slice(first, first + _PIECE)
            if not moving[piece].all():
                continue
            part = error[piece]
            power = np.abs(np.fft.rfft((part - part.mean()) * np.hanning(_PIECE))) ** 2
            ripple += float(part @ part) * float(power[inside].sum() / power.sum())
            square += float(part @ part)
            count += _PIECE
    if not count:
        raise ValueError("found no 0.4 s of motion, expected some")
    return Cost(100.0 * float(np.sqrt(square / count)), 100.0 * ripple / square)


def latched_beside(
    columns: JointColumns, time_s: FloatArray, beside_s: FloatArray, gear_ratio: float
) -> JointColumns:
    """Return a joint whose encoders were latched [n] s after the stamp, both at one instant, with the motor's speed."""
    motor, link, speed = columns.motor_position_rad, columns.link_position_rad, columns.motor_velocity_rad_s
    assert motor is not None
    assert link is not None
    assert speed is not None
    twist = low_pass(motor / gear_ratio - link, np.diff(time_s, prepend=time_s[0]), TORSION_BANDWIDTH_RAD_S)
    moved = speed * beside_s
    return replace(
        columns,
        motor_position_rad=motor + moved,
        link_position_rad=link + moved / gear_ratio - np.gradient(twist, time_s) * beside_s,
    )


def true_runs(
    paths: Sequence[Path], models: Path, link_noise_urad: float, seed: int, late_us: float = 0.0
) -> list[TrueRun]:
    """Return all joints of runs with their true torque.

    White noise of an RMS of link_noise_urad is added to the link positions; late_us: RMS by which the encoders of a sample
    were latched beside its stamp, both joints' alike.

    Raises RunError, RunTableError, ConfigError, and ValueError for a run without true torque.
    """
    noise = np.random.default_rng(seed)
    found = []
    joints = {each.number: each.joint for each in load_models(models)}
    for file in read_runs(paths, None):
        truth = read_truth(file.path)
        beside = 1e-6 * late_us * noise.standard_normal(len(file.table.time_s)) if late_us else None
        for number, joint in joints.items():
            if number not in truth:
                raise ValueError(
                    f"{file.name}: found no true torque of joint {number}, expected NAME.truth.npz beside it"
                )
            columns = file.table.joint(number, joint.gear_ratio)
            if link_noise_urad and columns.link_position_rad is not None:
                added = 1e-6 * link_noise_urad * noise.standard_normal(len(file.table.time_s))
                columns = replace(columns, link_position_rad=columns.link_position_rad + added)
            if beside is not None:
                columns = latched_beside(columns, file.table.time_s, beside, joint.gear_ratio)
            found.append(TrueRun(joint, file.table.time_s, columns, truth[number]))
    return found


def lines(rows: Sequence[Tradeoff]) -> list[str]:
    """Return the table as text."""
    head = "torsion [rad/s]  age [ms]  RMSE now [%]  aligned [%]  noise: moving, at rest [%]  inside 90 % [%]"
    return [
        head,
        *(
            f"{'+' * row.tracks + format(row.bandwidth_rad_s, '.0f'):>15}  {row.age_ms:8.2f}  {row.now_percent:12.2f}  "
            f"{row.aligned_percent:11.2f}  {row.noise_percent:18.3f}, {row.standing_percent:.3f}  "
            f"{row.inside_percent:15.1f}"
            for row in rows
        ),
    ]


def main(argv: list[str]) -> int:
    """Print the table; exit status 0 done, 1 failure, 2 usage."""
    parser = argparse.ArgumentParser(
        prog="python -m jtqd.sysid.evaluate.bandwidths",
        description="Noise against age: the fused estimate by the filter of its torsion, in % of rated torque.",
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
    parser.add_argument(
        "--late",
        type=float,
        default=0.0,
        metavar="US",
        help="by so much (RMS) both encoders are latched beside the stamp",
    )
    parser.add_argument("--seed", type=int, default=0, help="of what is added")
    options = parser.parse_args(argv)
    try:
        runs = true_runs(options.runs, options.models, options.link_noise, options.seed, options.late)
        rows = [tradeoff(runs, bandwidth) for bandwidth in BANDWIDTHS_RAD_S]
        rows += [tradeoff(runs, rate, tracks=True) for rate in RATES_RAD_S]
        cost = cost_of_age(runs)
        print("\n".join(lines(rows)))
        print(
            f"age of a low pass of {TORSION_BANDWIDTH_RAD_S:.0f} rad/s alone: {cost.percent:.2f} % of rated, "
            f"{cost.ripple_percent:.0f} % of its square at {_RIPPLE_HZ[0]:.0f} to {_RIPPLE_HZ[1]:.0f} Hz; "
            "+: the torsion tracked at that rate"
        )
    except (ConfigError, RunError, RunTableError, ValueError, OSError) as error:
        print(f"bandwidths: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
