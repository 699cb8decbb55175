"""The model of all runs: columns of all entries at the present solution, noise, the set of most evidence, its shapes.

1. What the values of the file and the waves of the library leave, under their priors, is the first noise.
2. Sets are searched from nothing and from all values of the file; those that are met are compared with variances of their
   own.
3. Currents and torsions are what the simulation with this set has; shapes move to where the set wants them; noise is
   what the set leaves. Then again.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.effects.effect import MOTOR, Linear
from jtqd.sysid.diagnosis import limits
from jtqd.sysid.diagnosis.dataset import Dataset, binned_runs, unpowered_columns, with_readings
from jtqd.sysid.diagnosis.entries import (
    Entry,
    entries_of,
    present_effects,
    set_state,
    shapes_of,
    slices_of,
    transform_of,
)
from jtqd.sysid.diagnosis.evidence import Equations, Means, Set, Sets, columns_of
from jtqd.sysid.diagnosis.findings import Present, shows_at
from jtqd.sysid.diagnosis.regressors import (
    OF_TORQUE,
    ChannelData,
    Index,
    Noise,
    RunData,
    basis_columns,
    contribution,
    features,
    fields_used,
    noise_of_channels,
    nuisances_of,
    run_sums,
    seen_in_bins,
)
from jtqd.sysid.diagnosis.signals import Channel, JointSignals

_TURNS: Final = 4
_ROUNDS: Final = 3
_STEPS: Final = 8
"""Of the variances."""
_CLIMB: Final = 4
"""Steps to a neighbouring set."""
_FROM_NOTHING: Final = 2
"""Turns that search from the empty set as well."""
_STATES: Final = frozenset(
    ("current_a", "current_rate_a_s", "torsion_rad", "torsion_rate_rad_s", "joint", "loss_per_torque")
)
"""What effects use that follows from the solution."""
_SETTLING: Final = 6
_SETTLED: Final = 0.1
"""Standard deviations: smaller changes of a coefficient are none."""
_STEP: Final = 0.02
_RATES_PER_K: Final = (0.003, 0.06)
_LEAST_SECANT: Final = 1e-3
"""Of the prior's size: less has no secant."""


def between(
    before: tuple[FloatArray, FloatArray], now: tuple[FloatArray, FloatArray], covariance: FloatArray
) -> FloatArray:
    """Return the next point of an iteration from its last two, each with its image: where the line through both has its
    fixed point, no further than either image (Anderson 1965, J. ACM 12). Images alone diverge where a motor saturates.
    """
    rest, change = now[1] - now[0], (now[1] - now[0]) - (before[1] - before[0])
    weighted = np.linalg.solve(covariance, change)
    part = float(rest @ weighted) / max(float(change @ weighted), 1e-30)
    return np.asarray(now[1] - min(max(part, 0.0), 1.0) * (now[1] - before[1]))


@dataclass
class Solution:
    """A set with its posterior.

    entries: all that competed; chosen: those that are in the set; equations, variances, sets: of the evidence, at the
    states of the set; sized: equations of sizes, with noise alone; runs, disturbed: binned, with discrepancy among the
    nuisances; own_means: of what each recording has of its own.
    """

    dataset: Dataset
    entries: list[Entry]
    chosen: Set
    equations: Equations
    sized: Equations
    variances: Mapping[object, float]
    runs: list[RunData]
    disturbed: list[RunData]
    own_means: list[FloatArray]
    sets: Sets
    work: _Work
    noise: Noise

    def settled(self, chosen: Set, variances: Mapping[object, float]) -> Solution:
        """Return the equations of all entries at currents, torsions and shapes as the simulation with another set has them,
        its coefficients at these variances; states of the signals stay those of the solution.
        """
        work = self.work.copy()
        work.settle(chosen, self.sized.sets(variances).fit(chosen).mean, self.noise.random, variances)
        self.work.set_states()
        made = work.equations(self.noise.random)
        return replace(
            self, sized=made, work=work, entries=work.entries, runs=work.runs, disturbed=work.disturbed
        )

    def transform(self) -> FloatArray:
        """Return the weights of scaled coefficients in the library's columns [P, E]."""
        return self.work.transform()

    @cached_property
    def plain(self) -> Sets:
        """Of sizes: what a set explains is the set's, whatever would resemble it."""
        return self.sized.sets(self.variances, self.chosen, resembling=False)

    @cached_property
    def covariance(self) -> FloatArray:
        """Of the set's values [q, q], with what calibrations outside of the set may be off by (JCGM 100:2008, type B)."""
        off = [e.prior.calibration and k not in self.chosen for k, e in enumerate(self.entries)]
        wide = copy(self.sized)
        wide.recorded = np.maximum(wide.recorded, np.repeat(off, [e.size for e in self.entries]))
        return wide.sets(self.variances, self.chosen).fit(self.chosen).covariance


