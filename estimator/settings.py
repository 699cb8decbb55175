"""Settings of the estimator: one frozen value, read from a configuration section or built in code."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any, Final

from jtqd.estimator.checked import ConfigError, Section

METHODS: Final = ("tob", "efficiency", "network", "fused")
"""tob: Eq. (4) with additive friction; efficiency: Eq. (7); network: the paper's section III on top; fused: ours."""

# name -> unit, lowest, highest
_RANGES: Final = {
    "bandwidth_rad_s": ("rad/s", 1.0, 5000.0),
    "link_bandwidth_rad_s": ("rad/s", 1.0, 5000.0),
    "standstill_velocity_rad_s": ("rad/s", 0.0, 1.0),
    "max_gap_s": ("s", 1e-4, 1.0),
    "envelope_margin": ("", 0.0, 1.0),
    "network_limit": ("", 0.0, 3.0),
    "friction_uncertainty": ("", 0.0, 1.0),
    "load_uncertainty": ("", 0.0, 1.0),
    "sigma_floor": ("", 0.0, 1.0),
    "torque_limit": ("", 1.0, 10.0),
}


@dataclass(frozen=True, slots=True)
class EstimatorSettings:
    """How one joint is estimated. Values out of range raise ConfigError.

    bandwidth_rad_s: g of the observer, group delay 1/g; link_bandwidth_rad_s: of the link velocity;
    standstill_velocity_rad_s: joint side, entered below it, left above twice it; max_gap_s: longer steps
    restart; envelope_margin: part of each feature's span over which the network fades out; network_limit,
    sigma_floor, torque_limit: parts of the rated torque (largest trusted difference between network and
    physics, sigma that nothing undercuts, largest believable torque); friction_uncertainty: standard
    deviation of friction as a part of it; load_uncertainty: of the classical observer, which knows no
    efficiency, as a part of the load.
    """

    method: str = "network"
    bandwidth_rad_s: float = 200.0
    link_bandwidth_rad_s: float = 200.0
    standstill_velocity_rad_s: float = 0.01
    max_gap_s: float = 0.05
    envelope_margin: float = 0.05
    network_limit: float = 0.25
    friction_uncertainty: float = 0.15
    load_uncertainty: float = 0.15
    sigma_floor: float = 0.005
    torque_limit: float = 3.0

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise ConfigError(
                f"estimator.method: found {self.method!r}, expected one of {', '.join(METHODS)}"
            )
        for name, (unit, low, high) in _RANGES.items():
            value = getattr(self, name)
            if not (isinstance(value, int | float) and math.isfinite(value) and low <= value <= high):
                raise ConfigError(
                    f"estimator.{name}: found {value!r}, expected a number {unit} from {low:g} to {high:g}"
                )

    @classmethod
    def from_section(cls, section: Section) -> EstimatorSettings:
        """Read the mapping of a configuration file; keys are the field names, all optional."""
        values: dict[str, Any] = {"method": section.text("method", choices=METHODS, default=cls().method)}
        for name, (unit, low, high) in _RANGES.items():
            default = next(item.default for item in fields(cls) if item.name == name)
            values[name] = section.number(name, unit, low, high, default=default)
        section.finish()
        return cls(**values)
