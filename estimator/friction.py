"""Additive friction of the joint side: Coulomb + Stribeck + viscous, with a smooth direction.

    tau_f(v) = tanh(v/w0) (Fc + Fs exp(-(v/vs)^2)) + Fv v          v = omega_m/G [rad/s], tau_f [Nm]

w0 = 0.02 rad/s is twice the standstill threshold: below it the direction of friction is not known anyway,
above 0.1 rad/s the direction is +-1 to 1e-4.
"""

from __future__ import annotations

from math import exp, tanh
from typing import Final

import numpy as np
import numpy.typing as npt

from estimator.parameters import Friction

DIRECTION_VELOCITY_RAD_S: Final = 0.02
"""w0: velocity of the joint side over which the direction of every loss turns."""

FloatArray = npt.NDArray[np.float64]


def static_friction(friction: Friction) -> float:
    """Return the torque [Nm, joint side] below which the joint may stand still: Fc + Fs."""
    return friction.coulomb_nm + friction.stribeck_nm


class FrictionModel:
    """tau_f(v) of this file with its constants at hand; odd in v, dissipative."""

    __slots__ = ("coulomb", "inverse_stribeck", "inverse_w0", "static", "stribeck", "viscous")

    def __init__(self, friction: Friction) -> None:
        self.coulomb: Final = friction.coulomb_nm
        self.stribeck: Final = friction.stribeck_nm
        self.viscous: Final = friction.viscous_nms_per_rad
        self.inverse_stribeck: Final = 1.0 / friction.stribeck_velocity_rad_s
        self.inverse_w0: Final = 1.0 / DIRECTION_VELOCITY_RAD_S
        self.static: Final = static_friction(friction)

    def torque(self, velocity_rad_s: float) -> float:
        """Return friction [Nm, joint side] at a joint-side velocity [rad/s]; its sign is the velocity's."""
        v = velocity_rad_s
        x = v * self.inverse_stribeck
        return tanh(v * self.inverse_w0) * (self.coulomb + self.stribeck * exp(-x * x)) + self.viscous * v

    def torque_many(self, velocity_rad_s: FloatArray) -> FloatArray:
        """Vectorised twin of `torque`, any shape."""
        v = velocity_rad_s
        x = v * self.inverse_stribeck
        result: FloatArray = (
            np.tanh(v * self.inverse_w0) * (self.coulomb + self.stribeck * np.exp(-x * x)) + self.viscous * v
        )
        return result
