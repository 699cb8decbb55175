"""Section `fused.tracking`: its torsion is the estimator's, and with it the interval holds 90 % of runs left out."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from jtqd.estimator.estimator import observe_run
from jtqd.estimator.joint import Tracking
from jtqd.estimator.run import JointColumns
from jtqd.estimator.settings import EstimatorSettings
from jtqd.sysid.fit import fused as fits
from jtqd.sysid.fit.calibration import SATURATION_RAD_S, by_speed, fit_tracking, tracking_of_unseen, worth_it
from jtqd.sysid.fit.residuals import TRACKING_RAD_S, WAVE_RAD_S, NowErrors, PathResiduals, path_residuals
from jtqd.sysid.fit.signals import run_signals
from jtqd.sysid.fit.torsion import torsion_now, torsion_through
from tests.estimator.fused_helpers import fused_joint, twisted
from tests.estimator.test_torsion_bandwidth import SLIPPING, lossless

AGED = np.full(400, 0.7)
NONE = np.zeros(400)
MADE = PathResiduals(
    NONE + 5.0,
    NONE + 1.0,
    NONE,
    NONE + 5.2,
    NONE,
    NONE + 0.1,
    NONE + 0.2,
    now=NowErrors(NONE + 0.6, AGED, NONE),
)
TORSION = replace(
    SLIPPING,
    orders_per_motor_rev=(2.0, 4.0, 1.0),
    cos_rad=(3e-5, -4e-6, 1e-5),
    sin_rad=(-2e-5, 5e-6, 4e-6),
    link_orders_per_rev=(1.0,),
    link_cos_rad=(2e-5,),
    link_sin_rad=(-1e-5,),
    hardening_rad=(4e-4,),
    hardening_nm_per_rad=(2000.0,),
)


def test_the_torsion_of_now_is_that_of_the_estimator() -> None:
    dt, current, motor, velocity, link = (
        np.array(each) for each in list(zip(*twisted(21).rows(), strict=True))[:5]
    )
    dt = np.full(len(dt), 0.001)
    joint = fused_joint(3, TORSION)
    assert joint.fused is not None
    joint = replace(
        joint, fused=replace(joint.fused, tracking=Tracking(TRACKING_RAD_S, 0.1, 0.1, WAVE_RAD_S))
    )
    columns = JointColumns(
        current_a=current,
        motor_position_rad=motor,
        motor_velocity_rad_s=velocity,
        link_position_rad=link,
        torque_nm=np.zeros(len(dt)),
    )
    run = run_signals("a", joint, EstimatorSettings(method="fused"), np.cumsum(dt), columns)
    assert run.as_read is not None
    found = torsion_now(TORSION, run, run.as_read, TRACKING_RAD_S, WAVE_RAD_S)
    settings = EstimatorSettings(method="fused", track_torsion=True)
    seen = observe_run(joint, settings, TORSION, dt, current, motor, velocity, link)
    np.testing.assert_allclose(found[300:], (seen.torsion_nm + seen.ahead_nm)[300:], atol=1e-6)
    late = torsion_through(TORSION, run, run.as_read, 800.0)
    settings = EstimatorSettings(method="fused", torsion_bandwidth_rad_s=800.0)
    seen = observe_run(joint, settings, TORSION, dt, current, motor, velocity, link)
    np.testing.assert_allclose(late[300:], (seen.torsion_nm + seen.ahead_nm)[300:], atol=1e-6)


def test_what_follows_in_a_fit_sees_the_tracked_torsion(monkeypatch: pytest.MonkeyPatch) -> None:
    """Zeros, agreement and calibration; without the section that of the fit's own filter."""
    joint = lossless(0.3, 0.3)
    assert joint.fused is not None
    for section in (Tracking(TRACKING_RAD_S, 0.1, 0.1, WAVE_RAD_S), None):
        seen: list[PathResiduals] = []
        monkeypatch.setattr(fits, "_unseen", lambda *_, **__: ([MADE] * 6, []))
        monkeypatch.setattr(fits, "tracking_of_unseen", lambda *_, made=section: made)
        monkeypatch.setattr(fits, "fit_standstill", lambda *_: None)
        monkeypatch.setattr(fits, "fit_loss", lambda *_: SimpleNamespace(loss=joint.fused.loss))  # type: ignore[union-attr]
        monkeypatch.setattr(fits, "fit_torsion", lambda *_: joint.fused.torsion)  # type: ignore[union-attr]
        monkeypatch.setattr(fits, "fit_envelope", lambda *_: None)
        for name in ("fit_zeros", "agreement_of_held_out"):
            monkeypatch.setattr(fits, name, lambda runs, *_, to=seen: to.extend(runs))
        monkeypatch.setattr(fits, "calibrated", lambda runs, fused, _, to=seen: (to.extend(runs), fused)[1])
        fits.fit_fused([None] * 6, joint.friction, 40.0)  # type: ignore[list-item]
        assert len(seen) == 18
        for run in seen:
            assert np.array_equal(run.torsion_error_nm, AGED if section else MADE.torsion_error_nm)
            np.testing.assert_allclose(run.torsion_nm - run.torsion_error_nm, 5.0)  # the sensor


