"""Report an efficiency fit: text, plain values, and the paper's Fig. 6 (measured eta and fitted surface per quadrant)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Final

import numpy as np

from jtqd.estimator.joint import CONVENTIONS, QUADRANTS, QuadrantPolynomial
from jtqd.sysid.fit.efficiency import (
    COEFFICIENTS,
    SAME_VELOCITY_RAD_S,
    TABLE_I,
    EfficiencyFit,
    EtaPoint,
    operating_points,
)
from jtqd.sysid.fit.plateaus import Mean, Plateau
from jtqd.sysid.report.figures import plain
from jtqd.sysid.runs.checks import RunIssue

SCHEMA: Final = "jtq.efficiency/1"
TITLES: Final = {
    "i_pos_w_pos": "i > 0, w > 0: driving",
    "i_neg_w_neg": "i < 0, w < 0: driving",
    "i_neg_w_pos": "i < 0, w > 0: back-driven",
    "i_pos_w_neg": "i > 0, w < 0: back-driven",
}


@dataclass(frozen=True)
class EfficiencyResult:
    """Result of one `jtq fit efficiency`; `fits` holds the one to be written first, then those for comparison."""

    joint: str
    number: int
    runs: Mapping[str, str]
    points: tuple[EtaPoint, ...]
    left_out: tuple[Plateau, ...]
    current_min_a: float
    fits: tuple[EfficiencyFit, ...]
    findings: tuple[RunIssue, ...]

    @property
    def temperature_c(self) -> float:
        """Mean over the plateaus, NaN where it was not measured."""
        known = [p.plateau.temperature_c for p in self.points if math.isfinite(p.plateau.temperature_c)]
        return float(np.mean(known)) if known else math.nan


def difference_from_table(
    points: Sequence[EtaPoint], name: str, polynomial: QuadrantPolynomial
) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Fitted minus Table I's eta (joint over motor) at the measured points of one quadrant, [n]."""
    own = [point for point in points if point.quadrant == name]
    table: QuadrantPolynomial = getattr(TABLE_I, name)
    pairs = zip(*(column.tolist() for column in operating_points(own)), strict=True)
    return np.array([polynomial.value(i, v) - table.value(i, v) for i, v in pairs])


def report_lines(result: EfficiencyResult) -> list[str]:
    """Return the report, ready to print."""
    lines = [
        f"{result.joint} (j{result.number}): {len(result.points)} plateaus in {len(result.runs)} runs"
        + ("" if math.isnan(result.temperature_c) else f", {result.temperature_c:.1f} degC on average")
    ]
    lines += [
        "",
        "measured eta (lowest to highest, with the largest standard error)",
        *_measured_lines(result),
    ]
    for fit in result.fits:
        lines += ["", *_summary_lines(fit)]
        if fit.weighted == result.fits[0].weighted:  # of the other weighting the figures are enough
            lines += _coefficient_lines(fit, result.points)
    if result.left_out:
        lines += [
            "",
            f"left out, {len(result.left_out)} plateaus with |i| < {result.current_min_a:.2f} A "
            "(the motor does not overcome its own friction, so eta is undefined):",
            *(f"  {_place(plateau)}" for plateau in result.left_out),
        ]
    if result.findings:
        lines += ["", "findings:", *(f"  {item.kind}: {item.text}" for item in result.findings)]
    return lines


def _measured_lines(result: EfficiencyResult) -> list[str]:
    lines = [f"  {'quadrant':<27}{'plateaus':>9}{'tau_j/(G Kt i)':>28}{'G Kt i/tau_j':>28}"]
    for name in QUADRANTS:
        own = [point for point in result.points if point.quadrant == name]
        cells = ""
        for convention in CONVENTIONS:
            etas = [point.eta(convention) for point in own]
            errors = [point.eta_se(convention) for point in own]
            text = f"{min(etas):.3f} to {max(etas):.3f} +- {max(errors):.3f}" if own else "none"
            cells += f"{text:>28}"
        lines.append(f"  {TITLES[name]:<27}{len(own):>9}{cells}")
    return lines


def _summary_lines(fit: EfficiencyFit) -> list[str]:
    """Return one line per quadrant; the paper's RMSE beside ours where the convention is Table I's."""
    beside = fit.convention == TABLE_I.convention
    kind = "weighted least squares" if fit.weighted else "least squares"
    paper = f"{'paper':>9}" if beside else ""
    lines = [
        f"Eq. (8) in the convention {fit.convention}, {kind}",
        f"  {'quadrant':<27}{'plateaus':>9}{'distinct':>10}{'RMSE':>9}{paper}{'RMSE Nm':>9}{'condition':>11}",
    ]
    for name, quadrant in fit.quadrants.items():
        table = f"{getattr(TABLE_I, name).rmse:>9.4f}" if beside else ""
        lines.append(
            f"  {TITLES[name]:<27}{quadrant.plateaus:>9}{quadrant.distinct:>10}{quadrant.rmse:>9.4f}{table}"
            f"{quadrant.rmse_nm:>9.3f}{quadrant.condition:>11.0f}"
        )
    return lines + [f"  {text}" for text in fit.refused.values()]


