"""Joint torque from motor current and encoder positions: observer, losses, fusion, network, uncertainty, status.

Samples or run tables in, estimates out, in SI units; no clock, no file but a network's, no socket. Imports onnxruntime
only when a network is loaded, and its own modules when a public name is first used.

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

>>> from jtqd.estimator import make_estimator
>>> estimator = make_estimator(joint, settings)
>>> for t in time_s:
...     estimate = estimator.step(0.001, 3.0, t * joint.gear_ratio, joint.gear_ratio, t)
>>> print(f"{estimate.torque_nm:.2f} Nm, {estimate.status!r}")
10.01 Nm, <Status.VALID: 2>
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jtqd.estimator.errors import ConfigError as ConfigError
    from jtqd.estimator.estimator import estimate_columns as estimate_columns
    from jtqd.estimator.estimator import make_estimator as make_estimator
    from jtqd.estimator.joint import Effect as Effect
    from jtqd.estimator.joint import Joint as Joint
    from jtqd.estimator.network import NetworkError as NetworkError
    from jtqd.estimator.network import load_network as load_network
    from jtqd.estimator.run import EstimateRun as EstimateRun
    from jtqd.estimator.run import JointColumns as JointColumns
    from jtqd.estimator.run import RunTable as RunTable
    from jtqd.estimator.run import RunTableError as RunTableError
    from jtqd.estimator.settings import METHODS as METHODS
    from jtqd.estimator.settings import EstimatorSettings as EstimatorSettings
    from jtqd.estimator.status import Estimate as Estimate
    from jtqd.estimator.status import Status as Status
else:  # each process of the daemon imports this package for a few of its modules
    _NAMES = {
        "errors": ("ConfigError",),
        "estimator": ("estimate_columns", "make_estimator"),
        "joint": ("Effect", "Joint"),
        "network": ("NetworkError", "load_network"),
        "run": ("EstimateRun", "JointColumns", "RunTable", "RunTableError"),
        "settings": ("METHODS", "EstimatorSettings"),
        "status": ("Estimate", "Status"),
    }
    _MODULES = {name: module for module, names in _NAMES.items() for name in names}
    __all__ = list(_MODULES)

    def __getattr__(name):
        """Import a public name from its module at its first use."""
        if name not in _MODULES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        value = getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
        globals()[name] = value
        return value
