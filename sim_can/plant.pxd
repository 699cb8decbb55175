"""Joints of a plant file as flat blocks; the equations stand in plant.pyx."""

cimport cython

from jtqd.sim_can.drives cimport TwoJoints

@cython.final
cdef class JointTemperature:
    cdef double usual, reference, kelvin_per_w, time_constant, viscous_per_k, coulomb_per_k
    cdef double ambient, heat_j, time_s
    cdef public double celsius
    cdef readonly double viscous, coulomb
    cpdef bint add(self, double power_w, double dt_s) noexcept
    cdef void factors(self) noexcept

@cython.final
cdef class LossTable:
    cdef readonly double torque_limit, per_torque_step, per_velocity_step
    cdef readonly int last_row
    cdef readonly object forward, reverse
    cdef double[:, ::1] forward_rows, reverse_rows
    cdef int columns
    cdef double at(self, double torque, double velocity) noexcept nogil

@cython.final
cdef class JointFriction:
    cdef LossTable table
    cdef double scale, stribeck, inverse_vs, reach, constant, viscous
    cpdef void differ(self, double constant_nm, double viscous_nms_per_rad) noexcept
    cdef double at(self, double torque, double velocity) noexcept nogil

cdef struct Constants:  # `plant_file.JointConstants` as a block
    double gear_ratio, torque_constant, rotor_inertia, stiffness, damping
    double ripple_nm, ripple_order, ripple_phase
    double error_rad, error_order, error_phase, error_slope
    double slip_nm, per_travel

cdef struct JointState:  # of one joint in its own frame
    double angle, velocity  # motor side
    double slip  # z
    double torsion  # δ within a control cycle
    double loss_w  # power of the friction in the last integration step

cdef class Plant(TwoJoints):
    cdef readonly tuple friction, temperatures
    cdef public list motor_position, motor_velocity, slip, loss_w
    cdef Constants constants[2]
    cdef double link_inertia[2]
    cdef object day_viscous
    cdef bint warming
    cdef JointState state(self, int k) except *
    cdef double torque(self, int k) except? -1.0
