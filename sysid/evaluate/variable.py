"""Errors over samples: per method and joint, per run, quadrant and velocity; and the paper's three figures. Pure."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from estimator.parameters import QUADRANTS
from sysid.evaluate.methods import OURS, TITLES
from sysid.evaluate.samples import Samples
from sysid.evaluate.score import VELOCITY_EDGES_RAD_S, Block, Score, bin_name, score, velocity_bins

PAPER_MSE_NM2: Final = {"tob": 10.07, "efficiency": 1.97, "network": 0.22}
"""Section IV.B of the paper, of its tested joint in velocity mode, by method."""

Row = Mapping[str, Score]
Keep = Callable[[Samples], NDArray[np.bool_]]


@dataclass(frozen=True)
class ErrorTables:
    """Scores by method. joints, quadrants, velocities: by joint number (and name); runs: by (run, joint number).

    tested: only the joint in velocity mode of each run, as in the paper; both: all joints together. A method is in a
    row only where every joint of the row has it.
    """

    joints: Mapping[int, Row]
    quadrants: Mapping[int, Mapping[str, Row]]
    velocities: Mapping[int, Mapping[str, Row]]
    runs: Mapping[tuple[str, int], Row]
    tested: Row
    both: Row
    bare_tested_nm2: float | None
    bare_both_nm2: float | None


def error_tables(samples: Sequence[Samples], velocity_joints: Mapping[str, int | None]) -> ErrorTables:
    """Return the tables of some runs; velocity_joints: by run, None where it is not known."""
    tested = [each for each in samples if velocity_joints.get(each.run) == each.number]
    numbers = sorted({each.number for each in samples})
    own = {number: [each for each in samples if each.number == number] for number in numbers}
    return ErrorTables(
        joints={number: row(own[number]) for number in numbers},
        quadrants={
            number: {name: row(own[number], _in_quadrant(k)) for k, name in enumerate(QUADRANTS)}
            for number in numbers
        },
        velocities={
            number: {bin_name(k): row(own[number], _in_bin(k)) for k in range(len(VELOCITY_EDGES_RAD_S) - 1)}
            for number in numbers
        },
        runs={(each.run, each.number): row([each]) for each in samples},
        tested=row(tested),
        both=row(samples),
        bare_tested_nm2=_bare(tested),
        bare_both_nm2=_bare(samples),
    )


def row(samples: Sequence[Samples], keep: Keep | None = None) -> Row:
    """Return the score of every method over the scored samples (of which `keep` chooses) of some joints and runs."""
    masks = [each.scored if keep is None else each.scored & keep(each) for each in samples]
    found = {}
    for method in common_methods(samples):
        blocks = [
            Block(each.error_nm(method)[mask], each.rated_nm)
            for each, mask in zip(samples, masks, strict=True)
        ]
        value = score(blocks)
        if value is not None:
            found[method] = value
    return found


def common_methods(samples: Iterable[Samples]) -> tuple[str, ...]:
    """Return the methods that all of the samples have, in TITLES' order."""
    sets = [set(each.estimate_nm) for each in samples]
    return tuple(method for method in TITLES if sets and all(method in one for one in sets))


def median_run(samples: Sequence[Samples]) -> Samples | None:
    """Return the run in the middle by the MSE of ours (else of the last method there is): the lower one of two."""
    methods = common_methods(samples)
    if not methods:
        return None
    method = OURS if OURS in methods else methods[-1]
    scored = [(one[method].mse_nm2, each.run, each) for each in samples if (one := row([each]))]
    if not scored:
        return None
    scored.sort(key=lambda item: item[:2])
    return scored[(len(scored) - 1) // 2][2]


def _in_quadrant(index: int) -> Keep:
    return lambda each: each.quadrant == index


def _in_bin(index: int) -> Keep:
    return lambda each: velocity_bins(each.velocity_rad_s) == index


def _bare(samples: Sequence[Samples]) -> float | None:
    """MSE [Nm^2] of the paper's network without the guard around it; None where a joint has none."""
    parts = [(each.bare_nm - each.sensor_nm)[each.scored] for each in samples]
    error = np.concatenate(parts) if parts else np.zeros(0)
    return float(np.mean(error * error)) if len(error) and np.isfinite(error).all() else None
