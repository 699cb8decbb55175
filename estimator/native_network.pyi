from collections.abc import Sequence
from typing import Final

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import Envelope

FADE_START: Final[float]
TEMPERATURE_MARGIN_K: Final[float]
DISTANCE_MARGIN: Final[float]
TORQUE_RAD_S: Final[tuple[float, ...]]
VELOCITY_RAD_S: Final[tuple[float, ...]]
TRAVELS_RAD: Final[tuple[float, ...]]
INPUTS: Final[tuple[str, ...]]
DIRECTION_RAD_S: Final[float]
OUTSIDE: Final[float]
QUICK: Final[float]
DEFAULT_C: Final[float]

Numbers = FloatArray | float
Layers = Sequence[tuple[FloatArray, FloatArray]]

class Perceptron:
    def __init__(self, layers: Layers) -> None: ...
    @staticmethod
    def fits(layers: Layers) -> bool: ...
    def run_one(self, *x: float) -> float: ...
    def run_many(self, features: FloatArray) -> FloatArray: ...

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
