"""The causes: each accepted effect with its values and intervals, its evidence, and what it cannot be distinguished from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from jtqd.estimator.effects.effect import Effect
from jtqd.sysid.diagnosis.case import Case, Fit
from jtqd.sysid.diagnosis.current_zero import offset_at_rest, rest_current
from jtqd.sysid.diagnosis.findings import Cause, Value, joint_text
from jtqd.sysid.diagnosis.gain import left_out_steps
from jtqd.sysid.diagnosis.guards import nothing_of
from jtqd.sysid.diagnosis.mixed_model import ENOUGH_RUNS
from jtqd.sysid.diagnosis.refine import parameter, places
from jtqd.sysid.diagnosis.regressors import EffectCandidate
from jtqd.sysid.diagnosis.stability import stability
from jtqd.sysid.fit.plateaus import student_975

_INACCURATE: Final = 0.015
"""Half width of the 95 % interval, as part of an effect's size, for what the equations here simplify: no interval is
narrower. Judged by its coverage of known truths (docs/diagnosis.md).
"""
_INACCURATE_RATE: Final = 0.04
"""The same of what is known by a derivative of measured angles or torques, smoothed as it is."""
_INACCURATE_TWIST: Final = 0.05
"""The same of what the teeth or the torsion do within a few tens of microradians, where encoders round."""
_OFFSET, _ASYMMETRY = "current_offset", "friction_asymmetry"

Classes = Sequence[tuple[EffectCandidate, ...]]
"""Per effect of a fit the alternatives that the runs do not rule out."""


def causes_of(case: Case, fit: Fit, classes: Classes, total_nm2: float) -> list[Cause]:
    """Return the causes; total_nm2: energy of all structure, of which each explains its share."""
    steady = stability(fit.refined, case.noise, nothing_of(fit.hypothesis))
    causes = []
    for k, (candidate, rms) in enumerate(zip(fit.chosen, case.rms_nm(fit), strict=True)):
        without = case.search.without(fit.hypothesis, candidate)
        evidence = max(without.model.deviance - fit.hypothesis.model.deviance, 1e-9)
        channel = max(rms, key=lambda c: rms[c])
        causes.append(
            Cause(
                candidate.effect.name,
                candidate.joint,
                _names(candidate, classes[k]),
                _normal_phase(values_of(fit, k)),
                without.bic - fit.hypothesis.bic,
                case.search.held_out(fit.hypothesis, candidate) / evidence,
                rms[channel],
                channel.balance,
                explained_share=sum(r * r for r in rms.values()) / total_nm2,
                stability=steady[k].ratio,
            )
        )
    return causes


def _names(candidate: EffectCandidate, rivals: Sequence[EffectCandidate]) -> tuple[str, ...]:
    """Return the names of a class; a rival of another joint with that joint."""
    names = [
        r.effect.name + (f" of {joint_text(r.joint)}" if r.joint != candidate.joint else "") for r in rivals
    ]
    return tuple(dict.fromkeys([candidate.effect.name, *names]))


def values_of(fit: Fit, k: int) -> dict[str, Value]:
    """Return the parameters of an effect with their 95 % intervals: Student's t by how much of the uncertainty is the runs'
    own changes. They are no narrower than `inaccurate`, with few runs no narrower than what leaving out a run changes.
    """
    candidate, refined = fit.chosen[k], fit.refined
    present, runs = refined.present[k], refined.mixed.runs
    first = places(refined.present)[k].start
    nothing = _of_nothing(candidate)
    values: dict[str, Value] = {}
    for name, value in present.values.items():
        p = parameter(present.effect, name)
        if name in present.free:
            place = first + present.free.index(name)
            share = float(refined.random_share[place])
            freedom = min((runs - 1.0) / max(share, 1e-3) ** 2, 1e4)
            half = student_975(freedom) * float(np.sqrt(refined.covariance[place, place]))
            # a phase has no size of its own: an angle of the same part of the wave
            size = 1.0 if name == "phase_rad" else abs(value - nothing.get(name, 0.0))
            half = float(np.hypot(half, inaccurate(present.effect) * size))
            if runs < ENOUGH_RUNS:
                half = max(half, *(abs(float(step[place])) for step in left_out_steps(refined)))
            low, high = value - half, value + half
            if name != "phase_rad":  # nothing is known beyond what the library thinks possible
                low, high = max(low, p.low), min(high, p.high)
            values[name] = Value(value, (low, high), p.unit)
        elif p.fixed:
            values[name] = Value(value, (value, value), p.unit)
    return values


def inaccurate(effect: Effect) -> float:
    """Return the least half width of a 95 % interval, as part of the effect's size."""
    if effect.follows_torsion or effect.geometric:
        return _INACCURATE_TWIST
    return _INACCURATE_RATE if effect.rate_based else _INACCURATE


def _of_nothing(candidate: EffectCandidate) -> dict[str, float]:
    """Return the parameters of the effect where it has no size; not those that no coefficient changes, as the travel of a
    hysteresis: what the search took for it is a place on a grid, and its size is all of it.
    """
    none, some = (candidate.term.combine([size] * candidate.size) for size in (0.0, 1.0))
    return {name: value for name, value in none.items() if some[name] != value}


def _normal_phase(values: Mapping[str, Value]) -> dict[str, Value]:
    """Return the parameters with phases in (-pi, pi] and no negative amplitude."""
    out = dict(values)
    phase = out.get("phase_rad")
    if phase is None:
        return out
    turn = 0.0
    for name in ("amplitude_nm", "amplitude_rad", "moment_nm"):
        v = out.get(name)
        if v is not None and v.value < 0.0:
            out[name] = Value(-v.value, (-v.ci95[1], -v.ci95[0]), v.unit)
            turn = np.pi
    value = phase.value + turn
    shift = value - float(np.angle(np.exp(1j * value)))
    low, high = phase.ci95
    out["phase_rad"] = Value(value - shift, (low + turn - shift, high + turn - shift), phase.unit)
    return out


def separated_at_rest(case: Case, fit: Fit, classes: Classes) -> tuple[Fit, Classes]:
    """Return fit and classes without friction asymmetry where the current at rest shows that it is an offset
    (`current_zero`).
    """
    for k, cause in enumerate(fit.chosen):
        twins = [c for c in classes[k] if {c.effect.name, cause.effect.name} == {_OFFSET, _ASYMMETRY}]
        twin = next((c for c in twins if c.joint == cause.joint), None)
        if twin is None or not isinstance(cause.joint, int):
            continue
        offset = cause if cause.effect.name == _OFFSET else twin
        others = [c for c in fit.chosen if c is not cause]
        as_offset = case.search.hypothesis((*others, offset), fit.hypothesis.model)
        size = offset.term.combine(as_offset.coefficients(offset))["offset_a"]
        if not offset_at_rest(rest_current(case.dataset.signals, cause.joint), size):
            continue
        rest = tuple(c for c in classes[k] if c is not twin)
        if cause is not offset:
            of = {c.first: rivals for c, rivals in zip(fit.chosen, classes, strict=True)}
            of[offset.first] = rest
            return case.fit(as_offset), [of[c.first] for c in as_offset.chosen]
        classes = [*classes[:k], rest, *classes[k + 1 :]]
    return fit, classes
