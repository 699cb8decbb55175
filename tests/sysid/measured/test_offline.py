"""The measured runs: scores are what they claim, and fitted friction helps where the page says it does."""

import numpy as np
import pytest

from jtqd.sysid.measured.offline import Case, evaluate, score


@pytest.fixture(scope="module")
def cases() -> dict[tuple[int, str], Case]:
    return {(case.joint, case.run): case for case in evaluate(None, "2026-01-01")[0]}


def test_an_estimate_that_is_only_late_by_the_filter_scores_zero() -> None:
    dt_s = np.full(2000, 0.001)
    t = np.cumsum(dt_s) - 0.001
    # First-order low-pass of sin(w t) from rest at 0, closed form, g = 200, w = 20.
    g, w = 200.0, 20.0
    late = g * (g * np.sin(w * t) - w * np.cos(w * t) + w * np.exp(-g * t)) / (g * g + w * w)
    assert score(late, np.sin(w * t), dt_s, g).rmse_nm < 2e-4
    assert score(np.sin(w * t), np.sin(w * t), dt_s, g).rmse_nm > 0.05


def test_rows_without_an_estimate_do_not_count() -> None:
    estimate = np.array([np.nan, 3.0, 1.0, np.nan, 1.0])
    result = score(estimate, np.ones(5), np.full(5, 0.001), 200.0)
    assert result.rows == 3
    assert result.rmse_nm == pytest.approx(np.sqrt(4.0 / 3.0))
    assert result.max_nm == 2.0
    with pytest.raises(ValueError, match="no row"):
        score(np.full(5, np.nan), np.ones(5), np.full(5, 0.001), 200.0)


def test_every_case_is_judged_on_a_run_its_fit_has_not_seen(cases: dict[tuple[int, str], Case]) -> None:
    assert len(cases) == 4
    for case in cases.values():
        assert case.fitted_on != case.run
        assert case.after.rows >= 0.99 * len(case.time_s)


def test_friction_explains_most_of_the_error_and_the_fit_beats_the_guess_in_three_of_four(
    cases: dict[tuple[int, str], Case],
) -> None:
    for case in cases.values():
        assert case.after.rmse_nm < 0.4 * case.no_friction.rmse_nm
    better = {key for key, case in cases.items() if case.after.rmse_nm < case.before.rmse_nm}
    # docs/measured_runs.md says where it got worse; when that changes, the page must change too.
    assert better == {(2, "RunTrajectory1"), (4, "opti_traj_testing1"), (4, "RunTrajectory1")}
