"""Time base of a run for a diagnosis: sample rate, resampling of uneven steps, unwrapping of positions, skew of channels."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import Joint
from jtqd.estimator.run import JointColumns, RunTable
from jtqd.estimator.text import counted
from jtqd.sysid.runs.channels import MOVING_RAD_S, RunIssue

SLOWEST_HZ: Final = 50.0
"""Below it accelerations and reversals are not in the data, and ripple of slow motion is aliased."""
UNEVEN: Final = 0.3
"""A step this part off the median is uneven: jitter of a stamp is less, a lost row more."""
JITTER: Final = 0.05
"""Less is no jitter (`diagnosis.signals.second_difference` takes such steps for even)."""
_SMOOTHER: Final = 0.7
"""Equal steps are taken where they leave this part of the roughness that positions have over the stamps, or less."""
_ROWS_AHEAD: Final = 4
_FOLLOWED: Final = 0.05
"""Part of a stamp's distance by which the phase of the cycles follows it: a clock drifts, jitter does not last."""
SKEW_NOTED_S: Final = 0.02
"""Less is left to the effect channel_delay."""
SKEW_REFUSED_S: Final = 0.1
_SKEW_LONGEST_S: Final = 0.6
_SKEW_STEP_S: Final = 0.005
_SKEW_GAIN: Final = 0.5
"""Part of the residual energy that a shift must take away to be accepted."""
_SKEW_MATTERS: Final = 0.005
"""Part of the torque's variance that it must take away: a regression that leaves almost nothing is bent by stiction."""
_TURN_PER_ROW: Final = 0.25
"""Part of a turn from one row to the next up to which a roll-over can be distinguished from motion."""
_POSITIONS: Final = ("motor_position_rad", "link_position_rad")


def check_rate(time_s: FloatArray, where: str) -> list[RunIssue]:
    """Return an issue when the run is sampled too slowly for a diagnosis."""
    step = float(np.median(np.diff(time_s)))
    if 1.0 / step >= SLOWEST_HZ:
        return []
    text = (
        f"{where}: time_s: found {1.0 / step:.4g} Hz (steps of {step:.4g} s), expected at least {SLOWEST_HZ:g} Hz: "
        f"recorded too slowly for friction and ripple{', or time in milliseconds' if step >= 0.5 else ''}"
    )
    return [RunIssue("sample_rate", text)]


def on_even_steps(table: RunTable, where: str) -> tuple[RunTable, list[RunIssue]]:
    """Return the run resampled to equal steps where its own are uneven, and a note of it.

    Values between two rows lie on a cubic through both with the slopes of a parabola through three rows: linear
    interpolation would put two steps into the acceleration at every lost cycle. A run whose steps are equal but for jitter
    is returned unchanged if its stamps are right.

    Stamps of a computer's clock, or rounded ones, jitter where the samples do not: a position over such stamps jumps by
    speed times jitter. Stamps or equal steps with rows missing are taken, whichever leaves positions smoother.
    """
    steps = np.diff(table.time_s)
    median = float(np.median(steps))
    off = np.abs(steps - median)
    if np.max(off) <= JITTER * median:
        return table, []

    def found(part: float) -> str:
        count = int(np.count_nonzero(off > part * median))
        return (
            f"{where}: time_s: found {count} of {len(steps)} steps off the median of {median:.4g} s by more than "
            f"{part:.0%} (up to {float(np.max(steps)):.4g} s)"
        )

    by_stamps = _resampled(table, table.time_s, median)
    equal = _resampled(table, *_equal_steps(table.time_s, median))
    if _roughness(equal) < _SMOOTHER * _roughness(by_stamps):
        text = f"{found(JITTER)}, but positions that are smooth over equal steps: the stamps jitter, not the samples"
        return equal, [RunIssue("time_jitter", f"{text}; equal steps used")]
    if np.max(off) <= UNEVEN * median:
        return table, []
    return by_stamps, [RunIssue("time_uneven", f"{found(UNEVEN)}: resampled to equal steps")]


def _resampled(table: RunTable, time_s: FloatArray, step_s: float) -> RunTable:
    """Return the run on steps of step_s, its rows at these times [n]."""
    grid = np.arange(time_s[0], time_s[-1] + 1e-9, step_s)
    joints = {
        number: columns.map(lambda _, column: _cubic(grid, time_s, column))
        for number, columns in table.joints.items()
    }
    return RunTable(grid, joints)


def _equal_steps(time_s: FloatArray, step_s: float) -> tuple[FloatArray, float]:
    """Return times of the rows [n] that are whole steps apart, and the step that ends where the stamps do.

    A row belongs to the next cycle, or to a later one where it and the following rows are late against the mean phase of the
    rows before: jitter makes one row late, a lost row all that follow.
    """
    ahead = np.min(
        [np.append(time_s[k:], np.full(k, np.inf)) - k * step_s for k in range(_ROWS_AHEAD)], axis=0
    )
    cycles = np.zeros(len(time_s))
    phase = float(time_s[0])
    for row, (stamp, late) in enumerate(zip(time_s.tolist(), ahead.tolist(), strict=True)):
        if row:
            steps = max(1, round((late - phase) / step_s))
            cycles[row] = cycles[row - 1] + steps
            phase += steps * step_s
            phase += _FOLLOWED * (stamp - phase)
    step = float(time_s[-1] - time_s[0]) / float(cycles[-1])
    return time_s[0] + step * cycles, step


