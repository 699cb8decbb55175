from typing import Final

from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.estimator.joint import Envelope, FusedSigma, Joint
from jtqd.estimator.losses import LossModel
from jtqd.estimator.settings import EstimatorSettings

SLOW_RAD_S: Final[float]
FAST_RAD_S: Final[float]
HOLD_S: Final[float]
DISAGREE_SIGMAS: Final[float]
FOREIGN_SIGMAS: Final[float]
GAUSS: Final[float]
LEAST_TORSION: Final[float]

def turning(velocity_rad_s: FloatArray) -> FloatArray: ...
def held(half_nm: FloatArray, dt_s: FloatArray, running: BoolArray) -> FloatArray: ...

class Fusion:
    def __init__(self, sigma: FusedSigma, with_torsion: bool) -> None: ...
    def fuse(
        self,
        raw_nm: float,
        loss_nm: float,
        half_nm: float,
        velocity_rad_s: float,
        torsion_nm: float,
        open_nm: float = 0.0,
    ) -> tuple[float, float]: ...
    def fuse_many(
        self,
        raw_nm: FloatArray,
        loss_nm: FloatArray,
        half_nm: FloatArray,
        velocity_rad_s: FloatArray,
        torsion_nm: FloatArray,
        open_nm: FloatArray | float = 0.0,
    ) -> tuple[FloatArray, FloatArray]: ...
    def weigh_known(
        self,
        raw_nm: FloatArray,
        half_nm: FloatArray,
        velocity_rad_s: FloatArray,
        torsion_nm: FloatArray,
        open_nm: FloatArray | float,
        known_nm2: FloatArray,
    ) -> tuple[FloatArray, FloatArray]: ...
    def variance_many(
        self,
        raw_nm: FloatArray,
        half_nm: FloatArray,
        velocity_rad_s: FloatArray,
        torsion_nm: FloatArray,
        open_nm: FloatArray | float = 0.0,
    ) -> FloatArray: ...
    def weigh_many(
        self,
        raw_nm: FloatArray,
        half_nm: FloatArray,
        velocity_rad_s: FloatArray,
        torsion_nm: FloatArray,
        open_nm: FloatArray | float = 0.0,
    ) -> tuple[FloatArray, FloatArray]: ...
    def rest_many(
        self,
        raw_nm: FloatArray,
        half_nm: FloatArray,
        velocity_rad_s: FloatArray,
        torsion_nm: FloatArray,
        open_nm: FloatArray | float = 0.0,
    ) -> tuple[FloatArray, FloatArray]: ...

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
