"""Search for effects: beam search over the library by BIC, one effect at a time, all refitted jointly.

BIC = deviance of the mixed model + ln(n_eff) per parameter. An effect enters when it lowers BIC by ENTER and when its
parameters are physically plausible; it stays when nothing that came later replaces it. Held out: the coefficients
of all other runs must predict the left-out run better with the effect than without.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.effects import EFFECTS
from jtqd.sysid.diagnosis.current_zero import Readings, UnpoweredColumn, reading_misfit
from jtqd.sysid.diagnosis.mixed_model import Mixed, Model, explained_each, solve
from jtqd.sysid.diagnosis.regressors import EffectCandidate

ENTER: Final = 10.0
"""BIC difference: very strong evidence on the scale of Kass and Raftery 1995, J. Am. Stat. Assoc. 90."""
HELD_OUT: Final = 0.3
"""Part of the evidence in sample that must be there on held-out runs."""
DEEPEST: Final = 6
_BEAM: Final = 3
_TRIED: Final = 8
_SCALED: Final = tuple(name for name, effect in EFFECTS.items() if effect.scales_balance)
_ONE_FACTOR: Final = 0.3
"""Changes that differ by less than this part of themselves are one."""


@dataclass(frozen=True)
class Hypothesis:
    """A set of candidates and its fit; bic as above."""

    chosen: tuple[EffectCandidate, ...]
    model: Model
    bic: float

    def coefficients(self, candidate: EffectCandidate) -> list[float]:
        """Return the coefficients of one of its candidates."""
        first = 0
        for one in self.chosen:
            if one is candidate:
                return [float(b) for b in self.model.beta[first : first + one.size]]
            first += one.size
        raise KeyError(candidate.key)


class Search:
    """The library's candidates on one set of runs.

    moments [channels, P, P]: mean products of a unit of every column, Nm^2; column_rms [P]: by them the rms in the
    channel where it is largest, Nm; least_nm: smaller contributions are not called effects, however certain; readings,
    unpowered: what the currents read without power, per run, and which columns make them read that (`current_zero`).
    """

    def __init__(
        self,
        mixed: Mixed,
        candidates: Sequence[EffectCandidate],
        effective_rows: float,
        moments: FloatArray,
        least_nm: float,
        *,
        readings: Sequence[Readings] = (),
        unpowered: Sequence[UnpoweredColumn] = (),
    ) -> None:
        self.mixed = mixed
        self._moments = moments
        self.column_rms = np.sqrt(np.diagonal(moments, axis1=1, axis2=2).max(axis=0))
        self.least_nm = least_nm
        self._readings, self._unpowered = readings, unpowered
        self.candidates = tuple(candidates)
        self.log_n = math.log(max(effective_rows, 10.0))
        prior, _ = mixed.marginal(mixed.prior)
        certain, _ = mixed.marginal(np.full_like(mixed.prior, 1e-12))
        self._marginal_share = np.clip(np.diag(prior) / np.maximum(np.diag(certain), 1e-300), 0.0, 1.0)
        terms: dict[tuple[str, object], int] = {}
        for c in candidates:
            terms[c.key] = terms.get(c.key, 0) + 1
        self._choice = {key: 2.0 * math.log(n) for key, n in terms.items()}
        self._log_n = {c.first: self._rows_that_count(c) for c in candidates}
        self.joints = len({c.joint for c in candidates} - {"sensor"})
        self._cache: dict[tuple[int, ...], Hypothesis] = {}
        self.rejected: set[tuple[str, object]] = set()
        """Effects (with joint) that shall not be chosen again (`guards`)."""

    def without_run(self, number: int) -> Search:
        """Return the search on the other runs, with nothing rejected; the sizes of columns stay those of all runs."""
        runs = [r for r in range(self.mixed.runs) if r != number]
        of_runs = [r for r, piece in enumerate(self.mixed.pieces) if piece != number]
        return Search(
            self.mixed.subset(runs),
            self.candidates,
            math.exp(self.log_n) * len(runs) / self.mixed.runs,
            self._moments,
            self.least_nm,
            readings=[self._readings[r] for r in of_runs] if self._readings else (),
            unpowered=self._unpowered,
        )

    def penalty(self, candidate: EffectCandidate) -> float:
        """Return what the candidate costs in BIC: its parameters, and the choice among its terms."""
        return candidate.size * self._log_n[candidate.first] + self._choice[candidate.key]

    def _rows_that_count(self, candidate: EffectCandidate) -> float:
        """Return ln n for the BIC of a candidate: of all rows where its uncertainty is noise, of the runs where it is
        what differs between runs (an offset is measured once per run, however long the run).
        """
        share = 1.0 - float(self._marginal_share[candidate.first])
        return (1.0 - share) * self.log_n + share * math.log(self.mixed.runs + 1.0)

    def hypothesis(self, chosen: Sequence[EffectCandidate], start: Model | None = None) -> Hypothesis:
        """Return the fit of a set of candidates."""
        ordered = tuple(sorted(chosen, key=lambda c: c.first))
        key = tuple(c.first for c in ordered)
        if key not in self._cache:
            columns = [k for c in ordered for k in c.columns]
            model = self.mixed.fit(columns, None if start is None else start.variances)
            cost = sum(self.penalty(c) for c in ordered)
            self._cache[key] = Hypothesis(ordered, model, model.deviance + cost)
        return self._cache[key]

    def without(self, hypothesis: Hypothesis, candidate: EffectCandidate) -> Hypothesis:
        """Return the fit of a set less one of its candidates, begun at its variances."""
        return self.hypothesis([c for c in hypothesis.chosen if c is not candidate], hypothesis.model)

    def plausible(self, hypothesis: Hypothesis) -> bool:
        """Return whether all parameters lie in their plausible ranges, and all contributions matter."""
        if units_changed(hypothesis, self.joints):
            return False
        return all(
            within(c, hypothesis.coefficients(c)) and self.size_nm(hypothesis, c) >= self.least_nm
            for c in hypothesis.chosen
        )

    def size_nm(self, hypothesis: Hypothesis, candidate: EffectCandidate) -> float:
        """Return the rms of a candidate's contribution in the channel where it is largest [Nm]."""
        own = slice(candidate.first, candidate.first + candidate.size)
        beta = np.array(hypothesis.coefficients(candidate))
        squares = np.einsum("i,cij,j->c", beta, self._moments[:, own, own], beta)
        return float(np.sqrt(max(squares.max(), 0.0)))

    def same_torques(self, one: Hypothesis, other: Hypothesis) -> bool:
        """Return whether two sets differ by less than what is called an effect, at rest as in motion, so that they explain
        the same. A wave of the sensor instead of one at a joint fits better only by a wave too small to be named.
        """
        difference = np.zeros(len(self.column_rms))
        difference[list(one.model.columns)] += one.model.beta
        difference[list(other.model.columns)] -= other.model.beta
        squares = np.einsum("i,cij,j->c", difference, self._moments, difference)
        at_rest = abs(self.reading_misfit(one) - self.reading_misfit(other))
        return bool(squares.max() < self.least_nm**2) and at_rest < ENTER

    def reading_misfit(self, hypothesis: Hypothesis) -> float:
        """Return the sum of squares that what the currents read without power leaves; 0 without such a reading."""
        beta = dict(zip(hypothesis.model.columns, hypothesis.model.beta, strict=True))
        read: dict[int, float] = {}
        for where, column, amperes in self._unpowered:
            if isinstance(where, int):
                read[where] = read.get(where, 0.0) + amperes * float(beta.get(column, 0.0))
        return reading_misfit(self._readings, read)

    def fits_beside(
        self, candidate: EffectCandidate, chosen: Sequence[EffectCandidate], *, again: bool = False
    ) -> bool:
        """Return whether a candidate may be added: effects once, waves once per order, rejected ones only `again`."""
        if (candidate.key in self.rejected and not again) or not pinned([*chosen, candidate], self.joints):
            return False
        for one in chosen:
            if one.key == candidate.key and (
                not candidate.effect.is_wave or order_of(one) == order_of(candidate)
            ):
                return False
        return True

    def run(self) -> Hypothesis:
        """Return the best set of candidates."""
        best = self.hypothesis(())
        beam = [best]
        seen = [best]
        for _ in range(DEEPEST):
            grown: dict[tuple[int, ...], Hypothesis] = {}
            for parent in beam:
                for child in self.children(parent):
                    grown[tuple(c.first for c in child.chosen)] = child
            if not grown:
                break
            beam = sorted(grown.values(), key=lambda h: h.bic)[:_BEAM]
            best = min((best, beam[0]), key=_with_price)
            seen += [*beam, min(grown.values(), key=_with_price)]
        # what two that came together leave when one of them goes must be worth its effects, too
        best = min((self.pruned(best), *seen), key=_with_price)
        shorter = [h for h in seen if len(h.chosen) < len(best.chosen) and self.same_torques(h, best)]
        return min(shorter, key=lambda h: (len(h.chosen), h.bic), default=best)

    def confirmed(self) -> Hypothesis:
        """Return the best set of candidates less those that do not help on held-out runs."""
        best = self.run()
        while best.chosen:
            weak = []
            for c in best.chosen:
                without = self.without(best, c)
                evidence = without.model.deviance - best.model.deviance
                if self.held_out(best, c) < HELD_OUT * evidence:
                    weak.append((evidence, c))
            if not weak:
                return best
            weakest = min(weak, key=lambda pair: pair[0])[1]
            best = self.without(best, weakest)
        return best

    def children(self, parent: Hypothesis) -> list[Hypothesis]:
        """Return the most promising plausible extensions that lower BIC by ENTER."""
        # at the parent's variances what is common to all runs can hide in them, so the prior's are tried too
        totals = [self.mixed.marginal(v)[0] for v in (parent.model.variances, self.mixed.prior)]
        base = list(parent.model.columns)
        additions = self.additions(parent.chosen)
        columns = [[k for c in new for k in c.columns] for new in additions]
        drops = np.max([explained_each(total, base, columns) for total in totals], axis=0)
        prices = [sum(self.penalty(c) for c in new) for new in additions]
        scored = [(float(d) - price, new) for d, price, new in zip(drops, prices, additions, strict=True)]
        scored.sort(key=lambda pair: -pair[0])
        out = []
        tried = 0
        for drop, new in scored:
            if drop < ENTER * 0.5 or tried >= _TRIED:
                break
            child = self.hypothesis((*parent.chosen, *new), parent.model)
            if self.plausible(child):
                tried += 1
                if child.bic < parent.bic - ENTER * len(new):
                    out.append(child)
        return out

    def additions(self, chosen: Sequence[EffectCandidate]) -> list[tuple[EffectCandidate, ...]]:
        """Return what may be added to a set: each candidate that fits beside it, and Coulomb with viscous friction of one
        joint, of which the one may only show with the other (a file with too much of one and too little of the other).
        """
        fitting = [c for c in self.candidates if self.fits_beside(c, chosen)]
        return [*((c,) for c in fitting), *friction_pairs(fitting)]

    def pruned(self, best: Hypothesis) -> Hypothesis:
        """Return the set without candidates that are no longer worth their place."""
        while best.chosen:
            candidate = min((self.without(best, c) for c in best.chosen), key=lambda h: h.bic)
            if candidate.bic - best.bic >= ENTER or not self.plausible(candidate):
                return best
            best = candidate
        return best

    def held_out(self, hypothesis: Hypothesis, candidate: EffectCandidate) -> float:
        """Return the drop of the deviance on held-out runs that the candidate brings, summed over the runs."""
        without = self.without(hypothesis, candidate)
        return float(np.sum(self.held_out_deviances(without) - self.held_out_deviances(hypothesis)))

    def held_out_deviances(self, hypothesis: Hypothesis) -> FloatArray:
        """Return the deviance of each held-out run, coefficients from all others: what varies from run to run has its
        price.
        """
        grams, logs = self._per_run(hypothesis)
        contrasts = [np.append(-beta, 1.0) for beta in self.held_out_beta(hypothesis)]
        squares = [float(c @ gram @ c) for c, gram in zip(contrasts, grams, strict=True)]
        return np.asarray(logs + np.array(squares))

    def held_out_beta(self, hypothesis: Hypothesis) -> list[FloatArray]:
        """Return per run the coefficients of a set of candidates from all other runs."""
        return [beta for beta, _ in self.held_out_fits(hypothesis)]

    def held_out_fits(self, hypothesis: Hypothesis) -> list[tuple[FloatArray, FloatArray]]:
        """Return per run the coefficients of a set of candidates from all other runs, and their covariance."""
        grams, _ = self._per_run(hypothesis)
        total = grams.sum(axis=0)
        return [solve(total - gram, len(hypothesis.model.columns)) for gram in grams]

    def of_pieces(self, per_run: Sequence[FloatArray]) -> list[FloatArray]:
        """Return the same for each piece of the runs."""
        return [per_run[r] for r in self.mixed.pieces]

    def _per_run(self, hypothesis: Hypothesis) -> tuple[FloatArray, FloatArray]:
        """Return per run the normal equations of a set of candidates and the log determinants [r]."""
        marginals, logs = self.mixed.marginal_runs(hypothesis.model.variances)
        places = np.array([*hypothesis.model.columns, marginals.shape[1] - 1], np.intp)
        return marginals[:, places[:, None], places[None, :]], logs


