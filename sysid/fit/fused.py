"""Fit section `fused` of a joint file: torsion, loss, operating envelope, and an uncertainty calibrated on held-out runs.

The runs are split into folds. Each run is compared with a fit on the other folds, which gives the residuals of the
uncertainty; the parameters that are written are those of all runs together.

    loss         additive loss (`losses.py`)                    torsion      spring and angle errors (`torsion.py`)
    envelope     what the runs covered (`envelope.py`)          sigma        standard deviations (`calibration.py`)
    tracking     of an estimate without delay (`calibration.py`)
    standstill   interval of a standing joint (`calibration.py`)
    zeros        day-to-day offset (`repeatability.py`)         agreement    of the two paths (`repeatability.py`)
    scale        last, with all of these (`calibration.py`)

A joint with one encoder has the current path alone: loss and sigma.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import Friction, Fused, Joint
from jtqd.estimator.text import counted
from jtqd.sysid.fit.calibration import (
    calibrated,
    fit_sigma,
    fit_standstill,
    fit_tracking,
    low_pass_advance,
    standing_errors,
)
from jtqd.sysid.fit.envelope import fit_envelope
from jtqd.sysid.fit.losses import LossFit, fit_loss
from jtqd.sysid.fit.repeatability import fit_agreement, fit_zeros
from jtqd.sysid.fit.residuals import PathResiduals, fused_errors, path_residuals
from jtqd.sysid.fit.signals import RunSignals
from jtqd.sysid.fit.torsion import fit_torsion

FOLDS: Final = 4
_LEAST_RUNS: Final = 6


@dataclass(frozen=True)
class FusedFit:
    """fused: the section; loss: details of its fit; held_out_rmse_nm: of the physics, one per run with motion."""

    fused: Fused
    loss: LossFit
    held_out_rmse_nm: tuple[float, ...]


def folds(runs: Sequence[RunSignals]) -> Iterator[tuple[list[RunSignals], list[int]]]:
    """Yield (runs to fit, indices of the held-out runs); whole runs, each held out exactly once."""
    for k in range(min(FOLDS, len(runs))):
        held_out = [n for n in range(len(runs)) if n % FOLDS == k]
        yield [run for n, run in enumerate(runs) if n not in held_out], held_out


def fit_fused(runs: Sequence[RunSignals], joint: Joint, *, two_encoders: bool = True) -> FusedFit:
    """Fit section `fused` of one joint.

    joint: friction and rated torque of its file are used.

    Raises:
        ValueError: fewer than 6 runs. LossFitError, TorsionError: the runs do not give a loss or a torsion.
    """
    if len(runs) < _LEAST_RUNS:
        raise ValueError(
            f"found {counted(len(runs), 'run')}, expected at least {_LEAST_RUNS}: standard deviations need held-out runs"
        )
    rated_nm = joint.rated_torque_nm
    moving, standing = _held_out(runs, joint.friction, two_encoders=two_encoders)
    fit = fit_loss(runs, joint.friction)
    fused = Fused(fit.loss, None, fit_sigma(moving, with_torsion=two_encoders))
    if two_encoders:
        torsion = fit_torsion(runs)
        fused = replace(fused, torsion=torsion, envelope=fit_envelope(runs, fit.loss, torsion, rated_nm))
    rmse = tuple(float(np.sqrt(np.mean(fused_errors(run, fused).error_nm ** 2))) for run in moving)
    if two_encoders:
        at_rest = [standing_errors(*run, fused) for run in standing]
        fused = replace(
            fused,
            tracking=fit_tracking(moving, fused),
            standstill=fit_standstill(at_rest, fused.sigma.reference_nm),
        )
        if fused.tracking is not None:
            moving = [run.with_tracked_torsion() for run in moving]
        fused = replace(fused, zeros=fit_zeros(moving, fused, rated_nm))
        fused = replace(fused, agreement=fit_agreement(moving, fused, rated_nm))
    return FusedFit(calibrated(moving, fused, rated_nm), fit, rmse)


def _held_out(
    runs: Sequence[RunSignals], friction: Friction, *, two_encoders: bool
) -> tuple[list[PathResiduals], list[tuple[PathResiduals, FloatArray]]]:
    """Return the residuals of every run with motion, in order, from fits on the other folds: moving; at rest.

    At rest only with two encoders, each with the `low_pass_advance` of its samples.
    """
    moving: dict[int, PathResiduals] = {}
    standing: dict[int, tuple[PathResiduals, FloatArray]] = {}
    for known, held_out in folds(runs):
        torsion = fit_torsion(known) if two_encoders else None
        loss = fit_loss(known, friction).loss
        for n in held_out:
            run = runs[n]
            if not run.moving.any():
                continue
            moving[n] = path_residuals(run, loss, torsion)
            if torsion is not None:
                advance = low_pass_advance(run, torsion)[run.standing]
                standing[n] = (path_residuals(run, loss, torsion, run.standing), advance)
    return [moving[n] for n in sorted(moving)], [standing[n] for n in sorted(standing)]
