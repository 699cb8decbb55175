"""What all benches share, whatever equations their joints have: drives, instruments, the frame of a plant, built-in motion. Pure."""

from libc.math cimport M_PI, NAN, ceil, cos, exp, fabs, fmax, fmin, isfinite, isnan, log, rint, sin, sqrt

from dataclasses import astuple
from typing import Final

OFF, VELOCITY, CURRENT = 0, 9, 10
"""Modes of operation of a drive (CiA 402, 6061h; OFF: power stage off): cyclic synchronous velocity [rad/s, motor side], and
cyclic synchronous torque [A]."""
CONTROL_CYCLE_S: Final = 0.001

cdef int IS_OFF = OFF, IS_VELOCITY = VELOCITY, IS_CURRENT = CURRENT
cdef double CONTROL_CYCLE = CONTROL_CYCLE_S


# What instruments read


cdef class Noise:
    """Normal noise of standard deviation 1 from uniform numbers in [0, 1), two at a time (Box and Muller 1958).

    uniform: `random` of a `random.Random`; the numbers are those of its `gauss`. Not numpy's, which would be 7 MB in a
    process that has to stay small.
    """

    def __init__(self, uniform):
        self.uniform = uniform

    cdef double normal(self) except? -1.0:
        cdef double angle, radius
        if self.one_left:
            self.one_left = False
            return self.left
        angle = self.uniform() * (2.0 * M_PI)
        radius = sqrt(-2.0 * log(1.0 - <double>self.uniform()))
        self.left, self.one_left = sin(angle) * radius, True
        return cos(angle) * radius


cdef class DriveSignals:
    """Measured quantities of one drive; mutable, read once per SYNC.

    motor_position_rad: motor side, multi-turn; motor_velocity_rad_s: motor side; link_position_rad: joint side; temperature_c:
    of the joint, nan where it is not measured. `enabled`: the source itself has the drive in operation (a recorded run); the
    node then reports "operation enabled" although no master sent a controlword. The plant leaves it False: its drives are
    enabled by a master or by the demo profile.
    """

    def __init__(self):
        self.temperature_c = NAN


cdef class ChannelSignal:
    """Measured torque of one sensor channel; `valid` False sets bit 0 of 6150h."""

    def __init__(self):
        self.valid = True


# Drives


cdef class DriveControl:
    """Loops of a drive; `plan` once per control cycle (1 ms), `step` once per integration step.

    Current loop (closed): di/dt = 2π B (i_ref - i), discretised exactly, |i_ref| limited; with the power stage off the current
    decays with the same time constant. Velocity loop (mode 9, motor side), e = ω_ref - ω:

        i_ref = kp e + ∫ kp/Ti e + (Jff α_ref + friction feedforward) / Kt

    ω_ref goes to a new target in a straight line (linear interpolation of CSV) within `interpolation_s` (60C2h), at least one
    control cycle, at most with the acceleration limit. The integrator stands while the current is limited in the direction of
    the error. The drive's own velocity is exact: its encoder interpolation is far finer than what it reports.
    """

    def __init__(self, side):
        joint, drive = side.joint, side.drive
        # nominal values: a drive knows no others
        kt, inertia = joint.torque_constant_nm_per_a, joint.rotor_inertia_kgm2
        self.bandwidth = 2.0 * M_PI * drive.current_bandwidth_hz
        self.kp = drive.velocity_bandwidth_rad_s * inertia / kt
        self.integral_rate = self.kp / drive.velocity_integral_time_s
        self.inertia_a = drive.acceleration_feedforward * inertia / kt
        self.friction = drive.friction_feedforward_a
        self.smooth = 0.01 * joint.gear_ratio  # friction feedforward turns over within 0.01 rad/s of the joint
        self.slope_limit = drive.acceleration_limit_rad_s2 * joint.gear_ratio
        self.limit = drive.current_limit_a
        self.mode = IS_OFF
        self.target = self.current_a = self.integral_a = 0.0
        self.reference_rad_s = self.slope_rad_s2 = 0.0
        self.interpolation_s = self.to_go_s = 0.0
        self.feedforward = self.base = 0.0
        self.decay_step, self.decay = -1.0, 0.0

    def command(self, int mode, double target, double motor_velocity_rad_s):
        """Set mode (OFF, VELOCITY, CURRENT) and target. Velocity mode starts from the present velocity and current.

        Raises ValueError for a target that is not a number.
        """
        if isnan(target):
            raise ValueError("found a target that is not a number, expected rad/s or A")
        if mode != self.mode:
            self.mode = mode
            self.reference_rad_s = motor_velocity_rad_s
            self.integral_a = self.current_a
        self.target = target
        self.to_go_s = self.interpolation_s

    cpdef void plan(self, double dt_s) noexcept:
        """Plan reference and feedforward of the next control cycle of length dt_s > 0."""
        cdef double cycles, slope, middle
        if self.mode == IS_VELOCITY:
            # whole cycles, at least one: SYNCs jitter, the line must end where a cycle ends
            cycles = rint(self.to_go_s / dt_s) if self.to_go_s > dt_s else 1.0
            self.to_go_s -= dt_s
            slope = (self.target - self.reference_rad_s) / (cycles * dt_s)
            self.slope_rad_s2 = slope = fmin(fmax(slope, -self.slope_limit), self.slope_limit)
            middle = self.reference_rad_s + 0.5 * slope * dt_s
            self.feedforward = self.inertia_a * slope + self.friction * middle / (fabs(middle) + self.smooth)
        elif self.mode == IS_CURRENT:
            self.base = fmin(fmax(self.target, -self.limit), self.limit)
        else:
            self.base = 0.0

    cpdef double step(self, double h, double motor_velocity_rad_s) noexcept:
        """Advance by h seconds and return the motor current in A."""
        cdef double error, wanted
        if self.mode == IS_VELOCITY:
            self.reference_rad_s += h * self.slope_rad_s2
            error = self.reference_rad_s - motor_velocity_rad_s
            wanted = self.kp * error + self.integral_a + self.feedforward
            if not (wanted > self.limit and error >= 0.0 or wanted < -self.limit and error <= 0.0):
                self.integral_a += h * self.integral_rate * error
            wanted = fmin(fmax(wanted, -self.limit), self.limit)
        else:
            wanted = self.base
        if h != self.decay_step:
            self.decay_step = h
            self.decay = 1.0 - exp(-self.bandwidth * h)
        self.current_a += self.decay * (wanted - self.current_a)
        return self.current_a


