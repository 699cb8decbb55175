"""Numbers of the paper: Table I, the fitted efficiency of its integrated joint.

Table I holds eta = tau_j/(G Kt i), below 1 when driving: the reciprocal of the paper's Eq. (6), so that its
Eq. (7) must multiply by it. Velocity is omega_m/G [rad/s], 0.2 to 3; current in A.
"""

from __future__ import annotations

from typing import Final

from estimator.parameters import Efficiency, QuadrantPolynomial

TABLE_I: Final = Efficiency(
    convention="joint_over_motor",
    i_pos_w_pos=QuadrantPolynomial(0.2530, 0.1493, -0.0820, -0.0117, 0.0060, 0.0066, rmse=0.01963),
    i_neg_w_neg=QuadrantPolynomial(0.2850, -0.1430, 0.0839, -0.0114, 0.0059, 0.0060, rmse=0.01719),
    i_neg_w_pos=QuadrantPolynomial(1.8830, 0.4870, 0.2602, 0.0658, 0.0435, -0.0168, rmse=0.05599),
    i_pos_w_neg=QuadrantPolynomial(1.8660, -0.4769, -0.2342, 0.0645, 0.04295, -0.0101, rmse=0.05504),
)
