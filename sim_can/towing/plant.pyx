"""Two harmonic-drive joints that face each other through a torque sensor: equations of docs/testing.md.

Per joint, own frame, J = Jm G² and v = ω/G on the joint side:

    J dv/dt = G (Kt(T) i (1 - s (i/I_r)²) + cogging(θ)) - τ G dδ/dθ - F
    (J1 + J2) dω_link/dt = τ1 - τ2 + τ_x    sensor = τ1 - J1 dω_link/dt        τ_x: of a push, on link 2

Semi-implicit Euler: velocities first, then angles with the new velocities; friction implicit. Pure: no clock.
"""

from libc.math cimport ceil, fabs, fmax, isfinite, rint

from jtqd.sim_can.drive_control cimport DriveControl
from jtqd.sim_can.towing.friction cimport BristleFriction
from jtqd.sim_can.towing.gear cimport Gear
from jtqd.sim_can.towing.warmth cimport Warmth
from jtqd.sim_can.towing.waves cimport waves_at, waves_of

from typing import Final

CONTROL_CYCLE_S: Final = 0.001

cdef double CONTROL_CYCLE = CONTROL_CYCLE_S


cdef class TrueJoint:
    """One joint with its drive; `side`: `bench_file.TowedJoint`. angle, velocity: of the motor [rad, rad/s]."""

    def __init__(self, side):
        self.ratio, self.per_ratio = side.joint.gear_ratio, 1.0 / side.joint.gear_ratio
        self.inertia = side.motor.rotor_inertia_kgm2 * self.ratio**2
        self.torque_constant, self.per_k = side.motor.torque_constant_nm_per_a, side.motor.torque_constant_per_k
        self.reference_c = side.warmth.reference_c
        self.saturation, self.per_current = side.motor.saturation_share, 1.0 / side.drive.rated_current_a
        self.cogging = waves_of(side.motor.cogging)
        self.gear = Gear(side.gear, self.ratio)
        self.friction = BristleFriction(side.friction, side.joint.rated_torque_nm, self.inertia)
        self.warmth = Warmth(side.warmth)
        self.drive = DriveControl(side)
        self.angle = self.velocity = self.loss_w = 0.0
        self.begin_day(0.0, 0.0, 0.0)

    cpdef void begin_day(self, double temperature_k, double coulomb, double viscous) noexcept:
        """Begin a day: room above the usual one [K], Coulomb and viscous friction above the usual ones [share]."""
        self.day_coulomb, self.day_viscous = 1.0 + coulomb, 1.0 + viscous
        self.warmth.start(temperature_k)
        self.friction.warm(self.day_coulomb * self.warmth.coulomb, self.day_viscous * self.warmth.viscous)

    cpdef double motor_torque(self, double current) noexcept:
        """Return the motor's torque [Nm, motor side] at a true current [A], without cogging."""
        cdef double used = current * self.per_current
        cdef double constant = self.torque_constant * (1.0 - self.per_k * (self.warmth.housing_c - self.reference_c))
        return constant * current * (1.0 - self.saturation * used * used)

    cdef double torque(self, double link_velocity) noexcept:
        """Return τ [Nm] at the present state."""
        return self.gear.torque(self.velocity * self.gear.slope(self.angle) - link_velocity)

    cdef double push(self, double current, double link_velocity, double h) noexcept:
        """Advance the motor's velocity by h seconds; return τ."""
        cdef double torque = self.torque(link_velocity)
        cdef double v = self.velocity * self.per_ratio
        cdef double mobility = h / self.inertia
        cdef double drive = self.ratio * (self.motor_torque(current) + waves_at(&self.cogging, self.angle))
        cdef double load = torque * self.ratio * self.gear.slope(self.angle)
        v = self.friction.settle(v + mobility * (drive - load), mobility, torque, v, self.angle, h)
        self.velocity = v * self.ratio
        self.loss_w = fabs(self.friction.torque * v)
        return torque

    cdef void turn(self, double link, double h) noexcept:
        """Advance the motor's angle by h seconds, to this link angle."""
        self.angle += h * self.velocity
        self.gear.turn(self.angle, link)

    cdef void warm(self, double dt_s) noexcept:
        """Add the losses of dt_s seconds to the temperatures."""
        if self.warmth.add(self.loss_w, dt_s):
            self.friction.warm(self.day_coulomb * self.warmth.coulomb, self.day_viscous * self.warmth.viscous)


