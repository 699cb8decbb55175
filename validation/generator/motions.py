"""References of one run: velocity of one joint, current of the other, drawn at random.

All arrays are [n] at 1 kHz. Every run has rests: standstill, both drives off, so zero current and zero set load.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

STEP_S: Final = 1e-3
RUN_S: Final = 20.0
KINDS: Final = ("fourier", "ladder", "slow", "turns")
PROFILES: Final = ("mixed", *KINDS, "constant")
"""mixed: every kind of KINDS in turn; constant: one speed and one load per run, which tells little (for refusals)."""

Array = np.ndarray


@dataclass(frozen=True)
class Motion:
    """velocity_rad_s, load_a, on: [n]; leader: index (0, 1) of the joint in velocity mode, the other takes load_a; marked:
    where the run table has the drives without power [n], None: it has no such column.
    """

    kind: str
    leader: int
    velocity_rad_s: Array
    load_a: Array
    on: Array
    start_rad: float
    temperature_c: Array  # [2, n]
    marked: Array | None = None


@dataclass(frozen=True)
class Reference:
    """Set-points that somebody asks for, [n] at 1 kHz: velocity of joint `leader` (0, 1), current of the other; off: (first,
    end) of samples for which the drives are to be switched off.
    """

    leader: int
    velocity_rad_s: Array
    load_a: Array
    off: tuple[tuple[int, int], ...] = ()


def driven_motion(
    rng: np.random.Generator, reference: Reference, run: int, count: int, samples: int
) -> Motion:
    """Return the motion of a reference, at rest after its end up to `samples`; drives are off where nothing is asked."""
    spare = samples - len(reference.velocity_rad_s)
    velocity = np.pad(reference.velocity_rad_s, (0, spare))
    load = np.pad(reference.load_a, (0, spare))
    idle = (velocity == 0.0) & (load == 0.0)
    settled = np.convolve(idle, np.ones(200), "full")[:samples] > 199.5
    marked = np.zeros(samples, bool)
    for first, end in reference.off:
        marked[first:end] = True
    t = STEP_S * np.arange(samples)
    start = float(rng.uniform(-3.0, 3.0))
    return Motion(
        "asked",
        reference.leader,
        velocity,
        load,
        ~(settled | marked),
        start,
        _temperature(rng, t, run, count),
        marked if reference.off else None,
    )


def draw_motion(  # noqa: PLR0917
    rng: np.random.Generator,
    kind: str,
    joints: tuple[dict[str, Any], dict[str, Any]],
    run: int,
    count: int,
    duration_s: float = RUN_S,
) -> Motion:
    """Return the references of run number `run` of `count`."""
    n = round(duration_s / STEP_S)
    t = STEP_S * np.arange(n)
    leader = int(rng.integers(2))
    follower = joints[1 - leader]
    speed = _speed_limit(rng, joints)
    rated = min(j["rated_torque_nm"] for j in joints)
    load = rng.uniform(0.5, 0.75) * rated / (follower["gear_ratio"] * follower["torque_constant_nm_per_a"])
    velocity, current = _SHAPES[kind](rng, t)
    moving, on = _rests(rng, t)
    return Motion(
        kind=kind,
        leader=leader,
        velocity_rad_s=speed * velocity * moving,
        load_a=load * current * moving,
        on=on,
        start_rad=float(rng.uniform(-3.0, 3.0)),
        temperature_c=_temperature(rng, t, run, count),
    )


def kinds(rng: np.random.Generator, profile: str, count: int) -> list[str]:
    """Return the kind of each of `count` runs; ValueError for an unknown profile."""
    if profile not in PROFILES:
        raise ValueError(f"profile: found {profile!r}, expected one of {', '.join(PROFILES)}")
    if profile != "mixed":
        return [profile] * count
    order = [KINDS[k % len(KINDS)] for k in range(count)]
    return [order[k] for k in rng.permutation(count)]


def _speed_limit(rng: np.random.Generator, joints: tuple[dict[str, Any], dict[str, Any]]) -> float:
    """Return a top speed [rad/s] at which friction alone takes at most 55 % of rated torque of either joint."""
    limits = [
        (0.55 * j["rated_torque_nm"] - j["friction"]["coulomb_nm"]) / j["friction"]["viscous_nms_per_rad"]
        for j in joints
    ]
    return float(min(rng.uniform(1.2, 2.2), *limits))


def _waves(rng: np.random.Generator, t: Array, low_hz: float, high_hz: float, count: int = 6) -> Array:
    """Return a sum of sines with non-commensurate periods, largest magnitude 1."""
    f = np.exp(rng.uniform(np.log(low_hz), np.log(high_hz), count))
    a = rng.uniform(0.4, 1.0, count) * (low_hz / f) ** 0.3
    x = np.sin(2 * np.pi * np.outer(f, t) + rng.uniform(0, 2 * np.pi, (count, 1)))
    y: Array = a @ x
    y /= np.max(np.abs(y))
    return y


def _levels(rng: np.random.Generator, t: Array, values: Array, ramp_s: float) -> Array:
    """Return plateaus of `values` of nearly equal length, joined by ramps."""
    edges = np.linspace(0.0, t[-1] + STEP_S, len(values) + 1)
    edges[1:-1] += rng.uniform(-0.1, 0.1, len(values) - 1) * edges[1]
    x = values[np.clip(np.searchsorted(edges, t, "right") - 1, 0, len(values) - 1)]
    wide = max(1, round(ramp_s / STEP_S))
    smooth: Array = np.convolve(np.pad(x, wide, mode="edge"), np.full(wide, 1.0 / wide), "same")[wide:-wide]
    return smooth


def _fourier(rng: np.random.Generator, t: Array) -> tuple[Array, Array]:
    return _waves(rng, t, 0.08, 1.0), _waves(rng, t, 0.06, 0.9)


def _ladder(rng: np.random.Generator, t: Array) -> tuple[Array, Array]:
    steps = np.geomspace(0.05, 1.0, 5)
    values = rng.permutation(np.concatenate((steps, -steps)))
    loads = rng.uniform(0.15, 1.0, 22) * rng.choice([-1.0, 1.0], 22)
    return _levels(rng, t, values, 0.25), _levels(rng, t, loads, 0.03)


def _slow(rng: np.random.Generator, t: Array) -> tuple[Array, Array]:
    period = rng.uniform(2.0, 4.5)
    slow = rng.uniform(0.06, 0.25) * np.sin(2 * np.pi * t / period)
    fade = _smooth_step((t - rng.uniform(0.5, 0.65) * t[-1]) / 1.0)
    velocity = slow * (1 - fade) + fade * _waves(rng, t, 0.15, 0.7)
    return velocity, _waves(rng, t, 0.1, 0.7)


def _turns(rng: np.random.Generator, t: Array) -> tuple[Array, Array]:
    values = np.array([1.0, -rng.uniform(0.5, 0.9)]) * rng.choice([-1.0, 1.0])
    velocity = _levels(rng, t, values, 0.5) * (0.85 + 0.15 * _waves(rng, t, 0.1, 0.6))
    return velocity, _waves(rng, t, 0.05, 0.5)


def _constant(rng: np.random.Generator, t: Array) -> tuple[Array, Array]:
    one = np.ones_like(t)
    return rng.uniform(0.3, 0.9) * one, rng.uniform(0.3, 1.0) * rng.choice([-1.0, 1.0]) * one


_SHAPES: Final[dict[str, Callable[[np.random.Generator, Array], tuple[Array, Array]]]] = {
    "fourier": _fourier,
    "ladder": _ladder,
    "slow": _slow,
    "turns": _turns,
    "constant": _constant,
}


def _rests(rng: np.random.Generator, t: Array) -> tuple[Array, Array]:
    """Return a factor 0..1 on both references, and where the drives are on: a rest first, one within, one last."""
    end = float(t[-1])
    middle = rng.uniform(0.35, 0.65) * end
    spans = ((-9.0, 0.7), (middle, middle + rng.uniform(0.9, 1.3)), (end - 0.5, end + 9.0))
    moving = np.ones_like(t)
    on = np.ones(len(t), bool)
    ramp = 0.4
    for low, high in spans:
        moving *= 1.0 - _smooth_step((t - (low - ramp)) / ramp) * _smooth_step((high + ramp - t) / ramp)
        on &= ~((t > low + 0.1) & (t < high))
    return moving, on


def _smooth_step(x: Array) -> Array:
    y = np.clip(x, 0.0, 1.0)
    result: Array = y * y * (3.0 - 2.0 * y)
    return result


def _temperature(rng: np.random.Generator, t: Array, run: int, count: int) -> Array:
    """Return temperatures [2, n] that rise within a run and, on the whole, from 25 to 45 C over all runs."""
    out = np.empty((2, len(t)))
    for j in range(2):
        begin = 25.0 + 15.0 * run / max(count - 1, 1) + rng.uniform(-2.0, 2.0)
        out[j] = begin + rng.uniform(2.5, 7.0) * (1.0 - np.exp(-t / rng.uniform(6.0, 15.0)))
    return out
