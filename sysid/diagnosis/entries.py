"""Entries: everything that may be wrong, one value or effect each, with its prior; the effects that a set of them makes.

An entry is a term of an effect of the library (`regressors.EffectCandidate`) whose columns are scaled by its prior's size,
so that every coefficient is N(0, 1) where the entry is in a set.

Effects that are present decide torsion and current: what a simulation with them has, K d = tau + contributions, and the
current that the motion and the load need. So the response of each balance (the current, the encoders' twist) has weight one
and no part in a regressor.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from types import MappingProxyType
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.corrections import with_effects_applied
from jtqd.estimator.effects.effect import MOTOR, SPAN_K, TORSION, ArrayFunctions, Effect, Term
from jtqd.estimator.joint import Effect as EffectOfFile
from jtqd.estimator.joint import Joint
from jtqd.sysid.diagnosis import limits
from jtqd.sysid.diagnosis.findings import JointName, Present, shows_at
from jtqd.sysid.diagnosis.limits import Prior, Usage
from jtqd.sysid.diagnosis.regressors import EffectCandidate, contribution, fields_used, relative_to
from jtqd.sysid.diagnosis.signals import SLOPE, JointSignals, held_by_spring
from jtqd.sysid.diagnosis.smoothing import first_difference

_MOST_STEPS: Final = 8
_DRAWS: Final = 20
_MOST_CURRENT: Final = 4.0
"""Of the largest current that the file alone draws."""
_NO_STEP: Final = 1e-6  # of that: smaller steps of the current are none
_SLOPES: Final = -4.0, -0.5  # of what is lacking over the current: -1 where effects see no current
_TORSION_STEP: Final = 1e-4  # of the twist at the rated torque: smaller steps of the torsion are none
_SOFTEST: Final = 0.1
"""Of the file's stiffness: less is taken for no spring, nor is a twist as under so little of it."""
_KINDS: Final = ("order_per_motor_rev", "channel", "motor_side")
"""Parameters of which several values may be present at once."""


@dataclass(frozen=True, eq=False)
class Entry:
    """One value or effect.

    candidate: its term, with the numbers of its columns in the library; weights [columns, m]: of its scaled coefficients;
    tangents: further columns, one per shape in `shapes`, of a change by its prior's deviation; prior; odds: log prior odds
    of being in a set; slot: at most one entry of a slot is in a set; low, high: bounds of a single coefficient.
    """

    candidate: EffectCandidate
    kind: str
    prior: Prior
    weights: FloatArray = field(repr=False)
    odds: float
    slot: tuple[object, ...]
    low: float = -math.inf
    high: float = math.inf
    shapes: tuple[str, ...] = ()
    tangents: tuple[int, ...] = ()
    amplitude: tuple[float, ...] = ()

    @property
    def effect(self) -> Effect:
        """The effect of the library."""
        return self.candidate.effect

    @property
    def joint(self) -> JointName:
        """Joint, or the sensor."""
        return self.candidate.joint

    @property
    def key(self) -> tuple[str, JointName]:
        """Effect and joint, whatever the term."""
        return self.candidate.key

    @property
    def columns(self) -> tuple[int, ...]:
        """Numbers of its columns in the library, tangents last."""
        return (*self.candidate.columns, *self.tangents)

    @property
    def size(self) -> int:
        """Number of scaled coefficients, tangents included."""
        return int(self.weights.shape[1])

    def coefficients(self, scaled: FloatArray) -> FloatArray:
        """Return the coefficients of the term's own columns of scaled ones."""
        return np.asarray((self.weights @ scaled)[: self.candidate.size])

    def values(self, scaled: FloatArray) -> dict[str, float]:
        """Return the parameters at scaled coefficients; a shape moves by its tangent, at most by half of itself."""
        values: dict[str, float] = dict(self.candidate.term.combine(self.coefficients(scaled)))
        own = self.candidate.term.basis[0]
        for name, c in zip(self.shapes, scaled[self.size - len(self.shapes) :], strict=True):
            values[name] = own[name] * (1.0 + float(np.clip(limits.SHAPE * c, -0.4, 0.6)))
        return values


