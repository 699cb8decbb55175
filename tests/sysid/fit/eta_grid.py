"""Plateaus that lie on a joint's own efficiency polynomials exactly, for tests of the fit."""

from __future__ import annotations

from collections.abc import Sequence

from jtqd.estimator.joint import QUADRANTS, Joint
from jtqd.sysid.fit.efficiency import EtaPoint, default_current_min, eta_points
from jtqd.sysid.fit.plateaus import Mean, Plateau
from tests.estimator.estimator_helpers import joint1
from tests.sysid.campaign_helpers import VELOCITIES_RAD_S

JOINT = joint1()
NM_PER_A = JOINT.gear_ratio * JOINT.torque_constant_nm_per_a


def plateau(
    i: float, v: float, tau: float, *, se_i: float = 1e-4, se_tau: float = 1e-3, run: str = "run"
) -> Plateau:
    return Plateau(run, 0.0, 2.0, Mean(v, 1e-4), Mean(i, se_i), Mean(tau, se_tau), 20, 25.0)


def grid(joint: Joint = JOINT) -> list[Plateau]:
    """Plateaus that lie on the joint's own polynomials exactly, at section II's velocities and 1 to 5 A."""
    found = []
    for name in QUADRANTS:
        sign_i, sign_v = (1.0 if "i_pos" in name else -1.0), (1.0 if "w_pos" in name else -1.0)
        for speed in VELOCITIES_RAD_S:
            for size in (1.0, 2.0, 3.0, 4.0, 5.0):
                i, v = sign_i * size, sign_v * speed
                eta = getattr(joint.efficiency, name).value(i, v)
                assert joint.efficiency is not None
                ratio = eta if joint.efficiency.convention == "joint_over_motor" else 1.0 / eta
                found.append(plateau(i, v, ratio * NM_PER_A * i))
    return found


def points_of(plateaus: Sequence[Plateau], joint: Joint = JOINT) -> list[EtaPoint]:
    return eta_points(plateaus, joint, default_current_min(joint))[0]
