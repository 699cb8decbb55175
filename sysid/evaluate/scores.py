"""Score errors and intervals of the estimates, and their jumps where a joint changes its quadrant.

Errors: several blocks of samples (runs, joints) are pooled, every sample counts alike; errors in percent are relative to
each block's own rated torque. Tables are per method and joint, run, quadrant and velocity.

Intervals: in motion value +- z sigma, z of the normal distribution (sysid.fit.fused: sigma is calibrated for z = 1.645,
90 %); at standstill value +- sigma, which is an interval and not a standard deviation.

Jumps at v = 0 and at tau = 0:

    jump = R(estimate) - max R(sensor),      R: max - min over 20 ms

The torque's own change in that time does not count against the estimate, and a spike that comes and goes is not missed.
The maximum is over the sensor's windows shifted by up to 10 ms: the torque of a reversing joint swings by 10 Nm in 20 ms,
and an estimate that follows it 2 ms late is late and does not jump. `unshifted_nm` is without that allowance.

`at` the crossing: the 20 ms around it. Over the `passage`: the largest of any 20 ms of the whole passage through
|v| <= 0.02 rad/s (or |tau| <= 0.3 Nm), entry and exit of the standstill status included, however long the joint rested.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.fusion import GAUSS
from jtqd.estimator.joint import QUADRANTS
from jtqd.sysid.evaluate.methods import OURS, TITLES, Samples

VELOCITY_EDGES_RAD_S: Final = (0.0, 0.05, 0.2, 0.5, 1.0, 2.0, math.inf)
"""Bins of |v|, joint side: creeping, the paper's slowest, slow, medium, fast, faster."""

LEVELS: Final = {0.5: 0.6744897501960817, 0.8: 1.2815515655446004, 0.9: GAUSS, 0.95: 1.959963984540054}
"""Nominal coverage -> half width in standard deviations, of the normal distribution that sigma stands for."""


class Score(NamedTuple):
    """Of `samples` errors: mean square [Nm^2], its root [Nm] and [% of rated torque], 95th percentile and largest [Nm]."""

    samples: int
    mse_nm2: float
    rmse_nm: float
    rmse_rated_percent: float
    p95_nm: float
    max_nm: float


class Block(NamedTuple):
    """Errors [n] of one run of one joint [Nm], and the rated torque of the joint."""

    error_nm: FloatArray
    rated_nm: float


def score(blocks: Sequence[Block]) -> Score | None:
    """Return the score of all samples of the blocks together; None when there are none."""
    filled = [block for block in blocks if len(block.error_nm)]
    if not filled:
        return None
    error = np.concatenate([block.error_nm for block in filled])
    share = np.concatenate([block.error_nm / block.rated_nm for block in filled])
    size = np.abs(error)
    mse = float(np.mean(error * error))
    return Score(
        len(error),
        mse,
        math.sqrt(mse),
        100.0 * math.sqrt(float(np.mean(share * share))),
        float(np.quantile(size, 0.95)),
        float(size.max()),
    )


class Coverage(NamedTuple):
    """Share of `samples` whose interval holds the sensor; se: standard error of it, from run to run, NaN for one run."""

    samples: int
    runs: int
    share: float
    se: float

    def __str__(self) -> str:
        """E.g. "91.3 % +- 1.2"; without the standard error where there is none."""
        beside = f" +- {100.0 * self.se:.1f}" if math.isfinite(self.se) else ""
        return f"{100.0 * self.share:.1f} %{beside}"


def coverage(inside: Sequence[NDArray[np.bool_]]) -> Coverage | None:
    """Return the coverage of runs, each an array [n] of whether a sample is inside; None when there is no sample.

    Samples of one run share its zero and its friction and are right or wrong together: the standard error is that of a
    ratio over whole runs (Cochran 1977, section 6.4), not sqrt(p (1 - p)/n).
    """
    runs = [each for each in inside if len(each)]
    if not runs:
        return None
    count = np.array([len(each) for each in runs], np.float64)
    good = np.array([np.count_nonzero(each) for each in runs], np.float64)
    share = float(good.sum() / count.sum())
    se = math.nan
    if len(runs) > 1:
        off = good - share * count
        se = math.sqrt(float(off @ off) * len(runs) / (len(runs) - 1)) / float(count.sum())
    return Coverage(int(count.sum()), len(runs), share, se)


