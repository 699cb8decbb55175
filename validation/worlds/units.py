"""Relative sizes of effects: what a size of 1 is for a joint, which parameter carries it, and how large it may be."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

Joint = Mapping[str, Any]


@dataclass(frozen=True)
class Unit:
    """parameter: that carries the size; of(joint): what a relative size of 1 is, SI; both: either sign occurs.

    base(joint): value of the parameter on a bench without the effect; largest: relative size beyond which a joint would
    be broken, not badly modelled; start: relative size at which the oracle looks.
    """

    parameter: str
    of: Callable[[Joint], float]
    start: float
    largest: float
    both: bool = True
    base: Callable[[Joint], float] = lambda joint: 0.0


def rated_nm(joint: Joint) -> float:
    """Return the rated torque [Nm]."""
    return float(joint["rated_torque_nm"])


def rated_a(joint: Joint) -> float:
    """Return the current of the rated torque [A]."""
    return rated_nm(joint) / float(joint["gear_ratio"] * joint["torque_constant_nm_per_a"])


def rated_twist(joint: Joint) -> float:
    """Return the twist of the spring at rated torque [rad]."""
    return rated_nm(joint) / float(joint["stiffness_nm_per_rad"])


def one(joint: Joint) -> float:
    """Return 1, for sizes without a unit."""
    return 1.0


def reflected(joint: Joint) -> float:
    """Return the rotor's inertia on the joint side [kg m^2]."""
    return float(joint["rotor_inertia_kgm2"] * joint["gear_ratio"] ** 2)


def _of_file(*keys: str) -> Callable[[Joint], float]:
    def value(joint: Joint) -> float:
        found: Any = joint
        for key in keys:
            found = found[key]
        return float(found)

    return value


_kt: Final = _of_file("torque_constant_nm_per_a")
_rotor: Final = _of_file("rotor_inertia_kgm2")
_coulomb: Final = _of_file("friction", "coulomb_nm")
_viscous: Final = _of_file("friction", "viscous_nms_per_rad")
_damping: Final = _of_file("damping_nms_per_rad")
_link: Final = _of_file("link_inertia_kgm2")

UNITS: Final[dict[str, Unit]] = {
    "coulomb_friction": Unit("coulomb_nm", rated_nm, 0.02, 0.04, base=_coulomb),
    "viscous_friction": Unit("viscous_nms_per_rad", rated_nm, 0.02, 0.036, base=_viscous),
    "stribeck_friction": Unit("stribeck_nm", rated_nm, 0.02, 0.05, both=False),
    "load_dependent_friction": Unit("load_coefficient", one, 0.05, 0.3, both=False),
    "friction_asymmetry": Unit("asymmetry_nm", rated_nm, 0.01, 0.04),
    "temperature_dependent_friction": Unit("viscous_per_k", one, 0.02, 0.1, both=False),
    "torque_ripple": Unit("amplitude_nm", rated_nm, 0.01, 0.1, both=False),
    "kinematic_error": Unit("amplitude_rad", rated_twist, 0.01, 0.3, both=False),
    "nonlinear_stiffness": Unit(
        "cubic_nm_per_rad3",
        lambda joint: float(joint["stiffness_nm_per_rad"]) / rated_twist(joint) ** 2,
        0.2,
        3.0,
        both=False,
    ),
    "hysteresis": Unit("torque_nm", rated_nm, 0.02, 0.2, both=False),
    "lost_motion": Unit("width_rad", rated_twist, 0.03, 0.5, both=False),
    "gear_damping": Unit("damping_nms_per_rad", _damping, 1.0, 20.0, both=False, base=_damping),
    "torque_constant": Unit("torque_constant_nm_per_a", _kt, 0.03, 0.3, base=_kt),
    "torque_constant_saturation": Unit(
        "saturation_per_a", lambda joint: 1.0 / rated_a(joint), 0.1, 0.4, both=False
    ),
    "torque_constant_temperature": Unit("per_k", one, -0.002, 0.02, both=False),
    "cogging": Unit("amplitude_nm", rated_nm, 0.01, 0.1, both=False),
    "current_offset": Unit("offset_a", rated_a, 0.01, 0.2),
    "rotor_inertia": Unit("rotor_inertia_kgm2", _rotor, 0.2, 4.0, both=False, base=_rotor),
    "sensor_offset": Unit("offset_nm", rated_nm, 0.01, 0.3),
    "sensor_gain": Unit("gain", one, 0.02, 0.3, base=one),
    "sensor_drift": Unit("per_k_nm", rated_nm, 0.001, 0.02),
    "sensor_crosstalk": Unit("amplitude_nm", rated_nm, 0.01, 0.2, both=False),
    "encoder_eccentricity": Unit("amplitude_rad", rated_twist, 0.01, 0.3, both=False),
    "channel_delay": Unit("delay_s", one, 0.002, 0.02, both=False),
    "link_inertia": Unit("link_inertia_kgm2", reflected, 0.1, 3.0, both=False, base=_link),
    "unbalance": Unit("moment_nm", rated_nm, 0.01, 0.2, both=False),
}
"""Names, parameters and their meaning are the joint file's (docs/diagnosis.md, Effects)."""


CHANNELS: Final = ("sensor", "current", "link")
"""Variants of `channel_delay`, by the number that the joint file gives them."""


def parameters(
    name: str, joint: Joint, size: float, rng: np.random.Generator, variant: str = ""
) -> dict[str, float]:
    """Return all parameters of an effect of this relative size; sign, phase, order and the like are drawn."""
    unit = UNITS[name]
    sign = float(rng.choice([-1.0, 1.0])) if unit.both else float(np.sign(unit.start))
    phase = float(rng.uniform(-np.pi, np.pi))
    share = float(rng.uniform())
    carried = unit.base(joint) + sign * abs(size) * unit.of(joint)
    others: dict[str, dict[str, float]] = {
        "stribeck_friction": {"stribeck_velocity_rad_s": 0.07 * 3.0**share},
        "temperature_dependent_friction": {"reference_c": 25.0, "coulomb_per_k": 0.0},
        "torque_ripple": {"order_per_motor_rev": (1.0, 2.0, 4.0)[int(3 * share)], "phase_rad": phase},
        "kinematic_error": {"order_per_motor_rev": (1.0, 2.0, 4.0)[int(3 * share)], "phase_rad": phase},
        "cogging": {"order_per_motor_rev": (6.0, 12.0, 24.0)[int(3 * share)], "phase_rad": phase},
        "hysteresis": {"travel_rad": 4e-5 * 6.0**share},
        "torque_constant_temperature": {"reference_c": 25.0},
        "sensor_drift": {"reference_c": 25.0, "rate_nm_per_s": 0.0},
        "sensor_crosstalk": {"phase_rad": phase, "share": 0.0},
        "encoder_eccentricity": {"phase_rad": phase, "motor_side": 0.0},
        "channel_delay": {"channel": float(CHANNELS.index(variant))} if variant else {},
        "unbalance": {"phase_rad": phase},
    }
    return {unit.parameter: carried, **others.get(name, {})}
