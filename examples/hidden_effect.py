"""Hide an effect in the emulated bench, find it over the bus, and measure what the extended model gains in jtqd.

    python -m examples.hidden_effect --effect torque_constant --bus none --out DIR --picture hidden.png
    python -m examples.hidden_effect --effect torque_constant --out DIR
    python -m jtqd.sim_can.bench_kernel run --time-travel --out DIR -- \\
        python -m examples.hidden_effect --effect torque_constant --bus sim:vcan0 --out DIR

A secret plant file -> `jtq campaign` on the bench that it makes -> `jtq diagnose` with the nominal joint files -> jtqd
with the nominal and with the extended joint files on fresh motions of the same bench -> `jtq diagnose` once more, with
the extended files. Every step is a command of its own, printed before it runs; docs/diagnosis.md, "End to end over the
bus".

The secret bench differs from the nominal joint files by one effect of joint 1 alone; noise, drives and the days
(`run_to_run`) are those of the campaign's bench. Its joints are otherwise what `jtq sim --plant` makes of their files.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import math
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml

from jtqd.daemon.logs import LogError, read_topics
from jtqd.daemon.logs.read import published_torque, reference_torque, sync_time
from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.command_line import count, natural, seconds
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.joint import Effect, Joint
from jtqd.estimator.methods import estimate_columns
from jtqd.estimator.observer import low_pass
from jtqd.estimator.run import RunTable
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.status import VALID
from jtqd.models.files import load_joint, load_yaml, shipped
from jtqd.sim_can.plant_file import plant_of_joint
from jtqd.sysid.campaign.emulated import emulated
from jtqd.sysid.fit.joint_writer import write_joint
from jtqd.sysid.planner.campaigns import variable_runs
from jtqd.sysid.planner.plan import DEFAULT_LIMITS, Plan
from jtqd.sysid.report.page import LIGHT, STYLE, check_picture
from jtqd.sysid.runs.files import read_run
from jtqd.sysid.runs.run_file import RunError
from jtqd.sysid.runs.tables import write_run

NUMBERS: Final = (1, 2)
SECRET_JOINT: Final = 1
NAMES: Final = ("torque_constant", "torque_ripple", "kinematic_error")
_PLANT: Final = "campaign_plant.yaml"
_KT_LOW: Final = 0.94
_FRESH_SEED: Final = 1000
"""Added to the seed: no motion of the fresh runs is one of the diagnosed runs."""
_DRIVE_ON: Final = 0x27
_DRIVE_MASK: Final = 0x6F
NO_BUS: Final = "none"
_FINDINGS: Final = 3
_STDERR: Final = 2
_METHODS: Final = ("efficiency", "tob")
_NEEDED: Final = ("scipy", "matplotlib", "jinja2")
Row = tuple[str, float, float]
"""Label of an error, and its value before and after [Nm]."""


class StepError(RuntimeError):
    """A command of the toolbox failed; the reason is in its log."""


def nominal_file(number: int) -> Path:
    """Joint file that campaign, diagnosis and jtqd begin with."""
    return shipped(f"joint{number}.yaml")


def secrets(joint: Joint) -> Mapping[str, Effect]:
    """Effects that can be hidden in `joint`, by name."""
    made = (
        Effect(
            "torque_constant", {"torque_constant_nm_per_a": _KT_LOW * joint.torque_constant_nm_per_a}
        ),  # 6 % low
        Effect("torque_ripple", {"amplitude_nm": 0.8, "order_per_motor_rev": 2.0, "phase_rad": 0.7}),
        Effect("kinematic_error", {"amplitude_rad": 1.0e-4, "order_per_motor_rev": 2.0, "phase_rad": 0.9}),
    )
    return {effect.name: effect for effect in made}


def write_secret(directory: Path, name: str) -> Path:
    """Write the plant file of the secret bench and its joint files; returns its path. Raises ConfigError, OSError."""
    directory.mkdir(parents=True, exist_ok=True)
    mapping: dict[str, Any] = load_yaml(shipped(_PLANT))
    for number in NUMBERS:
        joint = load_joint(nominal_file(number))
        effects = (secrets(joint)[name],) if number == SECRET_JOINT else ()
        file = f"joint{number}.yaml"
        write_joint(directory / file, replace(joint, effects=effects), "Joint of the secret bench.")
        own = plant_of_joint(joint).joints[0].deviations
        peak = {"torque_nm": own.stribeck_nm, "velocity_rad_s": own.stribeck_velocity_rad_s}
        part: dict[str, Any] = mapping[f"joint_{number}"]
        mapping[f"joint_{number}"] = {
            "joint": file,
            "deviations": {"stribeck": peak},
            **{key: part[key] for key in ("drive", "measurement")},
        }
    path = directory / "plant.yaml"
    path.write_text(yaml.safe_dump(mapping, sort_keys=False), encoding="utf-8")
    return path


def write_config(path: Path, joint_files: Mapping[int, Path], method: str) -> Path:
    """Write a configuration of jtqd for the bench: these joint files, this method. Raises OSError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    mapping: dict[str, Any] = load_yaml(shipped("bench.yaml"))
    mapping["estimator"] = {**mapping["estimator"], "method": method}
    for number, file in joint_files.items():
        mapping[f"joint_{number}"]["file"] = str(file.resolve())
    path.write_text(yaml.safe_dump(mapping, sort_keys=False), encoding="utf-8")
    return path


