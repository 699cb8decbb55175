"""Findings as the page shows them: every number already a text, every bar already a share of its width. Pure."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from estimator.effects.effect import Effect
from sysid.diagnosis.findings import Candidate, Cause, Findings, Gain
from sysid.diagnosis.report.quantities import (
    DASH,
    SPACE,
    fixed,
    number,
    parameter,
    percent,
    with_unit,
)
from sysid.diagnosis.report.words import (
    balance_title,
    effect_title,
    gain_interval,
    of_place,
    parameter_title,
    place,
)

CHOSEN: Final = "chosen"
CLASS_OF: Final = "class of"
SHOWN: Final = 12
"""Rows of the evidence that are open from the start."""
_BIC_DECADES: Final = 6.0
"""Width of the evidence's bars: logarithmic, full at 10 to this power."""


@dataclass(frozen=True)
class ParameterView:
    """One parameter: name in words, key of the joint file, value with unit, interval ("" for none)."""

    title: str
    key: str
    value: str
    interval: str


@dataclass(frozen=True)
class CauseView:
    """One effect found; others: what it cannot be told from; equation, tell_tale: "" for effects not in the library."""

    title: str
    name: str
    others: tuple[str, ...]
    parameters: tuple[ParameterView, ...]
    delta_bic: str
    held_out: str
    rms: str
    balance: str
    equation: str
    tell_tale: str


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
    return [_cause(each, effects) for each in findings.causes]


def _cause(cause: Cause, effects: Mapping[str, Effect]) -> CauseView:
    effect = effects.get(cause.name)
    rows = []
    for name, value in cause.parameters.items():
        text, interval = parameter(value)
        rows.append(ParameterView(parameter_title(name), name, text, interval))
    return CauseView(
        of_place(cause.name, cause.joint),
        cause.name,
        tuple(effect_title(name) for name in cause.names if name != cause.name),
        tuple(rows),
        fixed(cause.delta_bic, 0),
        percent(cause.held_out_gain),
        f"{number(cause.rms_nm)}{SPACE}Nm",
        balance_title(cause.balance),
        effect.equation if effect else "",
        effect.tell_tale if effect else "",
    )


def evidence_views(candidates: Sequence[Candidate]) -> list[EvidenceView]:
    """Return the rows: chosen first, then their classes, then by evidence."""
    return [_evidence(each) for each in sorted(candidates, key=_rank)]


def _state(candidate: Candidate) -> str:
    if candidate.reason == CHOSEN:
        return "chosen"
    return "class" if candidate.reason.startswith(CLASS_OF) else ""


def _rank(candidate: Candidate) -> tuple[int, float, str, str]:
    order = ("chosen", "class", "").index(_state(candidate))
    bic = candidate.delta_bic
    return order, -bic if math.isfinite(bic) else math.inf, candidate.name, str(candidate.joint)


def _evidence(candidate: Candidate) -> EvidenceView:
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
    """A part of the evidence; how far below nothing it can be has no meaning."""
    return f"below {percent(-1.0)}" if share < -1.0 else percent(share)


def reason_in_words(reason: str) -> str:
    """Return the reason with names of effects as words: "class of link_inertia" is "class of link inertia"."""
    return " ".join(effect_title(word) if "_" in word and word.islower() else word for word in reason.split())


def _minimum(candidate: Candidate) -> str:
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
    return views


def _bar(
    title: str, unit: str, errors: tuple[float, float], interval: tuple[float, float], drop: str
) -> BarView:
    """One error before and after; interval: of the one after; drop: what goes, as a text."""
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
