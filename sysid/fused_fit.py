"""The whole fit of section `fused` of a joint file: torsion, loss, standard deviations and their calibration. Pure.

Standard deviations come from runs that the fit had not seen: the runs are dealt into folds, each fold is judged by a
fit on the others, and the parameters that are written are those of all runs together.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from estimator.additive_loss import AdditiveLossModel
from estimator.friction import FloatArray
from estimator.fused_parameters import AdditiveLoss, Fused, FusedSigma, Torsion
from estimator.fusion import Fusion, held_many
from estimator.parameters import Friction
from sysid.loss_fit import LossFit, fit_loss
from sysid.run_signals import RunSignals
from sysid.sigma_fit import PathResiduals, conformal_scale, fit_sigma, quadrants_of
from sysid.torsion_fit import fit_torsion, torsion_torque

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
    """Yield (runs to fit, indices of runs to judge); whole runs only, every run judged once and never fitted then."""
    for k in range(min(count, len(runs))):
        judged = [n for n in range(len(runs)) if n % count == k]
        yield [run for n, run in enumerate(runs) if n not in judged], judged


def fit_fused(runs: Sequence[RunSignals], friction: Friction) -> FusedFit:
    """Fit section `fused` of one joint.

    runs: at least 6 (ValueError); friction: of the joint file. Raises LossFitError, TorsionError.
    """
    if len(runs) < _LEAST_RUNS:
        raise ValueError(
            f"found {len(runs)} runs, expected at least {_LEAST_RUNS}: standard deviations need unseen runs"
        )
    unseen = _unseen(runs, friction)
    sigma = fit_sigma(unseen)
    errors, sigmas = zip(*(fused_error(run, sigma) for run in unseen), strict=True)
    sigma = replace(sigma, scale=conformal_scale(errors, sigmas, [quadrants_of(run) for run in unseen]))
    fit = fit_loss(runs, friction)
    rmse = tuple(float(np.sqrt(np.mean(e * e))) for e in errors)
    return FusedFit(Fused(fit.loss, fit_torsion(runs), sigma), fit, rmse)


def _unseen(runs: Sequence[RunSignals], friction: Friction) -> list[PathResiduals]:
    """Return the residuals of every run with motion, in order, from fits on the runs of the other folds."""
    found: dict[int, PathResiduals] = {}
    for known, judged in folds(runs):
        torsion, loss = fit_torsion(known), fit_loss(known, friction).loss
        found |= {n: path_residuals(runs[n], loss, torsion) for n in judged if runs[n].moving.any()}
    return [found[n] for n in sorted(found)]


def path_residuals(run: RunSignals, loss: AdditiveLoss, torsion: Torsion) -> PathResiduals:
    """Return what both paths miss on a run's moving samples, with a loss and a torsion from elsewhere."""
    keep, seen = run.moving, run.seen
    loss_nm, wide = loss_and_width(run, loss)
    raw, sensor = seen.raw_nm[keep], run.sensor_nm[keep]
    tau, open_nm = (each[keep] for each in torsion_torque(torsion, run))
    current = raw - loss_nm[keep] - sensor
    return PathResiduals(raw, seen.velocity_rad_s[keep], wide[keep], tau, open_nm, current, tau - sensor)


def loss_and_width(run: RunSignals, loss: AdditiveLoss) -> tuple[FloatArray, FloatArray]:
    """Return loss and held half width of the friction interval [n] over a run; zero where nothing was observed."""
    seen = run.seen
    running = ~np.isnan(seen.raw_nm)
    raw, v, s = (np.where(running, x, 0.0) for x in (seen.raw_nm, seen.velocity_rad_s, seen.direction))
    value, half = AdditiveLossModel(loss).loss_many(raw, v, seen.temperature_c, s)
    return value, held_many(half, seen.dt_s, running)


def fused_error(run: PathResiduals, sigma: FusedSigma) -> tuple[FloatArray, FloatArray]:
    """Return error and standard deviation [n] of the fused physics: its weights apply to the paths' errors alike."""
    alpha, spread = Fusion(sigma, True).weigh_many(
        run.raw_nm, run.half_nm, run.velocity_rad_s, run.torsion_nm, run.open_nm
    )
    return run.current_error_nm + alpha * (run.torsion_error_nm - run.current_error_nm), spread
