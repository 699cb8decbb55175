"""Fit of the additive loss: penalised least squares over runs, with what differs from run to run as nuisance. Pure.

    tau_raw - sensor = L(x, v) - kappa (T_r - T0) v + zero_r + u_r v + ripple

L is linear in its node values (estimator.additive_loss). zero_r (the sensor's zero) and u_r (viscous friction of that
run against the mean) are random effects with a prior width, the ripple waves are columns without one: none of them
enters the result, all of them would bias it. Curvature over the nodes is penalised, and where there are no data the
nodes fall back on the joint file's friction. kappa/Fv is viscous_per_k, with a prior; T_r is the run's mean.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estimator.friction import FloatArray
from estimator.fused_parameters import AdditiveLoss, LossSide
from estimator.parameters import Friction
from sysid.run_signals import RunSignals

LOAD_NODES_NM = (
    -36.0, -30.0, -24.0, -18.0, -13.0, -9.0, -6.0, -4.5, -3.0, -2.0, -1.0,
    0.0, 1.0, 2.0, 3.0, 4.5, 6.0, 9.0, 13.0, 18.0, 24.0, 30.0, 36.0, 43.0, 50.0,
)  # fmt: skip
"""Closer near zero, where the loss changes its nature within one ampere."""

_EVERY = 10
_MIN_SPEED_RAD_S = 0.03  # below, the direction of friction is not settled
_NODES = len(LOAD_NODES_NM)
_ROWS = 3 * _NODES + 1  # one direction: c, f, q, Stribeck
_RIPPLE = slice(2 * _ROWS, 2 * _ROWS + 4)
_THERMAL = 2 * _ROWS + 4
_COMMON = 2 * _ROWS + 5

PER_K_PRIOR = (0.02, 0.012)  # 1/K: oil and grease lose 2 to 3.5 % of viscosity per kelvin
_NOISE_NM = 0.3
_COLOUR = 4.0  # neighbours at 10 ms still share their error: so many samples count as one
_ZERO_SIGMA_NM = 0.3
_VISCOUS_SIGMA = 0.3  # Nms/rad, of a run against the mean
# (pull towards the joint file's friction, allowed second difference per step) of c, f, q
_PRIOR = {"c": (6.0, 0.6), "f": (3.0, 0.35), "q": (0.6, 0.15)}


class LossFitError(ValueError):
    """The runs do not give a loss; one line."""


@dataclass(frozen=True)
class LossFit:
    """Result: the loss; residual_nm: RMS of the fit with its nuisances; runs and samples used."""

    loss: AdditiveLoss
    residual_nm: float
    viscous_per_k_sigma: float
    samples: int


def hat_values(load_nm: FloatArray) -> FloatArray:
    """Return the hat functions [n, nodes] of LOAD_NODES_NM, linear beyond the outer nodes for the constant part."""
    nodes = np.array(LOAD_NODES_NM)
    k = np.clip(np.searchsorted(nodes, load_nm, side="right") - 1, 0, _NODES - 2)
    share = (load_nm - nodes[k]) / (nodes[k + 1] - nodes[k])
    out = np.zeros((len(load_nm), _NODES))
    row = np.arange(len(load_nm))
    out[row, k] = 1.0 - share
    out[row, k + 1] = share
    return out


def _columns(run: RunSignals, stribeck_velocity: float, warmer_k: float) -> tuple[FloatArray, FloatArray]:
    """Return columns [n, _COMMON + 2] and target [n] of a run's moving samples."""
    keep = run.moving & (np.abs(run.seen.velocity_rad_s) > _MIN_SPEED_RAD_S)
    keep &= np.abs(run.seen.raw_nm) < 60.0
    index = np.flatnonzero(keep)[::_EVERY]
    raw, v = run.seen.raw_nm[index], run.seen.velocity_rad_s[index]
    s, a = np.tanh(v / 0.02), np.abs(v)
    positive = v > 0.0
    parts = []
    for side in (positive, ~positive):
        hats = hat_values(np.where(v > 0.0, raw, -raw)) * (s * side)[:, None]
        peak = np.exp(-((a / stribeck_velocity) ** 2)) * s * side
        parts += [hats, hats * a[:, None], hats * (a * a)[:, None], peak[:, None]]
    x = np.column_stack((*parts, run.seen.waves[index], -warmer_k * v, np.ones(len(index)), v))
    return x, raw - run.sensor_nm[index]


