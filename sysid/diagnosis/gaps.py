"""How large the gap is in each balance, against the noise floor of the data, and where it lies.

A condition, or axis (velocity, load, an angle, ...), explains a residual when the mean of a bin over the *other* runs
predicts it in this run. Measured is the squared error that this takes away, summed over all held-out runs
(`explained_by_bins`). Noise of two runs is independent, however coloured, so bins that only follow the noise explain
nothing, and more bins are no advantage. A condition that only differs from run to run (temperature, time) has no
advantage either, because other runs do not confirm it. Events and seconds with a deviating mean explain only what the
best axis does not predict: a bump that makes a step on every pass belongs to the angle. A range of the link's turn that
only one run reaches is confirmed by its passes (`passes`). The condition that explains most is the first location; what
it explains is taken out, and the search is made again (`locate`). Energies in Nm^2.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.estimator.effects.effect import TORSION
from jtqd.sysid.diagnosis.angle_events import predicted_by_passes, turn_range
from jtqd.sysid.diagnosis.dataset import Dataset
from jtqd.sysid.diagnosis.events import BLOCK_S, Burst, EventLimits, block_means, events, wandering
from jtqd.sysid.diagnosis.findings import Gap, Place, Trace
from jtqd.sysid.diagnosis.regressors import Index, RunData, binned
from jtqd.sysid.diagnosis.signals import Channel, JointSignals, Line
from jtqd.sysid.diagnosis.solution import Remaining
from jtqd.sysid.diagnosis.structure import (
    SIGNIFICANT,
    AxisMap,
    axis_map,
    axis_maps,
    axis_values,
    directions,
    signed,
)
from jtqd.sysid.diagnosis.unexplained import Unexplained, less_nuisances, own_changes

_SAME: Final = 0.02
"""Two runs whose velocities and loads differ by less than this part of their rms are repetitions."""
_PLACES_PER_AXIS: Final = 3
_LEAST_SHARE: Final = 0.02
"""Of the gap, from which a further bin is worth a line."""
_TRACE_POINTS: Final = 4000
QUADRANT_NAMES: Final = ("v+ load+", "v+ load-", "v- load+", "v- load-")
MOST: Final = 3
"""Locations that are looked for."""
LEAST: Final = 0.01
"""Part of the energy that a location must explain."""
_BEYOND: Final = 0.01
"""Largest p of an axis that explains what others before it do not."""
_FEWEST_RUNS: Final = 2
"""An axis is confirmed by this many runs at least."""
_AGREE: Final = 0.25
"""Part of the energy of passes that the other passes predict, where they agree: half of it as torque."""
_PRIOR_S: Final = 1.0
"""A bin's mean over the other runs counts as if it had been zero for so long before."""


@dataclass(frozen=True)
class Location:
    """Part of a gap: the energy [Nm^2] that an axis explains beyond those before it, with its bins, the largest first; or
    that events, seconds or a line hold.
    """

    energy_nm2: float
    axis: str = ""
    bins: tuple[int, ...] = ()
    burst: Burst | None = None
    line: Line | None = None


