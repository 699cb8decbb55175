"""A small network of the shipped shape and seeded motions for the estimator's tests."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import Efficiency, Joint, QuadrantPolynomial
from jtqd.estimator.network import FEATURES
from jtqd.models.files import load_joint, shipped
from jtqd.sysid.train.network import Layer, Trained, export_network, network_output

SIZES = (6, 20, 40, 10, 1)
LOW = (-6.0, -200.0, -250.0, -2.0, -2.5, -40.0)
HIGH = (6.0, 200.0, 250.0, 2.0, 2.5, 40.0)


def first_order_hold(rate_rad_s: float, dt_s: float) -> tuple[float, float, float]:
    """(a, b0, b1) of z_k = a z_(k-1) + b0 u_k + b1 u_(k-1): g/(s+g), exact for an input linear between samples."""
    x = rate_rad_s * dt_s
    share = -math.expm1(-x) / x
    return math.exp(-x), 1.0 - share, share - math.exp(-x)


def joint1() -> Joint:
    return load_joint(shipped("joint1.yaml"))


@dataclass(frozen=True)
class SmallNetwork:
    """Weights, normalisation and metadata; `data` is the ONNX file, `numpy` the reference."""

    layers: tuple[Layer, ...]
    mean: FloatArray
    std: FloatArray
    output_mean: float
    output_std: float
    metadata: dict[str, Any]

    @property
    def trained(self) -> Trained:
        return Trained(self.layers, self.mean, self.std, self.output_mean, self.output_std)

    @property
    def data(self) -> bytes:
        return export_network(self.trained, self.metadata)

    def numpy(self, x: FloatArray) -> FloatArray:
        return network_output(self.trained, x)

    def with_metadata(self, **changes: Any) -> SmallNetwork:
        kept = {key: value for key, value in (self.metadata | changes).items() if value is not ...}
        return replace(self, metadata=kept)


def small_network(seed: int = 1, follow: float = 1.0, noise: float = 1e-4) -> SmallNetwork:
    """6-20-40-10-1; with little noise its output is about `follow` times its last input: near physics."""
    rng = np.random.default_rng(seed)
    layers = [(noise * rng.normal(size=(m, n)), noise * rng.normal(size=n)) for m, n in pairwise(SIZES)]
    for w, _ in layers:
        w[-1 if w.shape[0] == 6 else 0, 0] = 1.0
    # each hidden layer halves the slope of its input at 0 (tanh(x/2)), so three layers need a factor 8; the
    # input is divided by 10 times its range to stay in the straight part, the output multiplied by as much
    std = 10.0 * np.array([6.0, 200.0, 250.0, 2.0, 2.5, 40.0])
    metadata = {
        "features": list(FEATURES),
        "envelope_low": list(LOW),
        "envelope_high": list(HIGH),
        "sigma_nm": 0.31,
        "joint": "joint1",
        "data_sha256": "ab" * 32,
    }
    return SmallNetwork(tuple(layers), np.zeros(6), std, 0.0, follow * 8.0 * std[-1], metadata)


def reciprocal_efficiency(joint: Joint) -> Efficiency:
    """Quadrants of G Kt i/tau_j: least-squares fit of the reciprocal of the joint's table on its grid."""
    assert joint.efficiency is not None
    quadrants = {}
    for name in ("i_pos_w_pos", "i_neg_w_neg", "i_neg_w_pos", "i_pos_w_neg"):
        source: QuadrantPolynomial = getattr(joint.efficiency, name)
        sign_i, sign_v = (1.0 if "i_pos" in name else -1.0), (1.0 if "w_pos" in name else -1.0)
        i, v = (
            a.ravel() for a in np.meshgrid(sign_i * np.linspace(1, 5, 9), sign_v * np.linspace(0.2, 3, 9))
        )
        target = np.array([1.0 / source.value(a, b) for a, b in zip(i.tolist(), v.tolist(), strict=True)])
        regressors = np.column_stack((np.ones_like(i), i, v, i * i, i * v, v * v))
        p = np.linalg.lstsq(regressors, target, rcond=None)[0].tolist()
        quadrants[name] = replace(QuadrantPolynomial(*p), rmse=source.rmse)
    return Efficiency("motor_over_joint", **quadrants)


@dataclass
class Motion:
    """Inputs of a run, arrays [n]."""

    dt_s: FloatArray
    current_a: FloatArray
    motor_position_rad: FloatArray
    motor_velocity_rad_s: FloatArray
    link_position_rad: FloatArray

    def rows(self) -> list[tuple[float, ...]]:
        return list(
            zip(
                *(a.tolist() for a in (self.dt_s, self.current_a, self.motor_position_rad)),
                self.motor_velocity_rad_s.tolist(),
                self.link_position_rad.tolist(),
                strict=True,
            )
        )

    def arrays(self) -> tuple[FloatArray, ...]:
        return (
            self.dt_s,
            self.current_a,
            self.motor_position_rad,
            self.motor_velocity_rad_s,
            self.link_position_rad,
        )


def motion(seed: int, count: int = 3000) -> Motion:
    """Reversals, standstill, a warm-up outside and inside the envelope, uneven steps; no faults yet."""
    rng = np.random.default_rng(seed)
    dt = rng.uniform(0.0005, 0.0015, count)
    t = np.cumsum(dt)
    v = rng.uniform(0.3, 1.4) * np.sin(rng.uniform(2, 6) * t + rng.uniform(0, 6))
    v += rng.uniform(0.1, 1.3) * np.sin(rng.uniform(1, 9) * t)
    still = rng.integers(0, count - 600)
    v[still : still + 500] *= np.linspace(1, 0, 500) ** 4
    v[still + 500 : still + 600] = 0.0
    i = (
        rng.uniform(1, 5) * np.sin(rng.uniform(1, 5) * t)
        + rng.uniform(-1.5, 1.5)
        + 0.05 * rng.normal(size=count)
    )
    link = np.cumsum(v * dt)
    return Motion(dt, i, 100.0 * link, 100.0 * v, link + 1e-5 * rng.normal(size=count))


def with_faults(m: Motion, seed: int) -> Motion:
    """Add NaN and infinities, gaps, zero and negative steps, absurd jumps: at seeded places."""
    rng = np.random.default_rng(seed + 77)
    count = len(m.dt_s)
    for array in m.arrays():
        for bad in (np.nan, np.inf, -np.inf, 1e300, -1e7):
            if rng.random() < 0.6:
                array[rng.integers(0, count)] = bad
    for bad in (0.0, -0.001, 0.051, 3.0, 0.05, 1e-12):
        m.dt_s[rng.integers(0, count)] = bad
    start = rng.integers(0, count - 40)
    m.current_a[start : start + 40] *= 30.0  # beyond 3 times rated, below the reset limit for a part of it
    return m
