"""Linear mixed model over runs: effects are common to all runs, nuisances (offset, viscous friction, ...) differ.

    y_r = X_r beta + Z_r u_r + e,   u_r ~ N(0, V),   e ~ N(0, 1) after whitening

V is diagonal, one variance per family, found by expectation-maximisation with a prior that is worth four runs (two runs
alone could claim that nothing ever drifts, or that everything does). With it, what looks like an effect but is only one
more of the changes that the runs show anyway is not evidence. Everything is done on normal equations: no pass over
samples.
Source: Laird and Ware 1982, Biometrics 38 (random effects, EM).
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.sysid.diagnosis.noise import Sums

ENOUGH_RUNS: Final = 4
"""From here on the runs show how much they usually differ, and the sum over held-out runs decides."""
_EM_STEPS: Final = 12
_PRIOR_RUNS: Final = 4.0
_RIDGE: Final = 1e-10
_MARGINALS_KEPT: Final = 4


@dataclass(frozen=True)
class Model:
    """Result of one model: columns chosen, coefficients, their covariance, variances of the families, criterion
    -2 log likelihood (constant left out), nuisances of each piece of a run [r, q].
    """

    columns: tuple[int, ...]
    beta: FloatArray
    covariance: FloatArray
    variances: FloatArray
    deviance: float
    squares: float  # part of the deviance that is the whitened sum of squares; the rest is the price of the variances
    nuisances: FloatArray


class Mixed:
    """Normal equations of all runs; columns P, nuisance families Q. Pieces of one recording are one run: they have one zero
    and one friction of the day, and are left out together.
    """

    def __init__(
        self, sums: Sequence[Sums], columns: int, prior_sigma: FloatArray, pieces: Sequence[int] | None = None
    ) -> None:
        """Sum up: pieces: number of the run of each of the sums, where several are of one run."""
        self.columns = columns
        self.prior = prior_sigma**2
        self.pieces = np.arange(len(sums)) if pieces is None else np.array(pieces, np.intp)
        grams = np.array([s.gram for s in sums])
        self.grams = np.zeros((int(self.pieces.max()) + 1, *grams.shape[1:]))
        np.add.at(self.grams, self.pieces, grams)
        self.rows = sum(s.rows for s in sums)
        self._p = slice(0, columns)
        self._q = slice(columns, columns + len(prior_sigma))
        self._fixed_index = np.concatenate((np.arange(columns), [self.grams.shape[1] - 1])).astype(np.intp)
        self._marginals: dict[bytes, tuple[FloatArray, float]] = {}

    @property
    def runs(self) -> int:
        """Number of runs."""
        return len(self.grams)

    def subset(self, runs: Sequence[int]) -> Mixed:
        """Return the same with these runs only; its pieces are those of these runs."""
        out = copy(self)
        out.grams, out._marginals = self.grams[list(runs)], {}
        place = {run: k for k, run in enumerate(runs)}
        out.pieces = np.array([place[int(p)] for p in self.pieces if int(p) in place], np.intp)
        out.rows = self.rows * len(runs) // max(len(self.grams), 1)
        return out

    def less(self, grams: FloatArray) -> Mixed:
        """Return the same without a part of each of the sums that it was made of [s, P+Q+1, P+Q+1]."""
        out = copy(self)
        out.grams, out._marginals = self.grams.copy(), {}
        np.subtract.at(out.grams, self.pieces, grams)
        return out

    def _inverse(self, variances: FloatArray) -> FloatArray:
        """(Z'Z + V^-1)^-1 per run [r, q, q]."""
        inner = self.grams[:, self._q, self._q] + np.diag(1.0 / variances)
        return np.asarray(np.linalg.inv(inner))

    def marginal_runs(self, variances: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return per run [r, P+1, P+1] the normal equations with nuisances integrated out, and log determinants [r]."""
        index = self._fixed_index
        cross = self.grams[:, index, self._q]
        inverse = self._inverse(variances)
        marginal = self.grams[:, index[:, None], index[None, :]] - cross @ inverse @ cross.transpose(0, 2, 1)
        log = -np.linalg.slogdet(inverse)[1] + float(np.sum(np.log(variances)))
        return marginal, log

    def marginal(self, variances: FloatArray) -> tuple[FloatArray, float]:
        """Return the sum over runs [P+1, P+1] and the sum of the log determinants; the last few are kept, change none."""
        key = variances.tobytes()
        if key not in self._marginals:
            for old in [*self._marginals][: 1 - _MARGINALS_KEPT]:
                del self._marginals[old]
            self._marginals[key] = self._marginal(variances)
        self._marginals[key] = self._marginals.pop(key)  # the last one used is the last to go
        return self._marginals[key]

    def _marginal(self, variances: FloatArray) -> tuple[FloatArray, float]:
        """Return `marginal`, computed."""
        index = self._fixed_index
        inverse = self._inverse(variances)
        total = self.grams.sum(axis=0)[index[:, None], index[None, :]]
        for gram, inner in zip(self.grams, inverse, strict=True):
            cross = gram[index, self._q]
            total = total - cross @ inner @ cross.T
        log = float(np.sum(-np.linalg.slogdet(inverse)[1]) + len(self.grams) * np.sum(np.log(variances)))
        return total, log

    def fit(self, columns: Sequence[int], start: FloatArray | None = None, steps: int = _EM_STEPS) -> Model:
        """Fit the effects' columns and the families' variances."""
        chosen = list(columns)
        variances = self.prior.copy() if start is None else start.copy()
        k, q = len(chosen), self._q
        last = self.grams.shape[1] - 1
        small = np.array([*chosen, *range(q.start, q.stop), last], np.intp)
        grams = self.grams[:, small[:, None], small[None, :]]
        fixed = [*range(k), grams.shape[1] - 1]
        nuisance = slice(k, k + len(self.prior))
        cross, inner, outer = (
            grams[:, fixed, nuisance],
            grams[:, nuisance, nuisance],
            grams[:, fixed][:, :, fixed],
        )
        transposed = cross.transpose(0, 2, 1)
        beta = np.zeros(k)
        for step in range(steps + 1):
            inverse = np.linalg.inv(inner + np.diag(1.0 / variances))
            lifted = cross @ inverse  # [r, k+1, q]
            total = (outer - lifted @ transposed).sum(axis=0)
            beta, covariance = solve(total, k)
            contrast = np.append(-beta, 1.0)
            u = np.einsum("rkq,k->rq", lifted, contrast)
            if step == steps:
                break
            spread = u**2 + np.einsum("rqq->rq", inverse)
            variances = (spread.sum(axis=0) + _PRIOR_RUNS * self.prior) / (self.runs + _PRIOR_RUNS)
        log = float(np.sum(-np.linalg.slogdet(inverse)[1]) + self.runs * np.sum(np.log(variances)))
        # the prior run is part of the criterion, else variances could be bought for nothing
        log += _PRIOR_RUNS * float(np.sum(np.log(variances) + self.prior / variances))
        squares = float(contrast @ total @ contrast)
        return Model(tuple(chosen), beta, covariance, variances, squares + log, squares, u[self.pieces])


def solve(total: FloatArray, k: int) -> tuple[FloatArray, FloatArray]:
    """Return least squares of the first k columns for the last, and its covariance."""
    covariance = _inverses(total[None, :k, :k])[0]
    return covariance @ total[:k, k], covariance


def _inverses(grams: FloatArray) -> FloatArray:
    """Return the inverse of each of these normal equations [m, k, k], with a little of their diagonals added."""
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(grams, axis1=1, axis2=2), 1e-30))
    scaled = grams * scale[:, :, None] * scale[:, None, :] + _RIDGE * np.eye(grams.shape[1])
    inverses: FloatArray = np.linalg.inv(scaled) * scale[:, :, None] * scale[:, None, :]
    return inverses


def explained(total: FloatArray, chosen: Sequence[int], extra: Sequence[int]) -> float:
    """Return by how much the columns `extra` lower the sum of squares beyond `chosen` (last row: residual)."""
    return explained_each(total, chosen, [extra])[0]


def explained_each(total: FloatArray, chosen: Sequence[int], extras: Sequence[Sequence[int]]) -> list[float]:
    """Return `explained` of each of `extras`; those of one length are solved together, which is several times faster."""
    [before] = _lowered(total, [list(chosen)])
    after = [0.0] * len(extras)
    for length in {len(extra) for extra in extras}:
        mine = [n for n, extra in enumerate(extras) if len(extra) == length]
        for n, square in zip(mine, _lowered(total, [[*chosen, *extras[n]] for n in mine]), strict=True):
            after[n] = square
    return [square - before for square in after]


def _lowered(total: FloatArray, sets: Sequence[Sequence[int]]) -> list[float]:
    """Return by how much each of these sets of columns, all of one length, lowers the sum of squares."""
    places = np.array(sets, np.intp)
    rights = total[places, -1]
    covariances = _inverses(total[places[:, :, None], places[:, None, :]])
    return [float((c @ right) @ right) for c, right in zip(covariances, rights, strict=True)]
