"""The set that predicts: all values of the file, no entry that raises the error on held-out runs, the gain's interval."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.stats import sem

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import Friction
from jtqd.sysid.diagnosis import limits, verdict
from jtqd.sysid.diagnosis.evidence import Sets
from jtqd.sysid.diagnosis.findings import CERTAIN, EFFECTIVE, ONE_OF, Present
from jtqd.sysid.diagnosis.model import _STATES, Solution
from jtqd.sysid.diagnosis.regressors import contribution
from jtqd.sysid.diagnosis.verdict import (
    Prediction,
    Sizes,
    _rms,
    gain_of,
    grade_of,
    judged,
    predict,
    predicted,
    stacked,
    steady,
    values_of,
)
from tests.sysid.diagnosis.diagnose_core_helpers import MOTOR1
from tests.sysid.diagnosis.pendulums import ARM, Rig, friction_of, runs_of, solved

RUNS = 4
TRUE = replace(ARM, friction=Friction(ARM.friction.coulomb_nm + 1.0, ARM.friction.viscous_nms_per_rad))


@pytest.fixture(scope="module")
def solution() -> Solution:
    return solved(ARM, runs_of(TRUE, 2, RUNS, Rig(counts=2.0**22)))


def test_the_set_predicts_with_values_of_the_file_that_change(solution: Solution) -> None:
    found = predict(solution)
    assert solution.chosen <= found.chosen
    slots = [solution.entries[k].slot for k in found.chosen]
    assert len(slots) == len(set(slots))
    assert all(solution.entries[k].prior.file for k in found.chosen - solution.chosen)
    first, values = 0, {}
    for k in sorted(found.chosen):
        e = solution.entries[k]
        values |= e.values(found.mean[first : first + e.size])
        first += e.size
    assert values["coulomb_nm"] == pytest.approx(TRUE.friction.coulomb_nm, abs=0.05)
    constant = values.get("torque_constant_nm_per_a", ARM.torque_constant_nm_per_a)
    assert constant == pytest.approx(ARM.torque_constant_nm_per_a, rel=0.02)


def test_sizes_are_of_the_noise_alone(solution: Solution) -> None:
    """What the equations are exact to makes evidence weigh less, and widens no interval."""
    noise = solution.noise
    assert all(noise.repeats[c] > 0.0 for c in noise.sigma)
    more = noise._replace(repeats={c: 10.0 * x for c, x in noise.repeats.items()})
    assert solution.work.equations(more).grams[0][0, 0] < solution.equations.grams[0][0, 0]
    own = solution.work.equations(noise.random).grams
    for found, wanted in zip(solution.sized.grams, own, strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-6)
    wide = replace(solution, sized=solution.equations)
    assert (np.diag(solution.covariance) < 0.9 * np.diag(wide.covariance)).any()


def test_squares_are_those_of_the_runs_without_their_own_say(solution: Solution) -> None:
    """Before: the residual as it is; after: about the noise, of which the coefficients of the others know nothing."""
    found = predict(solution)
    for row, run in zip(found.squares[MOTOR1], solution.runs, strict=True):
        d = run.channels[MOTOR1]
        before = d.residual[d.valid]
        assert row[0] == pytest.approx(float(before @ before))
        assert row[2] == len(before)
        assert row[1] < 0.1 * row[0]
    part = replace(solution, runs=[*solution.runs])
    spoilt = dict(part.runs[0].channels)
    spoilt[MOTOR1] = replace(spoilt[MOTOR1], residual=spoilt[MOTOR1].residual + 3.0)
    part.runs[0] = replace(part.runs[0], channels=spoilt)
    other = predicted(part, part.chosen).squares[MOTOR1]
    assert other[0, 1] > 5.0 * other[0, 2], "an offset of its own is not learned from it"


def with_noise_entry(solution: Solution, signs: tuple[int, ...]) -> tuple[Solution, int]:
    """The solution, noise of the columns apart, with an entry whose column is what the run leaves, in some with the other
    sign: in the rows, and in the equations, whose column is a sum of the others.
    """
    k = next(k for k, e in enumerate(solution.entries) if e.effect.name == "sensor_gain")
    column = solution.entries[k].columns[0]
    runs = []
    found = predict(solution)
    weights = solution.transform()
    at = np.zeros(weights.shape[1])
    ends = np.cumsum([0, *(e.size for e in solution.entries)])
    at[[j for m in sorted(found.chosen) for j in range(ends[m], ends[m + 1])]] = found.mean
    for run, sign in zip(solution.runs, signs, strict=True):
        d = run.channels[MOTOR1]
        noise = d.residual - d.regressors @ (weights @ at)[d.index]
        regressors = d.regressors.copy()
        regressors[:, d.index == column] = (sign * noise / float(solution.entries[k].weights[0, 0]))[:, None]
        runs.append(replace(run, channels={MOTOR1: replace(d, regressors=regressors)}))
    wide = copy(solution.sized)
    wide.grams = wide.grams.copy()
    for gram, sign in zip(wide.grams, signs, strict=True):
        left = np.zeros(len(gram))
        left[: len(at)], left[-1] = -at, 1.0
        turn = np.eye(len(gram))
        turn[:, int(solution.sets.slices[k][0])] = sign * left
        gram[:] = turn.T @ gram @ turn
    return replace(solution, runs=runs, disturbed=[], sized=wide, chosen=solution.chosen | {k}), k


def left_nm2(found: Prediction) -> float:
    return float(found.squares[MOTOR1][:, 1].sum())


def test_values_outside_of_the_set_predict_as_far_as_held_out_runs_want(solution: Solution) -> None:
    """A friction that is not in the set but in the runs comes back with the values of the file."""
    [k] = [k for k in solution.chosen if solution.entries[k].effect.name == "coulomb_friction"]
    less = predict(replace(solution, chosen=solution.chosen - {k}))
    assert k in less.chosen
    assert left_nm2(less) == pytest.approx(left_nm2(predict(solution)), rel=0.05)


def test_what_predicts_is_the_mixture(solution: Solution, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the part that held-out runs want: a value outside of the set has this part of what the wide set gives it, and the
    set keeps its own: a motor near full saturation has no simulation a little beside them.
    """
    found, kept = {}, {}
    for part in (0.0, 0.25, 1.0):
        monkeypatch.setattr(verdict, "stacked", lambda *_, part=part: part)
        prediction = predict(solution)
        places = solution.sets.places(prediction.chosen)
        found[part] = {k: float(prediction.mean[s][0]) for k, s in places.items() if k not in solution.chosen}
        kept[part] = {k: float(prediction.mean[s][0]) for k, s in places.items() if k in solution.chosen}
    assert found[0.0] == {}
    assert len(found[1.0]) > 1
    assert kept[0.0] == kept[0.25] == kept[1.0]
    assert found[0.25] == pytest.approx({k: 0.25 * value for k, value in found[1.0].items()})


