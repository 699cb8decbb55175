"""What ordinary judging days do not show: quick reversals, current steps at rest, rest before the first motion, creeping.

Motions are drawn by seed, within the limits of a campaign; days are those of their own seed. "two" has both encoders and
tracks offsets, "one" is fitted and run without the link encoder. Errors are against the true torque of the same instant.

| figure | runs |
|---|---|
| quick | squares of velocity, 1 to 3 rad/s at 0.5 to 2 Hz, against steps of current |
| steps at rest | both joints still, steps of current within what friction holds and beyond |
| before the first motion | the rest that such a run begins with: the plant as it is, and with one thing changed |
| creeping | velocities below 0.04 rad/s both ways |
| slow difference | ordinary judging days: means over 1 s of one encoder less both |
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from jtqd.estimator.arrays import BoolArray, FloatArray, StatusArray
from jtqd.estimator.estimator import estimate_columns
from jtqd.estimator.fusion import GAUSS
from jtqd.estimator.settings import recommended
from jtqd.estimator.status import STANDSTILL, VALID
from jtqd.sysid.planner.campaigns import seed_of
from jtqd.sysid.planner.plan import Plateau, Rest, Run, Segment
from validation.goals.identify import CHANGES, Driven, Identified, PlantFile, Sizes, drive, one_encoder

QUICK_RAD_S: Final = (1.0, 3.0)
QUICK_HZ: Final = (0.5, 2.0)
LOAD_A: Final = 4.0
CREEP_RAD_S: Final = (0.012, 0.04)
BEFORE_MOTION: Final = ("nothing", "link zero 100 urad", "kinematic error +110 urad")
"""Changes of the plant that an encoder shows only once the joint has moved."""
_RAMP_S: Final = 0.06


def quick_runs(count: int, seconds: float, seed: int) -> tuple[Run, ...]:
    """Return squares of velocity against steps of current; the velocity joint alternates."""

    def one(number: int) -> Run:
        rng = np.random.default_rng([seed, 1, number])
        speed, half_s = rng.uniform(*QUICK_RAD_S), 0.5 / rng.uniform(*QUICK_HZ)
        segments: list[Segment] = [Rest(0.6, 0.0)]
        for k in range(max(int((seconds - 1.2) / half_s), 2)):
            velocity = speed if k % 2 else -speed
            hold_s = round(half_s - _RAMP_S, 3)
            segments.append(Plateau(float(velocity), float(rng.uniform(-LOAD_A, LOAD_A)), hold_s, _RAMP_S))
        return Run(f"quick_{number:02d}", 1 + number % 2, (*segments, Rest(0.4, 0.2)))

    return tuple(map(one, range(count)))


def step_runs(count: int, seconds: float, seed: int) -> tuple[Run, ...]:
    """Return steps of current at rest, then a motion both ways."""

    def one(number: int) -> Run:
        rng = np.random.default_rng([seed, 2, number])
        loads = rng.uniform(-LOAD_A, LOAD_A, max(int((seconds - 2.6) / 0.5), 2)).tolist()
        steps = [Plateau(0.0, load, 0.48, 0.02) for load in loads]
        motion = [Plateau(velocity, 1.0, 0.5, 0.2) for velocity in (0.8, -0.8)]
        return Run(f"steps_{number:02d}", 1 + number % 2, (Rest(0.6, 0.0), *steps, *motion, Rest(0.4, 0.2)))

    return tuple(map(one, range(count)))


def creeping_runs(count: int, seconds: float, seed: int) -> tuple[Run, ...]:
    """Return slow motions about one angle against slow loads."""

    def one(number: int) -> Run:
        rng = np.random.default_rng([seed, 3, number])
        segments: list[Segment] = [Rest(0.6, 0.0)]
        for k in range(max(int((seconds - 1.2) / 1.5), 2)):
            velocity = float(rng.uniform(*CREEP_RAD_S)) * (1.0 if k % 2 else -1.0)
            segments.append(Plateau(velocity, float(rng.uniform(-LOAD_A, LOAD_A)), 1.2, 0.3))
        return Run(f"creeping_{number:02d}", 1 + number % 2, (*segments, Rest(0.4, 0.2)))

    return tuple(map(one, range(count)))


@dataclass(frozen=True)
class Part:
    """Of one joint in one run, arrays [n]: error [Nm], sigma [Nm] and status of an estimate; moves: by the motor's speed."""

    run: str
    error_nm: FloatArray
    sigma_nm: FloatArray
    status: StatusArray
    moves: BoolArray


TWO: Final = "two"
ONE: Final = "one"
ENCODERS: Final = (TWO, ONE)
_SETTINGS: Final = replace(recommended("fused"), track_zeros=True, track_torsion=True)
_MOVES_RAD_S: Final = 0.01


