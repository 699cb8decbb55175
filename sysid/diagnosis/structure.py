"""Views of a residual, and the search for those that explain it.

A view is a prediction of the residual of one balance from one thing. Its energy is the squared error that it takes away,
as a mean over all samples [Nm^2]. There are four kinds: *conditions* (bins of an axis), *lines* (waves), *events* and
*seconds*. Events and seconds predict nothing but themselves: they count by what the best condition leaves of them. `pursue`
takes out the view of most energy and searches again (matching pursuit: Mallat and Zhang 1993, IEEE Trans. Signal Process.
41).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Final

import numpy as np

from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.estimator.effects.effect import MOTOR
from jtqd.sysid.diagnosis.limits import LISTED, RELEVANCE
from jtqd.sysid.diagnosis.regressors import Index, RunData
from jtqd.sysid.diagnosis.signals import Channel, Line

AXES: Final = {
    "velocity": "rad/s",
    "load": "Nm",
    "current": "A",
    "quadrant": "",
    "temperature": "degC",
    "motor_angle": "rad",
    "link_angle": "rad",
    "time": "s",
}
"""Axes of conditions, with their units."""
BINS: Final = 12
"""Of an axis; twice as many of velocity, current and link angle."""
BLOCK_S: Final = 1.0
"""Seconds that are independent of each other; a bin's mean counts as if it had been zero for so long before. What is less
apart is one event, or one stay in a bin of angle.
"""
SIGNIFICANT: Final = 1e-3
"""Of some twenty conditions of a balance that are looked at, one in fifty balances has one this unlikely by chance."""
FLIPS: Final = round(10.0 / SIGNIFICANT) - 1
MOST: Final = 3
"""Views that are taken out."""
ORDERS: Final = np.arange(0.7, 10.0, 0.04)
"""Per motor revolution, where lines of a residual are looked for; what is slower is a condition of the angle."""
QUICK_ORDERS: Final = np.arange(0.75, 100.0, 0.25)
"""The same of what is quicker than a balance is judged."""
_HZ: Final = (2.0, 40.0)
"""Where vibrations of frames and sensors are looked for."""
HZ_STEP: Final = 0.25 / BLOCK_S
"""Of the spectrum: stretches are four blocks long."""
STRONG_LINE: Final = 25.0
"""Power of a line against the median of its neighbourhood."""
_PEAK: Final = 8.0
"""The same of a peak that may be one: noise has one in some thousand bins (exp(-8))."""
_FEWEST_TURNS: Final = 8.0
"""Of the motor in a stretch: an eighth of an order is resolved."""
_FAR: Final = 60.0
"""Square of a change, or of the mean of a second, against the median: Gaussian noise reaches it once in 10^7."""
_EVENT_S: Final = 0.05
"""Time of a change."""
Times = tuple[tuple[str, float], ...]
"""Moments: run, time [s]."""


@dataclass(frozen=True)
class Balance:
    """A balance of a joint in all runs; step_s: of a sample; rated_nm: of the joint."""

    runs: Sequence[RunData]
    channel: Channel
    step_s: float
    rated_nm: float

    @property
    def axes(self) -> list[dict[str, FloatArray]]:
        """The operating conditions of every run."""
        return [run.axes[self.channel.joint] for run in self.runs]

    @property
    def least_nm2(self) -> float:
        """The least energy of a view: what is smaller is not listed as an entry either."""
        return float((LISTED * RELEVANCE * self.rated_nm) ** 2)

    @property
    def steps_nm(self) -> list[FloatArray]:
        """What a step of an encoder is worth [run][n], Nm; zero of a balance without angles."""
        return [axes.get(self.channel.balance, np.zeros(len(axes["time"]))) for axes in self.axes]

    @property
    def coarse_nm2(self) -> float:
        """The least energy of a wave or of seconds: rounded angles leave waves, and means where motion is slow."""
        return max(self.least_nm2, float(np.mean(np.concatenate(self.steps_nm) ** 2)) / 12.0)


@dataclass(frozen=True)
class View:
    """A prediction of a residual [run][n] from one thing.

    axis: as in `Place`: a condition, "time" of events and seconds, "frequency". energy_nm2, by_run [runs]: of all runs, of
    each. edges [b+1], explained [b], places [run][n], side [run][n]: of a condition its bins, what each explains, the bin of
    every sample, its signs. what, times: "events" or "seconds" with their moments (run, time [s]), strongest first.
    masks [run][n]: samples that are the view's as a whole.
    """

    axis: str
    energy_nm2: float
    by_run: FloatArray
    prediction: list[FloatArray]
    edges: FloatArray | None = None
    explained: FloatArray | None = None
    places: Sequence[Index] = ()
    side: Sequence[FloatArray] = ()
    what: str = ""
    times: Times = ()
    masks: Sequence[BoolArray] = ()
    line: Line | None = None

    @property
    def bins(self) -> tuple[int, ...]:
        """Bins that explain something, the largest first."""
        explained = np.empty(0) if self.explained is None else self.explained
        return tuple(int(k) for k in np.argsort(-explained) if explained[k] > 0.0)

    def taken_from(self, parts: Sequence[FloatArray]) -> list[FloatArray]:
        """Return the residual [run][n] without what the view explains, NaN where all is the view's."""
        less = [x - p for x, p in zip(parts, self.prediction, strict=True)]
        return [np.where(m, np.nan, x) for m, x in zip(self.masks, less, strict=True)] if self.masks else less

    def same(self, other: View) -> bool:
        """Return whether both are views of one thing."""
        return (self.axis, self.what, self.line) == (other.axis, other.what, other.line)


