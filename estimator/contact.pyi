from typing import Final

from jtqd.estimator.arrays import CodeArray, FloatArray
from jtqd.estimator.joint import Joint
from jtqd.estimator.settings import EstimatorSettings

TREND_RAD_S: Final[float]
NOTCH_RAD_S: Final[float]
RELEASE: Final[float]
ALONE: Final[float]
LONGEST_S: Final[float]
BLIND: Final[int]
MEANT: Final[int]
SETTLE_S: Final[float]
UNEVEN: Final[float]
LONGEST_GAP: Final[int]
OFF: int
UNKNOWN: int
NONE: int
CONTACT: int

class ContactDetector:
    def __init__(self, threshold_nm: float, period_s: float = 0.001) -> None: ...
    @property
    def residual_nm(self) -> float: ...
    @property
    def told(self) -> int: ...
    def step(self, outside_nm: float, motor_position_rad: float) -> int: ...
    def run(self, outside_nm: FloatArray, motor_position_rad: FloatArray) -> tuple[FloatArray, CodeArray]: ...

def link_loads(
    joint: Joint,
    settings: EstimatorSettings,
    dt_s: FloatArray,
    current_a: FloatArray,
    motor_position_rad: FloatArray,
    motor_velocity_rad_s: FloatArray,
    link_position_rad: FloatArray,
) -> tuple[FloatArray, FloatArray]: ...
