"""The noise of channels against known processes, the normal equations against stacked rows."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from jtqd.estimator.arrays import FloatArray
from jtqd.sysid.diagnosis.regressors import (
    ChannelData,
    Noise,
    RunData,
    noise_of_channels,
    run_sums,
    saturated_residuals,
)
from jtqd.sysid.diagnosis.signals import Channel
from tests.sysid.diagnosis.diagnose_core_helpers import MOTOR1, TORSION1, run_data

MOTOR2 = Channel(2, "motor")


def coloured(a: FloatArray, noise: FloatArray) -> FloatArray:
    out = np.zeros(len(noise))
    for t, e in enumerate(noise):
        past = out[max(0, t - len(a)) : t][::-1]
        out[t] = e + a[: len(past)] @ past
    return out


NOISE = Noise({MOTOR1: 0.5, TORSION1: 2.0, MOTOR2: 1.0}, 1.5, {})
COUNT, COLUMNS, NUISANCES = 90, 3, 2


def small_run(invalid: dict[Channel, list[int]]) -> RunData:
    """Three channels with some of three columns and two nuisances each."""
    rng = np.random.default_rng(6)
    where = {MOTOR1: ([0, 2], [0]), TORSION1: ([2, 1], [0, 1]), MOTOR2: ([0, 1], [1])}
    run = run_data("run", dict.fromkeys(where, np.zeros(COUNT)), {})
    for c, (index, families) in where.items():
        valid = np.ones(COUNT, bool)
        valid[invalid.get(c, [])] = False
        parts = [rng.normal(size=(COUNT, k)) for k in (len(index), len(families), 1)]
        run.channels[c] = ChannelData(
            valid, parts[2][:, 0], parts[0], np.array(index, np.intp), parts[1], np.array(families, np.intp)
        )
    return run


def stacked(run: RunData) -> tuple[FloatArray, float]:
    """[X Z y] of the valid rows of all channels one below the other, at the places of all columns and families, in units of
    noise; how many rows they are worth.
    """
    rows, worth = [], 0.0
    for c, d in run.channels.items():
        wide = np.zeros((COUNT, COLUMNS + NUISANCES + 1))
        wide[:, d.index] = d.regressors
        wide[:, COLUMNS + d.families] = d.nuisances
        wide[:, -1] = d.residual
        rows.append(wide[d.valid] / (NOISE.sigma[c] * np.sqrt(NOISE.inflation)))
        worth += int(d.valid.sum()) / NOISE.inflation
    return np.vstack(rows), worth


@pytest.mark.parametrize("missing", [(), (TORSION1,)])
@pytest.mark.parametrize("invalid", [{}, {MOTOR1: [40], TORSION1: [80, 81]}])
def test_sums_are_those_of_the_valid_rows(
    invalid: dict[Channel, list[int]], missing: tuple[Channel, ...]
) -> None:
    run = small_run(invalid)
    for c in missing:
        del run.channels[c]
    every, worth = stacked(run)
    sums = run_sums(run, NOISE, COLUMNS, NUISANCES)
    assert sums.gram == pytest.approx(every.T @ every, rel=1e-9, abs=1e-9)
    assert sums.rows == pytest.approx(worth)


def test_a_mean_is_as_certain_as_the_rows_are_independent() -> None:
    """Of an autoregression with 0.9 the variance of a mean is (1 + 0.9) / (1 - 0.9) times that of independent rows."""
    rng = np.random.default_rng(7)
    parts = {
        MOTOR1: [coloured(np.array([0.9]), rng.normal(size=12000)) for _ in range(3)],
        TORSION1: [3.0 * rng.normal(size=12000) for _ in range(3)],
    }
    parts[TORSION1][0][100:4000] = np.nan
    noise = noise_of_channels(parts, 0.005)
    assert noise.sigma[MOTOR1] == pytest.approx(1.0 / np.sqrt(1.0 - 0.81), rel=0.05)
    assert noise.sigma[TORSION1] == pytest.approx(3.0, rel=0.05)
    assert noise.inflation == pytest.approx(0.5 * (19.0 + 1.0), rel=0.2)
    assert noise_of_channels({MOTOR1: parts[MOTOR1]}, 0.005).inflation == pytest.approx(19.0, rel=0.2)
    assert noise_of_channels({TORSION1: parts[TORSION1]}, 0.005).inflation < 1.4


def test_what_wanders_over_seconds_widens_everything() -> None:
    rng = np.random.default_rng(8)
    level = np.repeat(rng.normal(0.0, 0.3, 60), 200)
    assert noise_of_channels({MOTOR1: [rng.normal(size=12000) + level]}, 0.005).inflation > 10.0


def test_what_the_equations_are_exact_to_repeats_in_every_bin() -> None:
    """A mean over many bins is no more certain than this, spread over so many directions."""
    for bins in (10_000, 1_000_000):
        noise = noise_of_channels({MOTOR1: [np.tile([1e-3, -1e-3], bins // 2)]}, 0.005, 0.2, 16)
        variance = noise.repeats[MOTOR1] * noise.inflation / bins
        assert variance == pytest.approx(0.05**2, rel=1e-9)
        run = run_data("run", {MOTOR1: np.ones(2)}, {})
        weight = run_sums(run, noise, 0, 0).gram[-1, -1] / 2.0
        assert weight == pytest.approx(1.0 / (bins * 0.05**2), rel=1e-3)
        assert run_sums(run, noise.random, 0, 0).gram[-1, -1] / 2.0 > 10.0 * weight, "no size is less for it"
    assert noise_of_channels({MOTOR1: [np.full(9, 0.5)]}, 0.005).sigma[MOTOR1] == pytest.approx(0.5)


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
        gain = SimpleNamespace(effect=SimpleNamespace(scales_all=True), columns=leave)
        found = saturated_residuals(runs, MOTOR1, [cast("Any", gain)])
        for run, part in zip(runs, found, strict=True):
            assert np.isnan(part).tolist() == (~run.channels[MOTOR1].valid).tolist()
        everything = np.concatenate(found)
        assert everything[np.isfinite(everything)] == pytest.approx(direct, abs=1e-4)
