"""What no library has: each with its numbers, drawn for one joint of one case, and the right place in the map.

A place is {axis, low, high}; several places are alternatives: an event at its time in its run, or where its condition is.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import numpy as np

from validation.generator.motions import STEP_S, Motion
from validation.generator.plant import Array, Fault

Place = dict[str, Any]


@dataclass
class Oddity:
    """numbers: of `plant.NEUTRAL`, the same in all runs. Lists have one entry per run. wave: amplitude, order, phase
    of a torque that turns with the motor. places: where it is right to place it; times are added as they happen.
    """

    numbers: dict[str, float] = field(default_factory=dict)
    waits: list[list[int]] = field(default_factory=list)
    bursts: list[list[tuple[int, int, float]]] = field(default_factory=list)
    faults: list[list[Fault]] = field(default_factory=list)
    phases: list[float] = field(default_factory=list)
    wave: tuple[float, float, float] | None = None
    places: list[Place] = field(default_factory=list)


class Case(NamedTuple):
    """What an unknown thing is drawn for: joint `row` (0, 1) of one case, its nominal file, motions, size."""

    rng: np.random.Generator
    nominal: Mapping[str, Any]
    motions: Sequence[Motion]
    row: int
    size: float


@dataclass(frozen=True)
class Unknown:
    """low, high: typical sizes in unit; resembling: an effect of the library can take most of it, so that it is no fair test
    of a refusal.
    """

    make: Callable[[Case], Oddity]
    low: float
    high: float
    unit: str
    resembling: bool = False


def draw_unknown(name: str, case: Case, size: float | None) -> tuple[Oddity, float]:
    """Return the oddity and its size, a typical one where it is not given; ValueError for a name not in UNKNOWN."""
    if name not in UNKNOWN:
        raise ValueError(f"effect: found {name!r}, expected one of the library's or of {', '.join(UNKNOWN)}")
    entry = UNKNOWN[name]
    chosen = float(case.rng.uniform(entry.low, entry.high)) if size is None else float(size)
    return entry.make(case._replace(size=chosen)), chosen


def _coupling_slip(c: Case) -> Oddity:
    """Hub between gear and link encoder: it slips by size (torque it lets go, Nm) now and then under load."""
    above = 0.15 * float(c.nominal["rated_torque_nm"])
    waits = []
    for motion in c.motions:
        end = len(motion.on) * STEP_S
        gaps = c.rng.exponential(end / 4.0, 12)
        waits.append([round(x / STEP_S) for x in gaps])
    return Oddity(
        numbers={"slip_rad": c.size / float(c.nominal["stiffness_nm_per_rad"]), "slip_above_nm": above},
        waits=waits,
    )


def _local_damage(c: Case) -> Oddity:
    """Friction bump around one angle of the link: a tooth or a ball that is damaged."""
    visited = np.concatenate([_reference_angle(m, c.row)[::20] for m in c.motions])
    counts, edges = np.histogram(np.mod(visited, 2 * np.pi), 36, (0.0, 2 * np.pi))
    best = np.argsort(counts)[-18:]
    centre = float(edges[c.rng.choice(best)] + np.pi / 36)
    width = float(c.rng.uniform(0.12, 0.25))
    return Oddity(
        numbers={"bump_nm": c.size, "bump_at_rad": centre, "bump_width_rad": width},
        places=[{"axis": "link_angle", "low": centre - width, "high": centre + width}],
    )


def _reference_angle(motion: Motion, row: int) -> Array:
    """Return theta_l of a joint as its references have it."""
    side = 1.0 if motion.leader == 0 else -1.0
    angle = motion.start_rad + side * np.cumsum(motion.velocity_rad_s) * STEP_S
    return angle if row == 0 else -angle


def _bearing_line(c: Case) -> Oddity:
    """Torque line of a bearing: an order of the motor that is no whole number."""
    order = float(c.rng.integers(2, 6)) + float(c.rng.uniform(0.3, 0.7))
    return Oddity(
        wave=(c.size, order, float(c.rng.uniform(-np.pi, np.pi))),
        places=[{"axis": "frequency", "low": 0.96 * order, "high": 1.04 * order, "unit": "per motor rev"}],
    )


def _frame_vibration(c: Case) -> Oddity:
    """Interference of a fixed frequency on the motor's torque: it has nothing to do with any angle."""
    hz = float(c.rng.uniform(3.0, 9.0))
    return Oddity(
        numbers={"vibration_nm": c.size, "vibration_hz": hz},
        phases=[float(c.rng.uniform(-np.pi, np.pi)) for _ in c.motions],
        places=[{"axis": "frequency", "low": 0.93 * hz, "high": 1.07 * hz, "unit": "Hz"}],
    )


