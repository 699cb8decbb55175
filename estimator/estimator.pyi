from math import nan
from typing import Final

from jtqd.estimator.arrays import BoolArray, FloatArray, QuadrantArray
from jtqd.estimator.joint import Joint, Torsion
from jtqd.estimator.network import AnyNetwork, PathNetwork, TorqueNetwork
from jtqd.estimator.run import EstimateRun, JointColumns, ObservedRun
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.status import Estimate, Zeros

STANDSTILL_SIGMAS: Final[float]
SLOPE_NM: Final[float]

def quadrants(raw_nm: FloatArray, velocity_rad_s: FloatArray) -> QuadrantArray: ...

class JointEstimator(Estimator):
    def __init__(
        self, joint: Joint, settings: EstimatorSettings, network: TorqueNetwork | None = None
    ) -> None: ...

class FusedEstimator(Estimator):
    def __init__(
        self, joint: Joint, settings: EstimatorSettings, network: PathNetwork | None = None
    ) -> None: ...
    @property
    def zeros(self) -> Zeros | None: ...
    past: bytes | memoryview
    def shares_past(self, other: FusedEstimator) -> bool: ...

class ExtendedEstimator(Estimator):
    def __init__(self, joint: Joint, settings: EstimatorSettings, inner: Estimator) -> None: ...
    @property
    def inner(self) -> Estimator: ...
    @property
    def zeros(self) -> Zeros | None: ...

def observe_run(
    joint: Joint,
    settings: EstimatorSettings,
    torsion: Torsion | None,
    dt_s: FloatArray,
    current_a: FloatArray,
    motor_position_rad: FloatArray,
    motor_velocity_rad_s: FloatArray,
    link_position_rad: FloatArray,
    temperature_c: FloatArray | None = None,
) -> ObservedRun: ...

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

class PythonEstimator(Estimator):
    inner: Estimator
    def __init__(self, inner: object) -> None: ...

def make_estimator(
    joint: Joint, settings: EstimatorSettings, network: AnyNetwork | None = None
) -> Estimator: ...
def estimate_columns(
    joint: Joint,
    settings: EstimatorSettings,
    network: AnyNetwork | None,
    time_s: FloatArray,
    columns: JointColumns,
) -> EstimateRun: ...
