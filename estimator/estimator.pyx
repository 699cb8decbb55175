"""Estimate of one joint, sample by sample: observer, loss, network, uncertainty, in this order.

| class | methods |
|---|---|
| `JointEstimator` | `tob`, `efficiency`, `network`, of the paper |
| `FusedEstimator` | `fused` |
| `ExtendedEstimator` | any of them for a joint with effects: inputs corrected first (`corrections`) |

`make_estimator` chooses. All inputs of the loss pass the same filter; delay of the result: `settings.age_ms`.
"""

from libc.math cimport NAN, fabs, fmin, hypot, sqrt
from libc.string cimport memcmp, memcpy, memset

from jtqd.estimator.detection cimport (
    LinkLoad, bound_inputs, check_inputs, drop_inputs, fill_inputs, fill_link, in_order, louder_nm2, restart_inputs, restart_link,
    update_link
)
from jtqd.estimator.observer cimport (
    FusedObserved, FusedObserverLaw, Observed, Sample, fill_fused_observer, fill_guard, fill_observer, observe,
    observe_fused, restart_guard
)
from jtqd.estimator.fusion cimport (
    Fused, Learned, Rest, TURN_WAVES, apart_nm2, at_rest, day_nm2, degrades, drop_block, fading,
    fill_agreement, fill_fusion, fill_offsets, fill_proof, fuse_paths, gather, go_back, implausible, keep_offsets, known_nm2,
    local_stiffness, mismatch_variance, offsets_of, pause_turn, possible_error, prove, report_offsets, restart_agreement,
    restart_offsets, restart_proof, restart_turn, reweigh, turn_differs, unproven_nm2, update_difference, update_turn
)
from jtqd.estimator.native_network cimport (
    PATH_INPUTS, Perceptron, evaluate, fill_fused_trust, fill_path, fill_trust, follow_path, fused_trust, path_trust,
    start_path, trust
)
from jtqd.estimator.losses cimport (
    AdditiveLaw, AdditiveLossModel, Loss, LossModel, Spread, additive_loss, efficiency_loss, fill_uncertainty,
    sigma_moving, standing, thermal_friction
)

from dataclasses import replace
from typing import Final

import numpy as np

from jtqd.estimator import status as st
from jtqd.estimator.corrections import ExtendedInputs, acting_effects, plain_joint
from jtqd.estimator.observer import columns
from jtqd.estimator.native_network import OUTSIDE
from jtqd.estimator.network import FEATURES, check_fit, native_of, path_section
from jtqd.estimator.run import INPUTS, EstimateRun, ObservedRun
from jtqd.estimator.settings import METHODS, largest_torque_nm
from jtqd.estimator.status import Estimate, Status
from jtqd.estimator.fusion import FOREIGN_SIGMAS, ONE_WAY

STANDSTILL_SIGMAS: Final = 3.0
"""Half width of the standstill interval in standard deviations, where torsion narrows the interval of friction.

Of a joint file with section `fused.standstill` only for the disagreement of the paths.
"""

SLOPE_NM: Final = 0.5
"""Step of the motor torque over which the slope of the loss is taken."""

cdef double STANDSTILL_WIDTH = STANDSTILL_SIGMAS, STEP = SLOPE_NM, FOREIGN = FOREIGN_SIGMAS, ONE_SIDED = ONE_WAY
cdef double DOUBTFUL = 4.0  # tolerances of the inputs: the status is lowered
cdef double LOWERED_S = 0.1  # the status stays degraded for so long after the paths have disagreed: it must not flicker
cdef int STARTING = st.STARTING, VALID = st.VALID, DEGRADED = st.DEGRADED, STANDSTILL = st.STANDSTILL, INVALID = st.INVALID
cdef int LEFT = st.LEFT, APART = st.APART


# What all estimators share ---------------------------------------------------------------------------------------------

cdef void no_values(Values *out, int status) noexcept nogil:
    """Set `out` to a status without any number."""
    out.torque_nm = out.sigma_nm = out.tob_nm = out.physics_nm = out.network_nm = NAN
    out.torque_rate_nm_s = out.load_nm = NAN
    out.status = status


