"""Fit of the additive loss on runs made from a known one: it comes back, with the temperature's part, or is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from jtqd.estimator.joint import AdditiveLoss, Friction
from jtqd.estimator.losses import AdditiveLossModel
from jtqd.sysid.fit.losses import LOAD_NODES_NM, PER_K_PRIOR, LossFitError, fit_loss, hat_values
from jtqd.sysid.fit.signals import RunSignals
from tests.sysid.fit.fused_signals import Nuisance, made_run, one_way, smooth_loss

FRICTION = Friction(3.0, 2.0, 0.8, 0.05)


def drawn(rng: np.random.Generator, spread_k: float = 0.0) -> Nuisance:
    """Offsets of +-0.3 Nm, viscous friction of +-10 % and temperatures of +-spread_k from run to run."""
    offset, viscous, warmer = rng.uniform(-1.0, 1.0, 3).tolist()
    return Nuisance(0.3 * offset, 0.2 * viscous, 25.0 + spread_k * warmer)


def made_runs(seed: int, loss: AdditiveLoss, count: int, spread_k: float = 0.0) -> list[RunSignals]:
    rng = np.random.default_rng(seed)
    return [made_run(100 * seed + k, loss, own=drawn(rng, spread_k)) for k in range(count)]


def difference(fitted: AdditiveLoss, truth: AdditiveLoss, runs: list[RunSignals]) -> np.ndarray:
    """Fitted less true loss on a grid of load and speed, where within 1 Nm and 0.15 rad/s there are 50 samples."""
    raw = np.concatenate([run.seen.raw_nm for run in runs])
    v = np.concatenate([run.seen.velocity_rad_s for run in runs])
    a, b = AdditiveLossModel(fitted), AdditiveLossModel(truth)
    out = []
    for speed in (-2.5, -1.5, -0.8, -0.3, -0.1, 0.1, 0.3, 0.8, 1.5, 2.5):
        for load in np.arange(-28.0, 29.0, 2.0).tolist():
            if np.sum((np.abs(raw - load) < 1.0) & (np.abs(v - speed) < 0.15)) >= 50:
                thermal = a.thermal(truth.temperature_c)
                out.append(a.loss(load, speed, thermal)[0] - b.loss(load, speed, 0.0)[0])
    return np.array(out)


@pytest.mark.parametrize("seed", [1, 2])
def test_a_known_loss_comes_back(seed: int) -> None:
    """Through offsets, ripple and viscous friction of each run's own: 0.1 Nm RMS, of a loss of 3 to 20 Nm."""
    truth = smooth_loss()
    runs = made_runs(seed, truth, 12)
    fit = fit_loss(runs, FRICTION)
    off = difference(fit.loss, truth, runs)
    assert len(off) > 150
    assert np.sqrt(np.mean(off**2)) < 0.1
    assert np.max(np.abs(off)) < 0.35
    assert fit.residual_nm == pytest.approx(0.05, rel=0.15)  # the noise: nothing else is left
    fast = [int(np.sum(np.abs(run.seen.velocity_rad_s) > 0.03)) for run in runs]
    assert fit.samples == sum(-(-count // 10) for count in fast)
    assert fit.loss.velocity_max_rad_s == pytest.approx(
        max(np.abs(run.seen.velocity_rad_s).max() for run in runs)
    )


def test_the_file_s_friction_does_not_shine_through_where_there_are_data() -> None:
    truth = smooth_loss()
    runs = made_runs(3, truth, 8)
    one = fit_loss(runs, FRICTION).loss
    other = fit_loss(runs, replace(FRICTION, coulomb_nm=5.0)).loss
    assert np.max(np.abs(difference(other, one, runs))) < 0.1


@pytest.mark.parametrize("per_k", [0.005, 0.02, 0.035])
def test_viscous_per_k_lies_within_its_interval(per_k: float) -> None:
    """16 runs of +-10 K: less than 2.2 of its own standard deviations off, and better known than before."""
    for seed in (4, 5, 6):
        fit = fit_loss(made_runs(seed, smooth_loss(per_k), 16, 10.0), FRICTION)
        off = fit.loss.viscous_per_k - per_k
        assert fit.viscous_per_k_sigma < 0.75 * PER_K_PRIOR[1]
        assert abs(off) < 2.2 * fit.viscous_per_k_sigma, seed
        assert abs(off) < 0.8 * max(abs(PER_K_PRIOR[0] - per_k), 0.01), seed
        assert abs(fit.loss.temperature_c - 25.0) < 6.0


def test_viscous_per_k_is_exponential() -> None:
    """A joint 25 K warmer or colder: a straight line in T would be 2 % per kelvin too flat on one side."""
    truth = smooth_loss(0.03)
    runs = [
        made_run(700 + k, truth, own=Nuisance(temperature_c=25.0 + warmer), noise_nm=0.01)
        for k, warmer in enumerate((-25.0, 0.0, 25.0) * 3)
    ]
    fit = fit_loss(runs, FRICTION)
    assert fit.loss.viscous_per_k == pytest.approx(0.03, abs=0.0015)
    for temperature in (0.0, 50.0):
        expected = AdditiveLossModel(truth).thermal(temperature)
        assert AdditiveLossModel(fit.loss).thermal(temperature) == pytest.approx(expected, abs=0.08)


def test_without_temperatures_it_is_what_oil_does() -> None:
    runs = [made_run(800 + k, smooth_loss()) for k in range(4)]
    fit = fit_loss(runs, FRICTION)
    assert fit.loss.viscous_per_k == pytest.approx(PER_K_PRIOR[0], abs=1e-6)
    assert fit.viscous_per_k_sigma == pytest.approx(PER_K_PRIOR[1], rel=1e-6)
    assert fit.loss.temperature_c == 25.0
    assert fit_loss(runs, Friction(3.0, 0.0)).loss.thermal_viscous_nms_per_rad == 0.0


def test_hats_are_a_partition_and_linear() -> None:
    load = np.random.default_rng(1).uniform(-36.0, 50.0, 300)
    hats = hat_values(load)
    assert hats.sum(axis=1) == pytest.approx(np.ones(300))
    assert hats @ np.array(LOAD_NODES_NM) == pytest.approx(load)
    assert hats.min() >= 0.0
    outside = np.array((-50.0, 60.0))
    assert hat_values(outside) @ np.array(LOAD_NODES_NM) == pytest.approx(outside)


def test_what_gives_no_loss_is_refused() -> None:
    runs = [made_run(900 + k, smooth_loss()) for k in range(2)]
    for sign, name in ((1.0, "negative"), (-1.0, "positive")):
        with pytest.raises(LossFitError, match=f"found no motion in {name} direction, expected both"):
            fit_loss([one_way(run, sign) for run in runs], FRICTION)
    with pytest.raises(LossFitError, match="found no motion in positive direction"):
        fit_loss([], FRICTION)
    strange = [
        made_run(910 + k, smooth_loss(-0.3), own=Nuisance(temperature_c=25.0 + k), noise_nm=0.01)
        for k in range(-3, 4)
    ]
    with pytest.raises(LossFitError, match=r"found viscous_per_k -0\..*, expected at most 0\.1 either way"):
        fit_loss(strange * 4, FRICTION)


def test_no_fit_has_a_friction_that_gives_energy() -> None:
    """A plant whose loss falls towards standstill: the best Stribeck peak would be negative; what comes out is a file."""
    truth = smooth_loss()
    inverted = replace(
        truth,
        positive=replace(truth.positive, stribeck_nm=-2.5),
        negative=replace(truth.negative, stribeck_nm=-2.5),
        stribeck_velocity_rad_s=0.3,
    )
    fitted = fit_loss(made_runs(7, inverted, 8), replace(FRICTION, stribeck_velocity_rad_s=0.3)).loss
    for side in (fitted.positive, fitted.negative):
        assert side.stribeck_nm == 0.0
        assert min(side.constant_nm) >= 0.0
        assert min(side.viscous_nms_per_rad) >= 0.0
