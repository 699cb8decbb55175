"""Verdict: the values that predict and their gain on held-out runs; the entries of the set with grade, interval and size;
what remains, and what these runs cannot tell.

Evidence distinguishes sets; what predicts is another estimate, without discrepancy: a mixture of the set and of the set with
all values of the file, each under its priors (`stacked`). Errors are in Nm. The response of each balance has weight one, so
an error is that of the current that the simulation needs (as torque, G Kt i) and of the twist.

An entry is *certain* where nothing of `grade_of` speaks against it, *one of* where a set without it has nearly as much
evidence, else *effective*: it predicts. One relevance decides the verdict, for entries and for what remains alike.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from copy import copy, deepcopy
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.effects import EFFECTS
from jtqd.estimator.effects.effect import TORSION, Effect, Values
from jtqd.sysid.diagnosis import limits
from jtqd.sysid.diagnosis.dataset import Dataset
from jtqd.sysid.diagnosis.entries import Entry, present_effects
from jtqd.sysid.diagnosis.evidence import Set, Sets, without_noise
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
    Gain,
    JointName,
    Present,
    RunGain,
    Scope,
    UnexplainedResidual,
    Untold,
    Value,
    joint_text,
    shows_at,
)
from jtqd.sysid.diagnosis.model import Solution, recorded
from jtqd.sysid.diagnosis.next_experiment import next_experiment
from jtqd.sysid.diagnosis.regressors import Index, RunData, contribution
from jtqd.sysid.diagnosis.signals import Channel, JointSignals
from jtqd.sysid.diagnosis.unexplained import (
    Unexplained,
    channel_gaps,
    held_nm,
    remaining,
    traces,
    unexplained_residual,
)

_Z95: Final = 1.96
_BOOTSTRAPS: Final = 2000
_NONE: Final = 1e-12


@dataclass(frozen=True)
class Prediction:
    """The set that predicts: entries, their scaled coefficients, its effects, and per channel and recording the sums of
    squares before and after [Nm^2], each recording with the coefficients of all others, and the count of bins [r, 3].
    """

    chosen: Set
    mean: FloatArray
    effects: list[Present]
    squares: dict[Channel, FloatArray]


def predict(solution: Solution) -> Prediction:
    """Return what predicts: the set without entries whose size differs from run to run by more than itself, as a model that
    is complete has it, at the states of its own simulation.
    """
    chosen = steady(solution)
    return predicted(solution.settled(chosen, without_discrepancy(solution)), chosen)


def steady(solution: Solution) -> Set:
    """Return the set without entries whose size differs from run to run by more than itself: without these the error is
    less.
    """
    without, chosen = fits_without(solution), solution.chosen
    while chosen:
        sizes = Sizes(without, chosen)
        places = without[-1].places(chosen)
        differs = {k: sizes.over_runs(np.arange(s.start, s.stop))[0] for k, s in places.items()}
        worst = max(differs, key=differs.__getitem__)
        if not 1.0 < differs[worst] < math.inf:
            break
        chosen -= {worst}
    return chosen


def predicted(solution: Solution, chosen: Set) -> Prediction:
    """Return what predicts between a set and the set with all values of the file: what held-out runs want."""
    grams, counts = _grams(solution)
    without = fits_without(solution)
    wide = chosen | (solution.sized.values - solution.sized.alike(chosen))
    part = stacked(grams, without, chosen, wide) if len(grams) > 1 else 0.0
    mixed = [sets.coefficients(chosen) + part * _added(sets, chosen, wide) for sets in without]
    contrasts = [np.append(-mean, 1.0) for mean in mixed[:-1]]
    each = list(zip(grams, contrasts, counts, strict=True))
    squares = {
        c: np.array([(g[c][-1, -1], float(x @ g[c] @ x), count[c]) for g, x, count in each]) for c in grams[0]
    }
    named = wide if part > 0.0 else chosen
    mean = mixed[-1][without[-1].columns(named)]
    return Prediction(named, mean, effects_of(without[-1], named, mean), squares)


def stacked(
    grams: Sequence[dict[Channel, FloatArray]], without: Sequence[Sets], chosen: Set, wide: Set
) -> float:
    """Return the part of the wide set, 0 to 1, at which the mixture of two sets errs least on held-out runs (stacking:
    Wolpert 1992, Neural Networks 5; Yao et al. 2018, Bayesian Analysis 13).
    """
    slope = curvature = 0.0
    for run, sets in zip(grams, without[:-1], strict=True):
        few, step = sets.coefficients(chosen), _added(sets, chosen, wide)
        for gram in run.values():
            slope += float(step @ (gram[:-1, -1] - gram[:-1, :-1] @ few))
            curvature += float(step @ gram[:-1, :-1] @ step)
    return min(max(slope / curvature, 0.0), 1.0) if curvature > 0.0 else 0.0


def _added(sets: Sets, chosen: Set, wide: Set) -> FloatArray:
    """Return what a wide set adds to a set whose entries keep their sizes [E]: those are where simulations settled."""
    left = np.eye(len(sets.gram))
    left[:-1, -1] = -sets.coefficients(chosen)
    return Sets(sets.entries, left.T @ sets.gram @ left).coefficients(wide - chosen)


def without_discrepancy(solution: Solution) -> dict[object, float]:
    """Return the variances of a model that is complete."""
    return {
        g: v if isinstance(g, tuple) and g[0] == "family" else _NONE for g, v in solution.variances.items()
    }


def fits_without(solution: Solution) -> list[Sets]:
    """Return the sets without each recording in turn, and with all (of one recording: with it); without discrepancy."""
    *without, everything = solution.sized.marginal(without_discrepancy(solution))
    if len(without) == 1:
        without = [everything]
    return [Sets(solution.entries, gram) for gram in (*without, everything)]


class Sizes:
    """The size of an effect in each recording alone, beside all others of a set with the values of all recordings."""

    def __init__(self, without: Sequence[Sets], chosen: Set) -> None:
        """Take the sets without each recording in turn, and with all."""
        everything = without[-1]
        self._mean = everything.fit(chosen).mean
        at = np.append(everything.columns(chosen), -1)
        total = everything.gram[np.ix_(at, at)]
        self._runs = [total - sets.gram[np.ix_(at, at)] for sets in without[:-1]]

    def over_runs(self, at: Index) -> tuple[float, float]:
        """Return how much the size of the coefficients at these places of the set differs from recording to recording (rms,
        each weighted by what it holds of it), and the standard error of its mean, parts of it; inf with one recording.
        """
        energy, lacking, count = 0.0, 0.0, 0
        for gram in self._runs:
            own = float(self._mean[at] @ gram[np.ix_(at, at)] @ self._mean[at])
            more = float(self._mean[at] @ (gram[at, -1] - gram[at, :-1] @ self._mean))
            if own > 0.0:
                energy, lacking, count = energy + own, lacking + more**2 / own, count + 1
        if count < 2:
            return math.inf, math.inf
        differs = math.sqrt(lacking / energy)
        return differs, differs / math.sqrt(count - 1)


def _grams(solution: Solution) -> tuple[list[dict[Channel, FloatArray]], list[dict[Channel, int]]]:
    """Return per recording and channel the normal equations over [entries, response] in Nm, less what noise of torques puts
    into the columns, and the count of bins.
    """
    weights = solution.transform()
    pieces = solution.dataset.recordings
    channels = list(solution.runs[0].channels)
    grams = [{c: np.zeros((weights.shape[1] + 1,) * 2) for c in channels} for _ in range(max(pieces) + 1)]
    extra = deepcopy(grams)
    counts = [dict.fromkeys(channels, 0) for _ in grams]
    noisy = {run.name: run for run in solution.disturbed}
    for r, run in enumerate(solution.runs):
        for c in channels:
            x = _rows(run, c, weights)
            counts[pieces[r]][c] += len(x)
            grams[pieces[r]][c] += x.T @ x
            if run.name in noisy:
                noise = _rows(noisy[run.name], c, weights, run) - x
                extra[pieces[r]][c] += noise.T @ noise
    each = {c: without_noise(*(np.array([of[c] for of in x]) for x in (grams, extra)))[0] for c in channels}
    clean = [{c: each[c][r] for c in channels} for r in range(len(grams))]
    return clean, counts


def _rows(run: RunData, channel: Channel, weights: FloatArray, valid_of: RunData | None = None) -> FloatArray:
    """Return columns of entries and response in Nm in the valid bins (of another run, where given)."""
    d = run.channels[channel]
    valid = (valid_of or run).channels[channel].valid
    x = np.column_stack(((d.regressors @ weights[d.index])[valid], d.residual[valid]))
    return np.asarray(x - x.mean(axis=0) if channel.balance == TORSION and len(x) else x)


def gain_of(solution: Solution, prediction: Prediction, seed: int = 0) -> Gain:
    """Return the error of the simulation's torque before and after, in the balance where most goes away.

    The run's own zero and friction of the day stay in, as in service. ci95: of rmse_before - rmse_after [Nm], bootstrap over
    recordings.
    """
    squares = prediction.squares
    channel = max(squares, key=lambda c: _rms_of(squares[c], 0) - _rms_of(squares[c], 1))
    table = squares[channel]
    rng = np.random.default_rng(seed)
    picks = rng.integers(0, len(table), size=(_BOOTSTRAPS, len(table)))
    sums = table[picks].sum(axis=1)
    drawn = np.sqrt(sums[:, 0] / sums[:, 2]) - np.sqrt(sums[:, 1] / sums[:, 2])
    low, high = np.percentile(drawn, (2.5, 97.5))
    pieces = list(solution.dataset.recordings)
    names = [solution.dataset.runs[pieces.index(r)].name for r in range(len(table))]
    return Gain(
        _rms_of(table, 0),
        _rms_of(table, 1),
        f"each of {len(table)} runs held out once; {channel.balance} balance of joint {channel.joint}",
        (float(low), float(high)),
        joint=channel.joint,
        balance=channel.balance,
        runs=tuple(
            RunGain(name, _rms_of(row, 0), _rms_of(row, 1))
            for name, row in zip(names, table[:, None, :], strict=True)
            if row[0, 2] > 0.0
        ),
    )


def _rms_of(table: FloatArray, column: int) -> float:
    return float(np.sqrt(table[:, column].sum() / max(table[:, 2].sum(), 1.0)))


@dataclass(frozen=True)
class Judged:
    """Entries that are one effect, in the set: their places, rms per channel [Nm], twice the log evidence that the best set
    without them lacks, and that the set without them lacks where a discrepancy may imitate them, that best set's entries
    instead, least deviations of the coefficients [z] from none, in the set and its rivals; how much their size differs from
    run to run, and the standard error of its mean over runs, parts of it; whether it is held at a bound; the values that
    rivals give them.
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
    held: bool
    elsewhere: tuple[Values, ...] = ()


