"""Replay of whole runs in arrays, by the vectorised twins of the estimators: the same numbers to rounding, much faster.

Inputs are the SI values of the log, which the exact replay compares with the raw frames. What the loop decides after the
estimate (starting, drive off or in fault, too late, what fits the field of the PDO) is decided here again, in arrays.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from daemon.loop import estimate_pdo
from daemon.loop.cycle import STARTING_CYCLES
from daemon.loop.joint_cycle import FLAG_TEMPERATURE, drive_status
from daemon.loop.joint_safety import JointSafety
from daemon.loop.joint_status import JointStatus
from daemon.loop.joint_tally import FLAG_LATCHED, FLAG_NETWORK_SKIPPED
from daemon.replay.breaks import Steps
from daemon.safety_settings import SafetySettings
from daemon.shared import cycle_record as cr
from daemon.shared import faults
from estimator.methods import AnyNetwork, estimate_steps
from estimator.parameters import Joint
from estimator.run import JointColumns
from estimator.settings import EstimatorSettings
from estimator.status import DEGRADED, INVALID, OFF, PUBLISHED, STALE, STANDSTILL, STARTING, VALID
from estimator.whole_run import EstimateRun

Records = npt.NDArray[np.void]
Floats = npt.NDArray[np.float64]
Codes = npt.NDArray[np.uint16]

WHOLE = np.dtype(
    [
        *((name, "<f8") for name in ("torque_nm", "sigma_nm", "tob_nm", "physics_nm", "network_nm")),
        ("status", "<u2"),
    ]
)
"""What the estimator makes of a cycle."""
_STAGES = ("torque_nm", "sigma_nm", "tob_nm", "physics_nm", "network_nm")
_IS_PUBLISHED = np.isin(np.arange(16), [*PUBLISHED])
_STEADY = frozenset((VALID, STANDSTILL, DEGRADED, OFF))
"""A status that is asked for and published stays as it is while the same is asked for."""


@dataclass(frozen=True)
class Model:
    """What one joint is estimated with."""

    joint: Joint
    settings: EstimatorSettings
    network: AnyNetwork | None


def replay_whole(model: Model, safety: JointSafety, records: Records, steps: Steps) -> Records:
    """Estimates [n] of the states `records` of one joint, fields as `WHOLE`. Raises ConfigError where nothing fits.

    Faults of the inputs, and those that are latched, are taken from the log.
    """
    rows: npt.NDArray[np.intp] | slice = slice(None) if steps.used.all() else np.flatnonzero(steps.used)
    flags, word, cycle = (records[name][rows] for name in ("input_flags", "statusword", "cycle"))
    columns = JointColumns(
        current_a=records["current_a"][rows].copy(),
        motor_position_rad=records["motor_position_rad"][rows].copy(),
        motor_velocity_rad_s=records["motor_velocity_rad_s"][rows].copy(),
        link_position_rad=records["link_position_rad"][rows].copy(),
        temperature_c=np.where(flags & FLAG_TEMPERATURE, records["temperature_c"][rows], np.nan),
    )
    values = {name: np.full(len(records), np.nan) for name in _STAGES}
    status = np.full(len(records), STALE, np.uint16)
    found = np.zeros(len(records), np.int64)
    if len(flags):
        dt_s = steps.dt_ns[rows].astype(np.float64) * 1e-9
        made = _estimates(model, dt_s, columns, (flags & FLAG_NETWORK_SKIPPED) != 0)
        for name in _STAGES:
            values[name][rows] = getattr(made, name)
        asked = made.status.astype(np.uint16)
        status[rows], found[rows] = _asked(
            made.torque_nm, made.sigma_nm, asked, _Cycles(flags, word, cycle), safety
        )
    status = status_many(status, found, records, safety.settings)
    fits = fields(values["torque_nm"], values["sigma_nm"], status)[0] != estimate_pdo.NO_TORQUE
    values["torque_nm"][~fits] = values["sigma_nm"][~fits] = np.nan
    out = np.empty(len(records), WHOLE)
    for name, column in values.items():
        out[name] = column
    out["status"] = status
    return out


class _Cycles(NamedTuple):
    """Flags of the inputs, statusword and number of the cycles [n]."""

    flags: Codes
    statusword: Codes
    cycle: npt.NDArray[np.uint64]


def _estimates(
    model: Model, dt_s: Floats, columns: JointColumns, skipped: npt.NDArray[np.bool_]
) -> EstimateRun:
    """Estimates [n]; in the samples `skipped` there was no time for the network, and they are physics only."""
    made = estimate_steps(model.joint, model.settings, model.network, dt_s, columns)
    if model.network is None or not skipped.any():
        return made
    alone = model.settings
    if alone.method == "network":
        alone = replace(alone, method="tob" if model.joint.efficiency is None else "efficiency")
    physics = estimate_steps(model.joint, alone, None, dt_s, columns)
    status = np.where(
        skipped & (physics.status == VALID), DEGRADED, np.where(skipped, physics.status, made.status)
    )
    return EstimateRun(
        np.where(skipped, physics.torque_nm, made.torque_nm),
        np.where(skipped, physics.sigma_nm, made.sigma_nm),
        status.astype(np.uint8),
        made.tob_nm,
        made.physics_nm,
        np.where(skipped, np.nan, made.network_nm),
        made.features,
    )


def _asked(
    torque_nm: Floats, sigma_nm: Floats, status: Codes, cycles: _Cycles, safety: JointSafety
) -> tuple[Codes, npt.NDArray[np.int64]]:
    """Status that each cycle asks for, and its faults [n]: twin of what `JointCycle.observe` does with an estimate."""
    found = np.where(cycles.flags & FLAG_LATCHED, 0, cycles.flags >> 8).astype(np.int64)
    found &= ~(faults.OUT_OF_RANGE | faults.NOT_FINITE)
    found[status == INVALID] |= faults.OUT_OF_RANGE
    powered = np.ones(len(status), np.bool_)
    for word in np.flatnonzero(
        np.bincount(cycles.statusword)
    ).tolist():  # there are few different ones in a run
        said = drive_status(word)
        if said is not None:
            here = cycles.statusword == word
            status[here], powered[here], found[here] = said, False, found[here] & ~faults.OUT_OF_RANGE
    publishable = powered & _IS_PUBLISHED[status]
    limit = safety.torque_limit_nm
    with np.errstate(invalid="ignore"):
        sigma_good = (sigma_nm >= 0.0) & np.isfinite(sigma_nm)
        good = (np.abs(torque_nm) <= limit) & sigma_good
        finite = np.isfinite(torque_nm) & sigma_good
    found[publishable & ~good & finite] |= faults.OUT_OF_RANGE
    found[publishable & ~good & ~finite] |= faults.NOT_FINITE
    status[publishable & (cycles.cycle < STARTING_CYCLES)] = STARTING
    return status, found


def status_many(
    asked: Codes, found: npt.NDArray[np.int64], records: Records, settings: SafetySettings
) -> Codes:
    """Status to publish [n]: `JointStatus` over a whole run, which is asked only where something changes."""
    state = JointStatus(settings)
    latched = (records["input_flags"] & FLAG_LATCHED) != 0
    key = asked.astype(np.int64) | found << 8 | latched.astype(np.int64) << 24
    key |= (records["cycle_flags"] & (cr.FLAG_WITHDRAWN | cr.FLAG_RESET)).astype(np.int64) << 25
    starts = np.concatenate(([0], np.flatnonzero(np.diff(key)) + 1))
    out = asked.copy()
    for start, end in zip(starts.tolist(), [*starts[1:].tolist(), len(key)], strict=True):
        if latched[start]:
            out[start:end] = records["status"][start:end]
            continue
        status, faulty = int(asked[start]), int(found[start])
        flags = int(records["cycle_flags"][start])
        row = start
        while row < end:
            if flags & cr.FLAG_RESET:
                state.reset_latch()
            said = state.update(status, faulty)
            if flags & cr.FLAG_WITHDRAWN:
                said = state.late()
            out[row] = said
            row += 1
            if said == status and not faulty and not flags & cr.FLAG_WITHDRAWN and status in _STEADY:
                state.pass_over(end - row)
                out[row:end] = said
                break
    return out


def fields(
    torque_nm: Floats, sigma_nm: Floats, status: Codes
) -> tuple[npt.NDArray[np.int16], npt.NDArray[np.uint8], Codes]:
    """Twin of `estimate_pdo.field` [n]: integers of torque, sigma and status."""
    limit = -estimate_pdo.NO_TORQUE - 1
    publishable = _IS_PUBLISHED[status]
    with np.errstate(invalid="ignore"):
        counts = torque_nm * 100.0
        fits = publishable & (np.abs(counts) <= limit) & (sigma_nm >= 0.0) & (sigma_nm < np.inf)
        known = fits & (sigma_nm <= 12.7)
    whole = np.where(fits, np.rint(np.where(fits, counts, 0.0)), estimate_pdo.NO_TORQUE).astype(np.int16)
    widths = np.ceil(np.where(known, sigma_nm, 0.0) * 20.0 - 1e-9)
    sigma = np.where(known, widths, estimate_pdo.SIGMA_UNKNOWN).astype(np.uint8)
    return whole, sigma, np.where(publishable & ~fits, INVALID, status).astype(np.uint16)
