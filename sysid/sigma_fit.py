"""Standard deviations of the fused estimator's paths and their calibration, from residuals on unseen runs. Pure.

e_c = tau_raw - loss - sensor,  e_t = tau_t - sensor         (each from a fit that had not seen the run)
reference^2 = covariance of the two paths' run means: what both share is the sensor's zero
e_c^2 - reference^2 ~ current^2 + (viscous v)^2 + (load tau_raw)^2,  e_t^2 - reference^2 ~ torsion^2 + (load tau_t)^2
scale_q = 90 % quantile of |error|/sigma in quadrant q, over 1.645: split conformal prediction by runs
          (Vovk et al. 2005; Lei et al. 2018), every run weighted alike
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from scipy.optimize import nnls

from estimator.friction import FloatArray
from estimator.fused_parameters import FusedSigma
from estimator.fused_run import quadrant_many

COVERAGE: Final = 0.9
GAUSS: Final = 1.6448536269514722
"""Half width of a normal distribution's 90 % interval in standard deviations: the interval is value +- GAUSS sigma."""
_FLOOR_NM: Final = 0.02


class PathResiduals(NamedTuple):
    """One unseen run: arrays [n] of its moving samples (Nm, rad/s); half: `AdditiveLossModel.loss`."""

    raw_nm: FloatArray
    velocity_rad_s: FloatArray
    half_nm: FloatArray
    torsion_nm: FloatArray
    current_error_nm: FloatArray
    torsion_error_nm: FloatArray


def fit_sigma(runs: Sequence[PathResiduals]) -> FusedSigma:
    """Return the standard deviations of both paths, scale 1; needs at least three runs (ValueError)."""
    if len(runs) < 3:
        raise ValueError(f"found {len(runs)} unseen runs, expected at least 3")
    current = np.array([run.current_error_nm.mean() for run in runs])
    torsion = np.array([run.torsion_error_nm.mean() for run in runs])
    shared = max(float(np.mean((current - current.mean()) * (torsion - torsion.mean()))), _FLOOR_NM**2)
    fast = [np.abs(run.velocity_rad_s) > 0.1 for run in runs]
    raw, v, e_c, e_t, t = (
        np.concatenate([getattr(run, name)[keep] for run, keep in zip(runs, fast, strict=True)])
        for name in ("raw_nm", "velocity_rad_s", "current_error_nm", "torsion_error_nm", "torsion_nm")
    )
    ones = np.ones_like(v)
    a = nnls(np.column_stack((ones, v * v, raw * raw)), e_c * e_c - shared)[0]
    b = nnls(np.column_stack((ones, t * t)), e_t * e_t - shared)[0]
    return FusedSigma(
        current_nm=max(float(np.sqrt(a[0])), _FLOOR_NM),
        viscous_nms_per_rad=float(np.sqrt(a[1])),
        load=float(np.sqrt(a[2])),
        torsion_nm=max(float(np.sqrt(b[0])), _FLOOR_NM),
        torsion_load=float(np.sqrt(b[1])),
        reference_nm=float(np.sqrt(shared)),
    )


def conformal_scale(
    errors: Sequence[FloatArray], sigmas: Sequence[FloatArray], quadrants: Sequence[np.ndarray]
) -> tuple[float, float, float, float]:
    """Return the factor per quadrant that makes value +- GAUSS sigma cover COVERAGE of unseen samples.

    One array per run each; a quadrant without samples takes the factor of all. Runs count alike in a quadrant.
    """
    ratios = [np.abs(e) / s for e, s in zip(errors, sigmas, strict=True)]
    every = _weighted_quantile(ratios)
    scales = []
    for q in range(4):
        inside = [ratio[quadrant == q] for ratio, quadrant in zip(ratios, quadrants, strict=True)]
        inside = [part for part in inside if len(part) >= 50]
        scales.append((_weighted_quantile(inside) if inside else every) / GAUSS)
    a, b, c, d = (max(scale, 0.05) for scale in scales)
    return a, b, c, d


def _weighted_quantile(parts: Sequence[FloatArray]) -> float:
    values = np.concatenate(parts)
    weights = np.concatenate([np.full(len(part), 1.0) for part in parts])
    order = np.argsort(values)
    share = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(share, COVERAGE * share[-1])])


def quadrants_of(run: PathResiduals) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    """Return each sample's quadrant."""
    return quadrant_many(run.raw_nm, run.velocity_rad_s)
