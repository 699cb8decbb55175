"""Networks in a cycle: native evaluation of the project's own, and the weight with which one counts.

**Evaluation**: a perceptron with tanh, of which the daemon needs no runtime in a cycle.

    h_0 = x,   h_(k+1) = tanh(h_k W_k + b_k),   answer = h_last W_last + b_last     Gemm, Tanh, ..., Gemm

ONNX Runtime loads and checks the file and stays the referee: `jtqd.estimator.network.native_of` compares the two.

**Weight of a network**, 1 where it alone counts and 0 where only physics does, continuous in all arguments:

    paper's       1 inside the training range of every feature and near physics, 0 at a margin beside a range, or at the limit
                  of the distance to physics
    envelope      of a fit and of ours: a table over (v, tau_raw), 1 in cells that several training runs have visited and 0 in
                  others, bilinear between cell centres (a range per feature would count fast and heavy as known when the data
                  has only fast or heavy); times 1 inside the training range of temperature and of |tau_t - tau_c|, falling to
                  0 beside it

**Ours** gives the torque of the current path without delay, from the signals of one encoder (INPUTS; table: docs/estimator.md):

    tau_c = tau_r + N(x)      tau_r = G [ r/(s+r) (Kt i + J r w) - J r w ], r = 200 rad/s: motor torque less the rotor's

A stop operator follows the motor angle and stops at -1 and 1; its start is unknown: it is the middle of its bounds, which meet
after a swing of twice its travel. Low passes are exact for signals that are linear between samples (`observer`). Its trust is

    w = (envelope) times 1 while acceleration, |tau_r at 800 - tau_r| and |tau_r at 50 - tau_r| are within their limits, 0 from
        QUICK of them on; what exceeds a limit is forgotten within 0.05 s

Without trust its sigma is wider by OUTSIDE of the rated torque. The value stays: the law of the joint file is worse there.
"""

from libc.math cimport INFINITY, NAN, copysign, cos, fabs, fmax, fmin, isfinite, isnan, sin, sqrt, tanh
from libc.stdint cimport uint64_t
from libc.string cimport memset

from jtqd.estimator.fusion cimport fading
from jtqd.estimator.observer cimport Hold, filtered, hold

from typing import Final

import numpy as np

from jtqd.estimator.joint import MAX_CELLS

if MAX_CELLS + 2 > MOST_CELLS:
    raise ImportError(f"{MAX_CELLS} cells may be in an envelope, the compiled map has room for {MOST_CELLS - 2}")

FADE_START: Final = 0.75
"""Part of the network's limit from which it fades into physics; at the limit only physics is used."""
TEMPERATURE_MARGIN_K: Final = 1.0
"""Distance to the range of temperatures over which the weight falls to 0."""
DISTANCE_MARGIN: Final = 0.25
"""The same of the distance between torsion and current, as a part of its range."""

cdef double PER_KELVIN = 1.0 / TEMPERATURE_MARGIN_K

# The hyperbolic tangent -----------------------------------------------------------------------------------------------

cdef double PER_LN2 = 1.4426950408889634
cdef double LN2_HIGH = 0.6931471803691238  # ln 2 = high + low; k LN2_HIGH is exact for |k| < 2^20 (fdlibm, e_exp.c)
cdef double LN2_LOW = 1.9082149292705877e-10
cdef double ROUNDS = 6755399441055744.0  # 1.5 2^52: added to a small number it leaves the nearest integer in the last bits
cdef uint64_t ONE = 0x3FF0000000000000  # the bits of 1.0
cdef double FARTHEST = 40.0  # exp(-40) is 4e-18: nothing beside 1

cdef union Word:
    double number
    uint64_t bits