def plans(runs: int, fresh: int, seconds: float, seed: int) -> tuple[Plan, Plan]:
    """Plans of the runs to diagnose and of the fresh ones: drawn Fourier motions, none in both. Raises ConfigError."""
    joints = (load_joint(nominal_file(1)), load_joint(nominal_file(2)))
    limits = DEFAULT_LIMITS
    return (
        Plan("hidden effect", limits, variable_runs(limits, runs, seconds, seed=seed, joints=joints)),
        Plan(
            "hidden effect fresh",
            limits,
            variable_runs(limits, fresh, seconds, seed=seed + _FRESH_SEED, joints=joints),
        ),
    )


def log_rmse(logs: Sequence[Path], number: int, settings: EstimatorSettings) -> float:
    """Return the RMSE [Nm] of what joint `number` published in all logs while its drive was on and the joint moved.

    The sensor is filtered like the estimate. Standstill, where the estimate is an interval, does not count.
    Raises LogError.
    """
    return _rms([_log_errors(log, number, settings.bandwidth_rad_s) for log in logs], f"{number}")


def table_rmse(tables: Sequence[RunTable], number: int, joint: Joint, settings: EstimatorSettings) -> float:
    """Return the RMSE [Nm] of the whole-run estimate of run tables, in motion. Raises LogError."""
    errors = []
    for table in tables:
        columns = table.joint(number, joint.gear_ratio)
        result = estimate_columns(joint, settings, None, table.time_s, columns)
        assert columns.torque_nm is not None
        steps = np.diff(table.time_s, prepend=table.time_s[0])
        error = result.torque_nm - low_pass(columns.torque_nm, steps, settings.bandwidth_rad_s)
        errors.append(error[(result.status == VALID) & np.isfinite(error)])
    return _rms(errors, f"{number}")


def _rms(errors: Sequence[FloatArray], joint: str) -> float:
    whole = np.concatenate(errors) if errors else np.empty(0)
    if not len(whole):
        raise LogError(f"joint {joint}: found no estimate in motion, expected some")
    return float(np.sqrt(np.mean(np.square(whole))))


def _log_errors(log: Path, number: int, bandwidth_rad_s: float) -> FloatArray:
    state, frames = read_topics(log, (f"/joint/{number}/state", "/can/frames")).values()
    if not np.array_equal(state["cycle"], frames["cycle"]):
        raise LogError(f"{log}: found cycles in one topic that are not in the other, expected the same")
    sensor = reference_torque(state, sync_time(state["header"]["stamp"]), bandwidth_rad_s)
    error = published_torque(frames, number - 1) - sensor
    on = (state["statusword"] & _DRIVE_MASK) == _DRIVE_ON
    return np.asarray(error[on & (state["status"] == VALID) & np.isfinite(error)], np.float64)


