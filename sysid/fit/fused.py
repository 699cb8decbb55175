"""Fit section `fused` of a joint file: torsion, loss, standard deviations and their calibration.

Standard deviations come from runs that the fit had not seen: the runs are split into folds, each fold is compared with a
fit on the others, and the parameters that are written are those of all runs together.

With residuals e_c = tau_raw - loss - sensor and e_t = tau_t - sensor on runs not seen:

    reference^2 = covariance of the two paths' run means, less its standard error: what both share is the sensor's zero
    e_c^2 - reference^2 ~ current^2 + (viscous v)^2 + (load tau_raw)^2
    e_t^2 - reference^2 - open^2 ~ torsion^2 + (load tau_t)^2
    zeros: how far the link encoder's zero differs from day to day (`sysid/fit/zeros.py`)
    agreement: how far the two paths differ on ordinary days (`sysid/fit/agreement.py`)
    tracking: what an estimate of now errs by beyond that (`sysid/fit/tracking.py`)
    scale_q: in quadrant q, so that the interval with all of these holds on a run left out (`sysid/fit/calibration.py`)
    standstill: how wide the interval of a standing joint is (`sysid/fit/standstill.py`)

A joint with one encoder has the current path alone (torsion None): nothing tells the sensor's zero from that path's
own error, so reference is 0 and sigma holds both.

The level of 90 % is unbiased, not the conservative one that guarantees at least 90 %. Where a whole run shares its error
(its zeros), n runs have not shown the largest yet: 8 of them cover 87 % of others.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.optimize import nnls

from jtqd.estimator.agreement import levels
from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.estimator.checked import counted
from jtqd.estimator.envelope import MAX_CELLS, Envelope
from jtqd.estimator.estimator import SLOPE_NM
from jtqd.estimator.fusion import Fusion, held
from jtqd.estimator.joint import (
    AdditiveLoss,
    Agreement,
    Friction,
    Fused,
    FusedSigma,
    Torsion,
    Tracking,
)
from jtqd.estimator.losses import AdditiveLossModel
from jtqd.estimator.observer import low_pass
from jtqd.estimator.settings import TORSION_BANDWIDTH_RAD_S
from jtqd.sysid.fit.agreement import Levels, TurnRun, fit_agreement, fit_turn
from jtqd.sysid.fit.calibration import calibrated
from jtqd.sysid.fit.envelope import (
    FIT_ROOM_K,
    MOST_WIDER,
    TORQUE_STEP_SHARE,
    envelope_of,
    velocity_step,
    widened,
)
from jtqd.sysid.fit.losses import LossFit, fit_loss
from jtqd.sysid.fit.residuals import NowErrors, PathResiduals
from jtqd.sysid.fit.served import served
from jtqd.sysid.fit.signals import RunSignals
from jtqd.sysid.fit.standstill import KNOWN, Standing, ahead_nm, fit_standstill
from jtqd.sysid.fit.torsion import fit_torsion
from jtqd.sysid.fit.torsion_signals import (
    deflection,
    local_stiffness,
    torsion_now,
    torsion_through,
    torsion_torque,
)
from jtqd.sysid.fit.tracking import TRACKING_RAD_S, WAVE_RAD_S, fit_tracking, worth_it
from jtqd.sysid.fit.zeros import fit_zeros

_FLOOR_NM: Final = 0.02
_FAST_RAD_S: Final = 0.1
"""Slower samples do not count for sigma: near a reversal the loss is not settled, which `half` accounts for."""


def fit_sigma(runs: Sequence[PathResiduals], *, with_torsion: bool = True) -> FusedSigma:
    """Return the standard deviations of both paths, scale 1; without torsion those of the current path.

    Raises ValueError for fewer than three runs with samples, or none above 0.1 rad/s.
    """
    runs = [run for run in runs if len(run.raw_nm)]
    if len(runs) < 3:
        raise ValueError(f"found {len(runs)} held-out runs with motion, expected at least 3")
    current = np.array([run.current_error_nm.mean() for run in runs])
    torsion = np.array([run.torsion_error_nm.mean() for run in runs])
    products = (current - current.mean()) * (torsion - torsion.mean())
    # less its standard error: what is not surely the sensor's stays in the sigma of the torque
    doubt = float(np.std(products)) / np.sqrt(len(runs))
    shared = max(float(np.mean(products)) - doubt, _FLOOR_NM**2) if with_torsion else 0.0
    fast = [np.abs(run.velocity_rad_s) > _FAST_RAD_S for run in runs]
    if not any(map(np.any, fast)):
        raise ValueError(f"found no held-out sample above {_FAST_RAD_S} rad/s, expected some")
    raw, v, e_c, e_t, t, open_nm = (
        np.concatenate([getattr(run, name)[keep] for run, keep in zip(runs, fast, strict=True)])
        for name in (
            "raw_nm",
            "velocity_rad_s",
            "current_error_nm",
            "torsion_error_nm",
            "torsion_nm",
            "open_nm",
        )
    )
    ones = np.ones_like(v)
    a = nnls(np.column_stack((ones, v * v, raw * raw)), e_c * e_c - shared)[0]
    current_nm = max(float(np.sqrt(a[0])), _FLOOR_NM)
    # without torsion the estimator does not read its sigma; the file must have a number above 0
    b = (
        nnls(np.column_stack((ones, t * t)), e_t * e_t - shared - open_nm * open_nm)[0]
        if with_torsion
        else np.array((current_nm**2, 0.0))
    )
    return FusedSigma(
        current_nm=current_nm,
        viscous_nms_per_rad=float(np.sqrt(a[1])),
        load=float(np.sqrt(a[2])),
        torsion_nm=max(float(np.sqrt(b[0])), _FLOOR_NM),
        torsion_load=float(np.sqrt(b[1])),
        reference_nm=float(np.sqrt(shared)),
        scale=(1.0, 1.0, 1.0, 1.0),
    )


FOLDS: Final = 4
_LEAST_RUNS: Final = 6


@dataclass(frozen=True)
class FusedFit:
    """fused: the section; loss: details of its fit; unseen_rmse_nm: of the physics, one per run with motion, each run
    judged by a fit that had not seen it.
    """

    fused: Fused
    loss: LossFit
    unseen_rmse_nm: tuple[float, ...]


def folds(runs: Sequence[RunSignals], count: int = FOLDS) -> Iterator[tuple[list[RunSignals], list[int]]]:
    """Yield (runs to fit, indices of the runs left out); whole runs, each left out exactly once."""
    for k in range(min(count, len(runs))):
        judged = [n for n in range(len(runs)) if n % count == k]
        yield [run for n, run in enumerate(runs) if n not in judged], judged


def fit_fused(
    runs: Sequence[RunSignals],
    friction: Friction,
    rated_nm: float | None = None,
    *,
    with_torsion: bool = True,
) -> FusedFit:
    """Fit section `fused` of one joint.

    runs: at least 6 (ValueError); friction: of the joint file; rated_nm: its rated torque, of which the envelope's steps are
    a part, None: without an envelope; with_torsion: False for a joint with one encoder, which has no envelope either. Raises
    LossFitError, TorsionError.
    """
    if len(runs) < _LEAST_RUNS:
        raise ValueError(
            f"found {counted(len(runs), 'run')}, expected at least {_LEAST_RUNS}: standard deviations need held-out runs"
        )
    unseen, standing = _unseen(runs, friction, with_torsion=with_torsion)
    sigma = fit_sigma(unseen, with_torsion=with_torsion)
    fit = fit_loss(runs, friction)
    torsion = fit_torsion(runs) if with_torsion else None
    envelope = None if rated_nm is None or torsion is None else _envelope(runs, fit.loss, torsion, rated_nm)
    fused = Fused(fit.loss, torsion, sigma, envelope=envelope)
    rmse = tuple(float(np.sqrt(np.mean(served(run, fused).error_nm ** 2))) for run in unseen)
    if torsion is not None:
        standing_errors = [_standing(*run, fused) for run in standing]
        fused = replace(
            fused,
            tracking=tracking_of_unseen(unseen, fused),
            standstill=fit_standstill(standing_errors, sigma.reference_nm),
        )
        if fused.tracking is not None:
            unseen = [run.tracked() for run in unseen]
    if rated_nm is not None and torsion is not None:
        fused = replace(fused, zeros=fit_zeros(unseen, fused, rated_nm))
        fused = replace(fused, agreement=_agreement(unseen, fused, rated_nm))
    fused = calibrated(unseen, fused, rated_nm)
    return FusedFit(fused, fit, rmse)


def tracking_of_unseen(unseen: Sequence[PathResiduals], fused: Fused) -> Tracking | None:
    """Return what an estimate of now adds to sigma on unseen runs of a joint with torsion.

    None where the low pass of new configurations errs no more, or positions are not known.
    """
    if not all(len(run.now.tracked_nm) == len(run.raw_nm) for run in unseen):
        return None
    if not worth_it([run.now.tracked_nm for run in unseen], [run.now.late_nm for run in unseen]):
        return None
    each = [served(run, fused) for run in unseen]
    return fit_tracking(
        [run.error_nm for run in each], [run.now_nm for run in each], [run.velocity_rad_s for run in each]
    )


def _agreement(unseen: Sequence[PathResiduals], fused: Fused, rated_nm: float) -> Agreement | None:
    """Return how far the two paths differ on unseen runs; None for too little motion."""
    fusion = Fusion(fused.sigma, True)

    def of_runs(agreement: Agreement) -> list[Levels]:
        usual = replace(fused, agreement=agreement)
        return [
            levels(
                usual,
                rated_nm,
                run.dt_s,
                run.torsion_error_nm - run.current_error_nm,
                run.direction,
                run.velocity_rad_s,
                run.torsion_nm,
                fusion.variance_many(
                    run.raw_nm, run.half_nm, run.velocity_rad_s, run.torsion_nm, run.open_nm
                ),
                run.slope,
            )
            for run in unseen
            if len(run.dt_s)
        ]

    found = fit_agreement(of_runs)
    if found is None:
        return None
    turning = [
        TurnRun(
            run.dt_s,
            run.torsion_error_nm - run.current_error_nm,
            run.direction,
            run.velocity_rad_s,
            run.loss_nm,
            run.turn,
        )
        for run in unseen
        if len(run.turn)
    ]
    return replace(found, turn=fit_turn(turning))


def _envelope(
    runs: Sequence[RunSignals], loss: AdditiveLoss, torsion: Torsion, rated_nm: float
) -> Envelope | None:
    """Return what the runs covered; None where that takes a larger map than an envelope may have."""
    seen = [path_residuals(run, loss, torsion) for run in runs if run.moving.any()]
    velocity = np.concatenate([run.velocity_rad_s for run in seen])
    made = envelope_of(
        velocity,
        np.concatenate([run.raw_nm for run in seen]),
        np.concatenate([run.torsion_error_nm - run.current_error_nm for run in seen]),
        [run.temperature_c for run in runs],
        velocity_step_rad_s=velocity_step(velocity),
        torque_step_nm=TORQUE_STEP_SHARE * rated_nm,
        room_k=FIT_ROOM_K,
    )
    if max(len(made.known), len(made.known[0])) > MAX_CELLS - 2 * MOST_WIDER:
        return None
    load = max(float(np.abs(run.torsion_nm).max()) for run in seen)
    return replace(widened(made, [(run.velocity_rad_s, run.raw_nm) for run in seen]), load_nm=load)


def _unseen(
    runs: Sequence[RunSignals], friction: Friction, *, with_torsion: bool
) -> tuple[list[PathResiduals], list[tuple[PathResiduals, FloatArray]]]:
    """Return the residuals of every run with motion, in order, from fits on the runs of the other folds: moving; at rest.

    At rest only with torsion, each with what `ahead_nm` says of its samples.
    """
    moving: dict[int, PathResiduals] = {}
    standing: dict[int, tuple[PathResiduals, FloatArray]] = {}
    for known, judged in folds(runs):
        torsion = fit_torsion(known) if with_torsion else None
        loss = fit_loss(known, friction).loss
        for n in judged:
            run = runs[n]
            if not run.moving.any():
                continue
            moving[n] = path_residuals(run, loss, torsion)
            if torsion is not None:
                ahead = ahead_nm(run, torsion)[run.standing]
                standing[n] = (path_residuals(run, loss, torsion, run.standing), ahead)
    return [moving[n] for n in sorted(moving)], [standing[n] for n in sorted(standing)]


def path_residuals(
    run: RunSignals, loss: AdditiveLoss, torsion: Torsion | None, keep: BoolArray | None = None
) -> PathResiduals:
    """Return what both paths miss on samples `keep` [n] of a run, None: those in motion; loss and torsion from elsewhere."""
    keep, seen = run.moving if keep is None else keep, run.seen
    loss_nm, wide = loss_and_width(run, loss)
    raw, sensor = seen.raw_nm[keep], run.sensor_nm[keep]
    current = raw - loss_nm[keep] - sensor
    velocity, half = seen.velocity_rad_s[keep], wide[keep]
    if torsion is None:
        none = np.zeros(len(raw))
        return PathResiduals(raw, velocity, half, none, none, current, none)
    tau, open_nm = (each[keep] for each in torsion_torque(torsion, run))
    more, _ = AdditiveLossModel(loss).loss_many(
        raw + SLOPE_NM, velocity, seen.temperature_c[keep], seen.direction[keep]
    )
    slope = (more - loss_nm[keep]) / SLOPE_NM
    dt, direction = seen.dt_s[keep], seen.direction[keep]
    now = NowErrors()
    if run.as_read is not None:
        error = torsion_now(torsion, run, run.as_read, TRACKING_RAD_S, WAVE_RAD_S) - run.as_read.sensor_nm
        late = torsion_through(torsion, run, run.as_read, TORSION_BANDWIDTH_RAD_S) - run.as_read.sensor_nm
        now = NowErrors(error[keep], low_pass(error, seen.dt_s, run.bandwidth_rad_s)[keep], late[keep])
    stiffness = local_stiffness(torsion, deflection(torsion, run)[keep])
    return PathResiduals(
        raw,
        velocity,
        half,
        tau,
        open_nm,
        current,
        tau - sensor,
        dt,
        direction,
        slope,
        now,
        stiffness,
        loss_nm[keep],
        np.column_stack((seen.turn, seen.waves))[keep] if len(seen.turn) else np.zeros(0),
    )


def loss_and_width(run: RunSignals, loss: AdditiveLoss) -> tuple[FloatArray, FloatArray]:
    """Return loss and held half width of the friction interval [n] over a run; zero where nothing was observed."""
    seen = run.seen
    running = ~np.isnan(seen.raw_nm)
    raw, v, s = (np.where(running, x, 0.0) for x in (seen.raw_nm, seen.velocity_rad_s, seen.direction))
    value, half = AdditiveLossModel(loss).loss_many(raw, v, seen.temperature_c, s)
    return value, held(half, seen.dt_s, running)


def _standing(run: PathResiduals, ahead: FloatArray, fused: Fused) -> Standing:
    """Return what a standing run tells of the interval at rest."""
    spread, bound = Fusion(replace(fused.sigma, reference_nm=0.0), True).rest_many(
        run.raw_nm, run.half_nm, run.velocity_rad_s, run.torsion_nm, run.open_nm
    )
    error = served(run, fused).error_nm
    return Standing(error + ahead, spread, bound, run.open_nm <= KNOWN * fused.sigma.torsion_nm)
