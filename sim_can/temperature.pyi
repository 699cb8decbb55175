from typing import Final

from jtqd.sim_can.days import Thermal

UPDATE_S: Final[float]

class JointTemperature:
    celsius: float
    viscous: float
    coulomb: float
    def __init__(self, thermal: Thermal) -> None: ...
    def start(self, difference_k: float) -> None: ...
    def add(self, power_w: float, dt_s: float) -> bool: ...
