"""Detect plateaus of a run: stretches of settled velocity and load, with their means and standard errors.

Means over cells of whole ripple periods (`cut_cells`) are compared: a harmonic drive's ripple has 2 periods per motor
revolution, and a mean over whole ones does not contain it. The longest stretch of cells in which velocity, torque and motor
torque G Kt i each stay within a band is a plateau; then the longest of the remaining cells, and so on. The settling at its
ends is cut off. Marks, set-points and derivatives of noisy signals are not used.

Standard errors are those of means of coloured noise: the standard deviation without the ripple over the square root of
the effective number of samples, by their autocorrelation. Noise with a memory of a twentieth of the plateau still gets
an error that is right within a third; at a tenth it is 1.7 times too small, because such slow noise looks
like a change of level. A channel that moves by less than its own resolution is known to resolution/sqrt(12), not better.

Fit Coulomb and viscous friction of a joint to plateaus at no load.

    G Kt i - tau = Fc s(v) + Fv v + offset          s(v): the estimator's smooth direction, v = omega_m/G

A plateau is at no load when the motor carries next to no current (the other joint drives) or the output next to no torque.
The offset of current and sensor does not change sign with the direction, which separates it from friction when the joint
moved both ways. With one direction the offset is taken as 0 and the report has a warning. The Stribeck peak is the joint
file's.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import Friction, Joint
from jtqd.estimator.losses import FrictionModel
from jtqd.estimator.run import JointColumns
from jtqd.estimator.text import counted
from jtqd.sysid.progress import progress
from jtqd.sysid.runs.channels import integral
from jtqd.sysid.runs.run_file import RunFile

SAME_VELOCITY_RAD_S: Final = 0.03
"""Plateaus closer than this are at the same velocity."""
RIPPLE_ORDERS: Final = (1.0, 2.0, 4.0)
"""Orders per motor revolution that are removed from the samples before their noise is estimated."""


class PlateauError(ValueError):
    """A run lacks a column, or nothing in it settled; one line: found and expected."""


SHORTEST_S: Final = 0.5
"""Plateaus, unless the caller asks for shorter ones."""
_FEWEST_CELLS: Final = 3
_SLOWEST_RAD_S: Final = 0.05
"""Joint side; below it the Stribeck range begins."""
_CELL_S: Final = 0.1
_LONGEST_CELL_S: Final = 1.0
"""A joint whose ripple period takes longer is too slow to be averaged."""
_RIPPLE_PER_MOTOR_REV: Final = 2.0
_VELOCITY_BAND_RAD_S: Final = 0.005
_VELOCITY_BAND: Final = 0.01
"""Width of the band of a plateau's velocity, absolute and as a share of it; the wider one counts."""
_LOAD_BAND: Final = 0.01
_LOAD_BAND_MOST: Final = 0.05
"""Width of the band of torque and motor torque, parts of rated torque; where the noise from cell to cell is larger the band
follows it, up to the latter."""


@dataclass(frozen=True)
class Mean:
    """A mean over a plateau and its standard error."""

    value: float
    se: float


@dataclass(frozen=True)
class Plateau:
    """Averages over one settled stretch of one joint.

    velocity [rad/s] joint side, current [A], torque [Nm] as measured; temperature [degC], NaN where not measured.
    """

    run: str
    start_s: float
    end_s: float
    velocity: Mean
    current: Mean
    torque: Mean
    cells: int
    temperature_c: float = math.nan


