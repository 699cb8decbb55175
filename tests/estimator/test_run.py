"""Run tables: what is refused and how it is named, and what is derived from what."""

from __future__ import annotations

import copy
import json
import pickle
from dataclasses import replace

import numpy as np
import pytest

from jtqd.estimator.estimator import JointEstimator
from jtqd.estimator.run import EstimateRun, JointColumns, RunTable, RunTableError
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.status import NAMES, STANDSTILL, Status
from tests.estimator.estimator_helpers import joint1

T = np.cumsum(np.random.default_rng(1).uniform(0.0005, 0.002, 400))
Q = 0.3 * np.sin(4.0 * T)
FULL = JointColumns(
    current_a=np.cos(T),
    motor_position_rad=100.0 * Q,
    motor_velocity_rad_s=120.0 * np.cos(4.0 * T),
    link_position_rad=Q,
    link_velocity_rad_s=1.2 * np.cos(4.0 * T),
    torque_nm=T,
)


def test_wrong_columns_are_named() -> None:
    bad = np.sin(T)
    bad[17] = np.nan
    for joints, time_s, words in (
        ({2: replace(FULL, torque_nm=bad)}, T, "j2.torque_nm: found nan at sample 17, expected finite"),
        ({1: replace(FULL, current_a=T[:-1])}, T, "j1.current_a: found 399 samples, expected 400"),
        ({1: FULL}, T[::-1], "time_s: found .* at sample 1, expected increasing time"),
        ({1: FULL}, np.where(np.arange(400) == 9, T[8], T), "time_s: found .* at sample 9"),
        ({1: FULL}, np.where(np.arange(400) == 9, np.inf, T), "time_s: found inf at sample 9"),
        ({}, T[:1], "time_s: found 1 samples, expected at least 2"),
        ({}, T.reshape(2, -1), r"time_s: found an array of shape \(2, 200\)"),
    ):
        with pytest.raises(RunTableError, match=words):
            RunTable(time_s, joints)
    with pytest.raises(RunTableError, match="torque_nm: found an array of shape"):
        JointColumns(torque_nm=np.zeros((2, 2)))


def test_derivation_takes_the_nearest_source() -> None:
    """Velocities by central differences, one side of the gear from the other, nothing made up."""
    assert FULL.derived(T, 100.0).motor_velocity_rad_s is not None
    for name in ("motor_velocity_rad_s", "link_velocity_rad_s", "motor_position_rad", "link_position_rad"):
        derived = getattr(replace(FULL, **{name: None}).derived(T, 100.0), name)
        expected = getattr(FULL, name)[1:-1]  # one-sided, first order, at the two ends
        assert derived[1:-1] == pytest.approx(expected, abs=5e-3 if "motor" in name else 5e-5)
    motor_only = replace(FULL, link_position_rad=None, link_velocity_rad_s=None).derived(T, 100.0)
    assert motor_only.link_position_rad == pytest.approx(Q, abs=1e-12)
    assert motor_only.link_velocity_rad_s == pytest.approx(FULL.motor_velocity_rad_s / 100.0, abs=1e-12)
    link_only = replace(FULL, motor_position_rad=None, motor_velocity_rad_s=None).derived(T, 100.0)
    assert link_only.motor_velocity_rad_s == pytest.approx(FULL.motor_velocity_rad_s, abs=1e-9)
    wound = replace(FULL, motor_position_rad=100.0 * Q + 0.5 * T, motor_velocity_rad_s=None).derived(T, 100.0)
    assert wound.motor_velocity_rad_s == pytest.approx(np.gradient(100.0 * Q, T) + 0.5, abs=1e-9)
    nothing = JointColumns(current_a=T).derived(T, 100.0)
    assert nothing.motor_position_rad is None
    assert nothing.link_velocity_rad_s is None


def test_a_position_made_of_the_other_is_no_second_encoder() -> None:
    time = np.arange(200) * 1e-3
    motor = 100.0 * np.sin(time)
    made = JointColumns(motor_position_rad=motor).derived(time, 100.0)
    assert not made.two_encoders(100.0)
    assert not JointColumns(motor_position_rad=motor).two_encoders(100.0)
    assert (
        JointColumns(motor_position_rad=motor, link_position_rad=motor / 100.0 + 3.0).two_encoders(100.0)
        is False
    )
    twisted = motor / 100.0 - 1e-6 * np.cos(time)
    assert JointColumns(motor_position_rad=motor, link_position_rad=twisted).two_encoders(100.0)
    still = np.full(200, 0.5)
    assert JointColumns(motor_position_rad=still, link_position_rad=still).two_encoders(100.0), "says nothing"


def test_inputs_for_the_estimator() -> None:
    table = RunTable(T, {1: FULL})
    dt_s, *rest = table.estimator_inputs(1, 100.0)
    assert dt_s[0] == 0.0
    assert np.cumsum(dt_s) + T[0] == pytest.approx(T)
    run = JointEstimator(joint1(), EstimatorSettings(method="tob"), None).run(dt_s, *rest)
    assert run.status[0] == 1
    assert np.isfinite(run.torque_nm[1:]).all()
    with pytest.raises(RunTableError, match="j2: found no columns of this joint, the run has j1"):
        table.estimator_inputs(2, 100.0)
    with pytest.raises(RunTableError, match=r"j1\.current_a: missing"):
        RunTable(T, {1: replace(FULL, current_a=None)}).estimator_inputs(1, 100.0)


def test_tables_are_read_only_and_can_be_copied() -> None:
    table = RunTable(T, {1: FULL})
    with pytest.raises(ValueError, match="read-only"):
        table.time_s[0] = 3.0
    with pytest.raises(TypeError):
        table.joints[2] = FULL  # type: ignore[index]
    assert T.flags.writeable  # the caller's own array is left alone
    for other in (pickle.loads(pickle.dumps(table)), copy.deepcopy(table)):
        assert np.array_equal(other.joints[1].current_a, FULL.current_a)


def test_what_a_session_prints_is_one_line_without_arrays() -> None:
    time_s = 0.5 * np.arange(2000)
    columns = JointColumns(current_a=np.zeros(2000), link_position_rad=time_s)
    assert repr(columns) == "JointColumns(2000 rows: current_a, link_position_rad)"
    assert repr(JointColumns()) == "JointColumns(0 rows: )"
    assert (
        repr(RunTable(time_s, {1: columns, 4: columns})) == "RunTable(2000 rows, 0 to 999.5 s, joints 1, 4)"
    )
    status = np.repeat(np.array([6, 2], np.uint8), (3, 5))
    values = {name: np.zeros(8) for name in EstimateRun.__slots__ if name != "status"}
    assert repr(EstimateRun(status=status, **values)) == "EstimateRun(8 rows: valid 5, standstill 3)"


def test_a_status_is_its_code_and_has_its_name() -> None:
    assert [(int(each), each.name.lower()) for each in Status] == list(NAMES.items())
    assert Status(np.uint8(6)) is STANDSTILL
    assert json.dumps([Status.VALID]) == "[2]"
    assert f"{Status.INVALID}" == "15"
