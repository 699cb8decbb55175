"""Accuracy card: one method of one joint on held-out runs by speed, load and temperature, and what to measure next.

Speed is |v| of the joint; load is the sensor's torque along the motion, tau sign(v), in parts of rated torque: positive
where the motor drives the load, negative where the load drives the motor. A bin is `known` with at least two runs and 0.2 s
of data: one run is one offset of the sensor and one temperature.

Share of the offsets (`zeros`): mean square of a run's mean error over that of all errors. What is constant within a run is
no function of speed or load, and no fit removes it.

The card is a page, a picture, values for programs (schema jtq.accuracy/1) and lines for a terminal.
"""

from __future__ import annotations

import itertools
import math
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.estimator.decoder import plain_values
from jtqd.estimator.files import whole_file
from jtqd.estimator.joint import Joint
from jtqd.estimator.text import counted
from jtqd.sysid.evaluate.inputs import OURS, TITLES, JointModels, Samples
from jtqd.sysid.evaluate.report import indented_table
from jtqd.sysid.evaluate.scores import (
    NOMINAL,
    Coverage,
    Score,
    Standstill,
    covered,
    for_intervals,
    score,
    standstill,
)
from jtqd.sysid.report import page
from jtqd.sysid.report.page import LIGHT, STYLE, page_svg, plain
from jtqd.sysid.runs.channels import RunIssue

SCHEMA: Final = "jtq.accuracy/1"
BASELINE: Final = "tob"
LOAD_STEP: Final = 0.25
"""Of rated torque."""
TEMPERATURE_STEP_K: Final = 5.0
SPEED_BINS: Final = 6
ENOUGH_RUNS: Final = 2
ENOUGH_S: Final = 0.2
RUNS_FOR_INTERVAL: Final = 10
WARM_K: Final = 10.0
"""Range of temperature from which on its influence can be seen."""
PLACE: Final = 1.5
"""RMSE of a bin over that of all samples, from which on the bin is named."""
ZEROS: Final = 0.5
COVERAGE_OFF: Final = 0.03
"""Besides two standard errors."""
_UNLIMITED: Final = 1e6
"""Default of `MotionLimits`."""
_SERIES: Final = tuple(m * 10.0**p for p in range(-4, 4) for m in (1.0, 2.0, 5.0))


@dataclass(frozen=True)
class Bin:
    """From `low` to `high`: seconds and runs of data; score, RMSE of each run [Nm] and coverage of the 90 % interval.

    known: whether the figures are of the joint and not of one run.
    """

    low: float
    high: float
    seconds: float
    runs: int
    error: Score | None
    by_run_nm: tuple[float, ...]
    interval: Coverage | None
    known: bool = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "known", self.runs >= ENOUGH_RUNS and self.seconds >= ENOUGH_S)


class Axis(NamedTuple):
    """What errors are sorted by: field of `Card`, value of samples [n], label of a picture, an edge and a bin in words."""

    name: str
    value: Callable[[Samples], FloatArray]
    label: str
    edge: Callable[[float], str]
    place: Callable[[float, float], str]


def load_name(low: float, high: float) -> str:
    """Return a bin of load in words: "50 to 75 % of rated torque, load drives"."""
    ends = sorted((abs(low), abs(high)))
    return f"{100.0 * ends[0]:.0f} to {100.0 * ends[1]:.0f} % of rated torque, {'motor' if high > 0.0 else 'load'} drives"


_ALONG: Final = "torque along the motion [% of rated]"
SPEED: Final = Axis(
    "speed",
    lambda each: np.abs(each.velocity_rad_s),
    "speed |v| [rad/s]",
    "{:g}".format,
    "{:g} to {:g} rad/s".format,
)
LOAD: Final = Axis(
    "load",
    lambda each: each.sensor_nm * np.sign(each.velocity_rad_s) / each.rated_nm,
    f"{_ALONG}, negative: load drives",
    lambda edge: f"{100.0 * edge:.0f}",
    load_name,
)
TEMPERATURE: Final = Axis(
    "temperature",
    lambda each: each.temperature_c,
    "temperature [°C]",
    "{:g}".format,
    "{:g} to {:g} °C".format,
)
AXES: Final = (SPEED, LOAD, TEMPERATURE)


