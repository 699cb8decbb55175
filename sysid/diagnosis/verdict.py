"""Verdict: the entries of the set with grade, interval and size, what remains, and what these runs cannot tell.

An entry is *certain* where nothing of `grade_of` speaks against it, *one of* where a set without it has nearly as much
evidence, else *effective*: it predicts. One relevance decides the verdict, for entries and for what remains alike.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.effects import EFFECTS
from jtqd.estimator.effects.effect import Effect
from jtqd.sysid.diagnosis import limits
from jtqd.sysid.diagnosis.dataset import Dataset
from jtqd.sysid.diagnosis.entries import Entry, present_effects
from jtqd.sysid.diagnosis.evidence import Set, Sets
from jtqd.sysid.diagnosis.findings import (
    AMBIGUOUS,
    CAUSE,
    CERTAIN,
    EFFECTIVE,
    NO_GAP,
    ONE_OF,
    UNEXPLAINED,
    CandidateEvidence,
    Cause,
    Findings,
    JointName,
    Present,
    Scope,
    UnexplainedResidual,
    Untold,
    Value,
    joint_text,
)
from jtqd.sysid.diagnosis.held_out import Prediction, Sizes, fits_without, gain_of, predict
from jtqd.sysid.diagnosis.model import Solution, recorded
from jtqd.sysid.diagnosis.next_experiment import next_experiment
from jtqd.sysid.diagnosis.signals import Channel
from jtqd.sysid.diagnosis.unexplained import (
    Unexplained,
    channel_gaps,
    contributions,
    held_nm,
    remaining,
    traces,
    unexplained_residual,
)

_Z95: Final = 1.96


@dataclass(frozen=True)
class Judged:
    """Entries that are one effect, in the set: their places, rms per channel [Nm], twice the log evidence that the best set
    without them lacks, and that the set without them lacks where a discrepancy may imitate them, that best set's entries
    instead, deviations of the coefficients [z] from none; how much their size differs from run to run, and the standard
    error of its mean over runs, parts of it.
    """

    members: tuple[int, ...]
    present: Present
    rms_nm: Mapping[Channel, float]
    delta: float
    imitated: float
    rivals: tuple[Entry, ...]
    z: float
    differs: float
    error: float


def present_of(solution: Solution) -> tuple[list[Present], FloatArray]:
    """Return the effects of the set, and what each recording has of its own without discrepancy [r, q]."""
    mean = solution.sets.fit(solution.chosen).mean
    found = [(solution.entries[k], mean[at]) for k, at in solution.sets.places(solution.chosen).items()]
    return present_effects(found), np.array([u[: len(solution.dataset.families)] for u in solution.own_means])


def judged(solution: Solution) -> list[Judged]:
    """Return the effects of the set."""
    sets, chosen = solution.sets, solution.chosen
    plain = solution.equations.sets(solution.variances, chosen, resembling=False)
    recorder = copy(solution.equations)
    recorder.recorded = recorded(
        solution.entries, max(s.step_s for run in solution.dataset.signals for s in run)
    )
    imitating = recorder.sets(solution.variances, chosen)
    sizes = Sizes(fits_without(solution), chosen)
    values = sets.fit(chosen)
    places = sets.places(chosen)
    out = []
    for members in sets.effects(chosen):
        found = [(solution.entries[k], values.mean[places[k]]) for k in members]
        [present] = present_effects(found)
        rival = sets.without(chosen, members)
        imitated = imitating.fit(chosen).evidence - imitating.fit(chosen - set(members)).evidence
        at = np.concatenate([np.arange(places[k].start, places[k].stop) for k in members])
        mean = values.mean[at]
        z2 = float(mean @ np.linalg.solve(solution.covariance[np.ix_(at, at)], mean))
        out.append(
            Judged(
                members,
                present,
                _rms(solution, present),
                plain.lacks(chosen, rival),
                2.0 * imitated,
                tuple(sets.entries[k] for k in rival - chosen),
                math.sqrt(max(z2, 0.0)),
                *sizes.over_runs(at),
            )
        )
    return out


def _rms(solution: Solution, present: Present) -> dict[Channel, float]:
    """Return the rms of an effect per channel over valid bins of all runs, a constant in torsion taken off."""
    squares: dict[Channel, list[FloatArray]] = {}
    for run, found in zip(solution.dataset.runs, contributions(solution.dataset, present), strict=True):
        for channel, value in found.items():
            part = value[run.channels[channel].valid]
            if channel.balance == "torsion" and len(part):
                part = part - part.mean()
            squares.setdefault(channel, []).append(part * part)
    return {
        c: float(np.sqrt(np.mean(np.concatenate(x)))) if sum(map(len, x)) else 0.0 for c, x in squares.items()
    }


def grade_of(j: Judged, *, hidden: bool) -> tuple[str, tuple[str, ...]]:
    """Return the grade of an effect, and why it is not certain; see the module. hidden: what remains in its balance is
    larger than itself.
    """
    size = f"its size differs by {100.0 * j.differs:.0f} % from run to run"
    doubts = {
        "other entries explain these runs alike": j.delta <= limits.RIVAL,
        "a discrepancy, or a recorder within its step, would look alike": j.imitated <= limits.RIVAL,
        f"it is less than {limits.SURE:g} standard deviations from none": j.z <= limits.SURE,
        size if math.isfinite(j.differs) else "one run has no other to agree with": j.error >= limits.AGREE,
        "more than it remains in its balance": hidden,
    }
    found = tuple(text for text, holds in doubts.items() if holds)
    return (ONE_OF if j.delta <= limits.RIVAL and j.rivals else EFFECTIVE if found else CERTAIN), found


def conclude(solution: Solution, names: tuple[str, ...], scope: Scope, relevance: float) -> Findings:
    """Return the findings of one diagnosis, without what was noted on its runs before."""
    dataset = solution.dataset
    prediction = predict(solution)
    effects = judged(solution)
    rated = {n: joint.rated_torque_nm for n, joint in dataset.joints.items()}
    limits_nm = {c: relevance * rated[c.joint] for c in dataset.runs[0].channels}
    left = remaining(dataset, *present_of(solution))
    rest = unexplained_residual(left)
    predicting = extended_effects(solution, prediction)
    if (
        _largest(rest, limits_nm) > 1.0
    ):  # the discrepancy has a part in the set's values, none in those that predict
        own = solution.own(prediction.mean, prediction.chosen)[:, : len(dataset.families)]
        other = remaining(dataset, predicting, own)
        less = unexplained_residual(other)
        if _largest(less, limits_nm) < _largest(rest, limits_nm):
            left, rest = other, less
    held = held_nm(left)
    total = sum(sum(r * r for r in j.rms_nm.values()) for j in effects) + rest.energy_nm2()
    causes = sorted((_cause(solution, j, total, rest) for j in effects), key=lambda c: -c.rms_nm)
    matter = [c for c in causes if c.rms_nm >= limits_nm[_channel(c, dataset)]]
    listed = [c for c in causes if c.rms_nm >= limits.LISTED * limits_nm[_channel(c, dataset)]]
    listed = [c if c in matter else replace(c, matters=False) for c in listed]
    small = [replace(c, matters=False) for c in causes if all(c.key != x.key for x in listed)]
    unexplained = _unexplained(rest, held, limits_nm, rated, total)
    if unexplained.matters:
        verdict = UNEXPLAINED
    elif matter:
        verdict = CAUSE if all(c.grade == CERTAIN for c in matter) else AMBIGUOUS
    else:
        verdict = NO_GAP
    table, untold = entry_table(solution, causes, scope)
    gaps = channel_gaps(left, rest, unexplained.matters)
    reasons = rest.reasons if unexplained.matters else []
    gain = gain_of(solution, prediction) if prediction.chosen else None
    return Findings(
        verdict,
        tuple(reasons),
        names,
        tuple(sorted(dataset.joints)),
        gaps,
        tuple(listed),
        table,
        gain,
        traces=traces(left),
        explained_share=1.0 - rest.energy_nm2() / max(total, 1e-30) if causes else math.nan,
        unexplained=unexplained,
        too_small=tuple(small),
        cannot_be_told=untold,
        predicts=tuple(predicting),
        next_experiment=_next(matter, effects, dataset),
    )


def _largest(rest: Unexplained, limits_nm: Mapping[Channel, float]) -> float:
    """Return the largest of what remains in parts of its limit."""
    return max((rest.worst_nm.get(c, 0.0) / max(nm, 1e-12) for c, nm in limits_nm.items()), default=0.0)


def _channel(cause: Cause, dataset: Dataset) -> Channel:
    number = cause.joint if isinstance(cause.joint, int) else next(iter(dataset.joints))
    return Channel(number, cause.balance)


def _cause(solution: Solution, j: Judged, total_nm2: float, rest: Unexplained) -> Cause:
    channel = max(j.rms_nm, key=lambda c: j.rms_nm[c])
    remains = math.sqrt(rest.by_channel().get(channel, 0.0))
    grade, doubts = grade_of(j, hidden=remains > j.rms_nm[channel])
    rivals = tuple(
        dict.fromkeys(
            e.effect.name + (f" of {joint_text(e.joint)}" if e.joint != j.present.joint else "")
            for e in j.rivals
        )
    )
    name = j.present.name
    squares = sum(r * r for r in j.rms_nm.values())
    return Cause(
        name,
        j.present.joint,
        (name, *(r for r in rivals if r != name)) if grade == ONE_OF else (name,),
        values_of(solution, j),
        j.delta,
        j.rms_nm[channel],
        channel.balance,
        explained_share=squares / max(total_nm2, 1e-30),
        grade=grade,
        rivals=rivals if grade == ONE_OF else (),
        given=tuple(dict.fromkeys(solution.entries[k].prior.text for k in j.members)),
        doubts=doubts,
    )


def values_of(solution: Solution, j: Judged) -> dict[str, Value]:
    """Return the parameters of an effect with 95 % intervals, no narrower than what the equations simplify."""
    fit = solution.sets.fit(solution.chosen)
    places = solution.sets.places(solution.chosen)
    half: dict[str, float] = dict.fromkeys(j.present.values, 0.0)
    none: dict[str, float] = {}
    for k in j.members:
        e, at = solution.entries[k], places[k]
        mean, covariance = fit.mean[at], solution.covariance[at, at]
        here = e.values(mean)
        none = e.candidate.nothing | none
        for name in here:
            slope = np.array([_slope(e, mean, i, name) for i in range(e.size)])
            half[name] = max(half[name], _Z95 * math.sqrt(max(float(slope @ covariance @ slope), 0.0)))
    out: dict[str, Value] = {}
    for p in j.present.effect.parameters:
        value = j.present.values.get(p.name)
        if value is None:
            continue
        if half[p.name] <= 0.0:
            if p.fixed:
                out[p.name] = Value(value, (value, value), p.unit)
            continue
        without = 0.0 if p.name.startswith("reference") else none.get(p.name, 0.0)
        size = 1.0 if p.name == "phase_rad" else abs(value - without)
        wide = math.hypot(half[p.name], limits.INACCURATE * size)
        low, high = value - wide, value + wide
        if p.name != "phase_rad":
            low, high = max(low, p.low), min(high, p.high)
        out[p.name] = Value(value, (low, high), p.unit)
    return out


def _slope(e: Entry, mean: FloatArray, i: int, name: str) -> float:
    step = 1e-4 * max(abs(float(mean[i])), 1e-3)
    up, down = mean.copy(), mean.copy()
    up[i] += step
    down[i] -= step
    change = float(e.values(up)[name] - e.values(down)[name])
    if name == "phase_rad":
        change = float(np.angle(np.exp(1j * change)))
    return change / (2.0 * step)


def _unexplained(
    rest: Unexplained,
    held: Mapping[Channel, float],
    limits_nm: Mapping[Channel, float],
    rated: Mapping[int, float],
    total_nm2: float,
) -> UnexplainedResidual:
    """Return what remains in the channel where it is most, against its limit."""
    sizes = {c: max(rest.worst_nm.get(c, 0.0), held.get(c, 0.0)) for c in limits_nm}
    worst = max(sizes, key=lambda c: sizes[c] / limits_nm[c] if limits_nm[c] > 0.0 else sizes[c])
    return UnexplainedResidual(
        worst.joint,
        worst.balance,
        sizes[worst],
        100.0 * (sizes[worst] / rated[worst.joint]),
        rest.energy_nm2() / max(total_nm2, 1e-30),
        limits_nm[worst],
        sizes[worst] > limits_nm[worst],
    )


def entry_table(
    solution: Solution, causes: Sequence[Cause], scope: Scope
) -> tuple[tuple[CandidateEvidence, ...], tuple[Untold, ...]]:
    """Return one row per effect and joint: in the set, or why not, and the smallest size that would be; and what these runs
    cannot tell.
    """
    sets, chosen = solution.sets, solution.chosen
    gains = sets.gains(chosen)
    untold = set(sets.untold(chosen)) | set(solution.equations.noisy)
    there = {(c.name, c.joint): c for c in causes}
    of: dict[tuple[str, JointName], list[int]] = {}
    for k, e in enumerate(sets.entries):
        of.setdefault(e.key, []).append(k)
    rows, lost = [], []
    for (name, joint), members in of.items():
        cause = there.get((name, joint))
        best = max(members, key=lambda k: gains[k])
        smallest = min((_smallest(sets, chosen, k) for k in members if k not in untold), default=math.inf)
        if cause is not None:
            reason = "; ".join((f"in the set, {cause.grade}", *cause.doubts))
        elif all(k in untold for k in members):
            reason = "cannot be told from these runs"
            lost.append(Untold(name, joint, reason, EFFECTS[name].experiment))
        else:
            reason = "no evidence beyond the set"
        rows.append(
            CandidateEvidence(
                name,
                joint,
                cause.delta_evidence if cause else 2.0 * float(gains[best]),
                _minimum(sets.entries[best], smallest),
                reason,
            )
        )
    looked_at = {name for name, _ in of}
    first = min(solution.dataset.joints)
    for name, effect in EFFECTS.items():
        if name in looked_at:
            continue
        reason, motion = _absent(effect, solution.dataset, scope)
        if reason and motion is not None:
            lost.append(Untold(name, first, reason, motion))
        rows.append(CandidateEvidence(name, first, math.nan, {}, reason))
    rows.sort(key=lambda r: -r.delta_bic if math.isfinite(r.delta_bic) else math.inf)
    return tuple(rows), tuple(lost)


def _absent(effect: Effect, dataset: Dataset, scope: Scope) -> tuple[str, str | None]:
    """Return why no entry of an effect competed, and the kind of motion that would show it: "" where a channel lacks, None
    where nothing is asked for.
    """
    if any(effect.name == name for _, name in scope.out):
        return "not looked for, as asked", None
    if dataset.no_torque and effect.hooks == ("sensor_nm",):
        return "no torque was measured", None
    bends = {"twist_rad", "link_rad"} >= set(effect.hooks)
    if bends and all(s.torsion_nm is None for s in dataset.signals[0]):
        return "needs encoders on both sides", ""
    if "temperature_c" in effect.needs and not np.isfinite(dataset.signals[0][0].state.temperature_c).any():
        return "needs a temperature", ""
    return "nothing of it varies in these runs", effect.experiment


def _smallest(sets: Sets, chosen: Set, k: int) -> float:
    """Return the coefficient of a single-column entry at which its evidence would be RIVAL / 2 beyond nothing."""
    e = sets.entries[k]
    at = sets.columns(chosen - {k})
    s = sets.slices[k][0]
    fit = sets.fit(chosen - {k})
    inner = float(sets.gram[s, s] - sets.gram[s, at] @ fit.covariance @ sets.gram[at, s])
    if inner <= 0.0:
        return math.inf
    needed = 0.5 * limits.RIVAL - e.odds + 0.5 * e.size * math.log(inner + 1.0)
    return math.sqrt(2.0 * max(needed, 0.0) * (inner + 1.0)) / inner


def _minimum(e: Entry, smallest: float) -> dict[str, Value]:
    """Return the leading parameter at its smallest size."""
    if not math.isfinite(smallest):
        return {}
    scaled = np.zeros(e.size)
    scaled[0] = smallest
    values = e.values(scaled)
    none = e.candidate.nothing
    unit = {p.name: p.unit for p in e.effect.parameters}
    return {
        n: Value(abs(v - none.get(n, 0.0)), (math.nan, math.nan), unit[n])
        for n, v in values.items()
        if v != none.get(n) and n != "phase_rad"
    }


def extended_effects(solution: Solution, prediction: Prediction) -> list[Present]:
    """Return the effects of the extended model with the values that predict."""
    places = solution.sets.places(prediction.chosen)
    return present_effects([(solution.entries[k], prediction.mean[at]) for k, at in places.items()])


def _next(causes: Sequence[Cause], effects: Sequence[Judged], dataset: Dataset) -> dict[str, Any] | None:
    """Return the experiment that would settle what is not certain and has rivals."""
    rivals = {(j.present.name, j.present.joint): [e.effect.name for e in j.rivals] for j in effects}
    open_causes = [
        (c, tuple(dict.fromkeys((c.name, *rivals[c.name, c.joint])))) for c in causes if c.grade != CERTAIN
    ]
    open_causes = [(c, names) for c, names in open_causes if len(names) > 1]
    if not open_causes:
        return None
    text = "; ".join(
        f"{' and '.join(names)} {'fit these runs equally well' if c.grade == ONE_OF else 'are not settled'}"
        for c, names in open_causes
    )
    warm = bool(np.isfinite(dataset.signals[0][0].state.temperature_c).any())
    return next_experiment(
        [names for _, names in open_causes],
        dataset.joints,
        text,
        temperature=warm,
        signals=[run[0] for run in dataset.signals],
    )
