"""Fit section `fused.tracking` of a joint file: what an estimate of now errs by beyond one as old as the motor path.

    sigma now^2 = sigma^2 + k^2 (a^2 + (b v)^2)

sigma: calibrated for an estimate as old as the motor path, whose error is e; a, b: least squares of e_now^2 - e^2; k: so
that value +- 1.645 sigma holds the sensor in 90 % of the samples of a run, on average over runs that the fit had not seen.
The sensor is taken as it is: what it is older than the encoders is in a and b.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from scipy.optimize import nnls

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.fusion import GAUSS
from jtqd.estimator.joint import Tracking

TRACKING_RAD_S: Final = 400.0
WAVE_RAD_S: Final = 160.0
"""Rates of the torsion's tracking filter: at rest no noisier than a low pass of 800 rad/s; chosen from a table,
docs/estimator.md."""
COVERAGE: Final = 0.9
_MOST: Final = 4.0
"""Of k."""


def fit_tracking(
    errors: Sequence[FloatArray],
    sigmas: Sequence[FloatArray],
    errors_now: Sequence[FloatArray],
    velocity: Sequence[FloatArray],
) -> Tracking:
    """Return the section of runs left out, one array per run each: e with its calibrated sigma, e_now [Nm], v [rad/s]."""
    more = np.concatenate([now * now - e * e for e, now in zip(errors, errors_now, strict=True)])
    v = np.concatenate(velocity)
    (noise, viscous), _ = nnls(np.column_stack((np.ones_like(v), v * v)), more)

    def covered(k: float) -> float:
        shares = []
        for now, sigma, w in zip(errors_now, sigmas, velocity, strict=True):
            wide = GAUSS * np.sqrt(sigma * sigma + k * k * (noise + viscous * w * w))
            shares.append(float(np.mean(np.abs(now) <= wide)))
        return float(np.mean(shares))

    low, high = 0.0, _MOST
    while high - low > 1e-3:
        k = 0.5 * (low + high)
        low, high = (low, k) if covered(k) >= COVERAGE else (k, high)
    return Tracking(TRACKING_RAD_S, high * float(np.sqrt(noise)), high * float(np.sqrt(viscous)), WAVE_RAD_S)


def worth_it(errors_now: Sequence[FloatArray], errors_low_pass: Sequence[FloatArray]) -> bool:
    """Return whether tracking beats the low pass of new configurations, over runs left out, against the sensor now.

    Means of runs count for nothing: the zeros of a day are in both.
    """

    def square(runs: Sequence[FloatArray]) -> float:
        return float(sum(np.sum((run - run.mean()) ** 2) for run in runs if len(run)))

    return square(errors_now) < square(errors_low_pass)
