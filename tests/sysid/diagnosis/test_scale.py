"""A joint of a hundredth of the torque, or of twenty times it, is diagnosed as this one is: no constant is in Nm."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import pytest

from jtqd.estimator.joint import Joint
from jtqd.estimator.run import JointColumns, RunTable
from jtqd.models.files import load_joint, shipped
from jtqd.sysid.diagnosis.diagnose import diagnose
from jtqd.sysid.diagnosis.findings import Findings
from tests.sysid.diagnosis.diagnose_core_helpers import rich_run

NOMINAL = load_joint(shipped("joint1.yaml"))
FILE = replace(NOMINAL, efficiency=None, friction=replace(NOMINAL.friction, stribeck_nm=0.0))
TRUE = replace(FILE, friction=replace(FILE.friction, coulomb_nm=FILE.friction.coulomb_nm + 1.2))


def scaled(joint: Joint, scale: float) -> Joint:
    """The joint with all its torques times `scale`; speeds, currents and angles stay."""
    friction = joint.friction
    return replace(
        joint,
        torque_constant_nm_per_a=scale * joint.torque_constant_nm_per_a,
        rotor_inertia_kgm2=scale * joint.rotor_inertia_kgm2,
        link_inertia_kgm2=scale * joint.link_inertia_kgm2,
        stiffness_nm_per_rad=scale * joint.stiffness_nm_per_rad,
        damping_nms_per_rad=scale * joint.damping_nms_per_rad,
        rated_torque_nm=scale * joint.rated_torque_nm,
        friction=replace(
            friction,
            coulomb_nm=scale * friction.coulomb_nm,
            viscous_nms_per_rad=scale * friction.viscous_nms_per_rad,
            stribeck_nm=scale * friction.stribeck_nm,
        ),
    )


def times(table: RunTable, scale: float) -> RunTable:
    columns: JointColumns = table.joints[1]
    assert columns.torque_nm is not None
    return RunTable(table.time_s, {1: replace(columns, torque_nm=scale * columns.torque_nm)})


@cache
def found(scale: float) -> Findings:
    runs = [
        (f"run{k}", times(rich_run(TRUE, 40 + k, noise=2e-3, zero=0.03 + 2e-3 * (k - 1.5)), scale))
        for k in range(4)
    ]
    return diagnose(runs, {1: scaled(FILE, scale)})


@pytest.mark.parametrize("scale", [0.01, pytest.param(20.0, marks=pytest.mark.campaign)])
def test_the_same_causes_with_scaled_values(scale: float) -> None:
    one, other = found(1.0), found(scale)
    assert one.verdict == other.verdict
    assert [(c.name, c.joint) for c in other.causes] == [(c.name, c.joint) for c in one.causes]
    offset = {"sensor_offset", "current_offset", "friction_asymmetry"}
    assert {"coulomb_friction"} < {c.name for c in one.causes} <= {"coulomb_friction", *offset}, (
        "the offset must exceed the zeros of single runs, the friction that of single days"
    )
    for cause, same in zip(one.causes, other.causes, strict=True):
        assert set(same.names) == set(cause.names), "members of a class that fit alike may change places"
        assert same.delta_evidence == pytest.approx(cause.delta_evidence, rel=1e-2, abs=0.01)
        assert same.rms_nm == pytest.approx(scale * cause.rms_nm, rel=1e-3)
        for name, here in cause.parameters.items():
            factor = scale if name.endswith("_nm") else 1.0
            assert same.parameters[name].value == pytest.approx(factor * here.value, rel=1e-3)
            assert same.parameters[name].ci95 == pytest.approx([factor * end for end in here.ci95], rel=1e-2)
    (coulomb,) = (c for c in one.causes if c.name == "coulomb_friction")
    assert coulomb.parameters["coulomb_nm"].value == pytest.approx(TRUE.friction.coulomb_nm, rel=0.02)
    assert other.gaps[0].noise_floor_nm == pytest.approx(scale * one.gaps[0].noise_floor_nm, rel=1e-2)
    assert one.unexplained is not None
    assert other.unexplained is not None
    assert other.unexplained.relevant_nm == pytest.approx(scale * one.unexplained.relevant_nm)
