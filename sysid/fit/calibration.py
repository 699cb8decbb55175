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

Quantiles of errors over runs that a fit had not seen: what a new run's samples are covered with.

Split conformal prediction by runs (Vovk et al. 2005): runs are what is exchangeable, not samples. Every run is weighted
alike.

Fit section `fused.standstill` of a joint file: how wide the interval of a standing joint is.

    half = k sd + alpha open + (1 - alpha) half_f           (fusion.pyx)

open, half_f: what slip and friction leave open are bounds, not deviations, and count in full. sd: of both paths besides.
k: so that the interval holds on a day that the fit has not seen. All standing samples of a run share its zeros and its
pre-load: n runs are n errors, not as many as samples. With e = [|error| - bounds]+/sd on runs left out, where the slip is
known (how a joint stood before it was switched on no campaign tells: there its bound counts),

    k^2 = max(b_n RMS(e), q)^2 - z^2 mean(reference^2/sd^2)

b_n: of n normal errors, so that COVERAGE_AT_REST of other days is held on average over campaigns (Student's t_n), and
COVERAGE of them after 19 of 20 campaigns (tolerance interval, 1.645 sqrt(n/chi^2), chi^2 the 5 % quantile of n degrees of
freedom): 3.15 for 6 runs, 2.55 for 11, 2.08 for 32, 1.96 for many. q: quantile of e for COVERAGE_AT_REST of a run left out
(`conformal.py`), where days are not normal. z: 1.96. The error is against the sensor: its zero is in e and taken off again,
but what few runs add is of both, so that it cannot hide an error at rest. Every run is weighted alike; k is at least 1.
Fewer than FEWEST_RUNS runs with a stop tell nothing: no section, and the estimator takes 3
standard deviations. The torsion is that of the low pass of TORSION_BANDWIDTH_RAD_S: a tracked one is no noisier at rest.

Fit section `fused.tracking` of a joint file: what an estimate of now errs by beyond one as old as the motor path.

    sigma now^2 = sigma^2 + a^2 + (b v)^2/(1 + (v/s)^2)

sigma: of an estimate as old as the motor path, whose error is e; a, b, s: least squares of e_now^2 - e^2 over runs that the
fit had not seen. Of a wave over the motor's turn that the filter does not carry it misses all from some speed on, and no
more: a part that grows without end is too wide at rest and too narrow at the speeds of work. The sensor is taken as it is:
what it is older than the encoders is in a and b. That the interval of both together holds is up to the scale of sigma, found
after (`sysid/fit/calibration.py`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from scipy.optimize import nnls
from scipy.special import chdtri, ndtri, stdtrit

from jtqd.estimator.arrays import BoolArray, FloatArray, QuadrantArray
from jtqd.estimator.joint import (
    Fused,
    FusedSigma,
    Standstill,
    Torsion,
    Tracking,
)
from jtqd.estimator.observer import low_pass
from jtqd.estimator.settings import TORSION_BANDWIDTH_RAD_S
from jtqd.estimator.uncertainty import GAUSS, Fusion
from jtqd.sysid.fit.residuals import TRACKING_RAD_S, WAVE_RAD_S, PathResiduals, Served, served
from jtqd.sysid.fit.signals import RunSignals

COVERAGE: Final = 0.9
FEWEST: Final = 50
"""Samples of a run that a part of it needs for the run to count there."""
_LEAST_SCALE: Final = 0.05
_BEYOND: Final = 0.3
"""Part of what is left out that a level may leave out at least: the largest of few says nothing."""
_STEPS: Final = 200
"""Points of a run's distribution that the level is sought with: 0.25 % of a run between two of them at most."""


def conformal_scale(
    errors: Sequence[FloatArray],
    sigmas: Sequence[FloatArray],
    quadrants: Sequence[QuadrantArray],
    coverage: float = COVERAGE,
) -> tuple[float, float, float, float]:
    """Return the factor per quadrant that makes value +- GAUSS sigma cover this share of unseen samples.

    One array per run each. Runs count alike in a quadrant, whatever their length; a quadrant in which no run has 50
    samples takes the factor of all. Raises ValueError where there are no samples at all.
    """
    ratios = [np.abs(e) / s for e, s in zip(errors, sigmas, strict=True)]
    if not any(map(len, ratios)):
        raise ValueError("found no samples to calibrate sigma with, expected some")
    every = quantile_by_runs(ratios, coverage)
    scales = []
    for q in range(4):
        inside = [ratio[quadrant == q] for ratio, quadrant in zip(ratios, quadrants, strict=True)]
        inside = [part for part in inside if len(part) >= FEWEST]
        scales.append((quantile_by_runs(inside, coverage) if inside else every) / GAUSS)
    a, b, c, d = (max(scale, _LEAST_SCALE) for scale in scales)
    return a, b, c, d


def quantile_by_runs(parts: Sequence[FloatArray], coverage: float = COVERAGE) -> float:
    """Return the quantile of the samples of all parts, each part with the same weight, that covers a new part so far."""
    values = np.concatenate(parts)
    weights = np.concatenate([np.full(len(part), 1.0 / max(len(part), 1)) for part in parts])
    order = np.argsort(values)
    share = np.cumsum(weights[order])
    level = unbiased_level(parts, coverage)
    at = min(int(np.searchsorted(share, level * share[-1] * (1.0 - 1e-12))), len(values) - 1)
    return float(values[order][at])


def unbiased_level(parts: Sequence[FloatArray], coverage: float = COVERAGE) -> float:
    """Return the level at which the quantile of all parts but one covers this share of that one, on average over all.

    Runs are what is exchangeable, not samples. Where runs are all alike the level is the coverage; where each run is one
    error of its own, coverage (n + 1)/n, the mean of split conformal prediction without its rounding up (Lei et al.
    2018, which guarantees at least COVERAGE and so covers more on average). Real runs lie in between, and leaving out
    one run after the other tells where (Barber et al. 2021). At most a level that leaves out _BEYOND of what the
    coverage leaves out.
    """
    grid = (np.arange(_STEPS) + 0.5) / _STEPS
    rows = np.array([np.quantile(part, grid) for part in parts if len(part)])
    highest = 1.0 - _BEYOND * (1.0 - coverage)
    if len(rows) < 2:
        return highest
    run = np.repeat(np.arange(len(rows)), _STEPS)
    order = np.argsort(rows, axis=None, kind="stable")
    values, run = rows.ravel()[order], run[order]
    others = np.array([values[run != k] for k in range(len(rows))])

    def covered(level: float) -> float:
        ends = others[:, min(int(level * others.shape[1]), others.shape[1] - 1)]
        return float(np.mean(rows <= ends[:, None]))

    def root(target: float) -> float:
        low, high = 0.0, highest
        while high - low > 1e-4:
            middle = 0.5 * (low + high)
            low, high = (low, middle) if covered(middle) >= target else (middle, high)
        return high

    # a few runs of one error each are covered in steps, and a step may lie at the coverage itself: its middle
    return 0.5 * (root(coverage - 1e-9) + root(coverage + 1e-9))


_FLOOR_NM: Final = 0.02
_FAST_RAD_S: Final = 0.1
"""Slower samples do not count for sigma: near a reversal the loss is not settled, which `half` accounts for."""


def fit_sigma(runs: Sequence[PathResiduals], *, with_torsion: bool = True) -> FusedSigma:
    """Return the standard deviations of both paths, scale 1; without torsion those of the current path.

    Raises ValueError for fewer than three runs with samples, or none above 0.1 rad/s.
    """
    runs = [run for run in runs if len(run.raw_nm)]
    if len(runs) < 3:
        raise ValueError(f"found {len(runs)} held-out runs with motion, expected at least 3")
    current = np.array([run.current_error_nm.mean() for run in runs])
    torsion = np.array([run.torsion_error_nm.mean() for run in runs])
    products = (current - current.mean()) * (torsion - torsion.mean())
    # less its standard error: what is not surely the sensor's stays in the sigma of the torque
    doubt = float(np.std(products)) / np.sqrt(len(runs))
    shared = max(float(np.mean(products)) - doubt, _FLOOR_NM**2) if with_torsion else 0.0
    fast = [np.abs(run.velocity_rad_s) > _FAST_RAD_S for run in runs]
    if not any(map(np.any, fast)):
        raise ValueError(f"found no held-out sample above {_FAST_RAD_S} rad/s, expected some")
    raw, v, e_c, e_t, t, open_nm = (
        np.concatenate([getattr(run, name)[keep] for run, keep in zip(runs, fast, strict=True)])
        for name in (
            "raw_nm",
            "velocity_rad_s",
            "current_error_nm",
            "torsion_error_nm",
            "torsion_nm",
            "open_nm",
        )
    )
    ones = np.ones_like(v)
    a = nnls(np.column_stack((ones, v * v, raw * raw)), e_c * e_c - shared)[0]
    current_nm = max(float(np.sqrt(a[0])), _FLOOR_NM)
    # without torsion the estimator does not read its sigma; the file must have a number above 0
    b = (
        nnls(np.column_stack((ones, t * t)), e_t * e_t - shared - open_nm * open_nm)[0]
        if with_torsion
        else np.array((current_nm**2, 0.0))
    )
    return FusedSigma(
        current_nm=current_nm,
        viscous_nms_per_rad=float(np.sqrt(a[1])),
        load=float(np.sqrt(a[2])),
        torsion_nm=max(float(np.sqrt(b[0])), _FLOOR_NM),
        torsion_load=float(np.sqrt(b[1])),
        reference_nm=float(np.sqrt(shared)),
        scale=(1.0, 1.0, 1.0, 1.0),
    )


SATURATION_RAD_S: Final = (0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0, 1.3, 1.6, 2.0, 3.0, 5.0, 10.0)
"""Speeds among which s is chosen."""


def by_speed(velocity_rad_s: FloatArray, bend: float) -> FloatArray:
    """Return the square of speeds [n], bent: `Tracking.bend`."""
    square = velocity_rad_s * velocity_rad_s
    result: FloatArray = square / (1.0 + bend * square)
    return result


def fit_tracking(
    errors: Sequence[FloatArray], errors_now: Sequence[FloatArray], velocity: Sequence[FloatArray]
) -> Tracking:
    """Return the section of runs left out, one array per run each: e, e_now [Nm], v [rad/s]."""
    more = np.concatenate([now * now - e * e for e, now in zip(errors, errors_now, strict=True)])
    v = np.concatenate(velocity)
    found: list[tuple[float, Tracking]] = []
    for saturation in SATURATION_RAD_S:
        columns = np.column_stack((np.ones_like(v), by_speed(v, 1.0 / saturation**2)))
        (noise, viscous), _ = nnls(columns.T @ columns, columns.T @ more)
        one = Tracking(TRACKING_RAD_S, float(np.sqrt(noise)), float(np.sqrt(viscous)), WAVE_RAD_S, saturation)
        found.append((float(np.sum((columns @ (noise, viscous) - more) ** 2)), one))
    return min(found, key=lambda each: each[0])[1]


def worth_it(errors_now: Sequence[FloatArray], errors_low_pass: Sequence[FloatArray]) -> bool:
    """Return whether tracking beats the low pass of new configurations, over runs left out, against the sensor now.

    Means of runs count for nothing: the zeros of a day are in both.
    """

    def square(runs: Sequence[FloatArray]) -> float:
        return float(sum(np.sum((run - run.mean()) ** 2) for run in runs if len(run)))

    return square(errors_now) < square(errors_low_pass)


COVERAGE_AT_REST: Final = 0.95
"""More than in motion: who leans on a standing joint is not served by nine times out of ten."""
CONFIDENCE: Final = 0.95
"""Of campaigns, in which at least COVERAGE of other days is held."""
FEWEST_RUNS: Final = 6
KNOWN: Final = 0.05
"""Part of the torsion's standard deviation that its slip may leave open where it counts as known."""


class Standing(NamedTuple):
    """Standing samples of an unseen run, arrays [n]: error to the sensor, sd and bounds [Nm], known: whether the slip is."""

    error_nm: FloatArray
    spread_nm: FloatArray
    bound_nm: FloatArray
    known: BoolArray


def ahead_nm(run: RunSignals, torsion: Torsion) -> FloatArray:
    """Return what a torsion of TORSION_BANDWIDTH_RAD_S knows more than one of the motor path's age less the sensor's [n]."""
    if run.as_read is None:
        return np.zeros_like(run.sensor_nm)
    dt, rate = run.seen.dt_s, TORSION_BANDWIDTH_RAD_S
    torque = torsion.stiffness_nm_per_rad * (
        low_pass(run.as_read.torsion_rad, dt, rate) - run.seen.torsion_nm
    )
    result: FloatArray = torque - (low_pass(run.as_read.sensor_nm, dt, rate) - run.sensor_nm)
    return result


def beyond_normal(n: int) -> float:
    """Return b_n: half an interval in RMS of n normal errors that holds COVERAGE_AT_REST of others, COVERAGE at least."""
    student = stdtrit(n, 0.5 * (1.0 + COVERAGE_AT_REST))
    tolerance = ndtri(0.5 * (1.0 + COVERAGE)) * np.sqrt(n / chdtri(n, CONFIDENCE))
    return float(max(student, tolerance))


def fit_standstill(runs: Sequence[Standing], reference_nm: float = 0.0) -> Standstill | None:
    """Return the section; None for too few runs that came to rest. reference_nm: of the sensor's zero from run to run."""
    errors, zeros = [], []
    for run in runs:
        if np.count_nonzero(run.known) >= FEWEST:
            spread = run.spread_nm[run.known]
            errors.append(np.maximum(np.abs(run.error_nm) - run.bound_nm, 0.0)[run.known] / spread)
            zeros.append(float(np.mean((reference_nm / spread) ** 2)))
    n = len(errors)
    if n < FEWEST_RUNS:
        return None
    rms = np.sqrt(np.mean([np.mean(error * error) for error in errors]))
    most = max(beyond_normal(n) * rms, quantile_by_runs(errors, COVERAGE_AT_REST))
    normal = ndtri(0.5 * (1.0 + COVERAGE_AT_REST))
    return Standstill(float(np.sqrt(max(most * most - normal * normal * np.mean(zeros), 1.0))))


def tracking_of_unseen(unseen: Sequence[PathResiduals], fused: Fused) -> Tracking | None:
    """Return what an estimate of now adds to sigma on unseen runs of a joint with torsion.

    None where the low pass of new configurations errs no more, or positions are not known.
    """
    if not all(len(run.now.tracked_nm) == len(run.raw_nm) for run in unseen):
        return None
    if not worth_it([run.now.tracked_nm for run in unseen], [run.now.late_nm for run in unseen]):
        return None
    each = [served(run, fused) for run in unseen]
    return fit_tracking(
        [run.error_nm for run in each], [run.now_nm for run in each], [run.velocity_rad_s for run in each]
    )


def standing_errors(run: PathResiduals, ahead: FloatArray, fused: Fused) -> Standing:
    """Return what a standing run tells of the interval at rest."""
    spread, bound = Fusion(replace(fused.sigma, reference_nm=0.0), True).rest_many(
        run.raw_nm, run.half_nm, run.velocity_rad_s, run.torsion_nm, run.open_nm
    )
    error = served(run, fused).error_nm
    return Standing(error + ahead, spread, bound, run.open_nm <= KNOWN * fused.sigma.torsion_nm)


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
