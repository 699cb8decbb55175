"""Native evaluation of a perceptron against numpy, and what does not fit into its block."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.native_network import Perceptron


def layers(seed: int, *widths: int) -> list[tuple[FloatArray, FloatArray]]:
    rng = np.random.default_rng(seed)
    pairs = itertools.pairwise(widths)
    return [(rng.normal(size=(m, n)), rng.normal(size=n)) for m, n in pairs]


def numpy_answer(parts: list[tuple[FloatArray, FloatArray]], x: FloatArray) -> FloatArray:
    for w, b in parts[:-1]:
        x = np.tanh(x @ w + b)
    w, b = parts[-1]
    answer: FloatArray = x @ w + b
    return answer


@pytest.mark.parametrize(
    "widths",
    [(6, 1), (6, 20, 40, 10, 1), (28, 20, 40, 10, 1), (1, 1, 1), (3, 128, 1), (9, 7, 6, 5, 4, 3, 2, 2, 1)],
)
def test_against_numpy(widths: tuple[int, ...]) -> None:
    x = np.random.default_rng(5).normal(size=(200, widths[0])) * 2.0
    plain = layers(1, *widths)
    many = Perceptron(plain).run_many(x)
    assert many == pytest.approx(numpy_answer(plain, x)[:, 0], abs=1e-11)
    assert many.tolist() == [Perceptron(plain).run_one(*row) for row in x.tolist()]


def tanh_many(x: FloatArray) -> FloatArray:
    """Of a perceptron with one neuron and weights of 1."""
    one = np.ones((1, 1)), np.zeros(1)
    return Perceptron([one, one]).run_many(x[:, None])


def test_the_tangent_is_within_4e_16_odd_and_keeps_nan() -> None:
    rng = np.random.default_rng(1)
    x = np.concatenate(
        [np.linspace(-25.0, 25.0, 100_001), rng.normal(size=50_000), np.logspace(-300, 300, 5000)]
    )
    found = tanh_many(x)
    assert np.max(np.abs(found - [math.tanh(each) for each in x.tolist()])) < 4e-16
    assert np.array_equal(tanh_many(-x), -found)
    assert np.max(np.abs(found)) == 1.0
    edges = tanh_many(np.array([0.0, -0.0, math.inf, -math.inf, math.nan])).tolist()
    assert edges[:4] == [0.0, 0.0, 1.0, -1.0]
    assert math.isnan(edges[4])


def test_what_does_not_fit_is_refused() -> None:
    assert Perceptron.fits(layers(1, 6, 128, 1))
    for widths in ((6, 129, 1), (6, *[4] * 8, 1), (6, 100, 100, 1)):
        assert not Perceptron.fits(layers(1, *widths))
        with pytest.raises(ValueError, match="too large"):
            Perceptron(layers(1, *widths))
    with pytest.raises(ValueError, match="found 2 outputs, expected 1"):
        Perceptron(layers(1, 6, 2))
    with pytest.raises(ValueError, match="found weights"):
        Perceptron([*layers(1, 6, 4), *layers(1, 5, 1)])
    with pytest.raises(ValueError, match="found 5 inputs, expected 6"):
        Perceptron(layers(1, 6, 1)).run_one(*[0.0] * 5)
