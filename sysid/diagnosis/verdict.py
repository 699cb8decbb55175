"""Verdict of a diagnosis: gaps, causes with classes and intervals, evidence, gain, what is left over, as findings."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from jtqd.estimator.joint import Joint
from jtqd.sysid.diagnosis.current_zero import offset_at_rest, rest_current
from jtqd.sysid.diagnosis.dataset import Dataset
from jtqd.sysid.diagnosis.evidence import RELEVANT, candidate_table, class_beside, equivalence_class
from jtqd.sysid.diagnosis.fewer_runs import (
    MOST_ANEW,
    Compared,
    Gone,
    Key,
    Names,
    kept_text,
    named_by_fewer,
    same_candidates,
)
from jtqd.sysid.diagnosis.findings import (
    AMBIGUOUS,
    CAUSE,
    INSUFFICIENT,
    NO_GAP,
    UNEXPLAINED,
    CandidateEvidence,
    Cause,
    Findings,
    Gap,
    JointName,
    LeftOver,
    Value,
    joint_text,
)
from jtqd.sysid.diagnosis.gain import held_out_gain, left_out_steps
from jtqd.sysid.diagnosis.gaps import channel_gaps, traces
from jtqd.sysid.diagnosis.guards import nothing_of, objections
from jtqd.sysid.diagnosis.leave_one_out import ENOUGH_RUNS, LeaveOneOut
from jtqd.sysid.diagnosis.leftover import Leftover, leftover
from jtqd.sysid.diagnosis.next_experiment import MOST_KINDS, next_experiment
from jtqd.sysid.diagnosis.noise import Noise
from jtqd.sysid.diagnosis.refine import (
    PresentEffect,
    Refined,
    contributions,
    parameter,
    present_effects,
    refine,
)
from jtqd.sysid.diagnosis.regressors import EffectCandidate
from jtqd.sysid.diagnosis.search import Hypothesis, Search
from jtqd.sysid.diagnosis.signals import Channel
from jtqd.sysid.diagnosis.steadiness import steadiness
from jtqd.sysid.fit.friction import student_975

RELEVANCE: Final = 0.005
"""Part of the rated torque, rms over a run, from which what the causes leave matters; the user may set another."""
UNEXPLAINED_SHARE: Final = 0.05
"""Part of all structure (as squares) that must be left over as well for it to matter."""
FEW_UNEXPLAINED_SHARE: Final = 0.2
"""The same with two or three runs, where more of what is left over is the runs' own."""

_MOST_SAID: Final = 4
"""Lines about effects that fit and are not named."""

INACCURATE: Final = 0.06
"""Half width of the 95 % interval, as part of an effect's size, for what the equations here simplify (smoothing, first
order in a delay): no interval is narrower. Judged by its coverage of known truths (docs/diagnosis.md).
"""
_UNSTEADY: Final = "its size is not the same in all runs and under all conditions"
_FAR_FROM_CERTAIN: Final = 0.25
"""Part of the steadiness that is needed below which effects are taken away at once, not one by one."""
BESIDE: Final = 0.02
"""Part of the largest cause's contribution below which another one is within the model's own inaccuracy."""


@dataclass(frozen=True)
class _Found:
    """What was found, and what may be named of it.

    whole, refined: all that no guard objects to, and the fit that what is left over is judged with; best, proven: of that
    what is certain enough, and its fit; few: the rule for few runs, None with enough; share: of all structure that is left
    over; limits: from where it matters [Nm]; refused: the objections.
    """

    whole: Hypothesis
    refined: Refined
    best: Hypothesis
    proven: Refined
    few: LeaveOneOut | None
    left: Leftover
    share: float
    limits: Mapping[Channel, float]
    refused: Sequence[str]

    @property
    def large(self) -> bool:
        """Whether what is left over is relevant by its size."""
        return any(nm > self.limits[c] for c, nm in self.left.worst_nm.items())

    @property
    def matters(self) -> bool:
        """Whether what is left over matters: by its size, and as a part of the gap."""
        part = UNEXPLAINED_SHARE if self.few is None else FEW_UNEXPLAINED_SHARE
        return self.large and (self.share > part or not self.whole.chosen)

    @property
    def beside(self) -> bool:
        """Whether causes have to be certain beside what is left over, however small a part of the gap it is: a small effect
        may imitate it. With few runs they have a rule of their own.
        """
        return self.large and self.few is None


