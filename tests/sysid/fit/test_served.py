"""`served` is what the estimator does in service, and the calibration's scale holds the torque, not the sensor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from jtqd.estimator import status as st
from jtqd.estimator.estimator import FusedEstimator
from jtqd.estimator.joint import Tracking
from jtqd.estimator.run import JointColumns
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.uncertainty import GAUSS
from jtqd.sysid.fit.calibration import (
    COVERAGE,
    LATEST,
    OTHER_MOTIONS,
    OTHER_MOTIONS_LEARNED,
    by_speed,
    calibrated,
    early,
    sensor_zeros,
)
from jtqd.sysid.fit.repeatability import fit_zeros
from jtqd.sysid.fit.residuals import (
    TRACKING_RAD_S,
    WAVE_RAD_S,
    NowErrors,
    PathResiduals,
    Served,
    path_residuals,
    served,
)
from jtqd.sysid.fit.signals import run_signals
from tests.estimator.test_agreement import AGREEMENT, WAVIER
from tests.estimator.test_day_zeros import DAYS, LEARNING
from tests.estimator.test_zeros import driven
from tests.sysid.fit.test_zeros import RATED, fused
from tests.sysid.fit.test_zeros import runs as learnt


@pytest.mark.parametrize("tracked", [False, True])
def test_value_and_sigma_are_those_of_the_estimator(tracked: bool) -> None:
    assert LEARNING.fused is not None
    tracking = Tracking(TRACKING_RAD_S, 0.1, 0.3, WAVE_RAD_S, 0.5)
    agreement, zeros = replace(AGREEMENT, zero_factor=1.3), replace(DAYS, early=1.7)
    joint = replace(
        LEARNING, fused=replace(LEARNING.fused, agreement=agreement, tracking=tracking, zeros=zeros)
    )
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
    seen = path_residuals(run, joint.fused.loss, joint.fused.torsion)
    one, low_pass = (
        served(each, joint.fused, joint.rated_torque_nm, tracked=tracked) for each in (seen.tracked(), seen)
    )
    scale = np.array((joint.fused.zeros if tracked and joint.fused.zeros else joint.fused.sigma).scale)[
        one.quadrant
    ]
    late = np.flatnonzero(run.moving)[2000:]

    def off(run: Served) -> np.ndarray:
        """By what part sigma is not the estimator's."""
        missed = 0.1**2 + 0.3**2 * by_speed(run.velocity_rad_s, tracking.bend)
        sigma = np.sqrt((scale * run.spread_nm) ** 2 + run.more_nm2 + missed)
        return np.abs(sigma[2000:] / got.sigma_nm[late] - 1.0)

    assert one.more_nm2[2000:].max() > 0.1
    assert off(one).max() < 0.06
    assert np.quantile(off(one), 0.9) < 0.02
    assert np.quantile(off(low_pass), 0.9) > 0.01, (
        "the difference of the views is that of the tracked torsion"
    )
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
    assert np.mean(inside) == pytest.approx(COVERAGE, abs=0.025)


def of_day(known: float, error_nm: float, rng: np.random.Generator) -> tuple[Served, np.ndarray]:
    """A run of which the first half knows nothing of its zero of 0.2 Nm, the second this part; and its errors."""
    n = 1000
    part = np.where(np.arange(n) < n // 2, 0.0, known)
    one, none = np.ones(n), np.zeros(n)
    error = np.abs(rng.normal(0.0, 1.0, n)) * np.where(part > 0.0, 1.0, error_nm)
    return Served(error, none, one, none, one, np.zeros(n, np.intp), 0.04 * part), error


@pytest.mark.parametrize("wider", [0.7, 1.0, 1.4, 9.0])
def test_how_much_wider_errors_are_before_the_zero_is_known_is_found(wider: float) -> None:
    rng = np.random.default_rng(3)
    runs, errors = zip(*[of_day(0.8, wider, rng) for _ in range(40)], strict=True)
    # at 0.8 known the spread is still wider by a fifth: early/(1 + 0.2 (early - 1)) = wider
    expected = min(max((wider - 0.2 * wider) / (1.0 - 0.2 * wider), 1.0), LATEST) if wider < 5.0 else LATEST
    assert early(errors, runs, 0.2) == pytest.approx(expected, rel=0.06)
    assert early(errors[:7], runs[:7], 0.2) == 1.0


def test_where_zeros_differ_from_day_to_day_runs_are_covered_more_for_other_motions() -> None:
    days = learnt(0.4)
    section = replace(fused(), agreement=None)
    section = replace(section, zeros=fit_zeros(days, section, RATED))
    found = calibrated(days, section, RATED)
    assert found.zeros is not None
    for part, tracked, coverage in (
        (found, True, COVERAGE + OTHER_MOTIONS_LEARNED),
        (replace(found, zeros=None), False, COVERAGE + OTHER_MOTIONS),
    ):
        scale = found.zeros.scale if tracked else found.sigma.scale
        inside = []
        for run in days:
            one = served(run, part, RATED, tracked=tracked)
            sigma = np.hypot(np.array(scale)[one.quadrant] * one.spread_nm, np.sqrt(one.more_nm2))
            inside.append(np.mean(np.abs(one.error_nm) <= GAUSS * sigma))
        assert np.mean(inside) == pytest.approx(coverage, abs=0.015)
