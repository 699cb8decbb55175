"""Report of an evaluation: plain values (schema jtq.evaluation/1), text for a terminal, and one self-contained HTML page.

Figures: the paper's Figs. 14 and 16 with our data, errors by run and velocity, calibration; in the colours of
`sysid.report.page.LIGHT`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np

from jtqd.estimator.decoder import plain_values
from jtqd.estimator.fusion import GAUSS
from jtqd.estimator.joint import QUADRANTS
from jtqd.estimator.text import counted, table_lines
from jtqd.sysid.evaluate.evaluation import Evaluation, against_physics, mse, mse_ratio
from jtqd.sysid.evaluate.inputs import OURS, PAPERS, TITLES, JointModels, Samples
from jtqd.sysid.evaluate.scores import (
    LEVELS,
    PAPER_MSE_NM2,
    PAPER_WORST_PERCENT,
    VELOCITY_EDGES_RAD_S,
    WORST_TORQUE_NM,
    WORST_VELOCITY_RAD_S,
    Coverage,
    ErrorTables,
    IntervalTables,
    PlateauScore,
    Row,
    Score,
    Standstill,
    bin_name,
    common_methods,
    hardest_plateaus,
    ratio,
    shown,
    speed_groups,
    worst_plateau,
)
from jtqd.sysid.fit.efficiency import QUADRANT_TITLES
from jtqd.sysid.report import page
from jtqd.sysid.report.numbers import DASH
from jtqd.sysid.report.page import LIGHT, SENSOR, STANDING, page_svg, plain, shade, thinned

# Plain values ------------------------------------------------------------------------------------------------------------

SCHEMA: Final = "jtq.evaluation/1"


def as_mapping(result: Evaluation) -> dict[str, Any]:
    """Return dicts, lists, texts and finite numbers, None where there is none; joints are keys as text."""
    variable = result.variable
    tables = {
        kind: {name: value for name, value in vars(each).items() if name != "runs"}
        for kind, each in (("variable", variable), ("constant", result.constant_tables))
    }
    mapping: dict[str, Any] = plain_values(
        {
            "schema": SCHEMA,
            "methods": {method: TITLES[method] for method in result.methods},
            "models": [_model(each) for each in result.models],
            "runs": result.runs,
            "findings": [item._asdict() for item in result.findings],
            "figures_to_reach": result.targets,
            "constant": _constant(result),
            "variable": tables["variable"]
            | {
                "paper_mse_nm2": PAPER_MSE_NM2,
                "ratios": {"tested": _ratios(variable.tested), "both": _ratios(variable.both)},
            },
            "constant_runs": tables["constant"],
            "worse_than_physics": [
                {"run": run, "number": number, "ours_mse_nm2": ours, "physics_mse_nm2": physics}
                for run, number, ours, physics in against_physics(result.run_scores)[1]
            ],
            "intervals": result.intervals,
            "standstill": result.standstill,
            "jumps": {"at": result.jumps, "passage": result.passages},
            "outside": result.outside,
            "loop_time": result.loop_time,
            "truth": result.truth,
            "picture": result.picture and {"run": result.picture.run, "number": result.picture.number},
        }
    )
    return mapping


def _model(each: JointModels) -> dict[str, Any]:
    return {
        "number": each.number,
        "joint": each.joint.name,
        "rated_torque_nm": each.joint.rated_torque_nm,
        "methods": each.methods,
        "missing": each.missing,
        "files": each.files,
        "training_runs": len(frozenset().union(*each.training.values())),
        "silent_about_training": each.without_runs,
    }


def _ratios(one: Row) -> dict[str, float | None]:
    return {
        "tob_to_paper": mse_ratio(one, "tob", PAPERS),
        "efficiency_to_paper": mse_ratio(one, "efficiency", PAPERS),
        "ours_to_paper": mse_ratio(one, OURS, PAPERS),
        "ours_to_physics": mse_ratio(one, OURS, "physics"),
    }


def _constant(result: Evaluation) -> dict[str, Any]:
    numbers = sorted({each.number for each in result.plateaus})
    own = {number: [each for each in result.plateaus if each.number == number] for number in numbers}
    return {
        "plateaus": result.plateaus,
        "speeds": [
            {"number": number, "drive": drive, "velocity_rad_s": speed, **_group(group, result.methods)}
            for number, plateaus in own.items()
            for (drive, speed), group in speed_groups(plateaus).items()
        ],
        "hardest": {
            "paper_percent": PAPER_WORST_PERCENT,
            "velocity_rad_s": WORST_VELOCITY_RAD_S,
            "torque_nm": WORST_TORQUE_NM,
            "joints": {
                number: _group(hardest_plateaus(plateaus), result.methods) for number, plateaus in own.items()
            },
        },
    }


def _group(group: list[PlateauScore], methods: Iterable[str]) -> dict[str, Any]:
    torques = [abs(each.torque_nm) for each in group]
    found: dict[str, Any] = {
        "plateaus": len(group),
        "least_torque_nm": min(torques, default=None),
        "most_torque_nm": max(torques, default=None),
    }
    for key in ("percent", "rated_percent"):
        worst = {method: worst_plateau(group, method, key) for method in methods}
        found[f"worst_{key}"] = {method: each and each[0] for method, each in worst.items()}
    return found


# Text --------------------------------------------------------------------------------------------------------------------

_SHORT: Final = {
    **TITLES,
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
_QUADRANTS: Final = ("", "all", "i>0 w>0", "i<0 w<0", "i<0 w>0", "i>0 w<0")
_PAIRS: Final = (("tob", PAPERS), ("efficiency", PAPERS), (OURS, PAPERS), (OURS, "physics"))


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
        "D. targets of the paper's bench",
    ]
    rows = [[each.figure, each.paper, each.goal, each.ours, _MARKS[each.reached]] for each in result.targets]
    lines += indented_table(["figure", "paper", "target", "ours", "met"], rows)
    for each in result.targets:
        if each.reached is False and each.details:
            lines += [f"  {each.figure}:", *(f"    {line}" for line in each.details)]
    if result.findings:
        lines += ["", "findings", *(f"  {item.kind}: {item.text}" for item in result.findings)]
    return lines


def indented_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Return the lines of a table, two spaces to the right."""
    return [f"  {line}" for line in table_lines([header, *rows])]


