"""Torsion calibration on runs made from a known torsion and on emulated benches; its torque is the estimator's."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.estimator import observe_run
from jtqd.estimator.joint import Joint, Torsion, Tracking
from jtqd.estimator.observer import slipped
from jtqd.estimator.run import JointColumns
from jtqd.estimator.settings import TORSION_BANDWIDTH_RAD_S, EstimatorSettings
from jtqd.models.files import load_joint, shipped
from jtqd.sim_can.emulated_run import JointCommand, emulate_run
from jtqd.sim_can.plant_source import AnyPlant, load_any_plant
from jtqd.sysid.fit.signals import RunSignals, run_signals
from jtqd.sysid.fit.torsion import (
    TRACKING_RAD_S,
    WAVE_RAD_S,
    WORTH,
    TorsionError,
    extended,
    fit_torsion,
    local_stiffness,
    low_pass_torque,
    torsion_torque,
    tracked_torque,
)
from tests.estimator.estimator_helpers import joint1
from tests.estimator.fused_helpers import TORSION, fused_joint, twisted
from tests.sim_can.towing.benches import TYPICAL
from tests.sysid.fit.fused_signals import (
    FUSED,
    STIFF,
    Nuisance,
    made_run,
    one_way,
    smooth_loss,
    with_torsion,
)
from validation.goals.sources import true_torsion


def runs_of(seed: int, count: int = 6) -> list[RunSignals]:
    offsets = np.random.default_rng(seed).uniform(-0.3, 0.3, count)
    offsets -= offsets.mean()
    return [
        made_run(seed * 50 + k, smooth_loss(), STIFF, Nuisance(each))
        for k, each in enumerate(offsets.tolist())
    ]


def deflection_of(run: RunSignals) -> FloatArray:
    """What `made_run` bent the spring of STIFF by."""
    pairs = np.column_stack((STIFF.cos_rad, STIFF.sin_rad)).ravel()
    d: FloatArray = run.torsion_rad - STIFF.zero_rad - run.seen.waves @ pairs
    return d


@pytest.mark.parametrize("seed", [11, 12, 13])
def test_a_known_torsion_comes_back(seed: int) -> None:
    """Stiffness to 0.3 %, offset to 0.05 Nm, kinematic error to 0.5 urad, through the sensor's offset of each run."""
    runs = runs_of(seed)
    found = fit_torsion(runs)
    assert found.stiffness_nm_per_rad == pytest.approx(11000.0, rel=0.003)
    assert found.cubic_nm_per_rad3 == pytest.approx(1.5e8, rel=0.1)
    assert found.zero_rad == pytest.approx(-3e-5, abs=0.05 / 11000.0)
    assert found.orders_per_motor_rev == (2.0, 4.0)
    assert found.cos_rad == pytest.approx((4e-5, -5e-6), abs=5e-7)
    assert found.sin_rad == pytest.approx((-2e-5, 8e-6), abs=5e-7)
    assert found.hysteresis_nm == 0.0
    one = fit_torsion([one_way(run, 1.0) for run in runs])
    assert one.stiffness_nm_per_rad == pytest.approx(11000.0, rel=0.01)


def test_its_torque_is_the_sensors() -> None:
    runs = runs_of(14)
    found = fit_torsion(runs)
    for run in runs:
        off = torsion_torque(found, run)[0] - run.sensor_nm
        assert np.std(off) < 0.08
        assert abs(np.mean(off)) < 0.35  # the run's own offset of the sensor stays


def test_what_gives_no_torsion_is_refused() -> None:
    run = made_run(16, smooth_loss())
    rigid = with_torsion(run, np.zeros_like(run.sensor_nm))
    for runs in ([rigid], [rigid, rigid], [replace(run, moving=run.standing)], []):
        with pytest.raises(TorsionError, match="found no torsion between motor and link encoder"):
            fit_torsion(runs)
    with pytest.raises(TorsionError, match=r"found a stiffness of -1.*e\+04 Nm/rad, expected one > 0"):
        fit_torsion([with_torsion(run, -run.torsion_rad)])
    few = replace(run, moving=run.moving & (np.arange(len(run.sensor_nm)) < 300))
    with pytest.raises(TorsionError, match="found 60 moving samples, expected at least 90"):
        fit_torsion([few])