def _found(  # noqa: PLR0917
    dataset: Dataset,
    search: Search,
    best: Hypothesis,
    refined: Refined,
    noise: Noise,
    joints: Mapping[int, Joint],
    relevance: float,
) -> _Found:
    few = LeaveOneOut(dataset, search) if search.mixed.runs < ENOUGH_RUNS else None
    best, refined, explained, refused = _guarded(
        dataset, search, best, refined, noise, joints, bounds_only=few is not None
    )
    left = leftover(dataset, refined, noise, joints)
    whole, squares = best, _squares(explained)
    if few is not None:  # what is left over is judged with all that was found, names need more
        best = few.confirmed(whole)
        refined = refine(dataset, present_effects(best), noise)
        best, refined, explained, refused = _guarded(dataset, search, best, refined, noise, joints)
        named = leftover(dataset, refined, noise, joints)
        if named.energy_nm2() < left.energy_nm2():
            whole, left, squares = best, named, _squares(explained)
    limits = {c: relevance * joints[c.joint].rated_torque_nm for c in refined.runs[0].channels}
    found = _Found(whole, refined, best, refined, few, left, left.share(squares), limits, refused)
    if found.beside:
        best, proven = _proven(dataset, search, best, refined, noise, joints)
        weak = [c for c in whole.chosen if c not in best.chosen]
        if weak and not found.matters:  # what is not certain is left over, too
            left = leftover(dataset, proven, noise, joints)
            share = left.share(_squares([_rms_at(dataset, p) for p in proven.present]))
            said = [
                f"{c.effect.name} of {joint_text(c.joint)} fits but is not named: {_UNSTEADY}" for c in weak
            ]
            refused = [*refused, *said]
            found = replace(found, whole=best, refined=proven, left=left, share=share, refused=refused)
        found = replace(found, best=best, proven=proven)
    return found


def _with_fewer(  # noqa: PLR0917
    dataset: Dataset,
    search: Search,
    found: _Found,
    noise: Noise,
    joints: Mapping[int, Joint],
    relevance: float,
    anew: Names | None,
) -> tuple[_Found, list[tuple[EffectCandidate, ...]], list[str]]:
    """Return what was found with what fewer runs name and the runs left out bear out, its classes, and a line about each
    effect that fewer runs name (`fewer_runs`).
    """
    classes = _classes(search, found)
    here = {c.key for c in found.best.chosen} | {c.key for others in classes for c in others}

    def names(number: int) -> Sequence[EffectCandidate]:
        if anew is not None and (found.large or found.few is not None) and search.mixed.runs <= MOST_ANEW:
            return same_candidates(search, anew(number))
        part, of_part = dataset.without_recording(number), search.without_run(number)
        best = of_part.confirmed()
        quick = LeaveOneOut(part, of_part).confirmed(best) if of_part.mixed.runs < ENOUGH_RUNS else best
        if all(c.key in here for c in quick.chosen):
            return quick.chosen  # nothing to look at closer
        refined = refine(part, present_effects(best), noise)
        return _found(part, of_part, best, refined, noise, joints, relevance).best.chosen

    gone: dict[Key, tuple[EffectCandidate, list[str]]] = {}
    sets: list[Sequence[EffectCandidate]] = []
    for without, chosen in named_by_fewer(dataset, search, names):
        new = [c for c in chosen if c.key not in here]
        for c in new:
            gone.setdefault(c.key, (c, []))[1].append(without)
        sets += [chosen] if new else []
    if not gone:
        return found, classes, []
    compared = Compared(dataset, search, found.best)
    beside = {
        key: search.hypothesis((*found.best.chosen, c), found.best.model)
        for key, (c, _) in gone.items()
        if search.fits_beside(c, found.best.chosen)
    }
    tried = [
        *beside.items(),
        *((None, search.hypothesis(chosen, found.best.model)) for chosen in sets),
    ]
    kept, why = _borne_out(dataset, found, compared, tried, noise, joints)
    proven = refine(
        dataset, present_effects(kept), noise
    )  # also where nothing is kept: torsion is set by the last one
    said = [kept_text(c, compared.nm(found.best), compared.nm(kept)) for c in kept.chosen if c.key in gone]
    there = {c.key for c in kept.chosen}
    for key, (c, runs) in gone.items():
        if key not in there:
            with_it = beside.get(key) or search.hypothesis([c], found.best.model)
            said.append(
                Gone(c, tuple(runs), (compared.nm(with_it), compared.nm(kept)), why.get(key, "")).text
            )
    if kept is not found.best:
        same = found.whole is found.best
        found = replace(found, best=kept, proven=proven)
        if same:
            found = replace(found, whole=kept, refined=proven)
        classes = _classes(search, found)
    return found, classes, said


