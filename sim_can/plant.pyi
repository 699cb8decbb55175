from collections.abc import Callable
from typing import Final

from jtqd.sim_can.drives import TwoJoints
from jtqd.sim_can.plant_file import JointConstants, JointPlant, PlantParameters, Thermal

UPDATE_S: Final[float]

class JointTemperature:
    celsius: float
    viscous: float
    coulomb: float
    def __init__(self, thermal: Thermal) -> None: ...
    def start(self, difference_k: float) -> None: ...
    def add(self, power_w: float, dt_s: float) -> bool: ...

LOWEST_TABLE_VELOCITY_RAD_S: Final[float]
VELOCITY_STEP_RAD_S: Final[float]
HIGHEST_TABLE_VELOCITY_RAD_S: Final[float]
TORQUE_STEPS: Final[int]

class LossTable:
    torque_limit: float
    per_torque_step: float
    per_velocity_step: float
    last_row: int
    forward: memoryview
    reverse: memoryview
    def __init__(
        self,
        loss: Callable[[float, float], float],
        gear_ratio: float,
        torque_constant_nm_per_a: float,
        highest_current_a: float,
    ) -> None: ...
    def magnitude(self, torque_nm: float, velocity_rad_s: float) -> float: ...

class JointFriction:
    def __init__(
        self,
        table: LossTable,
        scale: float = 1.0,
        viscous_nms_per_rad: float = 0.0,
        stribeck_nm: float = 0.0,
        stribeck_velocity_rad_s: float = 0.05,
    ) -> None: ...
    def differ(self, constant_nm: float, viscous_nms_per_rad: float) -> None: ...
    def __call__(self, torque_nm: float, velocity_rad_s: float) -> float: ...

def relaxed_angle(constants: JointConstants, bend_rad: Callable[[float], float] | None = None) -> float: ...
def loss_table(side: JointPlant) -> LossTable: ...
def joint_friction(side: JointPlant, table: LossTable | None = None) -> JointFriction: ...

class Plant(TwoJoints):
    parameters: PlantParameters
    friction: tuple[JointFriction, JointFriction]
    temperatures: tuple[JointTemperature, JointTemperature]
    motor_position: list[float]
    motor_velocity: list[float]
    slip: list[float]
    loss_w: list[float]
    def __init__(self, parameters: PlantParameters) -> None: ...
