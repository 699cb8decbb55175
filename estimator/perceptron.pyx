"""Native evaluation of the project's own networks: a perceptron with tanh, of which the daemon needs no runtime in a cycle.

    h_0 = x,   h_(k+1) = tanh(h_k W_k + b_k),   y = h_last W_last + b_last          Gemm, Tanh, ..., Gemm
    answer = y                                          the paper's network, one output
    answer = sum over j of y_j x_(gate_j)               gated (method `fused`): gains of some of its inputs

ONNX Runtime loads and checks the file and stays the referee: `jtqd.estimator.network.native_of` compares the two.
"""

from libc.math cimport copysign, fabs
from libc.stdint cimport uint64_t

import numpy as np

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


def tanh_many(values):
    """Return the hyperbolic tangents [n] of values [n], as the networks take them."""
    cdef const double[::1] x = np.ascontiguousarray(values, np.float64)
    out = np.empty(x.shape[0])
    cdef double[::1] to = out
    cdef Py_ssize_t k
    with nogil:
        for k in range(x.shape[0]):
            to[k] = tanh_of(x[k])
    return out


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
    """Return the answer for the inputs x."""
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
        """Return the answer for one sample."""
        cdef double values[MOST_WIDTH]
        if len(x) != self.law.width[0]:
            raise ValueError(f"found {len(x)} inputs, expected {self.law.width[0]}")
        for n, value in enumerate(x):
            values[n] = value
        return evaluate(&self.law, values)

    def run_many(self, features):
        """Return the answers [n] for samples [n, inputs]."""
        cdef const double[:, ::1] x = np.ascontiguousarray(features, np.float64)
        if x.shape[1] != self.law.width[0]:
            raise ValueError(f"found features of shape {features.shape}, expected [n, {self.law.width[0]}]")
        out = np.empty(x.shape[0])
        cdef double[::1] to = out
        cdef Py_ssize_t k
        for k in range(x.shape[0]):
            to[k] = evaluate(&self.law, &x[k, 0])
        return out
