"""With fewer than four runs a name needs each held-out run: strong effects are still named, the rest is left open."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from examples.kinova_diagnosis import diagnose_all
from jtqd.sysid.diagnosis import acceptance, bounded
from jtqd.sysid.diagnosis.dataset import Dataset
from jtqd.sysid.diagnosis.diagnose import diagnose
from jtqd.sysid.diagnosis.findings import (
    AMBIGUOUS,
    CAUSE,
    INSUFFICIENT,
    NO_GAP,
    UNEXPLAINED,
    Findings,
    to_mapping,
)
from jtqd.sysid.diagnosis.leave_one_out import LeaveOneOut
from jtqd.sysid.diagnosis.mixed_model import ENOUGH_RUNS
from jtqd.sysid.diagnosis.search import Search
from validation.diagnosis.trials import joint_files, tables
from validation.generator.draw import draw


def found(seed: int, *effects: tuple[str, int | str, float | None], runs: int = 2) -> Findings:
    case = draw(seed, effects, runs=runs)
    return diagnose(tables(case.runs), joint_files(case))


@pytest.fixture(scope="module")
def measured() -> dict[int, Findings]:
    return {one.number: one.findings for one in diagnose_all(range(2, 8))}


@pytest.mark.parametrize("runs", [2, pytest.param(3, marks=pytest.mark.campaign)])
def test_nothing_hidden_in_few_runs_names_nothing(runs: int) -> None:
    findings = found(206, runs=runs)
    assert findings.verdict == NO_GAP
    assert not findings.causes


@pytest.mark.parametrize(
    ("seed", "name", "joint"),
    [
        pytest.param(207, "torque_ripple", 1, marks=pytest.mark.campaign),
        pytest.param(208, "load_dependent_friction", 2, marks=pytest.mark.campaign),
        (212, "sensor_gain", "sensor"),
    ],
)
def test_two_runs_of_a_strong_effect_name_it(seed: int, name: str, joint: int | str) -> None:
    findings = found(seed, (name, joint, None))
    assert findings.verdict == CAUSE
    assert [(c.names, c.joint) for c in findings.causes] == [((name,), joint)]


def test_a_parameter_whose_interval_holds_the_files_value_is_no_settled_cause() -> None:
    findings = found(211, ("viscous_friction", 1, None))
    assert [c.name for c in findings.causes] == ["viscous_friction"]
    assert findings.verdict == AMBIGUOUS
    assert findings.next_experiment is not None
    assert "not confirmed on every held-out run: viscous_friction of joint 1" in findings.reasons[-1]


def test_with_four_runs_nothing_of_this_applies(monkeypatch: pytest.MonkeyPatch) -> None:
    class Refusing(LeaveOneOut):
        def __init__(self, dataset: Dataset, search: Search) -> None:
            assert search.mixed.runs < ENOUGH_RUNS, "asked for with four runs"
            super().__init__(dataset, search)

    monkeypatch.setattr(acceptance, "LeaveOneOut", Refusing)
    assert found(206, runs=4).verdict == NO_GAP


def test_measured_joints_are_never_settled_by_two_short_runs(measured: dict[int, Findings]) -> None:
    for findings in measured.values():
        assert findings.verdict in (AMBIGUOUS, INSUFFICIENT, UNEXPLAINED)
        assert (findings.next_experiment is not None) == (findings.verdict != UNEXPLAINED)
        if findings.causes:
            assert findings.gain is not None
            assert all(run.rmse_after_nm < run.rmse_before_nm for run in findings.gain.runs)
        for gap in findings.gaps:
            assert gap.noise_floor_nm <= gap.rmse_nm


def test_friction_and_inertia_that_show_only_together_are_found(measured: dict[int, Findings]) -> None:
    """The file has far too much viscous friction and inertia of joint 6: each alone helps on no held-out run."""
    gain = measured[6].gain
    assert gain is not None
    assert gain.rmse_after_nm < 0.4 * gain.rmse_before_nm
    floor = next(gap.noise_floor_nm for gap in measured[6].gaps if gap.balance == "motor")
    assert floor < 0.3, "what all runs share is no noise"


def test_the_noise_floor_is_below_what_a_fit_on_the_other_run_leaves(measured: dict[int, Findings]) -> None:
    """Nothing is named in joint 7: what both runs lack in common is in their own changes, and is no variation."""
    for number in range(3, 8):
        findings = measured[number]
        runs = [run for bound in findings.bounded for run in bound.runs]
        runs += findings.gain.runs if findings.gain is not None else ()
        assert runs
        floor = next(gap.noise_floor_nm for gap in findings.gaps if gap.balance == "motor")
        assert 0.05 < floor <= np.sqrt(np.mean([run.rmse_after_nm**2 for run in runs]))


def test_what_one_encoder_and_one_joint_cannot_tell_apart_is_one_class(measured: dict[int, Findings]) -> None:
    inertia = next(c for c in measured[3].causes if "rotor_inertia" in c.names)
    assert "link_inertia" in inertia.names
    scale = next(c for c in measured[4].causes if c.joint == "sensor")
    assert "sensor_gain" in scale.names
    assert "torque_constant of joint 4" in scale.names


def test_small_joints_agree_on_a_smaller_rotor(measured: dict[int, Findings]) -> None:
    for number in (5, 6):
        rotor = next(c for c in measured[number].causes if c.name == "rotor_inertia")
        assert 5e-6 < rotor.parameters["rotor_inertia_kgm2"].value < 1.5e-5  # the file has 2.2e-5
        assert rotor.parameters["rotor_inertia_kgm2"].ci95[1] < 2.2e-5


def test_a_value_below_zero_is_no_cause_but_a_bound(measured: dict[int, Findings]) -> None:
    """Joint 7: both runs say that viscous friction is far below the file's 2 Nms/rad, together less than zero."""
    assert not measured[7].causes
    (bound,) = measured[7].bounded
    assert (bound.name, bound.joint, bound.file_value) == ("viscous_friction", 7, 2.0)
    assert bound.best < 0.0 < bound.at_most < 1.0
    for run in bound.runs:
        assert run.rmse_after_nm < 0.5 * run.rmse_before_nm
    assert bound.text in measured[7].reasons
    said = (
        f"viscous_friction of joint 7: at most {bound.at_most:.2g} Nms/rad by these runs, 2 in the joint file"
    )
    assert said in bound.text
    (written,) = to_mapping(measured[7])["bounded"]
    assert written["at_most"] == bound.at_most
    assert [run["run"] for run in written["runs"]] == ["opti_traj_testing1", "RunTrajectory1"]
    for number in range(2, 7):
        assert not measured[number].bounded, "what is named, or possible, or makes a run worse, is no bound"


