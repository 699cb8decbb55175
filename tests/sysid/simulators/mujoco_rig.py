"""A run in MuJoCo: the exported joint runs free for half a second at a time, driven by what was measured."""

from __future__ import annotations

import math

import mujoco
import numpy as np

from jtqd.estimator.run import RunTable

WINDOW_S = 0.5


def free_run_error(xml: str, table: RunTable, number: int, gear_ratio: float) -> float:
    """Rms error of the velocity [rad/s, joint side] over windows that begin in the measured state.

    ctrl is the measured current. The measured torque acts on the link, so in every coordinate that turns it.
    """
    model = mujoco.MjModel.from_xml_string(xml)
    dt = float(np.median(np.diff(table.time_s)))
    inner = max(1, round(dt / model.opt.timestep))
    model.opt.timestep = dt / inner
    data = mujoco.MjData(model)
    columns = table.joint(number, gear_ratio)
    assert columns.motor_position_rad is not None
    assert columns.current_a is not None
    assert columns.torque_nm is not None
    angle = columns.motor_position_rad / gear_ratio
    speed = np.gradient(angle, table.time_s)
    flexible = model.nv == 2
    errors: list[float] = []
    steps = round(WINDOW_S / dt)
    for start in range(2, len(angle) - steps - 2, steps):
        mujoco.mj_resetData(model, data)
        data.qpos[0], data.qvel[0] = angle[start], speed[start]
        if flexible:
            stiffness = float(model.jnt_stiffness[1])
            data.qpos[1] = -columns.torque_nm[start] / stiffness
            rate = (columns.torque_nm[start + 1] - columns.torque_nm[start - 1]) / (2.0 * dt)
            data.qvel[1] = -rate / stiffness
        for k in range(start, start + steps):
            data.ctrl[0] = 0.5 * (columns.current_a[k] + columns.current_a[k + 1])
            data.qfrc_applied[:] = -0.5 * (columns.torque_nm[k] + columns.torque_nm[k + 1])
            mujoco.mj_step(model, data, nstep=inner)
            errors.append(float(data.qvel[0] - speed[k + 1]))
    return math.sqrt(float(np.mean(np.square(errors))))
