"""The product as the judge's method, `--method validation.arm.product:jtqd_arm`. With `joints.py` this alone imports it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from jtqd.daemon.arm.estimator import ArmEstimator
from jtqd.daemon.arm.model import ArmModel, Payload
from jtqd.sysid.arm.identification import FreeMotion, identify, noise_of, normal_of
from validation.arm.arm import CYCLE_S, JOINTS, TOOL, Readings
from validation.arm.judge import Published, nothing
from validation.arm.trial import User


def jtqd_arm(user: User) -> Callable[[Readings], Published]:
    """Identify the arm, and return what `jtqd-arm` would publish of a day."""
    model = ArmModel(
        user.urdf.read_text(encoding="utf-8"), [f"panda_joint{k}" for k in range(1, JOINTS + 1)], TOOL
    )
    runs = [
        FreeMotion(CYCLE_S, each.link_rad, each.torque_nm, each.sigma_nm, Payload(*payload))
        for each, payload in user.identification
    ]
    model.set_inertial(identify(model, [normal_of(model, run) for run in runs]).inertial)
    noise = noise_of(model, runs)

    def run(readings: Readings) -> Published:
        estimator = ArmEstimator(model, CYCLE_S, noise)
        out = nothing(len(readings.time_s))
        for k in range(len(readings.time_s)):
            found = estimator.step(readings.link_rad[k], readings.torque_nm[k], readings.sigma_nm[k])
            out.external_nm[k], out.sigma_nm[k], out.wrench[k] = (
                found.external_nm,
                found.sigma_nm,
                found.wrench,
            )
            out.payload_kg[k], out.centre_m[k] = found.payload_kg, found.centre_m
            out.contact[k], out.strength_n[k], out.point_m[k] = found.contact, found.strength_n, found.point_m
            out.since_s[k] = found.since_cycle * CYCLE_S if found.contact else np.nan
        return out

    return run
