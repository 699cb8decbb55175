"""What remains of a residual, and where: the gaps of all balances, with noise floor, places and traces.

What entries and run-to-run variation leave is searched for views (`structure.pursue`). Those that are found are both what
remains, with energy and reasons, and where. Where nothing that remains matters, the places are those of the whole gap.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.effects.effect import MOTOR, TORSION
from jtqd.sysid.diagnosis.dataset import Dataset
from jtqd.sysid.diagnosis.entries import set_state
from jtqd.sysid.diagnosis.findings import Gap, Place, Present, Trace, shows_at
from jtqd.sysid.diagnosis.regressors import LINE, Index, RunData, binned, contribution, samples_in
from jtqd.sysid.diagnosis.signals import Channel, JointSignals
from jtqd.sysid.diagnosis.structure import AXES, QUICK_ORDERS, Balance, View, events, lines, pursue

_MOST_OF_THE_TIME: Final = 0.1
"""What takes more of the time than this is no event but a condition."""
_APART: Final = 0.25  # order, or Hz, within which two lines are one
_TRACE_POINTS: Final = 4000
"""Samples of a run in a picture."""
QUADRANT_NAMES: Final = ("v+ load+", "v+ load-", "v- load+", "v- load-")
_SHARED: Final = 5.0
"""Standard deviations of the mean of the usual run-to-run variation beyond which all runs have it in common."""
_SHAREABLE: Final = ("zero", "viscous", "coulomb")
"""Families that are the joint's where all runs share them; a torsion's zero is nobody's, `smooth` is what is near rest."""
Parts = list[FloatArray]
"""A residual [run][n], NaN where it is not valid."""


Quick = tuple[Balance, Parts, float]
"""A balance in steps as recorded, its residual, and the frequency [Hz] below which it is judged."""


@dataclass(frozen=True)
class Remaining:
    """What effects leave of the runs: residual per channel and run [n]; own: what each run has of its own [r, q]; quick: of
    channels that are judged below a frequency, what is quicker, too.
    """

    dataset: Dataset
    residual: Mapping[Channel, Parts]
    own: FloatArray
    quick: Mapping[Channel, Quick] = field(default_factory=dict)

    @cached_property
    def run_to_run(self) -> FloatArray:
        """Run-to-run variation [r, q], without unknown lines. Of a family that all runs have far more of than runs vary by,
        only what each has beside the others: what all share is the joint's, and unexplained where no cause covers it.
        """
        families, pieces = self.dataset.families, np.array(self.dataset.recordings)
        changes = np.where([g.name == LINE for g in families], 0.0, self.own)
        runs = np.array([changes[pieces == r].mean(axis=0) for r in np.unique(pieces)])
        sigma = np.array([g.sigma if g.name in _SHAREABLE else np.inf for g in families])
        shared = runs.mean(axis=0)
        shared[np.abs(shared) < _SHARED * sigma / np.sqrt(len(runs))] = 0.0
        return np.asarray(changes - shared)

    @cached_property
    def less_variation(self) -> dict[Channel, Parts]:
        """The residual less run-to-run variation but not less unknown lines, events with it."""
        out = {}
        for channel, parts in self.residual.items():
            data = self.dataset.of(channel)
            changes = [d.nuisances @ u[d.families] for d, u in zip(data, self.run_to_run, strict=True)]
            out[channel] = self.dataset.shown(channel, [x - y for x, y in zip(parts, changes, strict=True)])
        return out

    @cached_property
    def before(self) -> dict[Channel, Parts]:
        """The same with what the effects explain: the residual with the joint files."""
        return {
            c: [
                x + d.residual - left
                for x, d, left in zip(parts, self.dataset.of(c), self.residual[c], strict=True)
            ]
            for c, parts in self.less_variation.items()
        }


