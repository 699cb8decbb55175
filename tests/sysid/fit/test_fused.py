"""Section `fused` of a joint file: the whole fit, on runs made from known joints and on the emulated bench."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest

from jtqd.estimator import status as st
from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.estimator.estimator import FusedEstimator, estimate_columns
from jtqd.estimator.fusion import GAUSS
from jtqd.estimator.joint import AdditiveLoss, Friction, Joint, Tracking
from jtqd.estimator.losses import AdditiveLossModel
from jtqd.estimator.observer import low_pass
from jtqd.estimator.settings import EstimatorSettings, bandwidth_of, recommended
from jtqd.models.files import load_joint, shipped
from jtqd.sim_can.emulated_run import EmulatedRun, JointCommand, Push, emulate, emulate_run
from jtqd.sim_can.plant import joint_friction
from jtqd.sim_can.plant_file import Day
from jtqd.sysid.fit import fused as fits
from jtqd.sysid.fit.calibration import PathResiduals, calibrated, fused_errors, path_residuals
from jtqd.sysid.fit.fused import FOLDS, FusedFit, fit_fused, folds
from jtqd.sysid.fit.losses import PER_K_PRIOR, fit_loss
from jtqd.sysid.fit.signals import RunSignals, run_signals
from jtqd.sysid.fit.torsion import TRACKING_RAD_S, WAVE_RAD_S, fit_torsion
from tests.estimator.fused_helpers import fused_joint
from tests.estimator.test_torsion_filters import lossless
from tests.sysid.fit.fused_signals import (
    FUSED,
    STIFF,
    Nuisance,
    campaign_plant,
    emulated,
    made_run,
    one_way,
    smooth_loss,
    with_torsion,
)

MADE = replace(fused_joint(), friction=Friction(3.0, 2.0, 0.8, 0.05))


@pytest.mark.parametrize("count", [2, 3, 4, 5, 8, 17])
def test_folds_never_split_a_run_and_hold_out_each_once(count: int) -> None:
    one = made_run(1, smooth_loss(), count=300)
    runs = [replace(one, name=f"run {k}") for k in range(count)]
    parts = list(folds(runs))
    assert len(parts) == min(FOLDS, count)
    for known, held_out in parts:
        names = [run.name for run in known]
        assert names
        assert sorted(names + [runs[n].name for n in held_out]) == sorted(run.name for run in runs)
    assert sorted(n for _, held_out in parts for n in held_out) == list(range(count))


# Runs made from a known joint --------------------------------------------------------------------------


DRAWN = np.random.default_rng(41).uniform(-1.0, 1.0, (14, 3)).tolist()
OFFSETS_NM = [0.3 * (a - float(np.mean([b for b, _, _ in DRAWN]))) for a, _, _ in DRAWN]
"""Of the sensor, by run."""


@pytest.fixture(scope="module")
def runs() -> list[RunSignals]:
    return [
        made_run(4100 + k, smooth_loss(), STIFF, Nuisance(offset, 0.2 * b, 25.0 + 5.0 * c), noise_nm=0.1)
        for k, (offset, (_, b, c)) in enumerate(zip(OFFSETS_NM, DRAWN, strict=True))
    ]


@pytest.fixture(scope="module")
def fit(runs: list[RunSignals]) -> FusedFit:
    return fit_fused(runs, MADE)


def test_the_section_is_whole_and_can_be_written(fit: FusedFit) -> None:
    joint = replace(fused_joint(), fused=fit.fused)
    assert Joint.from_mapping(joint.to_mapping(), "x").fused == fit.fused
    assert fit.fused.torsion is not None
    assert fit.fused.torsion.stiffness_nm_per_rad == pytest.approx(11000.0, rel=0.01)
    assert fit.fused.loss == fit.loss.loss


def test_held_out_runs_are_as_wrong_as_sigma(runs: list[RunSignals], fit: FusedFit) -> None:
    """Offsets of +-0.3 Nm are 0.17 Nm RMS, noise 0.1; fits without the run hold the torque, not the sensor, in 90 %."""
    assert len(fit.held_out_rmse_nm) == len(runs)
    assert fit.fused.sigma.reference_nm == pytest.approx(0.17, abs=0.06)
    assert 0.15 < np.sqrt(np.mean(np.square(fit.held_out_rmse_nm))) < 0.25
    held_out: dict[int, PathResiduals] = {}
    for known, indices in folds(runs):
        loss, torsion = fit_loss(known, MADE.friction).loss, fit_torsion(known)
        held_out |= {n: path_residuals(runs[n], loss, torsion) for n in indices}
    parts = [held_out[n] for n in range(len(runs))]
    plain = replace(fit.fused, agreement=None, tracking=None, zeros=None)
    plain = calibrated(parts, plain, MADE.rated_torque_nm)
    torque, sensor = [], []
    for part, offset, rmse in zip(parts, OFFSETS_NM, fit.held_out_rmse_nm, strict=True):
        one = fused_errors(part, plain)
        assert np.sqrt(np.mean(one.error_nm**2)) == pytest.approx(rmse, rel=1e-6)
        scale = np.array(plain.sigma.scale)[one.quadrant]
        wide = GAUSS * np.hypot(scale * one.spread_nm, np.sqrt(one.more_nm2))
        torque.append(np.mean(np.abs(one.error_nm - offset) <= wide))
        sensor.append(np.mean(np.abs(one.error_nm) <= wide))
    assert np.mean(torque) == pytest.approx(0.94, abs=0.03)  # the mean of 14 offsets is in doubt
    assert np.mean(sensor) < 0.8


def test_one_encoder_has_the_current_path_alone(runs: list[RunSignals]) -> None:
    """No torsion; the offset of the sensor cannot be separated and stays in sigma, so that the interval holds with it."""
    blind = [with_torsion(run, np.full_like(run.sensor_nm, np.nan)) for run in runs]
    found = fit_fused(blind, MADE, two_encoders=False)
    assert found.fused.torsion is None
    assert found.fused.sigma.reference_nm == 0.0
    inside = []
    for known, indices in folds(blind):
        loss = fit_loss(known, MADE.friction).loss
        for n in indices:
            parts = path_residuals(blind[n], loss, None)
            one = fused_errors(parts, found.fused)
            assert np.array_equal(one.error_nm, parts.current_error_nm)
            scale = np.array(found.fused.sigma.scale)[one.quadrant]
            inside.append(np.mean(np.abs(one.error_nm) <= GAUSS * scale * one.spread_nm))
    assert np.mean(inside) == pytest.approx(0.9, abs=0.03)
    joint = replace(fused_joint(), fused=found.fused)
    assert Joint.from_mapping(joint.to_mapping(), "x").fused == found.fused


def test_runs_without_motion_are_left_out(runs: list[RunSignals]) -> None:
    still = replace(runs[0], moving=runs[0].standing)
    assert len(fit_fused([*runs[:6], still], MADE).held_out_rmse_nm) == 6


@pytest.mark.parametrize(
    ("change", "error"),
    [
        (lambda runs: runs[:5], "found 5 runs, expected at least 6: standard deviations need held-out"),
        (lambda runs: [one_way(run, 1.0) for run in runs], "found no motion in negative direction"),
        (
            lambda runs: [with_torsion(run, 0.0 * run.sensor_nm) for run in runs],
            "found no torsion between motor and link encoder",
        ),
    ],
)
def test_what_cannot_be_fitted_is_refused(
    runs: list[RunSignals], change: Callable[[list[RunSignals]], list[RunSignals]], error: str
) -> None:
    with pytest.raises(ValueError, match=error):
        fit_fused(change(runs), MADE)


def test_what_follows_tracking_uses_the_tracked_torsion(monkeypatch: pytest.MonkeyPatch) -> None:
    """Offsets, agreement and calibration; without the section the torsion of the fit's own filter."""
    joint = lossless(0.3, 0.3)
    assert joint.fused is not None
    none = np.zeros(400)
    parts = (none + 5.0, none + 1.0, none, none + 5.2, none, none + 0.1, none + 0.2)
    made = PathResiduals(*parts, tracked_nm=none + 0.6, delayed_nm=none + 0.7, low_pass_nm=none)
    loss = SimpleNamespace(loss=joint.fused.loss)
    for section in (Tracking(TRACKING_RAD_S, 0.1, 0.1, WAVE_RAD_S), None):
        seen: list[PathResiduals] = []

        def taking(runs: list[PathResiduals], *_: object, to: list[PathResiduals] = seen) -> None:
            to.extend(runs)

        replacements = {
            "_held_out": lambda *_, **__: ([made] * 6, []),
            "fit_tracking": lambda *_, made=section: made,
            "fit_standstill": lambda *_: None,
            "fit_loss": lambda *_: loss,
            "fit_torsion": lambda *_: joint.fused.torsion,  # type: ignore[union-attr]
            "fit_envelope": lambda *_: None,
            "fit_zeros": taking,
            "fit_agreement": taking,
            "calibrated": taking,
        }
        for name, function in replacements.items():
            monkeypatch.setattr(fits, name, function)
        fits.fit_fused([None] * 6, joint)  # type: ignore[list-item]
        assert len(seen) == 18
        for run in seen:
            assert np.array_equal(run.torsion_error_nm, made.delayed_nm if section else made.torsion_error_nm)
            np.testing.assert_allclose(run.torsion_nm - run.torsion_error_nm, 5.0)  # the sensor


