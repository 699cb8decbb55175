"""Effects that are present: their parameters, the state of the joint that follows from them, and what they leave.

Torsion and current are what a simulation with these effects has: K d = tau + contributions, and the current that the motion
and the load need. So the response of each balance (the current, the encoders' twist) has weight one and no part in a
regressor.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.corrections import with_effects_applied
from jtqd.estimator.effects.effect import MOTOR, TORSION, Effect
from jtqd.estimator.joint import Effect as EffectOfFile
from jtqd.sysid.diagnosis.dataset import Dataset
from jtqd.sysid.diagnosis.entries import Entry
from jtqd.sysid.diagnosis.findings import JointName, shows_at
from jtqd.sysid.diagnosis.regressors import LINE, RunData, binned, contribution, fields_used
from jtqd.sysid.diagnosis.signals import Channel, JointSignals
from jtqd.sysid.diagnosis.smoothing import current_rate

_MOST_STEPS: Final = 8
_DRAWS: Final = 20
_MOST_CURRENT: Final = 4.0
"""Of the largest current that the file alone draws."""
_TORSION_STEP: Final = 1e-4
"""Of the twist at the rated torque: smaller steps of the torsion are none."""
_SOFTEST: Final = 0.1
"""Of the file's stiffness: less is taken for no spring, nor is a twist as under so little of it."""
_SHARED: Final = 5.0
"""Standard deviations of the mean over runs, of days that differ as usual, beyond which all runs have it in common."""
_OF_A_DAY: Final = ("zero", "viscous", "coulomb")
"""Families that are the joint's where all runs share them; a torsion's zero is nobody's, `smooth` is what is near rest."""
Parts = list[FloatArray]
"""A residual [run][n], NaN where it is not valid."""


@dataclass(frozen=True)
class PresentEffect:
    """An effect with all its parameters by name."""

    effect: Effect
    joint: JointName
    values: Mapping[str, float]


def present_effects(found: Sequence[tuple[Entry, FloatArray]]) -> list[PresentEffect]:
    """Return entries with their scaled coefficients as effects with parameters, kinds of one effect together."""
    out: dict[tuple[object, ...], dict[str, float]] = {}
    of: dict[tuple[object, ...], Entry] = {}
    for e, scaled in found:
        at: tuple[object, ...] = (*e.key, e.slot[-1])
        values = e.values(scaled)
        nothing = e.candidate.term.combine([0.0] * e.candidate.size)
        there = out.setdefault(at, {})
        of[at] = e
        for name, value in values.items():
            if name not in there or value != nothing.get(name):
                there[name] = value
    result = []
    for place, values in out.items():
        e = of[place]
        known = {p.name: p for p in e.effect.parameters}
        for p in known.values():
            if p.default is not None and not math.isnan(p.default):
                values.setdefault(p.name, p.default)
        clipped = {
            n: v if n == "phase_rad" else float(np.clip(v, known[n].low, known[n].high))
            for n, v in values.items()
        }
        result.append(PresentEffect(e.effect, e.joint, clipped))
    return result


def set_state(s: JointSignals, present: Sequence[PresentEffect]) -> None:
    """Set torsion and current of one joint of a run to what the simulation with these effects has."""
    mine = [p for p in present if shows_at(p.joint, s.number)]
    values = tuple(
        EffectOfFile(p.effect.name, dict(p.values))
        for p in mine
        if p.joint == s.number and all(q.key for q in p.effect.parameters)
    )
    s.believed[:] = [with_effects_applied(replace(s.joint, effects=values))]
    _set_torsion(s, mine)
    scale = s.joint.gear_ratio * s.joint.torque_constant_nm_per_a
    acting = [p for p in mine if "current_a" in fields_used(p.effect, p.values, s.joint)]
    rest = s.demand_nm + _sum(s, [p for p in mine if p not in acting], MOTOR)
    s.state.current_a = rest / scale
    most = _MOST_CURRENT * float(np.max(np.abs(rest), initial=0.0)) / scale
    for _ in range(_DRAWS if acting else 0):  # damped: a constant twice as large would swing for ever
        drawn = (rest + _sum(s, acting, MOTOR)) / scale
        s.state.current_a = np.clip(0.5 * (s.state.current_a + drawn), -most, most)
    s.state.current_rate_a_s = current_rate(s.state.current_a, s.time_s)


