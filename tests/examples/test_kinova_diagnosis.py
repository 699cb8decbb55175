"""The diagnosis of the measured arm: seven joint files, one encoder counted once, a dead sensor said, table, figures."""

from pathlib import Path

import numpy as np
import pytest

from examples.kinova_diagnosis import (
    Diagnosed,
    as_mapping,
    diagnose_all,
    draw_residuals,
    ladder_lines,
    measured_runs,
    only,
    table_lines,
)
from jtqd.models.files import load_joint, shipped
from jtqd.sysid.diagnosis.findings import (
    CAUSE,
    INSUFFICIENT,
    UNEXPLAINED,
    Cause,
    Findings,
    Gain,
    Gap,
    Trace,
    Value,
)


@pytest.mark.parametrize("number", range(1, 8))
def test_joint_files_hold_the_recorders_constants_and_name_their_origins(number: int) -> None:
    joint = load_joint(shipped(f"kinova_gen3/joint{number}.yaml"))
    # models/kinova_gen3/README.md: 9.13 Nm/A for the large joints 1 to 4, 5.852 Nm/A for the small ones
    nm_per_a = joint.gear_ratio * joint.torque_constant_nm_per_a
    assert nm_per_a == pytest.approx(9.13 if number <= 4 else 5.852)
    assert joint.rated_torque_nm == (32.0 if number <= 4 else 13.0)
    keys = "torque_constant_nm_per_a rotor_inertia_kgm2 friction link_inertia_kgm2 rated_torque_nm"
    assert all(len(str(joint.provenance[key])) > 20 for key in keys.split())
    assert 29.0 < float(joint.provenance["temperature_c"]) < 42.0


def test_the_shipped_runs_hold_what_seven_joints_need_and_one_encoder_counts_once() -> None:
    for run in measured_runs():
        assert sorted(run.table.joints) == list(range(1, 8))
        for number, columns in run.table.joints.items():
            assert columns.motor_position_rad is None
            for name in ("current_a", "motor_velocity_rad_s", "link_position_rad", "temperature_c"):
                assert getattr(columns, name) is not None
            dead = run.name == "RunTrajectory1" and number == 1
            assert (columns.torque_nm is None) == dead
        alone = only(run, 2)
        assert list(alone.table.joints) == [2]
        assert not any(note.startswith("j1.") for note in alone.notes)


def test_a_joint_with_a_dead_sensor_is_refused_with_the_reason() -> None:
    one = diagnose_all([1])[0]
    assert one.findings.verdict == INSUFFICIENT
    assert any("j1.torque_nm" in reason for reason in one.findings.reasons)
    line = table_lines([one])[2]
    assert line.startswith("| 1 | insufficient_data | - | ")
    assert "j1.torque_nm" in line


def made_up() -> Diagnosed:
    time = np.linspace(0.0, 1.0, 50)
    wave = np.sin(6.0 * time)
    traces = tuple(Trace(run, 2, "motor", time, wave, 0.3 * wave, wave, 11.0 * wave) for run in ("a", "b"))
    names = ("load_dependent_friction", "torque_constant")
    values = {"load_coefficient": Value(0.07, (0.05, 0.09), "")}
    cause = Cause(names[0], 2, values, 40.0, 1.5, "motor", rivals=names[1:])
    gap = Gap(2, "motor", 1.6, 0.4, ())
    gain = Gain(1.6, 1.1, "each of 2 runs held out once", (0.3, 0.7))
    findings = Findings(CAUSE, (), ("a", "b"), (2,), (gap,), (cause,), gain=gain, traces=traces)
    return Diagnosed(2, load_joint(shipped("kinova_gen3/joint2.yaml")), findings)


def test_the_table_says_gap_class_parameters_and_gain(tmp_path: Path) -> None:
    one = made_up()
    assert table_lines([one])[2] == (
        "| 2 | cause | 1.60 (5.0% of rated), 0.40 | "
        "load_dependent_friction (or torque_constant): load_coefficient 0.07 +- 0.02 | 1.60, 1.10 |"
    )
    mapping = as_mapping([one], {"a": "00", "b": "11"})
    assert [each["joint"] for each in mapping["joints"]] == [2]
    draw_residuals([one], tmp_path / "residuals.png")
    draw_residuals([], tmp_path / "none.png")
    assert (tmp_path / "residuals.png").stat().st_size > 10_000


def test_the_ladder_stands_beside_the_file_and_the_extended_file() -> None:
    """Joint 2 without causes: the extended file is the file, and each run's ladder is that of the other run."""
    joint = load_joint(shipped("kinova_gen3/joint2.yaml"))
    nothing = Findings(UNEXPLAINED, (), ("a", "b"), (2,), (), ())
    rows = [line.strip("|").split("|") for line in ladder_lines([Diagnosed(2, joint, nothing)])[2:]]
    assert [row[1].strip() for row in rows] == ["opti_traj_testing1", "RunTrajectory1"]
    for row in rows:
        file, ladder, extended = (float(cell) for cell in row[2:5])
        assert extended == file
        assert row[5].strip() == ("yes" if file < ladder else "no")
    assert len({row[3] for row in rows}) == 2
