"""Motor residuals where the losses depend on the load: expanded about the sensor's zero of the run. Pure.

The simulation takes its losses at the measured torque, so a zero z of the sensor is in the residual twice: as -z, and
as the losses' error. Driving with an efficiency of a half that doubles it, driven back it takes part of it away:

    motor = .. - loss0(tau) - tau = .. - z - (loss0(tau) - loss0(tau - z))  ~  .. - z (1 + loss0')

A zero of 0.3 Nm is not small where the efficiency turns from driving to driven back, within 2 Nm. So loss0 is expanded
about a first guess z0 of each run's zero and not about 0; the residual still holds the whole of z, now linearly. A bad
guess does no harm but that of none.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from estimator.friction import FloatArray
from sysid.diagnosis.base_loss import BaseLoss
from sysid.diagnosis.signals import JointSignals

_LARGEST_NM: Final = 2.0
_TURNS: Final = 2


def about_zero(run: Sequence[JointSignals], bases: Mapping[int, BaseLoss]) -> list[JointSignals]:
    """Return the signals of one run's joints with motor residual and `per_torque` expanded about the run's zero."""
    if not any(bases[s.number].depends_on_load for s in run):
        return list(run)
    out = [_expanded(s, bases[s.number], 0.0) for s in run]
    for _ in range(_TURNS):
        guess = _first_guess(out)
        out = [_expanded(s, bases[s.number], guess) for s in run]
    return out


def _expanded(s: JointSignals, base: BaseLoss, zero_nm: float) -> JointSignals:
    torque, velocity = s.state.torque_nm, s.state.velocity_rad_s
    true = torque - zero_nm
    slope = base.slope(true, velocity)
    less = base.loss(torque, velocity) - base.loss(true, velocity) - slope * zero_nm
    return replace(s, motor_nm=s.motor_nm + less, per_torque=1.0 + slope)


def _first_guess(run: Sequence[JointSignals]) -> float:
    """Return the zero [Nm] that fits all motor balances best, beside friction, inertia and gain of each joint."""
    rows: list[FloatArray] = []
    rest: list[FloatArray] = []
    for k, s in enumerate(run):
        good, state = s.moving, s.state
        if not good.any():
            continue
        own = np.column_stack(
            (
                state.direction,
                state.velocity_rad_s,
                state.current_a,
                state.motor_acceleration_rad_s2,
                state.torque_nm,
            )
        )[good]
        wide = np.zeros((len(own), 1 + 5 * len(run)))
        wide[:, 0] = -np.broadcast_to(s.per_torque, good.shape)[good]
        wide[:, 1 + 5 * k : 6 + 5 * k] = own
        rows.append(wide)
        rest.append(s.motor_nm[good])
    if not rows:
        return 0.0
    found = np.linalg.lstsq(np.concatenate(rows), np.concatenate(rest), rcond=None)[0]
    return float(np.clip(found[0], -_LARGEST_NM, _LARGEST_NM))
