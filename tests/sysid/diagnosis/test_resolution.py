"""Steps of recorded values are found whatever recorder made them, and what they cost an acceleration is as computed."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from jtqd.estimator.arrays import FloatArray
from jtqd.sysid.diagnosis.smoothing import (
    Smoother,
    acceleration_noise,
    cutoff_hz,
    described,
    noise_of,
    steps_of,
)

STEP_S = 1e-3


def ramp(last: float = 2000.0, count: int = 20000) -> FloatArray:
    """A position that a motor may have: from 0 to `last`, never twice the same."""
    x = np.linspace(0.0, 1.0, count)
    result: FloatArray = last * (x + 0.05 * np.sin(9.0 * x))
    return result


def digits(x: FloatArray, count: int) -> FloatArray:
    return np.array([float(f"{v:.{count}g}") for v in x])


@pytest.mark.parametrize(
    ("recorder", "step"),
    [
        (lambda x: digits(x, 7), 1e-3),
        (lambda x: digits(x, 6), 1e-2),
        (lambda x: np.round(x, 2), 1e-2),
        (lambda x: x.astype(np.float32).astype(np.float64), 2.0**-13),
        (lambda x: np.round(x / 0.35) * 0.35, 0.35),
        (lambda x: x, 0.0),
    ],
    ids=["7 digits", "6 digits", "2 decimals", "single precision", "counts", "double precision"],
)
def test_steps_of_large_values_are_those_of_the_recorder(
    recorder: Callable[[FloatArray], FloatArray], step: float
) -> None:
    x = recorder(ramp())
    found = steps_of(x)[np.abs(x) > 1100.0]
    assert found == pytest.approx(step, rel=1e-3)


def test_steps_of_digits_grow_with_the_value() -> None:
    x = digits(ramp(), 7)
    found = steps_of(x)
    assert found[(x > 100.0) & (x < 990.0)] == pytest.approx(1e-4)
    assert "steps of 0.001 rad beyond 1e+03 rad" in described(x, "rad")


def test_a_few_samples_beyond_a_power_of_ten_have_its_steps() -> None:
    """Ten times the noise on one sample in 200 is more than a third of all noise."""
    x = digits(ramp(100.5, 4000), 6)
    few = x >= 100.0
    assert 5 < few.sum() < 200
    assert steps_of(x)[few] == pytest.approx(1e-3)
    assert steps_of(x)[(x > 20.0) & ~few] == pytest.approx(1e-4)
    assert noise_of(x)[few] == pytest.approx(1e-3 / math.sqrt(12.0), rel=0.2)


def test_a_few_values_that_come_again_show_no_steps() -> None:
    x = np.concatenate((digits(ramp(90.0, 4000), 6), np.full(50, 100.5)))
    assert steps_of(x)[-1] == pytest.approx(1e-4)


def test_counts_that_are_printed_with_few_digits_are_a_grid() -> None:
    """14 bits, seven digits: the last is a thirtieth of a count, and no two distances are printed alike."""
    count = 2.0 * math.pi / 2**14
    x = 50.0 + 40.0 * np.sin(ramp(60.0))
    x = digits(np.round(x / count) * count, 7)
    assert steps_of(x)[x > 10.0] == pytest.approx(count, rel=2e-3)
    assert noise_of(x)[x > 10.0] == pytest.approx(count / math.sqrt(12.0), rel=0.02)
    coarse = digits(x, 5)
    assert steps_of(coarse)[coarse > 10.0] == pytest.approx(1e-3), "a grid finer than what is printed is none"


@pytest.mark.parametrize("bits", [12, 13, 14, 16])
@pytest.mark.parametrize("count", [7, 8, 12])
def test_the_grid_of_an_encoder_is_one_for_slow_steady_and_quick_motion(bits: int, count: int) -> None:
    """A motor that cruises, whose neighbouring samples are always as far apart, and reverses, and is printed coarsely where
    it is far; of each part alone not even the order of the step can be told.
    """
    t = np.arange(0.0, 20.0, 1.0 / 250.0)
    speed = 50.0 * np.clip(np.sin(2.0 * np.pi * 0.08 * t) * 3.0, -0.9, 0.9)
    step = 2.0 * np.pi / 2.0**bits
    x = digits(np.round((120.3 + np.cumsum(speed) / 250.0) / step) * step, count)
    printed = 10.0 ** (np.floor(np.log10(np.abs(x))) + 1.0 - count)
    assert steps_of(x) == pytest.approx(np.maximum(step, printed), rel=1e-3)


@pytest.mark.parametrize("decimals", [2, 3, 4])
@pytest.mark.parametrize("count", [7, 12])
def test_a_velocity_that_is_printed_with_few_decimals_has_their_step(decimals: int, count: int) -> None:
    """Values that come many times; few about zero show none."""
    x = digits(np.round(150.0 * np.sin(2.0 * np.pi * 0.3 * np.arange(0.0, 20.0, 1e-3)), decimals), count)
    assert steps_of(x)[np.abs(x) > 1.0] == pytest.approx(10.0**-decimals, rel=1e-6)


def test_a_steady_motion_is_no_grid() -> None:
    rng = np.random.default_rng(0)
    x = 1000.0 + 0.1 * np.arange(400) + 1e-4 * rng.normal(size=400)
    assert not steps_of(x).any()


def test_noise_is_that_of_the_steps_or_of_what_is_quicker_than_motion() -> None:
    assert noise_of(digits(ramp(), 7))[-1] == pytest.approx(1e-3 / math.sqrt(12.0), rel=0.2)
    noisy = ramp() + 0.01 * np.random.default_rng(1).normal(size=20000)
    assert np.median(noise_of(noisy)) == pytest.approx(0.01, rel=0.15)


def test_quick_motion_is_no_noise() -> None:
    """A ripple at a third of the sampling rate, on most of the time."""
    noise = 1e-4 * np.random.default_rng(1).normal(size=20000)
    k = np.arange(20000)
    ripple = 1e-2 * np.sin(2.1 * k) * (np.sin(2.0 * np.pi * k / 5000) > -0.7)
    assert np.median(noise_of(ramp() + noise + ripple)) == pytest.approx(1e-4, rel=0.25)


def test_motion_up_to_most_of_the_bandwidth_is_no_noise() -> None:
    """Rows at 200 Hz, motion up to 60 Hz at all times and a line at half the rate, all ten times the noise and more."""
    rng = np.random.default_rng(6)
    spectrum = np.fft.rfft(rng.normal(size=4000))
    spectrum[1200:] = 0.0
    motion = np.fft.irfft(spectrum, 4000)
    line = 0.01 * (-1.0) ** np.arange(4000)
    noise = 0.01 * rng.normal(size=4000)
    assert np.median(noise_of(motion + line + noise)) == pytest.approx(0.01, rel=0.15)


@pytest.mark.parametrize("of_velocity", [False, True])
def test_noise_of_an_acceleration_is_what_differences_of_noise_have_below_a_cutoff(of_velocity: bool) -> None:
    rng = np.random.default_rng(2)
    white = 1e-3 * rng.normal(size=200_000)
    rate = np.gradient(white, STEP_S) if of_velocity else np.diff(white, 2) / STEP_S**2
    spectrum, hz = np.fft.rfft(rate), np.fft.rfftfreq(len(rate), STEP_S)
    slow = np.fft.irfft(np.where(hz < 30.0, spectrum, 0.0), len(rate))
    want = float(acceleration_noise(1e-3, STEP_S, 30.0, of_velocity=of_velocity))
    assert np.std(slow) == pytest.approx(want, rel=0.05)
    cutoff = cutoff_hz(np.array([1e-3]), STEP_S, want, of_velocity=of_velocity)
    assert cutoff == pytest.approx([30.0])


def test_a_smoother_is_linear_has_no_delay_and_leaves_alone_what_is_fine() -> None:
    hz = np.full(4000, np.inf)
    hz[2000:] = 20.0
    smoother = Smoother.of(hz, STEP_S)
    t = STEP_S * np.arange(4000)
    slow, quick = np.sin(2.0 * np.pi * 4.0 * t), np.sin(2.0 * np.pi * 70.0 * t)
    assert smoother(slow + quick) == pytest.approx(smoother(slow) + smoother(quick))
    assert smoother(quick)[:2000].tolist() == quick[:2000].tolist()
    assert np.max(np.abs(smoother(quick)[2200:3800])) < 0.01
    assert smoother(slow)[2200:3800] == pytest.approx(slow[2200:3800], abs=0.01)
    both = np.array([slow, quick])
    assert np.array_equal(smoother(both), [smoother(row) for row in both])
    assert Smoother.of(np.full(4000, 0.46 / STEP_S), STEP_S).parts == ()
