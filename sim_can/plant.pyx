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

A gear's losses depend on what it transmits, F(τ, v), not on the motor's current: `LossTable` turns the joint file's law of
current and velocity into a table of that, `JointFriction` adds what the true joint differs from its file,
`JointTemperature` is one thermal mass that the friction warms.

Integration is semi-implicit Euler (velocities first, then positions with the new velocities). Friction is
implicit: within a step its impulse can stop the motor but never turn it round, h F/(G Jm) against |w|. So a
joint sticks at exactly zero velocity, does not creep, and no step size makes friction unstable. Pure: no
clock.
"""

from libc.math cimport NAN, cos, exp, fabs, fmax, fmin, sin

from jtqd.sim_can.drives cimport Truth, TwoJoints

from array import array
from dataclasses import replace
from typing import Final

from jtqd.estimator.losses import LossModel
from jtqd.sim_can.plant_file import substep_limit

# Losses and temperature

UPDATE_S: Final = 0.1
"""Of the temperature; with time constants of at least 10 s a step is below 1 % of any change."""

cdef double UPDATE = UPDATE_S


cdef class JointTemperature:
    """Temperature T of one joint: warmed by its own losses, cooled by its surroundings, felt by its friction.

        T' = (T_ambient + R P - T) / tau          P: power of the losses [W]
        viscous share of the losses times exp(-b (T - T_ref)), Coulomb share times exp(-c (T - T_ref))

    One thermal mass, as the grease that carries the viscous friction has no thermometer of its own either: the measured
    temperature is this one. `viscous` and `coulomb` are the factors of the two shares at the present temperature.
    """

    def __init__(self, thermal):
        self.usual = thermal.ambient_c
        self.reference = thermal.reference_c
        self.kelvin_per_w, self.time_constant = thermal.kelvin_per_w, thermal.time_constant_s
        self.viscous_per_k, self.coulomb_per_k = thermal.viscous_per_k, thermal.coulomb_per_k
        self.start(0.0)

    def start(self, double difference_k):
        """Begin a day in surroundings of `difference_k` above the usual ones, with the joint as warm as these."""
        self.ambient = self.celsius = self.usual + difference_k
        self.heat_j = self.time_s = 0.0
        self.factors()

    cpdef bint add(self, double power_w, double dt_s) noexcept:
        """The losses were power_w for dt_s. True when temperature and factors are new: each UPDATE_S."""
        cdef double final
        self.heat_j += power_w * dt_s
        self.time_s += dt_s
        if self.time_s < UPDATE:
            return False
        final = self.ambient + self.kelvin_per_w * self.heat_j / self.time_s
        self.celsius = final + (self.celsius - final) * exp(-self.time_s / self.time_constant)
        self.heat_j = self.time_s = 0.0
        self.factors()
        return True

    cdef void factors(self) noexcept:
        cdef double above = self.celsius - self.reference
        self.viscous = exp(-self.viscous_per_k * above)
        self.coulomb = exp(-self.coulomb_per_k * above)


LOWEST_TABLE_VELOCITY_RAD_S: Final = 0.2
"""Table I holds for 0.2 to 3 rad/s and up to 5 A. Below 0.2 rad/s an estimator's loss law may be smoothed through zero
velocity; a real joint sticks there. So the table is taken from 0.2 rad/s on and continued below as a straight line.
"""
VELOCITY_STEP_RAD_S: Final = 0.1
HIGHEST_TABLE_VELOCITY_RAD_S: Final = 3.6
TORQUE_STEPS: Final = 400

cdef double COLUMNS = TORQUE_STEPS
cdef double LAST_COLUMN = TORQUE_STEPS - 1e-9


cdef class LossTable:
    """F(τ, v) >= 0 [Nm]: loss of a joint that transmits τ at joint velocity v, by bilinear interpolation.

    A law given over current (Table I: τ = η(i, v) G Kt i) is inverted once: at constant velocity the motor
    must carry both, so G Kt i = τ + loss(i, v) for every i; where i moves, (τ, loss) is a curve, and this
    table holds its points. Friction then depends on what the gear transmits, not on the motor current: the
    same at standstill of the motor's inertia term, different when the rotor accelerates (τ, not i, loads the
    teeth). In steady state both are the same and η is Table I's.

    Args:
        loss: loss(current [A], joint velocity [rad/s]) -> Nm, signed like the velocity.
        gear_ratio: G. torque_constant_nm_per_a: Kt of the law (the nominal one, also where the plant's true
        Kt deviates).
        highest_current_a: the law is tabulated for |i| up to this; beyond, the loss stays what it is there.

    Attributes:
        forward, reverse: magnitudes for either direction of motion; rows by velocity k * 0.1 rad/s, columns by torque.
    """

    def __init__(self, loss, double gear_ratio, double torque_constant_nm_per_a, double highest_current_a):
        nm_per_a = gear_ratio * torque_constant_nm_per_a
        self.torque_limit = nm_per_a * highest_current_a
        self.per_torque_step = TORQUE_STEPS / (2.0 * self.torque_limit)
        self.per_velocity_step = 1.0 / VELOCITY_STEP_RAD_S
        self.last_row = round(HIGHEST_TABLE_VELOCITY_RAD_S / VELOCITY_STEP_RAD_S) - 1
        self.columns = TORQUE_STEPS + 1
        self.forward = self.forward_rows = _rows(loss, nm_per_a, highest_current_a, +1.0)
        self.reverse = self.reverse_rows = _rows(loss, nm_per_a, highest_current_a, -1.0)

    def magnitude(self, double torque_nm, double velocity_rad_s):
        """Return F(τ, v) in Nm, never negative; the sign of v selects the direction (v = 0 counts as forward)."""
        return self.at(torque_nm, velocity_rad_s)

    cdef double at(self, double torque, double velocity) noexcept nogil:
        """As `magnitude`, for the plant. Whatever is not a number lies at the table's end."""
        cdef const double *low = &self.reverse_rows[0, 0] if velocity < 0.0 else &self.forward_rows[0, 0]
        cdef const double *high
        cdef double x = fabs(velocity) * self.per_velocity_step
        cdef double y = (torque + self.torque_limit) * self.per_torque_step
        cdef double low_value
        cdef int k = self.last_row, m
        if x < k + 1.0:
            k = <int>x
        else:
            x = k + 1.0
        if y < 0.0:
            y = 0.0
        elif not y < COLUMNS:
            y = LAST_COLUMN
        m = <int>y
        y -= m
        low += k * self.columns + m
        high = low + self.columns
        low_value = low[0] + y * (low[1] - low[0])
        return low_value + (x - k) * (high[0] + y * (high[1] - high[0]) - low_value)


