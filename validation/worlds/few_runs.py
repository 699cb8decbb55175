"""`python -m validation few_runs_mujoco`: two short runs of one encoder (`validation.goals.few_runs`) in MuJoCo.

What the joint files do not say is hidden in all runs: another Coulomb and viscous friction, friction by load, another torque
constant, a zero of the current; their rotor inertia is a guess, too.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np

from jtqd.estimator.joint import Joint
from jtqd.estimator.run import JointColumns
from validation.goals.few_runs import guessed, window
from validation.goals.two_runs import Case, rows_of, summary
from validation.worlds.mujoco_bench import MujocoBench
from validation.worlds.sets import Hidden

SEEDS: Final = range(9581, 9606)
_COLUMNS: Final = (
    "current_a",
    "motor_position_rad",
    "motor_velocity_rad_s",
    "link_position_rad",
    "torque_nm",
)


def cases(seeds: Sequence[int]) -> Iterator[Case]:
    """Yield both joints of the bench for each seed."""
    for seed in seeds:
        rng = np.random.default_rng([seed, 77])
        hidden = [each for number in (1, 2) for each in _hidden(number, rng)]
        made = MujocoBench(2, 8.0).draw(seed, hidden)
        for number in (1, 2):
            rng = np.random.default_rng([seed, number])
            joint = guessed(Joint.from_mapping(dict(made.joints[number]), "mujoco"), rng, friction=0.0)
            runs = []
            for n, columns in enumerate(made.runs):
                own = JointColumns(
                    **{key: columns[f"j{number}.{key}"] for key in (*_COLUMNS, "temperature_c")}
                )
                runs.append(window(f"run{n + 1}", columns["time_s"], own, joint, rng))
            one, two = runs
            if one is not None and two is not None:
                yield Case("MuJoCo", f"{number}, seed {seed}", joint, (one, two))


def _hidden(number: int, rng: np.random.Generator) -> list[Hidden]:
    sizes = {
        "load_dependent_friction": rng.uniform(0.0, 0.15),
        "torque_constant": 0.03 * rng.normal(),
        "current_offset": 0.01 * rng.normal(),
        "coulomb_friction": 0.02 * rng.normal(),
        "viscous_friction": 0.015 * rng.normal(),
    }
    return [Hidden(name, number, abs(float(size))) for name, size in sizes.items()]


def main(argv: list[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m validation few_runs_mujoco", description=__doc__)
    parser.add_argument("--first", type=int, default=SEEDS.start, metavar="SEED")
    parser.add_argument("--seeds", type=int, default=len(SEEDS), metavar="N")
    options = parser.parse_args(argv)
    seeds = range(options.first, options.first + options.seeds)
    print("\n".join(summary([row for case in cases(seeds) for row in rows_of(case)])))
    return 0


if __name__ == "__main__":
    sys.exit(main())
