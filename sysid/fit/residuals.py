"""What both paths of method `fused` miss on a run that the fit had not seen.
A run that the fit had not seen, estimated as in service: error, standard deviation and what service adds to it.

    error = e_c + alpha (e_t - e_c)                      as old as the motor path
    spread = early sqrt(s_c^2 s_t^2/(s_c^2 + s_t^2))     early: what is not yet known of the day's zero
    error now = e_tracked + (1 - alpha) (e_c - e_t')     e_t': of the tracked torsion, made as old as the motor path
    more^2 = (disagreement beyond DISAGREE_SIGMAS)^2 + doubt^2

With zeros tracked, what is taken off both paths is in all of them (`zeros.pyx`, which defines early). Definitions of
disagreement and doubt: fusion.pyx, agreement.pyx.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from jtqd.estimator.arrays import BoolArray, FloatArray, QuadrantArray
from jtqd.estimator.estimator import SLOPE_NM, quadrants
from jtqd.estimator.joint import (
    AdditiveLoss,
    Fused,
    Torsion,
)
from jtqd.estimator.losses import AdditiveLossModel
from jtqd.estimator.observer import low_pass
from jtqd.estimator.path_difference import followed
from jtqd.estimator.settings import TORSION_BANDWIDTH_RAD_S
from jtqd.estimator.uncertainty import DISAGREE_SIGMAS, GAUSS, Fusion, held
from jtqd.sysid.fit.signals import RunSignals
from jtqd.sysid.fit.torsion import deflection, local_stiffness, torsion_now, torsion_through, torsion_torque

TRACKING_RAD_S: Final = 400.0
WAVE_RAD_S: Final = 160.0
"""Rates of the torsion's tracking filter: at rest no noisier than a low pass of 800 rad/s; chosen from a table,
docs/estimator.md."""


NONE: Final = np.zeros(0)
"""Of what is not known of a run."""


class NowErrors(NamedTuple):
    """Of the torsion against the sensor as it is, [n]: tracked; that through the motor path's filter; a low pass's."""

    tracked_nm: FloatArray = NONE
    aged_nm: FloatArray = NONE
    late_nm: FloatArray = NONE


class PathResiduals(NamedTuple):
    """One unseen run: arrays [n] of its moving samples (Nm, rad/s); half: `AdditiveLossModel.loss`; open: of the slip.

    torsion_nm, open_nm and torsion_error_nm are 0 where there is no torsion. dt_s, direction and slope (dL/draw of the loss)
    are for `fused.agreement`, stiffness (d tau_t/d d) for `fused.zeros`, now for `fused.tracking`; empty: the run does not
    count there. loss_nm, turn [n, 6] (filtered cos and sin of 1, 2 and 4 times the motor's angle): for
    `fused.agreement.turn`, empty as before.
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
    now: NowErrors = NowErrors()
    stiffness_nm_per_rad: FloatArray = NONE
    loss_nm: FloatArray = NONE
    turn: FloatArray = NONE

    def tracked(self) -> PathResiduals:
        """Return the run with the tracked torsion, made as old as the motor path: what service compares with the current."""
        error = self.now.aged_nm
        return self._replace(
            torsion_nm=self.torsion_nm + error - self.torsion_error_nm, torsion_error_nm=error
        )


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


class Served(NamedTuple):
    """One run, arrays [n] of its samples in motion. spread: of the torque, scale 1; now: empty where it is not known;
    known: what is taken off the torsion's variance."""

    error_nm: FloatArray
    now_nm: FloatArray
    spread_nm: FloatArray
    more_nm2: FloatArray
    velocity_rad_s: FloatArray
    quadrant: QuadrantArray
    known_nm2: FloatArray


def served(
    run: PathResiduals, fused: Fused, rated_nm: float | None = None, *, tracked: bool = False
) -> Served:
    """Return a run of a joint as service has it with this section; tracked: with `track_zeros`.

    rated_nm None, or a run without `dt_s`: nothing is learned in the run, neither zeros nor doubt.
    """
    fusion = Fusion(replace(fused.sigma, reference_nm=0.0), fused.torsion is not None)
    seen = (run.raw_nm, run.half_nm, run.velocity_rad_s, run.torsion_nm, run.open_nm)
    variance = fusion.variance_many(*seen)
    apart = run.torsion_error_nm - run.current_error_nm
    torsion, current, known, doubt, gain = np.zeros((5, len(run.raw_nm)))
    early = np.ones(len(run.raw_nm))
    if rated_nm is not None and fused.torsion is not None and len(run.dt_s):
        torsion, current, known, doubt, gain, early = followed(
            fused,
            rated_nm,
            run.dt_s,
            apart,
            run.direction,
            run.velocity_rad_s,
            run.torsion_nm,
            variance,
            run.slope,
            run.stiffness_nm_per_rad,
            tracked,
        )
    alpha, spread = fusion.weigh_known(*seen, known) if known.any() else fusion.weigh_many(*seen)
    e_c, e_t = run.current_error_nm + current, run.torsion_error_nm + torsion
    share = np.maximum(alpha, 1.0 - alpha)
    more = (doubt + (gain * (run.torsion_nm + torsion)) ** 2) * share**2 + alpha**2 * np.minimum(known, doubt)
    if fused.torsion is not None:
        apart = np.maximum(np.abs(e_t - e_c) - DISAGREE_SIGMAS * np.sqrt(variance), 0.0)
        more += (share * apart / GAUSS) ** 2
    now = run.now.tracked_nm
    if len(now):
        now = now + torsion + (1.0 - alpha) * (e_c - run.now.aged_nm - torsion)
    return Served(
        e_c + alpha * (e_t - e_c),
        now,
        spread * early,
        more,
        run.velocity_rad_s,
        quadrants(run.raw_nm, run.velocity_rad_s),
        known,
    )
