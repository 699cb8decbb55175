"""Two harmonic-drive joints that face each other through a torque sensor: equations of docs/testing.md.

Per joint, own frame, J = Jm G² and v = ω/G on the joint side:

    J dv/dt = G (Kt(T) i (1 - s (i/I_r)²) + cogging(θ)) - τ G dδ/dθ - F
    (J1 + J2) dω_link/dt = τ1 - τ2 + τ_x    sensor = τ1 - J1 dω_link/dt        τ_x: of a push, on link 2

Friction is a bristle (Canudas de Wit et al. 1995), joint side, z its deflection, g what the bristles bear while they slide:

    dz/dt = v - σ0 |v| z / g          F = σ0 z + σ1 dz/dt + c |v|^n sign(v)
    g(v, τ, θ) = (C (1 + (S - 1) exp(-(|v|/vs)^p)) + L |τ/τ_r|^q) (1 ± d) (1 + Σ a_k cos(k θ + φ_k))

Gear: transmission error, a spring of three straight parts as catalogues state it, damping, slips (Tjahjowidodo et al. 2013):

    δ = θ/G + Σ e_k cos(k θ + φ_k) - φ          τ = spring(δ) + D dδ/dt + Σ H_j z_j,   dz_j = dδ / travel_j, within -1 .. 1

Temperatures: grease, warmed by the friction, and housing with the thermometer, warmed through the grease:

    dTg/dt = (Th + Rg P - Tg) / τg          dTh/dt = (T_room + Rh P - Th) / τh
    Coulomb friction times 1 - b (Tg - T_ref);  viscous friction by Vogel's law of an oil, exp(B / (Tg - C) - B / (T_ref - C)),
    B = a (T_ref - C)², where -a is the relative slope at the reference

Semi-implicit Euler: velocities first, then angles with the new velocities; friction implicit. Pure: no clock.
"""

from libc.math cimport copysign, exp, fabs, fmax, fmin, pow

from jtqd.sim_can.drives cimport Truth, TwoJoints, waves_at, waves_of, waves_slope

from typing import Final


cdef class BristleFriction:
    """Friction of one joint with its state; `law`: `bench_file.Friction`, rated_nm: rated torque of the joint.

    inertia_kgm2: of the rotor at the joint, for the bristles' damping. Attributes: deflection [rad], torque [Nm] of the last step.
    """

    def __init__(self, law, double rated_nm, double inertia_kgm2):
        self.coulomb, self.static_share = law.coulomb_nm, law.static_ratio - 1.0
        self.inverse_vs, self.peak_exponent = 1.0 / law.stribeck_velocity_rad_s, law.stribeck_exponent
        self.load, self.load_exponent, self.per_rated = law.load_nm, law.load_exponent, 1.0 / rated_nm
        self.direction = law.direction_share
        self.viscous, self.viscous_exponent = law.viscous_nm, law.viscous_exponent
        self.stiffness = law.coulomb_nm / law.bristle_rad
        self.damping = 2.0 * law.bristle_damping_ratio * (self.stiffness * inertia_kgm2) ** 0.5
        self.waves = waves_of(law.angle)
        self.deflection = self.torque = 0.0
        self.warm(1.0, 1.0)

    cpdef void warm(self, double coulomb_factor, double viscous_factor) noexcept:
        """Set what day and temperature make of Coulomb and viscous friction."""
        self.coulomb_factor, self.viscous_factor = coulomb_factor, viscous_factor

    cpdef double sliding(self, double torque, double velocity, double angle) noexcept:
        """Return g(v, τ, θ) > 0 in Nm, without the viscous part."""
        cdef double peak = exp(-pow(fabs(velocity) * self.inverse_vs, self.peak_exponent))
        cdef double level = self.coulomb_factor * self.coulomb * (1.0 + self.static_share * peak)
        level += self.load * pow(fabs(torque) * self.per_rated, self.load_exponent)
        level *= 1.0 + self.direction if velocity >= 0.0 else 1.0 - self.direction
        return fmax(level * (1.0 + waves_at(&self.waves, angle)), 1e-3 * self.coulomb)

    cpdef double viscous_at(self, double speed) noexcept:
        """Return c |v|^n in Nm at a speed >= 0."""
        return self.viscous_factor * self.viscous * pow(speed, self.viscous_exponent) if speed > 0.0 else 0.0

    cdef double settle(
        self, double free, double mobility, double torque, double velocity, double angle, double h
    ) noexcept:
        """Return the velocity after h seconds, where it would be `free` without friction; advance the bristles.

        mobility: h / J [rad/s per Nm]. Implicit in velocity and deflection; level and viscous slope are those of
        `velocity`, so the friction is linear in the unknown and no step size makes it unstable:

            z' = (z + h v) / (1 + h a),  a = σ0 |velocity| / g,   F = σ0 z' + σ1 (z' - z) / h + c v
        """
        cdef double speed = fabs(velocity)
        cdef double slip = 1.0 + h * self.stiffness * speed / self.sliding(torque, velocity, angle)
        cdef double viscous = self.viscous_at(speed) / speed if speed > 1e-9 else 0.0
        cdef double per_velocity = (self.stiffness * h + self.damping) / slip + viscous
        cdef double held = self.stiffness * self.deflection / slip + self.damping * self.deflection * (1.0 / slip - 1.0) / h
        cdef double v = (free - mobility * held) / (1.0 + mobility * per_velocity)
        self.deflection = (self.deflection + h * v) / slip
        self.torque = held + per_velocity * v
        return v


