"""Step by step equals the whole run: with and without torsion, network and temperature, on runs full of faults."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from jtqd.estimator import status as st
from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.estimator import FusedEstimator, estimate_columns, observe_run
from jtqd.estimator.joint import Joint
from jtqd.estimator.losses import AdditiveLossModel
from jtqd.estimator.network import FusedNetwork
from jtqd.estimator.run import EstimateRun, JointColumns, ObservedRun
from jtqd.estimator.settings import EstimatorSettings
from tests.estimator.estimator_helpers import Motion, with_faults
from tests.estimator.fused_helpers import (
    TORSION,
    FakeNetwork,
    fused_joint,
    fused_network,
    patches,
    temperatures,
    twisted,
)

FIELDS = ("torque_nm", "sigma_nm", "status", "tob_nm", "physics_nm", "network_nm")
FUSED = EstimatorSettings(method="fused")
SLIPPING = replace(TORSION, hysteresis_nm=0.7, hysteresis_travel_rad=8e-5, damping_nms_per_rad=9.0)
RUNNING = {st.STARTING, st.VALID, st.STANDSTILL, st.INVALID}


def whole(
    joint: Joint, settings: EstimatorSettings, network: Any, m: Motion, temperature: FloatArray | None
) -> EstimateRun:
    return FusedEstimator(joint, settings, network).run(*m.arrays(), temperature)


def compare(  # noqa: PLR0917 - what both take, and a note
    joint: Joint,
    settings: EstimatorSettings,
    network: Any,
    m: Motion,
    temperature: FloatArray | None,
    note: object,
) -> EstimateRun:
    e = FusedEstimator(joint, settings, network)
    if temperature is None:
        single = [e.step(*row) for row in m.rows()]
    else:
        single = [e.step(*row, t) for row, t in zip(m.rows(), temperature.tolist(), strict=True)]
    run = whole(joint, settings, network, m, temperature)
    for name in FIELDS:
        expected = np.array([getattr(s, name) for s in single], np.float64)
        assert np.asarray(getattr(run, name)) == pytest.approx(expected, abs=1e-9, nan_ok=True), (name, note)
    published = np.isin(run.status, list(st.PUBLISHED))
    for name in ("torque_nm", "sigma_nm"):
        assert np.array_equal(np.isfinite(getattr(run, name)), published), (name, note)
    assert np.array_equal(np.isfinite(run.physics_nm), np.isfinite(run.features).all(axis=1)), note
    return run


@pytest.mark.parametrize("torsion", [TORSION, SLIPPING, None], ids=["torsion", "hysteresis", "rigid"])
@pytest.mark.parametrize("with_network", [True, False], ids=["network", "physics"])
def test_random_runs_equal_their_twin(torsion: Any, with_network: bool) -> None:
    """Reversals, standstill, uneven steps, gaps, NaN, infinities, absurd jumps, a warming joint, holes in the map."""
    seen: set[int] = set()
    for seed in range(5200, 5208):
        network = None
        if with_network:
            small = fused_network(
                seed, size_nm=(0.5, 6.0)[seed % 2], envelope=patches(seed, (20.0, 40.0)).to_mapping()
            )
            network = FusedNetwork(small.data)
        own = (None, 800.0)[seed // 2 % 2]
        settings = replace(FUSED, bandwidth_rad_s=(200.0, 90.0)[seed % 2], torsion_bandwidth_rad_s=own)
        m = with_faults(twisted(seed, 1500), seed) if seed % 4 else twisted(seed, 1500)
        temperature = temperatures(("none", "gaps", "constant", "rising")[seed // 2 % 4], seed, len(m.dt_s))
        run = compare(fused_joint(seed, torsion), settings, network, m, temperature, f"seed {seed}")
        seen |= set(run.status.tolist())
    assert seen == RUNNING | ({st.DEGRADED} if with_network else set())


def test_twin_with_a_network_that_gives_nonsense() -> None:
    """By speed: NaN, infinite, too far, in the range where it fades, and near."""

    def answer(v: float, *_: float) -> float:
        steps = (0.2, math.nan), (0.4, math.inf), (0.6, -1e9), (0.8, 9.9), (1.0, -8.0), (9.0, 2.0)
        return next(value for edge, value in steps if abs(v) < edge)

    m = twisted(7)
    run = compare(fused_joint(), FUSED, FakeNetwork(answer), m, np.full(len(m.dt_s), 25.0), "nonsense")
    assert {st.VALID, st.DEGRADED} <= set(run.status.tolist())
    assert np.nanmax(np.abs(run.torque_nm - run.physics_nm)) == pytest.approx(8.0 * 0.8, abs=1e-6)


def test_no_network_may_be_so_near_that_it_counts() -> None:
    m = twisted(7)
    run = compare(
        fused_joint(), replace(FUSED, network_limit=0.0), FakeNetwork(lambda *_: 1e-9), m, None, "limit 0"
    )
    assert np.array_equal(run.torque_nm, run.physics_nm, equal_nan=True)


def test_the_door_for_run_tables() -> None:
    """`estimate_columns` is the same run, its steps from the time, its temperature from the table."""
    m = twisted(12)
    time = np.cumsum(m.dt_s)
    temperature = temperatures("rising", 12, len(time))
    network = FusedNetwork(fused_network(12).data)
    inputs = m.arrays()[1:]
    columns = JointColumns(
        inputs[0], inputs[1], inputs[2], link_position_rad=inputs[3], temperature_c=temperature
    )
    joint = fused_joint(12)
    door = estimate_columns(joint, FUSED, network, time, columns)
    steps = replace(m, dt_s=np.diff(time, prepend=time[0]))
    direct = whole(joint, FUSED, network, steps, temperature)
    for name in (*FIELDS, "features"):
        assert np.array_equal(getattr(door, name), getattr(direct, name), equal_nan=True), name
    with pytest.raises(
        ValueError, match="joint joint1: the run has no motor_velocity_rad_s, link_position_rad"
    ):
        estimate_columns(joint, FUSED, None, time, JointColumns(inputs[0], inputs[1]))


def test_features_are_what_the_network_gets() -> None:
    asked: list[tuple[float, ...]] = []

    def answer(*x: float) -> float:
        asked.append(x)
        return 0.0

    m = twisted(3, 800)
    joint = fused_joint(3)
    e = FusedEstimator(joint, FUSED, FakeNetwork(answer))
    for row in m.rows():
        e.step(*row, 25.0)
    run = whole(joint, FUSED, None, m, None)
    running = np.isfinite(run.physics_nm)
    assert np.array(asked) == pytest.approx(run.features[running], abs=1e-9)
    assert joint.fused is not None
    seen = observe_run(joint, FUSED, joint.fused.torsion, *m.arrays())
    expected = np.column_stack(
        (seen.velocity_rad_s, seen.raw_nm, seen.torsion_nm - (seen.raw_nm - loss_nm(joint, seen)), seen.waves)
    )
    assert run.features[running] == pytest.approx(expected[running], abs=1e-12)


def loss_nm(joint: Joint, seen: ObservedRun) -> FloatArray:
    assert joint.fused is not None
    unknown = np.full_like(seen.raw_nm, np.nan)
    model = AdditiveLossModel(joint.fused.loss)
    return model.loss_many(seen.raw_nm, seen.velocity_rad_s, unknown, seen.direction)[0]


def test_lengths_and_emptiness() -> None:
    joint = fused_joint()
    empty = whole(joint, FUSED, FusedNetwork(fused_network().data), Motion(*([np.zeros(0)] * 5)), None)
    assert all(len(getattr(empty, name)) == 0 for name in FIELDS)
    with pytest.raises(ValueError, match="expected all of one length"):
        observe_run(joint, FUSED, None, *([np.zeros(3)] * 4), np.zeros(4))
    with pytest.raises(ValueError, match="expected all of one length"):
        observe_run(joint, FUSED, None, *([np.zeros(3)] * 5), np.zeros(2))
    with pytest.raises(ValueError, match="read-only"):
        whole(joint, FUSED, None, twisted(1, 700), None).torque_nm[0] = 1.0
