"""Signals, held-out residuals and their calibration: the fusion is the estimator's, and intervals hold what they promise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from jtqd.estimator import status as st
from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.estimator import FusedEstimator
from jtqd.estimator.fusion import GAUSS, Fusion
from jtqd.estimator.joint import FusedSigma, Tracking
from jtqd.estimator.observer import low_pass
from jtqd.estimator.run import JointColumns
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.status import STANDSTILL
from jtqd.sysid.fit import calibration
from jtqd.sysid.fit.calibration import (
    COVERAGE,
    FEWEST_RUNS,
    OTHER_MOTIONS,
    OTHER_MOTIONS_LEARNED,
    SATURATION_RAD_S,
    FusedErrors,
    PathResiduals,
    Standing,
    bent_square,
    calibrated,
    conformal_scale,
    fit_sigma,
    fit_standstill,
    fit_tracking,
    fused_errors,
    normal_bound,
    path_residuals,
    sensor_offsets,
    tracking_section,
    unbiased_level,
)
from jtqd.sysid.fit.fused import fit_zeros
from jtqd.sysid.fit.signals import UNIT_TORSION, run_signals
from jtqd.sysid.fit.torsion import TRACKING_RAD_S, WAVE_RAD_S
from tests.estimator.estimator_helpers import first_order_hold, joint1
from tests.estimator.fused_helpers import AGREEMENT, LEARNING, driven, twisted, wavier
from tests.estimator.test_torsion_filters import lossless
from tests.sysid.fit.fused_signals import FUSED, STIFF, made_run, smooth_loss
from tests.sysid.fit.test_repeatability import RATED, fused, runs_of_days

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
    agreement = replace(AGREEMENT, zero_factor=1.3)
    joint = replace(LEARNING, fused=replace(LEARNING.fused, agreement=agreement, tracking=tracking))
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

    # near a reversal and after rest, sigma in service holds as well what nothing has proven of the torsion yet
    proven = plain.half_nm[2000:] < 0.01
    assert 0.5 < proven.mean() < 1.0

    def off(run: FusedErrors) -> FloatArray:
        """By what part the estimator's sigma is larger."""
        missed = 0.1**2 + 0.3**2 * bent_square(run.velocity_rad_s, tracking.bend)
        sigma = np.sqrt((scale[run.quadrant] * run.spread_nm) ** 2 + run.more_nm2 + missed)
        return np.asarray(got.sigma_nm[late] / sigma[2000:] - 1.0)

    assert one.more_nm2[2000:].max() > 0.1
    assert off(one).min() > -0.06
    assert off(one)[~proven].max() > 0.1
    assert np.abs(off(one)[proven]).max() < 0.06
    assert np.quantile(np.abs(off(one)[proven]), 0.9) < 0.02
    assert np.quantile(np.abs(off(low_pass_view)[proven]), 0.9) > 0.01, (
        "the paths differ by the tracked torsion"
    )
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


# Conformal quantiles -----------------------------------------------------------------------------------


def heteroscedastic(rng: np.random.Generator, count: int = 1500) -> tuple[FloatArray, FloatArray, np.ndarray]:
    """(error, assumed sigma, quadrant): true scatter is a multiple of sigma that differs per quadrant, heavy tails."""
    sigma = rng.uniform(0.1, 2.0, count)
    quadrant = rng.integers(0, 4, count)
    factor = np.array((0.4, 1.0, 2.0, 5.0))[quadrant] * rng.lognormal(0.0, 0.2)  # and a bit per run
    return rng.standard_t(4, count) * sigma * factor, sigma, quadrant


def test_the_scaled_interval_covers_90_percent_of_new_runs() -> None:
    rng = np.random.default_rng(33)
    scale = conformal_scale(*zip(*(heteroscedastic(rng) for _ in range(60)), strict=True))
    assert scale[3] > 8 * scale[0]
    for quadrant in range(4):
        covered = []
        for _ in range(60):
            error, sigma, where = heteroscedastic(rng)
            inside = np.abs(error) <= GAUSS * scale[quadrant] * sigma
            covered.append(np.mean(inside[where == quadrant]))
        assert np.mean(covered) == pytest.approx(0.9, abs=0.015), quadrant


