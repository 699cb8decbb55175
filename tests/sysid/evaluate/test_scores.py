"""Scores: errors, intervals, truth, jumps, plateaus and ranges, against closed forms and samples whose errors are known."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from jtqd.estimator.joint import QUADRANTS, Envelope
from jtqd.estimator.run import JointColumns, RunTable
from jtqd.estimator.status import DEGRADED, VALID
from jtqd.sysid.evaluate.evaluation import against_physics
from jtqd.sysid.evaluate.inputs import Samples, by_data
from jtqd.sysid.evaluate.scores import (
    LEVELS,
    PlateauScore,
    coverage,
    covered,
    crossings,
    error_tables,
    hardest_plateaus,
    interval_tables,
    is_constant,
    jumps_around,
    largest_jump,
    median_run,
    outside_scores,
    plateau_scores,
    row,
    score,
    standstill,
    training_range,
    truth_tables,
    velocity_bins,
    worst_plateau,
)
from jtqd.sysid.fit.plateaus import Mean, Plateau
from jtqd.sysid.report.page import thinned
from jtqd.sysid.runs.tables import read_truth, truth_path, write_truth
from tests.sysid.evaluate.evaluate_helpers import known, samples


def test_a_score_has_squares_percentile_and_largest_error() -> None:
    parts = [
        samples({"fused": np.array(errors)}, rated_nm=rated)
        for errors, rated in (([3.0, -4.0], 40.0), ([0.0, 5.0], 20.0))
    ]
    one = known(score(parts, "fused"))
    assert one.samples == 4
    assert one.mse_nm2 == pytest.approx(50.0 / 4)
    assert one.rmse_nm == pytest.approx(math.sqrt(12.5))
    # each joint's errors against its own rated torque
    assert one.rmse_rated_percent == pytest.approx(100 * math.sqrt((9 + 16) / 1600 / 4 + 25 / 400 / 4))
    assert one.max_nm == 5.0
    assert one.p95_nm == pytest.approx(np.quantile([3, 4, 0, 5], 0.95))
    assert score([each.where(np.zeros(2, bool)) for each in parts], "fused") is None
    assert score(parts, "tob") is None


def test_velocity_bins_have_their_lower_edge_inside() -> None:
    v = np.array([0.0, 0.049, -0.05, 0.2, -0.5, 0.99, 1.0, -2.0, 9.0])
    assert velocity_bins(v).tolist() == [0, 0, 1, 2, 3, 3, 4, 5, 5]


def test_the_standard_error_of_a_coverage_is_the_one_between_runs() -> None:
    """1000 campaigns of 20 runs of 50 to 500 samples that are right, or wrong, as a whole."""
    seed = 11
    rng = np.random.default_rng(seed)
    found = [
        coverage([np.full(rng.integers(50, 500), rng.random() < 0.9) for _ in range(20)]) for _ in range(1000)
    ]
    shares = np.array([one.share for one in found if one is not None])
    claimed = np.sqrt(np.mean([one.se**2 for one in found if one is not None]))
    assert claimed == pytest.approx(shares.std(), rel=0.1), seed
    assert math.isnan(known(coverage([np.ones(5, bool)])).se)
    assert coverage([]) is None


def test_intervals_of_a_normal_error_cover_their_level() -> None:
    seed = 5
    rng = np.random.default_rng(seed)
    runs = [samples({"fused": rng.normal(0.0, 2.0, 4000)}, run=str(k), sigma_nm=2.0) for k in range(10)]
    for level in LEVELS:
        assert known(covered(runs, "fused", level)).share == pytest.approx(level, abs=0.01), (seed, level)
    table = known(interval_tables(runs))
    assert table.curve["both"][0.8].share == pytest.approx(0.8, abs=0.01)
    assert list(table.quadrants[1]) == ["i_pos_w_pos"]  # the only quadrant with samples
    assert interval_tables([samples({"tob": np.zeros(5)})]) is None


def test_standstill_is_scored_by_sigma_itself_and_in_no_other_score() -> None:
    error = np.concatenate((np.full(60, 0.9), np.full(40, 1.1)))  # of the interval +-1: 60 % inside
    moving = np.zeros(100, bool)
    moving[-10:] = True
    one = samples({"fused": error}, scored=moving)
    still = standstill([one])[1]
    assert still.share == pytest.approx(0.9)
    assert still.coverage["fused"].share == pytest.approx(60 / 90)
    assert still.half_width_nm["fused"] == 1.0
    assert row([one])["fused"].samples == 10
    assert row([one])["fused"].mse_nm2 == pytest.approx(1.21)


def test_tables_pool_what_belongs_together() -> None:
    n = 100
    quadrant_1 = samples({"tob": np.full(n, 1.0), "fused": np.full(n, 0.1)}, run="a", number=1)
    quadrant_2 = samples(
        {"tob": np.full(n, 3.0), "fused": np.full(n, 0.3)},
        run="a",
        number=2,
        velocity_rad_s=np.full(n, -0.1),
        raw_nm=np.full(n, -1.0),
    )
    other = samples({"tob": np.full(n, 5.0), "fused": np.full(n, 0.5)}, run="b", number=2)
    tables = error_tables([quadrant_1, quadrant_2, other], {"a": 1, "b": 2})
    assert tables.tested["tob"].mse_nm2 == pytest.approx((1 + 25) / 2)  # j1 of a, j2 of b
    assert tables.both["tob"].mse_nm2 == pytest.approx((1 + 9 + 25) / 3)
    assert tables.joints[2]["tob"].mse_nm2 == pytest.approx((9 + 25) / 2)
    assert tables.quadrants[2]["i_neg_w_neg"]["tob"].mse_nm2 == pytest.approx(9)
    assert tables.quadrants[2]["i_pos_w_neg"] == {}
    assert tables.velocities[2]["0.05 to 0.2"]["fused"].mse_nm2 == pytest.approx(0.09)
    assert tables.runs["b", 2]["tob"].rmse_nm == pytest.approx(5.0)
    assert tables.bare_network_mse_nm2["both"] is None
    assert tuple(QUADRANTS) == tuple(tables.quadrants[1])


def test_a_method_that_one_joint_lacks_is_not_pooled() -> None:
    n = 10
    both = error_tables(
        [samples({"tob": np.ones(n), "fused": np.ones(n)}), samples({"tob": np.ones(n)}, number=2)],
        {"run": None},
    )
    assert set(both.both) == {"tob"}
    assert set(both.joints[1]) == {"tob", "fused"}
    assert both.tested == {}


def test_the_median_run_is_the_one_in_the_middle_by_ours() -> None:
    runs = [
        samples({"tob": np.full(9, 9.0 - k), "fused": np.full(9, float(k))}, run=f"r{k}")
        for k in (3, 0, 2, 1, 4)
    ]
    assert known(median_run(runs)).run == "r2"
    assert known(median_run(runs[:2])).run == "r0"  # the lower one of two
    assert median_run([]) is None


def test_runs_in_which_ours_is_worse_than_its_physics_are_found_and_no_others() -> None:
    def one(run: str, ours: float, physics: float) -> Samples:
        return samples({"physics": np.full(9, physics), "fused": np.full(9, ours)}, run=run)

    tables = error_tables([one("better", 0.1, 0.2), one("same", 0.3, 0.3), one("worse", 0.3, 0.2999)], {})
    assert [found[:2] for found in against_physics(tables.runs)[1]] == [("worse", 1)]


# Constant velocity ---------------------------------------------------------------------------------------


def _plateau(start_s: float, end_s: float, velocity: float = 2.5, current: float = -4.0) -> Plateau:
    return Plateau("run", start_s, end_s, Mean(velocity, 0.0), Mean(current, 0.0), Mean(-29.0, 0.1), 9)


def test_the_error_of_a_plateau_is_that_of_its_means() -> None:
    n = 4000
    ripple = 2.0 * np.sin(2 * np.pi * np.arange(n) / 50.0)  # averages out over whole periods
    one = samples({"tob": -3.0 + ripple, "fused": np.full(n, 0.2)}, sensor_nm=np.full(n, -30.0))
    (found,), lost = plateau_scores([_plateau(1.0, 3.0)], one)
    assert lost == []
    assert found.drive == "back"
    assert found.errors_nm["tob"] == pytest.approx(-3.0)
    assert found.percent["tob"] == pytest.approx(10.0)
    assert found.rated_percent["tob"] == pytest.approx(7.5)
    assert found.percent["fused"] == pytest.approx(2 / 3)
    assert plateau_scores([_plateau(1.0, 3.0, -2.5, -4.0)], one)[0][0].drive == "forward"


def test_a_plateau_without_load_has_no_relative_error_and_one_without_values_is_named() -> None:
    scored = np.ones(4000, bool)
    scored[1000:1500] = False
    one = samples({"tob": np.ones(4000)}, sensor_nm=np.full(4000, 1.9), scored=scored)
    found, lost = plateau_scores([_plateau(2.0, 3.0), _plateau(1.0, 2.0)], one)
    assert [each.percent["tob"] for each in found] == [None]
    assert found[0].rated_percent["tob"] == pytest.approx(2.5)
    assert len(lost) == 1
    assert "50 %" in lost[0]
    assert "1.00 to 2.00 s" in lost[0]


def test_the_hardest_plateaus_are_back_driven_fast_and_heavy() -> None:
    def one(drive: str, velocity: float, torque: float, error: float) -> PlateauScore:
        return PlateauScore("run", 1, 0.0, 1.0, drive, velocity, 1.0, torque, 40.0, {"fused": error})

    right = [one("back", 2.5, -30.0, 0.3), one("back", -2.45, 34.0, -0.6)]
    wrong = [one("forward", 2.5, 30.0, 9.0), one("back", 1.5, 30.0, 9.0), one("back", 2.5, 20.0, 9.0)]
    assert hardest_plateaus(right + wrong) == right
    found = known(worst_plateau(right, "fused", "rated_percent"))
    assert found[0] == pytest.approx(1.5)
    assert found[1] is right[1]
    assert worst_plateau(right, "tob", "percent") is None


def test_a_run_is_at_constant_velocity_when_plateaus_fill_it() -> None:
    one = samples({"tob": np.zeros(4000)})  # moves for 4 s
    assert is_constant([_plateau(0.0, 1.0)], one)
    assert not is_constant([_plateau(0.0, 0.9)], one)
    assert not is_constant([], samples({"tob": np.zeros(10)}, velocity_rad_s=np.zeros(10)))


# Outside of the envelope, velocity joint, curves -----------------------------------------------------------


def test_outside_is_by_the_envelope_and_not_the_status() -> None:
    known = (
        (0, 0, 1, 1, 0),
        (0, 1, 1, 0, 0),
        (0, 0, 1, 0, 0),
    )  # columns -2..2 of 10 Nm: -1 to 1 are known somewhere
    envelope = Envelope(0.5, 10.0, known, 5.0, (20.0, 30.0))
    limits = training_range(envelope)
    assert limits.torque_nm == (-15.0, 15.0)
    assert limits.temperature_c == (20.0, 30.0)
    raw = np.array([-16.0, -14.0, 14.0, 15.5])
    errors = {"physics": np.array([1.0, 9.0, 9.0, 1.0]), "fused": np.array([1.0, 0.0, 0.0, 2.0])}
    one = samples(errors, raw_nm=raw, temperature_c=25.0, status=DEGRADED)
    one.status["fused"][0] = VALID
    (found,) = outside_scores([one], {1: envelope})
    assert (found.samples, found.of, found.by_load, found.by_temperature) == (2, 4, 2, 0)
    assert found.physics is not None
    assert found.physics.mse_nm2 == pytest.approx(1.0)
    assert found.ours.mse_nm2 == pytest.approx(2.5)
    assert found.flagged == 0.5
    warm = samples(errors, raw_nm=raw, temperature_c=31.0, status=DEGRADED)
    (found,) = outside_scores([warm], {1: envelope})
    assert (found.samples, found.by_load, found.by_temperature, found.flagged) == (4, 2, 4, 1.0)
    assert outside_scores([samples(errors, temperature_c=25.0)], {1: envelope}) == []
    alone = samples({"fused": errors["fused"]}, raw_nm=raw, temperature_c=25.0, status=DEGRADED)
    assert [each.physics for each in outside_scores([alone], {1: envelope})] == [None]


def test_the_velocity_joint_is_the_one_whose_current_turns_over() -> None:
    seed = 7
    rng = np.random.default_rng(seed)
    t = np.arange(8000) * 1e-3
    smooth = 3.0 * np.sin(1.5 * t) + rng.normal(0.0, 0.01, len(t))
    rough = smooth + 0.5 * np.tanh(np.sin(2.0 * t) / 0.02)

    def table(one: np.ndarray, two: np.ndarray) -> RunTable:
        return RunTable(t, {1: JointColumns(current_a=one), 2: JointColumns(current_a=two)})

    assert by_data(table(rough, smooth)) == 1, seed
    assert by_data(table(smooth, rough)) == 2, seed
    assert by_data(table(smooth, smooth[::-1])) is None, seed
    assert by_data(RunTable(t, {1: JointColumns(current_a=rough)})) is None


def test_a_thinned_curve_keeps_its_spikes_and_its_gaps() -> None:
    seed = 1
    values = np.random.default_rng(seed).normal(size=20_000)
    values[1234], values[4321] = 50.0, -60.0
    values[9000:9500] = np.nan
    time = np.arange(20_000) * 1e-3
    short, kept = thinned(time, values, 500)
    assert len(kept) <= 1500, seed
    assert np.nanmax(kept) == 50.0
    assert np.nanmin(kept) == -60.0
    assert np.all(np.diff(short) > 0)
    inside = (short > 9.05) & (short < 9.45)
    assert np.isnan(kept[inside]).all()
    assert thinned(time[:50], values[:50], 500)[1] is not None


def test_a_crossing_is_found_once_although_noise_crosses_zero_often() -> None:
    seed = 2
    rng = np.random.default_rng(seed)
    x = np.linspace(-1.0, 1.0, 2001) + rng.normal(0.0, 0.02, 2001)
    found = crossings(x, 0.1)
    assert len(found) == 1, seed
    assert abs(found[0].at - 1000) < 60
    assert found[0].start <= found[0].at <= found[0].end
    # approaches, turns round, leaves to the side it came from: no crossing; a step over the whole band: one
    assert crossings(np.abs(x) + 0.05, 0.1) == []
    assert [(c.start, c.at, c.end) for c in crossings(np.array([-1.0, -1.0, 1.0, 1.0]), 0.1)] == [(2, 2, 2)]


def _reversal(step_nm: float, swing_nm: float = 0.0, late: int = 0) -> Samples:
    """1 s with v = 0 in the middle: the estimate steps there, the sensor swings (in 20 ms), the estimate follows late."""
    n = 1001
    k = np.arange(n)
    swing = swing_nm * np.clip((k - 490) / 20.0, 0.0, 1.0)
    estimate = swing_nm * np.clip((k - 490 - late) / 20.0, 0.0, 1.0) + step_nm * (k >= 500)
    v = np.linspace(-0.5, 0.5, n) + 1e-6  # positive from sample 500 on
    return samples({"fused": estimate - swing}, sensor_nm=5.0 + swing, velocity_rad_s=v)


@pytest.mark.parametrize("step", [0.3, -2.0])
def test_a_step_at_a_reversal_is_a_jump_of_its_size(step: float) -> None:
    jump = known(largest_jump([_reversal(step)], "fused"))
    assert jump.nm == pytest.approx(abs(step))
    assert (jump.of, jump.crossings) == ("v = 0", 1)
    assert jump.time_s == pytest.approx(0.5, abs=0.011)
    assert largest_jump([_reversal(step)], "tob") is None


def test_a_swing_of_the_torque_is_no_jump_even_when_it_is_followed_late() -> None:
    followed = known(largest_jump([_reversal(0.0, swing_nm=10.0)], "fused"))
    late = known(largest_jump([_reversal(0.0, swing_nm=10.0, late=5)], "fused", passage=True))
    both = known(largest_jump([_reversal(3.0, swing_nm=10.0)], "fused"))
    assert followed.nm <= 1e-9
    assert late.nm <= 1e-9
    assert late.unshifted_nm == pytest.approx(2.5, abs=0.3)  # 5 of 20 samples
    assert both.nm == pytest.approx(3.0)


def test_a_spike_within_the_window_is_seen_and_one_elsewhere_is_not() -> None:
    spike = np.zeros(1001)
    spike[505] = 4.0
    v = np.linspace(-0.5, 0.5, 1001)
    at = known(largest_jump([samples({"fused": spike}, velocity_rad_s=v)], "fused"))
    assert at.nm == pytest.approx(4.0)
    away = known(
        largest_jump([samples({"fused": np.roll(spike, 200)}, velocity_rad_s=v)], "fused", passage=True)
    )
    assert away.nm == 0.0


def test_jumps_are_shown_beside_those_anywhere_in_motion() -> None:
    """A spike every 100 ms is in a fifth of the windows: as usual as at the one crossing in two."""
    n = 10_001
    error = np.where(np.arange(n) % 100 == 50, 0.7, 0.0)
    v = np.sin(2.0 * np.pi * (np.arange(n) - 50) / 2500.0)  # 8 crossings, each at a spike
    found = known(largest_jump([samples({"fused": error}, velocity_rad_s=v)], "fused"))
    assert found.crossings == 8
    assert found.nm == found.elsewhere_nm == pytest.approx(0.7)  # 1 of 8 < 1 of 5
    once = np.where(np.arange(n) == 50, 0.7, 0.0)
    calm = known(largest_jump([samples({"fused": once}, velocity_rad_s=v)], "fused"))
    assert calm.elsewhere_nm == 0.0


def test_a_passage_includes_entry_and_exit_of_a_long_rest() -> None:
    v = np.concatenate((np.full(200, -0.5), np.zeros(600), np.full(200, 0.5)))
    error = np.where(np.arange(1000) < 203, 0.0, 1.5)  # steps as it comes to rest
    runs = [samples({"fused": error}, velocity_rad_s=v)]
    assert known(largest_jump(runs, "fused")).nm == 0.0  # zero is crossed at 800
    assert known(largest_jump(runs, "fused", passage=True)).nm == pytest.approx(1.5)


def test_jumps_are_not_taken_over_gaps() -> None:
    estimate = np.zeros(100)
    estimate[50] = np.nan
    jump = jumps_around(estimate, np.zeros(100), 21)
    assert np.isnan(jump[40:61]).all()
    assert (jump[10:40] == 0.0).all()
    assert np.isnan(jump[:10]).all()


# Truth ---------------------------------------------------------------------------------------------------

TIME = np.arange(4000) * 1e-3
TORQUE = 20.0 * np.sin(2.0 * np.pi * 0.5 * TIME)


def test_an_offset_of_the_sensor_is_no_error_against_the_truth() -> None:
    """The estimate is 0.5 Nm from the sensor, which is 0.5 Nm off: it is right."""
    one = samples({"fused": np.full(4000, -0.5)}, sensor_nm=TORQUE + 0.5, sigma_nm=0.2)
    tables = known(truth_tables([replace(one, true_nm=TORQUE)]))
    assert tables.now[1]["fused"].rmse_nm == pytest.approx(0.0, abs=1e-12)
    assert tables.aligned[1]["fused"].rmse_nm == pytest.approx(
        0.005 * 20.0 * 2.0 * np.pi * 0.5 / np.sqrt(2.0), rel=0.02
    )
    shifted = known(truth_tables([replace(one, true_nm=TORQUE + 2.0)]))
    assert known(shifted.intervals).overall.share < 0.01
    assert shifted.now[1]["fused"].rmse_rated_percent == pytest.approx(5.0)


def test_samples_without_truth_are_in_no_table() -> None:
    one = samples({"fused": np.zeros(4000)}, sensor_nm=TORQUE)
    assert truth_tables([one]) is None
    both = known(truth_tables([one, replace(one, number=2, true_nm=TORQUE + 1.0)]))
    assert list(both.now) == [2]


def test_true_torques_are_written_beside_a_run_and_a_broken_file_is_named(tmp_path: Path) -> None:
    run = tmp_path / "a.b.csv.gz"
    assert read_truth(run) == {}
    write_truth(run, {1: TORQUE, 2: -TORQUE})
    assert truth_path(run) == tmp_path / "a.b.truth.npz"
    found = read_truth(run)
    assert np.array_equal(found[1], TORQUE)
    assert np.array_equal(found[2], -TORQUE)
    truth_path(run).write_bytes(b"PK\x03\x04 nothing")
    with pytest.raises(ValueError, match="expected true torques"):
        read_truth(run)