def velocity_bins(velocity_rad_s: FloatArray) -> NDArray[np.intp]:
    """Return for each sample the index of its bin of |v| in VELOCITY_EDGES_RAD_S."""
    inner = np.array(VELOCITY_EDGES_RAD_S[1:-1])
    return np.searchsorted(inner, np.abs(velocity_rad_s), side="right")


def bin_name(index: int) -> str:
    """Return a bin's name, e.g. "0.2 to 0.5"."""
    low, high = VELOCITY_EDGES_RAD_S[index], VELOCITY_EDGES_RAD_S[index + 1]
    return f"above {low:g}" if math.isinf(high) else f"{low:g} to {high:g}"


def ratio(a: float | None, b: float | None) -> float | None:
    """Return a/b; None where one is missing or b is zero."""
    return None if a is None or b is None or b == 0.0 else a / b


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


NOMINAL: Final = 0.9
ALLOWED: Final = (0.87, 0.93)
"""Coverage that counts as 90 %."""


@dataclass(frozen=True)
class IntervalTables:
    """Coverage of the intervals of `method`. overall, joints, quadrants: at 90 %; curve: nominal -> observed, by joint
    and, under None, of all joints.
    """

    method: str
    overall: Coverage
    joints: Mapping[int, Coverage]
    quadrants: Mapping[int, Mapping[str, Coverage]]
    curve: Mapping[int | None, Mapping[float, Coverage]]


def interval_tables(samples: Sequence[Samples], method: str = OURS) -> IntervalTables | None:
    """Return the coverage of a method over runs; None where it has no scored sample."""
    own = [each for each in samples if method in each.estimate_nm]
    overall = covered(own, method, NOMINAL)
    if overall is None:
        return None
    joints: dict[int, Coverage] = {}
    quadrants: dict[int, dict[str, Coverage]] = {}
    curve: dict[int | None, dict[float, Coverage]] = {None: _curve(own, method)}
    for number in sorted({each.number for each in own}):
        part = [each for each in own if each.number == number]
        one = covered(part, method, NOMINAL)
        if one is None:
            continue
        joints[number], curve[number] = one, _curve(part, method)
        by_quadrant = {name: covered(part, method, NOMINAL, _quadrant(k)) for k, name in enumerate(QUADRANTS)}
        quadrants[number] = {name: value for name, value in by_quadrant.items() if value is not None}
    return IntervalTables(method, overall, joints, quadrants, curve)


def covered(
    samples: Sequence[Samples], method: str, level: float, keep: Keep | None = None
) -> Coverage | None:
    """Return how often value +- z(level) sigma holds the sensor, over scored samples (of which `keep` chooses)."""
    inside = []
    for each in samples:
        mask = each.scored if keep is None else each.scored & keep(each)
        inside.append(np.abs(each.error_nm(method)[mask]) <= LEVELS[level] * each.sigma_nm[method][mask])
    return coverage(inside)


@dataclass(frozen=True)
class Standstill:
    """Standing samples of one joint: their share of all samples; coverage and mean half width [Nm] by method."""

    share: float
    coverage: Mapping[str, Coverage]
    half_width_nm: Mapping[str, float]


def standstill(samples: Sequence[Samples]) -> dict[int, Standstill]:
    """Return what the intervals of a standing joint were worth, by joint."""
    found = {}
    for number in sorted({each.number for each in samples}):
        own = [each for each in samples if each.number == number]
        total = sum(len(each.standing) for each in own)
        inside: dict[str, Coverage] = {}
        width: dict[str, float] = {}
        for method in common_methods(own):
            one = coverage(
                [
                    np.abs(each.error_nm(method)[each.standing]) <= each.sigma_nm[method][each.standing]
                    for each in own
                ]
            )
            if one is not None:
                inside[method] = one
                width[method] = float(
                    np.mean(np.concatenate([each.sigma_nm[method][each.standing] for each in own]))
                )
        count = sum(int(np.count_nonzero(each.standing)) for each in own)
        found[number] = Standstill(count / total, inside, width)
    return found


def _curve(samples: Sequence[Samples], method: str) -> dict[float, Coverage]:
    points = {level: covered(samples, method, level) for level in LEVELS}
    return {level: point for level, point in points.items() if point is not None}


def _quadrant(index: int) -> Keep:
    return lambda each: each.quadrant == index


