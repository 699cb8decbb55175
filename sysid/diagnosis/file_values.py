"""Values of the joint file of each parameter that a diagnosis found: file value -> found value, change in percent."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from jtqd.estimator.effects import EFFECTS
from jtqd.estimator.joint import Joint


class FileValue(NamedTuple):
    """What the file has. value: of the file, or of no effect (a gain of 1, an amplitude of 0), None where there is none to
    compare with; key: the file's key, "" where it has none.
    """

    value: float | None
    key: str

    def change(self, found: float) -> float | None:
        """Return the relative change, None from nothing or zero."""
        if self.value is None or self.value == 0.0 or not math.isfinite(found):
            return None
        return found / self.value - 1.0


def file_values(
    effect_name: str, where: int | str, parameters: Iterable[str], joints: Mapping[int, Joint]
) -> dict[str, FileValue]:
    """Return the joint file's value of each parameter of an effect of joint `where` (or "sensor").

    An effect that is in the file under `effects` has its value there; else a parameter that stands for a key of the file has
    that key's; any other has the value that means no effect.
    """
    joint = joints.get(where) if isinstance(where, int) else next(iter(joints.values()), None)
    effect = EFFECTS.get(effect_name)
    if joint is None or effect is None:
        return {}
    listed = next((item.parameters for item in joint.effects if item.name == effect_name), None)
    known = {parameter.name: parameter for parameter in effect.parameters}
    found = {}
    for name in parameters:
        parameter = known.get(name)
        key = parameter.key if parameter else ""
        if listed is not None and name in listed:
            found[name] = FileValue(float(listed[name]), f"effects: {effect_name}.{name}")
        elif key:
            found[name] = FileValue(_value(joint, key), key)
        else:
            found[name] = FileValue(parameter.neutral if parameter else 0.0, "")
    return found


def _value(joint: Joint, key: str) -> float:
    value: Any = joint
    for part in key.split("."):
        value = getattr(value, part)
    return float(value)
