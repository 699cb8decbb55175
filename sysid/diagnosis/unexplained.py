"""Unexplained residual: maps, events and lines in it that are not noise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.estimator.joint import Joint
from jtqd.estimator.text import counted
from jtqd.sysid.diagnosis.dataset import Dataset
from jtqd.sysid.diagnosis.events import (
    BLOCK_S,
    MOST_OF_THE_TIME,
    Burst,
    EventLimits,
    Events,
    block_means,
    bursts,
    wandering,
)
from jtqd.sysid.diagnosis.noise import Noise
from jtqd.sysid.diagnosis.regressors import LINE, ChannelData, RunData
from jtqd.sysid.diagnosis.signals import Channel, Line
from jtqd.sysid.diagnosis.solution import Remaining
from jtqd.sysid.diagnosis.structure import (
    SIGNIFICANT,
    AxisMap,
    axis_maps,
    axis_values,
    frequency_lines,
    order_lines,
    sharpened,
)

_RELEVANT: Final = 6e-4
"""Part of the rated torque (rms) from which structure counts as a gap."""
_JUMP: Final = 0.01
"""Part of the rated torque by which the residual must move for an event."""
_WANDER: Final = 0.006
"""Part of the rated torque (rms of means over seconds) from which a residual is not noise."""
SHARED: Final = 5.0
"""Standard deviations of the mean over runs, of days that differ as usual, beyond which all runs have it in common."""
_OF_A_DAY: Final = ("zero", "viscous", "coulomb")
"""Families that are the joint's where all runs share them; a torsion's zero is nobody's, `smooth` is what is near rest."""
_LINE_RATIO: Final = 25.0
_HZ_RATIO: Final = 25.0


@dataclass(frozen=True)
class Unexplained:
    """maps: all axes of all channels; found: those whose structure is significant and large enough to be reported; limits:
    by which a channel's events are judged; worst_nm: rms of the structure in the run that has most of it, per channel.
    """

    maps: tuple[AxisMap, ...]
    found: tuple[AxisMap, ...]
    bursts: tuple[Burst, ...]
    lines: tuple[Line, ...]
    limits: Mapping[Channel, EventLimits] = field(default_factory=dict)
    worst_nm: Mapping[Channel, float] = field(default_factory=dict)

    @property
    def significant(self) -> bool:
        """Whether anything is left that is not noise."""
        return bool(self.found or self.bursts or self.lines)

    def energy_nm2(self) -> float:
        """Return the largest energy per channel that is structure, summed over channels [Nm^2]."""
        return sum(self.by_channel().values())

    def by_channel(self) -> dict[Channel, float]:
        """Return the largest energy that is structure, per channel [Nm^2]."""
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
        """Return unexplained structure as a part of all structure; explained_nm2: of the causes, summed over channels."""
        left = self.energy_nm2()
        return left / max(left + explained_nm2, 1e-30)

    @property
    def reasons(self) -> list[str]:
        """Lines for people."""
        out = []
        for m in sorted(self.found, key=lambda m: -m.energy_nm2)[:3]:
            size, axis = np.sqrt(m.energy_nm2), m.axis.replace("_", " ")
            out.append(
                f"joint {m.channel.joint}, {m.channel.balance} balance: {size:.3g} Nm rms depend on the {axis}"
                " in a way that no effect of the library explains"
            )
        for b in self.bursts:
            run, t = b.times[0]
            many = len(b.times)
            what = (
                f"{counted(many, 'event')} that noise does not explain"
                if b.what == "events"
                else "means over a second that noise does not explain"
            )
            out.append(
                f"joint {b.channel.joint}, {b.channel.balance} balance: {what}, the strongest in {run} at {t:.1f} s"
            )
        for line in self.lines[:2]:
            where = (
                f"at {line.order:.3g} Hz, independent of the motion"
                if line.unit == "Hz"
                else f"at order {line.order:.2f} per motor revolution, which is no order of gear or motor"
            )
            out.append(
                f"joint {line.channel.joint}, {line.channel.balance} balance: {line.amplitude_nm:.3g} Nm {where}"
            )
        return out