# Plants


cdef class TwoJoints:
    """Frame of a plant of two joints that face each other: drives, control cycles, pushes on the links. Subclasses have the laws.

    drives: the control loops of both; link_*: position [rad] and velocity [rad/s] of the links, joint 1's frame; substep_s:
    largest integration step; parameters: of the plant or bench file.
    """

    def __init__(self, parameters, double substep_s):
        self.parameters, self.substep_s = parameters, substep_s
        self.drive_1, self.drive_2 = (DriveControl(side) for side in parameters.joints)
        self.drives = (self.drive_1, self.drive_2)

    def begin_run(self):
        """Start a run: the drives are about to be enabled; the time that effects may depend on counts from here."""

    def begin_day(self, day):
        """Set friction and temperatures of another day (`source.Day`); the joints stay where they are."""
        raise NotImplementedError

    def command(self, int drive, int mode, double target):
        """Set mode and target of drive 0 or 1; see `jtqd.sim_can.source`."""
        self.drives[drive].command(mode, target, self.truth(drive).motor_rad_s)

    def push(self, double torque_nm, double after_s=0.0):
        """Push the links with torque_nm [Nm, joint 1's frame], on joint 2's side of the sensor, from after_s [s] on."""
        self.next_external_nm, self.until_next_s = torque_nm, after_s

    cdef double external(self, double h) noexcept:
        """Let h seconds pass; return the torque of the push [Nm]."""
        if self.external_nm != self.next_external_nm:
            self.until_next_s -= h
            if self.until_next_s < 0.0:
                self.external_nm = self.next_external_nm
        return self.external_nm

    cpdef step(self, double dt_s):
        """Advance by dt_s: whole control cycles of about 1 ms, each in equal integration steps of at most `substep_s`.

        Raises ValueError for a time that is not finite.
        """
        cdef double cycle
        cdef int cycles, steps
        if dt_s <= 0.0:
            return
        if not isfinite(dt_s):
            raise ValueError(f"found a step of {dt_s} s, expected a finite one")
        cycles = <int>fmax(1.0, rint(dt_s / CONTROL_CYCLE))
        cycle = dt_s / cycles
        # the small excess keeps stamps that jitter by a few nanoseconds at the same number of steps
        steps = <int>fmax(1.0, ceil(cycle / self.substep_s - 1e-3))
        for _ in range(cycles):
            self.drive_1.plan(cycle)
            self.drive_2.plan(cycle)
            self._integrate(steps, cycle / steps)
            self.warm(cycle)

    cpdef _integrate(self, int steps, double h):
        """Integrate `steps` steps of h seconds."""
        raise NotImplementedError

    cdef int warm(self, double dt_s) except -1:
        """Add the losses of dt_s seconds to the joints' temperatures."""
        raise NotImplementedError

    cdef Truth truth(self, int k) except *:
        """Return the true values of joint k, own frame."""
        raise NotImplementedError

    def joint_torques(self):
        """Return (τ1, τ2): torque of each flexible spline in Nm, own frames."""
        raise NotImplementedError

    cpdef double sensor_torque(self) except? -1.0:
        """Return the true torque in the sensor, Nm."""
        raise NotImplementedError


