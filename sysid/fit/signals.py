"""Signals of one joint in one run, as fits of the fused estimator need them: outputs of the observer beside the sensor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.estimator.estimator import observe_run
from jtqd.estimator.joint import Joint, Torsion
from jtqd.estimator.observer import RIPPLE_ORDERS, low_pass
from jtqd.estimator.run import JointColumns, ObservedRun, RunTableError
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.status import STANDSTILL, VALID
from jtqd.sysid.progress import progress
from jtqd.sysid.runs.run_file import RunFile

UNIT_TORSION: Final = Torsion(1.0, 0.0, 0.0, tuple(map(float, RIPPLE_ORDERS)), (0.0, 0.0), (0.0, 0.0))
"""With it the torsion torque of the observer is the filtered torsion angle theta_m/G - theta_l itself [rad]."""

_SETTLE_S: Final = 0.1
"""After each start of the observer its filters settle for so long."""

_COLUMNS: Final = (
    "current_a",
    "motor_position_rad",
    "motor_velocity_rad_s",
    "link_position_rad",
    "torque_nm",
)


@dataclass(frozen=True)
class RunSignals:
    """One joint of one run; arrays [n].

    name: of the run, the unit of every split. moving, standing: status valid, status standstill, settled.
    With the delay of the motor path: seen, outputs of the observer, whose `torsion_nm` is the filtered torsion angle [rad];
    sensor_nm, the torque sensor through the same filter, of bandwidth_rad_s.
    Unfiltered: positions and velocity [rad, rad/s] of the encoders, torsion_rad, theta_m/G - theta_l, raw_sensor_nm.
    """

    name: str
    seen: ObservedRun
    sensor_nm: FloatArray
    moving: BoolArray
    standing: BoolArray
    motor_position_rad: FloatArray
    motor_velocity_rad_s: FloatArray
    link_position_rad: FloatArray
    torsion_rad: FloatArray
    raw_sensor_nm: FloatArray
    bandwidth_rad_s: float = EstimatorSettings().bandwidth_rad_s

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
    """Observe one joint of a run. Raises ValueError for a missing column or a sensor with NaN."""
    needed = {key: getattr(columns, key) for key in _COLUMNS}
    missing = [key for key, column in needed.items() if column is None]
    if missing:
        raise ValueError(f"{name}: joint {joint.name}: the run has no {', '.join(missing)}")
    current, motor, velocity, link, sensor = (np.asarray(column, np.float64) for column in needed.values())
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
        motor,
        velocity,
        link,
        motor / joint.gear_ratio - link,
        sensor,
        settings.bandwidth_rad_s,
    )


def signals_of_runs(runs: Sequence[RunFile], number: int, joint: Joint) -> list[RunSignals]:
    """Return the signals of one joint in all runs, with a progress bar on a terminal."""
    settings = EstimatorSettings(method="fused")
    return [
        run_signals(run.name, joint, settings, run.table.time_s, run.table.joint(number, joint.gear_ratio))
        for run in progress(runs, f"observing {joint.name}")
    ]


def two_encoders(runs: Sequence[RunFile], number: int, joint: Joint) -> bool:
    """Return whether the runs have both encoders of a joint. Raises RunTableError where only some have."""
    without = [run.name for run in runs if not run.table.joints[number].two_encoders(joint.gear_ratio)]
    if without and len(without) < len(runs):
        raise RunTableError(
            f"{without[0]}: j{number}: found one position, other runs have both, expected both in all runs or in none"
        )
    return not without
