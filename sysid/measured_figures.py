"""Figures of sysid.measured: estimate before and after beside the sensor, the residual of both below."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib as mpl

mpl.use("Agg")  # files only; a display is not needed
from matplotlib import pyplot as plt

from sysid import figure_parts as parts

if TYPE_CHECKING:
    from sysid.measured import Case


def draw_joint(cases: Sequence["Case"], path: Path) -> None:
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
                f"after: friction fitted on {case.fitted_on}, RMSE {case.after.rmse_nm:.2f} Nm",
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