cdef inline double tanh_of(double x) noexcept nogil:
    """Return tanh(x) within 4e-16; NaN stays.

        tanh|x| = (1 - t)/(1 + t),   t = exp(-2|x|) = 2^k exp(r),   |r| <= ln(2)/2
        exp(r) = (p + q)/(p - q)     p, q: even and odd part of the Pade approximant of order 6, error below 1e-18

    libm's function takes a call and branches per value; this one is arithmetic alone, so that the compiler computes several
    at once, and the same bits on every machine.
    """
    cdef Word k, power
    cdef double r, rr, p, q, y = -2.0 * fabs(x)
    y = -FARTHEST if y < -FARTHEST else y
    k.number = y * PER_LN2 + ROUNDS
    power.bits = (k.bits << 52) + ONE
    k.number -= ROUNDS
    r = (y - k.number * LN2_HIGH) - k.number * LN2_LOW
    rr = r * r
    p = 665280.0 + rr * (75600.0 + rr * (840.0 + rr))
    q = r * (332640.0 + rr * (10080.0 + rr * 42.0))
    return copysign(((p - q) - power.number * (p + q)) / ((p - q) + power.number * (p + q)), x)


# The network ----------------------------------------------------------------------------------------------------------

cdef enum:
    AT_ONCE = 8


cdef inline void weigh(int count, int inputs, int outputs, const double *h, const double *weights, double *y) noexcept nogil:
    """Set `count` <= AT_ONCE values of h W + b, whose sums stay in registers."""
    cdef double sums[AT_ONCE]
    cdef int m, n
    for m in range(count):
        sums[m] = weights[inputs * outputs + m]
    for n in range(inputs):
        for m in range(count):
            sums[m] += h[n] * weights[n * outputs + m]
    for m in range(count):
        y[m] = sums[m]


cdef double evaluate(const PerceptronLaw *law, const double *x) noexcept nogil:
    cdef double layer[2][MOST_WIDTH]
    cdef const double *h = x
    cdef const double *numbers = &law.numbers[0]
    cdef double *y = layer[0]
    cdef int k, m, inputs, outputs
    for k in range(law.layers):
        inputs, outputs = law.width[k], law.width[k + 1]
        y = layer[k & 1]
        m = 0
        while m + AT_ONCE <= outputs:
            weigh(AT_ONCE, inputs, outputs, h, numbers + m, y + m)
            m += AT_ONCE
        while m < outputs:
            weigh(1, inputs, outputs, h, numbers + m, y + m)
            m += 1
        numbers += (inputs + 1) * outputs
        if k < law.layers - 1:
            for m in range(outputs):
                y[m] = tanh_of(y[m])
        h = y
    return y[0]


cdef class Perceptron:
    """A perceptron of `layers`, each (weights [inputs, outputs], biases [outputs]); the last has one output.

    Raises ValueError for layers that do not fit together, or that are too large for the block (`fits`).
    """

    def __init__(self, layers):
        widths = [layers[0][0].shape[0], *(w.shape[1] for w, _ in layers)]
        if not self.fits(layers):
            raise ValueError(f"found a perceptron of widths {widths}, too large for native evaluation")
        for (w, b), inputs, outputs in zip(layers, widths, widths[1:], strict=False):
            if w.shape != (inputs, outputs) or b.shape != (outputs,):
                raise ValueError(f"found weights {w.shape} and biases {b.shape} after {inputs} inputs")
        if widths[-1] != 1:
            raise ValueError(f"found {widths[-1]} outputs, expected 1")
        self.law.layers = len(layers)
        numbers = np.concatenate([part.astype(np.float64).ravel() for layer in layers for part in layer])
        cdef const double[::1] flat = numbers
        cdef Py_ssize_t k
        for k in range(flat.shape[0]):
            self.law.numbers[k] = flat[k]
        for n, width in enumerate(widths):
            self.law.width[n] = width

    @staticmethod
    def fits(layers):
        """Return whether the block has room for these layers."""
        widths = [layers[0][0].shape[0], *(w.shape[1] for w, _ in layers)]
        numbers = sum(w.size + b.size for w, b in layers)
        return len(layers) <= MOST_LAYERS and max(widths) <= MOST_WIDTH and numbers <= MOST_NUMBERS

    def run_one(self, *x):
        cdef double values[MOST_WIDTH]
        if len(x) != self.law.width[0]:
            raise ValueError(f"found {len(x)} inputs, expected {self.law.width[0]}")
        for n, value in enumerate(x):
            values[n] = value
        return evaluate(&self.law, values)

    def run_many(self, features):
        cdef const double[:, ::1] x = np.ascontiguousarray(features, np.float64)
        if x.shape[1] != self.law.width[0]:
            raise ValueError(f"found features of shape {features.shape}, expected [n, {self.law.width[0]}]")
        out = np.empty(x.shape[0])
        cdef double[::1] to = out
        cdef Py_ssize_t k
        for k in range(x.shape[0]):
            to[k] = evaluate(&self.law, &x[k, 0])
        return out


