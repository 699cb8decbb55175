"""Drives, encoders and torque sensor of the emulated bench: `drive`, `measurement` and `sensor` of a plant
file.
"""

from dataclasses import dataclass

from estimator.checked import Section


@dataclass(frozen=True)
class DriveParameters:
    """Ratings and loops of a drive. Velocity loop gains are on the motor side."""

    rated_current_a: float = 8.0
    current_limit_a: float = 9.0
    trip_current_a: float = 12.0
    current_bandwidth_hz: float = 500.0
    velocity_bandwidth_rad_s: float = 400.0  # of the proportional loop with the rotor's inertia alone
    velocity_integral_time_s: float = 0.01
    acceleration_feedforward: float = 2.0  # in rotor inertias: a towing pair moves both rotors
    friction_feedforward_a: float = 0.0  # sign(reference velocity) times this
    acceleration_limit_rad_s2: float = 60.0  # joint side, of the velocity reference


@dataclass(frozen=True)
class MeasurementParameters:
    """Encoders and current measurement of a drive."""

    motor_counts_per_rev: int = 65536
    link_counts_per_rev: int = 524288
    link_noise_rad: float = 0.0
    velocity_filter_s: float = 0.001
    current_noise_a: float = 0.0
    current_offset_a: float = 0.0


@dataclass(frozen=True)
class SensorParameters:
    """Torque sensor between the joints: measured = gain * true + offset + noise."""

    noise_nm: float = 0.0
    offset_nm: float = 0.0
    gain: float = 1.0


def drive_from(section: Section | None) -> DriveParameters:
    """Checked values; None: the defaults. Raises ConfigError."""
    if section is None:
        return DriveParameters()
    base = DriveParameters()
    rated = section.number("rated_current_a", unit="A", low=0.1, high=1000.0, default=base.rated_current_a)
    limit = section.number("current_limit_a", unit="A", low=0.1, high=20.0 * rated, default=1.125 * rated)
    drive = DriveParameters(
        rated_current_a=rated,
        current_limit_a=limit,
        trip_current_a=section.number("trip_current_a", unit="A", low=0.05, default=1.33 * limit),
        current_bandwidth_hz=section.number(
            "current_bandwidth_hz", unit="Hz", low=50.0, high=5000.0, default=500.0
        ),
        velocity_bandwidth_rad_s=section.number(
            "velocity_bandwidth_rad_s",
            unit="rad/s",
            low=1.0,
            high=2000.0,
            default=base.velocity_bandwidth_rad_s,
        ),
        velocity_integral_time_s=section.number(
            "velocity_integral_time_s", unit="s", low=0.002, high=10.0, default=base.velocity_integral_time_s
        ),
        acceleration_feedforward=section.number(
            "acceleration_feedforward",
            unit="rotor inertias",
            low=0.0,
            high=10.0,
            default=base.acceleration_feedforward,
        ),
        friction_feedforward_a=section.number(
            "friction_feedforward_a", unit="A", low=0.0, high=limit, default=0.0
        ),
        acceleration_limit_rad_s2=section.number(
            "acceleration_limit_rad_s2", unit="rad/s2", low=0.1, default=base.acceleration_limit_rad_s2
        ),
    )
    section.finish()
    return drive


def measurement_from(section: Section | None) -> MeasurementParameters:
    """Checked values; None: the defaults. Raises ConfigError."""
    if section is None:
        return MeasurementParameters()
    measurement = MeasurementParameters(
        motor_counts_per_rev=section.integer("motor_counts_per_rev", low=16, high=1 << 24, default=65536),
        link_counts_per_rev=section.integer("link_counts_per_rev", low=16, high=1 << 26, default=524288),
        link_noise_rad=section.number("link_noise_rad", unit="rad", low=0.0, default=0.0),
        velocity_filter_s=section.number("velocity_filter_s", unit="s", low=0.0, high=0.1, default=0.001),
        current_noise_a=section.number("current_noise_a", unit="A", low=0.0, default=0.0),
        current_offset_a=section.number("current_offset_a", unit="A", default=0.0),
    )
    section.finish()
    return measurement


def sensor_from(section: Section | None) -> SensorParameters:
    """Checked values; None: the defaults. Raises ConfigError."""
    if section is None:
        return SensorParameters()
    sensor = SensorParameters(
        noise_nm=section.number("noise_nm", unit="Nm", low=0.0, default=0.0),
        offset_nm=section.number("offset_nm", unit="Nm", default=0.0),
        gain=section.number("gain", unit="1", low=0.01, high=100.0, default=1.0),
    )
    section.finish()
    return sensor
