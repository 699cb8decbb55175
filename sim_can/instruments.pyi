from typing import Any

from jtqd.sim_can.drive_file import SensorParameters
from jtqd.sim_can.plant import Plant
from jtqd.sim_can.plant_file import JointPlant, PlantParameters
from jtqd.sim_can.signals import ChannelSignal, DriveSignals, Noise

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

class Instruments:
    encoders: tuple[Encoders, Encoders]
    drives: tuple[DriveSignals, DriveSignals]
    sensor: TorqueSensor
    channel: ChannelSignal
    def begin_day(self, day: Any) -> None: ...
    def __init__(self, parameters: PlantParameters, noise: Noise) -> None: ...
    def read(
        self,
        plant: Plant,
        dt_s: float,
        torque_nm: float,
        errors: tuple[tuple[float, float, float], tuple[float, float, float]] | None,
    ) -> None: ...
