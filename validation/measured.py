"""Score the estimator on shipped runs of a real arm (models/kinova_gen3) by its torque sensor, before and after a fit.

    python -m validation measured --out DIR
    python -m validation measured --out DIR --bus unix:PATH
    python -m jtqd.sim_can.bench_kernel run --time-travel --out DIR -- python -m validation measured --bus vcan0 --out DIR

For each joint and each run the estimate is made three times: with the joint file that ships and method `tob` (before), with
losses, offset and rotor inertia fitted on the OTHER run and method `fused` without torsion (after: `sysid.fit.few_runs`),
and with no friction at all, for scale. No run is scored by a fit that has seen it. The reference is the sensor passed
through the observer's own low-pass, so that the known group delay is not counted as error.

--bus: jtqd itself against the played runs, scored from its own log (`measured_bus`); without a fit.
"""

from __future__ import annotations

import argparse
import datetime as dt
import math
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jtqd.estimator.command_line import make_directory
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
from validation.study import Report, Table, UsageError

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


def _save(joint: Joint, path: Path) -> None:
    write_joint(
        path, joint, "Made by jtq measured: the shipped joint file with fitted losses and rotor inertia."
    )


class Panel(NamedTuple):
    """What is drawn of one run, arrays [n]: estimates with label, shaded times, and differences to the offline estimate."""

    title: str
    time_s: Array
    reference_nm: Array
    estimates: Sequence[tuple[Array, str]]
    shades: Sequence[tuple[NDArray[np.bool_], str, str]]
    differences: Sequence[Array] = ()


def draw(panels: Sequence[Panel], path: Path) -> None:
    """Draw one column per run: torque, estimate less sensor, and the difference to the offline estimate; PNG at `path`."""
    import matplotlib as mpl
    from matplotlib import pyplot as plt

    from jtqd.sysid.report import page as parts

    mpl.use("Agg")  # files only; a display is not needed
    heights = (4, 3, 2) if panels[0].differences else (3, 2)
    size = (6.2 * len(panels), 7.6 if panels[0].differences else 6.4)
    figure, axes = plt.subplots(
        len(heights), len(panels), figsize=size, sharex="col", squeeze=False, height_ratios=heights
    )
    for column, panel in zip(axes.T, panels, strict=True):
        for colour, (values, label) in zip((parts.BEFORE, parts.AFTER), panel.estimates, strict=True):
            column[0].plot(panel.time_s, values, color=colour, linewidth=0.9, label=label)
            column[1].plot(panel.time_s, values - panel.reference_nm, color=colour, linewidth=0.9)
        for colour, difference in zip((parts.BEFORE, parts.AFTER), panel.differences, strict=False):
            column[2].plot(panel.time_s, 1e3 * difference, color=colour, linewidth=0.6)
        parts.sensor_line(column[0], panel.time_s, panel.reference_nm)
        parts.room_for_legend(column[0], 0.45)
        column[0].set_title(panel.title, fontsize=10)
        column[1].axhline(0.0, color=parts.SENSOR, linewidth=0.8)
        column[-1].set_xlabel("time [s]")
        for axis in column:
            for where, colour, label in panel.shades:
                named = label if axis is column[0] and where.any() else None
                parts.shade(axis, panel.time_s, where, colour, named)
            parts.plain(axis)
        parts.legend(column[0])
    labels = ("joint torque [Nm]", "estimate - sensor [Nm]", "published - offline [mNm]")
    for axis, label in zip(axes[:, 0], labels, strict=False):
        axis.set_ylabel(label)
    figure.tight_layout()
    figure.savefig(path, dpi=110, metadata={"Software": None})
    plt.close(figure)


