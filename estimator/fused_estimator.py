"""Our estimator of one joint, sample by sample: observer, additive loss, fusion with torsion, network, validity.

    tau_raw, v, tau_t, ripple  <-  FusedObserver
    physics = fusion of tau_raw - loss(tau_raw, v, T) and tau_t
    torque  = physics + w tanh^2(v/w0) N(features)          w: trust of the network, fades at standstill

Status 2 inside the network's envelope, 3 outside of it (the value is then the physics, by the share of trust), 6 at
standstill. Everything has passed the same filter: the estimate as a whole is 1/g old.
"""

from __future__ import annotations

from math import cos, nan, sin, tanh
from typing import Final

from estimator.additive_loss import AdditiveLossModel
from estimator.checked import ConfigError
from estimator.estimate import INVALID_ESTIMATE, STARTING_ESTIMATE, Estimate
from estimator.friction import DIRECTION_VELOCITY_RAD_S
from estimator.fused_network import FusedNetworkModel
from estimator.fused_observer import FusedObserver
from estimator.fused_parameters import Fused
from estimator.fused_trust import FusedTrust
from estimator.fusion import Fusion
from estimator.parameters import Joint
from estimator.settings import EstimatorSettings
from estimator.status import DEGRADED, INVALID, STANDSTILL, STARTING
from estimator.tracking import Tracker

STANDSTILL_SIGMAS: Final = 3.0
"""Half width of the standstill interval in standard deviations, where torsion narrows what friction leaves open."""

_new: Final = tuple.__new__


def fused_parts(
    joint: Joint, settings: EstimatorSettings, network: FusedNetworkModel | None
) -> tuple[Fused, FusedNetworkModel | None]:
    """Return section `fused` and the network, checked against each other; ConfigError when they do not fit."""
    if joint.effects:
        names = ", ".join(effect.name for effect in joint.effects)
        raise ConfigError(
            f"joint {joint.name}: found effects ({names}), which this estimator cannot apply; expected none"
        )
    if joint.fused is None:
        raise ConfigError(
            f"joint {joint.name}: found no section 'fused', which method '{settings.method}' needs; "
            "'jtq fit losses' makes one, methods 'tob' and 'efficiency' work without"
        )
    if network is not None and network.joint != joint.name:
        raise ConfigError(
            f"joint {joint.name}: found a network of joint '{network.joint}', expected one of '{joint.name}'"
        )
    return joint.fused, network


class FusedEstimator:
    """Estimator of one joint by method `fused`; without a network its physics alone, status valid.

    Raises ConfigError for a joint without section `fused`, effects it cannot apply, or another joint's network.
    """

    __slots__ = (
        "_fuse",
        "_inverse_w0",
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
        "_tracker",
        "_weight",
        "joint",
        "settings",
    )

    def __init__(
        self, joint: Joint, settings: EstimatorSettings, network: FusedNetworkModel | None = None
    ) -> None:
        fused, used = fused_parts(joint, settings, network)
        loss = AdditiveLossModel(fused.loss)
        self.joint: Final = joint
        self.settings: Final = settings
        observer = FusedObserver(
            joint, fused.torsion, settings.bandwidth_rad_s, settings.link_bandwidth_rad_s
        )
        self._tracker: Final = Tracker(observer, joint, settings)
        self._loss: Final = loss
        self._fuse: Final = Fusion(fused.sigma, fused.torsion is not None).fuse
        self._physics_scale: Final = fused.sigma.scale
        self._inverse_w0: Final = 1.0 / DIRECTION_VELOCITY_RAD_S
        self._stand_share: Final = 1.0 + settings.friction_uncertainty
        self._stand_floor: Final = settings.sigma_floor * joint.rated_torque_nm
        self._limit: Final = settings.torque_limit * joint.rated_torque_nm
        self._network_limit: Final = settings.network_limit * joint.rated_torque_nm
        self._run_network: Final = None if used is None else used.run_one
        self._network_scale: Final = fused.sigma.scale if used is None else used.sigma_scale
        self._weight: Final = None if used is None else FusedTrust(used.envelope).weight
        self._temperature = nan
        self._thermal = 0.0

    def reset(self) -> None:
        """Forget the past: the next step starts."""
        self._tracker.reset()

    def step(  # noqa: PLR0917
        self,
        dt_s: float,
        current_a: float,
        motor_position_rad: float,
        motor_velocity_rad_s: float,
        link_position_rad: float,
        temperature_c: float = nan,
    ) -> Estimate:
        """Return the estimate at this sample, dt_s [s] after the one before; never raises on any float.

        temperature_c: of the joint, NaN where it is not known (the loss is then that of the fit's temperature).
        """
        tracker = self._tracker
        seen = tracker.step(dt_s, current_a, motor_position_rad, motor_velocity_rad_s, link_position_rad)
        status = tracker.status
        if seen is None:
            return STARTING_ESTIMATE if status == STARTING else INVALID_ESTIMATE
        raw, v, _, torsion, c2, s2, c4, s4 = seen
        if temperature_c != self._temperature:  # changes twice a second at most; NaN each time, cheaply
            self._temperature = temperature_c
            self._thermal = self._loss.thermal(temperature_c)
        loss, half = self._loss.loss(raw, v, self._thermal)
        physics, sigma = self._fuse(raw, loss, half, v, torsion)
        quadrant = (0 if raw >= 0.0 else 2) if v >= 0.0 else (3 if raw >= 0.0 else 1)
        torque, network = physics, nan
        scale = self._physics_scale[quadrant]
        run_network = self._run_network
        if run_network is not None:
            distance = torsion - (raw - loss)
            correction = run_network(
                v,
                raw,
                distance,
                c2,
                s2,
                c4,
                s4,
                cos(link_position_rad),
                sin(link_position_rad),
            )
            network = physics + correction
            weight = 0.0
            if -self._network_limit <= correction <= self._network_limit:  # not so for NaN
                assert self._weight is not None
                weight = self._weight(v, raw, distance, temperature_c)
                s = tanh(v * self._inverse_w0)
                torque += weight * s * s * correction
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