def test_an_entry_whose_sign_differs_from_run_to_run_does_not_predict(solution: Solution) -> None:
    tampered, _ = with_noise_entry(solution, (1, -1, 1, -1))
    found = predict(tampered)
    assert found.chosen & tampered.chosen == solution.chosen
    plain = predict(replace(solution, disturbed=[]))
    assert left_nm2(found) == pytest.approx(left_nm2(plain), rel=1e-6)


def test_an_entry_that_predicts_every_run_is_kept(solution: Solution) -> None:
    tampered, k = with_noise_entry(solution, (1, 1, 1, 1))
    chosen = steady(tampered)
    assert k in chosen
    plain = predicted(replace(solution, disturbed=[]), solution.chosen)
    assert left_nm2(predicted(tampered, chosen)) < 0.5 * left_nm2(plain)


def test_between_two_sets_held_out_runs_decide(solution: Solution) -> None:
    """Of what the wide set adds, the part that errs least: all where it is right, none where it is noise, else between."""
    few, wide = frozenset({0}), frozenset({0, 1})

    def part(held_out: float, fitted: float) -> float:
        def sums(second: float) -> FloatArray:
            gram = np.diag([1e4, 1e4, 4e4])
            gram[0, 2] = gram[2, 0] = 1e4
            gram[1, 2] = gram[2, 1] = second * 1e4
            return gram

        entries = [e for e in solution.entries if e.size == 1][:2]
        fits = [Sets(entries, sums(fitted)) for _ in range(3)]
        return stacked([{MOTOR1: sums(held_out)}] * 2, fits, few, wide)

    assert part(0.5, 0.5) == pytest.approx(1.0, abs=0.01)
    assert part(-0.5, 0.5) == 0.0
    assert part(0.2, 0.5) == pytest.approx(0.4, abs=0.01)


def made_up(solution: Solution, before: list[float], after: list[float]) -> Any:
    squares = np.array([(100.0 * b * b, 100.0 * a * a, 100.0) for b, a in zip(before, after, strict=True)])
    return gain_of(solution, Prediction(frozenset(), np.empty(0), [], {MOTOR1: squares}))


