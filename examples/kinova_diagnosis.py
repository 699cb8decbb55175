"""Diagnose all seven joints of the measured Kinova Gen3 arm: what its rigid model with friction gets wrong.

    python -m examples.kinova_diagnosis --out DIR [--json]

Every joint is diagnosed by itself on both runs, with the joint file that one can write down without measuring
(models/kinova_gen3). Printed are verdict, gap, causes with their classes, and the gain on the held-out run; written are
findings.json and report.html of each joint, and the figure of docs/results.md.
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

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.command_line import make_directory
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.joint import Joint
from jtqd.estimator.run import RunTable, RunTableError
from jtqd.models.files import load_joint, shipped
from jtqd.sysid.diagnosis.dataset import usable_signals
from jtqd.sysid.diagnosis.findings import Cause, Findings, Trace, to_mapping
from jtqd.sysid.diagnosis.regressors import bin_samples, binned, run_data
from jtqd.sysid.diagnosis.run_files import diagnose
from jtqd.sysid.diagnosis.signals import Channel, JointSignals
from jtqd.sysid.report import page as parts
from jtqd.sysid.runs.checks import check_runs
from jtqd.sysid.runs.column_map import ColumnMap
from jtqd.sysid.runs.files import read_run
from jtqd.sysid.runs.run_file import RunError, RunFile

mpl.use("Agg")  # files only; a display is not needed

RUNS: Final = ("opti_traj_testing1", "RunTrajectory1")
JOINTS: Final = range(1, 8)
BY: Final = "kinova_diagnosis"


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
        findings = diagnose([only(run, number) for run in runs], {number: joint})
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
        found, gain = one.findings, one.findings.gain
        causes = "; ".join(map(_cause, found.causes) if found.causes else found.reasons) or "-"
        gained = "-" if gain is None else f"{gain.rmse_before_nm:.2f}, {gain.rmse_after_nm:.2f}"
        lines.append(f"| {one.number} | {found.verdict} | {_gap(one)} | {causes} | {gained} |")
    return lines


def ladder_lines(results: Sequence[Diagnosed]) -> list[str]:
    """Return the error on each run of the extended file, beside least squares fitted on the other run.

    Regressors: offset, Coulomb, viscous, inertia, friction by load. The extended file of a joint without a gain is the file.
    """
    runs = measured_runs()
    lines = [
        "| joint | held out | joint file [Nm rms] | ladder | extended file | ladder beaten or equalled |",
        "|---|---|---|---|---|---|",
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
            found = np.linalg.lstsq(fitted_x / size, fitted_y, rcond=1e-3)[0] / size
            file, ladder = (float(np.sqrt(np.mean(error**2))) for error in (y, y - x @ found))
            own = after.get(name, file)
            holds = "yes" if own < ladder + 0.005 else "no"
            lines.append(f"| {one.number} | {name} | {file:.2f} | {ladder:.2f} | {own:.2f} | {holds} |")
    return lines


def _ladder(run: Sequence[JointSignals], samples: int) -> tuple[FloatArray, FloatArray, str]:
    """Return columns [n, 5] and residual [n] of the motor balance, binned as the diagnosis has them, and the run's name."""
    (s,) = run
    state, data = s.state, run_data(run, [], samples).channels[Channel(s.number, "motor")]
    v, a = state.velocity_rad_s, state.motor_acceleration_rad_s2
    load = np.abs(state.torque_nm) * state.direction
    terms = (np.ones(len(s.time_s)), state.direction, v, a, load)
    columns = np.column_stack([binned(s.visible(term), samples) for term in terms])
    return columns[data.valid], data.residual[data.valid], s.run


def _gap(one: Diagnosed) -> str:
    """Return the gap of the motor's balance, the only one that one encoder gives."""
    gap = next((gap for gap in one.findings.gaps if gap.balance == "motor"), None)
    if gap is None:
        return "-"
    share = gap.rmse_nm / one.joint.rated_torque_nm
    return f"{gap.rmse_nm:.2f} ({share:.1%} of rated), {gap.noise_floor_nm:.2f}"


def _cause(cause: Cause) -> str:
    """Return name, class and parameters of a cause."""
    others = cause.names[1:]
    alike = f" (or {', '.join(others)})" if others else ""
    values = []
    for name, value in cause.parameters.items():
        half = 0.5 * (value.ci95[1] - value.ci95[0])
        spread = f" +- {half:.2g}" if math.isfinite(half) and half > 0.0 else ""
        values.append(f"{name} {value.value:.3g}{spread} {value.unit}".rstrip())
    return f"{cause.name}{alike}: {', '.join(values)}"


def as_mapping(results: Sequence[Diagnosed], sha256: Mapping[str, str]) -> dict[str, Any]:
    """Return the findings of all joints for a program."""
    joints = [{"joint": one.number, "findings": to_mapping(one.findings, sha256=sha256)} for one in results]
    return {"schema": "jtq.measured_diagnosis/1", "joints": joints}


def write(directory: Path, results: Sequence[Diagnosed], sha256: Mapping[str, str]) -> None:
    """Write findings.json and report.html of each joint and the figures. Raises OSError."""
    from jtqd.sysid.diagnosis.report import render

    for one in results:
        folder = directory / f"joint{one.number}"
        folder.mkdir(parents=True, exist_ok=True)
        text = json.dumps(to_mapping(one.findings, sha256=sha256), indent=1, allow_nan=False)
        (folder / "findings.json").write_text(f"{text}\n", encoding="utf-8")
        (folder / "report.html").write_text(render(one.findings), encoding="utf-8")
    path = directory / "measured_diagnosis_residuals.png"
    draw_residuals(results, path)
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
        make_directory(options.out)
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
        print("\n".join((*table_lines(results), "", *ladder_lines(results))))
    return 0


def draw_residuals(results: Sequence[Diagnosed], path: Path) -> None:
    """One row per joint that has traces, one column per run: residual of the motor balance over time, before and after."""

    def traces(one: Diagnosed) -> dict[str, Trace]:
        mine = (t for t in one.findings.traces if t.balance == "motor" and t.joint == one.number)
        return {trace.run: trace for trace in mine}

    rows = [one for one in results if traces(one)]
    runs = list(dict.fromkeys(run for one in rows for run in traces(one)))
    size = max(len(rows), 1), max(len(runs), 1)
    figure, axes = plt.subplots(*size, figsize=(5.6 * size[1], 1.7 * size[0]), squeeze=False)
    for line, one in zip(axes, rows, strict=False):
        for axis, run in zip(line, runs, strict=True):
            parts.plain(axis)
            trace = traces(one).get(run)
            if trace is None:
                axis.text(0.5, 0.5, "no usable sensor", transform=axis.transAxes, ha="center", fontsize=8)
                continue
            axis.plot(trace.time_s, trace.before_nm, color=parts.BEFORE, linewidth=0.9, label="before")
            if one.findings.causes:
                axis.plot(trace.time_s, trace.after_nm, color=parts.AFTER, linewidth=0.9, label="after")
            axis.axhline(0.0, color=parts.SENSOR, linewidth=0.8)
            axis.set_title(f"joint {one.number}, {run}: {one.findings.verdict}", fontsize=9)
        line[0].set_ylabel("residual [Nm]")
    for axis in axes[-1] if rows else ():
        axis.set_xlabel("time [s]")
    figure.tight_layout()
    named: dict[str, Any] = {}  # one legend above all panels: not every line is in each
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