def _rows(loss, double nm_per_a, double highest, double sign):
    """Return the magnitudes of the loss for one direction of motion."""
    cdef int count = round(HIGHEST_TABLE_VELOCITY_RAD_S / VELOCITY_STEP_RAD_S) + 1
    cdef int first = round(LOWEST_TABLE_VELOCITY_RAD_S / VELOCITY_STEP_RAD_S)
    cdef int last = 6 * TORQUE_STEPS
    cdef int k, n, m, columns = TORQUE_STEPS + 1
    # not numpy's arrays: it would be 11 MB in a process that needs no more of it
    table = memoryview(array("d", bytes(8 * count * columns))).cast("B").cast("d", (count, columns))
    cdef double[:, ::1] rows = table
    cdef double[::1] losses = array("d", bytes(8 * (last + 1)))
    cdef double[::1] torques = array("d", bytes(8 * (last + 1)))
    cdef double v, i, clipped, at = NAN, value = NAN, x
    for k in range(first, count):
        v, at = sign * k * VELOCITY_STEP_RAD_S, NAN
        for n in range(last + 1):
            # three times the range in current, so that the curve covers the torque grid where η is small, too
            i = _between(-3.0 * highest, 3.0 * highest, n, last)
            clipped = fmax(-highest, fmin(i, highest))
            if clipped != at:
                at, value = clipped, loss(clipped, v)
            losses[n], torques[n] = value, nm_per_a * i - value
            if n:  # a law may bend back where it is extrapolated; the inverse needs a rising curve
                torques[n] = fmax(torques[n], torques[n - 1])
        n = 0
        for m in range(columns):
            x = _between(-nm_per_a * highest, nm_per_a * highest, m, TORQUE_STEPS)
            while n < last - 1 and torques[n + 1] <= x:
                n += 1
            rows[k, m] = fmax(sign * _on_line(x, &torques[n], &losses[n]), 0.0)
    for k in range(first):
        for m in range(columns):
            rows[k, m] = fmax(rows[first, m] - (first - k) * (rows[first + 1, m] - rows[first, m]), 0.0)
    return table


