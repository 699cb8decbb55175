"""The whole fit of section `fused` of a joint file: torsion, loss, standard deviations and their calibration. Pure.

Standard deviations come from runs that the fit had not seen: the runs are dealt into folds, each fold is judged by a
fit on the others, and the parameters that are written are those of all runs together.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimator.additive_loss import AdditiveLossModel
from estimator.friction import FloatArray
from estimator.fused_parameters import AdditiveLoss, Fused, FusedSigma, Torsion
from estimator.fusion import Fusion
from estimator.parameters import Friction
from sysid.loss_fit import LossFit, fit_loss
from sysid.run_signals import RunSignals
from sysid.sigma_fit import PathResiduals, conformal_scale, fit_sigma, quadrants_of
from sysid.torsion_fit import fit_torsion, torsion_torque

FOLDS = 4


@dataclass(frozen=True)
class FusedFit:
    """fused: the section; loss: details of its fit; unseen_rmse_nm: of the physics on runs it had not seen, per run."""

    fused: Fused
    loss: LossFit
    unseen_rmse_nm: tuple[float, ...]


def folds(runs: Sequence[RunSignals], count: int = FOLDS) -> Iterator[tuple[list[RunSignals], list[int]]]:
    """Yield (runs to fit, indices of runs to judge); whole runs only, every run judged once."""
    for k in range(min(count, len(runs))):
        judged = [n for n in range(len(runs)) if n % count == k]
        yield [run for n, run in enumerate(runs) if n not in judged], judged


def fit_fused(runs: Sequence[RunSignals], friction: Friction) -> FusedFit:
    """Fit section `fused` of one joint.

    runs: at least 6 (ValueError); friction: of the joint file. Raises LossFitError, TorsionError.
    """
    if len(runs) < 6:
        raise ValueError(f"found {len(runs)} runs, expected at least 6: standard deviations need unseen runs")
    residuals: list[PathResiduals | None] = [None] * len(runs)
    for known, judged in folds(runs):
        torsion, loss = fit_torsion(known), fit_loss(known, friction).loss
        for n in judged:
            residuals[n] = path_residuals(runs[n], loss, torsion)
    unseen = [each for each in residuals if each is not None and len(each.raw_nm) > 0]
    sigma = fit_sigma(unseen)
    errors, sigmas = zip(*(_fused_error(run, sigma) for run in unseen), strict=True)
    sigma = replace(sigma, scale=conformal_scale(errors, sigmas, [quadrants_of(run) for run in unseen]))
    fit = fit_loss(runs, friction)
    rmse = tuple(float(np.sqrt(np.mean(e * e))) for e in errors)
    return FusedFit(Fused(fit.loss, fit_torsion(runs), sigma), fit, rmse)


def path_residuals(run: RunSignals, loss: AdditiveLoss, torsion: Torsion) -> PathResiduals:
    """Return what both paths miss on a run's moving samples."""
    keep = run.moving
    raw, v, sensor = run.seen.raw_nm[keep], run.seen.velocity_rad_s[keep], run.sensor_nm[keep]
    value, half = AdditiveLossModel(loss).loss_many(raw, v, run.seen.temperature_c[keep])
    tau = torsion_torque(torsion, run)[keep]
    return PathResiduals(raw, v, half, tau, raw - value - sensor, tau - sensor)


def _fused_error(run: PathResiduals, sigma: FusedSigma) -> tuple[FloatArray, FloatArray]:
    """Return error and standard deviation [n] of the fused physics; the sensor cancels out of the difference."""
    zero = np.zeros_like(run.raw_nm)
    sensor = run.torsion_nm - run.torsion_error_nm
    loss = run.raw_nm - sensor - run.current_error_nm
    value, spread = Fusion(sigma, True).fuse_many(
        run.raw_nm, loss, run.half_nm, run.velocity_rad_s, run.torsion_nm
    )
    return value - sensor + zero, spread
