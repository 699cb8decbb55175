"""Day-to-day repeatability of a joint: sections `fused.zeros` and `fused.agreement`, from held-out runs.

Offset of the link encoder (`fused.zeros`): how far it differs from day to day.

    spread_nm^2 = variance of the torsion's run means - reference^2
    spread_rad  = spread_nm over the mean stiffness of the spring
    correlation_s = long-run variance / assumed, of the residual of a day's states in the difference of the paths

The mean error of a run is its offset and the sensor's; reference^2 is the sensor's (`sysid/fit/calibration.py`). The
long-run variance is that of means over WINDOW_S, times WINDOW_S, after least squares with the states of
`path_difference.pyx` in each run; assumed is that of both paths, less that of the offset. The same runs are then estimated
as in service, each from its start, with offsets tracked. The section is written where that reduces the mean square error by
at least WORTH; `sysid/fit/calibration.py` sets its scale.

Agreement of the paths (`fused.agreement`): quantiles over samples of how far they differ on ordinary days. A difference
beyond is doubt that grows from zero, so a run slightly beyond costs little (estimator/path_difference.pyx).

Waves of the difference over the motor's turn, in contrast, are the same on every day. Least squares finds what all runs have
in common, with the slow part of each second removed on both sides. The residual waves of a run count by their covariance
over all runs, and the limit is beyond the largest of any run.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import TURN_WAVES, Agreement, DayZeros, Fused, FusedSigma, Turn
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
from jtqd.sysid.fit.residuals import PathResiduals, fused_errors

WORTH: Final = 0.05
"""Share of the held-out mean square error that tracked offsets must remove."""
_MOST: Final = 0.9
"""Share of the torsion's variance that the day's offset has at most."""
WINDOW_S: Final = 0.5
"""Longer than ripple and encoders' errors last; a run has to have two windows for each state."""
_SHORTEST_S: Final = 1e-3
"""A sample at 1 kHz."""
_FEWEST_DAYS: Final = 8
"""Runs, each of another day, that give a spread."""


def fit_zeros(runs: Sequence[PathResiduals], fused: Fused, rated_nm: float) -> DayZeros | None:
    """Return the section of held-out runs, scale 1; None where tracking is not worth it, or for too few runs."""
    if len(runs) < _FEWEST_DAYS or not all(len(run.dt_s) for run in runs):
        return None
    sigma = fused.sigma
    means = np.array([run.torsion_error_nm.mean() for run in runs])
    variance = min(float(np.var(means)) - sigma.reference_nm**2, _MOST * sigma.torsion_nm**2)
    if not variance > 0.0:
        return None
    stiffness = float(np.mean([run.stiffness_nm_per_rad.mean() for run in runs]))
    spread = float(np.sqrt(variance))
    found = DayZeros(spread / stiffness, spread, (1.0, 1.0, 1.0, 1.0), correlation(runs, sigma, spread))
    without, with_it = (
        float(
            np.mean(
                [
                    np.mean(fused_errors(run, section, rated_nm, track_zeros=True).error_nm ** 2)
                    for run in runs
                ]
            )
        )
        for section in (fused, replace(fused, zeros=found))
    )
    return found if with_it < (1.0 - WORTH) * without else None


def correlation(runs: Sequence[PathResiduals], sigma: FusedSigma, spread_nm: float) -> float | None:
    """Return the correlation time [s] of what no state of the day explains of the paths' difference; None if unknown.

    For the variance that the filter assumes: of both paths less that of the day's offset.
    """
    found, assumed = [], []
    for run in runs:
        keep = (np.abs(run.velocity_rad_s) > MOVING_RAD_S) & (np.abs(run.direction) > ONE_WAY)
        states = (
            run.stiffness_nm_per_rad,
            1.0 - run.slope,
            run.direction,
            run.velocity_rad_s,
            run.torsion_nm,
        )
        variance = Fusion(sigma, True).fuse(*run.fusion_inputs).variance_nm2 - spread_nm**2
        rows = np.column_stack((*states, run.apart_nm, variance))[keep]
        length = max(round(WINDOW_S / float(np.mean(run.dt_s))), 1)
        windows = len(rows) // length
        if windows < 2 * len(states):
            continue
        means = rows[: windows * length].reshape(windows, length, -1).mean(axis=1)
        x, y = means[:, :-2] / np.abs(means[:, :-2]).max(axis=0).clip(1e-12), means[:, -2]
        weights, _, rank, _ = np.linalg.lstsq(x, y, rcond=1e-6)
        residual = y - x @ weights
        found.append(float(residual @ residual) / (windows - int(rank)))
        assumed.append(float(means[:, -1].mean()))
    if not found:
        return None
    return float(np.clip(WINDOW_S * np.mean(found) / np.mean(assumed), _SHORTEST_S, CORRELATION_S))


QUANTILE: Final = 0.75
"""Of the blocks of all runs: the rest of ordinary days has a little doubt. Chosen on runs that no figure is reported on."""
LOWERED: Final = 0.99
"""Of the blocks of all runs: a doubt beyond it is not that of ordinary days. The rest, and as much by the envelope
(`envelope.BEYOND_SHARE`), is the 2 % that may be flagged without need."""
LEVEL_FACTOR: Final = 2.8
GAIN_FACTOR: Final = 4.0
"""Of `path_difference.pyx`, chosen with QUANTILE: larger ones cover changed joints no better."""
ZERO_FACTOR: Final = 1.3
"""Of `path_difference.pyx`: chosen on runs that no figure is reported on. Until the joint has moved both ways, the filter
finds less of an offset than there is: friction takes a part."""
GAIN_SIGMAS: Final = 1.0
"""Of `path_difference.pyx`: chosen on runs that no figure is reported on. More hold a softer spring less; without, sigma is
wider where a joint is always driven."""
_START: Final = Agreement(1.0, 1.0, 0.0, 0.0, gain_sigmas=GAIN_SIGMAS)
_FEWEST_BLOCKS: Final = 200
"""3 s of motion at 1 kHz."""
_FLOOR_NM: Final = 1e-3


