"""The measured runs: scores are what they claim, and the fit helps where the page says it does."""

from dataclasses import replace

import numpy as np
import pytest

from jtqd.models.files import load_joint, shipped
from jtqd.sysid.runs.column_map import ColumnMap
from jtqd.sysid.runs.files import read_run
from validation.measured import JOINTS, RUNS, Case, evaluate, fit, score


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


def test_friction_explains_most_of_the_error_and_the_fit_beats_the_guess(
    cases: dict[tuple[int, str], Case],
) -> None:
    for case in cases.values():
        assert case.after.rmse_nm < 0.4 * case.no_friction.rmse_nm
        # docs/results.md says by how much; when that changes, the page must change too
        assert case.after.rmse_nm < 0.9 * case.before.rmse_nm


def test_the_shipped_joint_files_are_what_the_shipped_runs_give() -> None:
    columns = ColumnMap.load(shipped("kinova_gen3/columns.yaml"))
    for run in RUNS:
        file = read_run(shipped(f"kinova_gen3/{run}.csv.gz"), columns)
        for number in JOINTS:
            nominal = load_joint(columns.joint_files[number])
            there = load_joint(shipped(f"kinova_gen3/joint{number}.fitted_on_{run}.yaml"))
            found = fit(nominal, file, number=number, run=run)
            assert there.fused is not None
            assert there.rotor_inertia_kgm2 == pytest.approx(found.joint.rotor_inertia_kgm2, rel=1e-6)
            for mine, shipped_side in (
                (found.fused.loss.positive, there.fused.loss.positive),
                (found.fused.loss.negative, there.fused.loss.negative),
            ):
                assert mine.constant_nm == pytest.approx(shipped_side.constant_nm, rel=1e-6)
                assert mine.viscous_nms_per_rad == pytest.approx(shipped_side.viscous_nms_per_rad, rel=1e-6)
            assert found.fused.sigma.scale == pytest.approx(there.fused.sigma.scale, rel=1e-6)
            assert there.provenance["log_sha256"] == file.sha256
            same = {"fused": None, "rotor_inertia_kgm2": nominal.rotor_inertia_kgm2}
            assert replace(there, **same, provenance=nominal.provenance) == nominal
