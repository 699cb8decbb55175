"""The additive loss: its formula, continuity, dissipation, the friction interval at rest, temperature, its twin."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import AdditiveLoss, LossSide
from jtqd.estimator.losses import AdditiveLossModel
from tests.estimator.fused_helpers import NODES, loss_of

W0 = 0.02
SEEDS = range(20, 28)


def plain(side: LossSide, load: float, speed: float, thermal: float = 0.0, vs: float = 0.05) -> float:
    """L_d between the outer nodes as the module's docstring says, with numpy's own interpolation."""
    c, f, q = (
        float(np.interp(load, NODES, values))
        for values in (side.constant_nm, side.viscous_nms_per_rad, side.quadratic_nms2_per_rad2)
    )
    peak = side.stribeck_nm * math.exp(-((speed / vs) ** 2))
    return max(c + peak + (f + thermal) * speed + q * speed**2, 0.0)


def expected(loss: AdditiveLoss, raw: float, v: float, s: float, thermal: float = 0.0) -> tuple[float, float]:
    speed = min(abs(v), loss.velocity_max_rad_s)
    positive = plain(loss.positive, raw, speed, thermal)
    negative = plain(loss.negative, -raw, speed, thermal)
    return (1 + s) / 2 * positive - (1 - s) / 2 * negative, (positive + negative) / 2 * (1 - s * s)


def scattered(seed: int, count: int = 400) -> list[tuple[float, float]]:
    """(raw, v) inside the nodes of both directions, half of them slow."""
    rng = np.random.default_rng(seed)
    v = rng.uniform(-4.0, 4.0, count)
    v[::2] *= 0.02
    return list(zip(rng.uniform(-30.0, 30.0, count).tolist(), v.tolist(), strict=True))


def test_by_hand() -> None:
    """Nodes 0 and 10 Nm, load 5 Nm at 2 rad/s: (1+3)/2 + (0.5+0.7)/2*2 + (0.1+0.3)/2*4 = 2 + 1.2 + 0.8."""
    side = LossSide((1.0, 3.0), (0.5, 0.7), (0.1, 0.3), 0.8)
    model = AdditiveLossModel(AdditiveLoss((0.0, 10.0), side, side, 0.05, 3.0, 25.0, 2.0, 0.025))
    assert model.loss(5.0, 2.0, 0.0) == (pytest.approx(4.0, abs=1e-12), 0.0)
    assert model.loss(-5.0, -2.0, 0.0) == (pytest.approx(-4.0, abs=1e-12), 0.0)
    assert model.loss(5.0, 2.0, -0.25)[0] == pytest.approx(
        3.5, abs=1e-12
    )  # thermal: a quarter less per rad/s


@pytest.mark.parametrize("seed", SEEDS)
def test_formula_between_the_nodes(seed: int) -> None:
    loss = loss_of(seed)
    model = AdditiveLossModel(loss)
    for raw, v in scattered(seed):
        assert model.loss(raw, v, -0.3) == pytest.approx(
            expected(loss, raw, v, math.tanh(v / W0), -0.3), abs=1e-7
        )
        for s in (-1.0, -0.4, 0.0, 0.9, 1.0):  # a direction from the observer in place of the velocity's
            assert model.loss(raw, v, 0.0, s) == pytest.approx(expected(loss, raw, v, s), abs=1e-12)


def test_beyond_the_outer_nodes_the_constant_goes_on_and_the_slopes_are_held() -> None:
    loss = loss_of(5)
    model = AdditiveLossModel(loss)
    side = loss.positive
    last, before = NODES[-1], NODES[-2]
    slope = (side.constant_nm[-1] - side.constant_nm[-2]) / (last - before)
    for v in (0.5, 1.0, 2.5):
        edge = model.loss(last, v, 0.0)[0]
        assert model.loss(last + 10.0, v, 0.0)[0] == pytest.approx(edge + 10.0 * slope, abs=1e-9)
    first = (side.constant_nm[1] - side.constant_nm[0]) / (NODES[1] - NODES[0])
    far = max(plain(side, NODES[0], 1.0) - 20.0 * first, 0.0)
    assert model.loss(NODES[0] - 20.0, 1.0, 0.0)[0] == pytest.approx(far, abs=1e-9)


def test_faster_than_measured_counts_as_measured() -> None:
    model = AdditiveLossModel(loss_of(6))
    assert model.loss(7.0, 9.0, 0.0) == model.loss(7.0, 3.0, 0.0)
    assert model.loss(7.0, 2.9, 0.0) != model.loss(7.0, 3.0, 0.0)


# ---- continuity and sign


@pytest.mark.parametrize("seed", SEEDS)
def test_no_jump_anywhere(seed: int) -> None:
    """A step of 1e-9 in load or speed changes nothing by more than 1e-6: at nodes, zero load, zero speed, borders."""
    model = AdditiveLossModel(loss_of(seed))
    rng = np.random.default_rng(seed)
    speeds = [0.0, *rng.uniform(-3.5, 3.5, 6), 3.0, -3.0, 1e-3, -0.02, 0.1, 0.21, -0.22]
    loads = [0.0, *NODES, *(-n for n in NODES), *rng.uniform(-60.0, 60.0, 6)]
    for v in speeds:
        for raw in loads:
            for step_raw, step_v in ((1e-9, 0.0), (0.0, 1e-9), (1e-9, 1e-9)):
                low = model.loss(raw - step_raw / 2, v - step_v / 2, 0.0)
                high = model.loss(raw + step_raw / 2, v + step_v / 2, 0.0)
                assert high == pytest.approx(low, abs=1e-6), (seed, raw, v)


def test_no_jump_where_one_direction_takes_over() -> None:
    """Fine scan through the speeds and directions at which the other side is left out, with very unequal sides."""
    loss = loss_of(3)
    heavy = replace(loss.negative, constant_nm=tuple(40.0 + c for c in loss.negative.constant_nm))
    model = AdditiveLossModel(replace(loss, negative=heavy))
    speeds = np.arange(0.15, 0.45, 2e-6)
    values = np.array([model.loss(5.0, v, 0.0)[0] for v in speeds.tolist()])
    assert np.max(np.abs(np.diff(values, 2))) < 1e-6
    directions = 1.0 - np.geomspace(1e-13, 1e-3, 20_000)
    values = np.array([model.loss(5.0, 0.5, 0.0, s)[0] for s in directions.tolist()])
    assert np.max(np.abs(np.diff(values) - 0.5 * 44.0 * np.diff(directions))) < 1e-4
    assert np.max(np.abs(np.diff(values)[directions[1:] > 1.0 - 1e-8])) < 1e-6


@pytest.mark.parametrize("seed", SEEDS)
def test_the_loss_dissipates(seed: int) -> None:
    """Of the sign of v beyond w0 while the sides differ by less than exp(2) = 7.4, and further out in any case."""
    model = AdditiveLossModel(loss_of(seed))
    for raw, v in scattered(seed):
        if abs(v) >= W0 and abs(raw) <= 20.0:
            assert model.loss(raw, v, 0.0)[0] * v >= 0.0, (seed, raw, v)
    rng = np.random.default_rng(seed)
    wild = [LossSide(*(tuple(rng.normal(0.0, 5.0, 8).tolist()) for _ in range(3)), -2.0) for _ in range(2)]
    model = AdditiveLossModel(replace(loss_of(seed), positive=wild[0], negative=wild[1]))
    zero = 0
    for raw, v in scattered(seed):
        value, half = model.loss(raw, 10.0 * v, -1.0)
        assert half >= 0.0
        if abs(10.0 * v) > 11 * W0:
            assert value * v >= 0.0, (seed, raw, v)
            zero += value == 0.0
    assert zero > 10  # a fit that would feed energy in is cut at zero


# ---- standstill


@pytest.mark.parametrize("seed", SEEDS)
def test_at_rest_the_value_is_the_middle_of_the_friction_interval(seed: int) -> None:
    """Friction holds any torque from tau_raw - L_+ to tau_raw + L_-, both at v -> 0 with the Stribeck peak."""
    loss = loss_of(seed)
    model = AdditiveLossModel(loss)
    for raw in (-25.0, -3.0, 0.0, 0.7, 18.0):
        low = raw - plain(loss.positive, raw, 0.0)
        high = raw + plain(loss.negative, -raw, 0.0)
        value, half = model.loss(raw, 0.0, 0.0)
        assert raw - value == pytest.approx((low + high) / 2, abs=1e-12)
        assert half == pytest.approx((high - low) / 2, abs=1e-12)
        assert model.loss(raw, 0.5, 0.0)[1] == 0.0


# ---- temperature


def test_temperature_acts_on_the_viscous_part_alone() -> None:
    model = AdditiveLossModel(loss_of(7))
    for kelvin in (-40.0, -15.0, 0.0, 3.0, 40.0):
        h = 2.0 * (math.exp(-0.025 * kelvin) - 1.0)
        assert model.thermal(25.0 + kelvin) == pytest.approx(h, abs=1e-12)
        cold = model.loss(10.0, 1.5, 0.0)[0]
        assert model.loss(10.0, 1.5, model.thermal(25.0 + kelvin))[0] == pytest.approx(
            cold + 1.5 * h, abs=1e-12
        )
    assert model.thermal(math.nan) == 0.0
    assert model.thermal(1e6) == model.thermal(math.inf) == model.thermal(65.0)
    assert model.thermal(-1e6) == model.thermal(-math.inf) == model.thermal(-15.0)


# ---- twin


def twin(model: AdditiveLossModel, points: FloatArray, direction: FloatArray | None) -> FloatArray:
    raw, v, temperature = points
    found = model.loss_many(raw, v, temperature, direction)
    one = [
        model.loss(a, b, model.thermal(t), None if direction is None else direction[k])
        for k, (a, b, t) in enumerate(points.T.tolist())
    ]
    return np.array(found) - np.array(one).T


@pytest.mark.parametrize("seed", SEEDS)
def test_the_vectorised_twin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    raw = np.concatenate((rng.uniform(-70.0, 70.0, 500), NODES, -np.array(NODES)))
    v = rng.normal(size=len(raw)) * rng.choice([0.01, 0.1, 2.0], len(raw))
    temperature = rng.choice([math.nan, 25.0, 12.3, 44.0, 300.0, -math.inf], len(raw))
    model = AdditiveLossModel(loss_of(seed))
    assert np.max(np.abs(twin(model, np.array([raw, v, temperature]), None))) < 1e-12
    s = np.clip(rng.normal(size=len(raw)), -1.0, 1.0) * rng.choice([1.0, 1.0 - 1e-10, 1.0 - 1e-8], len(raw))
    assert np.max(np.abs(twin(model, np.array([raw, v, temperature]), s))) < 1e-12
