"""Two runs of one encoder: what is best is taken from the table, and nobody is judged on what fitted him."""

import math
from dataclasses import replace

import numpy as np
import pytest

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import Friction, Joint
from jtqd.estimator.losses import FrictionModel
from jtqd.estimator.run import JointColumns
from jtqd.models.files import shipped
from jtqd.sysid.fit.plateaus import FitError
from validation.__main__ import main
from validation.goals.identify import plant_file
from validation.goals.two_runs import (
    SIMPLE,
    Row,
    fit_friction,
    kinova_cases,
    plant_cases,
    row_table,
    rows_of,
    summary_table,
)
from validation.measured import JOINTS

REGRESSIONS = {"current": 0.9, "tob_load": 0.7, "tob_fitted": 1.5, "ladder": 2.0}


def row(ours: float, inside: float, tob: float | None = 1.0) -> Row:
    rmse = {"ours": ours, "file": 3.0, **REGRESSIONS} | ({} if tob is None else {"tob": tob})
    return Row("w", "4", "a", "b", 50.0, rmse, {"ours": inside, "file": 99.0}, {"file": math.nan})


def test_ours_is_compared_with_the_best_of_the_regressions() -> None:
    assert set(REGRESSIONS) == set(SIMPLE)
    table = row_table([row(0.7, 90.0), row(0.71, 84.0, tob=None)])
    assert table.rows[0] == (
        *("4, a", "0.700", "1.000", "3.000", "0.900", "**0.700**", "1.500", "2.000"),
        *("90 %, -, 99 %", "-, -, -"),
    )
    assert [each.reached for each in (row(0.7, 90.0), row(0.71, 84.0))] == [True, False]
    assert [each.honest for each in (row(0.7, 90.0), row(0.71, 84.0))] == [True, False]


def test_a_summary_is_in_parts_of_the_rated_torque() -> None:
    ((*cells,),) = summary_table([row(0.7, 90.0), row(0.9, 80.0, tob=None)]).rows
    assert cells[:6] == ["w, 2", "1.6, 2", "1.4, 1", "2.0, 2", "6.0, 6", "1.8, 2"]
    assert cells[-3:] == ["50 %", "85 %", "50 %"]


def test_of_the_shipped_runs(capsys: pytest.CaptureFixture[str]) -> None:
    """Every joint both ways; regressions fall for an offset where joint 2 turns the other way, ours does not."""
    rows = [each for case in kinova_cases(JOINTS) for each in rows_of(case)]
    found = {(each.name, each.judged): each for each in rows}
    assert len(found) == 4
    for each in found.values():
        assert each.fitted != each.judged
    other_way = found["2", "RunTrajectory1"].rmse_nm
    assert min(other_way[name] for name in SIMPLE) > 9.0
    assert other_way["ours"] < other_way["file"]
    assert main(["two_runs", "--world", "kinova", "--joints", "4"]) == 0
    assert "of 2; interval 85 to 95 % in" in capsys.readouterr().out


def test_an_emulated_joint_is_known_by_two_windows() -> None:
    plant = plant_file("typical", shipped("plants/typical.yaml"))
    (case, *_) = plant_cases(plant, [7])
    for run in case.runs:
        assert 2.0 <= run.time_s[-1] + 0.001 <= 5.0
        assert run.columns.motor_position_rad is not None
        np.testing.assert_array_equal(
            run.columns.link_position_rad, run.columns.motor_position_rad / case.joint.gear_ratio
        )
    one, two = rows_of(case)
    assert (one.judged, one.fitted) == (two.fitted, two.judged)
    assert max(one.rmse_nm["ours"], two.rmse_nm["ours"]) < 0.15 * case.joint.rated_torque_nm


# Friction of one run.

JOINT = Joint(
    name="test",
    gear_ratio=100.0,
    torque_constant_nm_per_a=0.09,
    rotor_inertia_kgm2=4e-5,
    stiffness_nm_per_rad=1e4,
    damping_nms_per_rad=10.0,
    link_inertia_kgm2=1.0,
    rated_torque_nm=32.0,
    friction=Friction(1.0, 1.0),
)
TIME_S = 1e-3 * np.arange(8000)
SWING, LOAD = np.sin(2.0 * TIME_S) + 0.4 * np.sin(5.0 * TIME_S), 20.0 * np.cos(3.3 * TIME_S)


def moved(truth: Friction, speed: FloatArray = SWING, load: FloatArray = LOAD) -> JointColumns:
    """A joint with this friction at `speed` [rad/s] against `load` [Nm]: the current it needs."""
    omega = 100.0 * speed
    motor = (load + FrictionModel(truth).torque_many(speed)) / 100.0
    current = (motor + 4e-5 * np.gradient(omega, 1e-3)) / 0.09
    return JointColumns(current, None, omega, None, None, load, None)


@pytest.mark.parametrize(("coulomb", "viscous"), [(5.0, 3.0), (0.5, 9.0), (8.0, 0.2), (0.05, 0.05)])
def test_friction_is_recovered_with_inertia_and_load_present(coulomb: float, viscous: float) -> None:
    found = fit_friction(TIME_S, moved(Friction(coulomb, viscous)), JOINT)
    assert found.coulomb_nm == pytest.approx(coulomb, abs=0.03)
    assert found.viscous_nms_per_rad == pytest.approx(viscous, abs=0.03)


def test_what_a_run_cannot_give_keeps_the_files_value() -> None:
    """A friction that would drive the joint, one constant speed, rows at standstill."""
    run = moved(Friction(6.0, 0.0))
    assert fit_friction(TIME_S, replace(run, torque_nm=LOAD + 2.0 * SWING), JOINT).viscous_nms_per_rad == 1.0
    steady = moved(Friction(5.0, 3.0), np.ones(8000))
    noisy = replace(steady, torque_nm=LOAD + 0.1 * np.sin(40.0 * TIME_S))
    found = fit_friction(TIME_S, noisy, JOINT)
    assert found.viscous_nms_per_rad == 1.0
    assert found.coulomb_nm == pytest.approx(5.0 + 3.0 - 1.0, abs=0.05)
    speed = np.where(TIME_S < 5.0, SWING, 0.0)
    stuck = replace(moved(Friction(5.0, 3.0), speed), torque_nm=np.where(TIME_S < 5.3, LOAD, 4.0))
    assert fit_friction(TIME_S, stuck, JOINT).coulomb_nm == pytest.approx(5.0, abs=0.05)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"torque_nm": None}, "torque_nm"),
        ({"motor_velocity_rad_s": np.zeros(8000)}, "rows in motion"),
        ({"torque_nm": LOAD + np.linspace(-50.0, 50.0, 8000)}, "independent rows"),
    ],
)
def test_runs_that_cannot_serve_are_refused(change: dict[str, FloatArray | None], text: str) -> None:
    with pytest.raises(FitError, match=text):
        fit_friction(TIME_S, replace(moved(Friction(5.0, 3.0)), **change), JOINT)
