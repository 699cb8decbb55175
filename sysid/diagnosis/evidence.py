"""Evidence: marginal likelihood of sets of entries, and the search for the set that has most of it.

    y_r = X beta + F (w + v_r) + Z_r u_r + e_r        per balance, binned, e noise (`regressors`)

X: columns of the entries, scaled so that beta ~ N(0, 1) for entries in the set and 0 for all others; a set has prior odds.
F: eigenfunctions over the conditions, and rates of the load (`regressors.features`): what no library holds; w shared by
all runs, v_r a run's own.
Z: what a run has of its own (`regressors.families`; Laird and Ware 1982, Biometrics 38). The variances of w, v and u are
where the marginal likelihood is largest (MacKay 1992, Neural Computation 4). Given them everything is linear and Gaussian,
and the evidence of any set follows from one matrix of normal equations (George and McCulloch 1993, J. Am. Stat.
Assoc. 88: spike and slab):

    2 log evidence = b' (A_SS + 1)^-1 b - log |A_SS + 1| + 2 sum log odds

Beside a set the discrepancy has no part along the columns of the set and of the values of the file (Plumlee 2017, J. Am.
Stat. Assoc. 112). As much of each entry as it nevertheless resembles is a second, small prior of every entry (George and
McCulloch's spike of a width): a set needs more evidence than such a discrepancy would give it, and no size is less for it.

The response of each balance has weight one, so no set gains by scaling a balance. What noise of torques and motion puts into
the columns is taken out of the normal equations (Fuller 1987, Measurement Error Models), once for all sets.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from jtqd.estimator.arrays import FloatArray
from jtqd.sysid.diagnosis import limits
from jtqd.sysid.diagnosis.entries import Entry, slices_of
from jtqd.sysid.diagnosis.regressors import Index

Set = frozenset[int]
"""Numbers of entries."""
Variances = Mapping[object, float]
_LESS: Final = 1e-6
_TRIED: Final = 3
"""Additions that are tried at each step, those of largest gain."""
_RIVAL_STEPS: Final = 12
_SAME: Final = 0.05
"""Part of a column's energy that others may lack, and still add up to it."""
_NOISY: Final = 0.5
"""Part of the energy of a direction of the columns that its noise may be."""
_ALIKE: Final = 1e-10
"""Part of their energy below which columns differ by rounding."""


@dataclass(frozen=True)
class Fit:
    """A set at given variances: posterior mean and covariance of its scaled coefficients in order; log evidence less what
    all sets have in common.
    """

    mean: FloatArray
    covariance: FloatArray
    evidence: float


def columns_of(entries: Sequence[Entry], chosen: Set) -> Index:
    """Return the places of a set's coefficients among those of all entries."""
    spans = slices_of(entries)
    return np.array([j for k in sorted(chosen) for j in range(spans[k].start, spans[k].stop)], np.intp)


def _bounds(entries: Iterable[Entry]) -> tuple[FloatArray, FloatArray]:
    """Return the least and the largest value of each coefficient of all entries [E]: of a term's own, not of its shapes."""
    own = [e.candidate.size == 1 and k == 0 and e for e in entries for k in range(e.size)]
    return np.array([e.low if e else -math.inf for e in own]), np.array(
        [e.high if e else math.inf for e in own]
    )


