"""Day-to-day offsets and agreement of the paths: found as drawn, and no section where the runs do not show it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.fusion import turn_waves
from jtqd.estimator.joint import Agreement, DayZeros, Fused, FusedSigma
from jtqd.sysid.fit import fused as fits
from jtqd.sysid.fit.calibration import FusedErrors, PathResiduals, fused_errors
from jtqd.sysid.fit.fused import LOWERED, QUANTILE, correlation, fit_agreement, fit_turn, fit_zeros
from tests.estimator.fused_helpers import NARROW

K, RATED, DAYS = 12000.0, 40.0, 24
SIGMA = FusedSigma(0.6, 0.0, 0.0, 0.5, 0.0, 0.02, (1.0, 1.0, 1.0, 1.0))


def runs_of_days(offset_nm: float, within_nm: float = 0.2) -> list[PathResiduals]:
    """Runs to and fro of days whose offsets have this spread; both paths err within a run, the current more."""
    rng = np.random.default_rng(5)
    n = 8000
    t = np.arange(n) * 1e-3
    v = 1.2 * np.sin(2.5 * t)
    torque = 8.0 * np.sin(1.7 * t)
    found = []
    for offset in rng.normal(0.0, offset_nm, DAYS):
        slow = np.repeat(rng.normal(0.0, within_nm, n // 100), 100)
        friction = rng.normal(0.0, 0.3) * np.sign(v) + np.repeat(rng.normal(0.0, 0.5, n // 100), 100)
        none = np.zeros(n)
        paths = (torque, v, none, torque, none, friction, offset + slow)
        further = {"stiffness_nm_per_rad": np.full(n, K), "loss_nm": none, "turn": np.zeros((n, 6))}
        found.append(PathResiduals(*paths, np.full(n, 1e-3), np.tanh(v / 0.02), none, **further))
    return found


def fused(sigma: FusedSigma = SIGMA) -> Fused:
    assert NARROW.fused is not None
    return replace(NARROW.fused, sigma=sigma, tracking=None)  # these runs have no tracked torsion


def zeros_of(runs: list[PathResiduals], sigma: FusedSigma = SIGMA) -> DayZeros:
    found = fit_zeros(runs, fused(sigma), RATED)
    assert found is not None
    return found


def test_the_spread_of_the_days_is_an_angle_and_a_torque_less_the_sensors_offset() -> None:
    days = runs_of_days(0.4)
    found = zeros_of(days)
    drawn = float(np.std([run.torsion_error_nm.mean() for run in days]))
    assert found.spread_nm == pytest.approx(drawn, rel=0.01)
    assert found.spread_rad == pytest.approx(drawn / K, rel=0.01)
    other = zeros_of(days, replace(SIGMA, reference_nm=0.2))
    assert other.spread_nm**2 == pytest.approx(found.spread_nm**2 - 0.2**2 + 0.02**2, rel=1e-6)


def test_the_correlation_time_is_of_what_no_state_of_the_day_explains() -> None:
    """Within the runs noise lasts 0.1 s; offset and friction of the day are states. Too short runs have none."""
    within, friction, spread = 0.2, 0.5, 0.4
    assumed = SIGMA.current_nm**2 + SIGMA.torsion_nm**2 - spread**2
    expected = 0.1 * (within**2 + friction**2) / assumed
    days = runs_of_days(spread, within)
    assert correlation(days, SIGMA, spread) == pytest.approx(expected, rel=0.15)
    assert zeros_of(days).correlation_s == pytest.approx(expected, rel=0.15)
    short = [PathResiduals(*(column[:3000] for column in run)) for run in days]
    assert correlation(short, SIGMA, 0.4) is None


def test_days_that_hardly_differ_and_few_runs_have_no_section() -> None:
    assert fit_zeros(runs_of_days(0.02), fused(), RATED) is None
    assert fit_zeros(runs_of_days(0.4)[:7], fused(), RATED) is None


def test_tracked_offsets_reduce_error_and_spread() -> None:
    days = runs_of_days(0.4)
    section = replace(fused(), zeros=zeros_of(days))
    tracked = [fused_errors(run, section, RATED, track_zeros=True) for run in days]
    plain = [fused_errors(run, fused()) for run in days]

    def mean_square(of: list[FusedErrors]) -> float:
        return float(np.mean([np.mean(run.error_nm[5000:] ** 2) for run in of]))

    assert mean_square(tracked) < 0.8 * mean_square(plain)
    last, first = (np.mean([run.spread_nm[k] for run in of]) for of, k in ((tracked, -1), (plain, 0)))
    assert last < 0.9 * first


# Agreement ---------------------------------------------------------------------------------------------


def agreement_with(monkeypatch: pytest.MonkeyPatch, blocks: list[tuple[FloatArray, ...]]) -> Agreement | None:
    """The section where the estimator finds these levels, one entry per call."""
    asked = iter(blocks)
    monkeypatch.setattr(fits, "levels", lambda usual, *_: next(asked))
    return fit_agreement(runs_of_days(0.4)[:1], fused(), RATED)


def test_levels_are_quantiles_over_all_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    source = np.random.default_rng(3)
    drawn = [tuple(source.uniform(0.0, most, 3000) for most in (4.0, 1.0, 0.02, 0.5, 3.0)) for _ in range(2)]
    found = agreement_with(monkeypatch, drawn)
    assert found is not None
    assert found.slow_nm == pytest.approx(np.sqrt(4.0 * QUANTILE), rel=0.03)
    assert found.fast_nm == pytest.approx(np.sqrt(QUANTILE), rel=0.03)
    assert found.gain == pytest.approx(0.02 * QUANTILE, rel=0.03)
    assert found.zero_nm == pytest.approx(0.5 * QUANTILE, rel=0.03)
    assert found.lowered_nm == pytest.approx(3.0 * LOWERED, rel=0.01)


def test_the_doubt_of_ordinary_days_is_that_beyond_the_levels_found(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Agreement | None] = []

    def levels(usual: Fused, *_: object) -> tuple[FloatArray, ...]:
        asked.append(usual.agreement)
        ones = np.ones(400)
        return ones, ones, ones, ones, ones * (5.0 if len(asked) == 1 else 2.0)

    monkeypatch.setattr(fits, "levels", levels)
    found = fit_agreement(runs_of_days(0.4)[:1], fused(), RATED)
    assert found is not None
    assert asked[1:] == [replace(found, lowered_nm=0.0)]
    assert asked[0] is not None
    assert asked[0].gain_sigmas == found.gain_sigmas
    assert found.lowered_nm == pytest.approx(2.0)


def test_too_little_motion_has_no_levels(monkeypatch: pytest.MonkeyPatch) -> None:
    assert agreement_with(monkeypatch, [tuple(np.ones(150) for _ in range(5))]) is None


PARTS = np.random.default_rng(5).normal(size=(4, 6)) * np.array([[0.5], [0.1], [0.3], [0.2]])


def turning(seed: int, parts: FloatArray = PARTS, speed: float = 1.0) -> PathResiduals:
    """A run of a joint with these waves, which a day changes a little, and with a slow part that it changes a lot."""
    source, n = np.random.default_rng(seed), 4000
    t = np.arange(n) * 1e-3
    v = 1.2 + 0.8 * np.sin(2.0 * t + source.uniform(0.0, 6.0))
    loss = source.uniform(2.0, 6.0) + v
    angle = 100.0 * np.cumsum(v) * 1e-3
    waves = np.column_stack([f(order * angle) for order in (1, 2, 4) for f in (np.cos, np.sin)])
    of_day = parts + 0.05 * source.normal(size=parts.shape) * np.array([[1.0], [0.0], [0.0], [0.0]])
    size = np.column_stack((np.ones(n), loss, v, v * v)) @ of_day
    apart = np.einsum("nk,nk->n", waves, size) + source.normal() + 0.5 * source.normal() * v
    apart += 0.05 * source.normal(size=n)
    none = np.zeros(n)
    paths = (none, speed * v, none, none, none, none, apart)
    return PathResiduals(*paths, np.full(n, 1e-3), np.ones(n), none, loss_nm=loss, turn=waves)


def test_waves_of_the_turn_are_those_that_runs_have_in_common() -> None:
    found = fit_turn([turning(seed) for seed in range(24)])
    assert found is not None

    def square(run: PathResiduals) -> FloatArray:
        columns = run.dt_s, run.apart_nm, run.direction, run.velocity_rad_s, run.loss_nm, run.turn
        return turn_waves(found, *columns)[1]

    values = (found.constant_nm, found.loss_share, found.viscous_nms_per_rad, found.quadratic_nms2_per_rad2)
    other = turning(101, PARTS * np.array([[-1.0], [1.0], [1.0], [1.0]]))
    for run in (turning(100), other):
        v = run.velocity_rad_s
        size = np.column_stack((np.ones(4000), run.loss_nm, v, v**2)) @ (np.array(values) - PARTS)
        assert np.sqrt(np.mean(np.einsum("nk,nk->n", run.turn, size) ** 2)) < 0.1
    deviations = [math.hypot(*row) for row in found.root()]
    np.testing.assert_allclose(deviations, 0.05, rtol=0.5)
    assert square(turning(100)).max() < found.limit
    assert square(other)[1000 // 64] > found.limit, "the first second"


def test_one_odd_run_does_not_set_the_limit() -> None:
    """A changed gear would hide behind it."""
    runs = [turning(seed) for seed in range(200)]
    found, odd = (
        fit_turn(runs),
        fit_turn([*runs, turning(500, PARTS + np.array([[0.6], [0.0], [0.0], [0.0]]))]),
    )
    assert found is not None
    assert odd is not None
    assert odd.limit < 1.3 * found.limit


@pytest.mark.parametrize("runs", [[turning(seed) for seed in range(15)], [], [turning(9, speed=0.0)] * 20])
def test_too_few_runs_in_motion_have_no_waves(runs: list[PathResiduals]) -> None:
    assert fit_turn(runs) is None
