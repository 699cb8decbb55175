"""Current and velocity loop of one drive: first-order current loop, PI velocity loop with feedforward. Pure."""

import math

from jtqd.sim_can.plant_file import JointPlant
from jtqd.sim_can.source import CURRENT, OFF, VELOCITY


class DriveControl:
    """Loops of a drive; `plan` once per control cycle (1 ms), `step` once per integration step.

    Current loop (closed): di/dt = 2π B (i_ref - i), discretised exactly, |i_ref| limited. With the power
    stage off the current decays with the same time constant. Velocity loop (mode 9, motor side): i_ref = kp e
    + ∫ kp/Ti e + (Jff α_ref + friction feedforward) / Kt, e = ω_ref - ω. ω_ref goes to a new target in a
    straight line (linear interpolation of CSV) within `interpolation_s` (60C2h), at least within one control
    cycle, at most with the acceleration limit: a master that sends a target every 2 ms sets it, and the
    feedforward sees the slope of its trajectory instead of a staircase.
    The integrator stands while the current is limited in the direction of the error. The drive's own velocity
    is taken as exact: its encoder interpolation is far finer than what it reports.
    """

    __slots__ = (
        "_bandwidth",
        "_base",
        "_decay",
        "_decay_step",
        "_feedforward",
        "_friction",
        "_inertia_a",
        "_integral_rate",
        "_kp",
        "_limit",
        "_slope_limit",
        "_smooth",
        "_to_go_s",
        "current_a",
        "integral_a",
        "interpolation_s",
        "mode",
        "reference_rad_s",
        "slope_rad_s2",
        "target",
    )

    def __init__(self, side: JointPlant) -> None:
        joint, drive = side.joint, side.drive
        # nominal values: a drive knows no others
        kt, inertia = joint.torque_constant_nm_per_a, joint.rotor_inertia_kgm2
        self._bandwidth = 2.0 * math.pi * drive.current_bandwidth_hz
        self._kp = drive.velocity_bandwidth_rad_s * inertia / kt
        self._integral_rate = self._kp / drive.velocity_integral_time_s
        self._inertia_a = drive.acceleration_feedforward * inertia / kt
        self._friction = drive.friction_feedforward_a
        self._smooth = (
            0.01 * joint.gear_ratio
        )  # friction feedforward turns over within 0.01 rad/s of the joint
        self._slope_limit = drive.acceleration_limit_rad_s2 * joint.gear_ratio
        self._limit = drive.current_limit_a
        self.mode = OFF
        self.target = 0.0
        self.current_a = 0.0
        self.integral_a = 0.0
        self.reference_rad_s = 0.0
        self.slope_rad_s2 = 0.0
        self.interpolation_s = 0.0
        self._to_go_s = 0.0
        self._feedforward = 0.0
        self._base = 0.0
        self._decay_step = -1.0
        self._decay = 0.0

    def command(self, mode: int, target: float, motor_velocity_rad_s: float) -> None:
        """Set mode (OFF, VELOCITY, CURRENT) and target. Velocity mode starts from the present velocity and current."""
        if mode != self.mode:
            self.mode = mode
            self.reference_rad_s = motor_velocity_rad_s
            self.integral_a = self.current_a
        self.target = target
        self._to_go_s = self.interpolation_s

    def plan(self, dt_s: float) -> None:
        """Plan reference and feedforward of the next control cycle of length dt_s > 0."""
        if self.mode == VELOCITY:
            limit = self._slope_limit
            # whole cycles, at least one: SYNCs jitter, the line must end where a cycle ends
            cycles = round(self._to_go_s / dt_s) if self._to_go_s > dt_s else 1
            self._to_go_s -= dt_s
            slope = (self.target - self.reference_rad_s) / (cycles * dt_s)
            self.slope_rad_s2 = slope = min(max(slope, -limit), limit)
            middle = self.reference_rad_s + 0.5 * slope * dt_s
            self._feedforward = self._inertia_a * slope + self._friction * middle / (
                abs(middle) + self._smooth
            )
        elif self.mode == CURRENT:
            self._base = min(max(self.target, -self._limit), self._limit)
        else:
            self._base = 0.0

    def step(self, h: float, motor_velocity_rad_s: float) -> float:
        """Advance by h seconds and return the motor current in A."""
        if self.mode == VELOCITY:
            reference = self.reference_rad_s = self.reference_rad_s + h * self.slope_rad_s2
            error = reference - motor_velocity_rad_s
            wanted = self._kp * error + self.integral_a + self._feedforward
            limit = self._limit
            if wanted > limit:
                wanted = limit
                if error < 0.0:
                    self.integral_a += h * self._integral_rate * error
            elif wanted < -limit:
                wanted = -limit
                if error > 0.0:
                    self.integral_a += h * self._integral_rate * error
            else:
                self.integral_a += h * self._integral_rate * error
        else:
            wanted = self._base
        if h != self._decay_step:
            self._decay_step = h
            self._decay = 1.0 - math.exp(-self._bandwidth * h)
        current = self.current_a = self.current_a + self._decay * (wanted - self.current_a)
        return current
