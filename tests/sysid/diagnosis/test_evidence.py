"""Evidence of sets of entries against dense normal densities, the search on columns of which the truth is known."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from copy import copy
from itertools import combinations, pairwise
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from jtqd.estimator.arrays import FloatArray
from jtqd.sysid.diagnosis.entries import Entry
from jtqd.sysid.diagnosis.evidence import Equations, Scatter, Set, Sets, without_noise
from jtqd.sysid.diagnosis.limits import PRIORS, SURE
from jtqd.sysid.diagnosis.model import _End, _Search

EVEN = math.log(0.3 / 0.7)


def entry(
    size: int = 1,
    *,
    slot: object = None,
    odds: float = EVEN,
    low: float = -math.inf,
    high: float = math.inf,
    prior: str = "cogging",
) -> Entry:
    """An entry of `size` columns of which only numbers matter."""
    candidate = cast("Any", SimpleNamespace(size=size))
    return Entry(candidate, "made up", PRIORS[prior], np.eye(size), odds, (slot or object(),), low, high)


def gram_of(x: FloatArray, y: FloatArray) -> FloatArray:
    block = np.column_stack((x, y))
    return np.asarray(block.T @ block)


def log_density(y: FloatArray, covariance: FloatArray) -> float:
    """Of N(y; 0, covariance), less its constant."""
    return -0.5 * float(y @ np.linalg.solve(covariance, y)) - 0.5 * float(np.linalg.slogdet(covariance)[1])


SIZES = (1, 2, 1, 2, 1)
AT = ([0], [1, 2], [3], [4, 5], [6])


@pytest.fixture(scope="module")
def small() -> tuple[FloatArray, FloatArray, Sets]:
    """40 rows, entries of one and two columns, columns that have much in common, the second and the third entry there."""
    rng = np.random.default_rng(1)
    x = rng.normal(size=(40, 7)) * [0.3, 1.0, 0.2, 2.0, 0.5, 1.0, 0.1]
    x[:, 6] += 0.7 * x[:, 3]
    y = x @ np.array([0.0, 0.8, -0.5, 1.1, 0.0, 0.0, 0.0]) + rng.normal(size=40)
    entries = [
        entry(size, odds=odds) for size, odds in zip(SIZES, (EVEN, -3.0, EVEN, -1.0, 0.3), strict=True)
    ]
    return x, y, Sets(entries, gram_of(x, y))


EVERY: tuple[Set, ...] = tuple(frozenset(s) for s in ((), (0,), (1,), (2, 4), (0, 1, 2), (0, 1, 2, 3, 4)))


@pytest.mark.parametrize("chosen", EVERY, ids=str)
def test_evidence_is_the_marginal_likelihood(small: tuple[FloatArray, FloatArray, Sets], chosen: Set) -> None:
    x, y, sets = small
    columns = x[:, [j for k in sorted(chosen) for j in AT[k]]]
    whole = log_density(y, columns @ columns.T + np.eye(40))
    whole += sum(sets.entries[k].odds for k in chosen)
    nothing = log_density(y, np.eye(40))
    found = sets.fit(chosen)
    assert found.evidence - sets.fit(frozenset()).evidence == pytest.approx(whole - nothing, abs=1e-9)
    precision = columns.T @ columns + np.eye(columns.shape[1])
    assert found.mean == pytest.approx(np.linalg.solve(precision, columns.T @ y))
    assert found.covariance == pytest.approx(np.linalg.inv(precision))


@pytest.mark.parametrize("chosen", EVERY, ids=str)
def test_gains_are_differences_of_evidence(small: tuple[FloatArray, FloatArray, Sets], chosen: Set) -> None:
    _, _, sets = small
    gains = sets.gains(chosen)
    for k in range(len(SIZES)):
        if k in chosen:
            assert gains[k] == -math.inf
        else:
            both = sets.fit(chosen | {k}).evidence - sets.fit(chosen).evidence
            assert gains[k] == pytest.approx(both, abs=1e-9), k


def test_a_slot_is_taken_once_and_what_is_banned_stays_out(
    small: tuple[FloatArray, FloatArray, Sets],
) -> None:
    _, _, sets = small
    entries = [entry(size, slot="one" if k in (2, 4) else None) for k, size in enumerate(SIZES)]
    shared = Sets(entries, sets.gram)
    assert shared.gains(frozenset({2}))[4] == -math.inf
    assert math.isfinite(shared.gains(frozenset({1}))[4])
    assert 2 in Sets(entries, sets.gram).search(frozenset())
    assert 2 not in shared.search(frozenset(), banned=frozenset({2}))


def test_bounds_are_held_and_the_others_follow() -> None:
    """Friction is not negative: the best coefficient is -1.2, its bound -0.4; the others are as with that one fixed."""
    rng = np.random.default_rng(2)
    x = rng.normal(size=(200, 3)) @ np.array([[1.0, 0.6, 0.3], [0.0, 1.0, 0.2], [0.0, 0.0, 1.0]])
    y = x @ np.array([-1.2, 0.8, 0.3]) + rng.normal(size=200)
    sets = Sets([entry(low=-0.4), entry(high=5.0), entry()], gram_of(x, y))
    free = Sets([entry(), entry(), entry()], gram_of(x, y))
    every = frozenset({0, 1, 2})
    found = sets.fit(every)
    assert found.mean[0] == -0.4
    rest, inner = y + 0.4 * x[:, 0], x[:, 1:]
    assert found.mean[1:] == pytest.approx(np.linalg.solve(inner.T @ inner + np.eye(2), inner.T @ rest))
    assert found.evidence < free.fit(every).evidence
    assert sets.gains(frozenset())[0] == pytest.approx(
        sets.fit(frozenset({0})).evidence - sets.fit(frozenset()).evidence, abs=1e-9
    )
    best = max(
        (frozenset(s) for n in range(4) for s in combinations(range(3), n)),
        key=lambda s: sets.fit(s).evidence,
    )
    assert sets.search(frozenset()) == sets.search(every) == best


def greedy(sets: Sets, chosen: Set) -> Set:
    """The set from which neither an addition nor a removal gains."""
    while True:
        moves = [chosen ^ {k} for k in range(len(sets.entries))]
        best = max(moves, key=lambda s: sets.fit(s).evidence)
        if sets.fit(best).evidence <= sets.fit(chosen).evidence:
            return chosen
        chosen = best


@pytest.mark.parametrize(
    ("scale", "near"), [(0.3, 1.0), (0.7, 0.5), (3.0, 0.15)], ids=["weak", "strong", "stronger"]
)
def test_from_all_values_is_found_what_from_nothing_is_not(scale: float, near: float) -> None:
    """Two losses, and a column that is nearly their sum: with it in the set neither of the two is worth its odds."""
    rng = np.random.default_rng(5)
    a, b, others = rng.normal(size=300), rng.normal(size=300), rng.normal(size=(300, 3))
    x = max(scale, 1.0) * np.column_stack((a, b, a + b + near * rng.normal(size=300), others))
    y = scale * (a + b) + rng.normal(size=300)
    odds = (-1.0, -1.0, 1.0, EVEN, EVEN, EVEN)
    sets = Sets([entry(odds=each) for each in odds], gram_of(x, y))
    truth, wrong = frozenset({0, 1}), frozenset({2})
    assert sets.fit(truth).evidence > sets.fit(wrong).evidence + 2.0
    assert greedy(sets, wrong) == greedy(sets, frozenset()) == wrong, "else this shows nothing"
    assert sets.search(frozenset({0, 1, 2})) == truth


def test_in_noise_nothing_is_found() -> None:
    rng = np.random.default_rng(4)
    found = 0
    for _ in range(40):
        x, y = 5.0 * rng.normal(size=(100, 10)), rng.normal(size=100)
        found += len(Sets([entry(odds=-3.0) for _ in range(10)], gram_of(x, y)).search(frozenset()))
    assert found <= 1, "of 400 columns"


def test_what_these_runs_cannot_tell_is_as_uncertain_as_its_prior() -> None:
    """A column of no energy, and one that is in the set under another name; a strong one can be told."""
    rng = np.random.default_rng(5)
    x = rng.normal(size=(100, 4)) * [1.0, 0.02, 1.0, 1.0]
    x[:, 2] = x[:, 3] + 0.01 * x[:, 2]  # twice the same
    sets = Sets([entry() for _ in range(4)], gram_of(x, x[:, 3] + rng.normal(size=100)))
    assert sets.untold(frozenset()) == [1]
    strong = Sets(sets.entries, 400.0 * sets.gram)
    assert strong.untold(frozenset()) == []
    same = Sets(sets.entries[:2], strong.gram[np.ix_([2, 3, 4], [2, 3, 4])] + 1e3 * np.diag([0.0, 1e-9, 0.0]))
    assert same.untold(frozenset()) == []
    two = Sets([entry(2)], gram_of(x[:, :2], x[:, 3]))
    assert two.untold(frozenset()) == [0], "one of its coefficients is not told"


# Equations: what runs have of their own, discrepancy, noise in the columns.


def equations_of(
    blocks: Iterable[FloatArray],
    entries: Sequence[Entry],
    groups: Sequence[object],
    *,
    shared: Sequence[int] = (),
    noise: FloatArray | None = None,
    start: float = 0.5,
    most: float | None = None,
) -> Equations:
    """Of rows [E | N | y] of each run."""
    grams = np.array([b.T @ b for b in blocks])
    extra = np.zeros_like(grams) if noise is None else np.broadcast_to(noise, grams.shape).copy()
    kinds = set(groups)
    capped = {groups[k] for k in shared}
    limits = dict.fromkeys(capped, math.inf if most is None else most)
    return Equations(
        entries, grams, extra, groups, np.array(shared, np.intp), dict.fromkeys(kinds, (start, 2.0)), limits
    )


GROUPS = ("zero", "friction", "discrepancy", "discrepancy")


@pytest.fixture(scope="module")
def drifting() -> list[FloatArray]:
    """Five runs of 30 rows: three entries, an offset and a friction of the day, two features that all runs share."""
    rng = np.random.default_rng(6)
    w, out = rng.normal(size=2), []
    for _ in range(5):
        x, z, f = rng.normal(size=(30, 3)), rng.normal(size=(30, 2)), rng.normal(size=(30, 2))
        z[:, 0] = 1.0
        y = x @ [0.9, 0.0, -0.4] + z @ (rng.normal(size=2) * [0.8, 0.2])
        y = y + f @ (w + 0.3 * rng.normal(size=2)) + rng.normal(size=30)
        out.append(np.column_stack((x, z, f, y)))
    return out


VARIANCES = {"zero": 0.6, "friction": 0.1, "discrepancy": 0.2, ("shared", "discrepancy"): 0.7}


def covariance_of(
    blocks: Sequence[FloatArray], columns: Sequence[int], beside: Sequence[int] = ()
) -> FloatArray:
    """Of all y: entries N(0, 1), the runs' own nuisances, and the features' part that all runs share; that without what
    these columns explain of the features, by what the noise and the runs' own leave of both, under the same prior.
    """
    rows = np.vstack(blocks)
    x, other, f = rows[:, list(columns)], rows[:, list(beside)], rows[:, 5:7]
    out = np.eye(len(rows))
    first = 0
    for b in blocks:
        own = b[:, 3:7] * np.sqrt([VARIANCES[g] for g in GROUPS])
        out[first : first + len(b), first : first + len(b)] += own @ own.T
        first += len(b)
    weighed = np.linalg.solve(out, other)
    f = f - other @ np.linalg.solve(other.T @ weighed + np.eye(len(beside)), weighed.T @ f)
    return np.asarray(out + x @ x.T + VARIANCES["shared", "discrepancy"] * (f @ f.T))  # type: ignore[index]


@pytest.mark.parametrize(
    "chosen", [frozenset(), frozenset({0}), frozenset({0, 2}), frozenset({0, 1, 2})], ids=str
)
@pytest.mark.parametrize("beside", [frozenset(), frozenset({0, 2})], ids=str)
def test_nuisances_and_discrepancy_are_integrated_out(
    drifting: list[FloatArray], chosen: Set, beside: Set
) -> None:
    equations = equations_of(drifting, [entry() for _ in range(3)], GROUPS, shared=(2, 3))
    y = np.concatenate([b[:, -1] for b in drifting])
    sets = equations.sets(VARIANCES, beside, resembling=False)
    dense = log_density(y, covariance_of(drifting, sorted(chosen), sorted(beside))) + EVEN * len(chosen)
    nothing = log_density(y, covariance_of(drifting, (), sorted(beside)))
    assert sets.fit(chosen).evidence - sets.fit(frozenset()).evidence == pytest.approx(
        dense - nothing, abs=1e-8
    )


@pytest.mark.parametrize("chosen", [frozenset({0}), frozenset({0, 1, 2})], ids=str)
def test_a_set_is_scored_with_a_discrepancy_beside_it(drifting: list[FloatArray], chosen: Set) -> None:
    equations = equations_of(drifting, [entry() for _ in range(3)], GROUPS, shared=(2, 3))
    y = np.concatenate([b[:, -1] for b in drifting])
    _, score, means = equations.expected(chosen, VARIANCES, 0)
    _, empty, _ = equations.expected(frozenset(), VARIANCES, 0)
    of = covariance_of(drifting, sorted(chosen), sorted(chosen))
    dense = log_density(y, of) + EVEN * len(chosen) - log_density(y, covariance_of(drifting, ()))
    assert score - empty == pytest.approx(-2.0 * dense, abs=1e-8)
    sets = equations.sets(VARIANCES, chosen, resembling=False)
    assert means.beta == pytest.approx(sets.fit(chosen).mean)
    assert len(means.own) == len(drifting)


def test_what_a_value_of_the_file_explains_is_no_discrepancy(drifting: list[FloatArray]) -> None:
    """Of a set without it, too; one of its own kind in the set stands for it."""
    slot = object()
    entries = [
        entry(),
        entry(prior="viscous_friction", slot=slot),
        entry(prior="viscous_friction", slot=slot),
    ]
    equations = equations_of(drifting, entries, GROUPS, shared=(2, 3))
    y = np.concatenate([b[:, -1] for b in drifting])
    apart = []
    for chosen, beside in (((), {1, 2}), ((0,), {0, 1, 2}), ((0, 1), {0, 1}), ((2,), {2})):
        _, score, _ = equations.expected(frozenset(chosen), VARIANCES, 0)
        dense = log_density(y, covariance_of(drifting, chosen, sorted(beside))) + EVEN * len(chosen)
        apart.append(score + 2.0 * dense)
    assert apart == pytest.approx(4 * [apart[0]], abs=1e-8)


def test_what_resembles_an_entry_is_no_evidence_for_it(drifting: list[FloatArray]) -> None:
    """A discrepancy that may look like entry 0 as much as 2 is large: a prior of its own beside the set's."""
    plain = equations_of(drifting, [entry() for _ in range(3)], GROUPS, shared=(2, 3))
    rows = np.vstack(drifting)
    for k, found in enumerate(plain.resemblance["discrepancy"]):
        of_one = [np.linalg.lstsq(rows[:, [k]], rows[:, j], rcond=None)[0][0] for j in (5, 6)]
        assert found == pytest.approx(sum(x * x for x in of_one)), "of least squares in each feature"
    alike = copy(plain)
    alike.resemblance = {"discrepancy": np.array([0.64, 0.0, 4.0]) / 0.74}
    deviation = alike.deviation(VARIANCES)
    assert deviation == pytest.approx(np.array([0.8, 0.0, 1.0])), "no more than the prior"
    with_recorder = copy(alike)
    with_recorder.recorded = np.array([0.09, 0.04, 0.5])
    assert with_recorder.deviation(VARIANCES) == pytest.approx(np.sqrt([0.73, 0.04, 1.0]))
    y = np.concatenate([b[:, -1] for b in drifting])
    x = np.vstack(drifting)[:, :3] * deviation
    base = covariance_of(drifting, ()) + x @ x.T
    for chosen in (frozenset({0}), frozenset({0, 1})):
        column = np.vstack(drifting)[:, sorted(chosen)]
        dense = log_density(y, base + column @ column.T) - log_density(y, base) + EVEN * len(chosen)
        sets = alike.sets(VARIANCES)
        assert sets.fit(chosen).evidence - sets.fit(frozenset()).evidence == pytest.approx(dense, abs=1e-8)
    without = plain.sets(VARIANCES, resembling=False)
    assert alike.sets(VARIANCES).gains(frozenset())[0] < 0.1 * without.gains(frozenset())[0]


