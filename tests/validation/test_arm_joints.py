"""Joints of the foreign arm as the product estimates them: fitted on a towing bench, judged on the arm."""

from __future__ import annotations

import numpy as np
import pytest

from validation.arm.arm import CYCLE_S, JOINTS, NO_TORQUE, Arm, Payload, Run, read
from validation.arm.joints import RealJoints, nominal, towed


def test_joints_that_were_fitted_tell_the_torque_in_the_arm() -> None:
    arm = Arm("typical", 9)
    joints = RealJoints(arm, *towed(arm, runs=6, seconds=5.0))
    pose = np.array([0.3, -0.3, 0.0, -2.2, 0.0, 2.0, 0.4])
    t = CYCLE_S * np.arange(4000)
    path = pose + 0.3 * (1.0 - np.cos(2.0 * np.pi * t[:, None] / np.linspace(2.0, 3.5, JOINTS)))
    run = Run(1, path, Payload(1.0, (0.0, 0.0, 0.05)))
    truth = arm.record([run])[0]
    readings = read(arm, run, truth, joints)
    told = np.isfinite(readings.torque_nm)
    assert told[500:].mean() > 0.95
    assert np.array_equal(readings.status == NO_TORQUE, ~told)
    off = np.where(told, (readings.torque_nm - truth.drive_nm) / arm.rated_nm, 0.0)
    assert (np.sqrt(np.mean(off[1000:] ** 2, axis=0)) < 0.04).all()
    inside = np.abs(readings.torque_nm - truth.drive_nm) < 1.645 * readings.sigma_nm
    assert inside[told].mean() > 0.5


def test_a_joint_file_has_the_size_of_its_joint() -> None:
    arm = Arm("typical", 9)
    joints = nominal(arm)
    for k in range(JOINTS):
        assert joints[k].rated_torque_nm == arm.rated_nm[k]
        rotor = joints[k].rotor_inertia_kgm2 * joints[k].gear_ratio ** 2
        assert rotor == pytest.approx(arm.nominal["rotor_kgm2"][k])
        assert joints[k].friction.coulomb_nm == pytest.approx((3.0, 3.2)[k % 2] * arm.size[k])
