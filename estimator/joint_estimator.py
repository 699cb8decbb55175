"""The estimate of one joint, sample by sample: observer, loss, network, validity, in this order.

    tau_raw, tau_tob, v, r  <-  observer (Eqs. 4, 7)
    i_eff      = tau_raw/(G Kt)                current without the part that accelerates the rotor
    efficiency = tau_raw - loss(i_eff, v)      inside a quadrant tau_raw eta(i_eff, v): Eq. (7) with Table I
    network    = N(i, theta_m, omega_m, theta_l, omega_l, efficiency)

Everything that enters the loss went through the same filter, so the physics estimate as a whole is 1/g old.
"""

from __future__ import annotations

from math import nan
from typing import Final

from estimator.estimate import INVALID_ESTIMATE, OFF_ESTIMATE, STARTING_ESTIMATE, Estimate
from estimator.losses import LossModel
from estimator.network_use import NetworkModel, checked_network, trust_of
from estimator.observer import Observer
from estimator.parameters import Joint
from estimator.settings import METHODS, EstimatorSettings
from estimator.status import DEGRADED, INVALID, STANDSTILL, STARTING
from estimator.tracking import Tracker
from estimator.validity import Uncertainty
from estimator.whole_run import EstimateRun, estimate_run

__all__ = [
    "METHODS",
    "OFF_ESTIMATE",
    "Estimate",
    "EstimateRun",
    "EstimatorSettings",
    "JointEstimator",
    "estimate_run",
]


_new: Final = tuple.__new__


class JointEstimator:
    """Estimator of one plain joint. Raises ConfigError for effects (`make_estimator` applies them), another's network.

    joint: parameters; settings: method and thresholds; network: needed by method "network" only. A joint
    without efficiency may use methods "tob" and "network" (the loss is then its additive friction).
    """

    __slots__ = (
        "_inverse_gain",
        "_limit",
        "_loss",
        "_moving",
        "_network_sigma",
        "_run_network",
        "_standing",
        "_tracker",
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
        self._tracker: Final = Tracker(
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
        self._tracker.reset()

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
        tracker = self._tracker
        seen = tracker.step(dt_s, current_a, motor_position_rad, motor_velocity_rad_s, link_position_rad)
        status = tracker.status
        if seen is None:
            return STARTING_ESTIMATE if status == STARTING else INVALID_ESTIMATE
        raw, tob, v, link_velocity = seen
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
