"""Fit of the torsion on runs made from a known one, and what the fits see of a run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from jtqd.estimator.estimator import observe_run
from jtqd.estimator.joint import Torsion
from jtqd.estimator.observer import first_order_hold, low_pass, slipped
from jtqd.estimator.run import JointColumns
from jtqd.estimator.status import STANDSTILL
from jtqd.sysid.fit.signals import UNIT_TORSION, RunSignals, run_signals
from jtqd.sysid.fit.torsion import TorsionError, fit_torsion, torsion_torque
from tests.estimator.estimator_helpers import joint1
from tests.estimator.fused_helpers import TORSION, twisted
from tests.sysid.fit.fused_signals import FUSED, STIFF, Nuisance, made_run, one_way, smooth_loss


def runs_of(seed: int, count: int = 6, torsion: Torsion = STIFF) -> list[RunSignals]:
    zeros = np.random.default_rng(seed).uniform(-0.3, 0.3, count)
    zeros -= zeros.mean()
    return [
        made_run(seed * 50 + k, smooth_loss(), torsion, Nuisance(zero))
        for k, zero in enumerate(zeros.tolist())
    ]


@pytest.mark.parametrize("seed", [11, 12, 13])
def test_a_known_torsion_comes_back(seed: int) -> None:
    """Stiffness to 0.3 %, zero to 0.05 Nm, kinematic error to 0.5 urad, through the sensor zero of each run."""
    found = fit_torsion(runs_of(seed))
    assert found.stiffness_nm_per_rad == pytest.approx(11000.0, rel=0.003)
    assert found.cubic_nm_per_rad3 == pytest.approx(1.5e8, rel=0.1)
    assert found.zero_rad == pytest.approx(-3e-5, abs=0.05 / 11000.0)
    assert found.orders_per_motor_rev == (2.0, 4.0)
    assert found.cos_rad == pytest.approx((4e-5, -5e-6), abs=5e-7)
    assert found.sin_rad == pytest.approx((-2e-5, 8e-6), abs=5e-7)


def test_its_torque_is_the_sensor_s() -> None:
    runs = runs_of(14)
    found = fit_torsion(runs)
    for run in runs:
        off = torsion_torque(found, run)[0] - run.sensor_nm
        assert np.std(off) < 0.08
        assert abs(np.mean(off)) < 0.35  # the run's own zero of the sensor stays


def test_torque_of_other_orders_is_refused_where_positions_are_not_known() -> None:
    run = runs_of(15, 1)[0]
    with pytest.raises(
        ValueError, match=r"found a torsion of order 6, expected one of 2 and 4: no positions"
    ):
        torsion_torque(replace(STIFF, orders_per_motor_rev=(2.0, 6.0)), run)


def test_what_gives_no_torsion_is_refused() -> None:
    run = made_run(16, smooth_loss())
    rigid = replace(run, seen=replace(run.seen, torsion_nm=np.zeros_like(run.sensor_nm)))
    for runs in ([rigid], [rigid, rigid], [replace(run, moving=run.standing)], []):
        with pytest.raises(TorsionError, match="found no torsion between motor and link encoder"):
            fit_torsion(runs)
    turned = replace(run, seen=replace(run.seen, torsion_nm=-run.seen.torsion_nm))
    with pytest.raises(TorsionError, match=r"found a stiffness of -1.*e\+04 Nm/rad, expected one > 0"):
        fit_torsion([turned])
    few = replace(run, moving=run.moving & (np.arange(len(run.sensor_nm)) < 300))
    with pytest.raises(TorsionError, match="found 60 moving samples, expected at least 90"):
        fit_torsion([few])


def test_one_direction_is_enough_for_a_torsion() -> None:
    found = fit_torsion([one_way(run, 1.0) for run in runs_of(17)])
    assert found.stiffness_nm_per_rad == pytest.approx(11000.0, rel=0.01)


# ---- what the fits see of a run


def columns(seed: int, count: int = 3000) -> tuple[np.ndarray, JointColumns]:
    m = twisted(seed, count)
    torque = 10.0 * np.sin(3.0 * np.cumsum(m.dt_s))
    i, q, w, link = m.arrays()[1:]
    return np.cumsum(m.dt_s), JointColumns(i, q, w, link, torque_nm=torque)


def test_the_sensor_gets_the_age_of_the_estimate() -> None:
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
    assert one.motor_position_rad is not None
    assert one.link_position_rad is not None
    twist = one.motor_position_rad / 100.0 - one.link_position_rad
    seen = low_pass(twist, np.diff(time, prepend=time[0]), 200.0)
    running = np.isfinite(run.seen.torsion_nm)
    assert run.seen.torsion_nm[running] == pytest.approx(seen[running], abs=2e-6)
    assert UNIT_TORSION.stiffness_nm_per_rad == 1.0
    warm = run_signals(
        "b", joint1(), FUSED, time, replace(one, temperature_c=np.where(time < 1, np.nan, 31.0))
    )
    assert warm.temperature_c == 31.0


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


def test_hysteresis_is_found_with_its_half_width() -> None:
    """A loop of +-0.6 Nm over 0.1 mrad: half width to a tenth, stiffness not bent by it; none where there is none."""
    true = replace(STIFF, hysteresis_nm=0.6, hysteresis_travel_rad=1e-4)
    runs = []
    for seed in range(4):
        run = made_run(seed, smooth_loss(), noise_nm=0.02)
        pairs = np.column_stack((STIFF.cos_rad, STIFF.sin_rad)).ravel()
        d = run.seen.torsion_nm - STIFF.zero_rad - run.seen.waves @ pairs
        runs.append(replace(run, sensor_nm=run.sensor_nm + 0.6 * slipped(d, 1e-4)[0]))
    found = fit_torsion(runs)
    assert found.hysteresis_nm == pytest.approx(0.6, rel=0.1)
    assert found.hysteresis_travel_rad == 1e-4
    assert found.stiffness_nm_per_rad == pytest.approx(true.stiffness_nm_per_rad, rel=0.01)
    assert fit_torsion([made_run(seed, smooth_loss()) for seed in range(4)]).hysteresis_nm == 0.0


def test_a_damping_is_found_and_not_taken_for_hysteresis() -> None:
    """8 Nms/rad through ripple of the torsion at 150 rad/s, beside a loop of +-0.4 Nm over 0.1 mrad; none where none is."""
    runs, still = [], []
    for seed in range(4):
        run = made_run(seed, smooth_loss(), noise_nm=0.02)
        t = np.cumsum(run.seen.dt_s)
        seen = replace(run.seen, torsion_nm=run.seen.torsion_nm + 1e-4 * np.sin(150.0 * t))
        pairs = np.column_stack((STIFF.cos_rad, STIFF.sin_rad)).ravel()
        d = seen.torsion_nm - STIFF.zero_rad - seen.waves @ pairs
        rate = np.gradient(d, 1e-3)
        sensor = 11000.0 * d + 1.5e8 * d**3 + 0.4 * slipped(d, 1e-4)[0]
        still.append(replace(run, seen=seen, sensor_nm=sensor))
        runs.append(replace(run, seen=seen, sensor_nm=sensor + 8.0 * rate))
    found = fit_torsion(runs)
    assert found.damping_nms_per_rad == pytest.approx(8.0, rel=0.1)
    assert found.hysteresis_travel_rad == 1e-4
    assert found.hysteresis_nm == pytest.approx(0.4, rel=0.1)
    assert fit_torsion(still).damping_nms_per_rad < 1.0


def test_slip_follows_saturates_and_comes_back() -> None:
    """Between bounds from -1 to 1 at first, that meet after twice the travel one way; a gap begins anew."""
    d = np.array([0.0, 0.5, 1.0, 3.0, 2.5, np.nan, 2.0, 0.0, 0.25])
    middle, width = slipped(d, 1.0)
    assert middle.tolist() == [0.0, 0.25, 0.5, 1.0, 0.5, 0.0, 0.0, -1.0, -0.75]
    assert width.tolist() == [1.0, 0.75, 0.5, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0]


def test_torsion_torque_is_the_observer_s() -> None:
    """Of observed signals, through the filter, its offsets, cube, damping and slip: as step by step."""
    torsion = replace(TORSION, hysteresis_nm=0.6, damping_nms_per_rad=7.0)
    m = twisted(25)
    raw = observe_run(joint1(), FUSED, UNIT_TORSION, *m.arrays())
    run = RunSignals("a", raw, np.zeros(3000), np.ones(3000, bool), np.zeros(3000, bool))
    torque, width = torsion_torque(torsion, run)
    seen = observe_run(joint1(), FUSED, torsion, *m.arrays())
    assert torque[2:] == pytest.approx(seen.torsion_nm[2:], abs=0.05)  # the start counts a step later
    settled = np.flatnonzero(width == 0.0)[0]
    assert 10 < settled < 1500
    assert seen.open_nm[settled:] == pytest.approx(0.0, abs=1e-12)
    assert torque[settled:] == pytest.approx(seen.torsion_nm[settled:], abs=1e-9)
