"""Trials on the project's generator: hides effects, has them diagnosed, prints the table of figures.

    python -m validation trials --trials 25 --seed 1
    python -m validation trials --trials 100 --kinds nothing,one --json figures.json
    python -m validation trials --trials 25 --seed 1 --recorder seven_digits
    python -m validation trials --trials 0 --cost               what ten runs of 60 s cost

One trial is one bench of two joints, diagnosed with nothing hidden, one effect at three times and at one time its minimum
detectable size, two effects, and something that no library has. The diagnosis gets the run tables and the nominal joint
files; sizes come from the minimum detectable sizes that it reports for the same motions with nothing hidden.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from jtqd.estimator.command_line import count, natural
from jtqd.estimator.effects import EFFECTS
from jtqd.estimator.joint import Joint
from jtqd.estimator.run import COLUMN_NAMES, JointColumns, RunTable
from jtqd.sysid.diagnosis.diagnose import diagnose
from jtqd.sysid.diagnosis.entries import set_state
from jtqd.sysid.diagnosis.findings import CandidateEvidence, Findings, Present
from jtqd.sysid.diagnosis.regressors import all_in_bin, bin_samples, binned, contribution
from jtqd.sysid.diagnosis.signals import BaseLoss, joint_signals
from jtqd.sysid.planner.plan import Plan, check_plan
from validation.diagnosis.entries import ENTRIES, SENSOR, Array, Columns, Hidden, base_value, scaled
from validation.diagnosis.recorder import PRESETS, Recorder
from validation.diagnosis.scores import (
    Outcome,
    coverage_by_parameter,
    failures,
    generator_shares,
    judged,
    score,
)
from validation.generator.draw import UNKNOWN, Case, Order, draw_many, follow_up
from validation.generator.plant import Reference
from validation.study import ROOT, Report, Table, UsageError, in_processes, share_table

KINDS: Final = ("nothing", "one", "least", "two", "unknown")
FACTOR: Final = 3.0
UNLIKE: Final = tuple(name for name, entry in UNKNOWN.items() if not entry.resembling)


def trial(
    number: int, seed: int, kinds: Sequence[str] = KINDS, recorder: Recorder | None = None
) -> list[Outcome]:
    """Return the outcomes of trial `number` of a campaign; every effect and every unknown thing has its turn by number.

    recorder: what is diagnosed are the files that it writes; the sizes are those for the runs as they are.
    """
    own = int(np.random.SeedSequence([seed, number]).generate_state(1)[0])
    rng = np.random.default_rng([own, 77])
    plain = draw_many([Order(own)])[0]
    findings = diagnose(tables(plain.runs), joint_files(plain))
    seen = findings if recorder is None else judged(plain.runs, plain.joints, recorder, own)
    allowed = recorder.explains if recorder is not None else ()
    out = [score("nothing", own, plain.truth, seen, not_wrong=allowed)]
    orders = orders_of(number, own, rng, plain, findings, kinds, out)
    cases = draw_many([order for _, order in orders]) if orders else []
    for (kind, order), case in zip(orders, cases, strict=True):
        if recorder is not None:
            recorded = judged(case.runs, case.joints, recorder, own)
            detail = [_short(t) for t in case.truth]
            out.append(score(kind, own, case.truth, recorded, not_wrong=allowed, detail=detail))
            continue
        found = diagnose(tables(case.runs), joint_files(case))
        more: dict[str, Any] = {"detail": [_short(t) for t in case.truth]}
        if kind in ("one", "two"):
            more["gain"] = gains(case, found)
        if kind == "one" and found.verdict == "ambiguous" and found.next_experiment is not None:
            more["settled"] = settled(order, case, found)
        out.append(score(kind, own, case.truth, found, **more))
    return out


def _short(truth: Mapping[str, Any]) -> str:
    """Return what was hidden as text, with the first of its right places."""
    values = " ".join(f"{k}={x:.3g}" for k, x in truth["parameters"].items())
    right = [
        " ".join(str(round(x, 3) if isinstance(x, float) else x) for x in p.values())
        for p in truth.get("places", ())
    ]
    text = f"{truth['name']} of {truth['joint']} size {truth['size']:.3g} ({values})"
    return text + (f"; right: {'; '.join(right[:4])}" if right else "")


def orders_of(  # noqa: PLR0917
    number: int,
    own: int,
    rng: np.random.Generator,
    plain: Case,
    findings: Findings,
    kinds: Sequence[str],
    out: list[Outcome],
) -> list[tuple[str, Order]]:
    """Return (kind, what to draw) for one trial; effects that these motions cannot show are noted as invisible in `out`."""
    names = list(ENTRIES)
    orders: list[tuple[str, Order]] = []
    name = names[number % len(names)]
    here = [k for k in ("one", "least") if k in kinds]
    if here:
        chosen = _pick(name, rng, plain, findings)
        for kind in here:
            if chosen is None:
                out.append(Outcome(kind, own, ((name, None),), "invisible"))
            else:
                orders.append(
                    (kind, Order(own, [_sized(*chosen, FACTOR if kind == "one" else 1.0, rng, plain)]))
                )
    if "two" in kinds:
        pair: list[Hidden] = []
        for other in rng.permutation(names):
            found = _pick(str(other), rng, plain, findings)
            if found is not None:
                pair.append(_sized(*found, FACTOR, rng, plain))
            if len(pair) == 2:
                break
        orders.append(("two", Order(own, pair)))
    if "unknown" in kinds:
        strange = UNLIKE[number % len(UNLIKE)]
        orders.append(("unknown", Order(own, [Hidden(strange, int(rng.integers(1, 3)))])))
    return orders


def _pick(
    name: str, rng: np.random.Generator, plain: Case, findings: Findings
) -> tuple[CandidateEvidence, Mapping[str, float]] | None:
    """Return an evidence of this effect and its parameters at the minimum, one of the visible ones at random."""
    options = [
        (row, values) for row in findings.candidates if row.name == name for values in minima(row, plain)
    ]
    return options[int(rng.integers(len(options)))] if options else None


def minima(row: CandidateEvidence, plain: Case) -> list[Mapping[str, float]]:
    """Return the parameters at the minimum detectable size, one entry per way of looking, absolute as in a joint file."""
    nominal = plain.joints[row.joint if isinstance(row.joint, int) else 1]
    entry = ENTRIES[row.name]
    out: list[Mapping[str, float]] = []
    for parameter, value in row.minimum.items():
        if parameter in (entry.parameter, entry.second) and 0.0 < value.value < np.inf:
            values = {parameter: base_value(row.name, nominal, parameter) + value.value}
            if row.name == "channel_delay":
                values["channel"] = 0.0 if row.joint == SENSOR else 1.0
            out.append(values)
    return out


def _sized(
    row: CandidateEvidence, minimum: Mapping[str, float], factor: float, rng: np.random.Generator, plain: Case
) -> Hidden:
    nominal = plain.joints[row.joint if isinstance(row.joint, int) else 1]
    joint = row.joint if isinstance(row.joint, int) else SENSOR
    return Hidden(row.name, joint, scaled(row.name, nominal, minimum, factor, rng))


def tables(runs: Sequence[Columns], first: int = 1) -> list[tuple[str, RunTable]]:
    """Return the columns as (name, RunTable), named run<first>, ..."""
    return [(f"run{k}", run_table(c, (1, 2))) for k, c in enumerate(runs, first)]


def run_table(run: Columns, numbers: Iterable[int]) -> RunTable:
    """Return the columns of a run as a run table of these joints."""
    joints = {n: JointColumns(**{x: run.get(f"j{n}.{x}") for x in COLUMN_NAMES}) for n in numbers}
    return RunTable(run["time_s"], joints)


def joint_files(case: Case, hidden: bool = False) -> dict[int, Joint]:
    """Return the nominal joints; hidden: with the effects that are there as effects of the file."""
    out = {}
    for n, mapping in case.joints.items():
        full: dict[str, Any] = dict(mapping)
        if hidden:
            full["effects"] = [
                {"name": t["name"], "parameters": t["parameters"]}
                for t in case.truth
                if t["joint"] in (n, SENSOR)
            ]
        out[n] = Joint.from_mapping(full, f"joint{n}")
    return out


def gains(case: Case, findings: Findings) -> tuple[float, float, float] | None:
    """Return rms before, after, and after with the true model, in the balance that the findings' gain is measured in."""
    gain = findings.gain
    if gain is None or gain.joint is None or gain.balance is None:
        return None
    return gain.rmse_before_nm, gain.rmse_after_nm, _true_rms(case, gain.balance, gain.joint)


