"""The evaluation as plain values (schema jtq.evaluation/1), as text for a terminal, and as one self-contained HTML page."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any, Final

from jtqd.estimator.checked import counted
from jtqd.estimator.joint import QUADRANTS
from jtqd.sysid.evaluate import constant, figures
from jtqd.sysid.evaluate.constant import PlateauScore, speed_groups
from jtqd.sysid.evaluate.evaluation import Evaluation, RunRecord, Target, mse, worse_runs
from jtqd.sysid.evaluate.methods import OURS, PAPERS, TITLES, JointModels
from jtqd.sysid.evaluate.scores import PAPER_MSE_NM2, Coverage, ErrorTables, IntervalTables, Row, ratio
from jtqd.sysid.evaluate.truth import TruthTables
from jtqd.sysid.fit.efficiency import TITLES as QUADRANT_TITLES
from jtqd.sysid.report import page
from jtqd.sysid.report.figures import page_svg
from jtqd.sysid.report.numbers import DASH

SCHEMA: Final = "jtq.evaluation/1"


def as_mapping(result: Evaluation) -> dict[str, Any]:
    """Return dicts, lists, texts and finite numbers, None where there is none; joints are keys as text."""
    mapping = {
        "schema": SCHEMA,
        "methods": {method: TITLES[method] for method in result.methods},
        "models": [_models(each) for each in result.models],
        "runs": [_run(each, result) for each in result.runs],
        "findings": [item._asdict() for item in result.findings],
        "figures_to_reach": [each._asdict() for each in result.targets],
        "constant": _constant(result),
        "variable": _tables(result.variable) | _against_paper(result.variable),
        "constant_runs": _tables(result.constant_tables),
        "worse_than_physics": [
            {"run": run, "number": number, "ours_mse_nm2": ours, "physics_mse_nm2": physics}
            for run, number, ours, physics in worse_runs(
                {**result.variable.runs, **result.constant_tables.runs}
            )
        ],
        "intervals": {name: _intervals(each) for name, each in result.intervals.items()},
        "standstill": {number: vars(each) for number, each in result.standstill.items()},
        "jumps": {"at": result.jumps, "passage": result.passages},
        "outside": list(result.outside),
        "loop_time": result.loop_time,
        "truth": None if result.truth is None else _truth(result.truth),
        "picture": None
        if result.picture is None
        else {"run": result.picture.run, "number": result.picture.number},
    }
    plain: dict[str, Any] = plain_values(mapping)
    return plain


def _models(each: JointModels) -> dict[str, Any]:
    return {
        "number": each.number,
        "joint": each.joint.name,
        "rated_torque_nm": each.joint.rated_torque_nm,
        "methods": each.methods,
        "missing": each.missing,
        "files": each.files,
        "training_runs": len(each.training.sources),
        "silent_about_training": each.training.silent,
    }


def _run(record: RunRecord, result: Evaluation) -> dict[str, Any]:
    tables = {"variable": result.variable, "constant": result.constant_tables}.get(record.kind)
    joints = {
        number: {
            "scored": scored,
            "standing": standing,
            "errors": None if tables is None else _row(tables.runs[record.name, number]),
        }
        for number, (scored, standing) in record.joints.items()
    }
    return record._asdict() | {"joints": joints}


def _constant(result: Evaluation) -> dict[str, Any]:
    numbers = sorted({each.number for each in result.plateaus})
    own = {number: [each for each in result.plateaus if each.number == number] for number in numbers}
    hard = constant.hardest(result.plateaus)
    return {
        "plateaus": [_plateau(each) for each in result.plateaus],
        "speeds": [
            {"number": number, "drive": drive, "velocity_rad_s": speed, **_group(group, result.methods)}
            for number in numbers
            for (drive, speed), group in speed_groups(own[number]).items()
        ],
        "hardest": {
            "paper_percent": constant.PAPER_WORST_PERCENT,
            "velocity_rad_s": constant.WORST_VELOCITY_RAD_S,
            "torque_nm": constant.WORST_TORQUE_NM,
            "joints": {
                number: _group([each for each in hard if each.number == number], result.methods)
                for number in numbers
            },
        },
    }


def _group(group: list[PlateauScore], methods: Iterable[str]) -> dict[str, Any]:
    torques = [abs(each.torque_nm) for each in group]
    worst: dict[str, dict[str, Any]] = {"worst_percent": {}, "worst_rated_percent": {}}
    for method in methods:
        for key, size in (
            ("worst_percent", PlateauScore.percent),
            ("worst_rated_percent", PlateauScore.rated_percent),
        ):
            found = constant.worst(group, method, size)
            worst[key][method] = None if found is None else found[0]
    return {
        "plateaus": len(group),
        "least_torque_nm": min(torques, default=None),
        "most_torque_nm": max(torques, default=None),
        **worst,
    }


def _plateau(each: PlateauScore) -> dict[str, Any]:
    return each._asdict() | {
        "percent": {method: each.percent(method) for method in each.errors_nm},
        "rated_percent": {method: each.rated_percent(method) for method in each.errors_nm},
    }


def _tables(tables: ErrorTables) -> dict[str, Any]:
    return {
        "tested": _row(tables.tested),
        "both": _row(tables.both),
        "joints": {number: _row(one) for number, one in tables.joints.items()},
        "quadrants": {
            n: {name: _row(one) for name, one in rows.items()} for n, rows in tables.quadrants.items()
        },
        "velocities": {
            n: {name: _row(one) for name, one in rows.items()} for n, rows in tables.velocities.items()
        },
        "bare_network_mse_nm2": {"tested": tables.bare_tested_nm2, "both": tables.bare_both_nm2},
    }


def _against_paper(tables: ErrorTables) -> dict[str, Any]:
    return {
        "paper_mse_nm2": PAPER_MSE_NM2,
        "ratios": {
            name: {
                "tob_to_paper": ratio(mse(one, "tob"), mse(one, PAPERS)),
                "efficiency_to_paper": ratio(mse(one, "efficiency"), mse(one, PAPERS)),
                "ours_to_paper": ratio(mse(one, OURS), mse(one, PAPERS)),
                "ours_to_physics": ratio(mse(one, OURS), mse(one, "physics")),
            }
            for name, one in (("tested", tables.tested), ("both", tables.both))
        },
    }


def _row(one: Row) -> dict[str, Any]:
    return {method: value._asdict() for method, value in one.items()}


def _intervals(table: IntervalTables) -> dict[str, Any]:
    return {
        "method": table.method,
        "overall": table.overall,
        "joints": table.joints,
        "quadrants": table.quadrants,
        "curve": {"both" if number is None else number: one for number, one in table.curve.items()},
    }


def _truth(truth: TruthTables) -> dict[str, Any]:
    return {
        "now": {number: _row(one) for number, one in truth.now.items()},
        "aligned": {number: _row(one) for number, one in truth.aligned.items()},
        "intervals": None if truth.intervals is None else _intervals(truth.intervals),
        "standstill": {number: vars(one) for number, one in truth.standstill.items()},
    }


def plain_values(value: Any) -> Any:
    """Named tuples and mappings as dicts with text keys, sequences as lists, numbers that are not finite as None."""
    if hasattr(value, "_asdict"):
        value = value._asdict()
    if isinstance(value, Mapping):
        return {str(key): plain_values(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain_values(item) for item in value]
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    return value


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
        *_text_constant(mapping),
        "",
        "B. variable velocity: mean square error in Nm²",
        *_variable(result),
        "",
        "C. 90 % interval of our method: coverage of the true torque where a run has it, else of the sensor, in %",
        *_text_intervals(result),
        "",
        *_text_truth(result),
        "D. targets",
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
    lines = [f"{counted(len(kinds), 'run')}: {counts}"]
    for models in result.models:
        lines.append(
            f"{models.joint.name} (j{models.number}): " + ", ".join(TITLES[m] for m in models.methods)
        )
        lines += [f"  without {TITLES[method]}: {reason}" for method, reason in models.missing.items()]
    return lines


def _text_constant(mapping: Mapping[str, Any]) -> list[str]:
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


def _text_intervals(result: Evaluation) -> list[str]:
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
        lines.append(f"  standstill j{number}, {share}: the interval contained it in {held or 'no sample'}")
    return lines


def _text_truth(result: Evaluation) -> list[str]:
    """Return the table against the true torque; nothing where no run has it."""
    truth = result.truth
    if truth is None:
        return []
    methods = result.methods
    rows = [
        [f"j{number} {text}", *(_rmse(scores, method) for method in methods)]
        for text, part in (("now", truth.now), ("aligned", truth.aligned))
        for number, scores in part.items()
    ]
    lines = [
        "against the true torque: RMSE in motion in % of rated torque (now: the estimate's age is an error)"
    ]
    lines += table(["", *(_SHORT[m] for m in methods)], rows)
    if truth.intervals is not None:
        cells = [
            [f"j{number} 90 %", *_coverages(truth.intervals, number)] for number in truth.intervals.joints
        ]
        lines += table(["", "all", "i>0 w>0", "i<0 w<0", "i<0 w>0", "i>0 w<0"], cells)
    for number, one in truth.standstill.items():
        held = ", ".join(
            f"{_SHORT[m]} {100 * c.share:.1f} % (half width {one.half_width_nm[m]:.2f} Nm)"
            for m, c in one.coverage.items()
        )
        lines.append(
            f"  standstill j{number}: the interval contained the true torque in {held or 'no sample'}"
        )
    return [*lines, ""]


def _rmse(scores: Row, method: str) -> str:
    return _cell(scores[method].rmse_rated_percent if method in scores else None, ".2f")


def _coverages(tables: IntervalTables, number: int) -> list[str]:
    quadrants = tables.quadrants[number]
    return [_coverage(one) for one in (tables.joints[number], *(quadrants.get(name) for name in QUADRANTS))]


def _coverage(one: Coverage | None) -> str:
    return "-" if one is None else str(one).replace(" %", "")


def _targets(targets: Sequence[Target]) -> list[str]:
    """Return the table, and under it the details of what is not reached."""
    rows = [[each.figure, each.paper, each.goal, each.ours, _MARKS[each.reached]] for each in targets]
    lines = table(["figure", "paper", "target", "ours", "met"], rows)
    for each in targets:
        if each.reached is False and each.details:
            lines += [f"  {each.figure}:", *(f"    {line}" for line in each.details)]
    return lines


def _samples(row: Row) -> str:
    return str(next(iter(row.values())).samples) if row else "0"


def _cell(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


TEMPLATE: Final = "report.html.j2"


def report_html(result: Evaluation, mapping: Mapping[str, Any], made: str) -> str:
    """Return the page; mapping: `as_mapping(result)`, made: when and by what, one line. Needs jinja2 and matplotlib."""
    content = {
        "e": mapping,
        "made": made,
        "quadrants": QUADRANTS,
        "pictures": pictures(result),
        "verdict": _verdict(mapping),
    }
    filters = {
        "number": number,
        "percent": percent,
        "quadrant": lambda name: QUADRANT_TITLES[name].replace("w", "ω", 1),
    }
    return page.render("jtqd.sysid.evaluate", TEMPLATE, content, filters)


def pictures(result: Evaluation) -> dict[str, Any]:
    """Return the figures as SVG, "" where there is nothing to draw; per joint under its number as text."""
    numbers = [each.number for each in result.models]
    own = {number: [each for each in result.plateaus if each.number == number] for number in numbers}
    return {
        "constant": {
            str(number): {
                drive: _svg(f"constant-{number}-{drive}", figures.constant_figure, own[number], drive)
                for drive in ("forward", "back")
            }
            for number in numbers
        },
        "run": None if result.picture is None else _svg("run", figures.run_figure, result.picture),
        "paper": _svg("paper", figures.paper_figure, result.variable),
        "runs": {
            str(number): _svg(f"runs-{number}", figures.runs_figure, result.variable, number)
            for number in numbers
        },
        "velocities": {
            str(number): _svg(f"velocities-{number}", figures.velocities_figure, result.variable, number)
            for number in numbers
        },
        "calibration": _svg("calibration", figures.calibration_figure, result.intervals),
    }


def _svg(name: str, draw: Callable[..., Any], *arguments: Any) -> str:
    return page_svg(partial(draw, *arguments), f"figure-{name}")


def number(value: float | None, form: str = ".2f") -> str:
    """Format a number, a dash where there is none."""
    return DASH if value is None else format(value, form)


def percent(share: float | None, form: str = ".1f") -> str:
    """Format a share as percent without the sign, a dash where there is none."""
    return DASH if share is None else format(100.0 * share, form)


def _verdict(mapping: Mapping[str, Any]) -> dict[str, int]:
    """Count the targets that are met, missed and not known; figures without a goal are left out."""
    states = [each["reached"] for each in mapping["figures_to_reach"] if each["goal"] != "-"]
    return {"reached": states.count(True), "missed": states.count(False), "unknown": states.count(None)}
