"""Motions of the Panda: joint torques, pushes and payloads by MuJoCo, without noise."""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import mujoco
import numpy as np

from jtqd.daemon.arm.model import ArmModel
from validation.arm.arm import TOOL, URDF, rigid
from validation.arm.arm import Payload as TruePayload

JOINTS = [f"panda_joint{k}" for k in range(1, 8)]
PERIOD_S = 1e-3


class Push(NamedTuple):
    """A force [N] in base axes at a point of a link, from one cycle to another."""

    link: int
    point_m: tuple[float, float, float]
    force_n: tuple[float, float, float]
    first: int
    last: int
    rise: int = 10


class Motion(NamedTuple):
    position_rad: np.ndarray
    torque_nm: np.ndarray
    external_nm: np.ndarray
    wrench: np.ndarray


@cache
def model_text() -> str:
    return URDF.read_text(encoding="utf-8")


def new_model() -> ArmModel:
    return ArmModel(model_text(), JOINTS, TOOL)


def moved(
    cycles: int,
    *,
    payload: TruePayload | None = None,
    push: Push | None = None,
    seed: int = 1,
    still: bool = False,
    factors: np.ndarray | None = None,
    shifts_m: np.ndarray | None = None,
) -> Motion:
    """Return a motion of all joints by MuJoCo, without noise."""
    rng = np.random.default_rng(seed)
    t = PERIOD_S * np.arange(cycles)[:, None]
    size = np.zeros(7) if still else rng.uniform(0.2, 0.4, 7)
    rate, phase = rng.uniform(1.0, 2.5, 7), rng.uniform(0.0, 6.0, 7)
    centre = np.array([0.2, -0.4, 0.3, -1.8, 0.4, 1.6, 0.5])
    q = centre + size * np.sin(rate * t + phase)
    v, a = size * rate * np.cos(rate * t + phase), -size * rate**2 * np.sin(rate * t + phase)
    model: Any = rigid(factors, shifts_m, payload)
    data = mujoco.MjData(model)
    need, external, wrench = np.zeros_like(q), np.zeros_like(q), np.zeros((cycles, 6))
    jacobian = np.zeros((3, 7))
    for k in range(cycles):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[k], v[k], a[k]
        mujoco.mj_inverse(model, data)
        need[k] = data.qfrc_inverse
        if push is not None and push.first <= k < push.last:
            share = min((k - push.first + 1) / push.rise, 1.0)
            point = data.xpos[push.link] + data.xmat[push.link].reshape(3, 3) @ np.array(push.point_m)
            mujoco.mj_jac(model, data, jacobian, None, point, push.link)
            force = share * np.array(push.force_n)
            external[k] = jacobian.T @ force
            if push.link == 7:
                tool = data.site_xpos[model.site("tool").id]
                wrench[k] = *force, *np.cross(point - tool, force)
    return Motion(q, need - external, external, wrench)
