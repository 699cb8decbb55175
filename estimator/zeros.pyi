from typing import Final

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import Fused

MOVING_RAD_S: Final[float]
ONE_WAY: Final[float]
BLOCK: Final[int]
CORRELATION_S: Final[float]
DOUBT: Final[float]
SURE: Final[float]
COVERED: Final[float]
SLEW_S: Final[float]
LARGEST_LINK: Final[float]
CURRENT_SHARE: Final[float]
LEAST_GAIN: Final[float]
FRICTION_SHARE: Final[float]
DRIFT_S: Final[float]
JUMP: Final[float]
JUMP_S: Final[float]
KNOWN_SHARE: Final[float]

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
) -> tuple[FloatArray, FloatArray, FloatArray]: ...
