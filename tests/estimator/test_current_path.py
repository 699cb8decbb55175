"""The current path by a network: inputs against numpy, the loop against whole runs and ONNX Runtime, spread and trust."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.estimator import FusedEstimator, make_estimator, observe_run, quadrants
from jtqd.estimator.joint import Effect, Joint
from jtqd.estimator.native_network import (
    DEFAULT_C,
    DIRECTION_RAD_S,
    INPUTS,
    OUTSIDE,
    QUICK,
    TORQUE_RAD_S,
    TRAVELS_RAD,
    VELOCITY_RAD_S,
)
from jtqd.estimator.network import PathNetwork
from jtqd.estimator.observer import low_pass, slipped
from jtqd.estimator.status import DEGRADED, STARTING, VALID
from tests.estimator.estimator_helpers import Motion
from tests.estimator.fused_helpers import (
    REST_NM,
    TRACKED,
    TRAINED_C,
    FakeNetwork,
    everywhere,
    fused_joint,
    fused_network,
    temperatures,
    twisted,
)

JOINT = fused_joint()
ONE = replace(JOINT, fused=replace(JOINT.fused, torsion=None, tracking=None))  # type: ignore[type-var]


def numpy_inputs(joint: Joint, m: Motion, temperature_c: FloatArray) -> FloatArray:
    """The table of docs/estimator.md, column by column, for a run without a gap."""
    omega, angle, ratio = m.motor_velocity_rad_s, m.motor_position_rad, joint.gear_ratio
    v = omega / ratio

    def motor_nm(rate: float) -> FloatArray:
        momentum = joint.rotor_inertia_kgm2 * rate * omega
        passed = low_pass(joint.torque_constant_nm_per_a * m.current_a + momentum, m.dt_s, rate)
        return np.asarray(ratio * (passed - momentum))

    base = motor_nm(TORQUE_RAD_S[0])
    stops = [slipped(angle, travel)[0] for travel in TRAVELS_RAD]
    turns = [order * angle for order in (1, 2, 4)] + [order * angle / ratio for order in (1, 2)]
    return np.column_stack(
        [
            base,
            *(motor_nm(rate) - base for rate in TORQUE_RAD_S[1:]),
            m.current_a,
            v,
            *(low_pass(v, m.dt_s, rate) - v for rate in VELOCITY_RAD_S[:3]),
            VELOCITY_RAD_S[3] * (v - low_pass(v, m.dt_s, VELOCITY_RAD_S[3])),
            np.tanh(v / DIRECTION_RAD_S),
            temperature_c,
            *(wave(turn) for turn in turns for wave in (np.sin, np.cos)),
            *stops,
            np.abs(base) * stops[2],
            np.sqrt(np.abs(v)) * stops[2],
        ]
    )


def moving(seed: int, count: int = 3000) -> Motion:
    """Uneven steps, rough current, swings of 0.05 to 60 rad of the motor."""
    rng = np.random.default_rng(seed)
    dt = rng.uniform(0.7e-3, 1.4e-3, count)
    t = np.cumsum(dt)
    size, rate = rng.uniform(0.002, 0.6), rng.uniform(1.0, 9.0)
    angle = 100.0 * size * np.sin(rate * t + 1.0) + 3.0
    omega = 100.0 * size * rate * np.cos(rate * t + 1.0)
    current = 2.0 * np.sin(5.0 * t) + rng.normal(0.0, 0.2, count)
    return Motion(dt, current, angle, omega, angle / 100.0)


@pytest.mark.parametrize("seed", range(4))
def test_inputs_are_those_of_the_table(seed: int) -> None:
    m = moving(seed)
    warm = np.linspace(21.0, 31.0, 3000)
    for joint in (ONE, JOINT):
        found = FusedEstimator(joint, TRACKED, FakeNetwork(lambda *_: 0.0)).run(*m.arrays(), warm).features
        assert np.isnan(found[0]).all(), "the observer starts at the first sample"
        assert found[1:] == pytest.approx(numpy_inputs(joint, m, warm)[1:], abs=1e-9)
    assert len(INPUTS) == len(set(INPUTS)) == found.shape[1]


def test_after_a_gap_the_memory_starts_again() -> None:
    m = moving(5)
    m.dt_s[1000] = 0.2
    late = Motion(*(each[1000:] for each in m.arrays()))
    warm = np.full(3000, 25.0)
    whole, part = (
        FusedEstimator(ONE, TRACKED, FakeNetwork(lambda *_: 0.0)).run(*each.arrays(), warm[: len(each.dt_s)])
        for each in (m, late)
    )
    assert whole.status[1000] == STARTING
    assert whole.features[1001:].tolist() == part.features[1:].tolist()


def test_an_unknown_temperature_is_the_middle_of_the_training_and_none_at_all_a_constant() -> None:
    m = moving(6, 10)
    for range_c, expected in ((TRAINED_C, 26.0), (None, DEFAULT_C)):
        network = FakeNetwork(lambda *_: 0.0, everywhere(temperature_c=range_c))
        for given in (None, np.full(10, math.nan)):
            features = FusedEstimator(ONE, TRACKED, network).run(*m.arrays(), given).features
            assert set(features[1:, INPUTS.index("temperature_c")]) == {expected}
    warm = FusedEstimator(ONE, TRACKED, network).run(*m.arrays(), np.full(10, 40.0)).features
    assert set(warm[1:, INPUTS.index("temperature_c")]) == {DEFAULT_C}


@pytest.mark.parametrize("joint", [ONE, JOINT], ids=["one encoder", "two"])
@pytest.mark.parametrize("kind", ["none", "rising", "gaps"])
def test_samples_one_by_one_whole_runs_and_onnx_runtime_agree(joint: Joint, kind: str) -> None:
    """The loop's step gives the run's numbers to the last bit; ONNX Runtime the network's to rounding."""
    m, network = twisted(8, 2000), PathNetwork(fused_network(8, size_nm=5.0).data)
    warm = temperatures(kind, 8, 2000)
    run = FusedEstimator(joint, TRACKED, network).run(*m.arrays(), warm)
    one = FusedEstimator(joint, TRACKED, network)
    rows = m.rows() if warm is None else [(*row, t) for row, t in zip(m.rows(), warm.tolist(), strict=True)]
    steps = [one.step(*row) for row in rows]
    for name in ("torque_nm", "sigma_nm", "network_nm", "physics_nm"):
        assert np.array_equal(getattr(run, name), [getattr(each, name) for each in steps], equal_nan=True)
    assert run.status.tolist() == [each.status for each in steps]
    known = np.isfinite(run.network_nm)
    assert np.count_nonzero(known) > 1000
    x = run.features[known]
    assert run.network_nm[known] == pytest.approx(x[:, 0] + network.run_many(x), abs=1e-9)
    assert np.ptp(network.run_many(x)) > 1.0


