"""How a true joint differs from its file: `deviations` of a plant file. Unknown keys are errors."""

from dataclasses import dataclass

from estimator.checked import Section


@dataclass(frozen=True)
class Deviations:
    """How the true joint differs from its file. The defaults are a joint that is exactly as its file says."""

    friction_scale: float = 1.0
    viscous_scale: float = (
        1.0  # of the file's friction.viscous_nms_per_rad; the difference is added to the losses
    )
    torque_constant_scale: float = 1.0
    stiffness_scale: float = 1.0
    rotor_inertia_scale: float = 1.0
    ripple_nm: float = 0.0  # joint side, A cos(order θm + phase) on the motor's load
    ripple_order_per_motor_rev: float = 2.0
    ripple_phase_rad: float = 0.0
    stribeck_nm: float = 0.0
    stribeck_velocity_rad_s: float = 0.05
    kinematic_error_rad: float = 0.0  # joint side, torsion gains A sin(order θm + phase)
    kinematic_error_order_per_motor_rev: float = 2.0
    kinematic_error_phase_rad: float = 0.0
    hysteresis_nm: float = 0.0  # one Maxwell-slip element beside the spring
    hysteresis_travel_rad: float = 1.0e-4  # torsion over which it goes from 0 to hysteresis_nm

    @property
    def kinematic_slope(self) -> float:
        """Largest |de/dθm| of the kinematic error, joint rad per motor rad."""
        return self.kinematic_error_rad * self.kinematic_error_order_per_motor_rev

    @property
    def hysteresis_stiffness(self) -> float:
        """Stiffness of the Maxwell-slip element while it sticks, Nm/rad."""
        return self.hysteresis_nm / self.hysteresis_travel_rad


_SCALES = (
    "friction_scale",
    "viscous_scale",
    "torque_constant_scale",
    "stiffness_scale",
    "rotor_inertia_scale",
)


def deviations_from(section: Section | None) -> Deviations:
    """Checked deviations; None: none. Raises ConfigError."""
    if section is None:
        return Deviations()
    values = {key: section.number(key, unit="1", low=0.0, high=10.0, default=1.0) for key in _SCALES}
    for key in ("torque_constant_scale", "stiffness_scale", "rotor_inertia_scale"):
        if values[key] < 0.05:
            raise section.error(key, values[key], "a number >= 0.05")
    ripple = section.section("ripple", optional=True)
    if ripple is not None:
        values["ripple_nm"] = ripple.number("amplitude_nm", unit="Nm", low=0.0)
        values["ripple_order_per_motor_rev"], values["ripple_phase_rad"] = _order_and_phase(ripple)
        ripple.finish()
    stribeck = section.section("stribeck", optional=True)
    if stribeck is not None:
        values["stribeck_nm"] = stribeck.number("torque_nm", unit="Nm", low=0.0)
        # above 0.06 rad/s the peak would reach into Table I's range, which begins at 0.2 rad/s
        values["stribeck_velocity_rad_s"] = stribeck.number(
            "velocity_rad_s", unit="rad/s", low=0.002, high=0.06, default=0.05
        )
        stribeck.finish()
    error = section.section("kinematic_error", optional=True)
    if error is not None:
        values["kinematic_error_rad"] = error.number("amplitude_rad", unit="rad", low=0.0, high=0.01)
        order, phase = _order_and_phase(error)
        values["kinematic_error_order_per_motor_rev"], values["kinematic_error_phase_rad"] = order, phase
        error.finish()
    hysteresis = section.section("hysteresis", optional=True)
    if hysteresis is not None:
        values["hysteresis_nm"] = hysteresis.number("torque_nm", unit="Nm", low=0.0)
        values["hysteresis_travel_rad"] = hysteresis.number(
            "travel_rad", unit="rad", low=1.0e-6, high=0.1, default=1.0e-4
        )
        hysteresis.finish()
    section.finish()
    return Deviations(**values)


def _order_and_phase(section: Section) -> tuple[float, float]:
    order = section.number("order_per_motor_rev", unit="1/rev", low=0.0, default=2.0)
    return order, section.number("phase_rad", unit="rad", default=0.0)
