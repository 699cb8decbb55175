"""Held-out residuals: the error of current path and torsion path on a run that the fit did not use, and of their fusion.

    error = e_c + alpha (e_t - e_c)                          with the delay of the motor path
    spread = early sqrt(s_c^2 s_t^2/(s_c^2 + s_t^2))         early: the day's offset is not yet known
    error, no delay = e_tracked + (1 - alpha) (e_c - e_t')   e_t': of the tracked torsion through the motor path's filter
    more^2 = (disagreement beyond DISAGREE_SIGMAS)^2 + doubt^2

With `track_zeros` the corrections of both paths are in all of them. Definitions of early, disagreement and doubt:
path_difference.pyx, uncertainty.pyx.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from jtqd.estimator.arrays import BoolArray, FloatArray, QuadrantArray
from jtqd.estimator.estimator import SLOPE_NM, quadrants
from jtqd.estimator.joint import AdditiveLoss, Fused, Torsion
from jtqd.estimator.losses import AdditiveLossModel
from jtqd.estimator.observer import low_pass
from jtqd.estimator.path_difference import track_run
from jtqd.estimator.uncertainty import DISAGREE_SIGMAS, GAUSS, Fusion, faded
from jtqd.sysid.fit.signals import RunSignals
from jtqd.sysid.fit.torsion import (
    deflection,
    local_stiffness,
    low_pass_torque,
    torsion_torque,
    tracked_torque,
)

NONE: Final = np.zeros(0)


class PathResiduals(NamedTuple):
    """One held-out run: arrays [n] of its moving samples, [Nm] and [rad/s].

    half: width of the friction interval (`AdditiveLossModel.loss`). open: what the slip leaves open.
    Without torsion torsion_nm, open_nm, torsion_error_nm are 0, and what follows is empty:
    dt_s, direction, slope (dL/draw of the loss): for `fused.agreement`. stiffness (d tau_t/d d): for `fused.zeros`.
    tracked, delayed, low_pass: errors of the tracked torsion, of that through the motor path's filter, and of the torsion
    through the low pass of new configurations, against the unfiltered sensor: for `fused.tracking`.
    loss_nm, turn [n, 6] (filtered cos and sin of 1, 2 and 4 times the motor angle): for `fused.agreement.turn`.
    """

    raw_nm: FloatArray
    velocity_rad_s: FloatArray
    half_nm: FloatArray
    torsion_nm: FloatArray
    open_nm: FloatArray
    current_error_nm: FloatArray
    torsion_error_nm: FloatArray
    dt_s: FloatArray = NONE
    direction: FloatArray = NONE
    slope: FloatArray = NONE
    tracked_nm: FloatArray = NONE
    delayed_nm: FloatArray = NONE
    low_pass_nm: FloatArray = NONE
    stiffness_nm_per_rad: FloatArray = NONE
    loss_nm: FloatArray = NONE
    turn: FloatArray = NONE

    @property
    def apart_nm(self) -> FloatArray:
        """Difference of torsion path and current path [n]."""
        return self.torsion_error_nm - self.current_error_nm

    @property
    def fusion_inputs(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """What the array methods of `Fusion` take."""
        return self.raw_nm, self.half_nm, self.velocity_rad_s, self.torsion_nm, self.open_nm

    def with_tracked_torsion(self) -> PathResiduals:
        """Return the run with the tracked torsion, delayed as the motor path: the estimator compares these two."""
        return self._replace(
            torsion_nm=self.torsion_nm + self.delayed_nm - self.torsion_error_nm,
            torsion_error_nm=self.delayed_nm,
        )


def path_residuals(
    run: RunSignals, loss: AdditiveLoss, torsion: Torsion | None, keep: BoolArray | None = None
) -> PathResiduals:
    """Return the errors of both paths on samples `keep` [n] of a run, None: those in motion."""
    keep, seen = run.moving if keep is None else keep, run.seen
    loss_nm, wide = (each[keep] for each in loss_and_width(run, loss))
    raw, sensor, velocity = seen.raw_nm[keep], run.sensor_nm[keep], seen.velocity_rad_s[keep]
    current = raw - loss_nm - sensor
    if torsion is None:
        none = np.zeros(len(raw))
        return PathResiduals(raw, velocity, wide, none, none, current, none)
    tau, open_nm = (each[keep] for each in torsion_torque(torsion, run))
    direction = seen.direction[keep]
    more, _ = AdditiveLossModel(loss).loss_many(raw + SLOPE_NM, velocity, seen.temperature_c[keep], direction)
    tracked = tracked_torque(torsion, run) - run.raw_sensor_nm
    return PathResiduals(
        raw,
        velocity,
        wide,
        tau,
        open_nm,
        current,
        tau - sensor,
        dt_s=seen.dt_s[keep],
        direction=direction,
        slope=(more - loss_nm) / SLOPE_NM,
        tracked_nm=tracked[keep],
        delayed_nm=low_pass(tracked, seen.dt_s, run.bandwidth_rad_s)[keep],
        low_pass_nm=(low_pass_torque(torsion, run) - run.raw_sensor_nm)[keep],
        stiffness_nm_per_rad=local_stiffness(torsion, deflection(torsion, run)[keep]),
        loss_nm=loss_nm,
        turn=np.column_stack((seen.turn, seen.waves))[keep],
    )


def loss_and_width(run: RunSignals, loss: AdditiveLoss) -> tuple[FloatArray, FloatArray]:
    """Return loss and held half width of the friction interval [n] over a run; zero where nothing was observed."""
    seen = run.seen
    running = ~np.isnan(seen.raw_nm)
    raw, v, s = (np.where(running, x, 0.0) for x in (seen.raw_nm, seen.velocity_rad_s, seen.direction))
    value, half = AdditiveLossModel(loss).loss_many(raw, v, seen.temperature_c, s)
    return value, faded(half, seen.dt_s, running)


class FusedErrors(NamedTuple):
    """Errors of the estimator in one run, arrays [n] of its samples in motion.

    undelayed: with the torsion tracked. spread: standard deviation of the torque, scale 1. more: what the estimator adds to
    it. known: what the tracked offset takes off the torsion's variance.
    """

    error_nm: FloatArray
    undelayed_nm: FloatArray
    spread_nm: FloatArray
    more_nm2: FloatArray
    velocity_rad_s: FloatArray
    quadrant: QuadrantArray
    known_nm2: FloatArray


def fused_errors(
    run: PathResiduals, fused: Fused, rated_nm: float | None = None, *, track_zeros: bool = False
) -> FusedErrors:
    """Return the errors that the estimator makes in a run with this section.

    rated_nm None, or a joint without torsion: nothing is learned in the run, neither offsets nor doubt.
    """
    fusion = Fusion(replace(fused.sigma, reference_nm=0.0), fused.torsion is not None)
    paths = fusion.fuse(*run.fusion_inputs)
    torsion, current, known, doubt, gain = np.zeros((5, len(run.raw_nm)))
    early = np.ones(len(run.raw_nm))
    if rated_nm is not None and fused.torsion is not None and len(run.dt_s):
        torsion, current, known, doubt, gain, early = track_run(
            fused,
            rated_nm,
            run.dt_s,
            run.apart_nm,
            run.direction,
            run.velocity_rad_s,
            run.torsion_nm,
            paths.variance_nm2,
            run.slope,
            run.stiffness_nm_per_rad,
            track_zeros,
        )
    if known.any():
        paths = fusion.fuse(*run.fusion_inputs, known_nm2=known)
    alpha, _, spread, variance = paths
    e_c, e_t = run.current_error_nm + current, run.torsion_error_nm + torsion
    share = np.maximum(alpha, 1.0 - alpha)
    more = (doubt + (gain * (run.torsion_nm + torsion)) ** 2) * share**2 + alpha**2 * np.minimum(known, doubt)
    if fused.torsion is not None:
        apart = np.maximum(np.abs(e_t - e_c) - DISAGREE_SIGMAS * np.sqrt(variance), 0.0)
        more += (share * apart / GAUSS) ** 2
    undelayed = NONE
    if len(run.tracked_nm):
        undelayed = run.tracked_nm + torsion + (1.0 - alpha) * (e_c - run.delayed_nm - torsion)
    return FusedErrors(
        e_c + alpha * (e_t - e_c),
        undelayed,
        spread * early,
        more,
        run.velocity_rad_s,
        quadrants(run.raw_nm, run.velocity_rad_s),
        known,
    )
