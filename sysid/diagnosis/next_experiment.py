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

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.effects import EFFECTS
from jtqd.estimator.joint import Joint
from jtqd.estimator.text import counted
from jtqd.sysid.diagnosis.signals import JointSignals
from jtqd.sysid.diagnosis.smoothing import smooth
from jtqd.sysid.planner.campaigns import allowed_torque, missing_limits
from jtqd.sysid.planner.experiments import (
    EXPERIMENTS,
    VELOCITY_RAD_S,
    JointRange,
    Motion,
    joint_motions,
    pair_range_of,
    pair_runs,
)
from jtqd.sysid.planner.plan import Plan, check_plan, travel_rad

MOST_KINDS: Final = 3
_DEFAULT: Final = "excitation"

PAIRS: Final = {
    frozenset((name, other)): kind
    for name, effect in EFFECTS.items()
    for other, kind in effect.confused_with.items()
}
"""Two names -> the kind that separates them."""


def kind_of(name: str) -> str:
    """Return the kind of experiment that shows an effect (a name that the library does not have: the general one)."""
    return EFFECTS[name].experiment if name in EFFECTS else _DEFAULT


def kinds_for(classes: Iterable[Sequence[str]]) -> tuple[str, ...]:
    """Return the kinds that separate the members of every class, and show the effect of a class of one; at most MOST_KINDS.

    Kinds that serve more pairs come first; no class at all: the general excitation and its repetition, which give the
    noise floor.
    """
    votes: Counter[str] = Counter()
    for names in classes:
        if len(names) == 1:
            votes[kind_of(names[0])] += 1
        for a, b in combinations(dict.fromkeys(names), 2):
            separating = PAIRS.get(frozenset((a, b)))
            votes.update({separating} if separating else {kind_of(a), kind_of(b)})
    if not votes:
        return (_DEFAULT, "repeat")
    order = list(EXPERIMENTS)
    return tuple(sorted(votes, key=lambda kind: (-votes[kind], order.index(kind)))[:MOST_KINDS])


PLAN_FILE: Final = "next_experiment.plan.yaml"
MOTION_FILE: Final = "next_experiment.motion.csv"
CONFIG: Final = "CONFIG"
"""Stands in a command for a configuration of jtqd that is not known."""

_RANGE: Final = ("travel_rad", "velocity_rad_s", "acceleration_rad_s2")
"""Limits that the motion of a joint without runs needs."""
INSIDE: Final = 0.05
"""Part of the travel that is left free at either end."""
_TORQUE_SHARE: Final = 0.9
"""Of the allowed torque: positions that needed more in the runs are not visited."""
_BINS: Final = 24
_LEAST_TRAVEL_RAD: Final = 0.02
_LEAST_SPEED_RAD_S: Final = 0.005
_ACCELERATION_QUANTILE: Final = 0.99
_ACCELERATION_S: Final = 0.1
_BY_HAND: Final = {
    frozenset((name, other)): text
    for name, effect in EFFECTS.items()
    for other, text in effect.by_hand.items()
}


def next_experiment(
    classes: Iterable[Sequence[str]],
    joints: Mapping[int, Joint],
    why: str = "",
    *,
    velocity_rad_s: float = VELOCITY_RAD_S,
    temperature: bool = True,
    signals: Sequence[JointSignals] = (),
) -> dict[str, Any]:
    """Return what would settle it: {"why": text, "plan": mapping of jtq.plan/1} for two joints on a towing bench, and
    {"why": text, "plan": None, "motion": ..} for one joint, which is moved alone. Three and more are an
    arm: each gets a motion of its own (`each_joint`).

    classes: names of effects that the runs cannot distinguish, one sequence per class; a sequence of one name asks to make
    that effect visible. joints: files of the joints in the runs, whose ratings the plan keeps. why: what the
    diagnosis states before it. velocity_rad_s: the fastest motion allowed. temperature: whether the runs have one; without
    it the plan does not supervise it. signals: of one joint, its runs so far: where it may go. Raises ValueError without
    a joint.
    """
    classes = [tuple(names) for names in classes]
    kinds = kinds_for(classes)
    if len(joints) == 1:
        [(number, joint)] = joints.items()
        return _of_one_joint(classes, number, why, joint, signals)
    if len(joints) > 2:
        return each_joint(
            {number: _of_one_joint(classes, number, why, joint, ()) for number, joint in joints.items()}
        )
    reach = pair_range_of(joints, velocity_rad_s=velocity_rad_s, temperature=temperature)
    plan = Plan("next_" + "_".join(kinds), replace(reach.limits, travel_rad=1e3), pair_runs(kinds, reach))
    setpoints = check_plan(plan)
    travel = 1.1 * max(travel_rad(one) for one in setpoints.values()) + 1.0
    plan = replace(plan, limits=replace(plan.limits, travel_rad=float(np.ceil(travel))))
    parts = _begun(classes, why, {kind: EXPERIMENTS[kind].pair_text for kind in kinds})
    parts.append(
        f"{counted(len(plan.runs), 'run')}, {plan.duration_s / 60.0:.0f} min, at most {plan.limits.torque_nm:g} Nm and "
        f"{plan.limits.current_a:g} A."
    )
    return {"why": " ".join(parts), "plan": plan.to_mapping()}


