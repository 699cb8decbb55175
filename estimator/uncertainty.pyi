from typing import Final, NamedTuple

from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.estimator.joint import Envelope, FusedSigma

SLOW_RAD_S: Final[float]
FAST_RAD_S: Final[float]
HOLD_S: Final[float]
DISAGREE_SIGMAS: Final[float]
FOREIGN_SIGMAS: Final[float]
GAUSS: Final[float]
LEAST_TORSION: Final[float]
FADE_START: Final[float]
TEMPERATURE_MARGIN_K: Final[float]
DISTANCE_MARGIN: Final[float]

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

def network_shares(velocity_rad_s: FloatArray) -> FloatArray: ...
def faded(half_nm: FloatArray, dt_s: FloatArray, running: BoolArray) -> FloatArray: ...
def network_weights(
    low: tuple[float, ...],
    high: tuple[float, ...],
    margin: float,
    limit_nm: float,
    features: FloatArray,
    difference_nm: FloatArray,
) -> FloatArray: ...
def envelope_weights(
    envelope: Envelope,
    velocity_rad_s: Numbers,
    raw_nm: Numbers,
    distance_nm: Numbers = 0.0,
    temperature_c: Numbers | None = None,
) -> FloatArray: ...
