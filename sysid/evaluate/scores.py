"""Scores of an evaluation: errors, intervals, jumps at a change of quadrant, plateaus, and ours outside its envelope.

Errors: samples of runs and joints are pooled, every sample counts alike; errors in percent are relative to each joint's own
rated torque. Tables are per method and joint, run, quadrant and velocity.

Intervals: in motion value +- z sigma, z of the normal distribution (`sysid.fit.calibration`: sigma is calibrated for
z = 1.645, 90 %); at standstill value +- sigma, which is an interval and not a standard deviation.

Truth: emulated runs have the torque of the gear. The sensor has noise, an offset of the day and the links' inertia in it; an
interval that holds the sensor may be too wide for the torque, so intervals are scored against the torque where a run has it
(`for_intervals`). `now`: against the torque at the same instant, the delay of the estimate is an error, as for a controller.
`aligned`: against the torque through the filter of the method's delay, as the tables against the sensor.

Jumps at v = 0 and at tau = 0:

    jump = R(estimate) - max R(sensor),      R: max - min over 20 ms

The torque's own change in that time does not count against the estimate, and a spike that comes and goes is not missed.
The maximum is over the sensor's windows shifted by up to 10 ms: the torque of a reversing joint swings by 10 Nm in 20 ms,
and an estimate that follows it 2 ms late is late and does not jump. `unshifted_nm` is without that allowance. At the
crossing: the 20 ms around it. Over the passage: the largest of any 20 ms of the whole passage through |v| <= 0.02 rad/s (or
|tau| <= 0.3 Nm), entry and exit of the standstill status included, however long the joint rested.

Plateaus (section IV.A) are detected in the data (`sysid.fit.plateaus`). Their means run over whole ripple periods, so that
the error is that of the loss and not the ripple.

Outside is defined by the envelope of load and temperature: |motor torque| beyond the last cell of its map that any speed
has, or a temperature beyond the range of its runs, independent of the published status.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.estimator.fusion import GAUSS
from jtqd.estimator.joint import QUADRANTS, Envelope, Joint
from jtqd.estimator.observer import low_pass
from jtqd.estimator.run import JointColumns
from jtqd.estimator.settings import METHODS
from jtqd.estimator.status import DEGRADED
from jtqd.sysid.evaluate.inputs import OURS, PAPERS_BANDWIDTH, TITLES, Samples, settings_of
from jtqd.sysid.fit.plateaus import Plateau, PlateauError, find_plateaus

# Errors ------------------------------------------------------------------------------------------------------------------

VELOCITY_EDGES_RAD_S: Final = (0.0, 0.05, 0.2, 0.5, 1.0, 2.0, math.inf)
"""Bins of |v|, joint side: creeping, the paper's slowest, slow, medium, fast, faster."""
PAPER_MSE_NM2: Final = {"tob": 10.07, "efficiency": 1.97, "network": 0.22}
"""Section IV.B of the paper, of its tested joint in velocity mode, by method."""


@dataclass(frozen=True)
class Score:
    """Of `samples` errors: mean square [Nm^2], its root [Nm] and [% of rated torque], 95th percentile and largest [Nm]."""

    samples: int
    mse_nm2: float
    rmse_nm: float
    rmse_rated_percent: float
    p95_nm: float
    max_nm: float


Row = Mapping[str, Score]
"""Scores by method."""


def score(samples: Sequence[Samples], method: str) -> Score | None:
    """Return the score of a method over the scored samples of joints and runs; None where one lacks it, or without any."""
    if any(method not in each.estimate_nm for each in samples):
        return None
    errors = [each.scored_error_nm(method) for each in samples if each.scored.any()]
    if not errors:
        return None
    error = np.concatenate(errors)
    share = np.concatenate([each.scored_error_nm(method) / each.rated_nm for each in samples])
    mse = float(np.mean(error * error))
    return Score(
        len(error),
        mse,
        math.sqrt(mse),
        100.0 * math.sqrt(float(np.mean(share * share))),
        float(np.quantile(np.abs(error), 0.95)),
        float(np.abs(error).max()),
    )


