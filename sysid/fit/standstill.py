"""Fit section `fused.standstill` of a joint file: how wide the interval of a standing joint is.

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
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from scipy.special import chdtri, ndtri, stdtrit

from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.estimator.joint import Standstill, Torsion
from jtqd.estimator.observer import low_pass
from jtqd.estimator.settings import TORSION_BANDWIDTH_RAD_S
from jtqd.sysid.fit.conformal import COVERAGE, FEWEST, quantile_by_runs
from jtqd.sysid.fit.signals import RunSignals

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
