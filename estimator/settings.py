"""Settings of the estimator and of its plausibility checks: frozen values, read from a configuration or built in code."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Final

from jtqd.estimator.decoder import FieldError, check, choice, limits

TORSION_BANDWIDTH_RAD_S: Final = 800.0
"""Of joints whose torsion is not tracked, in new configurations: chosen from a table, docs/estimator.md."""

CONTACT_THRESHOLD: Final = 0.05
"""Torque from outside that is a contact, as a part of the rated torque."""

METHODS: Final = ("tob", "efficiency", "network", "fused")
"""tob: Eq. (4) with additive friction; efficiency: Eq. (7); network: the paper's section III on top; fused: ours."""


@dataclass(frozen=True, slots=True)
class EstimatorSettings:
    """How one joint is estimated. Values out of range raise ConfigError.

    bandwidth_rad_s: g of the observer, group delay 1/g; torsion_bandwidth_rad_s: g_t of the torsion of method
    `fused`, at least g, None for g; link_bandwidth_rad_s: of the link velocity;
    standstill_velocity_rad_s: joint side, entered below it, left above twice it; max_gap_s: longer steps
    restart; envelope_margin: part of each feature's span over which the network fades out; network_limit,
    sigma_floor, torque_limit: parts of the rated torque (largest trusted difference between network and
    physics, sigma that nothing undercuts, largest believable torque); friction_uncertainty: standard
    deviation of friction as a part of it; load_uncertainty: of the classical observer, which knows no
    efficiency, as a part of the load; track_zeros: of link encoder and current, method fused (`zeros`); track_torsion: a
    tracking filter, of now, in place of the torsion's low pass, method fused, for joint files with `fused.tracking`
    (`age`). Without these two keys as before there were such.
    """

    method: Annotated[str, choice(METHODS)] = "network"
    bandwidth_rad_s: Annotated[float, limits("rad/s", ge=1.0, le=5000.0)] = 200.0
    torsion_bandwidth_rad_s: Annotated[float, limits("rad/s", ge=1.0, le=5000.0)] | None = None
    link_bandwidth_rad_s: Annotated[float, limits("rad/s", ge=1.0, le=5000.0)] = 200.0
    standstill_velocity_rad_s: Annotated[float, limits("rad/s", ge=0.0, le=1.0)] = 0.01
    max_gap_s: Annotated[float, limits("s", ge=1e-4, le=1.0)] = 0.05
    envelope_margin: Annotated[float, limits(ge=0.0, le=1.0)] = 0.05
    network_limit: Annotated[float, limits(ge=0.0, le=3.0)] = 0.25
    friction_uncertainty: Annotated[float, limits(ge=0.0, le=1.0)] = 0.15
    load_uncertainty: Annotated[float, limits(ge=0.0, le=1.0)] = 0.15
    sigma_floor: Annotated[float, limits(ge=0.0, le=1.0)] = 0.005
    torque_limit: Annotated[float, limits(ge=1.0, le=10.0)] = 3.0
    track_zeros: bool = False
    track_torsion: bool = False

    def __post_init__(self) -> None:
        check(self, "estimator")
        own = self.torsion_bandwidth_rad_s
        if own is not None and own < self.bandwidth_rad_s:
            expected = f"at least bandwidth_rad_s ({self.bandwidth_rad_s:g} rad/s)"
            raise FieldError("estimator", "torsion_bandwidth_rad_s", own, expected)

    @property
    def own_torsion_bandwidth_rad_s(self) -> float:
        """g_t of the torsion, which is g where none is set."""
        own = self.torsion_bandwidth_rad_s
        return self.bandwidth_rad_s if own is None else own

    def sensor_zero_nm(self, rated_torque_nm: float) -> float:
        """Return what a comparison with a torque sensor holds beside sigma, as a standard deviation: the sensor's zero.

        Of method fused; sigma of the others never falls below `sigma_floor` anyway.
        """
        return self.sigma_floor * rated_torque_nm if self.method == "fused" else 0.0


def recommended(method: str) -> EstimatorSettings:
    """Return the settings of a new configuration with this method. Raises ConfigError for an unknown one."""
    if method != "fused":
        return EstimatorSettings(method=method)
    return EstimatorSettings(
        method=method, torsion_bandwidth_rad_s=TORSION_BANDWIDTH_RAD_S, track_zeros=True, track_torsion=True
    )


@dataclass(frozen=True, slots=True)
class PlausibilityLimits:
    """Thresholds of the plausibility checks, see the table in `plausibility`. Values out of range raise ConfigError.

    motor_jump_rad, mismatch_rad: motor side; twist_rad: joint side, for eccentric encoders and the like; frozen_s: of the
    current. docs/safety.md says how far the runs of the bench stay below them.
    """

    motor_jump_rad: Annotated[float, limits("rad", ge=0.01, le=1e6)] = 1.0
    mismatch_rad: Annotated[float, limits("rad", ge=0.01, le=1e6)] = 4.0
    twist_rad: Annotated[float, limits("rad", ge=1e-4, le=1e3)] = 0.01
    frozen_s: Annotated[float, limits("s", ge=0.01, le=1e6)] = 0.5

    def __post_init__(self) -> None:
        check(self, "plausibility")
