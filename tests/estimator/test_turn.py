"""Waves over the motor's turn: those of another joint are told within a second of motion, those of the file's never."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from jtqd.estimator import status as st
from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.estimator import FusedEstimator, observe_run
from jtqd.estimator.fusion import EVERY, LEAST_S, TURN_BLOCK, TURN_MEMORY_S, TURN_TREND_S, turn_waves
from jtqd.estimator.joint import TURN_WAVES, Agreement, Joint, Turn
from jtqd.estimator.losses import AdditiveLossModel
from jtqd.estimator.run import EstimateRun
from jtqd.estimator.settings import EstimatorSettings
from tests.estimator.test_fused_estimator import NARROW
from tests.estimator.test_zeros import OFF, ON, K, driven

NONE = (0.0,) * TURN_WAVES
DIAGONAL = tuple(0.01 * float(m == n) for m in range(TURN_WAVES) for n in range(m + 1))
TURN = Turn(NONE, NONE, NONE, NONE, covariance_nm2=DIAGONAL, limit=15.0)
LARGE = Agreement(slow_nm=20.0, fast_nm=20.0, gain=1.0, zero_nm=20.0)
"""Levels that nothing here is beyond: what is told is told by the waves."""
COS_OF = {1: 0, 2: 2, 4: 4}
PARTS: dict[str, tuple[float, Callable[[FloatArray, FloatArray], FloatArray]]] = {
    "constant_nm": (0.7, lambda v, loss: np.ones_like(v)),
    "loss_share": (0.25, lambda v, loss: loss),
    "viscous_nms_per_rad": (0.8, lambda v, loss: v),
    "quadratic_nms2_per_rad2": (0.8, lambda v, loss: v * v),
}
"""Size of a part of a wave that tells another joint, and what it goes with, by speed and loss."""


def joint_of(turn: Turn | None = TURN) -> Joint:
    return replace(NARROW, fused=replace(NARROW.fused, agreement=replace(LARGE, turn=turn)))  # type: ignore[type-var]


def with_wave(order: int, key: str, seconds: float = 5.0) -> tuple[FloatArray, ...]:
    """Samples of a joint whose torsion has a wave: cos of an order of the motor's turn, times one part."""
    (dt, current, motor, velocity, link, temperature), torque = driven(seconds)
    v = velocity / 100.0
    raw = torque.copy()
    for _ in range(20):  # raw torque of a torque: the loss depends on it
        loss = AdditiveLossModel(NARROW.fused.loss).loss_many(raw, v, temperature, np.tanh(v / 0.02))[0]  # type: ignore[union-attr]
        raw = torque + loss
    size, part = PARTS[key]
    return dt, current, motor, velocity, link - size * part(v, loss) * np.cos(order * motor) / K, temperature


def first_told_s(found: EstimateRun) -> float:
    told = found.status == st.DEGRADED
    return float(np.argmax(told)) * 1e-3 if told.any() else np.inf


def own(order: int, key: str, factor: float = 1.0) -> Turn:
    """Return what a file has of the wave."""
    values = [0.0] * TURN_WAVES
    values[COS_OF[order]] = factor * PARTS[key][0]
    return replace(TURN, **{key: tuple(values)})


@pytest.mark.parametrize("order", [1, 2, 4])
@pytest.mark.parametrize("key", PARTS)
def test_a_wave_that_is_not_the_files_is_told_within_a_second_and_its_own_never(order: int, key: str) -> None:
    columns = with_wave(order, key)
    assert first_told_s(FusedEstimator(joint_of(None), ON).run(*columns)) == np.inf
    assert first_told_s(FusedEstimator(joint_of(), ON).run(*columns)) < 1.0
    assert first_told_s(FusedEstimator(joint_of(own(order, key)), ON).run(*columns)) == np.inf
    assert first_told_s(FusedEstimator(joint_of(own(order, key, -1.0)), ON).run(*columns)) < 1.0


def test_a_file_without_the_key_is_as_before() -> None:
    columns = with_wave(2, "constant_nm")
    without, told = (FusedEstimator(joint_of(turn), ON).run(*columns) for turn in (None, TURN))
    assert first_told_s(without) == np.inf
    np.testing.assert_array_equal(without.torque_nm, told.torque_nm)
    moving = (told.status == st.VALID) & (without.status == st.VALID)
    assert moving.any()
    np.testing.assert_array_equal(without.sigma_nm[moving], told.sigma_nm[moving])


@pytest.mark.parametrize("settings", [ON, OFF], ids=["tracked", "not tracked"])
def test_friction_and_zero_of_the_day_are_no_waves(settings: EstimatorSettings) -> None:
    """Each reversal is a step of twice the day's friction: trends start again behind it. The start is one, too."""
    columns, _ = driven(friction_nm=1.0, link_zero_rad=5e-5)
    without, told = (FusedEstimator(joint_of(turn), settings).run(*columns) for turn in (None, TURN))
    np.testing.assert_array_equal(told.status, without.status)


def test_what_was_another_joint_is_forgotten_in_motion() -> None:
    (dt, *_), _ = driven(8.0)
    mended = list(with_wave(2, "constant_nm", 8.0))
    mended[4] = np.where(np.cumsum(dt) < 2.0, mended[4], driven(8.0)[0][4])
    found = FusedEstimator(joint_of(), ON).run(*mended)
    assert first_told_s(found) < 1.0
    assert not (found.status[-2000:] == st.DEGRADED).any()


