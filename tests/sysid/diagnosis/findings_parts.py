"""Parts of which findings are made up: rows of evidence, maps, signals."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from jtqd.sysid.diagnosis.findings import CandidateEvidence, Gap, Place, Trace, Value

INFINITY = float("inf")
NAN = float("nan")
JOINT_EFFECTS: Mapping[str, tuple[str, float, str]] = {
    "coulomb_friction": ("coulomb_nm", 0.06, "Nm"),
    "viscous_friction": ("viscous_nms_per_rad", 0.11, "Nms/rad"),
    "stribeck_friction": ("stribeck_nm", 0.31, "Nm"),
    "load_dependent_friction": ("load_coefficient", 0.012, "1"),
    "friction_asymmetry": ("asymmetry_nm", 0.07, "Nm"),
    "temperature_dependent_friction": ("viscous_per_k", 0.004, "1/K"),
    "torque_ripple": ("amplitude_nm", 0.02, "Nm"),
    "kinematic_error": ("amplitude_rad", 4e-6, "rad"),
    "nonlinear_stiffness": ("cubic_nm_per_rad3", 2.4e8, "Nm/rad3"),
    "hysteresis": ("torque_nm", 0.12, "Nm"),
    "lost_motion": ("width_rad", 2.2e-5, "rad"),
    "torque_constant": ("torque_constant_nm_per_a", 0.0004, "Nm/A"),
    "torque_constant_saturation": ("saturation_per_a", 0.002, "1/A"),
    "torque_constant_temperature": ("per_k", 0.0006, "1/K"),
    "cogging": ("amplitude_nm", 0.02, "Nm"),
    "current_offset": ("offset_a", 0.006, "A"),
    "rotor_inertia": ("rotor_inertia_kgm2", 1.2e-6, "kgm2"),
    "encoder_eccentricity": ("amplitude_rad", 6e-6, "rad"),
    "channel_delay": ("delay_s", 0.0004, "s"),
    "link_inertia": ("link_inertia_kgm2", 0.02, "kgm2"),
    "gear_damping": ("damping_nms_per_rad", 3.0, "Nms/rad"),
    "unbalance": ("moment_nm", 0.05, "Nm"),
}
SENSOR_EFFECTS: Mapping[str, tuple[str, float, str]] = {
    "sensor_offset": ("offset_nm", 0.05, "Nm"),
    "sensor_gain": ("gain", 0.004, "1"),
    "sensor_drift": ("per_k_nm", INFINITY, "Nm/K"),
    "sensor_crosstalk": ("amplitude_nm", 0.06, "Nm"),
    "channel_delay": ("delay_s", 0.0005, "s"),
}


def value(middle: float, half: float, unit: str) -> Value:
    return Value(middle, (middle - half, middle + half), unit)


def given(number: float, unit: str = "") -> Value:
    return Value(number, (number, number), unit)


def candidates(
    joints: tuple[int, ...], chosen: Mapping[tuple[str, int | str], tuple[float, str]]
) -> tuple[CandidateEvidence, ...]:
    """All of the library for these joints; chosen: evidence and reason of those that stand out."""
    keys: list[tuple[str, int | str]] = [(name, j) for j in joints for name in JOINT_EFFECTS]
    keys += [(name, "sensor") for name in SENSOR_EFFECTS]
    random = np.random.default_rng(4)
    rows = []
    for name, joint in keys:
        parameter, size, unit = (SENSOR_EFFECTS if joint == "sensor" else JOINT_EFFECTS)[name]
        minimum = {parameter: Value(size, (size, size), unit)}
        bic, reason = chosen.get((name, joint), (float(random.uniform(-9, 4)), "no evidence beyond the set"))
        if (name, joint) not in chosen and "temperature" in name:
            bic, reason = NAN, "needs temperature_c"
        elif size == INFINITY:
            reason = "invisible in these runs"
        rows.append(CandidateEvidence(name, joint, bic, minimum, reason))
    return tuple(rows)


def places(hot: Mapping[str, Mapping[int, float]]) -> tuple[Place, ...]:
    """A map over all axes; hot: axis to shares of single bins, the rest is even."""
    axes = {
        "velocity": (np.linspace(-1.8, 1.8, 13), "rad/s"),
        "load": (np.linspace(-32.0, 32.0, 13), "Nm"),
        "temperature": (np.linspace(24.0, 41.0, 7), "degC"),
        "motor_angle": (np.linspace(0.0, 2 * np.pi, 17), "rad"),
        "link_angle": (np.linspace(0.0, 2 * np.pi, 17), "rad"),
        "time": (np.linspace(0.0, 60.0, 11), "s"),
        "frequency": (np.array([0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 100.0]), "Hz"),
    }
    out = []
    random = np.random.default_rng(2)
    for axis, (edges, unit) in axes.items():
        shares = random.uniform(0.7, 1.3, len(edges) - 1)
        marked = hot.get(axis, {})
        free = [k for k in range(len(shares)) if k not in marked]
        shares[free] *= (1.0 - sum(marked.values())) / shares[free].sum()
        for k, share in marked.items():
            shares[k] = share
        for low, high, share in zip(edges[:-1], edges[1:], shares, strict=True):
            name = f"{round(low, 9) + 0.0:.3g} to {high:.3g} {unit}"
            out.append(Place(axis, name, float(share), float(low), float(high), unit, 0.3 + float(share)))
    marked = hot.get("quadrant", {})
    rest = (1.0 - sum(marked.values())) / max(1, 4 - len(marked))
    for k, name in enumerate(("+v +tau", "-v +tau", "-v -tau", "+v -tau")):
        out.append(Place("quadrant", name, marked.get(k, rest), float(k), float(k + 1), ""))
    return tuple(out)


def gap(joint: int, balance: str, rmse: float, floor: float, hot: Mapping[str, Mapping[int, float]]) -> Gap:
    """A gap; of each axis that `hot` names the largest places."""
    everywhere = places(hot)
    found = [
        each
        for axis in hot
        for each in sorted((p for p in everywhere if p.axis == axis), key=lambda p: -p.share)[:3]
    ]
    return Gap(joint, balance, rmse, floor, tuple(found))


Gone = Callable[[Any, Any, Any], Any]
"""What the causes explain [n], of velocity, torque and motor angle [n]."""
NOTHING: Gone = lambda v, t, a: 0.0 * v  # noqa: E731
RIPPLE: Gone = lambda v, t, a: 0.418 * np.cos(2 * a)  # noqa: E731
VISCOUS: Gone = lambda v, t, a: 1.4 * v  # noqa: E731
SLIP: Gone = lambda v, t, a: 3.0 * np.exp(-(((a / 100 - 1.2) / 0.05) ** 2))  # noqa: E731
GAIN: Gone = lambda v, t, a: 0.048 * t  # noqa: E731


def trace(run: str, joint: int, balance: str, gone: Gone, *, seconds: float = 60.0, seed: int = 1) -> Trace:
    """One run of Fourier velocity against Fourier torque, 200 Hz."""
    random = np.random.default_rng(seed)
    time = np.arange(0.0, seconds, 0.005)
    phases = random.uniform(0.0, 2 * np.pi, 8)
    velocity = sum(0.55 * np.sin(2 * np.pi * 0.07 * k * time + phases[k]) for k in (1, 2, 3))
    torque = sum(9.0 * np.sin(2 * np.pi * 0.053 * k * time + phases[k + 3]) for k in (1, 2, 4))
    angle = 100.0 * np.cumsum(velocity) * 0.005
    noise = random.normal(0.0, 0.1, len(time))
    slow = np.convolve(random.normal(0.0, 1.0, len(time)), np.ones(60) / 60, "same")
    after = noise + 0.9 * slow
    before = after + gone(velocity, torque, angle)
    return Trace(run, joint, balance, time, before, after, velocity, torque + before)
