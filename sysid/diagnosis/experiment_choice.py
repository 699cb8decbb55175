"""Which kind of motion separates what the runs cannot: of effects that look alike, and of one that does not show.

What an effect needs to be seen at all is its `Effect.experiment`. For two effects that look alike the kind that separates
them is in PAIRS where it is another one. Of all kinds that a diagnosis would like, at most MOST_KINDS are planned, those
that serve most pairs first.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from itertools import combinations
from typing import Final

from jtqd.estimator.effects.library import EFFECTS
from jtqd.sysid.diagnosis.towing_motion import EXPERIMENTS

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
        "hysteresis gear_damping",
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
        "gear_damping channel_delay",
        "gear_damping link_inertia",
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
    "quick_changes": "rotor_inertia link_inertia channel_delay gear_damping",
    "warm_up": "temperature_dependent_friction torque_constant_temperature sensor_drift",
    "zero_reading": "current_offset sensor_offset",
}
_OWN: Final = {name: kind for kind, names in _VISIBLE.items() for name in names.split()}


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