cdef class Estimator:
    """Estimator of one joint: `advance` is the one step there is; the loop, `step` and `run` call it.

    Attributes:
        joint, settings: what it was made of.
        with_network: whether a network is used.
    """

    cdef void advance(self, const Sample *sample, bint network_wanted, Values *out) noexcept nogil:
        """Set `out` to the estimate at this sample; without `network_wanted` there is no time for the network."""

    cdef double ask(self) noexcept with gil:
        """Return the answer for `features` of a network that is not evaluated natively; NaN where it fails."""
        cdef int n
        try:
            return self.run_one(*[self.features[n] for n in range(self.width)])
        except Exception:
            return NAN

    cdef const void *learned(self, Learned *out, size_t *size) noexcept nogil:
        """Set `out` to what is known of the zeros; return the estimator's whole state and its `size`.

        An estimator that learns nothing: no flag is set, and NULL is returned.
        """
        memset(out, 0, sizeof(Learned))
        size[0] = 0
        return NULL

    def reset(self):
        """Forget the past: the next step starts."""
        raise NotImplementedError

    def step(
        self, double dt_s, double current_a, double motor_position_rad, double motor_velocity_rad_s,
        double link_position_rad, double temperature_c=NAN, bint network_wanted=True
    ):
        """Return the `Estimate` at this sample, dt_s [s] after the one before; never raises on any float.

        temperature_c: of the joint, NaN where it is not known. Without network_wanted there is no time for the network:
        this sample is physics only.
        """
        cdef Sample sample = Sample(
            dt_s, current_a, motor_position_rad, motor_velocity_rad_s, link_position_rad, temperature_c
        )
        cdef Values out
        no_values(&out, INVALID)  # of an estimator that raises, which Python prints
        self.advance(&sample, network_wanted, &out)
        return Estimate(out.torque_nm, out.sigma_nm, Status(out.status), out.tob_nm, out.physics_nm, out.network_nm)

    def run(
        self, dt_s, current_a, motor_position_rad, motor_velocity_rad_s, link_position_rad, temperature_c=None,
        network_wanted=None
    ):
        """Return the estimates of a run as an `EstimateRun`: `step` for every sample of arrays [n].

        dt_s[k] is the time since sample k-1; temperature_c, network_wanted: None for NaN and True throughout.
        Raises ValueError for arrays of different length.
        """
        inputs = columns(dt_s, current_a, motor_position_rad, motor_velocity_rad_s, link_position_rad, temperature_c)
        n = inputs.shape[1]
        wanted = np.ones(n, np.uint8) if network_wanted is None else np.ascontiguousarray(network_wanted, np.uint8)
        values, features, status = np.empty((7, n)), np.full((n, self.width), NAN), np.empty(n, np.uint8)
        cdef const double[:, ::1] x = inputs
        cdef const unsigned char[::1] w = wanted
        cdef double[:, ::1] to = values
        cdef double[:, ::1] f = features
        cdef unsigned char[::1] s = status
        cdef Sample sample
        cdef Values out
        cdef Py_ssize_t k
        cdef int m
        if w.shape[0] != x.shape[1]:
            raise ValueError(f"found {w.shape[0]} values of network_wanted, expected {n}")
        with nogil:
            for k in range(x.shape[1]):
                sample = Sample(x[0, k], x[1, k], x[2, k], x[3, k], x[4, k], x[5, k])
                no_values(&out, INVALID)
                self.observed = False
                self.advance(&sample, w[k], &out)
                to[0, k], to[1, k] = out.torque_nm, out.sigma_nm
                to[2, k], to[3, k], to[4, k] = out.tob_nm, out.physics_nm, out.network_nm
                to[5, k], to[6, k] = out.torque_rate_nm_s, out.load_nm
                s[k] = out.status
                if self.observed:
                    for m in range(self.width):
                        f[k, m] = self.features[m]
        torque, sigma, tob, physics, network, rate, load = values
        return EstimateRun(torque, sigma, status, tob, physics, network, rate, load, features)


cdef fill_network(NetworkLaw *law, network, joint):
    """Set a network's parameters; return the function of one sample of a network that is not evaluated natively, else None."""
    law.used = network is not None
    law.native = False
    if network is None:
        return None
    native = native_of(network, joint)
    if native is None:
        return network.run_one
    law.native = True
    law.perceptron = (<Perceptron>native).law
    return None


# The paper's estimator ------------------------------------------------------------------------------------------------

