"""Fit of the torsion: stiffness and kinematic error from both encoders and the torque sensor. Pure.

    sensor = K d + K3 d^3 - K sum_n (c_n cos(n theta_m) + s_n sin(n theta_m)) + zero of the run

d is the filtered torsion angle, and so are the waves. Each run has a zero of its own: the sensor's zero and the link
encoder's cannot be told apart in one run; their mean over the runs is the torsion's zero.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from estimator.friction import FloatArray
from estimator.fused_parameters import Torsion
from sysid.run_signals import RunSignals

_EVERY = 5
_ORDERS = (2.0, 4.0)
_ZERO_SIGMA_NM = 0.5  # a priori, per run: far more than a good sensor drifts
_CUBIC_SHARE = 0.5  # a priori sigma of K3 d^3 at the largest d, as a share of K d


class TorsionError(ValueError):
    """The runs do not give a torsion; one line."""


def fit_torsion(runs: Sequence[RunSignals]) -> Torsion:
    """Return the torsion parameters by least squares over all moving samples; raises TorsionError."""
    blocks: list[FloatArray] = []
    targets: list[FloatArray] = []
    largest = max(float(np.abs(run.seen.torsion_nm[run.moving]).max(initial=0.0)) for run in runs)
    if largest <= 0.0:
        raise TorsionError("found no torsion between motor and link encoder, expected some under load")
    for n, run in enumerate(runs):
        keep = np.flatnonzero(run.moving)[::_EVERY]
        d = run.seen.torsion_nm[keep] / largest
        zero = np.zeros((len(keep), len(runs)))
        zero[:, n] = 1.0
        common = np.ones((len(keep), 1))
        blocks.append(np.column_stack((d, d**3, run.seen.waves[keep], common, zero)))
        targets.append(run.sensor_nm[keep])
    x, y = np.vstack(blocks), np.concatenate(targets)
    if len(y) < 10 * x.shape[1]:
        raise TorsionError(f"found {len(y)} moving samples, expected at least {10 * x.shape[1]}")
    gram, right = x.T @ x, x.T @ y
    scale = float(np.sqrt(gram[0, 0] / len(y))) * float(np.abs(y).max())
    noise = _noise_of(x, y)
    prior = np.zeros(x.shape[1])
    prior[1] = noise / max(_CUBIC_SHARE * scale, 1e-9) ** 2
    prior[7:] = noise / _ZERO_SIGMA_NM**2
    w = np.linalg.lstsq(gram + np.diag(prior), right, rcond=None)[0]
    stiffness = float(w[0]) / largest
    if not stiffness > 0.0:
        raise TorsionError(f"found a stiffness of {stiffness:.3g} Nm/rad, expected one > 0")
    return Torsion(
        stiffness_nm_per_rad=stiffness,
        cubic_nm_per_rad3=float(w[1]) / largest**3,
        zero_rad=-float(w[6]) / stiffness,
        orders_per_motor_rev=_ORDERS,
        cos_rad=(-float(w[2]) / stiffness, -float(w[4]) / stiffness),
        sin_rad=(-float(w[3]) / stiffness, -float(w[5]) / stiffness),
    )


def _noise_of(x: FloatArray, y: FloatArray) -> float:
    """Return the residual variance of the plain straight line [Nm^2]."""
    w = np.linalg.lstsq(x[:, :7], y, rcond=None)[0]
    return float(np.mean((y - x[:, :7] @ w) ** 2))


def torsion_torque(torsion: Torsion, run: RunSignals) -> FloatArray:
    """Return tau_t [n] of observed signals, as FusedObserver gives it but for the order of filter and cube."""
    d = run.seen.torsion_nm - torsion.zero_rad
    for k in range(2):
        d = (
            d
            - torsion.cos_rad[k] * run.seen.waves[:, 2 * k]
            - torsion.sin_rad[k] * run.seen.waves[:, 2 * k + 1]
        )
    result: FloatArray = d * (torsion.stiffness_nm_per_rad + torsion.cubic_nm_per_rad3 * d * d)
    return result