def kind_of(c: EffectCandidate) -> str:
    """Return the name of the prior of a term's size: of a code that is set, of its leading parameter, else of the effect."""
    p, lead = c.term.basis[0], lead_of(c)
    named = {q.name: q.prior for q in c.effect.parameters if q.prior}
    codes = (q.prior for q in c.effect.parameters if q.fixed and q.prior and p.get(q.name))
    return next(codes, named.get(lead) or c.effect.name)


def shapes_of(effect: Effect, term: Term) -> tuple[str, ...]:
    """Return the parameters of a term that no coefficient changes and a fit may move: a travel, a Stribeck speed."""
    some, more = (term.combine([size] * len(term.basis)) for size in (1.0, 2.0))
    return tuple(
        p.name
        for p in effect.parameters
        if not (
            p.fixed
            or p.key == p.name
            or (p.unit in ("rad", "°C") and p.name.startswith(("phase", "reference")))
        )
        and p.name in some
        and some[p.name] == more[p.name] != 0.0
    )


def entries_of(
    candidates: Sequence[EffectCandidate],
    signals: Sequence[Sequence[JointSignals]],
    trust: Mapping[str, float] = MappingProxyType({}),
) -> list[Entry]:
    """Return the entries of all candidates that these runs can show; trust: factors of priors by their name in limits."""
    joints = {s.number: s.joint for s in signals[0]}
    use = {n: usage([s for run in signals for s in run if s.number == n]) for n in joints}
    terms = Counter(c.key for c in candidates)
    places = [c.joint if isinstance(c.joint, int) else min(joints) for c in candidates]
    found = [
        entry_of(c, joints[n], use[n], terms[c.key], trust) for c, n in zip(candidates, places, strict=True)
    ]
    return [entry for entry in found if entry is not None]


def usage(signals: Sequence[JointSignals]) -> Usage:
    """Return what the runs of one joint are like."""
    speed = math.sqrt(float(np.mean(np.concatenate([s.state.velocity_rad_s**2 for s in signals]))))
    warm = np.concatenate([s.state.temperature_c for s in signals])
    warm = warm[np.isfinite(warm)]
    slow = np.concatenate([s.highest_order()[s.usable(MOTOR)] for s in signals])
    order = float(np.quantile(slow, 1.0 - limits.SEEN)) if len(slow) else math.inf
    return Usage(speed, float(np.ptp(warm)) if len(warm) else 0.0, order)


_WARMS_K: Final = 1.0


def entry_of(
    c: EffectCandidate, joint: Joint, use: Usage, terms: int, trust: Mapping[str, float]
) -> Entry | None:
    """Return the entry of a candidate, None where it is one of another's or its condition does not vary."""
    effect, p = c.effect, c.term.basis[0]
    kind = kind_of(c)
    prior = limits.PRIORS.get(kind, limits.OTHER)
    nothing = c.nothing
    lead = lead_of(c)
    if _sizes(c) > 1:
        return None
    if use.warming_k < _WARMS_K and "temperature_c" in fields_used(effect, p, joint):
        return None
    if p.get("order_per_motor_rev", 0.0) > use.order:
        return None
    referred = "reference_c" in p and c.size == 2
    step = p[lead] if referred or (c.size > 1 and "phase_rad" in p) else p[lead] - nothing[lead]
    weights, part = np.eye(c.size), limits.REFERENCE_K / SPAN_K
    if referred:
        weights = np.array([[1.0, -part], [0.0, part]])
    weights = weights * (trust.get(kind, 1.0) * prior.size(joint, use) / step)
    chance = limits.P_FILE if prior.file else limits.P_EFFECT / terms
    detail = tuple((k, p[k]) for k in _KINDS if k in p)
    low, high = -math.inf, math.inf
    if c.size == 1:
        q, per_scaled = next(x for x in effect.parameters if x.name == lead), step * weights[0, 0]
        low, high = sorted((end - nothing[lead]) / per_scaled for end in (q.low, q.high))
        if nothing[lead] and (effect.scales_balance or effect.scales_all):
            around = sorted((f - 1.0) * nothing[lead] / per_scaled for f in limits.SCALES)
            low, high = max(low, around[0]), min(high, around[1])
    odds = math.log(chance / (1.0 - chance))
    return Entry(c, kind, prior, weights, odds, (kind, c.joint, detail), low, high)