def channel_gaps(dataset: Dataset, refined: Remaining, left: Unexplained | None) -> tuple[Gap, ...]:
    """Return the gaps of all channels, largest excess over the floor first; places of the unexplained residual where `left`
    is given (nothing named), else of the whole gap.
    """
    residuals = _raw(dataset)
    # where the gap lives: without what each run has of its own, which would hide a small effect
    shown = _before(dataset, refined) if left is None else less_nuisances(dataset, refined)
    maps = axis_maps(dataset.runs, shown, dataset.step_s) if left is None else left.maps
    out = []
    for channel, parts in residuals.items():
        everything = np.concatenate(parts)
        rmse = float(np.sqrt(np.nanmean(everything**2)))
        floor, origin = _floor(dataset, refined, channel)
        floor = min(floor, rmse)  # changes from run to run that work against each other are not noise
        mine = [m for m in maps if m.channel == channel]
        noise = float(np.sqrt(np.nanmean(np.concatenate(dataset.unexplained[channel]) ** 2)))
        every = [p for m in mine for p in _bins(m, noise)]
        limits = None if left is None else left.limits[channel]
        lines = [] if left is None else [x for x in left.lines if x.channel == channel]
        by_axis = {m.axis: m for m in mine}
        locations = locate(dataset.runs, channel, shown[channel], limits, lines=lines, maps=by_axis)
        excess = max(rmse**2 - noise**2, 1e-30)
        if left is not None:  # locations are those of events, too, which the maps leave out
            by_axis = {a: _with_events(dataset.runs, m, shown[channel]) for a, m in by_axis.items()}
        places = _places(locations, by_axis, noise, excess, left is not None)
        out.append(Gap(channel.joint, channel.balance, rmse, floor, origin, tuple(places), tuple(every)))
    if left is not None:  # what is not explained comes first, wherever the gap is largest
        energy = left.by_channel()
        return tuple(sorted(out, key=lambda g: -energy.get(Channel(g.joint, g.balance), 0.0)))
    return tuple(sorted(out, key=lambda g: g.noise_floor_nm**2 - g.rmse_nm**2))


def _raw(dataset: Dataset) -> dict[Channel, list[FloatArray]]:
    """Residuals of the simulation with the joint file [run][n]; torsion without each run's zero; NaN where invalid."""
    out: dict[Channel, list[FloatArray]] = {}
    for r, run in enumerate(dataset.runs):
        for channel, d in run.channels.items():
            x = np.where(dataset.valid_or_event(r, channel), d.residual, np.nan)
            if channel.balance == "torsion":
                x = x - np.nanmean(x)
            out.setdefault(channel, []).append(x)
    return out


def _floor(dataset: Dataset, refined: Remaining, channel: Channel) -> tuple[float, str]:
    """Return the noise floor [Nm] and where it was taken from."""
    repeats = _repeats(dataset, channel)
    if repeats is not None:
        return repeats, "repeated runs"
    noise = np.concatenate(dataset.unexplained[channel])
    square = float(np.nanmean(noise**2))
    drift, count = 0.0, 0
    for run, u in zip(refined.runs, own_changes(dataset, refined), strict=True):
        d = run.channels[channel]
        part = (d.nuisances @ u[d.families])[d.valid]
        if channel.balance == "torsion" and len(part):
            part = part - part.mean()
        drift += float(part @ part)
        count += len(part)
    return float(np.sqrt(square + drift / max(count, 1))), "what no effect explains, and run-to-run variation"


def _repeats(dataset: Dataset, channel: Channel) -> float | None:
    """Return rms of half the difference of repeated runs times sqrt 2 [Nm]; None without repetitions."""
    differences = []
    runs = dataset.runs
    for a in range(len(runs)):
        for b in range(a):
            one, two = runs[a], runs[b]
            if len(one.time_s) != len(two.time_s) or not _alike(
                one.axes[channel.joint], two.axes[channel.joint]
            ):
                continue
            x, y = one.channels[channel], two.channels[channel]
            both = x.valid & y.valid
            d = (x.residual - y.residual)[both]
            differences.append(d - d.mean() if channel.balance == "torsion" and len(d) else d)
    if not differences or sum(map(len, differences)) < 200:
        return None
    return float(np.sqrt(0.5 * np.mean(np.concatenate(differences) ** 2)))


def _alike(one: dict[str, FloatArray], two: dict[str, FloatArray]) -> bool:
    for axis in ("velocity", "load"):
        scale = float(np.sqrt(np.mean(one[axis] ** 2)))
        apart = float(np.sqrt(np.mean((one[axis] - two[axis]) ** 2)))
        limit = _SAME if axis == "velocity" else 0.1
        if scale <= 0.0 or apart > limit * scale:
            return False
    return True