def own_changes(dataset: Dataset, refined: Remaining) -> FloatArray:
    """Return the runs' own changes [r, q], without strange lines: of a family that all runs have far more of than days
    differ by, only what each has beside the others. What all runs share is no change from run to run: it is the joint's, and
    unexplained where no cause covers it.
    """
    changes = np.array(refined.nuisances)
    changes[:, [g.name == LINE for g in dataset.families]] = 0.0
    pieces = np.array(refined.pieces)
    runs = np.array([changes[pieces == r].mean(axis=0) for r in np.unique(pieces)])
    sigma = np.array([np.inf if g.name not in _OF_A_DAY else g.sigma for g in dataset.families])
    shared = runs.mean(axis=0)
    shared[np.abs(shared) < SHARED * sigma / np.sqrt(len(runs))] = 0.0
    return np.asarray(changes - shared)


def less_nuisances(dataset: Dataset, refined: Remaining) -> dict[Channel, list[FloatArray]]:
    """Return what the causes leave, less the runs' own changes but not less strange lines, events with it [run][n]."""
    out: dict[Channel, list[FloatArray]] = {}
    for r, (run, u) in enumerate(zip(refined.runs, own_changes(dataset, refined), strict=True)):
        for channel, d in run.channels.items():
            rest = d.residual - d.nuisances @ u[d.families]
            out.setdefault(channel, []).append(np.where(dataset.valid_or_event(r, channel), rest, np.nan))
    return out


def held_nm(dataset: Dataset, refined: Remaining) -> dict[Channel, float]:
    """Return what the rows of held channels are wrong by: rms over the run that has most of it [Nm], beyond
    what is usual in the others; at rest, where the balance is not known, against a straight line between the rows around
    them. Channels without such rows are left out.
    """
    return {c: max(e / n for e, n in runs) ** 0.5 for c, runs in _held(dataset, refined).items()}


def _measured_or_held(d: ChannelData) -> BoolArray:
    return d.valid if d.held is None else d.valid | d.held


def _held(dataset: Dataset, refined: Remaining) -> dict[Channel, list[tuple[float, int]]]:
    """Return (sum of squares [Nm^2], samples held or valid) of the runs with held rows, by channel."""
    out: dict[Channel, list[tuple[float, int]]] = {}
    for run, left, u in zip(dataset.runs, refined.runs, refined.nuisances, strict=True):
        for channel, d in run.channels.items():
            if d.held is None or not (d.held.any() or len(d.at_rest_nm)):
                continue
            rest = left.channels[channel].residual - d.nuisances @ u[d.families]
            usual = float(np.mean(rest[d.valid] ** 2)) if d.valid.any() else 0.0
            excess = max(float(np.sum(rest[d.held] ** 2 - usual)), 0.0) + float(np.sum(d.at_rest_nm**2))
            out.setdefault(channel, []).append(
                (excess, int(np.sum(_measured_or_held(d))) + len(d.at_rest_nm))
            )
    return out


def events_left(dataset: Dataset, refined: Remaining, noise: Noise) -> dict[Channel, Events]:
    """Return rare events where the residual of the causes has any that are large enough to matter, else nothing.

    The residual of the causes decides whether there are events. The residual that no effect of the library explains decides
    when they are: events bend the fitted causes, which then leave residuals at other moments.
    """
    if not _bursts(dataset, less_nuisances(dataset, refined), noise):
        return {}
    found = _bursts(dataset, dataset.unexplained, noise)
    return {c: e for c, e in found.items() if e.part < MOST_OF_THE_TIME}


def _bursts(
    dataset: Dataset, residuals: Mapping[Channel, list[FloatArray]], noise: Noise
) -> dict[Channel, Events]:
    found = bursts(dataset.runs, residuals, _limits(dataset, noise))
    return {c: e for c, e in found.items() if e.burst.excess_nm2 > 0.25 * _least(dataset.joints[c.joint])}


def _limits(dataset: Dataset, noise: Noise) -> dict[Channel, EventLimits]:
    rated = {c: dataset.joints[c.joint].rated_torque_nm for c in dataset.runs[0].channels}
    return {c: EventLimits(noise.ar[c], dataset.step_s, _JUMP * x, _WANDER * x) for c, x in rated.items()}