def _within(inner: FloatArray, right: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Return the x of inner x = right; what is beyond its bound is held at it."""
    mean = np.linalg.solve(inner, right)
    held = np.zeros(len(right), bool)
    for _ in range(len(right)):
        beyond = ~held & ((mean < low) | (mean > high))
        if not beyond.any():
            break
        held |= beyond
        mean[held] = np.clip(mean[held], low[held], high[held])
        free = ~held
        if free.any():
            rest = right[free] - inner[np.ix_(free, held)] @ mean[held]
            mean[free] = np.linalg.solve(inner[np.ix_(free, free)], rest)
    return np.asarray(mean)


class Means(NamedTuple):
    """Of coefficients [q], shared discrepancy [k], each recording's own [r][N]; overlap of features and columns [E, k]."""

    beta: FloatArray
    shared: FloatArray
    own: list[FloatArray]
    overlap: FloatArray


class Scatter(NamedTuple):
    """What noise puts into the equations over [E, response], summed over so many rows, and how far that scatters."""

    gram: FloatArray
    rows: float

    def by_chance(self, one: FloatArray, other: FloatArray | float = 0.0) -> float:
        """Return by how much the squares that noise leaves with coefficients may by chance be less than with others [E]:
        limits.SURE standard deviations of (w'd)(w's), w white, d and s difference and sum of both contrasts.
        """
        apart, both = np.append(one - other, 0.0), np.append(one + other, -2.0)
        size = max(float(apart @ self.gram @ apart), 0.0) * max(float(both @ self.gram @ both), 0.0)
        return limits.SURE * math.sqrt(2.0 * size / self.rows)


class Sets:
    """Sets of entries on marginal normal equations A [E + 1, E + 1], last: the response."""

    def __init__(self, entries: Sequence[Entry], gram: FloatArray, noise: Scatter | None = None) -> None:
        self.entries, self.gram = list(entries), gram
        self.noise = noise or Scatter(np.zeros_like(gram), 1.0)
        self.slices: list[Index] = [np.arange(s.start, s.stop) for s in slices_of(entries)]
        one = np.array([e.size == 1 for e in entries], bool)
        self._single = np.flatnonzero(one)
        self._place = np.array([self.slices[k][0] for k in self._single], np.intp)
        self._many = [
            (members, np.array([self.slices[k] for k in members]))
            for size in sorted({e.size for e in entries} - {1})
            for members in [np.flatnonzero([e.size == size for e in entries])]
        ]
        self.low, self.high = _bounds(entries)
        self._odds = np.array([e.odds for e in entries])
        self._fits: dict[Set, Fit] = {}

    def columns(self, chosen: Set) -> Index:
        """Return the places of a set's coefficients, in order of its entries."""
        return np.concatenate([np.empty(0, np.intp), *(self.slices[k] for k in sorted(chosen))])

    def lacks(self, chosen: Set, other: Set) -> float:
        """Return twice the log evidence that another set lacks, less what noise may by chance have made of it."""
        fits = [self.fit(s) for s in (chosen, other)]
        apart = self.noise.by_chance(*map(self.coefficients, (chosen, other)))
        return 2.0 * (fits[0].evidence - fits[1].evidence) - apart

    def coefficients(self, chosen: Set, mean: FloatArray | None = None) -> FloatArray:
        """Return the coefficients of all entries with this set [E]; mean: those of the set, where they are known."""
        out = np.zeros(len(self.gram) - 1)
        out[self.columns(chosen)] = self.fit(chosen).mean if mean is None else mean
        return out

    def fit(self, chosen: Set) -> Fit:
        """Return the posterior of a set; a coefficient beyond its bound is held at it."""
        if chosen not in self._fits:
            self._fits[chosen] = self._fit(chosen)
        return self._fits[chosen]

    def _fit(self, chosen: Set) -> Fit:
        at = self.columns(chosen)
        inner = self.gram[np.ix_(at, at)] + np.eye(len(at))
        right = self.gram[at, -1]
        factor = cho_factor(inner)
        mean = _within(inner, right, self.low[at], self.high[at])
        covariance = cho_solve(factor, np.eye(len(at)))
        explained = float(2.0 * mean @ right - mean @ inner @ mean)
        explained -= self.noise.by_chance(self.coefficients(chosen, mean))
        evidence = 0.5 * explained - float(np.sum(np.log(np.diag(factor[0]))))
        return Fit(mean, covariance, evidence + sum(self.entries[k].odds for k in chosen))

    def places(self, chosen: Set) -> dict[int, slice]:
        """Return where the coefficients of each entry of a set are among those of all."""
        return dict(zip(sorted(chosen), slices_of(self.entries[k] for k in sorted(chosen)), strict=True))

    def gains(self, chosen: Set) -> FloatArray:
        """Return the log evidence that adding each entry brings [entries]; -inf where its slot is taken."""
        now = self.fit(chosen)
        out = np.full(len(self.entries), -math.inf)
        if not math.isfinite(now.evidence):
            return out
        at = self.columns(chosen)
        cross = self.gram[:, at]
        rest = self.gram - cross @ (now.covariance @ cross.T)
        response = self.gram[:, -1] - cross @ now.mean  # with the bounds that the set is at
        taken = {self.entries[k].slot for k in chosen}
        free = np.array([k not in chosen and e.slot not in taken for k, e in enumerate(self.entries)], bool)
        if len(self._single):
            precision = rest[self._place, self._place] + 1.0
            b = response[self._place]
            with np.errstate(divide="ignore", invalid="ignore"):
                best = np.clip(b / precision, self.low[self._place], self.high[self._place])
                value = best * b - 0.5 * precision * best**2 - 0.5 * np.log(precision)
            good = (precision >= 1.0) & free[self._single]
            out[self._single[good]] = value[good]
        for members, places in self._many:
            inner = rest[places[:, :, None], places[:, None, :]] + np.eye(places.shape[1])
            b = response[places]
            good = free[members] & (np.linalg.eigvalsh(inner)[:, 0] >= 1.0 - _LESS)
            if good.any():
                half = np.linalg.solve(inner[good], b[good][:, :, None])[:, :, 0]
                value = 0.5 * np.sum(b[good] * half, axis=1) - 0.5 * np.linalg.slogdet(inner[good])[1]
                out[members[good]] = value
        return np.asarray(out + self._odds)

    def search(self, start: Set, banned: Set = frozenset(), steps: int = 60) -> Set:
        """Return the set from which no addition, removal or exchange gains."""
        chosen = start
        for _ in range(steps):
            moves = [*self._additions(chosen, banned), *(chosen - {k} for k in chosen)]
            for k in chosen:
                moves += self._additions(chosen - {k}, banned | {k})
            best = max(moves, key=lambda s: self.fit(s).evidence, default=chosen)
            if self.fit(best).evidence <= self.fit(chosen).evidence + _LESS:
                break
            chosen = best
        return chosen

    def neighbours(self, chosen: Set) -> list[Set]:
        """Return the sets with one more of the entries that promise most, and without one of those that are missed least."""
        less = sorted((chosen - {k} for k in chosen), key=lambda s: -self.fit(s).evidence)
        return [*self._additions(chosen, frozenset()), *less[:_TRIED], *self.one_for_many(chosen)]

    def one_for_many(self, chosen: Set) -> list[Set]:
        """Return the sets with one more entry in the place of all that a step along its column leaves nothing of, where the
        set's columns add up to its own. A gain of a sensor stands so for every constant of the joints.
        """
        fit, at = self.fit(chosen), self.columns(chosen)
        places, taken = self.places(chosen), {self.entries[k].slot for k in chosen}
        deviation = np.sqrt(np.diag(fit.covariance))
        out = []
        for k, j in zip(self._single.tolist(), self._place.tolist(), strict=True):
            if k in chosen or self.entries[k].slot in taken:
                continue
            shared = fit.covariance @ self.gram[at, j]
            if self.gram[j, j] - self.gram[at, j] @ shared > _SAME * self.gram[j, j]:
                continue
            step = fit.mean / np.where(np.abs(shared) > _SAME, shared, np.inf)
            largest = step[np.argmax(np.abs(np.where(step != 0.0, fit.mean, 0.0)))] if len(step) else 0.0
            left = np.abs(fit.mean - largest * shared)
            gone = {
                m
                for m, s in places.items()
                if np.all(left[s] < np.maximum(0.5 * np.abs(fit.mean[s]), deviation[s]))
            }
            if len(gone) > 1:
                out.append(chosen - gone | {k})
        return out

    def effects(self, chosen: Set) -> list[tuple[int, ...]]:
        """Return the entries of a set, those that are one effect together."""
        out: dict[tuple[object, ...], list[int]] = {}
        for k in sorted(chosen):
            e = self.entries[k]
            out.setdefault((*e.key, e.slot[-1]), []).append(k)
        return [tuple(members) for members in out.values()]

    def like(self, members: Sequence[int]) -> Set:
        """Return all entries of which one takes the place of an effect's."""
        one = self.entries[members[0]]
        return frozenset(
            k for k, e in enumerate(self.entries) if e.key == one.key and e.slot[-1] == one.slot[-1]
        )

    def without(self, chosen: Set, members: Sequence[int]) -> Set:
        """Return the set of most evidence without an effect."""
        same = self.like(members)
        return self.search(chosen - same, banned=same, steps=_RIVAL_STEPS)

    def _additions(self, chosen: Set, banned: Set) -> list[Set]:
        """Return the sets with one more of the entries that promise most."""
        gains = self.gains(chosen)
        gains[list(banned)] = -math.inf
        return [chosen | {k} for k in np.argsort(gains)[-_TRIED:].tolist() if math.isfinite(gains[k])]

    def untold(self, chosen: Set) -> list[int]:
        """Return the entries outside of a set of which these runs say next to nothing: posterior over prior deviation."""
        at = self.columns(chosen)
        cross = self.gram[:, at]
        rest = self.gram - cross @ (self.fit(chosen).covariance @ cross.T)
        return [
            k
            for k, s in enumerate(self.slices)
            if k not in chosen
            and max(1.0 / math.sqrt(max(rest[j, j], 0.0) + 1.0) for j in s.tolist()) > limits.UNTOLD
        ]


def without_noise(grams: FloatArray, noises: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return normal equations of recordings [r] over [columns, response] without what noise puts into them, of all but the
    response's square, and what was taken out.

    A direction of the columns that is noise for the most part in all recordings together is none: there a coefficient would
    explain noise. Directions are those in which neither energy nor noise is correlated, so it does not matter which columns
    span them.
    """
    gram, noise = grams.sum(axis=0)[:-1, :-1], noises.sum(axis=0)[:-1, :-1]
    _, kept = _directions(gram, noise)
    into = kept @ (kept.T @ gram)  # columns less what of them is noise
    clean, taken = grams.copy(), noises.copy()
    for g, n, one, other in zip(grams, noises, clean, taken, strict=True):
        here, there = into.T @ g[:-1, :-1] @ into, into.T @ n[:-1, :-1] @ into
        part, white = _directions(here, there)
        back = here @ white
        response = white.T @ into.T @ (g[:-1, -1] - n[:-1, -1])
        most = float(np.sum(response**2 / (1.0 - part)))  # no direction explains more than there is
        response *= min(1.0, math.sqrt(g[-1, -1] / most)) if most > 0.0 else 1.0
        for each, square, last in ((one, 1.0 - part, response), (other, part, white.T @ into.T @ n[:-1, -1])):
            each[:-1, :-1] = back * square @ back.T
            each[:-1, -1] = each[-1, :-1] = back @ last
    return clean, taken


def _directions(gram: FloatArray, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the part of noise [k] in directions [E, k] of the columns, of unit energy, which are not noise for the most."""
    energy = np.diag(gram)
    scale = 1.0 / np.sqrt(np.where(energy > 0.0, energy, np.inf))
    values, vectors = np.linalg.eigh(gram * scale[:, None] * scale)
    seen = values > _ALIKE
    white = scale[:, None] * vectors[:, seen] / np.sqrt(values[seen])
    part, turn = np.linalg.eigh(white.T @ noise @ white)
    return np.maximum(part[part < _NOISY], 0.0), white @ turn[:, part < _NOISY]


class Equations:
    """Whitened normal equations of all recordings over [entries' columns E | nuisances N | response].

    grams: per recording; noise: what the noise of torques puts into them; groups: of the variance of each nuisance; shared:
    which nuisances are discrepancy, with a part that all runs have in common.
    """

    def __init__(  # noqa: PLR0917
        self,
        entries: Sequence[Entry],
        grams: FloatArray,
        noise: FloatArray,
        groups: Sequence[object],
        shared: Index,
        start: Mapping[object, tuple[float, float]],
        most: Mapping[object, float],
        rows: float = math.inf,
    ) -> None:
        self.entries, self.groups, self.shared = list(entries), groups, shared
        self.recorded = np.zeros(sum(e.size for e in entries))
        self.start, self.most = start, most
        self.grams, self.noise = without_noise(grams, noise)
        self.E, self.N = sum(e.size for e in entries), len(groups)
        self.kinds = sorted(set(groups), key=str)
        self.member = {g: np.array([k for k, h in enumerate(groups) if h == g], np.intp) for g in self.kinds}
        self._inner = np.arange(self.E, self.E + self.N)
        self._outer = np.concatenate((np.arange(self.E), self.E + shared, [self.E + self.N])).astype(np.intp)
        self.rows = rows
        self.values: Set = frozenset(k for k, e in enumerate(entries) if e.prior.file)
        self.resemblance = self._resemblance()

    def alike(self, chosen: Set) -> Set:
        """Return all entries of the slots of a set."""
        slots = {self.entries[k].slot for k in chosen}
        return frozenset(k for k, e in enumerate(self.entries) if e.slot in slots)

    def _resemblance(self) -> dict[object, FloatArray]:
        """Return per discrepancy the variance of each coefficient [E] that least squares finds in one of unit variance."""
        total = self.grams.sum(axis=0)
        energy = np.maximum(np.diag(total)[: self.E], 1e-30)
        many = {g: [self.E + k for k in self.shared.tolist() if self.groups[k] == g] for g in self.most}
        return {g: np.sum((total[f, : self.E] / energy) ** 2, axis=0) for g, f in many.items()}

    def _orthogonal(self, total: FloatArray, chosen: Set) -> tuple[FloatArray, FloatArray]:
        """Return the equations over [E, shared, response] with a discrepancy that has no part along the columns of a set and
        of the values of the file (Plumlee 2017, J. Am. Stat. Assoc. 112): what these explain is none; and that basis.
        """
        at, e = columns_of(self.entries, chosen | self.values - self.alike(chosen)), self.E
        basis = np.eye(len(total))
        inner = total[np.ix_(at, at)] + np.eye(len(at))
        basis[at, e : e + len(self.shared)] = -np.linalg.solve(inner, total[at, e : e + len(self.shared)])
        return basis.T @ total @ basis, basis

    def first(self) -> dict[object, float]:
        """Return the variances to begin with."""
        out = {g: v for g, (v, _) in self.start.items()}
        return out | {("shared", g): out[g] for g in self.kinds if g in self.most}

    def sets(self, variances: Variances, chosen: Set = frozenset(), *, resembling: bool = True) -> Sets:
        """Return the sets at these variances, with the discrepancy beside a set; resembling: and what resembles any."""

        parts, _, keep = self._reduced(variances)
        total, basis = self._orthogonal(np.sum(parts, axis=0), chosen)
        gram, scatter = (
            self._without_shared(total, variances)[0],
            self._scatter(total, basis, keep, variances),
        )
        gram = self._without_resemblance(gram, variances) if resembling else gram
        return Sets(self.entries, gram, scatter)

    def deviation(self, variances: Variances) -> FloatArray:
        """Return the prior deviation of coefficients outside of a set [E]: as the recording makes them and the discrepancy
        resembles them, 1 at most.
        """
        out = self.recorded.copy()
        for g, part in self.resemblance.items():
            out += (variances["shared", g] + variances[g] / len(self.grams)) * part
        return np.sqrt(np.minimum(out, 1.0))

    def marginal(self, variances: Variances) -> list[FloatArray]:
        """Return the equations over [E, response] of all recordings but each in turn, and of all."""

        parts = np.array(self._reduced(variances)[0])
        totals = [*(parts.sum(axis=0) - parts), parts.sum(axis=0)]
        return [self._without_shared(total, variances)[0] for total in totals]

    def _without_resemblance(self, gram: FloatArray, variances: Variances) -> FloatArray:
        """Return the equations over [E, response] without what of the discrepancy resembles the entries: its covariance
        beside the noise's, by the matrix inversion lemma.
        """
        deviation = self.deviation(variances)
        part = deviation[:, None] * gram[: self.E]
        inner = np.eye(self.E) + part[:, : self.E] * deviation
        return np.asarray(gram - part.T @ np.linalg.solve(inner, part))

    def _reduced(
        self, variances: Variances
    ) -> tuple[list[FloatArray], float, list[tuple[FloatArray, FloatArray]]]:
        """Return per recording the equations over [E, shared, response] without its nuisances; log determinants; factors."""
        d = np.array([variances[g] for g in self.groups])
        out, logs, keep = [], 0.0, []
        for g in self.grams:
            inner = g[np.ix_(self._inner, self._inner)] + np.diag(1.0 / d)
            lower = np.linalg.cholesky(inner)
            cross = g[np.ix_(self._inner, self._outer)]
            half = np.linalg.solve(lower, cross)
            out.append(g[np.ix_(self._outer, self._outer)] - half.T @ half)
            logs += 2.0 * float(np.sum(np.log(np.diag(lower)))) + float(np.sum(np.log(d)))
            keep.append((lower, cross))
        return out, logs, keep

    def _shared_variances(self, variances: Variances) -> FloatArray:
        return np.array([variances["shared", self.groups[k]] for k in self.shared.tolist()])

    def _without_shared(self, total: FloatArray, variances: Variances) -> tuple[FloatArray, float]:
        """Return the equations over [E, response] without the shared discrepancy, and its log determinant."""
        w, o = self._places()
        v = self._shared_variances(variances)
        lower = np.linalg.cholesky(total[np.ix_(w, w)] + np.diag(1.0 / v))
        half = np.linalg.solve(lower, total[np.ix_(w, o)])
        log = 2.0 * float(np.sum(np.log(np.diag(lower)))) + float(np.sum(np.log(v)))
        return total[np.ix_(o, o)] - half.T @ half, log

    def _scatter(
        self,
        total: FloatArray,
        basis: FloatArray,
        keep: Sequence[tuple[FloatArray, FloatArray]],
        variances: Variances,
    ) -> Scatter:
        """Return the noise over [E, response] that is left by what a recording has of its own and by the discrepancy: what
        these explain of a column they explain of its noise.
        """

        def left(noise: FloatArray, o: Index, n: Index, into: FloatArray) -> FloatArray:
            side = noise[np.ix_(n, o)].T @ into
            return np.asarray(noise[np.ix_(o, o)] - side - side.T + into.T @ noise[np.ix_(n, n)] @ into)

        whole = np.zeros_like(total)
        for noise, (lower, cross) in zip(self.noise, keep, strict=True):
            whole += basis.T @ left(noise, self._outer, self._inner, cho_solve((lower, True), cross)) @ basis
        w, o = self._places()
        inner = total[np.ix_(w, w)] + np.diag(1.0 / self._shared_variances(variances))
        into = np.asarray(np.linalg.solve(inner, total[np.ix_(w, o)]), np.float64)
        return Scatter(left(whole, o, w, into), self.rows)

    def _places(self) -> tuple[Index, Index]:
        """Return where the shared discrepancy is in the equations over [E, shared, response], and where all else is."""
        end = self.E + len(self.shared)
        return np.arange(self.E, end), np.append(np.arange(self.E), end).astype(np.intp)

    def expected(
        self, chosen: Set, variances: Variances, steps: int
    ) -> tuple[dict[object, float], float, Means]:
        """Return the variances after `steps` for a set, -2 log marginal likelihood there, and means."""
        at, many, e = columns_of(self.entries, chosen), len(self.shared), self.E
        now = dict(variances)
        ends = zip(_bounds(self.entries), (-math.inf, math.inf), strict=True)
        low, high = (np.append(x[at], np.full(many, none)) for x, none in ends)
        for step in range(steps + 1):
            parts, logs, keep = self._reduced(now)
            total, basis = self._orthogonal(np.sum(parts, axis=0), chosen)
            q = np.concatenate((at, np.arange(e, e + many))).astype(np.intp)
            w = self._shared_variances(now)
            inner = total[np.ix_(q, q)] + np.diag(np.concatenate((np.ones(len(at)), 1.0 / w)))
            lower = np.linalg.cholesky(inner)
            covariance = np.linalg.inv(inner)
            theta = _within(inner, total[q, -1], low, high)
            left = float(total[-1, -1] - 2.0 * theta @ total[q, -1] + theta @ inner @ theta)
            score = left + logs + 2.0 * float(np.sum(np.log(np.diag(lower)))) + float(np.sum(np.log(w)))
            score -= 2.0 * sum(self.entries[k].odds for k in chosen)
            mine = np.zeros(e + many + 1)
            mine[q], mine[-1] = -theta, 1.0
            contrast = basis @ mine
            squares, spread, means = np.zeros(self.N), np.zeros(self.N), []
            for factor, cross in keep:
                inverse = np.linalg.inv(factor)
                inverse = inverse.T @ inverse
                u = inverse @ (cross @ contrast)
                b = inverse @ cross @ basis[:, q]
                squares += u**2
                spread += np.diag(inverse) + np.sum(b @ covariance * b, axis=1)
                means.append(u)
            for g in self.kinds:
                v0, n0 = self.start[g]
                score += n0 * (math.log(now[g]) + v0 / now[g])
                if g in self.most:
                    shared = now["shared", g]
                    score += n0 * (math.log(shared) + v0 / shared)
            if step == steps:
                score += self._scatter(total, basis, keep, now).by_chance(-mine[:e])
                break
            now = self._maximised(now, (squares, spread), (theta[len(at) :], np.diag(covariance)[len(at) :]))
        return now, score, Means(theta[: len(at)], theta[len(at) :], means, -basis[:e, e : e + many])

    def _maximised(
        self, now: Variances, own: tuple[FloatArray, FloatArray], shared: tuple[FloatArray, FloatArray]
    ) -> dict[object, float]:
        """Return the variances at which the squares are what the effective numbers of coefficients make expect (MacKay 1992,
        Neural Computation 4): many times fewer steps than by expectation-maximisation.
        """

        def better(g: object, kind: object, squares: float, spread: float, count: int) -> float:
            v0, n0 = self.start[kind]
            effective = max(count - spread / now[g], 0.0)
            return min((squares + n0 * v0) / (effective + n0), self.most.get(kind, math.inf))

        out: dict[object, float] = {}
        for g in self.kinds:
            mine = self.member[g]
            out[g] = better(
                g, g, float(own[0][mine].sum()), float(own[1][mine].sum()), len(self.grams) * len(mine)
            )
            if g in self.most:
                at = np.array([j for j, k in enumerate(self.shared.tolist()) if self.groups[k] == g], np.intp)
                out["shared", g] = better(
                    ("shared", g), g, float(np.sum(shared[0][at] ** 2)), float(shared[1][at].sum()), len(at)
                )
        return out