def _runs(result: Evaluation) -> list[str]:
    kinds = [record.kind for record in result.runs]
    counts = ", ".join(f"{kinds.count(kind)} {text}" for kind, text in _KINDS.items() if kind in kinds)
    lines = [f"{counted(len(kinds), 'run')}: {counts}"]
    for models in result.models:
        methods = ", ".join(TITLES[method] for method in models.methods)
        lines.append(f"{models.joint.name} (j{models.number}): {methods}")
        lines += [f"  without {TITLES[method]}: {reason}" for method, reason in models.missing.items()]
    return lines


def _text_constant(mapping: Mapping[str, Any]) -> list[str]:
    methods, speeds = list(mapping["methods"]), mapping["constant"]["speeds"]
    if not speeds:
        return ["  no run at constant velocity"]
    rows = [
        [
            f"j{each['number']} {each['drive']} {each['velocity_rad_s']:g} rad/s",
            str(each["plateaus"]),
            f"{each['least_torque_nm']:.1f} to {each['most_torque_nm']:.1f} Nm",
            *(
                f"{shown(each['worst_percent'][m], '.1f')} ({shown(each['worst_rated_percent'][m])})"
                for m in methods
            ),
        ]
        for each in speeds
    ]
    lines = indented_table(["", "plateaus", "load", *(_SHORT[m] for m in methods)], rows)
    hard = mapping["constant"]["hardest"]
    for number, group in hard["joints"].items():
        if group["plateaus"]:
            worst = ", ".join(f"{_SHORT[m]} {shown(group['worst_percent'][m], '.1f')} %" for m in methods)
            paper = f"(paper: TOB {hard['paper_percent']:g} %)"
            lines.append(f"  2.5 rad/s and about 30 Nm, back drive, j{number}: {worst} {paper}")
    return lines


