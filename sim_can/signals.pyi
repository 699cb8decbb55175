from collections.abc import Callable

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
