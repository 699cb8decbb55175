"""Friction fit: recovers what was put in, says how well, and keeps what a run cannot support."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from jtqd.estimator.joint import Friction, Joint
from jtqd.estimator.losses import FrictionModel
from jtqd.estimator.observer import low_pass
from jtqd.estimator.run import JointColumns
from jtqd.sysid.fit.plateaus import FitError
from validation.goals.friction import fit_friction

Array = NDArray[np.float64]
DT_S = 0.001
JOINT = Joint(
    name="test",
    gear_ratio=100.0,
    torque_constant_nm_per_a=0.09,
    rotor_inertia_kgm2=4e-5,
    stiffness_nm_per_rad=1e4,
    damping_nms_per_rad=10.0,
    link_inertia_kgm2=1.0,
    rated_torque_nm=32.0,
    friction=Friction(coulomb_nm=1.0, viscous_nms_per_rad=1.0),
)


def _run(
    truth: Friction, speed: Array, load: Array, noise: Array | float = 0.0
) -> tuple[Array, JointColumns]:
    """A joint with friction `truth` moved at `speed` [rad/s] against `load` [Nm]: the current it needs."""
    time_s: Array = DT_S * np.arange(len(speed), dtype=np.float64)
    omega_m = 100.0 * speed
    motor_torque = (load + FrictionModel(truth).torque_many(speed)) / 100.0
    current = (motor_torque + 4e-5 * np.gradient(omega_m, DT_S)) / 0.09
    return time_s, JointColumns(
        current_a=current,
        motor_position_rad=None,
        motor_velocity_rad_s=omega_m,
        link_position_rad=None,
        link_velocity_rad_s=None,
        torque_nm=load + noise,
        temperature_c=None,
    )


def _back_and_forth(count: int = 8000) -> tuple[Array, Array]:
    time_s = DT_S * np.arange(count)
    return np.sin(2.0 * time_s) + 0.4 * np.sin(5.0 * time_s), 20.0 * np.cos(3.3 * time_s)


@pytest.mark.parametrize(("coulomb", "viscous"), [(5.0, 3.0), (0.5, 9.0), (8.0, 0.2), (0.0, 0.0)])
def test_truth_is_recovered_with_inertia_and_load_present(coulomb: float, viscous: float) -> None:
    truth = Friction(coulomb + 0.05, viscous + 0.05)  # off the bound at zero, where rounding decides
    fit = fit_friction(*_run(truth, *_back_and_forth()), JOINT)
    assert fit.friction.coulomb_nm == pytest.approx(truth.coulomb_nm, abs=0.03)
    assert fit.friction.viscous_nms_per_rad == pytest.approx(truth.viscous_nms_per_rad, abs=0.03)
    assert fit.rmse_after_nm < 0.05
    assert fit.rmse_after_nm <= fit.rmse_before_nm
    assert fit.warnings == ()


def test_stribeck_peak_is_recovered_only_when_asked_for() -> None:
    truth = Friction(4.0, 2.0, stribeck_nm=1.5, stribeck_velocity_rad_s=0.3)
    joint = replace(JOINT, friction=replace(JOINT.friction, stribeck_velocity_rad_s=0.3))
    run = _run(truth, *_back_and_forth())
    fit = fit_friction(*run, joint, stribeck=True)
    assert fit.friction.stribeck_nm == pytest.approx(1.5, abs=0.05)
    assert fit.friction.coulomb_nm == pytest.approx(4.0, abs=0.05)
    without = fit_friction(*run, joint)
    assert without.friction.stribeck_nm == 0.0
    assert without.rmse_after_nm > 3.0 * fit.rmse_after_nm


def test_intervals_cover_the_truth_with_coloured_noise() -> None:
    seed = 5
    print("seed", seed)
    random_ = np.random.default_rng(seed)
    truth = Friction(5.0, 3.0)
    inside = 0
    for _ in range(60):
        speed, load = _back_and_forth()
        noise = low_pass(random_.normal(0.0, 12.0, len(speed)), np.full(len(speed), DT_S), 12.0)
        fit = fit_friction(*_run(truth, speed, load, noise), JOINT)
        assert fit.effective_rows < 0.05 * fit.rows
        error = np.abs([fit.friction.coulomb_nm - 5.0, fit.friction.viscous_nms_per_rad - 3.0])
        inside += int(np.count_nonzero(error <= [term.ci95 for term in fit.terms]))
    # 95 % of 120 is 114; white-noise intervals would cover about a fifth.
    assert inside >= 102


def test_a_term_that_would_drive_the_joint_keeps_the_files_value() -> None:
    speed, load = _back_and_forth()
    time_s, run = _run(Friction(6.0, 0.0), speed, load)
    assert run.torque_nm is not None
    fit = fit_friction(
        time_s, replace(run, torque_nm=run.torque_nm + 2.0 * speed), JOINT
    )  # viscous -2 Nms/rad
    assert fit.friction.viscous_nms_per_rad == 1.0
    assert fit.terms[1].kept.startswith("best value -2")
    assert np.isnan(fit.terms[1].ci95)
    assert fit.terms[0].kept == ""
    assert any("kept: best value -2" in line for line in fit.lines())


def test_one_constant_speed_cannot_split_coulomb_from_viscous_and_says_so() -> None:
    speed = np.full(3000, 1.0)
    load = 10.0 * np.cos(4.0 * DT_S * np.arange(3000))
    noise = 0.1 * np.sin(40.0 * DT_S * np.arange(3000))
    fit = fit_friction(*_run(Friction(5.0, 3.0), speed, load, noise), JOINT)
    assert fit.terms[1].kept.startswith("cannot be distinguished from coulomb_nm")
    # What it can say is the sum at that speed: Fc = 8 - 1.
    assert fit.friction.coulomb_nm == pytest.approx(7.0, abs=0.05)
    assert len(fit.warnings) == 1
    assert "positive direction" in fit.warnings[0]


def test_standstill_rows_do_not_count() -> None:
    speed, load = _back_and_forth()
    still = np.zeros(4000)
    time_s, run = _run(Friction(5.0, 3.0), np.concatenate([speed, still]), np.concatenate([load, still]))
    assert run.torque_nm is not None
    stuck = run.torque_nm.copy()
    stuck[8300:] = 4.0  # held by stiction: says nothing about the friction of motion
    fit = fit_friction(time_s, replace(run, torque_nm=stuck), JOINT)
    assert fit.rows <= 8000
    assert fit.friction.coulomb_nm == pytest.approx(5.0, abs=0.03)


def test_runs_that_cannot_serve_are_refused() -> None:
    time_s, run = _run(Friction(5.0, 3.0), *_back_and_forth())
    with pytest.raises(FitError, match="torque_nm"):
        fit_friction(time_s, replace(run, torque_nm=None), JOINT)
    with pytest.raises(FitError, match="rows in motion"):
        fit_friction(time_s, replace(run, motor_velocity_rad_s=np.zeros(len(time_s))), JOINT)
    # A drift of the sensor much larger than the friction: 8000 rows are worth three.
    assert run.torque_nm is not None
    drifting = replace(run, torque_nm=run.torque_nm + np.linspace(-50.0, 50.0, len(time_s)))
    with pytest.raises(FitError, match="independent rows"):
        fit_friction(time_s, drifting, JOINT)


def test_low_pass_is_the_closed_form_ramp_response() -> None:
    dt_s = np.array([0.001, 0.002, 0.0005, 0.003])
    t = np.cumsum(dt_s) - dt_s[0]
    # z' = g (t - z), z(0) = 0: z = t - (1 - exp(-g t))/g.
    assert low_pass(t, dt_s, 80.0) == pytest.approx(t - (1.0 - np.exp(-80.0 * t)) / 80.0, abs=1e-15)
