"""Diagnose all seven joints of the measured Kinova Gen3 arm: what its rigid model with friction gets wrong.

    python -m examples.kinova_diagnosis --out DIR [--json]

Every joint is diagnosed by itself on both runs, with the joint file that one can write down without measuring
(models/kinova_gen3). Printed are verdict, gap, causes with their classes, and the gain on the run left out; written are
findings.json and report.html of each joint, and the figures of docs/results.md.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import matplotlib as mpl
import numpy as np
from matplotlib import pyplot as plt
from scipy.optimize import lsq_linear

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.joint import Joint
from jtqd.estimator.run import RunTable, RunTableError
from jtqd.models.files import load_joint, shipped
from jtqd.sysid.diagnosis.channel import Channel
from jtqd.sysid.diagnosis.command import diagnosed
from jtqd.sysid.diagnosis.dataset import usable_signals
from jtqd.sysid.diagnosis.findings import Cause, Findings, Gap, Value, to_mapping
from jtqd.sysid.diagnosis.regressors import bin_samples, binned, run_data
from jtqd.sysid.diagnosis.signals import JointSignals
from jtqd.sysid.fit.few_runs import PRIOR
from jtqd.sysid.fit.plateaus import effective_samples
from jtqd.sysid.report import page as parts
from jtqd.sysid.runs.checks import check_runs
from jtqd.sysid.runs.column_map import ColumnMap
from jtqd.sysid.runs.files import read_run
from jtqd.sysid.runs.run_file import RunError, RunFile

mpl.use("Agg")  # files only; a display is not needed

RUNS: Final = ("opti_traj_testing1", "RunTrajectory1")
JOINTS: Final = range(1, 8)
BY: Final = "kinova_diagnosis"
_RUN_COLOURS: Final = ("#7a4fa3", "#2a8a5a")
_COLUMNS: Final = 3
_SLOW_RAD_S: Final = 0.03
"""Below it the direction of friction is not known, and the residual is not the model's fault."""


@dataclass(frozen=True)
class Diagnosed:
    """One joint of the arm: number, joint file as shipped, findings over both runs."""

    number: int
    joint: Joint
    findings: Findings


def measured_runs() -> list[RunFile]:
    """Return both runs as shipped, with the encoder counted once. Raises RunError, ConfigError."""
    columns = ColumnMap.load(shipped("kinova_gen3/columns.yaml"))
    runs = []
    for name in RUNS:
        file = read_run(shipped(f"kinova_gen3/{name}.csv.gz"), columns)
        runs.append(replace(file, name=name, table=one_encoder(file.table)))
    return runs


def one_encoder(table: RunTable) -> RunTable:
    """Return the run without motor positions, which the column map makes from the joint's: there is one encoder.

    As a second encoder they would mean that no joint ever twists under its load. Velocity and acceleration are those of the
    velocity channel: of the position, with its repeated rows, they would be known below 18 Hz only.
    """
    joints = {number: replace(columns, motor_position_rad=None) for number, columns in table.joints.items()}
    return RunTable(table.time_s, joints)


def only(run: RunFile, number: int) -> RunFile:
    """Return the run with one joint's columns and notes."""
    notes = tuple(note for note in run.notes if note.startswith(f"j{number}.") or not note.startswith("j"))
    return replace(run, table=RunTable(run.table.time_s, {number: run.table.joints[number]}), notes=notes)


def diagnose_all(numbers: Sequence[int] = JOINTS) -> list[Diagnosed]:
    """Diagnose each joint by itself on both runs. Raises RunError, ConfigError."""
    runs = measured_runs()
    result = []
    for number in numbers:
        joint = load_joint(shipped(f"kinova_gen3/joint{number}.yaml"))
        findings = diagnosed([only(run, number) for run in runs], {number: joint})
        result.append(Diagnosed(number, joint, findings))
    return result