def present_of(solution: Solution) -> tuple[list[Present], FloatArray]:
    """Return the effects of the set, and what each recording has of its own without discrepancy [r, q]."""
    own = np.array([u[: len(solution.dataset.families)] for u in solution.own_means])
    return effects_of(solution.plain, solution.chosen, solution.plain.fit(solution.chosen).mean), own


def effects_of(sets: Sets, chosen: Set, mean: FloatArray) -> list[Present]:
    """Return the effects of a set with these coefficients."""
    return present_effects([(sets.entries[k], mean[at]) for k, at in sets.places(chosen).items()])


def judged(solution: Solution) -> list[Judged]:
    """Return the effects of the set."""
    sets, plain, chosen = solution.sets, solution.plain, solution.chosen
    recorder = copy(solution.equations)
    recorder.recorded = recorded(
        solution.entries, max(s.step_s for run in solution.dataset.signals for s in run)
    )
    imitating = recorder.sets(solution.variances, chosen)
    sizes = Sizes(fits_without(solution), chosen)
    effects = sets.effects(chosen)
    apart = solution.equations.sets(solution.variances, chosen, resembling=False)
    without = [apart.without(chosen, members) for members in effects]
    lacks = {rival: apart.lacks(chosen, rival) for rival in without}
    alike = [chosen, *(rival for rival, lack in lacks.items() if lack <= limits.RIVAL)]
    places = sets.places(chosen)
    out = []
    for members in effects:
        none = [rival for rival in lacks if not rival & sets.like(members)]
        rival = min(none, key=lambda r: lacks[r])
        at = np.concatenate([np.arange(places[k].start, places[k].stop) for k in members])
        inner = solution.covariance[np.ix_(at, at)]
        size, own = plain.fit(chosen).mean[at], plain.columns(chosen)[at]
        z2, present = [], []
        for every in (s for s in alike if s.issuperset(members)):
            there, mean = plain.places(every), plain.fit(every).mean
            present += present_effects([(solution.entries[k], mean[there[k]]) for k in members])
            mean = np.concatenate([mean[there[k]] for k in members])
            z2.append(float(mean @ np.linalg.solve(inner, mean)))
        imitated = imitating.fit(chosen).evidence - imitating.fit(chosen - set(members)).evidence
        out.append(
            Judged(
                members,
                present[0],
                _rms(solution, present[0]),
                lacks[rival],
                2.0 * imitated,
                tuple(sets.entries[k] for k in rival - chosen),
                math.sqrt(max(min(z2), 0.0)),
                *sizes.over_runs(at),
                bool(np.any((size <= plain.low[own]) | (size >= plain.high[own]))),
                tuple(p.values for p in present[1:]),
            )
        )
    return out


