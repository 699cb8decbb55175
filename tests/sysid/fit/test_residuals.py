"""Signals of a run, and held-out residuals: what they are made of, and that their fusion is the estimator's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from jtqd.estimator import status as st
from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.estimator import FusedEstimator
from jtqd.estimator.fusion import Fusion
from jtqd.estimator.joint import Tracking
from jtqd.estimator.observer import low_pass
from jtqd.estimator.run import JointColumns
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.status import STANDSTILL
from jtqd.sysid.fit.calibration import FusedErrors, bent_square, fit_tracking, fused_errors, path_residuals
from jtqd.sysid.fit.signals import UNIT_TORSION, run_signals
from jtqd.sysid.fit.torsion import TRACKING_RAD_S, WAVE_RAD_S
from tests.estimator.estimator_helpers import first_order_hold, joint1
from tests.estimator.fused_helpers import AGREEMENT, DAYS, LEARNING, driven, twisted, wavier
from tests.estimator.test_torsion_filters import lossless
from tests.sysid.fit.fused_signals import FUSED, STIFF, made_run, smooth_loss
from tests.sysid.fit.test_repeatability import fused

# Signals -----------------------------------------------------------------------------------------------


def columns(seed: int) -> tuple[FloatArray, JointColumns]:
    m = twisted(seed)
    torque = 10.0 * np.sin(3.0 * np.cumsum(m.dt_s))
    i, q, w, link = m.arrays()[1:]
    return np.cumsum(m.dt_s), JointColumns(i, q, w, link, torque_nm=torque)


def test_the_sensor_gets_the_delay_of_the_estimate() -> None:
    """Uneven steps, against the recursion; a ramp lags by 1/g."""
    time, one = columns(21)
    dt = np.diff(time, prepend=time[0])
    assert one.torque_nm is not None
    got = low_pass(one.torque_nm, dt, 200.0)
    z, last = one.torque_nm[0], one.torque_nm[0]
    for k in range(1, len(time)):
        a, b0, b1 = first_order_hold(200.0, dt[k])
        z, last = a * z + b0 * one.torque_nm[k] + b1 * last, one.torque_nm[k]
        assert got[k] == pytest.approx(z, abs=1e-3)  # steps count to 0.1 us
    ramp = low_pass(7.0 * time, dt, 200.0)
    assert ramp[500:] == pytest.approx(7.0 * (time[500:] - 1 / 200.0), abs=2e-3)


def test_signals_of_a_run() -> None:
    time, one = columns(22)
    run = run_signals("a run", joint1(), FUSED, time, one)
    assert run.name == "a run"
    assert np.isnan(run.temperature_c)
    assert not np.any(run.moving & run.standing)
    assert np.array_equal(run.standing, (run.seen.status == STANDSTILL) & (time - time[0] >= 0.1))
    assert not run.moving[time - time[0] < 0.1].any()
    seen = low_pass(run.torsion_rad, np.diff(time, prepend=time[0]), 200.0)
    running = np.isfinite(run.seen.torsion_nm)
    assert run.seen.torsion_nm[running] == pytest.approx(seen[running], abs=2e-6)
    assert UNIT_TORSION.stiffness_nm_per_rad == 1.0
    warm = replace(one, temperature_c=np.where(time < 1, np.nan, 31.0))
    assert run_signals("b", joint1(), FUSED, time, warm).temperature_c == 31.0


def test_after_a_gap_the_filters_settle_again() -> None:
    time, one = columns(23)
    late = np.where(np.arange(len(time)) >= 1500, time + 0.2, time)
    run = run_signals("gap", joint1(), FUSED, late, one)
    after = (late >= late[1500]) & (late < late[1500] + 0.1)
    assert not (run.moving | run.standing)[after].any()
    assert (run.moving | run.standing)[~after & (late - late[0] >= 0.1)].all()


def test_a_run_without_what_is_needed_is_refused() -> None:
    time, one = columns(24)
    with pytest.raises(ValueError, match="r7: joint joint1: the run has no link_position_rad, torque_nm"):
        run_signals("r7", joint1(), FUSED, time, replace(one, link_position_rad=None, torque_nm=None))
    assert one.torque_nm is not None
    holes = np.where(np.arange(len(time)) % 1000 == 5, np.nan, one.torque_nm)
    with pytest.raises(
        ValueError, match="r7: joint joint1: torque_nm: found 3 gaps, expected finite numbers"
    ):
        run_signals("r7", joint1(), FUSED, time, replace(one, torque_nm=holes))


# Residuals ---------------------------------------------------------------------------------------------


def test_the_error_of_the_fused_value_is_that_of_fused_paths_less_the_sensor() -> None:
    run = made_run(7, smooth_loss())
    section = replace(fused(), loss=smooth_loss(), torsion=STIFF)
    parts = path_residuals(run, section.loss, section.torsion)
    one, sensor = fused_errors(parts, section), run.sensor_nm
    _, value, spread, _ = Fusion(replace(section.sigma, reference_nm=0.0), True).fuse(
        *parts.fusion_inputs, loss_nm=parts.raw_nm - sensor - parts.current_error_nm
    )
    assert one.error_nm == pytest.approx(value - sensor, abs=1e-9)
    assert one.spread_nm == pytest.approx(spread, rel=1e-9)
    assert parts.torsion_nm - parts.torsion_error_nm == pytest.approx(sensor, abs=1e-9)
    tracked = parts.with_tracked_torsion()
    assert tracked.torsion_nm - tracked.torsion_error_nm == pytest.approx(sensor, abs=1e-9)
    assert np.array_equal(tracked.torsion_error_nm, parts.delayed_nm)


@pytest.mark.parametrize("track_zeros", [False, True])
def test_value_and_sigma_are_those_of_the_estimator(track_zeros: bool) -> None:
    assert LEARNING.fused is not None
    tracking = Tracking(TRACKING_RAD_S, 0.1, 0.3, WAVE_RAD_S, 0.5)
    agreement, zeros = replace(AGREEMENT, zero_factor=1.3), replace(DAYS, early=1.7)
    joint = replace(
        LEARNING, fused=replace(LEARNING.fused, agreement=agreement, tracking=tracking, zeros=zeros)
    )
    assert joint.fused is not None
    inputs, _ = driven(8.0, link_zero_rad=4e-5)
    dt, current, motor, velocity, link, temperature = inputs
    link = link + 0.5 * (wavier(np.cumsum(dt), motor / 100.0, link) - link)
    settings = EstimatorSettings(method="fused", track_zeros=track_zeros, track_torsion=True)
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
    plain = path_residuals(run, joint.fused.loss, joint.fused.torsion)
    one, low_pass_view = (
        fused_errors(each, joint.fused, joint.rated_torque_nm, track_zeros=track_zeros)
        for each in (plain.with_tracked_torsion(), plain)
    )
    scale = np.array((joint.fused.zeros if track_zeros and joint.fused.zeros else joint.fused.sigma).scale)
    late = np.flatnonzero(run.moving)[2000:]

    def off(run: FusedErrors) -> FloatArray:
        """By what part sigma is not the estimator's."""
        missed = 0.1**2 + 0.3**2 * bent_square(run.velocity_rad_s, tracking.bend)
        sigma = np.sqrt((scale[run.quadrant] * run.spread_nm) ** 2 + run.more_nm2 + missed)
        return np.abs(sigma[2000:] / got.sigma_nm[late] - 1.0)

    assert one.more_nm2[2000:].max() > 0.1
    assert off(one).max() < 0.06
    assert np.quantile(off(one), 0.9) < 0.02
    assert np.quantile(off(low_pass_view), 0.9) > 0.01, "the paths differ by the tracked torsion"
    assert np.abs(one.undelayed_nm[2000:] - got.torque_nm[late]).max() < 0.02
    assert set(got.status[late]) <= {st.VALID, st.DEGRADED}


@pytest.mark.parametrize("counts", [65536, 64])
def test_a_coarse_motor_encoder_gets_no_tracking(counts: int) -> None:
    """Of 64 counts a turn one is a milliradian of the joint: 12 Nm at 12 000 Nm/rad; the low pass has a smaller error."""
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
        motor = np.round(joint.gear_ratio * (link + torque / 12000.0) / unit) * unit
        recorded = JointColumns(
            current_a=torque / (joint.gear_ratio * joint.torque_constant_nm_per_a),
            motor_position_rad=motor,
            motor_velocity_rad_s=joint.gear_ratio * speed,
            link_position_rad=link + 6e-6 * rng.normal(size=len(time)),
            torque_nm=torque + 0.02 * rng.normal(size=len(time)),
        )
        run = run_signals(str(seed), joint, FUSED, time, recorded)
        runs.append(path_residuals(run, joint.fused.loss, joint.fused.torsion))
    assert (fit_tracking(runs, joint.fused) is not None) == (counts == 65536)
    # offsets of the runs do not count: they are in both
    shifted = [run._replace(tracked_nm=run.tracked_nm + 5.0 * n) for n, run in enumerate(runs)]
    assert (fit_tracking(shifted, joint.fused) is not None) == (counts == 65536)