def slices_of(entries: Iterable[Entry]) -> list[slice]:
    """Return where the coefficients of each entry are among those of all."""
    ends = np.cumsum([0, *(e.size for e in entries)]).tolist()
    return [slice(a, b) for a, b in pairwise(ends)]


def transform_of(entries: Sequence[Entry], columns: int) -> FloatArray:
    """Return the weights of scaled coefficients of entries in the library's columns [P, E]."""
    out = np.zeros((columns, sum(e.size for e in entries)))
    for e, at in zip(entries, slices_of(entries), strict=True):
        out[list(e.columns), at] = e.weights
    return out


def _sizes(c: EffectCandidate) -> int:
    """Return how many of the parameters that a term changes are sizes, no phase or reference; always alike they are one."""
    sizes = {q.name for q in c.effect.parameters if q.neutral is not None and not q.fixed}
    each = [c.term.combine(one) for one in np.eye(c.size).tolist()]
    changed = sizes & {n for values in each for n, v in values.items() if v != c.nothing[n]}
    return len({tuple(values[n] for values in each) for n in changed})


def lead_of(c: EffectCandidate) -> str:
    """Return the name of the parameter that carries the size of a candidate."""
    one = c.term.combine([1.0] * c.size)
    two = c.term.combine([2.0] * c.size)
    return str(next(name for name in one if one[name] != two[name] and name != "phase_rad"))


def present_effects(found: Sequence[tuple[Entry, FloatArray]]) -> list[Present]:
    """Return entries with their scaled coefficients as effects with parameters, kinds of one effect together."""
    out: dict[tuple[object, ...], tuple[Entry, dict[str, float]]] = {}
    for e, scaled in found:
        nothing = e.candidate.nothing
        _, there = out.setdefault((*e.key, e.slot[-1]), (e, {}))
        for name, value in e.values(scaled).items():
            if name not in there or value != nothing.get(name):
                there[name] = value
    result = []
    for e, values in out.values():
        known = {p.name: p for p in e.effect.parameters}
        for p in known.values():
            if p.default is not None and not math.isnan(p.default):
                values.setdefault(p.name, p.default)
        clipped = {
            n: v if n == "phase_rad" else float(np.clip(v, known[n].low, known[n].high))
            for n, v in values.items()
        }
        result.append(Present(e.effect.name, e.joint, clipped))
    return result


def set_state(s: JointSignals, present: Sequence[Present]) -> None:
    """Set torsion and current of one joint of a run to what the simulation with these effects has."""
    mine = [p for p in present if shows_at(p.joint, s.number)]
    values = tuple(
        EffectOfFile(p.effect.name, dict(p.values))
        for p in mine
        if p.joint == s.number and all(q.key for q in p.effect.parameters)
    )
    s.believed.joint = with_effects_applied(replace(s.joint, effects=values))
    s.believed.loss_per_torque = _loss_per_torque(s, mine)
    _set_torsion(s, mine)
    reads = [p for p in mine if "current_a" in p.effect.hooks]  # more or later than what drives the motor
    mine = [p for p in mine if p not in reads]
    acting = [p for p in mine if "current_a" in fields_used(p.effect, p.values, s.joint)]
    rest = s.demand_nm + _sum(s, [p for p in mine if p not in acting], MOTOR)
    s.state.current_a = rest / s.nm_per_a
    most = _MOST_CURRENT * float(np.max(np.abs(rest), initial=0.0)) / s.nm_per_a
    # secants: what is drawn falls or rises with the current of its own moment
    before, lack = s.state.current_a, np.zeros(len(s.time_s))
    for _ in range(_DRAWS if acting else 0):
        last, lack = lack, (rest + _sum(s, acting, MOTOR)) / s.nm_per_a - s.state.current_a
        moved = s.state.current_a - before
        there = np.abs(moved) > _NO_STEP * most
        slope = np.divide(lack - last, moved, out=-np.ones(len(moved)), where=there)
        before = s.state.current_a
        s.state.current_a = np.clip(before - lack / np.clip(slope, *_SLOPES), -most, most)
        if float(np.max(np.abs(lack))) < _NO_STEP * most:
            break
    s.state.current_rate_a_s = first_difference(s.state.current_a, s.time_s)
    more_a = _sum(s, reads, MOTOR) / s.nm_per_a
    s.state.current_rate_a_s = first_difference(s.state.current_a + more_a, s.time_s)  # of the reading


