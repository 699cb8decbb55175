"""`python -m jtqd.sysid.goals.kinova`: the goals' row of a measured arm: one encoder, fitted on one run, judged on another.

Ours is what jtqd has for such a joint: `tob`, Coulomb and viscous friction fitted (`jtq measured`), and `fused` without
torsion, its losses and sigma fitted to eight pieces of the run, because `jtq fit losses` wants at least six runs. Beside
them stand the baselines of the goals' table that need one encoder, and least squares on current and speed:

    current and speed     tau = a0 + a1 tau_raw + a2 s + a3 v + a4 s |tau_raw|

All are fitted to the same run and judged on the same samples of the other: in motion, against the torque sensor of the same
age. The best of the baselines is the one that is best there, which nobody could have known before.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import fields, replace
from itertools import pairwise
from typing import Any, Final, NamedTuple, TypeVar

import numpy as np

from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.estimator.checked import ConfigError
from jtqd.estimator.fusion import GAUSS
from jtqd.estimator.joint import Joint
from jtqd.estimator.methods import estimate_columns
from jtqd.estimator.run import JointColumns, ObservedRun, RunTableError
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.status import DEGRADED, STANDSTILL, VALID
from jtqd.models.files import load_joint, shipped
from jtqd.sysid.fit.friction import FitError, fit_friction
from jtqd.sysid.fit.fused import fit_fused
from jtqd.sysid.fit.losses import LossFitError
from jtqd.sysid.fit.signals import RunSignals, run_signals
from jtqd.sysid.goals.baselines import BASELINES, Baseline, Example, fit_baseline
from jtqd.sysid.measured.offline import JOINTS, RUNS
from jtqd.sysid.runs.column_map import ColumnMap
from jtqd.sysid.runs.files import RunError, RunFile, read_run

BY: Final = "python -m jtqd.sysid.goals.kinova"
PIECES: Final = 8
INSIDE: Final = (85.0, 95.0)
"""Of an honest 90 % interval [%], as on the bench `bad_day`."""
METHODS: Final = ("tob", "fused")
"""Ours."""


def _current_and_speed(seen: ObservedRun) -> FloatArray:
    raw, s, v = seen.raw_nm, seen.direction, seen.velocity_rad_s
    return np.column_stack((np.ones_like(raw), raw, s, v, s * np.abs(raw)))


SIMPLE: Final = {
    "current": Baseline(
        "least squares on current and speed, 5 coefficients", False, False, _current_and_speed
    ),
    "tob_load": BASELINES["tob_load"],
    "tob_fitted": BASELINES["tob_fitted"],
}


_Rows = TypeVar("_Rows", RunSignals, ObservedRun)


class Row(NamedTuple):
    """One joint in one run, by method: RMSE in motion [Nm]; of ours, how often the 90 % interval holds the sensor in motion,
    and value +- sigma at standstill [%, NaN without such samples]. A method that cannot be fitted to the run is in none.
    """

    joint: int
    judged: str
    fitted: str
    rmse_nm: dict[str, float]
    inside: dict[str, float]
    standing: dict[str, float]

    @property
    def best_simple(self) -> str:
        """Name of the baseline that is best on the judged run."""
        return min(SIMPLE, key=lambda name: self.rmse_nm[name])


def pieces_of(run: RunSignals, count: int = PIECES) -> list[RunSignals]:
    """Cut a run into pieces of equal length: as many runs, but all of one day."""
    edges = np.linspace(0, len(run.sensor_nm), count + 1).astype(int).tolist()
    return [
        _cut(replace(run, name=f"{run.name}.{n}", as_read=None, seen=_cut(run.seen, rows)), rows)
        for n, rows in enumerate(slice(a, b) for a, b in pairwise(edges))
    ]


def _cut(of: _Rows, rows: slice) -> _Rows:
    """Return these rows of every array."""
    values: dict[str, Any] = {item.name: getattr(of, item.name) for item in fields(of)}
    arrays: dict[str, Any] = {key: each[rows] for key, each in values.items() if isinstance(each, np.ndarray)}
    return replace(of, **arrays)


def rows() -> list[Row]:
    """Fit and judge every joint both ways. Raises RunError, RunTableError, ConfigError, FitError, ValueError."""
    columns = ColumnMap.load(shipped("kinova_gen3/columns.yaml"))
    files = {run: read_run(shipped(f"kinova_gen3/{run}.csv.gz"), columns) for run in RUNS}
    return [
        _row(
            load_joint(columns.joint_files[number]), number, (fitted, files[fitted]), (judged, files[judged])
        )
        for number in JOINTS
        for judged, fitted in (RUNS, RUNS[::-1])
    ]


def _row(joint: Joint, number: int, known: tuple[str, RunFile], other: tuple[str, RunFile]) -> Row:
    """Fit a joint to the run `known`, and judge it on the run `other`."""
    settings = {name: EstimatorSettings(method=name) for name in METHODS}
    (fitted, known_table), (judged, table) = ((name, file.table) for name, file in (known, other))
    columns = _one_encoder(table.joints[number], joint)
    learned, seen = (
        run_signals(name, joint, settings["tob"], each.time_s, _one_encoder(each.joints[number], joint))
        for name, each in ((fitted, known_table), (judged, table))
    )
    friction = fit_friction(known_table.time_s, known_table.joints[number], joint).friction
    joints = {"tob": replace(joint, friction=friction)}
    with suppress(LossFitError):  # too little motion in one direction
        fused = fit_fused(pieces_of(learned), joint.friction, with_torsion=False).fused
        joints["fused"] = replace(joint, fused=fused)
    example = Example(learned.seen, learned.sensor_nm, learned.sensor_nm, learned.moving)
    found = {
        name: estimate_columns(each, settings[name], None, table.time_s, columns)
        for name, each in joints.items()
    }
    keep = seen.moving.copy()
    for each in found.values():
        keep &= np.isin(each.status, (VALID, DEGRADED))
    errors = {name: each.torque_nm - seen.sensor_nm for name, each in found.items()}
    errors |= {
        name: each.estimate(seen.seen, fit_baseline(each, [example])) - seen.sensor_nm
        for name, each in SIMPLE.items()
    }
    return Row(
        number,
        judged,
        fitted,
        {name: float(np.sqrt(np.mean(each[keep] ** 2))) for name, each in errors.items()},
        {name: _inside(errors[name], GAUSS * each.sigma_nm, keep) for name, each in found.items()},
        {
            name: _inside(errors[name], each.sigma_nm, seen.standing & (each.status == STANDSTILL))
            for name, each in found.items()
        },
    )


def _one_encoder(columns: JointColumns, joint: Joint) -> JointColumns:
    """Return the columns with the link's position that the motor's tells: there is one encoder."""
    assert columns.motor_position_rad is not None
    return replace(columns, link_position_rad=columns.motor_position_rad / joint.gear_ratio)


def _inside(error: FloatArray, half: FloatArray, where: BoolArray) -> float:
    return 100.0 * float(np.mean(np.abs(error[where]) <= half[where])) if where.any() else float("nan")


def markdown(found: Sequence[Row]) -> list[str]:
    """Return the table, and what holds of the goal."""
    names = (*METHODS, *SIMPLE)
    titles = ("ours, `tob`", "ours, `fused`", *(each.title for each in SIMPLE.values()))
    lines = [
        "| joint, judged on | "
        + " | ".join(titles)
        + " | inside 90 %: `tob`, `fused` | standstill: `tob`, `fused` |",
        "|" + "---|" * (len(names) + 3),
    ]
    for row in found:
        numbers = (
            "-"
            if n not in row.rmse_nm
            else f"{'**' * (n == row.best_simple)}{row.rmse_nm[n]:.3f}{'**' * (n == row.best_simple)}"
            for n in names
        )
        inside, standing = (
            ", ".join("-" if np.isnan(each.get(n, np.nan)) else f"{each[n]:.0f} %" for n in METHODS)
            for each in (row.inside, row.standing)
        )
        lines.append(f"| {row.joint}, {row.judged} | " + " | ".join(numbers) + f" | {inside} | {standing} |")
    lines += ["", *(_verdict(found, name) for name in METHODS)]
    return lines


def _verdict(every: Sequence[Row], name: str) -> str:
    found = [row for row in every if name in row.rmse_nm]
    left = len(every) - len(found)
    note = f"; not fitted in {left}: too little motion in one direction" if left else ""
    error = sum(row.rmse_nm[name] <= row.rmse_nm[row.best_simple] for row in found)
    honest = sum(INSIDE[0] <= row.inside[name] <= INSIDE[1] for row in found)
    return (
        f"- `{name}`: error at most that of the best simple regression in {error} of {len(found)}; "
        f"interval {INSIDE[0]:.0f} to {INSIDE[1]:.0f} % in {honest} of {len(found)}{note}"
    )


def main(argv: list[str] | None = None) -> int:
    """Print the row; exit status 0 done, whether the goal is reached or not, 1 failure, 2 usage."""
    parser = argparse.ArgumentParser(
        prog=BY, description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.parse_args(argv)
    try:
        print("\n".join(markdown(rows())))
    except (RunError, RunTableError, ConfigError, FitError, LossFitError, ValueError, OSError) as error:
        print(f"{BY}: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