cdef class JointEstimator(Estimator):
    """The paper's estimator of one joint: methods `tob`, `efficiency` and `network`.

        tau_raw, tau_tob, v, r  <-  observer (Eqs. 4, 7)
        i_eff      = tau_raw/(G Kt)                current without the part that accelerates the rotor
        efficiency = tau_raw - loss(i_eff, v)      inside a quadrant tau_raw eta(i_eff, v): Eq. (7) with Table I
        network    = N(i, theta_m, omega_m, theta_l, omega_l, efficiency)

    joint: parameters; settings: method and thresholds; network: needed by method "network" only. A joint without
    efficiency may use methods "tob" and "network" (the loss is then its additive friction).

    Raises ConfigError for effects (`make_estimator` applies them), a missing network or that of another joint; NetworkError
    for a network whose native evaluation differs from its runtime's.
    """

    def __init__(self, joint, settings, network=None):
        check_fit(joint, settings, network, "JointEstimator")
        used = network if METHODS[settings.method].network else None
        losses = LossModel(joint)
        self.joint, self.settings = joint, settings
        self.width = len(FEATURES)
        fill_guard(&self.law.guard, joint, settings)
        fill_observer(&self.law.observer, joint, settings)
        self.law.losses = (<LossModel>losses).law
        fill_uncertainty(&self.law.uncertainty, joint, settings)
        self.law.with_efficiency = "efficiency" in METHODS[settings.method].sections
        self.law.inverse_gain = 1.0 / losses.torque_per_ampere
        self.law.limit = largest_torque_nm(joint, settings)
        self.law.network_sigma = 0.0 if used is None else used.sigma_nm
        self.with_network = used is not None
        self.run_one = fill_network(&self.law.network, used, joint)
        if used is not None:
            limit_nm = settings.network_limit * joint.rated_torque_nm
            fill_trust(&self.law.trust, used.envelope_low, used.envelope_high, settings.envelope_margin, limit_nm)
        self.reset()

    def reset(self):
        restart_guard(&self.state.guard)

    cdef void advance(self, const Sample *x, bint network_wanted, Values *out) noexcept nogil:
        cdef const JointLaw *law = &self.law
        cdef Observed seen
        self.observed = observe(&law.guard, &self.state.guard, &law.observer, &self.state.observer, x, &seen)
        no_values(out, self.state.guard.status)
        if not self.observed:
            return
        cdef double raw = seen.raw_nm, v = seen.joint_velocity_rad_s
        cdef double i = raw * law.inverse_gain
        cdef double physics = seen.tob_nm, weight = 0.0, network = NAN, sigma
        cdef Spread still
        out.tob_nm = seen.tob_nm
        if law.with_efficiency:
            physics = out.physics_nm = raw - efficiency_loss(&law.losses, i, v)
        self.features[0], self.features[1] = x.current_a, x.motor_position_rad
        self.features[2], self.features[3] = x.motor_velocity_rad_s, x.link_position_rad
        self.features[4], self.features[5] = seen.link_velocity_rad_s, out.physics_nm
        if law.network.used and network_wanted:
            network = out.network_nm = (
                evaluate(&law.network.perceptron, self.features) if law.network.native else self.ask()
            )
            weight = trust(&law.trust, self.features, network - physics)
        if out.status == STANDSTILL:
            still = standing(&law.uncertainty, &law.losses, raw, i)
            out.torque_nm, out.sigma_nm = still.value, still.sigma
        elif weight == 1.0:
            out.torque_nm, out.sigma_nm = network, law.network_sigma
        else:
            sigma = sigma_moving(&law.uncertainty, &law.losses, raw, i, v)
            out.torque_nm, out.sigma_nm = physics, sigma
            if weight > 0.0:
                out.torque_nm = physics + weight * (network - physics)
                out.sigma_nm = sigma + weight * (law.network_sigma - sigma)
            elif law.network.used:
                out.status = DEGRADED
        publish_within(out, law.limit)


cdef void publish_within(Values *out, double limit) noexcept nogil:
    """Withhold a torque beyond the limit, or NaN."""
    if not -limit <= out.torque_nm <= limit:
        out.torque_nm = out.sigma_nm = NAN
        out.status = INVALID


# The fused estimator ----------------------------------------------------------------------------------------------------

cdef int quadrant_of(double raw, double v) noexcept nogil:
    if v >= 0.0:
        return 0 if raw >= 0.0 else 2
    return 3 if raw >= 0.0 else 1


def quadrants(raw_nm, velocity_rad_s):
    """Return the indices into QUADRANTS [n] by the signs of motor torque and velocity."""
    cdef const double[::1] raw = np.ascontiguousarray(raw_nm, np.float64)
    cdef const double[::1] v = np.ascontiguousarray(velocity_rad_s, np.float64)
    out = np.empty(len(raw), np.intp)
    cdef Py_ssize_t[::1] to = out
    cdef Py_ssize_t k
    for k in range(raw.shape[0]):
        to[k] = quadrant_of(raw[k], v[k])
    return out


