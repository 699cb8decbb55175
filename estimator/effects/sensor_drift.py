"""Zero of the torque sensor that wanders with time or temperature."""

from __future__ import annotations

from typing import Any

from jtqd.estimator.effects.effect import (
    FALLBACK_C,
    Effect,
    Functions,
    Joint,
    Parameter,
    Slope,
    State,
    Terms,
    Values,
    above,
    linear,
    reference_of,
)


class SensorDrift(Effect):
    group = "measurement"
    equation = "tau_s = TAU_S + r t + k (T - T0), t since the run's first sample"
    source = "zero drift and temperature effect on zero, as in data sheets of torque transducers"
    tell_tale = "A constant of all balances of both joints that grows with time or temperature, at rest too."
    confused_with = {
        "temperature_dependent_friction": "warm_up",
        "torque_constant_temperature": "warm_up",
        "sensor_offset": "warm_up",
    }
    experiment = "warm_up"
    parameters = (
        Parameter("rate_nm_per_s", "Nm/s", -100.0, 100.0, default=0.0),
        Parameter("per_k_nm", "Nm/K", -500.0, 500.0, default=0.0, prior="sensor_drift.per_k_nm"),
        Parameter("reference_c", "°C", -100.0, 200.0, default=FALLBACK_C, neutral=None),
    )
    needs = ("time_s",)
    at_sensor = True

    def sensor_nm(self, p: Values, s: State, joint: Joint, x: Functions) -> Any:
        drift = p["rate_nm_per_s"] * s.time_s
        return drift + p["per_k_nm"] * above(s.temperature_c, p["reference_c"]) if p["per_k_nm"] else drift

    def terms(self, joint: Joint) -> Terms:
        """Return a drift with time, and one with temperature (two columns: slope and constant)."""
        time = linear("rate_nm_per_s", 1e-3, per_k_nm=0.0, reference_c=FALLBACK_C)
        return time, Slope("per_k_nm", 0.01, reference_of(joint.provenance), {"rate_nm_per_s": 0.0}).term()
