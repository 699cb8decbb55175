"""Runs of the paper's section II on the emulated bench without a bus, for tests of the fits."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.run import RunTable
from jtqd.sim_can.emulated_run import JointCommand, emulate_run
from jtqd.sim_can.plant_file import PlantParameters

VELOCITIES_RAD_S = (0.2, 0.6, 1.0, 1.4, 1.8, 2.2, 2.6, 3.0)
"""Section II of the paper."""


def section_two_currents(velocity_rad_s: float) -> tuple[float, ...]:
    """Currents [A] of the driving joint at a velocity: up to 5 A, above 1.8 rad/s up to 4 A."""
    return (0.0, 1.0, 2.0, 3.0, 4.0, 5.0) if velocity_rad_s <= 1.8 else (0.0, 1.0, 2.0, 3.0, 4.0)


def plateau_run(
    plant: PlantParameters,
    points: Sequence[tuple[float, float]],
    *,
    velocity_joint: int = 1,
    hold_s: float = 0.8,
    ramp_s: float = 0.3,
    seed: int = 0,
    **emulate: Any,
) -> RunTable:
    """One run through (velocity [rad/s], current [A]) points: a smooth ramp to each, then a hold.

    velocity_joint (1 or 2) follows the velocity, the other joint the current, each in its own frame. Further
    arguments go to `emulate_run`.
    """
    x = np.linspace(0.0, 1.0, round(ramp_s * 1000), endpoint=False)
    rise = x**3 * (10.0 + x * (6.0 * x - 15.0))
    hold = np.ones(round(hold_s * 1000))
    pieces: list[FloatArray] = []
    last = np.zeros(2)
    for point in points:
        share = np.concatenate((rise, hold))[:, None]
        pieces.append(last + share * (np.array(point) - last))
        last = np.array(point)
    targets = np.concatenate(pieces)
    velocity, current = (column.tolist() for column in targets.T)
    commands = (
        JointCommand.velocity(lambda t: velocity[round(t * 1000)]),
        JointCommand.current(lambda t: current[round(t * 1000)]),
    )
    ordered = commands if velocity_joint == 1 else (commands[1], commands[0])
    return emulate_run(plant, ordered, len(targets) / 1000, seed, **emulate)


def section_two_points(
    velocities: Sequence[float] = VELOCITIES_RAD_S, sign: float = 1.0
) -> list[tuple[float, float]]:
    """(velocity, current) of the efficiency campaign in one direction; the current loads the velocity joint forward."""
    return [(sign * v, sign * i) for v in velocities for i in section_two_currents(v)]


def section_two_runs(
    plant: PlantParameters,
    *,
    velocities: Sequence[float] = VELOCITIES_RAD_S,
    hold_s: float = 0.8,
    ramp_s: float = 0.3,
    seed: int = 0,
    **emulate: Any,
) -> list[RunTable]:
    """The efficiency campaign as four runs: velocity joint 1 forward and reverse, then velocity joint 2.

    Whichever joint has the velocity is driven forward, the other one is driven back: the four runs hold all four
    quadrants of both joints. The default holds are short; 2.1 s are the campaign's.
    """
    return [
        plateau_run(
            plant,
            section_two_points(velocities, sign),
            velocity_joint=velocity_joint,
            hold_s=hold_s,
            ramp_s=ramp_s,
            seed=seed + number,
            **emulate,
        )
        for number, (velocity_joint, sign) in enumerate(((1, 1.0), (1, -1.0), (2, 1.0), (2, -1.0)))
    ]
