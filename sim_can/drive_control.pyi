from jtqd.sim_can.plant_file import JointPlant

class DriveControl:
    mode: int
    target: float
    current_a: float
    integral_a: float
    reference_rad_s: float
    slope_rad_s2: float
    interpolation_s: float
    def __init__(self, side: JointPlant) -> None: ...
    def command(self, mode: int, target: float, motor_velocity_rad_s: float) -> None: ...
    def plan(self, dt_s: float) -> None: ...
    def step(self, h: float, motor_velocity_rad_s: float) -> float: ...
