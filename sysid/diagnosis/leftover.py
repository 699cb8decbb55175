"""What the causes leave over: is it structure, and where. Pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import Joint
from jtqd.sysid.diagnosis.events import (
    BLOCK_S,
    MOST_OF_THE_TIME,
    Burst,
    Events,
    Prepared,
    block_means,
    bursts,
    events,
    wandering,
)
from jtqd.sysid.diagnosis.noise import Noise
from jtqd.sysid.diagnosis.refine import Refined
from jtqd.sysid.diagnosis.regressors import LINE, RunData
from jtqd.sysid.diagnosis.signals import Channel, Line
from jtqd.sysid.diagnosis.structure import (
    SIGNIFICANT,
    AxisMap,
    axis_map,
    axis_maps,
    axis_values,
    directions,
    frequency_lines,
    order_lines,
    sharpened,
    turned,
)

# Where an engineer should look first: which condition tells most of what is left over, and what tells the rest. Pure.
#
# An axis (velocity, load, an angle, ...) tells a residual when the mean of a bin over the *other* runs predicts it in this
# run: the square error that goes away, summed over the runs left out one by one (`told_by`). Noise of another run is
# independent however coloured it is, so bins that only follow the noise tell nothing or less, and more bins are no
# advantage; nor is a condition that merely goes with the run (temperature, time), because other runs do not confirm it.
# Events and seconds that are off tell only what the best axis does not predict: a bump that makes a step on every pass is
# the angle's, not the moments'. The condition that tells most is the first place; what it tells is taken out, and the
# search is made again: the second place tells most of what the first does not. Energies in Nm^2.


MOST: Final = 3
"""Places of different kinds that are looked for."""
LEAST: Final = 0.01
"""Part of the energy that a place must tell."""
_BEYOND: Final = 0.01
"""Largest p of an axis that tells what others before it do not."""
_FEWEST_RUNS: Final = 2
"""An axis is confirmed by this many runs at least."""
_PRIOR_S: Final = 1.0
"""A bin's mean over the other runs counts as if it had been zero for so long before."""


@dataclass(frozen=True)
class Told:
    """energy [Nm^2] that an axis tells beyond those before it, with its bins, the most telling first; or that events,
    seconds or a line hold.
    """

    energy_nm2: float
    axis: str = ""
    bins: tuple[int, ...] = ()
    burst: Burst | None = None
    line: Line | None = None


@dataclass(frozen=True)
class Judge:
    """What one channel is judged by: autoregression of its noise, seconds to a bin, by how much an event moves and seconds
    wander at least [Nm] (`leftover`).
    """

    ar: FloatArray
    step_s: float
    jump_nm: float
    wander_nm: float


@dataclass(frozen=True)
class _Axis:
    """An axis in one direction: energy told; prediction [run][n] of the residual; energy told per bin."""

    axis: str
    energy_nm2: float
    prediction: list[FloatArray]
    bins: FloatArray


