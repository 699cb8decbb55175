"""Calibration of sigma, the last step of a fit: `scale` of sections `fused.sigma` and `fused.zeros`.

    |error| <= 1.645 sqrt((scale_q spread)^2 + more^2)      in 92 % of the samples of a run left out, per quadrant q

error: of the estimate that service gives against the torque; more: what service adds by itself (`served.py`; where the
torsion is tracked, `fused.tracking`, too), so that it is not counted twice. scale_q is the conformal quantile of
sqrt(error^2 - (1.645 more)^2) over the spread.

The campaign has a sensor, not the torque. What both paths' run means share is the sensor's zero of that run, of standard
deviation `reference_nm`: a normal prior, and two normal measurements of it whose variance is what each path's means have
more. The posterior's mean is taken off a run's error, and its standard deviation is spread over the samples by quantiles
of a normal distribution (multiple imputation, Rubin 1987): a calibration against the torque, as far as the runs tell of it.
The mean of n runs' zeros is in the fitted torques and told by nothing: reference^2/n counts beside the posterior's variance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from scipy.special import ndtri

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.fusion import GAUSS
from jtqd.estimator.joint import Fused, Tracking
from jtqd.sysid.fit.conformal import COVERAGE, conformal_scale
from jtqd.sysid.fit.residuals import PathResiduals
from jtqd.sysid.fit.served import Served, served

OTHER_MOTIONS: Final = 0.02
"""What runs of the campaign are covered more than COVERAGE: motions of other kinds, and shorter ones, in which the zero of
the day is unknown for a larger part, are held in as much less. Chosen on runs that no figure is reported on."""
_QUANTILES: Final = 7
_LEAST_NM2: Final = 1e-4
"""Variance of a path's run means beside the sensor's zero: no path is free of an error of its own."""


def calibrated(runs: Sequence[PathResiduals], fused: Fused, rated_nm: float | None = None) -> Fused:
    """Return a section with both scales found on runs left out; its other parts are final.

    Without section `fused.zeros` new configurations track zeros with the scale of sigma, which is then that of tracked ones.
    """
    zeros, doubt_nm = sensor_zeros(runs, fused.sigma.reference_nm)
    plain = replace(fused, zeros=None)

    def scale(section: Fused, *, tracked: bool) -> tuple[float, float, float, float]:
        each = [served(run, section, rated_nm, tracked=tracked) for run in runs]
        return _scale(each, zeros, doubt_nm, fused.tracking)

    sigma = replace(fused.sigma, scale=scale(plain, tracked=fused.zeros is None))
    if fused.zeros is None:
        return replace(fused, sigma=sigma)
    return replace(fused, sigma=sigma, zeros=replace(fused.zeros, scale=scale(fused, tracked=True)))


def sensor_zeros(runs: Sequence[PathResiduals], reference_nm: float) -> tuple[FloatArray, float]:
    """Return the part [runs] of each run's errors that is its sensor's zero, and the standard deviation of that [Nm]."""
    if not reference_nm > 0.0:
        return np.zeros(len(runs)), 0.0
    means = np.array([(run.current_error_nm.mean(), run.torsion_error_nm.mean()) for run in runs])
    precision = 1.0 / np.maximum(means.var(axis=0) - reference_nm**2, _LEAST_NM2)
    variance = 1.0 / (1.0 / reference_nm**2 + float(precision.sum()))
    return variance * (means @ precision), float(np.sqrt(variance + reference_nm**2 / len(runs)))


def _scale(
    runs: Sequence[Served], zeros: FloatArray, doubt_nm: float, tracking: Tracking | None
) -> tuple[float, float, float, float]:
    normal = ndtri((np.arange(_QUANTILES) + 0.5) / _QUANTILES)
    normal *= doubt_nm / np.sqrt(np.mean(normal**2))
    left = []
    for run, zero in zip(runs, zeros, strict=True):
        error, more = run.error_nm, run.more_nm2
        if tracking is not None:
            error = run.now_nm
            more = more + tracking.sigma_nm**2 + (tracking.viscous_nms_per_rad * run.velocity_rad_s) ** 2
        error = error - zero + normal[np.arange(len(error)) % _QUANTILES]
        left.append(np.sqrt(np.maximum(error**2 - GAUSS**2 * more, 0.0)))
    return conformal_scale(
        left, [run.spread_nm for run in runs], [run.quadrant for run in runs], COVERAGE + OTHER_MOTIONS
    )
