"""Leave-one-run-out confirmation: with fewer than four runs an accepted effect must hold on each held-out run.

With many runs the sum over held-out runs decides whether an effect is present. With two or three, one run can carry that
sum, the variance of the runs' own changes is little more than its prior, and errors of the models pass for an effect. So the
rule is harder: with the coefficients of the other runs an effect must lower both the deviance and the plain squared error of
the torque on each held-out run. Where the set as a whole does not pass, the search is made again by that error alone. An
alternative is ruled out by being worse on each held-out run, not by their sum.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.sysid.diagnosis.dataset import Dataset
from jtqd.sysid.diagnosis.evidence import WITHIN
from jtqd.sysid.diagnosis.findings import Cause, JointName, joint_text
from jtqd.sysid.diagnosis.mixed_model import ENOUGH_RUNS, explained
from jtqd.sysid.diagnosis.regressors import EffectCandidate
from jtqd.sysid.diagnosis.search import DEEPEST, Hypothesis, Search, friction_pairs
from jtqd.sysid.diagnosis.signals import Channel

FALL: Final = 0.05
"""Part of the squared error of every held-out run that an effect must take away."""
LARGE_FALL: Final = 0.3
"""A fall that needs no other confirmation: the deviance asks for quick parts of the torque, where models err first."""
_LADDER: Final = ("coulomb_friction", "viscous_friction", "rotor_inertia", "load_dependent_friction")
_NEARLY: Final = 0.5
"""Part of an interval's width from its end within which a value is as good as inside, with so few runs."""
ENOUGH_LEFT: Final = 0.2
"""Part of the error that effects could explain at all which may stay unexplained on held-out runs."""
_SCALES: Final = frozenset({"torque_constant", "sensor_gain"})

Squares = Mapping[Channel, float]


