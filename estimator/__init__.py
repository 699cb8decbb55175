"""Joint torque from motor current and encoder positions: observer, losses, fusion, network, uncertainty, status.

Samples or run tables in, estimates out, in SI units; no clock, no file but a network's, no socket. Imports numpy and
itself; onnxruntime only when a network is loaded. The public names are imported when they are first used.

The torque of a joint that turns at 1 rad/s with 3 A, from arrays:

>>> import numpy as np
>>> from jtqd.estimator import EstimatorSettings, JointColumns, RunTable, estimate_columns
>>> from jtqd.models.files import load_joint, shipped
>>> joint = load_joint(shipped("joint1.yaml"))
>>> time_s = np.arange(200) * 0.001
>>> columns = JointColumns(current_a=np.full(200, 3.0), link_position_rad=1.0 * time_s)
>>> run = RunTable(time_s, {1: columns})
>>> settings = EstimatorSettings(method="efficiency")
>>> result = estimate_columns(joint, settings, None, run.time_s, run.joint(1, joint.gear_ratio))
>>> print(f"{result.torque_nm[-1]:.2f} Nm, standard deviation {result.sigma_nm[-1]:.2f} Nm")
10.01 Nm, standard deviation 0.86 Nm

The same sample by sample, as in a control loop: the first sample starts the observer and publishes nothing.

>>> from jtqd.estimator import make_estimator, status
>>> estimator = make_estimator(joint, settings)
>>> for t in time_s:
...     estimate = estimator.step(0.001, 3.0, t * joint.gear_ratio, joint.gear_ratio, t)
>>> print(f"{estimate.torque_nm:.2f} Nm, {status.NAMES[estimate.status]}")
10.01 Nm, valid
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jtqd.estimator.errors import ConfigError
    from jtqd.estimator.joint import Effect, Joint
    from jtqd.estimator.methods import estimate_columns, make_estimator
    from jtqd.estimator.network import load_network
    from jtqd.estimator.onnx_graph import NetworkError
    from jtqd.estimator.run import EstimateRun, JointColumns, RunTable, RunTableError
    from jtqd.estimator.settings import METHODS, EstimatorSettings
    from jtqd.estimator.status import Estimate

__all__ = [
    "METHODS",
    "ConfigError",
    "Effect",
    "Estimate",
    "EstimateRun",
    "EstimatorSettings",
    "Joint",
    "JointColumns",
    "NetworkError",
    "RunTable",
    "RunTableError",
    "estimate_columns",
    "load_network",
    "make_estimator",
]

_MODULES = {
    "METHODS": "settings",
    "ConfigError": "checked",
    "Effect": "joint",
    "Estimate": "status",
    "EstimateRun": "run",
    "EstimatorSettings": "settings",
    "Joint": "joint",
    "JointColumns": "run",
    "NetworkError": "onnx_graph",
    "RunTable": "run",
    "RunTableError": "run",
    "estimate_columns": "methods",
    "load_network": "network",
    "make_estimator": "methods",
}

if not TYPE_CHECKING:  # each process of the daemon imports this package for a few of its modules

    def __getattr__(name):
        """Import a public name from its module at its first use."""
        if name not in _MODULES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        value = getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
        globals()[name] = value
        return value
