"""Parameters refined on runs by the equations, noise floor of repetitions, current at rest, effects put into the file."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.effects import EFFECTS
from jtqd.estimator.joint import Joint
from jtqd.estimator.run import RunTable
from jtqd.sysid.diagnosis import guards
from jtqd.sysid.diagnosis import refine as refine_module
from jtqd.sysid.diagnosis import regressors as columns_module
from jtqd.sysid.diagnosis.case import Fit
from jtqd.sysid.diagnosis.causes import _normal_phase, values_of
from jtqd.sysid.diagnosis.current_zero import RestCurrent, offset_at_rest, rest_current
from jtqd.sysid.diagnosis.dataset import Dataset
from jtqd.sysid.diagnosis.diagnose import combined, one_sensor, with_effects_applied
from jtqd.sysid.diagnosis.findings import AMBIGUOUS, CAUSE, INSUFFICIENT, NO_GAP, UNEXPLAINED, Findings, Gap
from jtqd.sysid.diagnosis.gain import held_out_gain
from jtqd.sysid.diagnosis.gaps import _repeats
from jtqd.sysid.diagnosis.guards import beyond_bounds, free_run_fall
from jtqd.sysid.diagnosis.mixed_model import ENOUGH_RUNS, Model
from jtqd.sysid.diagnosis.noise import ORDER, Noise
from jtqd.sysid.diagnosis.refine import (
    PresentEffect,
    Refined,
    free_names,
    parameter,
    present_effects,
    refine,
    set_torsion,
)
from jtqd.sysid.diagnosis.regressors import contribution, families
from jtqd.sysid.diagnosis.search import Hypothesis
from jtqd.sysid.diagnosis.signals import BaseLoss, JointSignals, joint_signals
from tests.estimator.effects.effect_signals import PLAIN, extended
from tests.estimator.effects.effect_signals import state as made_up_state
from tests.sysid.diagnosis.diagnose_core_helpers import MOTOR1, TORSION1, candidates, rigid_run, run_data
from tests.sysid.diagnosis.diagnose_helpers import cause, findings, value

NOISE_NM = 0.3
SAMPLES = 5
STRIBECK = EFFECTS["stribeck_friction"]
TRUTH = {"stribeck_nm": 1.2, "stribeck_velocity_rad_s": 0.14}


def signals(table: RunTable, joint: Joint = PLAIN, name: str = "run") -> JointSignals:
    return joint_signals(name, table, 1, joint, BaseLoss(joint))


def peaked(runs: int, seed: float, noise: float = NOISE_NM, day_nm: float = 0.0) -> Dataset:
    """Runs of a joint with a Stribeck peak unknown to its file; day_nm: more Coulomb friction than in the file."""
    file = replace(PLAIN, friction=replace(PLAIN.friction, coulomb_nm=PLAIN.friction.coulomb_nm - day_nm))
    tables = [
        rigid_run(
            PLAIN,
            seed + 0.61 * k,
            noise=noise,
            stribeck_nm=TRUTH["stribeck_nm"],
            stribeck_velocity_rad_s=TRUTH["stribeck_velocity_rad_s"],
        )
        for k in range(runs)
    ]
    made = [[signals(t, file, f"run{k}")] for k, t in enumerate(tables)]
    groups = families(made)
    binned = [columns_module.run_data(s, [], SAMPLES, groups) for s in made]
    floor = noise / SAMPLES**0.5
    unexplained = {c: [np.full(len(r.time_s), floor) for r in binned] for c in binned[0].channels}
    return Dataset(made, binned, [], SAMPLES, SAMPLES * 1e-3, unexplained, groups, [])


WHITE = Noise(
    (MOTOR1, TORSION1),
    {MOTOR1: np.zeros(ORDER), TORSION1: np.zeros(ORDER)},
    np.array([NOISE_NM / SAMPLES**0.5, 1.0]),
    np.eye(2),
    1.0,
)


def start(**values: float) -> PresentEffect:
    return PresentEffect(STRIBECK, 1, values, free_names(STRIBECK, values))


@pytest.fixture(scope="module")
def refined() -> tuple[Dataset, Refined]:
    dataset = peaked(4, 0.2)
    return dataset, refine(dataset, [start(stribeck_nm=0.6, stribeck_velocity_rad_s=0.12)], WHITE)


def test_a_parameter_in_an_exponent_is_found_from_a_wrong_start(refined: tuple[Dataset, Refined]) -> None:
    """From half the size and the nearest velocity of the grid of the search; the equation is not linear in it."""
    _, result = refined
    found, spread = result.present[0].values, np.sqrt(np.diag(result.covariance))
    for k, (name, true) in enumerate(TRUTH.items()):
        assert result.present[0].free[k] == name
        assert abs(found[name] - true) < 4.0 * spread[k]
        assert 0.0 < spread[k] < 0.1 * true
    assert (result.random_share >= 0.0).all()
    assert (result.random_share < 1.0).all()


def test_without_noise_the_truth_is_reached() -> None:
    result = refine(peaked(2, 0.2, 0.0), [start(stribeck_nm=1.0, stribeck_velocity_rad_s=0.12)], WHITE)
    assert dict(result.present[0].values) == pytest.approx(TRUTH, rel=5e-3)


def test_a_start_from_afar_takes_as_many_steps_as_it_needs() -> None:
    """A quarter of the size at four times the velocity: six steps end 7e-5 Nm short."""
    result = refine(peaked(2, 0.2, 0.0), [start(stribeck_nm=0.3, stribeck_velocity_rad_s=0.6)], WHITE)
    assert dict(result.present[0].values) == pytest.approx(TRUTH, rel=1e-5)


def test_where_steps_do_not_come_to_rest_the_best_ones_count(monkeypatch: pytest.MonkeyPatch) -> None:
    """Steps that reach the truth and then go on, to and fro."""
    values = iter([{"stribeck_nm": 0.8}, {}, *({"stribeck_nm": 2.0 + 0.1 * (n % 2)} for n in range(40))])

    def stepped(look: Any) -> tuple[list[PresentEffect], bool]:
        return [replace(p, values={**TRUTH, **next(values)}) for p in look.present], False

    monkeypatch.setattr(refine_module, "_stepped", stepped)
    result = refine(peaked(2, 0.2, 0.0), [start(stribeck_nm=0.3, stribeck_velocity_rad_s=0.6)], WHITE)
    assert dict(result.present[0].values) == TRUTH
    left = np.concatenate([r.channels[MOTOR1].residual[r.channels[MOTOR1].valid] for r in result.runs])
    assert float(np.std(left)) < 1e-3


def test_what_is_left_is_the_noise(refined: tuple[Dataset, Refined]) -> None:
    _, result = refined
    left = np.concatenate([r.channels[MOTOR1].residual[r.channels[MOTOR1].valid] for r in result.runs])
    assert float(np.std(left)) == pytest.approx(WHITE.sigma[0], rel=0.05)


def test_the_gain_is_that_of_the_truth(refined: tuple[Dataset, Refined]) -> None:
    """Before: the peak and the noise; after: the noise alone, on runs whose parameters came from the others."""
    dataset, result = refined
    gain = held_out_gain(dataset, result)
    assert gain.rmse_after_nm == pytest.approx(WHITE.sigma[0], rel=0.05)
    peak: list[FloatArray] = []
    for run in dataset.signals:
        whole = contribution(STRIBECK, TRUTH, run[0])["motor"]
        peak.append(columns_module.binned(whole, SAMPLES)[dataset.runs[len(peak)].channels[MOTOR1].valid])
    truth = float(np.sqrt(np.mean(np.concatenate(peak) ** 2) + WHITE.sigma[0] ** 2))
    assert gain.rmse_before_nm == pytest.approx(truth, rel=0.05)
    low, high = gain.ci95
    assert low <= gain.rmse_before_nm - gain.rmse_after_nm <= high
    assert "motor balance of joint 1" in gain.split
    assert [each.run for each in gain.runs] == [run.name for run in dataset.runs]
    squares = np.mean([(r.rmse_before_nm**2, r.rmse_after_nm**2) for r in gain.runs], axis=0)
    assert np.sqrt(squares) == pytest.approx((gain.rmse_before_nm, gain.rmse_after_nm), rel=0.01), (
        "equal runs"
    )
    assert gain.free_run_after < gain.free_run_before
    assert gain.free_run_position_after < gain.free_run_position_before
    assert free_run_fall(dataset, result, 0) > 0.0


def test_the_torsion_of_a_spring_that_hardens_by_its_own_stiffness_is_solved_for() -> None:
    """Iterated, K d = tau - K3 d^3 swings out where 3 K3 d^2 is more than K."""
    s = signals(rigid_run(PLAIN, 0.3))
    stiffness = PLAIN.stiffness_nm_per_rad
    twist = PLAIN.rated_torque_nm / stiffness
    s.state.torque_nm = np.linspace(-1.3, 1.3, len(s.time_s)) * PLAIN.rated_torque_nm
    for cubic in (1.5, 0.02, -0.05):
        values = {"stiffness_nm_per_rad": 0.9 * stiffness, "cubic_nm_per_rad3": cubic * stiffness / twist**2}
        set_torsion(s, [PresentEffect(EFFECTS["nonlinear_stiffness"], 1, values, tuple(values))])
        d = s.state.torsion_rad
        spring = values["stiffness_nm_per_rad"] * d + values["cubic_nm_per_rad3"] * d**3
        assert spring == pytest.approx(s.state.torque_nm, abs=1e-3 * PLAIN.rated_torque_nm)
    set_torsion(s, ())
    assert s.state.torsion_rad == pytest.approx(s.state.torque_nm / stiffness)


@pytest.mark.filterwarnings("error")
def test_the_torsion_of_a_spring_that_cannot_hold_the_torque_stays_finite() -> None:
    """A softening spring holds no more than its peak; the search tries such values, and steps to them overflowed."""
    s = signals(rigid_run(PLAIN, 0.3))
    stiffness = PLAIN.stiffness_nm_per_rad
    twist = PLAIN.rated_torque_nm / stiffness
    for stiff, cubic in ((0.9, -2.0), (2.4, -40.0), (0.1, -1e4), (1.0, -1e9)):
        values = {
            "stiffness_nm_per_rad": stiff * stiffness,
            "cubic_nm_per_rad3": cubic * stiffness / twist**2,
        }
        set_torsion(s, [PresentEffect(EFFECTS["nonlinear_stiffness"], 1, values, tuple(values))])
        assert np.max(np.abs(s.state.torsion_rad)) < 15.0 * twist


def test_a_step_stays_in_range_and_is_not_too_long() -> None:
    one = start(stribeck_nm=1.0, stribeck_velocity_rad_s=0.1)
    low, high = (getattr(parameter(STRIBECK, "stribeck_nm"), end) for end in ("low", "high"))
    assert one.moved([1e9, 0.0]).values["stribeck_nm"] <= max(1.5, 1.0 + 0.05 * (high - low))
    down = one
    for _ in range(50):
        down = down.moved([-1e9, -1e9])
    assert down.values["stribeck_nm"] == low
    assert down.values["stribeck_velocity_rad_s"] == parameter(STRIBECK, "stribeck_velocity_rad_s").low


def test_orders_and_channels_are_not_refined() -> None:
    ripple = EFFECTS["torque_ripple"]
    assert free_names(ripple, {"amplitude_nm": 0.3, "order_per_motor_rev": 2.0, "phase_rad": 0.1}) == (
        "amplitude_nm",
        "phase_rad",
    )
    delay = EFFECTS["channel_delay"]
    assert free_names(delay, {"delay_s": 0.002, "channel": 1.0}) == ("delay_s",)


def test_the_floor_of_repeated_runs_is_their_noise() -> None:
    t = 0.005 * np.arange(4000)
    axes = {"velocity": np.cos(t), "load": 20.0 * np.sin(1.7 * t)}
    same = 2.0 * np.sin(3.0 * t)
    rng = np.random.default_rng(1)

    def run(name: str, drift: float, conditions: dict[str, FloatArray]) -> columns_module.RunData:
        parts = {c: same + drift + rng.normal(0.0, 0.25, 4000) for c in (MOTOR1, TORSION1)}
        return run_data(name, parts, conditions)

    other = {"velocity": np.cos(1.3 * t), "load": 20.0 * np.sin(1.7 * t)}
    dataset = peaked(2, 0.0)
    repeated = replace(dataset, runs=[run("a", 0.0, axes), run("b", 0.0, axes), run("c", 5.0, other)])
    for channel in (MOTOR1, TORSION1):
        assert _repeats(repeated, channel) == pytest.approx(0.25, rel=0.05)
    moved = replace(dataset, runs=[run("a", 0.0, axes), run("b", 0.4, axes)])
    assert _repeats(moved, TORSION1) == pytest.approx(0.25, rel=0.05), "each run has its zero there"
    assert _repeats(moved, MOTOR1) == pytest.approx((0.25**2 + 0.5 * 0.4**2) ** 0.5, rel=0.05)
    assert _repeats(replace(dataset, runs=[run("a", 0.0, axes), run("c", 0.0, other)]), MOTOR1) is None


FOLDED = (
    ("viscous_friction", {"viscous_nms_per_rad": 4.5}),
    ("coulomb_friction", {"coulomb_nm": 3.1}),
    ("rotor_inertia", {"rotor_inertia_kgm2": 8e-5}),
)


def test_an_effect_for_a_value_of_the_file_is_that_value() -> None:
    """Residuals of the joint with the value are those of the file less what the effect leaves."""
    s = signals(rigid_run(PLAIN, noise=0.1))
    joint = extended(PLAIN, *FOLDED)
    other = with_effects_applied(joint)
    assert other.effects == ()
    assert (other.friction.viscous_nms_per_rad, other.friction.coulomb_nm) == (4.5, 3.1)
    assert other.rotor_inertia_kgm2 == 8e-5
    left = s.motor_nm - sum(contribution(EFFECTS[n], p, s)["motor"] for n, p in FOLDED)
    assert signals(rigid_run(PLAIN, noise=0.1), other).motor_nm == pytest.approx(left, abs=1e-9)


def test_effects_that_are_more_than_a_value_stay() -> None:
    ripple = ("torque_ripple", {"amplitude_nm": 0.3})
    cubic = ("nonlinear_stiffness", {"cubic_nm_per_rad3": 1e9, "stiffness_nm_per_rad": 11000.0})
    found = with_effects_applied(extended(PLAIN, ripple, FOLDED[0], cubic))
    assert [e.name for e in found.effects] == ["torque_ripple", "nonlinear_stiffness"]
    assert found.friction.viscous_nms_per_rad == 4.5
    assert with_effects_applied(found) == found
    assert with_effects_applied(PLAIN) == PLAIN


def resting(current_a: list[float], number: int = 1) -> JointSignals:
    """Rests of half a second at these currents between motions."""
    parts, speeds = [], []
    for a in current_a:
        parts += [np.full(250, 3.0), np.full(100, 1.0), np.full(150, a)]
        speeds += [np.full(250, 0.5), np.zeros(250)]
    n = 500 * len(current_a)
    state = made_up_state(1, n)
    state.current_a, state.velocity_rad_s = np.concatenate(parts), np.concatenate(speeds)
    nothing = np.zeros(n)
    return JointSignals("run", number, PLAIN, state.time_s, state, nothing, None, nothing == 1.0, nothing)


def test_the_current_at_rest_is_that_of_the_second_half_of_every_rest() -> None:
    found = rest_current([[resting([0.05, 0.052, 0.048, 0.05, 0.05])]], 1)
    assert found is not None
    assert found.mean_a == pytest.approx(0.05)
    assert found.rests == 5
    assert found.scatter_a < 0.003
    assert rest_current([[resting([0.05, 0.05])], [resting([0.05])]], 1) is None, "three rests"
    assert rest_current([[resting([0.05] * 5)]], 2) is None


@pytest.mark.parametrize(
    ("rest", "shows"),
    [
        (RestCurrent(0.05, 0.002, 6), True),
        (RestCurrent(0.045, 0.002, 6), True),
        (RestCurrent(0.0, 0.001, 6), False),
        (RestCurrent(-0.05, 0.001, 6), False),
        (RestCurrent(0.05, 0.03, 6), False),
        (None, False),
    ],
)
def test_an_offset_is_one_that_every_rest_shows(rest: RestCurrent | None, shows: bool) -> None:
    assert offset_at_rest(rest, 0.05) is shows


def test_one_sensor_is_the_same_column() -> None:
    one = rigid_run(PLAIN)
    both = RunTable(one.time_s, {1: one.joints[1], 2: one.joints[1]})
    torque = one.joints[1].torque_nm
    assert torque is not None
    own = RunTable(one.time_s, {1: one.joints[1], 2: replace(one.joints[1], torque_nm=torque + 0.1)})
    assert one_sensor([("a", both), ("b", one)], (1, 2))
    assert not one_sensor([("a", both), ("b", own)], (1, 2))


@pytest.mark.parametrize(
    ("verdicts", "whole"),
    [
        ((NO_GAP, NO_GAP), NO_GAP),
        ((CAUSE, NO_GAP), CAUSE),
        ((CAUSE, AMBIGUOUS), AMBIGUOUS),
        ((UNEXPLAINED, AMBIGUOUS), UNEXPLAINED),
        ((NO_GAP, INSUFFICIENT), INSUFFICIENT),
    ],
)
def test_joints_together_have_the_verdict_that_asks_for_most(verdicts: tuple[str, str], whole: str) -> None:
    parts = [
        replace(findings(v, (), gain=None), joints=(n,), reasons=("why",), gaps=())
        for n, v in enumerate(verdicts, 1)
    ]
    found = combined(parts)
    assert found.verdict == whole
    assert found.joints == (1, 2)
    assert found.reasons == ("joint 1: why", "joint 2: why")


def test_joints_together_put_the_largest_first() -> None:
    small, large = (
        replace(cause("coulomb_friction", n, {"coulomb_nm": value(4.4)}), rms_nm=rms)
        for n, rms in ((1, 0.2), (2, 0.9))
    )

    def part(n: int, one: object, gap: float, plan: str) -> Findings:
        base = findings(CAUSE, (one,), joints=(n,), gaps=(Gap(n, "motor", gap, 0.1, "repeated runs", ()),))  # type: ignore[arg-type]
        assert base.gain is not None
        return replace(base, gain=replace(base.gain, split=f"joint {n}"), next_experiment={"why": plan})

    found = combined([part(1, small, 0.3, "first"), part(2, large, 0.8, "second")])
    assert [c.joint for c in found.causes] == [2, 1]
    assert [g.joint for g in found.gaps] == [2, 1]
    assert found.gain is not None
    assert found.gain.split == "joint 2", "of the largest cause"
    assert found.next_experiment is not None
    assert found.next_experiment["why"] == "Joint 1: first Joint 2: second"
    assert [each["joint"] for each in found.next_experiment["joints"]] == [1, 2]


def test_an_amplitude_is_positive_and_its_phase_within_a_turn() -> None:
    wave = {"amplitude_nm": value(-0.5, 0.1), "phase_rad": value(0.3, 0.05, "rad")}
    found = _normal_phase(wave)
    assert found["amplitude_nm"] == value(0.5, 0.1)
    assert found["phase_rad"].value == pytest.approx(0.3 - np.pi)
    assert found["phase_rad"].ci95 == pytest.approx((0.25 - np.pi, 0.35 - np.pi))
    around = _normal_phase({"amplitude_nm": value(0.5), "phase_rad": value(6.2, 0.2, "rad")})
    assert around["phase_rad"].value == pytest.approx(6.2 - 2 * np.pi)
    assert around["phase_rad"].ci95 == pytest.approx((6.0 - 2 * np.pi, 6.4 - 2 * np.pi))
    plain = {"gain": value(-1.0)}
    assert _normal_phase(plain) == plain


@pytest.mark.parametrize(
    ("name", "values", "part"),
    [
        ("hysteresis", {"torque_nm": 0.5, "travel_rad": 3.1e-5}, 0.05),
        ("link_inertia", {"link_inertia_kgm2": 0.3}, 0.04),
        ("stribeck_friction", {"stribeck_nm": 0.5, "stribeck_velocity_rad_s": 0.052}, 0.015),
        ("torque_constant", {"torque_constant_nm_per_a": 0.084}, 0.015),
    ],
)
def test_no_interval_is_narrower_than_a_part_of_the_size(
    name: str, values: dict[str, float], part: float
) -> None:
    """A travel or a velocity is its own size, however near it lies to where the search began; a constant of the file differs
    from the file's by its size.
    """
    (one,) = candidates(PLAIN, (name, 1, 0))
    free = tuple(values)
    certain = Refined(
        (PresentEffect(one.effect, 1, values, free),),
        1e-18 * np.eye(len(free)),
        np.zeros(len(free)),
        SimpleNamespace(runs=6),  # type: ignore[arg-type]
        np.ones(1),
        np.zeros((6, 1)),
        (),
    )
    model = Model((), np.empty(0), np.empty((0, 0)), np.ones(1), 0.0, 0.0, np.zeros((1, 1)))
    found = values_of(Fit(Hypothesis((one,), model, 0.0), certain), 0)
    base = {"torque_constant_nm_per_a": 0.08, "link_inertia_kgm2": PLAIN.link_inertia_kgm2}
    for key, true in values.items():
        half = part * (true - base.get(key, 0.0))
        assert found[key].ci95 == pytest.approx((true - half, true + half))


def test_terms_of_the_search_are_where_a_refinement_starts() -> None:
    """Coefficients of a wave's two columns and the wave refined are the same torque."""
    (one,) = candidates(PLAIN, ("torque_ripple", 1, 1))
    s = signals(rigid_run(PLAIN))
    columns = [contribution(one.effect, p, s)["motor"] for p in one.term.basis]
    whole = contribution(one.effect, one.term.combine([0.7, -1.1]), s)["motor"]
    assert whole == pytest.approx(0.7 * columns[0] - 1.1 * columns[1], abs=1e-9)