def test_the_interval_of_the_gain_is_over_runs(solution: Solution) -> None:
    same = made_up(solution, [2.0] * RUNS, [0.5] * RUNS)
    assert (same.rmse_before_nm, same.rmse_after_nm) == (2.0, 0.5)
    assert same.ci95 == pytest.approx((1.5, 1.5))
    apart = made_up(solution, [2.0] * RUNS, [0.2, 0.2, 0.2, 2.5])
    assert apart.ci95[0] < 0.0 < apart.ci95[1], "one run of four speaks against it"
    assert apart.ci95[0] < apart.rmse_before_nm - apart.rmse_after_nm < apart.ci95[1]
    assert [r.rmse_after_nm for r in apart.runs] == pytest.approx([0.2, 0.2, 0.2, 2.5])
    assert [r.run for r in apart.runs] == [run.name for run in solution.dataset.runs]
    assert "motor balance of joint 1" in apart.split


SURE = {"delta": 40.0, "imitated": 30.0, "z": 5.0, "differs": 0.05, "error": 0.05, "held": False}


@pytest.mark.parametrize(
    ("change", "rivals", "hidden", "grade"),
    [
        ({}, False, False, CERTAIN),
        ({}, True, False, CERTAIN),
        ({}, False, True, EFFECTIVE),
        ({"imitated": 0.5}, False, False, EFFECTIVE),
        ({"z": 2.5}, False, False, EFFECTIVE),
        ({"error": 0.08}, False, False, EFFECTIVE),
        ({"held": True}, False, False, EFFECTIVE),
        ({"delta": 0.5, "imitated": 0.5}, True, False, ONE_OF),
        ({"delta": 0.5, "imitated": 0.5}, False, False, EFFECTIVE),
    ],
)
def test_grades(solution: Solution, change: dict[str, float], rivals: bool, hidden: bool, grade: str) -> None:
    """Certain: more evidence than any set without it, also where a discrepancy may imitate it, three standard deviations
    from none, and the same in every run; not where more than it remains in its balance.
    """
    entries = tuple(solution.entries[:1]) if rivals else ()
    one: Any = SimpleNamespace(rivals=entries, **(SURE | change))
    found, doubts = grade_of(one, hidden=hidden)
    assert found == grade
    assert len(doubts) == len(change) + hidden


def test_what_a_certain_entry_must_survive(solution: Solution) -> None:
    """Its rival, and a discrepancy that imitates it."""
    chosen = solution.chosen
    apart = solution.equations.sets(solution.variances, chosen, resembling=False)
    own = judged(solution)
    assert own
    for j in own:
        dropped, sets = chosen - set(j.members), solution.sets
        imitated = 2.0 * (sets.fit(chosen).evidence - sets.fit(dropped).evidence)
        rival = apart.without(chosen, j.members)
        assert j.delta == pytest.approx(apart.lacks(chosen, rival))
        assert 0.99 * imitated < j.imitated < imitated, "a recorder within its step imitates a little of it"
        assert j.imitated < 2.0 * (apart.fit(chosen).evidence - apart.fit(dropped).evidence)


@pytest.mark.parametrize("spread", [0.0, 0.3])
def test_how_much_a_size_differs_from_run_to_run(solution: Solution, spread: float) -> None:
    """Runs with the size times 1 - spread and 1 + spread differ by it, however much of it each has."""
    [k] = [k for k, e in enumerate(solution.entries) if e.effect.name == "coulomb_friction"]
    column, size = int(solution.sets.slices[k][0]), 2.0
    grams = []
    for sign, weight in ((1.0, 4e4), (-1.0, 4e4), (1.0, 1e4), (-1.0, 1e4)):
        gram = np.zeros_like(solution.sets.gram)
        response = (1.0 + sign * spread) * size * weight
        gram[column, column], gram[-1, -1] = weight, 9.0 * weight
        gram[column, -1] = gram[-1, column] = response
        grams.append(gram)
    total = sum(grams)
    without = [Sets(solution.entries, total - gram) for gram in grams] + [Sets(solution.entries, total)]
    differs, _ = Sizes(without, frozenset({k})).over_runs(np.array([0]))
    assert differs == pytest.approx(spread, abs=1e-3)
    assert Sizes(without[-1:] * 2, frozenset({k})).over_runs(np.array([0])) == (float("inf"), float("inf"))


@pytest.mark.parametrize("sizes", [(2.0, 2.4, 1.7), (2.0, 2.4, 1.7, 2.1, 1.9, 2.2)])
def test_the_error_over_runs_is_that_of_a_mean(solution: Solution, sizes: tuple[float, ...]) -> None:
    """Runs that hold equally much of an entry are as many values of one sample."""
    [k] = [k for k, e in enumerate(solution.entries) if e.effect.name == "coulomb_friction"]
    column = int(solution.sets.slices[k][0])
    grams = []
    for size in sizes:
        gram = np.zeros_like(solution.sets.gram)
        gram[column, column], gram[-1, -1] = 1e6, 9e6
        gram[column, -1] = gram[-1, column] = 1e6 * size
        grams.append(gram)
    total = sum(grams)
    without = [Sets(solution.entries, total - gram) for gram in grams] + [Sets(solution.entries, total)]
    _, error = Sizes(without, frozenset({k})).over_runs(np.array([0]))
    assert error == pytest.approx(sem(sizes) / np.mean(sizes), rel=1e-3)


