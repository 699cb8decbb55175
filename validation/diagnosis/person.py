"""How well `jtq diagnose` does on data as a person has them: several values of the joint file wrong at once, few digits.

    python -m validation person --bench ours,mujoco,belt --sets 40 --seed 1 --out results.jsonl --processes 2
    python -m validation person --bench practice --practice DIR --sets 10 --seed 1 --out results.jsonl
    python -m validation person --score results.jsonl
    python -m validation person --more-data --bench ours --sets 5 --seed 1

A set is drawn from (seed, bench, index): joints, encoders, reference torque, 3 to 8 runs of 10 to 60 s, 100 to 1000 Hz, 5 to
7 digits (12 at times), and
- 3 to 6 values of the joint file that are wrong by what data sheets are off (`SHEETS`), runs being made with the true ones;
- 0 to 2 structural effects of the library, as large as `entries` has them;
- a rest in no library, up to 30 % of the gap: friction that is smooth over speed, load and angle, or a foreign kind.
In `--none-share` of the sets the file is true and nothing is hidden. Two more runs per set are held out: the tool never sees
them; they are written with 12 digits, so that rounding does not hide what files miss. `Can` states what a generator draws.

The tool runs as a user calls it, in a process of its own; its answer is findings.json and the extended joint files, no more.
An entry of the findings is certain (`grade`; where there is none: its class has its name alone), else "one_of". Beside it:
- the oracle (`balance.fit`): all wrong values and all structural effects that are there, fitted to the same runs;
- the ladder (`balance.ladder`): ordinary least squares.
A value is beyond 3 oracle sigma if both the truth and the oracle's value are that far from the file's: a rest can hide it.
Such an entry is settled by the oracle alone if no single other effect, all other true entries being refitted, comes within 6
in 2 log-likelihood (`balance.settled`, linearised). All files are judged
by `balance.errors`. A cause is there if it is a wrong value or an effect of that joint, or has the same law as one
(`ALIASES`, of the same order).

--more-data: in sets with something hidden and six held-out runs, the tool gets 3, 4, ... all runs; counted are the steps
that raise the held-out error beyond the 95 % bootstrap interval, over held-out runs, of the difference of squares.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import json
import math
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import yaml

from jtqd.estimator.command_line import count, natural
from jtqd.estimator.effects import EFFECTS
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.joint import Joint
from jtqd.sysid.runs.files import read_runs
from validation.diagnosis import balance
from validation.diagnosis.entries import SENSOR, Columns, at_sensor
from validation.diagnosis.person_sets import (
    BENCHES,
    HELD,
    SHEETS,
    TORSION_ONLY,
    Drawn,
    Key,
    Plan,
    made,
    plan,
    value_of,
    wrong_files,
)
from validation.diagnosis.recorder import Recorder, csv_text, record
from validation.study import ROOT, Z95, Report, Share, Table, UsageError, in_processes, share, share_table

SCHEMA: Final = "jtq.person/1"
RELEVANT: Final = 0.005
"""Of rated torque: the default of `--relevance`, from which on a foreign rest must be refused."""
HELD_MORE: Final = 6
AS_ORACLE: Final = 1.02
"""Times the oracle's held-out error: as good as who knows the truth. The ladder is better at times, by chance or because it
takes a part of the rest; how often stands in the note.
"""
_TIMEOUT_S: Final = 1200.0
ALIASES: Final = (frozenset({"torque_ripple", "cogging"}),)
"""Effects with one law."""

# The tool, and what it answers.

_CALL: Final = """
import json, re, resource, sys
from pathlib import Path
from jtqd.sysid.diagnosis.command import main
status = main(sys.argv[2:])
used = resource.getrusage(resource.RUSAGE_SELF)
peak = re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())
Path(sys.argv[1]).write_text(json.dumps([status, used.ru_utime + used.ru_stime, int(peak[1]) / 1e3]))
"""


@dataclass
class Answer:
    """What the tool wrote: exit status or a reason, findings, extended files (the given ones where it wrote none), cost."""

    status: str
    findings: dict[str, Any]
    files: dict[int, Joint]
    cpu_s: float = math.nan
    memory_mb: float = math.nan


def ask(folder: Path, runs: Sequence[Path], joints: Mapping[int, Path], columns: Path | None) -> Answer:
    """Call `jtq diagnose` on these files in a process of its own, measured by itself."""
    out, cost = folder / "diagnosis", folder / "cost.json"
    words = [str(cost), *map(str, runs), "--out", str(out), "--force", "--json"]
    for number, path in joints.items():
        words += ["--joint", f"{number}={path}"]
    if columns is not None:
        words += ["--columns", str(columns)]
    given = {n: Joint.from_mapping(_yaml(path), path.name) for n, path in joints.items()}
    try:
        done = subprocess.run(
            [sys.executable, "-c", _CALL, *words],
            cwd=ROOT,
            check=False,
            capture_output=True,
            text=True,
            timeout=_TIMEOUT_S,
        )
    except subprocess.TimeoutExpired:
        return Answer(f"no answer within {_TIMEOUT_S:.0f} s", {}, given)
    if not cost.exists() or not (out / "findings.json").exists():
        return Answer((done.stderr.strip() or "no output").rsplit("\n", 1)[-1], {}, given)
    status, cpu_s, memory_mb = json.loads(cost.read_text())
    files = dict(given)
    for number in joints:
        own = out / f"extended.joint{number}.yaml"
        path = own if own.exists() else out / "extended.joint.yaml"
        if path.exists() and (len(joints) == 1 or path == own):
            try:
                files[number] = Joint.from_mapping(_yaml(path), path.name)
            except (ConfigError, yaml.YAMLError) as error:  # a file that nobody can use is no answer
                return Answer(f"{path.name}: {error}", {}, given)
    findings = json.loads((out / "findings.json").read_text())
    return Answer(str(status), findings, files, cpu_s, memory_mb)


def _yaml(path: Path) -> Any:
    return yaml.safe_load(path.read_text(encoding="utf-8"))


def reported(findings: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the entries of the findings: name, joint, grade, rivals as [name, joint], share, parameters [value, ci95]."""
    out = []
    for cause in findings.get("causes", ()):
        name, joint = cause["name"], SENSOR if at_sensor(cause["name"]) else cause["joint"]
        names = {_rival(rival, joint) for rival in (*cause.get("class", ()), *(cause.get("rivals") or ()))}
        rivals = sorted(map(list, names - {(name, joint)}), key=str)
        alone = not rivals and findings.get("verdict") != "no_gap"
        out.append(
            {
                "name": name,
                "joint": joint,
                "grade": cause.get("grade") or ("certain" if alone else "one_of"),
                "rivals": rivals,
                "share": cause.get("share"),
                "parameters": {
                    key: [p["value"], *(p.get("ci95") or (None, None))]
                    for key, p in cause["parameters"].items()
                },
            }
        )
    return out


