"""Hides effects in a bench, has the recorded files diagnosed, prints the bench's table beside its targets.

    python -m validation benches --bench mujoco --seed 1 --out full.jsonl
    python -m validation benches --bench mujoco --seed 1 --recorder seven_digits --out seven.jsonl --against full.jsonl
    python -m validation benches --table full.jsonl

Every set is one line of --out as soon as it is scored. The same command again goes on where it stopped; another
recorder with the same seed records the same sets, so that --against compares set by set. --minutes ends early: sets come
in a mixed order, so that a part of a campaign is a fair sample of it. The diagnosis reads run files and joint files in a
directory of their own; what is hidden stays in this process. Exit status 0: all figures reached, 3: not all, 1: failure.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy: one process per core is faster
os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import json
import multiprocessing
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from rich.progress import Progress

from validation.hidden.figures import table
from validation.hidden.scores import Outcome, score
from validation.worlds.benches import BENCHES, missing
from validation.worlds.figures import failures, figures, lost_to_wrong
from validation.worlds.judge import judged
from validation.worlds.oracle import hidden_size
from validation.worlds.recorder import PRESETS
from validation.worlds.sets import Bench, Hidden

FULL: Final = 3.0
"""Times the visible size."""
HALF: Final = 1.5
REACHED, FAILED, USAGE, MISSED = 0, 1, 2, 3
SCHEMA: Final = "jtq.worlds/1"


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
    out: list[Job] = []
    plain: list[int] = []
    usable = {
        name: [v for v in bench.variants(name) if hidden_size(bench.name, name, FULL, v) is not None]
        for name in bench.effects
    }
    there = [name for name in bench.effects if usable[name]]

    def effect(rng: np.random.Generator, name: str, factor: float) -> Hidden:
        places = bench.places(name)
        place = places[int(rng.integers(len(places)))]
        variant = usable[name][int(rng.integers(len(usable[name])))]
        size = hidden_size(bench.name, name, factor, variant)
        assert size is not None
        return Hidden(name, place, size, variant)

    def add(kind: str, label: str, hide: Any) -> None:
        number = len(out)
        rng = np.random.default_rng([seed, number])
        own = int(rng.integers(2**31))
        if bench.real and plain:
            own = plain[int(rng.integers(len(plain)))]
        out.append(Job(f"{kind}.{label}", kind, own, tuple(hide(rng))))

    for k in range(counts.none):
        add("nothing", str(k), lambda rng: [])
    if bench.real:
        plain += [job.seed for job in out]
    for k in range(counts.per_effect):
        for name in there:
            add("single", f"{name}.{k}", lambda rng, n=name: [effect(rng, n, FULL)])
            add("half", f"{name}.{k}", lambda rng, n=name: [effect(rng, n, HALF)])
    for k in range(counts.pairs):
        add(
            "pair",
            str(k),
            lambda rng: [effect(rng, str(n), FULL) for n in rng.choice(there, 2, replace=False)],
        )
    for k in range(counts.foreign):
        for kind in bench.foreign:
            add("foreign", f"{kind}.{k}", lambda rng, n=kind: [_strange(rng, bench, n)])
            add(
                "beside",
                f"{kind}.{k}",
                lambda rng, n=kind: [_strange(rng, bench, n), effect(rng, str(rng.choice(there)), FULL)],
            )
    first = counts.none if bench.real else 0  # what the others are judged beside comes first
    order = np.random.default_rng([seed, 2**20]).permutation(len(out) - first) + first
    return [*out[:first], *(out[int(k)] for k in order)]


def _strange(rng: np.random.Generator, bench: Bench, kind: str) -> Hidden:
    places = bench.places(kind)
    return Hidden(kind, places[int(rng.integers(len(places)))])


def run_job(bench_name: str, job: Job, recorder_name: str) -> dict[str, Any]:
    """Draw, record, diagnose and score one set; return its line."""
    recorder = PRESETS[recorder_name]
    begin = time.monotonic()
    drawn = BENCHES[bench_name]().draw(job.seed, job.hidden)
    made = time.monotonic()
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
        "draw_s": round(made - begin, 2),
        "diagnose_s": round(time.monotonic() - made, 2),
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


def _run(item: tuple[str, Job, str]) -> dict[str, Any]:
    return run_job(*item)


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
        key = values.pop("key")
        for name in ("draw_s", "diagnose_s", "reasons", "intervals"):
            values.pop(name, None)
        outcomes[key] = Outcome(**values)
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
        _cut_off(path)
    else:
        path.write_text(json.dumps(header) + "\n", encoding="utf-8")
    left = [
        job
        for job in jobs(BENCHES[bench](), seed, counts)[:most]
        if job.key not in done and (not kinds or job.kind in kinds)
    ]
    deadline = time.monotonic() + 60.0 * minutes

    def in_time() -> Iterator[tuple[str, Job, str]]:
        for job in left:
            if time.monotonic() > deadline:
                return
            yield bench, job, recorder

    with path.open("a", encoding="utf-8") as file, Progress(disable=not sys.stderr.isatty()) as progress:
        bar = progress.add_task("sets", total=len(left))

        def keep(line: dict[str, Any]) -> None:
            file.write(json.dumps(line) + "\n")
            file.flush()
            progress.advance(bar)

        if processes <= 1:
            for item in in_time():
                keep(run_job(*item))
        else:
            with multiprocessing.get_context("spawn").Pool(processes) as pool:
                work = list(in_time()) if minutes == float("inf") else None
                for line in pool.imap_unordered(_run, work) if work is not None else _fed(pool, in_time()):
                    keep(line)


def _fed(pool: Any, items: Iterator[Any]) -> Iterator[dict[str, Any]]:
    """Return results while never more items wait than processes work: what is not begun can still be left out."""
    waiting = []
    for item in items:
        waiting.append(pool.apply_async(_run, (item,)))
        while len(waiting) >= pool._processes:
            ready = [w for w in waiting if w.ready()]
            for w in ready:
                waiting.remove(w)
                yield w.get()
            if not ready:
                time.sleep(0.05)
    for w in waiting:
        yield w.get()


def _cut_off(path: Path) -> None:
    """Remove a last line without its end: a campaign was stopped while it wrote."""
    text = path.read_text(encoding="utf-8")
    if not text.endswith("\n"):
        path.write_text(text[: text.rfind("\n") + 1], encoding="utf-8")


def main(arguments: Sequence[str] | None = None) -> int:  # noqa: PLR0915
    """Run or print; see the module."""
    parser = argparse.ArgumentParser(
        description=(__doc__ or "").split("\n", 1)[0],
        epilog="example: python -m validation benches --bench measured --seed 1 --out measured.jsonl",
    )
    default = Counts()
    parser.add_argument("--bench", choices=sorted(BENCHES))
    parser.add_argument("--seed", type=int, help="drawn and printed when not given")
    parser.add_argument("--recorder", choices=sorted(PRESETS), default="full", help="default: full")
    parser.add_argument("--per-effect", type=int, default=default.per_effect, metavar="N")
    parser.add_argument("--none", type=int, default=default.none, metavar="N")
    parser.add_argument("--pairs", type=int, default=default.pairs, metavar="N")
    parser.add_argument(
        "--foreign", type=int, default=default.foreign, metavar="N", help="sets per foreign kind"
    )
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
    options = parser.parse_args(arguments)
    if options.table is None and (options.bench is None or options.out is None):
        print("found neither --table nor --bench and --out, expected one of them", file=sys.stderr)
        return USAGE
    seed = int(np.random.default_rng().integers(10**6)) if options.seed is None else options.seed
    lacking = missing(options.bench) if options.table is None else ""
    if lacking:
        print(lacking, file=sys.stderr)
        return FAILED
    kinds = tuple(k for k in options.kinds.split(",") if k)
    counts = Counts(options.per_effect, options.none, options.pairs, options.foreign)
    try:
        if options.table is None:
            print(f"seed {seed}", file=sys.stderr)
            campaign(
                options.out,
                options.bench,
                seed,
                options.recorder,
                counts,
                options.processes,
                options.minutes,
                kinds,
                options.sets,
            )
        header, outcomes = read(options.table or options.out)
        against = None if options.against is None else read(options.against)
    except (ValueError, OSError) as error:
        print(error, file=sys.stderr)
        return FAILED
    print(
        f"bench {header['bench']}, recorder {header['recorder']}, seed {header['seed']}, {len(outcomes)} sets"
    )
    real = BENCHES[header["bench"]]().real
    rows = figures(list(outcomes.values()), real)
    print(table(rows))
    if against is not None:
        same = against[0]["bench"], against[0]["seed"], against[0]["counts"]
        if same != (header["bench"], header["seed"], header["counts"]):
            print(
                f"{options.against}: found other sets, expected bench, seed and counts to be the same",
                file=sys.stderr,
            )
            return FAILED
        common = {key: outcomes[key] for key in outcomes if key in against[1]}
        full = {key: against[1][key] for key in common}
        print(f"\nthe same {len(common)} sets, recorder {against[0]['recorder']}")
        print(table(figures(list(full.values()), real)))
        print(f"\nthe same {len(common)} sets, recorder {header['recorder']}")
        print(table(figures(list(common.values()), real)))
        print(f"a wrong name instead of a found one: {len(lost_to_wrong(full, common))} sets (none allowed)")
    if options.failures:
        for line in failures(list(outcomes.values())):
            print(line)
    return MISSED if any(row.reached is False for row in rows) else REACHED


if __name__ == "__main__":
    sys.exit(main())