def campaign_command(plan: str = PLAN_FILE, bus: str = "can0", config: str = CONFIG) -> str:
    """Return the command that runs a plan; config: of the bench, "" for the one that ships."""
    return f"jtq campaign {plan} --bus {bus}{f' --config {config}' if config else ''} --out RUNS"


_TOWING: Final = (
    "On a towing bench diagnose both joints together: the plan is then a campaign, and a sensor fault is in the "
    "balances of both joints, a joint fault in one."
)


def each_joint(experiments: Mapping[int, Mapping[str, Any]]) -> dict[str, Any]:
    """Return the experiments of joints that are moved one by one, by their numbers, as one.

    A single one is returned as it is; several are {"why": all of them, "plan": None, "motion": None, "joints": [{"joint",
    "why", "motion"}, ..], "tables": {number: CSV}}, tables for those with a motion. Raises ValueError without any.
    """
    if not experiments:
        raise ValueError("found no experiment, expected at least one")
    if len(experiments) == 1:
        [only] = experiments.values()
        return dict(only)
    numbers = sorted(experiments)
    reasons = [f"Joint {n}: {experiments[n]['why'].replace(f' {_TOWING}', '')}" for n in numbers]
    return {
        "why": " ".join(reasons),
        "plan": None,
        "motion": None,
        "joints": [
            {"joint": n, "why": experiments[n]["why"], "motion": experiments[n].get("motion")}
            for n in numbers
        ],
        "tables": {n: experiments[n]["table"] for n in numbers if experiments[n].get("table")},
    }


def _of_one_joint(
    classes: Sequence[Sequence[str]],
    number: int,
    why: str,
    joint: Joint,
    signals: Sequence[JointSignals],
) -> dict[str, Any]:
    """Return the experiment of a joint that nothing tows; signals: its runs so far."""
    kinds, room = kinds_for(classes), joint_range_of(joint, signals)
    parts = [*_begun(classes, why, {kind: EXPERIMENTS[kind].joint_text for kind in kinds}), _TOWING]
    if room is None:
        parts.append(f"No motion is planned: {_no_range(joint, signals)}.")
        return {"why": " ".join(parts), "plan": None, "motion": None}
    made = joint_motions(kinds, room)
    minutes = sum(motion.duration_s for motion in made) / 60.0
    parts.append(
        f"Joint {number} alone, {counted(len(made), 'run')}, {minutes:.0f} min, {room.low_rad:.3g} to {room.high_rad:.3g} "
        f"rad, at most {room.velocity_rad_s:.3g} rad/s and {room.acceleration_rad_s2:.3g} rad/s2, "
    )
    if math.isfinite(room.needed_nm):
        parts[-1] += (
            "as in these runs and within the joint's limits; there they needed up to "
            f"{room.needed_nm:.3g} Nm of {room.torque_nm:.3g} Nm, a payload may add no more than the rest."
        )
    else:
        parts[-1] += (
            f"within the joint's limits; no run shows what torque that needs, so go slowly first and watch "
            f"{room.torque_nm:.3g} Nm."
        )
    parts.append("All other joints stand as they did in these runs.")
    return {
        "why": " ".join(parts),
        "plan": None,
        "motion": _described(number, made, room),
        "table": csv_text(made),
    }


def _begun(classes: Sequence[Sequence[str]], why: str, done: Mapping[str, str]) -> list[str]:
    """Reason, what is to be separated, what is done by kind of experiment, what is left to do by hand."""
    parts = [why.strip().rstrip(".") + "."] if why.strip() else []
    aims = [f"to distinguish {', '.join(names[:-1])} from {names[-1]}" for names in classes if len(names) > 1]
    aims += [f"to detect {names[0]}" for names in classes if len(names) == 1]
    parts.append(f"Proposed{' ' if aims else ''}{' and '.join(aims)}:")
    parts += [f"{kind}: {what}." for kind, what in done.items()]
    return parts + [note for pair, note in _BY_HAND.items() if any(pair <= set(names) for names in classes)]


