"""What the pictures of the evaluation have in common: styles of the methods, size, axes, legend."""

from __future__ import annotations

from typing import Any, Final, NamedTuple

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