def remaining(dataset: Dataset, present: Sequence[Present], own: FloatArray) -> Remaining:
    """Return what effects leave; own: per recording [r, q]."""
    for s in (joint for run in dataset.signals for joint in run):
        set_state(s, present)
    residual = {c: [d.residual for d in dataset.of(c)] for c in dataset.runs[0].channels}
    for r, (run, data) in enumerate(zip(dataset.signals, dataset.runs, strict=True)):
        for p, s in ((p, s) for p in present for s in run if shows_at(p.joint, s.number)):
            for balance, value in contribution(p.effect, p.values, s).items():
                of = residual[Channel(s.number, balance)]
                of[r] = of[r] - binned(s.visible(value), data.samples)
    return Remaining(dataset, residual, own[list(dataset.recordings)], _quick(dataset, present))


def _quick(dataset: Dataset, present: Sequence[Present]) -> dict[Channel, Quick]:
    """Return what effects leave of channels that are judged below a frequency which is not the noise's, unfiltered."""
    every = [s for run in dataset.signals for s in run]
    step, out = max(s.step_s for s in every), dict[Channel, Quick]()
    for s in (s for s in every if s.visible.slowest_hz < s.known_motion.slowest_hz):
        samples, rated = samples_in(step, [s]), s.joint.rated_torque_nm
        mine = [contribution(p.effect, p.values, s) for p in present if shows_at(p.joint, s.number)]
        axes = {"time": s.state.time_s, "motor_angle": s.state.motor_position_rad, TORSION: s.rounded_nm}
        seen = {s.number: {name: binned(x, samples) for name, x in axes.items()}}
        for balance, known in ((MOTOR, s.motor_nm), (TORSION, s.torsion_nm)):
            if known is not None:
                channel = Channel(s.number, balance)
                runs, parts = [RunData(s.run, seen[s.number]["time"], {}, seen, samples)], list[FloatArray]()
                if channel in out:
                    runs, parts = [*out[channel][0].runs, *runs], out[channel][1]
                whole = s.known_motion(known - sum(found.get(balance, 0.0) for found in mine))
                parts.append(binned(np.where(s.usable(balance), whole, np.nan), samples))
                out[channel] = Balance(runs, channel, step, rated), parts, s.visible.slowest_hz
    return out


@dataclass(frozen=True)
class Unexplained:
    """views: of what remains, per channel that has any, each of what those before it leave; balances: of all."""

    views: Mapping[Channel, Sequence[View]]
    balances: Mapping[Channel, Balance]

    @property
    def worst_nm(self) -> dict[Channel, float]:
        """Rms of what remains in the run that has most of it, per channel [Nm]."""
        most = {c: np.max(np.sum([v.by_run for v in found], axis=0)) for c, found in self.views.items()}
        return {c: max(float(nm2), 0.0) ** 0.5 for c, nm2 in most.items()}

    def by_channel(self) -> dict[Channel, float]:
        """Return the energy that is structure, per channel [Nm^2]."""
        return {c: sum(v.energy_nm2 for v in found) for c, found in self.views.items()}

    @property
    def reasons(self) -> list[str]:
        """Lines for people, largest first."""
        every = [(v.energy_nm2, c, v) for c, found in self.views.items() for v in found]
        every.sort(key=lambda each: -each[0])
        return [
            f"joint {c.joint}, {c.balance} balance: {nm2**0.5:.3g} Nm rms that no effect of the library explains: {_name(v)}"
            for nm2, c, v in every
        ]


def _name(view: View) -> str:
    """Return a line, moments, or an axis as text."""
    if view.line is not None:
        order, hertz = view.line.order, view.line.unit == "Hz"
        return f"{order:.3g} Hz" if hertz else f"order {order:.2f} per motor revolution"
    if view.what:
        return f"{view.what}: " + ", ".join(f"{run} {t:.1f} s" for run, t in view.times[:6])
    return view.axis.replace("_", " ")


