"""The estimators of a joint; the equations stand in estimator.pyx."""

from jtqd.estimator.detection cimport InputLaw, InputState, LinkLaw, LinkState
from jtqd.estimator.observer cimport (
    FusedObserved, FusedObserverLaw, FusedObserverState, GuardLaw, GuardState, Observed, ObserverLaw, ObserverState,
    Sample
)
from jtqd.estimator.fusion cimport (
    AgreementLaw, AgreementState, Fused, FusionLaw, Learned, OffsetLaw, OffsetState, ProofLaw, ProofState
)
from jtqd.estimator.native_network cimport FusedTrustLaw, PathLaw, PathState, PerceptronLaw, TrustLaw
from jtqd.estimator.losses cimport AdditiveLaw, EfficiencyLaw, UncertaintyLaw

cdef enum:
    MOST_FEATURES = 28

cdef struct Values:  # `jtqd.estimator.status.Estimate` as a block; NaN where not computed or not to be published
    double torque_nm, sigma_nm, tob_nm, physics_nm, network_nm
    double torque_rate_nm_s, load_nm  # `contact`: load of the sample before
    int status

cdef void no_values(Values *out, int status) noexcept nogil

cdef class Estimator:
    cdef readonly object joint, settings
    cdef readonly bint with_network
    cdef int width  # features of the network
    cdef double features[MOST_FEATURES]  # of the last sample that was observed
    cdef bint observed  # whether the last sample was
    cdef object run_one  # of a network that is not evaluated natively
    cdef void advance(self, const Sample *sample, bint network_wanted, Values *out) noexcept nogil
    cdef double ask(self) noexcept with gil
    cdef const void *learned(self, Learned *out, size_t *size) noexcept nogil

cdef struct NetworkLaw:
    bint used
    bint native  # evaluated here; else by ONNX Runtime, or by a stand-in
    PerceptronLaw perceptron

cdef struct JointLaw:
    GuardLaw guard
    ObserverLaw observer
    EfficiencyLaw losses
    UncertaintyLaw uncertainty
    TrustLaw trust
    NetworkLaw network
    bint with_efficiency
    double inverse_gain, limit, network_sigma

cdef struct JointState:
    GuardState guard
    ObserverState observer

cdef class JointEstimator(Estimator):
    cdef JointLaw law
    cdef JointState state

cdef struct FusedLaw:
    GuardLaw guard
    FusedObserverLaw observer
    AdditiveLaw loss
    FusionLaw fusion
    FusedTrustLaw trust
    bint with_envelope  # trust is set
    NetworkLaw network
    PathLaw path  # of the network, as the next three
    FusionLaw view
    double rest, outside  # half width at rest; sigma without trust
    OffsetLaw offsets
    AgreementLaw agreement
    LinkLaw link
    InputLaw inputs
    ProofLaw proof
    bint tracked  # the torsion is tracked: noise of what is faster than the motor path
    double tracking_noise, tracking_viscous, tracking_bend  # bend: of the viscous part [s^2/rad^2], 0: none
    double physics_scale[4]
    double network_scale[4]
    double stand_share, stand_floor, stand_sigmas, limit

cdef struct FusedState:
    GuardState guard
    FusedObserverState observer
    double temperature, thermal
    double half
    double degraded_s  # time left of the status after the paths disagreed
    OffsetState offsets
    AgreementState agreement
    LinkState link
    PathState path
    InputState inputs
    ProofState proof

cdef class FusedEstimator(Estimator):
    cdef FusedLaw law
    cdef FusedState state
    cdef void update_path_difference(
        self, const FusedObserved *seen, const Sample *x, const Fused *physics, double loss, int status
    ) noexcept nogil
    cdef void look_now(self, FusedObserved *at) noexcept nogil
    cdef bint offset_pending(self) noexcept nogil
    cdef bint inconsistent(self, const Fused *physics, double dt) noexcept nogil
    cdef double half_interval(
        self, const FusedObserved *seen, const Fused *physics, double half, double more, double sigma
    ) noexcept nogil
    cdef double current_path(self, bint network_wanted) noexcept nogil
    cdef void estimate(self, const FusedObserved *seen, const Sample *x, bint network_wanted, Values *out) noexcept nogil

cdef class ExtendedEstimator(Estimator):
    cdef readonly Estimator inner
    cdef object corrections
    cdef double torque_nm  # last estimate
