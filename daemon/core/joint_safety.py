"""Limits and checks of a joint: what `daemon/core/status.pyx` judges its estimates by. Pure."""

from __future__ import annotations

from math import inf
from typing import Final

from jtqd.daemon.config import Config, SafetySettings
from jtqd.daemon.shared import faults
from jtqd.estimator.joint import Joint
from jtqd.estimator.plausibility import Plausibility
from jtqd.estimator.settings import EstimatorSettings, bandwidth_of

TORQUE_RANGE_NM: Final = 327.67
"""Of the field of the estimate PDO."""


class JointSafety:
    """Limits and checks of one joint, for the loop or a replay of its log; made once.

    Without a joint there is no check that needs its parameters.

    Attributes:
        settings: as configured.
        plausibility: checks of its inputs, None for none.
        torque_limit_nm: a torque beyond it is never published.
        network_limit_nm: a network further from physics than this has been dropped by the estimator.
        deviation_cycles: length of the fault `deviation`, 0 where it is not latched.
        sensor_zero_nm: of the torque sensor, beside sigma: standard deviation.
        bandwidth_rad_s: that makes the estimate's age (`age`); 0 without a joint: its sensor is taken as it is.
        max_gap_s: that a sensor of the same age bridges.
    """

    __slots__ = (
        "bandwidth_rad_s",
        "deviation_cycles",
        "max_gap_s",
        "network_limit_nm",
        "plausibility",
        "sensor_zero_nm",
        "settings",
        "torque_limit_nm",
    )

    def __init__(
        self,
        settings: SafetySettings | None = None,
        estimator: EstimatorSettings | None = None,
        joint: Joint | None = None,
        period_ns: int = 1_000_000,
    ) -> None:
        self.settings: Final = settings or SafetySettings()
        self.plausibility: Plausibility | None = None
        self.torque_limit_nm, self.network_limit_nm = TORQUE_RANGE_NM, inf
        self.deviation_cycles = 0
        self.sensor_zero_nm = 0.0
        self.bandwidth_rad_s, self.max_gap_s = 0.0, 0.05
        if self.settings.latch & faults.DEVIATION:
            self.deviation_cycles = max(1, round(self.settings.deviation_s * 1e9 / period_ns))
        if joint is None or estimator is None:
            return
        self.bandwidth_rad_s, self.max_gap_s = bandwidth_of(joint, estimator), estimator.max_gap_s
        self.torque_limit_nm = min(TORQUE_RANGE_NM, estimator.torque_limit * joint.rated_torque_nm)
        self.network_limit_nm = estimator.network_limit * joint.rated_torque_nm
        self.sensor_zero_nm = estimator.sensor_zero_nm(joint.rated_torque_nm)
        if self.settings.plausibility is not None:
            self.plausibility = Plausibility(
                joint, estimator.torque_limit, self.settings.plausibility, period_ns * 1e-9
            )


def safety_of(config: Config) -> list[JointSafety]:
    """Return the configured limits and checks of each joint."""
    return [
        JointSafety(config.safety, config.estimator, joint.joint, config.period_ns) for joint in config.joints
    ]
