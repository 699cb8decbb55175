"""Excitation trajectories for identification: Fourier coefficients chosen so that the runs tell the losses best.

    designs = design(ExcitationLimits(), count=8, duration_s=20.0, seed=1)
    segment = designs[0].to_mapping()          # the `fourier` segment of a plan (schema jtq.plan/1)

Each run moves one joint by velocity while the other one drives it with a current. The runs are designed one after the
other, each for what it adds to those before it (sequential D-optimality): the first four of eight are a design of four.
`draw` gives runs that are not optimised, for judging: within the same limits, but chosen by nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from estimator.checked import ConfigError
from estimator.parameters import Joint
from models.files import load_joint, shipped
from sysid.excitation_information import Information, log_det
from sysid.excitation_model import Bench, Candidates, ExcitationLimits
from sysid.fourier import MAX_HARMONICS, FourierSeries, FourierTrajectory
from sysid.genetic import POPULATION, Criterion, Found, minimise

__all__ = ["Design", "ExcitationLimits", "Search", "design", "draw"]

FloatArray = NDArray[np.float64]
Search = Callable[[Criterion, int, int, np.random.Generator], Found]
"""(criterion, dimension, evaluations, generator) -> the best genome found."""

STARTS: Final = 3
SEARCH_RATE_HZ: Final = 20.0
"""Grid of the search: at least 40 instants in a period of the fastest harmonic (0.5 Hz with five of 0.1 Hz)."""
FINAL_RATE_HZ: Final = 1000.0
"""Grid of the final scaling: that of the set-points, so that none of them exceeds a limit."""
SHORTEST_S: Final = 1.0
LONGEST_S: Final = 600.0


@dataclass(frozen=True)
class Design:
    """One run of the excitation: motion of the velocity joint and current of the driving joint.

    Attributes:
        velocity, current: the two series, of the same duration.
        information_log_det: log det of the scaled information of all runs so far, this one included; grows with every
            run. It compares designs for the same limits; its zero has no meaning of its own.
    """

    velocity: FourierTrajectory
    current: FourierSeries
    information_log_det: float

    def to_mapping(self) -> dict[str, Any]:
        """Return the `fourier` segment of a plan: plain numbers, ready for YAML."""
        return {
            "kind": "fourier",
            "velocity": self.velocity.to_mapping(),
            "current": self.current.to_mapping(),
            "duration_s": self.velocity.duration_s,
        }


def design(
    limits: ExcitationLimits,
    *,
    count: int,
    duration_s: float,
    harmonics: int = 5,
    seed: int = 0,
    evaluations: int = 2000,
    starts: int | None = None,
    joints: tuple[Joint, Joint] | None = None,
    on_progress: Callable[[int], None] | None = None,
) -> tuple[Design, ...]:
    """Return `count` runs of duration_s seconds each, every one within the limits and with at least one limit reached.

    Args:
        limits: what no run may exceed at any set-point of 1 kHz.
        count: number of runs, >= 1. duration_s: length of each, 1 to 600 s. harmonics: of velocity and of current.
        seed: the same arguments give the same runs.
        evaluations: motions that each search tries, >= 1.
        starts: independent searches for each run, of which the best counts. None: 3, or 1 where there are so few
            evaluations that nothing would be searched but only drawn.
        joints: velocity joint and driving joint; None: the two that ship. They tell which torque a current gives and
            which current a motion takes.
        on_progress: called after each batch with the number of motions tried since the last call.

    Raises:
        ConfigError: an argument is out of range.
    """
    if starts is None:
        starts = STARTS if evaluations > POPULATION else 1
    _check_range("count", count, 1, 1000)
    _check_range("evaluations", evaluations, 1, 10_000_000)
    _check_range("starts", starts, 1, 1000)
    number = starts

    def search(criterion: Criterion, dimension: int, evaluations: int, rng: np.random.Generator) -> Found:
        generators = rng.spawn(number)
        found = [minimise(criterion, dimension, evaluations=evaluations, rng=each) for each in generators]
        return min(found, key=lambda one: one.value)

    return sequence(
        Problem(limits, duration_s=duration_s, harmonics=harmonics, joints=joints, on_progress=on_progress),
        search,
        count=count,
        seed=seed,
        evaluations=evaluations,
    )[0]


def draw(
    limits: ExcitationLimits,
    *,
    count: int,
    duration_s: float,
    harmonics: int = 5,
    seed: int = 0,
    joints: tuple[Joint, Joint] | None = None,
) -> tuple[Design, ...]:
    """Return runs with random coefficients within the same limits: the first that are drawn, chosen by nothing.

    Arguments and errors as `design`.
    """
    return design(
        limits,
        count=count,
        duration_s=duration_s,
        harmonics=harmonics,
        seed=seed,
        evaluations=1,
        starts=1,
        joints=joints,
    )


class Problem:
    """Limits and joints of a design task, with the matrices that its evaluation needs.

    Raises:
        ConfigError: duration or harmonics out of range.
    """

    def __init__(
        self,
        limits: ExcitationLimits,
        *,
        duration_s: float,
        harmonics: int,
        joints: tuple[Joint, Joint] | None = None,
        on_progress: Callable[[int], None] | None = None,
    ) -> None:
        _check_range("duration_s", duration_s, SHORTEST_S, LONGEST_S)
        _check_range("harmonics", harmonics, 1, MAX_HARMONICS)
        bench = Bench(*(joints or (load_joint(shipped("joint1.yaml")), load_joint(shipped("joint2.yaml")))))
        coarse, fine = (
            Candidates(bench, limits, duration_s=duration_s, harmonics=harmonics, rate_hz=rate_hz)
            for rate_hz in (SEARCH_RATE_HZ, FINAL_RATE_HZ)
        )
        self._coarse: Final = coarse
        self._fine: Final = fine
        self._information: Final = Information(limits.velocity_rad_s, limits.torque_nm)
        self._on_progress: Final = on_progress
        self.dimension: Final = coarse.dimension

    def criterion(self, before: FloatArray) -> Criterion:
        """Return -log det of the information so far [20, 20] plus that of each candidate, as a function of genomes."""

        def value(genomes: FloatArray) -> FloatArray:
            motion = self._coarse.motion(genomes)
            if self._on_progress is not None:
                self._on_progress(len(genomes))
            return -log_det(before + self._information.of(motion.velocity, motion.torque))

        return value

    def finish(
        self, genome: FloatArray, before: FloatArray
    ) -> tuple[FourierTrajectory, FourierSeries, FloatArray]:
        """Scale a genome [d] on the fine grid; return its series and the information so far with it."""
        velocity, current, motion = self._fine.series(genome)
        return velocity, current, before + self._information.of(motion.velocity, motion.torque)[0]


def sequence(
    problem: Problem, search: Search, *, count: int, seed: int, evaluations: int
) -> tuple[tuple[Design, ...], FloatArray]:
    """Design `count` runs one after the other by any search; return them and their common information [20, 20].

    Run k of a seed has its own random numbers, whatever the number of runs.
    """
    designs: list[Design] = []
    information: FloatArray = np.zeros((1, 1))
    for k in range(count):
        rng = np.random.default_rng([seed, k])
        found = search(problem.criterion(information), problem.dimension, evaluations, rng)
        velocity, current, information = problem.finish(found.genome, information)
        designs.append(Design(velocity, current, float(log_det(information))))
    return tuple(designs), information


def _check_range(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise ConfigError(f"{name}: found {value!r}, expected {low:g} to {high:g}")
