"""Noise against age: what an age costs of a ripple, and that a tracked torsion has none; late stamps."""

from __future__ import annotations

import numpy as np
import pytest

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.run import JointColumns
from jtqd.sysid.evaluate.bandwidths import TrueRun, cost_of_age, latched_beside, lines, tradeoff
from tests.estimator.test_torsion_bandwidth import SPEED, lossless

TIME = 0.001 * np.arange(4000)


def of(torque: FloatArray) -> TrueRun:
    """A joint at constant speed whose both views see this torque exactly."""
    joint = lossless(0.3, 0.3)
    link = SPEED * TIME
    columns = JointColumns(
        current_a=torque / (joint.gear_ratio * joint.torque_constant_nm_per_a),
        motor_position_rad=joint.gear_ratio * (link + torque / 12000.0),
        motor_velocity_rad_s=np.full(len(TIME), joint.gear_ratio * SPEED),
        link_position_rad=link,
    )
    return TrueRun(joint, TIME, columns, torque)


def test_an_age_costs_of_a_ripple_what_its_low_pass_takes_off() -> None:
    omega = 2.0 * np.pi * 50.0
    run = of(4.0 * np.sin(omega * TIME))
    found = cost_of_age([run], 800.0)
    expected = 4.0 / 2.0**0.5 * omega / np.hypot(omega, 800.0) / run.joint.rated_torque_nm
    assert found.percent == pytest.approx(100.0 * expected, rel=0.02)
    assert found.ripple_percent > 99.0
    assert cost_of_age([of(4.0 * np.sin(2.0 * np.pi * 5.0 * TIME))], 800.0).ripple_percent < 5.0


def test_a_tracked_torsion_is_of_now_and_marked() -> None:
    run = of(5.0 * np.sin(20.0 * TIME))
    low, tracked = tradeoff([run], 800.0), tradeoff([run], 400.0, tracks=True)
    assert (low.age_ms, tracked.age_ms) == (1.25, 0.0)
    assert low.now_percent > 0.1 > 10.0 * tracked.now_percent
    assert low.aligned_percent < 0.01
    text = lines([low, tracked])
    assert text[1].split()[0] == "800"
    assert text[2].split()[0] == "+400"


def test_encoders_latched_beside_the_stamp_are_where_the_joint_is_then() -> None:
    run = of(5.0 * np.sin(20.0 * TIME))
    columns, beside, ratio = run.columns, np.full(len(TIME), 2e-4), run.joint.gear_ratio
    moved = latched_beside(columns, TIME, beside, ratio)
    assert columns.motor_position_rad is not None
    assert columns.link_position_rad is not None
    motor, link = moved.motor_position_rad, moved.link_position_rad
    assert motor is not None
    assert link is not None
    assert motor - columns.motor_position_rad == pytest.approx(np.full(len(TIME), 2e-4 * ratio * SPEED))
    twist = (motor / ratio - link)[100:]
    assert twist == pytest.approx(5.0 * np.sin(20.0 * (TIME[100:] + 2e-4)) / 12000.0, abs=1e-7)
