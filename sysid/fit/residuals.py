"""What both paths of method `fused` miss on a run that the fit had not seen."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from jtqd.estimator.arrays import FloatArray

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
