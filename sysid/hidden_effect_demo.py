"""An effect hidden in the emulated bench, found over the bus, and what the extended model is then worth in jtqd.

    python -m sysid.hidden_effect_demo --effect torque_constant --out DIR
    python -m sim_can.bench_kernel run --time-travel --out DIR -- python -m sysid.hidden_effect_demo \
        --effect torque_constant --bus sim:vcan0 --out DIR

A secret plant file -> `jtq campaign` on the bench that it makes -> `jtq diagnose` with the nominal joint files -> jtqd
with the nominal and with the extended joint files on fresh motions of the same bench -> `jtq diagnose` once more, with
the extended files. Every step is a command of its own, printed before it runs. docs/diagnosis.md, "End to end over the bus".
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from daemon.logs.reader import LogError
from estimator.arguments import count, natural, seconds
from estimator.checked import ConfigError
from estimator.settings import EstimatorSettings
from models.files import load_joint
from sim_can.run_files import RunError, read_run
from sim_can.run_table_file import write_run
from sysid.campaign.plan import Plan
from sysid.emulated_runs import emulated
from sysid.hidden_effect import (
    NAMES,
    NUMBERS,
    SECRET_JOINT,
    nominal_file,
    plans,
    secrets,
    write_config,
    write_secret,
)
from sysid.hidden_effect_score import log_rmse, table_rmse

NO_BUS: Final = "none"
_FINDINGS: Final = 3
_STDERR: Final = 2
_METHODS: Final = ("efficiency", "tob")
Row = tuple[str, float, float]
"""What is judged, and its error before and after [Nm]."""


class StepError(RuntimeError):
    """A command of the toolbox failed; it has said why."""


def main(arguments: list[str] | None = None) -> int:
    """Run all steps and print the table; exit status 0 done, 1 failure, 2 usage."""
    options = _parser().parse_args(arguments)
    try:
        options.out.mkdir(parents=True, exist_ok=True)
        result = run(options)
    except (StepError, ConfigError, RunError, LogError) as error:
        print(f"hidden_effect_demo: {error}", file=sys.stderr)
        return 1
    except OSError as error:
        print(
            f"hidden_effect_demo: {error.filename or options.out}: {error.strerror or error}", file=sys.stderr
        )
        return 1
    print(json.dumps(result, indent=1) if options.json else "\n".join(lines(result)))
    return 0


def run(options: argparse.Namespace) -> dict[str, Any]:
    """All steps; what they showed. Raises StepError, ConfigError, RunError, LogError, OSError."""
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
        "extended_on_the_same_runs": _said(again),
        "extended_on_fresh_runs": _said(fresh_after),
    }


def lines(result: Mapping[str, Any]) -> list[str]:
    """The result as text: hidden, found, and errors before and after."""
    hidden, gain = result["hidden"], result["gain"]
    values = ", ".join(f"{name} {value:.4g}" for name, value in hidden["parameters"].items())
    out = [
        f"hidden  {hidden['name']} of joint {hidden['joint']}: {values}",
        f"found   verdict {result['verdict']}",
    ]
    for cause in result["causes"]:
        told = ", ".join(
            f"{name} {each['value']:.4g}{_interval(each)}" for name, each in cause["parameters"].items()
        )
        out.append(f"        {' or '.join(cause['class'])} of joint {cause['joint']}: {told}")
    where = "jtqd on fresh runs" if result["bus"] != NO_BUS else "estimator on fresh runs"
    rows: list[Row] = []
    if gain["rmse_before_nm"] is not None:
        rows.append((f"promised: {gain['split']}", gain["rmse_before_nm"], gain["rmse_after_nm"]))
    for number, balances in result["simulation"].items():
        rows += [
            (f"simulation on fresh runs: joint {number}, {b} balance", *both) for b, both in balances.items()
        ]
    rows += [(f"{where}: joint {n}, method {result['method']}", *both) for n, both in result["jtqd"].items()]
    wide = max(len(row[0]) for row in rows)
    out += ["", f"{'error against the sensor, Nm rms':<{wide}}  before   after  taken away"]
    out += [f"{what:<{wide}}  {b:6.3f}  {a:6.3f}  {_taken(b, a):10.3f}" for what, b, a in rows]
    out += ["", f"extended files, same runs:  {result['extended_on_the_same_runs']}"]
    out += [f"extended files, fresh runs: {result['extended_on_fresh_runs']}"]
    return out


class _Bench:
    """Where the motions take place: the secret bench on a bus, with jtqd; or without a bus, with the estimator alone."""

    def __init__(self, options: argparse.Namespace, plant: Path) -> None:
        self._options = options
        self._plant = plant
        self._settings = EstimatorSettings(method=options.method)

    def play(self, plan: Plan, name: str, joints: Mapping[int, Path]) -> dict[int, float]:
        """Play a plan into out/name while jtqd estimates with these joint files; its error per joint [Nm rms]."""
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
    command = [sys.executable, "-m", "daemon.jtq", *arguments]
    status = subprocess.run(command, check=False, stdout=_STDERR).returncode
    if status not in (0, _FINDINGS):
        raise StepError(f"jtq {arguments[0]} ended with exit status {status}")


def _gap(findings: Mapping[str, Any], joint: int, balance: str) -> float:
    for gap in findings["gaps"]:
        if (gap["joint"], gap["balance"]) == (joint, balance):
            return float(gap["rmse_nm"])
    return math.nan


def _said(findings: Mapping[str, Any]) -> str:
    names = ", ".join(f"{each['name']} of {each['joint']}" for each in findings["causes"])
    return f"{findings['verdict']}{f' ({names})' if names else ''}"


def _interval(value: Mapping[str, Any]) -> str:
    low, high = value["ci95"]
    return "" if low is None or high is None or low == high else f" [{low:.4g}, {high:.4g}]"


def _taken(before: float, after: float) -> float:
    """Rms of what is gone: independent errors add in squares, so this can be compared where what is left differs."""
    return math.copysign(math.sqrt(abs(before**2 - after**2)), before - after)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m sysid.hidden_effect_demo",
        description="Hide an effect in the emulated bench, find it from a campaign, and measure what jtqd gains by it.",
        epilog="example: python -m sysid.hidden_effect_demo --effect torque_ripple --out hidden",
    )
    add = parser.add_argument
    add("--effect", choices=NAMES, required=True, help="what is hidden in joint 1")
    add("--out", type=Path, required=True, metavar="DIR", help="everything goes there; made if missing")
    add("--bus", default="sim", help=f"sim, sim:BUS, or {NO_BUS}: the bench without a bus (default sim)")
    add("--method", choices=_METHODS, default=_METHODS[0], help="of jtqd (default efficiency)")
    add("--runs", type=count, default=6, metavar="N", help="runs to diagnose (default 6)")
    add("--fresh-runs", type=count, default=4, metavar="N", help="fresh runs (default 4)")
    add("--seconds", type=seconds, default=16.0, metavar="S", help="length of a run (default 16)")
    add("--seed", type=natural, default=0, help="of motions, days and noise (default 0)")
    add("--json", action="store_true", help="print the result as JSON")
    return parser


if __name__ == "__main__":
    sys.exit(main())
