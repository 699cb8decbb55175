from typing import Final

from jtqd.estimator.joint import Joint
from jtqd.estimator.settings import PlausibilityLimits

FORGET_S: Final = 1.0
JUMP_RAD_S: Final = 300.0
LAG_S: Final = 0.05
FROZEN_RAD: Final = 5.0
LONGEST_STEP_S: Final = 0.05

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