def draw(path: Path, run_file: Path, result: Mapping[str, Any], extended: Path, method: str) -> None:
    """Draw the estimate of one fresh run with the nominal and with the extended joint file, and their errors.

    Needs matplotlib. Raises RunError, ConfigError, OSError.
    """
    import matplotlib as mpl

    mpl.use("Agg")  # files only; a display is not needed
    from matplotlib import pyplot as plt

    table, settings = read_run(run_file).table, EstimatorSettings(method=method)
    joints = {"before": load_joint(nominal_file(SECRET_JOINT)), "after": load_joint(extended)}
    found = next(iter(result["causes"]), None)
    named = "nothing" if found is None else f"{' or '.join(found['class'])} of joint {found['joint']}"
    with mpl.rc_context(STYLE | {"savefig.facecolor": LIGHT["paper"], "font.size": 9.0}):
        figure, (above, below) = plt.subplots(
            2, 1, figsize=(9.0, 4.2), sharex=True, layout="constrained", height_ratios=(1.3, 1.0)
        )
        for name, joint in joints.items():
            columns = table.joint(SECRET_JOINT, joint.gear_ratio)
            assert columns.torque_nm is not None
            steps = np.diff(table.time_s, prepend=table.time_s[0])
            sensor = low_pass(columns.torque_nm, steps, settings.bandwidth_rad_s)
            estimate = estimate_columns(joint, settings, None, table.time_s, columns)
            moving = np.where(estimate.status == VALID, 1.0, np.nan)
            error = (estimate.torque_nm - sensor) * moving
            label = f"{name}: {float(np.sqrt(np.nanmean(error**2))):.2f} Nm rms"
            if name == "before":
                above.plot(table.time_s, sensor, color=LIGHT["ink"], linewidth=1.2, label="torque sensor")
            above.plot(
                table.time_s,
                estimate.torque_nm * moving,
                color=LIGHT[name],
                linewidth=0.9,
                label=f"{name} the diagnosis",
            )
            below.plot(table.time_s, error, color=LIGHT[name], linewidth=0.8, label=label)
        above.set_title(
            f"hidden: {result['hidden']['name']} of joint {SECRET_JOINT}; found: {named}",
            loc="left",
            fontsize=11,
        )
        above.set_ylabel("joint torque [Nm]")
        below.set_ylabel("estimate - sensor [Nm]")
        below.set_xlabel("time of a run that the diagnosis has not seen [s]")
        below.axhline(0.0, color=LIGHT["soft"], linewidth=0.6)
        for axis in (above, below):
            axis.margins(x=0)
            axis.legend(loc="upper left", bbox_to_anchor=(1.005, 1.0), frameon=False)
        figure.savefig(path, dpi=110)
        plt.close(figure)