@dataclass(frozen=True)
class Advice:
    """What to measure or do next, and why; `key` for programs."""

    key: str
    text: str


@dataclass(frozen=True)
class Card:
    """Everything on the card of one joint.

    speed [rad/s], load [parts of rated torque], temperature [degC]: bins; empty where it was not measured. cells: by load
    (rows, as `load`) and speed (columns, as `speed`). baseline: score of the classical TOB on the same samples, None where
    that is the method. mean_nm: standard deviation of the runs' mean errors; zeros: their share of the mean square.
    limit_rad_s: highest speed that counts; given: whether it is that of the joint file's motion_limits.
    """

    number: int
    joint: str
    rated_nm: float
    method: str
    runs: int
    seconds: float
    error: Score
    baseline: Score | None
    mean_nm: float
    zeros: float
    interval: Coverage
    standstill: Standstill
    speed: tuple[Bin, ...]
    load: tuple[Bin, ...]
    temperature: tuple[Bin, ...]
    cells: tuple[tuple[Bin, ...], ...]
    limit_rad_s: float
    given: bool
    advice: tuple[Advice, ...] = ()

    def bins(self, axis: Axis) -> tuple[Bin, ...]:
        """Return the bins of one axis."""
        found: tuple[Bin, ...] = getattr(self, axis.name)
        return found


def method_of(models: JointModels) -> str:
    """Return the best method that jtqd can run with these files: the last one of TITLES."""
    return models.methods[-1]


def make_card(samples: Sequence[Samples], joint: Joint, method: str) -> Card | None:
    """Return the card of one joint from its runs; None where no run has a sample in motion.

    It compares with the sensor, whose offset of the day is in every difference and no part of sigma: intervals have it
    added.
    """
    samples = [for_intervals(replace(each, true_nm=None)) for each in samples]
    own = [each for each in samples if method in each.estimate_nm and each.scored.any()]
    overall, interval = score(own, method), covered(own, method)
    if overall is None or interval is None:
        return None
    means = np.array([float(np.mean(each.scored_error_nm(method))) for each in own])
    weights = np.array([np.count_nonzero(each.scored) for each in own], np.float64)
    limit, given = _speed_limit(own, joint)
    edges = speed_edges(limit), load_edges(own), temperature_edges(own)
    places = {axis.name: list(itertools.pairwise(each)) for axis, each in zip(AXES, edges, strict=True)}

    def bins(of: Sequence[Samples], axis: Axis) -> tuple[Bin, ...]:
        return tuple(_bin(_within(of, axis, place), method, place) for place in places[axis.name])

    card = Card(
        number=own[0].number,
        joint=joint.name,
        rated_nm=joint.rated_torque_nm,
        method=method,
        runs=len(own),
        seconds=_seconds(own),
        error=overall,
        baseline=None if method == BASELINE else score(own, BASELINE),
        mean_nm=float(np.std(means, ddof=1)) if len(means) > 1 else math.nan,
        zeros=float(weights @ means**2 / weights.sum()) / overall.mse_nm2 if overall.mse_nm2 else 0.0,
        interval=interval,
        standstill=standstill(samples)[own[0].number],
        speed=bins(own, SPEED),
        load=bins(own, LOAD),
        temperature=bins(own, TEMPERATURE),
        cells=tuple(bins(_within(own, LOAD, heavy), SPEED) for heavy in places["load"]),
        limit_rad_s=limit,
        given=given,
    )
    return replace(card, advice=tuple(_advice(card)))


def speed_edges(limit_rad_s: float) -> tuple[float, ...]:
    """Return edges 0, ..., limit: 1, 2, 5, 10, ... between, SPEED_BINS of bins."""
    inner = [value for value in _SERIES if value < 0.85 * limit_rad_s][-(SPEED_BINS - 1) :]
    return (0.0, *inner, limit_rad_s)


