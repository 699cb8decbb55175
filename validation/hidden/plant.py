"""Physical constants of many benches at once, as arrays [2, B] (joint, run): nominal, drifted, with hidden effects."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

Array = np.ndarray

MOTOR_FAMILY: Final = ("torque_ripple", "cogging")

# Array -> value of a bench without hidden effects.
_NEUTRAL: Final = {
    "stribeck": 0.0,
    "stribeck_velocity": 0.05,
    "load_coefficient": 0.0,
    "asymmetry": 0.0,
    "viscous_per_k": 0.0,
    "coulomb_per_k": 0.0,
    "friction_reference": 25.0,
    "kinematic": 0.0,
    "kinematic_order": 2.0,
    "kinematic_phase": 0.0,
    "cubic": 0.0,
    "hysteresis": 0.0,
    "travel": 1e-4,
    "play": 0.0,
    "saturation": 0.0,
    "constant_per_k": 0.0,
    "constant_reference": 25.0,
    "unbalance": 0.0,
    "unbalance_phase": 0.0,
    # measurement
    "current_offset": 0.0,
    "link_eccentricity": 0.0,
    "link_eccentricity_phase": 0.0,
    "motor_eccentricity": 0.0,
    "motor_eccentricity_phase": 0.0,
    "current_delay": 0.0,
    "link_delay": 0.0,
    # sensor: row 0 counts
    "sensor_offset": 0.0,
    "sensor_gain": 1.0,
    "sensor_rate": 0.0,
    "sensor_per_k": 0.0,
    "sensor_reference": 25.0,
    "crosstalk": 0.0,
    "crosstalk_share": 0.0,
    "crosstalk_phase": 0.0,
    "sensor_delay": 0.0,
}


class Plant:
    """Arrays [2, B] by attribute; waves: motor-side torque waves (joint, run, amplitude, order, phase)."""

    def __init__(self, joints: list[tuple[dict[str, Any], dict[str, Any]]], viscous_factor: Array) -> None:
        def of(key: str, inner: str = "") -> Array:
            rows = [[(j[inner] if inner else j)[key] for j in pair] for pair in joints]
            return np.array(rows, np.float64).T.copy()

        self.count = len(joints)
        self.ratio = of("gear_ratio")
        self.torque_constant = of("torque_constant_nm_per_a")
        self.rotor = of("rotor_inertia_kgm2")
        self.stiffness = of("stiffness_nm_per_rad")
        self.damping = of("damping_nms_per_rad")
        self.link_inertia = of("link_inertia_kgm2")
        self.rated = of("rated_torque_nm")
        self.coulomb = of("coulomb_nm", "friction")
        self.viscous = of("viscous_nms_per_rad", "friction")
        self.viscous_factor = viscous_factor
        self.waves: list[tuple[int, int, float, float, float]] = []
        for name, value in _NEUTRAL.items():
            setattr(self, name, np.full((2, self.count), value))

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(name)

    def hide(self, name: str, row: int, run: int, p: Mapping[str, float]) -> None:
        """Give joint `row` (sensor: 0) of run `run` the effect; parameters as in the joint file."""
        if name in MOTOR_FAMILY:
            wave = (p["amplitude_nm"], p["order_per_motor_rev"], p["phase_rad"])
            self.waves.append((row, run, *wave))
            return
        if name == "encoder_eccentricity":
            side = "motor" if p.get("motor_side", 0.0) else "link"
            getattr(self, f"{side}_eccentricity")[row, run] = p["amplitude_rad"]
            getattr(self, f"{side}_eccentricity_phase")[row, run] = p["phase_rad"]
            return
        if name == "channel_delay":
            channel = ("sensor", "current", "link")[int(p["channel"])]
            getattr(self, f"{channel}_delay")[0 if channel == "sensor" else row, run] = p["delay_s"]
            return
        for key, array in _ARRAYS[name].items():
            if key in p:
                getattr(self, array)[row, run] = p[key]


# Effect -> parameter -> array it is written to.
_ARRAYS: Final[dict[str, dict[str, str]]] = {
    "coulomb_friction": {"coulomb_nm": "coulomb"},
    "viscous_friction": {"viscous_nms_per_rad": "viscous"},
    "stribeck_friction": {"stribeck_nm": "stribeck", "stribeck_velocity_rad_s": "stribeck_velocity"},
    "load_dependent_friction": {"load_coefficient": "load_coefficient"},
    "friction_asymmetry": {"asymmetry_nm": "asymmetry"},
    "temperature_dependent_friction": {
        "viscous_per_k": "viscous_per_k",
        "coulomb_per_k": "coulomb_per_k",
        "reference_c": "friction_reference",
    },
    "kinematic_error": {
        "amplitude_rad": "kinematic",
        "order_per_motor_rev": "kinematic_order",
        "phase_rad": "kinematic_phase",
    },
    "nonlinear_stiffness": {"stiffness_nm_per_rad": "stiffness", "cubic_nm_per_rad3": "cubic"},
    "hysteresis": {"torque_nm": "hysteresis", "travel_rad": "travel"},
    "lost_motion": {"width_rad": "play"},
    "gear_damping": {"damping_nms_per_rad": "damping"},
    "torque_constant": {"torque_constant_nm_per_a": "torque_constant"},
    "torque_constant_saturation": {"saturation_per_a": "saturation"},
    "torque_constant_temperature": {"per_k": "constant_per_k", "reference_c": "constant_reference"},
    "current_offset": {"offset_a": "current_offset"},
    "rotor_inertia": {"rotor_inertia_kgm2": "rotor"},
    "sensor_offset": {"offset_nm": "sensor_offset"},
    "sensor_gain": {"gain": "sensor_gain"},
    "sensor_drift": {
        "rate_nm_per_s": "sensor_rate",
        "per_k_nm": "sensor_per_k",
        "reference_c": "sensor_reference",
    },
    "sensor_crosstalk": {
        "amplitude_nm": "crosstalk",
        "share": "crosstalk_share",
        "phase_rad": "crosstalk_phase",
    },
    "link_inertia": {"link_inertia_kgm2": "link_inertia"},
    "unbalance": {"moment_nm": "unbalance", "phase_rad": "unbalance_phase"},
}
