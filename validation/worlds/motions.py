"""What the MuJoCo bench is asked to do: velocity of one joint, current of the other, [n] at 1 kHz, relative to 1."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from validation.worlds.sets import Array

STEP_S: Final = 1e-3


@dataclass(frozen=True)
class Motion:
    """leader: index (0, 1) of the joint in velocity mode; the other follows load_a. temperature_c: [2, n]."""

    leader: int
    velocity_rad_s: Array
    load_a: Array
    start_rad: float
    temperature_c: Array


def _waves(rng: np.random.Generator, t: Array, slowest_s: float, fastest_s: float) -> Array:
    periods = np.exp(rng.uniform(np.log(fastest_s), np.log(slowest_s), 4))
    phases = rng.uniform(0.0, 2.0 * np.pi, 4)
    x = sum(np.sin(2.0 * np.pi * t / p + f) * p**0.4 for p, f in zip(periods, phases, strict=True))
    y: Array = x / np.max(np.abs(x))
    return y


def _moves(rng: np.random.Generator, t: Array) -> Array:
    """Point to point: trapezoids of velocity with rests between."""
    v = np.zeros_like(t)
    at, side = 0.6, float(rng.choice([-1.0, 1.0]))
    while at < t[-1]:
        top, ramp, length, rest = (
            rng.uniform(0.15, 1.0),
            rng.uniform(0.15, 0.5),
            rng.uniform(0.3, 1.8),
            rng.uniform(0.1, 0.6),
        )
        trapezoid = np.clip(np.minimum((t - at) / ramp, (at + 2 * ramp + length - t) / ramp), 0.0, 1.0)
        v += side * top * trapezoid
        at += 2 * ramp + length + rest
        side = -side
    return v


def _stairs(rng: np.random.Generator, t: Array) -> Array:
    """Return constant velocities up and down both directions."""
    levels = rng.permutation(np.concatenate((x := np.array([0.06, 0.2, 0.45, 0.75, 1.0]), -x)))
    k = np.minimum((t / t[-1] * len(levels)).astype(int), len(levels) - 1)
    width = 400
    padded = np.pad(levels[k], width, mode="edge")
    smooth: Array = np.convolve(padded, np.hanning(width) / np.hanning(width).sum(), "same")[width:-width]
    return smooth


def _creep(rng: np.random.Generator, t: Array) -> Array:
    period = rng.uniform(2.5, 5.0)
    triangle = 2.0 / np.pi * np.arcsin(np.sin(2.0 * np.pi * t / period))
    return rng.uniform(0.08, 0.25) * triangle


def _sweep(rng: np.random.Generator, t: Array) -> Array:
    """Return a swing whose frequency rises while its size falls: equal acceleration."""
    rate = 0.25 * (2.5 / 0.25) ** (t / t[-1])
    phase = 2.0 * np.pi * np.cumsum(rate) * STEP_S
    x: Array = np.sin(phase) * (0.25 / rate) ** 0.5
    return x


def _turns(rng: np.random.Generator, t: Array) -> Array:
    fast = rng.uniform(0.7, 1.0) * float(rng.choice([-1.0, 1.0]))
    v = np.where(t < 0.55 * t[-1], fast, -0.8 * fast)
    smooth: Array = np.convolve(np.pad(v, 300, mode="edge"), np.full(300, 1 / 300), "same")[300:-300]
    return smooth


SHAPES: Final[dict[str, Callable[[np.random.Generator, Array], Array]]] = {
    "waves": lambda rng, t: _waves(rng, t, 9.0, 1.5),
    "moves": _moves,
    "stairs": _stairs,
    "creep": _creep,
    "sweep": _sweep,
    "turns": _turns,
}


def _load(rng: np.random.Generator, t: Array) -> Array:
    if rng.uniform() < 0.5:
        return _waves(rng, t, 8.0, 1.2)
    count = int(rng.integers(8, 16))
    levels = rng.uniform(-1.0, 1.0, count)
    k = np.minimum((t / t[-1] * count).astype(int), count - 1)
    smooth: Array = np.convolve(np.pad(levels[k], 100, mode="edge"), np.full(100, 0.01), "same")[100:-100]
    return smooth


def draw_motion(  # noqa: PLR0917
    rng: np.random.Generator,
    kind: str,
    run: int,
    seconds: float,
    speed_rad_s: float,
    load_a: tuple[float, float],
) -> Motion:
    """Return run number `run`; load_a: largest current of joints 1 and 2 while they are the load."""
    t = STEP_S * np.arange(round(seconds / STEP_S))
    leader = int(rng.integers(2))
    begin = np.clip(t / 0.5, 0.0, 1.0)
    warm = [
        24.0
        + 2.5 * run
        + rng.uniform(0.0, 3.0)
        + rng.uniform(3.0, 8.0) * (1.0 - np.exp(-t / rng.uniform(5, 20)))
        for _ in range(2)
    ]
    return Motion(
        leader,
        speed_rad_s * SHAPES[kind](rng, t) * begin,
        load_a[1 - leader] * _load(rng, t) * begin,
        float(rng.uniform(-3.0, 3.0)),
        np.array(warm),
    )