def _rival(rival: Any, joint: int | str) -> Key:
    """Return name and joint of a rival: "NAME" (same joint), "NAME of joint 2", "NAME of the sensor", or a mapping."""
    if isinstance(rival, Mapping):
        name, where = str(rival["name"]), rival.get("joint", joint)
    else:
        name, _, place = str(rival).partition(" of ")
        where = int(place[-1]) if place[-1:].isdigit() else SENSOR if place else joint
    return name, SENSOR if at_sensor(name) else where


def is_there(cause: Mapping[str, Any], entries: Sequence[Mapping[str, Any]]) -> bool:
    """Return whether a reported cause is a wrong value or an effect of that joint, or has the law of one."""
    for entry in entries:
        if entry["joint"] == cause["joint"]:
            if entry["name"] == cause["name"]:
                return True
            if any({entry["name"], cause["name"]} <= alias for alias in ALIASES):
                orders = [entry["parameters"].get(_ORDER), (cause["parameters"].get(_ORDER) or [None])[0]]
                if None not in orders and abs(orders[0] - orders[1]) < 0.01 * abs(orders[0]):
                    return True
    return False


_ORDER: Final = "order_per_motor_rev"


# A set from its plan to its line.


@dataclass(frozen=True)
class Task:
    """One set of a campaign."""

    bench: str
    seed: int
    index: int
    none_share: float
    practice: Path | None = None
    keep: Path | None = None
    more_data: bool = False


def drawn_set(task: Task) -> tuple[Plan, Drawn]:
    bench = made(task.bench)
    none, held = (0.0, HELD_MORE) if task.more_data else (task.none_share, HELD)
    p = plan(bench.can, task.bench, task.seed, task.index, none, held)
    return p, bench.draw(p, task.practice) if task.bench == "practice" else bench.draw(p)


