"""What the pictures of sysid have in common: shades, axes, legends, thinning, SVG as text, doing without matplotlib."""

from __future__ import annotations

import io
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from jtqd.estimator.arrays import FloatArray

SENSOR, BEFORE, AFTER = "#222222", "#c8702a", "#2a78b8"
STANDING = "#e9e4da"
BUCKETS = 700
"""Of a curve over time: each keeps its lowest and highest sample, so that no spike is lost."""
STANDING_LABEL = "standstill: the estimate is the middle of an interval"


def shade(
    axis: Any, time_s: FloatArray, where: npt.NDArray[np.bool_], colour: str, label: str | None
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


def sensor_line(axis: Any, time_s: FloatArray, reference_nm: FloatArray) -> None:
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


def as_svg(figure: Any) -> str:
    """Return the figure as an SVG element without size of its own, and close it. The same figure gives the same text."""
    from matplotlib import pyplot as plt

    stream = io.StringIO()
    figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None})
    plt.close(figure)
    text = stream.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    return re.sub(
        r'(<svg[^>]*?) height="[^"]*"([^>]*?) width="[^"]*"|(<svg[^>]*?) width="[^"]*"([^>]*?) height="[^"]*"',
        r"\1\2\3\4",
        text,
        count=1,
    )


def thinned(time_s: FloatArray, values: FloatArray, buckets: int = BUCKETS) -> tuple[FloatArray, FloatArray]:
    """Return a curve of at most 2 `buckets` points: of each bucket its lowest and its highest sample, in order of time.

    A bucket that holds a NaN keeps one, so that gaps stay gaps.
    """
    size = -(-len(values) // buckets)
    if size <= 2:
        return time_s, values
    kept: list[int] = []
    for start in range(0, len(values), size):
        part = values[start : start + size]
        gap = np.flatnonzero(np.isnan(part))
        if len(gap) == len(part):
            ends = {0}
        elif len(gap):
            ends = {int(np.nanargmin(part)), int(np.nanargmax(part)), int(gap[0])}
        else:
            ends = {int(np.argmin(part)), int(np.argmax(part))}
        kept += [start + k for k in sorted(ends)]
    return time_s[kept], values[kept]


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
