"""Score the estimator on measured runs by the arm's own torque sensor, before and after fitting the losses.

For each joint and each run the estimate is made three times: with the joint file that ships and method `tob` (before), with
losses, offset and rotor inertia fitted on the OTHER run and method `fused` without torsion (after: `sysid.fit.few_runs`),
and with no friction at all, for scale. No run is scored by a fit that has seen it. The reference is the sensor passed
through the observer's own low-pass, so that the known group delay is not counted as error.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from jtqd.estimator.joint import Friction, Joint
from jtqd.estimator.methods import make_estimator
from jtqd.estimator.observer import low_pass
from jtqd.estimator.run import EstimateRun, RunTable
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.status import STANDSTILL
from jtqd.models.files import load_joint, shipped
from jtqd.sysid.fit.few_runs import FewRunsFit, fit_few_runs
from jtqd.sysid.fit.joint_writer import write_joint
from jtqd.sysid.fit.signals import run_signals
from jtqd.sysid.runs.column_map import ColumnMap
from jtqd.sysid.runs.files import read_run
from jtqd.sysid.runs.run_file import RunError, RunFile

Array = NDArray[np.float64]

RUNS = ("opti_traj_testing1", "RunTrajectory1")
JOINTS = (2, 4)
SETTINGS = EstimatorSettings(method="tob", bandwidth_rad_s=200.0)
AFTER = EstimatorSettings(method="fused", bandwidth_rad_s=200.0)
"""Of the fitted joint files, which have section `fused`."""
NO_FRICTION = Friction(coulomb_nm=0.0, viscous_nms_per_rad=0.0)


@dataclass(frozen=True)
class Score:
    """Error of an estimate against the sensor, in Nm, over the rows that have an estimate."""

    rmse_nm: float
    p95_nm: float
    max_nm: float
    rows: int


@dataclass(frozen=True)
class Case:
    """One joint in one run. Arrays [n]; `reference_nm` is the sensor through the observer's low-pass.

    At standstill the estimate is the middle of an interval as wide as the friction, no more.
    """

    joint: int
    run: str
    fitted_on: str
    rated_nm: float
    time_s: Array
    reference_nm: Array
    before_nm: Array
    after_nm: Array
    standstill: NDArray[np.bool_]
    no_friction: Score
    before: Score
    after: Score


def score(estimate_nm: Array, sensor_nm: Array, dt_s: Array, bandwidth_rad_s: float) -> Score:
    """Compare an estimate [n] with the sensor [n] filtered like it; rows whose estimate is NaN do not count.

    dt_s[k] is the step that ends at row k; dt_s[0] is not used. Raises ValueError without a single estimate.
    """
    error = estimate_nm - low_pass(sensor_nm, dt_s, bandwidth_rad_s)
    size = np.abs(error[np.isfinite(error)])
    if not len(size):
        raise ValueError("found no row with an estimate, expected at least one")
    return Score(
        math.sqrt(float(np.mean(size**2))), float(np.quantile(size, 0.95)), float(np.max(size)), len(size)
    )


def estimate(joint: Joint, table: RunTable, number: int) -> EstimateRun:
    """Estimate joint `number` of a run; torque is NaN where none would be published. Raises RunTableError."""
    settings = SETTINGS if joint.fused is None else AFTER
    dt_s, current, position, velocity, link = table.estimator_inputs(number, joint.gear_ratio)
    temperature = table.joints[number].temperature_c
    return make_estimator(joint, settings).run(dt_s, current, position, velocity, link, temperature)


def fit(joint: Joint, file: RunFile, *, number: int, run: str) -> FewRunsFit:
    """Fit a joint to one run, by its motor side alone. Raises LossFitError, RunTableError, ValueError."""
    columns = file.table.joint(number, joint.gear_ratio)
    return fit_few_runs([run_signals(run, joint, SETTINGS, file.table.time_s, columns)], joint)


def fitted_joint(joint: Joint, found: FewRunsFit, file: RunFile, *, run: str, date: str) -> Joint:
    """Return the fitted joint, and where it comes from."""
    origin: dict[str, object] = {
        "fused": f"fitted on {run}.csv.gz by jtq measured, and rotor_inertia_kgm2; no other value was fitted",
        "few_runs": found.lines(),
        "log_sha256": file.sha256,
        "date": date,
    }
    return replace(
        joint,
        fused=found.fused,
        rotor_inertia_kgm2=found.joint.rotor_inertia_kgm2,
        provenance={**joint.provenance, **origin},
    )


def compare(joint: Joint, after: Joint, table: RunTable, *, number: int, run: str, fitted_on: str) -> Case:
    """Estimate one joint in one run before and after, and score both."""
    sensor = table.joints[number].torque_nm
    if sensor is None:
        raise RunError(
            f"{run}: found no usable column j{number}.torque_nm, expected a reference to compare with"
        )
    dt_s = table.dt_s
    estimates = [estimate(j, table, number) for j in (replace(joint, friction=NO_FRICTION), joint, after)]
    none, old, new = (score(e.torque_nm, sensor, dt_s, SETTINGS.bandwidth_rad_s) for e in estimates)
    return Case(
        joint=number,
        run=run,
        fitted_on=fitted_on,
        rated_nm=joint.rated_torque_nm,
        time_s=table.time_s,
        reference_nm=low_pass(sensor, dt_s, SETTINGS.bandwidth_rad_s),
        before_nm=estimates[1].torque_nm,
        after_nm=estimates[2].torque_nm,
        standstill=estimates[2].status == STANDSTILL,
        no_friction=none,
        before=old,
        after=new,
    )


def evaluate(joint_files: Path | None, date: str) -> tuple[list[Case], dict[tuple[int, str], FewRunsFit]]:
    """Score all joints in all runs; return the cases, and the fits by (joint, run).

    Args:
        joint_files: folder for the fitted joint files; None: they are not written.
        date: for their provenance.

    Raises:
        RunError, RunTableError, ConfigError, LossFitError, ValueError, OSError: a file cannot be used.
    """
    columns = ColumnMap.load(shipped("kinova_gen3/columns.yaml"))
    files = {run: read_run(shipped(f"kinova_gen3/{run}.csv.gz"), columns) for run in RUNS}
    cases: list[Case] = []
    fits: dict[tuple[int, str], FewRunsFit] = {}
    for number in JOINTS:
        joint = load_joint(columns.joint_files[number])
        for run, other in (RUNS, RUNS[::-1]):
            found = fits[number, other] = fit(joint, files[other], number=number, run=other)
            after = fitted_joint(joint, found, files[other], run=other, date=date)
            cases.append(compare(joint, after, files[run].table, number=number, run=run, fitted_on=other))
            if joint_files is not None:
                _save(after, joint_files / f"joint{number}.fitted_on_{other}.yaml")
    return cases, fits


def table_lines(cases: list[Case]) -> list[str]:
    """RMSE per joint and run in Nm and in percent of rated torque, with what the fit did to it."""
    lines = [
        f"{'joint':>5}  {'scored on':<20}{'fitted on':<20}"
        f"{'no friction':>16}{'before':>16}{'after':>16}  change by the fit"
    ]
    for case in cases:
        cells = "".join(
            f"{s.rmse_nm:8.3f} ({100.0 * s.rmse_nm / case.rated_nm:4.1f} %)"
            for s in (case.no_friction, case.before, case.after)
        )
        change = case.after.rmse_nm / case.before.rmse_nm - 1.0
        verdict = f"better by {-100.0 * change:.0f} %" if change < 0.0 else f"WORSE by {100.0 * change:.0f} %"
        lines.append(f"{case.joint:>5}  {case.run:<20}{case.fitted_on:<20}{cells}  {verdict}")
    return lines


def as_mapping(cases: list[Case], fits: dict[tuple[int, str], FewRunsFit]) -> dict[str, object]:
    """Return the same for a program: scores per case, terms per fit."""
    return {
        "schema": "jtq.measured/2",
        "cases": [
            {
                "joint": case.joint,
                "run": case.run,
                "fitted_on": case.fitted_on,
                "rated_nm": case.rated_nm,
                "no_friction": asdict(case.no_friction),
                "before": asdict(case.before),
                "after": asdict(case.after),
            }
            for case in cases
        ],
        "fits": [
            {
                "joint": joint,
                "run": run,
                "terms": [asdict(term) for term in found.terms],
                "rotor_inertia_kgm2": found.joint.rotor_inertia_kgm2,
                "fused": found.fused.to_mapping(),
                "report": found.lines(),
            }
            for (joint, run), found in fits.items()
        ],
    }


def _save(joint: Joint, path: Path) -> None:
    write_joint(
        path, joint, "Made by jtq measured: the shipped joint file with fitted losses and rotor inertia."
    )