def test_what_predicts_is_where_its_own_simulation_is() -> None:
    """A torque constant of 0.7 of the file's: a set whose discrepancy left half of it stands at currents that are none of
    the file that predicts.
    """
    weak = replace(ARM, torque_constant_nm_per_a=0.7 * ARM.torque_constant_nm_per_a)
    found = solved(ARM, runs_of(weak, 3, 3, Rig(counts=2.0**22)))
    states = [s.state.current_a.copy() for run in found.dataset.signals for s in run]

    def constant(effects: list[Any]) -> float:
        [value] = [p.values["torque_constant_nm_per_a"] for p in effects if p.name == "torque_constant"]
        return float(value)

    work = found.work.copy()
    work.move(found.chosen, 0.5 * found.plain.fit(found.chosen).mean, _STATES, None)
    equations = work.equations(found.noise)
    halved = replace(found, sized=equations, runs=work.runs, disturbed=work.disturbed)
    there = constant(predicted(halved, found.chosen).effects)
    found.work.set_states()
    assert abs(there / weak.torque_constant_nm_per_a - 1.0) > 0.03, "else this shows nothing"
    assert constant(predict(halved).effects) == pytest.approx(weak.torque_constant_nm_per_a, rel=0.01)
    for before, s in zip(states, (s for run in found.dataset.signals for s in run), strict=True):
        assert np.array_equal(before, s.state.current_a), "states stay those of the set"


def test_a_discrepancy_that_resembles_a_value_widens_its_interval_and_takes_nothing_of_it() -> None:
    """A torque constant of 0.6 of the file's, beside a loss that no library has, in part a function of the load."""
    weak = replace(ARM, torque_constant_nm_per_a=0.6 * ARM.torque_constant_nm_per_a)
    friction = friction_of(weak)

    def loss(v: FloatArray, tau: FloatArray, theta: FloatArray) -> FloatArray:
        other = np.sin(2.5 * v) * np.cos(tau / 9.0) + np.cos(tau / 6.0)
        return np.asarray(friction(v, tau, theta) + 2.0 * other)

    found = solved(ARM, runs_of(weak, 3, 3, Rig(counts=2.0**22), loss))
    [j] = [j for j in judged(found) if j.present.name == "torque_constant"]
    value = values_of(found, j)["torque_constant_nm_per_a"]
    assert value.value == pytest.approx(weak.torque_constant_nm_per_a, rel=0.04)
    low, high = value.ci95
    assert low < weak.torque_constant_nm_per_a < high
    shrunk = found.sets.fit(found.chosen).mean / found.plain.fit(found.chosen).mean
    assert np.all(shrunk[found.sets.places(found.chosen)[j.members[0]]] < 0.95), "else this shows nothing"


def test_an_effect_of_a_rate_is_worth_nothing_of_the_noise() -> None:
    """The current that a simulation draws has the noise of the acceleration, and its rate has little else."""
    late = Present("channel_delay", 1, {"delay_s": 2e-3, "channel": 1.0})

    def worth_nm(rig: Rig) -> tuple[float, float]:
        found = solved(ARM, runs_of(ARM, 3, 3, replace(rig, rate_hz=1000.0)))
        raw = [contribution(late.effect, late.values, s)["motor"] for (s,) in found.dataset.signals]
        return _rms(found, late)[MOTOR1], float(np.sqrt(np.mean(np.concatenate(raw) ** 2)))

    clean, _ = worth_nm(Rig(counts=2.0**22, current_noise_a=0.0, sensor_noise_nm=0.0))
    found, raw = worth_nm(Rig(counts=2.0**17))
    assert found == pytest.approx(clean, rel=0.2)
    assert raw > 5.0 * clean, "else this shows nothing"


@pytest.mark.parametrize("part", [0.4, 0.7])
def test_a_value_at_the_end_of_its_range_is_not_certain(part: float) -> None:
    """A torque constant of 0.4 of the file's is another unit, not a data sheet that is off: 0.5 is the end."""
    weak = replace(ARM, torque_constant_nm_per_a=part * ARM.torque_constant_nm_per_a)
    found = solved(ARM, runs_of(weak, 3, 4, Rig(counts=2.0**22)))
    [j] = [j for j in judged(found) if j.present.name == "torque_constant"]
    assert j.held == (part < limits.SCALES[0])
    grade, _ = grade_of(j, hidden=False)
    assert grade == CERTAIN or part < limits.SCALES[0]