def _view(axis: str, parts: Sequence[FloatArray], prediction: list[FloatArray], **more: Any) -> View:
    """Return the view with its energies on this residual; with masks, above what is usual outside of them."""
    taken = np.array([np.nansum((2.0 * x - p) * p) for x, p in zip(parts, prediction, strict=True)])
    if masks := more.get("masks"):
        outside = np.concatenate([x[~m] for x, m in zip(parts, masks, strict=True)])
        usual = float(np.nanmean(outside**2)) if np.isfinite(outside).any() else 0.0
        taken -= [usual * np.sum(m & np.isfinite(x)) for x, m in zip(parts, masks, strict=True)]
    counts = np.array([np.isfinite(x).sum() for x in parts], np.float64)
    energy = float(taken.sum() / max(counts.sum(), 1.0))
    return View(axis, energy, taken / np.maximum(counts, 1.0), prediction, **more)


def pursue(balance: Balance, parts: Sequence[FloatArray]) -> list[View]:
    """Return the views that explain a balance's residual [run][n], NaN where not valid: each of what those before it leave,
    until none is significant and worth a place, at most MOST.
    """
    now, found = list(parts), list[View]()
    while len(found) < MOST and (views := _views(balance, now, found)):
        found.append(max(views, key=lambda v: v.energy_nm2))
        now = found[-1].taken_from(now)
    return found


def _views(balance: Balance, parts: Sequence[FloatArray], before: Sequence[View]) -> list[View]:
    """Return the significant views of a residual: condition, what events and seconds explain beyond it, lines."""

    def new(view: View) -> bool:
        return view.energy_nm2 > balance.least_nm2 and not any(view.same(b) for b in before)

    ranked = sorted(filter(new, conditions(balance, parts)), key=lambda v: -v.energy_nm2)
    best = next((v for v in ranked if chance(v, parts, balance.step_s) < SIGNIFICANT), None)
    moments, rest = events(balance, parts), list(parts)
    turn = moments and at_angle(balance, parts, moments)
    out = [v for v in (best, turn) if v and new(v)]
    if out:
        rest = max(out, key=lambda v: v.energy_nm2).taken_from(parts)
    if moments:  # what the best condition leaves of them
        moments = _moments_view(rest, moments.masks, moments.times)
        rest = moments.taken_from(rest)
    others = (moments, seconds(balance, rest), *lines(balance, parts))
    return out + [v for v in others if v and new(v)]


