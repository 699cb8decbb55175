"""A run that the fit had not seen, estimated as in service: error, standard deviation and what service adds to it.

    error = e_c + alpha (e_t - e_c)                      as old as the motor path
    spread = early sqrt(s_c^2 s_t^2/(s_c^2 + s_t^2))     early: what is not yet known of the day's zero
    error now = e_tracked + (1 - alpha) (e_c - e_t')     e_t': of the tracked torsion, made as old as the motor path
    more^2 = (disagreement beyond DISAGREE_SIGMAS)^2 + doubt^2

With zeros tracked, what is taken off both paths is in all of them (`zeros.pyx`, which defines early). Definitions of
disagreement and doubt: fusion.pyx, agreement.pyx.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from jtqd.estimator.agreement import followed
from jtqd.estimator.arrays import FloatArray, QuadrantArray
from jtqd.estimator.estimator import quadrants
from jtqd.estimator.fusion import DISAGREE_SIGMAS, GAUSS, Fusion
from jtqd.estimator.joint import Fused
from jtqd.sysid.fit.residuals import PathResiduals


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
