"""The noise model against known processes, and whitened sums against least squares with the dense covariance."""

from __future__ import annotations

import numpy as np
import pytest

from jtqd.estimator.arrays import FloatArray
from jtqd.sysid.diagnosis.noise import (
    ORDER,
    Noise,
    autoregression,
    noise_model,
    past_valid,
    run_sums,
    saturated_residuals,
    whiten,
)
from jtqd.sysid.diagnosis.regressors import ChannelData, RunData
from jtqd.sysid.diagnosis.signals import Channel
from tests.sysid.diagnosis.diagnose_core_helpers import MOTOR1, TORSION1, run_data

MOTOR2 = Channel(2, "motor")


def coloured(a: FloatArray, noise: FloatArray) -> FloatArray:
    out = np.zeros(len(noise))
    for t, e in enumerate(noise):
        past = out[max(0, t - len(a)) : t][::-1]
        out[t] = e + a[: len(past)] @ past
    return out


def padded(*a: float) -> FloatArray:
    return np.concatenate((a, np.zeros(ORDER - len(a))))


def test_coefficients_of_an_autoregression_come_back_through_gaps() -> None:
    rng = np.random.default_rng(3)
    truth = np.array([1.3, -0.6])
    series = [coloured(truth, rng.normal(size=12000)) for _ in range(3)]
    for x in series:
        for start in rng.integers(0, 11000, 8):
            x[start : start + 400] = np.nan
    assert autoregression(series, 2) == pytest.approx(truth, abs=0.02)
    assert autoregression(series) == pytest.approx(padded(*truth), abs=0.05), "and nothing beyond its order"
    assert autoregression([rng.normal(size=20000)], 3) == pytest.approx(np.zeros(3), abs=0.03)


def test_whitening_undoes_the_autoregression() -> None:
    rng = np.random.default_rng(4)
    e = rng.normal(size=(300, 2))
    a = np.array([0.9, -0.3, 0.0, 0.2])
    x = np.column_stack([coloured(a, e[:, k]) for k in (0, 1)])
    assert whiten(x, a) == pytest.approx(e, abs=1e-12)


@pytest.mark.parametrize("order", [1, 3, 7])
def test_a_row_counts_when_its_past_is_known(order: int) -> None:
    valid = np.random.default_rng(5).random(200) < 0.9
    slow = [t >= order and bool(valid[t - order : t + 1].all()) for t in range(200)]
    assert past_valid(valid, order).tolist() == slow
    assert not past_valid(np.ones(order, bool), order).any(), "shorter than its past"


NOISE = Noise(
    (MOTOR1, TORSION1, MOTOR2),
    {MOTOR1: padded(0.8), TORSION1: padded(0.5, -0.4), MOTOR2: padded(1.2, -0.5, 0.1)},
    np.array([0.5, 2.0, 1.0]),
    np.array([[1.0, 0.6, -0.2], [0.6, 1.0, 0.3], [-0.2, 0.3, 1.0]]),
    1.0,
)
COUNT, COLUMNS, NUISANCES = 90, 3, 2


def small_run(invalid: dict[Channel, list[int]]) -> RunData:
    """Three channels with some of three columns and two nuisances each; silent until every past is known."""
    rng = np.random.default_rng(6)
    where = {MOTOR1: ([0, 2], [0]), TORSION1: ([2, 1], [0, 1]), MOTOR2: ([0, 1], [1])}
    run = run_data("run", dict.fromkeys(where, np.zeros(COUNT)), {})
    for c, (index, families) in where.items():
        valid = np.ones(COUNT, bool)
        valid[invalid.get(c, [])] = False
        parts = [rng.normal(size=(COUNT, k)) for k in (len(index), len(families), 1)]
        for part in parts:
            part[:ORDER] = 0.0
        run.channels[c] = ChannelData(
            valid, parts[2][:, 0], parts[0], np.array(index, np.intp), parts[1], np.array(families, np.intp)
        )
    return run


def stacked(run: RunData) -> FloatArray:
    """[X Z y] of all channels one below the other, at the places of all columns and families."""
    rows = []
    for c in NOISE.channels:
        d = run.channels[c]
        wide = np.zeros((COUNT, COLUMNS + NUISANCES + 1))
        wide[:, d.index] = d.regressors
        wide[:, COLUMNS + d.families] = d.nuisances
        wide[:, -1] = d.residual
        rows.append(wide)
    return np.vstack(rows)


def filters() -> FloatArray:
    """The block diagonal matrix that whitens all channels in time."""
    out = np.zeros((3 * COUNT, 3 * COUNT))
    for k, c in enumerate(NOISE.channels):
        block = np.eye(COUNT)
        for lag, a in enumerate(NOISE.ar[c], 1):
            block -= a * np.eye(COUNT, k=-lag)
        out[k * COUNT : (k + 1) * COUNT, k * COUNT : (k + 1) * COUNT] = block
    return out


def innovations() -> FloatArray:
    one = NOISE.correlation * np.outer(NOISE.sigma, NOISE.sigma)
    return np.asarray(np.kron(one, np.eye(COUNT)), np.float64)


