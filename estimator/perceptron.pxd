"""A multilayer perceptron as a flat block; how it is evaluated stands in perceptron.pyx."""

cdef enum:
    MOST_LAYERS = 8
    MOST_WIDTH = 128
    MOST_NUMBERS = 8192  # weights and biases together

cdef struct PerceptronLaw:
    int layers
    int width[MOST_LAYERS + 1]  # inputs of each layer, then the outputs of the last
    int gated  # the last outputs are gains of the inputs `gate`; 0: the one output is the answer
    int gate[MOST_WIDTH]
    double numbers[MOST_NUMBERS]  # per layer: weights [inputs][outputs], biases [outputs]

cdef double evaluate(const PerceptronLaw *law, const double *x) noexcept nogil

cdef class Perceptron:
    cdef PerceptronLaw law
