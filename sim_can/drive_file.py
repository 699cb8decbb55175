"""What plant files and bench files say about drives and the torque sensor: sections `drive` and `sensor`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

from jtqd.estimator.checked import Section
from jtqd.estimator.decoder import decode, limits


@dataclass(frozen=True)
class DriveParameters:
    """Ratings and loops of a drive (`drive`). Velocity loop gains are on the motor side.

    velocity_bandwidth_rad_s: of the proportional loop with the rotor's inertia alone; acceleration_feedforward: in
    rotor inertias, as a towing pair moves both rotors; friction_feedforward_a: times sign(reference velocity);
    acceleration_limit_rad_s2: joint side, of the velocity reference.
    """

    rated_current_a: Annotated[float, limits("A", ge=0.1, le=1000.0)] = 8.0
    current_limit_a: Annotated[float, limits("A", ge=0.1)] = 9.0
    trip_current_a: Annotated[float, limits("A", ge=0.05)] = 12.0
    current_bandwidth_hz: Annotated[float, limits("Hz", ge=50.0, le=5000.0)] = 500.0
    velocity_bandwidth_rad_s: Annotated[float, limits("rad/s", ge=1.0, le=2000.0)] = 400.0
    velocity_integral_time_s: Annotated[float, limits("s", ge=0.002, le=10.0)] = 0.01
    acceleration_feedforward: Annotated[float, limits("rotor inertias", ge=0.0, le=10.0)] = 2.0
    friction_feedforward_a: Annotated[float, limits("A", ge=0.0)] = 0.0
    acceleration_limit_rad_s2: Annotated[float, limits("rad/s2", ge=0.1)] = 60.0

    @classmethod
    def from_section(cls, section: Section) -> DriveParameters:
        """Read `drive` of a plant file; currents left out follow from the rated one. Raises ConfigError."""
        drive = decode(cls, section)
        if not section.has("current_limit_a"):
            drive = replace(drive, current_limit_a=1.125 * drive.rated_current_a)
        if not section.has("trip_current_a"):
            drive = replace(drive, trip_current_a=1.33 * drive.current_limit_a)
        for key, value, high in (
            ("current_limit_a", drive.current_limit_a, 20.0 * drive.rated_current_a),
            ("friction_feedforward_a", drive.friction_feedforward_a, drive.current_limit_a),
        ):
            if value > high:
                raise section.error(key, value, f"a number in A <= {high:g}")
        return drive


@dataclass(frozen=True)
class SensorParameters:
    """Torque sensor between the joints (`sensor`): measured = gain * true + offset + noise."""

    noise_nm: Annotated[float, limits("Nm", ge=0.0)] = 0.0
    offset_nm: Annotated[float, limits("Nm")] = 0.0
    gain: Annotated[float, limits(ge=0.01, le=100.0)] = 1.0
