"""Figures of sysid.measured_diagnosis: what the simulation leaves over in time, and over the load."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import matplotlib as mpl

mpl.use("Agg")  # files only; a display is not needed
import numpy as np
from matplotlib import pyplot as plt

from sysid import figure_parts as parts

if TYPE_CHECKING:
    from sysid.measured_diagnosis import Diagnosed

_RUN_COLOURS: Final = ("#7a4fa3", "#2a8a5a")
_COLUMNS: Final = 3
_SLOW_RAD_S: Final = 0.03
"""Below it the direction of friction is not known, and the residual is not the model's fault."""


def draw_residuals(results: Sequence[Diagnosed], path: Path) -> None:
    """One row per joint that has traces, one column per run: residual of the motor balance over time, before and after."""
    rows = [one for one in results if _traces(one)]
    runs = list(dict.fromkeys(trace.run for one in rows for trace in _traces(one)))
    figure, axes = plt.subplots(
        max(len(rows), 1),
        max(len(runs), 1),
        figsize=(5.6 * max(len(runs), 1), 1.7 * max(len(rows), 1)),
        squeeze=False,
    )
    for line, one in zip(axes, rows, strict=False):
        for axis, run in zip(line, runs, strict=True):
            parts.plain(axis)
            trace = next((t for t in _traces(one) if t.run == run), None)
            if trace is None:
                axis.text(0.5, 0.5, "no usable sensor", transform=axis.transAxes, ha="center", fontsize=8)
                continue
            axis.plot(trace.time_s, trace.before_nm, color=parts.BEFORE, linewidth=0.9, label="before")
            if one.findings.causes:
                axis.plot(trace.time_s, trace.after_nm, color=parts.AFTER, linewidth=0.9, label="after")
            axis.axhline(0.0, color=parts.SENSOR, linewidth=0.8)
            axis.set_title(f"joint {one.number}, {run}: {one.findings.verdict}", fontsize=9)
        line[0].set_ylabel("residual [Nm]")
    if rows:
        parts.legend(axes[0][0])
        for axis in axes[-1]:
            axis.set_xlabel("time [s]")
    _save(figure, path)


def draw_loads(results: Sequence[Diagnosed], path: Path) -> None:
    """One panel per joint: residual times the direction of motion over the load along the motion, before anything is added.

    Coulomb and viscous friction that are right leave zero; a loss that grows with the load makes a V, a wrong torque
    constant a straight line through zero.
    """
    shown = [one for one in results if _traces(one)]
    count = max(len(shown), 1)
    lines = -(-count // _COLUMNS)
    figure, axes = plt.subplots(lines, _COLUMNS, figsize=(3.4 * _COLUMNS, 2.9 * lines), squeeze=False)
    for axis in axes.flat[len(shown) :]:
        axis.set_visible(False)
    for axis, one in zip(axes.flat, shown, strict=False):
        parts.plain(axis)
        for colour, trace in zip(_RUN_COLOURS, _traces(one), strict=False):
            s = np.sign(trace.velocity_rad_s)
            moving = (np.abs(trace.velocity_rad_s) > _SLOW_RAD_S) & np.isfinite(trace.before_nm)
            axis.plot(
                (trace.torque_nm * s)[moving],
                (trace.before_nm * s)[moving],
                ".",
                color=colour,
                markersize=2.5,
                label=trace.run,
            )
        axis.axhline(0.0, color=parts.SENSOR, linewidth=0.8)
        axis.set_title(f"joint {one.number}", fontsize=9)
        axis.set_xlabel("load along the motion [Nm]")
    for line in axes:
        line[0].set_ylabel("loss missed [Nm]")
    if shown:
        parts.legend(axes[0][0])
    _save(figure, path)


def _traces(one: Diagnosed) -> list[Any]:
    return [trace for trace in one.findings.traces if trace.balance == "motor" and trace.joint == one.number]


def _save(figure: Any, path: Path) -> None:
    figure.tight_layout()
    figure.savefig(path, dpi=110, metadata={"Software": None})
    plt.close(figure)
