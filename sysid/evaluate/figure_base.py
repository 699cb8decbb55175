"""What the pictures of the evaluation have in common: styles of the methods, size, curves thinned, SVG as text."""

from __future__ import annotations

import io
import re
from typing import Any, Final, NamedTuple

import numpy as np

from estimator.friction import FloatArray
from sysid.evaluate.methods import OURS, PAPERS


class Style(NamedTuple):
    """Of one method in every picture; the first three as in the paper's figures."""

    colour: str
    line: str
    marker: str


STYLES: Final = {
    "tob": Style("#c0392b", "--", "v"),
    "efficiency": Style("#c98a00", ":", "s"),
    PAPERS: Style("#7d3c98", "-.", "D"),
    "physics": Style("#2e9e6b", (0, (5, 1)), "^"),  # type: ignore[arg-type]  # matplotlib's own dash pattern
    OURS: Style("#1565a7", "-", "o"),
}
WIDTH_IN: Final = 6.4
BUCKETS: Final = 700
"""Of a curve over time: each keeps its lowest and highest sample, so that no spike is lost."""


def new_figure(rows: int, height: float, **options: Any) -> tuple[Any, Any]:
    """Return figure and axes [rows] of the report's width."""
    import matplotlib as mpl

    mpl.use("Agg")  # no display is needed
    mpl.rcParams.update({"svg.fonttype": "none", "svg.hashsalt": "jtq evaluate", "font.size": 9.5})
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(
        rows, 1, figsize=(WIDTH_IN, height), layout="constrained", squeeze=False, **options
    )
    return figure, axes[:, 0]


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
