"""Does a designed run give a better loss model? Designed and drawn runs on the emulated bench, fitted and judged alike.

The information that a design maximises is a promise about noise. On a bench whose loss is no polynomial it need not hold,
so this is tried: the loss model of `excitation_information` is fitted to the first runs of either kind and judged by its
error on further drawn runs. Needs the emulated bench only, no bus. Pure.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from statistics import median
from typing import Final

import numpy as np
from numpy.typing import NDArray

from estimator.parameters import Joint
from sim_can.emulated_run import JointCommand, emulate_run
from sim_can.plant_parameters import PlantParameters
from sysid.excitation_design import Design, ExcitationLimits, design, draw
from sysid.excitation_information import loss_regressor

FloatArray = NDArray[np.float64]

JUDGES: Final = 8
"""Drawn runs that nothing is fitted to."""
_AVERAGE: Final = 50
"""Set-points of 1 ms in an average: motor current, velocity and torque without ripple and ringing of the loops."""
_MOVING_RAD_S: Final = 0.02
_JUDGING_SEED: Final = 1_000_000
"""Far from the seeds of the runs that are fitted."""


@dataclass(frozen=True)
class Trial:
    """Error of the loss model on the judging runs [Nm], one per seed, after a fit to `runs` runs of one kind."""

    runs: int
    designed_nm: tuple[float, ...]
    drawn_nm: tuple[float, ...]

    def line(self) -> str:
        """Number of runs, then median and worst of either kind."""
        cells = "".join(f"{median(x):>10.2f}{max(x):>8.2f}" for x in (self.designed_nm, self.drawn_nm))
        return f"{self.runs:>5}{cells}"


HEADING: Final = f"{'runs':>5}{'designed':>10}{'worst':>8}{'drawn':>10}{'worst':>8}"


def trial(
    limits: ExcitationLimits,
    plant: PlantParameters,
    joints: tuple[Joint, Joint],
    *,
    count: int,
    duration_s: float,
    harmonics: int,
    seed: int,
    seeds: int,
    evaluations: int,
    on_progress: Callable[[int], None] | None = None,
) -> tuple[tuple[Trial, ...], float]:
    """Fit to 1, 2, .. `count` runs for each of `seeds` seeds; joint 1 is the velocity joint.

    Returns:
        One Trial per number of runs, and the error that the model makes when it is fitted to the judging runs
        themselves [Nm]: what its columns cannot express.
    """

    def measured(runs: tuple[Design, ...]) -> list[tuple[FloatArray, FloatArray]]:
        result = []
        for number, one in enumerate(runs):
            result.append(_loss_rows(one, plant, joints[0], number))
            if on_progress is not None:
                on_progress(1)
        return result

    def drawn(count: int, seed: int) -> tuple[Design, ...]:
        return draw(limits, count=count, duration_s=duration_s, harmonics=harmonics, seed=seed, joints=joints)

    def designed(count: int, seed: int) -> tuple[Design, ...]:
        return design(
            limits,
            count=count,
            duration_s=duration_s,
            harmonics=harmonics,
            seed=seed,
            evaluations=evaluations,
            joints=joints,
        )

    judges = measured(drawn(JUDGES, seed + _JUDGING_SEED))
    errors: dict[str, list[list[float]]] = {"designed": [], "drawn": []}
    for each in range(seed, seed + seeds):
        for kind, made in (("designed", designed(count, each)), ("drawn", drawn(count, each))):
            rows = measured(made)
            errors[kind].append([_error(_fit(rows[: k + 1]), judges) for k in range(count)])
    trials = tuple(
        Trial(k + 1, *(tuple(one[k] for one in errors[kind]) for kind in ("designed", "drawn")))
        for k in range(count)
    )
    return trials, _error(_fit(judges), judges)


def _loss_rows(one: Design, plant: PlantParameters, joint: Joint, seed: int) -> tuple[FloatArray, FloatArray]:
    """Play a run on the emulated bench; return regressor [n, 20] and loss [n] of joint 1, 50 ms apart, moving only."""
    duration_s = one.velocity.duration_s
    time_s = np.arange(round(duration_s * 1000) + 1) * 1e-3
    velocity, current = one.velocity.velocity(time_s).tolist(), one.current.value(time_s).tolist()
    table = emulate_run(
        plant,
        (
            JointCommand.velocity(lambda t: velocity[round(t * 1000)]),
            JointCommand.current(lambda t: current[round(t * 1000)]),
        ),
        duration_s,
        seed,
    )
    columns = table.joints[1]
    signals = (columns.motor_velocity_rad_s, columns.current_a, columns.torque_nm)
    average = np.full(_AVERAGE, 1.0 / _AVERAGE)
    omega, i, tau = (np.convolve(x, average, "valid") for x in signals if x is not None)  # none is missing
    G = joint.gear_ratio
    raw = G * (joint.torque_constant_nm_per_a * i - joint.rotor_inertia_kgm2 * np.gradient(omega, 1e-3))
    kept = np.flatnonzero(np.abs(omega) > G * _MOVING_RAD_S)[::_AVERAGE]
    return loss_regressor(omega[kept] / G, tau[kept]), (raw - tau)[kept]


def _fit(rows: list[tuple[FloatArray, FloatArray]]) -> FloatArray:
    """Least squares; where runs leave a combination open, its smallest solution."""
    X, y = (np.concatenate(parts) for parts in zip(*rows, strict=True))
    scale = np.sqrt(np.mean(np.square(X), axis=0)) + 1e-12
    solution: FloatArray = np.linalg.lstsq(X / scale, y, rcond=1e-6)[0] / scale
    return solution


def _error(coefficients: FloatArray, rows: list[tuple[FloatArray, FloatArray]]) -> float:
    """Root mean square over all runs [Nm]."""
    residual = np.concatenate([X @ coefficients - y for X, y in rows])
    return float(np.sqrt(np.mean(np.square(residual))))