def table_lines(results: Sequence[Diagnosed]) -> list[str]:
    """Return the results as the rows of a Markdown table."""
    lines = [
        "| joint | verdict | gap: RMSE, noise floor [Nm] | causes (and effects indistinguishable from them) | "
        "RMSE on held-out runs before, after [Nm] |",
        "|---|---|---|---|---|",
    ]
    for one in results:
        cells = (str(one.number), one.findings.verdict, _gap(one), _causes(one.findings), _gain(one.findings))
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def ladder_lines(results: Sequence[Diagnosed]) -> list[str]:
    """Return the error on each run of regressions fitted on the other: offset, Coulomb, viscous, inertia, load.

    The ladder is least squares; the possible one has no friction or inertia below zero; "near the file" has the same terms
    with the priors of `sysid.fit.few_runs` about the file.
    Of a joint without causes the extended file is the file, or the file with a value at its bound.
    """
    runs = measured_runs()
    lines = [
        "| joint | left out | joint file [Nm rms] | ladder | possible ladder | near the file | extended file | "
        "ladder beaten or equalled |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for one in results:
        checked = check_runs([(r.name, only(r, one.number).table) for r in runs], {one.number: one.joint})
        signals, _ = usable_signals(checked.runs, {one.number: one.joint}, (one.number,))
        if len(signals) < len(RUNS):
            continue
        samples = bin_samples(s for run in signals for s in run)
        parts = [_ladder(run, samples) for run in signals]
        after = {} if one.findings.gain is None else {g.run: g.rmse_after_nm for g in one.findings.gain.runs}
        for (x, y, name), (fitted_x, fitted_y, _) in zip(parts, parts[::-1], strict=True):
            size = np.sqrt(np.mean(fitted_x**2, axis=0))
            free = np.linalg.lstsq(fitted_x / size, fitted_y, rcond=1e-3)[0] / size
            near = _near_the_file(fitted_x, fitted_y, one.joint)
            fits = (free, _possible(fitted_x, fitted_y, one.joint), near)
            ladder, possible, regular = (float(np.sqrt(np.mean((y - x @ found) ** 2))) for found in fits)
            file = float(np.sqrt(np.mean(y**2)))
            bounds = [b for b in one.findings.bounded if b.in_file]
            after |= {r.run: r.rmse_after_nm for b in bounds for r in b.runs}
            own = after.get(name, file)
            cells = (
                f"{file:.2f}",
                f"{ladder:.2f}",
                f"{possible:.2f}",
                f"{regular:.2f}",
                f"{own:.2f}{' (bound)' if bounds else ''}",
            )
            holds = "yes" if own < ladder + 0.005 else "no"
            lines.append(f"| {one.number} | {name} | {' | '.join(cells)} | {holds} |")
    return lines


def single_lines(results: Sequence[Diagnosed]) -> list[str]:
    """Return, for joints without a cause, each term of the ladder alone: its value by each run, and what it predicts.

    Least squares, intervals of 95 % by effective samples; values are those of a joint file. Of a law that friction or
    inertia forbids (below zero) the value counts as zero where it predicts.
    """
    runs = measured_runs()
    lines = [
        f"| joint | alone | value by {', '.join(RUNS)} | predicts (file): {RUNS[0]}, {RUNS[1]} [Nm rms] |",
        "|---|---|---|---|",
    ]
    for one in results:
        checked = check_runs([(r.name, only(r, one.number).table) for r in runs], {one.number: one.joint})
        signals, _ = usable_signals(checked.runs, {one.number: one.joint}, (one.number,))
        if one.findings.causes or len(signals) < len(RUNS):
            continue
        samples = bin_samples(s for run in signals for s in run)
        parts = [_ladder(run, samples) for run in signals]
        gear = one.joint.gear_ratio
        terms = {
            "offset, Nm": (0.0, 1.0, -math.inf),
            "Coulomb friction, Nm": (one.joint.friction.coulomb_nm, 1.0, 0.0),
            "viscous friction, Nms/rad": (one.joint.friction.viscous_nms_per_rad, 1.0, 0.0),
            "rotor inertia, kg m2": (one.joint.rotor_inertia_kgm2, 1.0 / gear, 0.0),
            "load friction": (0.0, 1.0, 0.0),
        }
        for k, (name, (file, unit, least)) in enumerate(terms.items()):
            found = [_alone(x[:, k], y) for x, y, _ in parts]
            values = (f"{file + unit * value:.2g} ± {1.96 * unit * spread:.1g}" for value, spread in found)
            errors = []
            for (x, y, _), (value, _) in zip(parts, found[::-1], strict=True):
                used = (max(file + unit * value, least) - file) / unit
                before, after = (float(np.sqrt(np.mean((y - c * x[:, k]) ** 2))) for c in (0.0, used))
                errors.append(f"{after:.2f} ({before:.2f})")
            lines.append(f"| {one.number} | {name} | {', '.join(values)} | {', '.join(errors)} |")
    return lines


def _alone(x: FloatArray, y: FloatArray) -> tuple[float, float]:
    """Return least squares on one column, and its standard deviation."""
    power = float(x @ x)
    value = float(x @ y) / power
    error = y - value * x
    return value, math.sqrt(float(np.mean(error**2)) / power * len(y) / effective_samples(error))


def _possible(x: FloatArray, y: FloatArray, joint: Joint) -> FloatArray:
    """Return least squares of `_ladder` [5] with no friction or inertia below zero; what is not separable is shared."""
    friction, inertia = joint.friction, joint.rotor_inertia_kgm2 * joint.gear_ratio**2
    least = -np.array((np.inf, friction.coulomb_nm, friction.viscous_nms_per_rad, inertia, 0.0))
    size = np.sqrt(np.mean(x**2, axis=0))
    ridge = 1e-3 * math.sqrt(len(y)) * np.eye(len(size))
    scaled, target = np.vstack((x / size, ridge)), np.append(y, np.zeros(len(size)))
    return np.asarray(lsq_linear(scaled, target, (least * size - 1e-12, np.inf)).x / size, np.float64)


def _near_the_file(x: FloatArray, y: FloatArray, joint: Joint) -> FloatArray:
    """Return the most probable coefficients of `_ladder` [5]: Gaussian priors about the file, coloured residual."""
    rated, friction, inertia = (
        joint.rated_torque_nm,
        joint.friction,
        joint.rotor_inertia_kgm2 * joint.gear_ratio**2,
    )
    mean = np.array((0.0, 0.0, 0.0, 0.0, PRIOR.load_mean))
    spread = np.array(
        (
            PRIOR.offset_rated * rated,
            math.hypot(PRIOR.coulomb_share * friction.coulomb_nm, PRIOR.coulomb_rated * rated),
            math.hypot(PRIOR.viscous_share * friction.viscous_nms_per_rad, PRIOR.viscous_rated * rated),
            PRIOR.inertia_share * inertia,
            PRIOR.load,
        )
    )
    found = mean
    for _ in range(4):
        error = y - x @ found
        variance = max(float(np.mean(error**2)), (0.01 * rated) ** 2)
        weight = effective_samples(error) / len(y) / variance
        left = weight * (x.T @ x) + np.diag(spread**-2)
        found = np.linalg.solve(left, weight * (x.T @ y) + mean / spread**2)
    return np.asarray(found, np.float64)


def _ladder(run: Sequence[JointSignals], samples: int) -> tuple[FloatArray, FloatArray, str]:
    """Return columns [n, 5] and residual [n] of the motor balance, binned as the diagnosis has them, and the run's name."""
    (s,) = run
    state, data = s.state, run_data(run, [], samples).channels[Channel(s.number, "motor")]
    terms = (
        np.ones(len(s.time_s)),
        state.direction,
        state.velocity_rad_s,
        state.motor_acceleration_rad_s2,
        np.abs(state.torque_nm) * state.direction,
    )
    columns = np.column_stack([binned(s.seen("motor", term), samples) for term in terms])
    return columns[data.valid], data.residual[data.valid], s.run


def largest_gap(findings: Findings) -> Gap | None:
    """Return the gap of the motor's balance, the only one that one encoder gives; None where there is none."""
    return next((gap for gap in findings.gaps if gap.balance == "motor"), None)


def _gap(one: Diagnosed) -> str:
    gap = largest_gap(one.findings)
    if gap is None:
        return "-"
    rated = one.joint.rated_torque_nm
    return f"{gap.rmse_nm:.2f} ({gap.rmse_nm / rated:.1%} of rated), {gap.noise_floor_nm:.2f}"


def _causes(findings: Findings) -> str:
    if not findings.causes:
        return "; ".join(findings.reasons) or "-"
    return "; ".join(cause_text(cause) for cause in findings.causes)


def cause_text(cause: Cause) -> str:
    """Return name, class and parameters of a cause in a line."""
    others = [name for name in cause.names if name != cause.name]
    alike = f" (or {', '.join(others)})" if others else ""
    values = ", ".join(f"{name} {_value(value)}" for name, value in cause.parameters.items())
    return f"{cause.name}{alike}: {values}"


def _value(value: Value) -> str:
    half = 0.5 * (value.ci95[1] - value.ci95[0])
    spread = f" +- {half:.2g}" if math.isfinite(half) and half > 0.0 else ""
    return f"{value.value:.3g}{spread} {value.unit}".rstrip()


def _gain(findings: Findings) -> str:
    gain = findings.gain
    if gain is None:
        return "-"
    return f"{gain.rmse_before_nm:.2f}, {gain.rmse_after_nm:.2f}"


def as_mapping(results: Sequence[Diagnosed], sha256: Mapping[str, str]) -> dict[str, Any]:
    """Return the findings of all joints for a program."""
    joints = [{"joint": one.number, "findings": to_mapping(one.findings, sha256=sha256)} for one in results]
    return {"schema": "jtq.measured_diagnosis/1", "joints": joints}


def write(directory: Path, results: Sequence[Diagnosed], sha256: Mapping[str, str]) -> None:
    """Write findings.json and report.html of each joint and the figures. Raises OSError."""
    from jtqd.sysid.diagnosis.report.page import render

    for one in results:
        folder = directory / f"joint{one.number}"
        folder.mkdir(parents=True, exist_ok=True)
        text = json.dumps(to_mapping(one.findings, sha256=sha256), indent=1, allow_nan=False)
        (folder / "findings.json").write_text(f"{text}\n", encoding="utf-8")
        (folder / "report.html").write_text(render(one.findings), encoding="utf-8")
    for name, draw in (("residuals", draw_residuals), ("loads", draw_loads)):
        path = directory / f"measured_diagnosis_{name}.png"
        draw(results, path)
        print(f"{BY}: wrote {path}", file=sys.stderr)


def main(arguments: list[str] | None = None) -> int:
    """Command line; results on stdout, log on stderr. Exit status 0 done, 1 failure, 2 usage."""
    parser = argparse.ArgumentParser(
        prog=f"python -m examples.{BY}",
        description="Diagnose the seven joints of the measured Kinova Gen3 arm and draw the figures of the docs page.",
        epilog=f"example:\n  python -m examples.{BY} --out kinova_diagnosis",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="directory of reports and figures"
    )
    parser.add_argument("--json", action="store_true", help="print the findings of all joints as JSON")
    options = parser.parse_args(arguments)
    try:
        options.out.mkdir(parents=True, exist_ok=True)
        sha256 = {run.name: run.sha256 for run in measured_runs()}
        results = diagnose_all()
        write(options.out, results, sha256)
    except (RunError, RunTableError, ConfigError) as error:
        print(f"{BY}: {error}", file=sys.stderr)
        return 1
    except OSError as error:
        print(f"{BY}: {error.filename or options.out}: {error.strerror or error}", file=sys.stderr)
        return 1
    if options.json:
        print(json.dumps(as_mapping(results, sha256), indent=1, allow_nan=False))
    else:
        print(
            "\n".join(
                (
                    *table_lines(results),
                    "",
                    *ladder_lines(results),
                    "",
                    *single_lines(results),
                )
            )
        )
    return 0


def draw_residuals(results: Sequence[Diagnosed], path: Path) -> None:
    """One row per joint that has traces, one column per run: residual of the motor balance over time, before and after."""
    rows = [one for one in results if _traces(one)]
    runs = list(dict.fromkeys(trace.run for one in rows for trace in _traces(one)))
    figure, axes = plt.subplots(
        max(len(rows), 1),
        max(len(runs), 1),
        figsize=(5.6 * max(len(runs), 1), 1.7 * max(len(rows), 1)),
        squeeze=False,
    )
    for line, one in zip(axes, rows, strict=False):
        for axis, run in zip(line, runs, strict=True):
            parts.plain(axis)
            trace = next((t for t in _traces(one) if t.run == run), None)
            if trace is None:
                axis.text(0.5, 0.5, "no usable sensor", transform=axis.transAxes, ha="center", fontsize=8)
                continue
            axis.plot(trace.time_s, trace.before_nm, color=parts.BEFORE, linewidth=0.9, label="before")
            if one.findings.causes:
                axis.plot(trace.time_s, trace.after_nm, color=parts.AFTER, linewidth=0.9, label="after")
            axis.axhline(0.0, color=parts.SENSOR, linewidth=0.8)
            axis.set_title(f"joint {one.number}, {run}: {one.findings.verdict}", fontsize=9)
        line[0].set_ylabel("residual [Nm]")
    if rows:
        for axis in axes[-1]:
            axis.set_xlabel("time [s]")
    _save(figure, path)


def draw_loads(results: Sequence[Diagnosed], path: Path) -> None:
    """One panel per joint: residual times the direction of motion over the load along the motion, before anything is added.

    Coulomb and viscous friction that are right leave zero; a loss that grows with the load makes a V, a wrong torque
    constant a straight line through zero.
    """
    shown = [one for one in results if _traces(one)]
    count = max(len(shown), 1)
    lines = -(-count // _COLUMNS)
    figure, axes = plt.subplots(lines, _COLUMNS, figsize=(3.4 * _COLUMNS, 2.9 * lines), squeeze=False)
    for axis in axes.flat[len(shown) :]:
        axis.set_visible(False)
    for axis, one in zip(axes.flat, shown, strict=False):
        parts.plain(axis)
        for colour, trace in zip(_RUN_COLOURS, _traces(one), strict=False):
            s = np.sign(trace.velocity_rad_s)
            moving = (np.abs(trace.velocity_rad_s) > _SLOW_RAD_S) & np.isfinite(trace.before_nm)
            axis.plot(
                (trace.torque_nm * s)[moving],
                (trace.before_nm * s)[moving],
                ".",
                color=colour,
                markersize=2.5,
                label=trace.run,
            )
        axis.axhline(0.0, color=parts.SENSOR, linewidth=0.8)
        axis.set_title(f"joint {one.number}", fontsize=9)
        axis.set_xlabel("load along the motion [Nm]")
    for line in axes:
        line[0].set_ylabel("loss missed [Nm]")
    _save(figure, path)


def _traces(one: Diagnosed) -> list[Any]:
    return [trace for trace in one.findings.traces if trace.balance == "motor" and trace.joint == one.number]


def _save(figure: Any, path: Path) -> None:
    """Write a figure with one legend above all panels: none of them has room for it, and not every line is in each."""
    figure.tight_layout()
    named: dict[str, Any] = {}
    for axis in figure.axes:
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True):
            named.setdefault(label, handle)
    if named:
        place = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.0), "ncols": len(named)}
        figure.legend(named.values(), named.keys(), **place, fontsize=8, frameon=False, markerscale=3.0)
    figure.savefig(path, dpi=110, bbox_inches="tight", metadata={"Software": None})
    plt.close(figure)


if __name__ == "__main__":
    sys.exit(main())
