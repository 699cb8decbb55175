"""Parameters, networks and seeded motions for the tests of the fused estimator."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.decoder import plain_values
from jtqd.estimator.joint import (
    AdditiveLoss,
    Agreement,
    DayZeros,
    Envelope,
    Fused,
    FusedSigma,
    Joint,
    LossSide,
    Torsion,
    Tracking,
)
from jtqd.estimator.losses import AdditiveLossModel
from jtqd.estimator.native_network import INPUTS
from jtqd.estimator.settings import EstimatorSettings
from tests.estimator.estimator_helpers import Motion, SmallNetwork, joint1, motion

NODES = (-30.0, -12.0, -4.0, 0.0, 3.0, 9.0, 21.0, 40.0)
SIZES = (28, 20, 40, 10, 1)
HIGH = (50.0, 20.0, 20.0, 20.0, 8.0, 3.5, 3.0, 3.0, 3.0, 60.0, 1.0, 32.0, *([1.0] * 14), 50.0, 1.8)
LOW = (*(-each for each in HIGH[:11]), 20.0, *(-each for each in HIGH[12:]))
TRAINED_C = (20.0, 32.0)
TRACKED = EstimatorSettings(method="fused", track_torsion=True)
"""With a network the torsion has no delay either."""


def side(seed: int, nodes: tuple[float, ...] = NODES) -> LossSide:
    """One direction: larger when driving, some of it near zero when back-driven, never negative."""
    rng = np.random.default_rng(seed)
    driving = np.maximum(np.array(nodes), 0.0)
    c = 1.5 + 0.25 * driving + rng.uniform(0.0, 1.0, len(nodes))
    f = rng.uniform(0.5, 2.5, len(nodes))
    q = rng.uniform(0.0, 0.3, len(nodes))
    return LossSide(tuple(c.tolist()), tuple(f.tolist()), tuple(q.tolist()), float(rng.uniform(0.2, 1.0)))


def loss_of(seed: int, **changes: Any) -> AdditiveLoss:
    loss = AdditiveLoss(NODES, side(seed), side(seed + 1000), 0.05, 3.0, 25.0, 2.0, 0.025)
    return replace(loss, **changes)


TORSION = Torsion(12000.0, 4.0e7, 2.0e-5, (2.0, 4.0), (3.0e-5, -4.0e-6), (-2.0e-5, 5.0e-6))
SIGMA = FusedSigma(0.2, 0.1, 0.02, 0.35, 0.015, 0.15, (1.0, 1.2, 0.9, 1.4))
WIDE = FusedSigma(6.0, 3.0, 0.6, 10.5, 0.45, 4.5, SIGMA.scale)
"""30 times as wide, with the same weights: no disagreement of motions whose current and torsion have nothing in common."""


TRACKING = Tracking(400.0, 0.08, 0.17, 160.0, 0.2)


def fused(seed: int = 1, torsion: Torsion | None = TORSION, sigma: FusedSigma = WIDE) -> Fused:
    return Fused(loss_of(seed), torsion, sigma, tracking=TRACKING)


def fused_joint(seed: int = 1, torsion: Torsion | None = TORSION) -> Joint:
    return replace(joint1(), fused=fused(seed, torsion))


def everywhere(
    velocity: float = 4.0, torque: float = 60.0, temperature_c: tuple[float, float] | None = TRAINED_C
) -> Envelope:
    """Known from -velocity to velocity and -torque to torque; any distance up to 1000 Nm."""
    rows, columns = 2 * round(velocity / 0.25) + 1, 2 * round(torque / 3.0) + 1
    return Envelope(0.25, 3.0, ((1,) * columns,) * rows, 1000.0, temperature_c)


def patches(seed: int, temperature_c: tuple[float, float] | None = TRAINED_C) -> Envelope:
    """A map with holes, so that a motion runs in and out of what is known."""
    known = np.random.default_rng(seed).random((13, 13)) < 0.7
    table = tuple(tuple(int(cell) for cell in row) for row in known)
    return Envelope(0.5, 6.0, table, 12.0, temperature_c)


OWN = FusedSigma(0.3, 0.2, 0.04, 1.0, 0.0, 0.0, (0.5, 0.6, 0.7, 0.8))
"""Of a network of the current path: 0.3 Nm, 0.2 Nms/rad, 4 % of the motor torque."""
REST_NM, QUICK_LIMITS = 0.8, (400.0, 80.0, 80.0)
"""Wide limits of quickness: motions of tests are rough."""


def fused_network(seed: int = 1, noise: float = 0.4, size_nm: float = 1.0, **metadata: Any) -> SmallNetwork:
    """28-20-40-10-1 of random weights; `size_nm` scales its answer. Metadata `...` leaves a key out."""
    rng = np.random.default_rng(seed)
    layers = tuple((noise * rng.normal(size=(m, n)), noise * rng.normal(size=n)) for m, n in pairwise(SIZES))
    values = {
        "features": list(INPUTS),
        "envelope": everywhere().to_mapping(),
        "sigma": plain_values(OWN),
        "rest_nm": [REST_NM],
        "quick": list(QUICK_LIMITS),
        "input_low": list(LOW),
        "input_high": list(HIGH),
        "joint": "joint1",
        "data_sha256": "cd" * 32,
    }
    kept = {key: value for key, value in (values | metadata).items() if value is not ...}
    return SmallNetwork(layers, np.zeros(28), np.array(HIGH), 0.0, size_nm, kept)


class FakeNetwork:
    """A network that says what the test wants."""

    joint = "joint1"
    sigma, rest_nm = OWN, REST_NM

    def __init__(
        self,
        answer: Callable[..., float],
        envelope: Envelope | None = None,
        quick: tuple[float, float, float] = QUICK_LIMITS,
    ) -> None:
        self.answer, self.quick = answer, quick
        self.envelope = envelope or everywhere()

    def run_one(self, *x: float) -> float:
        return float(self.answer(*x))

    def run_many(self, features: FloatArray) -> FloatArray:
        return np.array([self.run_one(*row) for row in features.tolist()])


def twisted(seed: int, count: int = 3000) -> Motion:
    """`motion` with a torsion of up to 25 Nm between its encoders."""
    m = motion(seed, count)
    rng = np.random.default_rng(seed + 500)
    t = np.cumsum(m.dt_s)
    torque = rng.uniform(5.0, 25.0) * np.sin(rng.uniform(1.0, 4.0) * t + rng.uniform(0.0, 6.0))
    return replace(m, motor_position_rad=m.motor_position_rad + 100.0 * torque / 12000.0)


def temperatures(kind: str, seed: int, count: int) -> FloatArray | None:
    """A joint's temperature over a run: unknown, constant, or rising in steps, warm and with gaps."""
    if kind == "none":
        return None
    rng = np.random.default_rng(seed + 900)
    rising = np.round(np.linspace(rng.uniform(15.0, 26.0), rng.uniform(26.0, 45.0), count), 1)
    if kind == "gaps":
        rising[rng.random(count) < 0.1] = np.nan
        rising[count // 2 : count // 2 + 100] = np.nan
        rising[rng.integers(0, count, 3)] = (np.inf, -np.inf, 1e300)
    return np.full(count, 27.0) if kind == "constant" else rising


K, GAIN = 12000.0, 6.2
PLAIN = fused_joint(
    torsion=replace(TORSION, cubic_nm_per_rad3=0.0, zero_rad=0.0, cos_rad=(0.0, 0.0), sin_rad=(0.0, 0.0))
)
"""Torsion torque is K (theta_m/G - theta_l) without more."""
NARROW = replace(PLAIN, fused=replace(PLAIN.fused, sigma=SIGMA))  # type: ignore[type-var]
ON = EstimatorSettings(method="fused", track_zeros=True)
OFF = EstimatorSettings(method="fused")
AGREEMENT = Agreement(slow_nm=0.15, fast_nm=0.3, gain=0.02, zero_nm=0.6)
DAYS = DayZeros(2.5e-5, 0.3, SIGMA.scale)


def with_section(joint: Joint = NARROW, **sections: Any) -> Joint:
    """Return the joint with these parts of section `fused`."""
    assert joint.fused is not None
    return replace(joint, fused=replace(joint.fused, **sections))


USUAL, LEARNING = with_section(agreement=AGREEMENT), with_section(zeros=DAYS)


def wavier(t: FloatArray, motor: FloatArray, link: FloatArray) -> FloatArray:
    """Link position with a kinematic error of 150 urad more than the file has."""
    result: FloatArray = link + 150e-6 * np.sin(200.0 * motor)
    return result


def driven(
    seconds: float = 5.0,
    velocity: Callable[[FloatArray], FloatArray] = lambda t: 1.2 * np.sin(2.5 * t + 0.4),
    load: Callable[[FloatArray], FloatArray] = lambda t: 8.0 * np.sin(1.7 * t),
    friction_nm: float = 0.0,
    link_zero_rad: float | FloatArray = 0.0,
) -> tuple[tuple[FloatArray, ...], FloatArray]:
    """Samples of a joint that is as its file says, but for friction and zero; and the motor torque less loss [n]."""
    t = np.asarray(np.arange(round(1000 * seconds)) * 1e-3, np.float64)
    v, raw = velocity(t), load(t)
    model = AdditiveLossModel(NARROW.fused.loss)  # type: ignore[union-attr]
    turns: FloatArray = np.tanh(v / 0.02)
    torque = raw - model.loss_many(raw, v, np.full(len(t), 25.0), turns)[0] - friction_nm * turns
    motor = 100.0 * np.cumsum(v) * 1e-3
    link = motor / 100.0 - torque / K + link_zero_rad
    noise = np.random.default_rng(4).normal(0.0, 6e-6, len(t))
    rotor = NARROW.rotor_inertia_kgm2 * 100.0 * np.gradient(v, t) / NARROW.torque_constant_nm_per_a
    return (
        np.full(len(t), 1e-3),
        raw / GAIN + rotor,
        motor,
        100.0 * v,
        link + noise,
        np.full(len(t), 25.0),
    ), torque