# Instruments


cdef Waves waves_of(entries) except *:
    """Return the waves of a bench file's list: order per turn, amplitude, phase; at most MOST_WAVES (IndexError)."""
    cdef Waves waves
    waves.count = 0
    for order, amplitude, phase in map(astuple, entries):
        if waves.count == MOST_WAVES:
            raise IndexError(f"found more than {MOST_WAVES} waves")
        waves.order[waves.count] = order
        waves.amplitude[waves.count] = amplitude
        waves.phase[waves.count] = phase
        waves.count += 1
    return waves


cdef double waves_at(const Waves *waves, double angle) noexcept nogil:
    """Return the sum at this angle."""
    cdef double total = 0.0
    cdef int k
    for k in range(waves.count):
        total += waves.amplitude[k] * cos(waves.order[k] * angle + waves.phase[k])
    return total


cdef double waves_slope(const Waves *waves, double angle) noexcept nogil:
    """Return the sum's derivative with respect to the angle."""
    cdef double total = 0.0
    cdef int k
    for k in range(waves.count):
        total -= waves.amplitude[k] * waves.order[k] * sin(waves.order[k] * angle + waves.phase[k])
    return total


cdef class Encoders:
    """Encoders and current measurement of one drive; `law`: section `measurement` of its file.

        motor = counts(θ + zero + Σ e_k cos(k θ + φ_k))          link = φ + zero + Σ e_k cos(k φ + φ_k) + noise
        current = (i + ripple(θ)) (1 + gain) + zero + noise

    The motor's velocity is the difference of two counts through a first-order low pass of `velocity_filter_s`, made in the
    drive: it has the encoder's errors, and lags by half a sample period plus that time. signals: what is read.
    """

    def __init__(self, law, Noise noise not None):
        self.count_rad = 2.0 * M_PI / law.motor_counts_per_rev
        self.filter_s, self.link_noise, self.current_noise = law.velocity_filter_s, law.link_noise_rad, law.current_noise_a
        self.current_offset = getattr(law, "current_offset_a", 0.0)
        self.motor_errors = waves_of(getattr(law, "motor_errors", ()))
        self.link_errors = waves_of(getattr(law, "link_errors", ()))
        self.current_ripple = waves_of(getattr(law, "current_ripple", ()))
        self.noise, self.signals = noise, DriveSignals()
        self.share_dt, self.share = -1.0, 1.0
        self.begin_day(0.0, 0.0, 0.0, 0.0)

    cdef int begin_day(self, double motor_zero, double link_zero, double current_zero, double current_gain) except -1:
        """Set zeros [rad, rad, A] and gain of another day."""
        self.motor_zero, self.link_zero = motor_zero, link_zero
        self.current_zero, self.current_gain = self.current_offset + current_zero, 1.0 + current_gain
        return 0

    cdef int sample(self, const Truth *truth, double dt_s) except -1:
        """Set the signals to what is read at these true values, dt_s after the last sample."""
        cdef DriveSignals signals = self.signals
        cdef double read = truth.motor_rad + self.motor_zero + waves_at(&self.motor_errors, truth.motor_rad)
        cdef double count = rint(read / self.count_rad) + 0.0  # a count is a whole number: no minus zero
        cdef double ripple = waves_at(&self.current_ripple, truth.motor_rad)
        cdef double link = truth.link_rad
        if dt_s > 0.0:
            if dt_s != self.share_dt:
                self.share_dt = dt_s
                self.share = 1.0 - exp(-dt_s / self.filter_s) if self.filter_s > 0.0 else 1.0
            signals.motor_velocity_rad_s += self.share * (
                (count - self.count) * self.count_rad / dt_s - signals.motor_velocity_rad_s
            )
        self.count = count
        signals.motor_position_rad = count * self.count_rad
        if self.link_zero or self.link_errors.count:
            link = link + self.link_zero + waves_at(&self.link_errors, truth.link_rad)
        signals.link_position_rad = link + self.link_noise * self.noise.normal()
        signals.current_a = (
            self.current_gain * (truth.current_a + ripple) + self.current_zero + self.current_noise * self.noise.normal()
        )
        signals.temperature_c = truth.celsius
        return 0


