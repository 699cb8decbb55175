"""Small known problems for the tests of the diagnosis' statistics: normal equations, columns and runs made by numpy."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.effects import EFFECTS
from jtqd.estimator.joint import Joint
from jtqd.estimator.run import JointColumns, RunTable
from jtqd.sysid.diagnosis.findings import JointName
from jtqd.sysid.diagnosis.regressors import ChannelData, EffectCandidate, RunData
from jtqd.sysid.diagnosis.signals import Channel

MOTOR1, TORSION1 = Channel(1, "motor"), Channel(1, "torsion")


def candidates(joint: Joint, *wanted: tuple[str, JointName, int]) -> list[EffectCandidate]:
    """The term of this number of each effect (name, joint, number), columns one after another."""
    out: list[EffectCandidate] = []
    first = 0
    for name, where, number in wanted:
        term = EFFECTS[name].terms(joint)[number]
        out.append(EffectCandidate(EFFECTS[name], where, term, first))
        first += len(term.basis)
    return out


def run_data(
    name: str, channels: Mapping[Channel, FloatArray], axes: Mapping[str, FloatArray], step_s: float = 0.005
) -> RunData:
    """A binned run with these residuals (NaN: not valid), a constant for its zero and no regressors; the axes of all its
    joints are the same, those that are not given are still.
    """
    count = len(next(iter(channels.values())))
    time_s = step_s * np.arange(count, dtype=np.float64)
    still = dict.fromkeys(
        ("velocity", "load", "temperature", "motor_angle", "link_angle", "current"), np.zeros(count)
    )
    none = np.empty(0, np.intp)
    return RunData(
        name,
        time_s,
        {
            c: ChannelData(
                np.isfinite(x),
                np.nan_to_num(x),
                np.empty((count, 0)),
                none,
                np.ones((count, 1)),
                np.array([0]),
            )
            for c, x in channels.items()
        },
        {c.joint: still | {"time": time_s} | dict(axes) for c in channels},
    )


def rigid_run(
    joint: Joint,
    phase: float = 0.0,
    *,
    seconds: float = 6.0,
    step_s: float = 1e-3,
    noise: float = 0.0,
    stribeck_nm: float = 0.0,
    stribeck_velocity_rad_s: float = 0.1,
    stiffness: float = 1.0,
    damping_nms_per_rad: float = 0.0,
) -> RunTable:
    """Joint 1 by the equations, both encoders, every quadrant. stiffness: the truth as part of the file's value; the gear is
    not damped, or as is said here.

    The motor's friction is that of the file and a Stribeck peak; noise: of the current, as torque at the joint [Nm].
    """
    t = np.arange(0.0, seconds, step_s)
    w = (1.3, 2.9)
    link = 0.7 * np.sin(w[0] * t + phase)
    torque = 0.3 * joint.rated_torque_nm * np.sin(w[1] * t + 2.0 * phase)
    bend = -(w[1] ** 2) * torque
    link_acceleration = -(w[0] ** 2) * link
    gear = torque + joint.link_inertia_kgm2 * link_acceleration
    gear_bend = bend + joint.link_inertia_kgm2 * w[0] ** 4 * link
    K = stiffness * joint.stiffness_nm_per_rad
    twist = gear / K
    if damping_nms_per_rad:  # to first order in the damper's time
        twist = twist - damping_nms_per_rad * np.gradient(gear, t) / K**2
    motor = link + twist
    velocity = 0.7 * w[0] * np.cos(w[0] * t + phase) + np.gradient(twist, t)
    friction = joint.friction
    peak = stribeck_nm * np.exp(-((velocity / stribeck_velocity_rad_s) ** 2))
    loss = np.sign(velocity) * (friction.coulomb_nm + peak) + friction.viscous_nms_per_rad * velocity
    G = joint.gear_ratio
    inertial = joint.rotor_inertia_kgm2 * G**2 * (link_acceleration + gear_bend / K)
    random = np.random.default_rng(int(1000 * phase)).normal(0.0, 1.0, len(t))
    current = (gear + loss + inertial + noise * random) / (G * joint.torque_constant_nm_per_a)
    columns = JointColumns(
        current_a=current, motor_position_rad=G * motor, link_position_rad=link, torque_nm=torque
    )
    return RunTable(t, {1: columns})


def rich_run(
    joint: Joint,
    seed: int,
    *,
    seconds: float = 6.0,
    step_s: float = 1e-3,
    noise: float = 0.0,
    zero: float = 0.0,
) -> RunTable:
    """Joint 1 by the equations, both encoders, motion and load of many periods each: what differs in one run shows.

    noise: of current and link encoder, as torque at the joint; zero: of the sensor; both as parts of the rated torque.
    """
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, step_s)

    def waves(slowest_s: float, fastest_s: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        w = 2.0 * np.pi / np.geomspace(slowest_s, fastest_s, 5) * rng.uniform(0.8, 1.25, 5)
        size, phase = w**-0.6 * rng.uniform(0.5, 1.0, 5), rng.uniform(0.0, 2.0 * np.pi, 5)
        angle = w[:, None] * t + phase[:, None]
        scale = 1.0 / float(np.abs(size @ np.sin(angle)).max())
        return (
            scale * (size @ np.sin(angle)),
            scale * ((size * w) @ np.cos(angle)),
            -scale * ((size * w**2) @ np.sin(angle)),
        )

    link, speed, acceleration = (0.5 * x for x in waves(5.0, 0.5))
    torque, rate, bend = (0.45 * joint.rated_torque_nm * x for x in waves(3.0, 0.25))
    G, K, friction = joint.gear_ratio, joint.stiffness_nm_per_rad, joint.friction
    gear = torque + joint.link_inertia_kgm2 * acceleration
    velocity = speed + rate / K
    bent = (gear - joint.damping_nms_per_rad * rate / K) / K
    loss = friction.coulomb_nm * np.sign(velocity) + friction.viscous_nms_per_rad * velocity
    inertial = joint.rotor_inertia_kgm2 * G**2 * (acceleration + bend / K)
    noise_nm = noise * joint.rated_torque_nm * rng.normal(size=len(t))
    columns = JointColumns(
        current_a=(gear + loss + inertial + noise_nm) / (G * joint.torque_constant_nm_per_a),
        motor_position_rad=G * (link + bent),
        link_position_rad=link + noise * joint.rated_torque_nm / K * rng.normal(size=len(t)),
        torque_nm=torque + zero * joint.rated_torque_nm,
    )
    return RunTable(t, {1: columns})
