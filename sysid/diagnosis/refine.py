"""Parameters of the causes with intervals: Gauss-Newton on the mixed model, all causes and all runs at once.

The search is linear in its columns and takes velocities, travels and reference temperatures from grids. Here every free
parameter of every cause moves: the residual is computed at the present parameters, its derivatives by finite differences of
the effects, and the mixed model is solved for the step.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.effects.effect import MOTOR, TORSION, Effect, Parameter
from jtqd.estimator.joint import Joint
from jtqd.sysid.diagnosis.current_zero import UnpoweredColumn, unpowered, with_readings
from jtqd.sysid.diagnosis.dataset import Dataset
from jtqd.sysid.diagnosis.findings import JointName, shows_at
from jtqd.sysid.diagnosis.mixed_model import Mixed, Model
from jtqd.sysid.diagnosis.noise import Noise, run_sums
from jtqd.sysid.diagnosis.regressors import ChannelData, RunData, binned, contribution
from jtqd.sysid.diagnosis.search import Hypothesis
from jtqd.sysid.diagnosis.signals import Channel, JointSignals

_STEPS: Final = 6
_MOST_STEPS: Final = 24
_SETTLED: Final = 0.02
"""Of a parameter's standard deviation: smaller steps are none. At least _STEPS are made, at most _MOST_STEPS."""
_AS_GOOD: Final = 1.0
"""Of the deviance: the last parameters are taken that leave no more than this beyond the least."""
_MOST_TORSION_STEPS: Final = 8
_TORSION_STEP: Final = 1e-4
"""Of the twist at the rated torque: smaller steps of the torsion are none."""
_SOFTEST: Final = 0.1
"""Of the file's stiffness: less is taken for no spring, nor is a twist as under so little of it."""
_LARGEST_STEP: Final = 0.5
"""Of a parameter's own size or a tenth of its plausible range, whichever is more."""


@dataclass(frozen=True)
class PresentEffect:
    """An effect that is there: parameters by name and which of them are free."""

    effect: Effect
    joint: JointName
    values: Mapping[str, float]
    free: tuple[str, ...]

    def moved(self, step: Sequence[float]) -> PresentEffect:
        """Return it with its free parameters changed."""
        new = dict(self.values)
        for name, d in zip(self.free, step, strict=True):
            p = parameter(self.effect, name)
            size = max(abs(new[name]), 0.1 * (p.high - p.low) if np.isfinite(p.high - p.low) else 1.0)
            change = float(np.clip(d, -_LARGEST_STEP * size, _LARGEST_STEP * size))
            value = new[name] + change
            new[name] = value if name == "phase_rad" else float(np.clip(value, p.low, p.high))
        return replace(self, values=new)


@dataclass(frozen=True)
class Refined:
    """Causes at their best parameters, covariance of all free ones in order, the mixed model's sums (columns: free
    parameters; last: residual at these parameters), binned runs whose residual is what is left and whose regressors are
    the derivatives.
    """

    present: tuple[PresentEffect, ...]
    covariance: FloatArray
    random_share: FloatArray
    mixed: Mixed
    variances: FloatArray
    nuisances: FloatArray
    runs: tuple[RunData, ...]


def parameter(effect: Effect, name: str) -> Parameter:
    """Return the parameter of this name."""
    return next(p for p in effect.parameters if p.name == name)


def places(present: Sequence[PresentEffect]) -> list[slice]:
    """Return where the free parameters of each cause are among those of all."""
    ends = list(accumulate(len(p.free) for p in present))
    return [slice(end - len(p.free), end) for p, end in zip(present, ends, strict=True)]


def free_names(effect: Effect, values: Mapping[str, float]) -> tuple[str, ...]:
    """Return the parameters that a fit may move: not the fixed ones, and not those of a kind that is switched off (at
    its default of zero, as the temperature part of a drift in time).
    """
    return tuple(
        p.name
        for p in effect.parameters
        if not p.fixed
        and p.name in values
        and not (
            p.default is not None and not p.key and values[p.name] == p.default and p.default in (0.0, 25.0)
        )
    )


@dataclass(frozen=True)
class _Iterate:
    """Causes at some parameters: what is left there, and the step from there; left: the deviance that they leave."""

    present: tuple[PresentEffect, ...]
    mixed: Mixed
    model: Model
    data: list[RunData]
    left: float


