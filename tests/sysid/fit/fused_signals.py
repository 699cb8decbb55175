"""Runs for the fits of the fused estimator: made from a known loss and torsion, or by the emulated bench."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import AdditiveLoss, LossSide, Torsion
from jtqd.estimator.losses import AdditiveLossModel
from jtqd.estimator.run import ObservedRun
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.status import VALID
from jtqd.models.files import load_joint, shipped
from jtqd.sim_can.emulated_run import JointCommand, emulate_run
from jtqd.sim_can.plant_file import Day, PlantParameters, load_plant
from jtqd.sysid.fit.losses import LOAD_NODES_NM
from jtqd.sysid.fit.signals import RunSignals, run_signals

FUSED = EstimatorSettings(method="fused")
STIFF = Torsion(11000.0, 1.5e8, -3e-5, (2.0, 4.0), (4e-5, -5e-6), (-2e-5, 8e-6))


def smooth_loss(viscous_per_k: float = 0.02, temperature_c: float = 25.0) -> AdditiveLoss:
    """Unequal directions, more loss when driving, nothing that the fit's nodes could not follow."""
    x = np.array(LOAD_NODES_NM)
    driving = np.log1p(np.exp(x / 5.0)) * 5.0
    sides = [
        LossSide(
            tuple((level + share * driving).tolist()),
            tuple((2.0 + 0.02 * x).tolist()),
            tuple((0.1 + 0.002 * x).tolist()),
            0.8,
        )
        for level, share in ((2.5, 0.30), (3.2, 0.24))
    ]
    return AdditiveLoss(LOAD_NODES_NM, *sides, 0.05, 3.0, temperature_c, 2.0, viscous_per_k)


@dataclass(frozen=True)
class Nuisance:
    """What a run has of its own: offset of the sensor, viscous friction against the mean, temperature."""

    offset_nm: float = 0.0
    viscous: float = 0.0
    temperature_c: float = math.nan


def made_run(
    seed: int,
    loss: AdditiveLoss,
    torsion: Torsion = STIFF,
    own: Nuisance | None = None,
    *,
    noise_nm: float = 0.05,
    count: int = 6000,
) -> RunSignals:
    """One run whose sensor is motor torque less loss, less the run's own nuisances, plus noise; no filter has a delay."""
    own = own or Nuisance()
    rng = np.random.default_rng(seed)
    t = np.arange(count) * 0.001

    def wave(sizes: tuple[float, ...]) -> FloatArray:
        f, p = rng.uniform(0.15, 0.9, len(sizes)), rng.uniform(0.0, 6.28, len(sizes))
        out: FloatArray = sum(a * np.sin(2 * np.pi * f[k] * t + p[k]) for k, a in enumerate(sizes))
        return out

    v, raw = wave((1.3, 0.8, 0.6)), wave((16.0, 9.0, 5.0))
    angle = 100.0 * np.cumsum(v) * 0.001
    waves = np.column_stack([f(n * angle) for n in (2, 4) for f in (np.cos, np.sin)])
    direction = np.tanh(v / 0.02)
    temperature = np.full(count, own.temperature_c)
    value = AdditiveLossModel(loss).loss_many(raw, v, temperature, direction)[0]
    torque = raw - value - own.viscous * v - waves @ np.array((0.3, -0.2, 0.05, 0.1))
    d = torque / torsion.stiffness_nm_per_rad
    for _ in range(20):  # Newton: the deflection that carries this torque
        slope = torsion.stiffness_nm_per_rad + 3.0 * torsion.cubic_nm_per_rad3 * d**2
        d -= (torsion.stiffness_nm_per_rad * d + torsion.cubic_nm_per_rad3 * d**3 - torque) / slope
    pairs = np.column_stack((torsion.cos_rad, torsion.sin_rad)).ravel()
    twist = d + torsion.zero_rad + waves @ pairs + rng.normal(0.0, 2e-6, count)
    seen = ObservedRun(
        status=np.full(count, VALID, np.uint8),
        raw_nm=raw,
        velocity_rad_s=v,
        torsion_nm=twist,
        waves=waves,
        temperature_c=temperature,
        direction=direction,
        dt_s=np.full(count, 1e-3),
        open_nm=np.zeros(count),
        ahead_nm=np.zeros(count),
        turn=np.column_stack((np.cos(angle), np.sin(angle))),
    )
    sensor = torque - own.offset_nm + rng.normal(0.0, noise_nm, count)
    moving = np.ones(count, bool)
    return RunSignals(
        f"run {seed}",
        seen,
        sensor,
        moving,
        ~moving,
        angle,
        100.0 * v,
        angle / 100.0 - twist,
        twist,
        sensor,
        math.inf,
    )


def with_torsion(run: RunSignals, twist: FloatArray, sensor_nm: FloatArray | None = None) -> RunSignals:
    """The same run with another torsion angle [n], and with another sensor."""
    sensor = run.sensor_nm if sensor_nm is None else sensor_nm
    return replace(
        run,
        seen=replace(run.seen, torsion_nm=twist),
        link_position_rad=run.motor_position_rad / 100.0 - twist,
        torsion_rad=twist,
        sensor_nm=sensor,
        raw_sensor_nm=sensor,
    )


def one_way(run: RunSignals, sign: float) -> RunSignals:
    """The run's samples of one direction of motion only."""
    return replace(run, moving=run.moving & (sign * run.seen.velocity_rad_s > 0.0))


def campaign_plant() -> PlantParameters:
    return load_plant(shipped("campaign_plant.yaml"))


def sines(seed: int) -> tuple[JointCommand, JointCommand]:
    """Speeds to 3 rad/s and currents to 5 A by three sines each; even seeds drive joint 1 by velocity."""
    rng = np.random.default_rng(seed)

    def target(sizes: tuple[float, ...], low: float, high: float) -> JointCommand:
        f, p = rng.uniform(low, high, 3).tolist(), rng.uniform(0.0, 6.28, 3).tolist()

        def value(t: float) -> float:
            waves = (a * math.sin(6.2832 * b * t + c) for a, b, c in zip(sizes, f, p, strict=True))
            return min(2.0 * t, 1.0) * sum(waves)

        return JointCommand.velocity(value) if low < 0.18 else JointCommand.current(value)

    velocity, current = target((1.6, 0.9, 0.5), 0.15, 0.5), target((3.0, 1.3, 0.6), 0.2, 0.7)
    return (velocity, current) if seed % 2 == 0 else (current, velocity)


def emulated(seed: int, duration_s: float, day: int | Day | None = None) -> tuple[RunSignals, RunSignals]:
    """Both joints of one run of the campaign's bench."""
    table = emulate_run(campaign_plant(), sines(seed), duration_s, seed, day=day)
    one, two = (
        run_signals(
            f"run {seed}", load_joint(shipped(f"joint{n}.yaml")), FUSED, table.time_s, table.joints[n]
        )
        for n in (1, 2)
    )
    return one, two
