"""`python -m validation kinova`: the goals' row of a measured arm: one encoder, fitted on one run, judged on another.

The comparison is that of `goals.two_runs`. Joints 2 and 4 by default; the others, but joint 1 whose sensor is dead in one
run, with --joints. Both runs have been looked at many times: practice, not proof.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from typing import Final

import numpy as np

from jtqd.estimator.checked import ConfigError
from jtqd.estimator.run import RunTableError
from jtqd.models.files import load_joint, shipped
from jtqd.sysid.fit.losses import LossFitError
from jtqd.sysid.runs.column_map import ColumnMap
from jtqd.sysid.runs.files import read_run
from jtqd.sysid.runs.run_file import RunError
from validation.goals.two_runs import INSIDE, METHODS, Case, Row, Run, one_encoder, rows_of, titles
from validation.measured.offline import JOINTS, RUNS

BY: Final = "python -m validation kinova"
TWO_RUNS: Final = range(2, 8)
"""Joints with a torque sensor in both runs."""


def rows(joints: Sequence[int] = JOINTS) -> list[Row]:
    """Fit and judge every joint both ways. Raises RunError, RunTableError, ConfigError, LossFitError, ValueError."""
    columns = ColumnMap.load(shipped("kinova_gen3/columns.yaml"))
    files = {run: read_run(shipped(f"kinova_gen3/{run}.csv.gz"), columns).table for run in RUNS}
    found: list[Row] = []
    for number in joints:
        joint = load_joint(shipped(f"kinova_gen3/joint{number}.yaml"))
        one, two = (
            Run(name, table.time_s, one_encoder(table.joints[number], joint)) for name, table in files.items()
        )
        found += rows_of(Case("Kinova Gen3", str(number), joint, (one, two)))
    return found


def markdown(found: Sequence[Row]) -> list[str]:
    """Return the table, and what holds of the goal."""
    named = titles()
    told = ", ".join(METHODS[name] for name in METHODS)
    lines = [
        f"| joint, judged on | {' | '.join(named.values())} | inside 90 %: {told} | standstill: {told} |",
        "|" + "---|" * (len(named) + 3),
    ]
    for row in found:
        numbers = (
            "-"
            if name not in row.rmse_nm
            else f"{'**' * (name == row.best_simple)}{row.rmse_nm[name]:.3f}{'**' * (name == row.best_simple)}"
            for name in named
        )
        inside, standing = (
            ", ".join("-" if np.isnan(each.get(n, np.nan)) else f"{each[n]:.0f} %" for n in METHODS)
            for each in (row.inside, row.standing)
        )
        lines.append(f"| {row.name}, {row.judged} | {' | '.join(numbers)} | {inside} | {standing} |")
    reached, honest = sum(row.reached for row in found), sum(row.honest for row in found)
    return [
        *lines,
        "",
        f"ours: error at most that of the best simple regression in {reached} of {len(found)}; "
        f"interval {INSIDE[0]:.0f} to {INSIDE[1]:.0f} % in {honest} of {len(found)}; "
        f"on average {np.mean([row.inside['ours'] for row in found]):.0f} %",
    ]


def main(argv: list[str] | None = None) -> int:
    """Print the row; exit status 0 done, whether the goal is reached or not, 1 failure, 2 usage."""
    parser = argparse.ArgumentParser(
        prog=BY, description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--joints", type=int, nargs="+", choices=TWO_RUNS, default=list(JOINTS), metavar="N", help="2 to 7"
    )
    options = parser.parse_args(argv)
    try:
        print("\n".join(markdown(rows(options.joints))))
    except (RunError, RunTableError, ConfigError, LossFitError, ValueError, OSError) as error:
        print(f"{BY}: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
