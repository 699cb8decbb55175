"""The next experiment, in words and as a motion.

For two joints on a towing bench it is a plan that `jtq campaign` drives, for one joint a table of positions.
`Effect.experiment` shows an effect; `Effect.confused_with` names what separates it from one that looks alike. At most
MOST_KINDS are planned, those that serve most pairs first. `planner.experiments` has the motions.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any, Final

import numpy as np
from scipy.stats import binned_statistic

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.effects import EFFECTS
from jtqd.estimator.joint import Joint, MotionLimits
from jtqd.estimator.text import counted
from jtqd.sysid.diagnosis.signals import SLOWEST_RAD_S, JointSignals
from jtqd.sysid.diagnosis.smoothing import below
from jtqd.sysid.planner.campaigns import allowed_torque, missing_limits
from jtqd.sysid.planner.experiments import (
    EXPERIMENTS,
    JointRange,
    csv_text,
    joint_motions,
    pair_range_of,
    pair_runs,
)
from jtqd.sysid.planner.plan import Plan, check_plan, travel_rad

MOST_KINDS: Final = 3
"""Kinds of motion in one experiment."""
_DEFAULT: Final = "excitation"
SHOWN_BY: Final = {name: effect.experiment for name, effect in EFFECTS.items()}
"""Effect -> kind of experiment that shows it."""
PAIRS: Final = {
    frozenset((name, other)): kind
    for name, effect in EFFECTS.items()
    for other, kind in effect.confused_with.items()
}
"""Two effects -> kind of experiment that separates them."""
_BY_HAND: Final = {
    frozenset((name, other)): text
    for name, effect in EFFECTS.items()
    for other, text in effect.by_hand.items()
}
"""Two effects -> what separates them besides a motion."""
PLAN_FILE: Final = "next_experiment.plan.yaml"
MOTION_FILE: Final = "next_experiment.motion.csv"
_RANGE: Final = ("travel_rad", "velocity_rad_s", "acceleration_rad_s2")
"""Limits that the motion of a joint without runs needs."""
_MARGIN: Final = 0.1
"""Part of the travel and of the allowed torque that is left free."""
_BINS: Final = 24
"""Of the travel, in each of which the largest torque is known."""
_LEAST_TRAVEL_RAD: Final = 0.02
"""A joint that moved less stood."""
_ACCELERATION_S: Final = 0.1
"""The acceleration of a run is the largest of its means over this time."""
_TOWING: Final = (
    "On a towing bench diagnose both joints together: the plan is then a campaign, and a sensor fault is in the "
    "balances of both joints, a joint fault in one."
)


def kinds_for(classes: Iterable[Sequence[str]]) -> tuple[str, ...]:
    """Return the kinds that separate the members of every class, and show the effect of a class of one; at most MOST_KINDS.

    Kinds that serve more pairs come first; no class at all: the general excitation and its repetition, which give the
    noise floor. A name that the library does not have is shown by the general excitation.
    """
    votes: Counter[str] = Counter()
    for names in classes:
        alone = [tuple(names)] if len(names) == 1 else []
        for some in (*alone, *combinations(dict.fromkeys(names), 2)):
            separating = PAIRS.get(frozenset(some))
            votes.update({separating} if separating else {SHOWN_BY.get(name, _DEFAULT) for name in some})
    if not votes:
        return (_DEFAULT, "repeat")
    order = list(EXPERIMENTS)
    return tuple(sorted(votes, key=lambda kind: (-votes[kind], order.index(kind)))[:MOST_KINDS])


def next_experiment(
    classes: Iterable[Sequence[str]],
    joints: Mapping[int, Joint],
    why: str = "",
    *,
    temperature: bool = True,
    signals: Sequence[JointSignals] = (),
) -> dict[str, Any]:
    """Return what would settle it: {"why": text, "plan": mapping of jtq.plan/1} for two joints on a towing bench, and
    {"why": text, "plan": None, "motions": {file: motion}, "tables": {file: CSV}} for one joint, which is moved alone. Three
    and more are an arm: each gets a motion of its own (`each_joint`).

    classes: names of effects that the runs cannot distinguish, one sequence per class; one name alone is to be made visible.
    joints: files of the joints in the runs; why: what the diagnosis states before it; temperature: whether the runs have
    one, else the plan does not supervise it; signals: of one joint, its runs so far. Raises ValueError without a joint.
    """
    classes = [tuple(names) for names in classes]
    if len(joints) != 2:
        runs = signals if len(joints) == 1 else ()
        return each_joint({n: _of_one_joint(classes, n, why, joint, runs) for n, joint in joints.items()})
    kinds, reach = kinds_for(classes), pair_range_of(joints, temperature=temperature)
    plan = Plan("next_" + "_".join(kinds), replace(reach.limits, travel_rad=1e3), pair_runs(kinds, reach))
    travel = 1.1 * max(travel_rad(one) for one in check_plan(plan).values()) + 1.0
    plan = replace(plan, limits=replace(plan.limits, travel_rad=float(np.ceil(travel))))
    parts = _begun(classes, why, {kind: EXPERIMENTS[kind].pair_text for kind in kinds})
    parts.append(
        f"{counted(len(plan.runs), 'run')}, {plan.duration_s:.0f} s, at most {plan.limits.torque_nm:g} Nm and "
        f"{plan.limits.current_a:g} A."
    )
    return {"why": " ".join(parts), "plan": plan.to_mapping()}


def each_joint(experiments: Mapping[int, Mapping[str, Any]]) -> dict[str, Any]:
    """Return the experiments of joints that are moved one by one, by their numbers, as one: a file of its own for each joint
    that has a motion. Raises ValueError without any.
    """
    if not experiments:
        raise ValueError("joints: found none, expected at least one")
    if len(experiments) == 1:
        [only] = experiments.values()
        return dict(only)
    made: dict[str, Any] = {"why": "", "plan": None, "motions": {}, "tables": {}}
    for n, each in sorted(experiments.items()):
        made["why"] += f"Joint {n}: {each['why'].replace(f' {_TOWING}', '')} "
        for kind in ("motions", "tables"):
            for value in each.get(kind, {}).values():
                made[kind][f"next_experiment.joint{n}.motion.csv"] = value
    return made | {"why": made["why"].strip()}


def _of_one_joint(
    classes: Sequence[Sequence[str]], number: int, why: str, joint: Joint, signals: Sequence[JointSignals]
) -> dict[str, Any]:
    """Return the experiment of a joint that nothing tows; signals: its runs so far."""
    kinds = kinds_for(classes)
    parts = [*_begun(classes, why, {kind: EXPERIMENTS[kind].joint_text for kind in kinds}), _TOWING]
    try:
        room = joint_range_of(joint, signals)
    except NoRangeError as reason:
        return {"why": " ".join([*parts, f"No motion is planned: {reason}."]), "plan": None}
    made = joint_motions(kinds, room)
    length_s = sum(motion.duration_s for motion in made)
    needed = (
        f"as in these runs and within the joint's limits; there they needed up to {room.needed_nm:.3g} Nm of "
        f"{room.torque_nm:.3g} Nm, a payload may add no more than the rest."
    )
    if not math.isfinite(room.needed_nm):
        needed = (
            "within the joint's limits; no run shows what torque that needs, so go slowly first and watch "
            f"{room.torque_nm:.3g} Nm."
        )
    parts += [
        f"Joint {number} alone, {counted(len(made), 'run')}, {length_s:.0f} s, {room.low_rad:.3g} to {room.high_rad:.3g} "
        f"rad, at most {room.velocity_rad_s:.3g} rad/s and {room.acceleration_rad_s2:.3g} rad/s2, {needed}",
        "All other joints stand as they did in these runs.",
    ]
    motion = {
        "joint": number,
        "travel_rad": [room.low_rad, room.high_rad],
        "velocity_rad_s": room.velocity_rad_s,
        "acceleration_rad_s2": room.acceleration_rad_s2,
        "torque_nm": room.torque_nm,
        "runs": [{"name": m.name, "what": m.what, "duration_s": m.duration_s} for m in made],
    }
    files = {"motions": {MOTION_FILE: motion}, "tables": {MOTION_FILE: csv_text(made)}}
    return {"why": " ".join(parts), "plan": None, **files}


def _begun(classes: Sequence[Sequence[str]], why: str, done: Mapping[str, str]) -> list[str]:
    """Reason, what is to be separated, what is done by kind of experiment, what is left to do by hand."""
    parts = [why.strip().rstrip(".") + "."] if why.strip() else []
    aims = [f"to distinguish {', '.join(names[:-1])} from {names[-1]}" for names in classes if len(names) > 1]
    aims += [f"to detect {names[0]}" for names in classes if len(names) == 1]
    parts.append(f"Proposed{' ' if aims else ''}{' and '.join(aims)}:")
    parts += [f"{kind}: {what}." for kind, what in done.items()]
    return parts + [note for pair, note in _BY_HAND.items() if any(pair <= set(names) for names in classes)]


class NoRangeError(ValueError):
    """Neither the runs nor the joint file show where a joint may move; why, in one line."""


def joint_range_of(joint: Joint, signals: Sequence[JointSignals]) -> JointRange:
    """Return the range of motion that the joint file allows and these runs have already used.

    A motion stays within the travel, speed and acceleration of the runs, and at positions at which they needed no more than
    the allowed torque. Without a usable run it is the range of the joint file, where that is complete. Raises NoRangeError.
    """
    limits, allowed = joint.motion_limits or MotionLimits(), allowed_torque(joint)
    speed, acceleration = limits.velocity_rad_s, limits.acceleration_rad_s2
    if not signals:
        lacking = missing_limits(joint, *_RANGE)
        if lacking:
            raise NoRangeError(
                "no run that can be used shows where the joint may go, and motion_limits of the joint file (or --limits) "
                f"lacks {', '.join(lacking)}"
            )
        return JointRange(*limits.travel_rad, speed, acceleration, allowed, math.nan)
    position = np.concatenate([s.state.link_position_rad for s in signals])
    torque = np.abs(np.concatenate([s.sensor_nm for s in signals]))
    speed = min(speed, max(float(np.max(np.abs(s.state.velocity_rad_s))) for s in signals))
    acceleration = min(acceleration, max(_acceleration(s) for s in signals))
    low = max(limits.travel_rad[0], float(np.min(position)))
    high = min(limits.travel_rad[1], float(np.max(position)))
    moved = high - low >= _LEAST_TRAVEL_RAD and speed >= SLOWEST_RAD_S and acceleration > 0.0
    stretch = _calm_stretch(position, torque, low, high, (1.0 - _MARGIN) * allowed) if moved else None
    if stretch is None:
        raise NoRangeError(
            "within motion_limits of the joint file (or --limits) the joint stood in these runs, or it needed more than "
            f"{1.0 - _MARGIN:.0%} of the torque allowed"
        )
    low, high = stretch
    margin = 0.5 * _MARGIN * (high - low)
    needed = float(np.max(torque[(position >= low) & (position <= high)]))
    return JointRange(low + margin, high - margin, speed, acceleration, allowed, needed)


def _acceleration(s: JointSignals) -> float:
    """Return the acceleration of a run [rad/s2], mean over _ACCELERATION_S: single samples are noise of the encoder."""
    v = s.state.velocity_rad_s
    wide = min(max(1, round(_ACCELERATION_S / s.step_s)), len(v) - 1)
    calm = below(v, s.step_s, 1.0 / _ACCELERATION_S)
    return float(np.max(np.abs(calm[wide:] - calm[:-wide]))) / (wide * s.step_s)


def _calm_stretch(
    position: FloatArray, torque: FloatArray, low: float, high: float, bound: float
) -> tuple[float, float] | None:
    """Return the longest stretch of low..high in which the runs needed at most `bound`; None: nowhere."""
    peak, edges, _ = binned_statistic(position, torque, "max", _BINS, (low, high))
    # a bin that no run has been in (NaN) is not known to be calm
    steps = np.diff(np.concatenate(([0], peak <= bound, [0])))
    starts, ends = np.flatnonzero(steps > 0), np.flatnonzero(steps < 0)
    if not len(starts):
        return None
    k = int(np.argmax(ends - starts))
    first, last = float(edges[starts[k]]), float(edges[ends[k]])
    return (first, last) if last - first >= _LEAST_TRAVEL_RAD else None