def _borne_out(  # noqa: PLR0917
    dataset: Dataset,
    found: _Found,
    compared: Compared,
    tried: Sequence[tuple[Key | None, Hypothesis]],
    noise: Noise,
    joints: Mapping[int, Joint],
) -> tuple[Hypothesis, dict[Key, str]]:
    """Return the set that predicts the runs left out best, what is named included, and what speaks against an effect (by its
    key) that would have been better. Beside what is left over all have to be as certain as any cause.
    """
    kept, why = found.best, {}
    for key, other in tried:
        if not compared.clearly_better(other) or compared.nm(other) >= compared.nm(kept):
            continue
        refined = refine(dataset, present_effects(other), noise)
        against = objections(dataset, other, refined)
        unsteady = (
            found.beside
            and not against
            and (_proven(dataset, compared.search, other, refined, noise, joints)[0] is not other)
        )
        if not against and not unsteady:
            kept = other
        elif key is not None:
            why[key] = against[0][1] if against else _UNSTEADY
    return kept, why


def named(  # noqa: PLR0917
    dataset: Dataset,
    search: Search,
    best: Hypothesis,
    refined: Refined,
    noise: Noise,
    joints: Mapping[int, Joint],
    relevance: float,
) -> Sequence[EffectCandidate]:
    """Return what may be named of a dataset, without a look at fewer runs."""
    return _found(dataset, search, best, refined, noise, joints, relevance).best.chosen


def _squares(explained: Sequence[Mapping[Channel, float]]) -> float:
    return sum(r * r for e in explained for r in e.values())


def _classes(search: Search, found: _Found) -> list[tuple[EffectCandidate, ...]]:
    """Return per cause the alternatives that these runs do not rule out."""
    if found.few is not None:
        return [found.few.rivals(found.best, c) for c in found.best.chosen]
    alternatives = class_beside if found.beside else equivalence_class
    return [alternatives(search, found.best, c) for c in found.best.chosen]


def conclude(  # noqa: PLR0917
    dataset: Dataset,
    search: Search,
    best: Hypothesis,
    refined: Refined,
    noise: Noise,
    joints: Mapping[int, Joint],
    names: tuple[str, ...],
    numbers: tuple[int, ...],
    relevance: float = RELEVANCE,
    anew: Names | None = None,
) -> Findings:
    """Return the findings of one diagnosis; relevance: see RELEVANCE; anew: what is named without a recording."""
    found = _found(dataset, search, best, refined, noise, joints, relevance)
    found, classes, became = _with_fewer(dataset, search, found, noise, joints, relevance, anew)
    few, left, whole, judged, matters = found.few, found.left, found.whole, found.refined, found.matters
    gain = held_out_gain(dataset, found.proven)
    best, refined, classes = _without_asymmetry_at_rest(
        dataset, search, found.best, found.proven, noise, classes
    )
    causes, energies = _causes(dataset, search, best, refined, noise, classes)
    total = max(sum(energies) + left.energy_nm2(), 1e-30)
    causes = [replace(c, explained_share=e / total) for c, e in zip(causes, energies, strict=True)]
    rated = {n: joint.rated_torque_nm for n, joint in joints.items()}
    rest = _left_over(left, found.limits, rated, left.energy_nm2() / total, matters=matters)
    unsure = [] if few is None else few.unsure(whole, best, classes, causes)
    doubt = few.doubt(unsure) if few is not None and unsure else ""
    rivals = {r.key: c.effect.name for c, others in zip(best.chosen, classes, strict=True) for r in others}
    table = candidate_table(search, best, rivals, left_over=found.beside)
    reasons: list[str] = []
    if matters:
        verdict = UNEXPLAINED
        reasons += _closest(whole, causes, found.share)
        left, judged = _least_left(dataset, left, judged, noise, joints)
        reasons += left.reasons
        reasons += _told_from(table, max(rated.values())) if found.beside else []
    elif not causes:
        verdict = INSUFFICIENT if doubt else NO_GAP
        reasons += [doubt] if doubt else []
    else:
        verdict = CAUSE if all(len(c.names) == 1 for c in causes) and not doubt else AMBIGUOUS
    causes.sort(key=lambda c: -c.rms_nm)
    gaps = channel_gaps(dataset, judged if matters else refined, left if matters else None)
    if not reasons:
        reasons = [s for s in (_reason(verdict, causes, gaps), doubt) if s]
    return Findings(
        verdict,
        (*reasons, *found.refused, *became),
        names,
        numbers,
        gaps,
        tuple(causes),
        table,
        gain if causes else None,
        next_experiment=_settling_experiment(verdict, causes, unsure, joints, dataset),
        traces=traces(dataset, judged if matters else refined),
        explained_share=sum(energies) / total if causes else math.nan,
        left_over=rest,
    )


