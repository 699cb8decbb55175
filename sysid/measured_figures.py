"""Figures of sysid.measured: estimate before and after beside the sensor, the residual of both below."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib as mpl

mpl.use("Agg")  # files only; a display is not needed
from matplotlib import pyplot as plt

if TYPE_CHECKING:
    from sysid.measured import Case

SENSOR, BEFORE, AFTER = "#222222", "#c8702a", "#2a78b8"
STANDING = "#e9e4da"


def draw_joint(cases: Sequence["Case"], path: Path) -> None:
    """One column per run: torque above, estimate minus sensor below, standstill shaded; PNG at `path`."""
    figure, axes = plt.subplots(
        2, len(cases), figsize=(6.2 * len(cases), 6.4), sharex="col", squeeze=False, height_ratios=(3, 2)
    )
    for (above, below), case in zip(axes.T, cases, strict=True):
        time_s = case.time_s - case.time_s[0]
        lines = (
            (case.before_nm, BEFORE, f"before: joint file as shipped, RMSE {case.before.rmse_nm:.2f} Nm"),
            (
                case.after_nm,
                AFTER,
                f"after: friction fitted on {case.fitted_on}, RMSE {case.after.rmse_nm:.2f} Nm",
            ),
        )
        for values, colour, label in lines:
            above.plot(time_s, values, color=colour, linewidth=0.9, label=label)
            below.plot(time_s, values - case.reference_nm, color=colour, linewidth=0.9)
        above.plot(
            time_s,
            case.reference_nm,
            color=SENSOR,
            linewidth=1.4,
            label="torque sensor, filtered like the estimate",
        )
        low, high = above.get_ylim()
        above.set_ylim(low, high + 0.40 * (high - low))  # room for the legend above the curves
        above.set_title(f"joint {case.joint}, {case.run}", fontsize=10)
        below.axhline(0.0, color=SENSOR, linewidth=0.8)
        below.set_xlabel("time [s]")
        for axis in (above, below):
            axis.fill_between(
                time_s,
                0.0,
                1.0,
                where=case.standstill,
                transform=axis.get_xaxis_transform(),
                color=STANDING,
                linewidth=0.0,
                label="standstill: the estimate is the middle of an interval" if axis is above else None,
            )
            axis.grid(True, color="#dddddd", linewidth=0.6)
            axis.set_axisbelow(True)
            for side in ("top", "right"):
                axis.spines[side].set_visible(False)
        above.legend(loc="upper left", fontsize=8, framealpha=0.85, edgecolor="none")
    axes[0][0].set_ylabel("joint torque [Nm]")
    axes[1][0].set_ylabel("estimate - sensor [Nm]")
    figure.tight_layout()
    figure.savefig(path, dpi=110, metadata={"Software": None})
    plt.close(figure)
