"""Friction, efficiency and additive loss: closed forms, Table I in both conventions, dissipation, continuity, twins."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import AdditiveLoss, Efficiency, Friction, Joint, LossSide
from jtqd.estimator.losses import AdditiveLossModel, FrictionModel, LossModel, static_friction
from jtqd.models.files import load_joint, shipped
from tests.estimator.estimator_helpers import joint1, reciprocal_efficiency
from tests.estimator.fused_helpers import NODES, loss_of

GRID_I = [s * a for s in (-1, 1) for a in np.linspace(1.0, 7.0, 25).tolist()]
GRID_V = [s * a for s in (-1, 1) for a in np.linspace(0.2, 3.0, 29).tolist()]


def printed_eta(e: Efficiency, i: float, v: float) -> float:
    """The polynomial of the quadrant as the file gives it: no bounds, no blending."""
    if i > 0:
        return (e.i_pos_w_pos if v > 0 else e.i_pos_w_neg).value(i, v)
    return (e.i_neg_w_pos if v > 0 else e.i_neg_w_neg).value(i, v)


def both_conventions(joint: Joint) -> list[Joint]:
    return [joint, replace(joint, efficiency=reciprocal_efficiency(joint))]


def random_points(seed: int, count: int) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    i = rng.normal(size=count) * rng.choice([0.01, 0.3, 3.0, 10.0], count)
    v = rng.normal(size=count) * rng.choice([0.001, 0.03, 1.0, 4.0], count)
    i[:50] = 0.0
    v[25:75] = 0.0
    v[75:80] = -0.0
    return i, v


def test_friction_closed_forms() -> None:
    model = FrictionModel(Friction(3.0, 2.0, 0.8, 0.05))
    # at 1 rad/s the direction is 1, Stribeck gone (exp(-400)): 3 + 2; at 0.02 rad/s tanh(1), exp(-0.16)
    assert model.torque(1.0) == pytest.approx(5.0, abs=1e-12)
    assert model.torque(0.02) == pytest.approx(
        math.tanh(1.0) * (3.0 + 0.8 * math.exp(-0.16)) + 0.04, abs=1e-12
    )
    assert model.torque(0.0) == 0.0
    assert static_friction(Friction(3.0, 2.0, 0.8)) == pytest.approx(3.8)
    _, v = random_points(3, 5000)
    many = model.torque_many(v)
    assert np.max(np.abs(many - [model.torque(x) for x in v.tolist()])) < 1e-12
    assert np.array_equal(model.torque_many(-v), -many)
    assert np.all(many * v >= 0.0)


@pytest.mark.parametrize("name", ["joint1.yaml", "joint2.yaml"])
def test_steady_state_is_the_table_in_both_conventions(name: str) -> None:
    for joint in both_conventions(load_joint(shipped(name))):
        e = joint.efficiency
        assert e is not None
        model = LossModel(joint)
        gain = joint.gear_ratio * joint.torque_constant_nm_per_a
        checked = 0
        for i in GRID_I:
            for v in GRID_V:
                driving = i * v > 0
                if not driving and abs(i) > 5.0:
                    continue
                eta = printed_eta(e, i, v)
                eta = eta if e.convention == "joint_over_motor" else 1.0 / eta
                if eta > 1.0 if driving else eta < 1.0:
                    continue  # here the fit itself would feed energy in
                torque = gain * i - model.loss(i, v)
                assert torque / (gain * i) == pytest.approx(eta, abs=1e-3), (e.convention, i, v)
                checked += 1
        assert checked > 2200  # of 2 * 25 * 29 driving and 2 * 17 * 29 back-driving points


def test_the_table_misses_dissipation_by_little_and_rarely() -> None:
    """Table I as printed feeds energy in at a corner of one quadrant; the bound moves it by < 2e-3."""
    joint = joint1()
    assert joint.efficiency is not None
    worst = 0.0
    for i in GRID_I:
        for v in GRID_V:
            if i * v < 0 and abs(i) <= 5.0:
                worst = max(worst, 1.0 - printed_eta(joint.efficiency, i, v))
    assert 0.0 < worst < 2e-3


def test_a_driving_joint_gives_less_than_its_motor_and_a_driven_one_holds_more() -> None:
    for joint in both_conventions(joint1()):
        model = LossModel(joint)
        gain = model.torque_per_ampere
        for i in GRID_I:
            for v in GRID_V:
                torque = gain * i - model.loss(i, v)
                if i * v > 0:
                    assert 0.0 < torque / (gain * i) < 1.0
                else:
                    assert torque / (gain * i) >= 1.0 - 1e-12


def test_losses_always_dissipate_and_are_bounded() -> None:
    i, v = random_points(11, 20000)
    for joint in both_conventions(joint1()):
        model = LossModel(joint)
        loss = model.loss_many(i, v)
        assert np.all(loss * v >= 0.0)
        assert np.all(loss[v == 0.0] == 0.0)
        bound = np.maximum(3.0 * model.torque_per_ampere * np.abs(i), 0) + FrictionModel(
            joint.friction
        ).torque_many(np.abs(v))
        assert np.all(np.abs(loss) <= bound + 1e-12)


def test_continuous_across_reversal_zero_current_and_clamps() -> None:
    for joint in both_conventions(joint1()):
        model = LossModel(joint)
        for i in (-6.9, -3.0, -0.5, 0.0, 0.2, 0.5, 4.0, 8.0):
            v = np.linspace(-3.5, 3.5, 280001)  # 2.5e-5 rad/s
            loss = model.loss_many(np.full_like(v, i), v)
            # d/dv tanh(50 v) is at most 50; Stribeck and eta add less than 40 Nm/(rad/s)
            assert np.max(np.abs(np.diff(loss))) < 2.5e-5 * (50 * np.max(np.abs(loss)) + 40)
        for v0 in (-3.5, -1.0, -0.05, -0.001, 0.001, 0.05, 1.0, 3.5):
            i = np.linspace(-9, 9, 180001)  # 1e-4 A, slopes below 75 Nm/A
            loss = model.loss_many(i, np.full_like(i, v0))
            assert np.max(np.abs(np.diff(loss))) < 1.05e-4 * 75


def test_zero_current_is_the_additive_friction() -> None:
    joint = joint1()
    model, friction = LossModel(joint), FrictionModel(joint.friction)
    for v in (-2.0, -0.03, -0.0, 0.0, 0.004, 0.7, 5.0):
        assert model.loss(0.0, v) == pytest.approx(friction.torque(v), abs=1e-12)


def test_beyond_the_measured_range_eta_is_held() -> None:
    model = LossModel(joint1())
    for i, i_end, v, v_end in ((9.0, 7.0, 1.0, 1.0), (-20.0, -5.0, 1.0, 1.0), (3.0, 3.0, -8.0, -3.0)):
        held = 1.0 - model.loss(i, v) / (model.torque_per_ampere * i)
        end = 1.0 - model.loss(i_end, v_end) / (model.torque_per_ampere * i_end)
        assert held == pytest.approx(end, abs=1e-9)
        assert model.eta(i, v) == pytest.approx(end, abs=1e-9)


def test_a_wild_table_is_bounded() -> None:
    joint = joint1()
    e = joint.efficiency
    assert e is not None
    for p00, driving, driven in ((-9.0, 0.05, 1.0), (99.0, 1.0, 4.0)):
        wild = {name: replace(getattr(e, name), p00=p00) for name in ("i_pos_w_pos", "i_pos_w_neg")}
        model = LossModel(replace(joint, efficiency=replace(e, **wild)))
        assert model.eta(3.0, 1.0) == driving
        assert model.eta(3.0, -1.0) == driven
        assert model.loss(3.0, 1.0) == pytest.approx(18.6 * (1.0 - driving))
        assert model.loss(3.0, -1.0) == pytest.approx(18.6 * (1.0 - driven))
        inverse = replace(e, convention="motor_over_joint", **wild)
        model = LossModel(replace(joint, efficiency=inverse))
        assert model.eta(3.0, 1.0) == pytest.approx(1.05 - driving)  # the reciprocal meets the other end
        assert model.eta(3.0, -1.0) == pytest.approx(5.0 - driven)


def test_arrays_have_the_values_of_single_calls() -> None:
    i, v = random_points(5, 20000)
    points = list(zip(i.tolist(), v.tolist(), strict=True))
    for joint in [*both_conventions(joint1()), replace(joint1(), efficiency=None)]:
        model = LossModel(joint)
        assert model.loss_many(i, v).tolist() == [model.loss(a, b) for a, b in points]


def test_without_efficiency_the_loss_is_friction() -> None:
    joint = replace(joint1(), efficiency=None)
    model = LossModel(joint)
    assert model.loss(4.0, 0.7) == FrictionModel(joint.friction).torque(0.7)
    with pytest.raises(ValueError, match="no efficiency"):
        model.eta(1.0, 1.0)


W0 = 0.02
SEEDS = range(20, 24)


def side_by_hand(side: LossSide, load: float, speed: float, thermal: float = 0.0, vs: float = 0.05) -> float:
    """L_d between the outer nodes as the module's docstring says, with numpy's own interpolation."""
    c, f, q = (
        float(np.interp(load, NODES, values))
        for values in (side.constant_nm, side.viscous_nms_per_rad, side.quadratic_nms2_per_rad2)
    )
    peak = side.stribeck_nm * math.exp(-((speed / vs) ** 2))
    return max(c + peak + (f + thermal) * speed + q * speed**2, 0.0)


def additive_by_hand(
    loss: AdditiveLoss, raw: float, v: float, s: float, thermal: float = 0.0
) -> tuple[float, float]:
    speed = min(abs(v), loss.velocity_max_rad_s)
    positive = side_by_hand(loss.positive, raw, speed, thermal)
    negative = side_by_hand(loss.negative, -raw, speed, thermal)
    return (1 + s) / 2 * positive - (1 - s) / 2 * negative, (positive + negative) / 2 * (1 - s * s)


def scattered_points(seed: int, count: int = 400) -> list[tuple[float, float]]:
    """(raw, v) inside the nodes of both directions, half of them slow."""
    rng = np.random.default_rng(seed)
    v = rng.uniform(-4.0, 4.0, count)
    v[::2] *= 0.02
    return list(zip(rng.uniform(-30.0, 30.0, count).tolist(), v.tolist(), strict=True))


def test_additive_loss_by_hand() -> None:
    """Nodes 0 and 10 Nm, load 5 Nm at 2 rad/s: (1+3)/2 + (0.5+0.7)/2*2 + (0.1+0.3)/2*4 = 2 + 1.2 + 0.8."""
    side = LossSide((1.0, 3.0), (0.5, 0.7), (0.1, 0.3), 0.8)
    model = AdditiveLossModel(AdditiveLoss((0.0, 10.0), side, side, 0.05, 3.0, 25.0, 2.0, 0.025))
    assert model.loss(5.0, 2.0, 0.0) == (pytest.approx(4.0, abs=1e-12), 0.0)
    assert model.loss(-5.0, -2.0, 0.0) == (pytest.approx(-4.0, abs=1e-12), 0.0)
    assert model.loss(5.0, 2.0, -0.25)[0] == pytest.approx(
        3.5, abs=1e-12
    )  # thermal: a quarter less per rad/s


@pytest.mark.parametrize("seed", SEEDS)
def test_additive_formula_between_the_nodes(seed: int) -> None:
    loss = loss_of(seed)
    model = AdditiveLossModel(loss)
    for raw, v in scattered_points(seed):
        assert model.loss(raw, v, -0.3) == pytest.approx(
            additive_by_hand(loss, raw, v, math.tanh(v / W0), -0.3), abs=1e-7
        )
        for s in (-1.0, -0.4, 0.0, 0.9, 1.0):  # a direction from the observer in place of the velocity's
            assert model.loss(raw, v, 0.0, s) == pytest.approx(additive_by_hand(loss, raw, v, s), abs=1e-12)


def test_beyond_the_outer_nodes_the_additive_constant_goes_on_and_the_slopes_are_held() -> None:
    loss = loss_of(5)
    model = AdditiveLossModel(loss)
    side = loss.positive
    last, before = NODES[-1], NODES[-2]
    slope = (side.constant_nm[-1] - side.constant_nm[-2]) / (last - before)
    for v in (0.5, 1.0, 2.5):
        edge = model.loss(last, v, 0.0)[0]
        assert model.loss(last + 10.0, v, 0.0)[0] == pytest.approx(edge + 10.0 * slope, abs=1e-9)
    first = (side.constant_nm[1] - side.constant_nm[0]) / (NODES[1] - NODES[0])
    far = max(side_by_hand(side, NODES[0], 1.0) - 20.0 * first, 0.0)
    assert model.loss(NODES[0] - 20.0, 1.0, 0.0)[0] == pytest.approx(far, abs=1e-9)


def test_faster_than_measured_counts_as_measured() -> None:
    model = AdditiveLossModel(loss_of(6))
    assert model.loss(7.0, 9.0, 0.0) == model.loss(7.0, 3.0, 0.0)
    assert model.loss(7.0, 2.9, 0.0) != model.loss(7.0, 3.0, 0.0)


# ---- continuity and sign


@pytest.mark.parametrize("seed", SEEDS)
def test_additive_loss_has_no_jump(seed: int) -> None:
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
def test_the_additive_loss_dissipates(seed: int) -> None:
    """Of the sign of v beyond w0 while the sides differ by less than exp(2) = 7.4, and further out in any case."""
    model = AdditiveLossModel(loss_of(seed))
    for raw, v in scattered_points(seed):
        if abs(v) >= W0 and abs(raw) <= 20.0:
            assert model.loss(raw, v, 0.0)[0] * v >= 0.0, (seed, raw, v)
    rng = np.random.default_rng(seed)
    drawn = [rng.normal(0.0, 5.0, (3, 8)) for _ in range(2)]
    wild = [  # only the quadratic part and the temperature may take away: a file with other signs is refused
        LossSide(*(tuple(each.tolist()) for each in (abs(c), abs(v), q)), stribeck_nm=0.5)
        for c, v, q in drawn
    ]
    model = AdditiveLossModel(replace(loss_of(seed), positive=wild[0], negative=wild[1]))
    zero = 0
    for raw, v in scattered_points(seed):
        value, half = model.loss(raw, 10.0 * v, -1.0)
        assert half >= 0.0
        if abs(10.0 * v) > 11 * W0:
            assert value * v >= 0.0, (seed, raw, v)
            zero += value == 0.0
    assert zero > 10  # a fit that would feed energy in is cut at zero


# ---- standstill


@pytest.mark.parametrize("seed", SEEDS)
def test_at_rest_the_additive_loss_is_the_middle_of_the_friction_interval(seed: int) -> None:
    """Friction holds any torque from tau_raw - L_+ to tau_raw + L_-, both at v -> 0 with the Stribeck peak."""
    loss = loss_of(seed)
    model = AdditiveLossModel(loss)
    for raw in (-25.0, -3.0, 0.0, 0.7, 18.0):
        low = raw - side_by_hand(loss.positive, raw, 0.0)
        high = raw + side_by_hand(loss.negative, -raw, 0.0)
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


# ---- additive_twin


def additive_twin(model: AdditiveLossModel, points: FloatArray, direction: FloatArray | None) -> FloatArray:
    raw, v, temperature = points
    found = model.loss_many(raw, v, temperature, direction)
    one = [
        model.loss(a, b, model.thermal(t), None if direction is None else direction[k])
        for k, (a, b, t) in enumerate(points.T.tolist())
    ]
    return np.array(found) - np.array(one).T


@pytest.mark.parametrize("seed", SEEDS)
def test_additive_twin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    raw = np.concatenate((rng.uniform(-70.0, 70.0, 500), NODES, -np.array(NODES)))
    v = rng.normal(size=len(raw)) * rng.choice([0.01, 0.1, 2.0], len(raw))
    temperature = rng.choice([math.nan, 25.0, 12.3, 44.0, 300.0, -math.inf], len(raw))
    model = AdditiveLossModel(loss_of(seed))
    assert np.max(np.abs(additive_twin(model, np.array([raw, v, temperature]), None))) < 1e-12
    s = np.clip(rng.normal(size=len(raw)), -1.0, 1.0) * rng.choice([1.0, 1.0 - 1e-10, 1.0 - 1e-8], len(raw))
    assert np.max(np.abs(additive_twin(model, np.array([raw, v, temperature]), s))) < 1e-12
