"""The evaluation as plain values (schema jtq.evaluation/1), as text for a terminal, and as one self-contained HTML page."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np

from jtqd.estimator.joint import QUADRANTS
from jtqd.estimator.text import counted, table_lines
from jtqd.estimator.uncertainty import GAUSS
from jtqd.sysid.evaluate.evaluation import Evaluation, RunRecord, Target, mse, worse_runs
from jtqd.sysid.evaluate.methods import OURS, PAPERS, TITLES, JointModels, Samples
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
    TruthTables,
    bin_name,
    common_methods,
    hardest_plateaus,
    ratio,
    speed_groups,
    worst_plateau,
)
from jtqd.sysid.fit.efficiency import QUADRANT_TITLES
from jtqd.sysid.report import page
from jtqd.sysid.report.figures import SENSOR, STANDING, page_svg, plain, shade, thinned
from jtqd.sysid.report.numbers import DASH
from jtqd.sysid.report.page import LIGHT


class Style(NamedTuple):
    """Of one method in every figure; the first three as in the paper's."""

    colour: str
    line: str
    marker: str


STYLES: Final = {
    "tob": Style(LIGHT["series_1"], "--", "v"),
    "efficiency": Style(LIGHT["series_2"], ":", "s"),
    PAPERS: Style(LIGHT["series_3"], "-.", "D"),
    "physics": Style(LIGHT["series_4"], (0, (5, 1)), "^"),  # type: ignore[arg-type]  # matplotlib's own dash pattern
    OURS: Style(LIGHT["series_5"], "-", "o"),
}
WIDTH_IN: Final = 6.4


def new_figure(rows: int, height: float, **options: Any) -> tuple[Any, Any]:
    """Return figure and axes [rows] of the report's width."""
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(
        rows, 1, figsize=(WIDTH_IN, height), layout="constrained", squeeze=False, **options
    )
    return figure, axes[:, 0]


def plain_log(axis: Any, set_scale: Any) -> None:
    """Logarithmic, with 0.1, 0.2, 0.5, 1, ... instead of powers."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    set_scale("log")
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def legend_above(figure: Any, *axes: Any) -> None:
    """One legend above the figure, as many columns as fit."""
    handles, labels = [], []
    for axis in axes:
        more, names = axis.get_legend_handles_labels()
        handles += more
        labels += names
    figure.legend(
        handles, labels, loc="outside upper left", ncols=min(len(labels), 3), fontsize=8.5, frameon=False
    )


def constant_figure(plateaus: Sequence[PlateauScore], drive: str) -> Any | None:
    """Like Fig. 14, one joint: measured and estimated torque of every plateau, and the error; None without plateaus."""
    own = sorted(
        (each for each in plateaus if each.drive == drive),
        key=lambda each: (round(abs(each.velocity_rad_s), 1), abs(each.torque_nm)),
    )
    if not own:
        return None
    figure, (upper, lower) = new_figure(2, 4.6, sharex=True)
    x = np.arange(len(own))
    torque = np.array([abs(each.torque_nm) for each in own])
    upper.plot(
        x, torque, color=SENSOR, marker="_", markersize=11, linestyle="none", label="torque sensor", zorder=4
    )
    for method in [m for m in TITLES if all(m in each.errors_nm for each in own)]:
        style = STYLES[method]
        look = {"color": style.colour, "marker": style.marker, "markersize": 4.5, "linewidth": 1.1}
        error = np.array([each.errors_nm[method] * np.sign(each.torque_nm) for each in own])
        upper.plot(x, torque + error, linestyle="none", label=TITLES[method], **look)
        percent = [value if (value := each.percent(method)) is not None else np.nan for each in own]
        lower.plot(x, percent, linestyle=style.line, **look)
    speeds = [round(abs(each.velocity_rad_s), 1) for each in own]
    starts = [k for k in range(len(own)) if k == 0 or speeds[k] != speeds[k - 1]]
    for axis in (upper, lower):
        plain(axis)
        for k in starts[1:]:
            axis.axvline(k - 0.5, color=LIGHT["soft"], linewidth=0.8)
    for k, end in zip(starts, [*starts[1:], len(own)], strict=True):
        lower.text(
            (k + end - 1) / 2,
            -0.06,
            f"{speeds[k]:g} rad/s",
            transform=lower.get_xaxis_transform(),
            ha="center",
            va="top",
            fontsize=9,
        )
    lower.set_xticks([])
    upper.set_ylabel("|torque| [Nm]")
    lower.set_ylabel("error [% of torque]")
    for axis in (upper, lower):
        axis.set_ylim(bottom=0.0)
    legend_above(figure, upper)
    return figure


def run_figure(samples: Samples) -> Any:
    """Like Fig. 16: sensor and every method over one run, and their errors with the 90 % interval of ours."""
    figure, (upper, lower) = new_figure(2, 5.2, sharex=True)
    time = samples.time_s
    for axis in (upper, lower):
        plain(axis)
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
        lower.fill_between(
            band_time,
            -band,
            band,
            color=STYLES[OURS].colour,
            alpha=0.18,
            linewidth=0.0,
            label="90 % interval of ours",
        )
    upper.set_ylabel("torque [Nm]")
    lower.set_ylabel("error [Nm]")
    lower.set_xlabel("time [s]")
    upper.set_xlim(time[0], time[-1])
    legend_above(figure, upper, lower)
    return figure


def paper_figure(tables: ErrorTables) -> Any | None:
    """Return the mean square errors at variable velocity beside the paper's three; None without any."""
    if not tables.both:
        return None
    methods = [method for method in TITLES if method in tables.both]
    figure, (axis,) = new_figure(1, 0.9 + 0.45 * len(methods))
    y = np.arange(len(methods))[::-1]
    for place, method in zip(y, methods, strict=True):
        colour = STYLES[method].colour
        for row, marker, filled in ((tables.tested, "o", True), (tables.both, "o", False)):
            if method in row:
                axis.plot(
                    row[method].mse_nm2,
                    place,
                    marker,
                    color=colour,
                    markersize=8,
                    markerfacecolor=colour if filled else LIGHT["paper"],
                )
        if method in PAPER_MSE_NM2:
            axis.plot(PAPER_MSE_NM2[method], place, "x", color=SENSOR, markersize=8, markeredgewidth=1.8)
    for marker, face, label in (
        ("o", LIGHT["soft"], "here, joint in velocity mode"),
        ("o", LIGHT["paper"], "here, all joints"),
        ("x", SENSOR, "paper"),
    ):
        axis.plot(
            [],
            [],
            marker,
            color=LIGHT["soft"] if marker == "o" else SENSOR,
            markerfacecolor=face,
            label=label,
        )
    plain_log(axis.xaxis, axis.set_xscale)
    axis.set_yticks(y, [TITLES[method] for method in methods])
    axis.set_ylim(-0.6, len(methods) - 0.4)
    axis.set_xlabel("mean square error [Nm²]")
    plain(axis)
    legend_above(figure, axis)
    return figure