def _causes(  # noqa: PLR0917
    dataset: Dataset,
    search: Search,
    best: Hypothesis,
    refined: Refined,
    noise: Noise,
    classes: Sequence[tuple[EffectCandidate, ...]],
) -> tuple[list[Cause], list[float]]:
    """Return the causes, and the energy that each explains, summed over channels [Nm^2]."""
    explained = [_rms_at(dataset, p) for p in refined.present]
    steady = steadiness(refined, noise, nothing_of(best))
    causes = [
        replace(
            _cause(search, best, refined, k, classes[k], *_largest(explained[k])), steadiness=steady[k].ratio
        )
        for k in range(len(classes))
    ]
    return causes, [_squares([e]) for e in explained]


def _left_over(
    left: Leftover,
    limits: Mapping[Channel, float],
    rated: Mapping[int, float],
    share: float,
    *,
    matters: bool,
) -> LeftOver:
    """Return what is left over in the channel where it is most, against its limit [Nm]."""
    sizes = {c: left.worst_nm.get(c, 0.0) for c in limits}
    worst = max(sizes, key=lambda c: sizes[c] / limits[c] if limits[c] > 0.0 else sizes[c])
    size = sizes[worst]
    return LeftOver(
        worst.joint, worst.balance, size, size / rated[worst.joint], share, limits[worst], matters
    )


def _closest(whole: Hypothesis, causes: Sequence[Cause], share: float) -> list[str]:
    """Return what to say of effects that were found although something matters that they leave."""
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


def _told_from(table: Sequence[CandidateEvidence], rated_nm: float) -> list[str]:
    """Return how large an effect must be to be told beside what is left over; none is larger than the rated torque."""
    seen = sorted((c.minimum_rms_nm, c.name) for c in table if c.minimum_rms_nm < rated_nm)
    if not seen:
        return []
    (low, easiest), (high, hardest) = seen[0], seen[-1]
    return [
        f"on these runs an effect below {low:.2g} Nm rms ({easiest.replace('_', ' ')}) to {high:.2g} Nm rms"
        f" ({hardest.replace('_', ' ')}) cannot be told from what is left over"
    ]


def _guarded(  # noqa: PLR0917
    dataset: Dataset,
    search: Search,
    best: Hypothesis,
    refined: Refined,
    noise: Noise,
    joints: Mapping[int, Joint],
    *,
    bounds_only: bool = False,
) -> tuple[Hypothesis, Refined, list[dict[Channel, float]], list[str]]:
    """Return hypothesis, refinement and rms without irrelevant causes and without those that a guard objects to, and the
    objections; with enough runs the search is made again without the first of them.
    """
    said: list[str] = []
    while True:
        best, refined, rms = _without_negligible(dataset, search, best, refined, noise, joints)
        found = objections(dataset, best, refined, bounds_only=bounds_only)
        if not found:
            return best, refined, rms, said[:_MOST_SAID]
        weak = [best.chosen[k] for k, _ in found]
        again = not said and search.mixed.runs >= ENOUGH_RUNS
        for c, (_, why) in zip(weak, found, strict=True):
            said.append(f"{c.effect.name} of {joint_text(c.joint)} fits but is not named: {why}")
            search.rejected.add(c.key)
        rest = [c for c in best.chosen if c not in weak]
        best = search.confirmed() if again else search.hypothesis(rest, best.model)
        refined = refine(dataset, present_effects(best), noise)


