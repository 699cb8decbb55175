"""All effects by name, found in the files of this package: a new effect is a new file and nothing else.

A file that defines EFFECT is an effect and has its name; the others are what effects share.
"""

from __future__ import annotations

import functools
import importlib
import math
import pkgutil
import sys
from collections.abc import Mapping
from types import MappingProxyType
from typing import Annotated, Final

from jtqd.estimator.checked import ConfigError
from jtqd.estimator.decoder import Field, FieldError, below, field_of, limits, read_values
from jtqd.estimator.effects.effect import Effect

HOOKS: Final = ("loss_nm", "twist_rad", "load_nm", "current_a", "link_rad", "sensor_nm")
GROUPS: Final = ("friction", "transmission", "actuator", "measurement", "load")

NAMES: Final = (
    "coulomb_friction",
    "viscous_friction",
    "stribeck_friction",
    "load_dependent_friction",
    "friction_asymmetry",
    "temperature_dependent_friction",
    "torque_ripple",
    "kinematic_error",
    "nonlinear_stiffness",
    "hysteresis",
    "lost_motion",
    "gear_damping",
    "torque_constant",
    "torque_constant_saturation",
    "torque_constant_temperature",
    "cogging",
    "current_offset",
    "rotor_inertia",
    "sensor_offset",
    "sensor_gain",
    "sensor_drift",
    "sensor_crosstalk",
    "encoder_eccentricity",
    "channel_delay",
    "link_inertia",
    "unbalance",
)
"""What joint files and findings may rely on; the library may hold more, never fewer."""


_SHARED: Final = ("library", "effect", "regression", "scalar", "whole")
"""Files that hold no effect; `whole` is not loaded for them: it brings numpy, which supervisor and bench do without."""


def discover() -> dict[str, Effect]:
    """Return the effects of this package by name, in alphabetical order.

    Raises TypeError for a file whose EFFECT is not what its name says or has a hook, group or parameter that does
    not exist, and when one of NAMES is missing: mistakes of a programmer, seen at the first import.
    """
    effects: dict[str, Effect] = {}
    for module in pkgutil.iter_modules(sys.modules[__package__].__path__):
        if module.name in _SHARED:
            continue
        effect = getattr(importlib.import_module(f"jtqd.estimator.effects.{module.name}"), "EFFECT", None)
        if effect is not None:
            effects[module.name] = _complete(effect, module.name)
    missing = [name for name in NAMES if name not in effects]
    if missing:
        raise TypeError(f"effect library: missing {', '.join(missing)}")
    return dict(sorted(effects.items()))


def _complete(effect: object, file: str) -> Effect:
    """Return the effect; TypeError when it is not one or contradicts itself."""
    if not isinstance(effect, Effect):
        raise TypeError(f"effect library: {file}.EFFECT: found {effect!r}, expected an Effect")
    if effect.name != file:
        raise TypeError(f"effect library: {file}.EFFECT: found the name {effect.name!r}, expected {file!r}")
    unknown = [hook for hook in effect.hooks if hook not in HOOKS]
    if unknown or not effect.hooks:
        raise TypeError(
            f"effect library: {file}.EFFECT: found hooks {effect.hooks}, expected some of {HOOKS}"
        )
    if effect.group not in GROUPS:
        raise TypeError(
            f"effect library: {file}.EFFECT: found group {effect.group!r}, expected one of {GROUPS}"
        )
    return effect


EFFECTS: Final[Mapping[str, Effect]] = MappingProxyType(discover())


def effect_of(name: str) -> Effect:
    """Return an effect by name. Raises ConfigError for a name that the library does not have."""
    if name not in EFFECTS:
        raise ConfigError(f"effect: found {name!r}, expected one of " + ", ".join(EFFECTS))
    return EFFECTS[name]


def checked_parameters(name: str, given: Mapping[str, float]) -> dict[str, float]:
    """Return the parameters of an effect with defaults filled in, in the library's order.

    A parameter that the joint file's own value stands for (default NaN) stays out unless given. Raises ConfigError for
    an unknown effect or parameter, a missing one, and a value that is no number or out of its plausible range.
    """
    with below("", f"effect {name}"):
        values = read_values(_fields(name), given)
    found: dict[str, float] = {}
    for p in EFFECTS[name].parameters:
        value: float = values.get(p.name, math.nan if p.default is None else p.default)
        if p.whole and value != round(value):
            raise FieldError(f"effect {name}", p.name, value, f"a whole number from {p.low:g} to {p.high:g}")
        if not math.isnan(value):
            found[p.name] = value
    return found


@functools.cache
def _fields(name: str) -> tuple[Field, ...]:
    """Return how the parameters of an effect are read. Raises ConfigError for an unknown effect."""
    return tuple(
        field_of(
            p.name, Annotated[float, limits(p.unit, ge=p.low, le=p.high)], optional=p.default is not None
        )
        for p in effect_of(name).parameters
    )
