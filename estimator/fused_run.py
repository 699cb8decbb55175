"""Vectorised twin of FusedEstimator for whole runs: same numbers to 1e-9, a fraction of the time.

Also the way in for fits: `observe_run` gives what the additive loss, the fusion and the network see.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from estimator.additive_loss import AdditiveLossModel
from estimator.friction import FloatArray
from estimator.fused_estimator import STANDSTILL_SIGMAS, fused_parts
from estimator.fused_network import FusedNetworkModel
from estimator.fused_observer import FusedObserved, FusedObserver
from estimator.fused_parameters import Torsion
from estimator.fused_trust import FusedTrust
from estimator.fusion import Fusion, held_many, turning_many
from estimator.observer_run import observe_fused
from estimator.parameters import Joint
from estimator.settings import EstimatorSettings
from estimator.status import DEGRADED, INVALID, STANDSTILL, VALID
from estimator.tracking import Tracker
from estimator.validity import FADE_START
from estimator.whole_run import EstimateRun, StatusArray

QuadrantArray = np.ndarray[tuple[int], np.dtype[np.intp]]


@dataclass(frozen=True, slots=True)
class ObservedRun:
    """Outputs of the fused observer over a run, arrays [n]; NaN where it was not running.

    Torques [Nm, joint side], velocity [rad/s, joint side]; waves [n, 4]: filtered cos and sin of 2 and 4 times
    the motor angle; temperature [n], NaN where unknown; direction [n], -1 to 1; dt_s [n], time since the sample before;
    open_nm [n]: what the torsion's slip leaves open to either side.
    """

    status: StatusArray
    raw_nm: FloatArray
    velocity_rad_s: FloatArray
    torsion_nm: FloatArray
    waves: FloatArray
    temperature_c: FloatArray
    direction: FloatArray
    dt_s: FloatArray
    open_nm: FloatArray


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
    """Run observer and guard over a run; arrays [n], dt_s[k] is the time since sample k-1 (dt_s[0] is not used).

    Raises ValueError for arrays of different length.
    """
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
    quick = observe_fused(joint, settings, torsion, columns)
    if quick is not None:
        return _observed(quick[0], quick[1].T, temperature_c, columns[0])
    observer = FusedObserver(joint, torsion, settings.bandwidth_rad_s, settings.link_bandwidth_rad_s)
    tracker = Tracker(observer, joint, settings)
    step = tracker.step
    status = np.empty(count, np.uint8)
    rows: list[tuple[float, ...]] = []
    nothing = (np.nan,) * len(FusedObserved._fields)
    for k, sample in enumerate(zip(*(column.tolist() for column in columns), strict=True)):
        rows.append(step(*sample) or nothing)
        status[k] = tracker.status
    return _observed(status, np.array(rows, np.float64).reshape(-1, len(nothing)), temperature_c, columns[0])


def _observed(
    status: StatusArray, seen: FloatArray, temperature_c: FloatArray, dt_s: FloatArray
) -> ObservedRun:
    """Return outputs `seen` [n, fields of FusedObserved] by name."""
    return ObservedRun(
        status,
        seen[:, 0].copy(),
        seen[:, 1].copy(),
        seen[:, 3].copy(),
        seen[:, 4:8].copy(),
        np.asarray(temperature_c, np.float64),
        seen[:, 8].copy(),
        dt_s,
        seen[:, 9].copy(),
    )


def network_features(seen: ObservedRun, current_path_nm: FloatArray) -> FloatArray:
    """Return FUSED_FEATURES [n, 7]; current_path_nm [n]: motor torque less loss."""
    return np.column_stack(
        (
            seen.velocity_rad_s,
            seen.raw_nm,
            seen.torsion_nm - current_path_nm,
            seen.waves,
        )
    )


def quadrant_many(raw_nm: FloatArray, velocity_rad_s: FloatArray) -> QuadrantArray:
    """Return the index into QUADRANTS [n] by the signs of motor torque and velocity."""
    positive = raw_nm >= 0.0
    return np.where(velocity_rad_s >= 0.0, np.where(positive, 0, 2), np.where(positive, 3, 1)).astype(np.intp)


def estimate_observed(
    joint: Joint, settings: EstimatorSettings, network: FusedNetworkModel | None, seen: ObservedRun
) -> EstimateRun:
    """Return the estimates of an observed run (observed with the joint's own torsion); features are [n, 7].

    Raises ConfigError as FusedEstimator does.
    """
    fused, used = fused_parts(joint, settings, network)
    status = seen.status.copy()
    running = (status != INVALID) & ~np.isnan(seen.raw_nm)
    at = _running_only(seen, running)
    raw, v, torsion = at.raw_nm, at.velocity_rad_s, at.torsion_nm
    with np.errstate(invalid="ignore", over="ignore"):
        loss, half = AdditiveLossModel(fused.loss).loss_many(raw, v, at.temperature_c, at.direction)
        wide = held_many(half, seen.dt_s, running)
        fusion = Fusion(fused.sigma, fused.torsion is not None)
        physics, sigma = fusion.fuse_many(raw, loss, wide, v, torsion, at.open_nm)
        features = network_features(at, raw - loss)
        features[~running] = np.nan
        quadrant = quadrant_many(raw, v)
        scale = np.array(fused.sigma.scale)[quadrant]
        torque, answer = physics, np.full_like(raw, np.nan)
        if used is not None:
            correction = np.full_like(raw, np.nan)
            correction[running] = used.run_many(features[running])
            limit = settings.network_limit * joint.rated_torque_nm
            weight = _weight(used, at, raw - loss, correction, limit)
            answer = physics + correction
            torque = physics + np.where(weight > 0.0, weight * turning_many(v) * correction, 0.0)
            scale = scale + weight * (np.array(used.sigma_scale)[quadrant] - scale)
            status[(status == VALID) & (weight < 1.0)] = DEGRADED
        open_nm = (1.0 + settings.friction_uncertainty) * half + settings.sigma_floor * joint.rated_torque_nm
        standing = np.minimum(open_nm, STANDSTILL_SIGMAS * scale * sigma)
        sigma = np.where(status == STANDSTILL, standing, sigma * scale)
        good = running & (np.abs(torque) <= settings.torque_limit * joint.rated_torque_nm)
    status[running & ~good] = INVALID
    empty = np.full_like(raw, np.nan)
    return EstimateRun(
        np.where(good, torque, np.nan),
        np.where(good, sigma, np.nan),
        status,
        empty,
        np.where(running, physics, np.nan),
        answer,
        features,
    )


def _running_only(seen: ObservedRun, running: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> ObservedRun:
    """Return zeros where nothing was observed: the formulas then need no exceptions."""
    return replace(
        seen,
        raw_nm=np.where(running, seen.raw_nm, 0.0),
        velocity_rad_s=np.where(running, seen.velocity_rad_s, 0.0),
        torsion_nm=np.where(running, seen.torsion_nm, 0.0),
        direction=np.where(running, seen.direction, 0.0),
        open_nm=np.where(running, seen.open_nm, 0.0),
    )


def _weight(
    network: FusedNetworkModel,
    seen: ObservedRun,
    current_path_nm: FloatArray,
    correction_nm: FloatArray,
    limit_nm: float,
) -> FloatArray:
    """Return the network's share [n] without its fading at standstill; a correction of NaN gives 0."""
    raw, v, distance = seen.raw_nm, seen.velocity_rad_s, seen.torsion_nm - current_path_nm
    trust = FusedTrust(network.envelope).weight_many(v, raw, distance, seen.temperature_c)
    size, fade = np.abs(correction_nm), FADE_START * limit_nm
    near = np.where(size > fade, (limit_nm - size) / max(limit_nm - fade, 1e-12), 1.0)
    return np.where(size <= limit_nm, np.minimum(trust, near), 0.0)
