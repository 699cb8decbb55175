"""Error of the estimate against the torque sensor: as jtqd published it, from its logs, or offline from run tables."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from daemon.logs.reader import LogError, read_topics
from estimator.friction import FloatArray
from estimator.methods import estimate_columns
from estimator.parameters import Joint
from estimator.run import RunTable
from estimator.settings import EstimatorSettings
from estimator.status import VALID
from sysid.friction_fit import low_pass
from sysid.measured_bus_score import published_torque, reference_torque, sync_time

_DRIVE_ON: Final = 0x27
_DRIVE_MASK: Final = 0x6F


def log_rmse(logs: Sequence[Path], number: int, settings: EstimatorSettings) -> float:
    """Return the RMSE [Nm] of what joint `number` published in all logs while its drive was on and the joint moved.

    The sensor is filtered like the estimate. A joint that stands has an interval and no value, so it is not judged.
    Raises LogError.
    """
    return _rms([_log_errors(log, number, settings.bandwidth_rad_s) for log in logs], f"{number}")


def table_rmse(tables: Sequence[RunTable], number: int, joint: Joint, settings: EstimatorSettings) -> float:
    """Return the same of the whole-run estimate of run tables. Raises LogError."""
    errors = []
    for table in tables:
        columns = table.joint(number, joint.gear_ratio)
        result = estimate_columns(joint, settings, None, table.time_s, columns)
        assert columns.torque_nm is not None
        steps = np.diff(table.time_s, prepend=table.time_s[0])
        error = result.torque_nm - low_pass(columns.torque_nm, steps, settings.bandwidth_rad_s)
        errors.append(error[(result.status == VALID) & np.isfinite(error)])
    return _rms(errors, f"{number}")


def _rms(errors: Sequence[FloatArray], joint: str) -> float:
    whole = np.concatenate(errors) if errors else np.empty(0)
    if not len(whole):
        raise LogError(f"joint {joint}: found no estimate in motion, expected some")
    return float(np.sqrt(np.mean(np.square(whole))))


def _log_errors(log: Path, number: int, bandwidth_rad_s: float) -> FloatArray:
    state, frames = read_topics(log, (f"/joint/{number}/state", "/can/frames")).values()
    if not np.array_equal(state["cycle"], frames["cycle"]):
        raise LogError(f"{log}: found cycles in one topic that are not in the other, expected the same")
    sensor = reference_torque(state, sync_time(state["header"]["stamp"]), bandwidth_rad_s)
    error = published_torque(frames, number - 1) - sensor
    on = (state["statusword"] & _DRIVE_MASK) == _DRIVE_ON
    return np.asarray(error[on & (state["status"] == VALID) & np.isfinite(error)], np.float64)