# Weight of the paper's network ---------------------------------------------------------------------------------------

cdef int fill_trust(TrustLaw *law, low, high, double margin, double limit) except -1:
    if len(low) != FEATURES or len(high) != FEATURES:
        raise ValueError(f"found ranges of {len(low)} and {len(high)} features, expected {FEATURES}")
    for n, (a, b) in enumerate(zip(low, high, strict=True)):
        law.low[n], law.high[n] = a, b
        # a feature that was constant in training, or no margin at all: a step of rounding size instead of 1/0
        law.inverse_margin[n] = 1.0 / max(margin * (b - a), 1e-9 * max(1.0, abs(a), abs(b)))
    law.limit = limit
    law.fade = FADE_START * limit
    law.inverse_fade = 1.0 / max(limit - law.fade, 1e-12)
    return 0


cdef double _inside(const TrustLaw *law, const double *x) noexcept nogil:
    cdef double weight = 1.0, part
    cdef int n
    for n in range(FEATURES):
        if law.low[n] <= x[n] <= law.high[n]:
            continue
        part = 1.0 - fmax(law.low[n] - x[n], x[n] - law.high[n]) * law.inverse_margin[n]
        if not part > 0.0:  # NaN included
            return 0.0
        weight = fmin(weight, part)
    return weight


cdef double trust(const TrustLaw *law, const double *x, double difference) noexcept nogil:
    """Return the weight for features x and network minus physics; a difference of NaN gives 0."""
    cdef double distance = fabs(difference)
    if distance <= law.fade:
        return _inside(law, x)
    if distance < law.limit:
        return fmin((law.limit - distance) * law.inverse_fade, _inside(law, x))
    return 0.0


def network_weights(low, high, double margin, double limit_nm, features, difference_nm):
    """Return the weights [n] of the paper's network for features [n, 6] and network minus physics [n] (NaN gives 0).

    low, high: training range per feature; margin: part of the span beside a range over which the weight falls to 0; limit_nm:
    largest |network - physics|, the weight falls from FADE_START of it.
    """
    cdef const double[:, ::1] x = np.ascontiguousarray(features, np.float64)
    cdef const double[::1] difference = np.ascontiguousarray(difference_nm, np.float64)
    cdef TrustLaw law
    fill_trust(&law, low, high, margin, limit_nm)
    return np.array([trust(&law, &x[k, 0], difference[k]) for k in range(x.shape[0])])


# Envelope of a fit and of a network of the current path -----------------------------------------------------------------

cdef int fill_fused_trust(FusedTrustLaw *law, envelope) except -1:
    rows = envelope.known
    if max(len(rows), len(rows[0])) > MAX_CELLS:
        raise ValueError(f"found a map of {len(rows)} by {len(rows[0])} cells, expected at most {MAX_CELLS} each")
    law.inverse_velocity = 1.0 / envelope.velocity_step_rad_s
    law.inverse_torque = 1.0 / envelope.torque_step_nm
    # a frame of zeros: the interpolation needs no border, and beyond the map nothing is known
    memset(law.known, 0, sizeof(law.known))
    for m, row in enumerate(rows):
        for n, cell in enumerate(row):
            law.known[m + 1][n + 1] = cell
    law.velocity_last = len(rows) + 1
    law.torque_last = len(rows[0]) + 1
    law.velocity_0 = law.velocity_last / 2.0
    law.torque_0 = law.torque_last / 2.0
    law.distance = envelope.distance_nm
    law.inverse_fade = 1.0 / (DISTANCE_MARGIN * envelope.distance_nm)
    law.with_temperature = envelope.temperature_c is not None
    law.low, law.high = envelope.temperature_c or (0.0, 0.0)
    law.load = INFINITY if envelope.load_nm is None else envelope.load_nm
    return 0