def runs_figure(tables: ErrorTables, number: int) -> Any | None:
    """MSE of every run of one joint, by the MSE of its physics; None without runs."""
    runs = [row for (_, joint), row in tables.runs.items() if joint == number and row]
    if not runs:
        return None
    reference = "physics" if all("physics" in row for row in runs) else next(iter(runs[0]))
    runs.sort(key=lambda row: row[reference].mse_nm2)
    figure, (axis,) = new_figure(1, 2.9)
    for method in [m for m in TITLES if all(m in row for row in runs)]:
        style = STYLES[method]
        axis.plot(
            np.arange(1, len(runs) + 1),
            [row[method].mse_nm2 for row in runs],
            color=style.colour,
            marker=style.marker,
            markersize=4.5,
            linestyle=style.line,
            linewidth=0.8,
            label=TITLES[method],
        )
    plain_log(axis.yaxis, axis.set_yscale)
    axis.set_ylabel("MSE [Nm²]")
    axis.set_xlabel(f"runs, by the MSE of {TITLES[reference]}")
    axis.set_xticks(np.arange(1, len(runs) + 1) if len(runs) <= 30 else [])
    plain(axis)
    legend_above(figure, axis)
    return figure


def velocities_figure(tables: ErrorTables, number: int) -> Any | None:
    """RMSE of one joint by |velocity|; None without samples."""
    rows = tables.velocities.get(number, {})
    names = [name for k in range(len(VELOCITY_EDGES_RAD_S) - 1) if rows.get(name := bin_name(k))]
    if not names:
        return None
    figure, (axis,) = new_figure(1, 2.9)
    for method in [m for m in TITLES if all(m in rows[name] for name in names)]:
        style = STYLES[method]
        axis.plot(
            names,
            [rows[name][method].rmse_rated_percent for name in names],
            color=style.colour,
            marker=style.marker,
            markersize=4.5,
            linestyle=style.line,
            linewidth=1.2,
            label=TITLES[method],
        )
    plain_log(axis.yaxis, axis.set_yscale)
    axis.set_ylabel("RMSE [% of rated]")
    axis.set_xlabel("|velocity| [rad/s]")
    plain(axis)
    legend_above(figure, axis)
    return figure


def calibration_figure(tables: Mapping[str, IntervalTables]) -> Any | None:
    """Return how often the interval held the sensor against how often it should have; None without intervals."""
    if not tables:
        return None
    figure, (axis,) = new_figure(1, 3.6)
    axis.plot([40, 100], [40, 100], color=LIGHT["soft"], linewidth=1.0, label="ideal")
    looks = {"variable": "-", "constant": ":"}
    colours = [LIGHT[f"series_{k}"] for k in (5, 1, 4, 3)]
    numbers = sorted({number for table in tables.values() for number in table.joints})
    for kind, line in looks.items():
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
    hard = hardest_plateaus(result.plateaus)
    return {
        "plateaus": [_plateau(each) for each in result.plateaus],
        "speeds": [
            {"number": number, "drive": drive, "velocity_rad_s": speed, **_group(group, result.methods)}
            for number in numbers
            for (drive, speed), group in speed_groups(own[number]).items()
        ],
        "hardest": {
            "paper_percent": PAPER_WORST_PERCENT,
            "velocity_rad_s": WORST_VELOCITY_RAD_S,
            "torque_nm": WORST_TORQUE_NM,
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
            found = worst_plateau(group, method, size)
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
    """Return an indented table as lines."""
    return [f"  {line}" for line in table_lines([header, *rows])]


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
                drive: _svg(f"constant-{number}-{drive}", constant_figure, own[number], drive)
                for drive in ("forward", "back")
            }
            for number in numbers
        },
        "run": None if result.picture is None else _svg("run", run_figure, result.picture),
        "paper": _svg("paper", paper_figure, result.variable),
        "runs": {
            str(number): _svg(f"runs-{number}", runs_figure, result.variable, number) for number in numbers
        },
        "velocities": {
            str(number): _svg(f"velocities-{number}", velocities_figure, result.variable, number)
            for number in numbers
        },
        "calibration": _svg("calibration", calibration_figure, result.intervals),
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