def _rms(solution: Solution, present: Present) -> dict[Channel, float]:
    """Return the rms of an effect per channel where the balances of all runs are judged, less what noise puts into it; a
    constant in torsion taken off. Of a wave, which the angle gives however quick it is, all; else what is seen.
    """
    wave = "order_per_motor_rev" in present.values
    noisy = {(s.run, s.number): s for run in solution.dataset.disturbed for s in run}

    def parts(s: JointSignals) -> dict[str, FloatArray]:
        made = contribution(present.effect, present.values, s)
        return {balance: x if wave else s.visible(x) for balance, x in made.items()}

    squares: dict[Channel, list[FloatArray]] = {}
    for s in (s for run in solution.dataset.signals for s in run if shows_at(present.joint, s.number)):
        again = parts(noisy.get((s.run, s.number), s))
        for balance, value in parts(s).items():
            part, noise = (x[s.usable(balance)] for x in (value, again[balance] - value))
            if balance == TORSION and len(part):
                part, noise = part - part.mean(), noise - noise.mean()
            squares.setdefault(Channel(s.number, balance), []).append(part**2 - noise**2)
    return {
        c: math.sqrt(max(float(np.mean(np.concatenate(x))), 0.0)) if sum(map(len, x)) else 0.0
        for c, x in squares.items()
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
        "it is held at the end of its range": j.held,
        "more than it remains in its balance": hidden,
    }
    found = tuple(text for text, holds in doubts.items() if holds)
    return (ONE_OF if j.delta <= limits.RIVAL and j.rivals else EFFECTIVE if found else CERTAIN), found


