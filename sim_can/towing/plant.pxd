"""One joint, and two of them with the torque sensor between; the equations stand in plant.pyx."""

cimport cython

from jtqd.sim_can.drive_control cimport DriveControl
from jtqd.sim_can.towing.friction cimport BristleFriction
from jtqd.sim_can.towing.gear cimport Gear
from jtqd.sim_can.towing.warmth cimport Warmth
from jtqd.sim_can.towing.waves cimport Waves

@cython.final
cdef class TrueJoint:
    cdef readonly Gear gear
    cdef readonly BristleFriction friction
    cdef readonly Warmth warmth
    cdef readonly DriveControl drive
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
    cdef void warm(self, double dt_s) noexcept

@cython.final
cdef class TowingPlant:
    cdef readonly object parameters
    cdef readonly TrueJoint one, two
    cdef readonly tuple joints, drives
    cdef readonly double substep_s
    cdef public double link_position, link_velocity
    cdef double inertia_1, inertia_2
    cdef double external_nm, next_external_nm, until_next_s  # on link 2, joint 1's frame
    cpdef step(self, double dt_s)
    cdef void integrate(self, int steps, double h) noexcept
    cpdef double sensor_torque(self) except? -1.0
