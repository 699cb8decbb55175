"""What a jtqd of each joint would publish: joint files fitted on a towing bench, the product's estimator on the readings.

In place of `trial.error_process`. Of the arm's folder this file alone, with the study, imports the product.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from jtqd.estimator.estimator import estimate_columns
from jtqd.estimator.joint import Joint
from jtqd.estimator.run import JointColumns
from jtqd.estimator.settings import EstimatorSettings, recommended
from jtqd.estimator.status import DEGRADED as JTQD_DEGRADED
from jtqd.estimator.status import STANDSTILL as JTQD_STANDSTILL
from jtqd.models.files import load_joint, shipped
from jtqd.sysid.fit.fused import fit_fused
from jtqd.sysid.fit.signals import RunSignals, run_signals
from validation.arm.arm import (
    CYCLE_S,
    DEGRADED,
    JOINTS,
    NO_TORQUE,
    STANDSTILL,
    VALID,
    Arm,
    Array,
    Readings,
    Run,
    Truth,
    limits,
    no_joints,
    read,
)

TOWED_RUNS, TOWED_S = 16, 12.0
TOWED_DAY: Final = 5000
SENSOR_NM: Final = 0.02
"""Noise of the towing bench's torque sensor, for a joint of the bench file's size."""
LARGEST_LOAD: Final = 0.95
"""Of rated torque."""


def towed(arm: Arm, runs: int = TOWED_RUNS, seconds: float = TOWED_S) -> tuple[list[Run], list[Truth]]:
    """Return runs of all joints alone on towing benches: waves of position and of load, each run on a day of its own."""
    t = CYCLE_S * np.arange(round(seconds / CYCLE_S))
    begin = np.clip(t / 1.0, 0.0, 1.0)[:, None] ** 2
    made, loads = [], []
    for k in range(runs):
        rng = np.random.default_rng([arm.seed, 43, k])

        def waves(slowest_s: float, fastest_s: float, count: int, rng: np.random.Generator = rng) -> Array:
            period = np.exp(rng.uniform(np.log(fastest_s), np.log(slowest_s), (count, JOINTS)))
            turn = rng.uniform(0.0, 2.0 * np.pi, (count, JOINTS))
            return np.asarray((np.sin(2.0 * np.pi * t[:, None, None] / period + turn)).sum(axis=1))

        path = begin * waves(8.0, 2.0, 3)
        top = np.abs(np.gradient(path, CYCLE_S, axis=0)).max(axis=0)
        path *= limits()["rad_s"] * rng.uniform(0.1, 0.7, JOINTS) / top
        load = waves(6.0, 0.7, 4)
        load *= begin * rng.uniform(0.3, LARGEST_LOAD, JOINTS) / np.abs(load).max(axis=0)
        made.append(Run(TOWED_DAY + k, path))
        loads.append(load * arm.rated_nm)
    return made, arm.tow(made, np.stack(loads))


def nominal(arm: Arm) -> list[Joint]:
    """Return what a user believes before any fit: the shipped joint files in another size."""
    found = []
    for j in range(JOINTS):
        file, size = load_joint(shipped(f"joint{1 + j % 2}.yaml")), float(arm.size[j])
        friction = replace(
            file.friction,
            **{
                key: size * getattr(file.friction, key)
                for key in ("coulomb_nm", "viscous_nms_per_rad", "stribeck_nm")
            },
        )
        found.append(
            replace(
                file,
                name=f"joint{j + 1}",
                rated_torque_nm=float(arm.rated_nm[j]),
                friction=friction,
                **{
                    key: size * getattr(file, key)
                    for key in (
                        "rotor_inertia_kgm2",
                        "stiffness_nm_per_rad",
                        "damping_nms_per_rad",
                        "link_inertia_kgm2",
                    )
                },
            )
        )
    return found


def _settings() -> EstimatorSettings:
    """Return the settings of a new configuration."""
    return replace(recommended("fused"), track_zeros=True)


def _columns(readings: Readings, j: int) -> JointColumns:
    def column(x: Array) -> Array:
        return np.ascontiguousarray(x[:, j])

    return JointColumns(
        current_a=column(readings.current_a),
        motor_position_rad=column(readings.motor_rad),
        motor_velocity_rad_s=column(readings.motor_rad_s),
        link_position_rad=column(readings.link_rad),
        temperature_c=column(readings.temperature_c),
    )


class RealJoints:
    """Joints of an arm, fitted to runs of its towing benches; called in place of `trial.error_process`."""

    def __init__(self, arm: Arm, runs: Sequence[Run], truths: Sequence[Truth]) -> None:
        rng = np.random.default_rng([arm.seed, 44])
        signals: list[list[RunSignals]] = [[] for _ in range(JOINTS)]
        joints = nominal(arm)
        for run, truth in zip(runs, truths, strict=True):
            readings = read(arm, run, truth, no_joints)
            sensor = truth.drive_nm + arm.size * SENSOR_NM * rng.normal(size=truth.drive_nm.shape)
            for j, joint in enumerate(joints):
                columns = replace(_columns(readings, j), torque_nm=np.ascontiguousarray(sensor[:, j]))
                signals[j].append(
                    run_signals(
                        f"{run.day}", joint, EstimatorSettings(method="fused"), readings.time_s, columns
                    )
                )
        self.joints = [
            replace(joint, fused=fit_fused(own, joint).fused)
            for joint, own in zip(joints, signals, strict=True)
        ]

    def __call__(
        self, arm: Arm, run: Run, truth: Truth, rng: np.random.Generator
    ) -> tuple[Array, Array, Array]:
        """Return torque, sigma and status [n, 7]."""
        readings = read(arm, run, truth, no_joints)
        found = [
            estimate_columns(joint, _settings(), None, readings.time_s, _columns(readings, j))
            for j, joint in enumerate(self.joints)
        ]
        torque, sigma = (
            np.stack([getattr(each, key) for each in found], axis=1) for key in ("torque_nm", "sigma_nm")
        )
        reported = np.stack([each.status for each in found], axis=1)
        status = np.full(reported.shape, VALID, np.int8)
        for of, to in ((JTQD_DEGRADED, DEGRADED), (JTQD_STANDSTILL, STANDSTILL)):
            status[reported == of] = to
        status[~np.isfinite(torque)] = NO_TORQUE
        return torque, sigma, status