def _bins(m: AxisMap, floor: float) -> list[Place]:
    """Return all bins of an axis that were visited, with their share of the axis' energy above the floor."""
    return [p for k, p in enumerate(_every_bin(m, floor)) if m.count[k] > 0]


def _every_bin(m: AxisMap, floor: float) -> list[Place]:
    excess = np.maximum(np.nan_to_num(m.square_nm2) - floor**2, 0.0) * m.count
    total = max(float(excess.sum()), 1e-30)
    return [
        Place(
            m.axis,
            _bin_name(m, k),
            float(excess[k]) / total,
            float(m.edges[k]),
            float(m.edges[k + 1]),
            m.unit,
            float(np.sqrt(m.square_nm2[k])),
        )
        for k in range(len(m.count))
    ]


def _with_events(runs: Sequence[RunData], m: AxisMap, parts: Sequence[FloatArray]) -> AxisMap:
    """Return the map with time spent and mean square of this residual [run][n] in its bins."""
    bins = len(m.edges) - 1
    count, square = np.zeros(bins), np.zeros(bins)
    for place, x in zip(_binned(runs, m.channel, m.axis, m.edges), parts, strict=True):
        good = np.isfinite(x)
        count += np.bincount(place[good], minlength=bins)
        square += np.bincount(place[good], x[good] ** 2, minlength=bins)
    return replace(m, count=count, square_nm2=np.where(count > 0, square / np.maximum(count, 1.0), np.nan))


def _places(
    locations: Sequence[Location],
    maps: Mapping[str, AxisMap],
    floor: float,
    excess_nm2: float,
    significant: bool,
) -> list[Place]:
    """Return the places of the findings: the first of each location (`locate`), then more bins of their axes, then the other
    axes by their structure; significant: leave out axes that could be chance, and what others explain already.
    """
    ranked: list[list[Place]] = []
    for t in locations:
        if t.burst is not None:
            ranked.append([_moments(t.burst, excess_nm2)])
        elif t.line is not None:
            ranked.append([_line(t.line, excess_nm2)])
        else:
            bins = _every_bin(maps[t.axis], floor)
            ranked.append([bins[k] for k in t.bins[:_PLACES_PER_AXIS]])
    if not significant:
        others = [m for m in maps.values() if all(t.axis != m.axis for t in locations)]
        others.sort(key=lambda m: (m.p >= SIGNIFICANT, -m.energy_nm2))
        ranked += [sorted(_bins(m, floor), key=lambda p: -p.share)[:_PLACES_PER_AXIS] for m in others]
    first = [places[0] for places in ranked[:MOST] if places]
    return first + [p for places in ranked for p in places if p not in first and p.share > _LEAST_SHARE]


def _moments(burst: Burst, excess_nm2: float) -> Place:
    start = burst.times[0][1]
    end = start + (1.0 if burst.what == "seconds" else 0.1)
    share = min(burst.excess_nm2 / excess_nm2, 1.0)
    return Place("time", burst.name, share, start, end, "s", float(np.sqrt(burst.excess_nm2)))


def _line(line: Line, excess_nm2: float) -> Place:
    hertz = line.unit == "Hz"
    name = f"{line.order:.3g} Hz" if hertz else f"order {line.order:.2f} per motor revolution"
    rms = line.amplitude_nm / 2**0.5
    share = min(rms**2 / excess_nm2, 1.0)
    return Place("frequency", name, share, line.order, line.order, line.unit, rms)


def _bin_name(m: AxisMap, k: int) -> str:
    if m.axis == "quadrant":
        return QUADRANT_NAMES[k]
    return f"{m.edges[k]:.3g} to {m.edges[k + 1]:.3g} {m.unit}".strip()


