"""One channel reads late: what it shows is d seconds old."""

from __future__ import annotations

from typing import Any

from jtqd.estimator.effects.effect import Column, Effect, Functions, Joint, Parameter, State, Values, full

SENSOR, CURRENT, LINK = 0.0, 1.0, 2.0
"""Codes of `channel`."""


class ChannelDelay(Effect):
    group = "measurement"
    equation = "reading(t) = truth(t - d): sensor = -d dtau/dt, current = -d di/dt, link = -d omega_l"
    source = "a shift in time; rates are means over it (age_s), in the loop its first-order Taylor expansion"
    tell_tale = "A loop between the channel and what it is compared with, whose area grows with frequency."
    confused_with = {
        "viscous_friction": "speed_ladder",
        "hysteresis": "load_ramp",
        "rotor_inertia": "quick_changes",
        "torque_ripple": "quick_changes",
    }
    experiment = "quick_changes"
    parameters = (
        Parameter("delay_s", "s", -0.02, 0.1),
        Parameter("channel", "", 0.0, 2.0, default=0.0, fixed=True, whole=True, neutral=None),
    )
    # so small a delay that a mean rate is that of the moment
    columns = tuple(Column("delay_s", 1e-5, {"channel": channel}) for channel in (SENSOR, CURRENT, LINK))
    rate_based = True

    def sensor_nm(self, p: Values, s: State, joint: Joint, x: Functions) -> Any:
        if p["channel"] != SENSOR:
            return full(0.0, s.torque_rate_nm_s)
        return -p["delay_s"] * s.torque_rate_nm_s

    def current_a(self, p: Values, s: State, joint: Joint, x: Functions) -> Any:
        if p["channel"] != CURRENT:
            return full(0.0, s.current_a)
        return -p["delay_s"] * s.current_rate_a_s

    def link_rad(self, p: Values, s: State, joint: Joint, x: Functions) -> Any:
        if p["channel"] != LINK:
            return full(0.0, s.link_velocity_rad_s)
        return -p["delay_s"] * s.link_velocity_rad_s

    def age_s(self, p: Values) -> float:
        """Return the delay: reading(t) - truth(t) = reading(t) - reading(t + d) is -d times the mean rate in between."""
        return p["delay_s"]

    def at_sensor_of(self, p: Values) -> bool:
        return p["channel"] == SENSOR
