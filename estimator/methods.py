"""Estimator of a joint by method: `make_estimator` for samples one by one, `estimate_columns` for whole runs.

Effects of the joint file are applied here, whatever the method: the estimators themselves take plain joints only.
"""

from __future__ import annotations

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.checked import ConfigError
from jtqd.estimator.corrections import acting_effects, needs_torque, plain_joint
from jtqd.estimator.estimator import (
    ExtendedEstimator,
    FusedEstimator,
    JointEstimator,
    checked_fused,
    corrected_by_steps,
)
from jtqd.estimator.joint import Joint
from jtqd.estimator.network import FusedNetwork, TorqueNetwork
from jtqd.estimator.run import JointColumns
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.whole_run import EstimateRun, estimate_observed, estimate_run, extended_run, observe_run

AnyEstimator = JointEstimator | FusedEstimator | ExtendedEstimator
AnyNetwork = TorqueNetwork | FusedNetwork
_Inputs = tuple[FloatArray, FloatArray, FloatArray, FloatArray]


def load_network(method: str, source: bytes | str, sha256: str | None = None) -> AnyNetwork:
    """Return the network of a method from a file or bytes. Raises NetworkError."""
    return FusedNetwork(source, sha256) if method == "fused" else TorqueNetwork(source, sha256)


def make_estimator(
    joint: Joint, settings: EstimatorSettings, network: AnyNetwork | None = None
) -> AnyEstimator:
    """Return the step-by-step estimator of a joint. Raises ConfigError when joint, method and network do not fit."""
    plain = plain_joint(joint)
    inner: JointEstimator | FusedEstimator
    if settings.method == "fused":
        inner = FusedEstimator(plain, settings, _fused(plain, network))
    else:
        inner = JointEstimator(plain, settings, _paper(plain, network))
    return ExtendedEstimator(joint, settings, inner) if acting_effects(joint) else inner


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
    return estimate_steps(joint, settings, network, np.diff(time_s, prepend=time_s[0]), columns)


def estimate_steps(
    joint: Joint,
    settings: EstimatorSettings,
    network: AnyNetwork | None,
    dt_s: FloatArray,
    columns: JointColumns,
) -> EstimateRun:
    """Return the estimates as `estimate_columns`, by time steps: dt_s[k] is the time since sample k-1, 0 starts again."""
    inputs = _corrected(joint, settings, network, dt_s, columns)
    joint = plain_joint(joint)
    if settings.method == "fused":
        used = _fused(joint, network)
        torsion = checked_fused(joint, settings, used).torsion
        observed = observe_run(joint, settings, torsion, dt_s, *inputs, columns.temperature_c)
        return estimate_observed(joint, settings, used, observed)
    return estimate_run(joint, settings, _paper(joint, network), dt_s, *inputs)


def _corrected(
    joint: Joint,
    settings: EstimatorSettings,
    network: AnyNetwork | None,
    dt_s: FloatArray,
    columns: JointColumns,
) -> _Inputs:
    """Return the inputs of the plain joint's estimator; ValueError for a missing column."""
    inputs = _inputs(joint, columns)
    if not acting_effects(joint):
        return inputs
    if needs_torque(joint):
        estimator = make_estimator(joint, settings, network)
        assert isinstance(estimator, ExtendedEstimator)
        current, link = corrected_by_steps(estimator, dt_s, inputs, columns.temperature_c)
    else:
        current, link = extended_run(joint, settings, dt_s, *inputs, columns.temperature_c)
    return current, inputs[1], inputs[2], link


def _inputs(joint: Joint, columns: JointColumns) -> _Inputs:
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


def _fused(joint: Joint, network: AnyNetwork | None) -> FusedNetwork | None:
    """Return the network if method `fused` can use it; ConfigError else."""
    if isinstance(network, TorqueNetwork):
        raise ConfigError(f"joint {joint.name}: found a network of method 'network', expected one of 'fused'")
    return network


def _paper(joint: Joint, network: AnyNetwork | None) -> TorqueNetwork | None:
    """Return the network if the paper's methods can use it; ConfigError else."""
    if isinstance(network, FusedNetwork):
        raise ConfigError(f"joint {joint.name}: found a network of method 'fused', expected one of 'network'")
    return network
