"""What a torsion makes of a run's observed signals, as FusedObserver does: deflection, its rate, slips, torque."""

from __future__ import annotations

from dataclasses import replace
from math import inf

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import Torsion
from jtqd.estimator.observer import RIPPLE_ORDERS, low_pass, slipped, tracked
from jtqd.sysid.fit.signals import AsRead, RunSignals


def deflection(torsion: Torsion, run: RunSignals) -> FloatArray:
    """Return d [n]: filtered torsion angle less zero and the errors of gear and link encoder.

    Raises ValueError for orders beyond RIPPLE_ORDERS where the run's positions are not known.
    """
    d: FloatArray = run.seen.torsion_nm - torsion.zero_rad
    for order, cos, sin in zip(torsion.orders_per_motor_rev, torsion.cos_rad, torsion.sin_rad, strict=True):
        d = d - _motor_waves(run, order) @ np.array((cos, sin))
    for order, cos, sin in zip(
        torsion.link_orders_per_rev, torsion.link_cos_rad, torsion.link_sin_rad, strict=True
    ):
        d = d - run.waves(_known(run.link_position_rad, order), order) @ np.array((cos, sin))
    return d


def _motor_waves(run: RunSignals, order: float) -> FloatArray:
    if order in RIPPLE_ORDERS:
        first = 2 * RIPPLE_ORDERS.index(order)  # c2, s2, c4, s4
        return run.seen.waves[:, first : first + 2]
    return run.waves(_known(run.motor_position_rad, order), order)


def _known(angle_rad: FloatArray | None, order: float) -> FloatArray:
    if angle_rad is None:
        known = " and ".join(map(str, RIPPLE_ORDERS))
        raise ValueError(
            f"found a torsion of order {order:g}, expected one of {known}: no positions are known"
        )
    return angle_rad


def stretched(d_rad: FloatArray, beyond_rad: float) -> FloatArray:
    """Return by how much |d| exceeds a deflection, with the sign of d [n]."""
    result: FloatArray = np.copysign(np.maximum(np.abs(d_rad) - beyond_rad, 0.0), d_rad)
    return result


def local_stiffness(torsion: Torsion, d_rad: FloatArray) -> FloatArray:
    """Return d tau_t/d d [n, Nm/rad] of the spring at deflections [n], without slips."""
    result: FloatArray = torsion.stiffness_nm_per_rad + 3.0 * torsion.cubic_nm_per_rad3 * d_rad * d_rad
    for beyond, stiffness in zip(torsion.hardening_rad, torsion.hardening_nm_per_rad, strict=True):
        result = result + stiffness * (np.abs(d_rad) > beyond)
    return result


def rate_of(d_rad: FloatArray, run: RunSignals) -> FloatArray:
    """Return d' [n, rad/s] of a filtered deflection, as FusedObserver forms it: over the step before; 0 beside a gap."""
    dt_s = run.seen.dt_s
    rate = np.diff(d_rad, prepend=np.nan) / np.where(dt_s > 0.0, dt_s, np.nan)
    return np.nan_to_num(rate, nan=0.0)


def torsion_torque(torsion: Torsion, run: RunSignals) -> tuple[FloatArray, FloatArray]:
    """Return tau_t and open [n] of observed signals, as FusedObserver gives them. Raises ValueError as `deflection`."""
    d = deflection(torsion, run)
    return _torque(torsion, d, rate_of(d, run))


def torsion_now(
    torsion: Torsion, run: RunSignals, as_read: AsRead, rate_rad_s: float, wave_rad_s: float
) -> FloatArray:
    """Return the torsion's torque [n] as FusedObserver forms it with the torsion tracked at these rates, of now.

    Raises ValueError where the run's positions are not known.
    """
    d, motor = _as_read(torsion, run, as_read)
    d, rate = tracked(d, motor, as_read.motor_velocity_rad_s, run.seen.dt_s, rate_rad_s, wave_rad_s)
    return _torque(torsion, d, rate)[0]


def torsion_through(torsion: Torsion, run: RunSignals, as_read: AsRead, bandwidth_rad_s: float) -> FloatArray:
    """Return the torsion's torque [n] as FusedObserver forms it through a low pass of its own, 1/g_t old.

    Raises ValueError where the run's positions are not known.
    """
    d = low_pass(_as_read(torsion, run, as_read)[0], run.seen.dt_s, bandwidth_rad_s)
    return _torque(torsion, d, rate_of(d, run))[0]


def _as_read(torsion: Torsion, run: RunSignals, as_read: AsRead) -> tuple[FloatArray, FloatArray]:
    """Return the deflection through no filter, and the motor's position [n]."""
    motor = run.motor_position_rad
    if run.link_position_rad is None or motor is None:
        raise ValueError(f"{run.name}: found no positions, expected those of both encoders")
    waves = [part(order * motor) for order in RIPPLE_ORDERS for part in (np.cos, np.sin)]
    seen = replace(run.seen, torsion_nm=as_read.torsion_rad, waves=np.column_stack(waves))
    return deflection(torsion, replace(run, seen=seen, bandwidth_rad_s=inf)), motor


def _torque(torsion: Torsion, d: FloatArray, rate_rad_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return tau_t and open [n] of a deflection and its rate [n]."""
    result: FloatArray = d * (torsion.stiffness_nm_per_rad + torsion.cubic_nm_per_rad3 * d * d)
    result = result + torsion.damping_nms_per_rad * rate_rad_s
    for beyond, stiffness in zip(torsion.hardening_rad, torsion.hardening_nm_per_rad, strict=True):
        result = result + stiffness * stretched(d, beyond)
    open_nm = np.zeros_like(d)
    elements = ((torsion.hysteresis_nm, torsion.hysteresis_travel_rad),)
    for torque, travel in (*elements, *zip(torsion.slips_nm, torsion.slips_travel_rad, strict=True)):
        if torque:
            z, width = slipped(d, travel)
            result, open_nm = result + torque * z, open_nm + torque * width
    return result, open_nm