cdef class FusedEstimator(Estimator):
    """Estimator of one joint, method `fused`, degraded outside the joint file's envelope.

        tau_raw, v, tau_t, waves, s, open  <-  fused observer   s: direction, -1 to 1; open: of the torsion's slip
        physics = fusion of tau_raw - loss(tau_raw, v, s, T) and tau_t
        torque  = physics

    With a network of the current path (`native_network`), which has no delay, in motion

        torque  = tau_c + alpha (tau_t - tau_c),   alpha = s_c^2/(s_c^2 + s_t^2),   tau_c = tau_r + N(x)

    s_c: its spread, wider where it is not trusted, and the friction interval near standstill. At standstill the torque is that
    of physics, without torsion tau_c. Offsets and agreement are judged by the path that counts, the network's where there is one;
    where its trust is below one half nothing is learned. Where it has no value the torque is physics, and the status 3;
    without torsion also where the trust is below one half.

    Raises ConfigError for a joint without section `fused`, effects (`make_estimator` applies them), another joint's
    network, or settings of another method; NetworkError for a network whose native evaluation differs from its runtime's.
    """

    def __init__(self, joint, settings, network=None):
        check_fit(joint, settings, network, "FusedEstimator")
        fused = joint.fused
        judged = fused if network is None else path_section(fused, network)
        self.joint, self.settings = joint, settings
        self.width = 0 if network is None else PATH_INPUTS
        fill_guard(&self.law.guard, joint, settings)
        fill_fused_observer(&self.law.observer, joint, fused.torsion, settings)
        self.law.loss = (<AdditiveLossModel>AdditiveLossModel(fused.loss)).law
        fill_fusion(&self.law.fusion, fused.sigma, fused.torsion is not None)
        self.law.fusion.reference = 0.0  # sigma is that of the torque, not of a comparison with a sensor
        per_ampere = joint.gear_ratio * joint.torque_constant_nm_per_a
        estimated = judged.agreement is not None
        self.law.tracked = self.law.observer.tracking > 0.0
        if self.law.tracked:
            self.law.tracking_noise = fused.tracking.sigma_nm**2
            self.law.tracking_viscous = fused.tracking.viscous_nms_per_rad**2
            self.law.tracking_bend = fused.tracking.bend
        fill_offsets(&self.law.offsets, per_ampere, joint.rated_torque_nm, judged, settings.track_zeros, estimated)
        fill_agreement(&self.law.agreement, judged.agreement, joint.rated_torque_nm)
        fill_link(&self.law.link, joint, fused.torsion)
        noise = self.law.tracking_noise if self.law.tracked else self.law.fusion.torsion
        fill_inputs(&self.law.inputs, joint, fused.torsion, noise)
        fill_proof(&self.law.proof, joint.rated_torque_nm, judged)
        learned = self.law.offsets.spread > 0.0
        physics_scale = fused.zeros.scale if learned and fused.zeros is not None else fused.sigma.scale
        network_scale = judged.zeros.scale if learned else judged.sigma.scale
        for k in range(4):
            self.law.physics_scale[k], self.law.network_scale[k] = physics_scale[k], network_scale[k]
        self.law.stand_share = 1.0 + settings.friction_uncertainty
        self.law.stand_floor = settings.sigma_floor * joint.rated_torque_nm
        self.law.stand_sigmas = 0.0 if fused.standstill is None else fused.standstill.sigmas
        self.law.limit = largest_torque_nm(joint, settings)
        self.with_network = network is not None
        self.run_one = fill_network(&self.law.network, network, joint)
        if network is not None:
            fill_path(&self.law.path, joint, network)
            fill_fusion(&self.law.view, judged.sigma, fused.torsion is not None)
            self.law.view.reference = 0.0
            self.law.rest, self.law.outside = network.rest_nm, OUTSIDE * joint.rated_torque_nm
        self.law.with_envelope = fused.envelope is not None
        if fused.envelope is not None:
            fill_fused_trust(&self.law.trust, fused.envelope)
        self.state.temperature, self.state.thermal = NAN, 0.0
        self.reset()

    def reset(self):
        restart_guard(&self.state.guard)
        self.state.half = self.state.degraded_s = 0.0
        restart_offsets(&self.law.offsets, &self.state.offsets)
        restart_agreement(&self.state.agreement)
        restart_link(&self.state.link)
        restart_inputs(&self.law.inputs, &self.state.inputs)
        restart_proof(&self.law.proof, &self.state.proof)

    @property
    def zeros(self):
        """Offsets of link encoder and current (`Zeros`); None where they are not tracked."""
        return offsets_of(&self.law.offsets, &self.state.offsets) if self.law.offsets.corrected else None

    cdef const void *learned(self, Learned *out, size_t *size) noexcept nogil:
        """As `Estimator.learned`; whether the two paths disagree is reported in any case."""
        report_offsets(&self.law.offsets, &self.state.offsets, out)
        if self.state.degraded_s > 0.0:
            out.flags |= APART
        if self.offset_pending():
            out.flags |= LEFT
        size[0] = sizeof(FusedState)
        return &self.state

    @property
    def past(self):
        """The whole state, bytes of layout `status.PAST_LAYOUT`; `past = other.past` continues from that state.

        Raises ValueError for bytes of another length.
        """
        return (<const char *> &self.state)[: sizeof(FusedState)]

    @past.setter
    def past(self, const unsigned char[::1] content):
        if <size_t> content.shape[0] != sizeof(FusedState):
            raise ValueError(f"found a block of {content.shape[0]} bytes, expected {sizeof(FusedState)}")
        memcpy(&self.state, &content[0], sizeof(FusedState))

    def shares_past(self, FusedEstimator other):
        """Return whether the state of `other` is valid here: the parameters that offsets are estimated with are the same.

        These are the observer with its torsion, the losses, the torque per ampere, and whether there is a network. Limits, sigmas
        and the network itself may differ.
        """
        return (
            self.law.network.used == other.law.network.used
            and self.law.offsets.corrected == other.law.offsets.corrected
            and self.law.offsets.torque_per_ampere == other.law.offsets.torque_per_ampere
            and memcmp(&self.law.observer, &other.law.observer, sizeof(FusedObserverLaw)) == 0
            and memcmp(&self.law.loss, &other.law.loss, sizeof(AdditiveLaw)) == 0
        )

    cdef void advance(self, const Sample *x, bint network_wanted, Values *out) noexcept nogil:
        cdef FusedObserved seen
        cdef LinkLoad link
        cdef Sample corrected
        if self.law.inputs.used:
            check_inputs(&self.law.inputs, &self.state.inputs, x, self.state.guard.standing)
        if self.law.offsets.corrected:
            corrected = x[0]
            corrected.link_position_rad -= self.state.offsets.now.link_rad
            corrected.current_a -= self.state.offsets.now.current_a
            x = &corrected
        self.observed = observe_fused(
            &self.law.guard, &self.state.guard, &self.law.observer, &self.state.observer, x, &seen
        )
        if self.law.network.used and self.state.guard.running:
            if self.observed:
                follow_path(&self.law.path, &self.state.path, x, self.features)
            else:
                start_path(&self.law.path, &self.state.path, x, self.features)
        no_values(out, self.state.guard.status)
        if self.observed:
            update_link(
                &self.law.link, &self.state.link, &self.law.observer, &self.state.observer, seen.torsion_nm + seen.ahead_nm,
                x.dt_s, &link
            )
            out.torque_rate_nm_s, out.load_nm = link.rate_nm_s, link.load_nm
            self.estimate(&seen, x, network_wanted, out)
            if self.law.inputs.used and not self.state.inputs.alive:
                no_values(out, STARTING)
        else:
            self.state.half = 0.0
            restart_proof(&self.law.proof, &self.state.proof)
            if out.status == INVALID:
                drop_inputs(&self.state.inputs)
            drop_block(&self.state.offsets)
            restart_turn(&self.state.agreement)
            restart_link(&self.state.link)

    cdef void update_path_difference(
        self, const FusedObserved *seen, const Sample *x, const Fused *physics, double loss, int status
    ) noexcept nogil:
        """Take a sample of the difference of the paths: into the offsets, and into the check that the joint is that of its file."""
        cdef const FusedLaw *law = &self.law
        cdef FusedState *s = &self.state
        cdef double v = seen.joint_velocity_rad_s, raw = seen.raw_nm
        cdef double noise = physics.variance - law.offsets.spread_nm  # the day's offset is a state, no noise
        cdef Loss next
        cdef double wave[TURN_WAVES]
        if not in_order(&s.inputs):
            status = DEGRADED  # nothing is learned from a fault
        if law.agreement.with_turn:
            if status == VALID:
                wave[0], wave[1], wave[2] = seen.cos1, seen.sin1, seen.cos2
                wave[3], wave[4], wave[5] = seen.sin2, seen.cos4, seen.sin4
                update_turn(&law.agreement, &s.agreement, x.dt_s, physics.difference, seen.direction, v, loss, wave)
            else:
                pause_turn(&s.agreement)
        if status != VALID:
            drop_block(&s.offsets)
        elif gather(&s.offsets, x.dt_s, physics.difference, seen.direction, v, seen.torsion_nm, noise):
            next = additive_loss(&law.loss, raw + STEP, v, s.thermal, seen.direction)
            update_difference(
                &law.offsets, &s.offsets, &law.agreement, &s.agreement, local_stiffness(&law.observer, s.observer.d),
                (next.nm - additive_loss(&law.loss, raw, v, s.thermal, seen.direction).nm) / STEP
            )

    cdef bint inconsistent(self, const Fused *physics, double dt) noexcept nogil:
        """Return whether the paths contradict the joint file: they disagree, or the link's offset is implausible."""
        cdef FusedState *s = &self.state
        if fabs(physics.difference) > FOREIGN * sqrt(physics.variance) or turn_differs(&self.law.agreement, &s.agreement):
            s.degraded_s = LOWERED_S
        elif s.degraded_s > 0.0:
            s.degraded_s -= dt
        if s.degraded_s > 0.0:
            return True
        return self.offset_pending() or (self.law.offsets.corrected and implausible(&self.law.offsets, &s.offsets))

    cdef bint offset_pending(self) noexcept nogil:
        """Return whether the uncorrected part of a known offset exceeds the torsion's own sigma."""
        cdef double rest = self.state.offsets.uncorrected_nm
        return self.law.offsets.corrected and rest * rest > FOREIGN * FOREIGN * self.law.fusion.torsion

    cdef double current_path(self, bint network_wanted) noexcept nogil:
        """Return the torque of the current path by the network [Nm]; NaN where it has no value that can be believed."""
        cdef double correction = NAN
        if self.law.network.used and network_wanted:
            correction = evaluate(&self.law.network.perceptron, self.features) if self.law.network.native else self.ask()
        return self.features[0] + correction

    cdef void look_now(self, FusedObserved *at) noexcept nogil:
        """Bring torsion, motor torque and waves to the instant of the network's current path."""
        at.raw_nm, at.torsion_nm, at.ahead_nm = self.features[0], at.torsion_nm + at.ahead_nm, 0.0
        at.sin1, at.cos1, at.sin2 = self.features[12], self.features[13], self.features[14]
        at.cos2, at.sin4, at.cos4 = self.features[15], self.features[16], self.features[17]

    cdef void estimate(self, const FusedObserved *seen, const Sample *x, bint network_wanted, Values *out) noexcept nogil:
        """Set `out`, whose status is the guard's, to the estimate of an observed sample."""
        cdef const FusedLaw *law = &self.law
        cdef FusedState *s = &self.state
        cdef double raw = seen.raw_nm, v = seen.joint_velocity_rad_s
        cdef double scale, view, trusted = 1.0, difference, known = 0.0, share = 1.0
        cdef double spread, more, mismatch, variance, unproven, lost, noise, stiffness
        cdef FusedObserved at
        cdef int status
        cdef bint by_network, standing = out.status == STANDSTILL, alone = not law.fusion.with_torsion
        cdef int quadrant = quadrant_of(raw, v)
        cdef Loss loss
        cdef Fused physics, best
        if x.temperature_c != s.temperature:  # reported twice a second
            s.temperature = x.temperature_c
            s.thermal = thermal_friction(&law.loss, x.temperature_c)
        loss = additive_loss(&law.loss, raw, v, s.thermal, seen.direction)
        lost = loss.nm
        s.half = fading(loss.half, s.half, x.dt_s)
        physics = fuse_paths(&law.fusion, raw, loss.nm, s.half, v, seen.torsion_nm, seen.open_nm)
        best, at, scale, status = physics, seen[0], law.physics_scale[quadrant], out.status
        view = out.network_nm = self.current_path(network_wanted)
        by_network = -law.limit <= view <= law.limit  # not so for NaN
        if by_network:
            trusted = path_trust(&law.path, &s.path, self.features, x.temperature_c)
        if by_network and (alone or not standing):  # of now, as the torsion
            self.look_now(&at)
            loss.nm = at.raw_nm - view
            # the friction interval counts where the torsion can take over
            best = fuse_paths(
                &law.view, at.raw_nm, loss.nm, hypot(0.0 if alone else s.half, (1.0 - trusted) * law.outside), v,
                at.torsion_nm, at.open_nm
            )
            scale = law.network_scale[quadrant]
        degraded = self.inconsistent(&best, x.dt_s)
        if status == VALID:
            bound_inputs(&s.inputs, possible_error(&best))
        unproven = prove(&law.proof, &s.proof, &best, &at, x.dt_s, standing, in_order(&s.inputs))
        if law.network.used and status == VALID and not (by_network and trusted > 0.5):
            status = DEGRADED  # nothing is learned from a path that is not trusted
        if law.offsets.estimated:
            if not in_order(&s.inputs):
                go_back(&s.offsets)
            elif status == VALID and fabs(at.direction) > ONE_SIDED:
                keep_offsets(&law.offsets, &s.offsets, &s.agreement, &best, fmin(fabs(at.raw_nm), fabs(at.torsion_nm)), x.dt_s)
            self.update_path_difference(&at, x, &best, loss.nm, status)
        if law.offsets.spread > 0.0:
            known = known_nm2(&law.offsets, &s.offsets)
            reweigh(&physics, known, law.offsets.spread_nm)
            reweigh(&best, known, law.offsets.spread_nm)
        out.physics_nm = physics.value + seen.ahead_nm  # paths fused at the same delay, then advanced by the torsion
        out.torque_nm = best.value + at.ahead_nm
        # at rest the current path is only an interval, and its distance to the torsion is no evidence against the file
        difference = 0.0 if standing else seen.torsion_nm - (raw - lost)
        if law.with_envelope:
            # the fit is known up to half the weight; the same motor torque holds more load when back-driven
            if fabs(physics.value) > law.trust.load or fused_trust(&law.trust, v, raw, difference, x.temperature_c) < 0.5:
                degraded = True
        if law.network.used and (not by_network or (alone and trusted < 0.5)):
            degraded = True
        if by_network and not standing:
            share = best.alpha * best.alpha
        spread = scale * best.sigma
        # an uncorrected offset counts once: as mismatch, where the file has section agreement
        more = apart_nm2(&best, 0.0 if law.agreement.used else s.offsets.uncorrected_nm)
        variance = spread * spread + day_nm2(&law.offsets, known, best.alpha) + more
        if law.agreement.used:
            mismatch = mismatch_variance(&s.agreement, best.alpha, at.torsion_nm)
            if degrades(
                &law.agreement, &s.agreement, &s.offsets, mismatch, sqrt(variance), best.alpha, at.torsion_nm
            ):
                s.degraded_s, degraded = LOWERED_S, True
            more += mismatch
            variance += mismatch
        if s.inputs.doubt > DOUBTFUL * law.inputs.tolerance:
            s.degraded_s, degraded = LOWERED_S, True
        if degraded:
            out.status = DEGRADED
        elif standing and alone and law.network.used:
            variance = law.rest * law.rest + (2.0 * (1.0 - trusted) * law.outside) ** 2
        elif standing:
            variance = self.half_interval(seen, &physics, loss.half, more, sqrt(variance)) ** 2
        if law.tracked and out.status != STANDSTILL:  # measured in motion; of the torsion, by its share
            variance += share * (law.tracking_noise + law.tracking_viscous * v * v / (1.0 + law.tracking_bend * v * v))
        noise = louder_nm2(&law.inputs, &s.inputs)
        stiffness = local_stiffness(&law.observer, s.observer.d)  # more under load
        if noise > 0.0:
            variance += (stiffness * best.alpha / law.observer.stiffness) ** 2 * noise
        unproven = unproven_nm2(
            &law.proof, unproven, best.alpha, s.offsets.now.link_rad, share * stiffness * stiffness * at.behind_rad2
        )
        out.sigma_nm = sqrt(variance + unproven + s.inputs.doubt * s.inputs.doubt)
        publish_within(out, law.limit)

    cdef double half_interval(
        self, const FusedObserved *seen, const Fused *physics, double half, double more, double sigma
    ) noexcept nogil:
        """Return half the interval of a standing joint [Nm], of friction or of the fusion, whichever is less.

        half: of the friction interval; more: variance of the paths' disagreement; sigma: as in motion.
        """
        cdef const FusedLaw *law = &self.law
        cdef double friction = law.stand_share * half + law.stand_floor, width
        cdef Rest rest
        if law.stand_sigmas == 0.0:
            return fmin(friction, STANDSTILL_WIDTH * sigma)
        rest = at_rest(
            &law.fusion, physics.alpha, seen.raw_nm, self.state.half, seen.joint_velocity_rad_s, seen.torsion_nm,
            seen.open_nm
        )
        width = law.stand_sigmas * rest.spread + rest.bound
        if more > 0.0:
            width = sqrt(width * width + STANDSTILL_WIDTH * STANDSTILL_WIDTH * more)
        # the friction interval is centred on the current path, not on the value
        return fmin(friction + fabs(physics.alpha * physics.difference), width)


