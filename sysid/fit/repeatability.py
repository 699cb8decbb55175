"""Fit section `fused.zeros` of a joint file: how far the link encoder's zero differs from day to day.

    spread_nm^2 = variance of the torsion's run means - reference^2        on runs that the fit had not seen
    spread_rad  = spread_nm over the mean stiffness of the spring

    correlation_s = long-run variance / assumed, of what a day's states leave of the difference of the paths

The mean error of a run is its zero and the sensor's; reference^2 is the sensor's (`sysid/fit/fused.py`). The long-run
variance is that of means over WINDOW_S, times WINDOW_S, after least squares with the states of `zeros.pyx` in each run;
assumed is that of both paths, less that of the zero. The same runs are then estimated as in service, each from its start:
zeros tracked, what is known of them taken off value and sigma. The section is written where that takes at least WORTH off
the mean square error; `sysid/fit/calibration.py` sets its scale.

Fit section `fused.agreement` of a joint file: how far the two paths differ on runs that the fit had not seen.

Levels of samples, not of runs: what is beyond is doubt that grows from zero, so a run that is a little beyond costs little
(estimator/agreement.pyx).

Waves of the difference over the motor's turn, in contrast, are those of the joint on every day. What all runs have of them
is found by least squares, the slow part of each second left out on both sides; what is left in a run then counts by its
covariance over all runs, and the limit is beyond the largest that any run came to.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import (
    TURN_WAVES,
    Agreement,
    DayZeros,
    Fused,
    FusedSigma,
    Turn,
)
from jtqd.estimator.path_difference import (
    CORRELATION_S,
    EVERY,
    MOVING_RAD_S,
    ONE_WAY,
    TURNING_RAD_S,
    levels,
    turn_waves,
)
from jtqd.estimator.uncertainty import Fusion
from jtqd.sysid.fit.residuals import PathResiduals, served

WORTH: Final = 0.05
"""Part of the mean square error on runs left out that the learned zeros must take away to be believed."""
_MOST: Final = 0.9
"""Of the torsion's variance: the rest is never the day's zero."""
WINDOW_S: Final = 0.5
"""Longer than ripple and encoders' errors last; a run has to have two windows for each state."""
_SHORTEST_S: Final = 1e-3
"""A sample at 1 kHz."""
_FEWEST_DAYS: Final = 8
"""Runs, of a day each, from which a spread of days can be told."""


def fit_zeros(runs: Sequence[PathResiduals], fused: Fused, rated_nm: float) -> DayZeros | None:
    """Return the section of runs left out, scale 1; None where it is not worth it, or for too few runs."""
    if len(runs) < _FEWEST_DAYS or not all(len(run.dt_s) for run in runs):
        return None
    sigma = fused.sigma
    means = np.array([run.torsion_error_nm.mean() for run in runs])
    spread = min(float(np.var(means)) - sigma.reference_nm**2, _MOST * sigma.torsion_nm**2)
    if not spread > 0.0:
        return None
    stiffness = float(np.mean([run.stiffness_nm_per_rad.mean() for run in runs]))
    nm = float(np.sqrt(spread))
    found = DayZeros(nm / stiffness, nm, (1.0, 1.0, 1.0, 1.0), correlation(runs, sigma, nm))
    before, after = (
        _mean_square([served(run, section, rated_nm, tracked=True).error_nm for run in runs])
        for section in (fused, replace(fused, zeros=found))
    )
    return found if after < (1.0 - WORTH) * before else None


