"""Signals of a run for the fits of the fused estimator: the observer's outputs beside the sensor of the same age."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.estimator.estimator import observe_run
from jtqd.estimator.joint import Joint, Torsion
from jtqd.estimator.observer import RIPPLE_ORDERS, low_pass
from jtqd.estimator.run import JointColumns, ObservedRun
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.status import STANDSTILL, VALID

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


class AsRead(NamedTuple):
    """What no filter of ours has passed [n]: torsion angle of both encoders [rad], sensor [Nm], motor's speed [rad/s]."""

    torsion_rad: FloatArray
    sensor_nm: FloatArray
    motor_velocity_rad_s: FloatArray


@dataclass(frozen=True)
class RunSignals:
    """One joint of one run, at the estimator's age; arrays [n].

    name: of the run, the unit of every split; seen: outputs of the observer, with `torsion_nm` the filtered torsion
    angle [rad]; sensor_nm: torque sensor through the estimator's filter; moving: status valid and settled;
    standing: status standstill; positions: of the encoders as read, None where they are not known; as_read: what is needed
    for an estimate of now, None where it is not known.
    """

    name: str
    seen: ObservedRun
    sensor_nm: FloatArray
    moving: BoolArray
    standing: BoolArray
    motor_position_rad: FloatArray | None = None
    link_position_rad: FloatArray | None = None
    bandwidth_rad_s: float = EstimatorSettings().bandwidth_rad_s
    as_read: AsRead | None = None

    def waves(self, angle_rad: FloatArray, order: float) -> FloatArray:
        """Return cos and sin [n, 2] of a multiple of an angle [n], through the estimator's filter."""
        parts = (np.cos(order * angle_rad), np.sin(order * angle_rad))
        return np.column_stack([low_pass(part, self.seen.dt_s, self.bandwidth_rad_s) for part in parts])

    @property
    def temperature_c(self) -> float:
        """Mean temperature of the run; NaN where the run has none."""
        known = self.seen.temperature_c[np.isfinite(self.seen.temperature_c)]
        return float(known.mean()) if len(known) else float("nan")


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
        low_pass(sensor, dt, settings.bandwidth_rad_s),
        settled & (seen.status == VALID),
        settled & (seen.status == STANDSTILL),
        np.asarray(motor, np.float64),
        np.asarray(link, np.float64),
        settings.bandwidth_rad_s,
        AsRead(
            np.asarray(motor, np.float64) / joint.gear_ratio - link, sensor, np.asarray(velocity, np.float64)
        ),
    )
