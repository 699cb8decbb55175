"""Section `fused.zeros`: the spread of the days' zeros is found, and believed where runs left out confirm it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from jtqd.estimator.joint import DayZeros, Fused, FusedSigma
from jtqd.sysid.fit.repeatability import correlation, fit_zeros
from jtqd.sysid.fit.residuals import PathResiduals, Served, served
from tests.estimator.test_fused_estimator import NARROW

K, RATED, DAYS = 12000.0, 40.0, 24
SIGMA = FusedSigma(0.6, 0.0, 0.0, 0.5, 0.0, 0.02, (1.0, 1.0, 1.0, 1.0))


ARRAYS = tuple(name for name in PathResiduals._fields if name != "now")


def runs(zero_nm: float, within_nm: float = 0.2) -> list[PathResiduals]:
    """Runs to and fro of days whose zeros have this spread; both paths err within a run, the current more."""
    rng = np.random.default_rng(5)
    n = 8000
    t = np.arange(n) * 1e-3
    v = 1.2 * np.sin(2.5 * t)
    torque = 8.0 * np.sin(1.7 * t)
    found = []
    for zero in rng.normal(0.0, zero_nm, DAYS):
        slow = np.repeat(rng.normal(0.0, within_nm, n // 100), 100)
        friction = rng.normal(0.0, 0.3) * np.sign(v) + np.repeat(rng.normal(0.0, 0.5, n // 100), 100)
        none = np.zeros(n)
        found.append(
            PathResiduals(
                torque, v, none, torque, none, friction, zero + slow, np.full(n, 1e-3), np.tanh(v / 0.02), none,
                stiffness_nm_per_rad=np.full(n, K),
            )
        )  # fmt: skip
    return found


def fused(sigma: FusedSigma = SIGMA) -> Fused:
    assert NARROW.fused is not None
    return replace(NARROW.fused, sigma=sigma)


def fitted(of: Sequence[PathResiduals], sigma: FusedSigma = SIGMA) -> DayZeros | None:
    return fit_zeros(of, fused(sigma), RATED)


def test_the_spread_of_the_days_is_found_as_an_angle_and_as_a_torque() -> None:
    days = runs(0.4)
    found = fitted(days)
    assert found is not None
    drawn = float(np.std([run.torsion_error_nm.mean() for run in days]))
    assert found.spread_nm == pytest.approx(drawn, rel=0.01)
    assert found.spread_rad == pytest.approx(drawn / K, rel=0.01)


def test_what_is_the_sensors_zero_is_not_the_encoders() -> None:
    found, plain = fitted(runs(0.4), replace(SIGMA, reference_nm=0.2)), fitted(runs(0.4))
    assert found is not None
    assert plain is not None
    assert found.spread_nm**2 == pytest.approx(plain.spread_nm**2 - 0.2**2 + 0.02**2, rel=1e-6)


def test_the_noise_is_what_the_states_of_the_day_leave() -> None:
    within, friction, spread = 0.2, 0.5, 0.4
    assumed = SIGMA.current_nm**2 + SIGMA.torsion_nm**2 - spread**2
    expected = (
        0.1 * (within**2 + friction**2) / assumed
    )  # both last 0.1 s; zero and friction of the day are states
    assert correlation(runs(spread, within), SIGMA, spread) == pytest.approx(expected, rel=0.15)
    found = fitted(runs(spread, within))
    assert found is not None
    assert found.correlation_s == pytest.approx(expected, rel=0.15)


def test_of_too_short_runs_no_noise_is_told() -> None:
    short = [run._replace(**{name: getattr(run, name)[:3000] for name in ARRAYS}) for run in runs(0.4)]
    assert correlation(short, SIGMA, 0.4) is None


def test_days_that_hardly_differ_and_few_runs_have_no_section() -> None:
    assert fitted(runs(0.02)) is None
    assert fitted(runs(0.4)[:7]) is None


def test_served_with_tracked_zeros_errs_less_and_knows_it() -> None:
    days = runs(0.4)
    found = fitted(days)
    assert found is not None
    learned = [served(run, replace(fused(), zeros=found), RATED, tracked=True) for run in days]
    plain = [served(run, fused()) for run in days]
    late = slice(5000, None)

    def mean_square(of: list[Served]) -> float:
        return float(np.mean([np.mean(run.error_nm[late] ** 2) for run in of]))

    assert mean_square(learned) < 0.8 * mean_square(plain)
    assert np.mean([run.spread_nm[-1] for run in learned]) < 0.9 * np.mean(
        [run.spread_nm[0] for run in plain]
    )
