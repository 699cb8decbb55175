"""Fit section `fused.zeros` of a joint file: how far the link encoder's zero differs from day to day.

    spread_nm^2 = variance of the torsion's run means - reference^2        on runs that the fit had not seen
    spread_rad  = spread_nm over the mean stiffness of the spring

    correlation_s = long-run variance / assumed, of what a day's states leave of the difference of the paths

The mean error of a run is its zero and the sensor's; reference^2 is the sensor's (`sysid/fit/fused.py`). The long-run
variance is that of means over WINDOW_S, times WINDOW_S, after least squares with the states of `zeros.pyx` in each run;
assumed is that of both paths, less that of the zero. The same runs are then estimated as in service, each from its start:
zeros tracked, what is known of them taken off value and sigma. The section is written where that takes at least WORTH off
the mean square error; `sysid/fit/calibration.py` sets its scale.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.fusion import Fusion
from jtqd.estimator.joint import DayZeros, Fused, FusedSigma
from jtqd.estimator.zeros import CORRELATION_S, MOVING_RAD_S, ONE_WAY
from jtqd.sysid.fit.residuals import PathResiduals
from jtqd.sysid.fit.served import served

WORTH: Final = 0.05
"""Part of the mean square error on runs left out that the learned zeros must take away to be believed."""
_MOST: Final = 0.9
"""Of the torsion's variance: the rest is never the day's zero."""
WINDOW_S: Final = 0.5
"""Longer than ripple and encoders' errors last; a run has to have two windows for each state."""
_SHORTEST_S: Final = 1e-3
"""A sample at 1 kHz."""
_FEWEST: Final = 8
"""Runs, of a day each, from which a spread of days can be told."""


def fit_zeros(runs: Sequence[PathResiduals], fused: Fused, rated_nm: float) -> DayZeros | None:
    """Return the section of runs left out, scale 1; None where it is not worth it, or for too few runs."""
    if len(runs) < _FEWEST or not all(len(run.dt_s) for run in runs):
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