def load_edges(samples: Sequence[Samples]) -> tuple[float, ...]:
    """Return edges in parts of rated torque: -1 to 1, and as far beyond as runs reach (at most 2)."""
    most = max(float(np.quantile(np.abs(LOAD.value(each)[each.scored]), 0.999)) for each in samples)
    steps = round(min(2.0, max(1.0, math.ceil(most / LOAD_STEP - 0.2) * LOAD_STEP)) / LOAD_STEP)
    return tuple(LOAD_STEP * k for k in range(-steps, steps + 1))


def temperature_edges(samples: Sequence[Samples]) -> tuple[float, ...]:
    """Return edges at multiples of 5 K around the measured temperatures; empty without any."""
    every = np.concatenate([each.temperature_c[each.scored] for each in samples])
    every = every[np.isfinite(every)]
    if not len(every):
        return ()
    low, high = np.quantile(every, (0.001, 0.999)).tolist()
    first, last = math.floor(low / TEMPERATURE_STEP_K), math.floor(high / TEMPERATURE_STEP_K) + 1
    stride = -(-(last - first) // 8)
    return tuple(TEMPERATURE_STEP_K * k for k in range(first, last + stride, stride))


def _speed_limit(samples: Sequence[Samples], joint: Joint) -> tuple[float, bool]:
    limits = joint.motion_limits
    if limits is not None and limits.velocity_rad_s < _UNLIMITED:
        return limits.velocity_rad_s, True
    seen = max(float(np.quantile(SPEED.value(each)[each.scored], 0.999)) for each in samples)
    return float(f"{seen:.2g}"), False


def _within(samples: Sequence[Samples], axis: Axis, edges: tuple[float, float]) -> list[Samples]:
    """Return the samples, of which those in a bin are scored."""
    low, high = edges

    def inside(value: FloatArray) -> BoolArray:
        return (value >= low) & (value < high)

    return [each.where(inside(axis.value(each))) for each in samples]


def _seconds(samples: Sequence[Samples]) -> float:
    return sum(float(np.diff(each.time_s, prepend=each.time_s[0])[each.scored].sum()) for each in samples)


def _bin(samples: Sequence[Samples], method: str, edges: tuple[float, float]) -> Bin:
    there = [each for each in samples if each.scored.any()]
    each_run = [score([each], method) for each in there]
    return Bin(
        *edges,
        seconds=_seconds(there),
        runs=len(there),
        error=score(there, method),
        by_run_nm=tuple(one.rmse_nm for one in each_run if one is not None),
        interval=covered(there, method),
    )


# Advice ------------------------------------------------------------------------------------------------------------------


def _advice(card: Card) -> list[Advice]:
    """Return the most valuable first: what is wrong before what is not known."""
    rules = (_method, _interval, _zeros, _place, _loads, _speeds, _corners, _warmth, _standing, _runs)
    return [Advice(rule.__name__.strip("_"), text) for rule in rules if (text := rule(card))]


def _method(card: Card) -> str:
    if card.method in ("physics", OURS):
        return ""
    return (
        f"These files give no more than {TITLES[card.method]}, which does not know the losses of the gear by load: run "
        "jtq fit losses on runs of this joint, then this card on other ones."
    )


def _interval(card: Card) -> str:
    share, se = card.interval.share, card.interval.se
    allowed = COVERAGE_OFF + (2.0 * se if math.isfinite(se) else 0.1)
    if abs(share - NOMINAL) <= allowed:
        return ""
    words = "too small" if share < NOMINAL else "larger than it need be"
    return (
        f"The 90 % interval holds the sensor in {100.0 * share:.0f} % of the samples, so sigma is {words}: fit again "
        "(jtq fit losses) with runs of as many days as a controller will see."
    )


def _zeros(card: Card) -> str:
    if card.runs < ENOUGH_RUNS or card.zeros < ZEROS:
        return ""
    return (
        f"{100.0 * card.zeros:.0f} % of the mean square error is constant within a run and differs from run to run "
        f"({card.mean_nm:.2g} Nm): offsets of sensor, current or encoders, or friction of the day. Take the sensor's offset "
        "unloaded before each run; jtq diagnose reports which of them it is. More speeds and loads will not lower it."
    )


def _place(card: Card) -> str:
    """Name the worst bin that is known and clearly above the whole."""
    found = [
        (each.error.rmse_nm / card.error.rmse_nm, axis.place(each.low, each.high))
        for axis in AXES
        for each in card.bins(axis)
        if each.known and each.error is not None
    ]
    ratio, place = max(found, default=(0.0, ""))
    if ratio < PLACE:
        return ""
    return (
        f"The error is {ratio:.1f} times the average at {place}: jtq diagnose on these runs names the cause; more runs "
        "there help the fit only when there were few."
    )


def _loads(card: Card) -> str:
    """Name the loads up to rated torque that are not known, by who drives."""
    texts = []
    for title, bins in (
        ("motor drives the load", [each for each in card.load if each.low >= 0.0]),
        (
            "load drives the motor",
            [
                replace(each, low=-each.high, high=-each.low)
                for each in reversed(card.load)
                if each.high <= 0.0
            ],
        ),
    ):
        gaps = ranges([each for each in bins if each.high <= 1.0 + 1e-9 and not each.known])
        if gaps:
            spans = " and ".join(f"{100.0 * abs(low):.0f} to {100.0 * high:.0f} %" for low, high in gaps)
            texts.append(f"{title}: {spans}")
    if not texts:
        return ""
    return f"Loads of rated torque without two runs ({'; '.join(texts)}): measure there, or keep the joint out of there."


def _speeds(card: Card) -> str:
    gaps = ranges([each for each in card.speed if not each.known])
    if gaps:
        spans = " and ".join(f"{low:g} to {high:g} rad/s" for low, high in gaps)
        return f"Speeds without two runs: {spans}."
    if not card.given:
        return (
            f"No run is faster than {card.limit_rad_s:g} rad/s, and the joint file names no motion_limits: whether that is "
            "all of its range is not known here."
        )
    return ""


def _corners(card: Card) -> str:
    """Name speed and load that are known each, but not together; the largest product of them."""
    found = [
        (cell.high * max(abs(heavy.low), abs(heavy.high)), fast, heavy)
        for heavy, row in zip(card.load, card.cells, strict=True)
        for fast, cell in zip(card.speed, row, strict=True)
        if heavy.known and fast.known and not cell.known
    ]
    if not found:
        return ""
    _, fast, heavy = max(found, key=lambda item: item[0])
    return (
        f"{counted(len(found), 'combination')} of speed and load that were measured apart were not measured together, the "
        f"hardest: {fast.low:g} to {fast.high:g} rad/s at {load_name(heavy.low, heavy.high)}."
    )


def _warmth(card: Card) -> str:
    if not card.temperature:
        return "The runs have no temperature: a warm gear has another friction. Record it (the drive's, or a sensor's)."
    known = [each for each in card.temperature if each.known]
    if known and known[-1].high - known[0].low > WARM_K:
        return ""
    low, high = card.temperature[0].low, card.temperature[-1].high
    return f"All runs lie between {low:g} and {high:g} °C: begin with the joint cold, and repeat after an hour of work."


def _standing(card: Card) -> str:
    if card.standstill.coverage.get(card.method) is not None:
        return ""
    return "The joint never stands still under load: hold it for some seconds, there friction leaves only an interval."


def _runs(card: Card) -> str:
    if card.runs >= RUNS_FOR_INTERVAL:
        return ""
    known = "" if not math.isfinite(card.interval.se) else f" (now ± {100.0 * card.interval.se:.0f} points)"
    return (
        f"{counted(card.runs, 'run')}: the coverage of the interval is known from {RUNS_FOR_INTERVAL} runs on{known}, "
        "each after a new start or on another day."
    )


def ranges(bins: Sequence[Bin]) -> list[tuple[float, float]]:
    """Return neighbouring bins as one range each."""
    found: list[tuple[float, float]] = []
    for each in bins:
        if found and math.isclose(found[-1][1], each.low):
            found[-1] = (found[-1][0], each.high)
        else:
            found.append((each.low, each.high))
    return found


# Page, values, text ------------------------------------------------------------------------------------------------------


def card_html(
    cards: Sequence[Card], files: Mapping[int, Mapping[str, str]], findings: Sequence[RunIssue], made: str
) -> str:
    """Return the page; files: name to SHA-256, by joint. Needs jinja2 and matplotlib."""
    content = {
        "cards": [
            {
                "joint": card.joint,
                "title": f"method {card.method}",
                "source": source(card),
                "tiles": tiles(card),
                "advice": card.advice,
                "picture": page_svg(lambda card=card: card_figure(card), f"card-{card.number}"),  # type: ignore[misc]
                "files": sorted(files[card.number].items()),
            }
            for card in cards
        ],
        "findings": [f"{each.kind}: {each.text}" for each in findings],
        "made": made,
    }
    return page.render("jtqd.sysid.evaluate", "card.html.j2", content)


def card_mapping(cards: Sequence[Card], findings: Sequence[RunIssue]) -> dict[str, Any]:
    """Return the cards for a program; an axis that was not measured is an empty list."""
    found = [each._asdict() for each in findings]
    mapping: dict[str, Any] = plain_values({"schema": SCHEMA, "joints": cards, "findings": found})
    return mapping


def card_lines(card: Card) -> list[str]:
    """Return the card for a terminal."""
    lines = [f"{card.joint}: method {card.method}; {source(card)}"]
    lines += [
        f"  {title:<15}{value}{f' ({more})' if more else ''}".rstrip() for title, value, more in tiles(card)
    ]
    for axis in AXES:
        rows = [
            [
                axis.place(each.low, each.high).replace("°C", "degC"),
                "-" if each.error is None else f"{each.error.rmse_nm:.3f}",
                "-" if each.interval is None else f"{100.0 * each.interval.share:.0f} %",
                str(each.runs),
                f"{each.seconds:.0f}",
            ]
            for each in card.bins(axis)
        ]
        if rows:
            header = [axis.name, "RMSE [Nm]", "90 % interval", "runs", "seconds"]
            lines += ["", *indented_table(header, rows)]
    nothing = "nothing: every speed, load and temperature was measured"
    advice = [each.text for each in card.advice] or [nothing]
    return [*lines, "", "  what to measure next", *(f"  - {text}" for text in advice)]


def source(card: Card) -> str:
    """Return what the card was made from."""
    runs = counted(card.runs, "run")
    return f"{runs}, {card.seconds:.0f} s in motion, joint {card.number}, rated torque {card.rated_nm:g} Nm"


def tiles(card: Card) -> list[tuple[str, str, str]]:
    """Return title, figure and explanation of the single figures."""
    interval = card.interval
    se = f" ± {100.0 * interval.se:.0f}" if math.isfinite(interval.se) else ""
    beside = "" if card.baseline is None else f"classical TOB {card.baseline.rmse_nm:.2g} Nm"
    standing = card.standstill.coverage.get(card.method)
    rest = ("not measured", "")
    if standing is not None:
        width = card.standstill.half_width_nm[card.method]
        rest = (f"holds {100.0 * standing.share:.0f} %", f"half width {width:.2g} Nm on average")
    relative = f"{card.error.rmse_rated_percent:.2g} % of rated"
    return [
        ("RMSE", f"{card.error.rmse_nm:.2g} Nm", ", ".join(filter(None, (relative, beside)))),
        ("95 % of errors", f"below {card.error.p95_nm:.2g} Nm", f"largest {card.error.max_nm:.2g} Nm"),
        (
            "90 % interval",
            f"holds {100.0 * interval.share:.0f}{se} %",
            "of the sensor in motion, its offset added",
        ),
        ("Standstill", *rest),
    ]


# Picture -----------------------------------------------------------------------------------------------------------------

WIDTH_IN: Final = 10.0
_KNOWN, _LITTLE = LIGHT["after"], LIGHT["noise"]
_LINE_CHARACTERS: Final = 132


def card_figure(card: Card) -> Any:
    """Return the four panels, in the colours of `LIGHT`."""
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
        text = "\n".join(lines) or "Nothing: every speed, load and temperature was measured."
        below.text(0.012, top - 0.24 / foot, text, va="top", linespacing=1.35)
        with whole_file(path) as file:
            figure.savefig(file, format="png", dpi=110)
        plt.close(figure)


def _panels(figure: Any, card: Card) -> None:
    left, right = figure.subfigures(1, 2)
    upper_left, lower_left = left.subfigures(2, 1)
    upper_right, lower_right = right.subfigures(2, 1)
    sizes = [
        value
        for axis in AXES
        for each in card.bins(axis)
        if each.error is not None
        for value in (each.error.rmse_nm, *each.by_run_nm)
    ]
    for axis, panel in zip(AXES, (upper_left, upper_right, lower_left), strict=True):
        _panel(panel, axis, card.bins(axis), 1.12 * max(sizes, default=1.0))
    _map(lower_right, card)


def _edge_names(bins: Sequence[Bin], axis: Axis) -> list[str]:
    return [axis.edge(edge) for edge in (*(each.low for each in bins), bins[-1].high)]


def _panel(figure: Any, of: Axis, bins: Sequence[Bin], top: float) -> None:
    """RMSE of each bin as a bar, of each run as a dot; below, the coverage of the interval."""
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2.6, 1.0))
    for axis in (upper, lower):
        plain(axis)
        axis.grid(visible=False, axis="x")
    if not bins:
        upper.text(0.5, 0.5, "not measured", transform=upper.transAxes, ha="center", color=LIGHT["soft"])
        lower.set_xticks([])
    for place, each in enumerate(bins):
        x = place + 0.5
        if each.error is None:
            look = {"ha": "center", "va": "bottom", "color": LIGHT["soft"], "fontsize": 8}
            upper.text(x, 0.02 * top, "no data", **look)
            continue
        bar = {"color": _KNOWN, "alpha": 0.75} if each.known else {"color": _LITTLE, "alpha": 1.0}
        upper.bar(x, each.error.rmse_nm, 0.8, **bar)
        spread = np.linspace(-0.25, 0.25, len(each.by_run_nm)) if len(each.by_run_nm) > 1 else np.zeros(1)
        upper.plot(x + spread, each.by_run_nm, "o", color=LIGHT["ink"], markersize=2.0, linestyle="none")
        if each.interval is not None:
            lower.errorbar(
                x,
                100.0 * each.interval.share,
                yerr=100.0 * each.interval.se if math.isfinite(each.interval.se) else 0.0,
                fmt="o",
                color=_KNOWN if each.known else LIGHT["soft"],
                markersize=4.0,
                elinewidth=1.2,
            )
    if bins:
        lower.set_xticks(range(len(bins) + 1), _edge_names(bins, of))
        lower.set_xlim(0, len(bins))
    lower.axhline(100.0 * NOMINAL, color=LIGHT["soft"], linewidth=0.8, linestyle="--")
    lower.set_ylim(0.0, 105.0)
    lower.set_yticks([0, 50, 90], ["0", "50", "90 %"])
    lower.set_ylabel("in 90 %\ninterval")
    lower.set_xlabel(of.label)
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
            rmse = cell.error.rmse_nm
            bar = {"color": _LITTLE, "alpha": 0.6}
            if cell.known:
                bar = {"color": _KNOWN, "alpha": 0.12 + 0.63 * min(1.0, rmse / most)}
            axis.bar(x + 0.5, 0.94, 0.94, bottom=y + 0.03, linewidth=0, **bar)
            axis.text(
                x + 0.5,
                y + 0.48,
                f"{rmse:.2f}" if rmse < 9.995 else f"{rmse:.0f}",
                ha="center",
                va="center",
                fontsize=7.5,
                color=LIGHT["ink"] if cell.known else LIGHT["soft"],
            )
    axis.set_xlim(0, len(card.speed))
    axis.set_ylim(0, len(card.load))
    axis.set_xticks(range(len(card.speed) + 1), _edge_names(card.speed, SPEED))
    axis.set_yticks(range(len(card.load) + 1), _edge_names(card.load, LOAD))
    axis.grid(visible=False)
    axis.set_xlabel("speed |v| [rad/s]; in the cells: RMSE [Nm]")
    axis.set_ylabel(_ALONG)
