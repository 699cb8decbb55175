"""Picture of the accuracy card: error and coverage by speed, load and temperature, and the map of speed and load.

Each function returns a matplotlib figure in the colours of `sysid.report.page.LIGHT`.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from jtqd.sysid.evaluate.card import Bin, Card
from jtqd.sysid.evaluate.scores import NOMINAL
from jtqd.sysid.report.figures import STYLE, plain
from jtqd.sysid.report.page import LIGHT

WIDTH_IN: Final = 10.0
_KNOWN, _LITTLE = LIGHT["after"], LIGHT["noise"]
_LINE_CHARACTERS: Final = 132


def card_figure(card: Card) -> Any:
    """Return the four panels."""
    from matplotlib import pyplot as plt

    figure = plt.figure(figsize=(WIDTH_IN, 6.4), layout="constrained")
    _panels(figure, card)
    return figure


def write_png(card: Card, path: Path) -> None:
    """Write the whole card as one picture: figures in words, panels, what to measure next. Needs matplotlib."""
    import matplotlib as mpl

    mpl.use("Agg")  # files only; a display is not needed
    from matplotlib import pyplot as plt

    lines = [
        line
        for advice in card.advice
        for line in textwrap.wrap(
            advice.text, _LINE_CHARACTERS, initial_indent="•  ", subsequent_indent="    "
        )
    ]
    head, foot = 1.1, 0.45 + 0.19 * max(1, len(lines))
    with mpl.rc_context(STYLE | {"savefig.facecolor": LIGHT["paper"]}):
        figure = plt.figure(figsize=(WIDTH_IN, 6.4 + head + foot), layout="constrained")
        above, panels, below = figure.subfigures(3, 1, height_ratios=(head, 6.4, foot))
        _panels(panels, card)
        above.text(0.012, 0.86, f"Accuracy of {card.joint}", fontsize=15, weight="bold", va="top")
        above.text(0.012, 0.56, f"method {card.method}; {source(card)}", color=LIGHT["soft"], va="top")
        for place, (title, value, more) in enumerate(tiles(card)):
            x = 0.012 + 0.245 * place
            above.text(x, 0.34, f"{title}: {value}", weight="bold", va="top")
            above.text(x, 0.16, more, color=LIGHT["soft"], va="top", fontsize=8.5)
        top = 1.0 - 0.12 / foot
        below.text(0.012, top, "What to measure next", fontsize=11, weight="bold", va="top")
        below.text(
            0.012,
            top - 0.24 / foot,
            "\n".join(lines) or "Nothing: every speed, load and temperature was measured.",
            va="top",
            linespacing=1.35,
        )
        figure.savefig(path, dpi=110)
        plt.close(figure)


def source(card: Card) -> str:
    """Return what the card was made from."""
    runs = "1 run" if card.runs == 1 else f"{card.runs} runs"
    return f"{runs}, {card.seconds:.0f} s in motion, joint {card.number}, rated torque {card.rated_nm:g} Nm"


def tiles(card: Card) -> list[tuple[str, str, str]]:
    """Return title, figure and explanation of what is known in one number."""
    interval = card.interval
    se = f" ± {100.0 * interval.se:.0f}" if math.isfinite(interval.se) else ""
    beside = "" if card.baseline is None else f"classical TOB {card.baseline.rmse_nm:.2g} Nm"
    standing = card.standstill.coverage.get(card.method)
    return [
        (
            "RMSE",
            f"{card.error.rmse_nm:.2g} Nm",
            ", ".join(filter(None, (f"{card.error.rmse_rated_percent:.2g} % of rated", beside))),
        ),
        ("95 % of errors", f"below {card.error.p95_nm:.2g} Nm", f"largest {card.error.max_nm:.2g} Nm"),
        (
            "90 % interval",
            f"holds {100.0 * interval.share:.0f}{se} %",
            "of the sensor in motion, its zero added",
        ),
        (
            "Standstill",
            "not measured" if standing is None else f"holds {100.0 * standing.share:.0f} %",
            ""
            if standing is None
            else f"half width {card.standstill.half_width_nm[card.method]:.2g} Nm on average",
        ),
    ]


def _panels(figure: Any, card: Card) -> None:
    left, right = figure.subfigures(1, 2)
    upper_left, lower_left = left.subfigures(2, 1)
    upper_right, lower_right = right.subfigures(2, 1)
    top = 1.12 * max(
        (
            value
            for each in (*card.speed, *card.load, *card.temperature)
            if each.error is not None
            for value in (each.error.rmse_nm, *each.by_run_nm)
        ),
        default=1.0,
    )
    _panel(upper_left, card.speed, top, "speed |v| [rad/s]", lambda edge: f"{edge:g}")
    _panel(
        upper_right,
        card.load,
        top,
        "torque along the motion [% of rated], negative: load drives",
        lambda edge: f"{100.0 * edge:.0f}",
    )
    _panel(lower_left, card.temperature, top, "temperature [°C]", lambda edge: f"{edge:g}")
    _map(lower_right, card)


def _panel(figure: Any, bins: Sequence[Bin], top: float, label: str, name: Callable[[float], str]) -> None:
    """RMSE of each bin as a bar, of each run as a dot; below, the coverage of the interval."""
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2.6, 1.0))
    for axis in (upper, lower):
        plain(axis)
        axis.grid(visible=False, axis="x")
    if not bins:
        upper.text(0.5, 0.5, "not measured", transform=upper.transAxes, ha="center", color=LIGHT["soft"])
        lower.set_xticks([])
    for place, each in enumerate(bins):
        if each.error is None:
            upper.text(
                place + 0.5, 0.02 * top, "no data", ha="center", va="bottom", color=LIGHT["soft"], fontsize=8
            )
            continue
        upper.bar(
            place + 0.5,
            each.error.rmse_nm,
            0.8,
            color=_KNOWN if each.known else _LITTLE,
            alpha=0.75 if each.known else 1.0,
        )
        spread = np.linspace(-0.25, 0.25, len(each.by_run_nm)) if len(each.by_run_nm) > 1 else np.zeros(1)
        upper.plot(
            place + 0.5 + spread, each.by_run_nm, "o", color=LIGHT["ink"], markersize=2.0, linestyle="none"
        )
        if each.interval is not None:
            error = 100.0 * each.interval.se if math.isfinite(each.interval.se) else 0.0
            lower.errorbar(
                place + 0.5,
                100.0 * each.interval.share,
                yerr=error,
                fmt="o",
                color=_KNOWN if each.known else LIGHT["soft"],
                markersize=4.0,
                elinewidth=1.2,
            )
    if bins:
        lower.set_xticks(
            range(len(bins) + 1), [name(edge) for edge in (*(each.low for each in bins), bins[-1].high)]
        )
        lower.set_xlim(0, len(bins))
    lower.axhline(100.0 * NOMINAL, color=LIGHT["soft"], linewidth=0.8, linestyle="--")
    lower.set_ylim(0.0, 105.0)
    lower.set_yticks([0, 50, 90], ["0", "50", "90 %"])
    lower.set_ylabel("in 90 %\ninterval")
    lower.set_xlabel(label)
    upper.set_ylim(0.0, top)
    upper.set_ylabel("RMSE [Nm]")


def _map(figure: Any, card: Card) -> None:
    """RMSE of each combination of speed and load; pale where one run or less than a second is all there is."""
    axis = figure.subplots(1, 1)
    most = max(
        (cell.error.rmse_nm for row in card.cells for cell in row if cell.known and cell.error is not None),
        default=1.0,
    )
    for y, row in enumerate(card.cells):
        for x, cell in enumerate(row):
            if cell.error is None:
                continue
            share = min(1.0, cell.error.rmse_nm / most)
            axis.bar(
                x + 0.5,
                0.94,
                0.94,
                bottom=y + 0.03,
                color=_KNOWN if cell.known else _LITTLE,
                alpha=0.12 + 0.63 * share if cell.known else 0.6,
                linewidth=0,
            )
            axis.text(
                x + 0.5,
                y + 0.48,
                f"{cell.error.rmse_nm:.2f}" if cell.error.rmse_nm < 9.995 else f"{cell.error.rmse_nm:.0f}",
                ha="center",
                va="center",
                fontsize=7.5,
                color=LIGHT["ink"] if cell.known else LIGHT["soft"],
            )
    axis.set_xlim(0, len(card.speed))
    axis.set_ylim(0, len(card.load))
    axis.set_xticks(
        range(len(card.speed) + 1),
        [f"{edge:g}" for edge in (*(b.low for b in card.speed), card.speed[-1].high)],
    )
    axis.set_yticks(
        range(len(card.load) + 1),
        [f"{100.0 * edge:.0f}" for edge in (*(b.low for b in card.load), card.load[-1].high)],
    )
    axis.grid(visible=False)
    axis.set_xlabel("speed |v| [rad/s]; in the cells: RMSE [Nm]")
    axis.set_ylabel("torque along the motion [% of rated]")