def _roughness(table: RunTable) -> float:
    """Return the geometric mean of the fourth differences of the positions that move; NaN without one."""
    positions = [getattr(columns, name) for columns in table.joints.values() for name in _POSITIONS]
    rough = [float(np.std(np.diff(x, 4))) for x in positions if x is not None and np.ptp(x) > 0.0]
    return math.exp(float(np.mean(np.log(rough)))) if rough and min(rough) > 0.0 else math.nan


def _cubic(at: FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
    """Return y(at) [m] on a cubic Hermite spline through (x, y) [n], x rising; at within x."""
    slope = np.gradient(y, x)
    k = np.clip(np.searchsorted(x, at, side="right") - 1, 0, len(x) - 2)
    h = x[k + 1] - x[k]
    u = np.clip((at - x[k]) / h, 0.0, 1.0)
    w = 1.0 - u
    ends = w * w * (1.0 + 2.0 * u) * y[k] + u * u * (1.0 + 2.0 * w) * y[k + 1]
    result: FloatArray = ends + h * u * w * (w * slope[k] - u * slope[k + 1])
    return result


def unwrapped(table: RunTable, where: str) -> tuple[RunTable, list[RunIssue]]:
    """Return the run with positions that roll over made continuous, and a note for each."""
    joints: dict[int, JointColumns] = {}
    notes: list[RunIssue] = []
    for number, columns in table.joints.items():
        changed: dict[str, Any] = {}
        for name in _POSITIONS:
            position = getattr(columns, name)
            turn = None if position is None else _turn(position)
            if turn is None:
                continue
            changed[name] = np.unwrap(position, period=turn)
            rolls = int(np.count_nonzero(np.abs(np.diff(position)) > 0.5 * turn))
            found = f"found it rolling over by {turn:.4g} rad {counted(rolls, 'time')}: made continuous"
            notes.append(RunIssue("position_rollover", f"{where}: j{number}.{name}: {found}"))
        joints[number] = replace(columns, **changed) if changed else columns
    return (RunTable(table.time_s, joints) if notes else table), notes


def _turn(position: FloatArray) -> float | None:
    """Return the period of a position that rolls over by 2 pi (or by 360, before degrees are found), else None."""
    steps = np.abs(np.diff(position))
    for period in (2.0 * math.pi, 360.0):
        jumps = steps > 0.5 * period
        if not jumps.any() or jumps.all():
            continue
        usual = float(np.quantile(steps[~jumps], 0.99))
        if usual < _TURN_PER_ROW * period and np.all(np.abs(steps[jumps] - period) < 0.1 * period + usual):
            return period
    return None


def skew_s(table: RunTable, number: int, joint: Joint) -> float | None:
    """Return the seconds by which the sensor's torque is late (early: negative) against current and motion; None: unknown.

    The torque is shifted over the regression on motor torque, acceleration, friction's sign, velocity and a constant; the
    channels are in step where the residual is smallest. Friction would bias a plain cross-correlation.
    """
    columns = table.joint(number, joint.gear_ratio)
    torque, current, velocity = columns.torque_nm, columns.current_a, columns.motor_velocity_rad_s
    if torque is None or current is None or velocity is None:
        return None
    dt = float(np.median(np.diff(table.time_s)))
    width = max(1, round(_SKEW_STEP_S / dt))
    whole = len(torque) // width * width
    tau, i, w = (x[:whole].reshape(-1, width).mean(axis=1) for x in (torque, current, velocity))
    step = dt * width
    reach = round(_SKEW_LONGEST_S / step)
    v = w / joint.gear_ratio
    inside = slice(reach, len(v) - reach)
    if len(v) < 6 * reach or np.count_nonzero(np.abs(v[inside]) > MOVING_RAD_S) < 100:
        return None
    x = np.column_stack((i, np.gradient(w, step), np.tanh(v / MOVING_RAD_S), v, np.ones(len(v))))[inside]
    size = np.linalg.norm(x, axis=0)
    q, _ = np.linalg.qr(x / np.where(size > 0.0, size, 1.0))
    residual = _residual_shares(q, tau - np.mean(tau), 2 * reach + 1)
    best = int(np.argmin(residual))
    if residual[reach] - residual[best] < _SKEW_MATTERS:
        return 0.0
    at_end = best in (0, 2 * reach)
    if residual[best] > (1.0 - _SKEW_GAIN) * residual[reach] or residual[best] > 0.5 or at_end:
        return 0.0 if best == reach else None
    return (best - reach) * step


def _residual_shares(q: FloatArray, y: FloatArray, shifts: int) -> FloatArray:
    """Return the part of the variance of y[k : k + n] that the orthonormal q [n, p] does not explain, k = 0 .. shifts - 1.

    q spans the constant. All shifts at once: the products with q are correlations by FFT, the sums are running ones.
    """
    n = len(q)
    size = 1 << (len(y) + n).bit_length()
    spectrum = np.fft.rfft(y, size)[:, None] * np.conj(np.fft.rfft(q, size, axis=0))
    products = np.fft.irfft(spectrum, size, axis=0)[:shifts]
    total, energy = (np.concatenate(([0.0], np.cumsum(x))) for x in (y, y * y))
    constant = (total[n : n + shifts] - total[:shifts]) ** 2 / n
    variance = np.maximum(energy[n : n + shifts] - energy[:shifts] - constant, 1e-30)
    result: FloatArray = 1.0 - (np.sum(products**2, axis=1) - constant) / variance
    return result
