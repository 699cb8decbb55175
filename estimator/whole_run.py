"""Vectorised twin of JointEstimator for whole runs: same numbers to 1e-9, a fraction of the time.

The observer is a recursion: long runs go through `observer_run` in arrays, short ones and those with garbage through a loop
over the same code as in service. Losses, network, sigma and status are arrays.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from estimator.friction import FloatArray
from estimator.losses import LossModel
from estimator.network_use import NetworkModel, checked_network, trust_of
from estimator.observer import Observer
from estimator.observer_run import observe_paper
from estimator.parameters import Joint
from estimator.settings import EstimatorSettings
from estimator.status import DEGRADED, INVALID, STANDSTILL, VALID
from estimator.tracking import Tracker
from estimator.validity import Uncertainty

StatusArray = npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class EstimateRun:
    """The fields of Estimate as read-only arrays [n] and the features [n, 6], NaN where not running."""

    torque_nm: FloatArray
    sigma_nm: FloatArray
    status: StatusArray
    tob_nm: FloatArray
    physics_nm: FloatArray
    network_nm: FloatArray
    features: FloatArray

    def __post_init__(self) -> None:
        for name in self.__slots__:
            getattr(self, name).setflags(write=False)


def estimate_run(  # noqa: PLR0917 - as JointEstimator and its step together
    joint: Joint,
    settings: EstimatorSettings,
    network: NetworkModel | None,
    dt_s: FloatArray,
    current_a: FloatArray,
    motor_position_rad: FloatArray,
    motor_velocity_rad_s: FloatArray,
    link_position_rad: FloatArray,
) -> EstimateRun:
    """Return the estimates of a run; arrays [n], dt_s[k] is the time since sample k-1 (dt_s[0] is not used).

    Raises ConfigError as JointEstimator does, ValueError for arrays of different length.
    """
    used = checked_network(joint, settings, network)
    columns = [
        np.ascontiguousarray(column, np.float64)
        for column in (dt_s, current_a, motor_position_rad, motor_velocity_rad_s, link_position_rad)
    ]
    if len({column.shape for column in columns}) != 1 or columns[0].ndim != 1:
        raise ValueError(f"found arrays of shapes {[c.shape for c in columns]}, expected five of one length")
    status, raw, tob, v, link_velocity = _observe(joint, settings, columns)
    running = status != INVALID
    running &= ~np.isnan(raw)
    losses = LossModel(joint)
    uncertainty = Uncertainty(joint, settings, losses)
    i = raw / losses.torque_per_ampere
    empty = np.full_like(raw, np.nan)
    with np.errstate(invalid="ignore", over="ignore"):
        efficiency = empty if settings.method == "tob" else raw - losses.loss_many(i, v)
        physics = tob if settings.method == "tob" else efficiency
        torque, sigma = physics.copy(), uncertainty.moving_many(raw, i, v)
        features = np.column_stack((*columns[1:], link_velocity, efficiency))
        features[~running] = np.nan
        answer = empty
        if used is not None:
            answer = empty.copy()
            answer[running] = used.run_many(features[running])
            weight = trust_of(joint, settings, used).weight_many(features, answer - physics)
            on = running & (weight > 0.0)
            torque[on] += weight[on] * (answer[on] - physics[on])
            sigma[on] += weight[on] * (used.sigma_nm - sigma[on])
            status[(status == VALID) & ~on] = DEGRADED
        standing = status == STANDSTILL
        torque[standing], sigma[standing] = uncertainty.standing_many(raw[standing], i[standing])
        beyond = running & ~(np.abs(torque) <= settings.torque_limit * joint.rated_torque_nm)
    status[beyond] = INVALID
    torque[beyond | ~running] = sigma[beyond | ~running] = np.nan
    return EstimateRun(torque, sigma, status, tob, efficiency, answer, features)


def _observe(
    joint: Joint, settings: EstimatorSettings, columns: list[FloatArray]
) -> tuple[StatusArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Run the tracker: status [n] and raw, tob, joint velocity, link velocity [n], NaN where it has none."""
    found = observe_paper(joint, settings, columns)
    if found is not None:
        raw, tob, v, link_velocity = found[1]
        return found[0], raw, tob, v, link_velocity
    tracker = Tracker(
        Observer(joint, settings.bandwidth_rad_s, settings.link_bandwidth_rad_s), joint, settings
    )
    step = tracker.step
    count = len(columns[0])
    status = np.empty(count, np.uint8)
    rows: list[tuple[float, ...]] = []
    nothing = (np.nan,) * 4
    for k, sample in enumerate(zip(*(column.tolist() for column in columns), strict=True)):
        rows.append(step(*sample) or nothing)
        status[k] = tracker.status
    raw, tob, v, link_velocity = np.array(rows, np.float64).reshape(-1, 4).T.copy()
    return status, raw, tob, v, link_velocity