def test_errors_that_whole_runs_share_are_covered_alike() -> None:
    """Each run has its own offset and little else, calibrated on 20 runs: 90 % on average over 200 campaigns.

    Level 0.9 of the pooled samples would cover 87 %, that of split conformal prediction, rounded up, 91 %.
    """
    rng = np.random.default_rng(36)
    one, where = np.ones(100), np.zeros(100, int)

    def error() -> FloatArray:
        return rng.normal() + 0.1 * rng.normal(size=100)

    covered = []
    for _ in range(200):
        scale = conformal_scale([error() for _ in range(20)], [one] * 20, [where] * 20)[0]
        covered.append(np.mean(np.abs([error() for _ in range(40)]) <= GAUSS * scale))
    assert np.mean(covered) == pytest.approx(0.9, abs=0.015)


def test_the_level_lies_between_that_of_samples_and_that_of_runs() -> None:
    rng = np.random.default_rng(37)
    alike = [np.abs(rng.normal(size=4000)) for _ in range(48)]
    assert unbiased_level(alike) == pytest.approx(0.9, abs=0.003)
    apart = [np.full(100, k / 48) for k in rng.permutation(48)]
    assert unbiased_level(apart) == pytest.approx(0.9 * 49 / 48, abs=0.01)  # of 48 places one must be taken
    between = [np.abs(rng.normal() + rng.normal(size=4000)) for _ in range(48)]
    assert 0.9 < unbiased_level(between) < 0.9 * 49 / 48
    assert unbiased_level(apart[:8]) == unbiased_level(apart[:1]) == 0.97  # 8 runs do not show the largest


def test_normal_errors_of_the_assumed_size_need_no_factor() -> None:
    rng = np.random.default_rng(34)
    one = np.ones(4000)
    runs = [(rng.normal(size=4000), one, rng.integers(0, 4, 4000)) for _ in range(100)]
    assert conformal_scale(*zip(*runs, strict=True)) == pytest.approx((1.0,) * 4, abs=0.01)


def test_runs_count_alike_whatever_their_length() -> None:
    """20 runs, one of them long and ten times as wrong as the others: 5 % of runs, though 98 % of samples; then three."""
    short = (np.full(100, 1.0), np.ones(100), np.zeros(100, int))
    long = (np.full(100_000, 10.0), np.ones(100_000), np.zeros(100_000, int))
    for count, expected in ((1, 1.0), (3, 10.0)):
        runs = [short] * (20 - count) + [long] * count
        assert conformal_scale(*zip(*runs, strict=True))[0] == pytest.approx(expected / GAUSS)


def test_a_quadrant_without_samples_takes_the_factor_of_all() -> None:
    rng = np.random.default_rng(35)
    runs = [(3.0 * rng.normal(size=500), np.ones(500), np.repeat((0, 1), (480, 20))) for _ in range(20)]
    scale = conformal_scale(*zip(*runs, strict=True))
    assert scale[1] == scale[2] == scale[3] == pytest.approx(3.0, abs=0.1)
    with pytest.raises(ValueError, match="found no samples to calibrate sigma with"):
        conformal_scale([np.zeros(0)] * 2, [np.zeros(0)] * 2, [np.zeros(0, int)] * 2)
    assert min(conformal_scale([np.zeros(100)], [np.ones(100)], [np.zeros(100, int)])) > 0.0


# Sigma and tracking ------------------------------------------------------------------------------------

TRUE = FusedSigma(0.25, 0.12, 0.02, 0.3, 0.03, 0.4, (1.0, 1.0, 1.0, 1.0))


def residuals(rng: np.random.Generator, count: int = 2000) -> PathResiduals:
    """One run of errors drawn as TRUE has them, its reference shared by both paths."""
    raw, v = rng.uniform(-30.0, 30.0, count), rng.uniform(-3.0, 3.0, count)
    torque = 0.7 * raw
    current = np.sqrt(0.25**2 + (0.12 * v) ** 2 + (0.02 * raw) ** 2)
    torsion = np.sqrt(0.3**2 + (0.03 * torque) ** 2)
    offset = rng.normal(0.0, 0.4)
    errors = (rng.normal(0.0, sd) + offset for sd in (current, torsion))
    return PathResiduals(raw, v, np.zeros(count), torque, np.zeros(count), *errors)