def _coefficient_lines(fit: EfficiencyFit, points: Sequence[EtaPoint]) -> list[str]:
    """Coefficients with standard errors, beside Table I where the convention is the table's."""
    beside = fit.convention == TABLE_I.convention
    lines = []
    for name, quadrant in fit.quadrants.items():
        lines.append(f"  {TITLES[name]}")
        table_header = f"{'Table I':>10}{'difference':>12}" if beside else ""
        lines.append(f"    {'':<4}{'fitted':>10}{'std err':>10}{table_header}")
        for key in COEFFICIENTS:
            value, table = getattr(quadrant.polynomial, key), getattr(getattr(TABLE_I, name), key)
            cells = f"{table:>10.4f}{value - table:>12.4f}" if beside else ""
            lines.append(f"    {key:<4}{value:>10.4f}{quadrant.errors[key]:>10.4f}{cells}")
        if beside:
            off = difference_from_table(points, name, quadrant.polynomial)
            lines.append(
                f"    eta against Table I at these points: {float(np.sqrt(np.mean(off**2))):.4f} RMS, "
                f"{float(np.max(np.abs(off))):.4f} at most"
            )
    return lines


def _place(plateau: Plateau) -> str:
    return (
        f"{plateau.run} {plateau.start_s:.2f} to {plateau.end_s:.2f} s: i = {plateau.current.value:.3f} A, "
        f"v = {plateau.velocity.value:.3f} rad/s, tau_j = {plateau.torque.value:.2f} Nm"
    )


def as_mapping(result: EfficiencyResult) -> dict[str, Any]:
    """Return the same for a program (schema jtq.efficiency/1)."""
    return {
        "schema": SCHEMA,
        "joint": result.joint,
        "number": result.number,
        "runs": dict(result.runs),
        "temperature_c": None if math.isnan(result.temperature_c) else result.temperature_c,
        "current_min_a": result.current_min_a,
        "fits": [_fit_mapping(fit, result.points) for fit in result.fits],
        "plateaus": [
            plateau_mapping(point.plateau)
            | {"quadrant": point.quadrant, "joint_over_motor": point.ratio, "joint_over_motor_se": point.se}
            for point in result.points
        ],
        "left_out": [plateau_mapping(plateau) for plateau in result.left_out],
        "findings": [item._asdict() for item in result.findings],
    }


def _fit_mapping(fit: EfficiencyFit, points: Sequence[EtaPoint]) -> dict[str, Any]:
    quadrants = {}
    for name, quadrant in fit.quadrants.items():
        entry = {item.name: getattr(quadrant, item.name) for item in fields(quadrant)} | {
            "polynomial": {key: getattr(quadrant.polynomial, key) for key in COEFFICIENTS},
            "errors": dict(quadrant.errors),
        }
        if fit.convention == TABLE_I.convention:
            off = difference_from_table(points, name, quadrant.polynomial)
            entry["paper_rmse"] = getattr(TABLE_I, name).rmse
            entry["table_i_rms"] = float(np.sqrt(np.mean(off**2)))
        quadrants[name] = entry
    return {
        "convention": fit.convention,
        "weighted": fit.weighted,
        "quadrants": quadrants,
        "refused": dict(fit.refused),
    }


def plateau_mapping(plateau: Plateau) -> dict[str, Any]:
    """Return one plateau as plain values; means as value and standard error, an unknown temperature as None."""
    out: dict[str, Any] = {}
    for item in fields(plateau):
        value = getattr(plateau, item.name)
        if isinstance(value, Mean):
            value = value._asdict()
        elif isinstance(value, float) and math.isnan(value):
            value = None
        out[item.name] = value
    return out


_RATIOS: Final = {"joint_over_motor": "τ_j / (G Kt i)", "motor_over_joint": "G Kt i / τ_j"}
MOST_CURVES: Final = 8
"""As many velocities as the paper has; of more, this many are drawn as curves, evenly chosen. Points are all drawn."""

_TICK: Final = 0.04
"""Of the bar's length: room of one velocity."""