def recorded(entries: Sequence[Entry], step_s: float) -> FloatArray:
    """Return the variance of each scaled coefficient that a recorder makes [E]: it reads its channels at moments within a
    step, which stamps do not tell apart.
    """
    ages = [(e.effect.age_s(e.values(np.ones(e.size))), e.size) for e in entries]
    return np.repeat([(step_s / age) ** 2 / 12.0 if age else 0.0 for age, _ in ages], [n for _, n in ages])


class _End(NamedTuple):
    """A set with variances of its own: -2 log marginal likelihood, set, variances, means."""

    score: float
    chosen: Set
    variances: Mapping[object, float]
    means: Means


class _Search:
    """Sets on one noise: searched at the variances of one set, compared with each at its own."""

    def __init__(self, equations: Equations) -> None:
        self.equations = equations
        self.met: dict[Set, _End] = {}

    def own(self, chosen: Set) -> _End:
        """Return a set with variances of its own."""
        if chosen not in self.met:
            variances, score, means = self.equations.expected(chosen, self.equations.first(), _STEPS)
            self.met[chosen] = _End(score, chosen, variances, means)
        return self.met[chosen]

    def best(self, starts: Sequence[Set], *, rivals: bool) -> _End:
        """Return the set of most evidence of all that searches from these sets meet, and of their neighbours; rivals: also
        of those that searches without one of its effects end in. From each set once as if there were no discrepancy: that of
        a set which lacks an effect may hide it.
        """
        self.own(frozenset())
        plain = self.equations.sets(self.equations.first())
        for start in (*starts, *map(plain.search, starts)):
            now = start
            for _ in range(_ROUNDS):
                sets = self.equations.sets(self.own(now).variances, now)
                before, now = now, max(map(sets.search, {now, *starts}), key=lambda s: sets.fit(s).evidence)
                if now == before:
                    break
            self.own(now)
        best = self._least()
        for _ in range(_CLIMB):
            sets = self.equations.sets(best.variances, best.chosen)
            near = sets.neighbours(best.chosen)
            if rivals:
                near += [sets.without(best.chosen, members) for members in sets.effects(best.chosen)]
            for s in near:
                self.own(s)
            before_that, best = best, self._least()
            if best is before_that:
                break
        return self._without_the_replaceable(best) if rivals else best

    def _without_the_replaceable(self, best: _End) -> _End:
        """Return the set without effects that its others nearly replace, which then have the whole size."""
        sets = self.equations.sets(best.variances, best.chosen, resembling=False)
        while True:
            less = [best.chosen - set(members) for members in sets.effects(best.chosen)]
            least = max(less, key=lambda s: sets.fit(s).evidence, default=best.chosen)
            lacks = 2.0 * (sets.fit(best.chosen).evidence - sets.fit(least).evidence)
            if not less or max(lacks, self.own(least).score - best.score) > limits.RIVAL:
                return best
            best = self.own(least)

    def _least(self) -> _End:
        return min(self.met.values(), key=lambda end: end.score)


def solve(dataset: Dataset) -> Solution:
    """Return the set of entries with most evidence on these runs."""
    work = _Work(dataset)
    residuals = work.first_residuals()
    start = work.file_values()
    exact = limits.FLOOR * dataset.rated_torque_nm, sum(e.size for e in work.entries)
    for turn in range(_TURNS):
        if turn + 1 < _TURNS:  # the last one compares what the one before has moved, on the same noise
            noise = noise_of_channels(residuals, dataset.step_s, *exact)
        equations = work.equations(noise)
        search = _Search(equations)
        starts = [start, *([frozenset[int]()] if turn < _FROM_NOTHING else [])]
        best = search.best(starts, rivals=turn + 1 == _TURNS)
        start, variances, means = best.chosen, best.variances, best.means
        residuals = work.left(start, means)
        work.settle(start, means.beta, noise.random, variances)
    equations = work.equations(noise)  # at the states of the set itself
    variances, _, means = equations.expected(start, variances, _STEPS)
    return Solution(
        dataset,
        work.entries,
        start,
        equations,
        work.equations(noise.random),
        variances,
        work.runs,
        work.disturbed,
        means.own,
        equations.sets(variances, start),
        work,
        noise,
    )


