from typing import Final

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import Fused

TREND_S: Final[float]
UP_S: Final[float]
DOWN_S: Final[float]
LOWER_SIGMAS: Final[float]
LEAST_SHARE: Final[float]
SURE_SIGMAS: Final[float]

def levels(
    fused: Fused,
    rated_nm: float,
    dt_s: FloatArray,
    apart_nm: FloatArray,
    direction: FloatArray,
    velocity_rad_s: FloatArray,
    torsion_nm: FloatArray,
    variance_nm2: FloatArray,
    slope: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]: ...
def followed(
    fused: Fused,
    rated_nm: float,
    dt_s: FloatArray,
    apart_nm: FloatArray,
    direction: FloatArray,
    velocity_rad_s: FloatArray,
    torsion_nm: FloatArray,
    variance_nm2: FloatArray,
    slope: FloatArray,
    stiffness: FloatArray,
    tracked: bool = True,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]: ...