def test_a_refinement_starts_within_the_ranges_of_its_parameters() -> None:
    """Columns that others left behind can combine to an infinite rate; one of no size ended the diagnosis with an error."""
    warm = candidates(PLAIN, ("temperature_dependent_friction", 1, 0))
    columns = [0.0, -100.0]  # viscous friction that would feed energy in
    assert warm[0].term.combine(columns)["viscous_per_k"] == -np.inf
    model = Model((0, 1), np.array(columns), np.eye(2), np.ones(1), 0.0, 0.0, np.zeros((1, 1)))
    (start,) = present_effects(Hypothesis(tuple(warm), model, 0.0))
    limits = parameter(start.effect, "viscous_per_k")
    assert start.values["viscous_per_k"] == limits.low
    assert beyond_bounds(start, {}), "and is then refused"


def test_where_no_torque_was_measured_a_cause_must_lower_the_position_error_of_a_free_run(
    refined: tuple[Dataset, Refined], monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset, result = refined
    monkeypatch.setattr(guards, "nothing_of", lambda _: [{}])
    monkeypatch.setattr(guards, "free_run_fall", lambda *_: -0.1)
    best = Hypothesis((), result, 0.0)  # type: ignore[arg-type]
    assert guards.objections(dataset, best, result) == []
    found = guards.objections(replace(dataset, no_torque=True), best, result)
    assert found == [(0, "it raises the error of the position in a free run on held-out runs")]


def test_causes_that_lower_the_plain_error_nowhere_on_runs_left_out_are_none(
    refined: tuple[Dataset, Refined], monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset, result = refined
    monkeypatch.setattr(guards, "nothing_of", lambda _: [{}])
    best = Hypothesis((), result, 0.0)  # type: ignore[arg-type]
    assert guards.objections(dataset, best, result) == []
    monkeypatch.setattr(guards, "falls_nm", lambda squares: dict.fromkeys(squares, 0.0))
    assert guards.objections(dataset, best, result) == [(0, "it raises the error on held-out runs")]


@pytest.mark.parametrize("runs", [3, 4])
def test_a_friction_of_the_day_that_lies_against_a_cause_speaks_against_it_with_few_runs_only(
    runs: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A peak of 1.2 Nm, days with 0.5 Nm less friction than the file: without the peak the plain error is less."""
    dataset = peaked(runs, 0.2, day_nm=-0.5)
    result = refine(dataset, [start(stribeck_nm=0.6, stribeck_velocity_rad_s=0.12)], WHITE)
    assert result.present[0].values == pytest.approx(TRUTH, rel=0.15)
    gain = held_out_gain(dataset, result)
    monkeypatch.setattr(guards, "nothing_of", lambda _: [{}])
    found = guards.objections(dataset, Hypothesis((), result, 0.0), result)  # type: ignore[arg-type]
    if runs < ENOUGH_RUNS:
        assert found == [(0, "it raises the error on held-out runs")]
        assert gain.plain_nm is None
        assert gain.rmse_after_nm >= gain.rmse_before_nm
        return
    assert found == []
    assert gain.plain_nm is not None
    assert gain.plain_nm[1] > gain.plain_nm[0] > gain.rmse_before_nm > 1.3 * gain.rmse_after_nm
    assert gain.rmse_after_nm == pytest.approx(WHITE.sigma[0], rel=0.1)
    assert gain.split.endswith("without run-to-run variation")
