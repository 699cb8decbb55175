from typing import Final, NamedTuple

from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.estimator.joint import Fused, FusedSigma, Turn

HOLD_S: Final[float]
DISAGREE_SIGMAS: Final[float]
FOREIGN_SIGMAS: Final[float]
GAUSS: Final[float]
MOVING_RAD_S: Final[float]
ONE_WAY: Final[float]
CORRELATION_S: Final[float]
DOWN_S: Final[float]
TURNING_RAD_S: Final[float]
TURN_TREND_S: Final[float]
TURN_MEMORY_S: Final[float]
LEAST_S: Final[float]
EVERY: Final[int]
TURN_BLOCK: Final[int]

Numbers = FloatArray | float

class FusedPaths(NamedTuple):
    alpha: FloatArray
    value_nm: FloatArray
    sigma_nm: FloatArray
    variance_nm2: FloatArray

class Fusion:
    def __init__(self, sigma: FusedSigma, with_torsion: bool) -> None: ...
    def fuse(
        self,
        raw_nm: Numbers,
        half_nm: Numbers,
        velocity_rad_s: Numbers,
        torsion_nm: Numbers,
        open_nm: Numbers = 0.0,
        loss_nm: Numbers = 0.0,
        known_nm2: FloatArray | None = None,
    ) -> FusedPaths: ...
    def at_rest(
        self,
        raw_nm: Numbers,
        half_nm: Numbers,
        velocity_rad_s: Numbers,
        torsion_nm: Numbers,
        open_nm: Numbers = 0.0,
    ) -> tuple[FloatArray, FloatArray]: ...

def faded(half_nm: FloatArray, dt_s: FloatArray, running: BoolArray) -> FloatArray: ...
def levels(
    fused: Fused,
    rated_nm: float,
    dt_s: FloatArray,
    difference_nm: FloatArray,
    direction: FloatArray,
    velocity_rad_s: FloatArray,
    torsion_nm: FloatArray,
    variance_nm2: FloatArray,
    slope: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]: ...
def track_run(
    fused: Fused,
    rated_nm: float,
    dt_s: FloatArray,
    raw_nm: FloatArray,
    half_nm: FloatArray,
    velocity_rad_s: FloatArray,
    torsion_nm: FloatArray,
    open_nm: FloatArray,
    difference_nm: FloatArray,
    direction: FloatArray,
    slope: FloatArray,
    stiffness: FloatArray,
    ahead_nm: FloatArray,
    behind_nm2: FloatArray,
    resting: BoolArray,
    tracked: bool = True,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]: ...
def turn_waves(
    turn: Turn,
    dt_s: FloatArray,
    difference_nm: FloatArray,
    direction: FloatArray,
    velocity_rad_s: FloatArray,
    loss_nm: FloatArray,
    waves: FloatArray,
) -> tuple[FloatArray, FloatArray]: ...