def test_one_gain_stands_for_all_that_it_scales() -> None:
    """Three columns, and a fourth that is their sum: three values that are the same are one step along it."""
    rng = np.random.default_rng(12)
    x = rng.normal(size=(200, 3))
    x = np.column_stack((x, x.sum(axis=1)))
    y = x @ [0.5, 0.5, 0.5, 0.0] + 0.1 * rng.normal(size=200)
    rows = np.column_stack((x, y)) / 0.1
    sets = Sets([entry() for _ in range(4)], rows.T @ rows)
    three = frozenset({0, 1, 2})
    assert sets.one_for_many(three) == [frozenset({3})]
    apart = np.column_stack((x, x[:, :3] @ [0.5, -0.2, 0.1] + 0.1 * rng.normal(size=200))) / 0.1
    assert Sets([entry() for _ in range(4)], apart.T @ apart).one_for_many(three) == []


@pytest.mark.parametrize("most", [None, 0.05], ids=["free", "capped"])
def test_steps_of_the_variances_raise_the_marginal_likelihood(
    drifting: list[FloatArray], most: float | None
) -> None:
    equations = equations_of(drifting, [entry() for _ in range(3)], GROUPS, shared=(2, 3), most=most)
    first: Any = dict.fromkeys(VARIANCES, 0.04)
    path = [equations.expected(frozenset({0, 2}), first, k)[1] for k in (0, 1, 2, 4, 8, 16)]
    assert all(after <= now + 1e-6 for now, after in pairwise(path)), (
        "the discrepancy turns with the variances"
    )
    assert path[0] > path[-1] + 1.0
    if most is not None:
        found, _, _ = equations.expected(frozenset({0, 2}), first, 16)
        assert found["discrepancy"] <= most
        assert found["shared", "discrepancy"] == most