def write(folder: Path, p: Plan, drawn: Drawn) -> dict[str, Any]:
    """Write all files of a set and return their paths: runs, held, without, joints, columns. runs/ and the joint files are
    what the tool sees; `person` keeps truth and the rest beside.
    """
    seed = p.seed
    out: dict[str, Any] = {"columns": None}
    sharp = Recorder(digits=12, rate_hz=p.rate_hz)
    coarse = replace(sharp, digits=p.digits)
    for name, tables, recorder in (
        ("runs", drawn.runs[: p.runs], coarse),
        ("held", drawn.runs[p.runs :], sharp),
        ("exact", drawn.runs[: p.runs] if drawn.without else [], sharp),
        ("without", drawn.without, sharp),
    ):
        paths = []
        (folder / name).mkdir(parents=True, exist_ok=True)
        for k, table in enumerate(record(tables, recorder, seed), 1):
            paths.append(folder / name / f"run{k}.csv")
            paths[-1].write_text(csv_text(table, recorder), encoding="utf-8")
        out[name] = paths
    out["joints"] = {}
    for number, joint in wrong_files(p, drawn.true).items():
        out["joints"][number] = folder / f"joint{number}.yaml"
        out["joints"][number].write_text(yaml.safe_dump(joint, sort_keys=False), encoding="utf-8")
    if drawn.columns is not None:
        out["columns"] = folder / "columns.yaml"
        out["columns"].write_text(yaml.safe_dump(drawn.columns, sort_keys=False), encoding="utf-8")
    truth = {"plan": vars(p), "entries": [vars(e) for e in drawn.entries]}
    text = json.dumps({**truth, "true_files": drawn.true}, indent=1, default=_plain)
    (folder / "truth.json").write_text(text, encoding="utf-8")
    return out


def _plain(x: Any) -> Any:
    return x.tolist() if isinstance(x, np.ndarray | np.generic) else str(x)


def views_of(
    paths: Sequence[Path], columns: Path | None, nominal: Mapping[int, Joint], encoders: int, cutoff: float
) -> list[balance.View]:
    """Return the views of run files of all joints, as the reader of the tool gives them."""
    read = read_runs(paths, columns, segments=True)
    return [
        balance.view(run.table, k, n, joint, encoders == 2, cutoff)
        for k, run in enumerate(read)
        for n, joint in nominal.items()
    ]


def cutoff_hz(runs: Sequence[Columns], digits: int, rate_hz: float, nominal: Mapping[int, Joint]) -> float:
    """Return the cutoff of the oracle's and the ladder's fits: the largest of 25, 12, 6, 3 Hz at which rounding of the
    motor's position is worth at most 0.2 % of rated torque as acceleration.
    """
    for cutoff in (balance.CUTOFF_HZ, 12.0, 6.0, 3.0):
        worst = 0.0
        for n, joint in nominal.items():
            reach = max(float(np.abs(run[f"j{n}.motor_position_rad"]).max()) for run in runs)
            step = 10.0 ** (math.floor(math.log10(max(reach, 1e-3))) + 1 - digits)
            noise = step / math.sqrt(12.0) * (2 * math.pi) ** 2 * math.sqrt(2.0 * cutoff**5 / (5.0 * rate_hz))
            inertia = joint.gear_ratio * joint.rotor_inertia_kgm2
            worst = max(worst, inertia * noise / joint.rated_torque_nm)
        if worst <= 0.002:
            return cutoff
    return 3.0


