"""What a torsion has beyond stiffness, cube, one slip and the waves of orders 2 and 4, where runs left out confirm it.

    hardening   the spring is stiffer (or softer) beyond deflections b_k, in straight parts, in place of the cube
    link        error of the link encoder over its own turn, orders 1 to 3
    motor       kinematic error of orders 1 and 3 of the motor's turn
    slips       several slip elements in place of one

Each is a group of columns of a linear model of the sensor's torque. The group that takes most off the error on runs left out
is taken first, and none that takes less than WORTH of it. A run's own zero is no error: it is the day's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.estimator.joint import Torsion
from jtqd.estimator.observer import slipped
from jtqd.sysid.fit.signals import RunSignals
from jtqd.sysid.fit.torsion_signals import deflection, local_stiffness, rate_of, stretched, torsion_torque

WORTH: Final = 0.05
"""Part of the variance on runs left out that an extension must take away to be believed."""
EXTENSIONS: Final = ("hardening", "link", "motor", "slips")
KNOTS: Final = (0.1, 0.25, 0.45, 0.65, 0.85)
"""Where the spring may change its stiffness, in parts of the largest deflection."""
LINK_ORDERS: Final = (1.0, 2.0, 3.0)
MOTOR_ORDERS: Final = (1.0, 3.0)
SLIP_TRAVELS_RAD: Final = (4e-5, 1e-4, 2.5e-4, 6e-4, 1.2e-3)
_EVERY: Final = 5
_FOLDS: Final = 4
_REPETITIONS: Final = 3
_SOFTEST: Final = 0.3
"""Least slope of a spring that is believed, in parts of its stiffness at rest."""
_RIDGE: Final = 1e-6
"""A priori pull towards zero, in parts of each column's own power."""


class _Table(NamedTuple):
    """Equations of one run: target [n], its own zero taken off, and columns [n, k] by group."""

    target: FloatArray
    columns: Mapping[str, FloatArray]


def extended(runs: Sequence[RunSignals], torsion: Torsion) -> Torsion:
    """Return the torsion with those of EXTENSIONS that runs left out confirm; unchanged where positions are not known."""
    if len(runs) < 2 * _FOLDS or any(run.motor_position_rad is None for run in runs):
        return torsion
    largest = max(float(np.abs(deflection(torsion, run)[run.moving]).max(initial=0.0)) for run in runs)
    knots = tuple(part * largest for part in KNOTS)
    tables = [_table(run, torsion, knots) for run in runs if np.count_nonzero(run.moving) > _EVERY]
    chosen: tuple[str, ...] = ()
    least = _left_out(tables, chosen)
    while len(chosen) < len(EXTENSIONS):
        scores = {name: _left_out(tables, (*chosen, name)) for name in EXTENSIONS if name not in chosen}
        best = min(scores, key=scores.__getitem__)
        if not scores[best] < (1.0 - WORTH) * least:
            break
        chosen, least = (*chosen, best), scores[best]
    if not chosen:
        return torsion
    result = torsion
    for _ in range(_REPETITIONS):
        tables = [_table(run, result, knots) for run in runs if np.count_nonzero(run.moving) > _EVERY]
        found = _solved(tables, chosen)
        result = _refined(result, found, chosen, knots)
    if not _hardens(result):
        return torsion
    below = np.mean([np.mean((run.sensor_nm - torsion_torque(result, run)[0])[run.moving]) for run in runs])
    return replace(result, zero_rad=result.zero_rad - float(below) / result.stiffness_nm_per_rad)


