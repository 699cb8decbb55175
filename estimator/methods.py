"""The estimator of a joint by its method: one door for the loop, one for whole runs."""

from __future__ import annotations

import numpy as np

from estimator.checked import ConfigError
from estimator.friction import FloatArray
from estimator.fused_estimator import FusedEstimator
from estimator.fused_network import FusedNetwork
from estimator.fused_run import estimate_observed, observe_run
from estimator.joint_estimator import JointEstimator
from estimator.network import TorqueNetwork
from estimator.parameters import Joint
from estimator.run import JointColumns
from estimator.settings import EstimatorSettings
from estimator.whole_run import EstimateRun, estimate_run

AnyEstimator = JointEstimator | FusedEstimator
AnyNetwork = TorqueNetwork | FusedNetwork


def load_network(method: str, source: bytes | str, sha256: str | None = None) -> AnyNetwork:
    """Return the network of a method from a file or bytes. Raises NetworkError."""
    return FusedNetwork(source, sha256) if method == "fused" else TorqueNetwork(source, sha256)


def make_estimator(
    joint: Joint, settings: EstimatorSettings, network: AnyNetwork | None = None
) -> AnyEstimator:
    """Return the step-by-step estimator of a joint. Raises ConfigError when joint, method and network do not fit."""
    if settings.method == "fused":
        if isinstance(network, TorqueNetwork):
            raise ConfigError(f"joint {joint.name}: found a network of method 'network', expected one of 'fused'")
        return FusedEstimator(joint, settings, network)
    if isinstance(network, FusedNetwork):
        raise ConfigError(f"joint {joint.name}: found a network of method 'fused', expected one of 'network'")
    return JointEstimator(joint, settings, network)


def estimate_columns(
    joint: Joint,
    settings: EstimatorSettings,
    network: AnyNetwork | None,
    time_s: FloatArray,
    columns: JointColumns,
) -> EstimateRun:
    """Return the estimates of one joint of a run table; raises ConfigError, and ValueError for a missing column."""
    dt = np.diff(time_s, prepend=time_s[0])
    needed = {
        name: getattr(columns, name)
        for name in ("current_a", "motor_position_rad", "motor_velocity_rad_s", "link_position_rad")
    }
    missing = [name for name, column in needed.items() if column is None]
    if missing:
        raise ValueError(f"joint {joint.name}: the run has no {', '.join(missing)}")
    if settings.method == "fused":
        if isinstance(network, TorqueNetwork):
            raise ConfigError(f"joint {joint.name}: found a network of method 'network', expected one of 'fused'")
        torsion = None if joint.fused is None else joint.fused.torsion
        seen = observe_run(joint, settings, torsion, dt, *needed.values(), columns.temperature_c)
        return estimate_observed(joint, settings, network, seen)
    if isinstance(network, FusedNetwork):
        raise ConfigError(f"joint {joint.name}: found a network of method 'fused', expected one of 'network'")
    return estimate_run(joint, settings, network, dt, *needed.values())