def _prior(friction: Friction, runs: int) -> tuple[FloatArray, FloatArray]:
    """Return precision matrix and its product with the prior mean."""
    size = _COMMON + 2 * runs
    precision, mean = np.zeros((size, size)), np.zeros(size)
    second = np.zeros((_NODES - 2, _NODES))
    for k in range(_NODES - 2):
        second[k, k : k + 3] = (1.0, -2.0, 1.0)
    for side in range(2):
        for part, (name, level) in enumerate(
            (("c", friction.coulomb_nm), ("f", friction.viscous_nms_per_rad), ("q", 0.0))
        ):
            at = slice(side * _ROWS + part * _NODES, side * _ROWS + (part + 1) * _NODES)
            pull, bend = _PRIOR[name]
            precision[at, at] += np.eye(_NODES) / pull**2 + second.T @ second / bend**2
            mean[at] += level / pull**2
        peak = side * _ROWS + 3 * _NODES
        precision[peak, peak] += 1.0
        mean[peak] += friction.stribeck_nm
    precision[_RIPPLE, _RIPPLE] += np.eye(4) / 4.0
    viscous = max(friction.viscous_nms_per_rad, 1e-6)
    precision[_THERMAL, _THERMAL] += 1.0 / (viscous * PER_K_PRIOR[1]) ** 2
    mean[_THERMAL] += PER_K_PRIOR[0] / (viscous * PER_K_PRIOR[1] ** 2)
    for r in range(runs):
        precision[_COMMON + 2 * r, _COMMON + 2 * r] += 1.0 / _ZERO_SIGMA_NM**2
        precision[_COMMON + 2 * r + 1, _COMMON + 2 * r + 1] += 1.0 / _VISCOUS_SIGMA**2
    return precision, mean


def fit_loss(runs: Sequence[RunSignals], friction: Friction) -> LossFit:
    """Fit the loss of one joint over runs; friction: the joint file's, used where there are no data.

    Raises LossFitError when a direction of motion has no data.
    """
    temperatures = np.array([run.temperature_c for run in runs])
    known = np.isfinite(temperatures)
    reference = float(temperatures[known].mean()) if known.any() else 25.0
    warmer = np.where(known, temperatures - reference, 0.0)
    blocks = [
        _columns(run, friction.stribeck_velocity_rad_s, float(k)) for run, k in zip(runs, warmer, strict=True)
    ]
    for side, name in ((0, "positive"), (1, "negative")):
        if not any(np.any(x[:, side * _ROWS : side * _ROWS + _NODES]) for x, _ in blocks):
            raise LossFitError(f"found no motion in {name} direction, expected both")
    weight = 1.0 / (_NOISE_NM**2 * _COLOUR)
    grams = [(weight * (x.T @ x), weight * (x.T @ y)) for x, y in blocks]
    samples = sum(len(y) for _, y in blocks)
    precision, mean = _prior(friction, len(runs))
    w, covariance = _solve(grams, precision, mean)
    viscous = max(friction.viscous_nms_per_rad, 1e-6)
    per_k = float(w[_THERMAL]) / viscous
    spread = float(np.sqrt(covariance[_THERMAL, _THERMAL])) / viscous
    residual = _residual(blocks, w)
    fastest = max(float(np.abs(run.seen.velocity_rad_s[run.moving]).max(initial=0.1)) for run in runs)
    loss = AdditiveLoss(
        LOAD_NODES_NM,
        _side(w[:_ROWS]),
        _side(w[_ROWS : 2 * _ROWS]),
        friction.stribeck_velocity_rad_s,
        fastest,
        reference,
        friction.viscous_nms_per_rad,
        per_k,
    )
    return LossFit(loss, residual, spread, samples)


def _solve(
    grams: list[tuple[FloatArray, FloatArray]], precision: FloatArray, mean: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return (most probable values, their covariance)."""
    left, right = precision.copy(), mean.copy()
    for r, (gram, moment) in enumerate(grams):
        at = np.concatenate((np.arange(_COMMON), [_COMMON + 2 * r, _COMMON + 2 * r + 1]))
        left[np.ix_(at, at)] += gram
        right[at] += moment
    covariance = np.linalg.inv(left)
    return covariance @ right, covariance


def _residual(blocks: list[tuple[FloatArray, FloatArray]], w: FloatArray) -> float:
    total, count = 0.0, 0
    for r, (x, y) in enumerate(blocks):
        own = np.concatenate((w[:_COMMON], w[_COMMON + 2 * r : _COMMON + 2 * r + 2]))
        e = y - x @ own
        total += float(e @ e)
        count += len(e)
    return float(np.sqrt(total / max(count, 1)))


def _side(w: FloatArray) -> LossSide:
    c, f, q = (tuple(float(value) for value in w[k * _NODES : (k + 1) * _NODES]) for k in range(3))
    return LossSide(c, f, q, float(w[3 * _NODES]))
