"""How much runs tell about the losses of a joint: D-optimality of the loss as a linear model in (v, tau). Pure.

The loss that is to be told apart, per direction of motion d and, in it, per quadrant (driving or back-driven):

    loss = s (c_d + f_d |v| + q_d v^2 + p_d exp(-(v/0.05)^2))                            s = tanh(v/0.02)
         + s (k_dq |tau| + m_dq tau^2 + n_dq |tau| |v|)

20 columns. The estimator's own loss (estimator/additive_loss.py) is finer in the load: lines between nodes. For a design
the few coefficients of a polynomial do better: they want the ends and the middle of every range, not a node's surroundings.

Both joints are served by one and the same number: at the same instant the other joint has (-v, tau), which only changes
places and signs of the columns, and no determinant.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from estimator.friction import DIRECTION_VELOCITY_RAD_S

FloatArray = NDArray[np.float64]

STRIBECK_VELOCITY_RAD_S: Final = 0.05
COLUMNS: Final = 20
_RIDGE: Final = 1e-9
"""Added to the diagonal of the information, whose columns have a mean square near 1: a run that leaves out a quadrant
gets a bad log det in place of an infinite one; that of a useful run changes by less than 0.001."""


def loss_regressor(velocity_rad_s: FloatArray, torque_nm: FloatArray) -> FloatArray:
    """Return the 20 columns of the loss model [..., 20] at velocities [rad/s] and joint torques [Nm] of one shape [...].

    Order: direction positive, then negative; in each 4 columns of speed, 3 of load driving (tau v >= 0), 3 back-driven.
    """
    v, tau = velocity_rad_s, torque_nm
    s = np.tanh(v / DIRECTION_VELOCITY_RAD_S)
    load, speed = np.abs(tau), np.abs(v)
    own = np.stack([s, speed * s, v * speed, s * np.exp(-np.square(v / STRIBECK_VELOCITY_RAD_S))], axis=-1)
    loaded = np.stack([load * s, load * load * s, load * speed * s], axis=-1)
    driving = tau * v >= 0.0
    blocks = []
    for side in (v >= 0.0, v < 0.0):
        blocks.append(own * side[..., None])
        blocks += [loaded * (side & quadrant)[..., None] for quadrant in (driving, ~driving)]
    return np.concatenate(blocks, axis=-1)


class Information:
    """Information matrices with fixed scales: the mean square of each column over the box of velocity and torque.

    velocity_rad_s, torque_nm: half widths of the box. The scale is a constant, so it shifts every log det by the same
    amount; it makes them readable and the matrices well scaled. Without it an optimum would be the same.
    """

    def __init__(self, velocity_rad_s: float, torque_nm: float) -> None:
        # fine in velocity for the narrow Stribeck column
        grid = np.meshgrid(
            velocity_rad_s * np.linspace(-1.0, 1.0, 1000), torque_nm * np.linspace(-1.0, 1.0, 20)
        )
        v, tau = (axis.ravel() for axis in grid)
        self._scale: Final = np.sqrt(np.mean(np.square(loss_regressor(v, tau)), axis=0))

    def of(self, velocity: FloatArray, torque: FloatArray) -> FloatArray:
        """Return X^T X / n [m, 20, 20] of m runs over n instants, [m, n] each, columns scaled."""
        X = loss_regressor(velocity, torque) / self._scale
        product: FloatArray = np.matmul(X.transpose(0, 2, 1), X) / X.shape[1]
        return product


def log_det(information: FloatArray) -> FloatArray:
    """Natural log of the determinant of [..., 20, 20], finite also where a quadrant is missing; higher is better."""
    return np.asarray(np.linalg.slogdet(information + _RIDGE * np.eye(information.shape[-1]))[1])


def condition(information: FloatArray) -> float:
    """Condition number of the scaled regressor, the root of that of its information [20, 20]."""
    return float(np.sqrt(np.linalg.cond(information)))
