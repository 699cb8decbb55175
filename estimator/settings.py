"""Estimation methods (METHODS), their settings, and the limits of the plausibility checks, as frozen values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import inf
from typing import Annotated, Any, Final

from jtqd.estimator.decoder import FieldError, check, choice, limits
from jtqd.estimator.joint import Joint, Torsion, Tracking

TORSION_BANDWIDTH_RAD_S: Final = 800.0
"""Of joints whose torsion is not tracked, in new configurations: chosen from a table, docs/estimator.md."""

CONTACT_THRESHOLD: Final = 0.05
"""Torque from outside that is a contact, as a part of the rated torque."""


@dataclass(frozen=True)
class Method:
    """One estimation method: what the product asks of it. A new method is a new entry of METHODS
    and, where no estimator serves it, a class.

    title: in tables; estimator: name of its class in `jtqd.estimator.estimator`; sections: of the joint file that a
    configuration with it must have; network: name of its class in `jtqd.estimator.network`, "" where it uses none;
    network_required: it estimates nothing without one; network_ending: of its file in a directory of models, after jointN;
    with_torsion: it estimates from `fused.torsion` where the joint file has it; sigma_has_floor: sigma is never below
    `sigma_floor`; settings: of a new configuration, where they are not the defaults.
    """

    title: str
    estimator: str
    sections: tuple[str, ...] = ()
    network: str = ""
    network_required: bool = False
    network_ending: str = ""
    with_torsion: bool = False
    sigma_has_floor: bool = True
    settings: Mapping[str, Any] = field(default_factory=dict)

    @property
    def network_optional(self) -> bool:
        """Whether it uses a network and estimates without one too."""
        return bool(self.network) and not self.network_required

    def torsion_of(self, joint: Joint) -> Torsion | None:
        """Return the torsion that a joint is estimated from; None where it is not."""
        return joint.fused.torsion if self.with_torsion and joint.fused is not None else None


METHODS: Final[Mapping[str, Method]] = {
    "tob": Method("classical TOB", "JointEstimator"),  # Eq. (4) with additive friction
    "efficiency": Method("TOB with efficiency", "JointEstimator", ("efficiency",)),  # Eq. (7)
    "network": Method(  # section III of the paper
        "the paper's chain",
        "JointEstimator",
        ("efficiency",),
        network="TorqueNetwork",
        network_required=True,
        network_ending=".onnx",
    ),
    "fused": Method(  # ours
        "ours",
        "FusedEstimator",
        ("fused",),
        network="PathNetwork",
        network_ending=".fused.onnx",
        with_torsion=True,
        sigma_has_floor=False,
        settings={
            "torsion_bandwidth_rad_s": TORSION_BANDWIDTH_RAD_S,
            "track_zeros": True,
            "track_torsion": True,
        },
    ),
}


@dataclass(frozen=True, slots=True)
class EstimatorSettings:
    """How one joint is estimated. Values out of range raise ConfigError.

    bandwidth_rad_s: g of the observer, group delay 1/g; torsion_bandwidth_rad_s: g_t of the torsion of method
    `fused`, at least g, None for g; link_bandwidth_rad_s: of the link velocity;
    standstill_velocity_rad_s: joint side, entered below it, left above twice it; max_gap_s: longer steps
    restart; envelope_margin: part of each feature's span over which the paper's network fades out; network_limit,
    sigma_floor, torque_limit: parts of the rated torque (largest trusted difference between network and
    physics, sigma that nothing undercuts, largest believable torque); friction_uncertainty: standard
    deviation of friction as a part of it; load_uncertainty: of the classical observer, which knows no
    efficiency, as a part of the load; track_zeros: estimate the offsets of link encoder and current, method fused (`zeros`);
    track_torsion: a tracking filter without delay in place of the torsion's low pass, method fused, for joint files with
    `fused.tracking`.
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
        """Return the standard deviation of the torque sensor's offset, which a comparison with it has besides sigma [Nm].

        0 for a method whose sigma has a floor.
        """
        return 0.0 if METHODS[self.method].sigma_has_floor else self.sigma_floor * rated_torque_nm


def recommended(method: str) -> EstimatorSettings:
    """Return the settings of a new configuration with this method. Raises ConfigError for an unknown one."""
    return EstimatorSettings(method=method, **(METHODS[method].settings if method in METHODS else {}))


def tracking_of(joint: Joint, settings: EstimatorSettings) -> Tracking | None:
    """Return the tracking filter of a joint's torsion; None where the torsion has a low pass.

    It is tracked where the settings ask for it and the joint file has what that adds to sigma.
    """
    torsion = METHODS[settings.method].torsion_of(joint) if settings.track_torsion else None
    tracking = None if joint.fused is None or torsion is None else joint.fused.tracking
    return None if tracking is None or tracking.wave_rad_s is None else tracking


def bandwidth_of(joint: Joint, settings: EstimatorSettings, *, network: bool = False) -> float:
    """Return the bandwidth of a joint's estimate [rad/s]; infinite where it has no delay.

    network: the joint has one. Without delay are a torsion that is tracked and a network of the current path. Every other
    path of an estimator passes g/(s+g), whose group delay at low frequency is 1/g (`observer`). An estimate from torsion
    is as old as its torsion path with bandwidth g_t, every other one as old as the motor path. The sensor is compared
    through the same filter (`observer.low_pass`, `observer.reference_of`).
    """
    if tracking_of(joint, settings) is not None or (network and METHODS[settings.method].network_optional):
        return inf
    if METHODS[settings.method].torsion_of(joint) is not None:
        return settings.own_torsion_bandwidth_rad_s
    return settings.bandwidth_rad_s


def largest_torque_nm(joint: Joint, settings: EstimatorSettings) -> float:
    """Return the largest torque that is believed [Nm]: the peak of the joint file, else `torque_limit` rated torques."""
    peak = joint.peak_torque_nm
    return settings.torque_limit * joint.rated_torque_nm if peak is None else peak


def largest_difference_nm(joint: Joint, settings: EstimatorSettings) -> float:
    """Return the largest difference of network and physics that is believed [Nm]; ours is a view of its own."""
    if METHODS[settings.method].network_optional:
        return largest_torque_nm(joint, settings)
    return settings.network_limit * joint.rated_torque_nm


def age_ms(joint: Joint, settings: EstimatorSettings, *, network: bool = False) -> float:
    """Return the group delay of a joint's estimate at low frequency [ms]; arguments as `bandwidth_of`."""
    return 1e3 / bandwidth_of(joint, settings, network=network)


@dataclass(frozen=True, slots=True)
class PlausibilityLimits:
    """Thresholds of the plausibility checks, see the table in `plausibility`. Values out of range raise ConfigError.

    motor_jump_rad, mismatch_rad: motor side; twist_rad: joint side, for eccentric encoders and the like; frozen_s: of the
    current. Margins of the bench's runs: docs/safety.md.
    """

    motor_jump_rad: Annotated[float, limits("rad", ge=0.01, le=1e6)] = 1.0
    mismatch_rad: Annotated[float, limits("rad", ge=0.01, le=1e6)] = 4.0
    twist_rad: Annotated[float, limits("rad", ge=1e-4, le=1e3)] = 0.01
    frozen_s: Annotated[float, limits("s", ge=0.01, le=1e6)] = 0.5

    def __post_init__(self) -> None:
        check(self, "plausibility")