def friction_pairs(candidates: Sequence[EffectCandidate]) -> list[tuple[EffectCandidate, EffectCandidate]]:
    """Return Coulomb and viscous friction of each joint that has both."""
    viscous = {c.joint: c for c in candidates if c.effect.name == "viscous_friction"}
    coulomb = [c for c in candidates if c.effect.name == "coulomb_friction" and c.joint in viscous]
    return [(c, viscous[c.joint]) for c in coulomb]


def _with_price(hypothesis: Hypothesis) -> float:
    """Return BIC with ENTER per effect: a set from another branch must be worth its effects as an addition must. Two zeros
    in the place of one (a sensor's and one joint's for the other joint's) fit as well, and by chance a little better.
    """
    return hypothesis.bic + ENTER * len(hypothesis.chosen)


def pinned(chosen: Sequence[EffectCandidate], joints: int) -> bool:
    """Return whether something fixes the scale: with the sensor's gain free, the stiffness (and the torque constant) of
    at least one joint is not. All of them times the same factor is a change of units, which shrinks the noise too.
    """
    names = [c.effect.name for c in chosen]
    if not any(c.effect.scales_all for c in chosen):
        return True
    return all(names.count(name) < joints for name in _SCALED)


def units_changed(hypothesis: Hypothesis, joints: int) -> bool:
    """Return whether most of the stiffnesses and torque constants of the joints change by one factor: the sensor's gain in
    other words (with the rest changed the other way), which is fewer effects and shrinks the noise where the factor is below
    1 (see `pinned`).
    """
    changes: list[float] = []
    for candidate in hypothesis.chosen:
        if candidate.effect.name in _SCALED:
            values = candidate.term.combine(hypothesis.coefficients(candidate))
            nothing = candidate.term.combine([0.0] * candidate.size)
            keyed = next(p.name for p in candidate.effect.parameters if p.key)
            changes.append(values[keyed] / nothing[keyed] - 1.0)
    changes.sort()
    most = len(_SCALED) * max(joints, 1) // 2 + 1
    alike = (changes[k : k + most] for k in range(len(changes) - most + 1))
    return any(some[-1] - some[0] < _ONE_FACTOR * abs(sum(some) / most) for some in alike)


def within(candidate: EffectCandidate, coefficients: Sequence[float]) -> bool:
    """Return whether the parameters of these coefficients are plausible."""
    values = candidate.term.combine(coefficients)
    return all(p.low <= values[p.name] <= p.high for p in candidate.effect.parameters if p.name in values)


def order_of(candidate: EffectCandidate) -> float:
    """Return the order per motor revolution of a wave, 0 for what is none."""
    return float(candidate.term.basis[0].get("order_per_motor_rev", 0.0))
