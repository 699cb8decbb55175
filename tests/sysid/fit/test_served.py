"""`served` is what the estimator does in service, and the calibration's scale holds the torque, not the sensor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from jtqd.estimator import status as st
from jtqd.estimator.estimator import FusedEstimator
from jtqd.estimator.fusion import GAUSS
from jtqd.estimator.joint import Tracking
from jtqd.estimator.run import JointColumns
from jtqd.estimator.settings import EstimatorSettings
from jtqd.sysid.fit.calibration import OTHER_MOTIONS, calibrated, sensor_zeros
from jtqd.sysid.fit.conformal import COVERAGE
from jtqd.sysid.fit.fused import path_residuals
from jtqd.sysid.fit.residuals import NowErrors, PathResiduals
from jtqd.sysid.fit.served import served
from jtqd.sysid.fit.signals import run_signals
from jtqd.sysid.fit.tracking import TRACKING_RAD_S, WAVE_RAD_S
from tests.estimator.test_agreement import AGREEMENT, WAVIER
from tests.estimator.test_day_zeros import LEARNING
from tests.estimator.test_zeros import driven
from tests.sysid.fit.test_zeros import fused


@pytest.mark.parametrize("tracked", [False, True])
def test_value_and_sigma_are_those_of_the_estimator(tracked: bool) -> None:
    assert LEARNING.fused is not None
    tracking = Tracking(TRACKING_RAD_S, 0.1, 0.05, WAVE_RAD_S)
    joint = replace(LEARNING, fused=replace(LEARNING.fused, agreement=AGREEMENT, tracking=tracking))
    assert joint.fused is not None
    columns, _ = driven(8.0, link_zero_rad=4e-5)
    dt, current, motor, velocity, link, temperature = columns
    link = link + 0.5 * (WAVIER(np.cumsum(dt), motor / 100.0, link) - link)
    settings = EstimatorSettings(method="fused", track_zeros=tracked, track_torsion=True)
    got = FusedEstimator(joint, settings).run(dt, current, motor, velocity, link, temperature)
    run = run_signals(
        "a",
        joint,
        replace(settings, track_zeros=False, track_torsion=False),
        np.cumsum(dt),
        JointColumns(
            current_a=current,
            motor_position_rad=motor,
            motor_velocity_rad_s=velocity,
            link_position_rad=link,
            temperature_c=temperature,
            torque_nm=np.zeros(len(dt)),
        ),
    )
    one = served(
        path_residuals(run, joint.fused.loss, joint.fused.torsion),
        joint.fused,
        joint.rated_torque_nm,
        tracked=tracked,
    )
    scale = np.array((joint.fused.zeros if tracked and joint.fused.zeros else joint.fused.sigma).scale)[
        one.quadrant
    ]
    sigma = np.sqrt((scale * one.spread_nm) ** 2 + one.more_nm2 + 0.1**2 + (0.05 * one.velocity_rad_s) ** 2)
    late = np.flatnonzero(run.moving)[2000:]
    assert one.more_nm2[2000:].max() > 0.1
    assert sigma[2000:] == pytest.approx(got.sigma_nm[late], rel=0.06)
    assert np.abs(one.now_nm[2000:] - got.torque_nm[late]).max() < 0.02
    assert set(got.status[late]) <= {st.VALID, st.DEGRADED}


def days(zeros: np.ndarray, tracked: bool = False) -> list[PathResiduals]:
    """Runs of a sensor with these zeros; the paths err by 0.6 and 0.5 Nm, of which half is the run's own."""
    rng = np.random.default_rng(12)
    n, found = 600, []
    for zero in zeros:
        v, torque = rng.uniform(0.5, 2.0, n) * rng.choice((-1.0, 1.0), n), rng.uniform(-20.0, 20.0, n)
        current, torsion = (
            size * (0.7 * rng.normal() + 0.7 * rng.normal(size=n)) + zero for size in (0.6, 0.5)
        )
        now = NowErrors(torsion + rng.normal(0.0, 0.4, n), torsion, torsion) if tracked else NowErrors()
        none = np.zeros(n)
        found.append(PathResiduals(torque, v, none, torque, none, current, torsion, now=now))
    return found


def test_zeros_of_the_sensor_are_told_as_well_as_they_are_said_to_be() -> None:
    true = np.random.default_rng(13).normal(0.0, 0.8, 400)
    found, sd = sensor_zeros(days(true), 0.8)
    assert np.std(found - true) == pytest.approx(sd, rel=0.25)
    assert sd < 0.5 * 0.8
    assert sensor_zeros(days(true)[:5], 0.0) == (pytest.approx(np.zeros(5)), 0.0)


@pytest.mark.parametrize("tracked", [False, True])
def test_the_calibrated_interval_holds_the_torque(tracked: bool) -> None:
    """Runs that the calibration did not see; with the sensor's zero in it, the interval would hold 97 %."""
    true = np.random.default_rng(14).normal(0.0, 0.8, 300)
    runs = days(true, tracked)
    section = fused()
    tracking = Tracking(TRACKING_RAD_S, 0.3, 0.0, WAVE_RAD_S) if tracked else None
    section = replace(
        section, sigma=replace(section.sigma, reference_nm=0.8), agreement=None, tracking=tracking
    )
    found = calibrated(runs[:200], section)
    inside = []
    for run, zero in zip(runs[200:], true[200:], strict=True):
        one = served(run, found)
        error = (one.now_nm if tracked else one.error_nm) - zero
        more = one.more_nm2 + (0.3**2 if tracked else 0.0)
        inside.append(
            np.abs(error)
            <= GAUSS * np.hypot(np.array(found.sigma.scale)[one.quadrant] * one.spread_nm, np.sqrt(more))
        )
    assert np.mean(inside) == pytest.approx(COVERAGE + OTHER_MOTIONS, abs=0.025)
