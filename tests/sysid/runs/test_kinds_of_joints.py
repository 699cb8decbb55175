"""Joints unlike the bench's: what their joint files state is no fault of a channel, and real faults of theirs are found."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import pytest

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import Friction, Joint, MotionLimits
from jtqd.estimator.run import JointColumns, RunTable
from jtqd.models.files import load_joint, shipped
from jtqd.sysid.runs.checks import check_runs

pytestmark = pytest.mark.filterwarnings("error")

T: Final = np.arange(0.0, 14.0, 0.002)
BASE: Final = replace(load_joint(shipped("joint1.yaml")), efficiency=None, effects=())


@dataclass(frozen=True)
class Kind:
    """A joint, its motion (amplitude [rad] at angular frequency [rad/s]), the weight of its load [Nm], its link encoder."""

    joint: Joint
    amplitude: float = 1.0
    turn: float = 1.5
    weight_nm: float = 5.0
    second_encoder: bool = True
    velocity: bool = True
    inertia_kgm2: float = 0.02

    def run(self) -> RunTable:
        """A run by the equations; the current has noise, the sensor too."""
        rng = np.random.default_rng(4)
        j, w = self.joint, self.turn
        q = self.amplitude * np.sin(w * T)
        v, a = np.gradient(q, T), -w * w * q
        torque = self.weight_nm * np.sin(q + 0.4 * np.sin(0.31 * T)) + self.inertia_kgm2 * a
        friction = j.friction.coulomb_nm * np.sign(v) + j.friction.viscous_nms_per_rad * v
        motor = torque + friction + j.gear_ratio**2 * j.rotor_inertia_kgm2 * a
        scale = j.gear_ratio * j.torque_constant_nm_per_a
        noise = rng.normal(scale=2e-3 * j.rated_torque_nm, size=(2, len(T)))
        turned = j.gear_ratio * (q + (torque / j.stiffness_nm_per_rad if self.second_encoder else 0.0))
        return RunTable(
            T,
            {
                1: JointColumns(
                    (motor + noise[0]) / scale,
                    motor_position_rad=turned,
                    motor_velocity_rad_s=np.gradient(turned, T) if self.velocity else None,
                    link_position_rad=q if self.second_encoder else turned * (1.0 / j.gear_ratio),
                    torque_nm=torque + 0.1 * noise[1],
                )
            },
        )


def joint(*values: float) -> Joint:
    """Ratio, torque constant, rotor inertia, stiffness, rated torque, Coulomb and viscous friction."""
    ratio, kt, rotor, stiffness, rated, *friction = values
    return replace(
        BASE,
        gear_ratio=ratio,
        torque_constant_nm_per_a=kt,
        rotor_inertia_kgm2=rotor,
        stiffness_nm_per_rad=stiffness,
        rated_torque_nm=rated,
        friction=Friction(*friction),
        motion_limits=None,
    )


SERVO: Final = joint(310.0, 0.004, 2e-8, 800.0, 3.0, 0.3, 0.05)
BELT: Final = joint(48.0, 0.06, 2e-5, 900.0, 20.0, 0.5, 0.3)
LIGHT: Final = joint(100.0, 0.1, 3e-5, 9000.0, 50.0, 3.0, 2.0)
KINDS: Final[dict[str, Kind]] = {
    "the rotor of a small servo at 3900 rad/s": Kind(SERVO, 2.5, 5.0, 0.8, inertia_kgm2=2e-3),
    "the same with one encoder and no velocity": Kind(
        SERVO, 2.5, 5.0, 0.8, second_encoder=False, velocity=False, inertia_kgm2=2e-3
    ),
    "a belt that winds up": Kind(BELT, 0.7, 1.1, -14.0),
    "a small travel": Kind(joint(128.0, 0.1, 3e-5, 2500.0, 40.0, 2.0, 3.0), 0.12, 3.0, -60.0),
    "a direct drive": Kind(joint(1.0, 2.0, 0.01, 1e5, 20.0, 0.1, 0.02), 1.2, 3.0),
    "a direct drive with one encoder": Kind(
        joint(1.0, 2.0, 0.01, 1e5, 20.0, 0.1, 0.02), second_encoder=False
    ),
    "one encoder": Kind(BASE, second_encoder=False),
    "a light joint without load": Kind(LIGHT, weight_nm=0.0, inertia_kgm2=0.003),
    "a light joint without load, moved slowly": Kind(LIGHT, 0.8, 0.7, 0.0, inertia_kgm2=0.003),
    "a quick actuator with a speed limit above": Kind(
        replace(
            joint(6.0, 0.09, 6e-5, 4000.0, 20.0, 0.1, 0.02), motion_limits=MotionLimits((-3.0, 3.0), 40.0)
        ),
        2.0,
        12.0,
        2.0,
        inertia_kgm2=1e-3,
    ),
}


@pytest.mark.parametrize("kind", KINDS)
def test_a_joint_as_its_file_states_is_used_without_a_word(kind: str) -> None:
    result = check_runs([("r.csv", KINDS[kind].run())], {1: KINDS[kind].joint})
    assert (result.refused, result.notes) == ((), ())


def scaled(names: str, factor: float) -> Callable[[JointColumns], JointColumns]:
    return lambda joint: joint.map(lambda name, x: factor * x if name in names.split() else x)


ANGLES: Final = "motor_position_rad motor_velocity_rad_s link_position_rad"
DEGREES: Final = 180.0 / np.pi


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("names", "factor", "fault"),
    [
        ("motor_position_rad motor_velocity_rad_s", 1.3, "gear"),
        ("link_position_rad", DEGREES, "degrees"),
        ("torque_nm", 1000.0, "mNm"),
        ("current_a", 1000.0, "mA"),
    ],
)
def test_its_real_faults_are_found(kind: str, names: str, factor: float, fault: str) -> None:
    one = KINDS[kind]
    if one.weight_nm == 0.0 and names == "torque_nm":
        pytest.skip("a torque of another unit is as small as the right one")
    table = one.run()
    wrong = scaled(names, factor)(table.joints[1])
    refused = check_runs([("r.csv", RunTable(T, {1: wrong}))], {1: one.joint}).refused
    assert any(fault in line for line in refused), refused


@pytest.mark.parametrize("kind", [KINDS["one encoder"], KINDS["a quick actuator with a speed limit above"]])
def test_all_angles_in_degrees_are_found_by_speed_or_by_the_torque_they_would_need(kind: Kind) -> None:
    table = kind.run()
    wrong = scaled(ANGLES, DEGREES)(table.joints[1])
    [line] = check_runs([("r.csv", RunTable(T, {1: wrong}))], {1: kind.joint}).refused
    assert "degrees" in line


def test_a_load_that_is_exactly_zero_at_rest_is_not_clipped() -> None:
    """The joint stands with the load set down; the motor's torque changes at rest."""
    rest = np.sin(0.9 * T) < 0.0
    q = np.where(rest, 0.0, 0.5 * (1.0 - np.cos(2.0 * 0.9 * T)))
    v = np.gradient(q, T)
    torque: FloatArray = np.where(rest, 0.0, 12.0 * np.abs(np.sin(0.9 * T)))
    creep = np.where(rest, 4.0 * np.sin(3.0 * T), 0.0)
    noise = np.random.default_rng(2).normal(scale=0.02, size=len(T))
    scale = BASE.gear_ratio * BASE.torque_constant_nm_per_a
    current = (torque + BASE.friction.coulomb_nm * np.sign(v) + creep + noise) / scale
    table = RunTable(T, {1: JointColumns(current, motor_position_rad=BASE.gear_ratio * q, torque_nm=torque)})
    result = check_runs([("r.csv", table)], {1: BASE})
    assert not any("saturated" in line or "stuck" in line for line in (*result.refused, *result.notes))
