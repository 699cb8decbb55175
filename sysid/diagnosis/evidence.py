"""Evidence: marginal likelihood of sets of entries, and the search for the set that has most of it.

    y_r = X beta + F (w + v_r) + Z_r u_r + e_r        per balance, binned, e coloured (`noise`)

X: columns of the entries, scaled so that beta ~ N(0, 1) for entries in the set and 0 for all others; a set has prior odds.
F: random Fourier features of the conditions (`discrepancy`): what no library holds; w shared by all runs, v_r a run's own.
Z: what a run has of its own (`regressors.families`). The variances of w, v and u are found by expectation-maximisation
(Laird and Ware 1982, Biometrics 38). Given them everything is linear and Gaussian, and the evidence of any set follows from
one matrix of whitened normal equations (George and McCulloch 1993, J. Am. Stat. Assoc. 88: spike and slab):

    2 log evidence = b' (A_SS + 1)^-1 b - log |A_SS + 1| + 2 sum log odds

The response of each balance has weight one, so no set gains by scaling a balance. What noise of a torque puts into the
columns is taken out of the normal equations (Fuller 1987, Measurement Error Models).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from jtqd.estimator.arrays import FloatArray
from jtqd.sysid.diagnosis import limits
from jtqd.sysid.diagnosis.entries import Entry
from jtqd.sysid.diagnosis.regressors import Index

Set = frozenset[int]
"""Numbers of entries."""
Groups = Sequence[object]
"""Of the variance of each nuisance."""
Variances = Mapping[object, float]
_LESS: Final = 1e-6
_TRIED: Final = 3
"""Additions that are tried at each step, those of largest gain."""
_PAIRED: Final = 8
"""Entries that share most with the one that goes, and as many of largest gain: their pairs are tried in its place."""
_LITTLE: Final = 0.1
_NOISY: Final = 0.5
"""Part of a column's energy that its noise may be."""


@dataclass(frozen=True)
class Fit:
    """A set at given variances: posterior mean and covariance of its scaled coefficients in order; log evidence less what
    all sets have in common.
    """

    mean: FloatArray
    covariance: FloatArray
    evidence: float