def test_variances_of_many_runs_are_found() -> None:
    rng = np.random.default_rng(7)
    blocks = []
    for _ in range(150):
        z = rng.normal(size=(40, 2))
        y = z @ (rng.normal(size=2) * [1.5, 0.3]) + rng.normal(size=40)
        blocks.append(np.column_stack((rng.normal(size=40), z, y)))
    equations = equations_of(blocks, [entry()], ("one", "two"))
    found, _, _ = equations.expected(frozenset(), equations.first(), 60)
    assert math.sqrt(found["one"]) == pytest.approx(1.5, rel=0.2)
    assert math.sqrt(found["two"]) == pytest.approx(0.3, rel=0.2)


TRUE, ROWS, NOISE2 = 0.8, 400, 0.3


def errors_in_variables(seed: int, taken_out: bool) -> FloatArray:
    """Coefficients of a column that is known with noise, which the response has as well, and of one known without."""
    rng = np.random.default_rng(seed)
    x, clean = rng.normal(size=(2, ROWS))
    x = x + 0.5 * clean
    u = math.sqrt(NOISE2) * rng.normal(size=ROWS)
    y = TRUE * x - 0.4 * clean - u + rng.normal(size=ROWS)
    scale = 10.0  # of the coefficients' prior: wide
    block = np.column_stack((scale * (x + u), scale * clean, np.ones(ROWS), y))
    noise = np.zeros((4, 4))
    noise[0, 0], noise[0, 3], noise[3, 0], noise[3, 3] = (
        ROWS * NOISE2 * k for k in (scale**2, -scale, -scale, 1.0)
    )
    equations = equations_of([block], [entry(), entry()], ("zero",), noise=noise if taken_out else None)
    return scale * equations.sets({"zero": 0.01}).fit(frozenset({0, 1})).mean


