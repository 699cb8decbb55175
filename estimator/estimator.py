"""The estimate of one joint, sample by sample: observer, loss, network, uncertainty, in this order.

| class | methods |
|---|---|
| `JointEstimator` | the paper's: `tob`, `efficiency`, `network` |
| `FusedEstimator` | ours: `fused` |
| `ExtendedEstimator` | either of them for a joint with effects: inputs corrected first (`corrections`) |

`methods.make_estimator` chooses. Each has `step`, `reset`, `with_network`, `joint` and `settings`. Everything that enters
the loss went through the same filter, so the physics estimate as a whole is 1/g old.
"""

from __future__ import annotations

from math import nan
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.checked import ConfigError
from jtqd.estimator.corrections import ExtendedInputs
from jtqd.estimator.fusion import HOLD_S, Fusion, turning
from jtqd.estimator.guard import Guard
from jtqd.estimator.joint import Fused, Joint
from jtqd.estimator.losses import AdditiveLossModel, LossModel
from jtqd.estimator.network import FusedNetworkModel, NetworkModel, checked_network, trust_of
from jtqd.estimator.observer import FusedObserver, Observer
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.status import (
    DEGRADED,
    INVALID,
    INVALID_ESTIMATE,
    STANDSTILL,
    STARTING,
    STARTING_ESTIMATE,
    Estimate,
)
from jtqd.estimator.validity import FADE_START, FusedTrust, Uncertainty

STANDSTILL_SIGMAS: Final = 3.0
"""Half width of the standstill interval in standard deviations, where torsion narrows what friction leaves open."""

_new: Final = tuple.__new__  # a NamedTuple's own constructor costs twice as much


class JointEstimator:
    """The paper's estimator of one joint: methods `tob`, `efficiency` and `network`.

        tau_raw, tau_tob, v, r  <-  observer (Eqs. 4, 7)
        i_eff      = tau_raw/(G Kt)                current without the part that accelerates the rotor
        efficiency = tau_raw - loss(i_eff, v)      inside a quadrant tau_raw eta(i_eff, v): Eq. (7) with Table I
        network    = N(i, theta_m, omega_m, theta_l, omega_l, efficiency)

    joint: parameters; settings: method and thresholds; network: needed by method "network" only. A joint without
    efficiency may use methods "tob" and "network" (the loss is then its additive friction).

    Raises ConfigError for effects (`make_estimator` applies them), a missing network or that of another joint.
    """

    __slots__ = (
        "_guard",
        "_inverse_gain",
        "_limit",
        "_loss",
        "_moving",
        "_network_sigma",
        "_run_network",
        "_standing",
        "_weight",
        "_with_efficiency",
        "joint",
        "settings",
    )

    def __init__(
        self, joint: Joint, settings: EstimatorSettings, network: NetworkModel | None = None
    ) -> None:
        used = checked_network(joint, settings, network)
        losses = LossModel(joint)
        uncertainty = Uncertainty(joint, settings, losses)
        self.joint: Final = joint
        self.settings: Final = settings
        self._guard: Final = Guard(
            Observer(joint, settings.bandwidth_rad_s, settings.link_bandwidth_rad_s), joint, settings
        )
        self._with_efficiency: Final = settings.method != "tob"
        self._inverse_gain: Final = 1.0 / losses.torque_per_ampere
        self._loss: Final = losses.loss
        self._moving: Final = uncertainty.moving
        self._standing: Final = uncertainty.standing
        self._limit: Final = settings.torque_limit * joint.rated_torque_nm
        self._run_network: Final = None if used is None else used.run_one
        self._network_sigma: Final = 0.0 if used is None else used.sigma_nm
        self._weight: Final = None if used is None else trust_of(joint, settings, used).weight

    @property
    def with_network(self) -> bool:
        """Whether a network is used."""
        return self._run_network is not None

    def reset(self) -> None:
        """Forget the past: the next step starts."""
        self._guard.reset()

    def step(  # noqa: PLR0917 - a sample, positional for speed
        self,
        dt_s: float,
        current_a: float,
        motor_position_rad: float,
        motor_velocity_rad_s: float,
        link_position_rad: float,
        temperature_c: float = nan,
        network_wanted: bool = True,
    ) -> Estimate:
        """Return the estimate at this sample, dt_s [s] after the one before; never raises on any float.

        Without network_wanted there is no time for it: this sample is physics only.
        """
        guard = self._guard
        observed = guard.step(dt_s, current_a, motor_position_rad, motor_velocity_rad_s, link_position_rad)
        status = guard.status
        if observed is None:
            return STARTING_ESTIMATE if status == STARTING else INVALID_ESTIMATE
        raw, tob, v, link_velocity = observed
        i = raw * self._inverse_gain
        efficiency = network = nan
        physics = tob
        if self._with_efficiency:
            physics = efficiency = raw - self._loss(i, v)
        weight = 0.0
        run_network = self._run_network
        if run_network is not None and network_wanted:
            network = run_network(
                current_a,
                motor_position_rad,
                motor_velocity_rad_s,
                link_position_rad,
                link_velocity,
                efficiency,
            )
            assert self._weight is not None
            difference = network - physics
            weight = self._weight(
                current_a,
                motor_position_rad,
                motor_velocity_rad_s,
                link_position_rad,
                link_velocity,
                efficiency,
                difference,
            )
        if status == STANDSTILL:
            torque, sigma = self._standing(raw, i)
        elif weight == 1.0:
            torque, sigma = network, self._network_sigma
        elif weight > 0.0:
            sigma = self._moving(raw, i, v)
            torque = physics + weight * (network - physics)
            sigma += weight * (self._network_sigma - sigma)
        else:
            torque, sigma = physics, self._moving(raw, i, v)
            if run_network is not None:
                status = DEGRADED
        if not -self._limit <= torque <= self._limit:
            torque = sigma = nan
            status = INVALID
        return _new(Estimate, (torque, sigma, status, tob, efficiency, network))


