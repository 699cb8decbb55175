from collections.abc import Callable
from typing import Any, Final

from jtqd.sim_can.source import Day

OFF: Final[int]
VELOCITY: Final[int]
CURRENT: Final[int]
CONTROL_CYCLE_S: Final[float]

class Noise:
    def __init__(self, uniform: Callable[[], float]) -> None: ...

class DriveSignals:
    motor_position_rad: float
    motor_velocity_rad_s: float
    link_position_rad: float
    current_a: float
    temperature_c: float
    enabled: bool

class ChannelSignal:
    torque_nm: float
    valid: bool

class DriveControl:
    mode: int
    target: float
    current_a: float
    integral_a: float
    reference_rad_s: float
    slope_rad_s2: float
    interpolation_s: float
    def __init__(self, side: Any) -> None: ...
    def command(self, mode: int, target: float, motor_velocity_rad_s: float) -> None: ...
    def plan(self, dt_s: float) -> None: ...
    def step(self, h: float, motor_velocity_rad_s: float) -> float: ...

class TwoJoints:
    parameters: Any
    drives: tuple[DriveControl, DriveControl]
    substep_s: float
    link_position: float
    link_velocity: float
    def begin_run(self) -> None: ...
    def begin_day(self, day: Day) -> None: ...
    def command(self, drive: int, mode: int, target: float) -> None: ...
    def push(self, torque_nm: float, after_s: float = 0.0) -> None: ...
    def step(self, dt_s: float) -> None: ...
    def _integrate(self, steps: int, h: float) -> None: ...
    def joint_torques(self) -> tuple[float, float]: ...
    def sensor_torque(self) -> float: ...

class Instruments:
    drives: tuple[DriveSignals, DriveSignals]
    channel: ChannelSignal
    day_zero_nm: float
    def __init__(self, parameters: Any, noise: Noise) -> None: ...
    def begin_day(self, day: Day) -> None: ...
    def read(
        self,
        plant: TwoJoints,
        dt_s: float,
        torque_nm: float,
        errors: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None,
    ) -> None: ...

PERIOD_S: Final[float]
BURSTS: Final[tuple[tuple[float, float, tuple[float, ...]], ...]]
LOADS: Final[tuple[tuple[float, float], ...]]
LOAD_RISE_S: Final[float]

def demo_velocity(time_s: float) -> float: ...
def demo_current(time_s: float) -> float: ...
