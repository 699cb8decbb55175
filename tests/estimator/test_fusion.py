"""Fusion of motor current and torsion: its limits, its variance against a Monte Carlo, its twin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from jtqd.estimator.joint import FusedSigma
from jtqd.estimator.uncertainty import HOLD_S, Fusion, held
from tests.estimator.fused_helpers import SIGMA

RAW, LOSS, HALF, V, TORSION_NM = 12.0, 3.0, 0.0, 1.0, 8.0


def test_an_exact_torsion_is_the_result() -> None:
    value, sigma = Fusion(replace(SIGMA, torsion_nm=1e-9, torsion_load=0.0), True).fuse(
        RAW, LOSS, HALF, V, TORSION_NM
    )
    assert value == pytest.approx(TORSION_NM, abs=1e-12)
    assert sigma == pytest.approx(SIGMA.reference_nm, abs=1e-12)


def test_a_worthless_torsion_leaves_the_current_path() -> None:
    variance = 0.2**2 + 0.1**2 * V**2 + 0.02**2 * RAW**2
    for fusion in (Fusion(replace(SIGMA, torsion_nm=1e9), True), Fusion(SIGMA, False)):
        value, sigma = fusion.fuse(RAW, LOSS, HALF, V, TORSION_NM)
        assert value == pytest.approx(RAW - LOSS, abs=1e-12)
        assert sigma == pytest.approx((variance + SIGMA.reference_nm**2) ** 0.5, abs=1e-9)


def test_at_rest_the_torsion_takes_over() -> None:
    """The wider friction leaves the current path open, the more of the result is torsion, without end."""
    fusion = Fusion(SIGMA, True)
    away = [abs(fusion.fuse(RAW, LOSS, half, 0.0, TORSION_NM)[0] - TORSION_NM) for half in (0, 1, 5, 50, 1e4)]
    assert away == sorted(away, reverse=True)
    assert away[-1] < 1e-6


def test_both_alike_is_the_mean() -> None:
    sigma = FusedSigma(0.3, 0.0, 0.0, 0.3, 0.0, 0.0, (1.0, 1.0, 1.0, 1.0))
    assert Fusion(sigma, True).fuse(RAW, LOSS, 0.0, V, 8.0) == pytest.approx((8.5, 0.3 / 2**0.5), abs=1e-12)


@pytest.mark.parametrize(
    ("raw", "v", "half", "torsion"), [(12.0, 1.0, 0.0, 8.0), (-30.0, 2.5, 0.0, -20.0), (5, 0, 2, 3)]
)
def test_sigma_is_the_scatter_of_the_result(raw: float, v: float, half: float, torsion: float) -> None:
    """Both paths and the reference scattered as the formula says: 400 000 draws around one truth, 1 % tolerance."""
    fusion = Fusion(SIGMA, True)
    alpha, sigma = (
        float(x[0]) for x in fusion.weigh_many(*(np.array([float(x)]) for x in (raw, half, v, torsion)))
    )
    assert fusion.fuse(raw, 0.0, half, v, torsion)[1] == pytest.approx(sigma, abs=1e-12)
    rng = np.random.default_rng(11)
    current_sd = (0.2**2 + (0.1 * v) ** 2 + (0.02 * raw) ** 2 + half**2) ** 0.5
    torsion_sd = (0.35**2 + (0.015 * torsion) ** 2) ** 0.5
    a, b, zero = (rng.normal(0.0, sd, 400_000) for sd in (current_sd, torsion_sd, SIGMA.reference_nm))
    assert np.std(a + alpha * (b - a) - zero) == pytest.approx(sigma, rel=0.01)
    best = min(np.std(a + share * (b - a)) for share in np.linspace(0.0, 1.0, 101))
    assert np.std(a + alpha * (b - a)) == pytest.approx(best, rel=0.001)  # no other weights do better


def test_arrays_have_the_values_of_single_calls() -> None:
    rng = np.random.default_rng(3)
    columns = [rng.normal(0.0, scale, 500) for scale in (20.0, 5.0, 2.0, 2.0, 20.0)]
    columns[2] = np.abs(columns[2])
    for with_torsion in (True, False):
        fusion = Fusion(SIGMA, with_torsion)
        one = np.array([fusion.fuse(*row) for row in np.array(columns).T.tolist()]).T
        assert np.array_equal(np.array(fusion.fuse_many(*columns)), one)


# ---- memory of the friction interval


def after(half: float, before: float, dt: float) -> float:
    """The second of two samples whose first left `before`."""
    return float(held(np.array((before, half)), np.array((1.0, dt)), np.ones(2, np.bool_))[1])


def test_what_friction_left_open_is_forgotten_over_50_ms() -> None:
    """A wider interval counts at once, a narrower one only as the memory fades: e^-1 after HOLD_S, in steps of any size."""
    assert after(3.0, 1.0, 0.001) == 3.0
    assert after(0.0, 3.0, 0.001) == pytest.approx(3.0 * (1.0 - 0.001 / HOLD_S), rel=1e-3)
    for dt in (0.0002, 0.001, 0.003):
        memory = 3.0
        for _ in range(round(HOLD_S / dt)):
            memory = after(0.0, memory, dt)
        assert memory == pytest.approx(3.0 * np.exp(-1.0), rel=0.04)
    rng = np.random.default_rng(5)
    for half, before, dt in rng.uniform((0.0, 0.0, 1e-4), (5.0, 5.0, 2e-3), (500, 3)).tolist():
        now = after(half, before, dt)
        assert max(half, before * np.exp(-dt / HOLD_S)) <= now <= max(half, before)
        assert after(half + 1e-9, before + 1e-9, dt) - now <= 1e-9 + 1e-15  # continuous


def test_the_memory_of_a_run() -> None:
    """As step by step, and begun anew where nothing was observed."""
    rng = np.random.default_rng(6)
    half, dt = np.maximum(rng.normal(size=400), 0.0) * 5.0, rng.uniform(0.0005, 0.002, 400)
    running = rng.random(400) > 0.05
    got = held(half, dt, running)
    memory = 0.0
    for k in range(400):
        memory = after(half[k], memory, dt[k]) if running[k] else 0.0
        assert got[k] == memory
    begins = np.flatnonzero(~running[:-1] & running[1:]) + 1
    assert len(begins) > 5
    assert np.array_equal(got[begins], half[begins])
    assert not got[~running].any()


# ---- what the slip leaves open


def test_an_open_slip_widens_sigma_and_gives_the_weight_to_the_current() -> None:
    """As if the torsion's own standard deviation were that much larger, in both forms; nothing open is the default."""
    fusion = Fusion(replace(SIGMA, torsion_load=0.0), True)
    wider = Fusion(replace(SIGMA, torsion_nm=(0.35**2 + 0.4**2) ** 0.5, torsion_load=0.0), True)
    known = fusion.fuse(RAW, LOSS, HALF, V, TORSION_NM)
    assert fusion.fuse(RAW, LOSS, HALF, V, TORSION_NM, 0.0) == known
    opened = fusion.fuse(RAW, LOSS, HALF, V, TORSION_NM, 0.4)
    assert opened == pytest.approx(wider.fuse(RAW, LOSS, HALF, V, TORSION_NM), abs=1e-12)
    assert opened[1] > known[1]
    assert abs(opened[0] - (RAW - LOSS)) < abs(known[0] - (RAW - LOSS))
    columns = [np.full(3, x) for x in (RAW, LOSS, HALF, V, TORSION_NM)]
    many = fusion.fuse_many(*columns, np.array((0.0, 0.4, 0.4)))
    assert np.array(many)[:, 0] == pytest.approx(known, abs=1e-12)
    assert np.array(many)[:, 1] == pytest.approx(opened, abs=1e-12)
