from typing import Final

from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.estimator.joint import FusedSigma

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
