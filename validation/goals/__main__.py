"""`python -m validation goals`: the goals' table: three plants, our estimate, its baselines and the targets."""

from __future__ import annotations

import argparse
import json
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Final

from jtqd.estimator.checked import ConfigError, check_output, count, natural
from jtqd.sysid.fit.losses import LossFitError
from jtqd.sysid.fit.torsion import TorsionError
from validation.goals.figures import Column, column
from validation.goals.identify import FIT_SEED, FULL, JUDGE_SEED, QUICK, TINY, Sizes
from validation.goals.plants import PlantFile, the_three
from validation.goals.table import as_mapping, change_lines, goal_lines, markdown, method_lines

BY: Final = "python -m validation goals"
SIZES: Final = {"full": FULL, "quick": QUICK, "tiny": TINY}
_EXAMPLES: Final = """examples:
  python -m validation goals --quick                 few days: large standard errors
  python -m validation goals --json goals.json       as many days as the docs' table"""


def parser() -> argparse.ArgumentParser:
    """Return the arguments of the command."""
    made = argparse.ArgumentParser(
        prog=BY, description=__doc__, epilog=_EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    size = made.add_mutually_exclusive_group()
    size.add_argument("--quick", action="store_const", const="quick", dest="size", help="a sixth of the runs")
    size.add_argument("--tiny", action="store_const", const="tiny", dest="size", help="to test the steps")
    made.add_argument(
        "--seed",
        type=natural,
        default=JUDGE_SEED,
        help="of the days and motions that judge (default %(default)s)",
    )
    made.add_argument(
        "--fit-seed", type=natural, default=FIT_SEED, help="of the campaigns (default %(default)s)"
    )
    made.add_argument("--jobs", type=count, default=1, metavar="N", help="plants at a time (default 1)")
    made.add_argument("--json", type=Path, metavar="FILE", help="also write every figure as JSON")
    return made


def _timed(sizes: Sizes, fit_seed: int, seed: int, plant: PlantFile) -> tuple[Column, float]:
    before = time.process_time()
    return column(plant, sizes, fit_seed, seed), time.process_time() - before


def main(argv: list[str] | None = None) -> int:
    """Print the tables; exit status 0 done, whether targets are reached or not, 1 failure, 2 usage."""
    arguments = parser()
    options = arguments.parse_args(argv)
    if options.seed == options.fit_seed:
        arguments.error(
            f"--seed, --fit-seed: found {options.seed} for both, expected two: the same days would fit and judge"
        )
    name = options.size or "full"
    try:
        if options.json is not None:
            check_output(options.json)
        with ProcessPoolExecutor(options.jobs) as pool:
            work = partial(_timed, SIZES[name], options.fit_seed, options.seed)
            done = list(pool.map(work, the_three()))
        columns = [each for each, _ in done]
        how = {"size": name, "seed": options.seed, "fit_seed": options.fit_seed}
        if options.json is not None:
            options.json.write_text(json.dumps(as_mapping(columns, how), indent=1) + "\n", encoding="utf-8")
    except (ConfigError, LossFitError, TorsionError, ValueError, OSError) as error:
        print(f"goals: {error}", file=sys.stderr)
        return 1
    print(
        f"{name}: {columns[0].runs} runs of two joints judge each plant, seed {options.seed}; campaigns of seed "
        f"{options.fit_seed}; {sum(cpu for _, cpu in done):.0f} s of CPU\n"
    )
    for lines in (goal_lines(columns), method_lines(columns), change_lines(columns)):
        print("\n".join((*markdown(lines), "")))
    return 0


if __name__ == "__main__":
    sys.exit(main())
