"""Verdict of a diagnosis: what was found as findings, with reasons in words and the experiment that would decide."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np

from jtqd.estimator.effects.effect import MOTOR
from jtqd.sysid.diagnosis.acceptance import Found, found_in
from jtqd.sysid.diagnosis.bounded import bounded_values, in_the_file
from jtqd.sysid.diagnosis.case import Case, Fit
from jtqd.sysid.diagnosis.causes import causes_of, separated_at_rest
from jtqd.sysid.diagnosis.dataset import Dataset
from jtqd.sysid.diagnosis.evidence import candidate_table
from jtqd.sysid.diagnosis.fewer_runs import Names, with_fewer
from jtqd.sysid.diagnosis.findings import (
    AMBIGUOUS,
    CAUSE,
    INSUFFICIENT,
    NO_GAP,
    UNEXPLAINED,
    BoundedValue,
    CandidateEvidence,
    Cause,
    Findings,
    Gap,
    JointName,
    UnexplainedResidual,
    joint_text,
)
from jtqd.sysid.diagnosis.gain import held_out_gain
from jtqd.sysid.diagnosis.gaps import channel_gaps, traces
from jtqd.sysid.diagnosis.next_experiment import MOST_KINDS, next_experiment
from jtqd.sysid.diagnosis.search import Hypothesis
from jtqd.sysid.diagnosis.unexplained import Unexplained

RELEVANCE: Final = 0.005
"""Part of the rated torque, rms over a run, from which what the causes leave matters; the user may set another."""


def conclude(
    case: Case, fit: Fit, names: tuple[str, ...], numbers: tuple[int, ...], names_without: Names
) -> Findings:
    """Return the findings of one diagnosis.

    fit: of what the search found; names, numbers: of all runs and joints asked about; names_without: what is reported
    without a recording.
    """
    found, became = with_fewer(found_in(case, fit), names_without)
    bounded = bounded_values(found)
    gain = held_out_gain(case.dataset, found.named.refined)
    named, classes = separated_at_rest(case, found.named, found.classes)
    left, shown = _remaining(found, named)
    explained = sum(case.energies_nm2(named))
    remains = found.remains_nm2(left)
    total = max(max(explained, sum(case.energies_nm2(shown))) + remains, 1e-30)
    causes = causes_of(case, named, classes, total)
    bounded = in_the_file(bounded, causes)
    unsure, doubt = [], ""
    if found.few is not None:
        unsure = found.few.unsure(found.whole.hypothesis, named.hypothesis, classes, causes)
        doubt = found.few.doubt(unsure) if unsure else ""
    rivals = {r.key: c.effect.name for c, others in zip(named.chosen, classes, strict=True) for r in others}
    table = candidate_table(case.search, named.hypothesis, rivals, unexplained=found.beside)
    reasons: list[str] = []
    if found.matters:
        verdict = UNEXPLAINED
        reasons = [
            f"joint {c.joint}, {c.balance} balance: {nm:.3g} Nm rms of the worst run where a channel is held"
            for c, nm in found.held_nm.items()
        ]
        if found.left_matters:
            reasons += [*_closest(found.whole.hypothesis, causes, found.share), *left.reasons]
        reasons += _detectable_range(table, case.dataset.rated_torque_nm) if found.beside else []
    elif causes:
        verdict = CAUSE if all(len(c.names) == 1 for c in causes) and not doubt else AMBIGUOUS
    else:
        verdict = INSUFFICIENT if doubt else NO_GAP
        reasons = [doubt] if doubt else []
    causes.sort(key=lambda c: -c.rms_nm)
    gaps = channel_gaps(case.dataset, shown.refined, left if found.left_matters else None)
    gaps = _below_bounds(gaps, bounded)
    bounds = tuple(f"{b.name} of {joint_text(b.joint)} " for b in bounded)  # once, as a bound
    refused = [line for line in found.refused if not line.startswith(bounds)]
    if not reasons:
        reasons = [s for s in (_reason(verdict, causes, gaps), doubt) if s]
    return Findings(
        verdict,
        (*reasons, *(b.text for b in bounded), *refused, *became),
        names,
        numbers,
        gaps,
        tuple(causes),
        table,
        gain if causes else None,
        next_experiment=_settling_experiment(verdict, causes, unsure, case.dataset),
        traces=traces(case.dataset, shown.refined),
        explained_share=explained / total if causes else math.nan,
        unexplained=_unexplained(found, left, remains / total),
        bounded=tuple(bounded),
    )


def _below_bounds(gaps: Sequence[Gap], bounded: Sequence[BoundedValue]) -> tuple[Gap, ...]:
    """Return the gaps with no noise floor above what a bounded value leaves on the held-out runs: where nothing is named,
    the runs' own changes hold what all of them lack of it, and that is no noise.
    """
    return tuple(_below(gap, [b for b in bounded if b.joint == gap.joint]) for gap in gaps)


def _below(gap: Gap, bounded: Sequence[BoundedValue]) -> Gap:
    left = [math.sqrt(float(np.mean([r.rmse_after_nm**2 for r in b.runs]))) for b in bounded]
    lower = min(left, default=math.inf)
    if gap.balance != MOTOR or lower >= gap.noise_floor_nm:
        return gap
    return replace(gap, noise_floor_nm=lower, floor_from="what a bounded value leaves on held-out runs")


def _unexplained(found: Found, left: Unexplained, share: float) -> UnexplainedResidual:
    """Return the unexplained residual in the channel where it is most, against its limit; share: of all structure, as
    energy.
    """
    sizes = {c: max(left.worst_nm.get(c, 0.0), found.held_nm.get(c, 0.0)) for c in found.limits}
    worst = max(sizes, key=lambda c: sizes[c] / found.limits[c] if found.limits[c] > 0.0 else sizes[c])
    return UnexplainedResidual(
        worst.joint,
        worst.balance,
        sizes[worst],
        sizes[worst] / found.case.dataset.joints[worst.joint].rated_torque_nm,
        share,
        found.limits[worst],
        found.matters,
        unconfirmed=not found.matters and left is not found.left,
    )


def _closest(whole: Hypothesis, causes: Sequence[Cause], share: float) -> list[str]:
    """Return the lines about effects that were found where a relevant residual remains."""
    named = {(c.name, c.joint) for c in causes}
    others = ", ".join(
        f"{c.effect.name} of {joint_text(c.joint)}" for c in whole.chosen if c.key not in named
    )
    if not others:
        return []
    one = len(whole.chosen) - len(named) == 1
    effects, are = ("effect", "it is") if one else ("effects", "they are")
    return [
        f"the closest {effects} of the library ({others}) would leave {share:.0%} of the structured gap, "
        f"so {are} not named as its cause"
    ]


def _detectable_range(table: Sequence[CandidateEvidence], rated_nm: float) -> list[str]:
    """Return how large an effect must be to be distinguished in the presence of an unexplained residual; none is
    larger than the rated torque.
    """
    seen = sorted((c.minimum_rms_nm, c.name) for c in table if c.minimum_rms_nm < rated_nm)
    if not seen:
        return []
    (low, easiest), (high, hardest) = seen[0], seen[-1]
    return [
        f"on these runs an effect below {low:.2g} Nm rms ({easiest.replace('_', ' ')}) to {high:.2g} Nm rms"
        f" ({hardest.replace('_', ' ')}) cannot be distinguished from the unexplained residual"
    ]


def _remaining(found: Found, named: Fit) -> tuple[Unexplained, Fit]:
    """Return what findings and report show as unexplained, and the fit that leaves it: that of the causes. Where something
    matters that all effects found leave, that of all of them, or of none where that leaves less: a fit that is bent leaves
    more than there was, and in other places.
    """
    case, whole = found.case, found.whole
    if not found.left_matters:
        if named.hypothesis is whole.hypothesis:
            return found.left, named
        return case.unexplained(named), named
    if whole.chosen:
        bare = case.fit(case.search.hypothesis(()))
        without = case.unexplained(bare)
        if without.energy_nm2() <= found.left.energy_nm2():
            return without, bare
    return found.left, whole


def _settling_experiment(
    verdict: str, causes: Sequence[Cause], unsure: Sequence[tuple[str, JointName]], dataset: Dataset
) -> dict[str, Any] | None:
    """Return the experiment that would settle an ambiguous verdict, a class in the presence of an unexplained
    residual, or one of too few runs; unsure: what does not hold on every held-out run.
    """
    in_class = any(len(c.names) > 1 for c in causes)
    if verdict not in (AMBIGUOUS, INSUFFICIENT) and not (verdict == UNEXPLAINED and in_class):
        return None
    classes = [tuple(dict.fromkeys(n.split(" of ")[0] for n in c.names)) for c in causes if len(c.names) > 1]
    warm = bool(np.isfinite(dataset.signals[0][0].state.temperature_c).any())
    reasons = [f"{' and '.join(names)} fit these runs equally well" for names in classes]
    alone = tuple(dict.fromkeys(name for name, _ in unsure))[:MOST_KINDS]
    if alone:
        reasons.append(
            f"{', '.join(alone)}: indicated by all runs together, but not confirmed on every held-out run"
        )
    text = "; ".join(reasons)
    classes += [(name,) for name in alone]
    seen = [run[0] for run in dataset.signals]
    return next_experiment(classes, dataset.joints, text, temperature=warm, signals=seen)


def _reason(verdict: str, causes: Sequence[Cause], gaps: Sequence[Gap]) -> str:
    if verdict == NO_GAP:
        worst = gaps[0]
        return (
            f"the simulation agrees with the runs: {worst.rmse_nm:.3g} Nm rms at joint {worst.joint} "
            f"({worst.balance} balance), of which noise and run-to-run variation are {worst.noise_floor_nm:.3g} Nm"
        )
    parts = []
    for c in causes:
        text = c.name.replace("_", " ")
        if len(c.names) > 1:
            text += " (or " + ", ".join(n.replace("_", " ") for n in c.names[1:]) + ")"
        parts.append(f"{text} of {joint_text(c.joint)}, {c.rms_nm:.3g} Nm rms")
    return "the simulation lacks " + "; ".join(parts)