cdef class Gear:
    """Gear of one joint with its state; `law`: `bench_file.Gear`. torsion: δ in rad after the last `turn`."""

    def __init__(self, law, double ratio):
        self.per_ratio, self.damping = 1.0 / ratio, law.damping_nms_per_rad
        self.stiffness = law.stiffness_nm_per_rad
        self.level = law.corners_nm
        self.corner[0] = self.level[0] / self.stiffness[0]
        self.corner[1] = self.corner[0] + (self.level[1] - self.level[0]) / self.stiffness[1]
        self.errors = waves_of(law.errors)
        self.slips = 0
        for slip in law.slips:
            if self.slips == MOST_SLIPS:
                raise IndexError(f"found more than {MOST_SLIPS} slips")
            self.slip_nm[self.slips], self.per_travel[self.slips] = slip.torque_nm, 1.0 / slip.travel_rad
            self.state[self.slips] = 0.0
            self.slips += 1
        self.torsion = 0.0

    cpdef double spring(self, double torsion) noexcept:
        """Return the spring's torque [Nm] at a torsion [rad]; odd."""
        cdef double size = fabs(torsion)
        if size <= self.corner[0]:
            return self.stiffness[0] * torsion
        if size <= self.corner[1]:
            return copysign(self.level[0] + self.stiffness[1] * (size - self.corner[0]), torsion)
        return copysign(self.level[1] + self.stiffness[2] * (size - self.corner[1]), torsion)

    cdef double slope(self, double angle) noexcept:
        """Return dδ/dθ, joint rad per motor rad."""
        return self.per_ratio + waves_slope(&self.errors, angle)

    cdef double torque(self, double rate) noexcept:
        """Return τ [Nm] at the present torsion and its rate [rad/s]."""
        cdef double total = self.spring(self.torsion) + self.damping * rate
        cdef int k
        for k in range(self.slips):
            total += self.slip_nm[k] * self.state[k]
        return total

    cpdef void turn(self, double angle, double link) noexcept:
        """Go to a motor angle and a link angle, joint frame [rad]."""
        cdef double torsion = angle * self.per_ratio + waves_at(&self.errors, angle) - link
        cdef double change = torsion - self.torsion
        cdef int k
        for k in range(self.slips):
            self.state[k] = fmin(fmax(self.state[k] + change * self.per_travel[k], -1.0), 1.0)
        self.torsion = torsion

    cpdef void relax(self, double angle, double link) noexcept:
        """Go there with all slips relaxed, as assembled."""
        cdef int k
        self.turn(angle, link)
        for k in range(self.slips):
            self.state[k] = 0.0


UPDATE_S: Final = 0.1
VOGEL_C: Final = -95.0
"""C of Vogel's law for a mineral oil."""

cdef double UPDATE = UPDATE_S


