from math import nan

from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.estimator.joint import Joint
from jtqd.estimator.run import EstimateRun
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.status import Estimate

class Estimator:
    joint: Joint
    settings: EstimatorSettings

    @property
    def with_network(self) -> bool: ...
    def reset(self) -> None: ...
    def step(
        self,
        dt_s: float,
        current_a: float,
        motor_position_rad: float,
        motor_velocity_rad_s: float,
        link_position_rad: float,
        temperature_c: float = nan,
        network_wanted: bool = True,
    ) -> Estimate: ...
    def run(
        self,
        dt_s: FloatArray,
        current_a: FloatArray,
        motor_position_rad: FloatArray,
        motor_velocity_rad_s: FloatArray,
        link_position_rad: FloatArray,
        temperature_c: FloatArray | None = None,
        network_wanted: BoolArray | None = None,
    ) -> EstimateRun: ...

def columns(*arrays: FloatArray | None) -> FloatArray: ...

class PythonEstimator(Estimator):
    inner: Estimator
    def __init__(self, inner: object) -> None: ...