def checked_fused(joint: Joint, settings: EstimatorSettings, network: FusedNetworkModel | None) -> Fused:
    """Return section `fused` of the joint; ConfigError when joint, method and network do not fit."""
    if settings.method != "fused":
        raise ConfigError(f"joint {joint.name}: found method '{settings.method}', expected 'fused'")
    if joint.effects:
        names = ", ".join(effect.name for effect in joint.effects)
        raise ConfigError(
            f"joint {joint.name}: found effects ({names}), which `make_estimator` applies, not this class"
        )
    if joint.fused is None:
        raise ConfigError(
            f"joint {joint.name}: found no section 'fused', which method 'fused' needs; "
            "'jtq fit losses' makes one, methods 'tob' and 'efficiency' do not need it"
        )
    if network is not None and network.joint != joint.name:
        raise ConfigError(
            f"joint {joint.name}: found a network of joint '{network.joint}', expected one of '{joint.name}'"
        )
    return joint.fused


def _no_trust(*_: float) -> float:
    return 0.0


class FusedEstimator:
    """Our estimator of one joint, method `fused`; without a network its physics alone, status valid.

        tau_raw, v, tau_t, waves, s, open  <-  FusedObserver    s: direction, -1 to 1; open: of the torsion's slip
        physics = fusion of tau_raw - loss(tau_raw, v, s, T) and tau_t
        torque  = physics + w turning(v) N(features)            w: trust of the network; turning: 0 at rest, 1 from 0.2 rad/s

    w is 1 inside the network's envelope, falls continuously to 0 outside of it, and falls from 1 to 0 while |N| goes
    from 75 % to 100 % of the limit. Status 2 where w = 1, 3 where it is less (at w = 0 the value is the physics alone),
    6 at standstill.

    Raises ConfigError for a joint without section `fused`, effects (`make_estimator` applies them), another joint's
    network, or settings of another method.
    """

    __slots__ = (
        "_fade",
        "_fuse",
        "_guard",
        "_half",
        "_inverse_fade",
        "_limit",
        "_loss",
        "_network_limit",
        "_network_scale",
        "_physics_scale",
        "_run_network",
        "_stand_floor",
        "_stand_share",
        "_temperature",
        "_thermal",
        "_thermal_of",
        "_weight",
        "joint",
        "settings",
    )

    def __init__(
        self, joint: Joint, settings: EstimatorSettings, network: FusedNetworkModel | None = None
    ) -> None:
        fused = checked_fused(joint, settings, network)
        loss = AdditiveLossModel(fused.loss)
        self.joint: Final = joint
        self.settings: Final = settings
        observer = FusedObserver(
            joint, fused.torsion, settings.bandwidth_rad_s, settings.link_bandwidth_rad_s
        )
        self._guard: Final = Guard(observer, joint, settings)
        self._loss: Final = loss.loss
        self._thermal_of: Final = loss.thermal
        self._fuse: Final = Fusion(fused.sigma, fused.torsion is not None).fuse
        self._physics_scale: Final = fused.sigma.scale
        self._stand_share: Final = 1.0 + settings.friction_uncertainty
        self._stand_floor: Final = settings.sigma_floor * joint.rated_torque_nm
        self._limit: Final = settings.torque_limit * joint.rated_torque_nm
        self._network_limit: Final = settings.network_limit * joint.rated_torque_nm
        self._fade: Final = FADE_START * self._network_limit
        self._inverse_fade: Final = 1.0 / max(self._network_limit - self._fade, 1e-12)
        self._run_network: Final = None if network is None else network.run_one
        self._network_scale: Final = fused.sigma.scale if network is None else network.sigma_scale
        self._weight: Final = _no_trust if network is None else FusedTrust(network.envelope).weight
        self._temperature = nan
        self._thermal = 0.0
        self._half = 0.0

    @property
    def with_network(self) -> bool:
        """Whether a network is used."""
        return self._run_network is not None

    def reset(self) -> None:
        """Forget the past: the next step starts."""
        self._guard.reset()

    def step(  # noqa: PLR0917 - a sample, positional for speed
        self,
        dt_s: float,
        current_a: float,
        motor_position_rad: float,
        motor_velocity_rad_s: float,
        link_position_rad: float,
        temperature_c: float = nan,
        network_wanted: bool = True,
    ) -> Estimate:
        """Return the estimate at this sample, dt_s [s] after the one before; never raises on any float.

        temperature_c: of the joint, NaN where it is not known (the loss is then that of the fit's temperature). Without
        network_wanted there is no time for it: this sample is physics only.
        """
        guard = self._guard
        observed = guard.step(dt_s, current_a, motor_position_rad, motor_velocity_rad_s, link_position_rad)
        status = guard.status
        if observed is None:
            self._half = 0.0
            return STARTING_ESTIMATE if status == STARTING else INVALID_ESTIMATE
        raw, v, _, torsion, c2, s2, c4, s4, s, open_nm = observed
        if temperature_c is not self._temperature:  # a joint reports it twice a second
            self._temperature = temperature_c
            self._thermal = self._thermal_of(temperature_c)
        loss, half = self._loss(raw, v, self._thermal, s)
        faded = self._half * (HOLD_S / (HOLD_S + dt_s))  # fusion.held, in line
        self._half = wide = half if half >= faded else faded
        physics, sigma = self._fuse(raw, loss, wide, v, torsion, open_nm)
        quadrant = (0 if raw >= 0.0 else 2) if v >= 0.0 else (3 if raw >= 0.0 else 1)
        torque, network = physics, nan
        scale = self._physics_scale[quadrant]
        run_network = self._run_network
        if run_network is not None and not network_wanted:
            if status != STANDSTILL:
                status = DEGRADED
        elif run_network is not None:
            distance = torsion - (raw - loss)
            correction = run_network(v, raw, distance, c2, s2, c4, s4)
            network = physics + correction
            weight = 0.0
            size = correction if correction >= 0.0 else -correction
            if size <= self._network_limit:  # not so for NaN
                weight = self._weight(v, raw, distance, temperature_c)
                if size > self._fade:
                    weight = min(weight, (self._network_limit - size) * self._inverse_fade)
                torque += weight * turning(v) * correction
                scale += weight * (self._network_scale[quadrant] - scale)
            if weight < 1.0 and status != STANDSTILL:
                status = DEGRADED
        if status == STANDSTILL:
            sigma = min(self._stand_share * half + self._stand_floor, STANDSTILL_SIGMAS * scale * sigma)
        else:
            sigma *= scale
        if not -self._limit <= torque <= self._limit:
            torque = sigma = nan
            status = INVALID
        return _new(Estimate, (torque, sigma, status, nan, physics, network))