def observe_run(
    joint, settings, torsion, dt_s, current_a, motor_position_rad, motor_velocity_rad_s, link_position_rad,
    temperature_c=None
):
    """Return the outputs of the fused observer and its guard over a run, an `ObservedRun`; arrays [n], dt_s[k] since sample k-1.

    torsion: in place of the joint's own, None for none. Raises ValueError for arrays of different length.
    """
    inputs = columns(dt_s, current_a, motor_position_rad, motor_velocity_rad_s, link_position_rad, temperature_c)
    cdef FusedLaw law
    cdef GuardState guard
    cdef FusedObserverState state
    cdef FusedObserved out
    cdef Sample sample
    cdef Py_ssize_t k
    fill_guard(&law.guard, joint, settings)
    fill_fused_observer(&law.observer, joint, torsion, settings)
    restart_guard(&guard)
    n = inputs.shape[1]
    rows, waves, status = np.full((7, n), NAN), np.full((n, 6), NAN), np.empty(n, np.uint8)
    cdef const double[:, ::1] x = inputs
    cdef double[:, ::1] to = rows
    cdef double[:, ::1] w = waves
    cdef unsigned char[::1] s = status
    with nogil:
        for k in range(x.shape[1]):
            sample = Sample(x[0, k], x[1, k], x[2, k], x[3, k], x[4, k], x[5, k])
            if observe_fused(&law.guard, &guard, &law.observer, &state, &sample, &out):
                to[0, k], to[1, k], to[2, k] = out.raw_nm, out.joint_velocity_rad_s, out.torsion_nm
                to[3, k], to[4, k], to[5, k], to[6, k] = out.direction, out.open_nm, out.ahead_nm, out.behind_rad2
                w[k, 0], w[k, 1], w[k, 2], w[k, 3] = out.cos2, out.sin2, out.cos4, out.sin4
                w[k, 4], w[k, 5] = out.cos1, out.sin1
            s[k] = guard.status
    raw, v, torsion_nm, direction, open_nm, ahead_nm, behind_rad2 = rows
    ripple, turn = np.ascontiguousarray(waves[:, :4]), np.ascontiguousarray(waves[:, 4:])
    return ObservedRun(status, raw, v, torsion_nm, ripple, inputs[5], direction, inputs[0], open_nm, ahead_nm, turn, behind_rad2)


