"""The evaluation for a terminal: the same numbers as in the report, at most 120 columns wide."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from sysid.evaluate.evaluation import Evaluation
from sysid.evaluate.methods import TITLES
from sysid.evaluate.score import ratio
from sysid.evaluate.targets import mse
from sysid.evaluate.variable import PAPER_MSE_NM2, Row

_SHORT = {
    "tob": "TOB",
    "efficiency": "efficiency",
    "network": "paper's",
    "physics": "physics",
    "fused": "ours",
}


def text_lines(result: Evaluation, mapping: Mapping[str, Any]) -> list[str]:
    """Return the lines; mapping: `as_mapping(result)`."""
    lines = _runs(result)
    lines += [
        "",
        "A. constant velocity: worst error in % of the torque (in brackets % of rated)",
        *_constant(mapping),
    ]
    lines += ["", "B. variable velocity: mean square error in Nm²", *_variable(result)]
    lines += ["", "C. 90 % interval of ours: how often it held the sensor, in %", *_intervals(result)]
    lines += ["", "D. figures to reach", *_targets(result)]
    if result.findings:
        lines += ["", "findings", *(f"  {item.kind}: {item.text}" for item in result.findings)]
    return lines


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Return lines with columns as wide as they must be; the first column to the left, the others to the right."""
    every = [list(header), *map(list, rows)]
    widths = [max(len(row[k]) for row in every) for k in range(len(header))]
    return [
        (
            "  "
            + row[0].ljust(widths[0])
            + "".join("  " + cell.rjust(w) for cell, w in zip(row[1:], widths[1:], strict=True))
        ).rstrip()
        for row in every
    ]


def _runs(result: Evaluation) -> list[str]:
    kinds = [record.kind for record in result.runs]
    counts = ", ".join(
        f"{kinds.count(kind)} {text}"
        for kind, text in (
            ("constant", "at constant velocity"),
            ("variable", "at variable velocity"),
            ("outside", "outside the envelope"),
        )
        if kind in kinds
    )
    lines = [f"{len(kinds)} runs: {counts}"]
    for models in result.models:
        lines.append(
            f"{models.joint.name} (j{models.number}): " + ", ".join(TITLES[m] for m in models.methods)
        )
        lines += [f"  without {TITLES[method]}: {reason}" for method, reason in models.missing.items()]
    return lines


def _constant(mapping: Mapping[str, Any]) -> list[str]:
    speeds = mapping["constant"]["speeds"]
    if not speeds:
        return ["  no run at constant velocity"]
    methods = list(mapping["methods"])
    rows = []
    for each in speeds:
        cells = [
            f"{_cell(each['worst_percent'].get(m), '.1f')} ({_cell(each['worst_rated_percent'].get(m), '.2f')})"
            for m in methods
        ]
        load = f"{each['least_torque_nm']:.1f} to {each['most_torque_nm']:.1f} Nm"
        place = f"j{each['number']} {each['drive']} {each['velocity_rad_s']:g} rad/s"
        rows.append([place, str(each["plateaus"]), load, *cells])
    lines = table(["", "plateaus", "load", *(_SHORT[m] for m in methods)], rows)
    hard = mapping["constant"]["hardest"]
    for number, group in hard["joints"].items():
        if group["plateaus"]:
            values = ", ".join(
                f"{_SHORT[m]} {_cell(group['worst_percent'].get(m), '.1f')} %" for m in methods
            )
            lines.append(
                f"  2.5 rad/s and about 30 Nm, back drive, j{number}: {values} (paper: TOB {hard['paper_percent']:g} %)"
            )
    return lines


def _variable(result: Evaluation) -> list[str]:
    tables = result.variable
    if not tables.both:
        return ["  no run at variable velocity"]
    rows: list[list[str]] = []
    methods = result.methods
    paper: list[str] = [_cell(PAPER_MSE_NM2.get(m), ".2f") for m in methods]
    rows.append(["paper, tested joint", "", *paper])
    named: list[tuple[str, Row]] = [("joint in velocity mode", tables.tested), ("both joints", tables.both)]
    named += [(f"j{number}", row) for number, row in tables.joints.items()]
    rows += [[name, _samples(row), *(_cell(mse(row, m), ".3f") for m in methods)] for name, row in named]
    lines = table(["", "samples", *(_SHORT[m] for m in methods)], rows)
    for name, row in named[:2]:
        values = [
            _cell(ratio(mse(row, a), mse(row, b)), form)
            for a, b, form in (
                ("tob", "network", ".1f"),
                ("efficiency", "network", ".1f"),
                ("fused", "network", ".3f"),
                ("fused", "physics", ".3f"),
            )
        ]
        lines.append(
            f"  ratios, {name}: TOB : paper's {values[0]} (paper 46), efficiency : paper's {values[1]} (paper 9.0), "
            f"ours : paper's {values[2]}, ours : physics {values[3]}"
        )
    return lines


def _intervals(result: Evaluation) -> list[str]:
    rows = []
    for kind, tables in result.intervals.items():
        if kind == "all":
            continue
        for number, quadrants in tables.quadrants.items():
            cells = [
                f"{100 * one.share:.1f} +- {100 * one.se:.1f}"
                for one in (tables.joints[number], *quadrants.values())
            ]
            cells += ["-"] * (5 - len(cells))
            rows.append([f"j{number} {kind} velocity", *cells])
    lines = table(["", "all", "i>0 w>0", "i<0 w<0", "i<0 w>0", "i>0 w<0"], rows) if rows else ["  not known"]
    for number, one in result.standstill.items():
        held = ", ".join(f"{_SHORT[m]} {100 * c.share:.1f}" for m, c in one.coverage.items())
        lines.append(
            f"  standstill j{number}: {100 * one.share:.0f} % of the samples; interval held the sensor in % of them: {held}"
        )
    return lines


def _targets(result: Evaluation) -> list[str]:
    rows = []
    for each in result.targets:
        mark = {True: "yes", False: "NO", None: "-"}[each.reached]
        rows.append([each.figure, each.paper, each.goal, each.ours, mark])
    return table(["figure", "paper", "to reach", "ours", "reached"], rows)


def _samples(row: Row) -> str:
    return str(next(iter(row.values())).samples) if row else "0"


def _cell(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)
