"""The evaluation as one HTML file that needs nothing else: tables from the mapping, pictures inline."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from estimator.parameters import QUADRANTS
from sysid.efficiency_report import TITLES as QUADRANT_TITLES
from sysid.evaluate import figures
from sysid.evaluate.evaluation import Evaluation

TEMPLATE: Final = "report.html.j2"


def report_html(result: Evaluation, mapping: Mapping[str, Any], made: str) -> str:
    """Return the page; mapping: `as_mapping(result)`, made: when and by what, one line. Needs jinja2 and matplotlib."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("sysid.evaluate", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["number"] = number
    environment.filters["percent"] = percent
    environment.filters["quadrant"] = lambda name: QUADRANT_TITLES[name].replace("w", "ω", 1)
    page = environment.get_template(TEMPLATE).render(
        e=mapping, made=made, quadrants=QUADRANTS, pictures=pictures(result), verdict=_verdict(mapping)
    )
    return f"{page}\n"


def pictures(result: Evaluation) -> dict[str, Any]:
    """Return the figures as SVG texts, None where there is nothing to draw; per joint under its number as text."""
    numbers = [each.number for each in result.models]
    own = {number: [each for each in result.plateaus if each.number == number] for number in numbers}
    return {
        "constant": {
            str(number): {drive: figures.constant_figure(own[number], drive) for drive in ("forward", "back")}
            for number in numbers
        },
        "run": None if result.picture is None else figures.run_figure(result.picture),
        "paper": figures.paper_figure(result.variable),
        "runs": {str(number): figures.runs_figure(result.variable, number) for number in numbers},
        "velocities": {str(number): figures.velocities_figure(result.variable, number) for number in numbers},
        "calibration": figures.calibration_figure(result.intervals),
    }


def number(value: float | None, form: str = ".2f") -> str:
    """Format a number, a dash where there is none."""
    return "–" if value is None else format(value, form)


def percent(share: float | None, form: str = ".1f") -> str:
    """Format a share as percent without the sign, a dash where there is none."""
    return "–" if share is None else format(100.0 * share, form)


def _verdict(mapping: Mapping[str, Any]) -> dict[str, int]:
    """How many of the figures to reach are reached, missed and not known; figures without a goal are not counted."""
    states = [each["reached"] for each in mapping["figures_to_reach"] if each["goal"] != "-"]
    return {"reached": states.count(True), "missed": states.count(False), "unknown": states.count(None)}