def test_hysteresis_is_found_with_its_half_width() -> None:
    """A loop of +-0.6 Nm over 0.1 mrad: half width to a tenth, stiffness not bent by it."""
    runs = []
    for seed in range(4):
        run = made_run(seed, smooth_loss(), noise_nm=0.02)
        loop = 0.6 * slipped(deflection_of(run), 1e-4)[0]
        runs.append(with_torsion(run, run.torsion_rad, run.sensor_nm + loop))
    found = fit_torsion(runs)
    assert found.hysteresis_nm == pytest.approx(0.6, rel=0.1)
    assert found.hysteresis_travel_rad == 1e-4
    assert found.stiffness_nm_per_rad == pytest.approx(STIFF.stiffness_nm_per_rad, rel=0.01)


def test_a_damping_is_found_and_not_taken_for_hysteresis() -> None:
    """8 Nms/rad through ripple of the torsion at 150 rad/s, beside a loop of +-0.4 Nm over 0.1 mrad; none where none is."""
    runs, still = [], []
    for seed in range(4):
        run = made_run(seed, smooth_loss(), noise_nm=0.02)
        run = with_torsion(run, run.torsion_rad + 1e-4 * np.sin(150.0 * np.cumsum(run.seen.dt_s)))
        d = deflection_of(run)
        sensor = 11000.0 * d + 1.5e8 * d**3 + 0.4 * slipped(d, 1e-4)[0]
        still.append(with_torsion(run, run.torsion_rad, sensor))
        runs.append(with_torsion(run, run.torsion_rad, sensor + 8.0 * np.gradient(d, 1e-3)))
    found = fit_torsion(runs)
    assert found.damping_nms_per_rad == pytest.approx(8.0, rel=0.1)
    assert found.hysteresis_travel_rad == 1e-4
    assert found.hysteresis_nm == pytest.approx(0.4, rel=0.1)
    assert fit_torsion(still).damping_nms_per_rad < 1.0


def test_slip_follows_saturates_and_comes_back() -> None:
    """Between bounds from -1 to 1 at first, that meet after twice the travel one way; a gap begins again."""
    d = np.array([0.0, 0.5, 1.0, 3.0, 2.5, np.nan, 2.0, 0.0, 0.25])
    middle, width = slipped(d, 1.0)
    assert middle.tolist() == [0.0, 0.25, 0.5, 1.0, 0.5, 0.0, 0.0, -1.0, -0.75]
    assert width.tolist() == [1.0, 0.75, 0.5, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0]


# The torque of a torsion is the estimator's ------------------------------------------------------------

RICH = replace(
    TORSION,
    cubic_nm_per_rad3=0.0,
    orders_per_motor_rev=(2.0, 4.0, 1.0),
    cos_rad=(*TORSION.cos_rad, 2e-5),
    sin_rad=(*TORSION.sin_rad, -1e-5),
    link_orders_per_rev=(1.0, 2.0),
    link_cos_rad=(3e-5, 1e-5),
    link_sin_rad=(-1e-5, 2e-5),
    hardening_rad=(2e-4, 8e-4),
    hardening_nm_per_rad=(2000.0, -700.0),
    hysteresis_nm=0.3,
    slips_nm=(0.2, 0.1),
    slips_travel_rad=(3e-5, 4e-4),
)
SLIPPING = replace(TORSION, hysteresis_nm=0.6, damping_nms_per_rad=7.0)


def twisted_run(joint: Joint, dt_s: float | None = None) -> tuple[RunSignals, tuple[FloatArray, ...]]:
    """A run of a joint in motion with torsion, and the inputs of the observer."""
    m = twisted(25)
    dt, current, motor, velocity, link, *more = m.arrays()
    if dt_s is not None:
        dt = np.full(len(dt), dt_s)
    columns = JointColumns(
        current_a=current,
        motor_position_rad=motor,
        motor_velocity_rad_s=velocity,
        link_position_rad=link,
        torque_nm=np.zeros(len(dt)),
    )
    time_s = np.cumsum(dt) - dt[0]
    return run_signals("a", joint, FUSED, time_s, columns), (
        np.diff(time_s, prepend=time_s[0]), current, motor, velocity, link, *more
    )  # fmt: skip


