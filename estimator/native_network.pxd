"""A multilayer perceptron, the weight of a network, and inputs of ours as flat blocks; native_network.pyx."""

from jtqd.estimator.observer cimport Sample

cdef enum:
    FEATURES = 6  # of the paper's network (jtqd.estimator.network.FEATURES)
    MOST_CELLS = 129  # of an envelope's map in each direction, with its frame
    MOST_LAYERS = 8
    MOST_WIDTH = 128
    MOST_NUMBERS = 8192  # weights and biases together

cdef struct PerceptronLaw:
    int layers
    int width[MOST_LAYERS + 1]  # inputs of each layer, then the outputs of the last
    double numbers[MOST_NUMBERS]  # per layer: weights [inputs][outputs], biases [outputs]

cdef double evaluate(const PerceptronLaw *law, const double *x) noexcept nogil

cdef class Perceptron:
    cdef PerceptronLaw law

cdef struct TrustLaw:
    double low[FEATURES]
    double high[FEATURES]
    double inverse_margin[FEATURES]
    double limit, fade, inverse_fade

cdef struct FusedTrustLaw:
    double inverse_velocity, inverse_torque, velocity_0, torque_0
    int velocity_last, torque_last
    double distance, inverse_fade
    bint with_temperature
    double low, high
    double load  # largest joint torque [Nm]
    unsigned char known[MOST_CELLS][MOST_CELLS]

cdef int fill_trust(TrustLaw *law, low, high, double margin, double limit) except -1
cdef int fill_fused_trust(FusedTrustLaw *law, envelope) except -1
cdef double trust(const TrustLaw *law, const double *features, double difference) noexcept nogil
cdef double fused_trust(
    const FusedTrustLaw *law, double velocity, double raw, double distance, double temperature
) noexcept nogil

cdef enum:
    PATH_INPUTS = 28  # of the network of the current path
    LOW_PASSES = 4  # of the motor torque, and of the velocity
    STOPS = 4

cdef struct PathLaw:
    double gear, inverse_gear, kt, inertia
    double middle  # temperature where it is not known
    double inverse_quick[3]
    FusedTrustLaw trust

cdef struct PathState:
    double current, omega, angle  # of the last sample
    double torque[LOW_PASSES]
    double speed[LOW_PASSES]
    double low[STOPS]
    double high[STOPS]
    double quick  # largest part of its limits that quickness had, fading

cdef int fill_path(PathLaw *law, joint, network) except -1
cdef void start_path(const PathLaw *law, PathState *s, const Sample *x, double *out) noexcept nogil
cdef void follow_path(const PathLaw *law, PathState *s, const Sample *x, double *out) noexcept nogil
cdef double path_trust(const PathLaw *law, const PathState *s, const double *inputs, double temperature) noexcept nogil
