"""Section `fused.tracking`: its torsion is the estimator's, and with it the interval holds 90 % of runs left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from jtqd.estimator.estimator import observe_run
from jtqd.estimator.fusion import GAUSS
from jtqd.estimator.joint import Tracking
from jtqd.estimator.run import JointColumns
from jtqd.estimator.settings import EstimatorSettings
from jtqd.sysid.fit.signals import run_signals
from jtqd.sysid.fit.torsion_signals import torsion_now
from jtqd.sysid.fit.tracking import TRACKING_RAD_S, fit_tracking
from tests.estimator.fused_helpers import fused_joint, twisted
from tests.estimator.test_torsion_bandwidth import SLIPPING

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
    joint = replace(joint, fused=replace(joint.fused, tracking=Tracking(TRACKING_RAD_S, 0.1, 0.1)))
    columns = JointColumns(
        current_a=current,
        motor_position_rad=motor,
        motor_velocity_rad_s=velocity,
        link_position_rad=link,
        torque_nm=np.zeros(len(dt)),
    )
    run = run_signals("a", joint, EstimatorSettings(method="fused"), np.cumsum(dt), columns)
    assert run.as_read is not None
    found = torsion_now(TORSION, run, run.as_read, TRACKING_RAD_S)
    settings = EstimatorSettings(method="fused", track_link=True)
    seen = observe_run(joint, settings, TORSION, dt, current, motor, velocity, link)
    np.testing.assert_allclose(found[300:], (seen.torsion_nm + seen.ahead_nm)[300:], atol=1e-6)


def test_the_interval_of_now_holds_90_percent_and_nothing_is_added_where_nothing_is_missing() -> None:
    rng = np.random.default_rng(6)
    runs, n = 12, 4000
    speed = [rng.uniform(0.0, 3.0, n) for _ in range(runs)]
    errors = [rng.normal(0.0, 0.1, n) for _ in range(runs)]
    sigmas = [np.full(n, 0.1)] * runs
    now = [e + rng.normal(0.0, 1.0, n) * np.hypot(0.08, 0.06 * v) for e, v in zip(errors, speed, strict=True)]
    found = fit_tracking(errors, sigmas, now, speed)
    assert found.rate_rad_s == TRACKING_RAD_S
    assert found.sigma_nm == pytest.approx(0.08, rel=0.1)
    assert found.viscous_nms_per_rad == pytest.approx(0.06, rel=0.1)
    inside = [
        np.abs(e) <= GAUSS * np.sqrt(0.01 + found.sigma_nm**2 + (found.viscous_nms_per_rad * v) ** 2)
        for e, v in zip(now, speed, strict=True)
    ]
    assert np.mean(inside) == pytest.approx(0.9, abs=0.002)
    same = fit_tracking(errors, [np.full(n, 0.2)] * runs, errors, speed)
    assert (same.sigma_nm, same.viscous_nms_per_rad) == (0.0, 0.0)
