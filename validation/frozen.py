"""Compare the results of this tree, number by number, with the ones stored in frozen.txt.

    python -m validation frozen                   compare; exit status 3 where a line differs
    python -m validation frozen findings replay   some sections only
    python -m validation frozen --store           store the results of this tree as the reference
    python -m validation frozen --out DIR         also keep full dumps, for a diff between two trees

A restructuring must not change a result. Each section runs the product's commands on inputs drawn from fixed seeds and
prints one line per result: numbers with all their digits, or a SHA-256 over them. Sentences are left out; verdicts, names,
order and numbers stay in.
"""

from __future__ import annotations

import argparse
import difflib
import hashlib
import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np

from validation.study import Report, Table, UsageError

STORED: Final = Path(__file__).with_name("frozen.txt")
SEEDS: Final = (3301, 3302, 3303)
"""Of the trials on the generator with equations of its own."""
MUJOCO_SEED: Final = 3304
NAMES: Final = frozenset(
    {"schema", "verdict", "name", "joint", "axis", "unit", "class", "effect", "balance", "grade"}
)
"""Keys of findings.json whose texts are results; any other text is a sentence."""


def called(*arguments: str, allowed: tuple[int, ...] = (0, 3), cwd: Path | None = None) -> str:
    """Return what a Python module of this tree prints. Raises RuntimeError for another exit status."""
    done = subprocess.run(
        [sys.executable, "-m", *arguments], capture_output=True, text=True, check=False, cwd=cwd
    )
    if done.returncode not in allowed:
        raise RuntimeError(f"{' '.join(arguments)}: exit status {done.returncode}\n{done.stderr[-2000:]}")
    return done.stdout


def jtq(*arguments: str) -> str:
    return called("jtqd.daemon.jtq", *arguments)


def digest(text: str | bytes) -> str:
    """Return the first 16 digits of the SHA-256."""
    return hashlib.sha256(text.encode() if isinstance(text, str) else text).hexdigest()[:16]


def numbers(value: Any, path: str = "", key: str = "") -> Iterator[str]:
    """Yield `path value` of each number, truth value and name of a JSON document, in its order."""
    if isinstance(value, dict):
        for name, each in value.items():
            yield from numbers(each, f"{path}.{name}", name)
    elif isinstance(value, list):
        for index, each in enumerate(value):
            yield from numbers(each, f"{path}[{index}]", key)
    elif not isinstance(value, str) or key in NAMES:
        yield f"{path} {json.dumps(value)}"


def findings_lines(label: str, text: str, out: Path) -> Iterator[str]:
    """Yield verdict, causes with their parameters, and the digest of all numbers of one findings.json."""
    content = json.loads(text)
    full = "\n".join(numbers(content))
    (out / f"{label}.findings.txt").write_text(full + "\n", encoding="utf-8")
    yield f"{label}: {content['verdict']}, {len(full.splitlines())} numbers and names, {digest(full)}"
    for cause in content["causes"]:
        values = " ".join(f"{name}={value['value']!r}" for name, value in cause["parameters"].items())
        yield f"{label}:   {cause['name']} of {cause['joint']} {values}"


def _trials(directory: Path) -> Iterator[Path]:
    """Write the runs and joint files of the trials; yield the folder of each."""
    import yaml

    from validation.diagnosis.benches import BENCHES, Counts, jobs
    from validation.diagnosis.entries import Hidden
    from validation.diagnosis.recorder import PRESETS
    from validation.diagnosis.scores import write
    from validation.generator.draw import draw

    hidden = (
        (),
        (Hidden("torque_ripple", 1, 0.6), Hidden("torque_constant", 2, 0.05)),
        (Hidden("hysteresis", 1, 1.5),),
    )
    for seed, effects in zip(SEEDS, hidden, strict=True):
        folder = directory / f"own_{seed}"
        folder.mkdir()
        case = draw(seed, effects)
        for number, columns in enumerate(case.runs, 1):
            table = np.column_stack(list(columns.values()))
            path = folder / f"run{number}.csv"
            np.savetxt(path, table, "%.9g", ",", header=",".join(columns), comments="")
        for number, joint in case.joints.items():
            (folder / f"joint{number}.yaml").write_text(yaml.safe_dump(joint, sort_keys=False))
        yield folder
    bench = BENCHES["mujoco"]()
    for number, job in enumerate(jobs(bench, MUJOCO_SEED, Counts())[:3]):
        folder = directory / f"mujoco_{MUJOCO_SEED}_{number}"
        folder.mkdir()
        drawn = bench.draw(job.seed, job.hidden)
        write(folder, drawn.runs, drawn.joints, PRESETS["full"], job.seed)
        yield folder


