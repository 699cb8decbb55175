"""Noise model and best hypothesis of a dataset, each from the other."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.sysid.diagnosis.current_zero import unpowered_columns, with_readings
from jtqd.sysid.diagnosis.dataset import Dataset
from jtqd.sysid.diagnosis.evidence import RELEVANT
from jtqd.sysid.diagnosis.mixed_model import Mixed
from jtqd.sysid.diagnosis.noise import Noise, noise_model, run_sums
from jtqd.sysid.diagnosis.regressors import RunData, column_moments
from jtqd.sysid.diagnosis.search import Hypothesis, Search
from jtqd.sysid.diagnosis.signals import Channel

_PASSES: Final = 2


def searched(dataset: Dataset) -> tuple[Noise, Search, Hypothesis]:
    """Return noise model and best hypothesis: the noise first from what nothing explains, then from what the best
    hypothesis leaves, which is more by what the many columns of the first have fitted of the noise itself.
    """
    runs, candidates = dataset.runs, dataset.candidates
    columns = candidates[-1].columns.stop if candidates else 0
    groups = dataset.families
    sigma = np.array([g.sigma for g in groups])
    moments = column_moments(runs, columns)
    unpowered = unpowered_columns(candidates, dataset.joints)
    least_nm = RELEVANT * dataset.rated_torque_nm
    residuals = dataset.unexplained
    for k in range(_PASSES):
        noise = noise_model(runs, residuals, dataset.step_s)
        sums = [run_sums(run, noise, columns, len(groups)) for run in runs]
        sums = with_readings(sums, dataset.readings, unpowered)
        mixed = Mixed(sums, columns, sigma, dataset.pieces)
        effective = mixed.rows / noise.inflation
        search = Search(
            mixed, candidates, effective, moments, least_nm, readings=dataset.readings, unpowered=unpowered
        )
        best = search.confirmed()
        if k + 1 < _PASSES:
            residuals = {c: unexplained_residual(runs, best, c) for c in residuals}
    return noise, search, best


def unexplained_residual(runs: Sequence[RunData], best: Hypothesis, channel: Channel) -> list[FloatArray]:
    """Return the residual less the chosen effects and each run's own changes [n], NaN where not valid."""
    out = []
    columns = {c: float(b) for c, b in zip(best.model.columns, best.model.beta, strict=True)}
    for run, u in zip(runs, best.model.nuisances, strict=True):
        if channel not in run.channels:
            continue
        d = run.channels[channel]
        weights = np.array([columns.get(int(k), 0.0) for k in d.index])
        rest = d.residual - d.regressors @ weights - d.nuisances @ u[d.families]
        out.append(np.where(d.valid, rest, np.nan))
    return out
