"""Torsion calibration: the spring of the gear, its slips and the angle errors, from both encoders and the torque sensor.

    sensor = K d + K3 d^3 + D d' + H z - K sum_n (c_n cos(n theta_m) + s_n sin(n theta_m)) + offset of the run

d is the filtered torsion angle less its offset, and the waves are filtered alike. The fit is repeated with the fitted
offsets, so that the cubic acts on the deflection alone. Each run has an offset of its own: the sensor's and the link
encoder's cannot be separated in one run. Their mean over the runs is the offset of the torsion.

z is d through a Maxwell-slip element; its travel is the best of a grid. A hysteresis is written only when it removes a
twentieth of the residual variance and dissipates (H > 0); a damping when it dissipates (D > 0). Without the damping
the slip would take its part: ripple of 100 rad/s loses as much in either.

Extensions are groups of columns of the same linear model, fitted where held-out runs confirm them:

    hardening   the spring is stiffer (or softer) beyond deflections b_k, piecewise linear, in place of the cubic
    link        error of the link encoder over its own turn, orders 1 to 3
    motor       kinematic error of orders 1 and 3 of the motor's turn
    slips       several slip elements in place of one

The group that reduces the held-out error most is taken first, none that reduces it by less than WORTH. The offset of each
run is no error.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import inf
from typing import Final, NamedTuple

import numpy as np

from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.estimator.joint import Torsion
from jtqd.estimator.observer import RIPPLE_ORDERS, low_pass, slipped, tracked
from jtqd.estimator.settings import TORSION_BANDWIDTH_RAD_S
from jtqd.sysid.fit.signals import RunSignals

TRACKING_RAD_S: Final = 400.0
WAVE_RAD_S: Final = 160.0
"""Rates of the tracking filter: at rest no noisier than a low pass of 800 rad/s; chosen from a table, docs/estimator.md."""

_EVERY: Final = 5
_REPETITIONS: Final = 3
_ORDERS: Final = tuple(float(order) for order in RIPPLE_ORDERS)


class TorsionError(ValueError):
    """The runs do not give a torsion; one line."""


# The torque of a torsion, as FusedObserver computes it -------------------------------------------------


def deflection(torsion: Torsion, run: RunSignals) -> FloatArray:
    """Return d [n]: filtered torsion angle less offset and the errors of gear and link encoder."""
    d: FloatArray = run.seen.torsion_nm - torsion.zero_rad
    for order, cos, sin in zip(torsion.orders_per_motor_rev, torsion.cos_rad, torsion.sin_rad, strict=True):
        if order in RIPPLE_ORDERS:
            first = 2 * RIPPLE_ORDERS.index(order)  # c2, s2, c4, s4
            waves = run.seen.waves[:, first : first + 2]
        else:
            waves = run.waves(run.motor_position_rad, order)
        d = d - waves @ np.array((cos, sin))
    for order, cos, sin in zip(
        torsion.link_orders_per_rev, torsion.link_cos_rad, torsion.link_sin_rad, strict=True
    ):
        d = d - run.waves(run.link_position_rad, order) @ np.array((cos, sin))
    return d


def deflection_rate(d_rad: FloatArray, run: RunSignals) -> FloatArray:
    """Return d' [n, rad/s] of a filtered deflection: over the step before; 0 beside a gap."""
    dt_s = run.seen.dt_s
    rate = np.diff(d_rad, prepend=np.nan) / np.where(dt_s > 0.0, dt_s, np.nan)
    return np.nan_to_num(rate, nan=0.0)


def beyond_knot(d_rad: FloatArray, knot_rad: float) -> FloatArray:
    """Return by how much |d| exceeds a knot, with the sign of d [n]."""
    result: FloatArray = np.copysign(np.maximum(np.abs(d_rad) - knot_rad, 0.0), d_rad)
    return result