def _true_rms(case: Case, balance: str, number: int) -> float:
    """Return the rms that the true model leaves: the run's own zero and friction of the day stay in, as in the gain."""
    joint = joint_files(case, hidden=True)[number]
    parts = [unexplained(joint, number, name, table, balance) for name, table in tables(case.runs)]
    return rms([part for part in parts if part is not None])


def unexplained(
    joint: Joint, number: int, run: str, table: RunTable, balance: str, *, visible: bool = False
) -> Array | None:
    """Return what a joint file with its effects leaves of a balance of a run, in means over bins, the torsion's less their
    mean; None where the run has not that balance. visible: only where the recording shows it. Current and torsion are those
    of a simulation with these effects, so that what remains is an error of the current, as torque, and of the twist.
    """
    s = joint_signals(run, table, number, joint, BaseLoss(joint))
    residual = s.motor_nm if balance == "motor" else s.torsion_nm
    if residual is None:
        return None
    set_state(s, [Present(e.name, number, e.parameters) for e in joint.effects])
    for effect in joint.effects:
        there = contribution(EFFECTS[effect.name], effect.parameters, s)
        residual = residual - there.get(balance, 0.0)
    samples = bin_samples([s])
    left = binned(s.visible(residual) if visible else residual, samples)
    return left[all_in_bin(s.moving, samples)] if balance == "motor" else left - left.mean()


