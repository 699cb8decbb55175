from typing import Final, NamedTuple

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import Joint, Torsion, Tracking

RAW_LIMIT: Final[float]
LINK_SPEED_LIMIT_RAD_S: Final[float]
RIPPLE_ORDERS: Final[tuple[int, int]]
TRACKED_FADE_S: Final[float]

def first_order_hold(rate_rad_s: float, dt_s: float) -> tuple[float, float, float]: ...
def slipped(d_rad: FloatArray, travel_rad: float) -> tuple[FloatArray, FloatArray]: ...
def low_pass(values: FloatArray, dt_s: FloatArray, bandwidth_rad_s: float) -> FloatArray: ...
def tracked(
    deflection_rad: FloatArray,
    motor_position_rad: FloatArray,
    motor_velocity_rad_s: FloatArray,
    dt_s: FloatArray,
    rate_rad_s: float,
    wave_rad_s: float,
    max_gap_s: float = 0.05,
) -> tuple[FloatArray, FloatArray]: ...
def reference_of(
    sensor_nm: FloatArray, dt_s: FloatArray, bandwidth_rad_s: float, max_gap_s: float = 0.05
) -> FloatArray: ...

class FusedObservedSample(NamedTuple):
    raw_nm: float
    joint_velocity_rad_s: float
    link_velocity_rad_s: float
    torsion_nm: float
    cos2: float
    sin2: float
    cos4: float
    sin4: float
    direction: float
    open_nm: float = 0.0
    ahead_nm: float = 0.0

class FusedObserver:
    def __init__(
        self,
        joint: Joint,
        torsion: Torsion | None,
        bandwidth_rad_s: float,
        link_bandwidth_rad_s: float,
        torsion_bandwidth_rad_s: float | None = None,
        tracking: Tracking | None = None,
    ) -> None: ...
    def start(
        self,
        current_a: float,
        motor_position_rad: float,
        motor_velocity_rad_s: float,
        link_position_rad: float,
    ) -> FusedObservedSample: ...
    def step(
        self,
        dt_s: float,
        current_a: float,
        motor_position_rad: float,
        motor_velocity_rad_s: float,
        link_position_rad: float,
    ) -> FusedObservedSample: ...
