"""The next experiment, in words and as a motion: for two joints on a towing bench a plan that `jtq campaign` drives
(`towing_motion`), for one joint a table of positions (`arm_motion`); of the kinds that `experiment_choice` says.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np

from jtqd.estimator.checked import counted
from jtqd.estimator.effects import EFFECTS
from jtqd.estimator.joint import Joint
from jtqd.sysid.diagnosis.arm_motion import KINDS, csv_text, described, motions, no_room, room_of
from jtqd.sysid.diagnosis.experiment_choice import kinds_for
from jtqd.sysid.diagnosis.signals import JointSignals
from jtqd.sysid.diagnosis.towing_motion import EXPERIMENTS, VELOCITY_RAD_S, reach_of
from jtqd.sysid.planner.plan import Plan, check_plan, travel_rad

PLAN_FILE: Final = "next_experiment.plan.yaml"
CONFIG: Final = "CONFIG"
"""Stands in a command for a configuration of jtqd that is not known."""

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
    {"why": text, "plan": None, "motion": ..} for one joint, which is moved by itself (`arm_motion`). Three and more are an
    arm: each gets a motion of its own (`each_joint`).

    classes: names of effects that the runs cannot distinguish, one sequence per class; a sequence of one name asks to make
    that effect visible. joints: files of the joints in the runs, whose ratings the plan keeps. why: what the
    diagnosis says before it. velocity_rad_s: the fastest motion allowed. temperature: whether the runs have one; without
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
    reach = reach_of(joints, velocity_rad_s=velocity_rad_s, temperature=temperature)
    runs = tuple(run for kind in kinds for run in EXPERIMENTS[kind].runs(reach))
    plan = Plan("next_" + "_".join(kinds), replace(reach.limits, travel_rad=1e3), runs)
    setpoints = check_plan(plan)
    travel = 1.1 * max(travel_rad(one) for one in setpoints.values()) + 1.0
    plan = replace(plan, limits=replace(plan.limits, travel_rad=float(np.ceil(travel))))
    parts = _begun(classes, why, {kind: EXPERIMENTS[kind].what for kind in kinds})
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
    said = [f"Joint {n}: {experiments[n]['why'].replace(f' {_TOWING}', '')}" for n in numbers]
    return {
        "why": " ".join(said),
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
    kinds, room = kinds_for(classes), room_of(joint, signals)
    parts = [*_begun(classes, why, {kind: KINDS[kind][0] for kind in kinds}), _TOWING]
    if room is None:
        parts.append(f"No motion is planned: {no_room(joint, signals)}.")
        return {"why": " ".join(parts), "plan": None, "motion": None}
    made = motions(kinds, room)
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
        "motion": described(number, made, room),
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
