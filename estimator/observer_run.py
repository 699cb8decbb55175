"""Observers and their guard over whole runs in arrays: twins of `observer`, `fused_observer` and `tracking` to 1e-9.

Each gives None where the plain loop must do it: short runs, garbage among the samples (the guard then starts again at places
that only the loop knows), a bandwidth too low for the stretches of `lanes`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from estimator.friction import DIRECTION_VELOCITY_RAD_S, FloatArray, FrictionModel
from estimator.fused_observer import RIPPLE_ORDERS
from estimator.fused_parameters import Torsion
from estimator.lanes import bounded_sums, recursion
from estimator.parameters import Joint
from estimator.settings import EstimatorSettings
from estimator.status import STANDSTILL, STARTING, VALID
from estimator.tracking import LINK_SPEED_LIMIT_RAD_S, RAW_LIMIT

_Status = npt.NDArray[np.uint8]
_Columns = list[FloatArray]
"""dt, current, motor position, motor velocity, link position, each [n]."""


class _Steps(NamedTuple):
    """First-order hold of every step [n]; where the observer starts a is 0 and the state is the input."""

    starts: npt.NDArray[np.bool_]
    a: FloatArray
    b0: FloatArray
    b1: FloatArray


def _steps(rate_rad_s: float, dt_s: FloatArray, max_gap_s: float) -> _Steps:
    starts = ~((dt_s > 0.0) & (dt_s <= max_gap_s))
    starts[0] = True
    x = rate_rad_s * np.where(starts, 1.0, dt_s)
    gone = -np.expm1(-x)
    share = gone / x
    a = 1.0 - gone
    return _Steps(
        starts, np.where(starts, 0.0, a), np.where(starts, 1.0, 1.0 - share), np.where(starts, 0.0, share - a)
    )


def _filtered(steps: _Steps, inputs: FloatArray) -> FloatArray | None:
    """Filter inputs [k, n], linear between samples."""
    x = steps.b0 * inputs
    x[:, 1:] += steps.b1[1:] * inputs[:, :-1]
    return recursion(steps.a, x)


def _link_velocity(
    rate_rad_s: float, steps: _Steps, dt_s: FloatArray, link_rad: FloatArray, v: FloatArray
) -> FloatArray | None:
    """Filtered derivative of the link position [n]; it starts with the velocity v of the motor side."""
    gone = -np.expm1(-rate_rad_s * np.where(steps.starts, 0.0, dt_s))
    slope = np.diff(link_rad, prepend=link_rad[0]) / np.where(steps.starts, 1.0, dt_s)
    found = recursion(
        np.where(steps.starts, 0.0, 1.0 - gone), np.where(steps.starts, v, gone * slope)[np.newaxis]
    )
    return None if found is None else found[0]


def _guard(steps: _Steps, v: FloatArray, settings: EstimatorSettings) -> _Status:
    """Status [n] by the filtered velocity: standing until it is above twice the threshold."""
    speed, stop = np.abs(v), settings.standstill_velocity_rad_s
    decides = steps.starts | (speed < stop) | (speed > 2.0 * stop)
    last = np.maximum.accumulate(np.where(decides, np.arange(len(v)), 0))
    status = np.where((speed < stop)[last], STANDSTILL, VALID).astype(np.uint8)
    status[steps.starts] = STARTING
    return status


def _plausible(joint: Joint, raw: FloatArray, link_velocity: FloatArray) -> bool:
    """Nothing for the guard to refuse; NaN fails."""
    limit = RAW_LIMIT * joint.rated_torque_nm
    return bool((np.abs(raw) <= limit).all() and (np.abs(link_velocity) <= LINK_SPEED_LIMIT_RAD_S).all())


def observe_paper(
    joint: Joint, settings: EstimatorSettings, columns: _Columns
) -> tuple[_Status, FloatArray] | None:
    """Status [n] and the rows of `observer.Observed` [4, n], NaN where it starts."""
    dt, current, _, velocity, link = columns
    if not len(dt) or not np.isfinite(np.array(columns[1:])).all():
        return None
    steps = _steps(settings.bandwidth_rad_s, dt, settings.max_gap_s)
    spin = joint.rotor_inertia_kgm2 * settings.bandwidth_rad_s * velocity
    v = velocity * (1.0 / joint.gear_ratio)
    friction = FrictionModel(joint.friction).torque_many(v)
    state = _filtered(steps, np.array((current * joint.torque_constant_nm_per_a + spin, v, friction)))
    slope = _link_velocity(settings.link_bandwidth_rad_s, steps, dt, link, v)
    if state is None or slope is None:
        return None
    raw = (state[0] - spin) * joint.gear_ratio
    if not _plausible(joint, raw[~steps.starts], slope[~steps.starts]):
        return None
    rows = np.array((raw, raw - state[2], state[1], slope))
    rows[:, steps.starts] = np.nan
    return _guard(steps, state[1], settings), rows


def observe_fused(
    joint: Joint, settings: EstimatorSettings, torsion: Torsion | None, columns: _Columns
) -> tuple[_Status, FloatArray] | None:
    """Status [n] and the rows of `fused_observer.FusedObserved` [10, n], NaN where it starts."""
    dt, current, angle, velocity, link = columns
    if not len(dt) or not np.isfinite(np.array(columns[1:])).all():
        return None
    steps = _steps(settings.bandwidth_rad_s, dt, settings.max_gap_s)
    spin = joint.rotor_inertia_kgm2 * settings.bandwidth_rad_s * velocity
    v = velocity * (1.0 / joint.gear_ratio)
    c, s = np.cos(angle), np.sin(angle)
    c2, s2 = c * c - s * s, 2.0 * c * s
    c4, s4 = c2 * c2 - s2 * s2, 2.0 * c2 * s2
    d = angle * (1.0 / joint.gear_ratio) - link
    if torsion is not None:
        d -= torsion.zero_rad + _kinematic_error(torsion, angle, (c2, s2, c4, s4))
    direction = np.tanh(v * (1.0 / DIRECTION_VELOCITY_RAD_S))
    state = _filtered(
        steps,
        np.array((current * joint.torque_constant_nm_per_a + spin, v, d, c2, s2, c4, s4, direction)),
    )
    slope = _link_velocity(settings.link_bandwidth_rad_s, steps, dt, link, v)
    if state is None or slope is None:
        return None
    raw = (state[0] - spin) * joint.gear_ratio
    twisted, open_nm = _torsion(torsion, state[2], steps.starts, dt)
    moving = ~steps.starts
    if not _plausible(joint, raw[moving], slope[moving]):
        return None
    if not (np.abs(twisted[moving]) <= RAW_LIMIT * joint.rated_torque_nm).all():
        return None
    rows = np.array((raw, state[1], slope, twisted, *state[3:], open_nm))
    rows[:, steps.starts] = np.nan
    return _guard(steps, state[1], settings), rows


def _kinematic_error(
    torsion: Torsion, angle: FloatArray, waves: tuple[FloatArray, FloatArray, FloatArray, FloatArray]
) -> FloatArray:
    """The encoder's error [rad] over the motor angle [n]; `waves`: cos and sin of 2 and 4 times it."""
    ready: dict[float, tuple[FloatArray, ...]] = dict(zip(RIPPLE_ORDERS, (waves[:2], waves[2:]), strict=True))
    error = np.zeros_like(angle)
    for order, c, s in zip(torsion.orders_per_motor_rev, torsion.cos_rad, torsion.sin_rad, strict=True):
        if order in ready:
            cos, sin = ready[order]
        else:
            cos, sin = np.cos(order * angle), np.sin(order * angle)
        error += c * cos + s * sin
    return error