def panel(case: Case) -> Panel:
    """Return what is drawn of a case."""
    from jtqd.sysid.report import page as parts

    before = f"before: joint file as shipped, RMSE {case.before.rmse_nm:.2f} Nm"
    after = f"after: losses fitted on {case.fitted_on}, RMSE {case.after.rmse_nm:.2f} Nm"
    return Panel(
        f"joint {case.joint}, {case.run}",
        case.time_s - case.time_s[0],
        case.reference_nm,
        ((case.before_nm, before), (case.after_nm, after)),
        ((case.standstill, parts.STANDING, parts.STANDING_LABEL),),
    )


def case_table(cases: Sequence[Case]) -> Table:
    """Return RMSE per joint and run in Nm and in percent of rated torque, with what the fit did to it."""
    head = ("joint", "scored on", "fitted on", "no friction", "before", "after", "change by the fit")
    rows = []
    for case in cases:
        change = 100.0 * (case.after.rmse_nm / case.before.rmse_nm - 1.0)
        rows.append(
            (
                *(str(case.joint), case.run, case.fitted_on),
                *(percent_of(s.rmse_nm, case.rated_nm) for s in (case.no_friction, case.before, case.after)),
                f"better by {-change:.0f} %" if change < 0.0 else f"WORSE by {change:.0f} %",
            )
        )
    return Table(
        head, rows, "RMSE of the estimate against the arm's torque sensor, Nm (percent of rated torque)"
    )


def percent_of(error_nm: float, rated_nm: float) -> str:
    """Return an error in Nm and in percent of the rated torque."""
    return f"{error_nm:.3f} ({100.0 * error_nm / rated_nm:.1f} %)"


def options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the study."""
    parser.add_argument(
        "--bus", help="play the runs on this bus (vcan0, unix:PATH) and score the published estimates of jtqd"
    )
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="directory of the figures and jtqd's logs"
    )
    parser.add_argument(
        "--joint-files",
        type=Path,
        metavar="DIR",
        help="directory of the fitted joint files (default: the --out directory)",
    )


def run(options: argparse.Namespace) -> Report:
    """Score, draw, and return the tables."""
    if options.bus is not None and options.joint_files is not None:
        raise UsageError("--joint-files: not possible with --bus, which does not fit")
    make_directory(options.out)
    if options.bus is not None:
        from validation import measured_bus

        results = measured_bus.evaluate(options.bus, options.out)
        runs = [{k: x for k, x in vars(each).items() if not isinstance(x, np.ndarray)} for each in results]
        report = Report([measured_bus.bus_table(results)], values={"runs": runs})
        panels = {n: measured_bus.panels([r for r in results if r.joint == n]) for n in JOINTS}
        name = "measured_bus_joint{}.png"
    else:
        cases, fits = evaluate(options.joint_files or options.out, dt.date.today().isoformat())
        notes = []
        for (joint, on), found in fits.items():
            notes += ["", f"joint {joint}, losses fitted on {on}:", *(f"  {line}" for line in found.lines())]
        report = Report([case_table(cases)], {}, notes[1:], _values(cases, fits))
        panels = {n: [panel(case) for case in cases if case.joint == n] for n in JOINTS}
        name = "measured_joint{}.png"
    try:
        for number, drawn in panels.items():
            draw(drawn, options.out / name.format(number))
    except ModuleNotFoundError as error:
        print(f"measured: no figures: {error}", file=sys.stderr)
    return report


def _values(cases: Sequence[Case], fits: dict[tuple[int, str], FewRunsFit]) -> dict[str, Any]:
    return {
        "cases": [
            {
                **{k: getattr(case, k) for k in ("joint", "run", "fitted_on", "rated_nm")},
                **{k: asdict(getattr(case, k)) for k in ("no_friction", "before", "after")},
            }
            for case in cases
        ],
        "fits": [
            {
                "joint": joint,
                "run": on,
                "terms": [asdict(term) for term in found.terms],
                "rotor_inertia_kgm2": found.joint.rotor_inertia_kgm2,
                "report": found.lines(),
            }
            for (joint, on), found in fits.items()
        ],
    }