# The emulated bench ------------------------------------------------------------------------------------

SPEEDS = (0.2, 0.3, 0.5, 0.8, 1.2, 1.6, 2.0, 2.5)
TORQUES = (-26, -22, -18, -14, -10, -7, -4, -2, 0, 2, 4, 7, 10, 14, 18, 22, 26)
Runs = tuple[list[RunSignals], list[RunSignals]]


def joint(number: int) -> Joint:
    return load_joint(shipped(f"joint{number}.yaml"))


@pytest.fixture(scope="module")
def nominal() -> Runs:
    """Both joints in 8 runs of 8 s of the campaign's bench, all of the nominal day."""
    pairs = [emulated(1000 + k, 8.0) for k in range(8)]
    return [one for one, _ in pairs], [two for _, two in pairs]


@pytest.fixture(scope="module")
def nominal_fit(nominal: Runs) -> FusedFit:
    return fit_fused(nominal[0], joint(1))


def off(loss: AdditiveLoss, number: int, runs: list[RunSignals]) -> np.ndarray:
    """Fitted loss less the plant's own friction law, on a grid of torque and speed, where there are data."""
    friction = joint_friction(campaign_plant().joints[number - 1])
    model = AdditiveLossModel(loss)
    raw = np.concatenate([run.seen.raw_nm[run.moving] for run in runs])
    v = np.concatenate([run.seen.velocity_rad_s[run.moving] for run in runs])
    found = []
    for speed in (*SPEEDS, *(-speed for speed in SPEEDS)):
        for torque in TORQUES:
            truth = math.copysign(friction(float(torque), speed), speed)
            near = (np.abs(raw - torque - truth) < 1.5) & (np.abs(v - speed) < 0.15)
            if np.sum(near) >= 100:
                value = model.loss(torque + truth, speed, model.thermal(25.0))[0]
                found.append(value - truth)
    return np.array(found)