def _variable(result: Evaluation) -> list[str]:
    tables, methods = result.variable, result.methods
    if not tables.both:
        return ["  no run at variable velocity"]
    named = {"joint in velocity mode": tables.tested, "all joints": tables.both}
    ratios = [
        f"  ratios, {name}: " + ", ".join(_ratio(row, a, b) for a, b in _PAIRS) for name, row in named.items()
    ]
    named |= {f"j{number}": row for number, row in tables.joints.items()}
    rows = [["paper, tested joint", "", *(shown(PAPER_MSE_NM2.get(m), ".2f") for m in methods)]]
    for name, row in named.items():
        samples = str(next(iter(row.values())).samples) if row else "0"
        rows.append([name, samples, *(shown(mse(row, m), ".3f") for m in methods)])
    return indented_table(["", "samples", *(_SHORT[m] for m in methods)], rows) + ratios


def _ratio(row: Row, a: str, b: str) -> str:
    """E.g. "TOB : paper's 23.9 (paper 45.8)"."""
    paper = ratio(PAPER_MSE_NM2.get(a), PAPER_MSE_NM2.get(b))
    beside = "" if paper is None else f" (paper {paper:.1f})"
    form = ".3f" if a == OURS else ".1f"
    return f"{_SHORT[a]} : {_SHORT[b]} {shown(mse_ratio(row, a, b), form)}{beside}"


def _text_intervals(result: Evaluation) -> list[str]:
    rows = [
        [f"j{number} {kind} velocity", *_coverages(tables, number)]
        for kind, tables in result.intervals.items()
        if kind != "all"
        for number in tables.joints
    ]
    lines = indented_table(_QUADRANTS, rows) if rows else ["  not known"]
    for number, one in result.standstill.items():
        share = f"{100 * one.share:.0f} % of the samples"
        lines.append(f"  standstill j{number}, {share}: the interval contained it in {_held(one)}")
    return lines


def _text_truth(result: Evaluation) -> list[str]:
    """Return the table against the true torque; nothing where no run has it."""
    truth = result.truth
    if truth is None:
        return []
    rows = [
        [
            f"j{number} {text}",
            *(shown(row[m].rmse_rated_percent if m in row else None, ".2f") for m in result.methods),
        ]
        for text, part in (("now", truth.now), ("aligned", truth.aligned))
        for number, row in part.items()
    ]
    lines = [
        "against the true torque: RMSE in motion in % of rated torque (now: the estimate's delay is an error)",
        *indented_table(["", *(_SHORT[m] for m in result.methods)], rows),
    ]
    if truth.intervals is not None:
        cells = [
            [f"j{number} 90 %", *_coverages(truth.intervals, number)] for number in truth.intervals.joints
        ]
        lines += indented_table(_QUADRANTS, cells)
    for number, one in truth.standstill.items():
        lines.append(
            f"  standstill j{number}: the interval contained the true torque in {_held(one, width=True)}"
        )
    return [*lines, ""]


def _held(one: Standstill, *, width: bool = False) -> str:
    parts = [
        f"{_SHORT[m]} {100 * c.share:.1f} %"
        + (f" (half width {one.half_width_nm[m]:.2f} Nm)" if width else "")
        for m, c in one.coverage.items()
    ]
    return ", ".join(parts) or "no sample"


def _coverages(tables: IntervalTables, number: int) -> list[str]:
    quadrants = tables.quadrants[number]
    cells: tuple[Coverage | None, ...] = (tables.joints[number], *(quadrants.get(q) for q in QUADRANTS))
    return ["-" if one is None else str(one).replace(" %", "") for one in cells]


# Page --------------------------------------------------------------------------------------------------------------------


