from collections.abc import Callable

from jtqd.sim_can.plant_file import JointPlant, SensorParameters
from jtqd.sim_can.signals import ChannelSignal, DriveSignals

class Noise:
    def __init__(self, uniform: Callable[[], float]) -> None: ...

class Encoders:
    link_zero_rad: float
    def __init__(self, side: JointPlant, noise: Noise) -> None: ...
    def sample(
        self, signals: DriveSignals, dt_s: float, motor_rad: float, link_rad: float, current_a: float
    ) -> None: ...

class TorqueSensor:
    offset_nm: float
    def __init__(self, sensor: SensorParameters, noise: Noise) -> None: ...
    def sample(self, signal: ChannelSignal, torque_nm: float) -> None: ...