cdef double _between(double low, double high, int n, int steps) noexcept nogil:
    """Return the n-th of `steps` + 1 numbers from low to high."""
    return high if n == steps else low + n * ((high - low) / steps)


cdef double _on_line(double x, const double *xs, const double *ys) noexcept nogil:
    """Return the value at x of the line through two points."""
    return ys[0] + (x - xs[0]) * ((ys[1] - ys[0]) / (xs[1] - xs[0]))


cdef class JointFriction:
    """Friction magnitude of one true joint: scaled loss table, constant and viscous parts, Stribeck peak.

    F(τ, v) = scale * table(τ, v) + c0 + c1 |v| + Fs exp(-(v / vs)²), never below zero. c0 and c1 are what the
    joint's Coulomb and viscous friction differ from its file's (`differ`), with temperature and from day to
    day. The Stribeck term is below 1e-6 Fs at 0.2 rad/s for vs <= 0.05 rad/s.
    """

    def __init__(
        self,
        LossTable table not None,
        double scale=1.0,
        double viscous_nms_per_rad=0.0,
        double stribeck_nm=0.0,
        double stribeck_velocity_rad_s=0.05,
    ):
        self.table = table
        self.scale = scale
        self.stribeck = stribeck_nm
        self.inverse_vs = 1.0 / stribeck_velocity_rad_s
        self.reach = 4.0 * stribeck_velocity_rad_s if stribeck_nm > 0.0 else -1.0
        self.differ(0.0, viscous_nms_per_rad)

    cpdef void differ(self, double constant_nm, double viscous_nms_per_rad) noexcept:
        """Set how much more (or less) Coulomb and viscous friction there is than in the table."""
        self.constant = constant_nm
        self.viscous = viscous_nms_per_rad

    def __call__(self, double torque_nm, double velocity_rad_s):
        """Return the magnitude in Nm at transmitted torque τ and joint velocity v (its sign gives the direction)."""
        return self.at(torque_nm, velocity_rad_s)

    cdef double at(self, double torque, double velocity) noexcept nogil:
        """As `__call__`, for the plant."""
        cdef double speed = fabs(velocity), x
        cdef double force = self.scale * self.table.at(torque, velocity) + self.viscous * speed + self.constant
        if speed < self.reach:
            x = speed * self.inverse_vs
            force += self.stribeck * exp(-x * x)
        return force if force > 0.0 else 0.0


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
    return JointFriction(table, d.friction_scale, viscous, d.stribeck.torque_nm, d.stribeck.velocity_rad_s)


# One joint in its own frame


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


# Both joints