@dataclass(frozen=True)
class _Axis:
    """An axis in one direction: energy explained; prediction [run][n] of the residual; energy explained per bin.

    passes: samples [run][n] at a range that its passes confirm, and their energy above what it is elsewhere: the moments in
    them are the range's as a whole, as those of events are the events'.
    """

    axis: str
    energy_nm2: float
    prediction: list[FloatArray]
    bins: FloatArray
    passes: list[BoolArray] | None = None
    passes_nm2: float = 0.0

    @property
    def whole_nm2(self) -> float:
        """What is ranked beside events: energy explained, of passes all that they have above what it is elsewhere."""
        return max(self.energy_nm2, self.passes_nm2)

    def taken_from(self, parts: Sequence[FloatArray]) -> list[FloatArray]:
        """Return the residual [run][n] less the prediction, NaN in passes."""
        less = [x - y for x, y in zip(parts, self.prediction, strict=True)]
        if self.passes is None:
            return less
        return [np.where(m, np.nan, x) for m, x in zip(self.passes, less, strict=True)]


def explained_by_bins(
    places: Sequence[Index], parts: Sequence[FloatArray], bins: int, step_s: float
) -> tuple[FloatArray, list[FloatArray]]:
    """Return the energy that the bins' means over the other runs take off each run, and bin [runs, bins] (sum of squares
    over samples, Nm^2), and those means at every sample [run][n]. places: bin of every sample.
    """
    sums, counts = np.zeros((len(parts), bins)), np.zeros((len(parts), bins))
    for r, (place, x) in enumerate(zip(places, parts, strict=True)):
        good = np.isfinite(x)
        sums[r] = np.bincount(place[good], x[good], minlength=bins)
        counts[r] = np.bincount(place[good], minlength=bins)
    others = (sums.sum(axis=0) - sums) / (counts.sum(axis=0) - counts + _PRIOR_S / step_s)
    # sum of x^2 - (x - m)^2 over a bin
    explained: FloatArray = 2.0 * others * sums - others**2 * counts
    return explained, [others[r][place] for r, place in enumerate(places)]


def locate(
    runs: Sequence[RunData],
    channel: Channel,
    parts: Sequence[FloatArray],
    limits: EventLimits | None,
    *,
    lines: Sequence[Line],
    maps: Mapping[str, AxisMap],
) -> list[Location]:
    """Return the locations of a channel's residual [run][n], first the one that explains most, at most MOST.

    limits: None for a gap that has causes or none: events and wandering are left out, and an axis need not be certain;
    maps: of this residual. Of a gap that is not explained an axis whose map could be chance is no location.
    """
    now = list(parts)
    whole = float(np.nanmean(np.concatenate(now) ** 2))
    out: list[Location] = []
    while len(out) < MOST:
        used = [t.axis for t in out]  # empty names: events, seconds, lines
        axis = _best_axis(
            runs, channel, now, maps, used=used, least_nm2=LEAST * whole, certain=limits is not None
        )
        if limits is not None and "link_angle" in maps and "link_angle" not in used:
            turn = _by_passes(runs, channel, now, maps["link_angle"].edges)
            axis = max((a for a in (axis, turn) if a is not None), key=lambda a: a.energy_nm2, default=None)
        rest = now if axis is None else axis.taken_from(now)
        found = [] if axis is None else [Location(axis.whole_nm2, axis.axis, _descending(axis.bins))]
        found += [
            Location(0.5 * x.amplitude_nm**2, line=x) for x in lines if all(t.line is not x for t in out)
        ]
        masked = now
        if limits is not None and not any(t.burst is not None and t.burst.what == "events" for t in out):
            seen = events(runs, channel, rest, limits)
            if seen is not None:
                found.append(Location(seen.burst.excess_nm2, burst=seen.burst))
                masked = [np.where(m, np.nan, x) for m, x in zip(seen.masks, now, strict=True)]
                rest = [np.where(m, np.nan, x) for m, x in zip(seen.masks, rest, strict=True)]
        if limits is not None and not any(t.burst is not None and t.burst.what == "seconds" for t in out):
            off = wandering(runs, {channel: rest}, {channel: limits})
            found += [Location(b.excess_nm2, burst=b) for b in off]
        best = max(found, key=lambda t: t.energy_nm2, default=None)
        if best is None or best.energy_nm2 < LEAST * whole:
            break
        out.append(best)
        if best.axis and axis is not None:
            now = axis.taken_from(now)
        elif best.burst is not None and limits is not None:
            now = masked if best.burst.what == "events" else _less_seconds(now, limits.step_s)
    return out


