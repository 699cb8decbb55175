"""One joint of one run: every method's estimate beside the sensor of the same age, and which samples count. Pure.

Only samples at which all methods move and have a value are scored, the same ones for each: a method must not look better
because it was silent where the others were wrong.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from estimator.friction import FloatArray
from estimator.fused_run import quadrant_many
from estimator.run import JointColumns
from estimator.settings import EstimatorSettings
from estimator.status import DEGRADED, STANDSTILL, VALID
from sysid.evaluate.methods import JointModels
from sysid.run_signals import same_age

SETTLE_S: Final = 0.1
"""From the first sample on for so long the filters' starts are still in the data."""

Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class Samples:
    """Arrays [n] of one joint (`number`) in one run (`run`).

    sensor_nm: torque sensor, filtered like the estimates; raw_nm: G Kt i less the rotor's share, whose sign with the
    velocity's [rad/s, joint side] makes the quadrant (index into QUADRANTS); estimate_nm, sigma_nm, status: by method;
    scored: all methods move and have a value; standing: all have a value and stand still; missing: settled, but some
    method has no value; temperature_c: NaN where the run has none; bare_nm: the paper's network by itself, without the
    guard around it, NaN where there is none.
    """

    run: str
    number: int
    rated_nm: float
    time_s: FloatArray
    sensor_nm: FloatArray
    raw_nm: FloatArray
    velocity_rad_s: FloatArray
    temperature_c: FloatArray
    quadrant: NDArray[np.intp]
    estimate_nm: Mapping[str, FloatArray]
    sigma_nm: Mapping[str, FloatArray]
    status: Mapping[str, NDArray[np.uint8]]
    scored: Flags
    standing: Flags
    missing: Flags
    bare_nm: FloatArray

    def error_nm(self, method: str) -> FloatArray:
        """Estimate less sensor [n] [Nm]."""
        return self.estimate_nm[method] - self.sensor_nm


def take_samples(run: str, models: JointModels, time_s: FloatArray, columns: JointColumns) -> Samples:
    """Estimate one joint of a run by every method.

    columns: all inputs and the sensor [n]; finite (`RunTable` is). Raises ConfigError and ValueError as the estimators.
    """
    runs, seen = models.estimate(time_s, columns)
    if columns.torque_nm is None:
        raise ValueError(f"{run}: j{models.number}.torque_nm: missing")
    dt = np.diff(time_s, prepend=time_s[0])
    sensor = same_age(columns.torque_nm, dt, EstimatorSettings().bandwidth_rad_s)
    settled = time_s - time_s[0] >= SETTLE_S
    published = settled & np.logical_and.reduce([np.isfinite(each.torque_nm) for each in runs.values()])
    moving = np.logical_and.reduce([np.isin(each.status, (VALID, DEGRADED)) for each in runs.values()])
    standing = np.logical_and.reduce([each.status == STANDSTILL for each in runs.values()])
    paper = runs.get("network")
    return Samples(
        run=run,
        number=models.number,
        rated_nm=models.joint.rated_torque_nm,
        time_s=time_s,
        sensor_nm=sensor,
        raw_nm=seen.raw_nm,
        velocity_rad_s=seen.velocity_rad_s,
        temperature_c=seen.temperature_c,
        quadrant=quadrant_many(seen.raw_nm, seen.velocity_rad_s),
        estimate_nm={method: each.torque_nm for method, each in runs.items()},
        sigma_nm={method: each.sigma_nm for method, each in runs.items()},
        status={method: each.status for method, each in runs.items()},
        scored=published & moving,
        standing=published & standing,
        missing=settled & ~published,
        bare_nm=np.full_like(sensor, np.nan) if paper is None else paper.network_nm,
    )
