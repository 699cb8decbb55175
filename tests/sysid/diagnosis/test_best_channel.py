"""Which channel the acceleration is of: the one that shows it best, unless it is late, filtered or of another scale."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np
import pytest
from scipy import signal

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import Joint
from jtqd.estimator.run import JointColumns, RunTable
from jtqd.models.files import load_joint, shipped
from jtqd.sysid.diagnosis.signals import BaseLoss, JointSignals, joint_signals

JOINT: Final[Joint] = replace(load_joint(shipped("joint1.yaml")), efficiency=None, effects=())
RATE_HZ: Final = 500.0
T: Final = np.arange(0.0, 12.0, 1.0 / RATE_HZ)
G: Final = JOINT.gear_ratio


def motion() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Angle, velocity and acceleration of the joint: some waves."""
    waves = [(0.6, 1.7, 0.2), (0.2, 5.3, 1.0), (0.05, 14.0, 2.0)]
    return (
        np.sum([a * np.sin(w * T + p) for a, w, p in waves], axis=0),
        np.sum([a * w * np.cos(w * T + p) for a, w, p in waves], axis=0),
        np.sum([-a * w * w * np.sin(w * T + p) for a, w, p in waves], axis=0),
    )


Q, V, A = motion()


def rounded(x: FloatArray, step: float) -> FloatArray:
    return np.asarray(step * np.round(x / step))


def held_rows(x: FloatArray) -> FloatArray:
    """One row in twenty is the one before once more."""
    again = np.flatnonzero(np.random.default_rng(1).random(len(x)) < 0.05)
    again = again[again > 0]
    out = x.copy()
    out[again] = x[again - 1]
    return out


def noisy(x: FloatArray, sigma: float) -> FloatArray:
    return x + np.random.default_rng(7).normal(scale=sigma, size=len(x))


def filtered(x: FloatArray, hz: float) -> FloatArray:
    return np.asarray(signal.sosfilt(signal.butter(1, hz, fs=RATE_HZ, output="sos"), x))


def signals(columns: JointColumns, joint: Joint = JOINT) -> JointSignals:
    return joint_signals("run", RunTable(T, {1: columns}), 1, joint, BaseLoss(joint))


def columns(**others: FloatArray) -> JointColumns:
    return JointColumns(current_a=0.1 * np.cos(T), torque_nm=np.sin(0.7 * T) + np.sin(3.1 * T), **others)


COARSE: Final = 2e-4
"""Joint side [rad]."""
GOOD: Final = 1e-3
"""Noise of a velocity, joint side [rad/s]."""


@pytest.mark.parametrize(
    ("position", "velocity", "of_position"),
    [
        (lambda: noisy(Q, 1e-9), lambda: noisy(V, GOOD), True),
        (lambda: rounded(Q, COARSE), lambda: noisy(V, GOOD), False),
        (lambda: held_rows(rounded(Q, COARSE)), lambda: noisy(V, GOOD), False),
        (lambda: rounded(Q, COARSE), lambda: noisy(V, 0.2), True),
        (lambda: rounded(Q, COARSE), lambda: noisy(np.roll(V, 5), GOOD), True),
        (lambda: rounded(Q, COARSE), lambda: noisy(filtered(V, 20.0), GOOD), True),
        (lambda: rounded(Q, COARSE), lambda: noisy(1.1 * V, GOOD), True),
        (lambda: noisy(Q, 0.05), lambda: noisy(V, GOOD), False),
    ],
    ids=["fine", "coarse", "repeated rows", "noisy", "late", "filtered", "scaled", "no fine position"],
)
@pytest.mark.parametrize("side", ["motor", "link"])
def test_the_channel_that_shows_the_acceleration_best_is_taken(
    position: Callable[[], FloatArray], velocity: Callable[[], FloatArray], of_position: bool, side: str
) -> None:
    ratio = G if side == "motor" else 1.0
    named = {f"{side}_position_rad": ratio * position(), f"{side}_velocity_rad_s": ratio * velocity()}
    s = signals(columns(**named))
    assert s.of_position == of_position
    inside = slice(200, -200)
    a = s.state.motor_acceleration_rad_s2[inside] / G
    assert float(np.std(a - A[inside])) < 0.12 * float(np.std(A)), "what is taken is the acceleration"


def test_a_derived_motor_position_is_the_one_encoder_and_its_velocity_counts() -> None:
    """An arm: joint position and velocity, of which a column map makes the motor's position."""
    q, v = rounded(Q, COARSE), noisy(V, GOOD)
    s = signals(columns(motor_position_rad=G * q, link_position_rad=q, link_velocity_rad_s=v))
    assert not s.of_position
    assert s.torsion_nm is None


def test_a_velocity_of_the_link_is_not_the_motors_where_both_have_an_encoder() -> None:
    twist = 4e-3 * np.sin(9.0 * T)
    q, v = rounded(Q, 1e-6), noisy(V, GOOD)
    s = signals(
        columns(motor_position_rad=G * rounded(Q + twist, COARSE), link_position_rad=q, link_velocity_rad_s=v)
    )
    assert s.of_position
    assert s.torsion_nm is not None
