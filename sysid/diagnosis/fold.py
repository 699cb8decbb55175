"""A joint whose effects that replace a value of its file are put into that value: the same joint in other words. Pure.

With an efficiency in the file the losses are the table's: there another friction or torque constant in the file is not
the effect that bears its name, which is what is lost beside the table. Such an effect stays an effect.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from estimator.effects.library import EFFECTS
from estimator.parameters import Joint


def fold(joint: Joint) -> Joint:
    """Return the joint with every effect put into the file's values where all its given parameters have a key for it."""
    kept = []
    for item in joint.effects:
        effect = EFFECTS[item.name]
        keys = {p.name: p.key for p in effect.parameters}
        beside_table = joint.efficiency is not None and "loss_nm" in effect.hooks and not effect.changes_joint
        if beside_table or not all(keys[name] for name in item.parameters):
            kept.append(item)
            continue
        for name, value in item.parameters.items():
            joint = _with(joint, keys[name].split("."), value)
    return replace(joint, effects=tuple(kept))


def _with(joint: Joint, path: list[str], value: float) -> Joint:
    if len(path) == 1:
        changed: dict[str, Any] = {path[0]: value}
        return replace(joint, **changed)
    inner: dict[str, Any] = {path[1]: value}
    return replace(joint, friction=replace(joint.friction, **inner))
