"""Lines of a residual: at orders of the motor, whatever the speed, and at fixed frequencies, whatever the motion. Pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from estimator.friction import FloatArray
from sysid.diagnosis.channel import Channel, Line
from sysid.diagnosis.columns import RunData

ORDERS: Final = np.arange(0.3, 10.0, 0.04)
"""Per motor revolution, where lines of what is left over are looked for."""


def order_lines(
    runs: Sequence[RunData],
    residuals: Mapping[Channel, list[FloatArray]],
    step_s: float,
    orders: FloatArray = ORDERS,
) -> list[Line]:
    """Return lines that stand out of the order spectrum of a channel, strongest first; orders: where to look, rising.

    Stretches of 2 s in which the motor turns far enough: the residual's Fourier sum over the motor's angle, so that a line
    at an order stays one whatever the speed. ratio: power against the median of its neighbourhood.
    """
    out = []
    for channel, parts in residuals.items():
        power, weight = _order_power(runs, channel, parts, orders, round(_STRETCH_S / step_s))
        if weight >= _FEWEST_STRETCHES:
            out += _peaks(channel, orders, power)
    out.sort(key=lambda line: -line.ratio)
    return out


def _order_power(
    runs: Sequence[RunData],
    channel: Channel,
    parts: Sequence[FloatArray],
    orders: FloatArray,
    length: int,
) -> tuple[FloatArray, int]:
    """Return the mean power at these orders over stretches of `length` bins, and how many there are."""
    power, weight = np.zeros(len(orders)), 0
    for run, x in zip(runs, parts, strict=True):
        angle = run.axes[channel.joint]["motor_angle"]
        for first in range(0, len(x) - length + 1, length):
            good = np.isfinite(x[first : first + length])
            theta = angle[first : first + length][good]
            if good.sum() < length // 2 or np.ptp(theta) < 2.0 * np.pi * _FEWEST_TURNS:
                continue
            y = x[first : first + length][good]
            y = ((y - y.mean()) / len(y)).astype(np.float32)
            # the angle within the stretch: single precision is enough for a thousand turns
            turn = np.outer(orders, theta - theta[0]).astype(np.float32)
            power += (np.cos(turn) @ y) ** 2 + (np.sin(turn) @ y) ** 2
            weight += 1
    return power / max(weight, 1), weight


def sharpened(line: Line, runs: Sequence[RunData], parts: Sequence[FloatArray], step_s: float) -> Line:
    """Return a line at an order with its exact order and size: the orders looked at first lie so far apart that a line
    between two of them turns out of phase within a stretch of many turns. parts: its channel's residual [run][n].

    First between its neighbours over the same stretches, then over whole runs, where a turn more or less in a thousand
    shows; the latter counts when the line keeps its phase over a run.
    """
    if line.unit == "Hz":
        return line
    near: FloatArray = line.order + _FINE * np.arange(-10.0, 11.0)
    power, weight = _order_power(runs, line.channel, parts, near, round(_STRETCH_S / step_s))
    if not weight:
        return line
    best = int(np.argmax(power))
    order, size = float(near[best]), 2.0 * float(np.sqrt(power[best]))
    ratio = line.ratio * max((size / line.amplitude_nm) ** 2, 1.0)
    exact: FloatArray = order + _EXACT * np.arange(-20.0, 21.0)
    whole = min(len(run.time_s) for run in runs)
    power, weight = _order_power(runs, line.channel, parts, exact, whole)
    best = int(np.argmax(power))
    if weight and 2.0 * float(np.sqrt(power[best])) > _COHERENT * size:
        order = float(exact[best])
    return replace(line, order=order, amplitude_nm=max(size, line.amplitude_nm), ratio=ratio)


_FINE: Final = 0.004
_EXACT: Final = 0.0004
_COHERENT: Final = 0.5
"""Part of its size over stretches that a line has over whole runs when it keeps its phase."""
_STRETCH_S: Final = 2.0
_FEWEST_TURNS: Final = 8.0
_FEWEST_STRETCHES: Final = 4.0


def _peaks(channel: Channel, orders: FloatArray, power: FloatArray) -> list[Line]:
    """Return local maxima far above the median of 60 neighbours; the amplitude is that of a wave of constant size."""
    out = []
    for k in range(1, len(orders) - 1):
        if power[k] >= power[k - 1] and power[k] > power[k + 1]:
            usual = float(np.median(power[max(0, k - 30) : k + 31])) + 1e-12
            if power[k] > 8.0 * usual:
                size = 2.0 * float(np.sqrt(power[k] - usual))
                out.append(Line(channel, float(orders[k]), size, float(power[k]) / usual))
    return out


_SEGMENT_S: Final = 4.0
_HZ: Final = (2.0, 40.0)


def frequency_lines(
    runs: Sequence[RunData], residuals: Mapping[Channel, list[FloatArray]], step_s: float
) -> list[Line]:
    """Return lines at a fixed frequency, strongest first: mean spectrum of stretches of 4 s of all runs, Hann window; the
    ratio is against the median of the neighbourhood.
    """
    length = round(_SEGMENT_S / step_s)
    window = np.hanning(length)
    out = []
    for channel, parts in residuals.items():
        power, weight = np.zeros(length // 2 + 1), 0.0
        for x in parts:
            for first in range(0, len(x) - length + 1, length // 2):
                piece = x[first : first + length]
                good = np.isfinite(piece)
                if good.mean() < 0.6:
                    continue
                shape = window * good
                piece = np.where(good, piece, 0.0)
                piece = piece - good * (piece.sum() / good.sum())
                power += np.abs(np.fft.rfft(piece * shape) / shape.sum()) ** 2
                weight += 1.0
        if weight < 4.0:
            continue
        power /= weight
        hz = np.fft.rfftfreq(length, step_s)
        for k in np.flatnonzero((hz > _HZ[0]) & (hz < min(_HZ[1], 0.4 / step_s))):
            if power[k] >= power[k - 1] and power[k] > power[k + 1]:
                near = np.median(power[max(1, k - 12) : k + 13])
                if power[k] > 12.0 * near:
                    size = 2.0 * float(np.sqrt(power[k] - near))
                    out.append(Line(channel, float(hz[k]), size, float(power[k] / near), "Hz"))
    out.sort(key=lambda line: -line.ratio)
    return out
