"""One encoder, two short runs: what is fitted to one is judged on the other. Ours beside least squares.

Ours is what `jtq fit losses` makes of one run (`sysid.fit.few_runs`, method `fused` without torsion). Beside it stand the
joint file as it was (`tob`), `tob` with Coulomb and viscous friction fitted (`friction.py`), the baselines of the
goals' table that need one encoder, and

    current and speed     tau = a0 + a1 tau_raw + a2 s + a3 v + a4 s |tau_raw|
    ladder                tau = tau_raw - (c0 + c1 s + c2 v + c3 dv/dt + c4 s |tau_raw|)

All are fitted to the same run and judged on the same samples of the other: in motion, against the torque sensor of the same
age. The best of the regressions is the one that is best there, which nobody could have known before.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.estimator.joint import Joint
from jtqd.estimator.methods import estimate_columns
from jtqd.estimator.run import JointColumns, ObservedRun
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.status import DEGRADED, STANDSTILL, VALID
from jtqd.estimator.uncertainty import GAUSS
from jtqd.sysid.fit.few_runs import Prior, fit_few_runs
from jtqd.sysid.fit.friction import FitError
from jtqd.sysid.fit.losses import LossFitError
from jtqd.sysid.fit.signals import run_signals
from validation.goals.baselines import BASELINES, Baseline, Example, fit_baseline
from validation.goals.friction import fit_friction

INSIDE: Final = (85.0, 95.0)
"""Of an honest 90 % interval [%], as on the bench `bad_day`."""
OURS: Final = "ours"
METHODS: Final[Mapping[str, str]] = {
    OURS: "ours",
    "tob": "`tob`, friction fitted",
    "file": "joint file",
}
"""Estimators of jtqd, with a sigma."""
RCOND: Final = 1e-3
"""What a run does not excite at all is left out of the regressions, too: some would err by 1e9 Nm else."""


def _current_and_speed(seen: ObservedRun) -> FloatArray:
    raw, s, v = seen.raw_nm, seen.direction, seen.velocity_rad_s
    return np.column_stack((np.ones_like(raw), raw, s, v, s * np.abs(raw)))


def _ladder(seen: ObservedRun) -> FloatArray:
    raw, s, v = seen.raw_nm, seen.direction, np.nan_to_num(seen.velocity_rad_s)
    acceleration = np.gradient(v, np.cumsum(np.maximum(seen.dt_s, 1e-9)))
    return np.column_stack((np.ones_like(raw), s, v, acceleration, s * np.abs(raw)))


SIMPLE: Final = {
    "current": Baseline(
        "least squares on current and speed, 5 coefficients", False, False, _current_and_speed
    ),
    "tob_load": BASELINES["tob_load"],
    "tob_fitted": BASELINES["tob_fitted"],
    "ladder": Baseline("ladder with inertia, 5 coefficients", False, True, _ladder),
}


class Run(NamedTuple):
    """One joint of one run: name, stamps [n], columns."""

    name: str
    time_s: FloatArray
    columns: JointColumns


class Case(NamedTuple):
    """One joint of a world with two runs; joint: its file as it was before them."""

    world: str
    name: str
    joint: Joint
    runs: tuple[Run, Run]


class Row(NamedTuple):
    """One case judged on one run, by method: RMSE in motion [Nm]; of the estimators, how often the 90 % interval holds the
    sensor in motion, and value +- sigma at standstill [%, NaN without such samples].

    A method that cannot be fitted to the run is in none.
    """

    world: str
    name: str
    judged: str
    fitted: str
    rated_nm: float
    rmse_nm: dict[str, float]
    inside: dict[str, float]
    standing: dict[str, float]

    @property
    def best_simple(self) -> str:
        """Name of the regression that is best on the judged run."""
        return min(SIMPLE, key=lambda name: self.rmse_nm[name])

    @property
    def reached(self) -> bool:
        """Whether ours is at most the best regression."""
        return self.rmse_nm[OURS] <= self.rmse_nm[self.best_simple]

    @property
    def honest(self) -> bool:
        """Whether our interval holds neither more nor less than it says."""
        return INSIDE[0] <= self.inside[OURS] <= INSIDE[1]


def one_encoder(columns: JointColumns, joint: Joint) -> JointColumns:
    """Return the columns with the link's position that the motor's tells."""
    assert columns.motor_position_rad is not None
    return replace(columns, link_position_rad=columns.motor_position_rad / joint.gear_ratio)


def rows_of(case: Case) -> list[Row]:
    """Fit a case to each of its runs and judge it on the other. Raises ConfigError, LossFitError, ValueError."""
    return [_row(case, *pair) for pair in (case.runs, case.runs[::-1])]


def _row(case: Case, judged: Run, fitted: Run) -> Row:
    joint = case.joint
    settings = {name: EstimatorSettings(method="fused" if name == OURS else "tob") for name in METHODS}
    known, seen = (
        run_signals(each.name, joint, settings["tob"], each.time_s, each.columns) for each in (fitted, judged)
    )
    joints = {OURS: fit_few_runs([known], joint).joint, "file": joint}
    with suppress(FitError):  # too little motion for a fit without a prior
        joints["tob"] = replace(joint, friction=fit_friction(fitted.time_s, fitted.columns, joint).friction)
    example = Example(known.seen, known.sensor_nm, known.sensor_nm, known.moving)
    found = {
        name: estimate_columns(each, settings[name], None, judged.time_s, judged.columns)
        for name, each in joints.items()
    }
    keep = seen.moving.copy()
    for each in found.values():
        keep &= np.isin(each.status, (VALID, DEGRADED))
    if not keep.any():
        raise LossFitError(f"{judged.name}: found no motion to judge by, expected some")
    errors = {name: each.torque_nm - seen.sensor_nm for name, each in found.items()}
    errors |= {
        name: each.estimate(seen.seen, fit_baseline(each, [example], RCOND)) - seen.sensor_nm
        for name, each in SIMPLE.items()
    }
    return Row(
        case.world,
        case.name,
        judged.name,
        fitted.name,
        joint.rated_torque_nm,
        {name: float(np.sqrt(np.mean(each[keep] ** 2))) for name, each in errors.items()},
        {name: _inside(errors[name], GAUSS * each.sigma_nm, keep) for name, each in found.items()},
        {
            name: _inside(errors[name], each.sigma_nm, seen.standing & (each.status == STANDSTILL))
            for name, each in found.items()
        },
    )


def errors_of_ours(case: Case, priors: Sequence[Prior]) -> FloatArray:
    """Return the RMSE of ours with each prior, judged on each run [priors, 2], in parts of the rated torque."""
    fused, joint = EstimatorSettings(method="fused"), case.joint
    found = np.zeros((len(priors), 2))
    signals = [run_signals(run.name, joint, fused, run.time_s, run.columns) for run in case.runs]
    for n, (judged, seen, known) in enumerate(zip(case.runs, signals, signals[::-1], strict=True)):
        for k, prior in enumerate(priors):
            fitted = fit_few_runs([known], joint, prior).joint
            torque = estimate_columns(fitted, fused, None, judged.time_s, judged.columns).torque_nm
            found[k, n] = np.sqrt(np.nanmean((torque - seen.sensor_nm)[seen.moving] ** 2))
    return found / joint.rated_torque_nm


def _inside(error: FloatArray, half: FloatArray, where: BoolArray) -> float:
    return 100.0 * float(np.mean(np.abs(error[where]) <= half[where])) if where.any() else float("nan")


def titles() -> dict[str, str]:
    """Return the head of each column of a table."""
    return {**METHODS, **{name: each.title for name, each in SIMPLE.items()}}


def summary(rows: Sequence[Row]) -> list[str]:
    """Return a table of many cases, one line per world: RMSE in percent of the rated torque, median and worst."""
    named = {
        OURS: "ours",
        "best": "best regression in hindsight",
        **{k: v for k, v in titles().items() if k != OURS},
    }
    lines = [
        "| world, fits | "
        + " | ".join(named.values())
        + " | ours at most the best | inside our 90 % | of fits, 85 to 95 % |",
        "|" + "---|" * (len(named) + 4),
    ]
    for world in dict.fromkeys(row.world for row in rows):
        found = [row for row in rows if row.world == world]
        cells = [
            _spread([_percent(row, name) for row in found if name == "best" or name in row.rmse_nm])
            for name in named
        ]
        lines.append(
            f"| {world}, {len(found)} | "
            + " | ".join(cells)
            + f" | {100.0 * np.mean([row.reached for row in found]):.0f} %"
            + f" | {np.mean([row.inside[OURS] for row in found]):.0f} %"
            + f" | {100.0 * np.mean([row.honest for row in found]):.0f} % |"
        )
    return lines


def _percent(row: Row, name: str) -> float:
    return 100.0 * row.rmse_nm[row.best_simple if name == "best" else name] / row.rated_nm


def _spread(values: Sequence[float]) -> str:
    return f"{np.median(values):.1f}, {max(values):.0f}" if len(values) else "-"