def rms(parts: Sequence[Array]) -> float:
    square = sum(float(part @ part) for part in parts)
    return float(np.sqrt(square / max(sum(map(len, parts)), 1)))


def settled(order: Order, case: Case, findings: Findings) -> bool:
    """Return whether the plan of the findings, run on the same bench, makes the hidden effect the only name."""
    assert findings.next_experiment is not None
    plan = Plan.from_mapping(findings.next_experiment["plan"], "next_experiment")
    references = [
        Reference(s.velocity_joint - 1, s.velocity_rad_s, s.current_a, s.off)
        for s in check_plan(plan).values()
    ]
    runs = [*case.runs, *follow_up(order, references)]
    later = diagnose(tables(runs), joint_files(case))
    return all(score("", 0, case.truth, later).named)


LONGEST_S: Final = 60.0
LARGEST_GB: Final = 2.0
STEEPEST: Final = 2.6
"""Of the time of twice the samples; 2 is linear."""
_DRAW: Final = """
import pickle, sys
from validation.generator.draw import Order, draw_many
hidden = [("torque_ripple", 1, 0.5), ("torque_constant", 2, 0.002)]
case = draw_many([Order(5, hidden, runs=10, duration_s=float(sys.argv[2]))])[0]
pickle.dump(case, open(sys.argv[1], "wb"))
"""
_DIAGNOSE: Final = """
import json, pickle, resource, sys, time
from jtqd.sysid.diagnosis.diagnose import diagnose
from validation.diagnosis.trials import joint_files, tables
case = pickle.load(open(sys.argv[1], "rb"))
runs, joints = tables(case.runs), joint_files(case)
wall, cpu = time.monotonic(), time.process_time()
diagnose(runs, joints)
used = time.monotonic() - wall, time.process_time() - cpu
print(json.dumps([*used, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6]))
"""