# Conditions.


def axis_edges(axis: str, values: FloatArray) -> FloatArray | None:
    """Return the edges of the bins of an axis, None where it does not vary."""
    good = values[np.isfinite(values)]
    if not len(good):
        return None
    if axis == "motor_angle":
        return np.linspace(0.0, 2.0 * np.pi, BINS + 1)
    if axis == "quadrant":
        return np.array([-0.5, 0.5, 1.5, 2.5, 3.5])
    low, high = float(good.min()), float(good.max())
    if high - low < (2.0 if axis == "temperature" else 1e-6):
        return None
    count = 2 * BINS if axis in ("link_angle", "velocity", "current") else BINS
    edges = np.linspace(low, high, count + 1)
    edges[-1] += 1e-9 * (high - low)
    return edges


def axis_values(axes: Mapping[str, FloatArray], axis: str) -> FloatArray:
    """Return the coordinate of every sample of a run; angles within a turn."""
    if axis == "quadrant":
        return np.asarray(2.0 * (axes["velocity"] < 0.0) + (axes["load"] < 0.0), np.float64)
    if axis == "motor_angle":
        return np.asarray(np.mod(axes[axis], 2.0 * np.pi))
    if axis == "link_angle":
        return np.asarray(np.mod(axes[axis] + np.pi, 2.0 * np.pi) - np.pi)
    return axes[axis]


def bins_of(
    balance: Balance, axis: str, parts: Sequence[FloatArray]
) -> tuple[FloatArray, list[Index]] | None:
    """Return the edges of an axis and the bin of every sample [run][n], None where it does not vary.

    The bins cover what was visited while the residual was valid; those of the link angle all that was visited, so that they
    stay where they are when moments are taken out. The spring knows nothing of the current.
    """
    values = [axis_values(axes, axis) for axes in balance.axes]
    seen = [v if axis == "link_angle" else v[np.isfinite(x)] for v, x in zip(values, parts, strict=True)]
    edges = axis_edges(axis, np.concatenate(seen))
    if edges is None or (axis == "current" and balance.channel.balance != MOTOR):
        return None
    return edges, [np.clip(np.searchsorted(edges, v, side="right") - 1, 0, len(edges) - 2) for v in values]


def directions(balance: Balance) -> list[list[FloatArray]]:
    """Return the signs [run][n] in which a balance is looked at: as it is; in the direction of motion, because a loss (of
    the link too, which the torsion balance sees) changes its sign with it and would cancel in a mean of both; the motor
    balance also in the direction of the current, as what a drive loses does.
    """
    names = ("velocity", "current") if balance.channel.balance == MOTOR else ("velocity",)
    plain = [np.ones(len(a["time"])) for a in balance.axes]
    return [plain, *([np.sign(a[name]) for a in balance.axes] for name in names)]


def _times(parts: Sequence[FloatArray], side: Sequence[FloatArray]) -> list[FloatArray]:
    return [x * d for x, d in zip(parts, side, strict=True)]


def conditions(balance: Balance, parts: Sequence[FloatArray]) -> list[View]:
    """Return every axis in every direction as a view, whether significant or not: the mean of a bin over the other runs
    predicts this run. Noise of two runs is independent, so bins that only follow the noise explain nothing.
    """
    out, zero = [], BLOCK_S / balance.step_s
    for axis in AXES:
        edges, places = bins_of(balance, axis, parts) or (np.empty(0), [])
        for side in directions(balance) if places else ():
            explained, means = explained_by_bins(places, _times(parts, side), len(edges) - 1, zero)
            more = {"edges": edges, "explained": explained.sum(axis=0), "places": places, "side": side}
            out.append(_view(axis, parts, _times(means, side), **more))
    return out


