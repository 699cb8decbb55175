"""The goals: three plants, our estimate and its baselines against the torque that only a plant knows, and the targets.

python -m validation goals --quick                 few days: large standard errors
python -m validation goals --json goals.json       as many days as the docs' table
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Final, NamedTuple

from jtqd.estimator.command_line import count, natural
from jtqd.sysid.evaluate.inputs import OURS, PAPERS
from validation.goals.identify import FIT_SEED, FULL, JUDGE_SEED, QUICK, TINY, PlantFile, Sizes, the_three
from validation.goals.judge import OWN, REGRESSION, TITLES, Changed, Column, Figure, column
from validation.study import Report, Table, UsageError, in_processes

SIZES: Final = {"full": FULL, "quick": QUICK, "tiny": TINY}
_WITH: Final = {OURS: "ours", "ours_zeros": "ours, zeros tracked"}


class Row(NamedTuple):
    """A figure of the table: its name, targets (by column, empty for none), text of a column, and whether it is reached."""

    name: str
    targets: tuple[str, str, str]
    text: Callable[[Column], str]
    reached: Callable[[Column, int], bool] | None = None


def _number(figure: Figure, digits: int) -> str:
    if not math.isfinite(figure.value):
        return "-"
    beside = f" ± {figure.se:.{digits}f}" if math.isfinite(figure.se) else ""
    return f"{figure.value:.{digits}f}{beside}"


_NOW: Final = (0.5, 1.0, 1.5)
_RATIO: Final = (0.15, 0.2, 0.3)
_LOW: Final = (87.0, 86.0, 85.0)
_HIGH: Final = (93.0, 94.0, 95.0)
_CHANGED: Final = 85.0
_REST: Final = (2.5, 2.5, 3.0)
_FALSELY: Final = (2.0, 2.0, 3.0)


def _goals(method: str) -> list[Row]:
    """Return the rows of the goals for ours, zeros tracked or not."""
    name = _WITH[method]

    def interval(column: Column) -> str:
        one = column.interval[method]
        return f"{_number(one.low, 1)} to {_number(one.high, 1)}; all {_number(one.all, 1)}"

    def rest(column: Column) -> str:
        one = column.standstill[method]
        return f"{_number(one.inside, 1)}; {one.half_nm:.2f}"

    def changed(column: Column) -> str:
        what, one = column.worst_change(method)
        return f"{_number(one.inside, 1)} ({what})"

    def flagged(column: Column) -> str:
        one = column.outside[method]
        kinds = ", ".join(f"{kind} {_number(figure, 1)}" for kind, figure in one.flagged.items())
        return f"{kinds}; {_number(one.falsely, 1)}"

    return [
        Row(
            f"RMSE in motion against the true torque now, % of rated: {name}",
            _texts(_NOW),
            lambda column: _number(column.now_percent[method], 2),
            lambda column, k: column.now_percent[method].value <= _NOW[k],
        ),
        Row(
            f"MSE to that of the paper's chain identified on the same runs: {name}",
            _texts(_RATIO),
            lambda column: f"{column.to_chain(method):.3f}",
            lambda column, k: column.to_chain(method) <= _RATIO[k],
        ),
        Row(
            f"MSE to that of least squares on torsion and current: {name}",
            ("", "", ""),
            lambda column: f"{column.to_regression(method):.3f}",
        ),
        Row(
            f"90 % interval holds the true torque, %, worst and best of joints and quadrants: {name}",
            tuple(f"{low:g} to {high:g}" for low, high in zip(_LOW, _HIGH, strict=True)),  # type: ignore[arg-type]
            interval,
            lambda column, k: (
                column.interval[method].low.value >= _LOW[k]
                and column.interval[method].high.value <= _HIGH[k]
            ),
        ),
        Row(
            f"the same with one thing changed, %, worst change: {name}",
            _texts((_CHANGED,) * 3),
            changed,
            lambda column, k: column.worst_change(method)[1].inside.value >= _CHANGED,
        ),
        Row(
            f"standstill interval holds the true torque, %; mean half width, Nm: {name}",
            tuple(f"90; {half:g}" for half in _REST),  # type: ignore[arg-type]
            rest,
            lambda column, k: (
                column.standstill[method].inside.value >= 90.0
                and column.standstill[method].half_nm <= _REST[k]
            ),
        ),
        Row(
            f"outside, flagged, %; inside, falsely flagged, %: {name}",
            tuple(f"95; {each:g}" for each in _FALSELY),  # type: ignore[arg-type]
            flagged,
            lambda column, k: (
                column.outside[method].least.value >= 95.0
                and column.outside[method].falsely.value <= _FALSELY[k]
            ),
        ),
        Row(
            f"joints in runs worse than least squares on torsion and current, %: {name}",
            ("", "", ""),
            lambda column: _number(column.worse[method], 1),
        ),
    ]


def _texts(values: tuple[float, float, float]) -> tuple[str, str, str]:
    a, b, c = (f"{value:g}" for value in values)
    return a, b, c


_NOT_HERE: Final = (
    Row("joints in runs worse than physics, %", ("2", "2", "2"), lambda column: "none: no network"),
    Row(
        "contact of 3 Nm reported within, ms; false alarms per hour",
        ("3; 1", "3; 1", "5; 1"),
        lambda column: "docs/estimator.md",
    ),
)


def goal_rows() -> tuple[Row, ...]:
    pairs = zip(*(_goals(method) for method in OWN), strict=True)
    return (*(row for pair in pairs for row in pair), *_NOT_HERE)


def method_table(columns: Sequence[Column]) -> Table:
    """Return the table of methods: RMSE now in % of rated, and MSE [Nm^2] as old as the estimate."""

    def cells(name: str) -> list[str]:
        return [f"{_number(c.now_percent[name], 2)}; {_number(c.mse_nm2[name], 3)}" for c in columns]

    ratios = [f"{c.mse_nm2['tob'].value / c.mse_nm2[PAPERS].value:.1f}" for c in columns]
    return Table(
        ["method: RMSE now, % of rated; MSE aligned, Nm²", *(c.name for c in columns)],
        [
            *([title, *cells(name)] for name, title in TITLES.items()),
            ["the paper's ratio, classical TOB to its chain (46)", *ratios],
        ],
    )


def change_table(columns: Sequence[Column]) -> Table:
    """Return the table of changes: RMSE [Nm] and share inside [%] of ours without and with zeros; RMSE of least squares."""
    head = [
        "changed after identification: RMSE Nm, inside %, degraded %: ours / zeros tracked / RMSE of least squares",
        *(column.name for column in columns),
    ]
    names = list(dict.fromkeys(name for column in columns for name in column.changed[OURS]))
    return Table(head, [[name, *(_change(column, name) for column in columns)] for name in names])


def _change(column: Column, name: str) -> str:
    if name not in column.changed[OURS]:
        return "-"

    def text(one: Changed) -> str:
        return f"{one.rmse_nm.value:.2f}, {one.inside.value:.1f}, {one.degraded.value:.1f}"

    parts = [text(column.changed[method][name]) for method in OWN]
    return " / ".join((*parts, f"{column.changed[REGRESSION][name].rmse_nm.value:.2f}"))


def goal_table(columns: Sequence[Column]) -> tuple[Table, bool]:
    """Return the table of the goals, each column beside its targets, and whether all targets are reached."""
    rows, every = [], True
    for row in goal_rows():
        cells = [row.name]
        for k, each in enumerate(columns):
            reached = None if row.reached is None else row.reached(each, k)
            every = every and reached is not False
            verdict = {None: "", True: " ok", False: " missed"}[reached]
            cells += [row.text(each), f"{row.targets[k]}{verdict}"]
        rows.append(cells)
    return Table(["figure", *(text for c in columns for text in (c.name, "target"))], rows), every


def options(parser: argparse.ArgumentParser) -> None:
    size = parser.add_mutually_exclusive_group()
    size.add_argument("--quick", action="store_const", const="quick", dest="size", help="a sixth of the runs")
    size.add_argument("--tiny", action="store_const", const="tiny", dest="size", help="to test the steps")
    parser.add_argument(
        "--seed",
        type=natural,
        default=JUDGE_SEED,
        help="of the days and motions that judge (default %(default)s)",
    )
    parser.add_argument(
        "--fit-seed", type=natural, default=FIT_SEED, help="of the campaigns (default %(default)s)"
    )
    parser.add_argument("--jobs", type=count, default=1, metavar="N", help="plants at a time (default 1)")


def _timed(sizes: Sizes, fit_seed: int, seed: int, plant: PlantFile) -> tuple[Column, float]:
    before = time.process_time()
    return column(plant, sizes, fit_seed, seed), time.process_time() - before


def run(options: argparse.Namespace) -> Report:
    if options.seed == options.fit_seed:
        raise UsageError(
            f"--seed, --fit-seed: found {options.seed} for both, expected two: the same days would fit and judge"
        )
    name = options.size or "full"
    work = partial(_timed, SIZES[name], options.fit_seed, options.seed)
    done = list(in_processes(work, the_three(), options.jobs, "plants"))
    columns = [each for each, _ in done]
    goals, reached = goal_table(columns)
    cpu = sum(each for _, each in done)
    note = f"{name}: {columns[0].runs} runs of two joints judge each plant; {cpu:.0f} s of CPU"
    seeds = {"judge": options.seed, "fit": options.fit_seed}
    tables = [goals, method_table(columns), change_table(columns)]
    return Report(tables, seeds, [note], {"size": name, "columns": columns}, reached)
