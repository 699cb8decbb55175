"""The next experiment: which kind of motion separates what these runs cannot, as a plan that `jtq campaign` drives. Pure.

What an effect needs to be seen at all is its `Effect.experiment`. For two effects that look alike the kind that separates
them is in PAIRS where it is another one. Of all kinds that a diagnosis would like, at most MOST_KINDS are planned, those
that serve most pairs first.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any, Final

import numpy as np

from estimator.effects.library import EFFECTS
from estimator.parameters import Joint
from sysid.campaign.plan import Plan
from sysid.campaign.segments import check_plan, travel_rad
from sysid.diagnosis.experiment_bench import VELOCITY_RAD_S, reach_of
from sysid.diagnosis.experiment_runs import EXPERIMENTS, Kind

__all__ = ["EXPERIMENTS", "Kind", "kinds_for", "next_experiment"]

MOST_KINDS: Final = 3
_DEFAULT: Final = "excitation"

_PAIR_TABLE: Final = {
    "load_at_both_directions": (
        # even or odd in the direction of motion; in one joint or in both
        "torque_constant load_dependent_friction",
        "torque_constant torque_constant_saturation",
        "torque_constant sensor_gain",
        "torque_constant viscous_friction",
        "sensor_gain load_dependent_friction",
        "sensor_gain torque_constant_saturation",
        "sensor_gain nonlinear_stiffness",
        "load_dependent_friction coulomb_friction",
        "load_dependent_friction viscous_friction",
        "load_dependent_friction torque_constant_saturation",
        "load_dependent_friction friction_asymmetry",
        "lost_motion friction_asymmetry",
        "sensor_offset friction_asymmetry",
        "sensor_offset current_offset",
    ),
    "speed_ladder": (
        "coulomb_friction viscous_friction",
        "coulomb_friction current_offset",
        "coulomb_friction friction_asymmetry",
        "coulomb_friction sensor_offset",
        "viscous_friction rotor_inertia",
        "viscous_friction channel_delay",
    ),
    "slow_reversals": (
        "coulomb_friction stribeck_friction",
        "viscous_friction stribeck_friction",
        "stribeck_friction hysteresis",
        "stribeck_friction lost_motion",
        "stribeck_friction friction_asymmetry",
    ),
    "load_ramp": (
        "hysteresis lost_motion",
        "hysteresis nonlinear_stiffness",
        "lost_motion nonlinear_stiffness",
        "hysteresis channel_delay",
        "nonlinear_stiffness encoder_eccentricity",
    ),
    "full_turns": (
        # order, encoder, growth with load, one joint or both
        "torque_ripple cogging",
        "torque_ripple kinematic_error",
        "cogging kinematic_error",
        "kinematic_error encoder_eccentricity",
        "torque_ripple encoder_eccentricity",
        "sensor_crosstalk unbalance",
        "sensor_crosstalk encoder_eccentricity",
        "sensor_crosstalk sensor_offset",
        "unbalance encoder_eccentricity",
        "unbalance sensor_offset",
    ),
    "quick_changes": (
        "rotor_inertia link_inertia",
        "rotor_inertia channel_delay",
        "link_inertia channel_delay",
        "torque_ripple channel_delay",
    ),
    "warm_up": (
        "temperature_dependent_friction viscous_friction",
        "temperature_dependent_friction coulomb_friction",
        "temperature_dependent_friction sensor_drift",
        "temperature_dependent_friction torque_constant_temperature",
        "torque_constant torque_constant_temperature",
        "sensor_gain torque_constant_temperature",
        "sensor_drift torque_constant_temperature",
        "sensor_drift sensor_offset",
        "sensor_drift current_offset",
    ),
    "zero_reading": ("current_offset friction_asymmetry",),
}
PAIRS: Final = {frozenset(pair.split()): kind for kind, pairs in _PAIR_TABLE.items() for pair in pairs}
"""Two names -> the kind that separates them."""

_VISIBLE: Final = {
    "excitation": "torque_constant_saturation",
    "speed_ladder": "coulomb_friction viscous_friction friction_asymmetry",
    "slow_reversals": "stribeck_friction",
    "load_at_both_directions": "load_dependent_friction torque_constant sensor_gain torque_constant_saturation",
    "load_ramp": "nonlinear_stiffness hysteresis lost_motion",
    "full_turns": "torque_ripple kinematic_error cogging sensor_crosstalk encoder_eccentricity unbalance",
    "quick_changes": "rotor_inertia link_inertia channel_delay",
    "warm_up": "temperature_dependent_friction torque_constant_temperature sensor_drift",
    "zero_reading": "current_offset sensor_offset",
}
_OWN: Final = {name: kind for kind, names in _VISIBLE.items() for name in names.split()}

_BY_HAND: Final = {
    frozenset(("sensor_crosstalk", "unbalance")): (
        "If they stay together, turn the coupling by a quarter and run it again: crosstalk turns with the sensor, unbalance "
        "does not."
    ),
}


def kind_of(name: str) -> str:
    """Return the kind of experiment that shows an effect (a name that the library does not have: the general one)."""
    if name in _OWN:
        return _OWN[name]
    effect = EFFECTS.get(name)
    kind = effect.experiment if effect is not None else _DEFAULT
    return kind if kind in EXPERIMENTS else _DEFAULT


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


def next_experiment(
    classes: Iterable[Sequence[str]],
    joints: Mapping[int, Joint],
    why: str = "",
    *,
    velocity_rad_s: float = VELOCITY_RAD_S,
    temperature: bool = True,
) -> dict[str, Any]:
    """Return {"why": text, "plan": mapping of jtq.plan/1} of the campaign that would settle it.

    classes: names of effects that the runs cannot tell apart, one sequence per class; a sequence of one name asks to make
    that effect visible. joints: files of the joints in the runs, one or two, whose ratings the plan keeps. why: what the
    diagnosis has to say before. velocity_rad_s: the fastest motion allowed. temperature: whether the runs have one; without
    it the plan does not supervise it. Raises ValueError without a joint.
    """
    classes = [tuple(names) for names in classes]
    kinds = kinds_for(classes)
    reach = reach_of(joints, velocity_rad_s=velocity_rad_s, temperature=temperature)
    runs = tuple(run for kind in kinds for run in EXPERIMENTS[kind].runs(reach))
    plan = Plan("next_" + "_".join(kinds), replace(reach.limits, travel_rad=1e3), runs)
    setpoints = check_plan(plan)
    travel = 1.1 * max(travel_rad(one) for one in setpoints.values()) + 1.0
    plan = replace(plan, limits=replace(plan.limits, travel_rad=float(np.ceil(travel))))
    return {"why": _text(classes, kinds, joints, why, plan), "plan": plan.to_mapping()}


def _text(
    classes: Sequence[Sequence[str]], kinds: Sequence[str], joints: Mapping[int, Joint], why: str, plan: Plan
) -> str:
    """Reason, what is to be separated, what is done, what it takes, what is left to do by hand."""
    parts = [why.strip().rstrip(".") + "."] if why.strip() else []
    aims = [f"to tell {', '.join(names[:-1])} from {names[-1]}" for names in classes if len(names) > 1]
    aims += [f"to make {names[0]} visible" for names in classes if len(names) == 1]
    parts.append(f"Proposed{' ' if aims else ''}{' and '.join(aims)}:")
    parts += [f"{kind}: {EXPERIMENTS[kind].what}." for kind in kinds]
    if len(joints) == 1 and any(len(names) > 1 for names in classes):
        parts.append(
            "Record both joints of the bench: a fault of the sensor is in both balances, a fault of a joint in one."
        )
    parts += [note for pair, note in _BY_HAND.items() if any(pair <= set(names) for names in classes)]
    parts.append(
        f"{len(plan.runs)} runs, {plan.duration_s / 60.0:.0f} min, at most {plan.limits.torque_nm:g} Nm and "
        f"{plan.limits.current_a:g} A."
    )
    return " ".join(parts)