def _sensor_faults(c: Case) -> Oddity:
    """Loose connector of the sensor: bursts of 20 to 150 ms in which it reads far off or nothing."""
    faults = []
    for motion in c.motions:
        n = len(motion.on)
        many = int(c.rng.integers(3, 8))
        dropped = bool(c.rng.uniform() < 0.4)
        faults.append(
            [
                Fault(
                    int(s), int(c.rng.integers(20, 150)), c.size * float(c.rng.choice([-1.0, 1.0])), dropped
                )
                for s in c.rng.integers(1000, n - 1000, many)
            ]
        )
    return Oddity(faults=faults, places=[{"axis": "channel", "channel": "torque_nm", "stuck": True}])


def _current_dead_band(c: Case) -> Oddity:
    """Amplifier that folds back below a current: a motor torque under size (Nm, joint side) is lost in part.

    Its place is that current. At which load the current is small depends on direction and speed: no bin of the load.
    """
    width = c.size / float(c.nominal["gear_ratio"] * c.nominal["torque_constant_nm_per_a"])
    return Oddity(numbers={"dead_band_a": width}, places=[{"axis": "current", "low": -width, "high": width}])


def _friction_bursts(c: Case) -> Oddity:
    """A seal that grabs at random times for a moment."""
    bursts = []
    for motion in c.motions:
        n = len(motion.on)
        many = int(c.rng.integers(3, 7))
        starts = c.rng.integers(1000, n - 1000, many)
        bursts.append(
            [
                (int(s), int(s + c.rng.integers(150, 500)), c.size * float(c.rng.uniform(0.7, 1.3)))
                for s in starts
            ]
        )
    return Oddity(bursts=bursts)


def _speed_band(c: Case) -> Oddity:
    """Losses of a resonance that a band of speeds excites."""
    top = float(np.median([np.max(np.abs(m.velocity_rad_s)) for m in c.motions]))
    at = float(c.rng.uniform(0.35, 0.6)) * top
    width = float(c.rng.uniform(0.05, 0.09)) * top
    bands = [{"axis": "velocity", "low": s * at - 1.5 * width, "high": s * at + 1.5 * width} for s in (-1, 1)]
    return Oddity(
        numbers={"band_nm": c.size, "band_at_rad_s": at, "band_width_rad_s": width}, places=[*bands]
    )


def _speed_load(c: Case) -> Oddity:
    """Friction c |tau| v^2; size: c at the top speed."""
    top = max(float(np.max(np.abs(m.velocity_rad_s))) for m in c.motions)
    return Oddity(
        numbers={"speed_load": c.size / top**2},
        places=[
            {"axis": "velocity", "low": s * 0.8 * top - 0.3 * top, "high": s * 0.8 * top + 0.3 * top}
            for s in (-1, 1)
        ],
    )


UNKNOWN: Final[dict[str, Unknown]] = {
    "coupling_slip": Unknown(_coupling_slip, 1.5, 4.0, "Nm"),
    "local_damage": Unknown(_local_damage, 1.5, 4.0, "Nm"),
    "bearing_line": Unknown(_bearing_line, 0.4, 1.2, "Nm"),
    "frame_vibration": Unknown(_frame_vibration, 0.4, 1.2, "Nm"),
    "sensor_faults": Unknown(_sensor_faults, 3.0, 12.0, "Nm"),
    "current_dead_band": Unknown(_current_dead_band, 3.0, 6.0, "Nm"),
    "friction_bursts": Unknown(_friction_bursts, 1.5, 4.0, "Nm"),
    "speed_band": Unknown(_speed_band, 1.5, 4.0, "Nm"),
    "speed_load": Unknown(_speed_load, 0.1, 0.3, "", resembling=True),
}
