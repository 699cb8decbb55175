"""Fit the torsion: stiffness and kinematic error from both encoders and the torque sensor.

    sensor = K d + K3 d^3 + D d' + H z - K sum_n (c_n cos(n theta_m) + s_n sin(n theta_m)) + zero of the run

d is the filtered torsion angle less its offsets, and so are the waves; the fit is repeated with the fitted offsets, so
that the cubic acts on the deflection alone. Each run has a zero of its own: the sensor's zero and the link
encoder's cannot be told apart in one run; their mean over the runs is the torsion's zero.

z is d through a Maxwell-slip element; its travel is the best of a grid. A hysteresis is written only when it removes a
twentieth of the residual variance and dissipates (H > 0); a damping when it dissipates (D > 0). Without the damping
the slip would take its part: ripple of 100 rad/s loses as much in either. What joints have beyond that is added by
`torsion_extensions` where runs left out confirm it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import Torsion
from jtqd.estimator.observer import RIPPLE_ORDERS, slipped
from jtqd.sysid.fit.signals import RunSignals
from jtqd.sysid.fit.torsion_extensions import extended
from jtqd.sysid.fit.torsion_signals import rate_of

_EVERY: Final = 5
_ORDERS: Final = tuple(float(order) for order in RIPPLE_ORDERS)
_COMMON: Final = 8
"""Columns that all runs share: d, d^3, the four waves, the zero, and d'."""
_OFFSETS: Final = slice(2, 7)
_RATE_PER_S: Final = 100.0  # d' counts in so many d per second: columns of one size
_REPETITIONS: Final = 3
_TRAVELS_RAD: Final = (3e-5, 4e-5, 5e-5, 6e-5, 7e-5, 8.5e-5, 1e-4, 1.2e-4, 1.4e-4, 1.7e-4, 2e-4, 3e-4)
"""From a tenth of an arc minute to one: harmonic drives lose less than that (lost motion, hysteresis)."""
_HYSTERESIS_WORTH: Final = 0.05
"""Part of the residual variance that a hysteresis must take away to be believed."""
_ZERO_SIGMA_NM: Final = 0.5  # a priori, per run: far more than a good sensor drifts
_CUBIC_SHARE: Final = 0.5  # a priori sigma of K3 d^3 at the largest d, as a share of the largest torque


class TorsionError(ValueError):
    """The runs do not give a torsion; one line."""


def fit_torsion(runs: Sequence[RunSignals]) -> Torsion:
    """Return the torsion parameters by least squares over all moving samples; raises TorsionError."""
    largest = max(
        (float(np.abs(run.seen.torsion_nm[run.moving]).max(initial=0.0)) for run in runs), default=0.0
    )
    if largest <= 0.0:
        raise TorsionError("found no torsion between motor and link encoder, expected some under load")
    best = _fit(runs, largest, np.zeros(5), None)
    least = (1.0 - _HYSTERESIS_WORTH) * best.residual_nm2
    offsets = best.offsets
    for travel in _TRAVELS_RAD:
        found = _fit(runs, largest, offsets, travel, 1)
        if found.hysteresis_nm > 0.0 and found.residual_nm2 < least:
            best, least = found, found.residual_nm2
    if best.hysteresis_nm > 0.0:
        best = _fit(runs, largest, best.offsets, best.travel_rad)
    c2, s2, c4, s4, zero = best.offsets.tolist()
    plain = Torsion(
        stiffness_nm_per_rad=best.stiffness,
        cubic_nm_per_rad3=best.cubic,
        zero_rad=zero,
        orders_per_motor_rev=_ORDERS,
        cos_rad=(c2, c4),
        sin_rad=(s2, s4),
        hysteresis_nm=best.hysteresis_nm,
        hysteresis_travel_rad=best.travel_rad,
        damping_nms_per_rad=best.damping,
    )
    return extended(runs, plain)


class _Found(NamedTuple):
    """One solution; offsets: kinematic error (c2, s2, c4, s4) and zero [rad]; residual variance [Nm^2]."""

    stiffness: float
    cubic: float
    damping: float
    offsets: FloatArray
    hysteresis_nm: float
    travel_rad: float
    residual_nm2: float


def _fit(
    runs: Sequence[RunSignals],
    largest: float,
    offsets: FloatArray,
    travel_rad: float | None,
    repetitions: int = _REPETITIONS,
) -> _Found:
    """Solve with the hysteresis of one travel, or without; the offsets found are taken out and the fit repeated."""
    for _ in range(repetitions):
        x, y = _equations(runs, offsets, largest, travel_rad)
        if len(y) < 10 * x.shape[1]:
            raise TorsionError(f"found {len(y)} moving samples, expected at least {10 * x.shape[1]}")
        w = _solve(x, y, _COMMON + (travel_rad is not None))
        stiffness = float(w[0]) / largest
        if not stiffness > 0.0:
            raise TorsionError(f"found a stiffness of {stiffness:.3g} Nm/rad, expected one > 0")
        offsets = offsets - w[_OFFSETS] / stiffness
    return _Found(
        stiffness,
        float(w[1]) / largest**3,
        max(float(w[_COMMON - 1]) / (_RATE_PER_S * largest), 0.0),
        offsets,
        0.0 if travel_rad is None else float(w[_COMMON]),
        travel_rad or _TRAVELS_RAD[0],
        float(np.mean((y - x @ w) ** 2)),
    )


def _equations(
    runs: Sequence[RunSignals], offsets: FloatArray, largest: float, travel_rad: float | None
) -> tuple[FloatArray, FloatArray]:
    """Return columns [n, _COMMON (+ 1) + runs] and sensor [n] of all moving samples, thinned.

    d is less what is known of its offsets, and in parts of `largest`: then its cube carries no wave and no zero.
    """
    blocks: list[FloatArray] = []
    targets: list[FloatArray] = []
    for n, run in enumerate(runs):
        keep = np.flatnonzero(run.moving)[::_EVERY]
        shared = np.column_stack((run.seen.waves, np.ones(len(run.seen.waves))))
        d = run.seen.torsion_nm - shared @ offsets
        x, rate = d[keep] / largest, rate_of(d, run)[keep] / (_RATE_PER_S * largest)
        columns = [x, x**3, shared[keep], rate]
        if travel_rad is not None:
            columns.append(slipped(d, travel_rad)[0][keep])
        zero = np.zeros((len(keep), len(runs)))
        zero[:, n] = 1.0
        blocks.append(np.column_stack((*columns, zero)))
        targets.append(run.sensor_nm[keep])
    return np.vstack(blocks), np.concatenate(targets)


def _solve(x: FloatArray, y: FloatArray, shared: int) -> FloatArray:
    """Return the most probable coefficients; the first `shared` columns belong to all runs."""
    noise = _noise_of(x, y, shared)
    prior = np.zeros(x.shape[1])
    prior[1] = noise / max(_CUBIC_SHARE * float(np.abs(y).max()), 1e-9) ** 2
    prior[shared:] = noise / _ZERO_SIGMA_NM**2
    return np.asarray(np.linalg.lstsq(x.T @ x + np.diag(prior), x.T @ y, rcond=None)[0], np.float64)


def _noise_of(x: FloatArray, y: FloatArray, shared: int) -> float:
    """Return the residual variance with one zero for all runs [Nm^2]."""
    w = np.linalg.lstsq(x[:, :shared], y, rcond=None)[0]
    return float(np.mean((y - x[:, :shared] @ w) ** 2))
