"""Pendulums on one joint by inverse dynamics: motor encoder, motor current and a torque sensor with noise; numpy alone.

i = (G^2 Jm a + tau + loss(v, tau, theta)) / (G Kt) + noise        tau = Il a + m g l sin q, read by the sensor
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import signal

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.effects import EFFECTS
from jtqd.estimator.joint import Effect, Friction, Joint
from jtqd.estimator.run import JointColumns, RunTable
from jtqd.sysid.diagnosis.dataset import build_dataset, usable_signals
from jtqd.sysid.diagnosis.diagnose import disturbed_signals
from jtqd.sysid.diagnosis.entries import set_state
from jtqd.sysid.diagnosis.findings import Findings, Present
from jtqd.sysid.diagnosis.model import Solution, solve
from jtqd.sysid.diagnosis.regressors import all_in_bin, bin_samples, binned, contribution

Loss = Callable[[FloatArray, FloatArray, FloatArray], FloatArray]
"""Of velocity, torque, motor angle [n], joint side, Nm."""
Runs = list[tuple[str, RunTable]]

ARM = Joint(
    name="arm",
    gear_ratio=120.0,
    torque_constant_nm_per_a=0.075,
    rotor_inertia_kgm2=4e-5,
    stiffness_nm_per_rad=15000.0,
    damping_nms_per_rad=0.0,
    link_inertia_kgm2=0.0,
    rated_torque_nm=60.0,
    friction=Friction(coulomb_nm=3.2, viscous_nms_per_rad=5.0),
)


@dataclass(frozen=True)
class Rig:
    """Load of a pendulum and what measures it; sensor_zero_nm: of all runs; days: part by which a run's friction differs."""

    moment_nm: float = 25.0
    inertia_kgm2: float = 1.8
    rate_hz: float = 500.0
    seconds: float = 12.0
    sensor_noise_nm: float = 0.15
    current_noise_a: float = 0.02
    counts: float = 2.0**17
    sensor_zero_nm: float = 0.0
    days: float = 0.0


def friction_of(joint: Joint) -> Loss:
    f = joint.friction
    return lambda v, tau, theta: f.coulomb_nm * np.sign(v) + f.viscous_nms_per_rad * v


