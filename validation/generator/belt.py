"""One joint with a voltage-driven motor and a belt or a gear, from which trials of the diagnosis are drawn; numpy, scipy.

A user has one joint: on a pendulum of known mass, in an arm whose rigid-body model gives the torque, or towed by a load
machine behind a torque sensor. Joint side, p = theta_m/G, v = dp/dt, q link position, u = dq/dt, T temperature:

    L di/dt = U - R i - Ke omega_m      U = duty * supply(t), |duty| <= 1: current loop (PI), or duty of position and speed
    G^2 Jm dv/dt = G Kt i (1 - k|i|)(1 + a (T - T0)) - loss - tau                            Ke = Kt of the values
    loss = s (Fc e^(-c(T - T0)) + Fs e^(-(v/vs)^2) + mu |tau| + ...) + asym |s| + Fv e^(-b(T - T0)) v
           + sum of A cos(n theta_m + phi) + tau G E k cos(k theta_m + psi)
    tau = K x + K3 x^3 + H z + D dd/dt    d = p - q + E sin(k theta_m + psi) - slip, x = d beyond the play +-w/2
    (Jl + J) du/dt = tau - load - outer   load = U sin(q + phi) + ..., acts between gear and torque reference
    outer:  pendulum m g l sin(q);  arm m g l (1 + small) sin(q) and what the other joints do;  sensor: load machine
    torque = tau - Jl du/dt - load        what the reference gives: J du/dt + outer
    C dT/dt = losses/Rth - (T - Tair)     winding and gear in one, time constant of minutes

s in -1..1 is a bristle (Dahl): s' = (v - |v| s)/travel, so that a joint sticks; z is an elastic slip (Prandtl), held at
+-1. Of the day and not of the joint: friction is different by some tenths of a percent from run to run, so are air
temperature, supply and the zero of the link encoder. Semi-implicit Euler (positions leap over velocities; winding and
bristle implicit) at STEP_S, all runs side by side: fastest mode omega h < 0.6.

Readings are samples of the state, never averaged: encoders and current in counts; the current with ripple of commutation,
whose phase wanders, and noise below 60 Hz; the sensor with noise of both colours; then digits. The arm's model has noise
and a gravity that is wrong by some tenths of a percent.

Names and parameters of effects are those of joint files. Foreign effects (`FOREIGN`) are in no library:

    pulley_slip          the belt creeps while |tau| is above a limit; angle is lost for good
    tight_spot           friction is larger within a few degrees of one link angle
    power_friction       friction A |v/v0|^0.6
    cable_chain          a spring that engages beyond a link angle
    supply_constant      the torque per ampere follows the supply voltage
    wear_step            Coulomb friction jumps in the middle of one run, and stays
    frame_resonance      the frame gives way: share (x - tau), x'' = w^2 (tau - x) - 2 zeta w x'
    current_into_sensor  the sensor reads a part of |i|

    plant = draw_plant(rng, load="pendulum", encoders=1, transmission="belt")
    hidden = with_effect(plant, "viscous_friction", rng=rng)
    runs = record(hidden, [Recording("multisine", k) for k in range(6)], seed=1)   # columns of run tables
    joint_file(plant), columns_file(plant)                                         # what the user has; the truth: hidden
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any, Final

import numpy as np
from scipy.signal import lfilter

Array = np.ndarray
STEP_S: Final = 1.0 / 4000.0
BLOCK: Final = 400
"""Steps between updates of what is slow: temperature, supply, wear."""
LOADS: Final = ("pendulum", "sensor", "arm")
TRANSMISSIONS: Final = ("belt", "gear")
MOTIONS: Final = ("sines", "chirp", "multisine", "trapezoid", "ladder", "creep", "load_steps")
TEMPERATURES: Final = ("measured", "constant", "absent")
REFERENCE_C: Final = 25.0
GRAVITY_M_S2: Final = 9.80665
_SLOWEST_RAD_S: Final = 0.03


@dataclass(frozen=True)
class Plant:
    """All true values, SI. values: by dotted key of the joint file; nominal: the same as drawn, without any effect.

    effects: structural effect of the library -> parameters as in a joint file (those that replace a value are in `values`);
    foreign: effect of FOREIGN -> parameters. drive: winding_ohm, winding_h, supply_v, rated_a, top_rad_s (joint side), duty
    (1: voltage from position and speed, 0: current loop), bandwidth_rad_s. body: inertia_kgm2 (J), mass_kg, lever_m,
    gravity_error, travel_rad (motions stay within), bristle_rad, warm_k_per_w, warm_s. noise: bits of encoders and current,
    shares of rated torque or current.
    """

    transmission: str
    load: str
    encoders: int
    values: Mapping[str, float]
    nominal: Mapping[str, float]
    drive: Mapping[str, float]
    body: Mapping[str, float]
    noise: Mapping[str, float]
    effects: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    foreign: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    @property
    def hidden(self) -> tuple[str, ...]:
        """Names of all that `with_effect` has put in."""
        changed = [
            name for name, keys in _KEYS.items() if any(self.values[k] != self.nominal[k] for k in keys)
        ]
        return tuple(dict.fromkeys((*changed, *self.effects, *self.foreign)))


@dataclass(frozen=True)
class Recording:
    """One run: motion of MOTIONS drawn with `seed`, as a recorder of rate_hz (100..1000) writes it with so many digits
    (significant ones, stamps too; 12: as good as exact). temperature: of TEMPERATURES.
    """

    motion: str = "multisine"
    seed: int = 0
    seconds: float = 30.0
    rate_hz: float = 500.0
    digits: int = 7
    temperature: str = "measured"

    def __post_init__(self) -> None:
        if self.motion not in MOTIONS or self.temperature not in TEMPERATURES:
            raise ValueError(
                f"found {self.motion!r}, {self.temperature!r}, expected {MOTIONS}, {TEMPERATURES}"
            )
        if not (100.0 <= self.rate_hz <= 1000.0 and 4 <= self.digits <= 12 and self.seconds >= 2.0):
            raise ValueError("expected 100 to 1000 Hz, 4 to 12 digits, 2 s and more")


@dataclass(frozen=True)
class Truth:
    """True signals at STEP_S, arrays [n, runs], by name: see `_integrated`."""

    signals: SimpleNamespace
    runs: tuple[Recording, ...]


def _log(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(math.log(low), math.log(high))))


def draw_plant(rng: np.random.Generator, *, load: str, encoders: int, transmission: str) -> Plant:
    """Return a healthy plant of plausible size; its joint file is exact and has no structural effects."""
    if load not in LOADS or encoders not in (1, 2) or transmission not in TRANSMISSIONS:
        raise ValueError(
            f"found {load!r}, {encoders}, {transmission!r}, expected {LOADS}, 1 or 2, {TRANSMISSIONS}"
        )
    belt = transmission == "belt"
    ratio = float(np.round(rng.uniform(3.0, 12.0), 2)) if belt else float(rng.integers(30, 151))
    constant, rated_a = _log(rng, 0.05, 0.15), rng.uniform(4.0, 9.0)
    rated = max(0.9 * ratio * constant * rated_a, 3.0)
    constant = rated / (0.9 * ratio * rated_a)
    motor_rad_s = rng.uniform(150.0, 300.0)
    speed = motor_rad_s / ratio
    # the rotor alone takes 30 to 120 ms to its top speed with its rated torque
    rotor = constant * rated_a * rng.uniform(0.03, 0.12) / motor_rad_s
    reflected = rotor * ratio**2
    twist = rng.uniform(0.008, 0.018) if belt else rng.uniform(0.0015, 0.004)
    stiffness = rated / twist
    weight = rated * rng.uniform(0.45, 0.75)
    lever = rng.uniform(0.12, 0.4) if belt else rng.uniform(0.3, 0.7)
    mass = weight / (GRAVITY_M_S2 * lever)
    inertia = mass * lever**2 * rng.uniform(1.0, 1.15)
    if load == "sensor":
        inertia = reflected * (rng.uniform(3.0, 6.0) if belt else rng.uniform(0.6, 1.2))
    hub = inertia * rng.uniform(0.02, 0.06)
    reduced = reflected * (inertia + hub) / (reflected + inertia + hub)
    coulomb = rated * rng.uniform(0.03, 0.08)
    top = min(0.8 * speed, 8.0)
    values = {
        "gear_ratio": ratio,
        "torque_constant_nm_per_a": constant,
        "rotor_inertia_kgm2": rotor,
        "stiffness_nm_per_rad": stiffness,
        "damping_nms_per_rad": 2.0 * rng.uniform(0.03, 0.08) * math.sqrt(stiffness * reduced),
        "link_inertia_kgm2": hub,
        "rated_torque_nm": rated,
        "friction.coulomb_nm": coulomb,
        "friction.viscous_nms_per_rad": rated * rng.uniform(0.04, 0.09) / top,
        "friction.stribeck_nm": coulomb * rng.uniform(0.05, 0.2),
        "friction.stribeck_velocity_rad_s": max(rng.uniform(0.02, 0.05) * top, 0.04),
    }
    resistance = rng.uniform(0.2, 0.5) * constant * motor_rad_s / rated_a
    drive = {
        "winding_ohm": resistance,
        "winding_h": resistance * _log(rng, 1e-4, 1.5e-3),
        "supply_v": 1.5 * (constant * motor_rad_s + 2.0 * resistance * rated_a),
        "rated_a": rated_a,
        "top_rad_s": top,
        "duty": float(belt and load == "pendulum" and rng.uniform() < 0.6),
        "bandwidth_rad_s": 2.0 * math.pi * rng.uniform(4.0, 7.0),
    }
    body = {
        "inertia_kgm2": inertia,
        "mass_kg": 0.0 if load == "sensor" else mass,
        "lever_m": lever,
        "gravity_error": rng.normal(0.0, 0.002) if load == "arm" else 0.0,
        "travel_rad": min(6.0, 1.5 * top) if load == "sensor" else min(rng.uniform(1.2, 2.6), top),
        # stiffness of the bristle: omega h of the rotor on it at most 0.4
        "bristle_rad": max(2e-5, 1.2 * coulomb / (reflected * (0.4 / STEP_S) ** 2)),
        "warm_k_per_w": rng.uniform(8.0, 20.0) / (0.1 * resistance * rated_a**2 + 0.02 * rated * top),
        "warm_s": rng.uniform(40.0, 150.0),
    }
    noise = {
        "motor_bits": float(rng.integers(14, 19)),
        "link_bits": float(rng.integers(18, 22)),
        "current_bits": float(rng.integers(12, 15)),
        "commutation": rng.uniform(0.001, 0.004),
        "segments": float(rng.integers(11, 40)),
        "current": rng.uniform(0.0003, 0.001),
        "torque": rng.uniform(0.0002, 0.0006),
        "day": rng.uniform(0.002, 0.005),
    }
    return Plant(transmission, load, encoders, values, dict(values), drive, body, noise)


def joint_file(plant: Plant) -> dict[str, Any]:
    """Return the true joint file as a mapping; that of the plant as drawn is what a user has."""
    out: dict[str, Any] = {"name": f"{plant.transmission}_{plant.load}", "friction": {}}
    for key, value in plant.values.items():
        target = out["friction"] if key.startswith("friction.") else out
        target[key.removeprefix("friction.")] = float(value)
    out["effects"] = [{"name": name, "parameters": dict(p)} for name, p in plant.effects.items()]
    out["provenance"] = {"source": "validation/generator/belt.py", "temperature_c": REFERENCE_C}
    return out


def columns_file(plant: Plant, *, temperature: bool = True) -> dict[str, Any] | None:
    """Return the column map, None where the run tables need none; temperature: the runs have a column of it."""
    if plant.load == "sensor":
        return None
    ratio = plant.values["gear_ratio"]
    out: dict[str, Any] = {name: name for name in ("time_s", "j1.current_a", "j1.motor_position_rad")}
    link = {"column": "j1.motor_position_rad", "scale": 1.0 / ratio}
    out["j1.link_position_rad"] = link if plant.encoders == 1 else "j1.link_position_rad"
    if temperature:
        out["j1.temperature_c"] = "j1.temperature_c"
    if plant.load == "arm":
        out["j1.load"] = {"torque_nm": "model_torque_nm"}
    else:
        out["j1.load"] = {
            "mass_kg": plant.body["mass_kg"],
            "lever_m": plant.body["lever_m"],
            "inertia_kgm2": plant.body["inertia_kgm2"],
        }
    return out


def _clip(x: Any, most: float) -> Any:
    return np.minimum(np.maximum(x, -most), most)


# Laws. P: numbers of a plant (`_numbers`); x: state, arrays [runs] in the loop, [n, runs] of a whole recording.


def _numbers(plant: Plant) -> SimpleNamespace:
    v = plant.values
    p: dict[str, Any] = {key.removeprefix("friction."): value for key, value in v.items()}
    p |= dict.fromkeys(("sensor_drift_rate_nm_per_s", "sensor_drift_per_k_nm"), 0.0)
    p |= dict.fromkeys(("sensor_crosstalk_amplitude_nm", "sensor_crosstalk_share"), 0.0)
    p["sensor_drift_reference_c"] = REFERENCE_C
    p |= {f"{name}_{key}": x for name, e in plant.effects.items() for key, x in e.items()}
    p |= {f"{name}_{key}": x for name, e in plant.foreign.items() for key, x in e.items()}
    has = {*plant.effects, *plant.foreign}
    waves = [plant.effects[name] for name in ("torque_ripple", "cogging") if name in has]
    numbers = SimpleNamespace(**p, has=has, body=plant.body, waves=waves, load=plant.load)
    numbers.offset_a = plant.effects.get("current_offset", {}).get("offset_a", 0.0)
    numbers.full = v["gear_ratio"] * v["torque_constant_nm_per_a"]
    numbers.reflected = v["gear_ratio"] ** 2 * v["rotor_inertia_kgm2"]
    return numbers


def _slow(p: SimpleNamespace, x: SimpleNamespace) -> tuple[Any, Any, Any]:
    """Return Coulomb and viscous friction of the day, and G Kt, at temperature, supply and wear."""
    coulomb, viscous, gain = p.coulomb_nm * x.day_c, p.viscous_nms_per_rad * x.day_v, p.full
    warmer = x.temperature
    if "temperature_dependent_friction" in p.has:
        above = warmer - p.temperature_dependent_friction_reference_c
        viscous = viscous * np.exp(-p.temperature_dependent_friction_viscous_per_k * above)
        coulomb = coulomb * np.exp(-p.temperature_dependent_friction_coulomb_per_k * above)
    if "torque_constant_temperature" in p.has:
        above = warmer - p.torque_constant_temperature_reference_c
        gain = gain * (1.0 + p.torque_constant_temperature_per_k * above)
    if "supply_constant" in p.has:
        gain = gain * (1.0 + p.supply_constant_share * (x.supply - 1.0))
    if "wear_step" in p.has:
        coulomb = coulomb + p.wear_step_nm * x.worn
    return coulomb, viscous, gain


def _motor(p: SimpleNamespace, gain: Any, i: Any) -> Any:
    if "torque_constant_saturation" in p.has:
        return gain * i * (1.0 - p.torque_constant_saturation_saturation_per_a * abs(i))
    return gain * i


def _loss(p: SimpleNamespace, coulomb: Any, viscous: Any, x: SimpleNamespace) -> Any:
    level = coulomb
    if p.stribeck_nm:
        ratio = x.v * (1.0 / p.stribeck_velocity_rad_s)
        level = level + p.stribeck_nm * np.exp(-ratio * ratio)
    if "load_dependent_friction" in p.has:
        level = level + p.load_dependent_friction_load_coefficient * abs(x.tau)
    if "tight_spot" in p.has:
        away = (x.q - p.tight_spot_at_rad) / p.tight_spot_width_rad
        level = level + p.tight_spot_nm * np.exp(-away * away)
    if "power_friction" in p.has:
        level = level + p.power_friction_nm * (abs(x.v) / p.power_friction_at_rad_s) ** 0.6
    loss = x.s * level + viscous * x.v
    if "friction_asymmetry" in p.has:
        loss = loss + p.friction_asymmetry_asymmetry_nm * abs(x.s)
    for wave in p.waves:
        turn = wave["order_per_motor_rev"] * p.gear_ratio
        loss = loss + wave["amplitude_nm"] * np.cos(turn * x.p + wave["phase_rad"])
    if "kinematic_error" in p.has:
        turn = p.kinematic_error_order_per_motor_rev * p.gear_ratio
        wave = np.cos(turn * x.p + p.kinematic_error_phase_rad)
        loss = loss + x.tau * (turn * p.kinematic_error_amplitude_rad) * wave
    return loss


def _twist(p: SimpleNamespace, x: SimpleNamespace) -> tuple[Any, Any]:
    """Return d and its rate (creep of the belt apart)."""
    d, rate = x.p - x.q, x.v - x.u
    if "kinematic_error" in p.has:
        turn, size = p.kinematic_error_order_per_motor_rev * p.gear_ratio, p.kinematic_error_amplitude_rad
        angle = turn * x.p + p.kinematic_error_phase_rad
        d, rate = d + size * np.sin(angle), rate + (size * turn) * np.cos(angle) * x.v
    if "pulley_slip" in p.has:
        d = d - x.slip
    return d, rate


def _spring(p: SimpleNamespace, d: Any, rate: Any, z: Any) -> Any:
    """Return the torque that the transmission carries."""
    if "lost_motion" in p.has:
        half = 0.5 * p.lost_motion_width_rad
        d = d - _clip(d, half)
        rate = rate * (d != 0.0)
    tau = p.stiffness_nm_per_rad * d + p.damping_nms_per_rad * rate
    if "nonlinear_stiffness" in p.has:
        tau = tau + p.nonlinear_stiffness_cubic_nm_per_rad3 * d * d * d
    if "hysteresis" in p.has:
        tau = tau + p.hysteresis_torque_nm * z
    return tau


def _load(p: SimpleNamespace, x: SimpleNamespace) -> Any:
    """Return what acts on the link besides inertia and what the torque reference knows; 0.0 for nothing."""
    load: Any = 0.0
    if "unbalance" in p.has:
        load = p.unbalance_moment_nm * np.sin(x.q + p.unbalance_phase_rad)
    if "cable_chain" in p.has:
        load = load + p.cable_chain_nm_per_rad * np.maximum(x.q - p.cable_chain_from_rad, 0.0)
    if "frame_resonance" in p.has:
        load = load + p.frame_resonance_share * (x.frame - x.tau)
    return load


def _sensed(p: SimpleNamespace, x: SimpleNamespace) -> Any:
    """Return what a sensor without noise and delay reads of x.torque."""
    reading, has = x.torque, p.has
    if "sensor_gain" in has:
        reading = p.sensor_gain_gain * reading
    if "sensor_offset" in has:
        reading = reading + p.sensor_offset_offset_nm
    if "sensor_drift" in has:
        warmer = x.temperature - p.sensor_drift_reference_c
        reading = reading + p.sensor_drift_rate_nm_per_s * x.t + p.sensor_drift_per_k_nm * warmer
    if "sensor_crosstalk" in has:
        size = p.sensor_crosstalk_amplitude_nm + p.sensor_crosstalk_share * x.torque
        reading = reading + size * np.cos(x.q + p.sensor_crosstalk_phase_rad)
    if "current_into_sensor" in has:
        reading = reading + p.current_into_sensor_nm_per_a * abs(x.i)
    return reading


def _lag(p: SimpleNamespace, channel: int) -> float:
    here = "channel_delay" in p.has and int(p.channel_delay_channel) == channel
    return float(p.channel_delay_delay_s) if here else 0.0


def _eccentric(p: SimpleNamespace, x: SimpleNamespace) -> tuple[Any, Any]:
    """Return the errors of motor encoder and link encoder [rad, own side]."""
    if "encoder_eccentricity" not in p.has:
        return 0.0, 0.0
    size, phase = p.encoder_eccentricity_amplitude_rad, p.encoder_eccentricity_phase_rad
    if p.encoder_eccentricity_motor_side:
        return size * np.sin(p.gear_ratio * x.p + phase), 0.0
    return 0.0, size * np.sin(x.q + phase)


# Motions: what a person makes a joint do.


def _soft(x: Array, wide_s: float) -> Array:
    """Return x through two moving averages, ends held."""
    n = max(1, round(wide_s / STEP_S))
    for _ in range(2):
        total = np.cumsum(np.concatenate((np.full(n, x[0]), x)))
        x = (total[n:] - total[:-n]) / n
    return x


def _held(rng: np.random.Generator, t: Array, least_s: float, most_s: float) -> Array:
    """Return levels in -1..1 that each last for a random time."""
    out, at = np.empty_like(t), 0.0
    while at <= t[-1]:
        more = rng.uniform(least_s, most_s)
        out[(t >= at - 1e-9) & (t < at + more)] = rng.uniform(-1.0, 1.0)
        at += more
    return out


def _sines(rng: np.random.Generator, t: Array, low_hz: float, high_hz: float, count: int) -> Array:
    """Return a sum of sines with a largest magnitude of 1."""
    f = np.exp(rng.uniform(math.log(low_hz), math.log(high_hz), count))
    x = sum(np.sin(2 * np.pi * (a * t + b)) / a**0.5 for a, b in zip(f, rng.uniform(size=count), strict=True))
    return np.asarray(x / np.max(np.abs(x)))


def _velocity(rng: np.random.Generator, kind: str, t: Array, limits: tuple[float, float, float]) -> Array:
    """Return a velocity [n] of about these limits: travel to either side [rad], speed [rad/s], bend [rad/s2]."""
    travel, speed, bend = limits
    slowest = max(0.012 * speed, 0.05)
    if kind in ("sines", "multisine"):
        best = min(speed / travel, math.sqrt(bend / travel)) / (2 * np.pi)
        low, high, count = (0.7, 1.8, 2) if kind == "sines" else (0.4, 6.0, 8)
        return np.asarray(np.gradient(travel * _sines(rng, t, low * best, high * best, count), STEP_S))
    if kind == "chirp":
        w = 2 * np.pi * 0.08 * rng.uniform(15.0, 35.0) ** (t / t[-1])
        size = np.minimum(np.minimum(travel, 0.9 * speed / w), 0.8 * bend / w**2)
        return np.asarray(w * size * np.cos(np.cumsum(w) * STEP_S))
    if kind in ("trapezoid", "load_steps"):
        times, wide = ((1.6, 3.0), rng.uniform(0.4, 1.0)) if kind == "trapezoid" else ((2.0, 4.0), 0.8)
        far = min(travel, 0.5 * speed * wide, 0.5 * bend * wide**2)
        return np.asarray(np.gradient(_soft(far * _held(rng, t, *times), wide), STEP_S))
    # levels in both directions, as many strokes as the travel needs
    fastest = speed if kind == "ladder" else 4.0 * slowest
    levels = rng.permutation(np.geomspace(slowest, fastest, 6 if kind == "ladder" else 3))
    v = np.zeros_like(t)
    slot = t[-1] / len(levels)
    for k, level in enumerate(levels):
        at = t - k * slot
        here = (at >= 0.0) & (at < slot)
        strokes = max(1, math.ceil(level * slot / (3.6 * travel)))
        turn = np.floor(at[here] / slot * 4 * strokes).astype(int) % 4
        v[here] = level * np.where((turn == 0) | (turn == 3), 1.0, -1.0)
    return _soft(v, max(0.1, 2.2 * fastest / bend))


def _position(rng: np.random.Generator, kind: str, t: Array, limits: tuple[float, float, float]) -> Array:
    """Return a link position [n] from rest to rest, within the limits of `_velocity`."""
    window = np.clip(np.minimum(t - 0.3, t[-1] - 0.3 - t) / 0.7, 0.0, 1.0)
    travel, speed, bend = limits
    v = window * window * (3.0 - 2.0 * window) * _velocity(rng, kind, t, limits)
    x = np.cumsum(v) * STEP_S
    over = max(
        np.max(np.abs(x)) / travel, np.max(np.abs(v)) / speed, np.max(np.abs(np.diff(v))) / STEP_S / bend
    )
    return np.asarray(x / (over if kind in ("sines", "multisine") else max(over, 1.0)))


@dataclass(frozen=True)
class _References:
    """Arrays [n, runs]: q, its rate, outer torque, current of an open loop [A]; towed [runs]: the load machine leads."""

    q: Array
    u: Array
    outer: Array
    current: Array
    towed: Array


def _references(plant: Plant, runs: Sequence[Recording], n: int) -> _References:
    v, rated = plant.values, plant.values["rated_torque_nm"]
    total = (
        plant.body["inertia_kgm2"] + v["link_inertia_kgm2"] + v["gear_ratio"] ** 2 * v["rotor_inertia_kgm2"]
    )
    q, outer, current = np.zeros((n, len(runs))), np.zeros((n, len(runs))), np.zeros((n, len(runs)))
    towed = np.zeros(len(runs), bool)
    for r, run in enumerate(runs):
        rng = np.random.default_rng([run.seed, 11])
        m = round(run.seconds / STEP_S)
        t = STEP_S * np.arange(m)
        shape = np.clip(np.minimum(t - 0.3, t[-1] - 0.3 - t) / 0.7, 0.0, 1.0)
        shape = shape * shape * shape * (10.0 - 15.0 * shape + 6.0 * shape * shape)
        speed = plant.drive["top_rad_s"] * rng.uniform(0.7, 1.0)
        bend = min(0.35 * rated / total, 12.0 * speed)
        far = plant.body["travel_rad"] * rng.uniform(0.75, 1.0)
        x = _position(rng, run.motion, t, (far, speed, bend))
        q[:m, r] = x
        q[m:, r] = q[m - 1, r]
        if plant.load == "pendulum":
            continue
        if plant.load == "arm":
            size = rng.uniform(0.02, 0.12)
        else:
            size = rng.uniform(0.35, 0.6)
            towed[r] = rng.uniform() < 0.5
        if run.motion in ("load_steps", "ladder", "creep") and plant.load == "sensor":
            wave = _soft(_held(rng, t, 0.8, 2.5), 0.08)
        else:
            wave = _sines(rng, t, 0.08, 1.2, 5)
        push = size * rated * shape * wave
        if towed[r]:
            current[:m, r] = push / (v["gear_ratio"] * v["torque_constant_nm_per_a"])
        else:
            outer[:m, r] = push
    u = np.vstack((np.diff(q, axis=0), np.zeros((1, len(runs))))) / STEP_S
    return _References(q, u, outer, current, towed)


# Integration and readings.

_KEPT: Final = ("p", "v", "q", "u", "i", "s", "tau", "acc", "beta", "z", "slip", "frame")


def simulate(plant: Plant, recordings: Sequence[Recording], seed: int, *, quiet: bool = False) -> Truth:
    """Return the true signals; quiet: friction does not differ from run to run."""
    rng = np.random.default_rng([seed, 5])
    n = round(max(run.seconds for run in recordings) / STEP_S)
    n += -n % BLOCK
    count = len(recordings)
    spread = 0.0 if quiet else plant.noise["day"]
    x = SimpleNamespace(**{name: np.zeros(count) for name in _KEPT})
    x.day_c, x.day_v = 1.0 + spread * rng.normal(size=count), 1.0 + spread * rng.normal(size=count)
    air = rng.permutation(np.linspace(20.0, 34.0, count)) + rng.uniform(-1.0, 1.0, count)
    x.temperature = air + rng.uniform(0.0, 6.0, count)
    droop = rng.uniform(0.9, 1.0, count), rng.uniform(0.01, 0.06, count), rng.uniform(4.0, 12.0, count)
    signals = _integrated(plant, x, _references(plant, recordings, n), air, droop)
    return Truth(signals, tuple(recordings))


def _integrated(  # noqa: PLR0915 - one loop
    plant: Plant, x: SimpleNamespace, ref: _References, air: Array, droop: tuple[Array, Array, Array]
) -> SimpleNamespace:
    """Return arrays [n, runs] by name: _KEPT, t, temperature, supply (of nominal), worn, outer, load, torque; p, q, i, tau,
    torque, acc, beta are of one instant, v and u of half a step earlier.
    """
    p, h, (n, count) = _numbers(plant), STEP_S, ref.q.shape
    v, drive, body = plant.values, plant.drive, plant.body
    kept = np.empty((n, len(_KEPT), count))
    link = body["inertia_kgm2"] + p.link_inertia_kgm2
    total = link + p.reflected
    nominal = v["gear_ratio"] * plant.nominal["torque_constant_nm_per_a"]
    stiff, damp = (
        total * drive["bandwidth_rad_s"] ** 2 / nominal,
        1.4 * total * drive["bandwidth_rad_s"] / nominal,
    )
    alone = np.where(ref.towed, 0.0, 1.0)
    kp, kd = stiff * alone, damp * alone
    lead, brake = ref.towed * link * (2 * np.pi * 6.0) ** 2, ref.towed * 1.6 * link * 2 * np.pi * 6.0
    resistance, emf = drive["winding_ohm"], p.full
    over = h / drive["winding_h"]
    implicit = 1.0 / (1.0 + over * resistance)
    duty = bool(drive["duty"])
    gain_p, gain_i = drive["winding_h"] * 1200.0, resistance * 1200.0 * h
    most_a, volt = 2.5 * drive["rated_a"], drive["supply_v"]
    weight = body["mass_kg"] * GRAVITY_M_S2 * body["lever_m"] * (1.0 + body["gravity_error"])
    x.worn, x.supply = np.zeros(count), np.ones(count)
    bent, slides, frame = h / body["bristle_rad"], "pulley_slip" in p.has, "frame_resonance" in p.has
    elastic = "hysteresis" in p.has
    t = h * np.arange(n)[:, None]
    ripple = 0.01 * np.sin(2 * np.pi * 100.0 * t)
    supply = droop[0] - droop[1] * 0.5 * (1.0 - np.cos(2 * np.pi * t / droop[2])) + ripple
    worn = np.zeros((n, count))
    if "wear_step" in p.has:
        first = int(p.wear_step_run * count)
        worn[:, first + 1 :] = 1.0
        worn[int(p.wear_step_share * n) // BLOCK * BLOCK :, first] = 1.0
    temperature = np.empty((n, count))
    total_i = np.zeros(count)
    bend_rate = np.zeros(count)
    d = _twist(p, x)[0]
    coulomb, viscous, gain = _slow(p, x)
    for k in range(n):
        if k % BLOCK == 0:
            if k:
                old = kept[k - BLOCK : k]
                lost = resistance * np.mean(old[:, 4] ** 2, 0) + np.mean(np.abs(old[:, 1]), 0) * coulomb
                lost = lost + viscous * np.mean(old[:, 1] ** 2, 0)
                warm = body["warm_k_per_w"] * lost - (x.temperature - air)
                x.temperature = x.temperature + BLOCK * h / body["warm_s"] * warm
            x.worn, x.supply = worn[k], supply[k]
            temperature[k : k + BLOCK] = x.temperature
            coulomb, viscous, gain = _slow(p, x)
        before, (d, rate) = d, _twist(p, x)
        if elastic:
            x.z = _clip(x.z + (d - before) / p.hysteresis_travel_rad, 1.0)
        x.tau = tau = _spring(p, d, rate, x.z)
        wanted = kp * (ref.q[k] - x.p) + kd * (ref.u[k] - x.v) + ref.current[k]
        wanted = _clip(wanted, most_a)
        if duty:
            asked = resistance * wanted + emf * ref.u[k]
        else:
            error = wanted - x.i
            asked = resistance * wanted + emf * x.v + gain_p * error + total_i
            total_i = _clip(total_i + gain_i * error, volt)
        voltage = _clip(asked, volt) * supply[k]
        x.i = (x.i + over * (voltage - emf * x.v)) * implicit
        step = bent * x.v
        x.s = (x.s + step) / (1.0 + abs(step))
        x.acc = (_motor(p, gain, x.i) - _loss(p, coulomb, viscous, x) - tau) * (1.0 / p.reflected)
        outer = ref.outer[k] + lead * (x.q - ref.q[k]) + brake * (x.u - ref.u[k]) + weight * np.sin(x.q)
        x.beta = (tau - _load(p, x) - outer) * (1.0 / link)
        kept[k] = (x.p, x.v, x.q, x.u, x.i, x.s, tau, x.acc, x.beta, x.z, x.slip, x.frame)
        if slides:
            above = tau - _clip(tau, p.pulley_slip_above_nm)
            x.slip = x.slip + h * p.pulley_slip_rad_per_nms * above
        if frame:
            omega = p.frame_resonance_rad_s
            bend_rate = bend_rate + h * omega * (omega * (tau - x.frame) - 2.0 * 0.04 * bend_rate)
            x.frame = x.frame + h * bend_rate
        x.v = x.v + h * x.acc
        x.u = x.u + h * x.beta
        x.p = x.p + h * x.v
        x.q = x.q + h * x.u
    out = SimpleNamespace(**{name: kept[:, k] for k, name in enumerate(_KEPT)})
    out.t, out.temperature, out.supply, out.worn = t, temperature, np.repeat(supply[::BLOCK], BLOCK, 0), worn
    out.day_c, out.day_v = x.day_c, x.day_v
    out.load, out.outer = _load(p, out), ref.outer
    out.torque = out.tau - p.link_inertia_kgm2 * out.beta - out.load
    return out


def _at(x: Array, place: Array) -> Array:
    """Return x [n] between its samples: the cubic through four of them; exact on a sample."""
    k = np.clip(np.floor(place + 1e-9).astype(int), 1, len(x) - 3)
    a = place - k
    low, high = a * (a - 1.0) / 6.0, a * (a + 1.0) / 6.0
    weights = (
        -low * (a - 2.0),
        (a + 1.0) * (a - 1.0) * (a - 2.0) / 2.0,
        -3.0 * high * (a - 2.0),
        high * (a - 1.0),
    )
    return np.asarray(sum(w * x[k + j] for j, w in enumerate(weights, -1)))


def _coloured(rng: np.random.Generator, n: int, corner_hz: float) -> Array:
    """Return noise [n] at STEP_S below a corner, standard deviation 1."""
    a = math.exp(-2.0 * math.pi * corner_hz * STEP_S)
    return np.asarray(lfilter([math.sqrt(1.0 - a * a)], [1.0, -a], rng.normal(size=n)))


def _digits(x: Array, digits: int) -> Array:
    size = np.floor(np.log10(np.maximum(np.abs(x), 1e-300)))
    unit = 10.0 ** (digits - 1.0 - np.clip(size, -30.0, 30.0))
    return np.asarray(np.round(x * unit) / unit)


def record(
    plant: Plant, recordings: Sequence[Recording], seed: int, *, quiet: bool = False
) -> list[dict[str, Array]]:
    """Return the run tables: columns [n] by name of the contract, and `model_torque_nm` of an arm.

    quiet: without noise, counts, zeros and differences from run to run; digits are kept.
    """
    x, p = simulate(plant, recordings, seed, quiet=quiet).signals, _numbers(plant)
    motor_error, link_error = _eccentric(p, x)
    # readings [n, runs] and how late each is
    readings = {
        "j1.current_a": (x.i + p.offset_a, _lag(p, 1)),
        "j1.motor_position_rad": (p.gear_ratio * x.p + motor_error, 0.0),
    }
    if plant.encoders == 2:
        readings["j1.link_position_rad"] = (x.q + link_error, _lag(p, 2))
    if plant.load == "sensor":
        readings["j1.torque_nm"] = (_sensed(p, x), _lag(p, 0))
    elif plant.load == "arm":
        weight = plant.body["mass_kg"] * GRAVITY_M_S2 * plant.body["lever_m"]
        model = plant.body["inertia_kgm2"] * x.beta + weight * np.sin(x.q) + x.outer
        readings["model_torque_nm"] = (model, 0.0)
    tables = []
    for r, run in enumerate(recordings):
        rng = np.random.default_rng([seed, 7, r])
        time = np.arange(math.floor(run.seconds * run.rate_hz + 1e-6)) / run.rate_hz
        table = {"time_s": time}
        for name, (reading, late) in readings.items():
            true = reading[:, r]
            if not quiet:
                true = true + _disturbance(rng, plant, name, x.i[:, r], x.p[:, r])
            table[name] = _at(true, np.maximum(time - late, 0.0) / STEP_S)
            if not quiet:
                table[name] = _counted(rng, plant, name, table[name])
        if run.temperature != "absent":
            moment = np.floor(time * 10.0) * 10.0 * 0.01 / STEP_S  # read at 10 Hz, in tenths
            warm = np.round(x.temperature[moment.astype(int), r], 1)
            table["j1.temperature_c"] = (
                warm if run.temperature == "measured" else np.full(len(time), REFERENCE_C)
            )
        tables.append({name: _digits(column, run.digits) for name, column in table.items()})
    return tables


def _disturbance(rng: np.random.Generator, plant: Plant, name: str, i: Array, p: Array) -> Array | float:
    """Return what disturbs a reading before it is sampled [n], at STEP_S."""
    noise, n = plant.noise, len(i)
    if name == "j1.current_a":
        wander = np.cumsum(rng.normal(size=n)) * math.sqrt(STEP_S / 0.05)
        angle = 2.0 * noise["segments"] * plant.values["gear_ratio"] * p + wander
        low = _coloured(rng, n, 60.0)
        return np.asarray(
            noise["commutation"] * i * np.cos(angle) + noise["current"] * plant.drive["rated_a"] * low
        )
    if name == "j1.link_position_rad":
        return rng.normal(0.0, 2e-4)  # its zero
    if name == "j1.motor_position_rad":
        return 0.0
    return noise["torque"] * plant.values["rated_torque_nm"] * 0.7 * _coloured(rng, n, 20.0)


def _counted(rng: np.random.Generator, plant: Plant, name: str, x: Array) -> Array:
    """Return samples [n] as a converter or an encoder gives them."""
    noise = plant.noise
    if name == "j1.current_a":
        unit = 5.2 * plant.drive["rated_a"] / 2.0 ** noise["current_bits"]
    elif name.endswith("position_rad"):
        unit = 2.0 * math.pi / 2.0 ** noise["motor_bits" if "motor" in name else "link_bits"]
    elif name == "j1.torque_nm":
        rated = plant.values["rated_torque_nm"]
        x, unit = x + 0.7 * noise["torque"] * rated * rng.normal(size=len(x)), 4.0 * rated / 2.0**16
    else:
        return x
    return np.asarray(unit * np.round(x / unit))


# What can be hidden.

_KEYS: Final[dict[str, tuple[str, ...]]] = {
    "coulomb_friction": ("friction.coulomb_nm",),
    "viscous_friction": ("friction.viscous_nms_per_rad",),
    "stribeck_friction": ("friction.stribeck_nm", "friction.stribeck_velocity_rad_s"),
    "torque_constant": ("torque_constant_nm_per_a",),
    "rotor_inertia": ("rotor_inertia_kgm2",),
    "link_inertia": ("link_inertia_kgm2",),
    "gear_damping": ("damping_nms_per_rad",),
    "nonlinear_stiffness": ("stiffness_nm_per_rad",),
}
"""Effects that replace values of the joint file."""
_STRUCTURAL: Final = (
    *("load_dependent_friction", "friction_asymmetry", "temperature_dependent_friction", "torque_ripple"),
    *("kinematic_error", "hysteresis", "lost_motion", "torque_constant_saturation"),
    *(
        "torque_constant_temperature",
        "cogging",
        "current_offset",
        "sensor_offset",
        "sensor_gain",
        "sensor_drift",
    ),
    *("sensor_crosstalk", "encoder_eccentricity", "channel_delay", "unbalance"),
)
EFFECTS: Final = (*_KEYS, *_STRUCTURAL)
FOREIGN: Final = (
    *("pulley_slip", "tight_spot", "power_friction", "cable_chain", "supply_constant", "wear_step"),
    *("frame_resonance", "current_into_sensor"),
)
_TWO_ENCODERS: Final = frozenset(
    (
        "nonlinear_stiffness",
        "hysteresis",
        "lost_motion",
        "gear_damping",
        "encoder_eccentricity",
        "pulley_slip",
    )
)
_SENSOR: Final = frozenset(name for name in (*EFFECTS, *FOREIGN) if "sensor" in name)


def showable(plant: Plant) -> tuple[str, ...]:
    """Return the names of EFFECTS and FOREIGN that runs of this kind of plant can show at all."""
    out = []
    for name in (*EFFECTS, *FOREIGN):
        needless = (name in _TWO_ENCODERS and plant.encoders == 1) or (
            name in _SENSOR and plant.load != "sensor"
        )
        strange = (name == "pulley_slip" and plant.transmission != "belt") or (
            name == "cable_chain" and plant.load == "sensor"
        )
        if not (needless or strange):
            out.append(name)
    return tuple(out)


def with_effect(plant: Plant, name: str, size: float = 1.0, *, rng: np.random.Generator) -> Plant:
    """Return the plant with an effect of EFFECTS or FOREIGN; size 1: what a careful user would notice, some percent of the
    rated torque at its largest; signs, phases, orders and places are drawn. ValueError where the plant cannot show it.
    """
    if name not in showable(plant):
        raise ValueError(f"found {name!r}, expected one of {', '.join(showable(plant))}")
    if name in FOREIGN:
        return replace(plant, foreign={**plant.foreign, name: _foreign(plant, name, size, rng)})
    if name not in _KEYS:
        return replace(plant, effects={**plant.effects, name: _structural(plant, name, size, rng)})
    v, sign, effects = dict(plant.values), float(rng.choice((-1.0, 1.0))), dict(plant.effects)
    key = _KEYS[name][0]
    if name == "stribeck_friction":
        v[key] += 0.35 * size * v["friction.coulomb_nm"]
    elif name == "link_inertia":
        v[key] += 0.25 * size * plant.body["inertia_kgm2"]
    elif name == "gear_damping":
        v[key] *= 1.0 + 10.0 * size
    elif name == "nonlinear_stiffness" and sign > 0.0:
        twist = v["rated_torque_nm"] / v[key]
        effects[name] = {"cubic_nm_per_rad3": 0.25 * size * v["rated_torque_nm"] / twist**3}
    else:
        share = {
            "coulomb_friction": 0.3,
            "viscous_friction": 0.35,
            "torque_constant": 0.05,
            "rotor_inertia": 0.3,
        }
        v[key] *= max(1.0 + sign * size * share.get(name, 0.15), 0.3)
    return replace(plant, values=v, effects=effects)


def _structural(  # noqa: PLR0911
    plant: Plant, name: str, size: float, rng: np.random.Generator
) -> dict[str, float]:
    """Return the parameters of an effect, as in a joint file."""
    v, two = plant.values, plant.encoders == 2
    ratio, rated, rated_a = v["gear_ratio"], v["rated_torque_nm"], plant.drive["rated_a"]
    twist, sign, share = (
        rated / v["stiffness_nm_per_rad"],
        float(rng.choice((-1.0, 1.0))),
        float(rng.uniform()),
    )
    phase, warm = {"phase_rad": float(rng.uniform(-math.pi, math.pi))}, {"reference_c": REFERENCE_C}
    belt = plant.transmission == "belt"
    slow_order = float(rng.choice((1.0, 2.0) if belt else (1.0, 2.0, 4.0)))
    if name == "kinematic_error":
        wave = 0.02 * twist if two else 0.04 / (ratio * slow_order)
        return {"amplitude_rad": min(wave * size, 0.005), "order_per_motor_rev": slow_order} | phase
    if name == "cogging":
        order = float(rng.choice((6.0, 12.0, 18.0, 24.0) if belt else (12.0, 24.0, 36.0, 42.0)))
        return {"amplitude_nm": 0.012 * rated * size, "order_per_motor_rev": order} | phase
    if name == "sensor_drift":
        per_k = {"per_k_nm": sign * 0.0015 * rated * size} | warm
        return per_k if share < 0.5 else {"rate_nm_per_s": sign * 0.0008 * rated * size}
    if name == "sensor_crosstalk":
        return ({"share": 0.035 * size} if share < 0.5 else {"amplitude_nm": 0.012 * rated * size}) | phase
    if name == "encoder_eccentricity":
        wave = 0.02 * twist * size * (1.0 if share < 0.7 else ratio)
        return {"amplitude_rad": min(wave, 0.1), "motor_side": float(share >= 0.7)} | phase
    if name == "channel_delay":
        channels = [1.0, *([2.0] if two else []), *([0.0] if plant.load == "sensor" else [])]
        channel = float(rng.choice(channels))
        return {"delay_s": (0.002 if channel == 2.0 else 0.006) * size, "channel": channel}
    simple: dict[str, dict[str, float]] = {
        "load_dependent_friction": {"load_coefficient": 0.06 * size},
        "friction_asymmetry": {"asymmetry_nm": sign * 0.012 * rated * size},
        "temperature_dependent_friction": {"viscous_per_k": 0.02 * size, "coulomb_per_k": 0.004 * size}
        | warm,
        "torque_ripple": {"amplitude_nm": 0.015 * rated * size, "order_per_motor_rev": slow_order} | phase,
        "hysteresis": {"torque_nm": 0.015 * rated * size, "travel_rad": (0.03 + 0.07 * share) * twist},
        "lost_motion": {"width_rad": 0.06 * twist * size},
        "torque_constant_saturation": {"saturation_per_a": 0.06 / rated_a * size},
        "torque_constant_temperature": {"per_k": -0.003 * size} | warm,
        "current_offset": {"offset_a": sign * 0.012 * rated_a * size},
        "sensor_offset": {"offset_nm": sign * 0.012 * rated * size},
        "sensor_gain": {"gain": 1.0 + sign * 0.04 * size},
        "unbalance": {"moment_nm": 0.02 * rated * size} | phase,
    }
    return simple[name]


def _foreign(plant: Plant, name: str, size: float, rng: np.random.Generator) -> dict[str, float]:
    v, travel = plant.values, plant.body["travel_rad"]
    rated = v["rated_torque_nm"]
    at = float(rng.uniform(-0.4, 0.4)) * travel
    made: dict[str, dict[str, float]] = {
        "pulley_slip": {"above_nm": 0.3 * rated, "rad_per_nms": 0.5 * size / v["stiffness_nm_per_rad"]},
        "tight_spot": {"nm": 0.06 * rated * size, "at_rad": at, "width_rad": float(rng.uniform(0.05, 0.12))},
        "power_friction": {"nm": 0.06 * rated * size, "at_rad_s": plant.drive["top_rad_s"]},
        "cable_chain": {"nm_per_rad": 0.08 * rated * size / travel, "from_rad": at},
        "supply_constant": {"share": 0.5 * size},
        "wear_step": {
            "nm": 0.03 * rated * size,
            "run": float(rng.uniform(0.2, 0.8)),
            "share": float(rng.uniform(0.3, 0.7)),
        },
        "frame_resonance": {"share": 0.6 * size, "rad_s": 2.0 * math.pi * float(rng.uniform(9.0, 20.0))},
        "current_into_sensor": {"nm_per_a": 0.05 * rated / plant.drive["rated_a"] * size},
    }
    return made[name]


def without(plant: Plant, name: str) -> Plant:
    """Return the plant without one hidden effect."""
    values = dict(plant.values) | {key: plant.nominal[key] for key in _KEYS.get(name, ())}
    effects = {key: p for key, p in plant.effects.items() if key != name}
    foreign = {key: p for key, p in plant.foreign.items() if key != name}
    return replace(plant, values=values, effects=effects, foreign=foreign)


def relevance(plant: Plant, name: str, recordings: Sequence[Recording], seed: int) -> float:
    """Return what a hidden effect is worth on these runs: rms in percent of the rated torque of the difference that it makes
    in the balance where it makes most, laws with and without it along the plant's true motion. The motor's balance counts
    where the joint moves, the torsion's (two encoders) everywhere and without each run's mean, which a zero would take.
    """
    if name not in plant.hidden:
        raise ValueError(f"found {name!r}, expected one of {plant.hidden}")
    truth = simulate(plant, recordings, seed, quiet=True)
    x, last = truth.signals, [round(run.seconds / STEP_S) for run in recordings]
    motor, torsion = (
        a - b for a, b in zip(_balances(plant, x), _balances(without(plant, name), x), strict=True)
    )
    moving = np.abs(x.v) > _SLOWEST_RAD_S
    squares = [motor[:n, r][moving[:n, r]] ** 2 for r, n in enumerate(last)]
    worth = float(np.mean(np.concatenate(squares)))
    if plant.encoders == 2:
        worth = max(worth, float(np.mean(np.concatenate([torsion[:n, r] for r, n in enumerate(last)]) ** 2)))
    return 100.0 * math.sqrt(worth) / plant.values["rated_torque_nm"]


def _balances(plant: Plant, x: SimpleNamespace) -> tuple[Array, Array]:
    """Return motor and torsion balance [n, runs] by the laws of `plant` along given true signals, sensor errors in both."""
    p, shape = _numbers(plant), x.p.shape

    def late(a: Array, channel: int) -> Array:
        lag = _lag(p, channel)
        return np.interp(x.t[:, 0] - lag, x.t[:, 0], a) - a if lag else np.zeros_like(a)

    def each(a: Array, channel: int) -> Array:
        return np.stack([late(column, channel) for column in a.T], 1) if _lag(p, channel) else np.zeros(shape)

    coulomb, viscous, gain = _slow(p, x)
    beyond = p.link_inertia_kgm2 * x.beta + _load(p, x) - _sensed(p, x) - each(x.torque, 0)
    motor = _motor(p, gain, x.i) - p.reflected * x.acc - _loss(p, coulomb, viscous, x) - beyond
    motor = motor - gain * (p.offset_a + each(x.i, 1))
    motor_error, link_error = _eccentric(p, x)
    error = link_error + each(x.q, 2) - motor_error / p.gear_ratio
    torsion = _spring(p, *_twist(p, x), x.z) + p.stiffness_nm_per_rad * error - beyond
    return np.broadcast_to(motor, shape), np.broadcast_to(torsion - np.mean(torsion, 0), shape)
