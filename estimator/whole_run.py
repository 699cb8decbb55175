"""Vectorised twins of the estimators for whole runs: same numbers to 1e-9, a fraction of the time.

| for | instead of |
|---|---|
| `estimate_run` | `JointEstimator` |
| `observe_run`, then `estimate_observed` | `FusedEstimator`; fits need the observed run alone |
| `extended_run` | `ExtendedInputs` |

The observer is a recursion: long runs go through `whole_observers` in arrays, short ones and those with garbage through a
loop over the same code as in service. Losses, network, sigma and status are arrays.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import nan
from typing import Any, Final

import numpy as np

from jtqd.estimator.arrays import BoolArray, FloatArray, StatusArray
from jtqd.estimator.corrections import (
    INVERSE_W0,
    Pairs,
    Smoothed,
    acting_effects,
    at_motor,
    hooks_of,
    needs_torque,
    seeming_inertia_a,
    torsion_zero,
)
from jtqd.estimator.effects.effect import State
from jtqd.estimator.effects.functions import Whole
from jtqd.estimator.estimator import STANDSTILL_SIGMAS, checked_fused
from jtqd.estimator.fusion import Fusion, held_many, turning_many
from jtqd.estimator.guard import Guard
from jtqd.estimator.joint import Joint, Torsion
from jtqd.estimator.losses import AdditiveLossModel, LossModel
from jtqd.estimator.network import FusedNetworkModel, NetworkModel, checked_network, trust_of
from jtqd.estimator.observer import FusedObserved, FusedObserver, Observed, Observer
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.status import DEGRADED, INVALID, STANDSTILL, VALID
from jtqd.estimator.validity import FADE_START, FusedTrust, Uncertainty
from jtqd.estimator.whole_observers import observe_fused, observe_paper

QuadrantArray = np.ndarray[tuple[int], np.dtype[np.intp]]


@dataclass(frozen=True, slots=True)
class EstimateRun:
    """Fields of `Estimate` as read-only arrays [n], and the network's features [n, 6 or 7], NaN where not running."""

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
    columns = _checked_columns(dt_s, current_a, motor_position_rad, motor_velocity_rad_s, link_position_rad)
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


def _checked_columns(*arrays: FloatArray) -> list[FloatArray]:
    """Return the five columns of a run [n] as contiguous arrays; ValueError for different lengths."""
    columns = [np.ascontiguousarray(column, np.float64) for column in arrays]
    if len({column.shape for column in columns}) != 1 or columns[0].ndim != 1:
        raise ValueError(f"found arrays of shapes {[c.shape for c in columns]}, expected five of one length")
    return columns


def _by_steps(guard: Guard[Any], columns: list[FloatArray], width: int) -> tuple[StatusArray, FloatArray]:
    """Return status [n] and the observer's outputs [width, n] sample by sample, NaN where the guard gives none."""
    step = guard.step
    status = np.empty(len(columns[0]), np.uint8)
    rows: list[tuple[float, ...]] = []
    nothing = (nan,) * width
    for k, sample in enumerate(zip(*(column.tolist() for column in columns), strict=True)):
        rows.append(step(*sample) or nothing)
        status[k] = guard.status
    return status, np.array(rows, np.float64).reshape(-1, width).T.copy()


