"""Warm magnets are weaker: the torque constant falls with temperature."""

from __future__ import annotations

from typing import Any

from jtqd.estimator.effects.effect import (
    REFERENCE,
    Effect,
    Functions,
    Joint,
    Parameter,
    Slope,
    State,
    Terms,
    Values,
    above,
    reference_of,
)


class TorqueConstantTemperature(Effect):
    group = "actuator"
    equation = "Kt (1 + a (T - T0)), so that loss = -G Kt a (T - T0) i"
    source = "reversible remanence coefficient of NdFeB magnets, IEC 60404-8-1: about -0.0011 per K"
    tell_tale = (
        "The gain of the motor balance over the current drifts with temperature; at equal temperature it "
        "is constant."
    )
    confused_with = {"sensor_gain": "warm_up"}
    experiment = "warm_up"
    parameters = (Parameter("per_k", "1/K", -0.02, 0.02), REFERENCE)
    needs = ("temperature_c",)

    def loss_nm(self, p: Values, s: State, joint: Joint, x: Functions) -> Any:
        scale = -joint.gear_ratio * joint.torque_constant_nm_per_a * p["per_k"]
        return scale * above(s.temperature_c, p["reference_c"]) * s.current_a

    def terms(self, joint: Joint) -> Terms:
        """Return two columns: slope over temperature, and constant."""
        return (Slope("per_k", 1e-3, reference_of(joint.provenance)).term(),)