def find_plateaus(
    time_s: FloatArray, run: JointColumns, joint: Joint, name: str = "", shortest_s: float = SHORTEST_S
) -> list[Plateau]:
    """Return the plateaus of one joint in one run, in order of time.

    time_s [n] rising; run: current, motor velocity and measured torque [n] are needed (`RunTable.joint` derives a
    missing velocity); joint: gear ratio, torque constant and rated torque are used. `name` goes into the plateaus.

    Raises:
        PlateauError: a column is missing, or nothing settled.
    """
    current, omega_m, torque = _needed_columns(run, name)
    nm_per_a = joint.gear_ratio * joint.torque_constant_nm_per_a
    speed = omega_m / joint.gear_ratio
    cells = cut_cells(time_s, (speed, torque, nm_per_a * current), omega_m)
    found, longest_s = _stretches(cells, joint.rated_torque_nm, shortest_s)
    if not found:
        raise PlateauError(
            f"{name}: found no settled plateau (longest settled stretch {longest_s:.2f} s), expected velocity and load "
            f"constant for {shortest_s:g} s while the joint moves at {_SLOWEST_RAD_S:g} rad/s or more"
        )
    angle = integral(time_s, omega_m)
    plateaus = []
    for first, last in found:
        start_s, end_s = float(cells.start_s[first]), float(cells.end_s[last - 1])
        inside = slice(*np.searchsorted(time_s, (start_s, end_s)).tolist())
        whole = np.array([start_s]), np.array([end_s])
        velocity_mean, current_mean, torque_mean = (
            Mean(
                float(means_between(time_s, signal, *whole)[0]), standard_error(signal[inside], angle[inside])
            )
            for signal in (speed, current, torque)
        )
        warm = math.nan if run.temperature_c is None else float(np.mean(run.temperature_c[inside]))
        count = last - first
        plateaus.append(Plateau(name, start_s, end_s, velocity_mean, current_mean, torque_mean, count, warm))
    return plateaus