def test_a_run_observed_before_is_told_alike() -> None:
    columns = with_wave(2, "constant_nm", 2.0)
    joint = joint_of()
    seen = observe_run(joint, OFF, joint.fused.torsion, *columns)  # type: ignore[union-attr]
    whole, again = FusedEstimator(joint, OFF).run(*columns), FusedEstimator(joint, OFF)
    for _ in range(2):  # the second time nothing is left of the first
        assert np.array_equal(again.run_observed(seen).status, whole.status)
    with pytest.raises(ValueError, match="waves of the motor's turn"):
        again.run_observed(replace(seen, turn=np.zeros((0, 2))))


def test_an_estimator_goes_on_from_the_past_of_another() -> None:
    columns = with_wave(2, "constant_nm", 3.0)
    whole = FusedEstimator(joint_of(), ON).run(*columns)
    first, second = FusedEstimator(joint_of(), ON), FusedEstimator(joint_of(), ON)
    cut = 437
    first.run(*(column[:cut] for column in columns))
    second.past = first.past
    for k in range(cut, 1500):
        got = second.step(*(column[k] for column in columns))
        assert (got.status, got.torque_nm) == (whole.status[k], whole.torque_nm[k])


def plain(x: FloatArray, y: FloatArray) -> FloatArray:
    """The waves [blocks, 6] of samples taken: least squares, written as the equations are."""
    trends, rows = np.column_stack((x, y))[0], []
    way = 1.0 - np.exp(-EVERY * 1e-3 / TURN_TREND_S)
    for row in np.column_stack((x, y))[1:]:
        trends = trends + way * (row - trends)
        rows.append(row - trends)
    rest, found = np.array(rows), []
    for last in range(TURN_BLOCK, len(rest) + 1, TURN_BLOCK):
        block = (last - 1 - np.arange(last)) // TURN_BLOCK
        weight = EVERY * 1e-3 * np.exp(-block * TURN_BLOCK * EVERY * 1e-3 / TURN_MEMORY_S)
        a, b = rest[:last, :-1], rest[:last, -1]
        found.append(
            np.linalg.solve(a.T @ (weight[:, None] * a) + LEAST_S * np.eye(TURN_WAVES), a.T @ (weight * b))
        )
    return np.array(found)


def test_the_waves_are_those_of_least_squares() -> None:
    source = np.random.default_rng(8)
    n = 40 * EVERY * TURN_BLOCK + 1
    waves, apart = source.normal(size=(n, TURN_WAVES)), source.normal(size=n)
    v, loss = 1.0 + 0.3 * source.normal(size=n).clip(-2.0, 2.0), source.normal(size=n)
    root = source.normal(size=(TURN_WAVES, TURN_WAVES)) + 3.0 * np.eye(TURN_WAVES)
    covariance = root @ root.T
    parts = source.normal(size=(4, TURN_WAVES))
    turn = Turn(*map(tuple, parts), tuple(covariance[np.tril_indices(TURN_WAVES)]), 1.0)
    found, square = turn_waves(turn, np.full(n, 1e-3), apart, np.ones(n), v, loss, waves)
    rest = apart - np.einsum("nk,nk->n", waves, np.column_stack((np.ones(n), loss, v, v * v)) @ parts)
    expected = plain(waves[::EVERY], rest[::EVERY])
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    np.testing.assert_allclose(
        square, np.einsum("nk,nk->n", expected @ np.linalg.inv(covariance), expected), rtol=1e-9
    )


def test_waves_of_another_shape_are_refused() -> None:
    ones = np.ones(5)
    with pytest.raises(ValueError, match=r"expected \(5, 6\)"):
        turn_waves(TURN, ones, ones, ones, ones, ones, np.ones((5, 4)))


def test_the_section_survives_a_file() -> None:
    joint = joint_of(own(2, "loss_share"))
    mapping = joint.to_mapping()
    assert Joint.from_mapping(mapping, "joint.yaml") == joint
    assert "turn" not in joint_of(None).to_mapping()["fused"]["agreement"]
    mapping["fused"]["agreement"]["turn"]["limit_nm"] = 3.0
    with pytest.raises(ConfigError, match="limit_nm"):
        Joint.from_mapping(mapping, "joint.yaml")
    del mapping["fused"]["agreement"]["turn"]["limit_nm"]
    mapping["fused"]["agreement"]["turn"]["viscous_nms_per_rad"][2] = float("nan")
    with pytest.raises(ConfigError, match="viscous_nms_per_rad"):
        Joint.from_mapping(mapping, "joint.yaml")


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("constant_nm", (0.0,) * 5),
        ("quadratic_nms2_per_rad2", (0.0,) * 7),
        ("covariance_nm2", DIAGONAL[:-1]),
        ("covariance_nm2", (-1.0, *DIAGONAL[1:])),
        ("limit", 0.0),
    ],
)
def test_numbers_that_cannot_be_are_refused(key: str, value: object) -> None:
    with pytest.raises(ConfigError, match=key):
        replace(TURN, **{key: value})
