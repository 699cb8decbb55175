"""The evaluation for a terminal: the same numbers as in the report."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

from estimator.parameters import QUADRANTS
from sysid.evaluate.evaluation import Evaluation
from sysid.evaluate.intervals import IntervalTables
from sysid.evaluate.methods import OURS, PAPERS, TITLES
from sysid.evaluate.score import Coverage, ratio
from sysid.evaluate.targets import Target, mse
from sysid.evaluate.variable import PAPER_MSE_NM2, Row

_SHORT: Final = {
    "tob": "TOB",
    "efficiency": "efficiency",
    PAPERS: "paper's",
    "physics": "physics",
    OURS: "ours",
}
_KINDS: Final = {
    "constant": "at constant velocity",
    "variable": "at variable velocity",
    "outside": "to look outside the envelope",
}
_MARKS: Final = {True: "yes", False: "NO", None: "-"}


def text_lines(result: Evaluation, mapping: Mapping[str, Any]) -> list[str]:
    """Return the lines; mapping: `as_mapping(result)`."""
    lines = [
        *_runs(result),
        "",
        "A. constant velocity: worst error in % of the torque (in brackets: % of rated torque)",
        *_constant(mapping),
        "",
        "B. variable velocity: mean square error in Nm²",
        *_variable(result),
        "",
        "C. 90 % interval of ours: how often it held the sensor, in %",
        *_intervals(result),
        "",
        "D. figures to reach",
        *_targets(result.targets),
    ]
    if result.findings:
        lines += ["", "findings", *(f"  {item.kind}: {item.text}" for item in result.findings)]
    return lines


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Return lines with columns as wide as they must be; the first column to the left, the others to the right."""
    every = [list(header), *map(list, rows)]
    widths = [max(len(row[k]) for row in every) for k in range(len(header))]
    lines = []
    for row in every:
        cells = [row[0].ljust(widths[0]), *(c.rjust(w) for c, w in zip(row[1:], widths[1:], strict=True))]
        lines.append(("  " + "  ".join(cells)).rstrip())
    return lines


def _runs(result: Evaluation) -> list[str]:
    kinds = [record.kind for record in result.runs]
    counts = ", ".join(f"{kinds.count(kind)} {text}" for kind, text in _KINDS.items() if kind in kinds)
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
        errors = [
            f"{_cell(each['worst_percent'][m], '.1f')} ({_cell(each['worst_rated_percent'][m], '.2f')})"
            for m in methods
        ]
        load = f"{each['least_torque_nm']:.1f} to {each['most_torque_nm']:.1f} Nm"
        place = f"j{each['number']} {each['drive']} {each['velocity_rad_s']:g} rad/s"
        rows.append([place, str(each["plateaus"]), load, *errors])
    lines = table(["", "plateaus", "load", *(_SHORT[m] for m in methods)], rows)
    hard = mapping["constant"]["hardest"]
    for number, group in hard["joints"].items():
        if group["plateaus"]:
            worst = ", ".join(f"{_SHORT[m]} {_cell(group['worst_percent'][m], '.1f')} %" for m in methods)
            paper = f"(paper: TOB {hard['paper_percent']:g} %)"
            lines.append(f"  2.5 rad/s and about 30 Nm, back drive, j{number}: {worst} {paper}")
    return lines


def _variable(result: Evaluation) -> list[str]:
    tables, methods = result.variable, result.methods
    if not tables.both:
        return ["  no run at variable velocity"]
    named: list[tuple[str, Row]] = [("joint in velocity mode", tables.tested), ("all joints", tables.both)]
    named += [(f"j{number}", row) for number, row in tables.joints.items()]
    rows = [["paper, tested joint", "", *(_cell(PAPER_MSE_NM2.get(m), ".2f") for m in methods)]]
    rows += [[name, _samples(row), *(_cell(mse(row, m), ".3f") for m in methods)] for name, row in named]
    lines = table(["", "samples", *(_SHORT[m] for m in methods)], rows)
    for name, row in named[:2]:
        lines.append(f"  ratios, {name}: " + ", ".join(_ratio(row, a, b) for a, b in _PAIRS))
    return lines


_PAIRS: Final = (("tob", PAPERS), ("efficiency", PAPERS), (OURS, PAPERS), (OURS, "physics"))


def _ratio(row: Row, a: str, b: str) -> str:
    """E.g. "TOB : paper's 23.9 (paper 45.8)"."""
    paper = ratio(PAPER_MSE_NM2.get(a), PAPER_MSE_NM2.get(b))
    beside = "" if paper is None else f" (paper {paper:.1f})"
    form = ".3f" if a == OURS else ".1f"
    return f"{_SHORT[a]} : {_SHORT[b]} {_cell(ratio(mse(row, a), mse(row, b)), form)}{beside}"


def _intervals(result: Evaluation) -> list[str]:
    rows = [
        [f"j{number} {kind} velocity", *_coverages(tables, number)]
        for kind, tables in result.intervals.items()
        if kind != "all"
        for number in tables.joints
    ]
    lines = table(["", "all", "i>0 w>0", "i<0 w<0", "i<0 w>0", "i>0 w<0"], rows) if rows else ["  not known"]
    for number, one in result.standstill.items():
        held = ", ".join(f"{_SHORT[m]} {100 * c.share:.1f} %" for m, c in one.coverage.items())
        share = f"{100 * one.share:.0f} % of the samples"
        lines.append(
            f"  standstill j{number}, {share}: the interval held the sensor in {held or 'no sample'}"
        )
    return lines


def _coverages(tables: IntervalTables, number: int) -> list[str]:
    quadrants = tables.quadrants[number]
    return [_coverage(one) for one in (tables.joints[number], *(quadrants.get(name) for name in QUADRANTS))]


def _coverage(one: Coverage | None) -> str:
    return "-" if one is None else str(one).replace(" %", "")


def _targets(targets: Sequence[Target]) -> list[str]:
    """The table, and under it the details of what is not reached."""
    rows = [[each.figure, each.paper, each.goal, each.ours, _MARKS[each.reached]] for each in targets]
    lines = table(["figure", "paper", "to reach", "ours", "reached"], rows)
    for each in targets:
        if each.reached is False and each.details:
            lines += [f"  {each.figure}:", *(f"    {line}" for line in each.details)]
    return lines


def _samples(row: Row) -> str:
    return str(next(iter(row.values())).samples) if row else "0"


def _cell(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)