class Sets:
    """Sets of entries on marginal normal equations A [E + 1, E + 1], last: the response."""

    def __init__(
        self,
        entries: Sequence[Entry],
        gram: FloatArray,
        out: Set = frozenset(),
        noise: FloatArray | None = None,
    ) -> None:
        self.entries, self.gram, self.out = list(entries), gram, out
        self._noise = np.zeros_like(gram) if noise is None else noise
        self.slices: list[Index] = []
        first = 0
        for e in entries:
            self.slices.append(np.arange(first, first + e.size))
            first += e.size
        one = np.array([e.size == 1 for e in entries], bool)
        self._single = np.flatnonzero(one)
        self._place = np.array([self.slices[k][0] for k in self._single], np.intp)
        self._many = [
            (members, np.array([self.slices[k] for k in members]))
            for size in sorted({e.size for e in entries} - {1})
            for members in [np.flatnonzero([e.size == size for e in entries])]
        ]
        singles = [e for e in entries if e.size == 1]
        self._low = np.array([e.low for e in singles])
        self._high = np.array([e.high for e in singles])
        self._odds = np.array([e.odds for e in entries])
        self._fits: dict[Set, Fit] = {}

    def columns(self, chosen: Set) -> Index:
        """Return the places of a set's coefficients, in order of its entries."""
        return (
            np.concatenate([self.slices[k] for k in sorted(chosen)]).astype(np.intp)
            if chosen
            else np.empty(0, np.intp)
        )

    def fit(self, chosen: Set) -> Fit:
        """Return the posterior of a set; a coefficient beyond its bound is held at it."""
        if chosen not in self._fits:
            self._fits[chosen] = self._fit(chosen)
        return self._fits[chosen]

    def _fit(self, chosen: Set) -> Fit:
        at = self.columns(chosen)
        inner = self.gram[np.ix_(at, at)] + np.eye(len(at))
        right = self.gram[at, -1]
        try:
            factor = cho_factor(inner)
        except np.linalg.LinAlgError:
            return Fit(np.zeros(len(at)), np.eye(len(at)), -math.inf)
        low, high = self._bounds(chosen)
        mean = cho_solve(factor, right)
        held = np.zeros(len(at), bool)
        for _ in range(len(at)):
            beyond = ~held & ((mean < low) | (mean > high))
            if not beyond.any():
                break
            held |= beyond
            mean[held] = np.clip(mean[held], low[held], high[held])
            free = ~held
            if free.any():
                rest = right[free] - inner[np.ix_(free, held)] @ mean[held]
                mean[free] = np.linalg.solve(inner[np.ix_(free, free)], rest)
        covariance = cho_solve(factor, np.eye(len(at)))
        log = float(np.sum(np.log(np.diag(factor[0]))))
        evidence = float(mean @ right - 0.5 * mean @ inner @ mean) - log
        return Fit(mean, covariance, evidence + sum(self.entries[k].odds for k in chosen))

    def noise(self, chosen: Set) -> float:
        """Return the whitened energy that noise of torques and accelerations has in what a set leaves."""
        contrast = np.zeros(len(self._noise))
        contrast[self.columns(chosen)], contrast[-1] = -self.fit(chosen).mean, 1.0
        return float(contrast @ self._noise @ contrast)

    def places(self, chosen: Set) -> dict[int, slice]:
        """Return where the coefficients of each entry of a set are among those of all."""
        out, first = {}, 0
        for k in sorted(chosen):
            out[k] = slice(first, first + self.entries[k].size)
            first += self.entries[k].size
        return out

    def _bounds(self, chosen: Set) -> tuple[FloatArray, FloatArray]:
        ends = [
            (e.low, e.high) if k == 0 and e.bounded else (-math.inf, math.inf)
            for e in (self.entries[j] for j in sorted(chosen))
            for k in range(e.size)
        ]
        return np.array([a for a, _ in ends]), np.array([b for _, b in ends])

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
        free = np.array(
            [k not in chosen | self.out and e.slot not in taken for k, e in enumerate(self.entries)], bool
        )
        if len(self._single):
            precision = rest[self._place, self._place] + 1.0
            b = response[self._place]
            with np.errstate(divide="ignore", invalid="ignore"):
                best = np.clip(b / precision, self._low, self._high)
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
        """Return the set from which no addition, removal, exchange or exchange of one for two gains."""
        chosen = start
        for _ in range(steps):
            moves = [*self._additions(chosen, banned), *(chosen - {k} for k in chosen)]
            for k in chosen:
                less = chosen - {k}
                moves += self._additions(less, banned | {k})
                moves += [less | pair for pair in self._pairs(less, k, banned)]
            best = max(moves, key=lambda s: self.fit(s).evidence, default=chosen)
            if self.fit(best).evidence <= self.fit(chosen).evidence + _LESS:
                break
            chosen = best
        return chosen

    def _additions(self, chosen: Set, banned: Set) -> list[Set]:
        """Return the sets with one more of the entries that promise most."""
        gains = self.gains(chosen)
        gains[list(banned)] = -math.inf
        return [chosen | {k} for k in np.argsort(gains)[-_TRIED:].tolist() if math.isfinite(gains[k])]

    def _pairs(self, less: Set, gone: int, banned: Set) -> list[Set]:
        """Return pairs of single-column entries that may stand in the place of one: of those that share most with it, and of
        those that promise most, the pair with most evidence.
        """
        if self.entries[gone].size > 1:
            return []
        now, at = self.fit(less), self.columns(less)
        cross = self.gram[:, at]
        column = self.slices[gone][0]
        taken = {self.entries[k].slot for k in less}
        usable = np.array(
            [
                k not in banned | self.out and k != gone and self.entries[k].slot not in taken
                for k in self._single.tolist()
            ],
            bool,
        )
        if usable.sum() < 2:
            return []
        members, places = self._single[usable], self._place[usable]
        rest = self.gram[np.ix_(places, places)] - cross[places] @ (now.covariance @ cross[places].T)
        b = self.gram[places, -1] - cross[places] @ now.mean
        shared = self.gram[places, column] - cross[places] @ (now.covariance @ cross[column])
        scale = np.sqrt(np.maximum(np.diag(rest), 0.0) + 1.0)
        few = np.union1d(
            np.argsort(np.abs(b) / scale)[-_PAIRED:], np.argsort(np.abs(shared) / scale)[-_PAIRED:]
        ).astype(np.intp)
        i, j = np.triu_indices(len(few), 1)
        i, j = few[i], few[j]
        p, q, r = rest[i, i] + 1.0, rest[j, j] + 1.0, rest[i, j]
        determinant = p * q - r * r
        good = (p >= 1.0) & (q >= 1.0) & (determinant >= 1.0)
        value = (
            0.5 * (q * b[i] ** 2 - 2.0 * r * b[i] * b[j] + p * b[j] ** 2) / np.where(good, determinant, 1.0)
        )
        value = np.where(good, value - 0.5 * np.log(np.where(good, determinant, 1.0)), -math.inf)
        best = np.argsort(value)[-2:]
        return [frozenset((int(members[i[k]]), int(members[j[k]]))) for k in best if math.isfinite(value[k])]

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
        groups: Groups,
        shared: Index,
        start: Mapping[object, tuple[float, float]],
        most: Mapping[object, float],
    ) -> None:
        self.entries, self.groups, self.shared = list(entries), groups, shared
        self.plain, self.noise = grams, noise
        self.start, self.most = start, most
        self.E, self.N = sum(e.size for e in entries), len(groups)
        self.kinds = sorted(set(groups), key=str)
        self.member = {g: np.array([k for k, h in enumerate(groups) if h == g], np.intp) for g in self.kinds}
        self._inner = np.arange(self.E, self.E + self.N)
        self._outer = np.concatenate((np.arange(self.E), self.E + shared, [self.E + self.N])).astype(np.intp)
        self.noisy = self._noisy()
        self.kappa = 1.0
        self.grams = grams
        self._take_out(1.0)

    def _noisy(self) -> Set:
        """Return the entries whose columns are noise for the most part, as a rate of a noisy torque is."""
        ends = np.cumsum([0, *(e.size for e in self.entries)])
        signal, noise = (np.einsum("rii->i", g)[: self.E] for g in (self.plain, self.noise))
        much = noise > _NOISY * signal
        return frozenset(k for k in range(len(self.entries)) if much[ends[k] : ends[k + 1]].any())

    def _take_out(self, kappa: float) -> None:
        self.kappa = kappa
        self.grams = self.plain - kappa * self.noise
        self.grams[:, -1, -1] = self.plain[:, -1, -1]

    def first(self) -> dict[object, float]:
        """Return the variances to begin with."""
        out = {g: v for g, (v, _) in self.start.items()}
        for g in self.kinds:
            if g in self.most:
                out["shared", g] = out[g]
        return out

    def columns_of(self, chosen: Set) -> Index:
        """Return the places of a set's coefficients."""
        ends = np.cumsum([0, *(e.size for e in self.entries)])
        return (
            np.concatenate([np.arange(ends[k], ends[k + 1]) for k in sorted(chosen)]).astype(np.intp)
            if chosen
            else np.empty(0, np.intp)
        )

    def sets(self, variances: Variances) -> Sets:
        """Return the sets at these variances."""
        parts, _, _ = self._reduced(variances)
        return self._sets(np.sum(parts, axis=0), variances)

    def _sets(self, total: FloatArray, variances: Variances) -> Sets:
        ends = np.array([*range(self.E), self.E + self.N], np.intp)
        noise = self.noise.sum(axis=0)[np.ix_(ends, ends)]
        return Sets(self.entries, self._without_shared(total, variances)[0], self.noisy, noise)

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
        many = len(self.shared)
        w = np.arange(self.E, self.E + many)
        o = np.concatenate((np.arange(self.E), [self.E + many])).astype(np.intp)
        v = self._shared_variances(variances)
        lower = np.linalg.cholesky(total[np.ix_(w, w)] + np.diag(1.0 / v))
        half = np.linalg.solve(lower, total[np.ix_(w, o)])
        log = 2.0 * float(np.sum(np.log(np.diag(lower)))) + float(np.sum(np.log(v)))
        return total[np.ix_(o, o)] - half.T @ half, log

    def own(self, chosen: Set, mean: FloatArray, variances: Variances) -> FloatArray:
        """Return the means of each recording's nuisances beside a set with these coefficients [r, N]."""
        d = np.array([variances[g] for g in self.groups])
        contrast = np.zeros(self.E + 1)
        contrast[self.columns_of(chosen)], contrast[-1] = -mean, 1.0
        ends = np.array([*range(self.E), self.E + self.N], np.intp)
        out = []
        for gram in self.grams:
            inner = gram[np.ix_(self._inner, self._inner)] + np.diag(1.0 / d)
            out.append(np.linalg.solve(inner, gram[np.ix_(self._inner, ends)] @ contrast))
        return np.array(out)

    def expected(
        self, chosen: Set, variances: Variances, steps: int
    ) -> tuple[dict[object, float], float, tuple[FloatArray, FloatArray, list[FloatArray]]]:
        """Return `_expected`; where what is taken out, known to its own scatter, leaves no covariance, less is taken out."""
        while True:
            try:
                return self._expected(chosen, variances, steps)
            except np.linalg.LinAlgError:
                if self.kappa <= 0.0:
                    raise
                self._take_out(0.5 * self.kappa if self.kappa > _LITTLE else 0.0)

    def _expected(
        self, chosen: Set, variances: Variances, steps: int
    ) -> tuple[dict[object, float], float, tuple[FloatArray, FloatArray, list[FloatArray]]]:
        """Return the variances by `steps` of expectation-maximisation for a set, -2 log marginal likelihood there, and the
        means of coefficients, shared discrepancy, and each recording's nuisances.
        """
        at, many, e = self.columns_of(chosen), len(self.shared), self.E
        now = dict(variances)
        for step in range(steps + 1):
            parts, logs, keep = self._reduced(now)
            total = np.sum(parts, axis=0)
            q = np.concatenate((at, np.arange(e, e + many))).astype(np.intp)
            w = self._shared_variances(now)
            inner = total[np.ix_(q, q)] + np.diag(np.concatenate((np.ones(len(at)), 1.0 / w)))
            lower = np.linalg.cholesky(inner)
            covariance = np.linalg.inv(inner)
            theta = covariance @ total[q, -1]
            score = (
                float(total[-1, -1] - theta @ total[q, -1])
                + logs
                + 2.0 * float(np.sum(np.log(np.diag(lower))))
                + float(np.sum(np.log(w)))
                - 2.0 * sum(self.entries[k].odds for k in chosen)
            )
            contrast = np.zeros(e + many + 1)
            contrast[q], contrast[-1] = -theta, 1.0
            second, means = np.zeros(self.N), []
            for factor, cross in keep:
                inverse = np.linalg.inv(factor)
                inverse = inverse.T @ inverse
                u = inverse @ (cross @ contrast)
                b = inverse @ cross[:, q]
                second += u**2 + np.diag(inverse) + np.einsum("ij,jk,ik->i", b, covariance, b)
                means.append(u)
            for g in self.kinds:
                v0, n0 = self.start[g]
                score += n0 * (math.log(now[g]) + v0 / now[g])
                if g in self.most:
                    shared = now["shared", g]
                    score += n0 * (math.log(shared) + v0 / shared)
            if step == steps:
                break
            now = self._maximised(second, theta[len(at) :], np.diag(covariance)[len(at) :])
        return now, score, (theta[: len(at)], theta[len(at) :], means)

    def _maximised(self, second: FloatArray, shared: FloatArray, spread: FloatArray) -> dict[object, float]:
        out: dict[object, float] = {}
        for g in self.kinds:
            v0, n0 = self.start[g]
            mine = self.member[g]
            most = self.most.get(g, math.inf)
            out[g] = min((float(second[mine].sum()) + n0 * v0) / (len(self.grams) * len(mine) + n0), most)
            if g in self.most:
                at = np.array([j for j, k in enumerate(self.shared.tolist()) if self.groups[k] == g], np.intp)
                sums = float(np.sum(shared[at] ** 2 + spread[at]))
                out["shared", g] = min((sums + n0 * v0) / (len(at) + n0), most)
        return out
