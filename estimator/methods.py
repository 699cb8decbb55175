"""Estimator of a joint by method: `make_estimator` for samples one by one, `estimate_columns` for whole runs.

Effects of the joint file are applied here, whatever the method: the estimators themselves take plain joints only.
"""

from __future__ import annotations

import numpy as np

from jtqd.estimator import estimator
from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.corrections import acting_effects, plain_joint
from jtqd.estimator.joint import Joint
from jtqd.estimator.network import FusedNetwork, TorqueNetwork
from jtqd.estimator.run import EstimateRun, JointColumns
from jtqd.estimator.sample import Estimator
from jtqd.estimator.settings import METHODS, EstimatorSettings

AnyEstimator = Estimator
AnyNetwork = TorqueNetwork | FusedNetwork


def make_estimator(
    joint: Joint, settings: EstimatorSettings, network: AnyNetwork | None = None
) -> AnyEstimator:
    """Return the estimator of a joint. Raises ConfigError when joint, method and network do not fit."""
    plain = plain_joint(joint)
    inner = getattr(estimator, METHODS[settings.method].estimator)(plain, settings, network)
    return estimator.ExtendedEstimator(joint, settings, inner) if acting_effects(joint) else inner


def estimate_columns(
    joint: Joint,
    settings: EstimatorSettings,
    network: AnyNetwork | None,
    time_s: FloatArray,
    columns: JointColumns,
) -> EstimateRun:
    """Return the estimates of one joint of a run table, time_s [n].

    Raises ConfigError as `make_estimator` does, ValueError for a missing column.
    """
    current, motor, velocity, link = _inputs(joint, columns)
    dt_s = np.diff(time_s, prepend=time_s[0])
    return make_estimator(joint, settings, network).run(
        dt_s, current, motor, velocity, link, columns.temperature_c
    )


def _inputs(joint: Joint, columns: JointColumns) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return current, motor position, motor velocity and link position; ValueError for a missing column."""
    needed = {
        name: getattr(columns, name)
        for name in ("current_a", "motor_position_rad", "motor_velocity_rad_s", "link_position_rad")
    }
    missing = [name for name, column in needed.items() if column is None]
    if missing:
        raise ValueError(f"joint {joint.name}: the run has no {', '.join(missing)}")
    current, motor, velocity, link = needed.values()
    return current, motor, velocity, link
