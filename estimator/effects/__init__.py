"""Effect library: physical deviations of a joint from the rigid textbook, one file each, for estimator, plant and diagnosis.

EFFECTS has all effects by name. A new effect is a new file of this folder: a subclass of `effect.Effect` registers itself.
Trials hide it by an entry of `validation/diagnosis/entries.py`; `tests/estimator/effects/laws.py` has its law a second time.
"""

from __future__ import annotations

import functools
import importlib
import math
import pkgutil
from collections.abc import Mapping
from types import MappingProxyType
from typing import Annotated, Final

from jtqd.estimator.decoder import Field, FieldError, below, field_of, limits, read_values
from jtqd.estimator.effects.effect import REGISTERED, Effect
from jtqd.estimator.errors import ConfigError


def discover() -> dict[str, Effect]:
    """Import every file of this folder and return the effects by name, in alphabetical order.

    Raises TypeError for an effect that contradicts itself: a mistake of a programmer, seen at the first import.
    """
    for module in pkgutil.iter_modules(__path__):
        importlib.import_module(f"{__name__}.{module.name}")
    return dict(sorted(REGISTERED.items()))


EFFECTS: Final[Mapping[str, Effect]] = MappingProxyType(discover())


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
    if name not in EFFECTS:
        raise ConfigError(f"effect: found {name!r}, expected one of " + ", ".join(EFFECTS))
    return tuple(
        field_of(
            p.name, Annotated[float, limits(p.unit, ge=p.low, le=p.high)], optional=p.default is not None
        )
        for p in EFFECTS[name].parameters
    )
