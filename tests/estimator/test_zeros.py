"""Zeros as slow states: found where motion shows them, left alone where it does not, told, limited, handed over."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from jtqd.estimator import status as st
from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.estimator import FusedEstimator, observe_run
from jtqd.estimator.joint import Joint
from jtqd.estimator.losses import AdditiveLossModel
from jtqd.estimator.run import EstimateRun
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.status import Zeros
from tests.estimator.fused_helpers import SIGMA
from tests.estimator.test_fused_estimator import NARROW

K, GAIN = 12000.0, 6.2
ON = EstimatorSettings(method="fused", track_zeros=True)
OFF = EstimatorSettings(method="fused")
LIMITED = replace(
    NARROW,
    fused=replace(NARROW.fused, torsion=replace(NARROW.fused.torsion, zero_limit_rad=5e-4)),  # type: ignore[type-var, union-attr]
)

Columns = tuple[FloatArray, ...]


def driven(
    seconds: float = 5.0,
    velocity: Callable[[FloatArray], FloatArray] = lambda t: 1.2 * np.sin(2.5 * t + 0.4),
    load: Callable[[FloatArray], FloatArray] = lambda t: 8.0 * np.sin(1.7 * t),
    friction_nm: float = 0.0,
    link_zero_rad: float | FloatArray = 0.0,
) -> tuple[Columns, FloatArray]:
    """Samples of a joint that is as its file says, but for friction and zero; and the motor torque less loss [n]."""
    t = np.arange(round(1000 * seconds)) * 1e-3
    v, raw = velocity(t), load(t)
    model = AdditiveLossModel(NARROW.fused.loss)  # type: ignore[union-attr]
    turns = np.tanh(v / 0.02)
    torque = raw - model.loss_many(raw, v, np.full(len(t), 25.0), turns)[0] - friction_nm * turns
    motor = 100.0 * np.cumsum(v) * 1e-3
    link = motor / 100.0 - torque / K + link_zero_rad
    noise = np.random.default_rng(4).normal(0.0, 6e-6, len(t))
    rotor = NARROW.rotor_inertia_kgm2 * 100.0 * np.gradient(v, t) / NARROW.torque_constant_nm_per_a
    return (
        np.full(len(t), 1e-3),
        raw / GAIN + rotor,
        motor,
        100.0 * v,
        link + noise,
        np.full(len(t), 25.0),
    ), torque


def tracked(columns: Columns, joint: Joint = NARROW) -> tuple[EstimateRun, Zeros]:
    e = FusedEstimator(joint, ON)
    run = e.run(*columns)
    assert e.zeros is not None
    return run, e.zeros


def error(run: EstimateRun, torque: FloatArray, last: int = 1500) -> float:
    return float(np.sqrt(np.mean((run.torque_nm - torque)[-last:] ** 2)))


@pytest.mark.parametrize("zero", [1e-4, -1e-3])
def test_a_zero_of_the_link_encoder_is_taken_off_and_told(zero: float) -> None:
    columns, torque = driven(link_zero_rad=zero)
    run, zeros = tracked(columns)
    assert zeros.link_rad == pytest.approx(zero, abs=1e-5)
    assert zeros.link_used_rad == pytest.approx(zero, abs=1e-5)
    assert abs(zeros.link_rad - zero) < 3.0 * zeros.link_sigma_rad < 4e-5
    assert zeros.plausible
    without = FusedEstimator(NARROW, OFF).run(*columns)
    assert error(without, torque) > 0.2
    assert error(run, torque) < 0.4 * error(without, torque)
    assert run.status[-1] == st.VALID


def test_where_there_is_no_zero_nothing_is_changed() -> None:
    columns, _ = driven()
    run, zeros = tracked(columns)
    assert (zeros.link_used_rad, zeros.current_used_a) == (0.0, 0.0)
    np.testing.assert_array_equal(run.torque_nm, FusedEstimator(NARROW, OFF).run(*columns).torque_nm)


def test_a_zero_that_the_files_sigma_covers_is_known_and_left_alone() -> None:
    """0.3 Nm where the file's sigma of the torsion is 0.35: however long it is seen, it may be an error of model."""
    columns, _ = driven(8.0, link_zero_rad=2.5e-5)
    zeros = tracked(columns)[1]
    assert zeros.link_rad == pytest.approx(2.5e-5, abs=8e-6)
    assert abs(zeros.link_used_rad) < 5e-6
    assert 4.0 * zeros.link_sigma_rad < 4e-5


