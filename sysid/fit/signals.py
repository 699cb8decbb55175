"""Signals of a run for the fits of the fused estimator: the observer's outputs beside the sensor of the same age."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.estimator.joint import Joint, Torsion
from jtqd.estimator.observer import RIPPLE_ORDERS, first_order_hold
from jtqd.estimator.run import JointColumns
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.status import STANDSTILL, VALID
from jtqd.estimator.whole_run import ObservedRun, observe_run

UNIT_TORSION: Final = Torsion(1.0, 0.0, 0.0, tuple(map(float, RIPPLE_ORDERS)), (0.0, 0.0), (0.0, 0.0))
"""With it the observer's torsion torque is the filtered torsion angle theta_m/G - theta_l itself [rad]."""

_SETTLE_S: Final = 0.1
"""From each start of the observer on for so long the filters' starts are still in the data."""

_COLUMNS: Final = (
    "current_a",
    "motor_position_rad",
    "motor_velocity_rad_s",
    "link_position_rad",
    "torque_nm",
)


@dataclass(frozen=True)
class RunSignals:
    """One joint of one run, at the estimator's age; arrays [n].

    name: of the run, the unit of every split; seen: outputs of the observer, with `torsion_nm` the filtered torsion
    angle [rad]; sensor_nm: torque sensor through the estimator's filter; moving: status valid and settled;
    standing: status standstill.
    """

    name: str
    seen: ObservedRun
    sensor_nm: FloatArray
    moving: BoolArray
    standing: BoolArray

    @property
    def temperature_c(self) -> float:
        """Mean temperature of the run; NaN where the run has none."""
        known = self.seen.temperature_c[np.isfinite(self.seen.temperature_c)]
        return float(known.mean()) if len(known) else float("nan")


def same_age(sensor_nm: FloatArray, dt_s: FloatArray, bandwidth_rad_s: float) -> FloatArray:
    """Return the sensor through g/(s+g), first-order hold with the measured steps: as old as the estimate.

    sensor_nm, dt_s [n], n > 0; steps are taken to 0.1 us, a step <= 0 passes its sample on unfiltered.
    """
    steps, index = np.unique(np.round(dt_s[1:], 7), return_inverse=True)
    table = [
        first_order_hold(bandwidth_rad_s, float(step)) if step > 0 else (0.0, 1.0, 0.0) for step in steps
    ]
    out = np.empty_like(sensor_nm)
    z = last = float(sensor_nm[0])
    out[0] = z
    for k, (x, n) in enumerate(zip(sensor_nm[1:].tolist(), index.tolist(), strict=True), 1):
        a, b0, b1 = table[n]
        z = a * z + b0 * x + b1 * last
        last = x
        out[k] = z
    return out


def run_signals(
    name: str, joint: Joint, settings: EstimatorSettings, time_s: FloatArray, columns: JointColumns
) -> RunSignals:
    """Observe one joint of a run. Raises ValueError for a column that is missing or a sensor with NaN."""
    needed = {key: getattr(columns, key) for key in _COLUMNS}
    missing = [key for key, column in needed.items() if column is None]
    if missing:
        raise ValueError(f"{name}: joint {joint.name}: the run has no {', '.join(missing)}")
    current, motor, velocity, link, torque = needed.values()
    sensor = np.asarray(torque, np.float64)
    gaps = int((~np.isfinite(sensor)).sum())
    if gaps:
        raise ValueError(f"{name}: joint {joint.name}: torque_nm: found {gaps} gaps, expected finite numbers")
    dt = np.diff(time_s, prepend=time_s[0])
    seen = observe_run(
        joint, settings, UNIT_TORSION, dt, current, motor, velocity, link, columns.temperature_c
    )
    running = (seen.status == VALID) | (seen.status == STANDSTILL)
    started = np.maximum.accumulate(np.where(running, time_s[0], time_s))
    settled = time_s - started >= _SETTLE_S
    return RunSignals(
        name,
        seen,
        same_age(sensor, dt, settings.bandwidth_rad_s),
        settled & (seen.status == VALID),
        settled & (seen.status == STANDSTILL),
    )