def _proven(  # noqa: PLR0917
    dataset: Dataset,
    search: Search,
    best: Hypothesis,
    refined: Refined,
    noise: Noise,
    joints: Mapping[int, Joint],
) -> tuple[Hypothesis, Refined]:
    """Return the same with those causes only that are certain whatever is left over (`steadiness`)."""
    while best.chosen:
        margins = [s.margin for s in steadiness(refined, noise, nothing_of(best))]
        if min(margins) >= 1.0:
            break
        least = max(min(margins), _FAR_FROM_CERTAIN)
        best = search.hypothesis(
            [c for c, m in zip(best.chosen, margins, strict=True) if m > least], best.model
        )
        refined = refine(dataset, present_effects(best), noise)
    best, refined, _ = _without_negligible(dataset, search, best, refined, noise, joints)
    return best, refined


def _least_left(
    dataset: Dataset, left: Leftover, refined: Refined, noise: Noise, joints: Mapping[int, Joint]
) -> tuple[Leftover, Refined]:
    """Return what is left over without any cause where that is less: a fit that is bent leaves more than there was, and in
    other places.
    """
    if not refined.present:
        return left, refined
    bare = refine(dataset, (), noise)
    without = leftover(dataset, bare, noise, joints)
    return (without, bare) if without.energy_nm2() <= left.energy_nm2() else (left, refined)


def _without_asymmetry_at_rest(  # noqa: PLR0917
    dataset: Dataset,
    search: Search,
    best: Hypothesis,
    refined: Refined,
    noise: Noise,
    classes: list[tuple[EffectCandidate, ...]],
) -> tuple[Hypothesis, Refined, list[tuple[EffectCandidate, ...]]]:
    """Return the same without friction asymmetry where the current at rest shows that it is an offset (`current_zero`)."""
    pair = {"current_offset", "friction_asymmetry"}
    for k, cause in enumerate(best.chosen):
        twin = next(
            (c for c in classes[k] if c.joint == cause.joint and {c.effect.name, cause.effect.name} == pair),
            None,
        )
        if twin is None or not isinstance(cause.joint, int):
            continue
        offset = cause if cause.effect.name == "current_offset" else twin
        others = [c for c in best.chosen if c is not cause]
        as_offset = search.hypothesis((*others, offset), best.model)
        size = offset.term.combine(as_offset.coefficients(offset))["offset_a"]
        if not offset_at_rest(rest_current(dataset.signals, cause.joint), size):
            continue
        rest = tuple(c for c in classes[k] if c is not twin)
        if cause is not offset:
            best = search.hypothesis((*others, twin), best.model)
            refined = refine(dataset, present_effects(best), noise)
            by_key = {
                c.key: found for c, found in zip((*others, twin), (*_others(classes, k), rest), strict=True)
            }
            return best, refined, [by_key[c.key] for c in best.chosen]
        classes = [*classes[:k], rest, *classes[k + 1 :]]
    return best, refined, classes


def _others(classes: Sequence[tuple[EffectCandidate, ...]], k: int) -> list[tuple[EffectCandidate, ...]]:
    return [c for j, c in enumerate(classes) if j != k]


def _settling_experiment(
    verdict: str,
    causes: Sequence[Cause],
    unsure: Sequence[tuple[str, JointName]],
    joints: Mapping[int, Joint],
    dataset: Dataset,
) -> dict[str, Any] | None:
    """Return the experiment that would settle an ambiguous verdict, a class beside something left over, or one of too few
    runs; unsure: what does not hold on every held-out run.
    """
    in_class = any(len(c.names) > 1 for c in causes)
    if verdict not in (AMBIGUOUS, INSUFFICIENT) and not (verdict == UNEXPLAINED and in_class):
        return None
    classes = [tuple(dict.fromkeys(n.split(" of ")[0] for n in c.names)) for c in causes if len(c.names) > 1]
    known = {s.number: joints[s.number] for s in dataset.signals[0]}
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
    return next_experiment(classes, known, text, temperature=warm, signals=seen)