def _table(run: RunSignals, torsion: Torsion, knots: Sequence[float]) -> _Table:
    assert run.motor_position_rad is not None
    assert run.link_position_rad is not None
    keep = np.flatnonzero(run.moving)[::_EVERY]
    d = deflection(torsion, run)
    # an error of an angle is a torque by the spring's stiffness where it is: that at rest counts as 1
    stiffer = (local_stiffness(torsion, d) / torsion.stiffness_nm_per_rad)[:, None]
    columns = {
        "spring": d[:, None],
        "cubic": d[:, None] ** 3,
        "damping": rate_of(d, run)[:, None],
        "ripple": stiffer * run.seen.waves,
        "slip": slipped(d, torsion.hysteresis_travel_rad)[0][:, None],
        "hardening": np.column_stack([stretched(d, knot) for knot in knots]),
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


def _weights(x: FloatArray, y: FloatArray, signs: BoolArray) -> FloatArray:
    """Return the least squares coefficients; those of `signs` that come out below zero are left out, one after the other."""
    power = x.T @ x
    power[np.diag_indices_from(power)] *= 1.0 + _RIDGE
    right = x.T @ y
    active = np.diag(power) > 0.0
    while True:
        w = np.zeros(x.shape[1])
        w[active] = np.linalg.lstsq(power[np.ix_(active, active)], right[active], rcond=None)[0]
        below = np.where(signs & active, w, 0.0)
        worst = int(np.argmin(below))
        if not below[worst] < 0.0:
            return w
        active[worst] = False


def _signs(tables: Sequence[_Table], groups: Sequence[str]) -> BoolArray:
    """Return which columns dissipate, and therefore have a coefficient of at least 0."""
    return np.concatenate(
        [np.full(tables[0].columns[name].shape[1], name in ("slip", "slips", "damping")) for name in groups]
    )


def _left_out(tables: Sequence[_Table], chosen: Sequence[str]) -> float:
    """Return the mean variance [Nm^2] on runs left out, each less its own zero."""
    groups = _groups(chosen)
    signs = _signs(tables, groups)
    errors = []
    for fold in range(_FOLDS):
        others = [each for k, each in enumerate(tables) if k % _FOLDS != fold]
        w = _weights(*_stacked(others, groups), signs)
        for each in tables[fold::_FOLDS]:
            x, y = _stacked([each], groups)
            errors.append(float(np.var(y - x @ w)))
    return float(np.mean(errors))


def _solved(tables: Sequence[_Table], chosen: Sequence[str]) -> dict[str, FloatArray]:
    """Return the coefficients by group, of all runs."""
    groups = _groups(chosen)
    w = _weights(*_stacked(tables, groups), _signs(tables, groups))
    ends = np.cumsum([tables[0].columns[name].shape[1] for name in groups])
    return dict(zip(groups, np.split(w, ends[:-1]), strict=True))


def _refined(
    torsion: Torsion, found: Mapping[str, FloatArray], chosen: Sequence[str], knots: Sequence[float]
) -> Torsion:
    """Return the torsion with these coefficients; waves of a torque are waves of the angle, over the stiffness."""
    stiffness = float(found["spring"][0])
    result = replace(
        torsion,
        stiffness_nm_per_rad=stiffness,
        cubic_nm_per_rad3=float(found["cubic"][0]) if "cubic" in found else 0.0,
        damping_nms_per_rad=float(found["damping"][0]),
        hysteresis_nm=float(found["slip"][0]) if "slip" in found else 0.0,
    )
    if "hardening" in chosen:
        steps = tuple(found["hardening"].tolist())
        result = replace(result, hardening_rad=tuple(knots), hardening_nm_per_rad=steps)
    if "slips" in chosen:
        pairs = [
            pair for pair in zip(found["slips"].tolist(), SLIP_TRAVELS_RAD, strict=True) if pair[0] > 0.0
        ]
        torques, travels = zip(*pairs, strict=True) if pairs else ((), ())
        result = replace(result, slips_nm=torques, slips_travel_rad=travels)
    motor = dict(
        zip(torsion.orders_per_motor_rev, zip(torsion.cos_rad, torsion.sin_rad, strict=True), strict=True)
    )
    link = dict(
        zip(
            torsion.link_orders_per_rev,
            zip(torsion.link_cos_rad, torsion.link_sin_rad, strict=True),
            strict=True,
        )
    )
    _add_waves(motor, (2.0, 4.0), found["ripple"], stiffness)
    if "motor" in chosen:
        _add_waves(motor, MOTOR_ORDERS, found["motor"], stiffness)
    if "link" in chosen:
        _add_waves(link, LINK_ORDERS, found["link"], stiffness)
    return replace(
        result,
        orders_per_motor_rev=tuple(motor),
        cos_rad=tuple(c for c, _ in motor.values()),
        sin_rad=tuple(s for _, s in motor.values()),
        link_orders_per_rev=tuple(link),
        link_cos_rad=tuple(c for c, _ in link.values()),
        link_sin_rad=tuple(s for _, s in link.values()),
    )


def _add_waves(
    waves: dict[float, tuple[float, float]], orders: Sequence[float], torque: FloatArray, stiffness: float
) -> None:
    for order, (c, s) in zip(orders, torque.reshape(-1, 2).tolist(), strict=True):
        before = waves.get(order, (0.0, 0.0))
        waves[order] = (before[0] - c / stiffness, before[1] - s / stiffness)


def _hardens(torsion: Torsion) -> bool:
    """Return whether the spring's torque rises everywhere."""
    slopes = torsion.stiffness_nm_per_rad + np.cumsum((0.0, *torsion.hardening_nm_per_rad))
    return bool(slopes.min() > _SOFTEST * torsion.stiffness_nm_per_rad > 0.0)