def motion(rng: np.random.Generator, t: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Angle, velocity, acceleration of a sum of sines of 0.1 to 0.6 Hz about rest [n]."""
    w = 2.0 * np.pi * np.array([0.11, 0.19, 0.31, 0.47, 0.61]) * rng.uniform(0.9, 1.1, 5)
    size = 0.55 * rng.uniform(0.6, 1.2, 5) * np.array([1.0, 0.8, 0.5, 0.3, 0.2])
    turn = w[:, None] * t + rng.uniform(0.0, 2.0 * np.pi, 5)[:, None]
    return size @ np.sin(turn), (size * w) @ np.cos(turn), -(size * w**2) @ np.sin(turn)


def runs_of(true: Joint, seed: int, count: int, rig: Rig = Rig(), loss: Loss | None = None) -> Runs:
    loss = loss or friction_of(true)
    out = []
    for k in range(count):
        rng = np.random.default_rng([seed, k])
        t = np.arange(0.0, rig.seconds, 1.0 / rig.rate_hz)
        q, v, a = motion(rng, t)
        tau = rig.inertia_kgm2 * a + rig.moment_nm * np.sin(q)
        G = true.gear_ratio
        lost = (1.0 + rig.days * rng.uniform(-1.0, 1.0)) * loss(v, tau, G * q)
        current = (G**2 * true.rotor_inertia_kgm2 * a + tau + lost) / (G * true.torque_constant_nm_per_a)
        step = 2.0 * np.pi / rig.counts
        columns = JointColumns(
            current_a=current + rig.current_noise_a * rng.normal(size=len(t)),
            motor_position_rad=step * np.round(G * q / step),
            torque_nm=tau + rig.sensor_zero_nm + rig.sensor_noise_nm * rng.normal(size=len(t)),
        )
        out.append((f"run{k}", RunTable(t, {1: columns})))
    return out


FINE_HZ: float = 10_000.0
"""Rate at which the spring is integrated."""
SPRUNG = replace(ARM, stiffness_nm_per_rad=4000.0, damping_nms_per_rad=4.0, rated_torque_nm=30.0)
"""A gear that its pendulum turns visibly, and that swings with it at 20 to 40 Hz."""


def sprung_runs(true: Joint, seed: int, count: int, rig: Rig = Rig(sensor_noise_nm=0.02)) -> Runs:
    """Runs with an encoder on either side of the gear's spring, K d + D d' = tau, whose load swings quickly, too."""
    out = []
    for k in range(count):
        rng = np.random.default_rng([seed, k])
        t = np.arange(0.0, rig.seconds, 1.0 / FINE_HZ)
        q, _, _ = motion(rng, t)
        w = 2.0 * np.pi * rng.uniform(18.0, 40.0, 3)
        q = q + (1.2 / (rig.inertia_kgm2 * w**2)) @ np.sin(w[:, None] * t + rng.uniform(0.0, 6.0, 3)[:, None])
        tau = rig.inertia_kgm2 * np.gradient(np.gradient(q, t), t) + rig.moment_nm * np.sin(q)
        K, D = true.stiffness_nm_per_rad, true.damping_nms_per_rad
        top, bottom = signal.bilinear([1.0], [D, K], FINE_HZ)
        shaft = q + signal.lfilter(top, bottom, tau)
        v = np.gradient(shaft, t)
        G, loss = true.gear_ratio, friction_of(true)
        torque = G**2 * true.rotor_inertia_kgm2 * np.gradient(v, t) + tau + loss(v, tau, G * shaft)
        kept = slice(round(0.1 * FINE_HZ), None, round(FINE_HZ / rig.rate_hz))
        t, noise = t[kept] - t[kept][0], rng.normal(size=(2, len(t[kept])))
        step = 2.0 * np.pi / rig.counts
        columns = JointColumns(
            current_a=torque[kept] / (G * true.torque_constant_nm_per_a) + rig.current_noise_a * noise[0],
            motor_position_rad=step * np.round(G * shaft[kept] / step),
            link_position_rad=1e-6 * np.round(1e6 * q[kept]),
            torque_nm=tau[kept] + rig.sensor_noise_nm * noise[1],
        )
        out.append((f"run{k}", RunTable(t, {1: columns})))
    return out


Effects = Sequence[tuple[str, Mapping[str, float]]]


def with_effects(joint: Joint, effects: Effects) -> Joint:
    return replace(joint, effects=tuple(Effect(name, dict(p)) for name, p in effects))


def predicted(joint: Joint, effects: Effects, runs: Runs) -> list[dict[str, FloatArray]]:
    """Of each run where it moves, in bins: torque of the measured current and of that which a simulation with these effects
    needs, G Kt i [m], velocity, acceleration, load.
    """
    present = [Present(name, "sensor" if EFFECTS[name].at_sensor else 1, p) for name, p in effects]
    signals, reasons = usable_signals(runs, {1: joint}, (1,))
    assert not reasons
    scale = joint.gear_ratio * joint.torque_constant_nm_per_a
    out = []
    for (s,) in signals:
        set_state(s, present)
        read = [p for p in present if "current_a" in p.effect.hooks]
        more = sum(contribution(p.effect, p.values, s)["motor"] for p in read)
        samples = bin_samples([s])
        good = all_in_bin(s.usable("motor"), samples)
        columns = {
            "measured": scale * s.current_a,
            "predicted": scale * s.state.current_a + more,
            "velocity": s.state.velocity_rad_s,
            "acceleration": s.state.motor_acceleration_rad_s2 / joint.gear_ratio,
            "load": s.state.torque_nm,
        }
        out.append({name: binned(x, samples)[good] for name, x in columns.items()})
    return out


def solved(joint: Joint, runs: Runs) -> Solution:
    """The set of most evidence, with what `diagnose` knows of the noise of torque and acceleration."""
    usable, _ = usable_signals(runs, {1: joint}, (1,))
    dataset = build_dataset(usable, {1: joint})
    return solve(replace(dataset, disturbed=disturbed_signals(runs, {1: joint}, (1,), usable)))


def rms_error(joint: Joint, effects: Effects, runs: Runs) -> float:
    """Error of the torque of the current, Nm rms."""
    parts = [p["measured"] - p["predicted"] for p in predicted(joint, effects, runs)]
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))


def ladder_error(joint: Joint, fit: Runs, fresh: Runs) -> float:
    """Error on fresh runs of the usual ladder: offset, Coulomb, viscous, inertia, load, gain by least squares."""

    def columns(runs: Runs) -> tuple[FloatArray, FloatArray]:
        rows = predicted(joint, (), runs)
        v, a, load, y = (
            np.concatenate([r[n] for r in rows]) for n in ("velocity", "acceleration", "load", "measured")
        )
        x = np.column_stack((np.ones_like(v), np.sign(v), v, a, np.abs(load) * np.sign(v), load))
        return x, y

    x, y = columns(fit)
    beta = np.linalg.lstsq(x, y, rcond=None)[0]
    x, y = columns(fresh)
    return float(np.sqrt(np.mean((y - x @ beta) ** 2)))


def extended(found: Findings) -> Effects:
    """The effects of the extended file."""
    return [(p.name, p.values) for p in found.predicts]


def parameter(found: Findings, effect: str, name: str) -> Any:
    """The value of an entry with its interval, None where it is not in the set."""
    causes = (*found.causes, *found.too_small)
    return next((c.parameters[name] for c in causes if c.name == effect), None)