def unexplained_residual(left: Remaining) -> Unexplained:
    """Return the unexplained residual when causes and run-to-run variation are taken out."""
    balances = _balances(left.dataset, left.less_variation)
    found = {c: pursue(balances[c], x) for c, x in left.less_variation.items()}
    every = {c: x for c, x in left.quick.items() if len(x[1]) == len(left.dataset.runs)}
    for c, (fine, parts, above_hz) in every.items():
        before = [v.line for v in found[c] if v.line]
        new = [
            v
            for v in lines(fine, parts, QUICK_ORDERS)
            if v.line and (v.line.unit != "Hz" or v.line.order > above_hz)
            if not any(v.line.unit == x.unit and abs(v.line.order - x.order) < _APART for x in before)
        ]
        found[c] += new[:1]
    return Unexplained({c: views for c, views in found.items() if views}, balances)


def _balances(dataset: Dataset, residuals: Mapping[Channel, Parts]) -> dict[Channel, Balance]:
    rated = {c: dataset.joints[c.joint].rated_torque_nm for c in residuals}
    return {c: Balance(dataset.runs, c, dataset.step_s, rated[c]) for c in residuals}


def events_left(left: Remaining) -> dict[Channel, View]:
    """Return rare events where the residual of the causes has any that are large enough to matter, else nothing.

    The residual of the causes decides whether there are events. The residual that no effect of the library explains decides
    when they are: events bend the fitted causes, which then leave residuals at other moments.
    """

    def large(residuals: Mapping[Channel, Parts]) -> dict[Channel, View]:
        balances = _balances(left.dataset, residuals)
        found = {c: events(balances[c], parts) for c, parts in residuals.items()}
        return {c: e for c, e in found.items() if e and e.energy_nm2 > balances[c].least_nm2}

    found = large(left.dataset.unexplained) if large(left.less_variation) else {}
    return {c: e for c, e in found.items() if np.mean(np.concatenate(e.masks)) < _MOST_OF_THE_TIME}


def held_nm(left: Remaining) -> dict[Channel, float]:
    """Return what the rows of held channels are wrong by: rms over the run that has most of it [Nm], beyond what is usual in
    the others; at rest, where the balance is not known, against a straight line between the rows around them. Channels
    without such rows are left out.
    """
    out: dict[Channel, float] = {}
    for channel, parts in left.residual.items():
        for d, x, u in zip(left.dataset.of(channel), parts, left.own, strict=True):
            if d.held is not None and (d.held.any() or len(d.at_rest_nm)):
                rest = x - d.nuisances @ u[d.families]
                usual = float(np.mean(rest[d.valid] ** 2)) if d.valid.any() else 0.0
                excess = max(float(np.sum(rest[d.held] ** 2 - usual)), 0.0) + float(np.sum(d.at_rest_nm**2))
                count = int(np.sum(d.valid | d.held)) + len(d.at_rest_nm)
                out[channel] = max(out.get(channel, 0.0), (excess / count) ** 0.5)
    return out


def channel_gaps(left: Remaining, found: Unexplained, matters: bool) -> tuple[Gap, ...]:
    """Return the gaps of all channels: with the places of what remains, that which has most of it first, where it matters;
    else with those of the whole gap, the largest excess over the floor first.
    """
    # where the gap lives: without what each run has of its own, which would hide a small effect
    shown = left.less_variation if matters else left.before
    out = []
    for channel, balance in found.balances.items():
        x, rmse = shown[channel], _rms(_raw(left.dataset, channel))
        floor = min(_floor(left, channel), rmse)  # variation of runs that cancels is no noise
        noise = _rms(left.dataset.unexplained[channel])
        views = found.views.get(channel, ()) if matters else pursue(balance, x)
        ranked = [_places(v, x, noise, max(rmse**2 - noise**2, 1e-30)) for v in views]
        places = (*(each[0] for each in ranked), *(p for each in ranked for p in each[1:]))
        out.append(Gap(channel.joint, channel.balance, rmse, floor, places))
    if matters:  # what is not explained comes first, wherever the gap is largest
        energy = found.by_channel()
        return tuple(sorted(out, key=lambda g: -energy.get(Channel(g.joint, g.balance), 0.0)))
    return tuple(sorted(out, key=lambda g: g.noise_floor_nm**2 - g.rmse_nm**2))