def test_effects_of_the_joint_file_are_corrected_before() -> None:
    m = twisted(9, 1500)
    off = replace(JOINT, effects=(Effect("current_offset", {"offset_a": 0.5}),))
    found = (
        make_estimator(off, TRACKED, FakeNetwork(lambda *_: 0.0))
        .run(  # type: ignore[arg-type]
            *replace(m, current_a=m.current_a + 0.5).arrays(), None
        )
        .features
    )
    plain = FusedEstimator(JOINT, TRACKED, FakeNetwork(lambda *_: 0.0)).run(*m.arrays(), None).features
    assert found[1:] == pytest.approx(plain[1:], abs=1e-9, nan_ok=True)


# ---- sigma and trust


def held(v: float, i: float = 1.0, temperature_c: float = 25.0, **network: object) -> tuple[float, float]:
    """(value less 6.2 Nm/A, sigma) of a joint with one encoder at a constant state."""
    e = FusedEstimator(ONE, TRACKED, FakeNetwork(lambda *_: 0.25, **network))  # type: ignore[arg-type]
    for k in range(400):
        got = e.step(0.001, i, 0.1 * v * k, 100.0 * v, 1e-3 * v * k, temperature_c)
    return got.torque_nm - 6.2 * i, got.sigma_nm


def own(i: float, v: float) -> float:
    """Sigma of the network's view, before the factor of its quadrant."""
    return math.sqrt(0.3**2 + (0.2 * v) ** 2 + (0.04 * 6.2 * i) ** 2)


@pytest.mark.parametrize(
    ("i", "v", "scale"), [(1.0, 0.1, 0.5), (-1.0, -1.5, 0.6), (-2.0, 1.5, 0.7), (1.0, -3.0, 0.8)]
)
def test_sigma_by_speed_load_and_quadrant(i: float, v: float, scale: float) -> None:
    assert held(v, i) == pytest.approx((0.25, scale * own(i, v)), abs=1e-9)