def test_what_an_estimate_of_now_errs_by_more_is_found_and_nothing_where_nothing_is_missing() -> None:
    rng = np.random.default_rng(6)
    runs, n = 12, 4000
    speed = [rng.uniform(0.0, 3.0, n) for _ in range(runs)]
    errors = [rng.normal(0.0, 0.1, n) for _ in range(runs)]
    now = [e + rng.normal(0.0, 1.0, n) * np.hypot(0.08, 0.06 * v) for e, v in zip(errors, speed, strict=True)]
    found = fit_tracking(errors, now, speed)
    assert (found.rate_rad_s, found.wave_rad_s) == (TRACKING_RAD_S, WAVE_RAD_S)
    assert found.sigma_nm == pytest.approx(0.08, rel=0.1)
    assert found.viscous_nms_per_rad == pytest.approx(0.06, rel=0.1)
    assert found.saturation_rad_s == SATURATION_RAD_S[-1]
    bent = [
        e + rng.normal(0.0, 1.0, n) * np.sqrt(0.08**2 + 0.2**2 * v * v / (1.0 + (v / 0.8) ** 2))
        for e, v in zip(errors, speed, strict=True)
    ]
    found = fit_tracking(errors, bent, speed)
    assert found.saturation_rad_s == pytest.approx(0.8, rel=0.3)
    v = np.array([0.0, 0.5, 1.0, 3.0])
    missed = found.sigma_nm**2 + found.viscous_nms_per_rad**2 * by_speed(v, found.bend)
    assert missed == pytest.approx(0.08**2 + 0.2**2 * v * v / (1.0 + (v / 0.8) ** 2), rel=0.15)
    same = fit_tracking(errors, errors, speed)
    assert (same.sigma_nm, same.viscous_nms_per_rad) == (0.0, 0.0)


def test_it_is_worth_it_where_runs_left_out_err_less_than_with_the_low_pass_zeros_apart() -> None:
    rng = np.random.default_rng(8)
    small, large = ([zero + size * rng.normal(size=500) for zero in (-1.0, 2.0)] for size in (0.1, 0.2))
    assert worth_it(small, large)
    assert worth_it([5.0 + each for each in small], large)
    assert not worth_it(large, small)


@pytest.mark.parametrize("counts", [65536, 64])
def test_a_coarse_motor_encoder_gets_no_tracking(counts: int) -> None:
    """Of 64 counts a turn one is a milliradian of the joint: 12 Nm at 12 000 Nm/rad; the low pass takes more of it off."""
    joint = lossless(0.3, 0.3)
    assert joint.fused is not None
    runs = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        time = 1e-3 * np.arange(1200)
        speed = 1.8 * np.sin(6.0 * time + seed)
        link = np.cumsum(speed) * 1e-3
        torque = 10.0 * np.sin(2.0 * time + seed) + 0.4 * np.sin(2.0 * joint.gear_ratio * link)
        unit = 2.0 * np.pi / counts
        columns = JointColumns(
            current_a=torque / (joint.gear_ratio * joint.torque_constant_nm_per_a),
            motor_position_rad=np.round(joint.gear_ratio * (link + torque / 12000.0) / unit) * unit,
            motor_velocity_rad_s=joint.gear_ratio * speed,
            link_position_rad=link + 6e-6 * rng.normal(size=len(time)),
            torque_nm=torque + 0.02 * rng.normal(size=len(time)),
        )
        run = run_signals(str(seed), joint, EstimatorSettings(method="fused"), time, columns)
        runs.append(path_residuals(run, joint.fused.loss, joint.fused.torsion))
    assert (tracking_of_unseen(runs, joint.fused) is not None) == (counts == 65536)
