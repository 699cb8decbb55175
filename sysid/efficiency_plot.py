"""The paper's Fig. 6 of one fit: measured eta and the fitted surface, one panel per quadrant, one curve per velocity."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from estimator.paper import TABLE_I
from estimator.parameters import QUADRANTS
from sysid.efficiency_fit import SAME_VELOCITY_RAD_S, EfficiencyFit, EtaPoint
from sysid.efficiency_report import TITLES
from sysid.figure_parts import plain

_RATIOS: Final = {"joint_over_motor": "τ_j / (G Kt i)", "motor_over_joint": "G Kt i / τ_j"}
MOST_CURVES: Final = 8
"""As many velocities as the paper has; of more, this many are drawn as curves, evenly chosen. Points are all drawn."""


def draw_fit(points: Sequence[EtaPoint], fit: EfficiencyFit, title: str, path: Path) -> None:
    """Draw the measured points and the fit to `path` (png, svg, pdf by its ending). Needs matplotlib."""
    import matplotlib as mpl

    mpl.use("Agg")  # files only; a display is not needed
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
    if len(groups) <= 2 * MOST_CURVES:
        bar.set_ticks(groups, labels=[f"{speed:.1f}" for speed in groups])
    figure.suptitle(title, fontsize=13, x=0.01, ha="left")
    figure.savefig(path, dpi=100)
    plt.close(figure)


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
        return f"{text}; {count} plateaus, RMSE {fit.quadrants[name].rmse:.4f}{paper}"
    return f"{text}; {count} plateaus, not fitted"


def _groups(speeds: Sequence[float]) -> list[float]:
    """Distinct velocities, rising; each the mean of those that are the same within SAME_VELOCITY_RAD_S."""
    groups: list[list[float]] = []
    for speed in sorted(speeds):
        if groups and speed - groups[-1][0] <= SAME_VELOCITY_RAD_S:
            groups[-1].append(speed)
        else:
            groups.append([speed])
    return [float(np.mean(group)) for group in groups]
