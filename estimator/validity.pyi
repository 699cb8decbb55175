from typing import Final

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.envelope import Envelope
from jtqd.estimator.joint import Joint
from jtqd.estimator.losses import LossModel
from jtqd.estimator.settings import EstimatorSettings

FADE_START: Final[float]
TEMPERATURE_MARGIN_K: Final[float]
DISTANCE_MARGIN: Final[float]

class Uncertainty:
    def __init__(self, joint: Joint, settings: EstimatorSettings, losses: LossModel) -> None: ...
    def moving(self, raw_nm: float, current_a: float, velocity_rad_s: float) -> float: ...
    def standing(self, raw_nm: float, current_a: float) -> tuple[float, float]: ...

class Trust:
    def __init__(
        self, low: tuple[float, ...], high: tuple[float, ...], margin: float, limit_nm: float
    ) -> None: ...
    def weight(self, *values: float) -> float: ...

class FusedTrust:
    def __init__(self, envelope: Envelope) -> None: ...
    def weight(
        self, velocity_rad_s: float, raw_nm: float, distance_nm: float, temperature_c: float
    ) -> float: ...
    def weigh_map(self, velocity_rad_s: FloatArray, raw_nm: FloatArray) -> FloatArray: ...
