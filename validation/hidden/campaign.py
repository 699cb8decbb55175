"""Hides effects, has them diagnosed, prints the table of figures.

    python -m validation trials --trials 25 --seed 1
    python -m validation trials --trials 100 --kinds nothing,one --json > figures.json
    python -m validation trials --trials 25 --seed 1 --recorder seven_digits
    python -m validation trials --trials 0 --cost               what ten runs of 60 s cost

One trial is one bench of two joints, diagnosed with nothing hidden, one effect at three times and at one time its minimum
detectable size, two effects, and something that no library has. Exit status 0: all figures reached, 3: not all.
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
from collections.abc import Sequence
from dataclasses import asdict
from typing import Final

import numpy as np
from rich.progress import Progress

from validation.hidden.cost import cost_table
from validation.hidden.figures import coverage_by_parameter, failures, figures, table
from validation.hidden.scores import Outcome
from validation.hidden.trials import KINDS, trial
from validation.worlds.recorder import PRESETS, Recorder

REACHED: Final = 0
FAILED: Final = 1
MISSED: Final = 3


def run(  # noqa: PLR0917
    trials: int,
    seed: int,
    kinds: Sequence[str] = KINDS,
    processes: int = 2,
    first: int = 0,
    recorder: str | None = None,
) -> list[Outcome]:
    """Return the outcomes of trials first .. first + trials - 1, in order; recorder: a name of `PRESETS`."""
    preset = None if recorder is None else PRESETS[recorder]
    work = [(number, seed, tuple(kinds), preset) for number in range(first, first + trials)]
    shown = sys.stderr.isatty()
    out: list[list[Outcome]] = []
    with Progress(disable=not shown) as progress:
        bar = progress.add_task("trials", total=trials)
        if processes <= 1:
            for item in work:
                out.append(trial(*item))
                progress.advance(bar)
        else:
            with multiprocessing.get_context("spawn").Pool(processes) as pool:
                for outcomes in pool.imap(_trial, work):
                    out.append(outcomes)
                    progress.advance(bar)
    return [o for outcomes in out for o in outcomes]


def _trial(item: tuple[int, int, tuple[str, ...], Recorder | None]) -> list[Outcome]:
    return trial(*item)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the campaign; see the module."""
    parser = argparse.ArgumentParser(
        description=(__doc__ or "").split("\n", 1)[0],
        epilog="example: python -m validation trials --trials 25 --seed 1",
    )
    parser.add_argument("--trials", type=int, default=25, help="benches, each with all kinds (default 25)")
    parser.add_argument("--seed", type=int, help="drawn and printed when not given")
    parser.add_argument("--first", type=int, default=0, help="number of the first trial, to repeat one")
    parser.add_argument("--kinds", default=",".join(KINDS), help=f"some of {','.join(KINDS)}")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--recorder", choices=sorted(PRESETS), help="judge what it writes of the runs")
    parser.add_argument("--cost", action="store_true", help="measure ten runs of 60 s as well")
    parser.add_argument("--json", action="store_true", help="figures and all outcomes as JSON")
    options = parser.parse_args(arguments)
    kinds = tuple(options.kinds.split(","))
    wrong = [k for k in kinds if k not in KINDS]
    if wrong or options.trials < 0 or options.processes < 1:
        found = f"--kinds {wrong[0]!r}" if wrong else "--trials or --processes below its least"
        print(f"found {found}, expected some of {', '.join(KINDS)}; numbers from 0 and 1", file=sys.stderr)
        return 2
    seed = int(np.random.default_rng().integers(10**6)) if options.seed is None else options.seed
    print(f"seed {seed}", file=sys.stderr)
    begin = time.monotonic()
    outcomes = run(options.trials, seed, kinds, options.processes, options.first, options.recorder)
    rows = figures(outcomes)
    if options.cost:
        try:
            rows += cost_table()
        except RuntimeError as error:
            print(f"--cost: {error}", file=sys.stderr)
            return FAILED
    if options.json:
        print(
            json.dumps(
                {
                    "seed": seed,
                    "figures": [asdict(r) for r in rows],
                    "outcomes": [asdict(o) for o in outcomes],
                }
            )
        )
    else:
        print(f"seed {seed}, {options.trials} trials, {time.monotonic() - begin:.0f} s")
        print(table(rows))
        for line in [*failures(outcomes), *coverage_by_parameter(outcomes)]:
            print(line, file=sys.stderr)
    return MISSED if any(row.reached is False for row in rows) else REACHED


if __name__ == "__main__":
    sys.exit(main())