def truth_of(
    p: Plan, drawn: Drawn, nominal: Mapping[int, Joint]
) -> tuple[balance.Truth, list[balance.Parameter]]:
    """Return the true set with what is free in it."""
    joints = {n: Joint.from_mapping(joint, f"true{n}") for n, joint in drawn.true.items()}
    effects: dict[int, list[Any]] = {n: [] for n in joints}
    free: list[balance.Parameter] = []
    for k, entry in enumerate(drawn.entries):
        sheet = SHEETS.get(entry.name)
        place = entry.joint if isinstance(entry.joint, int) else min(joints)
        if entry.wrong_value and sheet is not None and sheet.key:
            value = value_of(drawn.true[place], sheet.key)
            file = next(iter(entry.base.values()))
            free.append(balance.Parameter(k, place, sheet.key, value, file, sheet.sigma * value))
            continue
        own = EFFECTS[entry.name]
        values = {
            q.name: q.default for q in own.parameters if q.default is not None and not math.isnan(q.default)
        }
        values |= entry.parameters
        for n in joints if entry.joint == SENSOR else (place,):
            effects[n].append((own, values))
        for q in own.parameters:
            if q.name not in values or q.fixed or q.name == "reference_c":
                continue
            value = float(values[q.name])
            if value == q.neutral and q.name not in entry.base:
                continue  # idle: another parameter carries the effect
            neutral = value if q.neutral is None else q.neutral
            scale = 0.3 if q.name == "phase_rad" else 0.3 * abs(value - neutral) or 0.3 * abs(value)
            at = (entry.base.get(q.name, value), max(scale, 1e-9), entry.name, entry.joint == SENSOR)
            free.append(balance.Parameter(k, place, q.name, value, *at))
    return balance.Truth(joints, effects, free), free


def judge(p: Plan, drawn: Drawn, paths: Mapping[str, Any], answer: Answer | None) -> dict[str, Any]:
    """Return what oracle, ladder and evaluator find: of the tool's answer where there is one."""
    nominal = {n: Joint.from_mapping(_yaml(path), path.name) for n, path in paths["joints"].items()}
    cutoff = cutoff_hz(drawn.runs[: p.runs], p.digits, p.rate_hz, nominal)
    seen = views_of(paths["runs"], paths["columns"], nominal, p.encoders, cutoff)
    held = views_of(paths["held"], paths["columns"], nominal, p.encoders, balance.CUTOFF_HZ)
    truth, free = truth_of(p, drawn, nominal)
    out: dict[str, Any] = {"cutoff_hz": cutoff}
    given = {n: balance.File.of(joint) for n, joint in nominal.items()}
    exact = truth.files(np.array([q.true for q in free]))
    if free:
        found = balance.fit(seen, truth, nominal)
        moved = [(v - q.file) / q.scale for v, q in zip(found.values, free, strict=True)]
        skip = [*(TORSION_ONLY if p.encoders == 1 else ())]
        if p.known_load:
            skip += [name for name in EFFECTS if at_sensor(name)]
        alone = balance.settled(seen, found, truth, nominal, moved, skip)
        files = found.files
        out["oracle"] = [
            {
                "name": entry.name,
                "joint": entry.joint,
                "wrong_value": entry.wrong_value,
                "parameter": q.key.rpartition(".")[2],
                "true": q.true,
                "file": q.file,
                "value": float(value),
                "sigma": float(sigma),
                "beyond": (beyond := bool(min(abs(q.true - q.file), abs(value - q.file)) > 3.0 * sigma)),
                "alone": beyond and alone[q.entry],
            }
            for q, value, sigma in zip(free, found.values, found.sigma, strict=True)
            for entry in [drawn.entries[q.entry]]
            if q.key.rpartition(".")[2] in entry.base
        ]
    else:
        files, out["oracle"] = exact, []
    errors = {"file": given, "true": exact, "oracle": files}
    if answer is not None:
        errors["tool"] = {n: balance.File.of(joint) for n, joint in answer.files.items()}
    both = {name: balance.combined_nm(held, each, nominal) for name, each in errors.items()}
    out["error_nm"] = {name: total for name, (total, _) in both.items()}
    out["error_nm"]["ladder"] = balance.ladder(seen, held, nominal)
    out["per_run_nm"] = {name: runs for name, (_, runs) in both.items()}
    out["relevance"] = relevance(paths, nominal, exact, p.encoders) if paths["without"] else 0.0
    return out


_WIDE_HZ: Final = 60.0
"""Cutoff of a rest's relevance: some foreign kinds are lines above 25 Hz."""