def conclude(solution: Solution, names: tuple[str, ...], scope: Scope, relevance: float) -> Findings:
    """Return the findings of one diagnosis, without what was noted on its runs before."""
    dataset = solution.dataset
    prediction = predict(solution)
    effects = judged(solution)
    joints = dataset.joints
    limits_nm = {c: relevance * joints[c.joint].rated_torque_nm for c in dataset.runs[0].channels}
    left = remaining(dataset, *present_of(solution))
    rest = unexplained_residual(left)
    predicting = prediction.effects
    left_nm2 = sum(rest.by_channel().values())
    total_nm2 = sum(sum(r * r for r in j.rms_nm.values()) for j in effects) + left_nm2
    left_share = left_nm2 / max(total_nm2, 1e-30)
    unexplained = _unexplained(rest, held_nm(left), limits_nm, dataset, left_share)
    found = sorted(
        (_cause(solution, j, total_nm2, rest, limits_nm) for j in effects), key=lambda x: -x[0].rms_nm
    )
    causes = [cause for cause, _ in found]
    matter = [cause for cause in causes if cause.matters]
    if unexplained.matters:
        verdict = UNEXPLAINED
    elif matter:
        verdict = CAUSE if all(c.grade == CERTAIN for c in matter) else AMBIGUOUS
    else:
        verdict = NO_GAP
    table, untold = entry_table(solution, causes, scope)
    return Findings(
        verdict,
        tuple(rest.reasons if unexplained.matters else ()),
        names,
        tuple(sorted(joints)),
        channel_gaps(left, rest, unexplained.matters),
        tuple(cause for cause, size in found if size >= limits.LISTED),
        table,
        gain_of(solution, prediction) if prediction.chosen else None,
        traces=traces(left),
        explained_share=1.0 - left_share if causes else math.nan,
        unexplained=unexplained,
        too_small=tuple(cause for cause, size in found if size < limits.LISTED),
        cannot_be_told=untold,
        predicts=tuple(predicting),
        next_experiment=_next(matter, effects, dataset),
    )


