from typing import Final

from jtqd.estimator.arrays import CodeArray, FloatArray
from jtqd.estimator.joint import Joint
from jtqd.estimator.settings import PlausibilityLimits

FROZEN_RAD: Final[float]

class Plausibility:
    mismatch_rad: float
    def __init__(
        self, joint: Joint, torque_limit: float, limits: PlausibilityLimits, period_s: float = 0.001
    ) -> None: ...
    def reset(self) -> None: ...
    def step(
        self,
        dt_s: float,
        motor_position_rad: float,
        motor_velocity_rad_s: float,
        link_position_rad: float,
        current_a: float,
    ) -> int: ...

def detect_contacts(
    external_nm: FloatArray, motor_position_rad: FloatArray, threshold_nm: float, period_s: float = 0.001
) -> tuple[FloatArray, CodeArray]: ...
