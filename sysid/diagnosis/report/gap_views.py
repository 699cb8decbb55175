"""Where the gap lives, as the page shows it: the first places in words, every condition as bars on one scale. Pure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

from sysid.diagnosis.findings import Gap, Place
from sysid.diagnosis.report.quantities import SPACE, number, percent, unit_name
from sysid.diagnosis.report.words import AXES, balance_title, bin_name, effect_title, where

_HOT: Final = 2.0
"""A bin with this many times its even share of the gap is marked."""
_EVEN: Final = 1.5
"""An axis without a bin above this many even shares tells nothing, and is shown on demand."""


@dataclass(frozen=True)
class BinView:
    """One bin: height of its bar (1: the largest of all axes of the gap), whether it is marked, all of it as a text."""

    height: float
    hot: bool
    text: str


@dataclass(frozen=True)
class AxisView:
    """The gap over one operating condition; uneven: largest share in units of an even one; even: height of an even share;
    low, high: ends of the axis.
    """

    title: str
    bins: tuple[BinView, ...]
    low: str
    high: str
    peak: str
    uneven: float
    even: float


@dataclass(frozen=True)
class PlaceView:
    """One place of the gap: where, its share as a text and as a bar."""

    where: str
    share: str
    bar: float


@dataclass(frozen=True)
class GapView:
    """One balance of one joint; floor: share of the residual that is noise; places: the first of each axis; telling, even:
    axes over which the gap is uneven, and the others.
    """

    title: str
    rmse: str
    noise: str
    floor: float
    floor_from: str
    places: tuple[PlaceView, ...]
    telling: tuple[AxisView, ...]
    even: tuple[AxisView, ...]


def gap_views(gaps: Sequence[Gap]) -> list[GapView]:
    """Return the gaps, each with its axes, the most uneven first."""
    return [_gap(each) for each in gaps]


def _gap(gap: Gap) -> GapView:
    axes: dict[str, list[Place]] = {}
    for each in gap.map:
        axes.setdefault(each.axis, []).append(each)
    axes = {name: _together(bins) for name, bins in axes.items()}
    highest = max((each.share * len(places) for places in axes.values() for each in places), default=1.0)
    views = [_axis(name, places, max(highest, _HOT)) for name, places in axes.items()]
    views.sort(key=lambda view: -view.uneven)
    floor = gap.noise_floor_nm / gap.rmse_nm if gap.rmse_nm > 0.0 else 1.0
    return GapView(
        f"Joint {gap.joint}, {balance_title(gap.balance)}",
        f"{number(gap.rmse_nm)}{SPACE}Nm",
        f"{number(gap.noise_floor_nm)}{SPACE}Nm",
        min(1.0, floor) if math.isfinite(floor) else 0.0,
        gap.floor_from,
        _top_places(gap.localisation),
        tuple(view for view in views if view.uneven > _EVEN),
        tuple(view for view in views if view.uneven <= _EVEN),
    )


def _together(places: Sequence[Place]) -> list[Place]:
    """Return the bins of one axis with shares that are at most the whole: where the gap is small beside the noise, the
    excess of some bins is larger than that of all.
    """
    whole = max(1.0, sum(max(each.share, 0.0) for each in places))
    return [replace(each, share=each.share / whole) for each in places]


def _top_places(places: Sequence[Place]) -> tuple[PlaceView, ...]:
    """Return the first place of every axis, in the order of the findings."""
    first: dict[str, Place] = {}
    for each in places:
        first.setdefault(each.axis, each)
    return tuple(
        PlaceView(where(each), percent(each.share), min(max(each.share, 0.0), 1.0)) for each in first.values()
    )


def _axis(name: str, places: Sequence[Place], highest: float) -> AxisView:
    """One axis; highest: full height, in units of an even share."""
    ordered = sorted(places, key=lambda each: (each.low, each.high))
    top = max(ordered, key=lambda each: each.share)
    even = 1.0 / len(ordered)
    bins = tuple(
        BinView(max(each.share, 0.0) / even / highest, each.share > _HOT * even, _bin_text(each))
        for each in ordered
    )
    ends = (ordered[0].low, ordered[-1].high)
    unit = unit_name(top.unit)
    named = not all(math.isfinite(end) for end in ends) or name == "quadrant"
    return AxisView(
        AXES.get(name, effect_title(name)),
        bins,
        bin_name(ordered[0]) if named else f"{number(ends[0])} {unit}".rstrip(),
        bin_name(ordered[-1]) if named else f"{number(ends[1])} {unit}".rstrip(),
        f"{percent(top.share)} at {bin_name(top)}",
        top.share / even,
        1.0 / highest,
    )


def _bin_text(each: Place) -> str:
    rms = f", {number(each.rms_nm)} Nm rms" if math.isfinite(each.rms_nm) else ""
    return f"{bin_name(each)}: {percent(each.share)}{rms}"
