"""Two harmonic-drive joints facing each other, coupled by a stiff torque sensor: the paper's Eqs. (1)-(3).

Per joint j in its own frame (θ motor side m, link side l; w = dθ/dt), with the kinematic error of the gear
e(θm) = E sin(k θm + ψ), its slope e' = de/dθm, and a Maxwell-slip element z beside the spring:

    Jm dwm/dt = Kt i - τ (1/G + e') - (A cos(n θm + φ) + friction) / G       (1)
    δ = θm/G + e(θm) - θl              τ = K δ + D dδ/dt + H z               (3)
    dz = dδ / travel, z held within -1 .. 1

The motor's load is τ dδ/dθm: the virtual work of the spring, so a kinematic error makes no energy. Both links
and the sensor are one rigid body, and the joints face each other, so θl2 = -θl1:

    (Jl1 + Jl2) dwl1/dt = τ1 - τ2 + τx                                       (2)
    sensor = τ1 - Jl1 dwl1/dt              τx: of a push, on link 2

The sensor's torque is positive along the positive current of either joint.

Integration is semi-implicit Euler (velocities first, then positions with the new velocities). Friction is
implicit: within a step its impulse can stop the motor but never turn it round, h F/(G Jm) against |w|. So a
joint sticks at exactly zero velocity, does not creep, and no step size makes friction unstable. Pure: no
clock.
"""

from libc.math cimport ceil, cos, fabs, fmax, fmin, isfinite, rint, sin

from jtqd.sim_can.drive_control cimport DriveControl
from jtqd.sim_can.losses cimport JointFriction, LossTable
from jtqd.sim_can.losses cimport JointTemperature

from dataclasses import replace
from typing import Final, NamedTuple

from jtqd.estimator.losses import LossModel
from jtqd.sim_can.plant_file import NOMINAL_DAY
from jtqd.sim_can.plant_file import substep_limit

CONTROL_CYCLE_S: Final = 0.001

cdef double CONTROL_CYCLE = CONTROL_CYCLE_S


class JointConstants(NamedTuple):
    """Constants of one joint for the inner loop, SI units."""

    gear_ratio: float
    torque_constant: float
    rotor_inertia: float
    stiffness: float
    damping: float
    ripple_nm: float
    ripple_order: float
    ripple_phase: float
    error_rad: float  # E, kinematic error
    error_order: float
    error_phase: float
    error_slope: float  # G E k: e' in units of 1/G
    slip_nm: float  # H, hysteresis
    per_travel: float


def _constants(side):
    d = side.deviations
    return JointConstants(
        side.joint.gear_ratio,
        side.torque_constant,
        side.rotor_inertia,
        side.stiffness,
        side.damping,
        d.ripple_nm,
        d.ripple_order_per_motor_rev,
        d.ripple_phase_rad,
        d.kinematic_error_rad,
        d.kinematic_error_order_per_motor_rev,
        d.kinematic_error_phase_rad,
        side.joint.gear_ratio * d.kinematic_slope,
        d.hysteresis_nm,
        1.0 / d.hysteresis_travel_rad,
    )


def relaxed_angle(constants, bend_rad=None):
    """Return the motor angle without torsion at link angle zero, θ = -G (e(θ) + b(θ)): a bench is assembled without stress.

    bend_rad: b(θ), twist by position alone. The iteration contracts: G |e' + b'| < 1/2 (`plant_file`). 0 without either.
    """
    cdef Constants c = constants._asdict()
    cdef double angle = 0.0, bend
    for _ in range(60):
        bend = 0.0 if bend_rad is None else bend_rad(angle)
        angle = -c.gear_ratio * c.error_rad * sin(c.error_order * angle + c.error_phase)
        angle -= c.gear_ratio * bend
    return angle if c.error_rad or bend_rad is not None else 0.0


def loss_table(side):
    """Return the losses of the joint's file over what the gear transmits, without a Stribeck peak: that is a deviation."""
    joint = side.joint
    if joint.efficiency is None:
        joint = replace(joint, friction=replace(joint.friction, stribeck_nm=0.0))
    return LossTable(
        LossModel(joint).loss,
        joint.gear_ratio,
        joint.torque_constant_nm_per_a,
        side.drive.current_limit_a,
    )