def test_noise_in_a_column_bends_no_coefficient() -> None:
    """Without the correction the noise in the column attenuates, and what the response has of it adds: both go."""
    draws = range(200)
    with_it = np.array([errors_in_variables(k, True) for k in draws])
    without = np.array([errors_in_variables(k, False) for k in draws])
    spread = np.std(with_it, axis=0) / math.sqrt(len(draws))
    assert np.mean(with_it, axis=0) == pytest.approx((TRUE, -0.4), abs=float(4.0 * spread.max()))
    assert float(spread.max()) < 0.01
    assert np.mean(without[:, 0]) == pytest.approx((TRUE - NOISE2) / (1.0 + NOISE2), abs=0.03)


def with_noise(seed: int, columns: int = 6) -> tuple[FloatArray, FloatArray]:
    """Normal equations of columns and response, some alike, and what noise of some size puts into them."""
    rng = np.random.default_rng(seed)
    mixed = rng.normal(size=(columns + 1, columns + 1))
    mixed[:, 1] = mixed[:, 0] + 1e-3 * mixed[:, 1]
    rows = rng.normal(size=(300, columns + 1)) @ mixed
    noise = rng.normal(size=(300, columns + 1)) * rng.uniform(0.0, 2.0, columns + 1)
    return rows.T @ rows + noise.T @ noise, noise.T @ noise


