"""Exported models: MuJoCo reads them, and running free in MuJoCo a better joint file has the smaller error."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as ET

import mujoco
import numpy as np
import pytest

from jtqd.daemon.jtq import main as jtq
from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import Effect, Friction, MotionLimits
from jtqd.estimator.run import JointColumns, RunTable
from jtqd.models.files import load_joint, shipped
from jtqd.sysid.fit.joint_writer import write_joint
from jtqd.sysid.score.command import FREE, errors_on
from jtqd.sysid.simulators import mjcf, model_of, urdf
from tests.sysid.score.test_score import TRUE, WRONG, swing
from tests.sysid.simulators.mujoco_rig import free_run_error


def test_the_values_of_the_file_are_in_the_model() -> None:
    effects = (
        Effect("rotor_inertia", {"rotor_inertia_kgm2": 4e-5}),
        Effect("torque_constant", {"torque_constant_nm_per_a": 0.05}),
        Effect("coulomb_friction", {"coulomb_nm": 1.7}),
        Effect("torque_ripple", {"amplitude_nm": 0.4, "order_per_motor_rev": 2.0, "phase_rad": 0.1}),
    )
    joint = replace(TRUE, effects=effects, motion_limits=MotionLimits((-1.0, 2.0), velocity_rad_s=3.0))
    model = mujoco.MjModel.from_xml_string(mjcf(model_of(joint), flexible=True))
    assert model.dof_armature[0] == pytest.approx(50.0**2 * 4e-5)
    assert model.dof_frictionloss[0] == pytest.approx(1.7)
    assert model.dof_damping.tolist() == pytest.approx([0.8, 5.0])
    assert model.actuator_gear[0, 0] == pytest.approx(50.0 * 0.05)
    assert model.jnt_stiffness[1] == pytest.approx(9000.0)
    assert model.jnt_range[0].tolist() == pytest.approx([-1.0, 2.0])
    [left] = model_of(joint).left_out
    assert left.startswith("torque_ripple (of the transmission): amplitude_nm 0.4")
    assert left in mjcf(model_of(joint))


def test_urdf_has_dynamics_that_mujoco_reads() -> None:
    joint = replace(TRUE, motion_limits=MotionLimits((-1.0, 2.0), velocity_rad_s=3.0))
    text = urdf(model_of(joint))
    model = mujoco.MjModel.from_xml_string(text)
    assert model.dof_frictionloss[0] == pytest.approx(1.2)
    assert model.dof_damping[0] == pytest.approx(0.8)
    assert model.jnt_range[0].tolist() == pytest.approx([-1.0, 2.0])
    root = ET.fromstring(text)
    assert root.findtext(".//mechanicalReduction") == "50"
    limit = root.find(".//limit")
    assert limit is not None
    assert limit.attrib == {"effort": "20", "velocity": "3", "lower": "-1", "upper": "2"}


@pytest.mark.parametrize("known", [(), ("link_inertia_kgm2",)])
def test_a_joint_with_one_encoder_has_no_stiffness(tmp_path: Path, known: tuple[str, ...]) -> None:
    """Such a joint file leaves stiffness and damping out, and the inertia where the load has all of it."""
    write_joint(tmp_path / "whole.yaml", TRUE, "t")
    elastic = ("stiffness_nm_per_rad", "damping_nms_per_rad", "link_inertia_kgm2")
    lines = (tmp_path / "whole.yaml").read_text().splitlines()
    kept = [line for line in lines if not line.startswith(tuple(key for key in elastic if key not in known))]
    (tmp_path / "joint.yaml").write_text("\n".join(kept) + "\n")
    joint = load_joint(tmp_path / "joint.yaml", elastic=False)
    for text in (mjcf(model_of(joint)), urdf(model_of(joint))):
        model = mujoco.MjModel.from_xml_string(text)
        assert model.dof_frictionloss[0] == pytest.approx(1.2)
    assert jtq(["export-model", str(tmp_path / "joint.yaml"), "--out", str(tmp_path / "joint.xml")]) == 0
    assert jtq(["export-model", str(tmp_path / "joint.yaml"), "--flexible"]) == 1


LINK_KGM2 = 0.02


def wound_up(table: RunTable) -> RunTable:
    """The same motion of the load with the spring of TRUE and a link between: the motor turns on by the wind-up."""
    t, (k, g) = table.time_s, (TRUE.stiffness_nm_per_rad, TRUE.gear_ratio)
    columns = table.joints[1]
    assert columns.torque_nm is not None
    assert columns.motor_position_rad is not None
    link = columns.motor_position_rad / g
    gear = columns.torque_nm + LINK_KGM2 * second(link, t)
    angle = link + gear / k
    speed = np.gradient(angle, t)
    friction = TRUE.friction.coulomb_nm * np.sign(speed) + TRUE.friction.viscous_nms_per_rad * speed
    motor = gear + friction + g * g * TRUE.rotor_inertia_kgm2 * second(angle, t)
    current = motor / g / TRUE.torque_constant_nm_per_a
    return RunTable(
        t, {1: JointColumns(current_a=current, motor_position_rad=g * angle, torque_nm=columns.torque_nm)}
    )


def second(x: FloatArray, t: FloatArray) -> FloatArray:
    return np.gradient(np.gradient(x, t), t)


@pytest.mark.parametrize("flexible", [False, True])
def test_round_trip_the_gain_is_there_in_mujoco_too(flexible: bool) -> None:
    """Motor, load and motion are known in closed form (`swing`); MuJoCo integrates the exported joint by itself."""
    table, joints = swing(0.3), (WRONG, TRUE)
    if flexible:
        table = wound_up(table)
        joints = tuple(replace(j, damping_nms_per_rad=0.0, link_inertia_kgm2=LINK_KGM2) for j in joints)
    before, after = (
        free_run_error(mjcf(model_of(joint), flexible=flexible), table, 1, TRUE.gear_ratio)
        for joint in joints
    )
    assert after < 0.25 * before
    ours = errors_on("r", table, 1, joints[0]).errors[FREE]
    assert before == pytest.approx(ours, rel=0.15)  # two simulators, one model


def test_values_that_a_format_cannot_express_are_listed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_joint(tmp_path / "plain.yaml", TRUE, "plain")
    assert jtq(["export-model", str(tmp_path / "plain.yaml"), "--out", str(tmp_path / "joint.xml")]) == 0
    assert capsys.readouterr() == ("", "")
    assert mujoco.MjModel.from_xml_path(str(tmp_path / "joint.xml")).njnt == 1
    assert jtq(["export-model", str(shipped("joint1.yaml"))]) == 3
    printed = capsys.readouterr()
    assert "not in the model: efficiency: losses that depend on the load" in printed.err
    assert mujoco.MjModel.from_xml_string(printed.out).njnt == 1
    stribeck = replace(TRUE, friction=Friction(1.2, 0.8, 0.6, 0.1))
    assert model_of(stribeck).left_out == ("friction.stribeck_nm 0.6 below 0.1 rad/s",)
    assert jtq(["export-model", str(tmp_path / "plain.yaml"), "--format", "urdf", "--flexible"]) == 2
    assert jtq(["export-model", str(tmp_path / "none.yaml")]) == 1
    assert jtq(["export-model", str(tmp_path / "plain.yaml"), "--out", str(tmp_path / "no" / "x.xml")]) == 1
    assert all(line.startswith("jtq export-model: ") for line in capsys.readouterr().err.splitlines())


def test_losses_of_an_efficiency_are_their_line_at_no_load() -> None:
    model = model_of(load_joint(shipped("joint1.yaml")))
    assert model.frictionloss_nm > 0.0
    assert model.damping_nms_per_rad > 0.0