def _needed_columns(run: JointColumns, name: str) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return current, motor velocity and measured torque [n]. Raises PlateauError naming what is missing."""
    columns = {key: getattr(run, key) for key in ("current_a", "motor_velocity_rad_s", "torque_nm")}
    missing = [key for key, column in columns.items() if column is None]
    if missing:
        raise PlateauError(
            f"{name}: found no {', '.join(missing)}, expected current, motor velocity and measured torque"
        )
    return columns["current_a"], columns["motor_velocity_rad_s"], columns["torque_nm"]


def mean_temperature(plateaus: Iterable[Plateau]) -> float:
    """Return the mean temperature of the plateaus [degC], NaN where none has one."""
    known = [plateau.temperature_c for plateau in plateaus if math.isfinite(plateau.temperature_c)]
    return float(np.mean(known)) if known else math.nan


def standard_error(samples: FloatArray, motor_angle_rad: FloatArray) -> float:
    """Return the standard error of the mean of samples [n] over whole ripple periods, under coloured noise.

    motor_angle_rad [n]: for the ripple, which is taken out before the noise is judged.
    """
    residual = samples - samples.mean()
    angles = [order * (motor_angle_rad - motor_angle_rad[0]) for order in RIPPLE_ORDERS]
    ripple = np.column_stack([f(a) for a in angles for f in (np.cos, np.sin)])
    residual = residual - ripple @ np.linalg.lstsq(ripple, residual, rcond=None)[0]
    # the mean is from the same samples: n_eff - 1 degrees of freedom
    independent = max(effective_samples(residual) - 1.0, 1.0)
    return max(float(np.std(residual)) / math.sqrt(independent), _resolution_error(samples))


def effective_samples(residual: FloatArray) -> float:
    """Independent samples in a residual [n]: n / (1 + 2 sum rho_k), up to the first rho_k < 0.05."""
    centred = residual - residual.mean()
    count = len(centred)
    spectrum = np.fft.rfft(centred, 2 * count)
    correlation = np.fft.irfft(spectrum * np.conj(spectrum))[:count]
    if correlation[0] <= 0.0:
        return float(count)
    rho = correlation / correlation[0]
    below = np.flatnonzero(rho < 0.05)
    end = int(below[0]) if len(below) else count
    return max(1.0, count / (1.0 + 2.0 * float(np.sum(rho[1:end]))))


def _resolution_error(samples: FloatArray) -> float:
    """resolution/sqrt(12) where the signal is too quiet to be dithered over its own steps, else 0."""
    values = np.unique(samples)
    if len(values) == 1:
        return 0.0  # a single value does not show its own resolution
    step = float(np.min(np.diff(values)))
    return step / math.sqrt(12.0) if float(np.std(samples)) < 0.5 * step else 0.0


def _stretches(cells: Cells, rated_nm: float, shortest_s: float) -> tuple[list[tuple[int, int]], float]:
    """Plateaus as (first, last + 1) of cells, in order of time; and the length [s] of the longest stretch of all."""
    found: list[tuple[int, int]] = []
    longest_s = 0.0
    reach = _reach(cells, _load_bands(cells, rated_nm))
    todo = [(0, len(cells.means))]
    while todo:
        low, high = todo.pop()
        if low >= high:
            continue
        ends = np.minimum(reach[low:high], high)
        lengths = cells.end_s[ends - 1] - cells.start_s[low:high]
        lengths[ends <= np.arange(low, high)] = 0.0  # a cell that is no plateau even by itself
        first = low + int(np.argmax(lengths))
        last = int(ends[first - low])
        longest_s = max(longest_s, float(lengths.max()))
        if float(lengths.max()) < shortest_s:
            continue
        todo += [(low, first), (last, high)]
        first, last = _trimmed(cells.means, first, last, rated_nm)
        long_enough = cells.end_s[last - 1] - cells.start_s[first] >= shortest_s
        fast_enough = abs(float(np.mean(cells.means[first:last, 0]))) >= _SLOWEST_RAD_S
        if last - first >= _FEWEST_CELLS and long_enough and fast_enough:
            found.append((first, last))
    return sorted(found), longest_s


def _load_bands(cells: Cells, rated_nm: float) -> FloatArray:
    """Widths [2] of the band in Nm for torque and motor torque: _LOAD_BAND, or of the noise from cell to cell."""
    moving = cells.usable & (np.abs(cells.means[:, 0]) >= _SLOWEST_RAD_S)
    # Third differences suppress a drift and a slow swing, and have sqrt(20) times the noise of the cells.
    # The lowest fifth: cells of a transition are no noise, and in a run of short holds they are many.
    steps = np.abs(np.diff(cells.means[:, 1:], n=3, axis=0))
    steps = steps[moving[3:] & moving[2:-1] & moving[1:-2] & moving[:-3]]
    if not len(steps):
        return np.full(2, _LOAD_BAND * rated_nm)
    # 20 % of a normal are within 0.2533 sigma; 8 sigma hold a hundred cells of one plateau
    noise = np.quantile(steps, 0.2, axis=0) / (0.2533 * math.sqrt(20.0))
    result: FloatArray = np.clip(8.0 * noise, _LOAD_BAND * rated_nm, _LOAD_BAND_MOST * rated_nm)
    return result


def _reach(cells: Cells, load_bands: FloatArray) -> NDArray[np.intp]:
    """For each cell k the end (exclusive) of the longest stretch from k on that stays within all bands."""
    count = len(cells.means)
    reach = np.arange(count)
    moving = (cells.usable & (np.abs(cells.means[:, 0]) >= 0.5 * _SLOWEST_RAD_S)).tolist()
    rows = cells.means.tolist()
    torque_band, motor_band = load_bands.tolist()
    for first in range(count):
        v_low, t_low, m_low = v_high, t_high, m_high = rows[first]
        velocity_band = max(_VELOCITY_BAND_RAD_S, _VELOCITY_BAND * abs(v_low))
        last = first
        while last < count and moving[last]:
            v, t, m = rows[last]
            v_low, t_low, m_low = min(v, v_low), min(t, t_low), min(m, m_low)
            v_high, t_high, m_high = max(v, v_high), max(t, t_high), max(m, m_high)
            if v_high - v_low > velocity_band or t_high - t_low > torque_band or m_high - m_low > motor_band:
                break
            last += 1
        reach[first] = last
    return reach


def _trimmed(means: FloatArray, first: int, last: int, rated_nm: float) -> tuple[int, int]:
    """Cut the cells at both ends that differ from the rest by more than its noise: the end of the settling."""
    while last - first >= 3:
        inside = means[first:last]
        middle = np.median(inside, axis=0)
        noise = 1.4826 * np.median(np.abs(inside - middle), axis=0)
        floor = np.array((0.001 * abs(middle[0]), 0.001 * rated_nm, 0.001 * rated_nm))
        far = np.any(np.abs(inside - middle) > 4.0 * np.maximum(noise, floor), axis=1)
        if not far[0] and not far[-1]:
            break
        first, last = first + int(far[0]), last - int(far[-1])
    return first, last


def plateaus_of(
    runs: Sequence[RunFile], number: int, joint: Joint, shortest_s: float = SHORTEST_S
) -> list[Plateau]:
    """Return the plateaus of one joint in all runs; a run without any is named on standard error.

    Raises:
        PlateauError: of the first run, when no run has a plateau. RunTableError: a run does not have the joint.
    """
    plateaus: list[Plateau] = []
    unsettled = []
    for run in progress(runs, "finding plateaus"):
        columns = run.table.joint(number, joint.gear_ratio)
        try:
            plateaus += find_plateaus(run.table.time_s, columns, joint, run.name, shortest_s)
        except PlateauError as error:
            unsettled.append(error)
    if not plateaus:
        raise unsettled[0]
    for reason in unsettled:
        print(f"jtq fit: {reason}", file=sys.stderr)
    return plateaus


class Cells(NamedTuple):
    """Consecutive cells: means [n, m] of m signals, edges [n] in s, and whether a cell may be used [n].

    Not usable: cells of a joint so slow that a ripple period takes longer than it may; they are cut by time instead.
    """

    means: FloatArray
    start_s: FloatArray
    end_s: FloatArray
    usable: NDArray[np.bool_]


def cut_cells(time_s: FloatArray, signals: Sequence[FloatArray], motor_velocity_rad_s: FloatArray) -> Cells:
    """Cut a run [n] into cells of as many whole ripple periods as take at least _CELL_S.

    time_s rising, steps may be uneven; the angle is the motor velocity's integral, so that positions that roll over or
    are not measured do not matter.
    """
    distance = integral(time_s, np.abs(motor_velocity_rad_s))
    periods = distance * _RIPPLE_PER_MOTOR_REV / math.tau
    starts, ends, usable = [], [], []
    start, last = float(time_s[0]), float(time_s[-1])
    while start + _CELL_S <= last:
        at, ahead = np.interp((start, start + _CELL_S), time_s, periods).tolist()
        end = _time_of(at + max(1, math.ceil(ahead - at - 1e-9)), time_s, periods)
        good = end - start <= _LONGEST_CELL_S
        if not good:
            end = start + _CELL_S
        starts.append(start)
        ends.append(end)
        usable.append(good)
        start = end
    edges = np.array(starts), np.array(ends)
    means = np.array([means_between(time_s, signal, *edges) for signal in signals])
    return Cells(means.T, *edges, np.array(usable, np.bool_))


def means_between(
    time_s: FloatArray, signal: FloatArray, start_s: FloatArray, end_s: FloatArray
) -> FloatArray:
    """Return the means [m] of a signal [n] over [start, end] (each [m]), samples at the ends taken in part."""
    area = integral(time_s, signal)
    result: FloatArray = np.interp(end_s, time_s, area) - np.interp(start_s, time_s, area)
    return result / (end_s - start_s)


def _time_of(period: float, time_s: FloatArray, periods: FloatArray) -> float:
    """When the given number of ripple periods has passed; infinity if it never does."""
    index = int(np.searchsorted(periods, period))
    if index >= len(periods):
        return math.inf
    share = (period - periods[index - 1]) / (periods[index] - periods[index - 1])
    return float(time_s[index - 1] + share * (time_s[index] - time_s[index - 1]))


COULOMB: Final = "coulomb_nm"
VISCOUS: Final = "viscous_nms_per_rad"
OFFSET: Final = "zero_nm"
NO_LOAD_SHARE: Final = 0.05
"""Share of rated torque that still counts as no load."""
FEWEST_VELOCITIES: Final = 3


class FitError(ValueError):
    """The run cannot serve for the fit; one line with the reason."""


@dataclass(frozen=True)
class Term:
    """One term of the fit: value and half width of its 95 % interval."""

    name: str
    value: float
    ci95: float


def student_975(freedom: float) -> float:
    """0.975 quantile of Student's t (Abramowitz and Stegun 26.7.5); within 2 % from a freedom of 3 on."""
    z = 1.959964
    return (
        z
        + (z**3 + z) / (4.0 * freedom)
        + (5.0 * z**5 + 16.0 * z**3 + 3.0 * z) / (96.0 * freedom**2)
        + (3.0 * z**7 + 19.0 * z**5 + 17.0 * z**3 - 15.0 * z) / (384.0 * freedom**3)
    )