def draw_fit(points: Sequence[EtaPoint], fit: EfficiencyFit, title: str, path: Path) -> None:
    """Draw the measured points and the fit to `path` (png, svg, pdf by its ending). Needs matplotlib."""
    import matplotlib as mpl

    mpl.use("Agg")  # files only; a display is not needed
    from matplotlib import pyplot as plt

    figure = fit_figure(points, fit, title)
    figure.savefig(path, dpi=100)
    plt.close(figure)


def fit_figure(points: Sequence[EtaPoint], fit: EfficiencyFit, title: str) -> Any:
    """Return the figure of `draw_fit`: a panel per quadrant, of two lines each above it."""
    import matplotlib as mpl
    from matplotlib import pyplot as plt

    speeds = [abs(point.plateau.velocity.value) for point in points]
    norm = mpl.colors.Normalize(0.0, max(speeds))
    colours = mpl.colors.LinearSegmentedColormap.from_list(
        "speed", plt.get_cmap("viridis")(np.linspace(0.0, 0.9, 64))
    )
    figure, axes = plt.subplots(2, 2, figsize=(12.0, 8.4), layout="constrained")
    for letter, name, axis in zip("abcd", QUADRANTS, axes.flat, strict=True):
        own = [point for point in points if point.quadrant == name]
        _panel(axis, own, fit, name, lambda speed: colours(norm(speed)))
        axis.set_title(f"({letter}) {_panel_title(fit, name, len(own))}", fontsize=10, loc="left")
        plain(axis)
    for axis in axes[1]:
        axis.set_xlabel("motor current i [A]")
    for axis in axes[:, 0]:
        axis.set_ylabel(f"η = {_RATIOS[fit.convention]}")
    bar = figure.colorbar(
        mpl.cm.ScalarMappable(norm, colours), ax=axes, label="|ω_m| / G [rad/s]", pad=0.015, aspect=40
    )
    groups = _groups(speeds)
    if float(np.min(np.diff([0.0, *groups]))) >= _TICK * max(groups):
        bar.set_ticks(groups, labels=[f"{speed:.1f}" for speed in groups])
    figure.suptitle(title, fontsize=13, x=0.01, ha="left")
    return figure


def _panel(axis: Any, points: Sequence[EtaPoint], fit: EfficiencyFit, name: str, colour: Any) -> None:
    """Points with error bars of two standard errors; curves over the currents measured at each velocity."""
    if not points:
        axis.text(0.5, 0.5, "no plateau", transform=axis.transAxes, ha="center", va="center", color="#777777")
        axis.set(xticks=[], yticks=[])
        return
    speeds = _groups([abs(point.plateau.velocity.value) for point in points])
    chosen = speeds
    if len(speeds) > MOST_CURVES:
        chosen = [speeds[k] for k in np.linspace(0, len(speeds) - 1, MOST_CURVES).round().astype(int)]
    for speed in speeds:
        own = [p for p in points if abs(abs(p.plateau.velocity.value) - speed) <= SAME_VELOCITY_RAD_S]
        current = np.array([p.plateau.current.value for p in own])
        shade = colour(speed)
        if speed in chosen and name in fit.quadrants:
            velocity = float(np.mean([p.plateau.velocity.value for p in own]))
            polynomial = fit.quadrants[name].polynomial
            along = np.linspace(current.min(), current.max(), 60)
            curve = [polynomial.value(i, velocity) for i in along.tolist()]
            axis.plot(along, curve, color=shade, linewidth=1.3, zorder=2)
        axis.errorbar(
            current,
            [p.eta(fit.convention) for p in own],
            yerr=[2.0 * p.eta_se(fit.convention) for p in own],
            fmt="o",
            color=shade,
            markeredgecolor="white",
            markeredgewidth=0.6,
            markersize=6.0,
            elinewidth=1.0,
            zorder=3,
        )


def _panel_title(fit: EfficiencyFit, name: str, count: int) -> str:
    text = TITLES[name].replace("w", "ω_m", 1)
    if name in fit.quadrants:
        paper = f" (paper {getattr(TABLE_I, name).rmse:.4f})" if fit.convention == TABLE_I.convention else ""
        return f"{text}\n{count} plateaus, RMSE {fit.quadrants[name].rmse:.4f}{paper}"
    return f"{text}\n{count} plateaus, not fitted"


def _groups(speeds: Sequence[float]) -> list[float]:
    """Distinct velocities, rising; each the mean of those that are the same within SAME_VELOCITY_RAD_S."""
    groups: list[list[float]] = []
    for speed in sorted(speeds):
        if groups and speed - groups[-1][0] <= SAME_VELOCITY_RAD_S:
            groups[-1].append(speed)
        else:
            groups.append([speed])
    return [float(np.mean(group)) for group in groups]