@pytest.mark.parametrize("torsion", [SLIPPING, RICH], ids=["plain", "with every extension"])
def test_torsion_torque_is_the_observers(torsion: Torsion) -> None:
    run, inputs = twisted_run(joint1())
    torque, width = torsion_torque(torsion, run)
    seen = observe_run(joint1(), FUSED, torsion, *inputs)
    settled = np.flatnonzero(width == 0.0)[0]
    assert 10 < settled < 2000
    assert seen.open_nm[settled:] == pytest.approx(0.0, abs=1e-12)
    assert torque[settled:] == pytest.approx(seen.torsion_nm[settled:], abs=1e-9)
    if torsion is RICH:
        plain = observe_run(joint1(), FUSED, TORSION, *inputs)
        assert np.abs(seen.torsion_nm - plain.torsion_nm)[settled:].max() > 0.5


@pytest.mark.parametrize("tracked", [True, False])
def test_the_torque_without_delay_is_the_estimators(tracked: bool) -> None:
    """Tracked, and through the low pass of new configurations."""
    torsion = replace(RICH, hysteresis_nm=0.7, slips_nm=(), slips_travel_rad=(), damping_nms_per_rad=9.0)
    joint = fused_joint(3, torsion)
    assert joint.fused is not None
    tracking = Tracking(TRACKING_RAD_S, 0.1, 0.1, WAVE_RAD_S)
    joint = replace(joint, fused=replace(joint.fused, tracking=tracking))
    run, inputs = twisted_run(joint, 0.001)
    settings = EstimatorSettings(method="fused", track_torsion=True)
    if not tracked:
        settings = EstimatorSettings(method="fused", torsion_bandwidth_rad_s=TORSION_BANDWIDTH_RAD_S)
    found, behind = (
        tracked_torque(torsion, run) if tracked else (low_pass_torque(torsion, run), np.zeros(len(inputs[0])))
    )
    seen = observe_run(joint, settings, torsion, *inputs)
    np.testing.assert_allclose(found[300:], (seen.torsion_nm + seen.ahead_nm)[300:], atol=1e-6)
    stiffness = local_stiffness(torsion, (seen.torsion_nm + seen.ahead_nm) / torsion.stiffness_nm_per_rad)
    np.testing.assert_allclose(behind[300:], (stiffness**2 * seen.behind_rad2)[300:], rtol=0.4, atol=1e-9)
    assert bool(behind.any()) == tracked


# Extensions --------------------------------------------------------------------------------------------


def signals(bench: AnyPlant, days: range) -> list[RunSignals]:
    joint = load_joint(shipped("joint1.yaml"))
    runs = []
    for day in days:
        f = 0.17 + 0.03 * (day % 7)
        commands = (
            JointCommand.velocity(
                lambda t, f=f: 1.4 * math.sin(2 * math.pi * f * t) + 0.7 * math.sin(9.1 * f * t)
            ),
            JointCommand.current(
                lambda t, f=f: 4.5 * math.sin(5.3 * f * t) * math.sin(2.7 * f * t) * min(t, 1.0)
            ),
        )
        table = emulate_run(bench, commands, 8.0, seed=3, day=day)
        runs.append(run_signals(f"day {day}", joint, FUSED, table.time_s, table.joints[1]))
    return runs


def error(torsion: Torsion, runs: list[RunSignals]) -> float:
    """RMS [Nm] against the sensor, each run less its own offset."""
    parts = [(torsion_torque(torsion, run)[0] - run.sensor_nm)[run.moving] for run in runs]
    return float(np.sqrt(np.mean(np.concatenate([part - part.mean() for part in parts]) ** 2)))


def has_extensions(torsion: Torsion) -> bool:
    parts = (torsion.link_orders_per_rev, torsion.hardening_rad, torsion.slips_nm)
    return any(map(len, parts)) or torsion.orders_per_motor_rev != (2.0, 4.0)


@pytest.fixture(scope="module")
def typical() -> tuple[Torsion, list[RunSignals]]:
    """The torsion of a bench with another spring, slips and encoder errors; its runs."""
    runs = signals(TYPICAL, range(12))
    return fit_torsion(runs), runs


