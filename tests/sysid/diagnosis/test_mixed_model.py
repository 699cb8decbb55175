"""The mixed model against dense least squares, and what varies from run to run."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest

from jtqd.estimator.run import JointColumns, RunTable
from jtqd.sysid.diagnosis.diagnose import diagnose
from jtqd.sysid.diagnosis.findings import NO_GAP, Findings
from jtqd.sysid.diagnosis.gain import left_out_steps
from jtqd.sysid.diagnosis.mixed_model import _MARGINALS_KEPT, _PRIOR_RUNS, explained, explained_each, solve
from jtqd.sysid.diagnosis.refine import Refined
from tests.sysid.diagnosis.diagnose_core_helpers import Dense, dense
from validation.diagnosis.trials import joint_files, tables
from validation.generator.draw import draw

PROBLEM = dense(1, [1.5, -0.7, 0.0], [0.8, 0.3])
VARIANCES = np.array([0.5, 0.07])


@pytest.mark.parametrize("beta", [[0.0, 0.0, 0.0], [1.5, -0.7, 0.0], [3.0, 1.0, -2.0]])
def test_nuisances_integrated_out_leave_the_normal_density(beta: list[float]) -> None:
    total, log = PROBLEM.mixed([1.0, 1.0]).marginal(VARIANCES)
    contrast = np.append(-np.array(beta), 1.0)
    assert contrast @ total @ contrast + log == pytest.approx(
        PROBLEM.deviance(np.array(beta), VARIANCES, [0, 1, 2]), rel=1e-9
    )


def test_the_runs_sum_up_to_the_whole() -> None:
    mixed = PROBLEM.mixed([1.0, 1.0])
    parts, logs = mixed.marginal_runs(VARIANCES)
    total, log = mixed.marginal(VARIANCES)
    assert parts.sum(axis=0) == pytest.approx(total, rel=1e-9, abs=1e-9)
    assert float(np.sum(logs)) == pytest.approx(log, rel=1e-9)
    some, _ = mixed.subset([0, 3]).marginal(VARIANCES)
    assert some == pytest.approx(parts[[0, 3]].sum(axis=0), rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("columns", [[], [1], [2, 0]])
def test_a_fit_is_generalised_least_squares_at_its_variances(columns: list[int]) -> None:
    prior = np.array([0.6, 0.6])
    model = PROBLEM.mixed([0.6, 0.6]).fit(columns)
    beta, covariance = PROBLEM.least_squares(model.variances, columns)
    assert model.beta == pytest.approx(beta, rel=1e-6)
    assert model.covariance == pytest.approx(covariance, rel=1e-6)
    price = _PRIOR_RUNS * np.sum(np.log(model.variances) + prior**2 / model.variances)
    assert model.deviance == pytest.approx(
        PROBLEM.deviance(beta, model.variances, columns) + float(price), rel=1e-9
    )
    for x, z, y, c, u in zip(
        PROBLEM.x, PROBLEM.z, PROBLEM.y, PROBLEM.covariances(model.variances), model.nuisances, strict=True
    ):
        best = (z * model.variances).T @ np.linalg.solve(c, y - x[:, columns] @ beta)
        assert u == pytest.approx(best, rel=1e-6), "best linear prediction of a run's own changes"


def test_every_step_towards_the_variances_lowers_the_criterion_until_its_minimum() -> None:
    mixed = PROBLEM.mixed([2.0, 0.05])
    path = [mixed.fit([0, 1], steps=k).deviance for k in (0, 1, 2, 4, 8, 16)]
    assert path == sorted(path, reverse=True)
    found = mixed.fit([0, 1], steps=3000)
    for k in (0, 1):
        for factor in (0.9, 1.1):
            moved = found.variances.copy()
            moved[k] *= factor
            assert mixed.fit([0, 1], moved, steps=0).deviance > found.deviance


def test_variances_of_many_runs_are_found_whatever_the_prior() -> None:
    problem = dense(5, [1.0], [1.5, 0.3], runs=120, count=50)
    found = problem.mixed([0.5, 0.5]).fit([0]).variances
    assert np.sqrt(found) == pytest.approx([1.5, 0.3], rel=0.2)


def test_what_differs_between_runs_is_measured_once_per_run() -> None:
    """A constant in six long runs whose zeros drift: six measurements, not six thousand."""
    ones = np.ones((6, 1000, 1))
    problem = dense(2, [0.0], [1.0], runs=6, count=1000, columns=ones)
    model = problem.mixed([1.0]).fit([0])
    assert model.covariance[0, 0] == pytest.approx((model.variances[0] + 1e-3) / 6.0, rel=1e-6)
    steady = dense(2, [0.0], [1e-6], runs=6, count=1000, columns=ones).mixed([1e-6]).fit([0])
    assert steady.covariance[0, 0] == pytest.approx(1.0 / 6000.0, rel=1e-3)


def test_solve_and_explained_are_least_squares() -> None:
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(80, 4)) * [1.0, 1e3, 1e-3, 1.0], rng.normal(size=80)
    x[:, 3] += 1e-3 * x[:, 1]
    block = np.column_stack((x, y))
    total = block.T @ block

    def left(columns: list[int]) -> float:
        rest = y - x[:, columns] @ np.linalg.lstsq(x[:, columns], y, rcond=None)[0] if columns else y
        return float(rest @ rest)

    beta, covariance = solve(total, 4)
    assert beta == pytest.approx(np.linalg.lstsq(x, y, rcond=None)[0], rel=1e-6)
    assert covariance == pytest.approx(np.linalg.inv(x.T @ x), rel=1e-6)
    for chosen, extra in (([], [1]), ([0, 2], [3, 1]), ([3], [])):
        assert explained(total, chosen, extra) == pytest.approx(
            left(chosen) - left(chosen + extra), rel=1e-6, abs=1e-6
        )
    extras = [[1], [3, 1], [], [3], [1, 3]]
    assert explained_each(total, [0, 2], extras) == [explained(total, [0, 2], extra) for extra in extras]


def test_marginals_that_are_kept_are_of_these_runs_and_variances() -> None:
    mixed = PROBLEM.mixed([1.0, 1.0])
    every = [k * VARIANCES for k in range(1, _MARGINALS_KEPT + 3)]
    fresh = [PROBLEM.mixed([1.0, 1.0]).marginal(v) for v in every]
    for v, (total, log) in [*zip(every, fresh, strict=True)] * 2:
        assert mixed.marginal(v)[0] == pytest.approx(total, rel=1e-12)
        assert mixed.marginal(v)[1] == log
    assert mixed.marginal(every[0]) is mixed.marginal(every[0])
    part, whole = mixed.subset([0, 1]).marginal(every[0])[0], fresh[0][0]
    assert not np.allclose(part, whole)
    assert not np.allclose(mixed.less(0.1 * mixed.grams).marginal(every[0])[0], whole)


def test_steps_of_runs_left_out_are_fits_of_the_others() -> None:
    problem = dense(8, [0.4, -0.2], [0.5, 0.2], runs=6)
    mixed = problem.mixed([0.5, 0.5])
    model = mixed.fit([0, 1])
    refined = Refined((), model.covariance, np.zeros(2), mixed, model.variances, model.nuisances, ())
    steps = left_out_steps(refined)
    for k, step in enumerate(steps):
        assert step == pytest.approx(problem.least_squares(model.variances, [0, 1], leave=k)[0], rel=1e-6)
    assert len({round(float(s[0]), 9) for s in steps}) == 6


def test_intervals_of_the_mixed_model_cover_the_truth() -> None:
    """A column that is half one of the runs' own changes: 95 % of the estimates within two standard deviations."""
    hits = 0
    for seed in range(200):
        rng = np.random.default_rng(seed)
        columns = 0.3 * rng.normal(size=(8, 40, 1)) + 1.0
        problem: Dense = dense(1000 + seed, [0.7], [0.4], runs=8, count=40, columns=columns)
        model = problem.mixed([0.4]).fit([0])
        hits += abs(float(model.beta[0]) - 0.7) < 2.0 * float(np.sqrt(model.covariance[0, 0]))
    assert 0.90 <= hits / 200 <= 0.99