def row(samples: Sequence[Samples]) -> Row:
    """Return the score of every method that all of the samples have."""
    scores = {method: score(samples, method) for method in common_methods(samples)}
    return {method: value for method, value in scores.items() if value is not None}


def common_methods(samples: Iterable[Samples]) -> tuple[str, ...]:
    """Return the methods that all of the samples have, in TITLES' order."""
    sets = [set(each.estimate_nm) for each in samples]
    return tuple(method for method in TITLES if sets and all(method in one for one in sets))


def by_joint(samples: Iterable[Samples]) -> dict[int, list[Samples]]:
    """Return the samples by joint number, rising."""
    found: dict[int, list[Samples]] = {}
    for each in samples:
        found.setdefault(each.number, []).append(each)
    return dict(sorted(found.items()))


def in_quadrant(samples: Iterable[Samples], index: int) -> list[Samples]:
    """Return the samples, of which those of one quadrant (index into QUADRANTS) are scored."""
    return [each.where(each.quadrant == index) for each in samples]


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


def shown(value: float | None, form: str = ".2f", missing: str = "-") -> str:
    """Return a number as text, `missing` where there is none."""
    return missing if value is None else format(value, form)


@dataclass(frozen=True)
class ErrorTables:
    """Scores by method. joints, quadrants, velocities: by joint number (and name). runs: by (run, joint number).

    tested: only the joint in velocity mode of each run, as in the paper. both: all joints together. A method is in a row
    only where every joint of the row has it. bare_network_mse_nm2: of the paper's network without the guard around it.
    """

    tested: Row
    both: Row
    joints: Mapping[int, Row]
    quadrants: Mapping[int, Mapping[str, Row]]
    velocities: Mapping[int, Mapping[str, Row]]
    bare_network_mse_nm2: Mapping[str, float | None]
    runs: Mapping[tuple[str, int], Row]


def error_tables(samples: Sequence[Samples], velocity_joints: Mapping[str, int | None]) -> ErrorTables:
    """Return the tables of some runs; velocity_joints: by run, None where it is not known."""
    tested = [each for each in samples if velocity_joints.get(each.run) == each.number]
    quadrants: dict[int, dict[str, Row]] = {}
    velocities: dict[int, dict[str, Row]] = {}
    for number, part in by_joint(samples).items():
        quadrants[number] = {name: row(in_quadrant(part, k)) for k, name in enumerate(QUADRANTS)}
        velocities[number] = {
            bin_name(k): row([each.where(velocity_bins(each.velocity_rad_s) == k) for each in part])
            for k in range(len(VELOCITY_EDGES_RAD_S) - 1)
        }
    return ErrorTables(
        tested=row(tested),
        both=row(samples),
        joints={number: row(part) for number, part in by_joint(samples).items()},
        quadrants=quadrants,
        velocities=velocities,
        bare_network_mse_nm2={"tested": _bare(tested), "both": _bare(samples)},
        runs={(each.run, each.number): row([each]) for each in samples},
    )


def _bare(samples: Sequence[Samples]) -> float | None:
    """MSE [Nm^2] of the paper's network without the guard around it; None where a joint has none."""
    parts = [(each.bare_nm - each.sensor_nm)[each.scored] for each in samples]
    error = np.concatenate(parts) if parts else np.zeros(0)
    return float(np.mean(error * error)) if len(error) and np.isfinite(error).all() else None


