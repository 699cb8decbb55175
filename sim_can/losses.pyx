"""Transmission losses of a true joint: friction over transmitted torque and velocity, and its temperature.

A gear's losses depend on what it transmits, F(τ, v), not on the motor's current: `LossTable` turns the joint file's law of
current and velocity into a table of that, `JointFriction` adds what the true joint differs from its file,
`JointTemperature` is one thermal mass that the friction warms. Pure.
"""

from libc.math cimport NAN, exp, fabs, fmax, fmin

from array import array
from typing import Final


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
