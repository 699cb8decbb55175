"""`jtq score`: errors that are known in closed form, both files side by side, and what it refuses."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from jtqd.daemon.jtq import main as jtq
from jtqd.estimator.joint import Effect, Friction, Joint
from jtqd.estimator.run import JointColumns, RunTable
from jtqd.sysid.fit.joint_writer import write_joint
from jtqd.sysid.runs.tables import write_run
from jtqd.sysid.score.command import FREE, MOTOR, errors_on, rows_of, visible_on
from tests.estimator.fused_helpers import fused_joint

TRUE = Joint(
    name="rig_joint1",
    gear_ratio=50.0,
    torque_constant_nm_per_a=0.06,
    rotor_inertia_kgm2=3e-5,
    stiffness_nm_per_rad=9000.0,
    damping_nms_per_rad=5.0,
    link_inertia_kgm2=0.0,
    rated_torque_nm=20.0,
    friction=Friction(1.2, 0.8),
)
WRONG = replace(TRUE, friction=Friction(0.7, 0.8))


def swing(phase: float, seconds: float = 6.0, rate_hz: float = 1000.0) -> RunTable:
    """A joint that swings a load against its friction, without noise: the motor balance of TRUE is zero in motion."""
    t = np.arange(0.0, seconds, 1.0 / rate_hz)
    v = 0.9 * np.cos(2.0 * t + phase) + 0.4 * np.cos(5.0 * t)
    q = 0.45 * np.sin(2.0 * t + phase) + 0.08 * np.sin(5.0 * t)
    a = -1.8 * np.sin(2.0 * t + phase) - 2.0 * np.sin(5.0 * t)
    load = 8.0 * np.sin(q) + 0.3 * a + 2.0 * np.sin(3.0 * t)
    motor = load + 1.2 * np.sign(v) + 0.8 * v + 50.0**2 * 3e-5 * a
    return RunTable(
        t, {1: JointColumns(current_a=motor / 50.0 / 0.06, motor_position_rad=50.0 * q, torque_nm=load)}
    )


def test_a_true_file_has_no_error_and_a_wrong_one_what_is_wrong():
    table = swing(0.3)
    right, wrong = (errors_on("r", table, 1, joint) for joint in (TRUE, WRONG))
    assert right.errors[MOTOR] < 0.01
    assert wrong.errors[MOTOR] == pytest.approx(
        0.5, rel=0.01
    )  # Coulomb friction wrong by 0.5 Nm, in every sample
    assert right.errors[FREE] < 0.1 * wrong.errors[FREE]
    assert right.errors["estimator tob"] < 0.6 * wrong.errors["estimator tob"]
    assert "estimator efficiency" not in right.errors
    assert "simulation, torsion balance" not in right.errors  # one encoder


def test_what_rounding_makes_of_the_acceleration_is_no_error():
    """Positions of the motor in steps of 50 mrad at 100 Hz: a second difference of them is newton metres of noise."""
    table = swing(0.3, 12.0, 100.0)
    columns = table.joints[1]
    assert columns.motor_position_rad is not None
    coarse = replace(columns, motor_position_rad=np.round(columns.motor_position_rad / 0.05) * 0.05)
    table = RunTable(table.time_s, {1: coarse})
    wrong = errors_on("r", table, 1, WRONG).errors[MOTOR]
    assert wrong == pytest.approx(0.5, rel=0.02)
    heavier = replace(TRUE, rotor_inertia_kgm2=6e-5)
    visible = visible_on("r", table, 1, WRONG)
    assert visible.highest_hz != visible_on("r", table, 1, heavier).highest_hz
    assert errors_on("r", table, 1, WRONG, visible).errors[MOTOR] == wrong
    own, shared = (errors_on("r", table, 1, heavier, each).errors[MOTOR] for each in (None, visible))
    assert own != shared, "two files are judged by the same part of a run"


def test_with_one_encoder_there_is_no_torsion_to_estimate_from(tmp_path, capsys):
    """Derived from the motor's, a link position makes a torsion of zero: method fused would be wrong by the whole torque."""
    path, run = tmp_path / "rig_joint1.yaml", tmp_path / "r.csv"
    write_joint(path, replace(TRUE, fused=fused_joint().fused), "test")
    write_run(run, swing(0.3))
    assert jtq(["score", str(path), str(run)]) == 0
    output = capsys.readouterr()
    assert "estimator tob" in output.out
    assert "fused" not in output.out
    assert (
        "r.csv: j1: found one encoder: method fused, which estimates from the torsion, is not scored"
        in output.err
    )
    rigid = replace(TRUE, fused=fused_joint(torsion=None).fused)
    assert "estimator fused, without network" in errors_on("r", swing(0.3), 1, rigid).errors


