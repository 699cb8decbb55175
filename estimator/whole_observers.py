"""Observers and their guard over whole runs in arrays: twins of `observer` and `guard` to 1e-9.

First-order recursions z_k = a_k z_(k-1) + x_k, |a_k| <= 1, over long runs: many stretches of a run advance side by side.
A stretch begins WARM_UP time constants early with any state, and has forgotten it by the time it counts: e^-45 is below what
a float64 can resolve. Each step of the loop is one operation on all stretches, so that a run of n samples takes n/stretches
steps. With a_k = 0 the recursion starts again at sample k.

`observe_paper` and `observe_fused` return None where the plain loop must do it: short runs, garbage among the samples (the
guard then starts again at places that only the loop knows), a bandwidth too low for the stretches.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.guard import LINK_SPEED_LIMIT_RAD_S, RAW_LIMIT
from jtqd.estimator.joint import Joint, Torsion
from jtqd.estimator.losses import DIRECTION_VELOCITY_RAD_S, FrictionModel
from jtqd.estimator.observer import RIPPLE_ORDERS
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.status import STANDSTILL, STARTING, VALID

WARM_UP: Final = 45.0
_BLOCK: Final = 1 << 18
"""Samples that are laid out at a time: what they take in memory stays small."""
_STRETCH: Final = 512
_LEAST: Final = 2000
"""Shorter runs are over before this pays."""


def warm_up_steps(a: FloatArray) -> int | None:
    """Return the samples after which every state is forgotten, by the slowest a > 0; None when too many to be worth it."""
    slow = a[a > 0.0]
    if len(a) < _LEAST or not len(slow):
        return None
    largest = float(slow.max())
    steps = int(np.ceil(-WARM_UP / np.log(largest))) + 1 if largest < 1.0 else len(a)
    return steps if steps <= len(a) // 8 else None


def recursion(a: FloatArray, x: FloatArray) -> FloatArray | None:
    """Return z [k, n] of a [n] and x [k, n], with z_(-1) = 0; None where a plain loop is as good (see `warm_up_steps`)."""
    warm = warm_up_steps(a)
    if warm is None:
        return None
    z = np.empty_like(x)
    state = np.zeros(len(x))
    for first in range(0, len(a), _BLOCK):
        end = min(first + _BLOCK, len(a))
        z[:, first:end] = _block(a[first:end], x[:, first:end], state, min(warm, end - first))
        state = z[:, end - 1]
    return z


def _block(a: FloatArray, x: FloatArray, state: FloatArray, warm: int) -> FloatArray:
    """Return z of one block; `state` is that before it."""
    rows, count = x.shape
    length = max(warm, _STRETCH)
    length += (9 - length) % 16  # columns a power of two apart would all meet in the same lines of the cache
    lanes = -(-count // length)
    # In front: a = 1, x = 0, so that the first lane keeps its state. Behind: zeros whose results are cut off.
    padded = np.zeros((rows + 1, warm + lanes * length))
    padded[0, :warm] = 1.0
    padded[0, warm : warm + count] = a
    padded[1:, warm : warm + count] = x
    step = padded.strides[1]
    view = np.lib.stride_tricks.as_strided(
        padded, (rows + 1, lanes, warm + length), (padded.strides[0], length * step, step), writeable=False
    )
    laid = np.ascontiguousarray(view.transpose(2, 0, 1))
    z = np.zeros((rows, lanes))
    z[:, 0] = state
    out = np.empty((length, rows, lanes))
    for now in laid[:warm]:
        np.multiply(z, now[0], out=z)
        np.add(z, now[1:], out=z)
    for now, there in zip(laid[warm:], out, strict=True):
        np.multiply(z, now[0], out=z)
        np.add(z, now[1:], out=z)
        there[...] = z
    return out.transpose(1, 2, 0).reshape(rows, lanes * length)[:, :count]


def bounded_sums(steps: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return z_k = clip(z_(k-1) + steps_k, -1, 1) [n] from z = -1 and from z = 1.

    What a stretch of steps does to any z is clip(z + sum, low, high), low and high being what it does to -1 and 1. So the
    stretches go side by side, each from there, and are put one after the other at the end.
    """
    count = len(steps)
    lanes = -(-count // (_STRETCH + 9))
    padded = np.zeros(lanes * (_STRETCH + 9))
    padded[:count] = steps
    laid = np.ascontiguousarray(padded.reshape(lanes, -1).T)
    total = np.cumsum(laid, axis=0)
    ends = np.empty((len(laid), 2, lanes))
    now = np.empty((2, lanes))
    now[0], now[1] = -1.0, 1.0
    for step, there in zip(laid, ends, strict=True):
        now += step
        np.maximum(now, -1.0, out=now)
        np.minimum(now, 1.0, out=now)
        there[...] = now
    first = np.empty((2, lanes))
    low, high = -1.0, 1.0
    sums, lows, highs = total[-1].tolist(), now[0].tolist(), now[1].tolist()
    for lane in range(lanes):
        first[:, lane] = low, high
        low = min(max(low + sums[lane], lows[lane]), highs[lane])
        high = min(max(high + sums[lane], lows[lane]), highs[lane])
    out = np.minimum(np.maximum(first + total[:, np.newaxis], ends[:, :1]), ends[:, 1:])
    low_all, high_all = out.transpose(1, 2, 0).reshape(2, -1)[:, :count]
    return low_all, high_all


def fading_maximum(values: FloatArray, kept: FloatArray) -> FloatArray:
    """Return m_k = max(values_k, kept_k m_(k-1)) [n] with m_(-1) = 0; values >= 0, 0 < kept <= 1."""
    out = np.empty_like(values)
    memory = 0.0
    for first in range(0, len(values), _STRETCH):
        part = slice(first, first + _STRETCH)
        product = np.cumprod(kept[part])  # 1e-154 at least, for the longest steps there are
        ratio = np.maximum.accumulate(values[part] / product)
        out[part] = product * np.maximum(ratio, memory)
        memory = float(out[part][-1])
    return out


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
    """Return the filtered derivative of the link position [n]; it starts with the velocity v of the motor side."""
    gone = -np.expm1(-rate_rad_s * np.where(steps.starts, 0.0, dt_s))
    slope = np.diff(link_rad, prepend=link_rad[0]) / np.where(steps.starts, 1.0, dt_s)
    filtered = recursion(
        np.where(steps.starts, 0.0, 1.0 - gone), np.where(steps.starts, v, gone * slope)[np.newaxis]
    )
    return None if filtered is None else filtered[0]


def _guard(steps: _Steps, v: FloatArray, settings: EstimatorSettings) -> _Status:
    """Return the status [n] by the filtered velocity: standing until it is above twice the threshold."""
    speed, stop = np.abs(v), settings.standstill_velocity_rad_s
    decides = steps.starts | (speed < stop) | (speed > 2.0 * stop)
    last = np.maximum.accumulate(np.where(decides, np.arange(len(v)), 0))
    status = np.where((speed < stop)[last], STANDSTILL, VALID).astype(np.uint8)
    status[steps.starts] = STARTING
    return status


def _plausible(joint: Joint, raw: FloatArray, link_velocity: FloatArray) -> bool:
    """Return whether the guard would refuse nothing; NaN fails."""
    limit = RAW_LIMIT * joint.rated_torque_nm
    return bool((np.abs(raw) <= limit).all() and (np.abs(link_velocity) <= LINK_SPEED_LIMIT_RAD_S).all())


def observe_paper(
    joint: Joint, settings: EstimatorSettings, columns: _Columns
) -> tuple[_Status, FloatArray] | None:
    """Return status [n] and the fields of `observer.Observed` [4, n], NaN where it starts."""
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
    """Return status [n] and the fields of `observer.FusedObserved` [10, n], NaN where it starts."""
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
    """Return the encoder's error [rad] over the motor angle [n]; `waves`: cos and sin of 2 and 4 times it."""
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
    """Return (torque, open) [Nm, n] at the filtered deflection d [rad, n]."""
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
    """Return the bounds of the slip [n]; at a start they are -1 and 1."""
    low, high = np.empty_like(steps), np.empty_like(steps)
    fresh = np.flatnonzero(starts).tolist()
    for first, end in zip(fresh, [*fresh[1:], len(steps)], strict=True):
        low[first:end], high[first:end] = bounded_sums(steps[first:end])
    return low, high
