"""Figures of the measured runs: estimate before and after beside the sensor, and the residual; offline and on the bus."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
from matplotlib import pyplot as plt

from jtqd.estimator.status import STALE, STANDSTILL
from jtqd.sysid.report import figures as parts

if TYPE_CHECKING:
    from validation.measured.bus import BusRun
    from validation.measured.offline import Case

mpl.use("Agg")  # files only; a display is not needed

SILENT = "#d9d9e6"
LABELS = {
    "before": (parts.BEFORE, "before: joint file as shipped"),
    "after": (parts.AFTER, "after: losses fitted on the other run"),
}


def draw_joint(cases: Sequence[Case], path: Path) -> None:
    """One column per run: torque above, estimate minus sensor below, standstill shaded; PNG at `path`."""
    figure, axes = plt.subplots(
        2, len(cases), figsize=(6.2 * len(cases), 6.4), sharex="col", squeeze=False, height_ratios=(3, 2)
    )
    for (above, below), case in zip(axes.T, cases, strict=True):
        time_s = case.time_s - case.time_s[0]
        lines = (
            (
                case.before_nm,
                parts.BEFORE,
                f"before: joint file as shipped, RMSE {case.before.rmse_nm:.2f} Nm",
            ),
            (
                case.after_nm,
                parts.AFTER,
                f"after: losses fitted on {case.fitted_on}, RMSE {case.after.rmse_nm:.2f} Nm",
            ),
        )
        for values, colour, label in lines:
            above.plot(time_s, values, color=colour, linewidth=0.9, label=label)
            below.plot(time_s, values - case.reference_nm, color=colour, linewidth=0.9)
        parts.sensor_line(above, time_s, case.reference_nm)
        parts.room_for_legend(above, 0.40)
        above.set_title(f"joint {case.joint}, {case.run}", fontsize=10)
        below.axhline(0.0, color=parts.SENSOR, linewidth=0.8)
        below.set_xlabel("time [s]")
        for axis in (above, below):
            parts.shade(
                axis, time_s, case.standstill, parts.STANDING, parts.STANDING_LABEL if axis is above else None
            )
            parts.plain(axis)
        parts.legend(above)
    axes[0][0].set_ylabel("joint torque [Nm]")
    axes[1][0].set_ylabel("estimate - sensor [Nm]")
    figure.tight_layout()
    figure.savefig(path, dpi=110, metadata={"Software": None})
    plt.close(figure)


def draw_bus_joint(results: Sequence[BusRun], path: Path) -> None:
    """One column per run: torque, estimate minus sensor, bus minus offline; PNG at `path`."""
    runs = list(dict.fromkeys(result.run for result in results))
    figure, axes = plt.subplots(
        3, len(runs), figsize=(6.2 * len(runs), 7.6), sharex="col", squeeze=False, height_ratios=(4, 3, 2)
    )
    for column, run in zip(axes.T, runs, strict=True):
        _column(column, [result for result in results if result.run == run])
    axes[0][0].set_ylabel("joint torque [Nm]")
    axes[1][0].set_ylabel("published - sensor [Nm]")
    axes[2][0].set_ylabel("published - offline [mNm]")
    figure.tight_layout()
    figure.savefig(path, dpi=110, metadata={"Software": None})
    plt.close(figure)


def _column(axes: Sequence[Any], results: Sequence[BusRun]) -> None:
    above, middle, below = axes
    for result in results:
        colour, label = LABELS[result.config]
        values, time_s = result.published_nm, result.time_s
        above.plot(
            time_s, values, color=colour, linewidth=0.9, label=f"{label}, RMSE {result.rmse_nm:.2f} Nm"
        )
        middle.plot(time_s, values - result.reference_nm, color=colour, linewidth=0.9)
        below.plot(time_s, 1e3 * (values - result.offline_nm), color=colour, linewidth=0.6)
    last = results[-1]
    parts.sensor_line(above, last.time_s, last.reference_nm)
    parts.room_for_legend(above, 0.50)
    above.set_title(f"joint {last.joint}, {last.run} on the bus", fontsize=10)
    below.set_xlabel("time since the first SYNC [s]")
    middle.axhline(0.0, color=parts.SENSOR, linewidth=0.8)
    below.axhline(0.0, color=parts.SENSOR, linewidth=0.8)
    shades = (
        (last.status == STANDSTILL, parts.STANDING, parts.STANDING_LABEL),
        (last.status == STALE, SILENT, "inputs missing: status stale, no torque published"),
    )
    for axis in axes:
        for where, colour, label in shades:
            parts.shade(axis, last.time_s, where, colour, label if axis is above and where.any() else None)
        parts.plain(axis)
    parts.legend(above)