def test_friction_is_no_zero_and_motion_one_way_tells_them_apart_not_at_all() -> None:
    """0.3 Nm more friction than the file has: one and a half of its standard deviations."""
    one_way, _ = driven(velocity=lambda t: 1.0 + 0.3 * np.sin(2.5 * t), friction_nm=0.3)
    zeros = tracked(one_way)[1]
    assert zeros.link_sigma_rad * K > 0.8 * SIGMA.current_nm
    assert zeros.link_used_rad == 0.0
    both, _ = driven(friction_nm=0.3)
    zeros = tracked(both)[1]
    assert zeros.link_sigma_rad * K < 0.7 * SIGMA.current_nm
    assert abs(zeros.link_rad) * K < 0.1
    assert zeros.link_used_rad == 0.0


def test_a_push_of_10_nm_is_no_zero() -> None:
    columns, _ = driven(
        load=lambda t: 8.0 * np.sin(1.7 * t) + np.where(t > 2.0, 10.0, 0.0), link_zero_rad=1e-4
    )
    assert tracked(columns)[1].link_rad == pytest.approx(1e-4, abs=1.2e-5)


def test_at_rest_nothing_is_learned() -> None:
    columns, _ = driven(velocity=lambda t: 0.0 * t, link_zero_rad=3e-4)
    zeros = tracked(columns)[1]
    assert (zeros.link_rad, zeros.link_used_rad) == (0.0, 0.0)
    assert zeros.link_sigma_rad == pytest.approx(0.3 * 40.0 / K)


def test_an_encoder_that_slips_in_the_run_is_found_again() -> None:
    at = np.where(np.arange(8000) < 4000, 0.0, 6e-4)
    columns, torque = driven(8.0, link_zero_rad=at)
    run, zeros = tracked(columns)
    assert zeros.link_rad == pytest.approx(6e-4, abs=2e-5)
    assert st.DEGRADED in run.status[4000:4100]
    assert run.status[-1] == st.VALID
    assert error(run, torque) < 0.3


def test_a_zero_beyond_the_limit_of_the_file_is_not_plausible_and_lowers_the_status() -> None:
    columns, _ = driven(link_zero_rad=1e-3)
    run, zeros = tracked(columns, LIMITED)
    assert not zeros.plausible
    assert run.status[-1] == st.DEGRADED


def test_reset_forgets_and_a_gap_does_not() -> None:
    columns, _ = driven(link_zero_rad=1e-3)
    e = FusedEstimator(NARROW, ON)
    e.run(*columns)
    known = e.zeros
    e.step(10.0, 0.0, 0.0, 0.0, 0.0)
    assert e.zeros == known
    e.reset()
    assert e.zeros is not None
    assert (e.zeros.link_rad, e.zeros.link_used_rad) == (0.0, 0.0)


def test_without_torsion_or_where_it_is_not_wanted_there_are_none() -> None:
    rigid = replace(NARROW, fused=replace(NARROW.fused, torsion=None))  # type: ignore[type-var]
    assert FusedEstimator(rigid, ON).zeros is None
    assert FusedEstimator(NARROW, OFF).zeros is None
    seen = observe_run(NARROW, ON, NARROW.fused.torsion, *driven(0.1)[0])  # type: ignore[union-attr]
    with pytest.raises(ValueError, match="tracks zeros"):
        FusedEstimator(NARROW, ON).run_observed(seen)
    assert math.isfinite(FusedEstimator(NARROW, OFF).run_observed(seen).torque_nm[-1])