@dataclass(frozen=True)
class NoLoadFit:
    """Friction for the joint file, its terms with the offset, RMS residual [Nm], number of plateaus."""

    friction: Friction
    terms: tuple[Term, ...]
    rmse_nm: float
    plateaus: int
    warnings: tuple[str, ...]

    def lines(self) -> list[str]:
        """Return the report, one fact per line."""
        lines = [f"{term.name} = {term.value:.4g}  +- {term.ci95:.2g} (95 %)" for term in self.terms]
        lines.append(f"residual {self.rmse_nm:.3f} Nm RMS over {self.plateaus} plateaus at no load")
        return lines + [f"warning: {text}" for text in self.warnings]


def no_load(plateaus: Sequence[Plateau], joint: Joint, current_max_a: float) -> list[Plateau]:
    """Return the plateaus with |i| <= current_max_a [A] or next to no torque."""
    torque_max = NO_LOAD_SHARE * joint.rated_torque_nm
    return [p for p in plateaus if abs(p.current.value) <= current_max_a or abs(p.torque.value) <= torque_max]


def fit_no_load(plateaus: Sequence[Plateau], joint: Joint) -> NoLoadFit:
    """Fit Coulomb and viscous friction to plateaus at no load; gear ratio and torque constant are taken as true.

    Raises:
        FitError: fewer than three velocities, or a friction that would drive the joint.
    """
    velocity = np.array([p.velocity.value for p in plateaus])
    speeds = np.sort(np.abs(velocity))
    distinct = int(np.count_nonzero(np.diff(speeds, prepend=-1.0) > SAME_VELOCITY_RAD_S))
    if distinct < FEWEST_VELOCITIES:
        raise FitError(
            f"found {counted(distinct, 'velocity', 'velocities')} at no load ({counted(len(plateaus), 'plateau')}), "
            f"expected at least {FEWEST_VELOCITIES}: the other joint drives this joint at zero current"
        )
    nm_per_a = joint.gear_ratio * joint.torque_constant_nm_per_a
    none = replace(joint.friction, coulomb_nm=0.0, viscous_nms_per_rad=0.0)
    peak = FrictionModel(none).torque_many(velocity)
    loss = np.array([nm_per_a * p.current.value - p.torque.value for p in plateaus]) - peak
    columns = {
        COULOMB: FrictionModel(Friction(1.0, 0.0)).torque_many(velocity),
        VISCOUS: FrictionModel(Friction(0.0, 1.0)).torque_many(velocity),
    }
    warnings = []
    if bool(np.any(velocity > 0.0)) and bool(np.any(velocity < 0.0)):
        columns[OFFSET] = np.ones_like(velocity)
    else:
        warnings.append(
            "all motion is in one direction: Coulomb friction includes the offsets of current and sensor"
        )
    matrix = np.column_stack(list(columns.values()))
    values = np.linalg.lstsq(matrix, loss, rcond=None)[0]
    residual = loss - matrix @ values
    freedom = max(len(loss) - len(values), 1)
    covariance = float(residual @ residual) / freedom * np.linalg.inv(matrix.T @ matrix)
    widths = student_975(freedom) * np.sqrt(np.diag(covariance))
    terms = tuple(Term(n, float(v), float(w)) for n, v, w in zip(columns, values, widths, strict=True))
    negative = [term for term in terms[:2] if term.value < 0.0]
    if negative:
        raise FitError(
            f"found {negative[0].name} = {negative[0].value:.3g} +- {negative[0].ci95:.2g}, expected a friction >= 0: "
            "swapped sign of current, torque or velocity, or a wrong gear ratio"
        )
    friction = replace(
        joint.friction, coulomb_nm=round(terms[0].value, 4), viscous_nms_per_rad=round(terms[1].value, 4)
    )
    rmse = math.sqrt(float(np.mean(residual**2)))
    return NoLoadFit(friction, terms, rmse, len(loss), tuple(warnings))
