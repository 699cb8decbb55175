"""Base template, colours and figures of every HTML report: one self-contained file, light and dark."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.command_line import check_output
from jtqd.estimator.errors import ConfigError

LIGHT: Final = {
    "paper": "#ffffff",
    "panel": "#f4f6f9",
    "ink": "#1b2430",
    "soft": "#556070",
    "line": "#d5dbe3",
    "before": "#b5541a",
    "after": "#1a6cb0",
    "noise": "#dfe4ea",
    "good": "#17774a",
    "bad": "#b02a20",
    "warn": "#8a5b00",
    "series_1": "#c0392b",
    "series_2": "#9a6a00",
    "series_3": "#7d3c98",
    "series_4": "#1f7a50",
    "series_5": "#1565a7",
}
DARK: Final = {
    "paper": "#12161c",
    "panel": "#1b212a",
    "ink": "#e7ebf1",
    "soft": "#a5b0be",
    "line": "#333c48",
    "before": "#ec9f62",
    "after": "#6ab2f2",
    "noise": "#2a323d",
    "good": "#63cd96",
    "bad": "#ff8d82",
    "warn": "#e5b64c",
    "series_1": "#ff8677",
    "series_2": "#e0b040",
    "series_3": "#c99be0",
    "series_4": "#5fc793",
    "series_5": "#72b4f0",
}


def render(
    package: str,
    template: str,
    content: Mapping[str, Any],
    filters: Mapping[str, Callable[..., Any]] | None = None,
) -> str:
    """Return the HTML page of a template (its file name, in a package) that extends "base.html.j2".

    content: variables of the template; `made`, when and by what the page was made, goes to its foot. Raises ImportError
    without jinja2, jinja2.UndefinedError for a variable that `content` does not have.
    """
    from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=ChoiceLoader([PackageLoader(each, ".") for each in (package, "jtqd.sysid.report")]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(filters or {})
    light, dark = (
        " ".join(f"--{role}: {colour};" for role, colour in colours.items()) for colours in (LIGHT, DARK)
    )
    return f"{environment.get_template(template).render(light=light, dark=dark, **content)}\n"


SENSOR, BEFORE, AFTER = LIGHT["ink"], LIGHT["before"], LIGHT["after"]
STANDING, GRID = LIGHT["noise"], LIGHT["line"]
PICTURES: Final = (".png", ".svg", ".pdf", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".eps", ".ps")
"""Endings of the pictures that a command writes."""
BUCKETS = 700
"""Of a curve over time: each keeps its lowest and highest sample, so that no spike is lost."""
STYLE: Final[dict[str, Any]] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "jtqd",
    "font.size": 9.5,
    "text.color": LIGHT["ink"],
    "axes.labelcolor": LIGHT["soft"],
    "axes.edgecolor": LIGHT["line"],
    "xtick.color": LIGHT["soft"],
    "ytick.color": LIGHT["soft"],
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": LIGHT["line"],
    "grid.linewidth": 0.5,
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "savefig.facecolor": "none",
    "legend.facecolor": LIGHT["paper"],
}
"""matplotlib settings of the figures of a page."""


def check_picture(path: Path) -> None:
    """Refuse a picture that cannot be written before the work for it is done. Raises ConfigError."""
    if path.suffix.lower() not in PICTURES:
        raise ConfigError(
            f"{path}: found {f'the ending {path.suffix!r}' if path.suffix else 'no ending'}, expected a picture: "
            f"{', '.join(PICTURES)}"
        )
    check_output(path)


def page_svg(draw: Callable[[], Any], name: str) -> str:
    """Return a figure as SVG for a page: its colours are the page's, its ids begin with `name`; "" without a figure.

    draw: makes the matplotlib figure, in colours of `LIGHT` and with the settings `STYLE`, or returns None. name: unique on
    the page. Raises ImportError without matplotlib.
    """
    import matplotlib as mpl

    mpl.use("Agg")  # no display is needed
    with mpl.rc_context(STYLE):
        figure = draw()
        return "" if figure is None else _compact(_with_roles(_with_prefix(as_svg(figure), name)))


def _with_roles(svg: str) -> str:
    """Replace the light colours by references to their roles, so that the figure follows the page."""
    roles = {colour: role for role, colour in LIGHT.items()}
    return re.sub(
        r"#[0-9a-f]{6}\b",
        lambda m: f"var(--{roles[m[0].lower()]})" if m[0].lower() in roles else m[0],
        svg,
        flags=re.IGNORECASE,
    )


def _with_prefix(svg: str, prefix: str) -> str:
    """Make the ids of a figure unique on its page."""
    svg = re.sub(r'\bid="', f'id="{prefix}-', svg)
    return re.sub(r'(url\(#|href="#)', rf"\1{prefix}-", svg)


def _compact(svg: str) -> str:
    """Use the page's font, and coordinates of a tenth of a unit: a third of the size."""
    svg = re.sub(r"font: (?:[a-z]+ )?([\d.]+px) [^;\"]*", r"font-size: \1", svg)
    return re.sub(r' d="[^"]*"', lambda path: re.sub(r"(\d+\.\d)\d+", r"\1", path[0]), svg)


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


def plain(axis: Any) -> None:
    """Light grid, no frame above and on the right."""
    axis.grid(True, color=GRID, linewidth=0.6)
    axis.set_axisbelow(True)
    for side in ("top", "right"):
        axis.spines[side].set_visible(False)


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