class LeaveOneOut:
    """Sets of candidates, judged on each held-out run."""

    def __init__(self, dataset: Dataset, search: Search) -> None:
        self.dataset = dataset
        self.search = search
        self._squares: dict[tuple[int, ...], list[Squares]] = {}

    def confirmed(self, found: Hypothesis) -> Hypothesis:
        """Return the set that was found where it holds, else the best by the error on held-out runs that does."""
        if self._reached(found):
            return found
        best = min((self.search.hypothesis(()), *self._ladders()), key=self._score)
        for _ in range(DEEPEST):
            grown = {tuple(c.first for c in h.chosen): h for h in self._children(best)}
            better = [h for h in grown.values() if self._score(h) < self._score(best) and self.holds(h)]
            if not better:
                break
            best = min(better, key=self._score)
        return best

    def _ladders(self) -> list[Hypothesis]:
        """Return the sets that are worth it of what is fitted to a joint first: friction, inertia, load-dependent friction.
        One of them may show only with the others, as each is wrong in a file that nobody measured; and one alone, that
        all runs share, need not be worth it in BIC, which may give it to the changes from run to run.
        """
        terms: dict[tuple[str, object], EffectCandidate] = {}
        for c in self.search.candidates:
            if c.effect.name in _LADDER:
                terms.setdefault(c.key, c)
        out = []
        for size in range(1, len(_LADDER) + 1):
            for chosen in itertools.combinations(terms.values(), size):
                if len({c.joint for c in chosen}) == 1:
                    h = self.search.hypothesis(chosen)
                    if self.search.plausible(h) and self._worth(h):
                        out.append(h)
        return out

    def _worth(self, hypothesis: Hypothesis) -> bool:
        """Return whether a set takes away much on each held-out run, and each of its candidates more than it costs: harm
        on one run is outweighed by what it does on the others.
        """
        chosen = hypothesis.chosen
        if min(self._falls(hypothesis, self.search.hypothesis(()), chosen)) < LARGE_FALL:
            return False
        each = [self._falls(hypothesis, self.search.without(hypothesis, c), (c,)) for c in chosen]
        return all(min(falls) > -2.0 * FALL and sum(falls) > 2.0 * FALL for falls in each)

    def holds(self, hypothesis: Hypothesis) -> bool:
        """Return whether each candidate, and all together, help on every held-out run."""
        nothing = self.search.hypothesis(())
        return self._helps(hypothesis, nothing, hypothesis.chosen) and not self._idle(hypothesis)

    def _reached(self, hypothesis: Hypothesis) -> bool:
        """Return whether it holds and is reached from nothing by one candidate after another, each set on the way holding:
        effects that help only together are each other's errors.
        """
        if not hypothesis.chosen:
            return True
        before = [self.search.without(hypothesis, c) for c in hypothesis.chosen]
        before += [
            self.search.hypothesis([c for c in hypothesis.chosen if c not in pair], hypothesis.model)
            for pair in friction_pairs(hypothesis.chosen)
        ]
        return self.holds(hypothesis) and any(self._reached(h) for h in before)

    def rivals(self, best: Hypothesis, cause: EffectCandidate) -> tuple[EffectCandidate, ...]:
        """Return the candidates (one per effect and joint) that in the place of `cause` help on every held-out run and on
        at least one of them leave no more than FALL more than it, best first; with one joint, torque constant and
        sensor gain are never separated, whose difference is a factor on friction and inertia.
        """
        others = [c for c in best.chosen if c is not cause]
        base = self.search.without(best, cause)
        found: dict[tuple[str, object], tuple[float, EffectCandidate]] = {}
        twins = _SCALES if self.search.joints == 1 and cause.effect.name in _SCALES else frozenset()
        for rival in self._grown(base):
            added = [c for c in rival.chosen if c not in others]
            new = added[0]
            if new.key == cause.key or len(added) > 1:
                continue
            helps = self._helps(rival, base, (new,), least=0.0)
            worse = all(fall < -FALL for fall in self._falls(rival, best, (new, cause)))
            worse = worse or self.search.reading_misfit(rival) - self.search.reading_misfit(best) > WITHIN
            if helps and not worse:
                score = self._score(rival)
                if score < found.get(new.key, (np.inf, new))[0]:
                    found[new.key] = score, new
        for c in self.search.candidates:
            if c.effect.name in twins and c.key != cause.key:
                found.setdefault(c.key, (np.inf, c))
        return tuple(c for _, c in sorted(found.values(), key=lambda pair: pair[0]))

    def unsure(
        self,
        found: Hypothesis,
        best: Hypothesis,
        classes: Sequence[Sequence[EffectCandidate]],
        causes: Sequence[Cause],
    ) -> list[tuple[str, JointName]]:
        """Return (effect, joint) of what these runs show without confirming it: causes whose interval holds the joint
        file's value, and, where much is unexplained, what was found on all runs together but is not named, largest first.
        """
        out = [
            (c.effect.name, c.joint)
            for c, cause in zip(best.chosen, causes, strict=True)
            if _holds_nothing(c, cause)
        ]
        if self.left_share(best) > ENOUGH_LEFT:
            there = {c.key for c in best.chosen} | {c.key for rivals in classes for c in rivals}
            more = [c for c in found.chosen if c.key not in there]
            out += [c.key for c in sorted(more, key=lambda c: -self.search.size_nm(found, c))]
        return list(dict.fromkeys(out))

    def doubt(self, unsure: Sequence[tuple[str, JointName]]) -> str:
        """Return a sentence about what is unsure."""
        names = ", ".join(f"{n} of {joint_text(j)}" for n, j in unsure)
        return (
            f"indicated by all {self.search.mixed.runs} runs together, but not confirmed on every held-out run: {names}; "
            f"expected {ENOUGH_RUNS} runs or more"
        )

    def left_share(self, best: Hypothesis) -> float:
        """Return which part of the squared error that effects could explain at all is left on held-out runs, 0 to 1."""
        floors = self.dataset.unexplained
        before, after = 0.0, 0.0
        pairs = zip(self.squares(self.search.hypothesis(())), self.squares(best), strict=True)
        for r, (raw, left) in enumerate(pairs):
            for channel in raw:
                mine = [floors[channel][k] for k in np.flatnonzero(self.search.mixed.pieces == r)]
                least = float(np.nanmean(np.concatenate(mine) ** 2))
                before += max(raw[channel] - least, 0.0)
                after += max(left[channel] - least, 0.0)
        return min(after / max(before, 1e-30), 1.0)

    def _children(self, parent: Hypothesis) -> list[Hypothesis]:
        """Return the plausible extensions by one candidate, each also without what it makes superfluous."""
        out = []
        for child in self._grown(parent):
            out.append(child)
            idle = self._idle(child)
            if idle and len(idle) < len(child.chosen):
                out.append(self.search.hypothesis([c for c in child.chosen if c not in idle], child.model))
        return out

    def _grown(self, parent: Hypothesis) -> list[Hypothesis]:
        """Return all plausible extensions that lower BIC; by how much is not asked, the held-out runs decide. Coulomb and
        viscous friction of a joint also come together.
        """
        totals = [self.search.mixed.marginal(v)[0] for v in (parent.model.variances, self.search.mixed.prior)]
        base = list(parent.model.columns)
        out = []
        for new in self.search.additions(parent.chosen):
            columns = [k for c in new for k in c.columns]
            drop = max(explained(total, base, columns) for total in totals)
            if drop < sum(self.search.penalty(c) for c in new):
                continue
            child = self.search.hypothesis((*parent.chosen, *new), parent.model)
            if child.bic < parent.bic and self.search.plausible(child):
                out.append(child)
        return out

    def _idle(self, hypothesis: Hypothesis) -> list[EffectCandidate]:
        """Return the candidates without which some run left out does as well."""
        chosen = hypothesis.chosen
        return [c for c in chosen if not self._helps(hypothesis, self.search.without(hypothesis, c), (c,))]

    def _helps(
        self, hypothesis: Hypothesis, without: Hypothesis, new: Sequence[EffectCandidate], least: float = FALL
    ) -> bool:
        if not new:
            return True
        fall = min(self._falls(hypothesis, without, new))
        if fall < least:
            return False
        drops = self.search.held_out_deviances(without) - self.search.held_out_deviances(hypothesis)
        return fall >= LARGE_FALL or bool(np.all(drops > 0.0))

    def _falls(self, one: Hypothesis, other: Hypothesis, where: Sequence[EffectCandidate]) -> list[float]:
        """Return per run the part of the other's squared error that `one` takes away, summed over the channels in which
        the candidates `where` act.
        """
        columns = np.array([k for c in where for k in c.columns], np.intp)
        out = []
        first = [int(np.argmax(self.search.mixed.pieces == r)) for r in range(self.search.mixed.runs)]
        for k, a, b in zip(first, self.squares(one), self.squares(other), strict=True):
            run = self.dataset.runs[k]
            there = [c for c, d in run.channels.items() if np.isin(columns, d.index).any()]
            out.append(sum(1.0 - a[c] / max(b[c], 1e-30) for c in there if c in a))
        return out

    def _score(self, hypothesis: Hypothesis) -> float:
        """Return the sum of the logarithms of the squared errors on held-out runs."""
        return sum(float(np.log(max(x, 1e-30))) for run in self.squares(hypothesis) for x in run.values())

    def squares(self, hypothesis: Hypothesis) -> list[Squares]:
        """Return per run left out the mean squared error of each channel [Nm^2] with the coefficients of the others; the
        run's own zero and friction stay in, in torsion all but its mean.
        """
        key = tuple(c.first for c in hypothesis.chosen)
        if key not in self._squares:
            self._squares[key] = self.squares_with(hypothesis, self.search.held_out_beta(hypothesis))
        return self._squares[key]

    def squares_with(self, hypothesis: Hypothesis, per_run: Sequence[FloatArray]) -> list[Squares]:
        """Return the same with these coefficients of each run left out."""
        sums: list[dict[Channel, FloatArray]] = [{} for _ in range(self.search.mixed.runs)]
        columns = list(hypothesis.model.columns)
        betas = self.search.of_pieces(per_run)
        for r, run, beta in zip(self.search.mixed.pieces, self.dataset.runs, betas, strict=True):
            weight = dict(zip(columns, (float(b) for b in beta), strict=True))
            for channel, d in run.channels.items():
                mine = np.flatnonzero(np.isin(d.index, columns))
                rest = d.residual - d.regressors[:, mine] @ np.array([weight[int(d.index[k])] for k in mine])
                rest = rest[d.valid]
                if channel.balance == "torsion" and len(rest):
                    rest = rest - rest.mean()
                if len(rest):
                    more = np.array([float(rest @ rest), float(len(rest))])
                    sums[r][channel] = sums[r].get(channel, np.zeros(2)) + more
        return [{c: float(s[0] / s[1]) for c, s in mine.items()} for mine in sums]


def _holds_nothing(candidate: EffectCandidate, cause: Cause) -> bool:
    """Return whether the intervals of all its parameters hold the values without it, or nearly (_NEARLY)."""
    nothing = candidate.term.combine([0.0] * candidate.size)
    free = {
        name: v.ci95 for name, v in cause.parameters.items() if v.ci95[1] > v.ci95[0] and name != "phase_rad"
    }
    room = {name: _NEARLY * (high - low) for name, (low, high) in free.items()}
    return all(
        low - room[name] <= nothing.get(name, 0.0) <= high + room[name] for name, (low, high) in free.items()
    )