@pytest.mark.parametrize("lacking", [0, 1])
def test_a_run_without_a_link_encoder_takes_the_torsion_balance_from_all(lacking: int) -> None:
    findings = _without("link_position_rad", lacking)
    assert {g.balance for g in findings.gaps} == {"motor"}
    assert findings.verdict == NO_GAP


def test_a_run_without_the_sensor_is_left_out_and_named() -> None:
    findings = _without("torque_nm", 1)
    assert any("run2" in note and "torque_nm" in note for note in findings.channel_notes)
    assert findings.verdict == NO_GAP


def test_a_run_of_another_rate_is_left_out_and_named() -> None:
    case = draw(12, runs=5, duration_s=8.0)
    runs = tables(case.runs)
    name, table = runs[3]
    joints = {
        n: JointColumns(**{f.name: None if (x := getattr(c, f.name)) is None else x[::2] for f in fields(c)})
        for n, c in table.joints.items()
    }
    runs[3] = name, RunTable(table.time_s[::2], joints)
    findings = diagnose(runs, joint_files(case))
    assert findings.channel_notes == ("run4: found 500 samples per second, expected 1000 as in the others",)
    assert findings.verdict == NO_GAP


def _without(name: str, which: int) -> Findings:
    case = draw(12, runs=5, duration_s=8.0)
    runs = tables(case.runs)
    run, table = runs[which]
    velocity = {"link_velocity_rad_s": None} if name == "link_position_rad" else {}
    joints = {n: replace(c, **{name: None}, **velocity) for n, c in table.joints.items()}
    runs[which] = run, RunTable(table.time_s, joints)
    return diagnose(runs, joint_files(case))
