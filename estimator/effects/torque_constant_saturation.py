"""Saturation: at large currents the motor gives less torque per ampere."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from jtqd.estimator.effects.effect import (
    Effect,
    Functions,
    JointValues,
    Parameter,
    State,
    Term,
    Values,
    linear,
)


class TorqueConstantSaturation(Effect):
    """Symbols as in `jtqd.estimator.effects.effect`."""

    name = "torque_constant_saturation"
    group = "actuator"
    equation = "tau_motor = Kt i (1 - k |i|), so that loss = G Kt k i |i|"
    source = "Hanselman 2006, Brushless Permanent Magnet Motor Design (iron saturation, first order)"
    tell_tale = (
        "The motor balance bends with the current: nothing at small currents, odd and quadratic at large "
        "ones."
    )
    confused_with = {
        "sensor_gain": "load_at_both_directions",
    }
    experiment = "load_at_both_directions"
    parameters = (Parameter("saturation_per_a", "1/A", 0.0, 0.5),)
    hooks = ("loss_nm",)

    def loss_nm(self, p: Values, s: State, joint: JointValues, x: Functions) -> Any:
        """Return the torque lost beyond the file's losses, Nm joint side."""
        scale = joint.gear_ratio * joint.torque_constant_nm_per_a * p["saturation_per_a"]
        return scale * s.current_a * abs(s.current_a)

    def terms(self, joint: JointValues) -> Sequence[Term]:
        """Return one column."""
        return (linear("saturation_per_a", 0.01),)