def fit_agreement(runs: Sequence[PathResiduals], fused: Fused, rated_nm: float) -> Agreement | None:
    """Return how far the two paths differ on held-out runs; None for too little motion."""
    fusion = Fusion(fused.sigma, True)
    moving = [run for run in runs if len(run.dt_s)]

    def levels_of(agreement: Agreement) -> list[tuple[FloatArray, ...]]:
        usual = replace(fused, agreement=agreement)
        return [
            levels(
                usual,
                rated_nm,
                run.dt_s,
                run.apart_nm,
                run.direction,
                run.velocity_rad_s,
                run.torsion_nm,
                fusion.fuse(*run.fusion_inputs).variance_nm2,
                run.slope,
            )
            for run in moving
        ]

    slow, fast, gain, offset, _ = (np.concatenate(parts) for parts in zip(*levels_of(_START), strict=True))
    if len(slow) < _FEWEST_BLOCKS:
        return None

    def level(values: FloatArray) -> float:
        return float(np.quantile(values, QUANTILE))

    found = Agreement(
        slow_nm=max(level(np.sqrt(slow)), _FLOOR_NM),
        fast_nm=max(level(np.sqrt(fast)), _FLOOR_NM),
        gain=level(gain),
        zero_nm=level(offset),
        level_factor=LEVEL_FACTOR,
        gain_factor=GAIN_FACTOR,
        zero_factor=ZERO_FACTOR,
        gain_sigmas=GAIN_SIGMAS,
    )
    doubt = np.concatenate([run[-1] for run in levels_of(found)])
    found = replace(found, lowered_nm=max(float(np.quantile(doubt, LOWERED)), _FLOOR_NM))
    return replace(found, turn=fit_turn(moving))


TURN_BEYOND: Final = 1.1
"""The limit in parts of the largest square of any run. Chosen on runs that no figure is reported on."""
_FEWEST_RUNS: Final = 16
"""With motion, for a covariance of the six waves."""
_TURN_FLOOR_NM: Final = 1e-2
_PART_S: Final = 1.0
"""The slow part is removed from pieces of this length."""


def fit_turn(runs: Sequence[PathResiduals]) -> Turn | None:
    """Return what runs have in common over the motor's turn, and how far they differ; None for too few runs."""
    constant, loss, viscous, quadratic = (tuple(map(float, part)) for part in _common_waves(runs))
    found = Turn(constant, loss, viscous, quadratic, _lower(np.eye(TURN_WAVES)), limit=1.0)
    each = [waves for waves in (_turn_waves(found, run)[0] for run in runs) if len(waves)]
    if len(each) < _FEWEST_RUNS:
        return None
    residual = np.concatenate(each)
    covariance = residual.T @ residual / len(residual) + _TURN_FLOOR_NM**2 * np.eye(TURN_WAVES)
    found = replace(found, covariance_nm2=_lower(covariance))
    largest = max(float(_turn_waves(found, run)[1].max(initial=0.0)) for run in runs)
    return replace(found, limit=TURN_BEYOND * largest)


def _turn_waves(turn: Turn, run: PathResiduals) -> tuple[FloatArray, FloatArray]:
    return turn_waves(turn, run.dt_s, run.apart_nm, run.direction, run.velocity_rad_s, run.loss_nm, run.turn)


def _lower(matrix: FloatArray) -> tuple[float, ...]:
    return tuple(map(float, matrix[np.tril_indices(len(matrix))]))


def _common_waves(runs: Sequence[PathResiduals]) -> FloatArray:
    """Return the parts [4, 6] of the waves that all runs have: constant, by loss, by speed, by its square."""
    products: FloatArray = np.zeros(4 * TURN_WAVES)
    squares: FloatArray = np.zeros((4 * TURN_WAVES, 4 * TURN_WAVES))
    for run in runs:
        turning = (np.abs(run.velocity_rad_s) > TURNING_RAD_S) & (np.abs(run.direction) > ONE_WAY)
        keep = np.flatnonzero(turning)[::EVERY]
        if not len(keep):
            continue
        v, loss, waves = run.velocity_rad_s[keep], run.loss_nm[keep], run.turn[keep]
        columns = np.column_stack([waves * part[:, None] for part in (np.ones_like(v), loss, v, v * v)])
        both = np.column_stack((columns, run.apart_nm[keep]))
        slow = np.column_stack((np.ones_like(v), run.direction[keep], v, loss))
        count = max(1, round(float(run.dt_s[keep].sum()) * EVERY / _PART_S))
        for at in np.array_split(np.arange(len(keep)), count):
            rest = both[at] - slow[at] @ np.linalg.lstsq(slow[at], both[at], rcond=None)[0]
            squares += rest[:, :-1].T @ rest[:, :-1]
            products += rest[:, :-1].T @ rest[:, -1]
    return np.asarray(np.linalg.lstsq(squares, products, rcond=None)[0], np.float64).reshape(4, TURN_WAVES)