def findings(out: Path) -> Iterator[str]:
    with tempfile.TemporaryDirectory() as scratch:
        for folder in _trials(Path(scratch)):
            runs = sorted(str(path) for path in folder.glob("run*.csv"))
            yield f"{folder.name}: inputs {digest(b''.join(Path(each).read_bytes() for each in runs))}"
            joints = [f"--joint={n}={folder / f'joint{n}.yaml'}" for n in (1, 2)]
            text = jtq("diagnose", *runs, *joints, "--out", str(folder / "diagnosis"), "--json")
            yield from findings_lines(folder.name, text, out)
            extended = next(folder.glob("diagnosis/extended*.yaml"), None)
            if extended is not None:
                yield f"{folder.name}: extended joint file {digest(_undated(extended))}"


def _undated(path: Path) -> str:
    """Return a joint file without dates, paths and the sentence about the split."""
    text = re.sub(r"\d{4}-\d\d-\d\d(T[\d:.]+(Z|\+00:00)?)?", "DATE", path.read_text(encoding="utf-8"))
    text = re.sub(r"(?m)^ *split: .*$", "", text)
    return text.replace(str(path.parent.parent), "").replace(str(path.parent), "")


def joint_files(out: Path) -> Iterator[str]:
    """Fit the losses of a joint file to the runs of a bench, score it."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = next(_trials(Path(scratch)))
        runs = sorted(str(path) for path in folder.glob("run*.csv"))
        written = folder / "losses.yaml"
        jtq("fit", "losses", *runs, "--joint", str(folder / "joint1.yaml"), "--out", str(written))
        (out / "losses.yaml").write_text(_undated(written), encoding="utf-8")
        yield f"jtq fit losses: {digest(_undated(written))}"
        scored = jtq("score", str(written), *runs, "--json")
        yield f"jtq score: {digest(chr(10).join(numbers(json.loads(scored))))}"


def replay(out: Path) -> Iterator[str]:
    """Replay the golden logs with every method, bit by bit."""
    from tests.golden.reference import CASES, replayed

    for name, case in CASES.items():
        output, result = replayed(case)
        content = b"".join(np.ascontiguousarray(values).tobytes() for values in output.values.values())
        same = "" if case.method else f", as recorded: {bool(result.identity and result.identity.explained)}"
        yield f"golden {name}: {len(output.cycle)} cycles, {digest(content)}{same}"


def fresh_log(out: Path) -> Iterator[str]:
    """Record 20 s of the emulated bench, replay the log, describe its schemas."""
    from mcap.reader import make_reader

    with tempfile.TemporaryDirectory() as scratch:
        called("jtqd.daemon.jtqd", "--bus", "sim", "--duration", "20", "--record", scratch)
        (log,) = Path(scratch).glob("*.mcap")
        identity = json.loads(jtq("replay", str(log), "--json"))
        (out / "replay.json").write_text(json.dumps(identity, indent=1), encoding="utf-8")
        yield f"fresh log: replay bit-identical: {_identical(identity)}"
        with log.open("rb") as file:
            reader = make_reader(file)
            summary = reader.get_summary()
            assert summary is not None
            for channel in sorted(summary.channels.values(), key=lambda each: each.topic):
                schema = summary.schemas[channel.schema_id]
                yield f"topic {channel.topic}: {schema.name} {schema.encoding} {digest(schema.data)}"
            yield f"attachments: {sorted(each.name for each in reader.iter_attachments())}"


def _identical(content: Any) -> bool:
    """Return whether every count of equal estimates of a replay is the count of all."""
    text = json.dumps(content)
    pairs = re.findall(r'"pdos": (\d+), "pdos_equal": (\d+)', text)
    return bool(pairs) and all(all_ == equal for all_, equal in pairs)


def wire(out: Path) -> Iterator[str]:
    """Describe what is on the bus: EDS files, DBC."""
    from jtqd.models.files import shipped

    root = Path(__file__).parents[1]
    for eds in sorted((root / "drivers").rglob("*.eds")):
        content = re.sub(r"(?m)^(Modification|Creation)(Date|Time)=.*$", "", eds.read_text(encoding="utf-8"))
        yield f"{eds.name}: {digest(content)}"
    with tempfile.TemporaryDirectory() as scratch:
        dbc = Path(scratch) / "bus.dbc"
        jtq("export", "dbc", "--out", str(dbc), "--config", str(shipped("bench.yaml")))
        yield f"DBC of bench.yaml: {digest(dbc.read_text(encoding='utf-8'))}"


def kinova(out: Path) -> Iterator[str]:
    with tempfile.TemporaryDirectory() as scratch:
        content = json.loads(called("examples.kinova_diagnosis", "--out", scratch, "--json"))
        for each in content["joints"]:
            yield from findings_lines(f"kinova_{each['joint']}", json.dumps(each["findings"]), out)


_PLANTS: Final = ("--plant", "table_i", "--plant", "typical", "--plant", "bad_day")
"""`coarse` takes as long as all others."""


def goals(out: Path) -> Iterator[str]:
    """Compute the goals' table on few days: campaign, fits, every method, beside its baselines."""
    with tempfile.TemporaryDirectory() as scratch:
        file = Path(scratch) / "goals.json"
        called("validation", "goals", "--quick", *_PLANTS, "--json", str(file))
        found = json.loads(file.read_text(encoding="utf-8"))
        seeds, columns = found["seeds"], found["values"]["columns"]
        content = {
            "schema": "jtq.goals/1",
            "seed": seeds["judge"],
            "fit_seed": seeds["fit"],
            "columns": columns,
        }
        full = "\n".join(numbers(content))
        (out / "goals.txt").write_text(full + "\n", encoding="utf-8")
        yield f"goals --quick: {len(full.splitlines())} numbers, {digest(full)}"


