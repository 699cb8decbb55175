"""Fit the additive loss model: penalised least squares over runs, with run-to-run differences as nuisance parameters.

    tau_raw - sensor = (1+s)/2 L_+ - (1-s)/2 L_- + kappa g(T) v + offset_r + u_r v + ripple

s is the observer's direction; L_+ and L_- are linear in their node values (jtqd.estimator.losses). offset_r (of the sensor)
and u_r (viscous friction of that run against the mean) are random effects with a prior width, the ripple waves have a wide
one: none of them enters the result, all of them would bias it. Curvature over the nodes is penalised, and where there are no
data the nodes fall back on the joint file's friction. Constant and viscous part of every load and the Stribeck peak are at
least 0, because friction takes energy. g(T) is (exp(-b (T - T0)) - 1)/b with b = kappa/Fv, the viscous_per_k, found by
repetition; it has a prior.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import AdditiveLoss, Friction, LossSide
from jtqd.sysid.fit.signals import RunSignals

LOAD_NODES_NM = (
    -36.0, -30.0, -24.0, -18.0, -13.0, -9.0, -6.0, -4.5, -3.0, -2.0, -1.0,
    0.0, 1.0, 2.0, 3.0, 4.5, 6.0, 9.0, 13.0, 18.0, 24.0, 30.0, 36.0, 43.0, 50.0,
)  # fmt: skip
"""Closer near zero, where the loss changes its nature within one ampere."""

_EVERY: Final = 10
_MIN_SPEED_RAD_S: Final = 0.03  # below, the direction of friction is not settled
_MAX_LOAD_NM: Final = 60.0  # beyond, the outer nodes would have to reach too far
_NODES: Final = len(LOAD_NODES_NM)
_ROWS: Final = 3 * _NODES + 1  # one direction: c, f, q, Stribeck
_RIPPLE: Final = slice(2 * _ROWS, 2 * _ROWS + 4)
_THERMAL: Final = 2 * _ROWS + 4
_COMMON: Final = 2 * _ROWS + 5  # shared by all runs; offset_r and u_r of each run follow

_SIGNED: Final = np.concatenate(
    [side * _ROWS + np.r_[: 2 * _NODES, 3 * _NODES] for side in range(2)]
)  # constant and viscous part of every load, Stribeck peak: friction takes energy; a quadratic part may be below 0
PER_K_PRIOR = (0.02, 0.012)  # 1/K: oil and grease lose 2 to 3.5 % of viscosity per kelvin
_PER_K_LIMIT: Final = 0.1  # what a joint file may hold
_REPETITIONS: Final = 3
_NOISE_NM: Final = 0.3
_COLOUR: Final = 4.0  # neighbours at 10 ms still share their error: so many samples count as one
_OFFSET_SIGMA_NM: Final = 0.3
_VISCOUS_SIGMA: Final = 0.3  # Nms/rad, of a run against the mean
_RIPPLE_SIGMA_NM: Final = 2.0
_NO_VISCOUS: Final = 1e-6  # Nms/rad, in place of a joint file's 0: no part of its loss falls with temperature
# (pull towards the joint file's friction, allowed second difference per step) of c, f, q
_PRIOR: Final = {"c": (6.0, 0.6), "f": (3.0, 0.35), "q": (0.6, 0.15)}


class LossFitError(ValueError):
    """The runs do not give a loss; one line."""


@dataclass(frozen=True)
class LossFit:
    """Result: the loss; residual_nm: RMS of the fit with its nuisances; viscous_per_k_sigma: standard deviation of
    loss.viscous_per_k; samples: used, after thinning.
    """

    loss: AdditiveLoss
    residual_nm: float
    viscous_per_k_sigma: float
    samples: int


@dataclass(frozen=True)
class _Block:
    """Equations of one run: columns x [n, _COMMON + 2], target y [n]; v [n], warmer_k [n] against the reference."""

    x: FloatArray
    y: FloatArray
    v: FloatArray
    warmer_k: FloatArray


def hat_values(load_nm: FloatArray) -> FloatArray:
    """Return the hat functions [n, nodes] of LOAD_NODES_NM; the outer ones go on as lines, as the constant part does."""
    nodes = np.array(LOAD_NODES_NM)
    k = np.clip(np.searchsorted(nodes, load_nm, side="right") - 1, 0, _NODES - 2)
    share = (load_nm - nodes[k]) / (nodes[k + 1] - nodes[k])
    out = np.zeros((len(load_nm), _NODES))
    row = np.arange(len(load_nm))
    out[row, k] = 1.0 - share
    out[row, k + 1] = share
    return out


def _block(run: RunSignals, stribeck_velocity: float, reference_c: float) -> _Block:
    """Return the equations of a run's moving samples; the thermal column is filled by `_set_thermal`."""
    keep = run.moving & (np.abs(run.seen.velocity_rad_s) > _MIN_SPEED_RAD_S)
    keep &= np.abs(run.seen.raw_nm) < _MAX_LOAD_NM
    index = np.flatnonzero(keep)[::_EVERY]
    raw, v = run.seen.raw_nm[index], run.seen.velocity_rad_s[index]
    s, a = run.seen.direction[index][:, None], np.abs(v)[:, None]
    peak = np.exp(-((a / stribeck_velocity) ** 2))
    parts = []
    for load, share in ((raw, 0.5 * (1.0 + s)), (-raw, -0.5 * (1.0 - s))):
        constant = hat_values(load) * share
        held = hat_values(np.clip(load, LOAD_NODES_NM[0], LOAD_NODES_NM[-1])) * share
        parts += [constant, held * a, held * a * a, peak * share]
    x = np.column_stack((*parts, run.seen.waves[index], np.zeros(len(index)), np.ones(len(index)), v))
    warmer = np.nan_to_num(run.seen.temperature_c[index] - reference_c, nan=0.0)
    return _Block(x, raw - run.sensor_nm[index], v, warmer)


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
    precision[_RIPPLE, _RIPPLE] += np.eye(4) / _RIPPLE_SIGMA_NM**2
    viscous = _viscous(friction)
    precision[_THERMAL, _THERMAL] += 1.0 / (viscous * PER_K_PRIOR[1]) ** 2
    mean[_THERMAL] += PER_K_PRIOR[0] / (viscous * PER_K_PRIOR[1] ** 2)
    for r in range(runs):
        precision[_COMMON + 2 * r, _COMMON + 2 * r] += 1.0 / _OFFSET_SIGMA_NM**2
        precision[_COMMON + 2 * r + 1, _COMMON + 2 * r + 1] += 1.0 / _VISCOUS_SIGMA**2
    return precision, mean