def _without_negligible(  # noqa: PLR0917
    dataset: Dataset,
    search: Search,
    best: Hypothesis,
    refined: Refined,
    noise: Noise,
    joints: Mapping[int, Joint],
) -> tuple[Hypothesis, Refined, list[dict[Channel, float]]]:
    """Return hypothesis and refinement without irrelevant causes, and the rms of each in each channel."""
    rated = max(j.rated_torque_nm for j in joints.values())
    while True:
        rms = [_rms_at(dataset, p) for p in refined.present]
        sizes = [max(r.values(), default=0.0) for r in rms]
        least = max(RELEVANT * rated, BESIDE * max(sizes, default=0.0))
        large = [c for c, size in zip(best.chosen, sizes, strict=True) if size >= least]
        if len(large) == len(best.chosen):
            return best, refined, rms
        best = search.hypothesis(large, best.model)
        refined = refine(dataset, present_effects(best), noise)


def _rms_at(dataset: Dataset, present: PresentEffect) -> dict[Channel, float]:
    """Return the rms of one cause's contribution in each channel, Nm, over valid bins."""
    found = {c: np.concatenate(parts) for c, parts in contributions(dataset, present).items()}
    return {c: float(np.sqrt(np.mean(x * x))) for c, x in found.items() if len(x)}


def _largest(rms: Mapping[Channel, float]) -> tuple[float, str]:
    channel = max(rms, key=lambda c: rms[c])
    return rms[channel], channel.balance


def _cause(  # noqa: PLR0917
    search: Search,
    best: Hypothesis,
    refined: Refined,
    k: int,
    rivals: Sequence[EffectCandidate],
    rms_nm: float,
    balance: str,
) -> Cause:
    candidate = best.chosen[k]
    present = refined.present[k]
    first = sum(len(p.free) for p in refined.present[:k])
    values: dict[str, Value] = {}
    runs = refined.mixed.runs
    zero = candidate.term.combine([0.0] * candidate.size)
    for name, value in present.values.items():
        unit = parameter(present.effect, name).unit
        if name in present.free:
            place = first + present.free.index(name)
            share = float(refined.random_share[place])
            freedom = min((runs - 1.0) / max(share, 1e-3) ** 2, 1e4)
            half = student_975(freedom) * float(np.sqrt(refined.covariance[place, place]))
            # a phase has no size of its own: an angle of the same part of the wave
            size = 1.0 if name == "phase_rad" else abs(value - zero.get(name, 0.0))
            half = float(np.hypot(half, INACCURATE * size))
            if runs < ENOUGH_RUNS:  # no narrower than what the runs say one without the other
                half = max(half, *(abs(float(step[place])) for step in left_out_steps(refined)))
            low, high = value - half, value + half
            if name != "phase_rad":  # nothing is known beyond what the library thinks possible
                p = parameter(present.effect, name)
                low, high = max(low, p.low), min(high, p.high)
            values[name] = Value(value, (low, high), unit)
        elif parameter(present.effect, name).fixed:
            values[name] = Value(value, (value, value), unit)
    without = search.hypothesis([c for c in best.chosen if c is not candidate], best.model)
    names = [candidate.effect.name]
    for rival in rivals:
        label = rival.effect.name
        if rival.joint != candidate.joint:
            label += f" of {joint_text(rival.joint)}"
        if label not in names:
            names.append(label)
    evidence = max(without.model.deviance - best.model.deviance, 1e-9)
    return Cause(
        candidate.effect.name,
        candidate.joint,
        tuple(names),
        _normal_phase(values),
        without.bic - best.bic,
        search.held_out(best, candidate) / evidence,
        rms_nm,
        balance,
    )


def _normal_phase(values: dict[str, Value]) -> dict[str, Value]:
    """Return the parameters with phases in (-pi, pi] and no negative amplitude."""
    out = dict(values)
    phase = out.get("phase_rad")
    if phase is None:
        return out
    turn = 0.0
    for name in ("amplitude_nm", "amplitude_rad", "moment_nm"):
        v = out.get(name)
        if v is not None and v.value < 0.0:
            out[name] = Value(-v.value, (-v.ci95[1], -v.ci95[0]), v.unit)
            turn = np.pi
    value = phase.value + turn
    shift = value - float(np.angle(np.exp(1j * value)))
    low, high = phase.ci95
    out["phase_rad"] = Value(value - shift, (low + turn - shift, high + turn - shift), phase.unit)
    return out


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