def correlation(runs: Sequence[PathResiduals], sigma: FusedSigma, spread_nm: float) -> float | None:
    """Return how long [s] the difference of the paths keeps what is no state of the day; None where no run tells.

    For the variance that the filter assumes: of both paths less that of the day's zero.
    """
    found, assumed = [], []
    for run in runs:
        keep = (np.abs(run.velocity_rad_s) > MOVING_RAD_S) & (np.abs(run.direction) > ONE_WAY)
        apart = run.torsion_error_nm - run.current_error_nm
        states = (
            run.stiffness_nm_per_rad,
            1.0 - run.slope,
            run.direction,
            run.velocity_rad_s,
            run.torsion_nm,
        )
        seen = (run.raw_nm, run.half_nm, run.velocity_rad_s, run.torsion_nm, run.open_nm)
        variance = Fusion(sigma, True).variance_many(*seen) - spread_nm**2
        rows = np.column_stack((*states, apart, variance))[keep]
        length = max(round(WINDOW_S / float(np.mean(run.dt_s))), 1)
        windows = len(rows) // length
        if windows < 2 * len(states):
            continue
        means = rows[: windows * length].reshape(windows, length, -1).mean(axis=1)
        x, y = means[:, :-2] / np.abs(means[:, :-2]).max(axis=0).clip(1e-12), means[:, -2]
        weights, _, rank, _ = np.linalg.lstsq(x, y, rcond=1e-6)
        left = y - x @ weights
        found.append(float(left @ left) / (windows - int(rank)))
        assumed.append(float(means[:, -1].mean()))
    if not found:
        return None
    return float(np.clip(WINDOW_S * np.mean(found) / np.mean(assumed), _SHORTEST_S, CORRELATION_S))


def _mean_square(errors: Sequence[FloatArray]) -> float:
    return float(np.mean([np.mean(error * error) for error in errors]))


QUANTILE: Final = 0.75
"""Of the blocks of all runs: the rest of ordinary days has a little doubt. Chosen on runs that no figure is reported on."""
LOWERED: Final = 0.99
"""Of the blocks of all runs: a doubt beyond it is none of ordinary days. What is left, and as much by the envelope
(`envelope.BEYOND_SHARE`), is the 2 % that may be flagged without need."""
LEVEL_FACTOR: Final = 2.8
GAIN_FACTOR: Final = 4.0
"""Of `agreement.pyx`, chosen with QUANTILE: larger ones cover what has changed no better."""
ZERO_FACTOR: Final = 1.3
"""Of `agreement.pyx`: chosen on runs that no figure is reported on. Until the joint has moved both ways, the filter
finds less of a zero than there is: friction takes a part."""
GAIN_SIGMAS: Final = 1.0
"""Of `agreement.pyx`: chosen on runs that no figure is reported on. More hold a softer spring less; without, sigma is wider
where a joint is always driven."""
_START: Final = Agreement(1.0, 1.0, 0.0, 0.0, gain_sigmas=GAIN_SIGMAS)
_FEWEST_BLOCKS: Final = 200
"""Blocks, 3 s of motion at 1 kHz: from less no level can be told."""
_FLOOR_NM: Final = 1e-3

Levels = tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]
"""Of one run, as `estimator.agreement.levels` returns it."""


def fit_agreement(levels: Callable[[Agreement], Sequence[Levels]]) -> Agreement | None:
    """Return the levels of runs; None for too little motion. levels: of all runs, their doubt beyond a section."""
    slow, fast, gain, left, _ = (np.concatenate(parts) for parts in zip(*levels(_START), strict=True))
    if len(slow) < _FEWEST_BLOCKS:
        return None

    def level(values: FloatArray) -> float:
        return float(np.quantile(values, QUANTILE))

    found = Agreement(
        slow_nm=max(level(np.sqrt(slow)), _FLOOR_NM),
        fast_nm=max(level(np.sqrt(fast)), _FLOOR_NM),
        gain=level(gain),
        zero_nm=level(left),
        level_factor=LEVEL_FACTOR,
        gain_factor=GAIN_FACTOR,
        zero_factor=ZERO_FACTOR,
        gain_sigmas=GAIN_SIGMAS,
    )
    doubt = np.concatenate([run[-1] for run in levels(found)])
    return replace(found, lowered_nm=max(float(np.quantile(doubt, LOWERED)), _FLOOR_NM))


TURN_BEYOND: Final = 1.1
"""So many times the largest square of any run is the limit. Chosen on runs that no figure is reported on."""
_FEWEST_RUNS: Final = 16
"""With motion: from fewer no covariance of the six waves can be told."""
_TURN_FLOOR_NM: Final = 1e-2
_PART_S: Final = 1.0
"""What is slow is left out of so long a part of a run at once."""


