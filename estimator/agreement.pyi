from typing import Final

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import Fused

TREND_S: Final = 0.1
UP_S: Final = 0.15
DOWN_S: Final = 5.0
LEVEL: Final = 1.4
GAIN: Final = 2.0
LOWER_SIGMAS: Final = 4.0
LEAST_SHARE: Final = 0.02

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
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]: ...
