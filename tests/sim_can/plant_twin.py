"""The plant of `jtqd.sim_can.plant` without kinematic error, hysteresis, temperature and days, written out plainly:
what a plant file without these sections must still do, bit by bit."""

import math

from jtqd.sim_can.plant import loss_table
from jtqd.sim_can.plant_file import substep_limit
from jtqd.sim_can.source import CURRENT, OFF, VELOCITY


class TwinDrive:
    """Loops of a drive whose velocity targets are reached within one control cycle."""

    def __init__(self, side):
        joint, drive = side.joint, side.drive
        kt, inertia = joint.torque_constant_nm_per_a, joint.rotor_inertia_kgm2
        self.drive = drive
        self.kp = drive.velocity_bandwidth_rad_s * inertia / kt
        self.inertia_a = drive.acceleration_feedforward * inertia / kt
        self.smooth = 0.01 * joint.gear_ratio
        self.slope_limit = drive.acceleration_limit_rad_s2 * joint.gear_ratio
        self.mode, self.target = OFF, 0.0
        self.current_a = self.integral_a = self.reference_rad_s = self.feedforward = self.slope = 0.0

    def command(self, mode, target, motor_velocity):
        if mode != self.mode:
            self.mode, self.reference_rad_s, self.integral_a = mode, motor_velocity, self.current_a
        self.target = target

    def plan(self, dt_s):
        if self.mode == VELOCITY:
            slope = (self.target - self.reference_rad_s) / dt_s
            self.slope = slope = min(max(slope, -self.slope_limit), self.slope_limit)
            middle = self.reference_rad_s + 0.5 * slope * dt_s
            self.feedforward = self.inertia_a * slope + self.drive.friction_feedforward_a * middle / (
                abs(middle) + self.smooth
            )

    def step(self, h, motor_velocity):
        limit = self.drive.current_limit_a
        wanted = self.target if self.mode == CURRENT else 0.0
        if self.mode == VELOCITY:
            self.reference_rad_s += h * self.slope
            error = self.reference_rad_s - motor_velocity
            wanted = self.kp * error + self.integral_a + self.feedforward
            if abs(wanted) <= limit or wanted * error < 0.0:
                self.integral_a += h * (self.kp / self.drive.velocity_integral_time_s) * error
        decay = 1.0 - math.exp(-2.0 * math.pi * self.drive.current_bandwidth_hz * h)
        self.current_a += decay * (min(max(wanted, -limit), limit) - self.current_a)
        return self.current_a


class TwinPlant:
    """Eqs. (1)-(3) with losses, ripple and Stribeck friction."""

    def __init__(self, parameters):
        self.sides = parameters.joints
        self.tables = [loss_table(side) for side in self.sides]
        self.drives = [TwinDrive(side) for side in self.sides]
        self.link_inertia = [side.joint.link_inertia_kgm2 for side in self.sides]
        self.substep_s = substep_limit(parameters)
        self.motor_position, self.motor_velocity = [0.0, 0.0], [0.0, 0.0]
        self.link_position = self.link_velocity = 0.0

    def command(self, drive, mode, target):
        self.drives[drive].command(mode, target, self.motor_velocity[drive])

    def friction(self, k, torque, velocity):
        side, d = self.sides[k], self.sides[k].deviations
        force = d.friction_scale * self.tables[k].magnitude(torque, velocity)
        force += (d.viscous_scale - 1.0) * side.joint.friction.viscous_nms_per_rad * abs(velocity)
        if d.stribeck.torque_nm > 0.0 and abs(velocity) < 4.0 * d.stribeck.velocity_rad_s:
            x = abs(velocity) * (1.0 / d.stribeck.velocity_rad_s)
            force += d.stribeck.torque_nm * math.exp(-x * x)
        return max(force, 0.0)

    def step(self):
        """One millisecond."""
        for drive in self.drives:
            drive.plan(0.001)
        steps = max(1, math.ceil(0.001 / self.substep_s - 1e-3))
        for _ in range(steps):
            self.substep(0.001 / steps)

    def substep(self, h):
        currents = [self.drives[k].step(h, self.motor_velocity[k]) for k in (0, 1)]
        torques = []
        for k, sign in ((0, 1.0), (1, -1.0)):
            side, g = self.sides[k], 1.0 / self.sides[k].joint.gear_ratio
            torsion = self.motor_position[k] * g - sign * self.link_position
            rate = self.motor_velocity[k] * g - sign * self.link_velocity
            torques.append(side.constants.stiffness * torsion + side.joint.damping_nms_per_rad * rate)
        for k in (0, 1):
            side, d, g = self.sides[k], self.sides[k].deviations, 1.0 / self.sides[k].joint.gear_ratio
            per_motor = h / side.constants.rotor_inertia
            per_joint = per_motor * g
            angle = d.ripple.order_per_motor_rev * self.motor_position[k] + d.ripple.phase_rad
            w = self.motor_velocity[k] + (
                per_motor * side.constants.torque_constant * currents[k]
                - per_joint * (torques[k] + d.ripple.amplitude_nm * math.cos(angle))
            )
            stop = per_joint * self.friction(k, torques[k], w * g)
            self.motor_velocity[k] = w - stop if w > stop else w + stop if w < -stop else 0.0
        self.link_velocity += h / sum(self.link_inertia) * (torques[0] - torques[1])
        for k in (0, 1):
            self.motor_position[k] += h * self.motor_velocity[k]
        self.link_position += h * self.link_velocity

    def sensor_torque(self):
        torques = []
        for k, sign in ((0, 1.0), (1, -1.0)):
            side, ratio = self.sides[k], self.sides[k].joint.gear_ratio
            torsion = self.motor_position[k] / ratio - sign * self.link_position
            rate = self.motor_velocity[k] / ratio - sign * self.link_velocity
            torques.append(side.constants.stiffness * torsion + side.joint.damping_nms_per_rad * rate)
        share = self.link_inertia[0] / sum(self.link_inertia)
        return torques[0] - share * (torques[0] - torques[1])