@pytest.mark.parametrize(
    ("state", "trust"),
    [
        ({"v": 0.6}, 1.0),
        ({"v": 0.6, "i": 10.2}, 0.0),  # beyond 60 Nm of the motor
        ({"v": 5.0}, 0.0),
        ({"v": 0.6, "temperature_c": TRAINED_C[1] + 0.25}, 0.75),
        ({"v": 0.6, "temperature_c": TRAINED_C[0] - 3.0}, 0.0),
        ({"v": 0.6, "temperature_c": math.nan}, 0.0),
    ],
)
def test_outside_of_the_training_sigma_grows_and_the_value_stays(
    state: dict[str, float], trust: float
) -> None:
    value, sigma = held(**state)  # type: ignore[arg-type]
    assert value == pytest.approx(0.25, abs=1e-9)
    inside = own(state.get("i", 1.0), state["v"])
    assert sigma == pytest.approx(0.5 * math.hypot(inside, (1.0 - trust) * OUTSIDE * 40.0), abs=1e-9)


@pytest.mark.parametrize("which", range(3))
def test_quick_motions_take_the_trust_and_give_it_back(which: int) -> None:
    """Each of the limits alone; what exceeds one is forgotten within 0.05 s."""
    m, column = moving(11), (9, 1, 2)[which]
    features = FusedEstimator(ONE, TRACKED, FakeNetwork(lambda *_: 0.0)).run(*m.arrays()).features
    limit = 0.55 * float(np.nanquantile(np.abs(features[:, column]), 0.95))
    a, b, c = (limit if n == which else 1e6 for n in range(3))
    run = FusedEstimator(ONE, TRACKED, FakeNetwork(lambda *_: 0.0, quick=(a, b, c))).run(
        *m.arrays(), np.full(3000, 25.0)
    )
    sizes = np.abs(run.features[:, column]) / limit
    quick, trust = 0.0, np.ones(3000)
    for k in range(1, 3000):
        quick = max(float(sizes[k]), quick * 0.05 / (0.05 + float(m.dt_s[k])))
        trust[k] = np.clip((QUICK - quick) / (QUICK - 1.0), 0.0, 1.0)
    raw = observe_run(ONE, TRACKED, None, *m.arrays())
    spread = 0.3**2 + (0.2 * raw.velocity_rad_s) ** 2 + (0.04 * raw.raw_nm) ** 2
    scale = np.array([0.5, 0.6, 0.7, 0.8])[quadrants(raw.raw_nm, raw.velocity_rad_s)]
    expected = scale * np.sqrt(spread + ((1.0 - trust) * OUTSIDE * 40.0) ** 2)
    moves = run.status == VALID
    moves |= (run.status == DEGRADED) & (np.abs(raw.velocity_rad_s) > 0.02)
    assert run.sigma_nm[moves] == pytest.approx(expected[moves], abs=1e-9)
    assert trust[moves].min() < 0.2
    assert trust[moves].max() == 1.0


def test_limits_of_quickness_are_where_trust_begins_to_fall() -> None:
    def sigma(limit: float) -> float:
        e = FusedEstimator(ONE, TRACKED, FakeNetwork(lambda *_: 0.0, quick=(1e6, limit, 1e6)))
        for k in range(300):
            got = e.step(0.001, 1.0, 0.06 * k, 60.0, 0.0, 25.0)
        got = e.step(0.001, 3.0, 0.06 * 300, 60.0, 0.0, 25.0)
        return got.sigma_nm / 0.5

    step = quickness()
    calm, half = sigma(1.01 * step), 0.5 * (1.0 + QUICK)
    assert calm == sigma(1e6)
    assert sigma(step / half) == pytest.approx(math.hypot(calm, 0.5 * OUTSIDE * 40.0), rel=1e-6)
    assert sigma(step / (1.01 * QUICK)) == pytest.approx(math.hypot(calm, OUTSIDE * 40.0), rel=1e-6)


def quickness() -> float:
    """|tau_r at 800 - tau_r at 200| at the first sample of a step of 2 A."""

    def part(rate: float) -> float:
        x = rate * 1e-3
        return 1.0 + math.expm1(-x) / x

    return 2.0 * 6.2 * (part(800.0) - part(200.0))


def test_at_rest_the_interval_is_that_of_the_training_and_wider_outside() -> None:
    assert held(0.0)[1] == pytest.approx(REST_NM)
    cool = TRAINED_C[0] - 0.25
    assert held(0.0, temperature_c=cool)[1] == pytest.approx(math.hypot(0.8, 2.0 * 0.25 * OUTSIDE * 40.0))