def relevance(
    paths: Mapping[str, Any], nominal: Mapping[int, Joint], exact: Mapping[int, balance.File], encoders: int
) -> float:
    """Return what the rest is worth, of rated torque: rms over the worst run of what the true file misses with it less what
    it misses without it (the same noise).
    """
    worst = 0.0
    both = [views_of(paths[k], paths["columns"], nominal, encoders, _WIDE_HZ) for k in ("exact", "without")]
    for one, two in zip(*both, strict=False):
        e1, e2 = (balance.errors(v, exact[v.number], nominal[v.number]) for v in (one, two))
        for kind in e1:
            a, b = np.full((2, len(one.motor_rad)), np.nan), np.full((2, len(two.motor_rad)), np.nan)
            a[0, one.keep if kind == balance.MOTOR else one.keep_torsion] = e1[kind]
            b[0, two.keep if kind == balance.MOTOR else two.keep_torsion] = e2[kind]
            n = min(a.shape[1], b.shape[1])
            apart = a[0, :n] - b[0, :n]
            apart = apart[np.isfinite(apart)]
            if len(apart):
                rated = nominal[one.number].rated_torque_nm
                worst = max(worst, float(np.sqrt(np.mean(apart**2))) / rated)
    return worst


def run_task(task: Task) -> dict[str, Any]:
    """Draw, ask, judge; return the line of a set. What fails in the study itself is in `failed`."""
    line: dict[str, Any] = {"key": f"{task.bench}.{task.index}", "bench": task.bench}
    try:
        with tempfile.TemporaryDirectory() as scratch:
            folder = Path(scratch) if task.keep is None else task.keep / line["key"]
            folder.mkdir(parents=True, exist_ok=True)
            p, drawn = drawn_set(task)
            paths = write(folder, p, drawn)
            line |= {"plan": json.loads(json.dumps(vars(p), default=_plain)), "nothing": p.nothing}
            if task.more_data:
                return line | {"steps": _steps(folder, p, drawn, paths)}
            answer = ask(folder, paths["runs"], paths["joints"], paths["columns"])
            entries = [
                {"name": e.name, "joint": e.joint, "parameters": e.parameters, "wrong_value": e.wrong_value}
                for e in drawn.entries
            ]
            unexplained = answer.findings.get("unexplained") or {}
            line |= {
                "entries": entries,
                "status": answer.status,
                "verdict": answer.findings.get("verdict", "failed"),
                "reported": reported(answer.findings),
                "placed": bool(unexplained.get("relevant")),
                "cannot_be_told": answer.findings.get("cannot_be_told"),
                "cpu_s": answer.cpu_s,
                "memory_mb": answer.memory_mb,
                **judge(p, drawn, paths, answer),
            }
    except (
        ValueError,
        RuntimeError,
        OSError,
        ArithmeticError,
        KeyError,
        IndexError,
        np.linalg.LinAlgError,
    ) as error:
        line["failed"] = f"{type(error).__name__}: {error}"
    return json.loads(json.dumps(line, default=_plain))  # type: ignore[no-any-return]