def test_known_standard_deviations_come_back() -> None:
    """Many runs: of the reference only what is sure counts as such."""
    rng = np.random.default_rng(31)
    found = fit_sigma([residuals(rng, 200) for _ in range(1200)])
    few = fit_sigma([residuals(rng, 2000) for _ in range(12)])
    assert few.reference_nm < 0.4 < np.hypot(few.reference_nm, few.current_nm)
    for name in ("current_nm", "viscous_nms_per_rad", "load", "torsion_nm", "torsion_load", "reference_nm"):
        assert getattr(found, name) == pytest.approx(getattr(TRUE, name), rel=0.15), name
    assert found.scale == (1.0, 1.0, 1.0, 1.0)


def test_sigma_needs_three_held_out_runs_with_motion() -> None:
    rng = np.random.default_rng(32)
    none = PathResiduals(*[np.zeros(0)] * 7)
    with pytest.raises(ValueError, match="found 2 held-out runs with motion, expected at least 3"):
        fit_sigma([residuals(rng), none, residuals(rng)])
    slow = [
        run._replace(velocity_rad_s=0.01 * run.velocity_rad_s) for run in (residuals(rng) for _ in range(3))
    ]
    with pytest.raises(ValueError, match=r"found no held-out sample above 0\.1 rad/s"):
        fit_sigma(slow)


@pytest.mark.parametrize(
    ("noise", "viscous", "saturation"), [(0.08, 0.06, None), (0.08, 0.2, 0.8), (0.0, 0.0, None)]
)
def test_the_further_error_without_delay_is_found(
    noise: float, viscous: float, saturation: float | None
) -> None:
    rng = np.random.default_rng(6)
    v = rng.uniform(0.0, 3.0, 48_000)
    error = rng.normal(0.0, 0.1, len(v))
    bend = 0.0 if saturation is None else 1.0 / saturation**2
    undelayed = error + rng.normal(size=len(v)) * np.hypot(noise, viscous * np.sqrt(bent_square(v, bend)))
    found = tracking_section(undelayed**2 - error**2, v)
    assert (found.rate_rad_s, found.wave_rad_s) == (TRACKING_RAD_S, WAVE_RAD_S)
    at = np.array([0.0, 0.5, 1.0, 3.0])
    missed = found.sigma_nm**2 + found.viscous_nms_per_rad**2 * bent_square(at, found.bend)
    assert missed == pytest.approx(noise**2 + viscous**2 * bent_square(at, bend), rel=0.15)
    if saturation is not None:
        assert found.saturation_rad_s == pytest.approx(saturation, rel=0.3)
    elif noise:
        assert found.saturation_rad_s == SATURATION_RAD_S[-1]


# Standstill --------------------------------------------------------------------------------------------

Draw = Callable[[np.random.Generator], float]


def day(error_nm: float, source: np.random.Generator, count: int = 60) -> Standing:
    """One run at rest: an error that all its samples share, a bit of noise, sd 0.5 Nm."""
    errors = error_nm + 0.05 * source.normal(size=count)
    return Standing(errors, np.full(count, 0.5), np.zeros(count), np.ones(count, bool))


def sigmas(runs: list[Standing], reference_nm: float = 0.0) -> float:
    found = fit_standstill(runs, reference_nm)
    assert found is not None
    return found.sigmas