def report_html(result: Evaluation, mapping: Mapping[str, Any], made: str) -> str:
    """Return the page; mapping: `as_mapping(result)`, made: when and by what, one line. Needs jinja2 and matplotlib."""
    states = [each.reached for each in result.targets if each.goal != "-"]
    counts = {"reached": states.count(True), "missed": states.count(False), "unknown": states.count(None)}
    content = {
        "e": mapping,
        "made": made,
        "quadrants": QUADRANTS,
        "pictures": pictures(result),
        "verdict": counts,
    }
    filters: dict[str, Callable[..., Any]] = {
        "number": partial(shown, missing=DASH),
        "percent": lambda share, form=".1f": shown(None if share is None else 100.0 * share, form, DASH),
        "quadrant": lambda name: QUADRANT_TITLES[name].replace("w", "ω", 1),
    }
    return page.render("jtqd.sysid.evaluate", "report.html.j2", content, filters)


def pictures(result: Evaluation) -> dict[str, Any]:
    """Return the figures as SVG, "" where there is nothing to draw; per joint under its number as text."""
    numbers = [each.number for each in result.models]
    own = {number: [each for each in result.plateaus if each.number == number] for number in numbers}
    variable = result.variable
    return {
        "constant": {
            str(number): {
                drive: _svg(f"constant-{number}-{drive}", constant_figure, own[number], drive)
                for drive in ("forward", "back")
            }
            for number in numbers
        },
        "run": None if result.picture is None else _svg("run", run_figure, result.picture),
        "paper": _svg("paper", paper_figure, variable),
        "runs": {str(n): _svg(f"runs-{n}", runs_figure, variable, n) for n in numbers},
        "velocities": {str(n): _svg(f"velocities-{n}", velocities_figure, variable, n) for n in numbers},
        "calibration": _svg("calibration", calibration_figure, result.intervals),
    }


def _svg(name: str, draw: Callable[..., Any], *arguments: Any) -> str:
    return page_svg(partial(draw, *arguments), f"figure-{name}")


# Figures -----------------------------------------------------------------------------------------------------------------


class Style(NamedTuple):
    """Of one method in every figure; the first three as in the paper's."""

    colour: str
    line: str
    marker: str


STYLES: Final = {
    **dict.fromkeys(TITLES, Style(LIGHT["soft"], "-", "x")),
    "tob": Style(LIGHT["series_1"], "--", "v"),
    "efficiency": Style(LIGHT["series_2"], ":", "s"),
    PAPERS: Style(LIGHT["series_3"], "-.", "D"),
    "physics": Style(LIGHT["series_4"], (0, (5, 1)), "^"),  # type: ignore[arg-type]  # matplotlib's own dash pattern
    OURS: Style(LIGHT["series_5"], "-", "o"),
}
WIDTH_IN: Final = 6.4


def _look(method: str) -> dict[str, Any]:
    colour, line, marker = STYLES[method]
    return {"color": colour, "linestyle": line, "marker": marker, "markersize": 4.5}


def _new_figure(rows: int, height: float, **options: Any) -> tuple[Any, Any]:
    """Return figure and axes [rows] of the report's width."""
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(
        rows, 1, figsize=(WIDTH_IN, height), layout="constrained", squeeze=False, **options
    )
    return figure, axes[:, 0]