def instructions(out: Path) -> Iterator[str]:
    """Count the instructions of a step and of a cycle; printed, compared with a limit of 2 %."""
    from tests.benchmarks.instructions import CYCLE, METHODS, STORED, count

    stored = json.loads(STORED.read_text(encoding="utf-8"))["instructions"]
    for name in (*METHODS, CYCLE):
        now = count(name)
        print(
            f"  {name}: {now:.0f} instructions, {100.0 * (now / stored[name] - 1.0):+.1f} %", file=sys.stderr
        )
        yield f"instructions {name}: at most 2 % above the stored ones: {now <= 1.02 * stored[name]}"


SECTIONS: Final[dict[str, Callable[[Path], Iterator[str]]]] = {
    "replay": replay,
    "wire": wire,
    "findings": findings,
    "joint_files": joint_files,
    "kinova": kinova,
    "fresh_log": fresh_log,
    "goals": goals,
    "instructions": instructions,
}


def stored_sections() -> dict[str, list[str]]:
    sections: dict[str, list[str]] = {}
    for line in STORED.read_text(encoding="utf-8").splitlines() if STORED.exists() else ():
        if line.startswith("["):
            sections[line.strip("[]")] = []
        elif line and not line.startswith("#"):
            sections[next(reversed(sections))].append(line)
    return sections


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("sections", nargs="*", metavar="SECTION", help=f"of {', '.join(SECTIONS)}")
    parser.add_argument("--store", action="store_true", help="store the results as the reference")
    parser.add_argument("--out", type=Path, metavar="DIR", help="keep full dumps")


def run(options: argparse.Namespace) -> Report:
    """Compare or store; see the module."""
    if unknown := set(options.sections) - set(SECTIONS):
        raise UsageError(f"found {', '.join(sorted(unknown))}, expected {', '.join(SECTIONS)}")
    reference, rows, differences = stored_sections(), [], []
    with tempfile.TemporaryDirectory() as scratch:
        out = options.out or Path(scratch)
        out.mkdir(parents=True, exist_ok=True)
        for name in options.sections or SECTIONS:
            lines = list(SECTIONS[name](out))
            found = list(difflib.unified_diff(reference.get(name, []), lines, lineterm="", n=0))[2:]
            differences += [f"{name}: {line}" for line in found]
            rows.append((name, str(len(lines)), f"{len(found)} lines differ" if found else "equal"))
            print(": ".join(rows[-1]), file=sys.stderr, flush=True)
            if options.store:
                reference[name] = lines
    if options.store:
        head = f"# {(__doc__ or '').splitlines()[0]} Written by `python -m validation frozen --store`.\n"
        body = "".join(
            f"[{name}]\n" + "".join(f"{line}\n" for line in reference[name])
            for name in SECTIONS
            if name in reference
        )
        STORED.write_text(head + body, encoding="utf-8")
    seeds = {"generator": ", ".join(map(str, SEEDS)), "mujoco": MUJOCO_SEED}
    table = Table(("section", "results", "beside the stored ones"), rows)
    return Report([table], seeds, differences, reached=options.store or not differences)
