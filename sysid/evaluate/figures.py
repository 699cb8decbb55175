"""Figures of the evaluation: the paper's Figs. 14 and 16 with our data, errors by run and velocity, calibration.

Each function returns a matplotlib figure in the colours of `sysid.report.page.LIGHT`, None where there is nothing to draw.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from jtqd.estimator.fusion import GAUSS
from jtqd.sysid.evaluate.constant import PlateauScore
from jtqd.sysid.evaluate.methods import OURS, PAPERS, TITLES, Samples
from jtqd.sysid.evaluate.scores import (
    LEVELS,
    PAPER_MSE_NM2,
    VELOCITY_EDGES_RAD_S,
    ErrorTables,
    IntervalTables,
    bin_name,
    common_methods,
)
from jtqd.sysid.report.figures import SENSOR, STANDING, plain, shade, thinned
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