@pytest.mark.parametrize("runs", [FEWEST_RUNS, 11, 32])
@pytest.mark.parametrize(
    ("draw", "least"),
    [(lambda source: 0.5 * source.normal(), 0.94), (lambda source: 0.5 * source.standard_t(4), 0.92)],
    ids=["normal", "heavy"],
)
def test_other_days_are_held(runs: int, draw: Draw, least: float) -> None:
    """Every run is one error: of few runs the factor is larger, and holds other days as often, or nearly."""
    source = np.random.default_rng(5)
    found = [sigmas([day(draw(source), source) for _ in range(runs)]) for _ in range(960 // (runs + 16))]
    others = np.abs([draw(source) for _ in range(4000)])
    assert least < np.mean([np.mean(others <= 0.5 * k) for k in found]) < 0.99


def test_few_normal_errors_need_a_wider_bound() -> None:
    """Tables of Student's t and of normal tolerance factors, mean known (90 % of all with 95 % confidence)."""
    assert [normal_bound(n) for n in (6, 11, 32)] == pytest.approx([3.15, 2.55, 2.077], rel=2e-3)
    assert normal_bound(10_000) == pytest.approx(1.96, rel=1e-3)
    source = np.random.default_rng(6)
    days = [day(0.5 * float(error), source) for error in np.linspace(-1.7, 1.7, 100)]  # uniform: RMS 0.99
    assert sigmas(days) == pytest.approx(1.98, rel=0.04)


def test_the_offset_of_the_sensor_is_no_error_of_the_joint_and_hides_none() -> None:
    """With a sensor whose offset is three times the joint's own error the factor is as without, but for few runs."""
    source = np.random.default_rng(9)

    def campaign(own_nm: float, runs: int) -> float:
        days = [day(own_nm * source.normal() + 1.5 * source.normal(), source) for _ in range(runs)]
        return sigmas(days, 1.5)

    assert 1.8 < np.mean([campaign(0.5, 40) for _ in range(15)]) < 3.5
    assert np.mean([campaign(1.5, 40) for _ in range(15)]) > 5.0
    assert np.mean([campaign(0.5, 10) for _ in range(15)]) > 2.2


def test_bounds_are_no_deviations_and_an_unknown_slip_does_not_count() -> None:
    source = np.random.default_rng(7)
    runs = [day(0.5 * source.normal(), source, 120) for _ in range(12)]
    beyond = [
        run._replace(error_nm=run.error_nm + 3.0 * np.sign(run.error_nm), bound_nm=run.bound_nm + 3.0)
        for run in runs
    ]
    assert sigmas(beyond) == pytest.approx(sigmas(runs))
    unknown = np.arange(120) < 60
    half = [run._replace(known=~unknown, error_nm=np.where(unknown, 50.0, run.error_nm)) for run in runs]
    assert sigmas(half) == pytest.approx(sigmas(runs), rel=0.05)


def test_too_few_stops_have_no_section_and_a_small_error_still_a_width() -> None:
    source = np.random.default_rng(8)
    few = [day(0.1, source) for _ in range(FEWEST_RUNS - 1)]
    assert fit_standstill(few) is None
    assert fit_standstill([*few, day(0.1, source, count=10)]) is None
    assert sigmas([day(0.001, source) for _ in range(8)]) == 1.0


# Scale -------------------------------------------------------------------------------------------------


def runs_of_sensor(offsets: np.ndarray, tracked: bool = False) -> list[PathResiduals]:
    """Runs of a sensor with these offsets; the paths err by 0.6 and 0.5 Nm, of which half is the run's own."""
    rng = np.random.default_rng(12)
    n, found = 600, []
    for offset in offsets:
        v, torque = rng.uniform(0.5, 2.0, n) * rng.choice((-1.0, 1.0), n), rng.uniform(-20.0, 20.0, n)
        current, torsion = (
            size * (0.7 * rng.normal() + 0.7 * rng.normal(size=n)) + offset for size in (0.6, 0.5)
        )
        none = np.zeros(n)
        run = PathResiduals(torque, v, none, torque, none, current, torsion)
        if tracked:
            run = run._replace(tracked_nm=torsion + rng.normal(0.0, 0.4, n), delayed_nm=torsion)
        found.append(run)
    return found


def inside(
    run: FusedErrors, error_nm: FloatArray, scale: tuple[float, ...], further_nm2: float = 0.0
) -> float:
    """Share of samples inside the 90 % interval."""
    sigma = np.hypot(np.array(scale)[run.quadrant] * run.spread_nm, np.sqrt(run.more_nm2 + further_nm2))
    return float(np.mean(np.abs(error_nm) <= GAUSS * sigma))


def test_offsets_of_the_sensor_are_as_well_known_as_their_standard_deviation() -> None:
    true = np.random.default_rng(13).normal(0.0, 0.8, 400)
    found, sd = sensor_offsets(runs_of_sensor(true), 0.8)
    assert np.std(found - true) == pytest.approx(sd, rel=0.25)
    assert sd < 0.5 * 0.8
    assert sensor_offsets(runs_of_sensor(true)[:5], 0.0) == (pytest.approx(np.zeros(5)), 0.0)


@pytest.mark.parametrize("tracked", [False, True])
def test_the_calibrated_interval_holds_the_torque(tracked: bool) -> None:
    """Runs that the calibration did not use; with the sensor's offset in it, the interval would hold 97 %."""
    true = np.random.default_rng(14).normal(0.0, 0.8, 300)
    runs = runs_of_sensor(true, tracked)
    tracking = Tracking(TRACKING_RAD_S, 0.3, 0.0, WAVE_RAD_S) if tracked else None
    section = fused()
    section = replace(
        section, sigma=replace(section.sigma, reference_nm=0.8), agreement=None, tracking=tracking
    )
    found = calibrated(runs[:200], section, RATED)
    shares = []
    for run, offset in zip(runs[200:], true[200:], strict=True):
        one = fused_errors(run, found)
        error = (one.undelayed_nm if tracked else one.error_nm) - offset
        shares.append(inside(one, error, found.sigma.scale, 0.3**2 if tracked else 0.0))
    assert np.mean(shares) == pytest.approx(COVERAGE, abs=0.025)


@pytest.mark.parametrize("tracked", [False, True])
def test_the_interval_holds_what_the_teacher_does_not_know(tracked: bool) -> None:
    """Campaigns whose teacher is off by an error of its own in all runs: they do not show it, its deviation does."""
    tracking = Tracking(TRACKING_RAD_S, 0.3, 0.0, WAVE_RAD_S) if tracked else None
    section = replace(fused(), agreement=None, tracking=tracking)
    section = replace(section, sigma=replace(section.sigma, reference_nm=0.0))
    runs = [
        run._replace(teacher_nm=np.full(len(run.raw_nm), 0.7))
        for run in runs_of_sensor(np.zeros(80), tracked)
    ]
    found = calibrated(runs[:60], section, RATED)
    shares = []
    for off in np.random.default_rng(15).normal(0.0, 0.7, 200):
        for run in runs[60:62]:
            one = fused_errors(run, found)
            error = (one.undelayed_nm if tracked else one.error_nm) - off
            shares.append(inside(one, error, found.sigma.scale, 0.3**2 if tracked else 0.0))
    assert np.mean(shares) == pytest.approx(COVERAGE, abs=0.06)


def test_where_sigma_is_widened_hides_no_error_elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    """Half of the samples are held by what widens sigma: 80 % of the others would do for 90 % of all, 85 % are asked for."""
    rng, n = np.random.default_rng(16), 4000
    one, none = np.ones(n), np.zeros(n)

    def errors(_: PathResiduals, *__: object, **___: object) -> FusedErrors:
        more = np.where(np.arange(n) % 2 == 0, 100.0, 0.0)
        return FusedErrors(rng.normal(size=n), none, one, more, one, np.zeros(n, np.intp))

    monkeypatch.setattr(calibration, "fused_errors", errors)
    section = replace(fused(), agreement=None, zeros=None)
    section = replace(section, sigma=replace(section.sigma, reference_nm=0.0))
    found = calibrated(runs_of_sensor(np.zeros(20)), section, RATED)
    assert found.sigma.scale[0] == pytest.approx(1.4395 / GAUSS, rel=0.02)


def test_where_offsets_differ_from_day_to_day_runs_are_covered_more_for_other_motions() -> None:
    days = runs_of_days(0.4)
    section = replace(fused(), agreement=None)
    section = replace(section, zeros=fit_zeros(days, section, RATED))
    found = calibrated(days, section, RATED)
    assert found.zeros is not None
    for part, scale, coverage in (
        (found, found.zeros.scale, COVERAGE + OTHER_MOTIONS_LEARNED),
        (replace(found, zeros=None), found.sigma.scale, COVERAGE + OTHER_MOTIONS),
    ):
        errors = [fused_errors(run, part, RATED, track_zeros=part.zeros is not None) for run in days]
        shares = [inside(run, run.error_nm, scale) for run in errors]
        assert np.mean(shares) == pytest.approx(coverage, abs=0.015)