cdef class TowingPlant:
    """Both joints and the link between them; `parameters`: `bench_file.TowingBench`. `link_*` is joint 1's frame."""

    def __init__(self, parameters):
        self.parameters = parameters
        self.one, self.two = (TrueJoint(side) for side in parameters.joints)
        self.joints = (self.one, self.two)
        self.drives = (self.one.drive, self.two.drive)
        self.inertia_1, self.inertia_2 = (side.link_inertia_kgm2 for side in parameters.joints)
        self.substep_s = parameters.longest_step_s
        self.link_position = self.link_velocity = 0.0
        self.external_nm = self.next_external_nm = self.until_next_s = 0.0
        self.one.gear.relax(0.0, 0.0)
        self.two.gear.relax(0.0, 0.0)

    def begin_run(self):
        """Start a run: the drives are about to be enabled."""

    def begin_day(self, day):
        """Set friction and temperatures of another day (`days.Day`); the joints stay where they are."""
        for joint, values in zip(self.joints, day.joints, strict=True):
            joint.begin_day(values.temperature_k, values.coulomb, values.viscous)

    def command(self, int drive, int mode, double target):
        """Set mode and target of drive 0 or 1; see `jtqd.sim_can.source`."""
        self.drives[drive].command(mode, target, self.joints[drive].velocity)

    def push(self, double torque_nm, double after_s=0.0):
        """Push the links with torque_nm [Nm, joint 1's frame], on joint 2's side of the sensor, from after_s [s] on."""
        self.next_external_nm, self.until_next_s = torque_nm, after_s

    cpdef step(self, double dt_s):
        """Advance by dt_s: whole control cycles of about 1 ms, each in equal integration steps. Raises ValueError."""
        cdef double cycle
        cdef int cycles, steps
        if dt_s <= 0.0:
            return
        if not isfinite(dt_s):
            raise ValueError(f"found a step of {dt_s} s, expected a finite one")
        cycles = <int>fmax(1.0, rint(dt_s / CONTROL_CYCLE))
        cycle = dt_s / cycles
        # the small excess keeps stamps that jitter by a few nanoseconds at the same number of steps
        steps = <int>fmax(1.0, ceil(cycle / self.substep_s - 1e-3))
        for _ in range(cycles):
            self.one.drive.plan(cycle)
            self.two.drive.plan(cycle)
            self.integrate(steps, cycle / steps)
            self.one.warm(cycle)
            self.two.warm(cycle)

    cdef void integrate(self, int steps, double h) noexcept:
        cdef TrueJoint one = self.one, two = self.two
        cdef double per_link = h / (self.inertia_1 + self.inertia_2)
        cdef double torque_1, torque_2
        for _ in range(steps):
            torque_1 = one.push(one.drive.step(h, one.velocity), self.link_velocity, h)
            torque_2 = two.push(two.drive.step(h, two.velocity), -self.link_velocity, h)
            if self.external_nm != self.next_external_nm:
                self.until_next_s -= h
                if self.until_next_s < 0.0:
                    self.external_nm = self.next_external_nm
            self.link_velocity += per_link * (torque_1 - torque_2 + self.external_nm)
            self.link_position += h * self.link_velocity
            one.turn(self.link_position, h)
            two.turn(-self.link_position, h)

    def joint_torques(self):
        """Return (τ1, τ2) in Nm, own frames."""
        return self.one.torque(self.link_velocity), self.two.torque(-self.link_velocity)

    cpdef double sensor_torque(self) except? -1.0:
        """Return the true torque in the sensor, Nm: τ1 - J1 dω_link/dt."""
        cdef double one = self.one.torque(self.link_velocity), two = self.two.torque(-self.link_velocity)
        return one - self.inertia_1 / (self.inertia_1 + self.inertia_2) * (one - two + self.external_nm)