@pytest.mark.parametrize("number", [1, 2])
def test_the_loss_of_the_plant_comes_back(nominal: Runs, number: int) -> None:
    """Of 3 to 15 Nm: 0.15 Nm RMS and 95 % of the grid within 0.3 Nm, through ripple, hysteresis and Stribeck peak.

    The worst points, within 0.9 Nm, lie where the plant's law has a kink: at no current, beside back driving.
    """
    runs = nominal[number - 1]
    fitted = fit_loss(runs, joint(number).friction)
    error = off(fitted.loss, number, runs)
    assert len(error) > 150
    assert np.sqrt(np.mean(error**2)) < 0.15
    assert np.quantile(np.abs(error), 0.95) < 0.3
    assert np.max(np.abs(error)) < 0.9
    assert fitted.residual_nm < 0.2


@pytest.mark.parametrize(("number", "phase"), [(1, 0.9), (2, 2.3)])
def test_stiffness_and_kinematic_error_of_the_plant_come_back(
    nominal: Runs, number: int, phase: float
) -> None:
    """Stiffness to 1 %; the plant adds A sin(2 theta + p) to the deflection, the estimator takes its error off."""
    torsion = fit_torsion(nominal[number - 1])
    assert torsion.stiffness_nm_per_rad == pytest.approx(joint(number).stiffness_nm_per_rad, rel=0.01)
    assert torsion.cos_rad[0] == pytest.approx(-4e-5 * math.sin(phase), abs=3e-6)
    assert torsion.sin_rad[0] == pytest.approx(-4e-5 * math.cos(phase), abs=3e-6)
    assert np.abs((torsion.cos_rad[1], torsion.sin_rad[1])).max() < 3e-6
    assert torsion.hysteresis_nm == pytest.approx(0.4, rel=0.2)
    assert torsion.hysteresis_travel_rad == pytest.approx(1e-4, rel=0.21)
    assert torsion.damping_nms_per_rad == pytest.approx(8.0, rel=0.3)
    assert abs(torsion.zero_rad) < 5e-6


