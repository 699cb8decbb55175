"""Findings as rows of the report: numbers as text, bars as shares of their width."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

from jtqd.estimator.effects.effect import Effect
from jtqd.estimator.joint import Joint
from jtqd.sysid.diagnosis.findings import CandidateEvidence, Cause, Findings, Gain, Gap, Place, file_values
from jtqd.sysid.diagnosis.report.words import (
    AXES,
    balance_title,
    bin_name,
    effect_title,
    evidence_in_words,
    gain_interval,
    of_place,
    parameter_title,
    place,
    where,
)
from jtqd.sysid.report.numbers import (
    DASH,
    SPACE,
    fixed,
    number,
    percent,
    unit_name,
    with_interval,
    with_unit,
)

_HOT: Final = 2.0
"""A bin with this many times its even share of the gap is marked."""
_EVEN: Final = 1.5
"""An axis without a bin above this many even shares is shown on demand only."""


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
    """One balance of one joint; floor: share of the residual that is noise; places: the first of each axis; uneven_axes,
    even_axes: axes over which the gap is uneven, and the others.
    """

    title: str
    rmse: str
    noise: str
    floor: float
    floor_from: str
    places: tuple[PlaceView, ...]
    uneven_axes: tuple[AxisView, ...]
    even_axes: tuple[AxisView, ...]


def gap_views(gaps: Sequence[Gap]) -> list[GapView]:
    """Return the gaps, each with its axes, the most uneven first."""
    return [_gap(each) for each in gaps]


def _gap(gap: Gap) -> GapView:
    axes: dict[str, list[Place]] = {}
    for each in gap.map:
        axes.setdefault(each.axis, []).append(each)
    axes = {name: _normalised(bins) for name, bins in axes.items()}
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


def _normalised(places: Sequence[Place]) -> list[Place]:
    """Return the bins of one axis with shares that are at most the whole: where the gap is small beside the noise, the
    excess of some bins is larger than that of all.
    """
    whole = max(1.0, sum(max(each.share, 0.0) for each in places))
    return [replace(each, share=each.share / whole) for each in places]


def _top_places(places: Sequence[Place]) -> tuple[PlaceView, ...]:
    """Return the first place of every axis of the findings, the largest share first."""
    first: dict[str, Place] = {}
    for each in places:
        first.setdefault(each.axis, each)
    ranked = sorted(first.values(), key=lambda each: -each.share)
    return tuple(
        PlaceView(where(each), percent(each.share), min(max(each.share, 0.0), 1.0)) for each in ranked
    )


def _axis(name: str, places: Sequence[Place], highest: float) -> AxisView:
    """Return one axis; highest: full height, in units of an even share."""
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


CHOSEN: Final = "chosen"
CLASS_OF: Final = "class of"
SHOWN: Final = 12
"""Rows of the evidence that are open from the start."""
_BIC_DECADES: Final = 6.0
"""Width of the evidence's bars: logarithmic, full at 10 to this power."""


@dataclass(frozen=True)
class ParameterView:
    """One parameter: name in words, key of the joint file, value with unit, interval ("" for none); before: what the joint
    file has, change: in percent ("" where there is nothing to compare with).
    """

    title: str
    key: str
    value: str
    interval: str
    before: str = ""
    change: str = ""


@dataclass(frozen=True)
class CauseView:
    """One effect found; others: effects indistinguishable from it; evidence: how sure it is, in words; equation, tell_tale:
    "" without a library effect.
    """

    title: str
    name: str
    others: tuple[str, ...]
    parameters: tuple[ParameterView, ...]
    evidence: str
    delta_bic: str
    held_out: str
    rms: str
    balance: str
    equation: str
    tell_tale: str
    share: str = ""
    stability: str = ""


@dataclass(frozen=True)
class LeftView:
    """What the causes leave: rms, part of the rated torque, whether that matters, what they explain ("" without causes)."""

    rms: str
    of_rated: str
    judged: str
    explained: str


@dataclass(frozen=True)
class EvidenceView:
    """One row of the evidence; state: "chosen", "class" or ""; bar: share of the full width."""

    title: str
    place: str
    state: str
    delta_bic: str
    bar: float
    held_out: str
    shared: str
    minimum: str
    reason: str


@dataclass(frozen=True)
class BarView:
    """One error before and after; widths of the bars in percent of what there is; whisker: interval of the one after."""

    title: str
    before: str
    after: str
    less: str
    drop: str
    before_width: float
    after_width: float
    whisker: tuple[float, float] | None


def cause_views(findings: Findings, effects: Mapping[str, Effect]) -> list[CauseView]:
    """Return the causes, largest first."""
    return [_cause(each, effects, findings.joint_files) for each in findings.causes]


