"""`python -m validation few_runs`: two short runs of one encoder, on joints that no choice was made on.

The three plants of the goals, each seed another day, motion and file: runs at varying speed and load, of which two windows
of 2 to 5 s are all that is known, many with motion in one direction only. The joint files are wrong as guesses are:
friction by a factor (35 %, standard deviation of its logarithm), rotor inertia (20 %), torque constant (2 % beside what the
plant has of its own). Each window fits once and judges once. `python -m validation few_runs_mujoco` is the same in MuJoCo.

--priors --first 500 --seeds 15: how the error changes with each number of the prior, where they were chosen.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import fields, replace
from typing import Any, Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.checked import ConfigError
from jtqd.estimator.joint import Joint
from jtqd.estimator.run import JointColumns
from jtqd.sysid.fit.few_runs import PRIOR, Prior
from jtqd.sysid.fit.losses import LossFitError
from jtqd.sysid.planner.campaigns import variable_runs
from jtqd.sysid.planner.plan import DEFAULT_LIMITS
from validation.goals.identify import NUMBERS, drive, nominal_joints
from validation.goals.plants import PlantFile, the_three
from validation.goals.two_runs import Case, Run, errors_of_ours, one_encoder, rows_of, summary

BY: Final = "python -m validation few_runs"
SEEDS: Final = range(9571, 9596)
"""Of the table in docs/results.md; those of 500 and up are for choices."""
RUN_S: Final = 9.0
_WINDOW_S: Final = (2.0, 5.0)
_MOVING_RAD_S: Final = 0.05
_MOVING_SHARE: Final = 0.5
_TRIES: Final = 40


def guessed(joint: Joint, rng: np.random.Generator, friction: float = 0.35) -> Joint:
    """Return a joint file that is wrong as guesses are; friction: standard deviation of the logarithm of its factors."""
    coulomb, viscous, inertia, constant = rng.normal(size=4)
    old = joint.friction
    new = replace(
        old,
        coulomb_nm=old.coulomb_nm * float(np.exp(friction * coulomb)),
        viscous_nms_per_rad=old.viscous_nms_per_rad * float(np.exp(friction * viscous)),
    )
    return replace(
        joint,
        friction=new,
        rotor_inertia_kgm2=joint.rotor_inertia_kgm2 * float(np.exp(0.2 * inertia)),
        torque_constant_nm_per_a=joint.torque_constant_nm_per_a * float(1.0 + 0.02 * constant),
        efficiency=None,
        fused=None,
    )


def window(
    name: str, time_s: FloatArray, columns: JointColumns, joint: Joint, rng: np.random.Generator
) -> Run | None:
    """Return a piece of a run of 2 to 5 s, at least half of it in motion; None where none was drawn."""
    rate = 1.0 / float(np.median(np.diff(time_s)))
    for _ in range(_TRIES):
        length = min(round(rate * rng.uniform(*_WINDOW_S)), len(time_s))
        rows = slice(start := int(rng.integers(0, len(time_s) - length + 1)), start + length)
        piece = _cut(columns, rows)
        assert piece.motor_velocity_rad_s is not None
        speed = np.abs(piece.motor_velocity_rad_s) / joint.gear_ratio
        if float(np.mean(speed > _MOVING_RAD_S)) > _MOVING_SHARE:
            return Run(name, time_s[rows] - time_s[start], one_encoder(piece, joint))
    return None


def _cut(columns: JointColumns, rows: slice) -> JointColumns:
    values: dict[str, Any] = {item.name: getattr(columns, item.name) for item in fields(columns)}
    arrays: dict[str, Any] = {key: each[rows] for key, each in values.items() if isinstance(each, np.ndarray)}
    return replace(columns, **arrays)


def plant_cases(plant: PlantFile, seeds: Sequence[int]) -> Iterator[Case]:
    """Yield both joints of a plant for each seed. Raises ConfigError."""
    bench, nominal = plant.bench(), nominal_joints(plant)
    for seed in seeds:
        driven = drive(bench, variable_runs(DEFAULT_LIMITS, 2, RUN_S, seed=seed, joints=nominal), seed)
        for number in NUMBERS:
            rng = np.random.default_rng([seed, number])
            joint = guessed(nominal[number - 1], rng)
            one, two = (
                window(run.name, run.table.time_s, run.columns(number, joint), joint, rng) for run in driven
            )
            if one is not None and two is not None:
                yield Case(plant.name, f"{number}, seed {seed}", joint, (one, two))


def priors_table(cases: Sequence[Case]) -> list[str]:
    """Return how the error changes with each number of the prior halved and doubled, one line per number."""
    changed = [PRIOR] + [
        PRIOR._replace(**{name: factor * getattr(PRIOR, name)})
        for name in Prior._fields
        for factor in (0.5, 2.0)
    ]
    worlds = dict.fromkeys(case.world for case in cases)
    error = {
        world: np.sqrt(
            np.mean(
                np.concatenate([errors_of_ours(c, changed) for c in cases if c.world == world], axis=1) ** 2,
                axis=1,
            )
        )
        for world in worlds
    }
    lines = [f"| {BY} --priors: RMSE | {' | '.join(worlds)} |", "|" + "---|" * (len(worlds) + 1)]
    lines.append(
        "| as it is | " + " | ".join(f"{100.0 * each[0]:.2f} % of rated" for each in error.values()) + " |"
    )
    for n, name in enumerate(Prior._fields):
        cells = (
            ", ".join(f"{100.0 * (each[1 + 2 * n + k] / each[0] - 1.0):+.0f} %" for k in range(2))
            for each in error.values()
        )
        lines.append(f"| {name} = {getattr(PRIOR, name):g}, halved, doubled | {' | '.join(cells)} |")
    return lines


def main(argv: list[str] | None = None) -> int:
    """Print the table; exit status 0 done, 1 failure, 2 usage."""
    parser = argparse.ArgumentParser(
        prog=BY, description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--first", type=int, default=SEEDS.start, metavar="SEED", help="default %(default)s")
    parser.add_argument("--seeds", type=int, default=len(SEEDS), metavar="N", help="default %(default)s")
    parser.add_argument(
        "--priors", action="store_true", help="how the error of ours changes with each number of the prior"
    )
    options = parser.parse_args(argv)
    seeds = range(options.first, options.first + options.seeds)
    if not seeds:
        parser.error(f"--seeds: found {options.seeds}, expected at least 1")
    try:
        cases = [case for plant in the_three() for case in plant_cases(plant, seeds)]
        lines = (
            priors_table(cases) if options.priors else summary([r for case in cases for r in rows_of(case)])
        )
    except (ConfigError, LossFitError, ValueError) as error:
        print(f"{BY}: {error}", file=sys.stderr)
        return 1
    print("\n".join(lines))
    return 0


if __name__ == "__main__":
    sys.exit(main())