def test_viscous_per_k_of_the_plant_lies_within_its_interval() -> None:
    """Days of 15 to 35 degC, each with offsets and viscous friction of its own; the plant's is 0.025 1/K."""
    rng = np.random.default_rng(7)
    runs: Runs = ([], [])
    for k, warmer in enumerate((-10.0, -7.0, -4.0, -1.0, 1.0, 4.0, 7.0, 10.0)):
        a, b, c, d, e = rng.uniform(-1.0, 1.0, 5).tolist()
        day = Day((0.1 * a, 0.1 * b), (warmer, -warmer), (1e-5 * c, 1e-5 * d), 0.3 * e)
        for joint_runs, run in zip(runs, emulated(2000 + k, 5.0, day), strict=True):
            joint_runs.append(run)
    for number, joint_runs in enumerate(runs, 1):
        fitted = fit_loss(joint_runs, joint(number).friction)
        assert fitted.loss.temperature_c == pytest.approx(25.0, abs=0.5)
        assert fitted.viscous_per_k_sigma < 0.65 * PER_K_PRIOR[1]
        assert abs(fitted.loss.viscous_per_k - 0.025) < 1.96 * fitted.viscous_per_k_sigma


@pytest.fixture(scope="module")
def fit_of_days() -> FusedFit:
    """Joint 1 in 12 runs of 6 s, each of a day of its own: only so is it known what a day changes."""
    return fit_fused([emulated(3000 + k, 6.0, day=100 + k)[0] for k in range(12)], joint(1))


class OfDay(NamedTuple):
    """Of one day: rms error and mean sigma in motion [Nm], share inside the 90 % interval, errors over sigma at rest [n]."""

    rms_nm: float
    sigma_nm: float
    inside: float
    standing: FloatArray


def other_days(fit: FusedFit, settings: EstimatorSettings, delay_rad_s: float | None = None) -> list[OfDay]:
    """Other motions, eight other days with their offsets and friction, against the true torque without the sensor's offset.

    delay_rad_s: of the low pass that the true torque is as old as; None: that of now.
    """
    ours, found = replace(joint(1), fused=fit.fused), []
    for day in range(8):
        motion = harmonic(1.2 + 0.2 * day, 0.4 + 0.05 * day, (3.0, -3.0, 1.5, -1.5)[day % 4])
        made = emulate(campaign_plant(), motion, 4.0, 55 + day, day=day)
        table = made.table
        run = estimate_columns(ours, settings, None, table.time_s, table.joints[1])
        true = made.joint_torque_nm[:, 0]
        assert np.ptp(true) > 15.0
        error = run.torque_nm - (true if delay_rad_s is None else low_pass(true, table.dt_s, delay_rad_s))
        moving = (run.status == st.VALID) & (table.time_s > 0.2)
        standing = (run.status == st.STANDSTILL) & (table.time_s > 0.2)
        found.append(
            OfDay(
                float(np.sqrt(np.mean(error[moving] ** 2))),
                float(np.mean(run.sigma_nm[moving])),
                float(np.mean(np.abs(error[moving]) <= 1.645 * run.sigma_nm[moving])),
                np.abs(error[standing]) / run.sigma_nm[standing],
            )
        )
    return found


