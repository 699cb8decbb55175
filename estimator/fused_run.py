"""Vectorised twin of FusedEstimator for whole runs: same numbers to 1e-9, a fraction of the time.

Also the way in for fits: `observe_run` gives what the additive loss, the fusion and the network see.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimator.additive_loss import AdditiveLossModel
from estimator.friction import DIRECTION_VELOCITY_RAD_S, FloatArray
from estimator.fused_estimator import STANDSTILL_SIGMAS, fused_parts
from estimator.fused_network import FusedNetworkModel
from estimator.fused_observer import FusedObserver
from estimator.fused_parameters import Torsion
from estimator.fused_trust import FusedTrust
from estimator.fusion import Fusion
from estimator.parameters import Joint
from estimator.settings import EstimatorSettings
from estimator.status import DEGRADED, INVALID, STANDSTILL, VALID
from estimator.tracking import Tracker
from estimator.whole_run import EstimateRun, StatusArray


@dataclass(frozen=True, slots=True)
class ObservedRun:
    """Outputs of the fused observer over a run, arrays [n]; NaN where it was not running.

    Torques [Nm, joint side], velocity [rad/s, joint side]; waves [n, 4]: filtered cos and sin of 2 and 4 times
    the motor angle; link [n]: link position [rad]; temperature [n], NaN where unknown.
    """

    status: StatusArray
    raw_nm: FloatArray
    velocity_rad_s: FloatArray
    torsion_nm: FloatArray
    waves: FloatArray
    link_rad: FloatArray
    temperature_c: FloatArray


def observe_run(  # noqa: PLR0917 - as a sample, in arrays
    joint: Joint,
    settings: EstimatorSettings,
    torsion: Torsion | None,
    dt_s: FloatArray,
    current_a: FloatArray,
    motor_position_rad: FloatArray,
    motor_velocity_rad_s: FloatArray,
    link_position_rad: FloatArray,
    temperature_c: FloatArray | None = None,
) -> ObservedRun:
    """Run observer and guard over a run; arrays [n]. Raises ValueError for arrays of different length."""
    columns = [
        np.ascontiguousarray(column, np.float64)
        for column in (dt_s, current_a, motor_position_rad, motor_velocity_rad_s, link_position_rad)
    ]
    if len({column.shape for column in columns}) != 1 or columns[0].ndim != 1:
        raise ValueError(f"found arrays of shapes {[c.shape for c in columns]}, expected five of one length")
    count = len(columns[0])
    if temperature_c is None:
        temperature_c = np.full(count, np.nan)
    elif np.shape(temperature_c) != (count,):
        raise ValueError(f"found temperatures of shape {np.shape(temperature_c)}, expected ({count},)")
    observer = FusedObserver(joint, torsion, settings.bandwidth_rad_s, settings.link_bandwidth_rad_s)
    tracker = Tracker(observer, joint, settings)
    step = tracker.step
    status = np.empty(count, np.uint8)
    rows: list[tuple[float, ...]] = []
    nothing = (np.nan,) * 8
    for k, sample in enumerate(zip(*(column.tolist() for column in columns), strict=True)):
        rows.append(step(*sample) or nothing)
        status[k] = tracker.status
    seen = np.array(rows, np.float64).reshape(-1, 8)
    return ObservedRun(
        status,
        seen[:, 0].copy(),
        seen[:, 1].copy(),
        seen[:, 3].copy(),
        seen[:, 4:8].copy(),
        columns[4],
        np.asarray(temperature_c, np.float64),
    )


def network_features(seen: ObservedRun, current_path_nm: FloatArray) -> FloatArray:
    """Return FUSED_FEATURES [n, 9]; current_path_nm [n]: motor torque less loss."""
    return np.column_stack(
        (
            seen.velocity_rad_s,
            seen.raw_nm,
            seen.torsion_nm - current_path_nm,
            seen.waves,
            np.cos(seen.link_rad),
            np.sin(seen.link_rad),
        )
    )


def quadrant_many(raw_nm: FloatArray, velocity_rad_s: FloatArray) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    """Return the index into QUADRANTS [n] by the signs of motor torque and velocity."""
    positive = raw_nm >= 0.0
    return np.where(velocity_rad_s >= 0.0, np.where(positive, 0, 2), np.where(positive, 3, 1)).astype(np.intp)


def estimate_observed(
    joint: Joint, settings: EstimatorSettings, network: FusedNetworkModel | None, seen: ObservedRun
) -> EstimateRun:
    """Return the estimates of an observed run (observed with the joint's own torsion)."""
    fused, used = fused_parts(joint, settings, network)
    status = seen.status.copy()
    raw, v = seen.raw_nm, seen.velocity_rad_s
    running = (status != INVALID) & ~np.isnan(raw)
    raw, v = np.where(running, raw, 0.0), np.where(running, v, 0.0)
    torsion = np.where(running, seen.torsion_nm, 0.0)
    loss, half = AdditiveLossModel(fused.loss).loss_many(raw, v, seen.temperature_c)
    fusion = Fusion(fused.sigma, fused.torsion is not None)
    physics, sigma = fusion.fuse_many(raw, loss, half, v, torsion)
    quadrant = quadrant_many(raw, v)
    scale = np.array(fused.sigma.scale)[quadrant]
    torque = physics.copy()
    answer = np.full_like(raw, np.nan)
    features = network_features(seen, raw - loss)
    features[~running] = np.nan
    if used is not None:
        correction = np.full_like(raw, np.nan)
        correction[running] = used.run_many(features[running])
        answer = physics + correction
        with np.errstate(invalid="ignore"):
            near = np.abs(correction) <= settings.network_limit * joint.rated_torque_nm
        weight = FusedTrust(used.envelope).weight_many(v, raw, torsion - (raw - loss), seen.temperature_c)
        weight = np.where(near, weight, 0.0)
        fade = np.tanh(v / DIRECTION_VELOCITY_RAD_S) ** 2
        torque += np.where(near, weight * fade * np.where(near, correction, 0.0), 0.0)
        scale = scale + weight * (np.array(used.sigma_scale)[quadrant] - scale)
        status[running & (weight < 1.0) & (status == VALID)] = DEGRADED
    standing = status == STANDSTILL
    open_nm = (1.0 + settings.friction_uncertainty) * half + settings.sigma_floor * joint.rated_torque_nm
    sigma = np.where(standing, np.minimum(open_nm, STANDSTILL_SIGMAS * scale * sigma), sigma * scale)
    with np.errstate(invalid="ignore"):
        beyond = running & ~(np.abs(torque) <= settings.torque_limit * joint.rated_torque_nm)
    status[beyond] = INVALID
    for stage in (physics, answer):
        stage[~running] = np.nan
    torque[beyond | ~running] = sigma[beyond | ~running] = np.nan
    return EstimateRun(torque, sigma, status, np.full_like(raw, np.nan), physics, answer, features)
