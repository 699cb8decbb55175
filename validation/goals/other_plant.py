"""Whether a joint file of another plant is flagged, and how soon.

The joints of each plant of docs/testing.md are identified on campaigns of that plant and run on days of every other, zeros
tracked, as new configurations have it. A joint in a run is flagged within a time where the status is degraded, or there is
no value, within the first of its motion that is as long.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from jtqd.estimator.arrays import BoolArray
from jtqd.estimator.command_line import natural
from jtqd.estimator.fusion import GAUSS
from validation.goals.goals import ZEROS, Judged, flagged, judge
from validation.goals.identify import (
    FIT_SEED,
    JUDGE_SEED,
    QUICK,
    Driven,
    Identified,
    PlantFile,
    Sizes,
    drive,
    identify_physics,
    judging_runs,
    nominal_joints,
    the_three,
)
from validation.study import Report, Table

WITHIN_S: Final = (1.0, 3.0, 10.0)
"""The first one is the goal; the others show how long it takes where that is missed."""


class Flagged(NamedTuple):
    """Flagged within WITHIN_S: % of joints in runs; degraded, inside the 90 % interval: % of samples in motion; RMSE now."""

    within: tuple[float, ...]
    degraded: float
    inside: float
    rmse_nm: float


def first_s(flags: BoolArray, moving: BoolArray, dt_s: float) -> float:
    """Return how long a joint had moved [s] when it was flagged first; infinite for never. Arrays [n]."""
    seen = flags[moving]
    return float(np.argmax(seen)) * dt_s if seen.any() else np.inf


def figures(judged: Sequence[Judged], dt_s: float) -> Flagged:
    rows = []
    for one in judged:
        if one.moving.any():
            result, moving = one.results[ZEROS], one.moving
            flags, error = flagged(result), (result.torque_nm - one.true_nm)[moving]
            inside = np.nanmean(result.inside(GAUSS)[moving])
            first = first_s(flags, moving, dt_s)
            rows.append(
                (flags[moving].mean(), inside, np.nanmean(error**2), *(first <= limit for limit in WITHIN_S))
            )
    degraded, inside, square, *within = np.mean(np.array(rows, np.float64), axis=0)
    return Flagged(
        tuple(100.0 * one for one in within), 100.0 * degraded, 100.0 * inside, float(np.sqrt(square))
    )


def crossed(
    plants: Sequence[PlantFile], sizes: Sizes, fit_seed: int, seed: int
) -> dict[tuple[str, str], Flagged]:
    """Return the figures by (plant of the joint files, plant of the days). Raises as `identify`."""
    models: dict[str, tuple[Identified, ...]] = {}
    days: dict[str, list[Driven]] = {}
    for plant in plants:
        models[plant.name] = identify_physics(plant, sizes, fit_seed)[0]
        days[plant.name] = drive(plant.bench(), judging_runs(sizes, nominal_joints(plant), seed), seed)
    return {
        (of, on): figures(
            [judge(run, one, None, (ZEROS,)) for run in runs for one in files],
            float(np.median(runs[0].table.dt_s)),
        )
        for of, files in models.items()
        for on, runs in days.items()
    }


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seed", type=natural, default=JUDGE_SEED, help="of the days (default %(default)s)")
    parser.add_argument("--fit-seed", type=natural, default=FIT_SEED, help="of the campaigns (%(default)s)")


def run(options: argparse.Namespace) -> Report:
    found = crossed(the_three(), QUICK, options.fit_seed, options.seed)
    times = ", ".join(f"{limit:g}" for limit in WITHIN_S)
    head = ("joint files of", "days of", f"flagged within {times} s", "degraded", "inside 90 %", "RMSE now")
    rows = [
        (
            *(of, on),
            ", ".join(f"{share:.0f}" for share in one.within) + " %",
            f"{one.degraded:.0f} %",
            f"{one.inside:.0f} %",
            f"{one.rmse_nm:.2f} Nm",
        )
        for (of, on), one in found.items()
    ]
    return Report([Table(head, rows)], {"judge": options.seed, "fit": options.fit_seed})