def _descending(explained: FloatArray) -> tuple[int, ...]:
    """Return the bins that explain something, the largest first."""
    return tuple(int(k) for k in np.argsort(-explained) if explained[k] > 0.0)


def _less_seconds(parts: Sequence[FloatArray], step_s: float) -> list[FloatArray]:
    """Return the residual less its mean over every second [run][n]."""
    block = max(2, round(BLOCK_S / step_s))
    out = []
    for x in parts:
        mean, use = block_means(x, block)
        level = np.zeros(len(x))
        level[: len(mean) * block] = np.repeat(np.where(use, mean, 0.0), block)
        out.append(x - level)
    return out


def _best_axis(
    runs: Sequence[RunData],
    channel: Channel,
    parts: Sequence[FloatArray],
    maps: Mapping[str, AxisMap],
    *,
    used: Sequence[str],
    least_nm2: float,
    certain: bool,
) -> _Axis | None:
    """Return the axis that explains most of what is left; certain: none that could be chance, by its map while nothing is
    taken out (`used` is empty), else by a map of what is left.
    """
    step_s = float(np.median(np.diff(runs[0].time_s)))
    count = max(sum(int(np.isfinite(x).sum()) for x in parts), 1)
    ranked: list[tuple[float, str, FloatArray, list[FloatArray], list[FloatArray] | None, FloatArray]] = []
    for axis, drawn in maps.items():
        if axis in used or (certain and not used and drawn.p >= SIGNIFICANT):
            continue
        edges, bins = drawn.edges, len(drawn.edges) - 1
        places = _binned(runs, channel, axis, edges)
        for side in directions(runs, channel):
            explained, means = explained_by_bins(places, signed(parts, side), bins, step_s)
            explained /= count
            if explained.sum() > least_nm2 and (explained.sum(axis=1) > 0.0).sum() >= _FEWEST_RUNS:
                ranked.append((float(explained.sum()), axis, explained, signed(means, side), side, edges))
    ranked.sort(key=lambda item: -item[0])
    for energy, axis, explained, prediction, side, edges in ranked:
        p = 0.0
        if certain and used:
            values = [axis_values(run.axes[channel.joint], axis) for run in runs]
            block = max(2, round(BLOCK_S / step_s))
            rng = np.random.default_rng(0)
            p = axis_map(channel, axis, edges, values, signed(parts, side), block=block, rng=rng).p
        if p < _BEYOND:
            return _Axis(axis, energy, prediction, explained.sum(axis=0))
    return None