cdef class Instruments:
    """All instruments of a bench: `drives` and `channel` are what they read; sensor = gain τ + zeros + noise."""

    def __init__(self, parameters, Noise noise not None):
        sensor = parameters.sensor
        self.encoders_1, self.encoders_2 = (Encoders(side.measurement, noise) for side in parameters.joints)
        self.drives, self.channel = (self.encoders_1.signals, self.encoders_2.signals), ChannelSignal()
        self.gain, self.zero_nm, self.noise_nm = sensor.gain, sensor.offset_nm, sensor.noise_nm
        self.noise = noise

    def begin_day(self, day):
        """Set zeros and gains of another day (`source.Day`)."""
        cdef Encoders encoders
        for k, encoders in enumerate((self.encoders_1, self.encoders_2)):
            encoders.begin_day(day.motor_zero_rad[k], day.link_zero_rad[k], day.current_zero_a[k], day.current_gain[k])
        self.day_zero_nm = day.sensor_zero_nm

    def read(self, TwoJoints plant not None, double dt_s, double torque_nm, errors=None):
        """Sample everything, dt_s after the last time.

        torque_nm: at the sensor; errors: what motor encoder, link encoder and current of both joints read above the truth,
        None for nothing.
        """
        cdef Truth truth
        cdef Encoders encoders
        for k, encoders in enumerate((self.encoders_1, self.encoders_2)):
            truth = plant.truth(k)
            if errors is not None:
                motor, link, current = errors[k]
                truth.motor_rad, truth.link_rad, truth.current_a = truth.motor_rad + motor, truth.link_rad + link, truth.current_a + current
            encoders.sample(&truth, dt_s)
        self.channel.torque_nm = (
            self.gain * torque_nm + self.zero_nm + self.day_zero_nm + self.noise_nm * self.noise.normal()
        )


# Built-in motion "demo"

# A velocity trajectory of joint 1, two smooth bursts with rests between them, against a torque of joint 2 that varies on its
# own, with non-commensurate periods. Together they fill all four quadrants. Everything starts from rest with zero slope.

PERIOD_S: Final = 20.0
BURSTS: Final = (
    (1.0, 8.4, (0.66, 1.38, -0.90, 0.66)),
    (10.9, 7.6, (-0.42, -1.14, 0.54, 1.26)),
)
"""(start, length in s, amplitudes in rad/s of sin(2πk x), k = 1, 2, ..., x = -1/2..1/2 over the burst)"""
LOADS: Final = ((2.7, 7.3), (0.7, 2.9), (0.4, 1.7))
"""(amplitude in A, period in s)"""
LOAD_RISE_S: Final = 2.0

cdef struct Burst:
    double start, length
    double amplitudes[4]

cdef struct Load:
    double amplitude, period

cdef double PERIOD = PERIOD_S, RISE = LOAD_RISE_S
cdef Burst[2] bursts = [{"start": s, "length": l, "amplitudes": a} for s, l, a in BURSTS]
cdef Load[3] loads = [{"amplitude": a, "period": p} for a, p in LOADS]


cpdef double demo_velocity(double time_s) noexcept:
    """Return the velocity of joint 1 in rad/s, joint side.

    Each burst is odd about its middle, so the joint comes back to where it began; the window cos² makes
    velocity and acceleration zero at both ends.
    """
    cdef double t = time_s % PERIOD, x, window, waves = 0.0
    cdef int b, k
    for b in range(2):
        x = (t - bursts[b].start) / bursts[b].length - 0.5
        if -0.5 < x < 0.5:
            window = cos(M_PI * x)
            for k in range(4):
                waves += bursts[b].amplitudes[k] * sin(2.0 * M_PI * (k + 1) * x)
            return window * window * waves
    return 0.0


cpdef double demo_current(double time_s) noexcept:
    """Return the motor current of joint 2 in A: a sum of sines that rises smoothly from zero within LOAD_RISE_S."""
    cdef double rise = 1.0 if time_s >= RISE else 0.5 - 0.5 * cos(M_PI * time_s / RISE)
    cdef double waves = 0.0
    cdef int k
    for k in range(3):
        waves += loads[k].amplitude * sin(2.0 * M_PI * time_s / loads[k].period)
    return rise * waves
