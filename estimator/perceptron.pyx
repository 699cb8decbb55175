"""Native evaluation of the project's own networks: a perceptron with tanh, of which the daemon needs no runtime in a cycle.

    h_0 = x,   h_(k+1) = tanh(h_k W_k + b_k),   y = h_last W_last + b_last          Gemm, Tanh, ..., Gemm
    answer = y                                          the paper's network, one output
    answer = sum over j of y_j x_(gate_j)               gated (method `fused`): gains of some of its inputs

ONNX Runtime loads and checks the file and stays the referee: `jtqd.estimator.network.native_of` compares the two.
"""

from libc.math cimport tanh

import numpy as np


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
        for m in range(outputs):
            y[m] = numbers[inputs * outputs + m]
        for n in range(inputs):
            for m in range(outputs):
                y[m] += h[n] * numbers[n * outputs + m]
        numbers += (inputs + 1) * outputs
        if k < law.layers - 1:
            for m in range(outputs):
                y[m] = tanh(y[m])
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