def test_on_a_bench_with_another_spring_the_error_of_other_days_falls_by_half(
    typical: tuple[Torsion, list[RunSignals]],
) -> None:
    found, runs = typical
    held_out = signals(TYPICAL, range(20, 24))
    plain = fit_torsion(runs[:7])  # too few runs for extensions
    assert not has_extensions(plain)
    assert error(found, held_out) < 0.5 * error(plain, held_out)
    assert extended(held_out, TORSION) is TORSION
    assert 0.0 < WORTH < 0.2


def test_spring_slips_and_encoder_errors_are_found_as_they_are(
    typical: tuple[Torsion, list[RunSignals]],
) -> None:
    found, law = typical[0], TYPICAL.joints[0]
    slip = sum(each.torque_nm for each in law.gear.slips)
    k, corner = law.gear.stiffness_nm_per_rad, law.gear.corners_nm
    for torque in (15.0, 30.0):  # below, the slips are not yet all the way
        d = np.linspace(0.0, 4e-3, 4001)
        spring = d * (found.stiffness_nm_per_rad + found.cubic_nm_per_rad3 * d * d)
        for knot, stiffness in zip(found.hardening_rad, found.hardening_nm_per_rad, strict=True):
            spring += stiffness * np.maximum(d - knot, 0.0)
        spring += sum(found.slips_nm) + found.hysteresis_nm  # the slips hold on top of the spring
        true = torque - slip
        parts = min(true, corner[0]), max(min(true, corner[1]) - corner[0], 0.0), max(true - corner[1], 0.0)
        twist = sum(part / each for part, each in zip(parts, k, strict=True))
        assert float(np.interp(torque, spring, d)) == pytest.approx(twist, rel=0.03)
    assert sum(found.slips_nm) == pytest.approx(slip, rel=0.35)
    first = law.measurement.link_errors[0]
    # the deflection has the link encoder's error with the other sign
    c, s = -math.cos(first.phase_rad), math.sin(first.phase_rad)
    expected = first.amplitude_rad * c, first.amplitude_rad * s
    assert (found.link_cos_rad[0], found.link_sin_rad[0]) == pytest.approx(expected, abs=1e-5)


def test_waves_of_the_motor_turn_are_found_as_they_are_although_the_spring_hardens(
    typical: tuple[Torsion, list[RunSignals]],
) -> None:
    """With one stiffness for all deflections those of order 1 are too large by 3 urad."""
    found, true = typical[0], true_torsion(TYPICAL.joints[0])
    for order in (1.0, 2.0):
        (c, s), expected = (
            (each.cos_rad[at], each.sin_rad[at])
            for each in (found, true)
            for at in (each.orders_per_motor_rev.index(order),)
        )
        assert (c, s) == pytest.approx(expected, abs=5e-7)


def test_on_a_bench_without_them_nothing_is_added() -> None:
    runs = signals(load_any_plant(shipped("campaign_plant.yaml")), range(10))
    assert not has_extensions(fit_torsion(runs))


def test_file_keeps_them_and_refuses_what_does_not_fit() -> None:
    mapping = load_joint(shipped("trained/joint1.yaml")).to_mapping()
    assert "slips_nm" not in mapping["fused"]["torsion"]
    mapping["fused"]["torsion"] |= {"slips_nm": [0.2, 0.1], "slips_travel_rad": [3e-5, 4e-4]}
    joint = Joint.from_mapping(mapping, "j.yaml")
    assert Joint.from_mapping(joint.to_mapping(), "j.yaml") == joint
    for change, expected in (
        ({"slips_nm": [0.2]}, "slips_travel_rad"),
        ({"slips_nm": [0.2, -0.1]}, "slips_nm"),
        ({"hardening_rad": [1e-3]}, "hardening_nm_per_rad"),
    ):
        broken = {
            **mapping,
            "fused": {**mapping["fused"], "torsion": {**mapping["fused"]["torsion"], **change}},
        }
        with pytest.raises(ConfigError, match=f"j.yaml: key 'fused.torsion.{expected}'"):
            Joint.from_mapping(broken, "j.yaml")