def _least(joint: Joint) -> float:
    """Return the energy from which structure is a gap [Nm^2]."""
    return (_RELEVANT * joint.rated_torque_nm) ** 2


def unexplained_residual(dataset: Dataset, refined: Remaining, noise: Noise) -> Unexplained:
    """Return the unexplained residual when causes and the runs' own changes are taken out."""
    joints = dataset.joints
    whole = less_nuisances(dataset, refined)
    found = _bursts(dataset, whole, noise)
    # maps and lines of what is no event: a few moments say nothing about a condition
    residuals = {c: _without_rare_events(parts, found.get(c)) for c, parts in whole.items()}
    maps = axis_maps(refined.runs, residuals, dataset.step_s)
    significant = tuple(
        m for m in maps if m.p < SIGNIFICANT and m.energy_nm2 > _least(joints[m.channel.joint])
    )
    limits = _limits(dataset, noise)
    burst = (*(e.burst for e in found.values()), *wandering(refined.runs, residuals, limits))
    lines = tuple(
        sharpened(line, refined.runs, residuals[line.channel], dataset.step_s)
        for line in (
            *order_lines(refined.runs, residuals, dataset.step_s),
            *frequency_lines(refined.runs, residuals, dataset.step_s),
        )
        if line.ratio > (_HZ_RATIO if line.unit == "Hz" else _LINE_RATIO)
        and 0.5 * line.amplitude_nm**2 > _least(joints[line.channel.joint])
    )
    worst = _worst_runs(
        refined.runs, whole, dataset.step_s, maps=significant, events=found, bursts=burst, lines=lines
    )
    return Unexplained(tuple(maps), significant, burst, lines, limits, worst)


def _worst_runs(
    runs: Sequence[RunData],
    whole: Mapping[Channel, Sequence[FloatArray]],
    step_s: float,
    *,
    maps: Sequence[AxisMap],
    events: Mapping[Channel, Events],
    bursts: Sequence[Burst],
    lines: Sequence[Line],
) -> dict[Channel, float]:
    """Return the rms of the structure in the run that has most of it [Nm]: of the largest map, event, wandering or line."""
    energy: dict[Channel, float] = {}

    def at_least(channel: Channel, nm2: float) -> None:
        energy[channel] = max(energy.get(channel, 0.0), nm2)

    for m in maps:
        chance = float(np.nansum(m.mean_nm**2 * m.count)) / max(float(m.count.sum()), 1.0)
        part = m.energy_nm2 / max(chance, 1e-30)  # the rest of the means' energy is chance
        for run in runs:
            values = axis_values(run.axes[m.channel.joint], m.axis)
            place = np.clip(np.searchsorted(m.edges, values, side="right") - 1, 0, len(m.mean_nm) - 1)
            here = m.mean_nm[place][run.channels[m.channel].valid]
            if np.isfinite(here).any():
                at_least(m.channel, part * float(np.nanmean(here**2)))
    for channel, found in events.items():
        usual = float(
            np.nanmedian([np.nanmean(x[~m] ** 2) for x, m in zip(whole[channel], found.masks, strict=True)])
        )
        for x, mask in zip(whole[channel], found.masks, strict=True):
            count = max(int(np.isfinite(x).sum()), 1)
            at_least(channel, float(np.nansum(x[mask] ** 2 - usual)) / count)
    block = max(2, round(BLOCK_S / step_s))
    for b in bursts:
        if b.what == "seconds":
            for x in whole[b.channel]:
                mean, use = block_means(x, block)
                if use.any():
                    at_least(b.channel, float(np.mean(mean[use] ** 2)))
    for line in lines:
        at_least(line.channel, 0.5 * line.amplitude_nm**2)
    return {c: float(np.sqrt(e)) for c, e in energy.items()}


def _without_rare_events(parts: Sequence[FloatArray], found: Events | None) -> list[FloatArray]:
    """Return the residual without its events where they are rare [run][n]."""
    if found is None or found.part >= MOST_OF_THE_TIME:
        return list(parts)
    return [np.where(m, np.nan, x) for m, x in zip(found.masks, parts, strict=True)]