def joint_friction(side, table=None):
    """Return the friction law of a true joint from its file's losses (`table`, else made here) and its deviations."""
    joint, d = side.joint, side.deviations
    viscous = (d.viscous_scale - 1.0) * joint.friction.viscous_nms_per_rad
    table = loss_table(side) if table is None else table
    return JointFriction(table, d.friction_scale, viscous, d.stribeck_nm, d.stribeck_velocity_rad_s)


# One joint in its own frame -------------------------------------------------------------------------------------------


cdef double torsion(const Constants *c, double turned, double angle, double link) noexcept nogil:
    """Return δ = θm/G + e(θm) - θl; turned: θm/G."""
    if c.error_rad:
        turned += c.error_rad * sin(c.error_order * angle + c.error_phase)
    return turned - link


cdef double transmission(const Constants *c, double angle) noexcept nogil:
    """Return dδ/dθm = 1/G + e' in units of 1/G."""
    return 1.0 + c.error_slope * cos(c.error_order * angle + c.error_phase) if c.error_rad else 1.0


cdef double spring(const Constants *c, double torsion, double rate, double slip) noexcept nogil:
    """Return τ = K δ + D dδ/dt + H z."""
    return c.stiffness * torsion + c.damping * rate + c.slip_nm * slip


cdef double push(
    const Constants *c, JointState *s, JointFriction friction, double current, double link_velocity, double h
) noexcept:
    """Advance the motor's velocity by h seconds, Eq. (1); return τ."""
    cdef double per_gear = 1.0 / c.gear_ratio
    cdef double per_motor = h / c.rotor_inertia
    cdef double slope = transmission(c, s.angle)
    cdef double torque = spring(c, s.torsion, s.velocity * per_gear * slope - link_velocity, s.slip)
    cdef double ripple = c.ripple_nm * cos(c.ripple_order * s.angle + c.ripple_phase)
    cdef double w = s.velocity + (
        per_motor * c.torque_constant * current - per_motor * per_gear * (torque * slope + ripple)
    )
    cdef double stop = per_motor * per_gear * friction.at(torque, w * per_gear)
    s.velocity = w - stop if w > stop else w + stop if w < -stop else 0.0
    s.loss_w = stop * fabs(s.velocity) / per_motor  # F = G Jm stop / h at the joint side, times |w|/G
    return torque


cdef void turn(const Constants *c, JointState *s, double link, double h) noexcept nogil:
    """Advance the motor's angle by h seconds, to this link angle; with it δ and z."""
    cdef double before = s.torsion
    s.angle += h * s.velocity
    s.torsion = torsion(c, s.angle * (1.0 / c.gear_ratio), s.angle, link)
    s.slip = fmin(fmax(s.slip + c.per_travel * (s.torsion - before), -1.0), 1.0) if c.slip_nm else s.slip


cdef class Pair:
    """A value of both joints, read and set by index 0 and 1; equal to any sequence of the same two values."""

    def __len__(self):
        return 2

    def __getitem__(self, int k):
        return self.at(k)[0]

    def __setitem__(self, int k, double value):
        self.at(k)[0] = value

    def __eq__(self, other):
        if isinstance(other, (Pair, list, tuple)):
            return [*self] == [*other]
        return NotImplemented

    __hash__ = None

    def __repr__(self):
        return repr([*self])

    cdef double *at(self, int k) except NULL:
        if not 0 <= k < 2:
            raise IndexError("joints are 0 and 1")
        return self.two if k else self.one


# Both joints ----------------------------------------------------------------------------------------------------------