def test_runs_of_other_days_are_as_wrong_as_sigma(fit_of_days: FusedFit) -> None:
    """Each day 0.5 Nm RMS of up to 30 Nm; 95 % of the standing samples are in their interval."""
    days = other_days(fit_of_days, FUSED, 200.0)
    assert max(day.rms_nm for day in days) < 0.5
    assert max(day.sigma_nm for day in days) < 0.5
    assert np.mean([np.mean(day.standing <= 1.0) for day in days]) > 0.95


@pytest.mark.xfail(
    strict=True, reason="0.798: sigma is calibrated for a torsion that is tracked, this one is not"
)
def test_without_a_tracking_filter_four_of_five_samples_are_in_the_90_percent_interval(
    fit_of_days: FusedFit,
) -> None:
    """Of a day on the average; eight days are few."""
    assert np.mean([day.inside for day in other_days(fit_of_days, FUSED, 200.0)]) > 0.8


def test_runs_of_other_days_in_service_are_as_wrong_as_sigma(fit_of_days: FusedFit) -> None:
    """Without delay 85 % are in the 90 % interval; where the joint stands sigma is a bound, and none is a tenth beyond."""
    days = other_days(fit_of_days, recommended("fused"))
    assert max(day.rms_nm for day in days) < 0.5
    assert np.mean([day.sigma_nm for day in days]) < 0.25
    assert np.mean([day.inside for day in days]) > 0.85
    assert max(day.standing.max() for day in days) < 1.1


# Reversal ----------------------------------------------------------------------------------------------


def harmonic(speed: float, hz: float, current_a: float) -> tuple[JointCommand, JointCommand]:
    """Joint 1 to and fro at up to `speed` [rad/s], joint 2 with a constant current."""
    velocity = JointCommand.velocity(lambda t: min(2.0 * t, 1.0) * speed * math.sin(6.2832 * hz * t))
    return velocity, JointCommand.current(lambda t: min(2.0 * t, 1.0) * current_a)


@pytest.mark.parametrize("current_a", [0.0, 2.0, 4.0, -3.0])
@pytest.mark.parametrize(("speed", "hz"), [(0.3, 0.25), (0.6, 0.5), (2.5, 1.0)])
def test_no_jump_at_a_reversal(nominal_fit: FusedFit, speed: float, hz: float, current_a: float) -> None:
    """The largest change in a millisecond is the true torque's and 0.1 Nm, at 0.5, 2 and 16 rad/s^2 of the joint.

    A loss that turned with the filtered speed, or a weight between the paths that followed it, would miss that.
    """
    physics = replace(nominal_fit.fused, agreement=None, envelope=None)
    ours = replace(joint(1), fused=physics)
    table = emulate_run(campaign_plant(), harmonic(speed, hz, current_a), 0.6 + 2.0 / hz, 77)
    run = estimate_columns(ours, FUSED, None, table.time_s, table.joints[1])
    true = low_pass(np.asarray(table.joints[1].torque_nm), table.dt_s, 200.0)
    later = table.time_s > 0.6
    assert {st.VALID, st.STANDSTILL} == set(run.status[later].tolist())
    v = low_pass(np.asarray(table.joints[1].motor_velocity_rad_s), table.dt_s, 200.0)[later]
    assert np.sum(np.diff(np.sign(v)) != 0) >= 3
    largest = np.max(np.abs(np.diff(run.torque_nm[later])))
    excess = largest - np.max(np.abs(np.diff(true[later])))
    print(f"{speed} rad/s, {hz} Hz, {current_a} A: {excess:.3f} Nm more than the true torque's")
    assert excess <= 0.1


# At rest, fitted to short runs that end in a stop, judged on other days -----------------------------------

STOP_S = 3.0


