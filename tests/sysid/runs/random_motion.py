"""Smooth random motions for training runs: windowed Fourier series with a rest between bursts, all from a seed. Pure."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

TimeFunction = Callable[[float], float]


@dataclass(frozen=True)
class Excitation:
    """Limits of a random motion.

    Attributes:
        velocity_rad_s: peak of the joint's velocity, joint side.
        travel_rad: largest excursion from the start.
        current_a: peak of the driving joint's current.
        burst_s, rest_s: length of a burst and of the rest after it.
        harmonics: number of sines in a burst.
    """

    velocity_rad_s: float = 2.6
    travel_rad: float = 2.6
    current_a: float = 4.5
    burst_s: float = 8.0
    rest_s: float = 2.0
    harmonics: int = 5


def random_velocity(limits: Excitation, duration_s: float, rng: np.random.Generator) -> TimeFunction:
    """Velocity over time [rad/s]: bursts that are odd about their middle, so that each comes back to where it began.

    The window cos^2 makes velocity and acceleration zero at both ends. Coefficients are scaled radially until peak
    velocity or travel reaches its limit (times a random share of 0.4 to 1, so that slow bursts are there as well).
    """
    period = limits.burst_s + limits.rest_s
    bursts = []
    x = np.linspace(-0.5, 0.5, 801)
    window = np.cos(math.pi * x) ** 2
    for _ in range(math.ceil(duration_s / period)):
        amplitudes = rng.normal(size=limits.harmonics)
        shape = window * sum(a * np.sin(2 * math.pi * k * x) for k, a in enumerate(amplitudes, 1))
        travel = np.abs(np.cumsum(shape)).max() * limits.burst_s / len(x)
        scale = rng.uniform(0.4, 1.0) / max(
            np.abs(shape).max() / limits.velocity_rad_s, travel / limits.travel_rad
        )
        bursts.append([float(scale * a) for a in amplitudes])

    def velocity(time_s: float) -> float:
        number, phase = divmod(time_s, period)
        place = (phase - limits.rest_s) / limits.burst_s - 0.5
        if not -0.5 < place < 0.5 or number >= len(bursts):
            return 0.0
        series = sum(a * math.sin(2 * math.pi * k * place) for k, a in enumerate(bursts[int(number)], 1))
        return math.cos(math.pi * place) ** 2 * series

    return velocity


def random_current(limits: Excitation, rng: np.random.Generator) -> TimeFunction:
    """Current over time [A]: four sines of incommensurate periods, rising from zero within 2 s, peak below the limit."""
    periods = rng.uniform(1.5, 9.0, 4)
    amplitudes = rng.uniform(0.2, 1.0, 4)
    amplitudes *= limits.current_a * rng.uniform(0.5, 1.0) / amplitudes.sum()
    phases = rng.uniform(0.0, 2 * math.pi, 4)
    terms = [
        (float(a), 2 * math.pi / float(p), float(f))
        for a, p, f in zip(amplitudes, periods, phases, strict=True)
    ]

    def current(time_s: float) -> float:
        rise = 1.0 if time_s >= 2.0 else 0.5 - 0.5 * math.cos(0.5 * math.pi * time_s)
        return rise * sum(a * math.sin(w * time_s + f) for a, w, f in terms)

    return current
