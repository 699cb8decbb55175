"""Friction of a harmonic-drive joint as a bristle (Canudas de Wit et al. 1995), joint side.

    dz/dt = v - σ0 |v| z / g          F = σ0 z + σ1 dz/dt + c |v|^n sign(v)
    g(v, τ, θ) = (C (1 + (S - 1) exp(-(|v|/vs)^p)) + L |τ/τ_r|^q) (1 ± d) (1 + Σ a_k cos(k θ + φ_k))

z: deflection [rad, joint side]; g: what the bristles bear while they slide; v: joint velocity; τ: torque of the gear; θ: motor angle.
"""

from libc.math cimport exp, fabs, fmax, pow

from jtqd.sim_can.towing.waves cimport waves_at, waves_of


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
