from typing import Final

from jtqd.estimator.arrays import FloatArray

RAW_LIMIT: Final[float]
LINK_SPEED_LIMIT_RAD_S: Final[float]
RIPPLE_ORDERS: Final[tuple[int, int]]

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
def columns(*arrays: FloatArray | None) -> FloatArray: ...