@pytest.mark.parametrize("seed", range(20))
def test_equations_without_noise_are_those_of_measurements(seed: int) -> None:
    """Whatever is taken out: no square is negative, none explains more than there is, and the response keeps its own."""
    gram, noise = with_noise(seed)
    (clean,), _ = without_noise(
        gram[None], (1.0 + seed % 3) * noise[None]
    )  # known to its scatter, or not at all
    assert np.linalg.eigvalsh(clean)[0] > -1e-9 * np.trace(gram)
    assert np.linalg.eigvalsh((gram - clean)[:-1, :-1])[0] > -1e-9 * np.trace(gram)
    assert clean[-1, -1] == gram[-1, -1]


def test_it_does_not_matter_which_columns_span_the_equations_without_noise() -> None:
    gram, noise = with_noise(3)
    turn = np.eye(7)
    turn[:6, :6] = np.random.default_rng(4).normal(size=(6, 6))
    turned = without_noise((turn.T @ gram @ turn)[None], (turn.T @ noise @ turn)[None])
    for (other,), (one,) in zip(turned, without_noise(gram[None], noise[None]), strict=True):
        assert other == pytest.approx(turn.T @ one @ turn, rel=1e-6, abs=1e-6 * gram.max())


def test_a_direction_that_is_mostly_noise_is_none() -> None:
    """Two columns that differ by noise alone are one, although neither is noise for the most part."""
    gram = 100.0 * np.array([[1.0, 0.9, 0.5], [0.9, 1.0, 0.4], [0.5, 0.4, 1.0]])
    noise = np.diag([8.0, 8.0, 0.0])  # of their difference 16, of which there is 20
    (clean,), (taken,) = without_noise(gram[None], noise[None])
    one, other = np.array([1.0, -1.0]), np.array([1.0, 1.0])
    assert clean[:2, :2] @ one == pytest.approx(0.0, abs=1e-9)
    assert clean[:2, -1] @ one == pytest.approx(0.0, abs=1e-9)
    assert other @ clean[:2, :2] @ other == pytest.approx(380.0 - 16.0)
    assert clean[:2, -1] @ other == pytest.approx(90.0)
    assert taken[:2, :2] == pytest.approx(4.0, abs=1e-9)  # of their sum alone