def _cause(cause: Cause, effects: Mapping[str, Effect], joints: Mapping[int, Joint]) -> CauseView:
    effect = effects.get(cause.name)
    known = file_values(cause.name, cause.joint, cause.parameters, joints)
    rows = []
    for name, value in cause.parameters.items():
        text, interval = with_interval(value.value, value.ci95, value.unit)
        before = change = ""
        there = known.get(name)
        if there is not None and there.value is not None:
            before = with_unit(there.value, value.unit)
            share = there.change(value.value)
            change = "not in the file" if share is None else f"{'+' if share > 0.0 else ''}{percent(share)}"
        rows.append(ParameterView(parameter_title(name), name, text, interval, before, change))
    return CauseView(
        of_place(cause.name, cause.joint),
        cause.name,
        tuple(effect_title(name) for name in cause.names if name != cause.name),
        tuple(rows),
        evidence_in_words(cause),
        fixed(cause.delta_bic, 0),
        percent(cause.held_out_gain),
        f"{number(cause.rms_nm)}{SPACE}Nm",
        balance_title(cause.balance),
        effect.equation if effect else "",
        effect.tell_tale if effect else "",
        _known_percent(cause.explained_share),
        number(cause.stability, 2) if math.isfinite(cause.stability) else "",
    )


def _known_percent(share: float) -> str:
    return percent(share) if math.isfinite(share) else ""


def left_view(findings: Findings) -> LeftView | None:
    """Return what the causes leave that is structure, None where it was not measured."""
    left = findings.unexplained
    if left is None:
        return None
    relevant = f"{number(left.relevant_nm)}{SPACE}Nm"
    place_ = f"joint {left.joint}, {left.balance} balance"
    return LeftView(
        f"{number(left.rms_nm)}{SPACE}Nm",
        percent(left.of_rated, 2),
        f"{place_}; {'it matters' if left.matters else 'it does not matter'} ({left.limit(relevant)})",
        _known_percent(findings.explained_share) if findings.causes else "",
    )


def evidence_views(candidates: Sequence[CandidateEvidence]) -> list[EvidenceView]:
    """Return the rows: chosen first, then their classes, then by evidence."""
    return [_evidence(each) for each in sorted(candidates, key=_rank)]


def _state(candidate: CandidateEvidence) -> str:
    if candidate.reason == CHOSEN:
        return "chosen"
    return "class" if candidate.reason.startswith(CLASS_OF) else ""


def _rank(candidate: CandidateEvidence) -> tuple[int, float, str, str]:
    order = ("chosen", "class", "").index(_state(candidate))
    bic = candidate.delta_bic
    return order, -bic if math.isfinite(bic) else math.inf, candidate.name, str(candidate.joint)


def _evidence(candidate: CandidateEvidence) -> EvidenceView:
    bic = candidate.delta_bic
    bar = min(math.log10(1.0 + bic) / _BIC_DECADES, 1.0) if math.isfinite(bic) and bic > 0.0 else 0.0
    return EvidenceView(
        effect_title(candidate.name),
        place(candidate.joint),
        _state(candidate),
        fixed(bic, 0),
        bar,
        _held(candidate.held_out_gain),
        percent(candidate.shared),
        _minimum(candidate),
        reason_in_words(candidate.reason),
    )


def _held(share: float) -> str:
    """Return a part of the evidence; how far below nothing it can be has no meaning."""
    return f"below {percent(-1.0)}" if share < -1.0 else percent(share)


def reason_in_words(reason: str) -> str:
    """Return the reason with names of effects as words: "class of link_inertia" is "class of link inertia"."""
    return " ".join(effect_title(word) if "_" in word and word.islower() else word for word in reason.split())


def _minimum(candidate: CandidateEvidence) -> str:
    texts = []
    for name, value in candidate.minimum.items():
        if math.isinf(value.value):
            return "invisible"
        if value.value == 0.0:
            return DASH
        size = with_unit(value.value, value.unit, 2)
        texts.append(size if len(candidate.minimum) == 1 else f"{size} {parameter_title(name)}")
    return ", ".join(texts) or DASH


def gain_views(gain: Gain | None) -> list[BarView]:
    """Return the error of the torque, and of the free run where it was measured."""
    if gain is None:
        return []
    before, after = gain.rmse_before_nm, gain.rmse_after_nm
    rest = (before - gain.ci95[1], before - gain.ci95[0])
    views = [_bar("torque", "Nm", (before, after), rest, gain_interval(gain))]
    if math.isfinite(gain.free_run_before) and math.isfinite(gain.free_run_after):
        unknown = (math.nan, math.nan)
        errors = (gain.free_run_before, gain.free_run_after)
        views.append(_bar("free run, velocity", "rad/s", errors, unknown, ""))
    errors = (gain.free_run_position_before, gain.free_run_position_after)
    if all(math.isfinite(error) for error in errors):
        views.append(_bar("free run, position", "rad", errors, (math.nan, math.nan), ""))
    return views


def _bar(
    title: str, unit: str, errors: tuple[float, float], interval: tuple[float, float], drop: str
) -> BarView:
    """Return one error before and after; interval: of the one after; drop: what goes, as a text."""
    before, after = errors
    share = after / before if before > 0.0 else math.nan
    rest = [end / before if before > 0.0 else math.nan for end in interval]
    known = all(math.isfinite(end) for end in rest)
    shares = [1.0, share, *(rest if known else ())]
    full = max(x for x in shares if math.isfinite(x))
    widths = [max(100.0 * x / full, 0.0) if math.isfinite(x) else 0.0 for x in shares]
    return BarView(
        title,
        f"{number(before)}{SPACE}{unit}",
        f"{number(after)}{SPACE}{unit}",
        percent(1.0 - share),
        drop,
        widths[0],
        widths[1],
        (widths[2], widths[3]) if known else None,
    )