def refine(dataset: Dataset, present: Sequence[PresentEffect], noise: Noise) -> Refined:
    """Return the refined causes of the dataset runs (their residuals are those at the joint files' values).

    Where steps do not come to rest, the parameters that left the least are taken, not the last ones.
    """
    iterate = best = _linearised(dataset, present, noise)
    least = iterate.left
    for step in range(1, _MOST_STEPS + 1):
        if not present:
            break
        now, settled = _stepped(iterate)
        iterate = _linearised(dataset, now, noise)
        least = min(least, iterate.left)
        if iterate.left <= least + _AS_GOOD:
            best = iterate
        if step >= _STEPS and settled:
            break
    model = best.model
    set_torsions(dataset, best.present)
    certain = best.mixed.marginal(np.full_like(model.variances, 1e-12))[0]
    count = len(model.columns)
    share = np.zeros(count)
    if count:
        tight = np.diag(np.linalg.pinv(certain[:count, :count], hermitian=True))
        share = np.clip(1.0 - tight / np.maximum(np.diag(model.covariance), 1e-300), 0.0, 1.0)
    return Refined(
        best.present,
        model.covariance,
        share,
        best.mixed,
        model.variances,
        model.nuisances,
        tuple(best.data),
    )


def _linearised(dataset: Dataset, present: Sequence[PresentEffect], noise: Noise) -> _Iterate:
    signals, runs, samples, groups = dataset.signals, dataset.runs, dataset.samples, dataset.families
    set_torsions(dataset, present)
    data = [_run_at(s, run, present, samples) for s, run in zip(signals, runs, strict=True)]
    count = sum(len(p.free) for p in present)
    sums = [run_sums(d, noise, count, len(groups)) for d in data]
    sums = with_readings(sums, dataset.readings, _unpowered(present, dataset.joints))
    mixed = Mixed(sums, count, np.array([g.sigma for g in groups]), dataset.pieces)
    return _Iterate(tuple(present), mixed, mixed.fit(range(count)), data, mixed.fit(()).deviance)


def _stepped(iterate: _Iterate) -> tuple[list[PresentEffect], bool]:
    """Return the causes one step further, and whether that step was none."""
    now, settled = [], True
    for p, mine in zip(iterate.present, places(iterate.present), strict=True):
        moved = p.moved([float(b) for b in iterate.model.beta[mine]])
        deviation = np.sqrt(np.maximum(np.diag(iterate.model.covariance)[mine], 0.0))
        change = np.array([moved.values[name] - p.values[name] for name in p.free])
        settled = settled and bool(np.all(np.abs(change) <= _SETTLED * deviation))
        now.append(moved)
    return now, settled


def set_torsions(dataset: Dataset, present: Sequence[PresentEffect]) -> None:
    """Set the torsion that effects see in all runs to what it is with these causes (`set_torsion`)."""
    for s in (joint for run in dataset.signals for joint in run):
        set_torsion(s, present)


def set_torsion(s: JointSignals, present: Sequence[PresentEffect]) -> None:
    """Set the torsion that effects see to what it is: that of the encoders for what follows it with memory or play, else
    what the spring does with the causes, K d = tau + their contributions.
    """
    mine = [p for p in present if shows_at(p.joint, s.number)]
    if s.twist_rad is not None and any(p.effect.follows_torsion for p in mine):
        s.state.torsion_rad = s.twist_rad
        return
    bent = [p for p in mine if "torsion_rad" in p.effect.needs]
    stiffness = s.joint.stiffness_nm_per_rad
    total = s.state.torque_nm + _torsion_sum(s, [p for p in mine if p not in bent])
    s.state.torsion_rad = total / stiffness
    if not bent:
        return
    usual = s.joint.rated_torque_nm / stiffness
    # Newton: a spring that hardens by its own stiffness is no small change, and one that softens may hold no such torque
    widest = max(usual, float(np.max(np.abs(total))) / stiffness) / _SOFTEST
    for _ in range(_MOST_TORSION_STEPS):
        d = s.state.torsion_rad
        here = _torsion_sum(s, bent)
        s.state.torsion_rad = d + _TORSION_STEP * usual
        slope = (_torsion_sum(s, bent) - here) / (_TORSION_STEP * usual)
        step = (total + here - stiffness * d) / np.maximum(stiffness - slope, _SOFTEST * stiffness)
        s.state.torsion_rad = np.clip(d + step, -widest, widest)
        if float(np.max(np.abs(step))) < _TORSION_STEP * usual:
            return


def _torsion_sum(s: JointSignals, present: Sequence[PresentEffect]) -> FloatArray | float:
    """Return what these causes contribute to the torsion balance [n], Nm."""
    return sum((_contribution(p, s, p.values).get(TORSION, 0.0) for p in present), 0.0)


