"""Observers and their guard: parameters, states, outputs; the equations stand in observer.pyx."""

from libc.math cimport expm1

from jtqd.estimator.losses cimport MOST_NODES, FrictionLaw

cdef struct Sample:
    double dt_s  # since the sample before
    double current_a, motor_position_rad, motor_velocity_rad_s, link_position_rad
    double temperature_c  # NaN where it is not known

cdef struct Observed:  # torques [Nm, joint side], velocities [rad/s, joint side]
    double raw_nm, tob_nm, joint_velocity_rad_s, link_velocity_rad_s

cdef struct ObserverLaw:
    double gear, inverse_gear, kt, inertia_rate, rate, link_rate
    FrictionLaw friction

cdef struct ObserverState:
    double u, v, friction  # inputs of the last sample
    double z, z_v, z_friction  # filtered
    double link, link_velocity

cdef struct Inputs:  # of the filter: u = i Kt + J g w, v, deflection d, waves, direction
    double u, v, d, cos1, sin1, cos2, sin2, cos4, sin4, direction

cdef struct FusedObserved:  # as Observed, and the filtered waves; open: half width of the slip's bounds, 0 once it is known
    double raw_nm, joint_velocity_rad_s, link_velocity_rad_s, torsion_nm
    double cos1, sin1, cos2, sin2, cos4, sin4, direction, open_nm, ahead_nm  # ahead: torsion through its own filter, less torsion_nm
    double behind_rad2  # product of what the tracking filter leaves of this deflection and the last; 0 without it

cdef struct Reference:  # of a sensor, delayed like the estimate
    double last, z, since, settled

cdef struct Wave:
    double order, cos, sin

cdef enum: MOST_LINK_ORDERS = 6
cdef enum: MOST_HARDENINGS = 8
cdef enum: MOST_SLIPS = 7  # with the one of `hysteresis_nm`

cdef struct Hardening:  # of the spring beyond a deflection
    double deflection, stiffness

cdef struct Slip:
    double half_nm, inverse_travel

cdef struct Bounds:  # of a slip's z
    double low, high

cdef struct TorsionTrack:  # d = level + wave; quarter: the wave a quarter of its turn ago; pij: covariance, noise of d is 1
    double level, rate, wave, quarter
    double p00, p01, p02, p03, p11, p12, p13, p22, p23, p33

cdef struct FusedObserverLaw:
    double gear, inverse_gear, kt, inertia_rate, rate, link_rate
    bint apart  # the torsion has a filter of its own
    double torsion_rate, torsion_share  # share: rate/torsion_rate
    double tracking, tracking_wave  # rates of the torsion's tracking filter; 0: the torsion has a low pass instead
    double stiffness, cubic, zero, damping, torsion_limit
    Wave two, four  # kinematic error at the ripple orders, which costs no further cos and sin
    int others, link_waves, hardenings, slips
    Wave other[MOST_NODES]
    Wave link_wave[MOST_LINK_ORDERS]
    Hardening hardening[MOST_HARDENINGS]
    Slip slip[MOST_SLIPS]

cdef struct FusedObserverState:
    Inputs last, z
    double d
    double torsion, torsion_z  # through the torsion's own filter, and also through the rest of the motor path's
    Bounds bounds[MOST_SLIPS]
    double link, link_velocity
    TorsionTrack track
    double d_rate, d_moved  # of the tracked deflection: rate of the filter, and of the readings

cdef struct GuardLaw:
    double max_gap, stop, leave, raw_limit

cdef struct GuardState:
    bint running, standing
    int status

cdef struct Hold:
    double a, b0, b1, decay  # decay: 1 - a

cdef inline Hold hold(double rate, double dt) noexcept nogil:
    """Return the coefficients of one step dt > 0 of a first-order hold; expm1 keeps tiny steps exact."""
    cdef double x = rate * dt
    cdef double decay = -expm1(-x)
    cdef double share = decay / x
    cdef double a = 1.0 - decay
    return Hold(a, 1.0 - share, share - a, decay)

cdef inline double filtered(const Hold *h, double z, double now, double last) noexcept nogil:
    return h.a * z + h.b0 * now + h.b1 * last

cdef int fill_observer(ObserverLaw *law, joint, settings) except -1
cdef int fill_fused_observer(FusedObserverLaw *law, joint, torsion, settings) except -1
cdef void restart_reference(Reference *r) noexcept nogil
cdef double follow_reference(Reference *r, double rate, double max_gap, double dt, double now) noexcept nogil
cdef int fill_guard(GuardLaw *law, joint, settings) except -1
cdef void restart_guard(GuardState *g) noexcept nogil
cdef bint observe(
    const GuardLaw *guard, GuardState *g, const ObserverLaw *law, ObserverState *s, const Sample *x, Observed *out
) noexcept nogil
cdef bint observe_fused(
    const GuardLaw *guard, GuardState *g, const FusedObserverLaw *law, FusedObserverState *s, const Sample *x,
    FusedObserved *out
) noexcept nogil