def local_stiffness(torsion: Torsion, d_rad: FloatArray) -> FloatArray:
    """Return d tau_t/d d [n, Nm/rad] of the spring at deflections [n], without slips."""
    result: FloatArray = torsion.stiffness_nm_per_rad + 3.0 * torsion.cubic_nm_per_rad3 * d_rad * d_rad
    for knot, stiffness in zip(torsion.hardening_rad, torsion.hardening_nm_per_rad, strict=True):
        result = result + stiffness * (np.abs(d_rad) > knot)
    return result


def torsion_torque(torsion: Torsion, run: RunSignals) -> tuple[FloatArray, FloatArray]:
    """Return tau_t [n], with the delay of the motor path, and the torque that slips leave open [n]."""
    d = deflection(torsion, run)
    return _torque(torsion, d, deflection_rate(d, run))


def tracked_torque(torsion: Torsion, run: RunSignals) -> tuple[FloatArray, FloatArray]:
    """Return tau_t [n] of the tracking filter, without delay, and what it leaves of two readings in a row [n, Nm^2]."""
    read = _unfiltered_deflection(torsion, run)
    motor = run.motor_position_rad, run.motor_velocity_rad_s
    d, rate = tracked(read, *motor, run.seen.dt_s, TRACKING_RAD_S, WAVE_RAD_S)
    left = local_stiffness(torsion, d) * (read - d)
    return _torque(torsion, d, rate)[0], left * np.append(0.0, left[:-1])


def low_pass_torque(torsion: Torsion, run: RunSignals) -> FloatArray:
    """Return tau_t [n] through the low pass of new configurations, TORSION_BANDWIDTH_RAD_S."""
    d = low_pass(_unfiltered_deflection(torsion, run), run.seen.dt_s, TORSION_BANDWIDTH_RAD_S)
    return _torque(torsion, d, deflection_rate(d, run))[0]


def _unfiltered_deflection(torsion: Torsion, run: RunSignals) -> FloatArray:
    waves = [part(order * run.motor_position_rad) for order in RIPPLE_ORDERS for part in (np.cos, np.sin)]
    seen = replace(run.seen, torsion_nm=run.torsion_rad, waves=np.column_stack(waves))
    return deflection(torsion, replace(run, seen=seen, bandwidth_rad_s=inf))