WINDOW_S: Final = 0.02
LIMIT_NM: Final = 0.2
VELOCITY_BAND_RAD_S: Final = 0.02
"""Twice the standstill threshold: outside of it the joint moves for every method."""
TORQUE_BAND_NM: Final = 0.3
"""Above the sensor's noise: its zero is crossed once, not twenty times."""


class Crossing(NamedTuple):
    """A change of sign: sample `start` is the first within the band, `at` the first that is for good on the other side
    of zero, `end` the first beyond the band.
    """

    start: int
    at: int
    end: int


class Jump(NamedTuple):
    """The largest jump [Nm] of one method and where it was; median over all `crossings`; largest one unshifted.

    elsewhere_nm: what one in `crossings` windows anywhere in motion exceeds: as much is noise and dynamics, not crossing.
    """

    nm: float
    run: str
    number: int
    time_s: float
    of: str
    crossings: int
    median_nm: float
    unshifted_nm: float
    elsewhere_nm: float


def crossings(values: FloatArray, band: float) -> list[Crossing]:
    """Return the changes of sign of values [n], with a hysteresis of +-band."""
    side = np.where(values > band, 1, np.where(values < -band, -1, 0))
    outside = np.flatnonzero(side)
    changed = np.flatnonzero(side[outside[:-1]] != side[outside[1:]])
    found = []
    for before, after in zip(outside[changed], outside[changed + 1], strict=True):
        inside = values[before : after + 1]
        last = np.flatnonzero(inside * side[before] >= 0.0)[-1]  # after it the old side is not seen again
        found.append(Crossing(int(before) + 1, int(before + last) + 1, int(after)))
    return found


def jumps_around(estimate_nm: FloatArray, sensor_nm: FloatArray, width: int, shift: int = 0) -> FloatArray:
    """Return the jump over the `width` samples around each sample [n]; NaN at the ends and where the estimate has gaps.

    width: odd; shift: samples by which the sensor's window may lie to either side.
    """
    jump = np.full(len(estimate_nm), np.nan)
    if len(estimate_nm) < width:
        return jump
    own, allowed = (np.ptp(sliding_window_view(each, width), axis=1) for each in (estimate_nm, sensor_nm))
    if shift:
        allowed = sliding_window_view(np.pad(allowed, shift, mode="edge"), 2 * shift + 1).max(axis=1)
    jump[width // 2 : width // 2 + len(own)] = own - allowed
    return jump


def largest_jump(samples: Iterable[Samples], method: str, *, passage: bool = False) -> Jump | None:
    """Return the largest jump of a method over all crossings of all runs; None where nothing is crossed."""
    found: list[tuple[float, Samples, int, str]] = []
    unshifted, elsewhere = [], []
    for each in samples:
        if method not in each.estimate_nm:
            continue
        reach = round(0.5 * WINDOW_S / float(np.median(np.diff(each.time_s))))
        estimate = each.estimate_nm[method]
        jump = jumps_around(estimate, each.sensor_of(method), 2 * reach + 1, reach)
        strict = jumps_around(estimate, each.sensor_of(method), 2 * reach + 1)
        elsewhere.append(jump[each.scored & np.isfinite(jump)])
        for of, one in _all_crossings(each):
            inside = slice(one.at, one.at + 1)
            if passage:
                inside = slice(max(one.start - reach, 0), one.end + reach + 1)
            if np.isfinite(jump[inside]).any():
                at = inside.start + int(np.nanargmax(jump[inside]))
                found.append((float(jump[at]), each, at, of))
                unshifted.append(float(np.nanmax(strict[inside])))
    if not found:
        return None
    size, each, at, of = max(found, key=lambda item: item[0])
    median = float(np.median([item[0] for item in found]))
    anywhere = np.concatenate(elsewhere)
    beyond = float(np.quantile(anywhere, 1.0 - 1.0 / len(found))) if len(anywhere) else np.nan
    time_s = float(each.time_s[at])
    return Jump(size, each.run, each.number, time_s, of, len(found), median, max(unshifted), beyond)


def _all_crossings(samples: Samples) -> list[tuple[str, Crossing]]:
    """Return the crossings of both quantities; where the observer was not running the velocity counts as zero."""
    velocity = np.nan_to_num(samples.velocity_rad_s)
    return [
        *(("v = 0", one) for one in crossings(velocity, VELOCITY_BAND_RAD_S)),
        *(("tau = 0", one) for one in crossings(samples.sensor_nm, TORQUE_BAND_NM)),
    ]