def told_by(
    places: Sequence[np.ndarray[tuple[int], np.dtype[np.intp]]],
    parts: Sequence[FloatArray],
    bins: int,
    step_s: float,
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
    told: FloatArray = 2.0 * others * sums - others**2 * counts
    return told, [others[r][place] for r, place in enumerate(places)]


def places_told(  # noqa: PLR0917
    runs: Sequence[RunData],
    channel: Channel,
    parts: Sequence[FloatArray],
    judge: Judge | None,
    lines: Sequence[Line],
    maps: Mapping[str, AxisMap],
) -> list[Told]:
    """Return the places of a channel's residual [run][n], first the one that tells most, at most MOST.

    judge: None for a gap that has causes or none: events and wandering are left out, and an axis need not be certain;
    maps: of this residual. Of a gap that is not explained an axis whose map could be chance is no place.
    """
    now = list(parts)
    whole = float(np.nanmean(np.concatenate(now) ** 2))
    out: list[Told] = []
    while len(out) < MOST:
        used = [t.axis for t in out]  # empty names: events, seconds, lines
        axis = _best_axis(runs, channel, now, used, maps, LEAST * whole, certain=judge is not None)
        rest = now if axis is None else [x - y for x, y in zip(now, axis.prediction, strict=True)]
        found = [] if axis is None else [Told(axis.energy_nm2, axis.axis, _order(axis.bins))]
        found += [Told(0.5 * x.amplitude_nm**2, line=x) for x in lines if all(t.line is not x for t in out)]
        masked = now
        if judge is not None and not any(t.burst is not None and t.burst.what == "events" for t in out):
            seen = events(runs, channel, rest, judge.ar, judge.step_s, judge.jump_nm)
            if seen is not None:
                found.append(Told(seen.burst.excess_nm2, burst=seen.burst))
                masked = [np.where(m, np.nan, x) for m, x in zip(seen.masks, now, strict=True)]
                rest = [np.where(m, np.nan, x) for m, x in zip(seen.masks, rest, strict=True)]
        if judge is not None and not any(t.burst is not None and t.burst.what == "seconds" for t in out):
            off = wandering(runs, {channel: rest}, judge.step_s, {channel: judge.wander_nm})
            found += [Told(b.excess_nm2, burst=b) for b in off]
        best = max(found, key=lambda t: t.energy_nm2, default=None)
        if best is None or best.energy_nm2 < LEAST * whole:
            break
        out.append(best)
        if best.axis and axis is not None:
            now = [x - y for x, y in zip(now, axis.prediction, strict=True)]
        elif best.burst is not None and judge is not None:
            now = masked if best.burst.what == "events" else _less_seconds(now, judge.step_s)
    return out


def _order(told: FloatArray) -> tuple[int, ...]:
    """Return the bins that tell something, the most telling first."""
    return tuple(int(k) for k in np.argsort(-told) if told[k] > 0.0)


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


def _best_axis(  # noqa: PLR0917
    runs: Sequence[RunData],
    channel: Channel,
    parts: Sequence[FloatArray],
    used: Sequence[str],
    maps: Mapping[str, AxisMap],
    least_nm2: float,
    *,
    certain: bool,
) -> _Axis | None:
    """Return the axis that tells most of what is left; certain: none that could be chance, by its map while nothing is
    taken out (`used` is empty), else by a map of what is left.
    """
    step_s = float(np.median(np.diff(runs[0].time_s)))
    count = max(sum(int(np.isfinite(x).sum()) for x in parts), 1)
    ranked: list[tuple[float, str, FloatArray, list[FloatArray], list[FloatArray] | None, FloatArray]] = []
    for axis, drawn in maps.items():
        if axis in used or (certain and not used and drawn.p >= SIGNIFICANT):
            continue
        edges, bins = drawn.edges, len(drawn.edges) - 1
        values = [axis_values(run.axes[channel.joint], axis) for run in runs]
        places = [np.clip(np.searchsorted(edges, v, side="right") - 1, 0, bins - 1) for v in values]
        for side in directions(runs, channel):
            told, means = told_by(places, turned(parts, side), bins, step_s)
            told /= count
            if told.sum() > least_nm2 and (told.sum(axis=1) > 0.0).sum() >= _FEWEST_RUNS:
                ranked.append((float(told.sum()), axis, told, turned(means, side), side, edges))
    ranked.sort(key=lambda item: -item[0])
    for energy, axis, told, prediction, side, edges in ranked:
        p = 0.0
        if certain and used:
            values = [axis_values(run.axes[channel.joint], axis) for run in runs]
            block = max(2, round(BLOCK_S / step_s))
            rng = np.random.default_rng(0)
            p = axis_map(channel, axis, edges, values, turned(parts, side), block, rng).p
        if p < _BEYOND:
            return _Axis(axis, energy, prediction, told.sum(axis=0))
    return None


_RELEVANT: Final = 6e-4
"""Part of the rated torque (rms) from which structure counts as a gap."""
_JUMP: Final = 0.01
"""Part of the rated torque by which the residual must move for an event."""
_WANDER: Final = 0.006
"""Part of the rated torque (rms of means over seconds) from which a residual is not noise."""
_LINE_RATIO: Final = 25.0
_HZ_RATIO: Final = 25.0


@dataclass(frozen=True)
class Leftover:
    """maps: all axes of all channels; found: those whose structure is significant and large enough to matter; judges: by
    what a channel's events are judged.
    """

    maps: tuple[AxisMap, ...]
    found: tuple[AxisMap, ...]
    bursts: tuple[Burst, ...]
    lines: tuple[Line, ...]
    judges: Mapping[Channel, Judge] = field(default_factory=dict)

    @property
    def significant(self) -> bool:
        """Whether anything is left that is not noise."""
        return bool(self.found or self.bursts or self.lines)

    def energy_nm2(self) -> float:
        """Largest energy per channel that is structure, summed over channels [Nm^2]."""
        return sum(self.by_channel().values())

    def by_channel(self) -> dict[Channel, float]:
        """Largest energy that is structure, per channel [Nm^2]."""
        by_channel: dict[Channel, float] = {}
        items = [
            *((m.channel, m.energy_nm2) for m in self.found),
            *((b.channel, b.excess_nm2) for b in self.bursts),
            *((line.channel, 0.5 * line.amplitude_nm**2) for line in self.lines),
        ]
        for channel, energy in items:
            by_channel[channel] = max(by_channel.get(channel, 0.0), energy)
        return by_channel

    def share(self, explained_nm2: float) -> float:
        """Return left-over structure as a part of all structure; explained_nm2: of the causes, summed over channels."""
        left = self.energy_nm2()
        return left / max(left + explained_nm2, 1e-30)

    @property
    def reasons(self) -> list[str]:
        """Lines for people."""
        out = []
        for m in sorted(self.found, key=lambda m: -m.energy_nm2)[:3]:
            size, axis = np.sqrt(m.energy_nm2), m.axis.replace("_", " ")
            out.append(
                f"joint {m.channel.joint}, {m.channel.balance} balance: {size:.3g} Nm rms follow the {axis}"
                " in a way that no effect of the library does"
            )
        for b in self.bursts:
            run, t = b.times[0]
            many = len(b.times)
            seen = f"{many} events that noise does not make" if b.what == "events" else "seconds that are off"
            out.append(
                f"joint {b.channel.joint}, {b.channel.balance} balance: {seen}, the strongest in {run} at {t:.1f} s"
            )
        for line in self.lines[:2]:
            where = (
                f"at {line.order:.3g} Hz, whatever the motion"
                if line.unit == "Hz"
                else f"at order {line.order:.2f} per motor revolution, which is none of gear or motor"
            )
            out.append(
                f"joint {line.channel.joint}, {line.channel.balance} balance: {line.amplitude_nm:.3g} Nm {where}"
            )
        return out


def less_nuisances(prepared: Prepared, refined: Refined) -> dict[Channel, list[FloatArray]]:
    """Return what the causes leave, less the runs' own changes but not less strange lines, events with it [run][n]."""
    use = np.array([g.name != LINE for g in prepared.groups])
    out: dict[Channel, list[FloatArray]] = {}
    for r, (run, u) in enumerate(zip(refined.runs, refined.nuisances, strict=True)):
        for channel, d in run.channels.items():
            weight = np.where(use[d.families], u[d.families], 0.0)
            rest = d.residual - d.nuisances @ weight
            out.setdefault(channel, []).append(np.where(prepared.seen(r, channel), rest, np.nan))
    return out


def events_left(
    prepared: Prepared, refined: Refined, noise: Noise, joints: Mapping[int, Joint]
) -> dict[Channel, Events]:
    """Return rare events where the causes leave any that are large enough to matter, else nothing.

    Whether there are any is asked of what the causes leave. Where they are is asked of what no effect of the library at all
    explains: causes that are bent by events leave others than those that are there.
    """
    if not _bursts(prepared, less_nuisances(prepared, refined), noise, joints):
        return {}
    found = _bursts(prepared, prepared.unexplained, noise, joints)
    return {c: e for c, e in found.items() if e.part < MOST_OF_THE_TIME}


def _bursts(
    prepared: Prepared,
    residuals: Mapping[Channel, list[FloatArray]],
    noise: Noise,
    joints: Mapping[int, Joint],
) -> dict[Channel, Events]:
    jumps = {c: _JUMP * joints[c.joint].rated_torque_nm for c in residuals}
    found = bursts(prepared.runs, residuals, noise.ar, prepared.step_s, jumps)
    return {c: e for c, e in found.items() if e.burst.excess_nm2 > 0.25 * _least(joints[c.joint])}


def _least(joint: Joint) -> float:
    """Return the energy from which structure is a gap [Nm^2]."""
    return (_RELEVANT * joint.rated_torque_nm) ** 2


def leftover(prepared: Prepared, refined: Refined, noise: Noise, joints: Mapping[int, Joint]) -> Leftover:
    """Return what is left over when causes and the runs' own changes are taken out."""
    whole = less_nuisances(prepared, refined)
    found = _bursts(prepared, whole, noise, joints)
    # maps and lines of what is no event: a few moments say nothing about a condition
    residuals = {c: _calm(parts, found.get(c)) for c, parts in whole.items()}
    maps = axis_maps(refined.runs, residuals, prepared.step_s)
    significant = tuple(
        m for m in maps if m.p < SIGNIFICANT and m.energy_nm2 > _least(joints[m.channel.joint])
    )
    wander = {c: _WANDER * joints[c.joint].rated_torque_nm for c in whole}
    burst = tuple(e.burst for e in found.values())
    burst += tuple(wandering(refined.runs, residuals, prepared.step_s, wander))
    lines = tuple(
        sharpened(line, refined.runs, residuals[line.channel], prepared.step_s)
        for line in (
            *order_lines(refined.runs, residuals, prepared.step_s),
            *frequency_lines(refined.runs, residuals, prepared.step_s),
        )
        if line.ratio > (_HZ_RATIO if line.unit == "Hz" else _LINE_RATIO)
        and 0.5 * line.amplitude_nm**2 > _least(joints[line.channel.joint])
    )
    judges = {
        c: Judge(noise.ar[c], prepared.step_s, _JUMP * joints[c.joint].rated_torque_nm, wander[c])
        for c in whole
    }
    return Leftover(tuple(maps), significant, burst, lines, judges)


def _calm(parts: Sequence[FloatArray], found: Events | None) -> list[FloatArray]:
    """Return the residual without its events where they are rare [run][n]."""
    if found is None or found.part >= MOST_OF_THE_TIME:
        return list(parts)
    return [np.where(m, np.nan, x) for m, x in zip(found.masks, parts, strict=True)]