@pytest.mark.parametrize(
    "shared", [0.0, 1.0], ids=["noise of the column alone", "noise that the response has, too"]
)
def test_what_noise_gives_a_set_by_chance_is_at_most_what_is_taken_off_its_evidence(shared: float) -> None:
    """Squares that noise alone leaves with a coefficient, less those without, over 2000 draws of 300 rows."""
    rng = np.random.default_rng(12)
    size = 0.3
    column = 0.5 * rng.normal(size=(2000, 300))
    response = rng.normal(size=(2000, 300)) + shared * column
    change = np.sum((response - size * column) ** 2 - response**2, axis=1)
    gram = 300.0 * np.array([[0.25, 0.25 * shared], [0.25 * shared, 1.0 + 0.25 * shared]])
    noise = Scatter(gram, 300.0)
    taken = noise.by_chance(np.array([size]))
    assert 0.6 * taken < SURE * np.std(change) < taken
    plain = gram_of(np.eye(3)[:, :1], np.array([3.0, 0.0, 0.0]))
    sets, sure = Sets([entry()], plain, noise=noise), Sets([entry()], plain)
    chosen = frozenset({0})
    mean = sure.fit(chosen).mean
    lost = sure.fit(chosen).evidence - sets.fit(chosen).evidence
    assert 2.0 * lost == pytest.approx(noise.by_chance(mean))
    alike = noise.by_chance(np.array([size]), np.array([size]))
    assert alike == 0.0
    assert sets.lacks(chosen, frozenset()) == pytest.approx(sure.lacks(chosen, frozenset()) - 4.0 * lost)