def _torque(torsion: Torsion, d: FloatArray, rate_rad_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return tau_t and open [n] of a deflection and its rate [n]."""
    result: FloatArray = d * (torsion.stiffness_nm_per_rad + torsion.cubic_nm_per_rad3 * d * d)
    result = result + torsion.damping_nms_per_rad * rate_rad_s
    for knot, stiffness in zip(torsion.hardening_rad, torsion.hardening_nm_per_rad, strict=True):
        result = result + stiffness * beyond_knot(d, knot)
    open_nm = np.zeros_like(d)
    torques = (torsion.hysteresis_nm, *torsion.slips_nm)
    travels = (torsion.hysteresis_travel_rad, *torsion.slips_travel_rad)
    for torque, travel in zip(torques, travels, strict=True):
        if torque:
            z, width = slipped(d, travel)
            result, open_nm = result + torque * z, open_nm + torque * width
    return result, open_nm


# The fit -----------------------------------------------------------------------------------------------

_COMMON: Final = 8
"""Columns that all runs share: d, d^3, the four waves, the offset, and d'."""
_OFFSETS: Final = slice(2, 7)
_RATE_PER_S: Final = 100.0  # d' counts in so many d per second: columns of one size
_TRAVELS_RAD: Final = (3e-5, 4e-5, 5e-5, 6e-5, 7e-5, 8.5e-5, 1e-4, 1.2e-4, 1.4e-4, 1.7e-4, 2e-4, 3e-4)
"""From a tenth of an arc minute to one: harmonic drives lose less than that (lost motion, hysteresis)."""
_HYSTERESIS_WORTH: Final = 0.05
"""Share of the residual variance that a hysteresis must remove."""
_OFFSET_SIGMA_NM: Final = 0.5  # a priori, per run: far more than a good sensor drifts
_CUBIC_SHARE: Final = 0.5  # a priori sigma of K3 d^3 at the largest d, as a share of the largest torque


def fit_torsion(runs: Sequence[RunSignals]) -> Torsion:
    """Return the torsion by least squares over all moving samples, with extensions. Raises TorsionError."""
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
    c2, s2, c4, s4, offset = best.offsets.tolist()
    plain = Torsion(
        stiffness_nm_per_rad=best.stiffness,
        cubic_nm_per_rad3=best.cubic,
        zero_rad=offset,
        orders_per_motor_rev=_ORDERS,
        cos_rad=(c2, c4),
        sin_rad=(s2, s4),
        hysteresis_nm=best.hysteresis_nm,
        hysteresis_travel_rad=best.travel_rad,
        damping_nms_per_rad=best.damping,
    )
    return extended(runs, plain)


class _Found(NamedTuple):
    """One solution; offsets: kinematic error (c2, s2, c4, s4) and offset [rad]; residual variance [Nm^2]."""

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
    """Solve with the hysteresis of one travel, or without; the fitted offsets are subtracted and the fit is repeated."""
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

    d is less its known offsets, and in parts of `largest`: then its cube carries neither wave nor offset.
    """
    blocks: list[FloatArray] = []
    targets: list[FloatArray] = []
    for n, run in enumerate(runs):
        keep = np.flatnonzero(run.moving)[::_EVERY]
        shared = np.column_stack((run.seen.waves, np.ones(len(run.seen.waves))))
        d = run.seen.torsion_nm - shared @ offsets
        x, rate = d[keep] / largest, deflection_rate(d, run)[keep] / (_RATE_PER_S * largest)
        columns = [x, x**3, shared[keep], rate]
        if travel_rad is not None:
            columns.append(slipped(d, travel_rad)[0][keep])
        own = np.zeros((len(keep), len(runs)))
        own[:, n] = 1.0
        blocks.append(np.column_stack((*columns, own)))
        targets.append(run.sensor_nm[keep])
    return np.vstack(blocks), np.concatenate(targets)


def _solve(x: FloatArray, y: FloatArray, shared: int) -> FloatArray:
    """Return the most probable coefficients; the first `shared` columns belong to all runs."""
    noise = _noise_of(x, y, shared)
    prior = np.zeros(x.shape[1])
    prior[1] = noise / max(_CUBIC_SHARE * float(np.abs(y).max()), 1e-9) ** 2
    prior[shared:] = noise / _OFFSET_SIGMA_NM**2
    return np.asarray(np.linalg.lstsq(x.T @ x + np.diag(prior), x.T @ y, rcond=None)[0], np.float64)


def _noise_of(x: FloatArray, y: FloatArray, shared: int) -> float:
    """Return the residual variance with one offset for all runs [Nm^2]."""
    w = np.linalg.lstsq(x[:, :shared], y, rcond=None)[0]
    return float(np.mean((y - x[:, :shared] @ w) ** 2))


# Extensions --------------------------------------------------------------------------------------------

WORTH: Final = 0.05
"""Share of the held-out variance that an extension must remove."""
EXTENSIONS: Final = ("hardening", "link", "motor", "slips")
KNOTS: Final = (0.1, 0.25, 0.45, 0.65, 0.85)
"""Where the spring may change its stiffness, in parts of the largest deflection."""
LINK_ORDERS: Final = (1.0, 2.0, 3.0)
MOTOR_ORDERS: Final = (1.0, 3.0)
SLIP_TRAVELS_RAD: Final = (4e-5, 1e-4, 2.5e-4, 6e-4, 1.2e-3)
_FOLDS: Final = 4
_SOFTEST: Final = 0.3
"""Least slope of a plausible spring, in parts of its stiffness at rest."""
_RIDGE: Final = 1e-6
"""A priori pull towards zero, in parts of each column's own power."""


class _Table(NamedTuple):
    """Equations of one run: target [n], its own offset subtracted, and columns [n, k] by group."""

    target: FloatArray
    columns: Mapping[str, FloatArray]


def extended(runs: Sequence[RunSignals], torsion: Torsion) -> Torsion:
    """Return the torsion with those of EXTENSIONS that held-out runs confirm; unchanged for less than eight runs."""
    if len(runs) < 2 * _FOLDS:
        return torsion
    largest = max(float(np.abs(deflection(torsion, run)[run.moving]).max(initial=0.0)) for run in runs)
    knots = tuple(part * largest for part in KNOTS)
    usable = [run for run in runs if np.count_nonzero(run.moving) > _EVERY]
    tables = [_table(run, torsion, knots) for run in usable]
    chosen: tuple[str, ...] = ()
    least = _held_out_variance(tables, chosen)
    while len(chosen) < len(EXTENSIONS):
        scores = {
            name: _held_out_variance(tables, (*chosen, name)) for name in EXTENSIONS if name not in chosen
        }
        best = min(scores, key=scores.__getitem__)
        if not scores[best] < (1.0 - WORTH) * least:
            break
        chosen, least = (*chosen, best), scores[best]
    if not chosen:
        return torsion
    result = torsion
    for _ in range(_REPETITIONS):
        found = _solved([_table(run, result, knots) for run in usable], chosen)
        result = _refined(result, found, knots)
    slopes = result.stiffness_nm_per_rad + np.cumsum((0.0, *result.hardening_nm_per_rad))
    if not slopes.min() > _SOFTEST * result.stiffness_nm_per_rad > 0.0:
        return torsion
    below = np.mean([np.mean((run.sensor_nm - torsion_torque(result, run)[0])[run.moving]) for run in runs])
    return replace(result, zero_rad=result.zero_rad - float(below) / result.stiffness_nm_per_rad)


def _table(run: RunSignals, torsion: Torsion, knots: Sequence[float]) -> _Table:
    keep = np.flatnonzero(run.moving)[::_EVERY]
    d = deflection(torsion, run)
    # an angle error is a torque by the local stiffness; that at rest counts as 1
    stiffer = (local_stiffness(torsion, d) / torsion.stiffness_nm_per_rad)[:, None]
    columns = {
        "spring": d[:, None],
        "cubic": d[:, None] ** 3,
        "damping": deflection_rate(d, run)[:, None],
        "ripple": stiffer * run.seen.waves,
        "slip": slipped(d, torsion.hysteresis_travel_rad)[0][:, None],
        "hardening": np.column_stack([beyond_knot(d, knot) for knot in knots]),
        "link": stiffer * np.hstack([run.waves(run.link_position_rad, order) for order in LINK_ORDERS]),
        "motor": stiffer * np.hstack([run.waves(run.motor_position_rad, order) for order in MOTOR_ORDERS]),
        "slips": np.column_stack([slipped(d, travel)[0] for travel in SLIP_TRAVELS_RAD]),
    }
    centred = {name: part[keep] - part[keep].mean(axis=0) for name, part in columns.items()}
    sensor = run.sensor_nm[keep]
    return _Table(sensor - sensor.mean(), centred)


def _groups(chosen: Sequence[str]) -> tuple[str, ...]:
    """Return the groups of the model: an extension takes the place of what it refines."""
    first = "hardening" if "hardening" in chosen else "cubic"
    slip = "slips" if "slips" in chosen else "slip"
    further = [name for name in chosen if name in ("link", "motor")]
    return ("spring", first, "damping", "ripple", slip, *further)


def _stacked(tables: Sequence[_Table], groups: Sequence[str]) -> tuple[FloatArray, FloatArray]:
    x = np.vstack([np.hstack([each.columns[name] for name in groups]) for each in tables])
    return x, np.concatenate([each.target for each in tables])


def _weights(tables: Sequence[_Table], groups: Sequence[str]) -> FloatArray:
    """Return the least squares coefficients; dissipating ones that come out below 0 are dropped, one after the other."""
    x, y = _stacked(tables, groups)
    dissipates: BoolArray = np.concatenate(
        [np.full(tables[0].columns[name].shape[1], name in ("slip", "slips", "damping")) for name in groups]
    )
    power = x.T @ x
    power[np.diag_indices_from(power)] *= 1.0 + _RIDGE
    right = x.T @ y
    active = np.diag(power) > 0.0
    while True:
        w = np.zeros(x.shape[1])
        w[active] = np.linalg.lstsq(power[np.ix_(active, active)], right[active], rcond=None)[0]
        below = np.where(dissipates & active, w, 0.0)
        worst = int(np.argmin(below))
        if not below[worst] < 0.0:
            return w
        active[worst] = False


def _held_out_variance(tables: Sequence[_Table], chosen: Sequence[str]) -> float:
    """Return the mean variance [Nm^2] on held-out runs, each less its own offset."""
    groups = _groups(chosen)
    errors = []
    for fold in range(_FOLDS):
        w = _weights([each for k, each in enumerate(tables) if k % _FOLDS != fold], groups)
        for each in tables[fold::_FOLDS]:
            x, y = _stacked([each], groups)
            errors.append(float(np.var(y - x @ w)))
    return float(np.mean(errors))


def _solved(tables: Sequence[_Table], chosen: Sequence[str]) -> dict[str, FloatArray]:
    """Return the coefficients by group, of all runs."""
    groups = _groups(chosen)
    ends = np.cumsum([tables[0].columns[name].shape[1] for name in groups])
    return dict(zip(groups, np.split(_weights(tables, groups), ends[:-1]), strict=True))


def _refined(torsion: Torsion, found: Mapping[str, FloatArray], knots: Sequence[float]) -> Torsion:
    """Return the torsion with these coefficients; waves of a torque are waves of the angle, over the stiffness."""
    stiffness = float(found["spring"][0])
    motor = _waves(torsion.orders_per_motor_rev, torsion.cos_rad, torsion.sin_rad)
    link = _waves(torsion.link_orders_per_rev, torsion.link_cos_rad, torsion.link_sin_rad)
    known = (motor, _ORDERS, "ripple"), (motor, MOTOR_ORDERS, "motor"), (link, LINK_ORDERS, "link")
    for waves, orders, name in known:
        if name in found:
            for order, (c, s) in zip(orders, found[name].reshape(-1, 2).tolist(), strict=True):
                cos, sin = waves.get(order, (0.0, 0.0))
                waves[order] = cos - c / stiffness, sin - s / stiffness
    result = replace(
        torsion,
        stiffness_nm_per_rad=stiffness,
        cubic_nm_per_rad3=float(found["cubic"][0]) if "cubic" in found else 0.0,
        damping_nms_per_rad=float(found["damping"][0]),
        hysteresis_nm=float(found["slip"][0]) if "slip" in found else 0.0,
        orders_per_motor_rev=tuple(motor),
        cos_rad=tuple(c for c, _ in motor.values()),
        sin_rad=tuple(s for _, s in motor.values()),
        link_orders_per_rev=tuple(link),
        link_cos_rad=tuple(c for c, _ in link.values()),
        link_sin_rad=tuple(s for _, s in link.values()),
    )
    if "hardening" in found:
        steps = tuple(found["hardening"].tolist())
        result = replace(result, hardening_rad=tuple(knots), hardening_nm_per_rad=steps)
    if "slips" in found:
        slips = zip(found["slips"].tolist(), SLIP_TRAVELS_RAD, strict=True)
        pairs = [(torque, travel) for torque, travel in slips if torque > 0.0]
        result = replace(
            result,
            slips_nm=tuple(torque for torque, _ in pairs),
            slips_travel_rad=tuple(travel for _, travel in pairs),
        )
    return result


def _waves(
    orders: Sequence[float], cos: Sequence[float], sin: Sequence[float]
) -> dict[float, tuple[float, float]]:
    return dict(zip(orders, zip(cos, sin, strict=True), strict=True))
