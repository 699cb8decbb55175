"""What the pictures of sysid have in common: shades, axes, legends, and doing without matplotlib."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

SENSOR, BEFORE, AFTER = "#222222", "#c8702a", "#2a78b8"
STANDING = "#e9e4da"
STANDING_LABEL = "standstill: the estimate is the middle of an interval"


def shade(
    axis: Any, time_s: npt.NDArray[np.float64], where: npt.NDArray[np.bool_], colour: str, label: str | None
) -> None:
    """Colour the whole height of the axis where `where` [n] is true; above the grid, below the curves."""
    axis.fill_between(
        time_s,
        0.0,
        1.0,
        where=where,
        transform=axis.get_xaxis_transform(),
        color=colour,
        linewidth=0.0,
        zorder=0.6,  # over the grid, below every curve and band
        label=label,
    )


def sensor_line(axis: Any, time_s: npt.NDArray[np.float64], reference_nm: npt.NDArray[np.float64]) -> None:
    """The reference of a measured run, over the estimates."""
    axis.plot(
        time_s, reference_nm, color=SENSOR, linewidth=1.4, label="torque sensor, filtered like the estimate"
    )


def room_for_legend(axis: Any, share: float) -> None:
    """Leave a share of the height above the curves."""
    low, high = axis.get_ylim()
    axis.set_ylim(low, high + share * (high - low))


def plain(axis: Any) -> None:
    """Light grid, no frame above and on the right."""
    axis.grid(True, color="#dddddd", linewidth=0.6)
    axis.set_axisbelow(True)
    for side in ("top", "right"):
        axis.spines[side].set_visible(False)


def legend(axis: Any) -> None:
    """Legend at the upper left; the curves shine through."""
    axis.legend(loc="upper left", fontsize=8, framealpha=0.85, edgecolor="none")


def draw_each_joint(
    joints: Sequence[int],
    results: Sequence[Any],
    pattern: Path,
    load: Callable[[], Callable[[Sequence[Any], Path], None]],
) -> None:
    """One picture per joint, said on stderr; without matplotlib only that is said.

    Args:
        joints: their numbers.
        results: each with the attribute `joint`.
        pattern: path of the pictures, "{}" standing for the joint's number.
        load: imports and returns the function that draws one joint's results.
    """
    try:
        draw_joint = load()
    except ImportError:
        print(
            "measured: no figures: matplotlib is not installed (it is in the extras 'dev' and 'train')",
            file=sys.stderr,
        )
        return
    for number in joints:
        path = pattern.with_name(pattern.name.format(number))
        draw_joint([result for result in results if result.joint == number], path)
        print(f"measured: wrote {path}", file=sys.stderr)