def _plain_log(axis: Any, set_scale: Any) -> None:
    """Logarithmic, with 0.1, 0.2, 0.5, 1, ... instead of powers."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    set_scale("log")
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def _finished(figure: Any, *axes: Any) -> Any:
    """Return the figure with plain axes and one legend above, as many columns as fit."""
    handles, labels = [], []
    for axis in axes:
        plain(axis)
        more, names = axis.get_legend_handles_labels()
        handles += more
        labels += names
    figure.legend(
        handles, labels, loc="outside upper left", ncols=min(len(labels), 3), fontsize=8.5, frameon=False
    )
    return figure


def constant_figure(plateaus: Sequence[PlateauScore], drive: str) -> Any | None:
    """Like Fig. 14, one joint: measured and estimated torque of every plateau, and the error; None without plateaus."""
    own = sorted(
        (each for each in plateaus if each.drive == drive),
        key=lambda each: (round(abs(each.velocity_rad_s), 1), abs(each.torque_nm)),
    )
    if not own:
        return None
    figure, (upper, lower) = _new_figure(2, 4.6, sharex=True)
    x = np.arange(len(own))
    torque = np.array([abs(each.torque_nm) for each in own])
    upper.plot(
        x, torque, color=SENSOR, marker="_", markersize=11, linestyle="none", label="torque sensor", zorder=4
    )
    for method in [m for m in TITLES if all(m in each.errors_nm for each in own)]:
        look = _look(method)
        error = np.array([each.errors_nm[method] * np.sign(each.torque_nm) for each in own])
        upper.plot(x, torque + error, label=TITLES[method], linewidth=1.1, **look | {"linestyle": "none"})
        percent = np.array([each.percent[method] for each in own], np.float64)  # None: NaN
        lower.plot(x, percent, linewidth=1.1, **look)
    speeds = [round(abs(each.velocity_rad_s), 1) for each in own]
    starts = [k for k in range(len(own)) if k == 0 or speeds[k] != speeds[k - 1]]
    below = {
        "transform": lower.get_xaxis_transform(),
        "ha": "center",
        "va": "top",
        "fontsize": 9,
    }
    for k, end in zip(starts, [*starts[1:], len(own)], strict=True):
        lower.text((k + end - 1) / 2, -0.06, f"{speeds[k]:g} rad/s", **below)
    lower.set_xticks([])
    upper.set_ylabel("|torque| [Nm]")
    lower.set_ylabel("error [% of torque]")
    for axis in (upper, lower):
        axis.set_ylim(bottom=0.0)
        for k in starts[1:]:
            axis.axvline(k - 0.5, color=LIGHT["soft"], linewidth=0.8)
    return _finished(figure, upper, lower)


def run_figure(samples: Samples) -> Any:
    """Like Fig. 16: sensor and every method over one run, and their errors with the 90 % interval of ours."""
    figure, (upper, lower) = _new_figure(2, 5.2, sharex=True)
    time = samples.time_s
    for axis in (upper, lower):
        shade(axis, time, samples.standing, STANDING, "standstill" if axis is upper else None)
    upper.plot(*thinned(time, samples.sensor_nm), color=SENSOR, linewidth=2.0, label="torque sensor")
    for method in common_methods([samples]):
        style = STYLES[method]
        look = {"color": style.colour, "linestyle": style.line, "linewidth": 1.3 if method == OURS else 1.0}
        upper.plot(*thinned(time, samples.estimate_nm[method]), label=TITLES[method], **look)
        error = np.where(samples.scored, samples.error_nm(method), np.nan)
        lower.plot(*thinned(time, error), **look)
    if OURS in samples.sigma_nm:
        half = np.where(samples.scored, GAUSS * samples.sigma_nm[OURS], np.nan)
        band_time, band = thinned(time, half)
        look = {"color": STYLES[OURS].colour, "alpha": 0.18, "linewidth": 0.0}
        lower.fill_between(band_time, -band, band, label="90 % interval of ours", **look)
    upper.set_ylabel("torque [Nm]")
    lower.set_ylabel("error [Nm]")
    lower.set_xlabel("time [s]")
    upper.set_xlim(time[0], time[-1])
    return _finished(figure, upper, lower)


def paper_figure(tables: ErrorTables) -> Any | None:
    """Return the mean square errors at variable velocity beside the paper's three; None without any."""
    if not tables.both:
        return None
    methods = [method for method in TITLES if method in tables.both]
    figure, (axis,) = _new_figure(1, 0.9 + 0.45 * len(methods))
    y = np.arange(len(methods))[::-1]
    for place, method in zip(y, methods, strict=True):
        colour = STYLES[method].colour
        for row, face in ((tables.tested, colour), (tables.both, LIGHT["paper"])):
            if method in row:
                look = {"color": colour, "markersize": 8, "markerfacecolor": face}
                axis.plot(row[method].mse_nm2, place, "o", **look)
        if method in PAPER_MSE_NM2:
            axis.plot(PAPER_MSE_NM2[method], place, "x", color=SENSOR, markersize=8, markeredgewidth=1.8)
    soft = LIGHT["soft"]
    for marker, colour, face, label in (
        ("o", soft, soft, "here, joint in velocity mode"),
        ("o", soft, LIGHT["paper"], "here, all joints"),
        ("x", SENSOR, SENSOR, "paper"),
    ):
        axis.plot([], [], marker, color=colour, markerfacecolor=face, label=label)
    _plain_log(axis.xaxis, axis.set_xscale)
    axis.set_yticks(y, [TITLES[method] for method in methods])
    axis.set_ylim(-0.6, len(methods) - 0.4)
    axis.set_xlabel("mean square error [Nm²]")
    return _finished(figure, axis)