def estimated(run: Driven, one: Identified, encoders: str, change: str = "nothing") -> Part:
    """Return the estimate of a joint in a run with two encoders or one, the link's position changed as CHANGES say."""
    columns, joint, time_s = run.columns(one.number, one.joint), one.joint, run.table.time_s
    link = next(each.link for each in CHANGES if each.name == change)
    if link is not None and columns.link_position_rad is not None and columns.motor_position_rad is not None:
        moved = link(columns.link_position_rad, columns.motor_position_rad / joint.gear_ratio)
        columns = replace(columns, link_position_rad=moved)
    if encoders == ONE:
        if one.one_encoder is None:
            raise ValueError("found no fit of one encoder")
        columns, joint = one_encoder(columns, joint), one.one_encoder
    found = estimate_columns(joint, _SETTINGS, None, time_s, columns)
    assert columns.motor_velocity_rad_s is not None
    moves: BoolArray = np.abs(columns.motor_velocity_rad_s) > _MOVES_RAD_S * joint.gear_ratio
    error = found.torque_nm - run.true_nm[:, one.number - 1]
    return Part(run.name, error, found.sigma_nm, found.status, moves)


def rmse_nm(parts: Sequence[Part], moving: bool) -> float:
    """Return the RMSE over the samples with a value, in motion or at rest."""
    errors = np.concatenate(
        [one.error_nm[np.isfinite(one.error_nm) & (one.moves == moving)] for one in parts]
    )
    return float(np.sqrt(np.mean(errors**2))) if len(errors) else math.nan


def largest_sigmas(parts: Sequence[Part]) -> float:
    """Return the largest error over sigma of the samples that are valid or at standstill."""
    sizes = [np.abs(one.error_nm / one.sigma_nm)[np.isin(one.status, (VALID, STANDSTILL))] for one in parts]
    every = np.concatenate(sizes)
    return float(every.max()) if len(every) else math.nan


def held_before_motion(parts: Sequence[Part]) -> float:
    """Return how often [%] the standstill interval holds the torque before the first motion of a run."""
    held, count = 0, 0
    for one in parts:
        first = int(np.argmax(one.moves)) if one.moves.any() else len(one.moves)
        rest = (one.status == STANDSTILL) & (np.arange(len(one.moves)) < first)
        held += int(np.count_nonzero(np.abs(one.error_nm[rest]) <= one.sigma_nm[rest]))
        count += int(np.count_nonzero(rest))
    return 100.0 * held / count if count else math.nan


def worst_held(parts: Sequence[Part]) -> float:
    """Return the share [%] of the interval that holds the torque in the joint and run where it holds least often: 90 % in
    motion, the standstill interval at rest.
    """
    shares = []
    for one in parts:
        counted = np.isin(one.status, (VALID, STANDSTILL))
        half = np.where(one.status == STANDSTILL, one.sigma_nm, GAUSS * one.sigma_nm)
        if counted.any():
            shares.append(float(np.mean((np.abs(one.error_nm) <= half)[counted])))
    return 100.0 * min(shares) if shares else math.nan


def slow_difference_nm(pairs: Sequence[tuple[Part, Part]], rate_hz: float = 1000.0) -> float:
    """Return the 95 % quantile of the size of means over 1 s of motion: one encoder's estimate less that of both."""
    count, means = round(rate_hz), []
    for one, two in pairs:
        known = one.moves & np.isfinite(one.error_nm) & np.isfinite(two.error_nm)
        apart = (one.error_nm - two.error_nm)[known]
        whole = len(apart) // count * count
        means.append(np.abs(apart[:whole].reshape(-1, count).mean(axis=1)))
    every = np.concatenate(means)
    return float(np.quantile(every, 0.95)) if len(every) else math.nan


@dataclass(frozen=True)
class Situations:
    """Figures of one plant, by encoders where both are judged: RMSE [Nm], sigmas, shares [%]."""

    quick_nm: Mapping[str, float]
    steps_nm: Mapping[str, float]
    sigmas: Mapping[str, float]
    before_motion: Mapping[str, float]
    creeping: Mapping[str, float]
    slow_nm: float


def situations(
    plant: PlantFile, models: Sequence[Identified], ordinary: Sequence[Driven], sizes: Sizes, seed: int
) -> Situations:
    """Drive and judge the runs of these figures; ordinary: judging days."""
    count, seconds = sizes.outside_runs, sizes.judge_s
    seed = seed_of("situations", 0.0, seed)

    def parts(driven: Sequence[Driven], encoders: str, change: str = "nothing") -> list[Part]:
        return [estimated(run, one, encoders, change) for run in driven for one in models]

    def every(driven: Sequence[Driven]) -> dict[str, list[Part]]:
        return {encoders: parts(driven, encoders) for encoders in ENCODERS}

    runs = step_runs(count, seconds, seed)
    quick = every(drive(plant.bench(), quick_runs(count, seconds, seed), seed))
    steps = every(drive(plant.bench(), runs, seed + 1))
    creeping = every(drive(plant.bench(), creeping_runs(count, seconds, seed), seed + 2))
    before = {}
    for change in CHANGES:
        if change.name in BEFORE_MOTION and change.possible(plant):
            before[change.name] = held_before_motion(
                parts(drive(change.bench(plant), runs, seed + 1), TWO, change.name)
            )
    pairs = zip(parts(ordinary, ONE), parts(ordinary, TWO), strict=True)
    return Situations(
        quick_nm={name: rmse_nm(found, True) for name, found in quick.items()},
        steps_nm={name: rmse_nm(found, False) for name, found in steps.items()},
        sigmas={name: max(largest_sigmas(quick[name]), largest_sigmas(steps[name])) for name in ENCODERS},
        before_motion=before,
        creeping={name: worst_held(found) for name, found in creeping.items()},
        slow_nm=slow_difference_nm(list(pairs)),
    )
