"""Calibration of sigma, the last step of a fit: `scale` of `fused.sigma` and `fused.zeros`, and `early` of the latter.

    |error| <= 1.645 sqrt((scale_q spread)^2 + more^2)      in 90 % of the samples of a run left out, per quadrant q

error: of the estimate that service gives against the torque; more: what service adds by itself (`served.py`; where the
torsion is tracked, `fused.tracking`, too), so that it is not counted twice. scale_q is the conformal quantile of
sqrt(error^2 - (1.645 more)^2) over the spread.

Before the zero of the day is known the error is wider than what is taken off s_t^2 says. The ratio r of the conformal
quantiles of the samples that know less than half of it and of the others, k and k' the means of what they know, is that of
the factors of the spread (`zeros.pyx`):

    (1 + (early - 1) (1 - k))/(1 + (early - 1) (1 - k')) = r

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
from jtqd.sysid.fit.conformal import COVERAGE, FEWEST, conformal_scale, quantile_by_runs
from jtqd.sysid.fit.residuals import PathResiduals
from jtqd.sysid.fit.served import Served, served
from jtqd.sysid.fit.tracking import by_speed

OTHER_MOTIONS: Final = 0.02
OTHER_MOTIONS_LEARNED: Final = 0.01
"""What runs of the campaign are covered more than COVERAGE where zeros differ from day to day, not tracked and tracked: of
days of other motions as much less is held. Chosen on runs that no figure is reported on."""
HALF_KNOWN: Final = 0.5
LATEST: Final = 2.0
"""Largest `early` that is believed."""
_FEWEST_RUNS: Final = 8
"""That have samples of either kind, for `early`."""
_QUANTILES: Final = 7
_LEAST_NM2: Final = 1e-4
"""Variance of a path's run means beside the sensor's zero: no path is free of an error of its own."""


def calibrated(runs: Sequence[PathResiduals], fused: Fused, rated_nm: float | None = None) -> Fused:
    """Return a section with both scales and `early` found on runs left out; its other parts are final.

    Without section `fused.zeros` new configurations track zeros with the scale of sigma, which is then that of tracked ones.
    """
    zeros, doubt_nm = sensor_zeros(runs, fused.sigma.reference_nm)
    plain = replace(fused, zeros=None)

    def seen(section: Fused, *, tracked: bool) -> list[Served]:
        return [served(run, section, rated_nm, tracked=tracked) for run in runs]

    def beyond(each: Sequence[Served]) -> list[FloatArray]:
        return _beyond(each, zeros, doubt_nm, fused.tracking)

    each = seen(plain, tracked=fused.zeros is None)
    coverage = COVERAGE if fused.zeros is None else COVERAGE + OTHER_MOTIONS
    sigma = replace(fused.sigma, scale=_scale(beyond(each), each, coverage))
    if fused.zeros is None:
        return replace(fused, sigma=sigma)
    days = replace(fused.zeros, early=1.0)
    each = seen(replace(fused, zeros=days), tracked=True)
    days = replace(days, early=early(beyond(each), each, days.spread_nm))
    each = seen(replace(fused, zeros=days), tracked=True)
    scale = _scale(beyond(each), each, COVERAGE + OTHER_MOTIONS_LEARNED)
    return replace(fused, sigma=sigma, zeros=replace(days, scale=scale))


def early(beyond: Sequence[FloatArray], runs: Sequence[Served], spread_nm: float) -> float:
    """Return the factor of the spread where nothing is known of the day's zero; runs: with a factor of 1.

    beyond: what of each run's errors is to be covered by the spread [Nm]. 1 where too few runs tell.
    """
    known = [run.known_nm2 / spread_nm**2 for run in runs]
    kinds = ([k < HALF_KNOWN for k in known], [k >= HALF_KNOWN for k in known])
    quantiles, shares = [], []
    for kind in kinds:
        kept = [n for n, keep in enumerate(kind) if np.count_nonzero(keep) >= FEWEST]
        if len(kept) < _FEWEST_RUNS:
            return 1.0
        quantiles.append(quantile_by_runs([(beyond[n] / runs[n].spread_nm)[kind[n]] for n in kept]))
        shares.append(float(np.mean([known[n][kind[n]].mean() for n in kept])))
    if not quantiles[0] > quantiles[1]:
        return 1.0
    more = quantiles[0] - quantiles[1]
    less = (1.0 - shares[0]) * quantiles[1] - (1.0 - shares[1]) * quantiles[0]
    return 1.0 + more / less if more < (LATEST - 1.0) * less else LATEST


def sensor_zeros(runs: Sequence[PathResiduals], reference_nm: float) -> tuple[FloatArray, float]:
    """Return the part [runs] of each run's errors that is its sensor's zero, and the standard deviation of that [Nm]."""
    if not reference_nm > 0.0:
        return np.zeros(len(runs)), 0.0
    means = np.array([(run.current_error_nm.mean(), run.torsion_error_nm.mean()) for run in runs])
    precision = 1.0 / np.maximum(means.var(axis=0) - reference_nm**2, _LEAST_NM2)
    variance = 1.0 / (1.0 / reference_nm**2 + float(precision.sum()))
    return variance * (means @ precision), float(np.sqrt(variance + reference_nm**2 / len(runs)))


def _beyond(
    runs: Sequence[Served], zeros: FloatArray, doubt_nm: float, tracking: Tracking | None
) -> list[FloatArray]:
    """Return what of the errors of runs, against the torque, is to be covered by the spread [Nm]."""
    normal = ndtri((np.arange(_QUANTILES) + 0.5) / _QUANTILES)
    normal *= doubt_nm / np.sqrt(np.mean(normal**2))
    left = []
    for run, zero in zip(runs, zeros, strict=True):
        error, more = run.error_nm, run.more_nm2
        if tracking is not None:
            error = run.now_nm
            more = more + tracking.sigma_nm**2
            more += tracking.viscous_nms_per_rad**2 * by_speed(run.velocity_rad_s, tracking.bend)
        error = error - zero + normal[np.arange(len(error)) % _QUANTILES]
        left.append(np.sqrt(np.maximum(error**2 - GAUSS**2 * more, 0.0)))
    return left


def _scale(
    beyond: Sequence[FloatArray], runs: Sequence[Served], coverage: float
) -> tuple[float, float, float, float]:
    return conformal_scale(beyond, [run.spread_nm for run in runs], [run.quadrant for run in runs], coverage)