def cost() -> tuple[Table, bool]:
    """Return what a diagnosis of ten runs of 60 s costs, and twice the samples, and whether that is little enough.

    In processes of its own. Raises RuntimeError with the last line of a process that fails.
    """
    wall, cpu, memory = _measured(60.0)
    _, half, _ = _measured(30.0)
    found = (
        ("ten runs of 60 s", f"{wall:.0f} s", f"at most {LONGEST_S:.0f} s", wall <= LONGEST_S),
        ("the same: memory", f"{memory:.2f} GB", f"at most {LARGEST_GB:.0f} GB", memory <= LARGEST_GB),
        ("twice the samples: time", f"x {cpu / half:.1f}", f"at most x {STEEPEST}", cpu <= STEEPEST * half),
    )
    rows = [(*texts, "yes" if reached else "NO") for *texts, reached in found]
    return Table(("cost", "found", "target", "reached"), rows), all(row[-1] for row in found)


def _measured(seconds: float) -> tuple[float, float, float]:
    """Return (wall time [s], processor time [s], largest memory of the process [GB]) of ten runs of this length."""
    with tempfile.TemporaryDirectory() as folder:
        file = str(Path(folder) / "case.pickle")
        _python(_DRAW, file, str(seconds))
        wall, cpu, memory = json.loads(_python(_DIAGNOSE, file))
    return wall, cpu, memory


def _python(code: str, *arguments: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments], cwd=ROOT, check=False, capture_output=True, text=True
    )
    if done.returncode:
        raise RuntimeError(done.stderr.strip().rsplit("\n", 1)[-1])
    return done.stdout


class Task(NamedTuple):
    """One trial of a campaign."""

    number: int
    seed: int
    kinds: tuple[str, ...]
    recorder: Recorder | None


def campaign(
    trials: int,
    seed: int,
    kinds: Sequence[str] = KINDS,
    *,
    processes: int = 2,
    first: int = 0,
    recorder: str | None = None,
) -> list[Outcome]:
    """Return the outcomes of trials first .. first + trials - 1, in order; recorder: a name of `PRESETS`."""
    preset = None if recorder is None else PRESETS[recorder]
    work = [Task(number, seed, tuple(kinds), preset) for number in range(first, first + trials)]
    return [o for outcomes in in_processes(_run, work, processes, "trials") for o in outcomes]


def _run(task: Task) -> list[Outcome]:
    return trial(*task)


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--trials", type=natural, default=25, help="benches, each with all kinds (default 25)"
    )
    parser.add_argument("--seed", type=int, help="drawn and printed when not given")
    parser.add_argument("--first", type=natural, default=0, help="number of the first trial, to repeat one")
    parser.add_argument("--kinds", default=",".join(KINDS), help=f"some of {','.join(KINDS)}")
    parser.add_argument("--processes", type=count, default=2)
    parser.add_argument("--recorder", choices=sorted(PRESETS), help="judge what it writes of the runs")
    parser.add_argument("--cost", action="store_true", help="measure ten runs of 60 s as well")


def run(options: argparse.Namespace) -> Report:
    """Run the campaign; see the module."""
    kinds = tuple(options.kinds.split(","))
    if wrong := [k for k in kinds if k not in KINDS]:
        raise UsageError(f"found --kinds {wrong[0]!r}, expected some of {', '.join(KINDS)}")
    seed = int(np.random.default_rng().integers(10**6)) if options.seed is None else options.seed
    print(f"seed {seed}", file=sys.stderr)
    outcomes = campaign(
        options.trials,
        seed,
        kinds,
        processes=options.processes,
        first=options.first,
        recorder=options.recorder,
    )
    rows = generator_shares(outcomes)
    reached = not any(row.reached is False for row in rows)
    tables = [share_table(rows, f"{options.trials} trials")]
    if options.cost:
        costs, cheap = cost()
        tables.append(costs)
        reached = reached and cheap
    notes = [*failures(outcomes), *coverage_by_parameter(outcomes)]
    return Report(tables, {"seed": seed}, notes, {"figures": rows, "outcomes": outcomes}, reached)