cdef class Plant(TwoJoints):
    """State and equations of the bench. Angles in rad, velocities in rad/s; `link_*` is joint 1's frame.

    Public state (may be set before a run): motor_position, motor_velocity (of both joints, motor side),
    link_position, link_velocity, slip (z of both joints); `drives` are the control loops, `temperatures` the
    joints' thermal states, loss_w the power of both joints' friction in the last integration step [W]. Joint files with
    effects need `jtqd.sim_can.effect_plant.EffectPlant` (ValueError here).
    """

    def __init__(self, parameters):
        if parameters.has_effects and type(self) is Plant:
            raise ValueError("found joints with effects, expected none: use EffectPlant")
        TwoJoints.__init__(self, parameters, substep_limit(parameters))
        one, two = parameters.joints
        table = loss_table(one)
        same = one.joint == two.joint and one.drive.current_limit_a == two.drive.current_limit_a
        self.friction = (joint_friction(one, table), joint_friction(two, table if same else None))
        self.temperatures = (JointTemperature(one.thermal), JointTemperature(two.thermal))
        for k, side in enumerate(parameters.joints):
            self.constants[k] = side.constants._asdict()
            self.link_inertia[k] = side.true_joint.link_inertia_kgm2
        self.warming = any(side.thermal.kelvin_per_w > 0.0 for side in parameters.joints)
        self.motor_position = [relaxed_angle(side.constants) for side in parameters.joints]
        self.motor_velocity, self.slip, self.loss_w = [0.0, 0.0], [0.0, 0.0], [0.0, 0.0]
        self.day_viscous = (0.0, 0.0)

    def begin_day(self, day):
        """Set friction and temperature of another day; both joints are as warm as their surroundings."""
        self.day_viscous = day.viscous
        for k in range(2):
            self.temperatures[k].start(day.temperature_k[k])
            self.set_friction(k)

    def set_friction(self, int k):
        """Set the Coulomb and viscous friction of the present day and temperature, as differences to the file's."""
        side, temperature = self.parameters.joints[k], self.temperatures[k]
        cdef double viscous = side.deviations.viscous_scale * (1.0 + self.day_viscous[k]) * temperature.viscous
        cdef double coulomb_nm = side.joint.friction.coulomb_nm, viscous_nms = side.joint.friction.viscous_nms_per_rad
        self.friction[k].differ((temperature.coulomb - 1.0) * coulomb_nm, (viscous - 1.0) * viscous_nms)

    cdef int warm(self, double dt_s) except -1:
        cdef int k
        if self.warming:
            for k in range(2):
                if (<JointTemperature>self.temperatures[k]).add(self.loss_w[k], dt_s):
                    self.set_friction(k)
        return 0

    cpdef _integrate(self, int steps, double h):
        cdef const Constants *c1 = &self.constants[0]
        cdef const Constants *c2 = &self.constants[1]
        cdef JointState one = self.state(0), two = self.state(1)
        cdef JointFriction friction_1 = self.friction[0], friction_2 = self.friction[1]
        cdef double link = self.link_position, link_velocity = self.link_velocity
        cdef double per_link = h / (self.link_inertia[0] + self.link_inertia[1])
        cdef double i1, i2, torque_1, torque_2
        one.torsion = torsion(c1, one.angle * (1.0 / c1.gear_ratio), one.angle, link)
        two.torsion = torsion(c2, two.angle * (1.0 / c2.gear_ratio), two.angle, -link)
        for _ in range(steps):
            i1 = self.drive_1.step(h, one.velocity)
            i2 = self.drive_2.step(h, two.velocity)
            torque_1 = push(c1, &one, friction_1, i1, link_velocity, h)
            torque_2 = push(c2, &two, friction_2, i2, -link_velocity, h)
            link_velocity += per_link * (torque_1 - torque_2 + self.external(h))  # (2)
            link += h * link_velocity
            turn(c1, &one, link, h)
            turn(c2, &two, -link, h)
        self.link_position, self.link_velocity = link, link_velocity
        self.motor_position = [one.angle, two.angle]
        self.motor_velocity = [one.velocity, two.velocity]
        self.slip, self.loss_w = [one.slip, two.slip], [one.loss_w, two.loss_w]

    cdef JointState state(self, int k) except *:
        """Return the state of a joint, own frame."""
        cdef JointState s
        cdef double link = -self.link_position if k else self.link_position
        s.angle, s.velocity, s.slip, s.loss_w = self.motor_position[k], self.motor_velocity[k], self.slip[k], self.loss_w[k]
        s.torsion = torsion(&self.constants[k], s.angle / self.constants[k].gear_ratio, s.angle, link)
        return s

    cdef Truth truth(self, int k) except *:
        cdef Truth truth
        truth.motor_rad, truth.motor_rad_s = self.motor_position[k], self.motor_velocity[k]
        truth.link_rad = -self.link_position if k else self.link_position
        truth.current_a = (self.drive_2 if k else self.drive_1).current_a
        truth.celsius = (<JointTemperature>self.temperatures[k]).celsius
        return truth

    cdef double torque(self, int k) except? -1.0:
        """Return τ of a joint in Nm, own frame, Eq. (3)."""
        cdef const Constants *c = &self.constants[k]
        cdef JointState s = self.state(k)
        cdef double link_velocity = -self.link_velocity if k else self.link_velocity
        return spring(c, s.torsion, s.velocity / c.gear_ratio * transmission(c, s.angle) - link_velocity, s.slip)

    def joint_torques(self):
        return self.torque(0), self.torque(1)

    cpdef double sensor_torque(self) except? -1.0:
        cdef double one = self.torque(0), two = self.torque(1)  # τ1 - Jl1 dwl1/dt
        return one - self.link_inertia[0] / (self.link_inertia[0] + self.link_inertia[1]) * (one - two + self.external_nm)
