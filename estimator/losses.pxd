"""Loss laws as flat parameter blocks and the functions that evaluate them; the equations stand in losses.pyx."""

cdef enum:
    MOST_NODES = 64  # of the load, and of a kinematic error's orders (jtqd.estimator.joint.MAX_NODES)

cdef struct FrictionLaw:
    double coulomb, stribeck, viscous, inverse_stribeck, static

cdef struct Quadrant:
    double c00, c10, c01, c20, c11, c02  # of |i| and |v|
    double low, high, current_max, rmse

cdef struct EfficiencyLaw:
    FrictionLaw friction
    Quadrant quadrants[4]  # 2 when v < 0, plus 1 when i < 0
    bint has_efficiency, reciprocal
    double torque_per_ampere

cdef struct LoadRow:
    double node, c, dc, f, df, q, dq

cdef struct SideLaw:
    LoadRow rows[MOST_NODES + 1]  # row n ends at node n; the first and the last lie outside
    double stribeck

cdef struct AdditiveLaw:
    int nodes
    double node[MOST_NODES]
    SideLaw positive, negative
    double inverse_vs, vmax, t0, per_k, viscous

cdef struct Loss:
    double nm    # the loss
    double half  # half the width of the interval that friction leaves open

cdef struct Interval:
    double forward, backward  # losses just before moving in the positive (>= 0) and the negative direction (<= 0)

cdef double direction_of(double velocity) noexcept nogil
cdef double friction_torque(const FrictionLaw *law, double velocity) noexcept nogil
cdef double efficiency_loss(const EfficiencyLaw *law, double current, double velocity) noexcept nogil
cdef double efficiency_rmse(const EfficiencyLaw *law, double current, double velocity) noexcept nogil
cdef Interval efficiency_standstill(const EfficiencyLaw *law, double current) noexcept nogil
cdef double thermal_friction(const AdditiveLaw *law, double temperature) noexcept nogil
cdef Loss additive_loss(const AdditiveLaw *law, double raw, double velocity, double thermal, double direction) noexcept nogil

cdef class FrictionModel:
    cdef FrictionLaw law

cdef class LossModel:
    cdef EfficiencyLaw law

cdef class AdditiveLossModel:
    cdef AdditiveLaw law

cdef struct Spread:
    double value, sigma

cdef struct UncertaintyLaw:
    double floor, u_friction, widened, load
    bint with_efficiency

cdef int fill_uncertainty(UncertaintyLaw *law, joint, settings) except -1
cdef double sigma_moving(
    const UncertaintyLaw *law, const EfficiencyLaw *losses, double raw, double current, double velocity
) noexcept nogil
cdef Spread standing(const UncertaintyLaw *law, const EfficiencyLaw *losses, double raw, double current) noexcept nogil
