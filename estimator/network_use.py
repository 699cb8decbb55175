"""How a network is attached to a joint: what it must offer, whether it fits, how far it is trusted."""

from __future__ import annotations

from typing import Protocol

from estimator.checked import ConfigError
from estimator.friction import FloatArray
from estimator.parameters import Joint
from estimator.settings import EstimatorSettings
from estimator.validity import Trust


class NetworkModel(Protocol):
    """What is needed of a network; estimator.network.TorqueNetwork has it."""

    @property
    def joint(self) -> str:
        """Name of the joint it was trained for."""

    @property
    def envelope_low(self) -> tuple[float, ...]:
        """Lower end of the training range per feature."""

    @property
    def envelope_high(self) -> tuple[float, ...]:
        """Upper end of the training range per feature."""

    @property
    def sigma_nm(self) -> float:
        """Held-out standard deviation."""

    def run_one(  # noqa: PLR0917
        self, x0: float, x1: float, x2: float, x3: float, x4: float, x5: float
    ) -> float:
        """Return the torque of one sample."""

    def run_many(self, features: FloatArray) -> FloatArray:
        """Return the torques [n] of samples [n, 6]."""


def checked_network(
    joint: Joint, settings: EstimatorSettings, network: NetworkModel | None
) -> NetworkModel | None:
    """Return the network that the method uses, if it uses one; ConfigError when the three do not fit."""
    if settings.method == "fused":
        raise ConfigError(
            f"joint {joint.name}: found method 'fused', which FusedEstimator applies, not this one"
        )
    if joint.effects:
        names = ", ".join(effect.name for effect in joint.effects)
        raise ConfigError(
            f"joint {joint.name}: found effects ({names}), which `make_estimator` applies, not this class"
        )
    if settings.method == "efficiency" and joint.efficiency is None:
        raise ConfigError(
            f"joint {joint.name}: found no efficiency, which method 'efficiency' needs; 'tob' works without"
        )
    if settings.method != "network":
        return None
    if network is None:
        raise ConfigError(f"joint {joint.name}: found no network, which method 'network' needs")
    if network.joint != joint.name:
        raise ConfigError(
            f"joint {joint.name}: found a network of joint '{network.joint}', expected one of '{joint.name}'"
        )
    return network


def trust_of(joint: Joint, settings: EstimatorSettings, network: NetworkModel) -> Trust:
    """Return the weight function of a network on a joint."""
    limit = settings.network_limit * joint.rated_torque_nm
    return Trust(network.envelope_low, network.envelope_high, settings.envelope_margin, limit)