def test_a_bound_needs_a_large_fall_on_every_run_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """Joint 7 leaves a fifth and a twelfth of the squared error: a fall of nine tenths is none of the first run."""
    monkeypatch.setattr(bounded, "LARGE_FALL", 0.9)
    [one] = diagnose_all(range(7, 8))
    assert not one.findings.bounded


@pytest.mark.parametrize(("limit", "held"), [(-0.5, True), (-5.0, False), (0.5, False)])
def test_a_value_beyond_its_limit_is_held_there_and_the_others_follow(limit: float, held: bool) -> None:
    """As least squares with that value fixed; one within its limit, or on its other side, stays."""
    rng = np.random.default_rng(3)
    x = rng.normal(size=(40, 3)) @ np.array([[1.0, 0.4, 0.2], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])
    y = x @ np.array([0.7, -1.2, 0.3]) + 0.1 * rng.normal(size=40)
    fitted = np.linalg.lstsq(x, y, rcond=None)[0]
    search = SimpleNamespace(held_out_fits=lambda _: [(fitted, np.linalg.inv(x.T @ x))])
    hypothesis = SimpleNamespace(model=SimpleNamespace(columns=[10, 11, 12]))
    [found] = bounded._held_at(
        cast("Any", search), cast("Any", hypothesis), cast("Any", SimpleNamespace(first=11)), limit
    )
    rest = np.linalg.lstsq(x[:, [0, 2]], y - limit * x[:, 1], rcond=None)[0]
    np.testing.assert_allclose(found, [rest[0], limit, rest[1]] if held else fitted, rtol=1e-9)