def _set_torsion(s: JointSignals, mine: Sequence[PresentEffect]) -> None:
    bent = [p for p in mine if "torsion_rad" in p.effect.needs]
    stiffness = s.joint.stiffness_nm_per_rad
    total = s.state.torque_nm + _sum(s, [p for p in mine if p not in bent], TORSION)
    s.state.torsion_rad = total / stiffness
    if not bent:
        return
    usual = s.joint.rated_torque_nm / stiffness
    # Newton: a spring that hardens by its own stiffness is no small change, and one that softens may hold no such torque
    widest = max(usual, float(np.max(np.abs(total))) / stiffness) / _SOFTEST
    for _ in range(_MOST_STEPS):
        d = s.state.torsion_rad
        here = _sum(s, bent, TORSION)
        s.state.torsion_rad = d + _TORSION_STEP * usual
        slope = (_sum(s, bent, TORSION) - here) / (_TORSION_STEP * usual)
        step = (total + here - stiffness * d) / np.maximum(stiffness - slope, _SOFTEST * stiffness)
        s.state.torsion_rad = np.clip(d + step, -widest, widest)
        if float(np.max(np.abs(step))) < _TORSION_STEP * usual:
            return


def _sum(s: JointSignals, present: Sequence[PresentEffect], balance: str) -> FloatArray | float:
    """Return what these effects contribute to a balance [n], Nm."""
    return sum((contribution(p.effect, p.values, s).get(balance, 0.0) for p in present), 0.0)


def contributions(dataset: Dataset, present: PresentEffect) -> list[dict[Channel, FloatArray]]:
    """Return what an effect contributes to each channel, per run, binned [n], Nm."""
    out = []
    for run, data in zip(dataset.signals, dataset.runs, strict=True):
        found = {}
        for s in run:
            if shows_at(present.joint, s.number):
                for balance, value in contribution(present.effect, present.values, s).items():
                    found[Channel(s.number, balance)] = binned(s.seen(balance, value), data.samples)
        out.append(found)
    return out


@dataclass(frozen=True)
class Remaining:
    """What effects leave: binned runs whose residual is that; nuisances: what each run has of its own [r, q]; pieces: number
    of the recording that each run is of.
    """

    present: tuple[PresentEffect, ...]
    runs: tuple[RunData, ...]
    nuisances: FloatArray
    pieces: Sequence[int]


def remaining(dataset: Dataset, present: Sequence[PresentEffect], nuisances: FloatArray) -> Remaining:
    """Return what effects leave; nuisances: per recording [r, q]."""
    for s in (joint for run in dataset.signals for joint in run):
        set_state(s, present)
    left = [{c: d.residual.copy() for c, d in run.channels.items()} for run in dataset.runs]
    for p in present:
        for rest, found in zip(left, contributions(dataset, p), strict=True):
            for channel, value in found.items():
                rest[channel] -= value
    runs = [
        replace(run, channels={c: replace(d, residual=rest[c]) for c, d in run.channels.items()})
        for run, rest in zip(dataset.runs, left, strict=True)
    ]
    pieces = dataset.recordings
    return Remaining(tuple(present), tuple(runs), nuisances[list(pieces)], pieces)


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
    shared[np.abs(shared) < _SHARED * sigma / np.sqrt(len(runs))] = 0.0
    return np.asarray(changes - shared)


def less_nuisances(dataset: Dataset, refined: Remaining) -> dict[Channel, Parts]:
    """Return what the causes leave, less the runs' own changes but not less strange lines, events with it."""
    out: dict[Channel, Parts] = {}
    for r, (run, u) in enumerate(zip(refined.runs, own_changes(dataset, refined), strict=True)):
        for channel, d in run.channels.items():
            rest = d.residual - d.nuisances @ u[d.families]
            out.setdefault(channel, []).append(np.where(dataset.valid_or_event(r, channel), rest, np.nan))
    return out


def residual_after(dataset: Dataset, refined: Remaining) -> dict[Channel, Parts]:
    """Return what the causes leave, less what each run has of its own where that makes it smaller: of few seconds
    its estimate under a prior need not.
    """
    out = less_nuisances(dataset, refined)
    for channel, parts in out.items():
        for r, run in enumerate(refined.runs):
            plain = np.where(dataset.valid_or_event(r, channel), run.channels[channel].residual, np.nan)
            parts[r] = min(parts[r], plain, key=lambda x: float(np.nansum(x**2)))
    return out


def residual_before(dataset: Dataset, refined: Remaining) -> dict[Channel, Parts]:
    """Return the same with what the causes explain: the residual with the joint files."""
    both = list(zip(dataset.runs, refined.runs, strict=True))
    return {
        c: [
            x + run.channels[c].residual - left.channels[c].residual
            for x, (run, left) in zip(after, both, strict=True)
        ]
        for c, after in residual_after(dataset, refined).items()
    }
