"""A small genetic algorithm: (mu + lambda), tournaments, blend crossover, mutation that fades. Pure.

Genomes are rows in the box [-1, 1]^d. Written for criteria that evaluate a whole generation at once and forgive nothing:
there are no penalties, the criterion makes its own genomes feasible.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Criterion = Callable[[FloatArray], FloatArray]
"""Values [m], lower is better, of genomes [m, d]; may be infinite, never NaN."""

POPULATION: Final = 40
TOURNAMENT: Final = 2
BLEND: Final = 0.3
"""How far beyond its parents a child may lie, in parts of their distance (BLX-alpha)."""
MUTATION_START: Final = 0.3
MUTATION_END: Final = 0.01
MUTATION_RATE: Final = 0.3
"""Standard deviation at the first and at the last generation, and the chance of each gene to be touched."""


class Found(NamedTuple):
    """Best genome [d] and its value."""

    genome: FloatArray
    value: float


def random_genomes(count: int, dimension: int, rng: np.random.Generator) -> FloatArray:
    """Return `count` genomes, uniform in the box."""
    return rng.uniform(-1.0, 1.0, (count, dimension))


def minimise(criterion: Criterion, dimension: int, *, evaluations: int, rng: np.random.Generator) -> Found:
    """Return the best of exactly `evaluations` genomes (>= 1); the same generator state gives the same result.

    Every generation makes as many children as there are parents; the best of both survive. A child is a random point of
    the box that its two parents span, widened by BLEND on each side, then mutated.

    Raises:
        ValueError: evaluations below 1.
    """
    if evaluations < 1:
        raise ValueError(f"{evaluations} evaluations")
    size = min(POPULATION, evaluations)
    parents = random_genomes(size, dimension, rng)
    values = criterion(parents)
    done = size
    while done < evaluations:
        number = min(size, evaluations - done)
        progress = done / evaluations
        sigma = MUTATION_START * (MUTATION_END / MUTATION_START) ** progress
        one, two = parents[_winners(values, number, rng)], parents[_winners(values, number, rng)]
        share = rng.uniform(-BLEND, 1.0 + BLEND, (number, dimension))
        touched = rng.random((number, dimension)) < MUTATION_RATE
        noise = np.where(touched, rng.normal(0.0, sigma, (number, dimension)), 0.0)
        children = np.clip(one + share * (two - one) + noise, -1.0, 1.0)
        everyone = np.concatenate([parents, children])
        all_values = np.concatenate([values, criterion(children)])
        keep = np.argsort(all_values, kind="stable")[:size]
        parents, values = everyone[keep], all_values[keep]
        done += number
    return Found(parents[0] if done > size else parents[int(np.argmin(values))], float(values.min()))


def _winners(values: FloatArray, number: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Index of the best of TOURNAMENT random parents, `number` times."""
    players = rng.integers(0, len(values), (number, TOURNAMENT))
    best = np.argmin(values[players], axis=1)
    winners: NDArray[np.intp] = players[np.arange(number), best]
    return winners