# Joints with effects --------------------------------------------------------------------------------------------------

cdef class ExtendedEstimator(Estimator):
    """Estimator of a joint with effects: `ExtendedInputs` corrects the inputs of the estimator of the plain joint.

    joint: with its effects; inner: estimator of `plain_joint(joint)`.
    """

    def __init__(self, joint, settings, Estimator inner):
        self.joint, self.settings, self.inner = joint, settings, inner
        self.width, self.with_network = inner.width, inner.with_network
        self.corrections = ExtendedInputs(joint, settings)
        self.torque_nm = NAN

    @property
    def zeros(self):
        return getattr(self.inner, "zeros", None)

    cdef const void *learned(self, Learned *out, size_t *size) noexcept nogil:
        """As that of the inner estimator: the corrections forget within a second and are not reported."""
        return self.inner.learned(out, size)

    def reset(self):
        self.inner.reset()
        self.corrections.restart()
        self.torque_nm = NAN

    cdef void advance(self, const Sample *x, bint network_wanted, Values *out) noexcept nogil:
        """Set `out` to the estimate at this sample; the corrections are Python."""
        cdef Sample corrected = x[0]
        cdef int n
        with gil:
            corrected.current_a, corrected.link_position_rad = self.corrections.step(
                x.dt_s, x.current_a, x.motor_position_rad, x.motor_velocity_rad_s, x.link_position_rad, x.temperature_c,
                self.torque_nm
            )
        self.inner.advance(&corrected, network_wanted, out)
        self.observed = self.inner.observed
        for n in range(self.width):
            self.features[n] = self.inner.features[n]
        self.torque_nm = out.torque_nm