def _rms(parts: Parts) -> float:
    return float(np.sqrt(np.nanmean(np.concatenate(parts) ** 2)))


def _places(view: View, parts: Parts, noise: float, excess_nm2: float) -> list[Place]:
    """Return the places of a view: moments, a line, or at most three bins of a condition."""
    size, share = float(np.sqrt(view.energy_nm2)), min(view.energy_nm2 / excess_nm2, 1.0)
    if view.line is not None:
        order, unit = view.line.order, view.line.unit
        return [Place("frequency", _name(view), share, order, order, unit, size)]
    if view.what:
        start, long = view.times[0][1], 1.0 if view.what == "seconds" else 0.1
        return [Place("time", _name(view), share, start, start + long, "s", size)]
    assert view.edges is not None
    bins = _bins(view.axis, view.edges, view.places, parts, noise)
    return [bins[k] for k in view.bins[:3]]


def _bins(axis: str, edges: FloatArray, places: Sequence[Index], parts: Parts, floor: float) -> list[Place]:
    """Return all bins of an axis with their share of its energy above the floor; rms NaN where nothing was visited."""
    place, x, unit = np.concatenate(list(places)), np.concatenate(parts), AXES[axis]
    count = np.bincount(place[np.isfinite(x)], minlength=len(edges) - 1)
    square = np.bincount(place, np.nan_to_num(x) ** 2, minlength=len(count))
    excess = np.maximum(square - floor**2 * count, 0.0)
    share = excess / max(float(excess.sum()), 1e-30)
    rms = np.sqrt(np.where(count > 0, square / np.maximum(count, 1), np.nan))
    names = [f"{a:.3g} to {b:.3g} {unit}".strip() for a, b in pairwise(edges)]
    names = list(QUADRANT_NAMES) if axis == "quadrant" else names
    return [
        Place(axis, name, float(share[k]), float(edges[k]), float(edges[k + 1]), unit, float(rms[k]))
        for k, name in enumerate(names)
    ]


def _raw(dataset: Dataset, channel: Channel) -> Parts:
    """Residual of the simulation with the joint file; torsion without each run's zero."""
    parts = dataset.shown(channel, [d.residual for d in dataset.of(channel)])
    return [x - np.nanmean(x) for x in parts] if channel.balance == TORSION else parts


def _floor(left: Remaining, channel: Channel) -> float:
    """Return the noise floor [Nm]: what no effect explains, and run-to-run variation."""
    drift = []
    for d, u in zip(left.dataset.of(channel), left.run_to_run, strict=True):
        part = (d.nuisances @ u[d.families])[d.valid]
        drift.append(part - part.mean() if channel.balance == TORSION and len(part) else part)
    square = float(np.mean(np.concatenate(drift) ** 2)) if any(map(len, drift)) else 0.0
    return float(np.hypot(_rms(left.dataset.unexplained[channel]), np.sqrt(square)))


def traces(left: Remaining) -> tuple[Trace, ...]:
    """Return measurement and residual before and after for plots, thinned, one per run and channel."""
    out = []
    for r, run in enumerate(left.dataset.runs):
        signals = {s.number: s for s in left.dataset.signals[r]}
        every = max(1, len(run.time_s) // _TRACE_POINTS)
        for c in run.channels:
            axes = run.axes[c.joint]
            measured = binned(_measured(signals[c.joint], c.balance), run.samples)
            curves = (left.before[c][r], left.less_variation[c][r], axes["velocity"], measured)
            shown = [x[::every] for x in (run.time_s, *curves)]
            out.append(Trace(run.name, c.joint, c.balance, *shown))
    return tuple(out)


def _measured(s: JointSignals, balance: str) -> FloatArray:
    """Return what a balance measures [n], Nm joint side: G Kt i of the motor, or the torque of the encoders' twist."""
    if balance == TORSION:
        return s.visible(s.sensor_nm if s.torsion_nm is None else s.torsion_nm + s.sensor_nm)
    return s.visible(s.nm_per_a * s.current_a)
