"""Fit section `fused` of a joint file: torsion, loss, standard deviations and their calibration.

Standard deviations come from runs that the fit had not seen: the runs are split into folds, each fold is compared with a
fit on the others, and the parameters that are written are those of all runs together.

With residuals e_c = tau_raw - loss - sensor and e_t = tau_t - sensor on runs not seen:

    reference^2 = covariance of the two paths' run means, less its standard error: what both share is the sensor's zero
    e_c^2 - reference^2 ~ current^2 + (viscous v)^2 + (load tau_raw)^2
    e_t^2 - reference^2 - open^2 ~ torsion^2 + (load tau_t)^2
    zeros: how far the link encoder's zero differs from day to day (`sysid/fit/repeatability.py`)
    agreement: how far the two paths differ on ordinary days (`sysid/fit/repeatability.py`)
    tracking: what an estimate of now errs by beyond that (`sysid/fit/calibration.py`)
    scale_q: in quadrant q, so that the interval with all of these holds on a run left out (`sysid/fit/calibration.py`)
    standstill: how wide the interval of a standing joint is (`sysid/fit/calibration.py`)

A joint with one encoder has the current path alone (torsion None): nothing tells the sensor's zero from that path's
own error, so reference is 0 and sigma holds both.

The level of 90 % is unbiased, not the conservative one that guarantees at least 90 %. Where a whole run shares its error
(its zeros), n runs have not shown the largest yet: 8 of them cover 87 % of others.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.checked import counted
from jtqd.estimator.joint import (
    Friction,
    Fused,
)
from jtqd.sysid.fit.calibration import (
    ahead_nm,
    calibrated,
    fit_sigma,
    fit_standstill,
    standing_errors,
    tracking_of_unseen,
)
from jtqd.sysid.fit.envelope import fit_envelope
from jtqd.sysid.fit.losses import LossFit, fit_loss
from jtqd.sysid.fit.repeatability import agreement_of_held_out, fit_zeros
from jtqd.sysid.fit.residuals import PathResiduals, path_residuals, served
from jtqd.sysid.fit.signals import RunSignals
from jtqd.sysid.fit.torsion import fit_torsion

FOLDS: Final = 4
_LEAST_RUNS: Final = 6


@dataclass(frozen=True)
class FusedFit:
    """fused: the section; loss: details of its fit; unseen_rmse_nm: of the physics, one per run with motion, each run
    judged by a fit that had not seen it.
    """

    fused: Fused
    loss: LossFit
    unseen_rmse_nm: tuple[float, ...]


def folds(runs: Sequence[RunSignals], count: int = FOLDS) -> Iterator[tuple[list[RunSignals], list[int]]]:
    """Yield (runs to fit, indices of the runs left out); whole runs, each left out exactly once."""
    for k in range(min(count, len(runs))):
        judged = [n for n in range(len(runs)) if n % count == k]
        yield [run for n, run in enumerate(runs) if n not in judged], judged


def fit_fused(
    runs: Sequence[RunSignals],
    friction: Friction,
    rated_nm: float | None = None,
    *,
    with_torsion: bool = True,
) -> FusedFit:
    """Fit section `fused` of one joint.

    runs: at least 6 (ValueError); friction: of the joint file; rated_nm: its rated torque, of which the envelope's steps are
    a part, None: without an envelope; with_torsion: False for a joint with one encoder, which has no envelope either. Raises
    LossFitError, TorsionError.
    """
    if len(runs) < _LEAST_RUNS:
        raise ValueError(
            f"found {counted(len(runs), 'run')}, expected at least {_LEAST_RUNS}: standard deviations need held-out runs"
        )
    unseen, standing = _unseen(runs, friction, with_torsion=with_torsion)
    sigma = fit_sigma(unseen, with_torsion=with_torsion)
    fit = fit_loss(runs, friction)
    torsion = fit_torsion(runs) if with_torsion else None
    envelope = (
        None if rated_nm is None or torsion is None else fit_envelope(runs, fit.loss, torsion, rated_nm)
    )
    fused = Fused(fit.loss, torsion, sigma, envelope=envelope)
    rmse = tuple(float(np.sqrt(np.mean(served(run, fused).error_nm ** 2))) for run in unseen)
    if torsion is not None:
        at_rest = [standing_errors(*run, fused) for run in standing]
        fused = replace(
            fused,
            tracking=tracking_of_unseen(unseen, fused),
            standstill=fit_standstill(at_rest, sigma.reference_nm),
        )
        if fused.tracking is not None:
            unseen = [run.tracked() for run in unseen]
    if rated_nm is not None and torsion is not None:
        fused = replace(fused, zeros=fit_zeros(unseen, fused, rated_nm))
        fused = replace(fused, agreement=agreement_of_held_out(unseen, fused, rated_nm))
    fused = calibrated(unseen, fused, rated_nm)
    return FusedFit(fused, fit, rmse)


def _unseen(
    runs: Sequence[RunSignals], friction: Friction, *, with_torsion: bool
) -> tuple[list[PathResiduals], list[tuple[PathResiduals, FloatArray]]]:
    """Return the residuals of every run with motion, in order, from fits on the runs of the other folds: moving; at rest.

    At rest only with torsion, each with what `ahead_nm` says of its samples.
    """
    moving: dict[int, PathResiduals] = {}
    standing: dict[int, tuple[PathResiduals, FloatArray]] = {}
    for known, judged in folds(runs):
        torsion = fit_torsion(known) if with_torsion else None
        loss = fit_loss(known, friction).loss
        for n in judged:
            run = runs[n]
            if not run.moving.any():
                continue
            moving[n] = path_residuals(run, loss, torsion)
            if torsion is not None:
                ahead = ahead_nm(run, torsion)[run.standing]
                standing[n] = (path_residuals(run, loss, torsion, run.standing), ahead)
    return [moving[n] for n in sorted(moving)], [standing[n] for n in sorted(standing)]
