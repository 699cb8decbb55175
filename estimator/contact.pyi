from jtqd.estimator.arrays import CodeArray, FloatArray
from jtqd.estimator.joint import Joint
from jtqd.estimator.settings import EstimatorSettings

def detect_contacts(
    external_nm: FloatArray,
    motor_position_rad: FloatArray,
    threshold_nm: float,
    period_s: float = 0.001,
) -> tuple[FloatArray, CodeArray]: ...
def link_loads(
    joint: Joint,
    settings: EstimatorSettings,
    dt_s: FloatArray,
    current_a: FloatArray,
    motor_position_rad: FloatArray,
    motor_velocity_rad_s: FloatArray,
    link_position_rad: FloatArray,
) -> tuple[FloatArray, FloatArray]: ...
