"""Two joints with the torque sensor between, and their parts; the equations stand in plant.pyx."""

cimport cython

from jtqd.sim_can.drives cimport TwoJoints, Waves


@cython.final
cdef class BristleFriction:
    cdef double coulomb, static_share, inverse_vs, peak_exponent
    cdef double load, load_exponent, per_rated, direction
    cdef double viscous, viscous_exponent
    cdef double stiffness, damping
    cdef double coulomb_factor, viscous_factor
    cdef Waves waves
    cdef readonly double deflection
    cdef public double torque
    cpdef void warm(self, double coulomb_factor, double viscous_factor) noexcept
    cpdef double sliding(self, double torque, double velocity, double angle) noexcept
    cpdef double viscous_at(self, double speed) noexcept
    cdef double settle(self, double free, double mobility, double torque, double velocity, double angle, double h) noexcept

cdef enum: MOST_SLIPS = 6

@cython.final
cdef class Gear:
    cdef double per_ratio, damping
    cdef double stiffness[3]
    cdef double corner[2]  # torsion at T1 and T2
    cdef double level[2]  # T1 and T2
    cdef Waves errors
    cdef int slips
    cdef double slip_nm[MOST_SLIPS]
    cdef double per_travel[MOST_SLIPS]
    cdef double state[MOST_SLIPS]  # z_j
    cdef readonly double torsion  # δ [rad]
    cpdef double spring(self, double torsion) noexcept
    cdef double slope(self, double angle) noexcept
    cdef double torque(self, double rate) noexcept
    cpdef void turn(self, double angle, double link) noexcept
    cpdef void relax(self, double angle, double link) noexcept

@cython.final
cdef class Warmth:
    cdef double ambient_c, reference_c
    cdef double grease_k_per_w, grease_s, housing_k_per_w, housing_s
    cdef double coulomb_per_k, vogel_k, vogel_c
    cdef double room_c, heat_j, time_s
    cdef readonly double grease_c, housing_c, coulomb, viscous
    cpdef void start(self, double difference_k) noexcept
    cpdef bint add(self, double power_w, double dt_s) noexcept

@cython.final
cdef class TrueJoint:
    cdef readonly Gear gear
    cdef readonly BristleFriction friction
    cdef readonly Warmth warmth
    cdef double ratio, per_ratio, inertia  # of the rotor, joint side
    cdef double torque_constant, per_k, reference_c, saturation, per_current
    cdef Waves cogging
    cdef double day_coulomb, day_viscous
    cdef public double angle, velocity  # motor side
    cdef double loss_w
    cpdef void begin_day(self, double temperature_k, double coulomb, double viscous) noexcept
    cpdef double motor_torque(self, double current) noexcept
    cdef double torque(self, double link_velocity) noexcept
    cdef double push(self, double current, double link_velocity, double h) noexcept
    cdef void turn(self, double link, double h) noexcept
    cdef void heat(self, double dt_s) noexcept

@cython.final
cdef class TowingPlant(TwoJoints):
    cdef readonly TrueJoint one, two
    cdef readonly tuple joints
    cdef double inertia_1, inertia_2