cdef double fused_trust(const FusedTrustLaw *law, double v, double raw, double distance, double temperature) noexcept nogil:
    """Return the weight; raw: motor torque; distance: torsion less current path; as `envelope_weights`."""
    cdef double x = v * law.inverse_velocity + law.velocity_0
    cdef double y = raw * law.inverse_torque + law.torque_0
    cdef double a, b, weight
    cdef int m, n
    if not (0.0 <= x < law.velocity_last and 0.0 <= y < law.torque_last):
        return 0.0
    m, n = <int>x, <int>y
    x -= m
    y -= n
    a = law.known[m][n] + y * (<double>law.known[m][n + 1] - law.known[m][n])
    b = law.known[m + 1][n] + y * (<double>law.known[m + 1][n + 1] - law.known[m + 1][n])
    weight = a + x * (b - a)
    if fabs(distance) > law.distance:
        weight *= fmax(0.0, 1.0 - (fabs(distance) - law.distance) * law.inverse_fade)
    if not law.with_temperature or law.low <= temperature <= law.high:
        return weight
    if isnan(temperature):
        return 0.0
    return weight * fmax(0.0, 1.0 - fmax(law.low - temperature, temperature - law.high) * PER_KELVIN)


def envelope_weights(envelope, velocity_rad_s, raw_nm, distance_nm=0.0, temperature_c=None):
    """Return the weights [n] in an envelope, by velocity, motor torque, torsion less current path and temperature, arrays [n].

    temperature_c: None: not looked at; NaN: not known, hence 0 where the data had one. The others must be finite.
    """
    columns = (velocity_rad_s, raw_nm, distance_nm, NAN if temperature_c is None else temperature_c)
    cdef const double[:, ::1] x = np.ascontiguousarray(np.broadcast_arrays(*columns), np.float64)
    cdef FusedTrustLaw law
    fill_fused_trust(&law, envelope)
    if temperature_c is None:
        law.with_temperature = False
    return np.array([fused_trust(&law, x[0, k], x[1, k], x[2, k], x[3, k]) for k in range(x.shape[1])])


# The network of the current path ---------------------------------------------------------------------------------------

TORQUE_RAD_S: Final = (200.0, 800.0, 50.0, 10.0)
VELOCITY_RAD_S: Final = (50.0, 10.0, 2.0, 100.0)  # the last is that of the acceleration
DIRECTION_RAD_S: Final = 0.03
TRAVELS_RAD: Final = (0.02, 0.07, 0.25, 0.8)  # a fixed grid, that belongs to no joint
INPUTS: Final = tuple(
    "torque_nm torque_800_nm torque_50_nm torque_10_nm current_a velocity_rad_s velocity_50_rad_s velocity_10_rad_s "
    "velocity_2_rad_s acceleration_rad_s2 direction temperature_c sin_1_motor cos_1_motor sin_2_motor cos_2_motor sin_4_motor "
    "cos_4_motor sin_1_link cos_1_link sin_2_link cos_2_link stop_0.02_rad stop_0.07_rad stop_0.25_rad stop_0.8_rad "
    "stop_by_torque stop_by_velocity".split()
)
OUTSIDE: Final = 0.075
"""Sigma of a value without trust, part of the rated torque: load, speed, 30 K and quick motions outside gave 2 to 7 %."""
QUICK: Final = 1.5
DEFAULT_C: Final = 25.0
"""Temperature of a joint that reports none."""
if (len(INPUTS), len(TORQUE_RAD_S), len(VELOCITY_RAD_S), len(TRAVELS_RAD)) != (PATH_INPUTS, LOW_PASSES, LOW_PASSES, STOPS):
    raise ImportError("the inputs of the current path and their room differ in number")

cdef double[LOW_PASSES] TORQUE_RATE = TORQUE_RAD_S, SPEED_RATE = VELOCITY_RAD_S
cdef double[STOPS] INVERSE_TRAVEL = [1.0 / travel for travel in TRAVELS_RAD]
cdef double ACCELERATION = VELOCITY_RAD_S[3], INVERSE_DIRECTION = 1.0 / DIRECTION_RAD_S
cdef double BEYOND = QUICK, INVERSE_BEYOND = 1.0 / (QUICK - 1.0)


cdef int fill_path(PathLaw *law, joint, network) except -1:
    law.gear, law.inverse_gear = joint.gear_ratio, 1.0 / joint.gear_ratio
    law.kt, law.inertia = joint.torque_constant_nm_per_a, joint.rotor_inertia_kgm2
    fill_fused_trust(&law.trust, network.envelope)
    law.middle = 0.5 * (law.trust.low + law.trust.high) if law.trust.with_temperature else DEFAULT_C
    for n, limit in enumerate(network.quick):
        law.inverse_quick[n] = 1.0 / limit
    return 0


