"""The effects: how a size becomes parameters of a joint file. Sizes are deviations of the leading parameter, SI.

An effect that replaces a value of the joint file has absolute parameters: file value plus deviation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

SENSOR: Final = "sensor"


@dataclass(frozen=True)
class Entry:
    """leading: parameter that carries the size; low, high: typical sizes (times the file's value if `relative`);
    both: either sign occurs; key: dotted key of the joint file that the parameter replaces; neutral: value without effect;
    second: another parameter that can carry the effect instead.
    """

    leading: str
    low: float
    high: float
    both: bool = True
    relative: bool = False
    key: str = ""
    neutral: float = 0.0
    at_sensor: bool = False
    second: str = ""


MENU: Final[dict[str, Entry]] = {
    "coulomb_friction": Entry("coulomb_nm", 0.5, 1.5, key="friction.coulomb_nm"),
    "viscous_friction": Entry(
        "viscous_nms_per_rad", 0.2, 0.5, relative=True, key="friction.viscous_nms_per_rad"
    ),
    "stribeck_friction": Entry("stribeck_nm", 0.5, 2.0, both=False),
    "load_dependent_friction": Entry("load_coefficient", 0.04, 0.15, both=False),
    "friction_asymmetry": Entry("asymmetry_nm", 0.3, 1.0),
    "temperature_dependent_friction": Entry(
        "viscous_per_k", 0.015, 0.035, both=False, second="coulomb_per_k"
    ),
    "torque_ripple": Entry("amplitude_nm", 0.2, 1.0, both=False),
    "kinematic_error": Entry("amplitude_rad", 3e-5, 2e-4, both=False),
    "nonlinear_stiffness": Entry(
        "cubic_nm_per_rad3", 0.1, 0.4, both=False, relative=True, second="stiffness_nm_per_rad"
    ),
    "hysteresis": Entry("torque_nm", 0.5, 2.0, both=False),
    "lost_motion": Entry("width_rad", 4e-5, 2e-4, both=False),
    "gear_damping": Entry(
        "damping_nms_per_rad", 0.5, 2.0, both=False, relative=True, key="damping_nms_per_rad"
    ),
    "torque_constant": Entry(
        "torque_constant_nm_per_a", 0.02, 0.08, relative=True, key="torque_constant_nm_per_a"
    ),
    "torque_constant_saturation": Entry("saturation_per_a", 0.005, 0.02, both=False),
    "torque_constant_temperature": Entry("per_k", -0.004, -0.001, both=False),
    "cogging": Entry("amplitude_nm", 0.1, 0.5, both=False),
    "current_offset": Entry("offset_a", 0.03, 0.1),
    "rotor_inertia": Entry("rotor_inertia_kgm2", 0.1, 0.4, relative=True, key="rotor_inertia_kgm2"),
    "sensor_offset": Entry("offset_nm", 0.4, 1.5, at_sensor=True),
    "sensor_gain": Entry("gain", 0.02, 0.08, neutral=1.0, at_sensor=True),
    "sensor_drift": Entry("rate_nm_per_s", 0.02, 0.1, at_sensor=True, second="per_k_nm"),
    "sensor_crosstalk": Entry("amplitude_nm", 0.1, 0.6, both=False, at_sensor=True, second="share"),
    "encoder_eccentricity": Entry("amplitude_rad", 2e-5, 1e-4, both=False),
    "channel_delay": Entry("delay_s", 0.001, 0.006, both=False),
    "link_inertia": Entry("link_inertia_kgm2", 1.0, 5.0, both=False, relative=True, key="link_inertia_kgm2"),
    "unbalance": Entry("moment_nm", 0.2, 1.5, both=False),
}

Size = float | Mapping[str, float] | None


def parameters(
    name: str,
    nominal: Mapping[str, Any],
    size: Size,
    rng: np.random.Generator,
    fixed: Mapping[str, float] | None = None,
) -> dict[str, float]:
    """Return all parameters of one hidden effect.

    size: a magnitude of the leading parameter (sign drawn where both occur), None for a typical one, or a mapping of
    parameters as they are; what it leaves out is drawn. fixed: parameters that are given besides a size.
    """
    entry = MENU[name]
    given = dict(size) if isinstance(size, Mapping) else dict(fixed or {})
    out = _others(name, nominal, rng, given)
    typical = float(rng.uniform(entry.low, entry.high))
    sign = float(rng.choice([-1.0, 1.0]))
    if entry.leading not in given:
        scale = _scale(name, nominal) if entry.relative else 1.0
        magnitude = typical * scale if size is None or isinstance(size, Mapping) else float(size)
        deviation = magnitude * (sign if entry.both else 1.0)
        base = _file_value(nominal, entry.key) if entry.key else entry.neutral
        if entry.key and base + deviation <= 0.0:
            deviation = abs(deviation)
        carried = isinstance(size, Mapping) and entry.second in given
        out[entry.leading] = base if carried else base + deviation
    out.update(given)
    return out


def deviation(name: str, nominal: Mapping[str, Any], values: Mapping[str, float]) -> float:
    """Return how far the leading parameter is from a bench without the effect."""
    leading = MENU[name].leading
    base = base_value(name, nominal, leading)
    return values.get(leading, base) - base


def base_value(name: str, nominal: Mapping[str, Any], parameter: str) -> float:
    """Return the value of a leading or second parameter on a bench without the effect."""
    entry = MENU[name]
    if parameter == "stiffness_nm_per_rad":
        return float(nominal[parameter])
    if parameter == entry.leading:
        return _file_value(nominal, entry.key) if entry.key else entry.neutral
    return 0.0


def scaled(
    name: str,
    nominal: Mapping[str, Any],
    minimum: Mapping[str, float],
    factor: float,
    rng: np.random.Generator,
) -> dict[str, float]:
    """Return parameters at `factor` times the minimum detectable size.

    minimum: parameters at the minimum, absolute; those that carry the effect are moved away from nothing, with a sign
    where both occur; phases and reference temperatures are drawn or usual; orders, channels and travels are kept.
    """
    entry = MENU[name]
    drawn = _others(name, nominal, rng, {})
    out = {k: x for k, x in drawn.items() if k not in minimum or k in ("phase_rad", "reference_c")}
    sign = float(rng.choice([-1.0, 1.0])) if entry.both else float(np.sign(entry.low + entry.high))
    for parameter, value in minimum.items():
        if parameter in (entry.leading, entry.second):
            base = base_value(name, nominal, parameter)
            away = factor * abs(value - base)
            step = sign * away
            out[parameter] = base + (step if base + step > 0.0 or base == 0.0 else away)
        elif parameter not in out:
            out[parameter] = value
    return out


def _scale(name: str, nominal: Mapping[str, Any]) -> float:
    """Return what a relative size is relative to."""
    if name == "nonlinear_stiffness":
        # share of the linear torque at rated torque: K3 d^2 = K at d = rated/K
        return float(nominal["stiffness_nm_per_rad"] ** 3 / nominal["rated_torque_nm"] ** 2)
    return _file_value(nominal, MENU[name].key)


def _file_value(nominal: Mapping[str, Any], key: str) -> float:
    value: Any = nominal
    for part in key.split("."):
        value = value[part]
    return float(value)


def _others(
    name: str, nominal: Mapping[str, Any], rng: np.random.Generator, given: Mapping[str, float]
) -> dict[str, float]:
    """Draw the parameters that do not carry the size."""
    phase = float(rng.uniform(-np.pi, np.pi))
    low_order = float(rng.choice([1.0, 2.0, 4.0]))
    high_order = float(rng.choice([6.0, 8.0, 10.0, 12.0, 14.0]))
    number = float(rng.uniform())
    return {
        "stribeck_friction": {"stribeck_velocity_rad_s": 0.05 * 4.0**number},
        "temperature_dependent_friction": {"reference_c": 25.0},
        "torque_ripple": {"order_per_motor_rev": low_order, "phase_rad": phase},
        "kinematic_error": {"order_per_motor_rev": low_order, "phase_rad": phase},
        "cogging": {"order_per_motor_rev": high_order, "phase_rad": phase},
        "hysteresis": {"travel_rad": 3e-5 * 10.0**number},
        "torque_constant_temperature": {"reference_c": 25.0},
        "sensor_drift": {"reference_c": 25.0},
        "sensor_crosstalk": {"phase_rad": phase},
        "encoder_eccentricity": {"phase_rad": phase, "motor_side": 0.0},
        "channel_delay": {"channel": float(int(3 * number))},
        "unbalance": {"phase_rad": phase},
    }.get(name, {})
