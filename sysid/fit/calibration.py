"""Uncertainty calibration: sigma of the fused estimate from held-out runs, so that its interval holds COVERAGE of a new run.

Quantiles over runs (split conformal prediction, Vovk et al. 2005): runs are exchangeable, samples are not. Every run has the
same weight.

**Sigma** (`fit_sigma`), with residuals e_c = tau_raw - loss - sensor and e_t = tau_t - sensor:

    reference^2 = covariance of the two paths' run means, less its standard error: they share the sensor's offset
    e_c^2 - reference^2 ~ current^2 + (viscous v)^2 + (load tau_raw)^2
    e_t^2 - reference^2 - open^2 ~ torsion^2 + (load tau_t)^2

With one encoder nothing separates the sensor's offset from the error of the current path: reference is 0, sigma holds both.

**Tracking** (`fit_tracking`), the error of an estimate without delay beyond that of one with the motor path's delay:

    sigma_undelayed^2 = sigma^2 + a^2 + (b v)^2/(1 + (v/s)^2)

a, b, s: least squares of e_undelayed^2 - e^2. Above some speed the filter misses all of a wave over the motor's turn, and
no more: a part that grows without end is too wide at rest and too narrow at the speeds of work. The sensor is taken as it
is: its own delay against the encoders is in a and b.

**Standstill** (`fit_standstill`), half width of the interval of a standing joint:

    half = k sd + alpha open + (1 - alpha) half_f           (fusion.pyx)

open, half_f: what slip and friction leave open are bounds, not deviations, and count in full. sd: of both paths besides.
All standing samples of a run share its offsets and its pre-load: n runs are n errors. With e = [|error| - bounds]+/sd, where
the slip is known (no campaign shows how a joint stood before it was switched on: there its bound counts),

    k^2 = max(b_n RMS(e), q)^2 - z^2 mean(reference^2/sd^2)

b_n: of n normal errors, so that COVERAGE_AT_REST of other days is held on average over campaigns (Student's t_n), and
COVERAGE of them after 19 of 20 campaigns (tolerance interval, 1.645 sqrt(n/chi^2), chi^2 the 5 % quantile of n degrees of
freedom): 3.15 for 6 runs, 2.55 for 11, 2.08 for 32, 1.96 for many. q: quantile of e for COVERAGE_AT_REST of a held-out run,
where days are not normal. z: 1.96. The error is against the sensor: its offset is in e and subtracted again, but the
allowance for few runs covers both, so that it cannot hide an error at rest. k is at least 1. Below FEWEST_RUNS runs with a
stop there is no section, and the estimator takes 3 standard deviations. The torsion is that of the low pass of
TORSION_BANDWIDTH_RAD_S: a tracked one is no noisier at rest.

**Scale** (`calibrated`), the last step of a fit: factors of `fused.sigma` and `fused.zeros`.

    |error| <= 1.645 sqrt((scale_q spread)^2 + more^2)      in COVERAGE of the samples of a held-out run, quadrant q,
                                                            and in QUIET of those with the lesser half of more/spread

error, spread, more: below; with the torsion tracked, `fused.tracking` is in more, so that it is not counted twice.
scale_q is the conformal quantile of sqrt(error^2 - (1.645 more)^2) over the spread.

The campaign has a sensor, not the torque. Both paths' run means share the sensor's offset in that run, of standard deviation
`reference_nm`: a normal prior, and two normal measurements of it whose variance is the excess of each path's means. The
posterior's mean is subtracted from a run's error, and its standard deviation is spread over the samples by quantiles of a
normal distribution (multiple imputation, Rubin 1987): a calibration against the torque, as far as the runs show it. The mean
of n runs' offsets is in the fitted torques and nothing shows it: reference^2/n counts beside the posterior's variance, and
that of a teacher that is no sensor (`known_load.py`).

The level is unbiased, not the conservative one that guarantees at least COVERAGE. Where a whole run shares its error (its
offsets), n runs have not shown the largest yet: 8 of them cover 87 % of others.

Held-out residuals: the error of current path and torsion path on a run that the fit did not use, and of their fusion.

    error = e_c + alpha (e_t - e_c)                          with the delay of the motor path
    spread = sqrt(alpha) s_t                                 s_t: without the day's offset, which is in more
    error, no delay = e_tracked + (1 - alpha) (e_c - e_t')   e_t': of the tracked torsion through the motor path's filter
    more^2 = what widens sigma in the estimator beside that

With `track_zeros` the corrections of both paths are in all of them. more: `track_run` of fusion.pyx.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final, NamedTuple, TypeVar

import numpy as np

from jtqd.estimator.arrays import BoolArray, FloatArray, QuadrantArray
from jtqd.estimator.estimator import SLOPE_NM, quadrants
from jtqd.estimator.fusion import GAUSS, Fusion, faded, track_run
from jtqd.estimator.joint import AdditiveLoss, Fused, FusedSigma, Standstill, Torsion, Tracking
from jtqd.estimator.losses import AdditiveLossModel
from jtqd.estimator.observer import low_pass
from jtqd.estimator.settings import TORSION_BANDWIDTH_RAD_S
from jtqd.estimator.status import STANDSTILL
from jtqd.sysid.fit.signals import RunSignals
from jtqd.sysid.fit.torsion import (
    TRACKING_RAD_S,
    WAVE_RAD_S,
    deflection,
    local_stiffness,
    low_pass_torque,
    torsion_torque,
    tracked_torque,
)

NONE: Final = np.zeros(0)
NEVER: Final = np.zeros(0, np.bool_)


class PathResiduals(NamedTuple):
    """One held-out run: arrays [n] of its moving samples, or of all that were observed (`observed_run`), [Nm] and [rad/s].

    teacher: standard deviation of what errors are against, 0 for a sensor.
    half: width of the friction interval (`AdditiveLossModel.loss`). open: what the slip leaves open.
    Without torsion torsion_nm, open_nm, torsion_error_nm are 0, and what follows is empty:
    dt_s, direction, slope (dL/draw of the loss): for `fused.agreement`. stiffness (d tau_t/d d): for `fused.zeros`.
    tracked, delayed, low_pass: errors of the tracked torsion, of that through the motor path's filter, and of the torsion
    through the low pass of new configurations, against the unfiltered sensor: for `fused.tracking`.
    loss_nm, turn [n, 6] (filtered cos and sin of 1, 2 and 4 times the motor angle): for `fused.agreement.turn`.
    ahead, behind: of the tracked torsion to the delayed one, to the readings. resting: standing. counted: moving, settled.
    now: the current path is no older than the tracked torsion; empty: it is, by the motor path's filter.
    """

    raw_nm: FloatArray
    velocity_rad_s: FloatArray
    half_nm: FloatArray
    torsion_nm: FloatArray
    open_nm: FloatArray
    current_error_nm: FloatArray
    torsion_error_nm: FloatArray
    dt_s: FloatArray = NONE
    direction: FloatArray = NONE
    slope: FloatArray = NONE
    tracked_nm: FloatArray = NONE
    delayed_nm: FloatArray = NONE
    low_pass_nm: FloatArray = NONE
    stiffness_nm_per_rad: FloatArray = NONE
    loss_nm: FloatArray = NONE
    turn: FloatArray = NONE
    teacher_nm: FloatArray = NONE
    ahead_nm: FloatArray = NONE
    behind_nm2: FloatArray = NONE
    resting: BoolArray = NEVER
    counted: BoolArray = NEVER
    now: BoolArray = NEVER

    @property
    def in_motion(self) -> PathResiduals:
        """The run's samples that count."""
        return _only(self, self.counted)

    @property
    def apart_nm(self) -> FloatArray:
        """Difference of torsion path and current path [n]."""
        return self.torsion_error_nm - self.current_error_nm

    @property
    def fusion_inputs(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """What the array methods of `Fusion` take."""
        return self.raw_nm, self.half_nm, self.velocity_rad_s, self.torsion_nm, self.open_nm

    @property
    def difference(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """What the functions of `fusion.pyx` take of the paths' difference."""
        return self.dt_s, self.apart_nm, self.direction, self.velocity_rad_s, self.torsion_nm

    def with_tracked_torsion(self) -> PathResiduals:
        """Return the run with the tracked torsion, delayed as the motor path: the estimator compares these two."""
        return self._replace(
            torsion_nm=self.torsion_nm + self.delayed_nm - self.torsion_error_nm,
            torsion_error_nm=self.delayed_nm,
        )


Run = TypeVar("Run", "PathResiduals", "FusedErrors")


def _only(run: Run, counted: BoolArray) -> Run:
    """Return the samples of a run that count; empty: all."""
    arrays: dict[str, Any] = run._asdict()
    return run._replace(**{key: x[counted] for key, x in arrays.items() if len(x)}) if len(counted) else run


def path_residuals(
    run: RunSignals, loss: AdditiveLoss, torsion: Torsion | None, keep: BoolArray | None = None
) -> PathResiduals:
    """Return the errors of both paths on samples `keep` [n] of a run, None: those in motion."""
    keep, seen = run.moving if keep is None else keep, run.seen
    loss_nm, wide = (each[keep] for each in loss_and_width(run, loss))
    raw, sensor, velocity = seen.raw_nm[keep], run.sensor_nm[keep], seen.velocity_rad_s[keep]
    current = raw - loss_nm - sensor
    teacher = np.zeros(len(raw)) if run.teacher_nm is None else run.teacher_nm[keep]
    if torsion is None:
        none = np.zeros(len(raw))
        return PathResiduals(raw, velocity, wide, none, none, current, none, teacher_nm=teacher)
    tau, open_nm = (each[keep] for each in torsion_torque(torsion, run))
    direction = seen.direction[keep]
    more, _ = AdditiveLossModel(loss).loss_many(raw + SLOPE_NM, velocity, seen.temperature_c[keep], direction)
    tracked, behind = tracked_torque(torsion, run)
    tracked -= run.raw_sensor_nm
    delayed = low_pass(tracked, seen.dt_s, run.bandwidth_rad_s)
    return PathResiduals(
        raw,
        velocity,
        wide,
        tau,
        open_nm,
        current,
        tau - sensor,
        dt_s=seen.dt_s[keep],
        direction=direction,
        slope=(more - loss_nm) / SLOPE_NM,
        tracked_nm=tracked[keep],
        delayed_nm=delayed[keep],
        low_pass_nm=(low_pass_torque(torsion, run) - run.raw_sensor_nm)[keep],
        stiffness_nm_per_rad=local_stiffness(torsion, deflection(torsion, run)[keep]),
        loss_nm=loss_nm,
        turn=np.column_stack((seen.turn, seen.waves))[keep],
        teacher_nm=teacher,
        ahead_nm=(tracked + run.raw_sensor_nm - delayed)[keep] - sensor,
        behind_nm2=behind[keep],
        resting=seen.status[keep] == STANDSTILL,
    )


def observed_run(run: RunSignals, loss: AdditiveLoss, torsion: Torsion) -> PathResiduals:
    """Return the errors of both paths on all observed samples: what the estimator knows depends on those at rest."""
    observed = ~np.isnan(run.seen.raw_nm)
    return path_residuals(run, loss, torsion, observed)._replace(counted=run.moving[observed])


def loss_and_width(run: RunSignals, loss: AdditiveLoss) -> tuple[FloatArray, FloatArray]:
    """Return loss and held half width of the friction interval [n] over a run; zero where nothing was observed."""
    seen = run.seen
    running = ~np.isnan(seen.raw_nm)
    raw, v, s = (np.where(running, x, 0.0) for x in (seen.raw_nm, seen.velocity_rad_s, seen.direction))
    value, half = AdditiveLossModel(loss).loss_many(raw, v, seen.temperature_c, s)
    return value, faded(half, seen.dt_s, running)


class FusedErrors(NamedTuple):
    """Errors of the estimator in one run, arrays [n] of its samples in motion.

    undelayed: with the torsion tracked. spread: standard deviation of the torque, scale 1. more: what the estimator adds to
    it. teacher: of `PathResiduals`. share: of the noise of the tracked torsion in the variance: all where it is put on top
    of a delayed fusion, else by its weight.
    """

    error_nm: FloatArray
    undelayed_nm: FloatArray
    spread_nm: FloatArray
    more_nm2: FloatArray
    velocity_rad_s: FloatArray
    quadrant: QuadrantArray
    teacher_nm: FloatArray = NONE
    share: FloatArray = NONE


def fused_errors(
    run: PathResiduals, fused: Fused, rated_nm: float | None = None, *, track_zeros: bool = False
) -> FusedErrors:
    """Return the errors that the estimator makes in a run with this section.

    rated_nm None, or a joint without torsion: nothing is learned in the run, and nothing widens the spread.
    """
    none = torsion = current = more = np.zeros(len(run.raw_nm))
    tracks = fused.tracking is not None and len(run.ahead_nm) > 0
    if rated_nm is None or fused.torsion is None or not len(run.dt_s):
        fusion = Fusion(replace(fused.sigma, reference_nm=0.0), fused.torsion is not None)
        alpha, _, spread, _ = fusion.fuse(*run.fusion_inputs)
    else:
        alpha, torsion, current, spread, more, _ = track_run(
            fused,
            rated_nm,
            run.dt_s,
            *run.fusion_inputs,
            run.apart_nm,
            run.direction,
            run.slope,
            run.stiffness_nm_per_rad,
            *((run.ahead_nm, run.behind_nm2) if tracks else (none, none)),
            run.resting if len(run.resting) else none > 0.0,
            track_zeros,
        )
    e_c, e_t = run.current_error_nm + current, run.torsion_error_nm + torsion
    undelayed = NONE
    if len(run.tracked_nm):
        undelayed = run.tracked_nm + torsion + (1.0 - alpha) * (e_c - run.delayed_nm - torsion)
    errors = FusedErrors(
        e_c + alpha * (e_t - e_c),
        undelayed,
        spread,
        more,
        run.velocity_rad_s,
        quadrants(run.raw_nm, run.velocity_rad_s),
        run.teacher_nm,
        np.where(run.now, alpha * alpha, 1.0) if len(run.now) else np.ones(len(alpha)),
    )
    return _only(errors, run.counted)


COVERAGE: Final = 0.9
FEWEST: Final = 50
"""Samples that a part of a run needs to count."""
Scale = tuple[float, float, float, float]
"""Factors of sigma, by quadrant."""
_ONE: Final[Scale] = (1.0, 1.0, 1.0, 1.0)

# Conformal quantiles -----------------------------------------------------------------------------------

_LEAST_SCALE: Final = 0.05
_BEYOND: Final = 0.3
"""Share of 1 - coverage that a level leaves out at least: the largest of few means nothing."""
_STEPS: Final = 200
"""Points of a run's distribution in the search of the level: 0.25 % of a run between two of them at most."""


def conformal_scale(
    errors: Sequence[FloatArray],
    sigmas: Sequence[FloatArray],
    quadrants: Sequence[QuadrantArray],
    coverage: float = COVERAGE,
) -> Scale:
    """Return the factor per quadrant that makes value +- GAUSS sigma cover this share of the samples of a new run.

    One array per run each. A quadrant in which no run has FEWEST samples takes the factor of all. Raises ValueError where
    there are no samples at all.
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
    """Return the quantile of the samples of all parts, of equal weight each, that covers this share of a new part."""
    values = np.concatenate(parts)
    weights = np.concatenate([np.full(len(part), 1.0 / max(len(part), 1)) for part in parts])
    order = np.argsort(values)
    share = np.cumsum(weights[order])
    level = unbiased_level(parts, coverage)
    at = min(int(np.searchsorted(share, level * share[-1] * (1.0 - 1e-12))), len(values) - 1)
    return float(values[order][at])


def unbiased_level(parts: Sequence[FloatArray], coverage: float = COVERAGE) -> float:
    """Return the level at which the quantile of all parts but one covers this share of that one, on average over all.

    Where runs are all alike the level is the coverage; where each run is one error of its own, coverage (n + 1)/n, the mean
    of split conformal prediction without its rounding up (Lei et al. 2018, which guarantees at least COVERAGE and so covers
    more on average). Real runs lie in between: the jackknife over runs finds where (Barber et al. 2021). At most a level
    that leaves out _BEYOND of what the coverage leaves out.
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


# Sigma and tracking ------------------------------------------------------------------------------------

_FLOOR_NM: Final = 0.02
_FAST_RAD_S: Final = 0.1
"""Slower samples do not count for sigma: near a reversal the loss is not settled, which `half` accounts for."""
SATURATION_RAD_S: Final = (0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0, 1.3, 1.6, 2.0, 3.0, 5.0, 10.0)
"""Speeds among which s is chosen."""


def fit_sigma(runs: Sequence[PathResiduals], *, with_torsion: bool = True) -> FusedSigma:
    """Return the standard deviations of both paths, scale 1; without torsion those of the current path.

    Raises ValueError for fewer than three runs with samples, or none above 0.1 rad/s.
    """
    from scipy.optimize import nnls

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

    def joined(name: str) -> FloatArray:
        return np.concatenate([getattr(run, name)[keep] for run, keep in zip(runs, fast, strict=True)])

    raw, v, e_c = joined("raw_nm"), joined("velocity_rad_s"), joined("current_error_nm")
    ones = np.ones_like(v)
    a = nnls(np.column_stack((ones, v * v, raw * raw)), e_c * e_c - shared)[0]
    current_nm = max(float(np.sqrt(a[0])), _FLOOR_NM)
    # without torsion the estimator does not read its sigma; the file must have a number above 0
    b = np.array((current_nm**2, 0.0))
    if with_torsion:
        e_t, t, open_nm = joined("torsion_error_nm"), joined("torsion_nm"), joined("open_nm")
        b = nnls(np.column_stack((ones, t * t)), e_t * e_t - shared - open_nm * open_nm)[0]
    return FusedSigma(
        current_nm=current_nm,
        viscous_nms_per_rad=float(np.sqrt(a[1])),
        load=float(np.sqrt(a[2])),
        torsion_nm=max(float(np.sqrt(b[0])), _FLOOR_NM),
        torsion_load=float(np.sqrt(b[1])),
        reference_nm=float(np.sqrt(shared)),
        scale=_ONE,
    )


def fit_tracking(runs: Sequence[PathResiduals], fused: Fused) -> Tracking | None:
    """Return the section of held-out runs; None where the low pass of new configurations has no larger error.

    Run means do not count in that comparison: the offsets of a day are in both.
    """

    def square(errors: Sequence[FloatArray]) -> float:
        return float(sum(np.sum((run - run.mean()) ** 2) for run in errors if len(run)))

    if not square([run.tracked_nm for run in runs]) < square([run.low_pass_nm for run in runs]):
        return None
    errors = [fused_errors(run, fused) for run in runs]
    return tracking_section(
        np.concatenate([run.undelayed_nm**2 - run.error_nm**2 for run in errors]),
        np.concatenate([run.velocity_rad_s for run in errors]),
    )


def tracking_section(excess_nm2: FloatArray, velocity_rad_s: FloatArray) -> Tracking:
    """Return the section from e_undelayed^2 - e^2 [n] at speeds [n]."""
    from scipy.optimize import nnls

    found: list[tuple[float, Tracking]] = []
    for saturation in SATURATION_RAD_S:
        columns = np.column_stack(
            (np.ones_like(velocity_rad_s), bent_square(velocity_rad_s, 1.0 / saturation**2))
        )
        (noise, viscous), _ = nnls(columns.T @ columns, columns.T @ excess_nm2)
        one = Tracking(TRACKING_RAD_S, float(np.sqrt(noise)), float(np.sqrt(viscous)), WAVE_RAD_S, saturation)
        found.append((float(np.sum((columns @ (noise, viscous) - excess_nm2) ** 2)), one))
    return min(found, key=lambda each: each[0])[1]


def bent_square(velocity_rad_s: FloatArray, bend: float) -> FloatArray:
    """Return the square of speeds [n], bent: `Tracking.bend`."""
    square = velocity_rad_s * velocity_rad_s
    result: FloatArray = square / (1.0 + bend * square)
    return result


# Standstill --------------------------------------------------------------------------------------------

COVERAGE_AT_REST: Final = 0.95
"""More than in motion: a controller relies on a standing joint."""
CONFIDENCE: Final = 0.95
"""Share of campaigns in which at least COVERAGE of other days is held."""
FEWEST_RUNS: Final = 6
KNOWN: Final = 0.05
"""Share of the torsion's standard deviation that its slip may leave open where it counts as known."""


class Standing(NamedTuple):
    """Standing samples of a held-out run, arrays [n]: error to the sensor, sd and bounds [Nm], whether the slip is known."""

    error_nm: FloatArray
    spread_nm: FloatArray
    bound_nm: FloatArray
    known: BoolArray


def low_pass_advance(run: RunSignals, torsion: Torsion) -> FloatArray:
    """Return what the low pass of TORSION_BANDWIDTH_RAD_S adds to torsion less sensor of the motor path's delay [n, Nm]."""
    dt, rate = run.seen.dt_s, TORSION_BANDWIDTH_RAD_S
    torque = torsion.stiffness_nm_per_rad * (low_pass(run.torsion_rad, dt, rate) - run.seen.torsion_nm)
    result: FloatArray = torque - (low_pass(run.raw_sensor_nm, dt, rate) - run.sensor_nm)
    return result


def standing_errors(run: PathResiduals, advance_nm: FloatArray, fused: Fused) -> Standing:
    """Return the errors of a held-out run at rest; advance: of its samples, see `low_pass_advance`."""
    fusion = Fusion(replace(fused.sigma, reference_nm=0.0), True)
    spread, bound = fusion.at_rest(*run.fusion_inputs)
    error = fused_errors(run, fused).error_nm + advance_nm
    error = np.hypot(error, run.teacher_nm) if len(run.teacher_nm) else error
    return Standing(error, spread, bound, run.open_nm <= KNOWN * fused.sigma.torsion_nm)


def normal_bound(n: int) -> float:
    """Return b_n: half an interval in RMS of n normal errors that holds COVERAGE_AT_REST of others, COVERAGE at least."""
    from scipy.special import chdtri, ndtri, stdtrit

    student = stdtrit(n, 0.5 * (1.0 + COVERAGE_AT_REST))
    tolerance = ndtri(0.5 * (1.0 + COVERAGE)) * np.sqrt(n / chdtri(n, CONFIDENCE))
    return float(max(student, tolerance))


def fit_standstill(runs: Sequence[Standing], reference_nm: float = 0.0) -> Standstill | None:
    """Return the section; None for too few runs that came to rest. reference_nm: of the sensor's offset from run to run."""
    from scipy.special import ndtri

    errors, offsets = [], []
    for run in runs:
        if np.count_nonzero(run.known) >= FEWEST:
            spread = run.spread_nm[run.known]
            errors.append(np.maximum(np.abs(run.error_nm) - run.bound_nm, 0.0)[run.known] / spread)
            offsets.append(float(np.mean((reference_nm / spread) ** 2)))
    n = len(errors)
    if n < FEWEST_RUNS:
        return None
    rms = np.sqrt(np.mean([np.mean(error * error) for error in errors]))
    most = max(normal_bound(n) * rms, quantile_by_runs(errors, COVERAGE_AT_REST))
    normal = ndtri(0.5 * (1.0 + COVERAGE_AT_REST))
    return Standstill(float(np.sqrt(max(most * most - normal * normal * np.mean(offsets), 1.0))))


# Scale -------------------------------------------------------------------------------------------------

OTHER_MOTIONS: Final = 0.02
OTHER_MOTIONS_LEARNED: Final = 0.01
"""Coverage of the campaign's runs above COVERAGE where offsets differ from day to day, not tracked and tracked: days of
other motions are covered by as much less. Chosen on runs that no figure is reported on."""
QUIET: Final = 0.85
"""Coverage, at least, of the half of the samples that is widened less: elsewhere what widens sigma covers nearly all."""
_QUANTILES: Final = 7
_LEAST_NM2: Final = 1e-4
"""Variance of a path's run means beside the sensor's offset: no path is free of an error of its own."""


def calibrated(runs: Sequence[PathResiduals], fused: Fused, rated_nm: float) -> Fused:
    """Return a section with both scales found on held-out runs; its other parts are final.

    Without section `fused.zeros` new configurations track offsets with the scale of sigma, which is then that of tracked
    ones.
    """
    offsets, doubt_nm = sensor_offsets([run.in_motion for run in runs], fused.sigma.reference_nm)

    def errors_of(section: Fused, *, track_zeros: bool) -> list[FusedErrors]:
        return [fused_errors(run, section, rated_nm, track_zeros=track_zeros) for run in runs]

    def beyond(errors: Sequence[FusedErrors]) -> list[FloatArray]:
        return _beyond(errors, offsets, doubt_nm, fused.tracking)

    def scale(errors: Sequence[FusedErrors], coverage: float) -> Scale:
        rest, widened = beyond(errors), [run.more_nm2 / run.spread_nm**2 for run in errors]
        scales = []
        for most, share in ((np.inf, coverage), (np.median(np.concatenate(widened)), QUIET)):
            keep = [more <= most for more in widened]
            kept = [x[k] for x, k in zip(rest, keep, strict=True)]
            spreads = [run.spread_nm[k] for run, k in zip(errors, keep, strict=True)]
            quadrants = [run.quadrant[k] for run, k in zip(errors, keep, strict=True)]
            scales.append(conformal_scale(kept, spreads, quadrants, share))
        a, b, c, d = map(max, *scales)
        return a, b, c, d

    if fused.zeros is None:
        errors = errors_of(fused, track_zeros=True)
        return replace(fused, sigma=replace(fused.sigma, scale=scale(errors, COVERAGE)))
    errors = errors_of(replace(fused, zeros=None), track_zeros=False)
    sigma = replace(fused.sigma, scale=scale(errors, COVERAGE + OTHER_MOTIONS))
    errors = errors_of(fused, track_zeros=True)
    days = replace(fused.zeros, scale=scale(errors, COVERAGE + OTHER_MOTIONS_LEARNED))
    return replace(fused, sigma=sigma, zeros=days)


def sensor_offsets(runs: Sequence[PathResiduals], reference_nm: float) -> tuple[FloatArray, float]:
    """Return the part [runs] of each run's errors that is its sensor's offset, and the standard deviation of that [Nm]."""
    if not reference_nm > 0.0:
        return np.zeros(len(runs)), 0.0
    means = np.array([(run.current_error_nm.mean(), run.torsion_error_nm.mean()) for run in runs])
    precision = 1.0 / np.maximum(means.var(axis=0) - reference_nm**2, _LEAST_NM2)
    variance = 1.0 / (1.0 / reference_nm**2 + float(precision.sum()))
    return variance * (means @ precision), float(np.sqrt(variance + reference_nm**2 / len(runs)))


def _beyond(
    runs: Sequence[FusedErrors], offsets: FloatArray, doubt_nm: float, tracking: Tracking | None
) -> list[FloatArray]:
    """Return what of the errors of runs, against the torque, the spread has to cover [Nm]."""
    from scipy.special import ndtri

    normal = ndtri((np.arange(_QUANTILES) + 0.5) / _QUANTILES)
    normal /= np.sqrt(np.mean(normal**2))
    beyond = []
    for run, offset in zip(runs, offsets, strict=True):
        error, more = run.error_nm, run.more_nm2
        if tracking is not None:
            error = run.undelayed_nm
            bent = bent_square(run.velocity_rad_s, tracking.bend)
            more = more + run.share * (tracking.sigma_nm**2 + tracking.viscous_nms_per_rad**2 * bent)
        doubt = np.hypot(doubt_nm, run.teacher_nm) if len(run.teacher_nm) else doubt_nm
        error = error - offset + doubt * normal[np.arange(len(error)) % _QUANTILES]
        beyond.append(np.sqrt(np.maximum(error**2 - GAUSS**2 * more, 0.0)))
    return beyond
