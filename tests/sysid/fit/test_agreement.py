"""Section `fused.agreement`: levels of unseen runs, and none where nothing can be told."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import Agreement
from jtqd.estimator.path_difference import turn_waves
from jtqd.models.files import load_joint, shipped
from jtqd.sysid.fit.fused import fit_fused
from jtqd.sysid.fit.repeatability import LOWERED, QUANTILE, Levels, TurnRun, fit_agreement, fit_turn
from tests.sysid.fit.test_fused import emulated


def test_levels_are_quantiles_over_all_blocks() -> None:
    source = np.random.default_rng(3)
    runs = [tuple(source.uniform(0.0, most, 1000) for most in (4.0, 1.0, 0.02, 0.5, 3.0)) for _ in range(3)]
    found = fit_agreement(lambda beyond: runs)  # type: ignore[arg-type, return-value]
    assert found is not None
    assert found.slow_nm == pytest.approx(np.sqrt(4.0 * QUANTILE), rel=0.03)
    assert found.fast_nm == pytest.approx(np.sqrt(QUANTILE), rel=0.03)
    assert found.gain == pytest.approx(0.02 * QUANTILE, rel=0.03)
    assert found.zero_nm == pytest.approx(0.5 * QUANTILE, rel=0.03)
    assert found.lowered_nm == pytest.approx(3.0 * LOWERED, rel=0.01)


def test_ordinary_doubt_is_that_beyond_the_levels_found() -> None:
    asked: list[Agreement] = []

    def of_runs(beyond: Agreement) -> list[Levels]:
        asked.append(beyond)
        ones = np.ones(400)
        return [(ones, ones, ones, ones, ones * (5.0 if len(asked) == 1 else 2.0))]

    found = fit_agreement(of_runs)
    assert found is not None
    assert asked[1:] == [replace(found, lowered_nm=0.0)]
    assert asked[0].gain_sigmas == found.gain_sigmas
    assert found.lowered_nm == pytest.approx(2.0)


def test_too_little_motion_has_no_levels() -> None:
    short = tuple(np.ones(150) for _ in range(5))
    assert fit_agreement(lambda beyond: [short]) is None  # type: ignore[arg-type, return-value, list-item]


def test_the_fit_writes_levels_of_the_size_of_its_own_errors() -> None:
    joint = load_joint(shipped("joint1.yaml"))
    runs = [emulated(7000 + k, 6.0, day=k)[0] for k in range(8)]
    fused = fit_fused(runs, joint.friction, joint.rated_torque_nm).fused
    assert fused.agreement is not None
    assert fused.torsion is not None
    assert 0.2 * fused.sigma.torsion_nm < fused.agreement.slow_nm < 10.0 * fused.sigma.current_nm
    assert fused.agreement.gain < 0.05
    assert 0.0 < fused.agreement.lowered_nm < 0.2 * joint.rated_torque_nm
    assert fused.envelope is not None
    assert fused.envelope.load_nm is not None
    sensor = max(float(np.abs(run.sensor_nm[run.moving]).max()) for run in runs)
    assert fused.envelope.load_nm == pytest.approx(sensor, rel=0.05)
    assert fit_fused(runs, joint.friction).fused.agreement is None  # nothing is known of the joint's size


PARTS = np.random.default_rng(5).normal(size=(4, 6)) * np.array([[0.5], [0.1], [0.3], [0.2]])


def turning(seed: int, parts: FloatArray = PARTS) -> TurnRun:
    """A run of a joint with these waves, whose day changes them a little, and what is slow a lot."""
    source, n = np.random.default_rng(seed), 4000
    t = np.arange(n) * 1e-3
    v = 1.2 + 0.8 * np.sin(2.0 * t + source.uniform(0.0, 6.0))
    loss = source.uniform(2.0, 6.0) + v
    angle = 100.0 * np.cumsum(v) * 1e-3
    waves = np.column_stack([f(order * angle) for order in (1, 2, 4) for f in (np.cos, np.sin)])
    of_day = parts + 0.05 * source.normal(size=parts.shape) * np.array([[1.0], [0.0], [0.0], [0.0]])
    size = np.column_stack((np.ones(n), loss, v, v * v)) @ of_day
    apart = np.einsum("nk,nk->n", waves, size) + source.normal() + 0.5 * source.normal() * v
    return TurnRun(np.full(n, 1e-3), apart + 0.05 * source.normal(size=n), np.ones(n), v, loss, waves)


def test_waves_of_the_turn_are_those_that_runs_have_in_common() -> None:
    found = fit_turn([turning(seed) for seed in range(24)])
    assert found is not None
    values = (found.constant_nm, found.loss_share, found.viscous_nms_per_rad, found.quadratic_nms2_per_rad2)
    other = turning(101, PARTS * np.array([[-1.0], [1.0], [1.0], [1.0]]))
    for run in (turning(100), other):
        expected = np.einsum(
            "nk,nk->n",
            run.waves,
            np.column_stack((np.ones(4000), run.loss_nm, run.velocity_rad_s, run.velocity_rad_s**2))
            @ (np.array(values) - PARTS),
        )
        assert np.sqrt(np.mean(expected**2)) < 0.1
    deviations = [math.hypot(*row) for row in found.root()]
    np.testing.assert_allclose(deviations, 0.05, rtol=0.5)
    assert turn_waves(found, *turning(100))[1].max() < found.limit
    _, square = turn_waves(found, *other)
    assert square[1000 // 64] > found.limit, "the first second"


def test_too_few_runs_have_no_waves() -> None:
    assert fit_turn([turning(seed) for seed in range(15)]) is None
    standing = turning(99)._replace(velocity_rad_s=np.zeros(4000))
    assert fit_turn([*[turning(seed) for seed in range(15)], standing]) is None
    assert fit_turn([]) is None