class ExtendedEstimator:
    """Estimator of a joint with effects: corrected inputs (`ExtendedInputs`) into the estimator of the plain joint.

    joint: with its effects; inner: estimator of `plain_joint(joint)`. `corrected`: current [A] and link position [rad]
    that the inner one was given last.
    """

    __slots__ = ("_inner", "_inner_step", "_inputs", "_torque", "corrected", "joint", "settings")

    def __init__(
        self, joint: Joint, settings: EstimatorSettings, inner: JointEstimator | FusedEstimator
    ) -> None:
        self.joint: Final = joint
        self.settings: Final = settings
        self.corrected = (nan, nan)
        self._inner: Final = inner
        self._inner_step: Final = inner.step
        self._inputs: Final = ExtendedInputs(joint, settings)
        self._torque = nan

    @property
    def with_network(self) -> bool:
        """Whether a network is used."""
        return self._inner.with_network

    def reset(self) -> None:
        """Forget the past: the next step starts."""
        self._inner.reset()
        self._inputs.restart()
        self._torque = nan

    def step(  # noqa: PLR0917 - a sample, positional for speed
        self,
        dt_s: float,
        current_a: float,
        motor_position_rad: float,
        motor_velocity_rad_s: float,
        link_position_rad: float,
        temperature_c: float = nan,
        network_wanted: bool = True,
    ) -> Estimate:
        """Return the estimate at this sample, dt_s [s] after the one before; never raises on any float."""
        self.corrected = current, link = self._inputs.step(
            dt_s,
            current_a,
            motor_position_rad,
            motor_velocity_rad_s,
            link_position_rad,
            temperature_c,
            self._torque,
        )
        estimate = self._inner_step(
            dt_s, current, motor_position_rad, motor_velocity_rad_s, link, temperature_c, network_wanted
        )
        self._torque = estimate.torque_nm
        return estimate


def corrected_by_steps(
    estimator: ExtendedEstimator,
    dt_s: FloatArray,
    columns: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    temperature_c: FloatArray | None,
) -> tuple[FloatArray, FloatArray]:
    """Return the corrected current and link position [n], sample by sample: where they depend on the estimates.

    columns: current, motor position, motor velocity, link position, each [n].
    """
    temperature = np.full(len(dt_s), nan) if temperature_c is None else temperature_c
    out = np.empty((2, len(dt_s)))
    samples = zip(*(column.tolist() for column in (dt_s, *columns, temperature)), strict=True)
    for k, sample in enumerate(samples):
        estimator.step(*sample)
        out[:, k] = estimator.corrected
    return out[0], out[1]
