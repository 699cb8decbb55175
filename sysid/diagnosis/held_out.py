"""The extended model that predicts, and its gain on held-out runs.

Evidence distinguishes sets; what predicts is another estimate, without discrepancy: a mixture of the set and of the set with
all values of the file, each under its priors (`stacked`). Errors are in Nm. The response of each balance has weight one, so
an error is that of the current that the simulation needs (as torque, G Kt i) and of the twist.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.effects.effect import TORSION
from jtqd.sysid.diagnosis.evidence import Set, Sets
from jtqd.sysid.diagnosis.findings import Gain, RunGain
from jtqd.sysid.diagnosis.model import Solution
from jtqd.sysid.diagnosis.regressors import Index, RunData
from jtqd.sysid.diagnosis.signals import Channel

_BOOTSTRAPS: Final = 2000
_NONE: Final = 1e-12


@dataclass(frozen=True)
class Prediction:
    """The set that predicts: entries, their scaled coefficients, and per channel and recording the sums of squares before
    and after [Nm^2], each recording with the coefficients of all others, and the count of bins [r, 3].
    """

    chosen: Set
    mean: FloatArray
    squares: dict[Channel, FloatArray]


def predict(solution: Solution) -> Prediction:
    """Return what predicts: between the set and the set with all values of the file what held-out runs want, without entries
    whose size differs from run to run by more than itself: without these the error is less.
    """
    grams, counts = _grams(solution)
    without = fits_without(solution)
    chosen = solution.chosen
    while chosen:
        sizes = Sizes(without, chosen)
        places = without[-1].places(chosen)
        differs = {k: sizes.over_runs(np.arange(s.start, s.stop))[0] for k, s in places.items()}
        worst = max(differs, key=differs.__getitem__)
        if not 1.0 < differs[worst] < math.inf:
            break
        chosen -= {worst}
    slots = {solution.entries[k].slot for k in chosen}
    values = {k for k, e in enumerate(solution.entries) if e.prior.file and e.slot not in slots}
    wide = chosen | values - solution.equations.noisy
    part = stacked(grams, without, chosen, wide) if len(grams) > 1 else 0.0
    mixed = [_coefficients(sets, chosen) + part * _added(sets, chosen, wide) for sets in without]
    each = _held_out(grams, mixed[:-1])
    squares = {
        c: np.array([(run[c][-1, -1], each[r][c], counts[r][c]) for r, run in enumerate(grams) if c in run])
        for c in grams[0]
    }
    named = wide if part > 0.0 else chosen
    return Prediction(named, mixed[-1][without[-1].columns(named)], squares)


def stacked(
    grams: Sequence[dict[Channel, FloatArray]], without: Sequence[Sets], chosen: Set, wide: Set
) -> float:
    """Return the part of the wide set, 0 to 1, at which the mixture of two sets errs least on held-out runs (stacking:
    Wolpert 1992, Neural Networks 5; Yao et al. 2018, Bayesian Analysis 13).
    """
    slope = curvature = 0.0
    for run, sets in zip(grams, without[:-1], strict=True):
        few, step = _coefficients(sets, chosen), _added(sets, chosen, wide)
        for gram in run.values():
            slope += float(step @ (gram[:-1, -1] - gram[:-1, :-1] @ few))
            curvature += float(step @ gram[:-1, :-1] @ step)
    return min(max(slope / curvature, 0.0), 1.0) if curvature > 0.0 else 0.0


def _coefficients(sets: Sets, chosen: Set) -> FloatArray:
    """Return the coefficients of all entries with this set [E]."""
    out = np.zeros(len(sets.gram) - 1)
    out[sets.columns(chosen)] = sets.fit(chosen).mean
    return out


def _added(sets: Sets, chosen: Set, wide: Set) -> FloatArray:
    """Return what a wide set adds to a set whose entries keep their sizes [E]: those are where simulations settled."""
    left = np.eye(len(sets.gram))
    left[:-1, -1] = -_coefficients(sets, chosen)
    return _coefficients(Sets(sets.entries, left.T @ sets.gram @ left), wide - chosen)


def fits_without(solution: Solution) -> list[Sets]:
    """Return the sets without each recording in turn, and with all (of one recording: with it); without discrepancy."""
    plain = {
        g: v if isinstance(g, tuple) and g[0] == "family" else _NONE for g, v in solution.variances.items()
    }
    *without, everything = solution.equations.marginal(plain)
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
    counts = [dict.fromkeys(channels, 0) for _ in grams]
    noisy = {run.name: run for run in solution.disturbed}
    for r, run in enumerate(solution.runs):
        for c in channels:
            x = _rows(run, c, weights)
            counts[pieces[r]][c] += len(x)
            grams[pieces[r]][c] += x.T @ x
            if run.name in noisy:
                noise = _rows(noisy[run.name], c, weights, run) - x
                extra = noise.T @ noise
                extra[-1, -1] = 0.0
                grams[pieces[r]][c] -= extra
    return grams, counts


def _rows(run: RunData, channel: Channel, weights: FloatArray, valid_of: RunData | None = None) -> FloatArray:
    d = run.channels[channel]
    valid = (valid_of or run).channels[channel].valid
    x = np.column_stack(((d.regressors @ weights[d.index])[valid], d.residual[valid]))
    return np.asarray(x - x.mean(axis=0) if channel.balance == TORSION and len(x) else x)


def _held_out(
    grams: Sequence[dict[Channel, FloatArray]], without: Sequence[FloatArray]
) -> list[dict[Channel, float]]:
    """Return per recording the squares with the coefficients [E] of all others."""
    out = []
    for run, mean in zip(grams, without, strict=True):
        contrast = np.append(-mean, 1.0)
        out.append({c: max(float(contrast @ g @ contrast), 0.0) for c, g in run.items()})
    return out


def gain_of(solution: Solution, prediction: Prediction, seed: int = 0) -> Gain:
    """Return the error of the simulation's torque before and after, in the balance where most goes away.

    The run's own zero and friction of the day stay in, as in service. ci95: of rmse_before - rmse_after [Nm], bootstrap over
    recordings.
    """
    squares = prediction.squares
    channel = max(squares, key=lambda c: _rms(squares[c], 0) - _rms(squares[c], 1))
    table = squares[channel]
    rng = np.random.default_rng(seed)
    picks = rng.integers(0, len(table), size=(_BOOTSTRAPS, len(table)))
    sums = table[picks].sum(axis=1)
    drawn = np.sqrt(sums[:, 0] / sums[:, 2]) - np.sqrt(sums[:, 1] / sums[:, 2])
    low, high = np.percentile(drawn, (2.5, 97.5))
    pieces = list(solution.dataset.recordings)
    names = [solution.dataset.runs[pieces.index(r)].name for r in range(len(table))]
    return Gain(
        _rms(table, 0),
        _rms(table, 1),
        f"each of {len(table)} runs held out once; {channel.balance} balance of joint {channel.joint}",
        (float(low), float(high)),
        joint=channel.joint,
        balance=channel.balance,
        runs=tuple(
            RunGain(name, _rms(row, 0), _rms(row, 1))
            for name, row in zip(names, table[:, None, :], strict=True)
            if row[0, 2] > 0.0
        ),
    )


def _rms(table: FloatArray, column: int) -> float:
    return float(np.sqrt(table[:, column].sum() / max(table[:, 2].sum(), 1.0)))
