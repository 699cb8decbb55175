"""What plant files and bench files say about drives and the torque sensor: sections `drive` and `sensor`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Final

from jtqd.estimator.decoder import FieldError, limits
from jtqd.estimator.errors import range_text


@dataclass(frozen=True)
class DriveParameters:
    """Ratings and loops of a drive (`drive`). Velocity loop gains are on the motor side.

    velocity_bandwidth_rad_s: of the proportional loop with the rotor's inertia alone; acceleration_feedforward: in
    rotor inertias, as a towing pair moves both rotors; friction_feedforward_a: times sign(reference velocity);
    acceleration_limit_rad_s2: joint side, of the velocity reference. Currents left out follow from the rated one.
    """

    rated_current_a: Annotated[float, limits("A", ge=0.1, le=1000.0)] = 8.0
    current_limit_a: Annotated[float, limits("A", ge=0.1)] = math.nan
    trip_current_a: Annotated[float, limits("A", ge=0.05)] = math.nan
    current_bandwidth_hz: Annotated[float, limits("Hz", ge=50.0, le=5000.0)] = 500.0
    velocity_bandwidth_rad_s: Annotated[float, limits("rad/s", ge=1.0, le=2000.0)] = 400.0
    velocity_integral_time_s: Annotated[float, limits("s", ge=0.002, le=10.0)] = 0.01
    acceleration_feedforward: Annotated[float, limits("rotor inertias", ge=0.0, le=10.0)] = 2.0
    friction_feedforward_a: Annotated[float, limits("A", ge=0.0)] = 0.0
    acceleration_limit_rad_s2: Annotated[float, limits("rad/s2", ge=0.1)] = 60.0

    def __post_init__(self) -> None:
        if math.isnan(self.current_limit_a):
            object.__setattr__(self, "current_limit_a", 1.125 * self.rated_current_a)
        if math.isnan(self.trip_current_a):
            object.__setattr__(self, "trip_current_a", 1.33 * self.current_limit_a)
        for key, high in (
            ("current_limit_a", 20.0 * self.rated_current_a),
            ("friction_feedforward_a", self.current_limit_a),
        ):
            value = getattr(self, key)
            if value > high:
                raise FieldError("drive", key, value, range_text("a number in A", None, high, None))


USUAL_DRIVE: Final = DriveParameters(trip_current_a=12.0)
"""Of a joint without a section `drive`."""


@dataclass(frozen=True)
class SensorParameters:
    """Torque sensor between the joints (`sensor`): measured = gain * true + offset + noise."""

    noise_nm: Annotated[float, limits("Nm", ge=0.0)] = 0.0
    offset_nm: Annotated[float, limits("Nm")] = 0.0
    gain: Annotated[float, limits(ge=0.01, le=100.0)] = 1.0
