"""What each effect leaves in the balances of motor and torsion, Nm (docstring of effect.py), written a second time by hand.

One row per effect, or per variant of it; nothing of the library: signals, parameters with defaults filled in, joint file.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.effects.effect import State
from jtqd.estimator.joint import Joint

Law = Callable[[Mapping[str, float], State, Joint], tuple[Any, Any]]


class Row(NamedTuple):
    """Effect, parameters that show clearly on a joint of 40 Nm, and (motor balance, torsion balance)."""

    name: str
    parameters: dict[str, float]
    law: Law


def slipped(d: FloatArray, travel: float) -> FloatArray:
    """Maxwell slip by its definition: the spring's end stays within `travel` of the deflection."""
    out, anchor = [], d[0]
    for now in d:
        anchor = min(max(anchor, now - travel), now + travel)
        out.append((now - anchor) / travel)
    return np.array(out)


def peak(height_nm: float, velocity_rad_s: float, s: State) -> Any:
    return height_nm * np.exp(-((s.velocity_rad_s / velocity_rad_s) ** 2)) * s.direction


def _stribeck(p: Mapping[str, float], s: State, j: Joint) -> tuple[Any, Any]:
    own_nm, own = j.friction.stribeck_nm, j.friction.stribeck_velocity_rad_s
    return peak(p["stribeck_nm"], p.get("stribeck_velocity_rad_s", own), s) - peak(own_nm, own, s), 0


def _temperature(p: Mapping[str, float], s: State, j: Joint) -> tuple[Any, Any]:
    warmer = s.temperature_c - p["reference_c"]
    viscous = j.friction.viscous_nms_per_rad * s.velocity_rad_s * (np.exp(-p["viscous_per_k"] * warmer) - 1.0)
    return viscous + j.friction.coulomb_nm * s.direction * (np.exp(-p["coulomb_per_k"] * warmer) - 1.0), 0


def _wave(p: Mapping[str, float], s: State, j: Joint) -> tuple[Any, Any]:
    return p["amplitude_nm"] * np.cos(p["order_per_motor_rev"] * s.motor_position_rad + p["phase_rad"]), 0


def _kinematic(p: Mapping[str, float], s: State, j: Joint) -> tuple[Any, Any]:
    size, order = p["amplitude_rad"], p["order_per_motor_rev"]
    angle = order * s.motor_position_rad + p["phase_rad"]
    motor = s.torque_nm * j.gear_ratio * order * size * np.cos(angle)
    return motor, -j.stiffness_nm_per_rad * size * np.sin(angle)


def _stiffness(p: Mapping[str, float], s: State, j: Joint) -> tuple[Any, Any]:
    own, d = j.stiffness_nm_per_rad, s.torsion_rad
    return 0, own * d - (p.get("stiffness_nm_per_rad", own) * d + p["cubic_nm_per_rad3"] * d**3)


def _play(p: Mapping[str, float], s: State, j: Joint) -> tuple[Any, Any]:
    d, half = s.torsion_rad, p["width_rad"] / 2.0
    return 0, j.stiffness_nm_per_rad * np.where(np.abs(d) < half, d, half * np.sign(d))


def _gain(p: Mapping[str, float], s: State, j: Joint) -> tuple[Any, Any]:
    return (-(s.torque_nm - s.torque_nm / p["gain"]),) * 2


def _drift(p: Mapping[str, float], s: State, j: Joint) -> tuple[Any, Any]:
    drift = p["rate_nm_per_s"] * s.time_s + p["per_k_nm"] * (s.temperature_c - p["reference_c"])
    return -drift, -drift


def _crosstalk(p: Mapping[str, float], s: State, j: Joint) -> tuple[Any, Any]:
    size = p["amplitude_nm"] + p["share"] * s.torque_nm
    return (-size * np.cos(s.coupling_position_rad + p["phase_rad"]),) * 2


def _eccentricity(p: Mapping[str, float], s: State, j: Joint) -> tuple[Any, Any]:
    if p["motor_side"]:  # the motor's encoder reads A too much, so that theta_m/G does by A/G
        error = -p["amplitude_rad"] / j.gear_ratio * np.sin(s.motor_position_rad + p["phase_rad"])
    else:
        error = p["amplitude_rad"] * np.sin(s.link_position_rad + p["phase_rad"])
    return 0, -j.stiffness_nm_per_rad * error


def _delay(p: Mapping[str, float], s: State, j: Joint) -> tuple[Any, Any]:
    if p["channel"] == 0:
        return (p["delay_s"] * s.torque_rate_nm_s,) * 2
    if p["channel"] == 1:
        return -j.gear_ratio * j.torque_constant_nm_per_a * p["delay_s"] * s.current_rate_a_s, 0
    return 0, j.stiffness_nm_per_rad * p["delay_s"] * s.link_velocity_rad_s


def _link_inertia(p: Mapping[str, float], s: State, j: Joint) -> tuple[Any, Any]:
    return ((p["link_inertia_kgm2"] - j.link_inertia_kgm2) * s.link_acceleration_rad_s2,) * 2