def test_a_score_and_an_evidence_lack_the_same_by_chance() -> None:
    """Noise is in column and response, so the sign of a coefficient decides how much it is."""
    rng = np.random.default_rng(14)
    blocks = [
        np.column_stack((rng.normal(size=(200, 1)), rng.normal(size=200), np.zeros(200))) for _ in range(3)
    ]
    for each in blocks:
        each[:, -1] = 0.4 * each[:, 0] + 0.1 * rng.normal(size=200)
    noise = np.array([[20.0, 0.0, 15.0], [0.0, 0.0, 0.0], [15.0, 0.0, 20.0]])
    equations = equations_of(blocks, [entry()], ("viscous",), noise=noise)
    chosen, variances = frozenset({0}), {"viscous": 1e-6}
    _, sure, means = equations.expected(chosen, variances, 0)
    equations.rows = 600.0
    _, score, _ = equations.expected(chosen, variances, 0)
    scatter = equations.sets(variances, chosen).noise
    taken = scatter.by_chance(means.beta)
    assert abs(taken - scatter.by_chance(-means.beta)) > 0.2 * taken
    assert score - sure == pytest.approx(taken)


def test_noise_that_each_recording_explains_by_its_own_is_no_gain_of_a_set() -> None:
    """A friction and that of the day have one column, and so one noise."""
    rng = np.random.default_rng(18)
    columns = [rng.normal(size=400) for _ in range(3)]
    blocks = [np.column_stack((x, x, -0.5 * x + rng.normal(size=400))) for x in columns]
    noise = 60.0 * np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
    equations = equations_of(blocks, [entry()], ("viscous",), noise=noise)
    equations.rows = 1200.0
    size = np.array([-0.5])
    little, wide = (equations.sets({"viscous": v}).noise.by_chance(size) for v in (1e-9, 10.0))
    assert little == pytest.approx(SURE * math.sqrt(2.0 / 1200.0) * 3.0 * 60.0 * 0.25, rel=1e-3)
    assert wide < 1e-3 * little


def test_noise_that_a_column_brings_into_the_discrepancy_is_taken_out_there_as_well() -> None:
    """The discrepancy is what the set's columns do not explain of it, so it has their noise, too. Were that left in, a
    coefficient and a discrepancy that cancel each other would explain noise: of a torque that is in column and response.
    """
    rng = np.random.default_rng(13)
    rows = 4000
    smooth, noise, own = np.linalg.qr(rng.normal(size=(rows, 3)))[0].T * math.sqrt(rows)
    block = np.column_stack((0.5 * smooth + 0.5 * noise, smooth, -noise + 0.3 * own)) / 0.3
    put_in = np.zeros((3, 3))
    put_in[0, 0], put_in[0, 2], put_in[2, 2] = 0.25 * rows, -0.5 * rows, rows
    put_in[2, 0] = put_in[0, 2]
    group = "discrepancy"
    equations = equations_of([block], [entry()], (group,), shared=(0,), noise=put_in / 0.09)
    variances = {group: 1.0, ("shared", group): 1.0}
    scores = [equations.expected(each, variances, 4)[1] for each in (frozenset[int](), frozenset({0}))]
    assert scores[1] > scores[0] - 6.0, "the response has no such effect"