def _viscous(friction: Friction) -> float:
    return max(friction.viscous_nms_per_rad, _NO_VISCOUS)


def fit_loss(runs: Sequence[RunSignals], friction: Friction) -> LossFit:
    """Fit the loss of one joint over runs; friction: the joint file's, used where there are no data.

    Raises LossFitError when a direction of motion has no data, or for a viscous_per_k that no lubricant has.
    """
    temperatures = np.array([run.temperature_c for run in runs])
    known = temperatures[np.isfinite(temperatures)]
    reference = float(known.mean()) if len(known) else 25.0
    blocks = [_block(run, friction.stribeck_velocity_rad_s, reference) for run in runs]
    for sign, name in ((1.0, "positive"), (-1.0, "negative")):
        if not any(np.any(sign * block.v > 0.0) for block in blocks):
            raise LossFitError(f"found no motion in {name} direction, expected both")
    prior = _prior(friction, len(runs))
    viscous = _viscous(friction)
    per_k = PER_K_PRIOR[0]
    for _ in range(_REPETITIONS):
        _set_thermal(blocks, per_k)
        w, covariance = _solve(blocks, *prior)
        per_k = float(w[_THERMAL]) / viscous
        if not abs(per_k) <= _PER_K_LIMIT:
            raise LossFitError(
                f"found viscous_per_k {per_k:.3g} 1/K, expected at most {_PER_K_LIMIT} either way"
            )
    speeds = (float(np.abs(run.seen.velocity_rad_s[run.moving]).max(initial=0.1)) for run in runs)
    sides = _side(w[:_ROWS]), _side(w[_ROWS : 2 * _ROWS])
    place = friction.stribeck_velocity_rad_s, max(speeds), reference
    loss = AdditiveLoss(LOAD_NODES_NM, *sides, *place, friction.viscous_nms_per_rad, per_k)
    spread = float(np.sqrt(covariance[_THERMAL, _THERMAL])) / viscous
    return LossFit(loss, _residual(blocks, w), spread, sum(len(block.y) for block in blocks))


def _set_thermal(blocks: Sequence[_Block], per_k: float) -> None:
    """Write kappa's column g(T) v for this b; its limit at b = 0 is -(T - T0) v."""
    for block in blocks:
        change = np.expm1(-per_k * block.warmer_k) / per_k if per_k else -block.warmer_k
        block.x[:, _THERMAL] = change * block.v


def _at(run: int) -> slice:
    return slice(_COMMON + 2 * run, _COMMON + 2 * run + 2)


def _solve(
    blocks: Sequence[_Block], precision: FloatArray, mean: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return (most probable values, their covariance)."""
    weight = 1.0 / (_NOISE_NM**2 * _COLOUR)
    left, right = precision.copy(), mean.copy()
    for r, block in enumerate(blocks):
        at = np.r_[:_COMMON, _at(r)]
        left[np.ix_(at, at)] += weight * (block.x.T @ block.x)
        right[at] += weight * (block.x.T @ block.y)
    covariance = np.asarray(np.linalg.inv(left), np.float64)
    values = covariance @ right
    if (values[_SIGNED] < 0.0).any():
        values = bounded(left, right, _SIGNED)
    return values, covariance


def bounded(left: FloatArray, right: FloatArray, signed: NDArray[np.intp] | slice) -> FloatArray:
    """Return the most probable values, none in `signed` below 0: bounded least squares (Stark and Parker 1995)."""
    from scipy.linalg import solve_triangular
    from scipy.optimize import lsq_linear

    root = np.linalg.cholesky(left)
    lowest = np.full(len(left), -np.inf)
    lowest[signed] = 0.0
    found = lsq_linear(root.T, solve_triangular(root, right, lower=True), (lowest, np.inf), method="bvls")
    result: FloatArray = found.x
    result[signed] = np.maximum(result[signed], 0.0)
    return result


def _residual(blocks: Sequence[_Block], w: FloatArray) -> float:
    errors = [block.y - block.x @ np.r_[w[:_COMMON], w[_at(r)]] for r, block in enumerate(blocks)]
    return float(np.sqrt(np.mean(np.square(np.concatenate(errors)))))


def _side(w: FloatArray) -> LossSide:
    c, f, q = (tuple(float(value) for value in w[k * _NODES : (k + 1) * _NODES]) for k in range(3))
    return LossSide(c, f, q, float(w[3 * _NODES]))
