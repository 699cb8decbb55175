"""Hide an effect in the emulated bench, find it over the bus, and measure what the extended model gains in jtqd.

    python -m examples.hidden_effect --effect torque_constant --bus none --out DIR --picture hidden.png
    python -m examples.hidden_effect --effect torque_constant --out DIR
    python -m jtqd.sim_can.bench_kernel run --time-travel --out DIR -- \\
        python -m examples.hidden_effect --effect torque_constant --bus sim:vcan0 --out DIR

A secret plant file -> `jtq campaign` on the bench that it makes -> `jtq diagnose` with the nominal joint files -> jtqd
with the nominal and with the extended joint files on fresh motions of the same bench -> `jtq diagnose` once more on the
first runs, with the extended files. Every step is a command of its own, printed before it runs. `jtq score` gives the
errors of both files' simulations on any runs.

The secret bench differs from the nominal joint files by one effect of joint 1 alone; noise, drives and the days
(`run_to_run`) are those of the campaign's bench. Its joints are otherwise what `jtq sim --plant` makes of their files.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import yaml

from jtqd.daemon.logs import LogError, read_topics
from jtqd.daemon.logs.read import published_torque, reference_torque, sync_time
from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.estimator.command_line import check_installed, count, make_directory, natural, seconds
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.estimator import estimate_columns
from jtqd.estimator.joint import Effect, Joint
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
"""The torque constant is 6 % low."""
_FRESH_SEED: Final = 1000
"""Added to the seed: no motion of the fresh runs is one of the diagnosed runs."""
_DRIVE_ON: Final = 0x27
_DRIVE_MASK: Final = 0x6F
NO_BUS: Final = "none"
_FINDINGS: Final = 3
_STDERR: Final = 2
_METHODS: Final = ("efficiency", "tob")


def nominal_file(number: int) -> Path:
    """Joint file that campaign, diagnosis and jtqd begin with."""
    return shipped(f"joint{number}.yaml")


def secrets(joint: Joint) -> Mapping[str, Effect]:
    """Effects that can be hidden in `joint`, by name."""
    low = {"torque_constant_nm_per_a": _KT_LOW * joint.torque_constant_nm_per_a}
    wave = {"order_per_motor_rev": 2.0}
    made = (
        Effect("torque_constant", low),
        Effect("torque_ripple", {"amplitude_nm": 0.8, **wave, "phase_rad": 0.7}),
        Effect("kinematic_error", {"amplitude_rad": 1.0e-4, **wave, "phase_rad": 0.9}),
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
        peak = asdict(plant_of_joint(joint).joints[0].deviations.stribeck)
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
    mapping["estimator"] = {**mapping["estimator"], "method": method, "shadow": []}
    for number, file in joint_files.items():
        mapping[f"joint_{number}"]["file"] = str(file.resolve())
        mapping[f"joint_{number}"].pop("shadow_networks", None)
    path.write_text(yaml.safe_dump(mapping, sort_keys=False), encoding="utf-8")
    return path


def plans(runs: int, fresh: int, seconds: float, seed: int) -> tuple[Plan, Plan]:
    """Plans of the runs to diagnose and of the fresh ones: drawn Fourier motions, none in both. Raises ConfigError."""
    joints = (load_joint(nominal_file(1)), load_joint(nominal_file(2)))

    def plan(name: str, count: int, seed: int) -> Plan:
        drawn = variable_runs(DEFAULT_LIMITS, count, seconds, seed=seed, joints=joints)
        return Plan(name, DEFAULT_LIMITS, drawn)

    return plan("hidden effect", runs, seed), plan("hidden effect fresh", fresh, seed + _FRESH_SEED)


def log_rmse(logs: Sequence[Path], number: int, settings: EstimatorSettings) -> float:
    """Return the RMSE [Nm] of what joint `number` published in all logs while its drive was on and the joint moved.

    The sensor is filtered like the estimate. Standstill, where the estimate is an interval, does not count.
    """
    errors = []
    for log in logs:
        state, frames = read_topics(log, (f"/joint/{number}/state", "/can/frames")).values()
        if not np.array_equal(state["cycle"], frames["cycle"]):
            raise LogError(f"{log}: found cycles in one topic that are not in the other, expected the same")
        sensor = reference_torque(state, sync_time(state["header"]["stamp"]), settings.bandwidth_rad_s)
        moving = ((state["statusword"] & _DRIVE_MASK) == _DRIVE_ON) & (state["status"] == VALID)
        errors.append((published_torque(frames, number - 1) - sensor)[moving])
    return rms(errors)


class Estimated(NamedTuple):
    """Torque and low-passed sensor of a run [n], and where the joint moves."""

    torque_nm: FloatArray
    sensor_nm: FloatArray
    moving: BoolArray


def estimated(table: RunTable, number: int, joint: Joint, settings: EstimatorSettings) -> Estimated:
    """Return the whole-run estimate of a joint."""
    columns = table.joint(number, joint.gear_ratio)
    assert columns.torque_nm is not None
    found = estimate_columns(joint, settings, None, table.time_s, columns)
    steps = np.diff(table.time_s, prepend=table.time_s[0])
    sensor = low_pass(columns.torque_nm, steps, settings.bandwidth_rad_s)
    return Estimated(found.torque_nm, sensor, found.status == VALID)


def table_rmse(tables: Sequence[RunTable], number: int, joint: Joint, settings: EstimatorSettings) -> float:
    """Return the RMSE [Nm] of the whole-run estimate of run tables, in motion."""
    found = [estimated(table, number, joint, settings) for table in tables]
    return rms([(each.torque_nm - each.sensor_nm)[each.moving] for each in found])


def rms(errors: Sequence[FloatArray]) -> float:
    """Return the root mean square of all finite values. Raises LogError without any."""
    whole = np.concatenate(errors)
    whole = whole[np.isfinite(whole)]
    if not len(whole):
        raise LogError("found no estimate in motion, expected some")
    return float(np.sqrt(np.mean(np.square(whole))))


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
            torque, sensor, moves = estimated(table, SECRET_JOINT, joint, settings)
            moving = np.where(moves, 1.0, np.nan)
            error = (torque - sensor) * moving
            if name == "before":
                above.plot(table.time_s, sensor, color=LIGHT["ink"], linewidth=1.2, label="torque sensor")
            line = {"color": LIGHT[name], "linewidth": 0.9}
            above.plot(table.time_s, torque * moving, **line, label=f"{name} the diagnosis")
            label = f"{name}: {float(np.sqrt(np.nanmean(error**2))):.2f} Nm rms"
            below.plot(table.time_s, error, **line | {"linewidth": 0.8}, label=label)
        title = f"hidden: {result['hidden']['name']} of joint {SECRET_JOINT}; found: {named}"
        above.set_title(title, loc="left", fontsize=11)
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
    try:
        check_installed("analysis", "scipy", "matplotlib", "jinja2")
        make_directory(options.out)
        if options.picture is not None:
            check_picture(options.picture)
        result = run(options)
        if options.picture is not None:
            fresh = min((options.out / "fresh_nominal").glob("*.csv.gz"))
            extended = options.out / "diagnosis" / f"extended.joint{SECRET_JOINT}.yaml"
            draw(options.picture, fresh, result, extended, options.method)
    except (ModuleNotFoundError, RuntimeError, ConfigError, RunError, LogError, OSError) as error:
        print(f"hidden_effect: {error}", file=sys.stderr)
        return 1
    print(json.dumps(result, indent=1) if options.json else "\n".join(lines(result)))
    return 0


def run(options: argparse.Namespace) -> dict[str, Any]:
    """Run all steps and return their results. Raises RuntimeError, ConfigError, RunError, LogError, OSError."""
    out: Path = options.out
    nominal = {number: nominal_file(number) for number in NUMBERS}
    plant = write_secret(out / "secret", options.effect)
    diagnosed, fresh = plans(options.runs, options.fresh_runs, options.seconds, options.seed)
    play = partial(_play, options, plant)
    play(diagnosed, "runs", nominal)
    found = _diagnose(out / "runs", nominal, out / "diagnosis")
    extended = {number: out / "diagnosis" / f"extended.joint{number}.yaml" for number in NUMBERS}
    before = play(fresh, "fresh_nominal", nominal)
    after = play(fresh, "fresh_extended", extended)
    again = _diagnose(out / "runs", extended, out / "diagnosis_extended")
    hidden = secrets(load_joint(nominal[SECRET_JOINT]))[options.effect]
    return {
        "hidden": {"name": hidden.name, "joint": SECRET_JOINT, "parameters": dict(hidden.parameters)},
        "verdict": found["verdict"],
        "causes": found["causes"],
        "gain": found["gain"],
        "jtqd": {number: (before[number], after[number]) for number in NUMBERS},
        "method": options.method,
        "bus": options.bus,
        "extended_on_the_same_runs": _verdict(again),
    }


def lines(result: Mapping[str, Any]) -> list[str]:
    """Return the result as text: hidden effect, diagnosis, and errors before and after."""
    hidden, gain, on_bus = result["hidden"], result["gain"], result["bus"] != NO_BUS
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
    rows = [(f"diagnosis: {gain['split']}", gain["rmse_before_nm"], gain["rmse_after_nm"])]
    where = f"{'jtqd' if on_bus else 'estimator'} on fresh runs"
    rows += [(f"{where}: joint {n}, method {result['method']}", *both) for n, both in result["jtqd"].items()]
    rows = [row for row in rows if row[1] is not None]
    wide = max(len(row[0]) for row in rows)
    out += ["", f"{'error against the sensor, Nm rms':<{wide}}  before   after  reduced by"]
    for what, before, after in rows:
        reduced = f"{100.0 * (1.0 - after / before):.0f} %" if before > 0.0 else "-"
        out.append(f"{what:<{wide}}  {before:6.3f}  {after:6.3f}  {reduced:>10}")
    return [*out, "", f"with the extended files, the same runs: {result['extended_on_the_same_runs']}"]


def _play(
    options: argparse.Namespace, plant: Path, plan: Plan, name: str, joints: Mapping[int, Path]
) -> dict[int, float]:
    """Play a plan into out/name on the secret bench: with a bus while jtqd estimates with these joint files, else with the
    estimator alone. Return the error of the estimate per joint [Nm rms].
    """
    out: Path = options.out / name
    settings = EstimatorSettings(method=options.method)
    if options.bus == NO_BUS:
        out.mkdir(exist_ok=True)
        files = [out / f"{each.name}.csv.gz" for each in plan.runs]
        for file, table in zip(files, emulated(plan, plant, options.seed).values(), strict=True):
            write_run(file, table)
        kept = [read_run(file).table for file in files]
        return {n: table_rmse(kept, n, load_joint(file), settings) for n, file in joints.items()}
    planned = options.out / f"{plan.name.replace(' ', '_')}.plan.yaml"
    planned.write_text(plan.to_yaml(), encoding="utf-8")
    config = write_config(options.out / f"{name}.jtqd.yaml", joints, options.method)
    bench = ("--bus", options.bus, "--plant", str(plant), "--seed", str(options.seed))
    _jtq("campaign", str(planned), *bench, "--config", str(config), "--out", str(out))
    return {n: log_rmse([out / f"{each.name}.mcap" for each in plan.runs], n, settings) for n in joints}


def _diagnose(runs: Path, joints: Mapping[int, Path], out: Path) -> dict[str, Any]:
    files = [part for number, file in joints.items() for part in ("--joint", f"{number}={file}")]
    _jtq("diagnose", str(runs), *files, "--out", str(out), "--force")
    found: dict[str, Any] = json.loads((out / "findings.json").read_text())
    return found


def _jtq(*arguments: str) -> None:
    """Run a command of the toolbox; its results go to standard error. Raises RuntimeError."""
    print(f"$ jtq {' '.join(arguments)}", file=sys.stderr, flush=True)
    command = [sys.executable, "-m", "jtqd.daemon.jtq", *arguments]
    status = subprocess.run(command, check=False, stdout=_STDERR).returncode
    if status not in (0, _FINDINGS):
        raise RuntimeError(f"jtq {arguments[0]} ended with exit status {status}")


def _verdict(findings: Mapping[str, Any]) -> str:
    names = ", ".join(f"{each['name']} of {each['joint']}" for each in findings["causes"])
    return f"{findings['verdict']}{f' ({names})' if names else ''}"


def _interval(value: Mapping[str, Any]) -> str:
    low, high = value["ci95"]
    return "" if low is None or high is None or low == high else f" [{low:.4g}, {high:.4g}]"


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