cdef class Plant:
    """State and equations of the bench. Angles in rad, velocities in rad/s; `link_*` is joint 1's frame.

    Public state (may be set before a run): motor_position, motor_velocity (of both joints, motor side),
    link_position, link_velocity, slip (z of both joints); `drives` are the control loops, `temperatures` the
    joints' thermal states. Joint files with effects need `jtqd.sim_can.effect_plant.EffectPlant` (ValueError here).
    """

    def __init__(self, parameters):
        if parameters.has_effects and type(self) is Plant:
            raise ValueError("found joints with effects, expected none: use EffectPlant")
        self.parameters = parameters
        one, two = parameters.joints
        table = loss_table(one)
        same = one.joint == two.joint and one.drive.current_limit_a == two.drive.current_limit_a
        self.friction_1 = joint_friction(one, table)
        self.friction_2 = joint_friction(two, table if same else None)
        self.drive_1, self.drive_2 = DriveControl(one), DriveControl(two)
        self.temperature_1, self.temperature_2 = JointTemperature(one.thermal), JointTemperature(two.thermal)
        self.friction = (self.friction_1, self.friction_2)
        self.drives = (self.drive_1, self.drive_2)
        self.temperatures = (self.temperature_1, self.temperature_2)
        self._joints = (_constants(one), _constants(two))
        self._link_inertia = (one.link_inertia, two.link_inertia)
        for k, side in enumerate(parameters.joints):
            self.constants[k] = self._joints[k]._asdict()
            self.link_inertia[k] = side.link_inertia
            self.coulomb_nm[k] = side.joint.friction.coulomb_nm
            self.viscous_nms_per_rad[k] = side.joint.friction.viscous_nms_per_rad
            self.viscous_scale[k] = side.deviations.viscous_scale
            self.state[k] = JointState(angle=relaxed_angle(self._joints[k]), velocity=0.0, slip=0.0, torsion=0.0, loss_w=0.0)
        self.day_viscous[0], self.day_viscous[1] = NOMINAL_DAY.viscous
        self.warming = any(side.thermal.kelvin_per_w > 0.0 for side in parameters.joints)
        self.substep_s = substep_limit(parameters)
        self.link_position = self.link_velocity = 0.0
        self.external_nm = self.next_external_nm = self.until_next_s = 0.0

    @property
    def motor_position(self):
        """Angles of both motors, rad."""
        return self.pair(&self.state[0].angle, &self.state[1].angle)

    @motor_position.setter
    def motor_position(self, values):
        self.state[0].angle, self.state[1].angle = values

    @property
    def motor_velocity(self):
        """Velocities of both motors, rad/s."""
        return self.pair(&self.state[0].velocity, &self.state[1].velocity)

    @motor_velocity.setter
    def motor_velocity(self, values):
        self.state[0].velocity, self.state[1].velocity = values

    @property
    def slip(self):
        """z of both joints."""
        return self.pair(&self.state[0].slip, &self.state[1].slip)

    @slip.setter
    def slip(self, values):
        self.state[0].slip, self.state[1].slip = values

    @property
    def _loss_w(self):
        """Power of the friction of both joints in the last integration step, W."""
        return self.pair(&self.state[0].loss_w, &self.state[1].loss_w)

    cdef Pair pair(self, double *one, double *two):
        cdef Pair pair = Pair.__new__(Pair)
        pair.plant, pair.one, pair.two = self, one, two
        return pair

    def begin_run(self):
        """Start a run: the drives are about to be enabled; the time that effects may depend on counts from here."""

    def begin_day(self, day):
        """Set friction and temperature of another day; both joints are as warm as their surroundings."""
        self.day_viscous[0], self.day_viscous[1] = day.viscous
        self.temperature_1.start(day.temperature_k[0])
        self.temperature_2.start(day.temperature_k[1])
        self.set_friction(0, self.friction_1, self.temperature_1)
        self.set_friction(1, self.friction_2, self.temperature_2)

    cdef void set_friction(self, int k, JointFriction friction, JointTemperature temperature) noexcept:
        """Set the Coulomb and viscous friction of the present day and temperature, as differences to the file's."""
        cdef double viscous = self.viscous_scale[k] * (1.0 + self.day_viscous[k]) * temperature.viscous
        friction.differ(
            (temperature.coulomb - 1.0) * self.coulomb_nm[k], (viscous - 1.0) * self.viscous_nms_per_rad[k]
        )

    def command(self, int drive, int mode, double target):
        """Set mode and target of drive 0 or 1; see `jtqd.sim_can.source`."""
        self.drives[drive].command(mode, target, self.state[drive].velocity)

    def push(self, double torque_nm, double after_s=0.0):
        """Push the links with torque_nm [Nm, joint 1's frame], on joint 2's side of the sensor, from after_s [s] on."""
        self.next_external_nm, self.until_next_s = torque_nm, after_s

    cpdef step(self, double dt_s):
        """Advance by dt_s: whole control cycles of about 1 ms, each in equal integration steps of at most `substep_s`.

        Raises ValueError for a time that is not finite.
        """
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
            self.drive_1.plan(cycle)
            self.drive_2.plan(cycle)
            self._integrate(steps, cycle / steps)
            if self.warming:
                self.warm(cycle)

    cdef void warm(self, double dt_s) noexcept:
        """Add the losses of dt_s seconds to the joints' temperatures."""
        if self.temperature_1.add(self.state[0].loss_w, dt_s):
            self.set_friction(0, self.friction_1, self.temperature_1)
        if self.temperature_2.add(self.state[1].loss_w, dt_s):
            self.set_friction(1, self.friction_2, self.temperature_2)

    cpdef _integrate(self, int steps, double h):
        """Integrate `steps` steps of h seconds."""
        cdef const Constants *c1 = &self.constants[0]
        cdef const Constants *c2 = &self.constants[1]
        cdef JointState *one = &self.state[0]
        cdef JointState *two = &self.state[1]
        cdef double link = self.link_position, link_velocity = self.link_velocity
        cdef double per_link = h / (self.link_inertia[0] + self.link_inertia[1])
        cdef double i1, i2, torque_1, torque_2
        one.torsion = torsion(c1, one.angle * (1.0 / c1.gear_ratio), one.angle, link)
        two.torsion = torsion(c2, two.angle * (1.0 / c2.gear_ratio), two.angle, -link)
        for _ in range(steps):
            i1 = self.drive_1.step(h, one.velocity)
            i2 = self.drive_2.step(h, two.velocity)
            torque_1 = push(c1, one, self.friction_1, i1, link_velocity, h)
            torque_2 = push(c2, two, self.friction_2, i2, -link_velocity, h)
            if self.external_nm != self.next_external_nm:
                self.until_next_s -= h
                if self.until_next_s < 0.0:
                    self.external_nm = self.next_external_nm
            link_velocity += per_link * (torque_1 - torque_2 + self.external_nm)  # (2)
            link += h * link_velocity
            turn(c1, one, link, h)
            turn(c2, two, -link, h)
        self.link_position, self.link_velocity = link, link_velocity

    cdef double torsion_of(self, int k) noexcept nogil:
        """Return δ of a joint in rad, own frame."""
        cdef double angle = self.state[k].angle, link = -self.link_position if k else self.link_position
        return torsion(&self.constants[k], angle / self.constants[k].gear_ratio, angle, link)

    cdef double torque_of(self, int k) noexcept nogil:
        """Return τ of a joint in Nm, own frame."""
        cdef const Constants *c = &self.constants[k]
        cdef const JointState *s = &self.state[k]
        cdef double link_velocity = -self.link_velocity if k else self.link_velocity
        cdef double rate = s.velocity / c.gear_ratio * transmission(c, s.angle) - link_velocity
        return spring(c, self.torsion_of(k), rate, s.slip)

    def joint_torques(self):
        """Return (τ1, τ2): torque of each flexible spline in Nm, Eq. (3), own frames."""
        return self.torque_of(0), self.torque_of(1)

    cpdef double sensor_torque(self) except? -1.0:
        """Return the true torque in the sensor, Nm: τ1 - Jl1 dwl1/dt."""
        cdef double one = self.torque_of(0), two = self.torque_of(1)
        return one - self.link_inertia[0] / (self.link_inertia[0] + self.link_inertia[1]) * (one - two + self.external_nm)

    def energy(self):
        """Return kinetic and elastic energy and the ripple's potential, J. Without motor current it can only fall."""
        cdef double total = 0.5 * (self.link_inertia[0] + self.link_inertia[1]) * self.link_velocity**2
        cdef const Constants *c
        cdef const JointState *s
        for k in range(2):
            c, s = &self.constants[k], &self.state[k]
            total += 0.5 * c.rotor_inertia * s.velocity**2 + 0.5 * c.stiffness * self.torsion_of(k) ** 2
            total += 0.5 * c.slip_nm / c.per_travel * s.slip**2
            if c.ripple_order > 0.0:
                total += (
                    c.ripple_nm / (c.gear_ratio * c.ripple_order) * sin(c.ripple_order * s.angle + c.ripple_phase)
                )
        return total