class _Work:
    """Binned columns of runs and disturbed runs at the present solution."""

    def __init__(self, dataset: Dataset) -> None:
        self.dataset = dataset
        self.entries = entries_of(dataset.candidates, dataset.signals, dataset.trust)
        self.families = len(dataset.families)
        self.columns = dataset.candidates[-1].columns.stop if dataset.candidates else 0
        rng = np.random.default_rng(0)
        self.present: list[Present] = []
        self.set_states()
        self.runs = [replace(run, channels=dict(run.channels)) for run in dataset.runs]
        self.disturbed = binned_runs(dataset.disturbed, dataset.step_s, dataset.candidates, dataset.families)
        names = [run.name for run in self.runs]
        self.disturbed_of = [names.index(run.name) for run in self.disturbed]
        self.groups: list[object] = [("family", k) for k in range(self.families)]
        rated = dataset.rated_torque_nm
        self.start: dict[object, tuple[float, float]] = {
            ("family", k): (f.sigma**2, limits.RUNS_COUNT) for k, f in enumerate(dataset.families)
        }
        self.most: dict[object, float] = {}
        shared: list[int] = []
        for channel in dataset.runs[0].channels:
            made = features(dataset.runs, channel, rng, self.disturbed)
            first, count = len(self.groups), made[0].shape[1]
            group = ("discrepancy", channel)
            self.groups += [group] * count
            self.start[group] = ((limits.FLOOR * rated) ** 2, limits.FLOOR_COUNT)
            gap = np.concatenate(
                [r.channels[channel].residual[r.channels[channel].valid] for r in dataset.runs]
            )
            self.most[group] = limits.CAP**2 * float(np.mean(gap**2)) if len(gap) else 1.0
            shared += range(first, first + count)
            for r, run in enumerate((*self.runs, *self.disturbed)):
                d = run.channels[channel]
                run.channels[channel] = replace(
                    d,
                    nuisances=np.hstack((d.nuisances, made[r])),
                    families=np.concatenate((d.families, np.arange(first, first + count))).astype(np.intp),
                )
        self.shared = np.array(shared, np.intp)
        joint = next(iter(dataset.joints.values()))
        self._used = {
            k: fields_used(e.effect, e.candidate.term.basis[0], joint) for k, e in enumerate(self.entries)
        }

    def copy(self) -> _Work:
        """Return work that moves by itself, but for the states of the signals."""
        out = copy(self)
        out.entries = list(self.entries)
        out.runs, out.disturbed = (
            [replace(run, channels=dict(run.channels)) for run in runs]
            for runs in (self.runs, self.disturbed)
        )
        return out

    def set_states(self) -> None:
        """Set the states of all signals to the present effects."""
        for s in (s for run in (*self.dataset.signals, *self.dataset.disturbed) for s in run):
            set_state(s, self.present)

    def file_values(self) -> Set:
        """Return the set of all values of the file, one of each slot."""
        taken: dict[object, int] = {}
        for k, e in enumerate(self.entries):
            if e.prior.file:
                taken.setdefault(e.slot, k)
        return frozenset(taken.values())

    def transform(self) -> FloatArray:
        return transform_of(self.entries, self.columns)

    def equations(self, noise: Noise, entries: Sequence[Entry] | None = None) -> Equations:
        """Return the normal equations of all recordings, over all entries or these."""
        entries = self.entries if entries is None else entries
        P, N = self.columns, len(self.groups)
        weights = transform_of(entries, P)
        used = np.flatnonzero(np.any(weights != 0.0, axis=1)) if entries is not self.entries else None
        E = weights.shape[1]
        full = np.zeros((P + N + 1, E + N + 1))
        full[:P, :E] = weights
        full[P:, E:] = np.eye(N + 1)
        sums = [run_sums(_only(run, used), noise, P, N) for run in self.runs]
        sums = with_readings(
            sums,
            self.dataset.readings,
            unpowered_columns([e.candidate for e in entries], self.dataset.joints),
        )
        pieces = self.dataset.recordings
        grams = np.zeros((max(pieces) + 1, E + N + 1, E + N + 1))
        extra = np.zeros_like(grams)
        for place, s in zip(pieces, sums, strict=True):
            grams[place] += full.T @ s.gram @ full
        for place, other in zip(self.disturbed_of, self.disturbed, strict=True):
            gram = run_sums(_only(_difference(other, self.runs[place]), used), noise, P, N).gram
            extra[pieces[place]] += full.T @ gram @ full
        lacking = set(range(len(grams))) - {pieces[place] for place in self.disturbed_of}
        for p in lacking if self.disturbed else ():  # as the others have
            extra[p] = extra.sum(axis=0) / (len(grams) - len(lacking))
        return Equations(
            entries,
            grams,
            extra,
            self.groups,
            self.shared,
            self.start,
            self.most,
            rows=float(sum(d.valid.sum() for run in self.runs for d in run.channels.values())),
        )

    def first_residuals(self) -> dict[Channel, list[FloatArray]]:
        """Return what the values of the file, the waves and the runs' own changes leave under their priors, per run [n].

        Not what everything could explain: the residual is a sum of measured terms, and with a column for each of them all of
        it is explained by taking everything away.
        """
        weights = self.transform()
        sigma = np.array([f.sigma for f in self.dataset.families])
        E, Q, R = weights.shape[1], self.families, len(self.runs)
        gram, right, parts, noise = np.zeros((E + R * Q,) * 2), np.zeros(E + R * Q), [], 0.0
        for r, run in enumerate(self.runs):
            for c, d in run.channels.items():
                own = d.families < Q
                x = np.hstack((d.regressors @ weights[d.index], d.nuisances[:, own] * sigma[d.families[own]]))
                place = np.concatenate((np.arange(E), E + r * Q + d.families[own])).astype(int)
                gram[np.ix_(place, place)] += x[d.valid].T @ x[d.valid]
                right[place] += x[d.valid].T @ d.residual[d.valid]
                parts.append((c, d, x, place))
                if d.valid.any():
                    noise = max(noise, float(np.var(d.residual[d.valid])))
        rest: list[tuple[Channel, FloatArray]] = []
        for _ in range(4):
            theta = np.linalg.solve(gram + noise * np.eye(len(gram)), right)
            rest = [(c, np.where(d.valid, d.residual - x @ theta[place], np.nan)) for c, d, x, place in parts]
            noise = float(np.nanmean(np.concatenate([x for _, x in rest]) ** 2))
        return {c: [x for k, x in rest if k == c] for c in self.runs[0].channels}

    def left(self, chosen: Set, means: Means) -> dict[Channel, list[FloatArray]]:
        """Return what set, discrepancy and the runs' own changes leave, per channel and run [n], NaN where not valid."""
        weights, pieces = self.transform(), self.dataset.recordings
        beta = -means.overlap @ means.shared
        beta[columns_of(self.entries, chosen)] += means.beta
        library = weights @ beta
        out: dict[Channel, list[FloatArray]] = {c: [] for c in self.runs[0].channels}
        for run, place in zip(self.runs, pieces, strict=True):
            total = means.own[place].copy()
            total[self.shared] += means.shared
            for c, d in run.channels.items():
                rest = d.residual - d.regressors @ library[d.index] - d.nuisances @ total[d.families]
                out[c].append(np.where(d.valid, rest, np.nan))
        return out

    def settle(
        self,
        chosen: Set,
        mean: FloatArray,
        noise: Noise,
        variances: Mapping[object, float],
        changed: frozenset[str] = _STATES,
    ) -> None:
        """Move to the solution; again with the coefficients there, where current or torsion that effects see depend on the
        set.
        """
        acting = any(self._used[k] & {"current_a", "torsion_rad"} for k in chosen)
        self.move(chosen, mean, changed, chosen if acting else None)
        before: tuple[FloatArray, FloatArray] | None = None
        for step in range(_SETTLING if acting else 0):
            few = [self.entries[k] for k in sorted(chosen)]
            every = frozenset(range(len(few)))
            fit = self.equations(noise, few).sets(variances, every, resembling=False).fit(every)
            done = step + 1 == _SETTLING or (
                len(mean) == len(fit.mean)
                and bool(np.all(np.abs(fit.mean - mean) <= _SETTLED * np.sqrt(np.diag(fit.covariance))))
            )
            now = mean, fit.mean
            mean = fit.mean if before is None or done else between(before, now, fit.covariance)
            before = now if len(now[0]) == len(now[1]) and not any(e.tangents for e in few) else None
            self.move(chosen, mean, changed, None if done else chosen)
            if done:
                return

    def move(self, chosen: Set, mean: FloatArray, changed: frozenset[str], only: Set | None) -> None:
        """Set states and shapes to the solution, and make the columns again that depend on them, of all or `only` some."""
        again, present = set(), []
        for k, at in zip(sorted(chosen), slices_of(self.entries[k] for k in sorted(chosen)), strict=True):
            e, scaled = self.entries[k], mean[at]
            moved = self._shaped(e, scaled)
            if moved is not e:
                self.entries[k] = moved
                again.add(k)
            present.append((e, scaled))
        self.present = present_effects(present)
        self.set_states()
        again |= {
            k
            for k, used in self._used.items()
            if used & changed and not (self.entries[k].effect.follows_torsion and k not in chosen)
        }
        again = again if only is None else again & only
        for signals, run in zip(
            (*self.dataset.signals, *self.dataset.disturbed), (*self.runs, *self.disturbed), strict=True
        ):
            self._columns_again(signals, run, again)

    def _shaped(self, e: Entry, scaled: FloatArray) -> Entry:
        """Return the entry with its shapes where the coefficients have them, and tangents of each."""
        names = shapes_of(e.effect, e.candidate.term)
        values = e.values(scaled)
        combine = e.candidate.term.combine
        if names:
            combine = replace(combine, fixed={**combine.fixed, **{n: values[n] for n in names}})
        elif isinstance(combine, Linear) and combine.base == (0.0,):
            # the secant at the present size: a delay and a play are not linear
            [name], [step] = combine.names, combine.step
            size = values[name]
            if abs(size) < _LEAST_SECANT * abs(step * e.weights[0, 0]):
                return e
            combine = replace(combine, step=(size,))
            e = replace(e, weights=e.weights * step / size)
        elif hasattr(combine, "rate"):  # an exponential, straight at the present rate
            rate = float(np.clip(abs(values[combine.names[0]]), *_RATES_PER_K))
            e = replace(e, weights=e.weights * combine.rate / rate)
            combine = replace(combine, rate=rate)
        else:
            return e
        candidate = replace(e.candidate, term=combine.term())
        tangents = e.tangents
        if names and not tangents:
            tangents = tuple(range(self.columns, self.columns + len(names)))
            self.columns += len(names)
            inner = np.zeros((e.candidate.size + len(names),) * 2)
            inner[: e.candidate.size, : e.candidate.size] = e.weights
            inner[range(e.candidate.size, len(inner)), range(e.candidate.size, len(inner))] = 1.0
            e = replace(e, weights=inner)
        return replace(
            e,
            candidate=candidate,
            shapes=names,
            tangents=tangents,
            amplitude=tuple(e.coefficients(np.append(scaled, np.zeros(e.size - len(scaled))))),
        )

    def _columns_again(self, signals: Sequence[JointSignals], run: RunData, entries: Iterable[int]) -> None:
        again = [self.entries[k] for k in entries]
        made = basis_columns(signals, [e.candidate for e in again])
        for e in again:
            c = e.candidate
            for s in (s for s in signals if shows_at(c.joint, s.number)):
                for column, name in zip(e.tangents, e.shapes, strict=True):
                    here = c.term.combine(e.amplitude)
                    there = {**here, name: here[name] * (1.0 + _STEP)}
                    one, two = contribution(c.effect, here, s), contribution(c.effect, there, s)
                    for balance in one:
                        change = limits.SHAPE / _STEP * (two[balance] - one[balance])
                        made.setdefault(Channel(s.number, balance), []).append((column, change))
        of = {s.number: s for s in signals}
        for s in signals:
            d = run.channels[Channel(s.number, MOTOR)]
            torque = nuisances_of(s, MOTOR, self.dataset.families, OF_TORQUE)
            numbers, values = seen_in_bins(s, torque, run.samples)
            nuisances = d.nuisances.copy()
            nuisances[:, np.searchsorted(d.families, numbers)] = values
            run.channels[Channel(s.number, MOTOR)] = replace(d, nuisances=nuisances)
        for channel, columns in made.items():
            d = run.channels[channel]
            place = {int(k): j for j, k in enumerate(d.index)}
            numbers, values = seen_in_bins(of[channel.joint], columns, run.samples)
            new = np.array([k not in place for k in numbers.tolist()], bool)
            regressors = np.hstack((d.regressors, values[:, new]))
            regressors[:, [place[k] for k in numbers[~new].tolist()]] = values[:, ~new]
            index = np.concatenate((d.index, numbers[new])).astype(np.intp)
            run.channels[channel] = replace(d, regressors=regressors, index=index)


def _only(run: RunData, columns: Index | None) -> RunData:
    """Return a run with some of its columns, all for None."""
    if columns is None:
        return run
    channels = {}
    for c, d in run.channels.items():
        keep = np.isin(d.index, columns)
        channels[c] = replace(d, regressors=d.regressors[:, keep], index=d.index[keep])
    return replace(run, channels=channels)


def _difference(other: RunData, run: RunData) -> RunData:
    """Return what the noise of a disturbed run adds to residual and columns; the discrepancy's as none."""
    channels = {}
    for c, d in other.channels.items():
        mine = run.channels[c]
        channels[c] = ChannelData(
            mine.valid,
            d.residual - mine.residual,
            d.regressors - mine.regressors,
            mine.index,
            d.nuisances - mine.nuisances,
            mine.families,
        )
    return replace(run, channels=channels)