cdef class Warmth:
    """Thermal state of one joint; `law`: `bench_file.Warmth`.

    coulomb, viscous: factors of the friction at the present temperature of the grease.
    """

    def __init__(self, law):
        self.ambient_c, self.reference_c = law.ambient_c, law.reference_c
        self.grease_k_per_w, self.grease_s = law.grease_kelvin_per_w, law.grease_time_constant_s
        self.housing_k_per_w, self.housing_s = law.housing_kelvin_per_w, law.housing_time_constant_s
        self.coulomb_per_k = law.coulomb_per_k
        self.vogel_c = VOGEL_C
        self.vogel_k = law.viscous_per_k * (law.reference_c - VOGEL_C) ** 2
        self.start(0.0)

    cpdef void start(self, double difference_k) noexcept:
        """Begin a day in a room of `difference_k` above the usual one, the joint as warm as the room."""
        self.room_c = self.grease_c = self.housing_c = self.ambient_c + difference_k
        self.heat_j = self.time_s = 0.0
        self._factors()

    cpdef bint add(self, double power_w, double dt_s) noexcept:
        """Add losses of power_w for dt_s seconds. Returns True when temperatures and factors are new."""
        cdef double power
        self.heat_j += power_w * dt_s
        self.time_s += dt_s
        if self.time_s < UPDATE:
            return False
        power = self.heat_j / self.time_s
        self.grease_c += _share(self.time_s, self.grease_s) * (self.housing_c + self.grease_k_per_w * power - self.grease_c)
        self.housing_c += _share(self.time_s, self.housing_s) * (self.room_c + self.housing_k_per_w * power - self.housing_c)
        self.heat_j = self.time_s = 0.0
        self._factors()
        return True

    def _factors(self):
        self.coulomb = fmax(1.0 - self.coulomb_per_k * (self.grease_c - self.reference_c), 0.2)
        self.viscous = exp(self.vogel_k / (self.grease_c - self.vogel_c) - self.vogel_k / (self.reference_c - self.vogel_c))


cdef double _share(double time_s, double constant_s) noexcept:
    return 1.0 - exp(-time_s / constant_s)


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

    cdef void heat(self, double dt_s) noexcept:
        """Add the losses of dt_s seconds to the temperatures."""
        if self.warmth.add(self.loss_w, dt_s):
            self.friction.warm(self.day_coulomb * self.warmth.coulomb, self.day_viscous * self.warmth.viscous)


cdef class TowingPlant(TwoJoints):
    """Both joints and the link between them; `parameters`: `bench_file.TowingBench`. `link_*` is joint 1's frame."""

    def __init__(self, parameters):
        TwoJoints.__init__(self, parameters, parameters.longest_step_s)
        self.one, self.two = (TrueJoint(side) for side in parameters.joints)
        self.joints = (self.one, self.two)
        self.inertia_1, self.inertia_2 = (side.link_inertia_kgm2 for side in parameters.joints)
        self.one.gear.relax(0.0, 0.0)
        self.two.gear.relax(0.0, 0.0)

    def begin_day(self, day):
        for k, joint in enumerate(self.joints):
            joint.begin_day(day.temperature_k[k], day.coulomb[k], day.viscous[k])

    cpdef _integrate(self, int steps, double h):
        cdef TrueJoint one = self.one, two = self.two
        cdef double per_link = h / (self.inertia_1 + self.inertia_2)
        cdef double torque_1, torque_2
        for _ in range(steps):
            torque_1 = one.push(self.drive_1.step(h, one.velocity), self.link_velocity, h)
            torque_2 = two.push(self.drive_2.step(h, two.velocity), -self.link_velocity, h)
            self.link_velocity += per_link * (torque_1 - torque_2 + self.external(h))
            self.link_position += h * self.link_velocity
            one.turn(self.link_position, h)
            two.turn(-self.link_position, h)

    cdef int warm(self, double dt_s) except -1:
        self.one.heat(dt_s)
        self.two.heat(dt_s)
        return 0

    cdef Truth truth(self, int k) except *:
        cdef TrueJoint joint = self.two if k else self.one
        cdef Truth truth
        truth.motor_rad, truth.motor_rad_s = joint.angle, joint.velocity
        truth.link_rad = -self.link_position if k else self.link_position
        truth.current_a = (self.drive_2 if k else self.drive_1).current_a
        truth.celsius = joint.warmth.housing_c
        return truth

    def joint_torques(self):
        return self.one.torque(self.link_velocity), self.two.torque(-self.link_velocity)

    cpdef double sensor_torque(self) except? -1.0:
        cdef double one = self.one.torque(self.link_velocity), two = self.two.torque(-self.link_velocity)
        return one - self.inertia_1 / (self.inertia_1 + self.inertia_2) * (one - two + self.external_nm)
