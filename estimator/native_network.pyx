"""Networks in a cycle: native evaluation of the project's own, and the weight with which one counts.

**Evaluation**: a perceptron with tanh, of which the daemon needs no runtime in a cycle.

    h_0 = x,   h_(k+1) = tanh(h_k W_k + b_k),   y = h_last W_last + b_last          Gemm, Tanh, ..., Gemm
    answer = y                                          the paper's network, one output
    answer = sum over j of y_j x_(gate_j)               gated (method `fused`): gains of some of its inputs

ONNX Runtime loads and checks the file and stays the referee: `jtqd.estimator.network.native_of` compares the two.

**Weight of a network**, 1 where it alone counts and 0 where only physics does, continuous in all arguments:

    network       1 inside the training range of every feature and near physics, 0 at a margin beside a range, or at the limit
                  of the distance to physics
    fused         a table over (v, tau_raw), 1 in cells that several training runs have visited and 0 in others, bilinear
                  between cell centres (a range per feature would count fast and heavy as known when the data has only fast or
                  heavy); times 1 inside the training range of temperature and of |tau_t - tau_c|, falling to 0 beside it
"""

from libc.math cimport INFINITY, NAN, copysign, fabs, fmax, fmin, isnan
from libc.stdint cimport uint64_t
from libc.string cimport memset

from typing import Final

import numpy as np

from jtqd.estimator.joint import MAX_CELLS

if MAX_CELLS + 2 > MOST_CELLS:
    raise ImportError(f"{MAX_CELLS} cells may be in an envelope, the compiled map has room for {MOST_CELLS - 2}")

SLOW_RAD_S: Final = 0.05
FAST_RAD_S: Final = 0.2
"""The fused network fades in between these speeds: at lower ones a wave of the motor angle looks like an offset."""
FADE_START: Final = 0.75
"""Part of the network's limit from which it fades into physics; at the limit only physics is used."""
TEMPERATURE_MARGIN_K: Final = 1.0
"""Distance to the range of temperatures over which the weight falls to 0."""
DISTANCE_MARGIN: Final = 0.25
"""The same of the distance between torsion and current, as a part of its range."""

cdef double SLOW = SLOW_RAD_S, FAST = FAST_RAD_S, INVERSE_RANGE = 1.0 / (FAST_RAD_S - SLOW_RAD_S)
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
    cdef double answer = 0.0
    cdef int k, n, m, inputs, outputs = 0
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
    if not law.gated:
        return y[0]
    for m in range(outputs):
        answer += y[m] * x[law.gate[m]]
    return answer


cdef class Perceptron:
    """A perceptron of `layers`, each (weights [inputs, outputs], biases [outputs]); gate: inputs that the outputs are gains of.

    Raises ValueError for layers that do not fit together, or that are too large for the block (`fits`).
    """

    def __init__(self, layers, gate=None):
        widths = [layers[0][0].shape[0], *(w.shape[1] for w, _ in layers)]
        if not self.fits(layers):
            raise ValueError(f"found a perceptron of widths {widths}, too large for native evaluation")
        for (w, b), inputs, outputs in zip(layers, widths, widths[1:], strict=False):
            if w.shape != (inputs, outputs) or b.shape != (outputs,):
                raise ValueError(f"found weights {w.shape} and biases {b.shape} after {inputs} inputs")
        answers = 1 if gate is None else len(gate)
        if widths[-1] != answers:
            raise ValueError(f"found {widths[-1]} outputs, expected {answers}")
        self.law.layers = len(layers)
        numbers = np.concatenate([part.astype(np.float64).ravel() for layer in layers for part in layer])
        cdef const double[::1] flat = numbers
        cdef Py_ssize_t k
        for k in range(flat.shape[0]):
            self.law.numbers[k] = flat[k]
        for n, width in enumerate(widths):
            self.law.width[n] = width
        self.law.gated = gate is not None
        for n, at in enumerate(gate or ()):
            if not 0 <= at < widths[0]:
                raise ValueError(f"found gate {at}, expected one of {widths[0]} inputs")
            self.law.gate[n] = at

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


# Weight of a fused network -------------------------------------------------------------------------------------------

cdef double network_share(double v) noexcept nogil:
    """Return the fused network's share at this speed, 0 to 1."""
    cdef double a = fabs(v)
    if a >= FAST:
        return 1.0
    return (a - SLOW) * INVERSE_RANGE if a > SLOW else 0.0


def network_shares(velocity_rad_s):
    cdef const double[::1] v = np.ascontiguousarray(velocity_rad_s, np.float64)
    out = np.empty(len(v))
    cdef double[::1] to = out
    cdef Py_ssize_t k
    for k in range(v.shape[0]):
        to[k] = network_share(v[k])
    return out


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