cdef void _set_inputs(const PathLaw *law, PathState *s, double temperature, double *out) noexcept nogil:
    cdef double v = s.omega * law.inverse_gear, c = cos(s.angle), d = sin(s.angle), e
    cdef int n
    for n in range(LOW_PASSES):
        out[n] = law.gear * (s.torque[n] - law.inertia * TORQUE_RATE[n] * s.omega)
        if n:
            out[n] -= out[0]
    out[4], out[5] = s.current, v
    for n in range(LOW_PASSES - 1):
        out[6 + n] = s.speed[n] - v
    out[9] = ACCELERATION * (v - s.speed[LOW_PASSES - 1])
    out[10] = tanh(v * INVERSE_DIRECTION)
    out[11] = temperature if law.trust.with_temperature and isfinite(temperature) else law.middle
    for n in range(3):  # of the angle itself: a multiple of a finite angle need not be finite
        out[12 + 2 * n], out[13 + 2 * n] = d, c
        e = 2.0 * c * d
        c, d = c * c - d * d, e
    c, d = cos(s.angle * law.inverse_gear), sin(s.angle * law.inverse_gear)
    out[18], out[19], out[20], out[21] = d, c, 2.0 * c * d, c * c - d * d
    for n in range(STOPS):
        out[22 + n] = 0.5 * (s.low[n] + s.high[n])
    out[26], out[27] = fabs(out[0]) * out[24], sqrt(fabs(v)) * out[24]


cdef void start_path(const PathLaw *law, PathState *s, const Sample *x, double *out) noexcept nogil:
    """Set the states of a joint in steady motion at this speed; what came before is unknown. `out`: inputs of this sample."""
    cdef int n
    s.current, s.omega, s.angle, s.quick = x.current_a, x.motor_velocity_rad_s, x.motor_position_rad, 0.0
    for n in range(LOW_PASSES):
        s.torque[n] = law.kt * s.current + law.inertia * TORQUE_RATE[n] * s.omega
        s.speed[n] = s.omega * law.inverse_gear
        s.low[n], s.high[n] = -1.0, 1.0
    _set_inputs(law, s, x.temperature_c, out)


cdef void follow_path(const PathLaw *law, PathState *s, const Sample *x, double *out) noexcept nogil:
    """Take a sample, dt > 0 after the last; `out`: its inputs."""
    cdef double part, now = x.motor_velocity_rad_s, way = x.motor_position_rad - s.angle
    cdef Hold h
    cdef int n
    for n in range(LOW_PASSES):
        h, part = hold(TORQUE_RATE[n], x.dt_s), law.inertia * TORQUE_RATE[n]
        s.torque[n] = filtered(
            &h, s.torque[n], law.kt * x.current_a + part * now, law.kt * s.current + part * s.omega
        )
        h, part = hold(SPEED_RATE[n], x.dt_s), way * INVERSE_TRAVEL[n]
        s.speed[n] = filtered(&h, s.speed[n], now * law.inverse_gear, s.omega * law.inverse_gear)
        s.low[n] = fmin(fmax(s.low[n] + part, -1.0), 1.0)
        s.high[n] = fmin(fmax(s.high[n] + part, -1.0), 1.0)
    s.current, s.omega, s.angle = x.current_a, now, x.motor_position_rad
    _set_inputs(law, s, x.temperature_c, out)
    part = fmax(fabs(out[1]) * law.inverse_quick[1], fabs(out[2]) * law.inverse_quick[2])
    s.quick = fading(fmax(fabs(out[9]) * law.inverse_quick[0], part), s.quick, x.dt_s)


cdef double path_trust(const PathLaw *law, const PathState *s, const double *inputs, double temperature) noexcept nogil:
    """Return the trust, 0 to 1, at these inputs."""
    cdef double weight = fused_trust(&law.trust, inputs[5], inputs[0], 0.0, temperature)
    return weight * fmin(fmax((BEYOND - s.quick) * INVERSE_BEYOND, 0.0), 1.0)