def _cause(
    solution: Solution, j: Judged, total_nm2: float, rest: Unexplained, limits_nm: Mapping[Channel, float]
) -> tuple[Cause, float]:
    """Return an effect as a cause, and its size in parts of its limit, which is that of the first joint for the sensor."""
    joint = j.present.joint
    channel = max(j.rms_nm, key=lambda c: j.rms_nm[c])
    size_nm = j.rms_nm[channel]
    of = joint if isinstance(joint, int) else min(solution.dataset.joints)
    part = size_nm / limits_nm[Channel(of, channel.balance)]
    # no wave looks like a law
    alike = sum(v.energy_nm2 for v in rest.views.get(channel, ()) if v.line is None)
    grade, doubts = grade_of(j, hidden=math.sqrt(max(alike, 0.0)) > size_nm)
    rivals = [e.effect.name + (f" of {joint_text(e.joint)}" if e.joint != joint else "") for e in j.rivals]
    rivals = list(dict.fromkeys(rivals)) if grade == ONE_OF else []
    cause = Cause(
        j.present.name,
        joint,
        values_of(solution, j),
        j.delta,
        size_nm,
        channel.balance,
        explained_share=sum(r * r for r in j.rms_nm.values()) / max(total_nm2, 1e-30),
        grade=grade,
        rivals=tuple(rivals),
        given=tuple(dict.fromkeys(solution.entries[k].prior.text for k in j.members)),
        doubts=doubts,
        matters=part >= 1.0,
    )
    return cause, part


def values_of(solution: Solution, j: Judged) -> dict[str, Value]:
    """Return the parameters of an effect with 95 % intervals, no narrower than what the equations simplify, that hold what
    rival sets make of it.
    """
    fit = solution.plain.fit(solution.chosen)
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
        every = [value, *(x[p.name] for x in j.elsewhere if p.name != "phase_rad")]
        low, high = min(every) - wide, max(every) + wide
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
    dataset: Dataset,
    share: float,
) -> UnexplainedResidual:
    """Return what remains in the channel where it is most, against its limit; share: of all structure."""
    sizes = {c: max(rest.worst_nm.get(c, 0.0), held.get(c, 0.0)) for c in limits_nm}
    worst = max(sizes, key=lambda c: sizes[c] / limits_nm[c])
    return UnexplainedResidual(
        worst.joint,
        worst.balance,
        sizes[worst],
        100.0 * (sizes[worst] / dataset.joints[worst.joint].rated_torque_nm),
        share,
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
    untold = set(sets.untold(chosen))
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
                cause.delta_evidence if cause else _brings(sets, chosen, best),
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
        if motion is not None:
            lost.append(Untold(name, first, reason, motion))
        rows.append(CandidateEvidence(name, first, math.nan, {}, reason))
    rows.sort(key=lambda r: -r.delta_bic if math.isfinite(r.delta_bic) else math.inf)
    return tuple(rows), tuple(lost)


def _brings(sets: Sets, chosen: Set, k: int) -> float:
    """Return twice the log evidence that an entry beyond the set brings, -inf where its slot is taken."""
    if sets.entries[k].slot in {sets.entries[j].slot for j in chosen}:
        return -math.inf
    return 2.0 * (sets.fit(chosen | {k}).evidence - sets.fit(chosen).evidence)


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