def main(arguments: list[str] | None = None) -> int:
    """Run all steps and print the table; exit status 0 done, 1 failure, 2 usage."""
    options = _parser().parse_args(arguments)
    missing = [name for name in _NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        print(
            f"hidden_effect: {', '.join(missing)} not installed: pip install 'jtqd[analysis]'",
            file=sys.stderr,
        )
        return 1
    try:
        options.out.mkdir(parents=True, exist_ok=True)
        if options.picture is not None:
            check_picture(options.picture)
        result = run(options)
        if options.picture is not None:
            fresh = sorted((options.out / "fresh_nominal").glob("*.csv.gz"))[0]
            extended = options.out / "diagnosis" / f"extended.joint{SECRET_JOINT}.yaml"
            draw(options.picture, fresh, result, extended, options.method)
    except (StepError, ConfigError, RunError, LogError) as error:
        print(f"hidden_effect: {error}", file=sys.stderr)
        return 1
    except OSError as error:
        print(f"hidden_effect: {error.filename or options.out}: {error.strerror or error}", file=sys.stderr)
        return 1
    print(json.dumps(result, indent=1) if options.json else "\n".join(lines(result)))
    return 0


def run(options: argparse.Namespace) -> dict[str, Any]:
    """Run all steps and return their results. Raises StepError, ConfigError, RunError, LogError, OSError."""
    out: Path = options.out
    nominal = {number: nominal_file(number) for number in NUMBERS}
    plant = write_secret(out / "secret", options.effect)
    diagnosed, fresh = plans(options.runs, options.fresh_runs, options.seconds, options.seed)
    bench = _Bench(options, plant)
    bench.play(diagnosed, "runs", nominal)
    found = _diagnose(out / "runs", nominal, out / "diagnosis")
    extended = {number: out / "diagnosis" / f"extended.joint{number}.yaml" for number in NUMBERS}
    before = bench.play(fresh, "fresh_nominal", nominal)
    after = bench.play(fresh, "fresh_extended", extended)
    fresh_before = _diagnose(out / "fresh_nominal", nominal, out / "diagnosis_fresh_nominal")
    fresh_after = _diagnose(out / "fresh_extended", extended, out / "diagnosis_fresh_extended")
    again = _diagnose(out / "runs", extended, out / "diagnosis_extended")
    hidden = secrets(load_joint(nominal[SECRET_JOINT]))[options.effect]
    return {
        "hidden": {"name": hidden.name, "joint": SECRET_JOINT, "parameters": dict(hidden.parameters)},
        "verdict": found["verdict"],
        "causes": found["causes"],
        "gain": found["gain"],
        "simulation": {
            number: {
                balance: (_gap(fresh_before, number, balance), _gap(fresh_after, number, balance))
                for balance in ("motor", "torsion")
            }
            for number in NUMBERS
        },
        "jtqd": {number: (before[number], after[number]) for number in NUMBERS},
        "method": options.method,
        "bus": options.bus,
        "extended_on_the_same_runs": _verdict(again),
        "extended_on_fresh_runs": _verdict(fresh_after),
    }


def lines(result: Mapping[str, Any]) -> list[str]:
    """Return the result as text: hidden effect, diagnosis, and errors before and after."""
    hidden, gain = result["hidden"], result["gain"]
    values = ", ".join(f"{name} {value:.4g}" for name, value in hidden["parameters"].items())
    out = [
        f"hidden  {hidden['name']} of joint {hidden['joint']}: {values}",
        f"found   verdict {result['verdict']}",
    ]
    for cause in result["causes"]:
        parameters = ", ".join(
            f"{name} {each['value']:.4g}{_interval(each)}" for name, each in cause["parameters"].items()
        )
        out.append(f"        {' or '.join(cause['class'])} of joint {cause['joint']}: {parameters}")
    where = "jtqd on fresh runs" if result["bus"] != NO_BUS else "estimator on fresh runs"
    rows: list[Row] = []
    if gain["rmse_before_nm"] is not None:
        rows.append((f"diagnosis: {gain['split']}", gain["rmse_before_nm"], gain["rmse_after_nm"]))
    for number, balances in result["simulation"].items():
        rows += [
            (f"simulation on fresh runs: joint {number}, {b} balance", *both) for b, both in balances.items()
        ]
    rows += [(f"{where}: joint {n}, method {result['method']}", *both) for n, both in result["jtqd"].items()]
    wide = max(len(row[0]) for row in rows)
    out += ["", f"{'error against the sensor, Nm rms':<{wide}}  before   after  reduced by"]
    out += [f"{what:<{wide}}  {b:6.3f}  {a:6.3f}  {_reduction(b, a):>10}" for what, b, a in rows]
    out += ["", f"extended files, same runs:  {result['extended_on_the_same_runs']}"]
    out += [f"extended files, fresh runs: {result['extended_on_fresh_runs']}"]
    return out


class _Bench:
    """The secret bench on a bus, with jtqd; or without a bus, with the estimator alone."""

    def __init__(self, options: argparse.Namespace, plant: Path) -> None:
        self._options = options
        self._plant = plant
        self._settings = EstimatorSettings(method=options.method)

    def play(self, plan: Plan, name: str, joints: Mapping[int, Path]) -> dict[int, float]:
        """Play a plan into out/name while jtqd estimates with these joint files; return its error per joint [Nm rms]."""
        out: Path = self._options.out / name
        if self._options.bus == NO_BUS:
            out.mkdir(exist_ok=True)
            tables = emulated(plan, self._plant, self._options.seed)
            for run_name, table in tables.items():
                write_run(out / f"{run_name}.csv.gz", table)
            kept = [read_run(out / f"{run_name}.csv.gz").table for run_name in tables]
            return {n: table_rmse(kept, n, load_joint(file), self._settings) for n, file in joints.items()}
        file = self._options.out / f"{plan.name.replace(' ', '_')}.plan.yaml"
        file.write_text(plan.to_yaml(), encoding="utf-8")
        config = write_config(self._options.out / f"{name}.jtqd.yaml", joints, self._options.method)
        bench = ("--bus", self._options.bus, "--plant", str(self._plant), "--seed", str(self._options.seed))
        _jtq("campaign", str(file), *bench, "--config", str(config), "--out", str(out))
        logs = [out / f"{each.name}.mcap" for each in plan.runs]
        return {number: log_rmse(logs, number, self._settings) for number in joints}


def _diagnose(runs: Path, joints: Mapping[int, Path], out: Path) -> dict[str, Any]:
    files = [part for number, file in joints.items() for part in ("--joint", f"{number}={file}")]
    _jtq("diagnose", str(runs), *files, "--out", str(out), "--force")
    found: dict[str, Any] = json.loads((out / "findings.json").read_text())
    return found


def _jtq(*arguments: str) -> None:
    """Run a command of the toolbox; its results go to standard error. Raises StepError."""
    print(f"$ jtq {' '.join(arguments)}", file=sys.stderr, flush=True)
    command = [sys.executable, "-m", "jtqd.daemon.jtq", *arguments]
    status = subprocess.run(command, check=False, stdout=_STDERR).returncode
    if status not in (0, _FINDINGS):
        raise StepError(f"jtq {arguments[0]} ended with exit status {status}")


def _gap(findings: Mapping[str, Any], joint: int, balance: str) -> float:
    for gap in findings["gaps"]:
        if (gap["joint"], gap["balance"]) == (joint, balance):
            return float(gap["rmse_nm"])
    return math.nan


def _verdict(findings: Mapping[str, Any]) -> str:
    names = ", ".join(f"{each['name']} of {each['joint']}" for each in findings["causes"])
    return f"{findings['verdict']}{f' ({names})' if names else ''}"


def _interval(value: Mapping[str, Any]) -> str:
    low, high = value["ci95"]
    return "" if low is None or high is None or low == high else f" [{low:.4g}, {high:.4g}]"


def _reduction(before: float, after: float) -> str:
    return f"{100.0 * (1.0 - after / before):.0f} %" if before > 0.0 else "-"


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m examples.hidden_effect",
        description="Hide an effect in the emulated bench, diagnose it from a campaign, and measure the gain in jtqd.",
        epilog="example: python -m examples.hidden_effect --effect torque_ripple --out hidden",
    )
    add = parser.add_argument
    add("--effect", choices=NAMES, required=True, help="effect hidden in joint 1")
    add("--out", type=Path, required=True, metavar="DIR", help="output directory; created if missing")
    add("--bus", default="sim", help=f"sim, sim:BUS, or {NO_BUS}: the bench without a bus (default sim)")
    add("--method", choices=_METHODS, default=_METHODS[0], help="of jtqd (default efficiency)")
    add("--runs", type=count, default=6, metavar="N", help="runs to diagnose (default 6)")
    add("--fresh-runs", type=count, default=4, metavar="N", help="fresh runs (default 4)")
    add("--seconds", type=seconds, default=16.0, metavar="S", help="length of a run (default 16)")
    add("--seed", type=natural, default=0, help="of motions, days and noise (default 0)")
    add("--picture", type=Path, metavar="FILE", help="draw the estimate before and after (png, svg)")
    add("--json", action="store_true", help="print the result as JSON")
    return parser


if __name__ == "__main__":
    sys.exit(main())
