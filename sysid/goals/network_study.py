"""`python -m jtqd.sysid.goals.network_study`: what a network could still learn of what physics leaves on a plant.

    residual = sensor - physics      both as old as the estimate at 800 rad/s; trained on less each run's mean (its zeros)

Two networks, trained on the campaign's runs by whole runs. `waves`: gains of the waves of the motor angle over speed, motor
torque, torsion less current; it has no mean over a turn. `free`: a function of the same, the direction, the torsion's rate
and the waves themselves. Neither sees time, temperature, or an angle that is not periodic in the motor's turn: nothing that
tells which run it is. The share of either is chosen on runs left out; it is judged against the true torque, on days of the
goals' table.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.checked import ConfigError, count
from jtqd.estimator.methods import estimate_columns
from jtqd.estimator.observer import low_pass
from jtqd.sysid.evaluate.methods import OURS, SETTLE_S
from jtqd.sysid.goals.identify import (
    FIT_SEED,
    JUDGE_SEED,
    QUICK,
    TINY,
    Driven,
    Identified,
    Sizes,
    drive,
    identify_physics,
    judging_runs,
    nominal_joints,
    observed,
)
from jtqd.sysid.goals.judge import settings_of
from jtqd.sysid.goals.plants import PlantFile, the_three
from jtqd.sysid.train.network import Trained, forward, train
from jtqd.sysid.train.ours import gated_output, quick_part, safe_share

BY: Final = "python -m jtqd.sysid.goals.network_study"
ORDERS: Final = (1.0, 2.0, 3.0, 4.0)
EVERY: Final = 5
HIDDEN: Final = (24, 24)
FOLDS: Final = 4
_SLOW_RAD_S: Final = 0.05


@dataclass(frozen=True)
class Part:
    """Moving samples of a joint in a run: core [n, 3], extra [n, 3], waves [n, 8]; residual against the sensor, error of
    physics against the true torque as old, both [n].
    """

    core: FloatArray
    extra: FloatArray
    waves: FloatArray
    residual_nm: FloatArray
    error_nm: FloatArray

    @property
    def free(self) -> FloatArray:
        """Inputs of the free network [n, 14]."""
        return np.column_stack((self.core, self.extra, self.waves))


def part_of(run: Driven, one: Identified) -> Part:
    """Return what a network may see of a joint in a run, and what physics leaves there."""
    joint, settings = one.joint, replace(settings_of(OURS), track_torsion=False)
    columns = run.columns(one.number, joint)
    time_s = run.table.time_s
    dt = np.diff(time_s, prepend=time_s[0])
    found = estimate_columns(joint, settings, None, time_s, columns)
    seen = observed(run, columns, joint)
    rate = settings.own_torsion_bandwidth_rad_s
    assert columns.torque_nm is not None
    assert columns.motor_position_rad is not None
    angle = columns.motor_position_rad
    waves = np.column_stack(
        [low_pass(wave(order * angle), dt, rate) for order in ORDERS for wave in (np.cos, np.sin)]
    )
    torsion = np.nan_to_num(joint.stiffness_nm_per_rad * (seen.torsion_nm + seen.ahead_nm))
    twist_rate = low_pass(np.gradient(torsion, time_s), dt, settings.bandwidth_rad_s)
    keep = (time_s - time_s[0] >= SETTLE_S) & np.isfinite(found.torque_nm)
    keep &= np.abs(np.nan_to_num(seen.velocity_rad_s)) > _SLOW_RAD_S
    residual = (low_pass(columns.torque_nm, dt, rate) - found.torque_nm)[keep]
    true = low_pass(np.ascontiguousarray(run.true_nm[:, one.number - 1]), dt, rate)
    return Part(
        found.features[keep][:, :3],
        np.column_stack((seen.direction, torsion, twist_rate))[keep],
        waves[keep],
        residual,
        (found.torque_nm - true)[keep],
    )


class Made(NamedTuple):
    """A trained network, and which of the two it is."""

    name: str
    trained: Trained

    def correction(self, part: Part) -> FloatArray:
        """Return what it adds to physics [n]."""
        made = self.trained
        if self.name == "waves":
            return gated_output(made, part.core, part.waves)
        return forward(
            made.weights, made.input_mean, made.input_std, made.output_mean, made.output_std, part.free
        )


def made_of(name: str, parts: Sequence[Part], iterations: int) -> Made:
    """Train one of the two networks."""
    waves = name == "waves"
    features = np.concatenate([(part.core if waves else part.free)[::EVERY] for part in parts])
    targets = [
        quick_part(part.residual_nm) if waves else part.residual_nm - part.residual_nm.mean()
        for part in parts
    ]
    return Made(
        name,
        train(
            features,
            np.concatenate([target[::EVERY] for target in targets]),
            iterations=iterations,
            seed=0,
            hidden=HIDDEN,
            waves=np.concatenate([part.waves[::EVERY] for part in parts]) if waves else None,
            weight_decay=0.05,
            progress=lambda n, loss: None,
        ),
    )


def share_of(name: str, parts: Sequence[Part], iterations: int) -> float:
    """Return the share that improves the runs left out, their zeros included, and worsens none; 0 where there is none."""
    unseen = []
    for fold in range(FOLDS):
        made = made_of(name, [part for n, part in enumerate(parts) if n % FOLDS != fold], iterations)
        unseen += [(part.residual_nm, made.correction(part)) for part in parts[fold::FOLDS]]
    return safe_share(unseen)


class Outcome(NamedTuple):
    """A network on other days: its share, MSE [Nm^2] against the true torque with it and of physics, runs made worse."""

    share: float
    mse_nm2: float
    physics_nm2: float
    worse: int
    runs: int

    @property
    def off_percent(self) -> float:
        """By how much the RMSE falls [%]."""
        return 100.0 * (1.0 - float(np.sqrt(self.mse_nm2 / self.physics_nm2)))


def outcome(made: Made, share: float, parts: Sequence[Part]) -> Outcome:
    """Judge a share of a network on parts of other days."""
    errors = [part.error_nm + share * made.correction(part) for part in parts]
    pairs = [
        (float(np.mean(e * e)), float(np.mean(part.error_nm**2)))
        for e, part in zip(errors, parts, strict=True)
    ]
    every, plain = np.concatenate(errors), np.concatenate([part.error_nm for part in parts])
    worse = sum(ours > 1.001 * physics for ours, physics in pairs)
    return Outcome(share, float(np.mean(every**2)), float(np.mean(plain**2)), worse, len(parts))


def shares_of_error(parts: Sequence[Part]) -> tuple[float, float, float, float]:
    """Return the mean square error of physics [Nm^2]: all, the runs' means, slower and quicker than half a second."""
    mean = [np.full(len(part.error_nm), part.error_nm.mean()) for part in parts]
    quick = [quick_part(part.error_nm) for part in parts]
    slow = [part.error_nm - m - q for part, m, q in zip(parts, mean, quick, strict=True)]
    every = [part.error_nm for part in parts]
    a, b, c, d = (float(np.mean(np.concatenate(each) ** 2)) for each in (every, mean, slow, quick))
    return a, b, c, d