class TurnRun(NamedTuple):
    """One unseen run, arrays [n] of its samples in motion, as `estimator.agreement.turn_waves` takes them."""

    dt_s: FloatArray
    apart_nm: FloatArray
    direction: FloatArray
    velocity_rad_s: FloatArray
    loss_nm: FloatArray
    waves: FloatArray


def fit_turn(runs: Sequence[TurnRun]) -> Turn | None:
    """Return what runs have in common over the motor's turn, and how far they differ; None for too few runs."""
    constant, loss, viscous, quadratic = (tuple(map(float, part)) for part in _own_waves(runs))
    found = Turn(constant, loss, viscous, quadratic, _lower(np.eye(TURN_WAVES)), limit=1.0)
    each = [waves for waves in (turn_waves(found, *run)[0] for run in runs) if len(waves)]
    if len(each) < _FEWEST_RUNS:
        return None
    left = np.concatenate(each)
    covariance = left.T @ left / len(left) + _TURN_FLOOR_NM**2 * np.eye(TURN_WAVES)
    found = replace(found, covariance_nm2=_lower(covariance))
    largest = max(float(turn_waves(found, *run)[1].max(initial=0.0)) for run in runs)
    return replace(found, limit=TURN_BEYOND * largest)


def _lower(matrix: FloatArray) -> tuple[float, ...]:
    return tuple(map(float, matrix[np.tril_indices(len(matrix))]))


def _own_waves(runs: Sequence[TurnRun]) -> FloatArray:
    """Return the parts [4, 6] of the waves that all runs have: constant, by loss, by speed, by its square."""
    products: FloatArray = np.zeros(4 * TURN_WAVES)
    squares: FloatArray = np.zeros((4 * TURN_WAVES, 4 * TURN_WAVES))
    for run in runs:
        turning = (np.abs(run.velocity_rad_s) > TURNING_RAD_S) & (np.abs(run.direction) > ONE_WAY)
        keep = np.flatnonzero(turning)[::EVERY]
        if not len(keep):
            continue
        v, loss, w = run.velocity_rad_s[keep], run.loss_nm[keep], run.waves[keep]
        columns = np.column_stack([w * part[:, None] for part in (np.ones_like(v), loss, v, v * v)])
        both = np.column_stack((columns, run.apart_nm[keep]))
        slow = np.column_stack((np.ones_like(v), run.direction[keep], v, loss))
        count = max(1, round(float(run.dt_s[keep].sum()) * EVERY / _PART_S))
        for at in np.array_split(np.arange(len(keep)), count):
            rest = both[at] - slow[at] @ np.linalg.lstsq(slow[at], both[at], rcond=None)[0]
            squares += rest[:, :-1].T @ rest[:, :-1]
            products += rest[:, :-1].T @ rest[:, -1]
    return np.asarray(np.linalg.lstsq(squares, products, rcond=None)[0], np.float64).reshape(4, TURN_WAVES)


def agreement_of_held_out(unseen: Sequence[PathResiduals], fused: Fused, rated_nm: float) -> Agreement | None:
    """Return how far the two paths differ on unseen runs; None for too little motion."""
    fusion = Fusion(fused.sigma, True)

    def of_runs(agreement: Agreement) -> list[Levels]:
        usual = replace(fused, agreement=agreement)
        return [
            levels(
                usual,
                rated_nm,
                run.dt_s,
                run.torsion_error_nm - run.current_error_nm,
                run.direction,
                run.velocity_rad_s,
                run.torsion_nm,
                fusion.variance_many(
                    run.raw_nm, run.half_nm, run.velocity_rad_s, run.torsion_nm, run.open_nm
                ),
                run.slope,
            )
            for run in unseen
            if len(run.dt_s)
        ]

    found = fit_agreement(of_runs)
    if found is None:
        return None
    turning = [
        TurnRun(
            run.dt_s,
            run.torsion_error_nm - run.current_error_nm,
            run.direction,
            run.velocity_rad_s,
            run.loss_nm,
            run.turn,
        )
        for run in unseen
        if len(run.turn)
    ]
    return replace(found, turn=fit_turn(turning))