def _steps(folder: Path, p: Plan, drawn: Drawn, paths: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return per number of runs the held-out error of the tool's files, in all and per held-out run."""
    nominal = {n: Joint.from_mapping(_yaml(path), path.name) for n, path in paths["joints"].items()}
    held = views_of(paths["held"], paths["columns"], nominal, p.encoders, balance.CUTOFF_HZ)
    out = []
    for k in range(3, p.runs + 1):
        answer = ask(folder, paths["runs"][:k], paths["joints"], paths["columns"])
        files = {n: balance.File.of(joint) for n, joint in answer.files.items()}
        total, runs = balance.combined_nm(held, files, nominal)
        out.append(
            {"runs": k, "error_nm": total, "per_run_nm": runs, "verdict": answer.findings.get("verdict")}
        )
    return out


def raised(fewer: Sequence[float], more: Sequence[float], seed: int = 0) -> bool:
    """Return whether the squared error rises beyond its 95 % bootstrap interval over runs."""
    d = np.square(more) - np.square(fewer)
    rng = np.random.default_rng(seed)
    means = d[rng.integers(len(d), size=(2000, len(d)))].mean(axis=1)
    return bool(np.quantile(means, 0.025) > 0.0)


# Tables.


def tables(lines: Sequence[Mapping[str, Any]]) -> tuple[list[Table], list[str], dict[str, Any], bool]:
    """Return tables overall and per generator, notes, values, and whether all targets are reached."""
    whole = [line for line in lines if "failed" not in line]
    out, values, reached = [], {}, True
    benches = list(dict.fromkeys(line["bench"] for line in whole))
    for name in (["overall"] if len(benches) != 1 else []) + benches:
        of = [line for line in whole if name in ("overall", line["bench"])]
        rows = [row for row in shares(of) if row is not None]
        ratios = figures(of)
        out += [
            share_table(rows, f"{name}: {len(of)} sets"),
            Table(("figure", "found", "target", "reached", "of"), [each.cells for each in ratios]),
        ]
        values[name] = {"shares": rows, "figures": ratios}
        reached = reached and False not in [*(row.reached for row in rows), *(row.reached for row in ratios)]
    notes = [f"{line['key']}: not scored: {line['failed']}" for line in lines if "failed" in line]
    for line in whole:
        if line["verdict"] == "failed":
            notes.append(f"{line['key']}: the tool gave no findings: {line['status']}")
        wrong = _wrong(line)
        if wrong:
            hidden = ", ".join(f"{e['name']} of {e['joint']}" for e in line["entries"]) or "nothing"
            notes.append(f"{line['key']}: wrong certain: {', '.join(wrong)}; hidden: {hidden}")
    return out, notes, values, reached


def _wrong(line: Mapping[str, Any]) -> list[str]:
    return [
        f"{c['name']} of {c['joint']}"
        for c in line["reported"]
        if c["grade"] == "certain" and not is_there(c, line["entries"])
    ]


def _found(line: Mapping[str, Any], row: Mapping[str, Any]) -> tuple[Mapping[str, Any] | None, bool]:
    """Return the entry of the findings with this name and joint, and whether it is reported at any grade."""
    named = next(
        (c for c in line["reported"] if (c["name"], c["joint"]) == (row["name"], row["joint"])), None
    )
    among = any([row["name"], row["joint"]] in c["rivals"] for c in line["reported"])
    return named, named is not None or among


def _at_most(line: Mapping[str, Any], one: str, other: str, factor: float = 1.0) -> bool:
    error = line["error_nm"]
    return bool(error[one] <= factor * error[other] * (1.0 + 1e-6))


def _interval(cause: Mapping[str, Any] | None, parameter: str) -> tuple[float, float] | None:
    value = cause["parameters"].get(parameter) if cause is not None else None
    return None if value is None or None in value[1:] else (value[1], value[2])


def shares(lines: Sequence[Mapping[str, Any]]) -> Iterator[Share | None]:
    """Yield the rows of shares, with targets."""
    hidden = [line for line in lines if not line["nothing"]]
    nothing = [line for line in lines if line["nothing"]]
    most = Counter(name.split(" ")[0] for line in hidden for name in _wrong(line)).most_common(4)
    listed = ", ".join(f"{n} {name}" for name, n in most)
    yield share(
        "1 wrong certain: sets with something hidden", [bool(_wrong(line)) for line in hidden], -0.02, listed
    )
    yield share("1 wrong certain: sets with nothing hidden", [bool(_wrong(line)) for line in nothing], -0.01)
    pairs = [(line, row) for line in hidden for row in line["oracle"]]
    values = [(line, row) for line, row in pairs if row["wrong_value"] and row["beyond"]]
    yield share(
        "2 wrong values beyond 3 oracle sigma: reported at any grade", [_found(*x)[1] for x in values], 0.95
    )
    inside, own = [], []
    for line, row in values:
        interval = _interval(_found(line, row)[0], row["parameter"])
        if interval is not None:
            inside.append(interval[0] <= row["true"] <= interval[1])
            own.append(abs(row["value"] - row["true"]) <= Z95 * row["sigma"])
    covered = share("2 of those with an interval: it holds the truth", inside, None)
    if covered is not None:
        note = f"the oracle's intervals: {100 * np.mean(own):.0f} %"
        covered = replace(covered, target="92 to 97 %", reached=0.92 <= covered.value <= 0.97, note=note)
    yield covered
    alone = [(line, row) for line, row in pairs if row["alone"]]
    certain = [(c := _found(*x)[0]) is not None and c["grade"] == "certain" for x in alone]
    yield share("3 settled by the oracle alone: graded certain", certain, 0.90)
    for of, what in ((hidden, "something"), (nothing, "nothing")):
        at_most = {who: [_at_most(line, who, "ladder") for line in of] for who in ("tool", "oracle")}
        note = f"the oracle's: {100 * np.mean(at_most['oracle']):.0f} %" if of else ""
        yield share(f"4 {what} hidden: held-out error at most the ladder's", at_most["tool"], None, note)
        either = [_at_most(x, "tool", "ladder") or _at_most(x, "tool", "oracle", AS_ORACLE) for x in of]
        yield share(f"4 {what} hidden: at most the ladder's, or as the oracle's", either, 0.98)
    yield share("5 nothing hidden: no_gap", [line["verdict"] == "no_gap" for line in nothing], None)
    foreign = [line for line in hidden if line["relevance"] > RELEVANT and line["plan"]["rest"]]
    foreign = [line for line in foreign if line["plan"]["rest"][0] != "smooth"]
    verdicts = ", ".join(f"{n} {v}" for v, n in Counter(line["verdict"] for line in foreign).most_common())
    refused = [line["verdict"] == "unexplained" or line["placed"] for line in foreign]
    yield share("5 foreign above relevance: refused or placed", refused, 0.90, verdicts)
    yield share("5 the same: called no_gap", [line["verdict"] == "no_gap" for line in foreign], None)


class Figure(NamedTuple):
    """What is no share: at most `target`, None: no target."""

    what: str
    value: float
    target: float | None
    of: int

    @property
    def reached(self) -> bool | None:
        return None if self.target is None else self.value <= self.target

    @property
    def cells(self) -> tuple[str, ...]:
        target = "" if self.target is None else f"at most {self.target:g}"
        return (
            self.what,
            f"{self.value:.4g}",
            target,
            {None: "", True: "yes", False: "NO"}[self.reached],
            str(self.of),
        )


def figures(lines: Sequence[Mapping[str, Any]]) -> list[Figure]:
    """Return ratios and cost."""
    widths = []
    for line in lines:
        for row in line["oracle"]:
            interval = _interval(_found(line, row)[0], row["parameter"]) if row["alone"] else None
            if interval is not None and row["sigma"] > 0.0:
                widths.append((interval[1] - interval[0]) / (2 * Z95 * row["sigma"]))
    ratio = [line["error_nm"]["tool"] / line["error_nm"]["oracle"] for line in lines if not line["nothing"]]
    plain = [line["error_nm"]["tool"] / line["error_nm"]["oracle"] for line in lines if line["nothing"]]
    cpu = [line["cpu_s"] for line in lines if line["cpu_s"] is not None and math.isfinite(line["cpu_s"])]
    memory = [
        line["memory_mb"]
        for line in lines
        if line["memory_mb"] is not None and math.isfinite(line["memory_mb"])
    ]
    wanted = [
        ("3 settled: width of the interval over the oracle's, median", widths, 0.5, 1.5),
        ("4 held-out error over the oracle's, median", ratio, 0.5, 1.02),
        ("4 held-out error over the oracle's, 95th percentile", ratio, 0.95, 1.10),
        ("4 nothing hidden: held-out error over the true file's, 95th percentile", plain, 0.95, None),
        ("6 processor time, median [s]", cpu, 0.5, None),
        ("6 processor time, largest [s]", cpu, 1.0, None),
        ("6 memory, largest [MB]", memory, 1.0, None),
    ]
    return [Figure(what, float(np.quantile(x, q)), target, len(x)) for what, x, q, target in wanted if x]


def more_data_table(lines: Sequence[Mapping[str, Any]]) -> tuple[list[Table], list[str]]:
    rows, notes, every = [], [], []
    for line in lines:
        for one, two in pairwise(line.get("steps", ())):
            worse = raised(one["per_run_nm"], two["per_run_nm"])
            every.append(worse)
            if worse:
                change = two["error_nm"] / one["error_nm"]
                notes.append(f"{line['key']}: from {one['runs']} to {two['runs']} runs: error x {change:.3f}")
    row = share("steps that raise the held-out error beyond its interval", every, -0.05)
    rows = [row] if row is not None else []
    notes += [f"{line['key']}: not scored: {line['failed']}" for line in lines if "failed" in line]
    return [share_table(rows, "one run more")], notes


# The study.


def read(path: Path) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """Return header and lines by key; a last line that was cut off is left out. ValueError for another file."""
    text = path.read_text(encoding="utf-8").splitlines()
    out = {}
    header: Any = None
    for number, row in enumerate(text, 1):
        try:
            values = json.loads(row)
        except ValueError:
            if number == len(text) > 1:
                break
            raise ValueError(f"{path}: line {number}: found no JSON, expected a set") from None
        if number == 1:
            header = values
        else:
            out[values["key"]] = values
    if not isinstance(header, dict) or header.get("schema") != SCHEMA:
        raise ValueError(f"{path}: line 1: found no header of this study, expected schema {SCHEMA!r}")
    return header, out


def campaign(
    path: Path | None, header: dict[str, Any], tasks: Sequence[Task], processes: int
) -> list[dict[str, Any]]:
    """Return the lines of all tasks; those in the file already are taken from it, the others go into it as they come."""
    done: dict[str, dict[str, Any]] = {}
    if path is not None and path.exists() and path.stat().st_size:
        there, done = read(path)
        if there != header:
            differs = next(k for k in header if there.get(k) != header[k])
            raise ValueError(
                f"{path}: found a campaign with {differs} {there.get(differs)!r}, expected {header[differs]!r}"
            )
        text = path.read_text(encoding="utf-8")
        path.write_text(text[: text.rfind("\n") + 1], encoding="utf-8")
    elif path is not None:
        path.write_text(json.dumps(header) + "\n", encoding="utf-8")
    missing = [task for task in tasks if f"{task.bench}.{task.index}" not in done]
    for line in in_processes(run_task, missing, processes, "sets"):
        done[line["key"]] = line
        if path is not None:
            with path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(line) + "\n")
    return [done[key] for task in tasks if (key := f"{task.bench}.{task.index}") in done]


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--bench", default=",".join(BENCHES), help=f"some of {','.join(BENCHES)}")
    parser.add_argument("--practice", type=Path, metavar="DIR", help="bench.py of another hand, not shipped")
    parser.add_argument("--sets", type=natural, default=20, help="per bench (default 20)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--none-share", type=float, default=0.2, help="sets with nothing hidden (default 0.2)"
    )
    parser.add_argument("--processes", type=count, default=1)
    parser.add_argument(
        "--out", type=Path, metavar="FILE.jsonl", help="one line per set; begun or gone on with"
    )
    parser.add_argument("--keep", type=Path, metavar="DIR", help="files of every set, to look at")
    parser.add_argument(
        "--score", type=Path, metavar="FILE.jsonl", help="print the tables of this file, run nothing"
    )
    parser.add_argument(
        "--more-data", action="store_true", help="what one more run changes in the held-out error"
    )