def noise_of(parts: Sequence[Part]) -> float:
    """Return the part [Nm^2] that changes from sample to sample: noise, which no input tells."""
    second = np.concatenate([np.diff(part.error_nm, 2) for part in parts])
    return float(np.mean(second**2)) / 6.0


def study(plant: PlantFile, sizes: Sizes, iterations: int, fit_seed: int, seed: int) -> list[str]:
    """Return the lines of the study of a plant."""
    models, excitation = identify_physics(plant, sizes, fit_seed)
    days = drive(plant.bench(), judging_runs(sizes, nominal_joints(plant), seed), seed)
    return [line for one in models for line in joint_lines(plant.name, one, excitation, days, iterations)]


def joint_lines(
    name: str, one: Identified, excitation: Sequence[Driven], days: Sequence[Driven], iterations: int
) -> list[str]:
    """Return the lines of one joint: what physics leaves, and both networks trained on `excitation`, judged on `days`."""
    known = [part_of(run, one) for run in excitation]
    other = [part for part in (part_of(run, one) for run in days) if len(part.error_nm) > EVERY]
    every, mean, slow, quick = shares_of_error(other)
    noise = noise_of(other)
    most = 100.0 * (1.0 - float(np.sqrt((mean + noise) / every)))
    parts = ", ".join(
        f"{text} {100 * each / every:.0f} %"
        for text, each in (
            ("the runs' means", mean),
            ("slower than half a second", slow),
            ("quicker", quick),
            ("of it from sample to sample", noise),
        )
    )
    lines = [
        f"{name}, {one.joint.name}: physics leaves {every:.4f} Nm^2 on {len(other)} runs of other days: {parts}",
        f"  the RMSE would fall by {most:.0f} % if all of it were learned but the runs' means and the noise",
    ]
    for kind in ("waves", "free"):
        made = made_of(kind, known, iterations)
        for text, share in (("whole", 1.0), ("its safe share", share_of(kind, known, iterations))):
            found, seen = outcome(made, share, other), outcome(made, share, known)
            lines.append(
                f"  {kind}, {text} ({share:.2f}): RMSE falls by {found.off_percent:.1f} %, worse in {found.worse} of "
                f"{found.runs} runs; on the runs it was trained on by {seen.off_percent:.1f} %"
            )
    return lines


def main(argv: list[str] | None = None) -> int:
    """Print the study; exit status 0 done, 1 failure, 2 usage."""
    parser = argparse.ArgumentParser(
        prog=BY, description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    names = {plant.name.replace(" ", "_"): plant for plant in the_three()}
    parser.add_argument("--plant", choices=names, default="typical", help="default typical")
    parser.add_argument(
        "--iterations", type=count, default=20, metavar="N", help="of each training (default 20)"
    )
    parser.add_argument("--tiny", action="store_true", help="to test the steps")
    options = parser.parse_args(argv)
    try:
        sizes = TINY if options.tiny else QUICK
        lines = study(names[options.plant], sizes, options.iterations, FIT_SEED, JUDGE_SEED)
    except (ConfigError, ValueError, OSError) as error:
        print(f"network_study: {error}", file=sys.stderr)
        return 1
    print("\n".join(lines))
    return 0


if __name__ == "__main__":
    sys.exit(main())
