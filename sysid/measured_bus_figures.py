"""Figures of sysid.measured_bus: what jtqd published beside the sensor, the residual, and bus minus offline."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np

mpl.use("Agg")  # files only; a display is not needed
from matplotlib import pyplot as plt

from estimator.status import STALE, STANDSTILL
from sysid.measured_figures import AFTER, BEFORE, SENSOR, STANDING

if TYPE_CHECKING:
    from sysid.measured_bus_score import BusRun

SILENT = "#d9d9e6"
LABELS = {
    "before": (BEFORE, "before: joint file as shipped"),
    "after": (AFTER, "after: friction fitted on the other run"),
}


def draw_joint(results: Sequence["BusRun"], path: Path) -> None:
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


def _column(axes: Sequence[Any], results: Sequence["BusRun"]) -> None:
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
    above.plot(
        last.time_s,
        last.reference_nm,
        color=SENSOR,
        linewidth=1.4,
        label="torque sensor, filtered like the estimate",
    )
    low, high = above.get_ylim()
    above.set_ylim(low, high + 0.50 * (high - low))  # room for the legend above the curves
    above.set_title(f"joint {last.joint}, {last.run} on the bus", fontsize=10)
    below.set_xlabel("time since the first SYNC [s]")
    middle.axhline(0.0, color=SENSOR, linewidth=0.8)
    below.axhline(0.0, color=SENSOR, linewidth=0.8)
    shades = (
        (last.status == STANDSTILL, STANDING, "standstill: the estimate is the middle of an interval"),
        (last.status == STALE, SILENT, "inputs missing: status stale, no torque published"),
    )
    for axis in axes:
        for where, colour, label in shades:
            axis.fill_between(
                last.time_s,
                0.0,
                1.0,
                where=np.asarray(where),
                transform=axis.get_xaxis_transform(),
                color=colour,
                linewidth=0.0,
                label=label if axis is above and where.any() else None,
            )
        axis.grid(True, color="#dddddd", linewidth=0.6)
        axis.set_axisbelow(True)
        for side in ("top", "right"):
            axis.spines[side].set_visible(False)
    above.legend(loc="upper left", fontsize=8, framealpha=0.85, edgecolor="none")
