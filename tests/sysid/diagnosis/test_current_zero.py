"""What the current reads without power: how it is taken, and that it settles what no motion can."""

from dataclasses import replace

import numpy as np
import pytest

from jtqd.estimator.effects import EFFECTS
from jtqd.estimator.joint import Effect, Joint
from jtqd.estimator.run import RunTable
from jtqd.sysid.diagnosis.dataset import (
    DRIFT,
    Reading,
    reading,
    unpowered_columns,
    with_readings,
)
from jtqd.sysid.diagnosis.diagnose import diagnose
from jtqd.sysid.diagnosis.findings import Cause
from jtqd.sysid.diagnosis.regressors import Sums
from jtqd.sysid.diagnosis.signals import BaseLoss, JointSignals, joint_signals
from tests.estimator.effects import effect_signals
from tests.sysid.diagnosis.diagnose_core_helpers import candidates, rigid_run

PLAIN = replace(effect_signals.PLAIN, damping_nms_per_rad=0.0)  # as in the runs
PER_A = PLAIN.gear_ratio * PLAIN.torque_constant_nm_per_a
ENCODER_RAD = 3e-6
RATED_A = PLAIN.rated_torque_nm / PER_A


def bench_run(
    phase: float,
    *,
    asymmetry_nm: float = 0.0,
    offset_a: float = 0.0,
    marked: bool = True,
    rest_s: float = 1.2,
) -> RunTable:
    """A motion, then a rest without power: the asymmetry is a torque of the motion, the offset is always read."""
    run = rigid_run(PLAIN, phase, noise=0.3)
    n, rest = len(run.time_s), round(rest_s / 1e-3)
    one = run.joints[1]
    assert one.current_a is not None
    noise = np.random.default_rng(int(1000 * phase) + 1).normal(0.0, 0.01, rest)
    current = np.concatenate((one.current_a + asymmetry_nm / PER_A, noise)) + offset_a
    held = {
        name: np.pad(getattr(one, name), (0, rest), mode="edge")
        for name in ("motor_position_rad", "link_position_rad", "torque_nm")
    }
    encoder = np.random.default_rng(int(1000 * phase) + 2).normal(0.0, ENCODER_RAD, n + rest)
    held["link_position_rad"] = held["link_position_rad"] + encoder
    enabled = np.where(np.arange(n + rest) < n, 1.0, 0.0) if marked else None
    time = 1e-3 * np.arange(n + rest)
    return RunTable(time, {1: replace(one, current_a=current, enabled=enabled, **held)})


def found(**truth: float) -> list[Cause]:
    runs = [(f"run{k}", bench_run(0.37 + 0.61 * k, **truth)) for k in range(5)]  # type: ignore[arg-type]
    return list(diagnose(runs, {1: PLAIN}).causes)


def signals(run: RunTable, joint: Joint = PLAIN) -> JointSignals:
    return joint_signals("run", run, 1, joint, BaseLoss(joint))


def alike(one: Cause) -> set[str]:
    """The class of a cause, without the joints; with one joint a zero of the sensor is always in it."""
    return {name.split(" of ")[0] for name in one.names} - {"sensor_offset"}


@pytest.mark.campaign  # both of them at once are told apart below
def test_a_reading_without_power_settles_which_of_the_two_it_is() -> None:
    """Without the mark both names stay together: the trials of the generator show that."""
    (one,) = found(asymmetry_nm=1.0)
    assert alike(one) == {"friction_asymmetry"}


def test_both_at_once_are_told_apart() -> None:
    causes = found(asymmetry_nm=-1.0, offset_a=1.6 / PER_A)
    offset = next(c for c in causes if c.name == "current_offset")
    (other,) = (c for c in causes if c is not offset)
    assert alike(offset) == {"current_offset"}
    assert alike(other) == {"friction_asymmetry"}
    assert offset.parameters["offset_a"].value == pytest.approx(1.6 / PER_A, abs=0.005)


def test_the_reading_is_the_mean_of_the_rest_without_its_ends_and_with_its_noise() -> None:
    run = bench_run(0.2, offset_a=0.05)
    one = run.joints[1]
    assert one.current_a is not None
    current = one.current_a.copy()
    current[6000:6090] += 3.0  # the current that dies away
    got = reading(signals(RunTable(run.time_s, {1: replace(one, current_a=current)})))
    assert got is not None
    assert got.current_a == pytest.approx(0.05, abs=4.0 * 0.01 / np.sqrt(1000))
    assert 0.3 * 0.01 / np.sqrt(1000) < got.noise_a < 3.0 * 0.01 / np.sqrt(1000)
    assert got.drift_a == pytest.approx(DRIFT * RATED_A)


def test_no_mark_or_a_short_rest_is_no_reading() -> None:
    assert reading(signals(bench_run(0.2, marked=False))) is None
    assert reading(signals(bench_run(0.2, rest_s=0.28))) is None
    assert reading(signals(bench_run(0.2, rest_s=0.32))) is not None


def test_what_the_joint_file_knows_of_its_offset_is_taken_off() -> None:
    knows = replace(PLAIN, effects=(Effect("current_offset", {"offset_a": 0.03}),))
    got = reading(signals(bench_run(0.2, offset_a=0.05), knows))
    assert got is not None
    assert got.current_a == pytest.approx(0.02, abs=0.002)


def one_reading(current_a: float, noise_a: float = 0.001, drift_a: float = 0.002) -> Reading:
    return Reading(current_a, noise_a, drift_a)


def test_many_readings_are_no_more_certain_than_the_drift() -> None:
    """The information of n readings of sigma^2 = noise^2 + n drift^2 is n / sigma^2, below 1 / drift^2."""
    chosen = candidates(PLAIN, ("friction_asymmetry", 1, 0), ("current_offset", 1, 0))
    rows = unpowered_columns(chosen, {1: PLAIN})
    assert [(where, column) for where, column, _ in rows] == [(1, 1)]
    amperes = rows[0][2]
    assert amperes == pytest.approx(EFFECTS["current_offset"].terms(PLAIN)[0].basis[0]["offset_a"])
    for n in (1, 4, 400):
        sums = [Sums(np.zeros((3, 3)), 100) for _ in range(n)]
        out = with_readings(sums, [{1: one_reading(0.05)}] * n, rows)
        gram = sum((s.gram for s in out), np.zeros((3, 3)))
        weight = n / (0.001**2 + n * 0.002**2)
        assert gram == pytest.approx(weight * np.outer([0.0, amperes, 0.05], [0.0, amperes, 0.05]), rel=1e-9)
        assert weight < 1.0 / 0.002**2
        assert out[0].rows == 101


def test_runs_without_a_reading_stay_as_they_are() -> None:
    sums = [Sums(np.ones((3, 3)), 100), Sums(np.ones((3, 3)), 100)]
    out = with_readings(sums, [{}, {1: one_reading(0.05)}], [])
    assert out[0] is sums[0]
    assert out[1].gram[2, 2] > 1.0
    assert with_readings(sums, [{}, {}], []) == sums
