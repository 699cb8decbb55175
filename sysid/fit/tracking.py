"""Fit section `fused.tracking` of a joint file: what an estimate of now errs by beyond one as old as the motor path.

    sigma now^2 = sigma^2 + a^2 + (b v)^2/(1 + (v/s)^2)

sigma: of an estimate as old as the motor path, whose error is e; a, b, s: least squares of e_now^2 - e^2 over runs that the
fit had not seen. Of a wave over the motor's turn that the filter does not carry it misses all from some speed on, and no
more: a part that grows without end is too wide at rest and too narrow at the speeds of work. The sensor is taken as it is:
what it is older than the encoders is in a and b. That the interval of both together holds is up to the scale of sigma, found
after (`sysid/fit/calibration.py`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from scipy.optimize import nnls

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import Tracking

TRACKING_RAD_S: Final = 400.0
WAVE_RAD_S: Final = 160.0
"""Rates of the torsion's tracking filter: at rest no noisier than a low pass of 800 rad/s; chosen from a table,
docs/estimator.md."""


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