def run(options: argparse.Namespace) -> Report:
    """Run or score; see the module."""
    if options.score is not None:
        header, by_key = read(options.score)
        lines = list(by_key.values())
        there = {line["bench"] for line in lines}
        notes = [
            f"LEFT OUT: bench {name}: no set in {options.score}" for name in BENCHES if name not in there
        ]
    else:
        names, notes = _benches(options)
        header = {
            "schema": SCHEMA,
            "seed": options.seed,
            "none_share": options.none_share,
            "more_data": options.more_data,
        }
        tasks = [
            Task(name, options.seed, k, options.none_share, options.practice, options.keep, options.more_data)
            for k in range(options.sets)
            for name in names
        ]
        lines = campaign(options.out, header, tasks, options.processes)
    seeds = {"seed": header["seed"]}
    if header["more_data"]:
        found, more = more_data_table(lines)
        return Report(found, seeds, [*notes, *more], lines)
    found, more, values, reached = tables(lines)
    return Report(found, seeds, [*notes, *more], values, reached and not notes)


def _benches(options: argparse.Namespace) -> tuple[list[str], list[str]]:
    """Return the generators that can run, and a loud line for each that cannot."""
    names, notes = [], []
    for name in options.bench.split(","):
        if name not in BENCHES:
            raise UsageError(f"found --bench {name!r}, expected some of {', '.join(BENCHES)}")
        missing = ""
        if name == "practice" and options.practice is None:
            missing = "--practice DIR is not given"
        elif name == "mujoco" and importlib.util.find_spec("mujoco") is None:
            missing = "mujoco is not installed"
        elif name == "belt" and importlib.util.find_spec("validation.generator.belt") is None:
            missing = "validation/generator/belt.py is not there"
        if missing:
            notes.append(f"LEFT OUT: bench {name}: {missing}")
            print(f"person: {notes[-1]}", file=sys.stderr)
        else:
            names.append(name)
    return names, notes
