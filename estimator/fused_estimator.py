"""Our estimator of one joint, sample by sample: observer, additive loss, fusion with torsion, network, validity.

    tau_raw, v, tau_t, waves, s, open  <-  FusedObserver    s: direction, -1 to 1; open: of the torsion's slip
    physics = fusion of tau_raw - loss(tau_raw, v, s, T) and tau_t
    torque  = physics + w turning(v) N(features)            w: trust of the network; turning: 0 at rest, 1 from 0.2 rad/s

w is 1 inside the network's envelope, falls continuously to 0 outside of it, and falls from 1 to 0 while |N| goes from
75 % to 100 % of the limit. Status 2 where w = 1, 3 where it is less (at w = 0 the value is the physics alone), 6 at
standstill. Everything has passed the same filter: the estimate as a whole is 1/g old.
"""

from __future__ import annotations

from math import nan
from typing import Final

from estimator.additive_loss import AdditiveLossModel
from estimator.checked import ConfigError
from estimator.estimate import INVALID_ESTIMATE, STARTING_ESTIMATE, Estimate
from estimator.fused_network import FusedNetworkModel
from estimator.fused_observer import FusedObserver
from estimator.fused_parameters import Fused
from estimator.fused_trust import FusedTrust
from estimator.fusion import HOLD_S, Fusion, turning
from estimator.parameters import Joint
from estimator.settings import EstimatorSettings
from estimator.status import DEGRADED, INVALID, STANDSTILL, STARTING
from estimator.tracking import Tracker
from estimator.validity import FADE_START

STANDSTILL_SIGMAS: Final = 3.0
"""Half width of the standstill interval in standard deviations, where torsion narrows what friction leaves open."""

_new: Final = tuple.__new__


def fused_parts(
    joint: Joint, settings: EstimatorSettings, network: FusedNetworkModel | None
) -> tuple[Fused, FusedNetworkModel | None]:
    """Return section `fused` and the network, checked; ConfigError when joint, method and network do not fit."""
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
            "'jtq fit losses' makes one, methods 'tob' and 'efficiency' work without"
        )
    if network is not None and network.joint != joint.name:
        raise ConfigError(
            f"joint {joint.name}: found a network of joint '{network.joint}', expected one of '{joint.name}'"
        )
    return joint.fused, network


def _no_trust(*_: float) -> float:
    return 0.0


class FusedEstimator:
    """Estimator of one joint by method `fused`; without a network its physics alone, status valid.

    Raises ConfigError for a joint without section `fused`, effects (`make_estimator` applies them), another joint's
    network, or settings of another method.
    """

    __slots__ = (
        "_fade",
        "_fuse",
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
        self._run_network: Final = None if used is None else used.run_one
        self._network_scale: Final = fused.sigma.scale if used is None else used.sigma_scale
        self._weight: Final = _no_trust if used is None else FusedTrust(used.envelope).weight
        self._temperature = nan
        self._thermal = 0.0
        self._half = 0.0

    @property
    def with_network(self) -> bool:
        """Whether a network is used."""
        return self._run_network is not None

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
        network_wanted: bool = True,
    ) -> Estimate:
        """Return the estimate at this sample, dt_s [s] after the one before; never raises on any float.

        temperature_c: of the joint, NaN where it is not known (the loss is then that of the fit's temperature). Without
        network_wanted there is no time for it: this sample is physics only.
        """
        tracker = self._tracker
        seen = tracker.step(dt_s, current_a, motor_position_rad, motor_velocity_rad_s, link_position_rad)
        status = tracker.status
        if seen is None:
            self._half = 0.0
            return STARTING_ESTIMATE if status == STARTING else INVALID_ESTIMATE
        raw, v, _, torsion, c2, s2, c4, s4, s, open_nm = seen
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