def _torsion(
    torsion: Torsion | None, d: FloatArray, starts: npt.NDArray[np.bool_], dt_s: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """(torque, open) [Nm, n] at the filtered deflection d [rad, n]."""
    if torsion is None:
        return np.zeros_like(d), np.zeros_like(d)
    step = np.diff(d, prepend=d[0])
    step[starts] = 0.0
    torque = d * (torsion.stiffness_nm_per_rad + torsion.cubic_nm_per_rad3 * d * d)
    torque += torsion.damping_nms_per_rad * step / np.where(starts, 1.0, dt_s)
    if not torsion.hysteresis_nm:
        return torque, np.zeros_like(d)
    low, high = _slip(step * (1.0 / torsion.hysteresis_travel_rad), starts)
    half = 0.5 * torsion.hysteresis_nm
    return torque + half * (low + high), half * (high - low)


def _slip(steps: FloatArray, starts: npt.NDArray[np.bool_]) -> tuple[FloatArray, FloatArray]:
    """Bounds of the slip [n]; at a start they are -1 and 1."""
    low, high = np.empty_like(steps), np.empty_like(steps)
    fresh = np.flatnonzero(starts).tolist()
    for first, end in zip(fresh, [*fresh[1:], len(steps)], strict=True):
        low[first:end], high[first:end] = bounded_sums(steps[first:end])
    return low, high
