"""`jtqd-arm` with an estimator whose answers are known: `python -m tests.daemon.arm.stub ARM.yaml ...`."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np

from jtqd.daemon.arm.estimator import ArmEstimate

BEGINS, EVERY = 30, 50
"""Of every EVERY cycles those from BEGINS on are a contact behind the first joint."""


class Stub:
    """External torques are twice the torques, from the third cycle after a position is there."""

    def __init__(self, model: Any, period_s: float, *_: Any) -> None:
        self.n, self.period_s, self.cycle, self.seen = model.n, period_s, -1, 0

    def step(self, position_rad: Any, torque_nm: Any, sigma_nm: Any) -> ArmEstimate:
        self.cycle += 1
        self.seen = self.seen + 1 if np.isfinite(position_rad).all() else 0
        known = 1.0 if self.seen > 2 else np.nan
        contact = int(self.seen > 2 and self.cycle % EVERY >= BEGINS)
        return ArmEstimate(
            external_nm=2.0 * known * torque_nm,
            sigma_nm=3.0 * known * sigma_nm,
            wrench=np.arange(1.0, 7.0) * known,
            wrench_sigma=0.1 * np.arange(1.0, 7.0),
            conditioning=7.5,
            payload_kg=1.25,
            payload_sigma_kg=0.05,
            centre_m=np.array([0.01, 0.02, 0.03]),
            contact=contact,
            strength_n=20.0 if contact else np.nan,
            since_cycle=self.cycle - self.cycle % EVERY + BEGINS,
            point_m=np.array([0.1, 0.2, 0.3]),
            point_sigma_m=0.04,
        )


if __name__ == "__main__":
    from jtqd.daemon.arm import command, process

    process.ArmEstimator = Stub  # type: ignore[assignment,misc]
    sys.exit(command.main())