def test_an_effect_of_the_file_is_part_of_its_simulation():
    mended = replace(WRONG, effects=(Effect("coulomb_friction", {"coulomb_nm": 1.2}),))
    assert errors_on("r", swing(0.3), 1, mended).errors[MOTOR] < 0.01


def test_an_effect_that_no_value_stands_for_is_simulated_too():
    """A ripple that the joint does not have is an error of its own size."""
    ripple = Effect("torque_ripple", {"amplitude_nm": 0.5, "order_per_motor_rev": 1.0, "phase_rad": 0.0})
    found = errors_on("r", swing(0.3), 1, replace(TRUE, effects=(ripple,)))
    assert found.errors[MOTOR] == pytest.approx(0.5 / math.sqrt(2.0), rel=0.15)


def test_all_runs_together_are_weighted_by_their_time_in_motion_whatever_their_rates():
    short, whole = swing(0.3, 3.0), swing(1.1, 9.0)
    half = {n: c.map(lambda _, x: x[::2]) for n, c in whole.joints.items()}
    long = RunTable(whole.time_s[::2], half)
    scored = [[errors_on(name, table, 1, WRONG) for name, table in (("a", short), ("b", long))]]
    rows = [row for row in rows_of(scored) if row.what == MOTOR]
    assert [row.run for row in rows] == ["all", "a", "b"]
    squares = [scored[0][k].moving_s * rows[1 + k].errors[0] ** 2 for k in (0, 1)]
    expected = math.sqrt(sum(squares) / sum(run.moving_s for run in scored[0]))
    assert scored[0][1].moving_s == pytest.approx(3.0 * scored[0][0].moving_s, rel=0.1)
    assert rows[0].errors[0] == pytest.approx(expected)
    assert math.isnan(rows[0].change)


@pytest.fixture
def files(tmp_path):
    write_joint(tmp_path / "wrong.yaml", WRONG, "wrong")
    write_joint(tmp_path / "true.yaml", TRUE, "true")
    for k in range(2):
        write_run(tmp_path / f"r{k}.csv", swing(0.3 + k))
    return tmp_path


def test_both_files_stand_in_one_table(files, capsys):
    arguments = ["score", str(files / "wrong.yaml"), str(files / "r0.csv"), str(files / "r1.csv")]
    assert jtq([*arguments, "--after", str(files / "true.yaml")]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[:2] == [f"before: {files / 'wrong.yaml'}", f"after: {files / 'true.yaml'}"]
    assert lines[3].split() == ["error,", "rms", "run", "before", "after", "unit", "change"]
    motor = next(line.split() for line in lines if line.startswith("simulation, motor balance"))
    assert float(motor[4]) == pytest.approx(0.5, rel=0.01)
    assert float(motor[5]) < 0.01
    assert jtq([*arguments, "--json"]) == 0
    made = json.loads(capsys.readouterr().out)
    assert made["schema"] == "jtq.score/1"
    assert {row["run"] for row in made["rows"]} == {"all", "r0.csv", "r1.csv"}
    assert all(row["change"] is None and len(row["rmse"]) == 1 for row in made["rows"])


def test_a_run_that_cannot_be_used_is_reported(files, capsys):
    table = swing(0.2)
    columns = replace(table.joints[1], torque_nm=None)
    write_run(files / "blind.csv", RunTable(table.time_s, {1: columns}))
    assert jtq(["score", str(files / "true.yaml"), str(files / "r0.csv"), str(files / "blind.csv")]) == 3
    output = capsys.readouterr()
    assert "blind.csv: j1.torque_nm: found no valid torque sensor channel" in output.err
    assert "r0.csv" in output.out
    assert jtq(["score", str(files / "true.yaml"), str(files / "blind.csv")]) == 1
    assert "found no run in which joint 1 can be scored" in capsys.readouterr().err


def test_files_of_two_joints_are_refused(files, capsys):
    write_joint(files / "other.yaml", replace(TRUE, gear_ratio=100.0), "other")
    status = jtq(
        ["score", str(files / "true.yaml"), str(files / "r0.csv"), "--after", str(files / "other.yaml")]
    )
    assert status == 1
    assert "found gear_ratio 100, expected 50" in capsys.readouterr().err
    assert jtq(["score", str(files / "none.yaml"), str(files / "r0.csv")]) == 1
    assert len(capsys.readouterr().err.splitlines()) == 1