def _observe(
    joint: Joint, settings: EstimatorSettings, columns: list[FloatArray]
) -> tuple[StatusArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return status [n] and raw, tob, joint velocity, link velocity [n] of the guarded observer, NaN where it has none."""
    observed = observe_paper(joint, settings, columns)
    if observed is None:
        observer = Observer(joint, settings.bandwidth_rad_s, settings.link_bandwidth_rad_s)
        observed = _by_steps(Guard(observer, joint, settings), columns, len(Observed._fields))
    status, (raw, tob, v, link_velocity) = observed
    return status, raw, tob, v, link_velocity


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
    columns = _checked_columns(dt_s, current_a, motor_position_rad, motor_velocity_rad_s, link_position_rad)
    count = len(columns[0])
    if temperature_c is None:
        temperature_c = np.full(count, np.nan)
    elif np.shape(temperature_c) != (count,):
        raise ValueError(f"found temperatures of shape {np.shape(temperature_c)}, expected ({count},)")
    observed = observe_fused(joint, settings, torsion, columns)
    if observed is None:
        observer = FusedObserver(joint, torsion, settings.bandwidth_rad_s, settings.link_bandwidth_rad_s)
        observed = _by_steps(Guard(observer, joint, settings), columns, len(FusedObserved._fields))
    status, rows = observed
    return ObservedRun(
        status=status,
        raw_nm=rows[0].copy(),
        velocity_rad_s=rows[1].copy(),
        torsion_nm=rows[3].copy(),
        waves=rows[4:8].T.copy(),
        temperature_c=np.asarray(temperature_c, np.float64),
        direction=rows[8].copy(),
        dt_s=columns[0],
        open_nm=rows[9].copy(),
    )


def network_features(observed: ObservedRun, current_path_nm: FloatArray) -> FloatArray:
    """Return FUSED_FEATURES [n, 7]; current_path_nm [n]: motor torque less loss."""
    return np.column_stack(
        (
            observed.velocity_rad_s,
            observed.raw_nm,
            observed.torsion_nm - current_path_nm,
            observed.waves,
        )
    )


def quadrant_many(raw_nm: FloatArray, velocity_rad_s: FloatArray) -> QuadrantArray:
    """Return the index into QUADRANTS [n] by the signs of motor torque and velocity."""
    positive = raw_nm >= 0.0
    return np.where(velocity_rad_s >= 0.0, np.where(positive, 0, 2), np.where(positive, 3, 1)).astype(np.intp)


def estimate_observed(
    joint: Joint, settings: EstimatorSettings, network: FusedNetworkModel | None, observed: ObservedRun
) -> EstimateRun:
    """Return the estimates of an observed run (observed with the joint's own torsion); features are [n, 7].

    Raises ConfigError as FusedEstimator does.
    """
    fused = checked_fused(joint, settings, network)
    status = observed.status.copy()
    running = (status != INVALID) & ~np.isnan(observed.raw_nm)
    at = _running_only(observed, running)
    raw, v, torsion = at.raw_nm, at.velocity_rad_s, at.torsion_nm
    with np.errstate(invalid="ignore", over="ignore"):
        loss, half = AdditiveLossModel(fused.loss).loss_many(raw, v, at.temperature_c, at.direction)
        wide = held_many(half, observed.dt_s, running)
        fusion = Fusion(fused.sigma, fused.torsion is not None)
        physics, sigma = fusion.fuse_many(raw, loss, wide, v, torsion, at.open_nm)
        features = network_features(at, raw - loss)
        features[~running] = np.nan
        quadrant = quadrant_many(raw, v)
        scale = np.array(fused.sigma.scale)[quadrant]
        torque, answer = physics, np.full_like(raw, np.nan)
        if network is not None:
            correction = np.full_like(raw, np.nan)
            correction[running] = network.run_many(features[running])
            limit = settings.network_limit * joint.rated_torque_nm
            weight = _weight(network, at, raw - loss, correction, limit)
            answer = physics + correction
            torque = physics + np.where(weight > 0.0, weight * turning_many(v) * correction, 0.0)
            scale = scale + weight * (np.array(network.sigma_scale)[quadrant] - scale)
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


def _running_only(observed: ObservedRun, running: BoolArray) -> ObservedRun:
    """Return zeros where nothing was observed: the formulas then need no exceptions."""
    return replace(
        observed,
        raw_nm=np.where(running, observed.raw_nm, 0.0),
        velocity_rad_s=np.where(running, observed.velocity_rad_s, 0.0),
        torsion_nm=np.where(running, observed.torsion_nm, 0.0),
        direction=np.where(running, observed.direction, 0.0),
        open_nm=np.where(running, observed.open_nm, 0.0),
    )


def _weight(
    network: FusedNetworkModel,
    observed: ObservedRun,
    current_path_nm: FloatArray,
    correction_nm: FloatArray,
    limit_nm: float,
) -> FloatArray:
    """Return the network's share [n] without its fading at standstill; a correction of NaN gives 0."""
    raw, v, distance = observed.raw_nm, observed.velocity_rad_s, observed.torsion_nm - current_path_nm
    trust = FusedTrust(network.envelope).weight_many(v, raw, distance, observed.temperature_c)
    size, fade = np.abs(correction_nm), FADE_START * limit_nm
    near = np.where(size > fade, (limit_nm - size) / max(limit_nm - fade, 1e-12), 1.0)
    return np.where(size <= limit_nm, np.minimum(trust, near), 0.0)


class SmoothedRun(Whole):
    """Twin of `corrections.Smoothed` over a run; share [n], 0 where a sample is not used."""

    __slots__ = ("_share",)

    def __init__(self, share: FloatArray) -> None:
        self._share: Final = share.tolist()

    def slip(self, d: FloatArray, travel: float) -> FloatArray:  # type: ignore[override]
        """Return the states [n]."""
        one = Smoothed()
        out: list[float] = []
        for now, share in zip(d.tolist(), self._share, strict=True):
            one.share = share
            out.append(one.slip(now, travel) if share else nan)
        return np.array(out)


def extended_run(  # noqa: PLR0917 - a sample, in arrays
    joint: Joint,
    settings: EstimatorSettings,
    dt_s: FloatArray,
    current_a: FloatArray,
    motor_position_rad: FloatArray,
    motor_velocity_rad_s: FloatArray,
    link_position_rad: FloatArray,
    temperature_c: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Return (i', theta_l') of a run, arrays [n]: twin of ExtendedInputs for joints without `needs_torque`."""
    assert not needs_torque(joint)
    pairs = acting_effects(joint)
    plain = replace(joint, effects=())
    with np.errstate(all="ignore"):  # what is not finite is put back below
        good = np.isfinite(current_a + motor_position_rad + motor_velocity_rad_s + link_position_rad)
        runs = good & np.concatenate(([False], good[:-1])) & (dt_s > 0.0) & (dt_s <= settings.max_gap_s)
        share = np.where(runs, -np.expm1(-settings.bandwidth_rad_s * dt_s), 1.0) * good
        v = motor_velocity_rad_s / joint.gear_ratio
        rate = np.zeros_like(v)
        if any(
            effect.name == "channel_delay" for effect, _ in pairs
        ):  # the one that reads the current's past
            rate = _rates(settings.link_bandwidth_rad_s, dt_s, current_a, good, runs)
        s = State(
            current_a=current_a,
            current_rate_a_s=rate,
            direction=np.tanh(v * INVERSE_W0),
            link_position_rad=link_position_rad,
            link_velocity_rad_s=v,
            motor_position_rad=motor_position_rad,
            temperature_c=np.full_like(v, nan) if temperature_c is None else temperature_c,
            velocity_rad_s=v,
        )

        def total(name: str, of: Pairs = pairs) -> Any:
            hooks = hooks_of(of, name, lambda: SmoothedRun(share))
            return sum(call(p, s, plain, x) for call, p, x in hooks)

        seeming = seeming_inertia_a(joint) * total("link_rad", at_motor(pairs)) * motor_velocity_rad_s**2
        s.current_a = current = current_a - total("current_a") + seeming
        link = link_position_rad - total("link_rad")
        s.torsion_rad = motor_position_rad / joint.gear_ratio - link - torsion_zero(joint)
        s.torque_nm = np.full_like(v, nan)  # not used: see needs_torque
        link = link - total("twist_rad")
        current = current - total("loss_nm") / (joint.gear_ratio * joint.torque_constant_nm_per_a)
    return np.where(good, current, current_a), np.where(good, link, link_position_rad)


def _rates(
    rate_rad_s: float, dt_s: FloatArray, current_a: FloatArray, good: BoolArray, runs: BoolArray
) -> FloatArray:
    """Return the filtered derivative of the current [n]; good: samples used, runs: those that do not start again."""
    out = np.zeros_like(current_a)
    gone = -np.expm1(-rate_rad_s * dt_s)
    slope = np.diff(current_a, prepend=0.0) / dt_s
    rate = 0.0
    rows = zip(gone.tolist(), slope.tolist(), good.tolist(), runs.tolist(), strict=True)
    for k, (share, now, usable, on) in enumerate(rows):
        if usable:
            rate = rate + share * (now - rate) if on else 0.0
            out[k] = rate
    return out
