"""Structure of a residual: maps over operating conditions with a test that needs no noise model, and lines.

A residual that has nothing to do with the conditions changes its sign at random from second to second, run to run.
So its sums over the bins of an axis (velocity, load, angles, ...) are compared with those after flipping the sign of whole
blocks at random: what is common to many blocks is structure. Lines are at orders of the motor, whatever the speed, or at
fixed frequencies, whatever the motion. Everything in Nm^2.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.effects.effect import MOTOR
from jtqd.sysid.diagnosis.events import BLOCK_S
from jtqd.sysid.diagnosis.regressors import RunData
from jtqd.sysid.diagnosis.signals import Channel, Line

FLIPS: Final = 9999
SIGNIFICANT: Final = 2e-4
"""Some seventy maps are looked at: one in a hundred sets of runs has a map this unlikely by chance."""
_BINS: Final = 12
_FEWEST_BLOCKS: Final = 8
UNITS: Final = {
    "velocity": "rad/s",
    "load": "Nm",
    "current": "A",
    "quadrant": "",
    "temperature": "degC",
    "motor_angle": "rad",
    "link_angle": "rad",
    "time": "s",
    "frequency": "Hz",
}
AXES: Final = (
    "velocity",
    "load",
    "current",
    "quadrant",
    "temperature",
    "motor_angle",
    "link_angle",
    "time",
)
ORDERS: Final = np.arange(0.3, 10.0, 0.04)
"""Per motor revolution, where lines of the unexplained residual are looked for."""
_FINE: Final = 0.004
_EXACT: Final = 0.0004
_COHERENT: Final = 0.5
"""Part of its size over stretches that a line has over whole runs when it keeps its phase."""
_STRETCH_S: Final = 2.0
_FEWEST_TURNS: Final = 8.0
_FEWEST_STRETCHES: Final = 4.0
_SEGMENT_S: Final = 4.0
_HZ: Final = (2.0, 40.0)


@dataclass(frozen=True)
class AxisMap:
    """One axis of one channel: edges [b+1], time spent in each bin [b] (samples), mean and mean square of the residual
    per bin, energy between bins that is not chance (>= 0, Nm^2), p value.
    """

    channel: Channel
    axis: str
    unit: str
    edges: FloatArray
    count: FloatArray
    mean_nm: FloatArray
    square_nm2: FloatArray
    energy_nm2: float
    p: float


def axes_of(channel: Channel) -> tuple[str, ...]:
    """Return the axes that a channel is drawn over; the spring knows nothing of the current."""
    return AXES if channel.balance == MOTOR else tuple(a for a in AXES if a != "current")


def axis_edges(axis: str, values: FloatArray) -> FloatArray | None:
    """Return the edges of the bins of an axis, None where it does not vary."""
    good = values[np.isfinite(values)]
    if len(good) < 100:
        return None
    if axis == "motor_angle":
        return np.linspace(0.0, 2.0 * np.pi, _BINS + 1)
    if axis == "quadrant":
        return np.array([-0.5, 0.5, 1.5, 2.5, 3.5])
    low, high = float(good.min()), float(good.max())
    if high - low < 1e-6 or (axis == "temperature" and high - low < 2.0):
        return None
    count = 2 * _BINS if axis in ("link_angle", "velocity", "current") else _BINS
    edges = np.linspace(low, high, count + 1)
    edges[-1] += 1e-9 * (high - low)
    return edges


def axis_values(axes: Mapping[str, FloatArray], axis: str) -> FloatArray:
    """Return the coordinate of every bin of a run; angles of the motor within a turn, of the link as they are within
    one turn or wrapped when the link turns further.
    """
    if axis == "quadrant":
        v, load = axes["velocity"], axes["load"]
        return np.where(v >= 0.0, np.where(load >= 0.0, 0.0, 1.0), np.where(load >= 0.0, 2.0, 3.0))
    if axis == "motor_angle":
        return np.asarray(np.mod(axes[axis], 2.0 * np.pi))
    if axis == "link_angle":
        return np.asarray(np.mod(axes[axis] + np.pi, 2.0 * np.pi) - np.pi)
    return axes[axis]


def axis_maps(
    runs: Sequence[RunData], residuals: Mapping[Channel, list[FloatArray]], step_s: float, seed: int = 0
) -> list[AxisMap]:
    """Return the maps of all channels and axes; residuals per channel and run [n], NaN where not valid.

    The bins cover what was visited while the residual was valid; those of the link angle all that was visited, because at an
    event, which is left out of maps, load or speed may be far off, the angle is not.
    """
    rng = np.random.default_rng(seed)
    block = max(2, round(BLOCK_S / step_s))
    out = []
    for channel, plain in residuals.items():
        for axis in axes_of(channel):
            values = [axis_values(run.axes[channel.joint], axis) for run in runs]
            there = [
                v if axis == "link_angle" else v[np.isfinite(x)] for v, x in zip(values, plain, strict=True)
            ]
            edges = axis_edges(axis, np.concatenate(there))
            if edges is not None:
                maps = [
                    axis_map(channel, axis, edges, values, signed(plain, side), block=block, rng=rng)
                    for side in directions(runs, channel)
                ]
                out.append(max(maps, key=lambda m: (m.p < SIGNIFICANT, m.energy_nm2)))
    return out


def directions(runs: Sequence[RunData], channel: Channel) -> list[list[FloatArray] | None]:
    """Return the signs in which a channel is looked at: as it is (None); in the direction of motion, because a loss (of the
    link too, which the torsion balance sees) changes its sign with it and would cancel in a map of both; the motor balance
    also in the direction of the current, as what a drive loses does.
    """
    axes = [run.axes[channel.joint] for run in runs]
    out: list[list[FloatArray] | None] = [None, [np.sign(a["velocity"]) for a in axes]]
    return [*out, [np.sign(a["current"]) for a in axes]] if channel.balance == MOTOR else out


def signed(parts: Sequence[FloatArray], side: Sequence[FloatArray] | None) -> list[FloatArray]:
    """Return the residual in these signs [run][n]."""
    return list(parts) if side is None else [x * d for x, d in zip(parts, side, strict=True)]


def axis_map(
    channel: Channel,
    axis: str,
    edges: FloatArray,
    values: Sequence[FloatArray],
    parts: Sequence[FloatArray],
    *,
    block: int,
    rng: np.random.Generator,
) -> AxisMap:
    """Return the map of one axis; values [run][n]: its coordinate, block: samples whose sign is flipped together."""
    bins = len(edges) - 1
    sums, counts, squares = [], np.zeros(bins), np.zeros(bins)
    for v, x in zip(values, parts, strict=True):
        good = np.isfinite(x) & np.isfinite(v)
        place = np.clip(np.searchsorted(edges, v[good], side="right") - 1, 0, bins - 1)
        number = np.arange(len(x))[good] // block
        many = int(number.max()) + 1 if len(number) else 0
        flat = np.bincount(number * bins + place, weights=x[good], minlength=many * bins)
        sums.append(flat.reshape(many, bins))
        counts += np.bincount(place, minlength=bins)
        squares += np.bincount(place, weights=x[good] ** 2, minlength=bins)
    table = np.vstack(sums)
    busy = counts > 50
    weight = np.where(busy, 1.0 / np.maximum(counts, 1.0), 0.0)
    total = table.sum(axis=0)
    found = float(np.sum(total**2 * weight))
    signs = rng.choice((-1.0, 1.0), size=(FLIPS, len(table)))
    chance = ((signs @ table) ** 2) @ weight
    p = float((1 + np.sum(chance >= found)) / (FLIPS + 1))
    n = max(float(counts.sum()), 1.0)
    energy = max(found - float(chance.mean()), 0.0) / n
    if len(table) < _FEWEST_BLOCKS:
        p = 1.0
    return AxisMap(
        channel,
        axis,
        UNITS[axis],
        edges,
        counts,
        np.where(busy, total * weight, np.nan),
        np.where(busy, squares * weight, np.nan),
        energy,
        p,
    )


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