cdef class PythonEstimator(Estimator):
    """Estimator written in Python, for the compiled loop: `inner` has `step` and `reset`, and perhaps the rest."""

    cdef readonly object inner

    def __init__(self, inner):
        self.inner, self.with_network = inner, getattr(inner, "with_network", False)
        self.joint, self.settings = getattr(inner, "joint", None), getattr(inner, "settings", None)

    cdef void advance(self, const Sample *sample, bint network_wanted, Values *out) noexcept nogil:
        with gil:
            e = self.inner.step(
                sample.dt_s, sample.current_a, sample.motor_position_rad, sample.motor_velocity_rad_s,
                sample.link_position_rad, sample.temperature_c, bool(network_wanted)
            )
            out.torque_nm, out.sigma_nm, out.status = e.torque_nm, e.sigma_nm, e.status
            out.tob_nm, out.physics_nm, out.network_nm = e.tob_nm, e.physics_nm, e.network_nm

    def reset(self):
        """Forget the past: the next step starts."""
        self.inner.reset()


# Estimator of a joint by method ----------------------------------------------------------------------------------------

def make_estimator(joint, settings, network=None):
    """Return the estimator of a joint. Raises ConfigError when joint, method and network do not fit."""
    plain = plain_joint(joint)
    inner = globals()[METHODS[settings.method].estimator](plain, settings, network)  # a class of this module
    return ExtendedEstimator(joint, settings, inner) if acting_effects(joint) else inner


def estimate_columns(joint, settings, network, time_s, columns):
    """Return the estimates of one joint of a run table, time_s [n].

    Raises ConfigError as `make_estimator` does, ValueError for a missing column.
    """
    inputs = {name: getattr(columns, name) for name in INPUTS}
    missing = [name for name, column in inputs.items() if column is None]
    if missing:
        raise ValueError(f"joint {joint.name}: the run has no {', '.join(missing)}")
    dt_s = np.diff(time_s, prepend=time_s[0])
    return make_estimator(joint, settings, network).run(dt_s, *inputs.values(), columns.temperature_c)