def test_noise_that_the_set_takes_out_of_a_feature_is_not_left_in_its_response() -> None:
    """A feature is an entry's column and a clean one. Beside the entry only the clean one is discrepancy, and its share of
    the response brings no noise; beside the empty set it brings that of the whole feature.
    """
    rng = np.random.default_rng(9)
    x, clean = rng.normal(size=(2, 400))
    block = np.column_stack((x, x + clean, x + 2.0 * clean))
    noise = np.zeros((3, 3))
    noise[:2, :2] = 20.0  # of x, in the column and in the feature
    equations = equations_of([block, block], [entry()], ("discrepancy",), shared=(0,), noise=noise)
    variances = {"discrepancy": 1e-9, ("shared", "discrepancy"): 10.0}
    left = [equations.sets(variances, s).noise.gram[-1, -1] for s in (frozenset[int](), frozenset({0}))]
    assert left[0] > 40.0
    assert abs(left[1]) < 0.05 * left[0]


def test_an_entry_that_a_discrepancy_nearly_follows_is_found_among_weak_ones() -> None:
    """Of the empty set the discrepancy is as large as the effect: beside it weak columns, which cost nothing, promise more.
    Without a discrepancy the entry is in the first set that is tried.
    """
    rng = np.random.default_rng(17)
    f = rng.normal(size=(300, 12))
    x = f @ rng.normal(size=12) / math.sqrt(12.0) + 0.002 * rng.normal(size=300)
    weak = 1e-3 * rng.normal(size=(300, 6))
    y = 3.0 * x + 0.1 * rng.normal(size=300)
    block = np.column_stack((x, weak, f, y)) / 0.1
    group = "discrepancy"
    entries = [entry(odds=-3.0), *(entry(odds=-1.0) for _ in range(6))]
    equations = equations_of([block], entries, (group,) * 12, shared=range(12), start=1e-4)
    search = _Search(equations)
    hiding = equations.sets(search.own(frozenset()).variances)
    assert hiding.search(frozenset()) == frozenset(), "else this shows nothing"
    assert frozenset({0}) not in hiding.neighbours(frozenset())
    assert search.best([frozenset()], rivals=False).chosen == frozenset({0})


@pytest.mark.parametrize("own", [1.0, 400.0])
def test_a_set_is_shortened_only_where_it_loses_nothing_at_variances_of_its_own(own: float) -> None:
    """At the variances of the longer set the shorter one is nearly as good; at its own it is, or it is not."""
    long, short = frozenset({0, 1}), frozenset({0})
    fits = {long: 10.0, short: 9.0, frozenset({1}): -math.inf, frozenset(): -math.inf}
    sets = SimpleNamespace(
        effects=lambda chosen: [(k,) for k in sorted(chosen)],
        fit=lambda chosen: SimpleNamespace(evidence=fits[chosen]),
    )
    search = _Search(cast("Any", SimpleNamespace(sets=lambda *_, **__: sets)))
    search.met = {
        s: _End(score, s, {}, None)
        for s, score in ((long, 0.0), (short, own), (frozenset(), 1e9), (frozenset({1}), 1e9))
    }
    assert search._without_the_replaceable(search.met[long]).chosen == (short if own < 6.0 else long)


def test_a_nuisance_that_is_mostly_noise_in_a_recording_is_none_there() -> None:
    """Where a run hardly creeps, its presliding friction is noise, however large the variance of it."""
    rng = np.random.default_rng(9)
    blocks = [np.column_stack((rng.normal(size=(200, 2)), rng.normal(size=200))) for _ in range(2)]
    blocks[1][:, 1] *= 1e-3
    noise = np.array([np.zeros((3, 3)), np.diag([0.0, 1.1e-6 * 200, 0.0])])
    equations = equations_of(blocks, [entry()], ("smooth",), noise=noise)
    _, score, _ = equations.expected(frozenset({0}), {"smooth": 1e6}, 0)
    blocks[1][:, 1] = 0.0
    without = equations_of(blocks, [entry()], ("smooth",))
    assert score == pytest.approx(without.expected(frozenset({0}), {"smooth": 1e6}, 0)[1], abs=0.1)