def runs_figure(tables: ErrorTables, number: int) -> Any | None:
    """MSE of every run of one joint, by the MSE of its physics; None without runs."""
    runs = [row for (_, joint), row in tables.runs.items() if joint == number and row]
    if not runs:
        return None
    reference = "physics" if all("physics" in row for row in runs) else next(iter(runs[0]))
    runs.sort(key=lambda row: row[reference].mse_nm2)
    x = np.arange(1, len(runs) + 1)
    figure, axis = _rows_figure(x, runs, lambda score: score.mse_nm2, "MSE [Nm²]", 0.8)
    axis.set_xlabel(f"runs, by the MSE of {TITLES[reference]}")
    axis.set_xticks(x if len(runs) <= 30 else [])
    return _finished(figure, axis)


def velocities_figure(tables: ErrorTables, number: int) -> Any | None:
    """RMSE of one joint by |velocity|; None without samples."""
    rows = tables.velocities.get(number, {})
    names = [name for k in range(len(VELOCITY_EDGES_RAD_S) - 1) if rows.get(name := bin_name(k))]
    if not names:
        return None
    bins = [rows[name] for name in names]
    figure, axis = _rows_figure(names, bins, lambda score: score.rmse_rated_percent, "RMSE [% of rated]", 1.2)
    axis.set_xlabel("|velocity| [rad/s]")
    return _finished(figure, axis)


def _rows_figure(
    x: Any, rows: Sequence[Row], value: Callable[[Score], float], label: str, linewidth: float
) -> tuple[Any, Any]:
    """Return figure and axis with a value of every method that all rows have, over x."""
    figure, (axis,) = _new_figure(1, 2.9)
    for method in [m for m in TITLES if all(m in row for row in rows)]:
        values = [value(row[method]) for row in rows]
        axis.plot(x, values, label=TITLES[method], linewidth=linewidth, **_look(method))
    _plain_log(axis.yaxis, axis.set_yscale)
    axis.set_ylabel(label)
    return figure, axis


def calibration_figure(tables: Mapping[str, IntervalTables]) -> Any | None:
    """Return observed against nominal coverage of the interval; None without intervals."""
    if not tables:
        return None
    figure, (axis,) = _new_figure(1, 3.6)
    axis.plot([40, 100], [40, 100], color=LIGHT["soft"], linewidth=1.0, label="ideal")
    colours = [LIGHT[f"series_{k}"] for k in (5, 1, 4, 3)]
    numbers = sorted({number for table in tables.values() for number in table.joints})
    for kind, line in (("variable", "-"), ("constant", ":")):
        for number in numbers:
            curve = tables[kind].curve.get(number, {}) if kind in tables else {}
            levels = [level for level in LEVELS if level in curve]
            if levels:
                axis.errorbar(
                    [100 * level for level in levels],
                    [100 * curve[level].share for level in levels],
                    yerr=[100 * np.nan_to_num(curve[level].se) for level in levels],
                    color=colours[(number - 1) % len(colours)],
                    linestyle=line,
                    marker="o",
                    markersize=4.5,
                    linewidth=1.2,
                    capsize=2.5,
                    label=f"joint {number}, {kind} velocity",
                )
    axis.set_xlabel("nominal [%]")
    axis.set_ylabel("observed [%]")
    axis.set_ylim(40, 101)
    plain(axis)
    axis.legend(loc="lower right", fontsize=8.5, framealpha=0.9, edgecolor="none")
    return figure