def median_run(samples: Sequence[Samples]) -> Samples | None:
    """Return the run in the middle by the MSE of ours (else of the last method there is): the lower one of two."""
    methods = common_methods(samples)
    if not methods:
        return None
    method = OURS if OURS in methods else methods[-1]
    scored = [(one.mse_nm2, each.run, each) for each in samples if (one := score([each], method))]
    scored.sort(key=lambda item: item[:2])
    return scored[(len(scored) - 1) // 2][2] if scored else None


# Intervals ---------------------------------------------------------------------------------------------------------------

NOMINAL: Final = 0.9
ALLOWED: Final = (0.87, 0.93)
"""Coverage that counts as 90 %."""
LEVELS: Final = {0.5: 0.6744897501960817, 0.8: 1.2815515655446004, 0.9: GAUSS, 0.95: 1.959963984540054}
"""Nominal coverage -> half width in standard deviations of the normal distribution."""


@dataclass(frozen=True)
class Coverage:
    """Share of `samples` whose interval holds the sensor; se: standard error of it, from run to run, NaN for one run."""

    samples: int
    runs: int
    share: float
    se: float

    def __str__(self) -> str:
        """E.g. "91.3 % +- 1.2"; without the standard error where there is none."""
        beside = f" +- {100.0 * self.se:.1f}" if math.isfinite(self.se) else ""
        return f"{100.0 * self.share:.1f} %{beside}"


def coverage(inside: Sequence[BoolArray]) -> Coverage | None:
    """Return the coverage of runs, each an array [n] of whether a sample is inside; None when there is no sample.

    Samples of one run share its offset and its friction and are right or wrong together: the standard error is that of a
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


def covered(samples: Sequence[Samples], method: str = OURS, level: float = NOMINAL) -> Coverage | None:
    """Return how often value +- z(level) sigma holds the sensor, over scored samples."""
    return coverage(
        [
            np.abs(each.scored_error_nm(method)) <= LEVELS[level] * each.sigma_nm[method][each.scored]
            for each in samples
        ]
    )


@dataclass(frozen=True)
class IntervalTables:
    """Coverage of the intervals of `method`. overall, joints, quadrants: at 90 %. curve: nominal -> observed, by joint and,
    under "both", of all joints.
    """

    method: str
    overall: Coverage
    joints: Mapping[int, Coverage]
    quadrants: Mapping[int, Mapping[str, Coverage]]
    curve: Mapping[int | str, Mapping[float, Coverage]]


def interval_tables(samples: Sequence[Samples]) -> IntervalTables | None:
    """Return the coverage of ours over runs; None where it has no scored sample."""
    own = [each for each in samples if OURS in each.estimate_nm]
    overall = covered(own)
    if overall is None:
        return None
    joints: dict[int, Coverage] = {}
    quadrants: dict[int, dict[str, Coverage]] = {}
    curve: dict[int | str, dict[float, Coverage]] = {"both": _curve(own)}
    for number, part in by_joint(own).items():
        one = covered(part)
        if one is None:
            continue
        joints[number], curve[number] = one, _curve(part)
        by_quadrant = {name: covered(in_quadrant(part, k)) for k, name in enumerate(QUADRANTS)}
        quadrants[number] = {name: value for name, value in by_quadrant.items() if value is not None}
    return IntervalTables(OURS, overall, joints, quadrants, curve)


def _curve(samples: Sequence[Samples]) -> dict[float, Coverage]:
    points = {level: covered(samples, level=level) for level in LEVELS}
    return {level: point for level, point in points.items() if point is not None}


@dataclass(frozen=True)
class Standstill:
    """Standing samples of one joint: their share of all samples; coverage and mean half width [Nm] by method."""

    share: float
    coverage: Mapping[str, Coverage]
    half_width_nm: Mapping[str, float]


def standstill(samples: Sequence[Samples]) -> dict[int, Standstill]:
    """Return coverage and width of the intervals of a standing joint, by joint."""
    found = {}
    for number, own in by_joint(samples).items():
        inside: dict[str, Coverage] = {}
        width: dict[str, float] = {}
        for method in common_methods(own):
            half = [each.sigma_nm[method][each.standing] for each in own]
            errors = [each.error_nm(method)[each.standing] for each in own]
            one = coverage([np.abs(e) <= h for e, h in zip(errors, half, strict=True)])
            if one is not None:
                inside[method], width[method] = one, float(np.mean(np.concatenate(half)))
        standing = sum(int(np.count_nonzero(each.standing)) for each in own)
        found[number] = Standstill(standing / sum(len(each.standing) for each in own), inside, width)
    return found


# Truth -------------------------------------------------------------------------------------------------------------------


def for_intervals(samples: Samples) -> Samples:
    """Return samples whose `sensor_of` an interval is to hold: the true torque, aligned, where the run has it.

    Else the sensor, and sigma of ours grows by the sensor's offset, which the comparison contains: at standstill, where
    sigma is a half width of so many standard deviations, by as many.
    """
    if samples.true_nm is not None:
        return _aligned(samples, samples.true_nm)
    wider = samples.reference_nm * np.where(samples.standing, samples.standstill_sigmas, 1.0)
    sigma = {
        method: values if METHODS[settings_of(method).method].sigma_has_floor else np.hypot(values, wider)
        for method, values in samples.sigma_nm.items()
    }
    return replace(samples, sigma_nm=sigma)


def _aligned(samples: Samples, true_nm: FloatArray) -> Samples:
    """Return samples with the true torque in place of the sensor, through the filter of each method's delay."""
    dt = np.diff(samples.time_s, prepend=samples.time_s[0])
    own = {m: low_pass(true_nm, dt, samples.bandwidth_rad_s[m]) for m in samples.sensors_nm}
    return replace(samples, sensor_nm=low_pass(true_nm, dt, PAPERS_BANDWIDTH), sensors_nm=own)


@dataclass(frozen=True)
class TruthTables:
    """Scores of all methods by joint, now and aligned; intervals of ours, standstill by joint: aligned."""

    now: Mapping[int, Row]
    aligned: Mapping[int, Row]
    intervals: IntervalTables | None
    standstill: Mapping[int, Standstill]


def truth_tables(samples: Sequence[Samples]) -> TruthTables | None:
    """Return the scores of the samples that have the truth; None where none has."""
    known = [(each, each.true_nm) for each in samples if each.true_nm is not None]
    if not known:
        return None
    now = [replace(each, sensor_nm=true, sensors_nm={}) for each, true in known]
    aligned = [_aligned(each, true) for each, true in known]
    return TruthTables(
        {number: row(part) for number, part in by_joint(now).items()},
        {number: row(part) for number, part in by_joint(aligned).items()},
        interval_tables(aligned),
        standstill(aligned),
    )


# Jumps -------------------------------------------------------------------------------------------------------------------

WINDOW_S: Final = 0.02
LIMIT_NM: Final = 0.2
VELOCITY_BAND_RAD_S: Final = 0.02
"""Twice the standstill threshold: outside of it the joint moves for every method."""
TORQUE_BAND_NM: Final = 0.3
"""Above the sensor's noise: zero is crossed once, not twenty times."""


class Crossing(NamedTuple):
    """A change of sign: sample `start` is the first within the band, `at` the first that is for good on the other side
    of zero, `end` the first beyond the band.
    """

    start: int
    at: int
    end: int


@dataclass(frozen=True)
class Jump:
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
        last = np.flatnonzero(inside * side[before] >= 0.0)[-1]  # the last sample on the old side
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


# Constant velocity -------------------------------------------------------------------------------------------------------

PAPER_WORST_PERCENT: Final = 27.6
"""Classical TOB, back drive, 2.5 rad/s, 30 Nm (section IV.A)."""
WORST_VELOCITY_RAD_S: Final = (2.4, 2.6)
WORST_TORQUE_NM: Final = (25.0, 35.0)
"""Counts as "2.5 rad/s and 30 Nm": no plateau has just that torque, because currents are commanded."""
NO_LOAD: Final = 0.05
"""Share of rated torque below which an error relative to the torque has no meaning."""
WHOLE: Final = 0.9
"""Share of a plateau's samples at which every method must have a value."""
CONSTANT_SHARE: Final = 0.25
"""Share of a run's moving time in plateaus from which on the run is one at constant velocity."""
_MOVING_RAD_S: Final = 0.05


@dataclass(frozen=True)
class PlateauScore:
    """One plateau of one joint; drive: forward or back, for this joint; errors: mean error by method [Nm].

    percent: of the plateau's torque, None next to no load. rated_percent: of rated torque.
    """

    run: str
    number: int
    start_s: float
    end_s: float
    drive: str
    velocity_rad_s: float
    current_a: float
    torque_nm: float
    rated_nm: float
    errors_nm: Mapping[str, float]
    percent: Mapping[str, float | None] = field(init=False)
    rated_percent: Mapping[str, float] = field(init=False)

    def __post_init__(self) -> None:
        size = {method: 100.0 * abs(error) for method, error in self.errors_nm.items()}
        torque = abs(self.torque_nm)
        loaded = torque >= NO_LOAD * self.rated_nm
        object.__setattr__(
            self, "percent", {method: each / torque if loaded else None for method, each in size.items()}
        )
        object.__setattr__(
            self, "rated_percent", {method: each / self.rated_nm for method, each in size.items()}
        )


def plateaus_of(name: str, time_s: FloatArray, columns: JointColumns, joint: Joint) -> list[Plateau]:
    """Return the plateaus of a joint in a run; none where nothing settled."""
    try:
        return find_plateaus(time_s, columns, joint, name)
    except PlateauError:
        return []


def is_constant(plateaus: Sequence[Plateau], samples: Samples) -> bool:
    """Return whether a run is at constant velocity: plateaus take a large share of its moving time."""
    speed = np.abs(np.nan_to_num(samples.velocity_rad_s))
    steps = np.diff(samples.time_s, prepend=samples.time_s[0])
    moving_s = float(np.sum(steps[speed > _MOVING_RAD_S]))
    return moving_s > 0.0 and sum(p.end_s - p.start_s for p in plateaus) >= CONSTANT_SHARE * moving_s


def plateau_scores(plateaus: Iterable[Plateau], samples: Samples) -> tuple[list[PlateauScore], list[str]]:
    """Return the scores of the plateaus of a run, and one line for each plateau at which a method had no value."""
    found, lost = [], []
    for plateau in plateaus:
        inside = slice(*np.searchsorted(samples.time_s, (plateau.start_s, plateau.end_s)).tolist())
        kept = samples.scored[inside]
        share = float(np.mean(kept)) if len(kept) else 0.0
        if share < WHOLE:
            lost.append(
                f"{samples.run}: j{samples.number}: found a value of every method at {100 * share:.0f} % of the plateau "
                f"from {plateau.start_s:.2f} to {plateau.end_s:.2f} s, expected {100 * WHOLE:.0f} %: plateau not scored"
            )
            continue
        found.append(
            PlateauScore(
                samples.run,
                samples.number,
                plateau.start_s,
                plateau.end_s,
                "forward" if plateau.current.value * plateau.velocity.value > 0.0 else "back",
                plateau.velocity.value,
                plateau.current.value,
                float(np.mean(samples.sensor_nm[inside][kept])),
                samples.rated_nm,
                {m: float(np.mean(samples.error_nm(m)[inside][kept])) for m in samples.estimate_nm},
            )
        )
    return found, lost


def hardest_plateaus(plateaus: Iterable[PlateauScore]) -> list[PlateauScore]:
    """Return the back-driven plateaus at about 2.5 rad/s and 30 Nm, where the paper's TOB is worst."""
    return [
        each
        for each in plateaus
        if each.drive == "back"
        and WORST_VELOCITY_RAD_S[0] <= abs(each.velocity_rad_s) <= WORST_VELOCITY_RAD_S[1]
        and WORST_TORQUE_NM[0] <= abs(each.torque_nm) <= WORST_TORQUE_NM[1]
    ]


def worst_plateau(
    plateaus: Iterable[PlateauScore], method: str, key: str
) -> tuple[float, PlateauScore] | None:
    """Return the largest `percent` or `rated_percent` (key) of a method and its plateau; None where no plateau has one."""
    sized = [(value, each) for each in plateaus if (value := getattr(each, key).get(method)) is not None]
    return max(sized, key=lambda item: item[0], default=None)


def speed_groups(plateaus: Iterable[PlateauScore]) -> dict[tuple[str, float], list[PlateauScore]]:
    """Return the plateaus by drive and |velocity| rounded to 0.1 rad/s; forward first, slow first."""
    groups: dict[tuple[str, float], list[PlateauScore]] = {}
    for each in plateaus:
        groups.setdefault((each.drive, round(abs(each.velocity_rad_s), 1)), []).append(each)
    return dict(sorted(groups.items(), key=lambda item: (item[0][0] != "forward", item[0][1])))


# Outside of the envelope -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Range:
    """Training range of a joint: motor torque, joint side [Nm], and temperature [degC], None where it had none."""

    torque_nm: tuple[float, float]
    temperature_c: tuple[float, float] | None


@dataclass(frozen=True)
class Outside:
    """Samples of one joint outside: how many of how many scored; ours and physics-only; share flagged degraded.

    physics: None where no network is there, so that ours is its physics. by_load, by_temperature: samples beyond that limit
    (some are beyond both).
    """

    number: int
    range: Range
    samples: int
    of: int
    by_load: int
    by_temperature: int
    ours: Score
    physics: Score | None
    flagged: float


def training_range(envelope: Envelope) -> Range:
    """Return the range of load and temperature of an envelope; a cell reaches half a step beyond its middle."""
    table = np.array(envelope.known)
    columns = np.flatnonzero(table.any(axis=0)) - table.shape[1] // 2
    if not len(columns):
        return Range((0.0, 0.0), envelope.temperature_c)
    low, high = (columns[0] - 0.5) * envelope.torque_step_nm, (columns[-1] + 0.5) * envelope.torque_step_nm
    return Range((float(low), float(high)), envelope.temperature_c)


def beyond(samples: Samples, limits: Range) -> tuple[BoolArray, BoolArray]:
    """Return which samples [n] are beyond the range of load, and beyond that of temperature."""
    with np.errstate(invalid="ignore"):
        load = (samples.raw_nm < limits.torque_nm[0]) | (samples.raw_nm > limits.torque_nm[1])
        if limits.temperature_c is None:
            return load, np.zeros_like(load)
        low, high = limits.temperature_c
        return load, (samples.temperature_c < low) | (samples.temperature_c > high)


def outside_scores(samples: Sequence[Samples], envelopes: Mapping[int, Envelope]) -> list[Outside]:
    """Return the scores of each joint that has an envelope and samples outside of it."""
    found = []
    for number, envelope in sorted(envelopes.items()):
        own = [each for each in samples if each.number == number and OURS in each.estimate_nm]
        limits = training_range(envelope)
        load, warm = zip(*(beyond(each, limits) for each in own), strict=True) if own else ((), ())
        outside = [each.where(a | b) for each, a, b in zip(own, load, warm, strict=True)]
        ours = score(outside, OURS)
        if ours is None:
            continue
        status = np.concatenate([each.status[OURS][each.scored] for each in outside])
        by_load, by_temperature = (
            sum(int(np.count_nonzero(each.scored & m)) for each, m in zip(outside, masks, strict=True))
            for masks in (load, warm)
        )
        of = sum(int(np.count_nonzero(each.scored)) for each in own)
        physics = score(outside, "physics")
        flagged = float(np.mean(status == DEGRADED))
        found.append(
            Outside(number, limits, ours.samples, of, by_load, by_temperature, ours, physics, flagged)
        )
    return found
