"""Hides effects in a bench, has the recorded files diagnosed, prints the bench's table beside its targets.

    python -m validation benches --bench mujoco --seed 1 --out full.jsonl
    python -m validation benches --bench mujoco --seed 1 --recorder seven_digits --out seven.jsonl --against full.jsonl
    python -m validation benches --table full.jsonl

Every set is one line of --out as soon as it is scored. The same command again goes on where it stopped; another
recorder with the same seed records the same sets, so that --against compares set by set. --minutes ends early: sets come
in a mixed order, so that a part of a campaign is a fair sample of it. The diagnosis reads run files and joint files in a
directory of their own; what is hidden stays in this process.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, TypeVar

import msgspec
import numpy as np

from validation.diagnosis.entries import ENTRIES, Bench, Hidden
from validation.diagnosis.measured_bench import MeasuredBench
from validation.diagnosis.mujoco_bench import MujocoBench
from validation.diagnosis.recorder import PRESETS
from validation.diagnosis.scores import Outcome, bench_shares, failures, judged, lost_to_wrong, score
from validation.study import Report, Table, UsageError, in_processes, share_table

FILE: Final = Path(__file__).with_name("visible.json")
"""Visible sizes by bench and effect, frozen by the study `oracle`."""
FULL: Final = 3.0
"""Times the visible size."""
HALF: Final = 1.5
SCHEMA: Final = "jtq.worlds/1"
Value = TypeVar("Value")
BENCHES: Final[dict[str, Callable[[], Bench]]] = {"mujoco": MujocoBench, "measured": MeasuredBench}


def bench_option(parser: argparse.ArgumentParser, *more: str, required: bool = True) -> None:
    """Add --bench to the options of a study; more: further names."""
    parser.add_argument("--bench", choices=sorted([*BENCHES, *more]), required=required)


def made(name: str) -> Bench:
    """Return a bench; ModuleNotFoundError with one line where it needs what is not installed."""
    if name == MujocoBench.name and importlib.util.find_spec("mujoco") is None:
        raise ModuleNotFoundError(
            "--bench mujoco: found no mujoco, expected it installed: make setup, or pip install -e '.[dev]'"
        )
    return BENCHES[name]()


def key(name: str, variant: str = "") -> str:
    return f"{name} of {variant}" if variant else name


def sizes(bench: str) -> dict[str, float]:
    found: dict[str, float] = json.loads(FILE.read_text(encoding="utf-8"))[bench]
    return found


def hidden_size(bench: str, name: str, factor: float, variant: str = "") -> float | None:
    """Return `factor` times the visible size; None where a joint of that size would be broken, not badly modelled."""
    size = sizes(bench).get(key(name, variant))
    if size is None or factor * size > ENTRIES[name].bench.largest:
        return None
    return factor * size


@dataclass(frozen=True)
class Counts:
    """Sets per effect and size, with nothing hidden, of pairs, per foreign kind alone and beside an effect."""

    per_effect: int = 3
    none: int = 40
    pairs: int = 40
    foreign: int = 3


@dataclass(frozen=True)
class Job:
    """One set: its name in the file, its seed, what is hidden."""

    key: str
    kind: str
    seed: int
    hidden: tuple[Hidden, ...]


def jobs(bench: Bench, seed: int, counts: Counts) -> list[Job]:
    """Return all sets of a campaign in a mixed order; the same whatever the recorder."""
    usable = {
        name: [v for v in bench.variants(name) if hidden_size(bench.name, name, FULL, v) is not None]
        for name in bench.effects
    }
    there = [name for name in bench.effects if usable[name]]

    def effect(rng: np.random.Generator, name: str, factor: float = FULL) -> Hidden:
        place = _one_of(rng, bench.places(name))
        variant = _one_of(rng, usable[name])
        size = hidden_size(bench.name, name, factor, variant)
        assert size is not None
        return Hidden(name, place, size, variant)

    def hidden(rng: np.random.Generator, kind: str, name: str) -> list[Hidden]:
        if kind in ("single", "half"):
            return [effect(rng, name, FULL if kind == "single" else HALF)]
        if kind == "pair":
            return [effect(rng, str(n)) for n in rng.choice(there, 2, replace=False)]
        foreign = [Hidden(name, _one_of(rng, bench.places(name)), 0.0)] if name else []
        return [*foreign, effect(rng, str(rng.choice(there)))] if kind == "beside" else foreign

    wanted = [("nothing", str(k), "") for k in range(counts.none)]
    for k in range(counts.per_effect):
        wanted += [(kind, f"{name}.{k}", name) for name in there for kind in ("single", "half")]
    wanted += [("pair", str(k), "") for k in range(counts.pairs)]
    for k in range(counts.foreign):
        wanted += [(kind, f"{name}.{k}", name) for name in bench.foreign for kind in ("foreign", "beside")]
    out: list[Job] = []
    for number, (kind, label, name) in enumerate(wanted):
        rng = np.random.default_rng([seed, number])
        own = int(rng.integers(2**31))
        if bench.real and number >= counts.none > 0:  # the seed of one that hides nothing
            own = out[int(rng.integers(counts.none))].seed
        out.append(Job(f"{kind}.{label}", kind, own, tuple(hidden(rng, kind, name))))
    first = counts.none if bench.real else 0  # what the others are judged beside comes first
    order = np.random.default_rng([seed, 2**20]).permutation(len(out) - first) + first
    return [*out[:first], *(out[int(k)] for k in order)]


def _one_of(rng: np.random.Generator, values: Sequence[Value]) -> Value:
    return values[int(rng.integers(len(values)))]


@dataclass(frozen=True)
class Task:
    """A set to score: bench, what is hidden, recorder, and when it is too late to begin."""

    bench: str
    job: Job
    recorder: str
    deadline: float


def run_task(task: Task) -> dict[str, Any] | None:
    """Draw, record, diagnose and score one set; return its line, None after the deadline."""
    begin = time.monotonic()
    if begin > task.deadline:
        return None
    recorder, job = PRESETS[task.recorder], task.job
    drawn = BENCHES[task.bench]().draw(job.seed, job.hidden)
    drawn_at = time.monotonic()
    findings = judged(drawn.runs, drawn.joints, recorder, job.seed)
    run_s = float(np.mean([run["time_s"][-1] for run in drawn.runs]))
    detail = [
        f"{t['name']} of {t['joint']} " + " ".join(f"{k}={x:.3g}" for k, x in t["parameters"].items())
        for t in drawn.truth
    ]
    outcome = score(
        job.kind, job.seed, drawn.truth, findings, run_s=run_s, not_wrong=recorder.explains, detail=detail
    )
    return {
        "key": job.key,
        "draw_s": round(drawn_at - begin, 2),
        "diagnose_s": round(time.monotonic() - drawn_at, 2),
        "reasons": list(findings.reasons[:3]),
        "intervals": [
            [c.name, parameter, t["parameters"].get(parameter), found.value, *found.ci95]
            for t in drawn.truth
            for c in findings.causes
            if (c.name, c.joint) == (t["name"], t["joint"])
            for parameter, found in c.parameters.items()
        ],
        **asdict(outcome),
    }


def read(path: Path) -> tuple[dict[str, Any], dict[str, Outcome]]:
    """Return header and outcomes by key of a campaign's file; a last line that was cut off is left out.

    Raises ValueError with one line for another file.
    """
    lines = path.read_text(encoding="utf-8").splitlines()
    try:
        header = json.loads(lines[0])
    except (IndexError, ValueError):
        header = None
    if not isinstance(header, dict) or header.get("schema") != SCHEMA:
        raise ValueError(f"{path}: line 1: found no header of a campaign, expected schema {SCHEMA!r}")
    outcomes = {}
    for number, line in enumerate(lines[1:], 2):
        try:
            values = json.loads(line)
        except ValueError:
            if number == len(lines):
                break
            raise ValueError(f"{path}: line {number}: found no JSON, expected a set") from None
        outcomes[values["key"]] = msgspec.convert(values, Outcome)
    return header, outcomes


def campaign(  # noqa: PLR0917
    path: Path,
    bench: str,
    seed: int,
    recorder: str,
    counts: Counts,
    processes: int = 1,
    minutes: float = float("inf"),
    kinds: Sequence[str] = (),
    most: int | None = None,
) -> None:
    """Score what is missing in the file, line by line. Raises ValueError for a file of another campaign, OSError."""
    header = {"schema": SCHEMA, "bench": bench, "seed": seed, "recorder": recorder, "counts": asdict(counts)}
    done: dict[str, Outcome] = {}
    if path.exists() and path.stat().st_size:
        there, done = read(path)
        if there != header:
            differs = next(k for k in header if there.get(k) != header[k])
            raise ValueError(
                f"{path}: found a campaign with {differs} {there.get(differs)!r}, expected {header[differs]!r}; "
                "another --out, or the same options"
            )
        text = path.read_text(encoding="utf-8")  # a last line without its end: stopped while it wrote
        path.write_text(text[: text.rfind("\n") + 1], encoding="utf-8")
    else:
        path.write_text(json.dumps(header) + "\n", encoding="utf-8")
    deadline = time.monotonic() + 60.0 * minutes
    tasks = [
        Task(bench, job, recorder, deadline)
        for job in jobs(made(bench), seed, counts)[:most]
        if job.key not in done and (not kinds or job.kind in kinds)
    ]
    with path.open("a", encoding="utf-8") as file:
        for line in in_processes(run_task, tasks, processes, "sets"):
            if line is not None:
                file.write(json.dumps(line) + "\n")
                file.flush()


def options(parser: argparse.ArgumentParser) -> None:
    default = Counts()
    bench_option(parser, required=False)
    parser.add_argument("--seed", type=int, help="drawn and printed when not given")
    parser.add_argument("--recorder", choices=sorted(PRESETS), default="full", help="default: full")
    for name, value in asdict(default).items():
        option = f"--{name.replace('_', '-')}"
        parser.add_argument(option, type=int, default=value, metavar="N", help=f"sets (default {value})")
    parser.add_argument("--kinds", default="", help="some of single,half,nothing,pair,foreign,beside")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--sets", type=int, metavar="N", help="only the first N of the mixed order")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="begin no set after this time")
    parser.add_argument(
        "--out", type=Path, metavar="FILE.jsonl", help="one line per set; begun or gone on with"
    )
    parser.add_argument("--against", type=Path, metavar="FILE.jsonl", help="the same sets, fully recorded")
    parser.add_argument(
        "--table", type=Path, metavar="FILE.jsonl", help="print the table of this file, run nothing"
    )
    parser.add_argument("--failures", action="store_true", help="also list the sets that failed")


def run(options: argparse.Namespace) -> Report:
    """Run or print; see the module."""
    if options.table is None:
        if options.bench is None or options.out is None:
            raise UsageError("found neither --table nor --bench and --out, expected one of them")
        seed = int(np.random.default_rng().integers(10**6)) if options.seed is None else options.seed
        counts = Counts(options.per_effect, options.none, options.pairs, options.foreign)
        kinds = tuple(k for k in options.kinds.split(",") if k)
        campaign(
            *(options.out, options.bench, seed, options.recorder, counts),
            *(options.processes, options.minutes, kinds, options.sets),
        )
    header, outcomes = read(options.table or options.out)
    real = BENCHES[header["bench"]]().real
    rows = bench_shares(list(outcomes.values()), real)
    title = f"bench {header['bench']}, recorder {header['recorder']}, {len(outcomes)} sets"
    tables, notes = [share_table(rows, title)], []
    if options.against is not None:
        more, lost = _compared(header, outcomes, options.against, real)
        tables += more
        notes.append(f"a wrong name instead of a found one: {lost} sets (none allowed)")
    if options.failures:
        notes += failures(list(outcomes.values()))
    reached = not any(row.reached is False for row in rows)
    return Report(tables, {"seed": header["seed"]}, notes, rows, reached)


def _compared(
    header: dict[str, Any], outcomes: dict[str, Outcome], path: Path, real: bool
) -> tuple[list[Table], int]:
    """Return the tables of the sets that both files have, and how many found names turn into wrong ones."""
    other, full = read(path)
    if any(other[k] != header[k] for k in ("bench", "seed", "counts")):
        raise ValueError(f"{path}: found other sets, expected bench, seed and counts to be the same")
    common = {key: outcomes[key] for key in outcomes if key in full}
    full = {key: full[key] for key in common}
    tables = [
        share_table(bench_shares(list(each.values()), real), f"the same {len(common)} sets, recorder {name}")
        for name, each in ((other["recorder"], full), (header["recorder"], common))
    ]
    return tables, len(lost_to_wrong(full, common))