def stopping(seed: int, number: int, pushes: tuple[Push, ...] = (), seconds: float = 4.2) -> EmulatedRun:
    """A run whose joints come to rest at STOP_S, one driven by velocity, the other by current."""
    source = np.random.default_rng([seed, number])
    speed, rate, load, other = source.uniform((0.8, 2.0, 1.0, 2.0), (2.2, 3.5, 4.0, 4.0)).tolist()

    def ending(t: float) -> float:
        return min(1.0, max(0.0, 3.0 * (STOP_S - t)))

    commands = (
        JointCommand.velocity(lambda t: ending(t) * speed * math.sin(rate * t)),
        JointCommand.current(lambda t: ending(t) * load * math.sin(other * t + 0.5)),
    )
    turned = commands if number % 2 == 0 else (commands[1], commands[0])
    return emulate(campaign_plant(), turned, seconds, seed, day=number, pushes=pushes)


@pytest.fixture(scope="module")
def stopped() -> Joint:
    """Joint 1, fitted to runs that end in a stop."""
    one = joint(1)
    signals = []
    for number in range(10):
        table = stopping(7100, number).table
        signals.append(run_signals(f"run {number}", one, FUSED, table.time_s, table.joints[1]))
    return replace(one, fused=fit_fused(signals, one).fused)


def at_rest(joint: Joint, run: EmulatedRun, first: int = 0) -> tuple[FloatArray, BoolArray, FloatArray]:
    """Estimate joint 1 from sample `first` on; half intervals, where they hold the torque, true torque: after the stop."""
    settings = recommended("fused")
    table, truth = run.table, np.ascontiguousarray(run.joint_torque_nm[first:, 0])
    inputs = [column[first:] for column in table.estimator_inputs(1, joint.gear_ratio)[1:]]
    temperature = table.joints[1].temperature_c
    dt = table.dt_s[first:]
    got = FusedEstimator(joint, settings).run(
        dt, *inputs, None if temperature is None else temperature[first:]
    )
    rest = (got.status == st.STANDSTILL) & (table.time_s[first:] > STOP_S + 0.3)
    error = got.torque_nm - low_pass(truth, dt, bandwidth_of(joint, settings))
    inside: BoolArray = np.abs(error) <= got.sigma_nm
    return got.sigma_nm[rest], inside[rest], truth[rest]


def test_the_fit_writes_the_section_and_stops_are_held_more_narrowly(stopped: Joint) -> None:
    assert stopped.fused is not None
    assert stopped.fused.standstill is not None
    wide = replace(
        stopped, fused=replace(stopped.fused, standstill=replace(stopped.fused.standstill, sigmas=6.0))
    )
    held, ratio = [], []
    for number in range(8):
        run = stopping(7101, number)
        half, inside, _ = at_rest(stopped, run)
        assert len(half) > 500
        held.append(inside.mean())
        ratio.append(half.mean() / at_rest(wide, run)[0].mean())
    assert np.mean(held) > 0.93
    assert max(ratio) < 0.75


def test_a_start_at_rest_is_held_wherever_the_slip_stands(stopped: Joint) -> None:
    """The estimator begins in the stop: what the hysteresis holds is unknown, and the interval larger by that."""
    held = []
    assert stopped.fused is not None
    undoubted = replace(stopped, fused=replace(stopped.fused, agreement=None))
    for number in range(6):
        run = stopping(7102, number)
        start = round(1000 * STOP_S) + 150
        _, inside, _ = at_rest(stopped, run, first=start)
        half, later = (at_rest(undoubted, run, first=first)[0] for first in (start, 0))
        assert half.mean() > later.mean()
        held.append(inside.mean())
    assert np.mean(held) > 0.93


def test_a_push_from_outside_is_held_though_the_current_does_not_see_it(stopped: Joint) -> None:
    held = []
    for number in range(6):
        pushes = tuple(Push(STOP_S + 0.6 + 0.4 * k, torque) for k, torque in enumerate((4.0, -6.0, 9.0)))
        _, inside, torque = at_rest(stopped, stopping(7103, number, pushes, 4.8))
        assert np.ptp(torque) > 3.0
        held.append(inside.mean())
    assert np.mean(held) > 0.93