def test_whitened_sums_are_least_squares_with_the_dense_covariance() -> None:
    run = small_run({})
    inverse = np.linalg.inv(filters())
    covariance = inverse @ innovations() @ inverse.T
    every = stacked(run)
    direct = every.T @ np.linalg.solve(covariance, every)
    sums = run_sums(run, NOISE, COLUMNS, NUISANCES)
    assert sums.gram == pytest.approx(direct, rel=1e-8, abs=1e-8)
    assert sums.rows == 3 * (COUNT - ORDER)


def test_a_row_that_is_not_valid_is_left_out_of_its_own_channel_alone() -> None:
    """As if the innovations it is in had not been measured; the other channels keep theirs, and their correlation."""
    invalid = {MOTOR1: [40], TORSION1: [80, 81]}
    run = small_run(invalid)
    good = np.concatenate([past_valid(run.channels[c].valid, ORDER) for c in NOISE.channels])
    white = (filters() @ stacked(run))[good]
    direct = white.T @ np.linalg.solve(innovations()[np.ix_(good, good)], white)
    sums = run_sums(run, NOISE, COLUMNS, NUISANCES)
    assert sums.gram == pytest.approx(direct, rel=1e-8, abs=1e-8)
    assert sums.rows == int(good.sum()) == 3 * (COUNT - ORDER) - (ORDER + 1) - 10


def test_a_channel_that_a_run_has_not_is_not_missed() -> None:
    run = small_run({})
    del run.channels[TORSION1]
    sums = run_sums(run, NOISE, COLUMNS, NUISANCES)
    assert sums.rows == 2 * (COUNT - ORDER)
    assert np.isfinite(sums.gram).all()


def test_the_noise_of_two_channels_of_one_sensor_is_found() -> None:
    rng = np.random.default_rng(7)
    correlation = np.array([[1.0, -0.7], [-0.7, 1.0]])
    e = rng.multivariate_normal([0.0, 0.0], correlation, size=(3, 8000)) * [0.2, 3.0]
    parts = {
        c: [coloured(NOISE.ar[c], e[r, :, k]) for r in range(3)] for k, c in enumerate((MOTOR1, TORSION1))
    }
    runs = [run_data(f"run{r}", {c: parts[c][r] for c in parts}, {}) for r in range(3)]
    noise = noise_model(runs, parts, 0.005)
    assert noise.sigma == pytest.approx([0.2, 3.0], rel=0.03)
    assert noise.correlation == pytest.approx(correlation, abs=0.03)
    assert noise.inflation == pytest.approx(1.0, abs=0.2)


def test_what_wanders_over_seconds_widens_everything() -> None:
    """A zero that moves between seconds is more than an autoregression over a tenth of a second knows of."""
    rng = np.random.default_rng(8)
    level = np.repeat(rng.normal(0.0, 0.3, 60), 200)
    parts = {MOTOR1: [rng.normal(size=12000) + level]}
    runs = [run_data("run", {MOTOR1: parts[MOTOR1][0]}, {})]
    assert noise_model(runs, parts, 0.005).inflation > 1.5


def test_with_a_floor_no_frequency_has_more_weight_than_in_white_noise() -> None:
    """Slow noise, of which little is left at half the rate: without a floor that little would weigh many times more."""
    rng = np.random.default_rng(10)
    slow = coloured(np.array([1.6, -0.64]), rng.normal(size=20000))
    runs = [run_data("run", {MOTOR1: slow}, {})]
    k = np.arange(1, ORDER + 1)
    weights = {}
    for floor in (0.0, 1.0):
        noise = noise_model(runs, {MOTOR1: [slow]}, 0.005, floor)
        response = [
            1.0 - np.sum(noise.ar[MOTOR1] * np.exp(-1j * w * k)) for w in np.linspace(0.0, np.pi, 200)
        ]
        weights[floor] = np.var(slow) * np.abs(response) ** 2 / float(noise.sigma[0]) ** 2
    assert weights[0.0][-1] > 30.0
    assert weights[1.0].max() < 1.05
    assert weights[1.0][0] < 0.2, "slow noise is as large as it is"


def test_what_nothing_explains_is_the_residual_of_least_squares() -> None:
    rng = np.random.default_rng(9)
    runs = []
    for r in range(3):
        x = rng.normal(size=200)
        x[rng.integers(0, 200, 20)] = np.nan
        run = run_data(f"run{r}", {MOTOR1: x + r}, {})
        d = run.channels[MOTOR1]
        d.regressors, d.index = rng.normal(size=(200, 3)), np.array([4, 7, 9])
        d.residual = d.residual + d.regressors @ [1.0, -2.0, 5.0]
        runs.append(run)
    for leave in ((), (7,)):
        keep = [k for k, column in enumerate((4, 7, 9)) if column not in leave]
        rows, target = [], []
        for r, run in enumerate(runs):
            d = run.channels[MOTOR1]
            zeros = np.zeros((200, 3))
            zeros[:, r] = 1.0
            rows.append(np.hstack((d.regressors[:, keep], zeros))[d.valid])
            target.append(d.residual[d.valid])
        x, y = np.vstack(rows), np.concatenate(target)
        direct = y - x @ np.linalg.lstsq(x, y, rcond=None)[0]
        found = saturated_residuals(runs, MOTOR1, leave)
        for run, part in zip(runs, found, strict=True):
            assert np.isnan(part).tolist() == (~run.channels[MOTOR1].valid).tolist()
        everything = np.concatenate(found)
        assert everything[np.isfinite(everything)] == pytest.approx(direct, abs=1e-4)
