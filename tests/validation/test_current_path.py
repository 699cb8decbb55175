"""The network of the current path: what it sees, how it learns, and the figures of its study."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import Joint
from jtqd.estimator.run import JointColumns
from jtqd.estimator.status import DEGRADED, STANDSTILL, VALID
from jtqd.sysid.planner.plan import DEFAULT_LIMITS, expand
from jtqd.sysid.train.current_path import EVERY, Block, Recipe, block, estimate_nm, seen, train
from jtqd.sysid.train.network import network_output
from tests.estimator.fused_helpers import fused_joint
from validation.current_path import changed
from validation.current_path.study import Example, Served, load_step_runs, percent, share
from validation.goals.identify import Change

JOINT: Joint = fused_joint()
INPUTS, N = 28, 1500
TIME: FloatArray = 1e-3 * np.arange(N)


def columns(**changes: FloatArray) -> JointColumns:
    """A joint that swings with 2 rad/s at a current that swings as well."""
    speed = 2.0 * np.sin(4.0 * TIME)
    motor = 100.0 * np.cumsum(speed) * 1e-3
    return replace(
        JointColumns(
            current_a=3.0 * np.cos(6.0 * TIME),
            motor_position_rad=motor,
            motor_velocity_rad_s=100.0 * speed,
            link_position_rad=motor / 100.0 + 1e-3,
            torque_nm=np.full(N, 5.0),
            temperature_c=30.0 + TIME,
        ),
        **changes,
    )


def test_inputs_are_of_one_encoder_and_of_the_past() -> None:
    found = seen(JOINT, TIME, columns())
    assert found.shape == (N, INPUTS)
    assert np.isfinite(found[1:]).all()
    other = seen(JOINT, TIME, columns(link_position_rad=np.zeros(N), torque_nm=np.zeros(N)))
    assert np.array_equal(other, found, equal_nan=True), "neither link encoder nor sensor"
    early = columns().map(lambda name, column: column[:700])
    assert np.array_equal(seen(JOINT, TIME[:700], early), found[:700], equal_nan=True)
    assert len({each.tobytes() for each in found.T}) == INPUTS, "no input is there twice"
    with pytest.raises(ValueError, match="current_a"):
        seen(JOINT, TIME, columns(current_a=None))  # type: ignore[arg-type]


def test_the_base_is_the_torque_of_a_rotor_that_accelerates_less_a_low_pass() -> None:
    """Constant current i and acceleration a: G (Kt i - J a) once the low pass of 200 rad/s has settled."""
    omega = 50.0 * TIME
    steady = columns(current_a=np.full(N, 2.0), motor_velocity_rad_s=omega)
    found = seen(JOINT, TIME, steady)[-1, 0]
    expected = 100.0 * (JOINT.torque_constant_nm_per_a * 2.0 - JOINT.rotor_inertia_kgm2 * 50.0)
    assert found == pytest.approx(expected, abs=1e-6)


def test_a_stop_operator_has_memory_of_the_last_reversal() -> None:
    """Swung by 0.2 rad a stop of 0.07 rad is at its end, one of 0.8 rad is not."""
    forth = np.concatenate((np.linspace(0.0, 0.2, 500), np.linspace(0.2, 0.16, 1000)))
    stops = seen(JOINT, TIME, columns(motor_position_rad=forth))[:, 22:26]
    assert stops[499, 0] == stops[499, 1] == 1.0
    assert abs(stops[499, 3]) < 0.2
    assert stops[-1, 1] == pytest.approx(1.0 - 0.04 / 0.07, abs=1e-6)


def test_only_settled_samples_that_the_teacher_knows_are_learned() -> None:
    known = np.arange(240.0)[:, None] * np.ones(INPUTS)
    teacher = known[:, 0] + 3.0
    teacher[120:] = np.nan
    settled = np.arange(240) >= 24
    found = block(known, teacher, settled)
    assert found.inputs[:, 0].tolist() == list(range(24, 120, EVERY))
    assert (found.target_nm == 3.0).all()


QUICK = Recipe(hidden=(8,), epochs=30, fewest_steps=200, batch=128)


def made(count: int, seed: int) -> list[Block]:
    rng = np.random.default_rng(seed)
    xs = [rng.normal(size=(300, INPUTS)) for _ in range(count)]
    return [Block(x, 3.0 * np.tanh(x[:, 0]) + 0.5 * x[:, 1] - 1.0) for x in xs]


def test_it_learns_a_function_and_the_same_one_again() -> None:
    blocks, fresh = made(8, 1), made(2, 2)
    network = train(blocks, QUICK)
    for each in fresh:
        error = network_output(network, each.inputs) - each.target_nm
        assert np.sqrt(np.mean(error**2)) < 0.25 * each.target_nm.std()
    again = train(blocks, QUICK)
    for (w, b), (other_w, other_b) in zip(network.weights, again.weights, strict=True):
        assert np.array_equal(w, other_w)
        assert np.array_equal(b, other_b)
    known = fresh[0].inputs
    assert estimate_nm(network, known) == pytest.approx(known[:, 0] + network_output(network, known))
    with pytest.raises(ValueError, match="1 run"):
        train(blocks[:1], QUICK)


def test_the_weights_are_those_of_the_epoch_that_was_best_on_runs_left_out() -> None:
    """Runs left out of pure noise: the smallest loss on them is not the last one, and it is the one that is kept."""
    rng = np.random.default_rng(5)
    blocks = [Block(rng.normal(size=(60, INPUTS)), rng.normal(size=60)) for _ in range(12)]
    recipe = replace(QUICK, epochs=60, hidden=(40,), rate=2e-2)
    network = train(blocks, recipe)
    held = [each for each, out in zip(blocks, recipe.held_out(12), strict=True) if out]
    error = np.concatenate([network_output(network, each.inputs) - each.target_nm for each in held])
    scaled = np.abs(error / network.output_std)
    knee = recipe.knee
    loss = np.where(scaled < knee, 0.5 * scaled**2, knee * (scaled - 0.5 * knee)).mean()
    assert loss == pytest.approx(min(network.losses), rel=1e-3)
    assert min(network.losses) < 0.98 * network.losses[-1]


def test_figures_count_settled_samples_that_have_a_value() -> None:
    true = np.zeros(4)
    known = np.zeros((4, INPUTS))
    one = Example(known, true, true, np.array([False, True, True, True]), np.array([True, True, True, False]))
    found = share(np.array([99.0, 4.0, np.nan, 8.0]), one, 40.0)
    assert found.moving == (pytest.approx(0.01), 1)
    assert found.standing == (pytest.approx(0.04), 1)
    assert percent([found.moving, (0.03, 3)]) == pytest.approx(10.0)
    assert math.isnan(percent([(0.0, 0)]))


def test_load_steps_are_steep_and_within_limits() -> None:
    for run in load_step_runs(3, 8.0, 3):
        points = expand(run)
        assert np.abs(points.current_a).max() <= DEFAULT_LIMITS.current_a
        assert np.abs(np.diff(points.current_a)).max() > 0.5


def test_figures_in_service_are_errors_and_what_intervals_hold() -> None:
    sums = Served(np.array([4.0, 16.0]), np.array([4.0, 1.0, 200.0, 0.0, 50.0]), np.array([180.0, 0.0, 1.0]))
    assert sums.text(40.0) == "2.50; 10.00 | 90.0; 0.0 | 2.0"


def test_what_is_flagged_is_not_beyond_and_rest_does_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    """What settles and rests errs by 9 Nm; of 400 samples that move half err by 4 sigma, and half of these are degraded."""
    status = np.full(1000, VALID, np.uint8)
    status[100:600], status[600:700] = STANDSTILL, DEGRADED
    error = np.where(np.arange(1000) < 600, 9.0, np.where(np.arange(1000) < 800, 2.0, 0.0))
    found = SimpleNamespace(torque_nm=5.0 + error, sigma_nm=np.full(1000, 0.5), status=status)
    monkeypatch.setattr(changed, "estimate_columns", lambda *_: found)
    table = SimpleNamespace(time_s=1e-3 * np.arange(1000))
    run: Any = SimpleNamespace(table=table, true_nm=np.full((1000, 2), 5.0), columns=lambda *_: None)
    models: Any = [SimpleNamespace(number=number, joint=None) for number in (1, 2)]
    got = changed.cell_of([run], Change("none"), models, (None, None))
    assert got == (pytest.approx(np.sqrt(2.0)), 50.0, 25.0, 25.0, 0.5)
