"""The paper's whole procedure and ours on a bench: campaigns, fits, training, evaluation, report.

    python -m validation reproduce --out reproduction            everything, about 85 minutes, 41 of them motion of the bench
    python -m validation reproduce --out /tmp/quick --quick      the same steps with shorter runs, too few for good figures
    python -m validation reproduce --plant models/plants/typical.yaml --out typical     another bench, without a bus

Every step is a `jtq` command of its own, printed before it runs, so that it can be repeated alone. Campaigns go on where
they were interrupted; fits and training give the same files from the same runs. With --plant the bench is another one
(docs/testing.md), and its campaigns are emulated without a bus, with the true torques beside the runs.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import re
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Final, NamedTuple

import yaml

from jtqd.estimator.command_line import check_installed, make_directory, natural
from jtqd.models.files import shipped
from jtqd.sysid.campaign.state import DONE, STATE_FILE
from jtqd.sysid.planner.campaigns import outside_runs
from jtqd.sysid.planner.plan import DEFAULT_LIMITS, Plan
from validation.study import Report, Table

_OUTSIDE_PLANT: Final = "campaign_plant_outside.yaml"
_FINDINGS: Final = 3
_OTHER_DAYS: Final = 7
"""Added to the seed: days and trajectories that no campaign has."""
_NEEDED: Final = ("torch", "onnx", "scipy", "matplotlib", "jinja2")
_VALIDATION_DAYS: Final = 1000
"""Added to the seed of emulated runs that judge."""
_EMULATED: Final = "jtqd.sysid.campaign.emulated"
_TRAINED: Final = "trained"
"""Folder in models/ with what this study has made; beside the configuration in a directory of its own."""


class Step(NamedTuple):
    """A command of the toolbox, and whether findings (exit status 3) are a result to go on with."""

    arguments: tuple[str, ...]
    findings_are_fine: bool = False
    module: str = "jtqd.daemon.jtq"

    @property
    def text(self) -> str:
        name = "jtq" if self.module == "jtqd.daemon.jtq" else f"python -m {self.module}"
        return " ".join((name, *self.arguments))

    @property
    def out(self) -> Path:
        """What it writes: a file, or a directory."""
        return Path(self.arguments[self.arguments.index("--out") + 1])


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="output directory; created if missing"
    )
    parser.add_argument(
        "--bus",
        default="sim",
        metavar="BUS",
        help="sim, sim:vcan0: the emulated bench on SocketCAN, or exact: in exact time (default sim)",
    )
    parser.add_argument(
        "--plant",
        type=Path,
        metavar="FILE",
        help="plant or bench file: every campaign is emulated on it without a bus, none outside its range",
    )
    parser.add_argument(
        "--quick", action="store_true", help="small campaigns and short training, to test the steps"
    )
    parser.add_argument(
        "--seed", type=natural, default=0, help="of trajectories, days and weights (default 0)"
    )


def run(options: argparse.Namespace) -> Report:
    """Run all steps. Raises RuntimeError with the step that failed, ConfigError, OSError."""
    out: Path = options.out
    make_directory(out)
    check_installed("train", *_NEEDED)  # a step asks for it only after an hour of campaigns
    (out / "models").mkdir(parents=True, exist_ok=True)
    _write_outside_plan(out / "outside.plan.yaml", options.seed, 2 if options.quick else 6)
    rows = run_steps(steps(out, options.bus, options.quick, options.seed, options.plant))
    for name in ("bench.yaml", "bench_paper.yaml"):
        write_config(out / "models" / name, name)
    notes = [
        f"report: {out / 'report' / 'evaluation.html'}, of many days {out / 'report_days' / 'evaluation.html'}",
        f"configuration for jtqd: {out / 'models' / 'bench.yaml'}",
    ]
    reached = all(status == 0 for _, status, _ in rows)
    table = Table(("step", "status", "time"), [(text, str(s), f"{t:.0f} s") for text, s, t in rows])
    return Report([table], {"seed": options.seed}, notes, reached=reached)


def run_steps(wanted: Iterable[Step]) -> list[tuple[str, int, float]]:
    """Run steps one after the other; return (command, exit status, seconds). Raises RuntimeError with one that fails."""
    rows = []
    for step in wanted:
        print(f"$ {step.text}", file=sys.stderr, flush=True)
        begin = time.monotonic()
        status = _run(step)
        if status and not (status == _FINDINGS and step.findings_are_fine):
            raise RuntimeError(f"{' '.join(step.text.split()[:3])} ended with status {status}")
        rows.append((step.text, status, time.monotonic() - begin))
    return rows


def _run(step: Step) -> int:
    """Run a step; a campaign that ended early goes on for as long as each attempt gets at least one more run done."""
    done = -1
    while True:
        status = subprocess.run([sys.executable, "-m", step.module, *step.arguments], check=False).returncode
        if status != 1 or step.arguments[0] != "campaign":
            return status
        now = _runs_done(step.out)
        if now <= done:
            return status
        done = now
        print(f"reproduce: runs done: {now}; the campaign continues", file=sys.stderr, flush=True)


def _runs_done(campaign: Path) -> int:
    """Return how many runs of a campaign are done; -1 where no campaign was begun."""
    try:
        runs = json.loads((campaign / STATE_FILE).read_text(encoding="utf-8"))["runs"]
    except (OSError, ValueError, KeyError):
        return -1
    return sum(run["status"] == DONE for run in runs)


def steps(out: Path, bus: str, quick: bool, seed: int, plant: Path | None = None) -> Iterator[Step]:
    """Yield the commands in their order; plant: another bench than the shipped one, without a bus."""
    runs, models, work = out / "campaigns", out / "models", out / "work"
    work.mkdir(exist_ok=True)
    common = ("--bus", bus, "--seed", str(seed))
    sizes = {
        "efficiency": ("--quick",) if quick else ("--hold", "1.2"),
        "excitation": ("--runs", "8", "--seconds", "8", "--evaluations", "160")
        if quick
        else ("--runs", "96", "--seconds", "12", "--evaluations", "400"),
        "quick": ("--runs", "6", "--seconds", "6") if quick else ("--runs", "20", "--seconds", "12"),
        "validate": ("--runs", "2", "--seconds", "6", "--hold", "1.0")
        if quick
        else ("--runs", "96", "--seconds", "8", "--hold", "1.6"),
    }

    def campaign(kind: str) -> Step:
        where = ("--out", str(runs / kind), *sizes[kind])
        if plant is None:
            return Step(("campaign", kind, *common, *where), True)
        # runs that judge are of days that no fit has seen
        days = seed + (_VALIDATION_DAYS if kind == "validate" else 0)
        arguments = ("--kind", kind, "--plant", str(plant), "--seed", str(days), *where)
        return Step(arguments, module=_EMULATED)

    for kind in ("excitation", "quick", "efficiency"):
        yield campaign(kind)
    for n in ("1", "2"):
        first, fitted, last = shipped(f"joint{n}.yaml"), work / f"joint{n}.yaml", models / f"joint{n}.yaml"
        number = ("--number", n)
        yield Step(("fit", "efficiency", str(runs / "efficiency"), "--joint", str(first), *number, "--out", str(fitted),
                    "--plot", str(out / f"efficiency_joint{n}.png")))  # fmt: skip
        yield Step(
            ("fit", "losses", str(runs / "excitation"), "--joint", str(fitted), *number, "--out", str(last))
        )
    joints = ("--joint", str(models / "joint1.yaml"), "--joint", str(models / "joint2.yaml"))
    short = ("--iterations", "30") if quick else ()
    for network, sources in (("paper", ("excitation",)), ("ours", ("excitation", "quick"))):
        yield Step(
            ("train", *(str(runs / kind) for kind in sources), *joints, "--network", network, "--seed", str(seed),
             "--out", str(models), *short),
            network == "ours",  # one that its gate refuses is a result: the configuration then has none
        )  # fmt: skip
    yield campaign("validate")
    outside: tuple[str, ...] = ()
    if plant is None:
        plan, stronger = str(out / "outside.plan.yaml"), str(shipped(_OUTSIDE_PLANT))
        outside = ("--outside", str(runs / "outside"))
        yield Step(("campaign", plan, *common, "--plant", stronger, "--out", outside[1]), True)
    yield Step(
        ("evaluate", str(runs / "validate"), *outside, "--models", str(models), "--out", str(out / "report")),
        True,
    )
    # How often an interval covers takes more days than a bus has time for.
    days = ("2", "6", "1.0") if quick else ("384", "8", "1.6")
    size = tuple(x for pair in zip(("--runs", "--seconds", "--hold"), days, strict=True) for x in pair)
    other = ("--seed", str(seed + _OTHER_DAYS))
    bench = () if plant is None else ("--plant", str(plant))
    yield Step(("--out", str(out / "days"), *bench, *size, *other), module=_EMULATED)
    yield Step(
        ("evaluate", str(out / "days"), "--models", str(models), "--out", str(out / "report_days")), True
    )


def _write_outside_plan(path: Path, seed: int, count: int) -> None:
    """Write the plan of runs with half as much load again as any that is trained on."""
    limits = replace(DEFAULT_LIMITS, current_a=16.0, torque_nm=90.0)
    plan = Plan("outside", limits, outside_runs(limits, count, 9.0, seed=seed))
    path.write_text(yaml.safe_dump(plan.to_mapping(), sort_keys=False, width=140), encoding="utf-8")


def write_config(path: Path, name: str) -> None:
    """Write a shipped configuration beside the models that are there, with those networks of its methods that are there."""
    text = shipped(name).read_text(encoding="utf-8").replace(f" {_TRAINED}/", " ")
    text = re.sub(r"  network:\n    file: .*\n    sha256: .*\n", "", text)
    ending = ".fused.onnx" if "  method: fused" in text else ".onnx"

    def with_hash(network: re.Match[str]) -> str:
        return network[1] + hashlib.sha256((path.parent / network[2]).read_bytes()).hexdigest()

    if all((path.parent / f"joint{number}.onnx").exists() for number in (1, 2)):
        text = re.sub(r"(      file: (joint\d\.onnx)\n      sha256: )\w+", with_hash, text)
    else:
        text = re.sub(r"  shadow_networks:\n(    .*\n)+", "", text).replace(
            "efficiency, network]", "efficiency]"
        )

    def with_network(joint: re.Match[str]) -> str:
        file = path.parent / f"{joint[1]}{ending}"
        if not file.exists():
            return joint[0]
        digest = hashlib.sha256(file.read_bytes()).hexdigest()
        return f"{joint[0]}  network:\n    file: {file.name}\n    sha256: {digest}\n"

    path.write_text(re.sub(r"  file: (joint\d)\.yaml\n", with_network, text), encoding="utf-8")
