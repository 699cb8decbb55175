"""Signals of one joint in one run, as fits of the fused estimator need them: outputs of the observer beside the teacher.

The teacher is the torque that a fit learns from: a torque sensor, a known load, or the known part of a load on an unknown
arm, which `few_runs.py` completes. What is called sensor in the fits is the teacher.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
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
from jtqd.sysid.runs.column_map import SHARP, motion_of
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
    arm [n, 3]: what the teacher lacks of a load on an unknown arm: sin, cos, d2/dt2 of the link's angle; None: nothing.
    teacher_nm: standard deviation of the teacher [Nm]; None: 0.
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
    arm: FloatArray | None = None
    teacher_nm: FloatArray | None = None

    @property
    def filtered_arm(self) -> FloatArray:
        """`arm` [n, 3] through the estimator's filter; zeros where nothing is missing."""
        if self.arm is None:
            return np.zeros((len(self.sensor_nm), 3))
        return np.column_stack([low_pass(part, self.seen.dt_s, self.bandwidth_rad_s) for part in self.arm.T])

    def waves(self, angle_rad: FloatArray, order: float) -> FloatArray:
        """Return cos and sin [n, 2] of a multiple of an angle [n], through the estimator's filter."""
        parts = (np.cos(order * angle_rad), np.sin(order * angle_rad))
        return np.column_stack([low_pass(part, self.seen.dt_s, self.bandwidth_rad_s) for part in parts])

    @property
    def temperature_c(self) -> float:
        """Mean temperature of the run; NaN where the run has none."""
        known = self.seen.temperature_c[np.isfinite(self.seen.temperature_c)]
        return float(known.mean()) if len(known) else float("nan")


def run_signals(  # noqa: PLR0917
    name: str,
    joint: Joint,
    settings: EstimatorSettings,
    time_s: FloatArray,
    columns: JointColumns,
    known_part_nm: FloatArray | None = None,
) -> RunSignals:
    """Observe one joint of a run; known_part_nm [n]: the teacher, on an unknown arm.

    Raises ValueError for a missing column or a sensor with NaN.
    """
    if known_part_nm is not None:
        columns = replace(columns, torque_nm=known_part_nm)
    needed = {key: getattr(columns, key) for key in _COLUMNS}
    missing = [key for key, column in needed.items() if column is None]
    if missing:
        raise ValueError(f"{name}: joint {joint.name}: the run has no {', '.join(missing)}")
    current, motor, velocity, link, sensor = (np.asarray(column, np.float64) for column in needed.values())
    gaps = int((~np.isfinite(sensor)).sum())
    if gaps:
        raise ValueError(f"{name}: joint {joint.name}: torque_nm: found {gaps} gaps, expected finite numbers")
    arm = None
    if known_part_nm is not None:
        arm = np.column_stack((np.sin(link), np.cos(link), motion_of(time_s, link, SHARP)[1]))
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
        arm,
    )


def signals_of_runs(runs: Sequence[RunFile], number: int, joint: Joint) -> list[RunSignals]:
    """Return the signals of one joint in all runs, with a progress bar on a terminal."""
    settings, ratio = EstimatorSettings(method="fused"), joint.gear_ratio
    signals = []
    for run in progress(runs, f"observing {joint.name}"):
        table, part = run.table, run.known_parts.get(number)
        signals.append(run_signals(run.name, joint, settings, table.time_s, table.joint(number, ratio), part))
    return signals


def two_encoders(runs: Sequence[RunFile], number: int, joint: Joint) -> bool:
    """Return whether the runs have both encoders of a joint. Raises RunTableError where only some have."""
    without = [run.name for run in runs if not run.table.joints[number].two_encoders(joint.gear_ratio)]
    if without and len(without) < len(runs):
        raise RunTableError(
            f"{without[0]}: j{number}: found one position, other runs have both, expected both in all runs or in none"
        )
    return not without