def explained_by_bins(
    places: Sequence[Index], parts: Sequence[FloatArray], bins: int, zero: float
) -> tuple[FloatArray, list[FloatArray]]:
    """Return the energy that the bins' means over the other runs take off each run, and bin [runs, bins] (sum of squares
    over samples, Nm^2), and those means at every sample [run][n]. places: bin of every sample; zero: samples of nothing
    that count in every mean.
    """
    sums, counts = np.zeros((len(parts), bins)), np.zeros((len(parts), bins))
    for r, (place, x) in enumerate(zip(places, parts, strict=True)):
        good = np.isfinite(x)
        sums[r] = np.bincount(place[good], x[good], minlength=bins)
        counts[r] = np.bincount(place[good], minlength=bins)
    others = (sums.sum(axis=0) - sums) / (counts.sum(axis=0) - counts + zero)
    # sum of x^2 - (x - m)^2 over a bin
    explained: FloatArray = 2.0 * others * sums - others**2 * counts
    return explained, [others[r][place] for r, place in enumerate(places)]


def chance(view: View, parts: Sequence[FloatArray], step_s: float) -> float:
    """Return how likely a condition explains this much of the residual [run][n] by chance: with random signs of its seconds,
    as a residual has that has nothing to do with the conditions.
    """
    assert view.edges is not None
    bins, block = len(view.edges) - 1, _block(step_s)
    tables, counts = [], []
    for place, x in zip(view.places, _times(parts, view.side), strict=True):
        good = np.isfinite(x)
        at = np.arange(len(x))[good] // block * bins + place[good]
        tables.append(np.bincount(at, x[good], (len(x) // block + 1) * bins).reshape(-1, bins))
        counts.append(np.bincount(place[good], minlength=bins))
    ends = np.cumsum([0, *map(len, tables)])
    signs = _signs(FLIPS, int(ends[-1]))
    sums = [signs[:, a:b] @ t.astype(np.float32) for a, b, t in zip(ends, ends[1:], tables, strict=False)]
    whole, energy = np.sum(sums, axis=0), np.zeros(FLIPS + 1)
    for own, n in zip(sums, counts, strict=True):
        mean = (whole - own) / (np.sum(counts, axis=0) - n + BLOCK_S / step_s)
        energy += np.sum(mean * (2.0 * own - mean * n), axis=1)
    return float(np.mean(energy >= energy[0]))


def _block(step_s: float) -> int:
    return max(2, round(BLOCK_S / step_s))


@lru_cache(maxsize=2)
def _signs(flips: int, blocks: int) -> FloatArray:
    """Return random signs [flips + 1, blocks], the first row all positive."""
    signs = np.random.default_rng(0).choice(np.array((-1.0, 1.0), np.float32), (flips, blocks))
    return np.asarray(np.vstack((np.ones((1, blocks), np.float32), signs)))


# Lines.


def lines(balance: Balance, parts: Sequence[FloatArray], orders: FloatArray = ORDERS) -> list[View]:
    """Return the lines that stand out of a channel's spectra; orders: as of `order_lines`."""
    runs, step_s, residual = balance.runs, balance.step_s, {balance.channel: parts}
    out = []
    for found in (*order_lines(runs, residual, step_s, orders), *frequency_lines(runs, residual, step_s)):
        if found.ratio > STRONG_LINE and 0.5 * found.amplitude_nm**2 > balance.coarse_nm2:
            line = sharpened(found, runs, parts, step_s)
            energy = 0.5 * line.amplitude_nm**2
            wave = _wave(line, balance, parts)
            out.append(View("frequency", energy, np.full(len(parts), energy), wave, line=line))
    return out


def _wave(line: Line, balance: Balance, parts: Sequence[FloatArray]) -> list[FloatArray]:
    """Return the wave of a line, with size and phase of every two seconds, zero where it hardly turns [run][n]."""
    out = []
    for axes, x in zip(balance.axes, parts, strict=True):
        angle = 2.0 * np.pi * axes["time"] if line.unit == "Hz" else axes["motor_angle"]
        turn, wave = line.order * angle, np.zeros(len(x))
        basis = np.column_stack((np.cos(turn), np.sin(turn), np.ones(len(x))))
        for at in np.array_split(np.arange(len(x)), max(len(x) // (2 * _block(balance.step_s)), 1)):
            good = at[np.isfinite(x[at])]
            if len(good) > len(at) // 4 and np.ptp(turn[good]) > 2.0 * np.pi:
                size, *_ = np.linalg.lstsq(basis[good], x[good], rcond=None)
                wave[at] = basis[at, :2] @ size[:2]
        out.append(wave)
    return out


def order_lines(
    runs: Sequence[RunData],
    residuals: Mapping[Channel, Sequence[FloatArray]],
    step_s: float,
    orders: FloatArray = ORDERS,
) -> list[Line]:
    """Return lines that stand out of the order spectrum of a channel, strongest first; orders: where to look, evenly.

    The residual's Fourier sum over the motor's angle, in stretches of 2 s in which the motor turns far enough: a line at an
    order stays one whatever the speed.
    """
    out = []
    for channel, parts in residuals.items():
        power, weight = _order_power(runs, channel, parts, orders, 2 * _block(step_s))
        if weight >= 4:
            out += _peaks(Line(channel, 0.0, 0.0, 0.0), orders, power, 30)
    return sorted(out, key=lambda line: -line.ratio)


def frequency_lines(
    runs: Sequence[RunData], residuals: Mapping[Channel, Sequence[FloatArray]], step_s: float
) -> list[Line]:
    """Return lines at a fixed frequency, strongest first: mean spectrum of stretches of 4 s of all runs, Hann window."""
    length = 4 * _block(step_s)
    window, out = np.hanning(length), list[Line]()
    hz = np.asarray(np.fft.rfftfreq(length, step_s), np.float64)
    for channel, parts in residuals.items():
        powers = []
        for x in parts:
            for first in range(0, len(x) - length + 1, length // 2):
                piece = x[first : first + length]
                good = np.isfinite(piece)
                if 2.0 * good.mean() > 1.0:
                    shape = window * good
                    piece = np.where(good, piece - np.nanmean(piece), 0.0)
                    powers.append(np.abs(np.fft.rfft(piece * shape) / shape.sum()) ** 2)
        if len(powers) >= 4:
            out += _peaks(Line(channel, 0.0, 0.0, 0.0, "Hz"), hz, np.mean(powers, axis=0), 12)
    out = [line for line in out if _HZ[0] < line.order < min(_HZ[1], 0.4 / step_s)]
    return sorted(out, key=lambda line: -line.ratio)


def _order_power(
    runs: Sequence[RunData], channel: Channel, parts: Sequence[FloatArray], orders: FloatArray, length: int
) -> tuple[FloatArray, int]:
    """Return the mean power at these orders over stretches of `length` samples, and how many there are."""
    power, weight = np.zeros(len(orders)), 0
    for run, x in zip(runs, parts, strict=True):
        angle = run.axes[channel.joint]["motor_angle"]
        for first in range(0, len(x) - length + 1, length):
            good = first + np.flatnonzero(np.isfinite(x[first : first + length]))
            theta, y = angle[good], x[good]
            if len(good) < length // 2 or np.ptp(theta) < 2.0 * np.pi * _FEWEST_TURNS:
                continue
            # the angle within the stretch: single precision is enough for a thousand turns
            wave, turn = (
                np.exp(1j * order * (theta - theta[0])).astype(np.complex64)
                for order in (orders[0], orders[1] - orders[0])
            )
            wave *= (y - y.mean()) / len(y)
            for k in range(len(orders)):
                power[k] += abs(wave.sum()) ** 2
                wave *= turn
            weight += 1
    return power / max(weight, 1), weight


def _peaks(of: Line, at: FloatArray, power: FloatArray, near: int) -> list[Line]:
    """Return the local maxima that stand out of `near` neighbours on either side, as lines of the channel and unit of `of`;
    the amplitude is that of a wave of constant size.
    """
    out = []
    for k in (np.flatnonzero((power[1:-1] >= power[:-2]) & (power[1:-1] > power[2:])) + 1).tolist():
        usual = float(np.median(power[max(0, k - near) : k + near + 1])) + 1e-12
        if power[k] > _PEAK * usual:
            size, ratio = 2.0 * float(np.sqrt(power[k] - usual)), float(power[k]) / usual
            out.append(replace(of, order=float(at[k]), amplitude_nm=size, ratio=ratio))
    return out


def sharpened(line: Line, runs: Sequence[RunData], parts: Sequence[FloatArray], step_s: float) -> Line:
    """Return a line at an order with its exact order and size; parts: its channel's residual [run][n].

    The orders looked at first lie so far apart that a line between two of them turns out of phase within a stretch of many
    turns. So: between its neighbours over the same stretches, then over whole runs, where a turn more or less in a thousand
    shows; the latter counts when the line keeps half of its size over a run, and so its phase.
    """
    near: FloatArray = line.order + 0.004 * np.arange(-10.0, 11.0)
    power, weight = np.zeros(1), 0
    if line.unit != "Hz":
        power, weight = _order_power(runs, line.channel, parts, near, 2 * _block(step_s))
    if not weight:
        return line
    order, size = float(near[np.argmax(power)]), 2.0 * float(np.sqrt(np.max(power)))
    ratio = line.ratio * max((size / line.amplitude_nm) ** 2, 1.0)
    exact: FloatArray = order + 0.0004 * np.arange(-20.0, 21.0)
    power, weight = _order_power(runs, line.channel, parts, exact, min(len(run.time_s) for run in runs))
    if weight and 2.0 * float(np.sqrt(np.max(power))) > 0.5 * size:
        order = float(exact[np.argmax(power)])
    return replace(line, order=order, amplitude_nm=max(size, line.amplitude_nm), ratio=ratio)


# Events and seconds.


def events(balance: Balance, parts: Sequence[FloatArray]) -> View | None:
    """Return the events of a residual [run][n], NaN where not valid; None without any.

    Between two changes of its mean over _EVENT_S that are far above the usual, more than a step of an encoder, and large
    enough to matter. A jump, a dip, a dropped reading has one at either end; what lies between two close together is one.
    """
    wide = max(4, round(_EVENT_S / balance.step_s))
    means = [_means(x, wide) for x in parts]
    changes = [np.abs(np.diff(m)) for m in means]
    every = np.concatenate(changes)
    usual = float(np.median(every[np.isfinite(every)] ** 2)) if np.isfinite(every).any() else 0.0
    least = max(math.sqrt(_FAR * usual), RELEVANCE * balance.rated_nm)
    found, masks = list[tuple[float, str, float]](), []
    for run, step, x, change in zip(balance.runs, balance.steps_nm, parts, changes, strict=True):
        mask, end = np.zeros(len(x), bool), -(10**9)  # of the event before
        for k in np.flatnonzero(np.nan_to_num(change) > np.maximum(least, _means(step, wide)[1:])).tolist():
            first, last = k * wide, (k + 2) * wide
            if first - end <= BLOCK_S / balance.step_s:
                first = min(first, end)
            else:
                found.append((float(change[k]), run.name, float(run.time_s[first + wide])))
            mask[first:last], end = True, last
        masks.append(mask)
    if not found:
        return None
    return _moments_view(parts, masks, _moments(found))


def _moments_view(parts: Sequence[FloatArray], masks: Sequence[BoolArray], times: Times) -> View:
    """Return the events of these samples [run][n] as a view of a residual."""
    own = [np.where(m & np.isfinite(x), x, 0.0) for m, x in zip(masks, parts, strict=True)]
    return _view("time", parts, own, masks=masks, what="events", times=times)


def _means(x: FloatArray, block: int) -> FloatArray:
    """Return means over whole blocks of a residual; NaN where less than half of a block is valid."""
    cut = x[: len(x) // block * block].reshape(-1, block)
    count = np.isfinite(cut).sum(axis=1)
    return np.where(2 * count > block, np.nansum(cut, axis=1) / np.maximum(count, 1), np.nan)


def _moments(found: list[tuple[float, str, float]]) -> Times:
    """Return (run, time) strongest first."""
    return tuple((run, t) for _, run, t in sorted(found, reverse=True))


def at_angle(balance: Balance, parts: Sequence[FloatArray], moments: View) -> View | None:
    """Return the range of the link's angle that events belong to, None where they belong to none.

    A range of angle that costs torque (a rubbing cover, a pulling cable) makes an event on every pass, and often only one
    run reaches it, a few times. So passes stand for runs: the mean of a bin over its other passes predicts the events of a
    pass. The range are the bins of which this is most, with the next on either side, through which its ends may cut.
    """
    found = bins_of(balance, "link_angle", parts)
    if found is None:
        return None
    edges, places = found
    bins, best = len(edges) - 1, np.zeros(len(edges) - 1)
    own = [np.where(np.isfinite(x), y, np.nan) for x, y in zip(parts, moments.prediction, strict=True)]
    for side in directions(balance):
        ours = zip(places, _times(own, side), strict=True)
        passes = [p for place, y in ours for p in _passes(place, y, balance.step_s)]
        zero = float(np.median([len(y) for _, y in passes]))
        each, _ = explained_by_bins([k for k, _ in passes], [y for _, y in passes], bins, zero)
        best = np.maximum(best, each.sum(axis=0))
    energy = np.bincount(np.concatenate(places), np.nan_to_num(np.concatenate(own)) ** 2, bins)
    agree = 2.0 * best > energy
    if 2.0 * energy[agree].sum() <= energy.sum():
        return None
    wide = np.convolve(agree, (1, 1, 1), "same") > 0
    if edges[-1] - edges[0] > 2.0 * np.pi * (1.0 - 1.5 / bins):  # the ends of a whole turn are neighbours
        wide |= np.roll(agree, 1) | np.roll(agree, -1)
    masks = [wide[place] for place in places]
    own = [np.where(m & np.isfinite(x), x, 0.0) for m, x in zip(masks, parts, strict=True)]
    explained = np.where(agree, best, 0.0)
    return _view("link_angle", parts, own, edges=edges, explained=explained, places=places, masks=masks)


def _passes(place: Index, x: FloatArray, step_s: float) -> list[tuple[Index, FloatArray]]:
    """Return the stays of a run in a bin, each as (bins, residual): of all bins that it visits."""
    every = [np.flatnonzero(place == k) for k in np.unique(place)]
    stays = (np.split(at, np.flatnonzero(np.diff(at) > BLOCK_S / step_s) + 1) for at in every)
    return [(place[stay], x[stay]) for each in stays for stay in each]


def seconds(balance: Balance, parts: Sequence[FloatArray]) -> View | None:
    """Return the means over seconds where the residual is not where it should be although no condition explains it: a zero
    that jumps, a joint that is not always the same. None where they may be noise.
    """
    block, prediction, means = _block(balance.step_s), [], list[tuple[float, str, float]]()
    for run, x in zip(balance.runs, parts, strict=True):
        mean = _means(x, block)
        prediction.append(np.zeros(len(x)))
        prediction[-1][: len(mean) * block] = np.repeat(np.nan_to_num(mean), block)
        middle = run.time_s[: len(mean) * block : block] + 0.5 * block * balance.step_s
        means += [(abs(float(m)), run.name, float(t)) for m, t in zip(mean, middle, strict=True)]
    means = [each for each in means if math.isfinite(each[0])]
    square = np.array([m * m for m, _, _ in means])
    if not means:
        return None
    far = square[square > _FAR * np.median(square)]
    all_of_them = np.mean(square) > max((RELEVANCE * balance.rated_nm) ** 2, balance.coarse_nm2)
    if all_of_them or np.sum(far) / len(square) > balance.coarse_nm2:
        return _view("time", parts, prediction, what="seconds", times=_moments(means)[:6])
    return None