def _loss_per_torque(s: JointSignals, mine: Sequence[Present]) -> FloatArray | float:
    """Return d loss / d torque of these effects [n], over +-SLOPE of the rated torque."""
    losing = [
        p
        for p in mine
        if "loss_nm" in p.effect.hooks and "torque_nm" in fields_used(p.effect, p.values, s.joint)
    ]
    torque, wide = s.state.torque_nm, SLOPE * s.joint.rated_torque_nm
    s.state.torque_nm = torque + wide
    ahead = _sum(s, losing, MOTOR)
    s.state.torque_nm = torque - wide
    behind = _sum(s, losing, MOTOR)
    s.state.torque_nm = torque
    return (ahead - behind) / (2.0 * wide)


def _set_torsion(s: JointSignals, mine: Sequence[Present]) -> None:
    """Set the twist of the spring: what is an angle of its own, whatever the spring, is between the encoders beside it."""
    angles = {"twist_rad", "link_rad"}
    loading = [
        p
        for p in mine
        if not angles & set(p.effect.hooks) or "joint" in fields_used(p.effect, p.values, s.joint)
    ]
    bent = [p for p in loading if "torsion_rad" in p.effect.needs]
    stiffness = s.joint.stiffness_nm_per_rad
    total = s.state.torque_nm + _sum(s, [p for p in loading if p not in bent], TORSION)
    total = held_by_spring(s.believed.joint or s.joint, total, s.time_s)
    s.state.torsion_rad = total / stiffness
    if not bent:
        return
    usual = s.joint.rated_torque_nm / stiffness
    # Newton: a spring that hardens by its own stiffness is no small change, and one that softens may hold no such torque.
    # What such a twist accelerates of the link is not in it: quicker than the link swings on its spring it would grow
    widest = max(usual, float(np.max(np.abs(total))) / stiffness) / _SOFTEST
    for _ in range(_MOST_STEPS):
        d = s.state.torsion_rad
        here = _twist(s, bent)
        s.state.torsion_rad = d + _TORSION_STEP * usual
        slope = 1.0 + (_twist(s, bent) - here) / (_TORSION_STEP * usual)
        step = (total / stiffness - here - d) / np.maximum(slope, _SOFTEST)
        s.state.torsion_rad = np.clip(d + step, -widest, widest)
        if float(np.max(np.abs(step))) < _TORSION_STEP * usual:
            return


def _twist(s: JointSignals, present: Sequence[Present]) -> FloatArray | float:
    """Return what these effects add to the twist [n], rad."""
    x = ArrayFunctions()
    return sum(
        (
            p.effect.twist_rad(
                p.values, s.state_of(p.effect, p.values), relative_to(p.effect, p.values, s), x
            )
            for p in present
        ),
        0.0,
    )


def _sum(s: JointSignals, present: Sequence[Present], balance: str) -> FloatArray | float:
    """Return what these effects contribute to a balance [n], Nm."""
    return sum((contribution(p.effect, p.values, s).get(balance, 0.0) for p in present), 0.0)