def _by_passes(
    runs: Sequence[RunData], channel: Channel, parts: Sequence[FloatArray], edges: FloatArray
) -> _Axis | None:
    """Return the link angle as the axis of what passes of a range of it have in common, None where there is none.

    The moments in the passes are the range's if what the other passes predict of a pass is not only that it deviates.
    """
    step_s = float(np.median(np.diff(runs[0].time_s)))
    places = _binned(runs, channel, "link_angle", edges)
    found = turn_range(places, parts, edges, step_s)
    if found is None:
        return None
    count = max(sum(int(np.isfinite(x).sum()) for x in parts), 1)
    masks = [np.isin(place, found.around) for place in places]
    inside = np.concatenate([x[m] for x, m in zip(parts, masks, strict=True)]) ** 2
    outside = np.concatenate([x[~m] for x, m in zip(parts, masks, strict=True)]) ** 2
    usual = float(np.nanmean(outside)) if np.isfinite(outside).any() else 0.0
    whole = float(np.nansum(inside - usual)) / count
    best: _Axis | None = None
    for side in directions(runs, channel):
        seen = signed(parts, side)
        means = predicted_by_passes(found, places, seen)
        bins = np.zeros(len(edges) - 1)
        for place, x, m in zip(places, seen, means, strict=True):
            good = np.isfinite(x)
            less = x[good] ** 2 - (x - m)[good] ** 2
            bins += np.bincount(place[good], less, minlength=len(bins))
        energy = float(bins.sum()) / count
        if best is None or energy > best.energy_nm2:
            best = _Axis("link_angle", energy, signed(means, side), bins)
    if best is not None and best.energy_nm2 > _AGREE * whole:
        return replace(best, passes=masks, passes_nm2=whole)
    return best


def _binned(runs: Sequence[RunData], channel: Channel, axis: str, edges: FloatArray) -> list[Index]:
    """Return the bin of every sample [run][n]."""
    values = [axis_values(run.axes[channel.joint], axis) for run in runs]
    return [np.clip(np.searchsorted(edges, v, side="right") - 1, 0, len(edges) - 2) for v in values]


def _causes(dataset: Dataset, refined: Remaining, channel: Channel) -> list[FloatArray]:
    """Return what the causes explain, per run [n]: before less after, the runs' own changes in neither."""
    return [
        run.channels[channel].residual - left.channels[channel].residual
        for run, left in zip(dataset.runs, refined.runs, strict=True)
    ]


def _after(dataset: Dataset, refined: Remaining) -> dict[Channel, list[FloatArray]]:
    """Return what the causes leave, less what each run has of its own where that makes it smaller [run][n]: fitted to the
    whitened residual of few seconds it need not.
    """
    out = less_nuisances(dataset, refined)
    for channel, parts in out.items():
        for r, run in enumerate(refined.runs):
            plain = np.where(dataset.valid_or_event(r, channel), run.channels[channel].residual, np.nan)
            if np.nansum(plain**2) < np.nansum(parts[r] ** 2):
                parts[r] = plain
    return out


def _before(dataset: Dataset, refined: Remaining) -> dict[Channel, list[FloatArray]]:
    """Return the residual with the joint files, less what each run has of its own [run][n]."""
    after = _after(dataset, refined)
    return {c: [a + b for a, b in zip(after[c], _causes(dataset, refined, c), strict=True)] for c in after}


def traces(dataset: Dataset, refined: Remaining) -> tuple[Trace, ...]:
    """Return measurement and residual before and after for plots, thinned, one per run and channel."""
    out = []
    after = _after(dataset, refined)
    raw = _before(dataset, refined)
    for r, run in enumerate(dataset.runs):
        signals = {s.number: s for s in dataset.signals[r]}
        for channel in run.channels:
            every = max(1, len(run.time_s) // _TRACE_POINTS)
            axes = run.axes[channel.joint]
            measured = binned(_measured(signals[channel.joint], channel.balance), run.samples)
            out.append(
                Trace(
                    run.name,
                    channel.joint,
                    channel.balance,
                    run.time_s[::every],
                    raw[channel][r][::every],
                    after[channel][r][::every],
                    axes["velocity"][::every],
                    axes["load"][::every],
                    measured[::every],
                )
            )
    return tuple(out)


def _measured(s: JointSignals, balance: str) -> FloatArray:
    """Return what a balance measures [n], Nm joint side: G Kt i of the motor, or the torque of the encoders' twist."""
    if balance == TORSION:
        return np.asarray(s.sensor_nm if s.torsion_nm is None else s.torsion_nm + s.sensor_nm)
    scale = s.joint.gear_ratio * s.joint.torque_constant_nm_per_a
    return np.asarray(s.seen(balance, scale * s.current_a))
