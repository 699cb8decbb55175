"""Two encoders whose balances are judged below 20 Hz, a third of what the link swings at: quicker waves are not lost."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
import pytest

from jtqd.estimator.effects import EFFECTS
from jtqd.estimator.run import JointColumns, RunTable
from jtqd.sysid.diagnosis.dataset import usable_signals
from jtqd.sysid.diagnosis.diagnose import diagnose
from jtqd.sysid.diagnosis.findings import NO_GAP, UNEXPLAINED, Findings
from jtqd.sysid.diagnosis.regressors import contribution
from tests.estimator.effects.effect_signals import PLAIN
from tests.sysid.diagnosis.diagnose_core_helpers import rich_run
from tests.sysid.diagnosis.pendulums import SPRUNG, motion

SWINGING: Final = replace(PLAIN, link_inertia_kgm2=PLAIN.stiffness_nm_per_rad / (2.0 * np.pi * 60.0) ** 2)


def found_with(
    *, vibration_nm: float = 0.0, hz: float = 0.0, ripple_nm: float = 0.0, order: float = 0.0
) -> Findings:
    runs = []
    for k in range(4):
        table = rich_run(SWINGING, 60 + k, noise=2e-3)
        c = table.joints[1]
        assert c.torque_nm is not None
        assert c.current_a is not None
        assert c.motor_position_rad is not None
        torque = c.torque_nm + vibration_nm * np.sin(2.0 * np.pi * hz * table.time_s)
        lost = ripple_nm * np.cos(order * c.motor_position_rad)
        current = c.current_a + lost / (SWINGING.gear_ratio * SWINGING.torque_constant_nm_per_a)
        runs.append((f"run{k}", RunTable(table.time_s, {1: replace(c, torque_nm=torque, current_a=current)})))
    return diagnose(runs, {1: SWINGING})


def test_a_sensor_that_vibrates_above_the_band_is_unexplained() -> None:
    found = found_with(vibration_nm=1.0, hz=35.0)
    assert found.verdict == UNEXPLAINED
    assert found.unexplained is not None
    bent = 1.0 + (35.0 / 60.0) ** 2  # the spring would move the link by as much
    assert found.unexplained.rms_nm == pytest.approx(bent / np.sqrt(2.0), rel=0.15)
    lines = [p for gap in found.gaps for p in gap.localisation if p.unit == "Hz"]
    assert lines
    assert lines[0].low == pytest.approx(35.0, abs=0.2)
    assert found_with().verdict == NO_GAP


def test_a_ripple_is_worth_what_it_is_and_not_what_of_it_is_judged() -> None:
    (cause,) = found_with(ripple_nm=0.6, order=4.0).causes
    assert (cause.name, cause.matters) == ("torque_ripple", True)
    assert cause.rms_nm == pytest.approx(0.6 / np.sqrt(2.0), rel=0.2)


def test_both_balances_close_where_teeth_swing_the_motor_quicker_than_the_link_follows() -> None:
    """The link moves as it does: the motor turns for the wave of the teeth, and its acceleration is not the link's."""
    joint = replace(SPRUNG, link_inertia_kgm2=0.08)
    wave = {"amplitude_rad": 2e-4, "order_per_motor_rev": 2.0, "phase_rad": 0.4}
    rng, t = np.random.default_rng(3), np.arange(0.0, 12.0, 1e-3)
    q, _, a = motion(rng, t)
    tau = 1.8 * a + 10.0 * np.sin(q)
    gear = tau + joint.link_inertia_kgm2 * a
    stiffness, damping, ratio = joint.stiffness_nm_per_rad, joint.damping_nms_per_rad, joint.gear_ratio
    twist = (gear - damping * np.gradient(gear, t) / stiffness) / stiffness
    shaft = q + twist
    for _ in range(6):
        angle = 2.0 * ratio * shaft + wave["phase_rad"]
        shaft = q + twist + wave["amplitude_rad"] * np.sin(angle)
    speed = np.gradient(shaft, t)
    loss = joint.friction.coulomb_nm * np.sign(speed) + joint.friction.viscous_nms_per_rad * speed
    motor = ratio**2 * joint.rotor_inertia_kgm2 * np.gradient(speed, t) + loss
    motor += gear * (1.0 - 2.0 * ratio * wave["amplitude_rad"] * np.cos(angle))
    columns = JointColumns(
        current_a=motor / (ratio * joint.torque_constant_nm_per_a),
        motor_position_rad=ratio * shaft,
        link_position_rad=q,
        torque_nm=tau + 0.02 * rng.normal(size=len(t)),
    )
    [[s]], _ = usable_signals([("run", RunTable(t, {1: columns}))], {1: joint}, (1,))
    made = contribution(EFFECTS["kinematic_error"], {**wave, "phase_rad": wave["phase_rad"] + np.pi}, s)
    for balance, residual in (("motor", s.motor_nm), ("torsion", s.torsion_nm)):
        left = s.visible(residual - made[balance])[s.usable(balance)]
        assert float(np.std(left)) < 1e-3 * joint.rated_torque_nm, balance
    slow = replace(columns, motor_position_rad=ratio * (q + twist), current_a=0.0 * t)
    [[s]], _ = usable_signals([("run", RunTable(t, {1: slow}))], {1: joint}, (1,))
    assert not s.visible.parts, "nothing is quick, and nothing is filtered"
