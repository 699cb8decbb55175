"""The goals and what the plants' columns say of them: text for a terminal, Markdown for a page, values for JSON."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any, Final, NamedTuple

from jtqd.sysid.evaluate.methods import OURS, PAPERS
from validation.goals.figures import REGRESSION, Changed, Column, Figure
from validation.goals.judge import OWN, TITLES

SCHEMA: Final = "jtq.goals/1"
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
        "contact of 3 Nm told within, ms; false alarms per hour",
        ("3; 1", "3; 1", "5; 1"),
        lambda column: "docs/estimator.md",
    ),
)


def goal_rows() -> tuple[Row, ...]:
    """Return the rows of the goals' table."""
    pairs = zip(*(_goals(method) for method in OWN), strict=True)
    return (*(row for pair in pairs for row in pair), *_NOT_HERE)


def method_lines(columns: Sequence[Column]) -> list[list[str]]:
    """Return the table of methods: RMSE now in % of rated, and MSE [Nm^2] as old as the estimate."""
    head = ["method: RMSE now, % of rated; MSE aligned, Nm²", *(column.name for column in columns)]
    return [
        head,
        *(
            [
                title,
                *(
                    f"{_number(column.now_percent[name], 2)}; {_number(column.mse_nm2[name], 3)}"
                    for column in columns
                ),
            ]
            for name, title in TITLES.items()
        ),
        [
            "the paper's ratio, classical TOB to its chain (46)",
            *(f"{column.mse_nm2['tob'].value / column.mse_nm2[PAPERS].value:.1f}" for column in columns),
        ],
    ]


def change_lines(columns: Sequence[Column]) -> list[list[str]]:
    """Return the table of changes: RMSE [Nm] and share inside [%] of ours without and with zeros; RMSE of least squares."""
    head = [
        "changed after identification: RMSE Nm, inside %, degraded %: ours / zeros tracked / RMSE of least squares",
        *(column.name for column in columns),
    ]
    names = list(dict.fromkeys(name for column in columns for name in column.changed[OURS]))
    return [head, *([name, *(_change(column, name) for column in columns)] for name in names)]


def _change(column: Column, name: str) -> str:
    if name not in column.changed[OURS]:
        return "-"

    def text(one: Changed) -> str:
        return f"{one.rmse_nm.value:.2f}, {one.inside.value:.1f}, {one.degraded.value:.1f}"

    parts = [text(column.changed[method][name]) for method in OWN]
    return " / ".join((*parts, f"{column.changed[REGRESSION][name].rmse_nm.value:.2f}"))


def goal_lines(columns: Sequence[Column]) -> list[list[str]]:
    """Return the table of the goals: each column beside its targets, "ok" where a target is reached."""
    head = ["figure", *(text for column in columns for text in (column.name, "target"))]
    lines = [head]
    for row in goal_rows():
        cells = [row.name]
        for k, column in enumerate(columns):
            cells.append(row.text(column))
            verdict = "" if row.reached is None else " ok" if row.reached(column, k) else " missed"
            cells.append(f"{row.targets[k]}{verdict}")
        lines.append(cells)
    return lines


def markdown(lines: Sequence[Sequence[str]]) -> list[str]:
    """Return a table as Markdown, its cells padded so that it can be read as text."""
    widths = [max(len(cells[k]) for cells in lines) for k in range(len(lines[0]))]
    rows = [
        "| " + " | ".join(f"{c:<{w}}" for c, w in zip(cells, widths, strict=True)) + " |" for cells in lines
    ]
    return [rows[0], "|" + "|".join("-" * (w + 2) for w in widths) + "|", *rows[1:]]


def as_mapping(columns: Sequence[Column], how: dict[str, Any]) -> dict[str, Any]:
    """Return everything as plain values for JSON; a number that does not exist is null."""
    result: dict[str, Any] = _plain({"schema": SCHEMA, **how, "columns": [asdict(each) for each in columns]})
    return result


def _plain(value: Any) -> Any:
    if isinstance(value, Figure | Changed) or hasattr(value, "_asdict"):
        return _plain(value._asdict())
    if isinstance(value, dict):
        return {str(key): _plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