def joint_range_of(joint: Joint, signals: Sequence[JointSignals]) -> JointRange | None:
    """Return the range of motion that the joint file allows and these runs have already used; None where nothing moved.

    A motion stays within the travel, speed and acceleration of the runs, and at positions at which they needed no more than
    the allowed torque. Without a usable run it is the range of the joint file, where that is complete.
    """
    if not signals:
        limits = joint.motion_limits
        if limits is None or missing_limits(joint, *_RANGE):
            return None
        return JointRange(
            *limits.travel_rad,
            limits.velocity_rad_s,
            limits.acceleration_rad_s2,
            allowed_torque(joint),
            math.nan,
        )
    position = np.concatenate([s.state.link_position_rad for s in signals])
    torque = np.abs(np.concatenate([s.sensor_nm for s in signals]))
    speed = max(float(np.max(np.abs(s.state.velocity_rad_s))) for s in signals)
    quick = max(_acceleration(s) for s in signals)
    low, high = float(np.min(position)), float(np.max(position))
    limits = joint.motion_limits
    if limits is not None:
        low, high = max(low, limits.travel_rad[0]), min(high, limits.travel_rad[1])
        speed = min(speed, limits.velocity_rad_s)
        quick = min(quick, limits.acceleration_rad_s2)
    allowed = allowed_torque(joint)
    if high - low < _LEAST_TRAVEL_RAD or speed < _LEAST_SPEED_RAD_S or not quick > 0.0:
        return None
    stretch = _calm_stretch(position, torque, low, high, _TORQUE_SHARE * allowed)
    if stretch is None:
        return None
    low, high = stretch
    margin = INSIDE * (high - low)
    there = (position >= low) & (position <= high)
    return JointRange(low + margin, high - margin, speed, quick, allowed, float(np.max(torque[there])))


def _acceleration(s: JointSignals) -> float:
    """Return the acceleration of a run [rad/s2], mean over _ACCELERATION_S: single samples are noise of the encoder."""
    v = s.state.velocity_rad_s
    step = float(np.median(np.diff(s.time_s)))
    wide = min(max(1, round(_ACCELERATION_S / step)), len(v) - 1)
    calm = smooth(v, max(1, wide // 4))
    return float(np.quantile(np.abs(calm[wide:] - calm[:-wide]), _ACCELERATION_QUANTILE)) / (wide * step)


def _no_range(joint: Joint, signals: Sequence[JointSignals]) -> str:
    """Return why `joint_range_of` gives none."""
    if signals:
        return (
            "within motion_limits of the joint file (or --limits) the joint stood in these runs, or it needed more than "
            f"{_TORQUE_SHARE:.0%} of the torque allowed"
        )
    return (
        "no run that can be used shows where the joint may go, and motion_limits of the joint file (or --limits) lacks "
        + ", ".join(missing_limits(joint, *_RANGE))
    )


def _calm_stretch(
    position: FloatArray, torque: FloatArray, low: float, high: float, bound: float
) -> tuple[float, float] | None:
    """Return the longest stretch of low..high in which the runs needed at most `bound`; None: nowhere."""
    edges = np.linspace(low, high, _BINS + 1)
    where = np.clip(np.searchsorted(edges, position, side="right") - 1, -1, _BINS - 1)
    inside = (position >= low) & (position <= high)
    peak = np.full(_BINS, np.inf)  # a bin that no run has been in is not known to be calm
    for k in range(_BINS):
        here = inside & (where == k)
        if here.any():
            peak[k] = float(np.max(torque[here]))
    calm = np.concatenate(([0], (peak <= bound).astype(int), [0]))
    starts, ends = np.flatnonzero(np.diff(calm) > 0), np.flatnonzero(np.diff(calm) < 0)
    if not len(starts):
        return None
    k = int(np.argmax(ends - starts))
    if edges[ends[k]] - edges[starts[k]] < _LEAST_TRAVEL_RAD:
        return None
    return float(edges[starts[k]]), float(edges[ends[k]])


def joint_motion_file(number: int) -> str:
    """Return the name of the motion of a joint where several have one."""
    return f"next_experiment.joint{number}.motion.csv"


def csv_text(made: Sequence[Motion]) -> str:
    """Return all runs as one CSV table at RATE_HZ: run, time_s, position_rad, velocity_rad_s, joint side."""
    lines = ["run,time_s,position_rad,velocity_rad_s"]
    for motion in made:
        rows = zip(motion.time_s, motion.position_rad, motion.velocity_rad_s, strict=True)
        lines += [f"{motion.name},{t:.2f},{q:.6f},{v:.6f}" for t, q, v in rows]
    return "\n".join(lines) + "\n"


def _described(joint: int, made: Sequence[Motion], room: JointRange) -> dict[str, Any]:
    """Return the motion as it stands in findings.json."""
    return {
        "joint": joint,
        "travel_rad": [room.low_rad, room.high_rad],
        "velocity_rad_s": room.velocity_rad_s,
        "acceleration_rad_s2": room.acceleration_rad_s2,
        "torque_nm": room.torque_nm,
        "runs": [{"name": m.name, "what": m.what, "duration_s": m.duration_s} for m in made],
    }