LAWS: tuple[Row, ...] = (
    Row(
        "coulomb_friction",
        {"coulomb_nm": 5.5},
        lambda p, s, j: ((p["coulomb_nm"] - j.friction.coulomb_nm) * s.direction, 0),
    ),
    Row(
        "viscous_friction",
        {"viscous_nms_per_rad": 4.0},
        lambda p, s, j: ((p["viscous_nms_per_rad"] - j.friction.viscous_nms_per_rad) * s.velocity_rad_s, 0),
    ),
    Row("stribeck_friction", {"stribeck_nm": 1.2, "stribeck_velocity_rad_s": 0.3}, _stribeck),
    Row(
        "load_dependent_friction",
        {"load_coefficient": 0.1},
        lambda p, s, j: (p["load_coefficient"] * np.abs(s.torque_nm) * s.direction, 0),
    ),
    Row(
        "friction_asymmetry",
        {"asymmetry_nm": 0.3},
        lambda p, s, j: (p["asymmetry_nm"] * np.abs(s.direction), 0),
    ),
    Row(
        "temperature_dependent_friction",
        {"viscous_per_k": 0.02, "coulomb_per_k": 0.004, "reference_c": 27.0},
        _temperature,
    ),
    Row("torque_ripple", {"amplitude_nm": 0.4, "order_per_motor_rev": 2.0, "phase_rad": 0.7}, _wave),
    Row("cogging", {"amplitude_nm": 0.2, "order_per_motor_rev": 12.0, "phase_rad": -0.7}, _wave),
    Row("kinematic_error", {"amplitude_rad": 1e-4, "order_per_motor_rev": 2.0, "phase_rad": 0.4}, _kinematic),
    Row("nonlinear_stiffness", {"stiffness_nm_per_rad": 13000.0, "cubic_nm_per_rad3": 3e8}, _stiffness),
    Row(
        "hysteresis",
        {"torque_nm": 1.5, "travel_rad": 2e-4},
        lambda p, s, j: (0, -p["torque_nm"] * slipped(s.torsion_rad, p["travel_rad"])),
    ),
    Row("lost_motion", {"width_rad": 2e-4}, _play),
    Row(
        "gear_damping",
        {"damping_nms_per_rad": 20.0},
        lambda p, s, j: (0, (j.damping_nms_per_rad - p["damping_nms_per_rad"]) * s.torsion_rate_rad_s),
    ),
    Row(
        "torque_constant",
        {"torque_constant_nm_per_a": 0.07},
        lambda p, s, j: (
            j.gear_ratio * (j.torque_constant_nm_per_a - p["torque_constant_nm_per_a"]) * s.current_a,
            0,
        ),
    ),
    Row(
        "torque_constant_saturation",
        {"saturation_per_a": 0.02},
        lambda p, s, j: (
            j.gear_ratio
            * j.torque_constant_nm_per_a
            * (s.current_a - s.current_a * (1 - p["saturation_per_a"] * np.abs(s.current_a))),
            0,
        ),
    ),
    Row(
        "torque_constant_temperature",
        {"per_k": -0.002, "reference_c": 26.0},
        lambda p, s, j: (
            -j.gear_ratio
            * j.torque_constant_nm_per_a
            * p["per_k"]
            * (s.temperature_c - p["reference_c"])
            * s.current_a,
            0,
        ),
    ),
    Row(
        "current_offset",
        {"offset_a": 0.05},
        lambda p, s, j: (
            np.full(len(s.time_s), j.gear_ratio * j.torque_constant_nm_per_a * p["offset_a"]),
            0,
        ),
    ),
    Row(
        "rotor_inertia",
        {"rotor_inertia_kgm2": 9e-5},
        lambda p, s, j: (
            j.gear_ratio * (p["rotor_inertia_kgm2"] - j.rotor_inertia_kgm2) * s.motor_acceleration_rad_s2,
            0,
        ),
    ),
    Row("sensor_offset", {"offset_nm": 0.6}, lambda p, s, j: (-p["offset_nm"], -p["offset_nm"])),
    Row("sensor_gain", {"gain": 1.04}, _gain),
    Row("sensor_drift", {"rate_nm_per_s": 0.1, "per_k_nm": 0.05, "reference_c": 20.0}, _drift),
    Row("sensor_crosstalk", {"amplitude_nm": 0.4, "share": 0.02, "phase_rad": 1.1}, _crosstalk),
    Row("encoder_eccentricity", {"amplitude_rad": 5e-5, "phase_rad": 0.3, "motor_side": 0.0}, _eccentricity),
    Row("encoder_eccentricity", {"amplitude_rad": 5e-3, "phase_rad": 0.3, "motor_side": 1.0}, _eccentricity),
    *(Row("channel_delay", {"delay_s": 2e-3, "channel": channel}, _delay) for channel in (0.0, 2.0, 1.0)),
    Row("link_inertia", {"link_inertia_kgm2": 0.04}, _link_inertia),
    Row(
        "unbalance",
        {"moment_nm": 1.1, "phase_rad": -0.4},
        lambda p, s, j: (p["moment_nm"] * np.sin(s.link_position_rad + p["phase_rad"]),) * 2,
    ),
)
LAW_OF: dict[str, Law] = {row.name: row.law for row in LAWS}
ALL: dict[str, dict[str, float]] = {row.name: row.parameters for row in LAWS}
"""One set of parameters per effect: of its last row."""
IDS = [f"{row.name}-{k}" for k, row in enumerate(LAWS)]
