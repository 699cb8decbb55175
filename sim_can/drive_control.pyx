"""Current and velocity loop of one drive: first-order current loop, PI velocity loop with feedforward. Pure."""

from libc.math cimport exp, fabs, fmax, fmin, isnan, rint

import math

from jtqd.sim_can import source

cdef int OFF = source.OFF, VELOCITY = source.VELOCITY, CURRENT = source.CURRENT


cdef class DriveControl:
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

    def __init__(self, side):
        joint, drive = side.joint, side.drive
        # nominal values: a drive knows no others
        kt, inertia = joint.torque_constant_nm_per_a, joint.rotor_inertia_kgm2
        self.bandwidth = 2.0 * math.pi * drive.current_bandwidth_hz
        self.kp = drive.velocity_bandwidth_rad_s * inertia / kt
        self.integral_rate = self.kp / drive.velocity_integral_time_s
        self.inertia_a = drive.acceleration_feedforward * inertia / kt
        self.friction = drive.friction_feedforward_a
        self.smooth = 0.01 * joint.gear_ratio  # friction feedforward turns over within 0.01 rad/s of the joint
        self.slope_limit = drive.acceleration_limit_rad_s2 * joint.gear_ratio
        self.limit = drive.current_limit_a
        self.mode = OFF
        self.target = self.current_a = self.integral_a = 0.0
        self.reference_rad_s = self.slope_rad_s2 = 0.0
        self.interpolation_s = self.to_go_s = 0.0
        self.feedforward = self.base = 0.0
        self.decay_step, self.decay = -1.0, 0.0

    def command(self, int mode, double target, double motor_velocity_rad_s):
        """Set mode (OFF, VELOCITY, CURRENT) and target. Velocity mode starts from the present velocity and current.

        Raises ValueError for a target that is not a number.
        """
        if isnan(target):
            raise ValueError("found a target that is not a number, expected rad/s or A")
        if mode != self.mode:
            self.mode = mode
            self.reference_rad_s = motor_velocity_rad_s
            self.integral_a = self.current_a
        self.target = target
        self.to_go_s = self.interpolation_s

    cpdef void plan(self, double dt_s) noexcept:
        """Plan reference and feedforward of the next control cycle of length dt_s > 0."""
        cdef double cycles, slope, middle
        if self.mode == VELOCITY:
            # whole cycles, at least one: SYNCs jitter, the line must end where a cycle ends
            cycles = rint(self.to_go_s / dt_s) if self.to_go_s > dt_s else 1.0
            self.to_go_s -= dt_s
            slope = (self.target - self.reference_rad_s) / (cycles * dt_s)
            self.slope_rad_s2 = slope = fmin(fmax(slope, -self.slope_limit), self.slope_limit)
            middle = self.reference_rad_s + 0.5 * slope * dt_s
            self.feedforward = self.inertia_a * slope + self.friction * middle / (fabs(middle) + self.smooth)
        elif self.mode == CURRENT:
            self.base = fmin(fmax(self.target, -self.limit), self.limit)
        else:
            self.base = 0.0

    cpdef double step(self, double h, double motor_velocity_rad_s) noexcept:
        """Advance by h seconds and return the motor current in A."""
        cdef double error, wanted
        if self.mode == VELOCITY:
            self.reference_rad_s += h * self.slope_rad_s2
            error = self.reference_rad_s - motor_velocity_rad_s
            wanted = self.kp * error + self.integral_a + self.feedforward
            if not (wanted > self.limit and error >= 0.0 or wanted < -self.limit and error <= 0.0):
                self.integral_a += h * self.integral_rate * error
            wanted = fmin(fmax(wanted, -self.limit), self.limit)
        else:
            wanted = self.base
        if h != self.decay_step:
            self.decay_step = h
            self.decay = 1.0 - exp(-self.bandwidth * h)
        self.current_a += self.decay * (wanted - self.current_a)
        return self.current_a
