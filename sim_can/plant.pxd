"""State and constants of the bench as flat blocks; the equations stand in plant.pyx."""

cimport cython

from jtqd.sim_can.drive_control cimport DriveControl
from jtqd.sim_can.losses cimport JointFriction
from jtqd.sim_can.losses cimport JointTemperature

cdef struct Constants:  # `JointConstants` as a block
    double gear_ratio, torque_constant, rotor_inertia, stiffness, damping
    double ripple_nm, ripple_order, ripple_phase
    double error_rad, error_order, error_phase, error_slope
    double slip_nm, per_travel

cdef struct JointState:  # of one joint in its own frame
    double angle, velocity  # motor side
    double slip  # z
    double torsion  # δ within a control cycle
    double loss_w  # power of the friction in the last integration step

@cython.final
cdef class Pair:
    cdef Plant plant  # keeps the values alive
    cdef double *one
    cdef double *two
    cdef double *at(self, int k) except NULL

cdef class Plant:
    cdef readonly object parameters
    cdef readonly tuple friction, drives, temperatures, _joints, _link_inertia
    cdef public double substep_s, link_position, link_velocity
    cdef JointFriction friction_1, friction_2
    cdef DriveControl drive_1, drive_2
    cdef JointTemperature temperature_1, temperature_2
    cdef Constants constants[2]
    cdef JointState state[2]
    cdef double link_inertia[2]
    cdef double coulomb_nm[2]
    cdef double viscous_nms_per_rad[2]
    cdef double viscous_scale[2]
    cdef double day_viscous[2]
    cdef bint warming
    cdef double external_nm, next_external_nm, until_next_s  # on link 2, joint 1's frame
    cdef Pair pair(self, double *one, double *two)
    cdef void set_friction(self, int k, JointFriction friction, JointTemperature temperature) noexcept
    cpdef step(self, double dt_s)
    cdef void warm(self, double dt_s) noexcept
    cpdef _integrate(self, int steps, double h)
    cdef double torsion_of(self, int k) noexcept nogil
    cdef double torque_of(self, int k) noexcept nogil
    cpdef double sensor_torque(self) except? -1.0