def _run_at(
    run: Sequence[JointSignals], base: RunData, present: Sequence[PresentEffect], samples: int
) -> RunData:
    """Return the run with what is left at these parameters, and derivatives by each free one, as regressors."""
    left = {c: d.residual.copy() for c, d in base.channels.items()}
    columns: dict[Channel, list[tuple[int, FloatArray]]] = {c: [] for c in base.channels}
    made: dict[Channel, list[tuple[int | None, FloatArray]]] = {c: [] for c in base.channels}
    for p, mine in zip(present, places(present), strict=True):
        for s in run:
            if not shows_at(p.joint, s.number):
                continue
            here = _contribution(p, s, p.values)
            for balance in (MOTOR, TORSION):
                channel = Channel(s.number, balance)
                if channel in left and balance in here:
                    made[channel].append((None, here[balance]))
            for place, name in enumerate(p.free, mine.start):
                size = _step_size(p, name)
                there = _contribution(p, s, {**p.values, name: p.values[name] + size})
                for balance, value in there.items():
                    made[Channel(s.number, balance)].append((place, (value - here[balance]) / size))
    of = {s.number: s for s in run}
    for channel, parts in made.items():
        seen = of[channel.joint].seen_each(channel.balance, [value for _, value in parts])
        for (column, _), value in zip(parts, seen, strict=True):
            if column is None:
                left[channel] = left[channel] - binned(value, samples)
            else:
                columns[channel].append((column, binned(value, samples)))
    channels = {}
    for c, d in base.channels.items():
        found = columns[c]
        index = np.array([k for k, _ in found], np.intp)
        x = np.column_stack([v for _, v in found]) if found else np.empty((len(d.valid), 0))
        channels[c] = ChannelData(d.valid, left[c], x, index, d.nuisances, d.families)
    return RunData(base.name, base.time_s, channels, base.axes)


def contributions(dataset: Dataset, present: PresentEffect) -> dict[Channel, list[FloatArray]]:
    """Return what one cause contributes to each channel, over the valid bins of each run [run][n], Nm; a constant in torsion
    is none.
    """
    out: dict[Channel, list[FloatArray]] = {}
    for run, data in zip(dataset.signals, dataset.runs, strict=True):
        for s in run:
            if not shows_at(present.joint, s.number):
                continue
            for balance, value in contribution(present.effect, present.values, s).items():
                channel = Channel(s.number, balance)
                part = binned(s.seen(balance, value), dataset.samples)[data.channels[channel].valid]
                if balance == TORSION and len(part):
                    part = part - part.mean()
                out.setdefault(channel, []).append(part)
    return out


def _unpowered(present: Sequence[PresentEffect], joints: Mapping[int, Joint]) -> list[UnpoweredColumn]:
    """Return what the causes read without power: the derivatives by the free parameters, and off the residual."""
    out: list[UnpoweredColumn] = []
    for p, mine in zip(present, places(present), strict=True):
        if "current_a" in p.effect.hooks and isinstance(p.joint, int):
            here = unpowered(p.effect, p.values, joints[p.joint])
            out.append((p.joint, -1, -here))
            for place, name in enumerate(p.free, mine.start):
                size = _step_size(p, name)
                there = unpowered(p.effect, {**p.values, name: p.values[name] + size}, joints[p.joint])
                out.append((p.joint, place, (there - here) / size))
    return out


def _contribution(p: PresentEffect, s: JointSignals, values: Mapping[str, float]) -> dict[str, FloatArray]:
    return contribution(p.effect, values, s)


def _step_size(p: PresentEffect, name: str) -> float:
    q = parameter(p.effect, name)
    if name == "phase_rad":
        return 1e-4
    width = q.high - q.low if np.isfinite(q.high - q.low) else 1.0
    return max(1e-4 * abs(p.values[name]), 1e-6 * width)


def present_effects(best: Hypothesis) -> list[PresentEffect]:
    """Return the chosen candidates as effects with parameters, none beyond the end of its range: a set that others left
    behind may combine to a rate of no friction at all (infinite).
    """
    out = []
    for c in best.chosen:
        values = dict(c.term.combine(best.coefficients(c)))
        for p in c.effect.parameters:
            if p.default is not None and not math.isnan(p.default):
                values.setdefault(p.name, p.default)
        free = free_names(c.effect, values)
        out.append(PresentEffect(c.effect, c.joint, values, free).moved([0.0] * len(free)))
    return out
