"""Loss torque of a joint file as the simulation computes it."""

from __future__ import annotations

from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import Joint
from jtqd.estimator.losses import DRIVING_CURRENT_MAX_A, LossModel
from jtqd.sim_can.plant import TORQUE_STEPS, LossTable
from jtqd.sim_can.plant_file import plant_of_joint

_SLOPE: Final = 0.0075
"""Part of the rated torque over which the losses' slope is taken: as wide as zeros of torque sensors are."""


class BaseLoss:
    """Losses of one joint file as the simulation has them, loss0(tau, v), signed like the velocity [Nm, joint side].

    The law of the emulated plant for this file (`jtqd.sim_can.plant_file.plant_of_joint`): with an efficiency the table of
    `jtqd.sim_can.plant` and the file's Stribeck peak, else the file's friction. The direction of friction is known: samples
    near rest, where a simulation's smoothing would matter, are not used by the diagnosis.
    """

    def __init__(self, joint: Joint) -> None:
        self._friction: Final = joint.friction
        self._slope_nm: Final = _SLOPE * joint.rated_torque_nm
        self._rows: tuple[FloatArray, FloatArray] | None = None
        if joint.efficiency is not None:
            highest = max(DRIVING_CURRENT_MAX_A, 9.0)
            table = LossTable(
                LossModel(joint).loss, joint.gear_ratio, joint.torque_constant_nm_per_a, highest
            )
            self._rows = (np.array(table.forward), np.array(table.reverse))
            self._limit = table.torque_limit
            self._per_torque = table.per_torque_step
            self._per_velocity = table.per_velocity_step
            self._last = table.last_row
            peak = plant_of_joint(joint).joints[0].deviations.stribeck
            self._peak = peak.torque_nm, peak.velocity_rad_s

    @property
    def depends_on_load(self) -> bool:
        """Whether the joint file has an efficiency."""
        return self._rows is not None

    def loss(self, torque_nm: FloatArray, velocity_rad_s: FloatArray) -> FloatArray:
        """Return the loss [n] at torque_nm [n] and velocity_rad_s [n]."""
        v = velocity_rad_s
        if self._rows is None:
            f = self._friction
            peak = f.stribeck_nm * np.exp(-((v / f.stribeck_velocity_rad_s) ** 2))
            result: FloatArray = np.sign(v) * (f.coulomb_nm + peak) + f.viscous_nms_per_rad * v
            return result
        x = np.minimum(np.abs(v) * self._per_velocity, self._last + 1.0)
        k = np.minimum(x.astype(np.intp), self._last)
        y = np.clip((torque_nm + self._limit) * self._per_torque, 0.0, TORQUE_STEPS - 1e-9)
        m = y.astype(np.intp)
        x, y = x - k, y - m
        out = np.empty_like(v)
        for rows, here in ((self._rows[0], v >= 0.0), (self._rows[1], v < 0.0)):
            a, b, p, q = k[here], m[here], x[here], y[here]
            low = rows[a, b] + q * (rows[a, b + 1] - rows[a, b])
            high = rows[a + 1, b] + q * (rows[a + 1, b + 1] - rows[a + 1, b])
            out[here] = low + p * (high - low)
        height, vs = self._peak
        signed: FloatArray = np.sign(v) * (out + height * np.exp(-((v / vs) ** 2)))
        return signed

    def slope(self, torque_nm: FloatArray, velocity_rad_s: FloatArray) -> FloatArray:
        """Return d loss / d torque [n]: torque that is wrong by e leaves a loss wrong by slope times e.

        Zero without efficiency: such losses know no load. Taken over +-_SLOPE of the rated torque, so that the grid of the
        table does not show.
        """
        if self._rows is None:
            return np.zeros_like(velocity_rad_s)
        wide = self._slope_nm
        ahead = self.loss(torque_nm + wide, velocity_rad_s)
        behind = self.loss(torque_nm - wide, velocity_rad_s)
        return (ahead - behind) / (2.0 * wide)
