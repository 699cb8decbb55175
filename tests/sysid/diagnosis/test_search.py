"""Search, classes and smallest sizes on columns made up by numpy, of which the truth is known."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.effects import EFFECTS
from jtqd.sysid.diagnosis.evidence import (
    candidate_table,
    class_beside,
    complete_minimum,
    equivalence_class,
    information,
    minimum_size,
    steady_size,
)
from jtqd.sysid.diagnosis.regressors import EffectCandidate
from jtqd.sysid.diagnosis.search import ENTER, Hypothesis, Search, pinned, units_changed, within
from jtqd.sysid.diagnosis.stability import needed
from tests.estimator.effects.effect_signals import PLAIN
from tests.sysid.diagnosis.diagnose_core_helpers import Dense, candidates, dense, search_of

LIBRARY = candidates(
    PLAIN,
    ("coulomb_friction", 1, 0),
    ("viscous_friction", 1, 0),
    ("rotor_inertia", 1, 0),
    ("current_offset", 1, 0),
    ("torque_ripple", 1, 0),
    ("torque_ripple", 1, 1),
    ("sensor_gain", "sensor", 0),
)
PLACES = {c.effect.name: c for c in LIBRARY}
WIDTH = LIBRARY[-1].columns.stop


def columns(seed: int, runs: int = 5, count: int = 400) -> FloatArray:
    return np.random.default_rng(seed).normal(size=(runs, count, WIDTH))


def problem(seed: int, hidden: dict[int, float], x: FloatArray | None = None) -> Dense:
    """Coefficients by column; a zero of each run of spread 0.3 beside."""
    beta = np.zeros(WIDTH)
    for column, size in hidden.items():
        beta[column] = size
    x = columns(seed) if x is None else x
    return dense(seed + 1, list(beta), [0.3], runs=len(x), count=x.shape[1], columns=x)


def names(h: Hypothesis) -> list[str]:
    return [c.effect.name for c in h.chosen]


def parameters(h: Hypothesis, c: EffectCandidate) -> dict[str, float]:
    return dict(c.term.combine(h.coefficients(c)))


def test_what_is_hidden_is_found_with_its_size() -> None:
    """Viscous friction, and a wave of the second of two orders."""
    search = search_of(problem(1, {1: -0.4, 6: 0.3, 7: -0.4}), LIBRARY)
    best = search.run()
    assert [c.key for c in best.chosen] == [("viscous_friction", 1), ("torque_ripple", 1)]
    friction, wave = (parameters(best, c) for c in best.chosen)
    assert friction["viscous_nms_per_rad"] == pytest.approx(
        PLAIN.friction.viscous_nms_per_rad - 0.4, abs=0.07
    )
    assert wave["order_per_motor_rev"] == LIBRARY[5].term.basis[0]["order_per_motor_rev"]
    assert wave["amplitude_nm"] == pytest.approx(0.1 * 0.5, abs=0.01)
    assert wave["phase_rad"] == pytest.approx(math.atan2(-0.4, 0.3), abs=0.15)


def test_in_noise_nothing_is_found() -> None:
    assert [names(search_of(problem(100 + k, {}), LIBRARY).run()) for k in range(30)] == [[]] * 30


def test_what_is_no_more_than_the_changes_of_the_runs_is_not_found() -> None:
    """A constant of 0.5 where the zero of each run is anywhere between -1 and 1, and where it is not."""
    x = columns(2)
    x[:, :, 0] = 1.0
    beta = [0.5] + [0.0] * (WIDTH - 1)
    drifting = dense(3, beta, [1.0], columns=x, count=400)
    steady = dense(3, beta, [1e-3], columns=x, count=400)
    assert names(search_of(drifting, LIBRARY, sigma=1.0).run()) == []
    assert names(search_of(steady, LIBRARY, sigma=1e-3).run()) == ["coulomb_friction"]


def test_bic_is_deviance_and_the_price_of_parameters_and_of_choosing() -> None:
    whole = problem(4, {})
    search = search_of(whole, LIBRARY)
    rows = 2000.0
    ripple, viscous = LIBRARY[4], PLACES["viscous_friction"]
    one, none = search.hypothesis([viscous]), search.hypothesis([])
    assert none.bic == none.model.deviance
    assert one.bic - one.model.deviance == pytest.approx(search.penalty(viscous))
    assert search.penalty(viscous) == pytest.approx(math.log(rows), rel=0.01)
    assert search.penalty(ripple) == pytest.approx(2.0 * math.log(rows) + 2.0 * math.log(2.0), rel=0.01)
    x = columns(4)
    x[:, :, 0] = 1.0
    constant = search_of(problem(4, {}, x), LIBRARY, sigma=1.0)
    assert constant.penalty(LIBRARY[0]) == pytest.approx(math.log(6.0), rel=0.05), "measured once per run"


def test_evidence_on_runs_left_out_is_that_of_direct_refits() -> None:
    whole = problem(5, {1: 0.5, 2: 0.2}, columns(5, count=80))
    search = search_of(whole, LIBRARY)
    best = search.hypothesis([LIBRARY[1], LIBRARY[2]])

    def direct(h: Hypothesis) -> float:
        out, v, chosen = 0.0, h.model.variances, list(h.model.columns)
        for k in range(len(whole.y)):
            beta, _ = whole.least_squares(v, chosen, leave=k)
            one = Dense(whole.x[k : k + 1], whole.z[k : k + 1], whole.y[k : k + 1])
            out += one.deviance(beta, v, chosen)
        return out

    without = search.hypothesis([LIBRARY[2]], best.model)
    assert search.held_out(best, LIBRARY[1]) == pytest.approx(direct(without) - direct(best), rel=1e-6)
    assert search.held_out(best, LIBRARY[1]) > 50.0
    useless = search.hypothesis([LIBRARY[1], LIBRARY[3]])
    assert search.held_out(useless, LIBRARY[3]) < 3.0


def test_what_a_later_addition_makes_superfluous_goes() -> None:
    """The sum of two columns comes first, and goes when both are there."""
    x = columns(6)
    x[:, :, 0] = x[:, :, 1] + x[:, :, 2] + 0.2 * x[:, :, 0]
    search = search_of(problem(6, {1: 0.5, 2: 0.5}, x), LIBRARY)
    first = max(search.children(search.hypothesis(())), key=lambda h: -h.bic)
    assert names(first) == ["coulomb_friction"]
    assert names(search.run()) == ["viscous_friction", "rotor_inertia"]


def test_two_effects_from_another_branch_must_be_worth_two() -> None:
    """A column that is nearly the sum of two others: the two fit a little better than the one, by less than ENTER in BIC."""
    x = columns(31)
    near = np.random.default_rng(32).normal(size=x.shape[:2])
    for apart, chosen in ((0.18, ["coulomb_friction"]), (0.6, ["viscous_friction", "current_offset"])):
        x[:, :, 0] = x[:, :, 1] + x[:, :, 3] + apart * near
        search = search_of(problem(31, {1: 0.4, 3: 0.4}, x), LIBRARY)
        one, two = search.hypothesis([LIBRARY[0]]), search.hypothesis([LIBRARY[1], LIBRARY[3]])
        assert two.bic < one.bic
        assert (one.bic - two.bic < ENTER) == (len(chosen) == 1)
        assert names(search.run()) == chosen


def test_implausible_and_tiny_effects_are_not_taken() -> None:
    search = search_of(problem(7, {1: -20.0}), LIBRARY)
    assert "viscous_friction" not in names(search.run()), "it would be negative"
    assert not within(PLACES["viscous_friction"], [-20.0])
    assert within(PLACES["viscous_friction"], [20.0])
    whole = problem(7, {1: 0.3})
    assert names(search_of(whole, LIBRARY, least_nm=0.2).run()) == ["viscous_friction"]
    assert names(search_of(whole, LIBRARY, least_nm=0.4).run()) == []


def test_the_size_of_an_effect_is_that_of_its_columns_together() -> None:
    """A slope over the temperature has two columns that are nearly the same: what one takes from the other is not there."""
    (slope,) = candidates(PLAIN, ("sensor_drift", "sensor", 1))
    warmth = np.linspace(24.0, 28.0, 100)
    columns = 0.01 * np.column_stack([warmth - 25.0, warmth - 35.0])
    moments = (columns.T @ columns / len(columns))[None]
    made = search_of(problem(7, {}), LIBRARY)
    search = Search(made.mixed, [slope], 100.0, moments, 0.1)
    for coefficients in ([3.0, -2.5], [1.0, 1.0], [0.0, 2.0]):
        model = replace(made.hypothesis(()).model, beta=np.array(coefficients))
        expected = np.sqrt(np.mean((columns @ coefficients) ** 2))
        assert search.size_nm(Hypothesis((slope,), model, 0.0), slope) == pytest.approx(expected)


def test_an_effect_is_there_once_and_a_wave_once_per_order() -> None:
    search = search_of(problem(8, {}), LIBRARY)
    first, second = LIBRARY[4], LIBRARY[5]
    assert search.fits_beside(second, [first])
    assert not search.fits_beside(first, [first])
    assert not search.fits_beside(LIBRARY[0], [LIBRARY[0]])


SCALES = candidates(
    PLAIN,
    ("sensor_gain", "sensor", 0),
    ("nonlinear_stiffness", 1, 0),
    ("nonlinear_stiffness", 2, 0),
    ("torque_constant", 1, 0),
    ("torque_constant", 2, 0),
    ("nonlinear_stiffness", 1, 1),
)


def test_something_must_fix_the_scale() -> None:
    gain, k1, k2, t1, t2, _ = SCALES
    assert pinned([gain, k1, t2], 2)
    assert not pinned([gain, k1, k2], 2)
    assert not pinned([gain, t1, t2], 2)
    assert pinned([k1, k2, t1, t2], 2)
    assert not pinned([gain, k1], 1)


@pytest.mark.parametrize(
    ("shares", "one_factor"),
    [
        ((-0.06, -0.061, -0.059, -0.06), True),
        ((0.03, 0.032, 0.029, 0.03), True),
        ((-0.06, -0.06, -0.06, 0.0), True),
        ((-0.06, -0.03, -0.06, -0.06), True),
        ((-0.06, -0.06, 0.03, 0.03), False),
        ((-0.06, -0.03, -0.06, -0.03), False),
        ((0.06, -0.06, 0.06, -0.06), False),
    ],
)
def test_most_constants_by_one_factor_are_a_change_of_units(
    shares: tuple[float, ...], one_factor: bool
) -> None:
    """That is the sensor's gain, the rest the other way; below 1 it would shrink the noise too, and be preferred for it."""
    four = SCALES[1:5]
    beta = np.zeros(SCALES[-1].columns.stop)
    for c, share in zip(four, shares, strict=True):
        beta[c.first] = share / (0.1 if c.effect.name == "nonlinear_stiffness" else 0.01)
    whole = dense(9, list(1.0 * beta), [1e-3], runs=4, count=60000 // len(beta))
    search = search_of(whole, SCALES, sigma=1e-3)
    h = search.hypothesis(four)
    assert units_changed(h, search.joints) is one_factor
    assert search.plausible(h) is not one_factor
    assert not units_changed(search.hypothesis(four[:2]), 2), "half of them are as the file says"


def collinear(apart: float, seed: int = 10) -> Search:
    """Coulomb friction hidden; a column of another effect that differs from it by `apart` of its size."""
    x = columns(seed)
    x[:, :, 3] = x[:, :, 0] + apart * x[:, :, 3]
    return search_of(problem(seed, {0: 0.5}, x), LIBRARY)


@pytest.mark.parametrize(("apart", "others"), [(0.02, ["current_offset"]), (0.6, []), (5.0, [])])
def test_a_class_is_what_explains_the_same_runs_as_well(apart: float, others: list[str]) -> None:
    search = collinear(apart)
    best = search.run()
    assert len(best.chosen) == 1
    rivals = equivalence_class(search, best, best.chosen[0])
    assert {best.chosen[0].effect.name, *(c.effect.name for c in rivals)} == {"coulomb_friction", *others}


def test_rivals_must_be_plausible_themselves() -> None:
    x = columns(11)
    x[:, :, 3] = -1e-4 * x[:, :, 0]  # it would take an offset of thousands of ampere
    search = search_of(problem(11, {0: 0.5}, x), LIBRARY)
    best = search.run()
    assert names(best) == ["coulomb_friction"]
    assert equivalence_class(search, best, best.chosen[0]) == ()


def test_information_is_what_no_other_column_has() -> None:
    """Of a column beside a chosen one and the runs' zeros: its squares after projecting out both."""
    x = columns(12)
    x[:, :, 1] += 0.7 * x[:, :, 0] + 2.0
    whole = problem(12, {0: 0.5}, x)
    search = search_of(whole, LIBRARY, sigma=0.3)
    best = search.hypothesis([LIBRARY[0]])
    found, share = information(search.mixed, best, LIBRARY[1])
    _, covariance = whole.least_squares(best.model.variances, [1, 0])
    assert found == pytest.approx(1.0 / covariance[0, 0], rel=1e-6)
    assert 0.0 < share < 1.0
    alone, _ = information(search.mixed, search.hypothesis([]), LIBRARY[1])
    assert alone > found


@pytest.mark.parametrize("index", [1, 2, 5])
def test_three_times_the_smallest_size_is_found_and_a_third_of_it_is_not(index: int) -> None:
    candidate = LIBRARY[index]
    found = {0.3: 0, 3.0: 0}
    for seed in range(8):
        nothing = search_of(problem(200 + seed, {}), LIBRARY)
        empty = nothing.hypothesis(())
        (value,) = minimum_size(nothing, empty, candidate).values()
        zero = candidate.term.combine([0.0] * candidate.size)
        one = candidate.term.combine([1.0] + [0.0] * (candidate.size - 1))
        lead = next(iter(minimum_size(nothing, empty, candidate)))
        unit = abs(one[lead] - zero.get(lead, 0.0))
        complete = complete_minimum(nothing, empty, candidate)
        assert complete is not None
        assert complete[lead] - zero.get(lead, 0.0) == pytest.approx(value.value)
        for factor in found:
            best = search_of(
                problem(200 + seed, {candidate.first: factor * value.value / unit}), LIBRARY
            ).run()
            found[factor] += candidate in best.chosen
    assert found == {0.3: 0, 3.0: 8}


def test_the_smallest_size_has_the_evidence_that_is_asked_for() -> None:
    """Without noise in y, the deviance of the column falls by exactly the price of the effect and ENTER."""
    whole = problem(13, {})
    search = search_of(whole, LIBRARY)
    empty, viscous = search.hypothesis(()), LIBRARY[1]
    size = minimum_size(search, empty, viscous)["viscous_nms_per_rad"].value
    info, share = information(search.mixed, empty, viscous)
    assert share < 0.01
    assert size**2 * info == pytest.approx(ENTER + search.penalty(viscous), rel=0.02)


@pytest.mark.parametrize("of_other", [0, 1])
def test_an_alternative_that_some_runs_prefer_stays_beside_what_is_left_over(of_other: int) -> None:
    """Current offset and Coulomb friction of nearly the same column; in some runs it is the one, in the rest the other."""
    x = columns(21)
    x[:, :, 3] = 0.9 * x[:, :, 0] + 0.4 * x[:, :, 3]
    whole = problem(21, {}, x)
    for r in range(len(whole.y)):
        whole.y[r] += 1.5 * x[r, :, 3 if r < of_other else 0]
    search = search_of(whole, LIBRARY)
    best = search.hypothesis([PLACES["coulomb_friction"]])
    assert equivalence_class(search, best, best.chosen[0]) == (), "by the noise alone it is decided"
    others = [c.effect.name for c in class_beside(search, best, best.chosen[0])]
    assert others == (["current_offset"] if of_other else [])


def test_a_steady_size_is_that_of_its_changes_from_run_to_run() -> None:
    x = columns(22)
    whole = problem(22, {}, x)
    sizes = np.array([0.3, -0.2, 0.25, -0.35, 0.1])
    for r, size in enumerate(sizes):
        whole.y[r] += size * x[r, :, 1]
    search = search_of(whole, LIBRARY)
    empty, viscous = search.hypothesis(()), LIBRARY[1]
    steady = steady_size(search, empty, viscous)
    assert steady == pytest.approx(needed(5) * sizes.std(ddof=1) / 5**0.5, rel=0.15)
    (alone,) = minimum_size(search, empty, viscous).values()
    (beside,) = minimum_size(search, empty, viscous, unexplained=True).values()
    assert alone.value < beside.value == pytest.approx(steady)


def test_a_size_with_which_the_joint_would_move_otherwise_is_invisible() -> None:
    search = search_of(problem(15, {}), LIBRARY)
    empty, viscous = search.hypothesis(()), LIBRARY[1]
    (size,) = minimum_size(search, empty, viscous).values()
    for share, visible in ((1.01, True), (0.99, False)):
        limited = replace(viscous, largest=share * size.value)
        (found,) = minimum_size(search, empty, limited).values()
        assert math.isfinite(found.value) is visible
        assert (complete_minimum(search, empty, limited) is not None) is visible


def test_a_stribeck_peak_that_makes_the_joint_jump_is_no_visible_size() -> None:
    """Steepest fall of Fs exp(-(v/vs)^2) over the reflected inertia, by differences; half the Coulomb friction at most."""
    peak = EFFECTS["stribeck_friction"]
    slow = {"stribeck_nm": 1.0, "stribeck_velocity_rad_s": 0.03}
    largest = peak.largest(PLAIN, slow)
    v = np.linspace(0.0, 0.2, 20001)
    fall = float(np.max(-np.gradient(largest * np.exp(-((v / 0.03) ** 2)), v)))
    assert fall / (PLAIN.gear_ratio**2 * PLAIN.rotor_inertia_kgm2) == pytest.approx(20.0, rel=1e-3)
    fast = slow | {"stribeck_velocity_rad_s": 0.2}
    assert peak.largest(PLAIN, fast) == pytest.approx(0.5 * PLAIN.friction.coulomb_nm)
    bare = replace(PLAIN, friction=replace(PLAIN.friction, coulomb_nm=0.0))
    assert peak.largest(bare, fast) == pytest.approx(0.025 * PLAIN.rated_torque_nm), (
        "its losses are in an efficiency"
    )
    assert EFFECTS["viscous_friction"].largest(PLAIN, {}) == math.inf


def test_a_column_that_is_not_there_is_invisible() -> None:
    x = columns(14)
    x[:, :, 2] = 0.0
    x[:, :, 3] = x[:, :, 0]
    search = search_of(problem(14, {0: 0.5}, x), LIBRARY)
    best = search.hypothesis([LIBRARY[0]])
    (size,) = minimum_size(search, best, LIBRARY[2]).values()
    assert size.value == math.inf
    assert complete_minimum(search, best, LIBRARY[2]) is None
    (same,) = minimum_size(search, best, LIBRARY[3]).values()
    (alone,) = minimum_size(search, search.hypothesis(()), LIBRARY[3]).values()
    assert same.value > 100.0 * alone.value, "beside what it is equal to"


def test_the_table_says_why_each_effect_was_not_chosen() -> None:
    x = columns(15)
    x[:, :, 2] = x[:, :, 1] + 0.5 * x[:, :, 2]
    x[:, :, 3] = 0.0
    search = search_of(problem(15, {1: 0.8}, x), LIBRARY)
    best = search.run()
    table = candidate_table(search, best, {("sensor_gain", "sensor"): "viscous_friction"})
    reasons = {row.name: row.reason for row in table}
    assert reasons == {
        "viscous_friction": "chosen",
        "rotor_inertia": "explained by the chosen effects",
        "current_offset": "invisible in these runs",
        "coulomb_friction": "below threshold",
        "torque_ripple": "below threshold",
        "sensor_gain": "class of viscous_friction",
    }
    assert [row.delta_bic for row in table] == sorted((row.delta_bic for row in table), reverse=True)
    rows = {row.name: row for row in table}
    assert rows["rotor_inertia"].shared > 0.95
    assert rows["coulomb_friction"].shared < 0.5 or rows["coulomb_friction"].delta_bic < ENTER
    assert rows["viscous_friction"].held_out_gain == pytest.approx(1.0, abs=0.1)


def test_two_waves_that_say_what_one_says_are_that_one() -> None:
    """A column that is nearly the sum of two others: the two fit better, but by less than what is an effect."""
    x = columns(31)
    near = np.random.default_rng(32).normal(size=x.shape[:2])
    x[:, :, 0] = x[:, :, 1] + x[:, :, 3] + 0.4 * near
    whole = problem(31, {1: 0.4, 3: 0.4}, x)
    exact = search_of(whole, LIBRARY, least_nm=0.005)
    one, two = exact.hypothesis([LIBRARY[0]]), exact.hypothesis([LIBRARY[1], LIBRARY[3]])
    assert two.bic < one.bic - 2.0 * ENTER
    assert names(exact.run()) == names(two)
    change = np.zeros(WIDTH)
    change[[0, 1, 3]] = one.model.beta[0], -two.model.beta[0], -two.model.beta[1]
    products = np.mean(x[:, :, :, None] * x[:, :, None, :], axis=(0, 1))
    size = float(np.sqrt(change @ products @ change))
    assert size < 0.3
    for least, chosen in ((0.9 * size, two), (1.1 * size, one)):
        search = Search(exact.mixed, LIBRARY, float(exact.mixed.rows), products[None], least)
        assert names(search.run()) == names(chosen)
