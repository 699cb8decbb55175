"""Regressors: what effects, changes from run to run and the discrepancy would leave in the residuals, binned; their sums.

A channel is one balance of one joint: up to four with two joints. An effect of joint j shows in the motor balance, the
torsion balance or both of that joint; an effect of the sensor in all channels at once.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np

from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.estimator.effects.effect import (
    MOTOR,
    TORSION,
    ArrayFunctions,
    Effect,
    ScalarFunctions,
    State,
    Term,
    Values,
)
from jtqd.estimator.joint import Joint
from jtqd.sysid.diagnosis import limits
from jtqd.sysid.diagnosis.findings import JointName, shows_at
from jtqd.sysid.diagnosis.signals import COMPUTED_HZ, SLOWEST_RAD_S, Channel, JointSignals, Line
from jtqd.sysid.diagnosis.smoothing import below, first_difference, second_difference

BIN_S: Final = 0.005
SAME_RATE: Final = 0.05
"""Part of a sample by which bins of two runs may differ: stamps are no better, and whole samples have one noise."""
LONG_S: Final = 600.0
"""Of all runs and joints together; beyond, bins grow so that memory does not."""


@dataclass(frozen=True)
class EffectCandidate:
    """One way in which one effect of one joint (or of the sensor) could be there: columns first..first+size."""

    effect: Effect
    joint: JointName
    term: Term
    first: int

    @property
    def size(self) -> int:
        """Number of columns."""
        return len(self.term.basis)

    @property
    def columns(self) -> range:
        """Their numbers."""
        return range(self.first, self.first + self.size)

    @property
    def key(self) -> tuple[str, JointName]:
        """Effect and joint, whatever the term."""
        return self.effect.name, self.joint

    @property
    def nothing(self) -> dict[str, float]:
        """Its parameters where it is not there."""
        return dict(self.term.combine([0.0] * self.size))


def relative_to(effect: Effect, p: Values, s: JointSignals) -> Joint:
    """Return the joint that parameters are relative to: with the values found, of the file for those that replace one."""
    replaces = any(q.key and q.name in p for q in effect.parameters)
    return s.joint if replaces or s.believed.joint is None else s.believed.joint


def contribution(effect: Effect, p: Values, s: JointSignals) -> dict[str, FloatArray]:
    """Return what the effect with parameters p leaves in each balance of this joint [n], Nm; absent: nothing."""
    joint, state, own, x = s.joint, s.state_of(effect, p), relative_to(effect, p, s), ArrayFunctions()
    out: dict[str, FloatArray] = {}

    def add(balance: str, value: FloatArray) -> None:
        out[balance] = out[balance] + value if balance in out else value

    hooks = effect.hooks
    if "loss_nm" in hooks:
        turns = p.get("order_per_motor_rev", 0.0) * joint.gear_ratio
        share = s.visible_share(turns * s.state.velocity_rad_s) if turns else 1.0
        add(MOTOR, effect.loss_nm(p, state, own, x) * share)
    if "current_a" in hooks:
        add(MOTOR, s.nm_per_a * effect.current_a(p, state, own, x))
    for hook, sign in (("load_nm", 1.0), ("sensor_nm", -1.0)):
        if hook in hooks:
            value = sign * getattr(effect, hook)(p, state, own, x) * np.ones(len(s.time_s))
            if s.torsion_nm is not None:  # the spring twists by it, too, and the link lags by that
                twist = s.followed(value / joint.stiffness_nm_per_rad)
                value -= joint.link_inertia_kgm2 * second_difference(twist, s.time_s)
            add(MOTOR, s.per_torque * value)
            add(TORSION, value)
    for hook in ("twist_rad", "link_rad"):
        if hook in hooks:
            angle = getattr(effect, hook)(p, state, own, x)
            add(TORSION, -joint.stiffness_nm_per_rad * angle)
            if hook == "link_rad" or effect.geometric:
                add(TORSION, -joint.damping_nms_per_rad * first_difference(angle, s.time_s))
            if hook == "link_rad" and effect.at_motor_of(p) and s.torsion_nm is not None:
                # velocity and acceleration are of that encoder; with no other one beside it, it is not looked for
                bent = second_difference(angle, s.time_s)
                inertia = joint.rotor_inertia_kgm2 * joint.gear_ratio**2
                viscous = joint.friction.viscous_nms_per_rad * first_difference(angle, s.time_s)
                add(MOTOR, (inertia + s.per_torque * joint.link_inertia_kgm2) * bent + viscous)
                add(TORSION, joint.link_inertia_kgm2 * bent)
            smooth = s.torsion_nm is not None and not effect.follows_torsion
            if hook == "twist_rad" and (effect.geometric or smooth):
                # the link's acceleration is that of the motor less tau/K (`signals`), so a twist beyond it adds its own, as
                # far as that of the torque is known: what is quicker turns the spring and not the link. Where it slips with
                # the encoders' difference, a second difference would be that of their noise
                bent = joint.link_inertia_kgm2 * second_difference(s.followed(angle), s.time_s)
                add(MOTOR, s.per_torque * bent)
                add(TORSION, bent)
    if s.torsion_nm is None:
        out.pop(TORSION, None)
    count = len(s.time_s)
    return {k: np.broadcast_to(np.asarray(v, np.float64), (count,)) for k, v in out.items()}


def fields_used(effect: Effect, p: Values, joint: Joint) -> frozenset[str]:
    """Return the fields of the state that the hooks of an effect use, "joint" where a value of the file is one, and
    "loss_per_torque" where it loads the gear.
    """
    seen: set[str] = set()

    class Recorder:
        def __getattr__(self, name: str) -> float:
            seen.add(name)
            return 0.5

    class File:
        def __getattr__(self, name: str) -> object:
            if name not in ("gear_ratio", "rated_torque_nm"):
                seen.add("joint")
            return getattr(joint, name)

    for hook in effect.hooks:
        getattr(effect, hook)(p, Recorder(), File(), ScalarFunctions())
    if any(hook in effect.hooks for hook in ("load_nm", "sensor_nm", "twist_rad", "link_rad")):
        seen.add("loss_per_torque")
    return frozenset(seen & {*State.__slots__, "joint", "loss_per_torque"})


def bin_samples(signals: Iterable[JointSignals]) -> int:
    """Return how many samples make a bin: where all is filtered, bins of what the highest cutoff leaves: there is nothing
    quicker.
    """
    total, step, highest = 0.0, 0.0, 0.0
    for s in signals:
        total += float(s.time_s[-1] - s.time_s[0])
        step = max(step, s.step_s)
        highest = max(highest, s.visible.highest_hz)
    width = max(BIN_S * max(1.0, total / LONG_S), 0.5 / highest)
    return max(1, round(width / step))


def samples_in(seconds: float, run: Sequence[JointSignals]) -> float:
    """Return how many samples of a run make a bin of so many seconds; a whole number where its rate allows."""
    samples = seconds / run[0].step_s
    whole = max(1, round(samples))
    return float(whole) if abs(samples - whole) <= SAME_RATE * whole else samples


def binned(x: FloatArray, samples: float) -> FloatArray:
    """Return means over whole bins [n // samples]; a sample that two bins share counts in each by its part."""
    count = int(len(x) / samples)
    if samples == int(samples):
        whole: FloatArray = x[: count * int(samples)].reshape(count, int(samples)).mean(axis=1)
        return whole
    middle = float(np.mean(x))
    sums = np.concatenate(([0.0], np.cumsum(x - middle)))
    ends = np.interp(_edges(count, samples), np.arange(len(sums)), sums)
    return np.asarray(middle + np.diff(ends) / samples)


def seen_in_bins(
    s: JointSignals, columns: Sequence[tuple[int, FloatArray]], samples: float
) -> tuple[Index, FloatArray]:
    """Return the numbers of columns [p], and the columns as they are seen, binned [n, p]; some at once, as
    calling a filter takes long.
    """
    out = [np.empty((int(len(s.time_s) / samples), 0))]
    for first in range(0, len(columns), _AT_ONCE):
        rows = s.visible(np.array([x for _, x in columns[first : first + _AT_ONCE]]))
        out += [binned(x, samples) for x in rows]
    return np.array([k for k, _ in columns], np.intp), np.column_stack(out)


def all_in_bin(good: BoolArray, samples: float) -> BoolArray:
    """Return whether every sample of the bin is good [n // samples], those that it shares with another too."""
    count = int(len(good) / samples)
    bad = np.concatenate(([0], np.cumsum(~good)))
    edges = _edges(count, samples)
    first, end = np.floor(edges[:-1]).astype(np.intp), np.ceil(edges[1:]).astype(np.intp)
    return np.asarray(bad[np.minimum(end, len(good))] == bad[first], np.bool_)


def _edges(count: int, samples: float) -> FloatArray:
    """Return the ends of bins in samples [count + 1]; those that are whole but for rounding are whole."""
    edges = samples * np.arange(count + 1)
    near = np.round(edges)
    return np.where(np.abs(edges - near) < 1e-6, near, edges)


Index = np.ndarray[tuple[int], np.dtype[np.intp]]
"""Numbers of bins, columns or families [n]."""


@dataclass
class ChannelData:
    """One channel of one run, binned: valid [n], residual [n], regressors [n, p] of columns `index` [p], nuisances
    [n, q] of families `families` [q]. held [n]: bins that are not valid only because a channel is held (None: no such);
    at_rest_nm: what a held channel is worth where the balance is not known anyway, one of each such bin.
    """

    valid: BoolArray
    residual: FloatArray
    regressors: FloatArray
    index: Index
    nuisances: FloatArray
    families: Index
    held: BoolArray | None = None
    at_rest_nm: FloatArray = field(default_factory=lambda: np.empty(0))


@dataclass
class RunData:
    """One run: its channels, and what the maps need per joint, binned [n]; samples: of this run to a bin."""

    name: str
    time_s: FloatArray
    channels: dict[Channel, ChannelData]
    axes: dict[int, dict[str, FloatArray]]
    samples: float = 1.0


class Family(NamedTuple):
    """A family of nuisances: what may differ from run to run without being anybody's fault, one coefficient per run.

    joint 0: common to all channels. Waves (order per motor revolution, or Hz) act in one balance: lines that are no
    effect's, found in the residual beforehand, so that no effect is bent to explain them.
    """

    name: str
    joint: int
    sigma: float
    balance: str = MOTOR
    order: float = 0.0
    hz: float = 0.0
    phase_rad: float = 0.0


_AT_ONCE: Final = 16
_AXES: Final = {
    "velocity": "velocity_rad_s",
    "load": "torque_nm",
    "temperature": "temperature_c",
    "motor_angle": "motor_position_rad",
    "link_angle": "link_position_rad",
    "time": "time_s",
    "current": "current_a",
}
"""Operating conditions, and what they are in the state."""
_ZERO: Final = 0.0025
"""Prior standard deviation of a run's own sensor zero, part of the rated torque."""
_SMOOTHING: Final = {"smoothing": 1, "smoothing_quartic": 2}
"""Of a computed torque: how often it is differentiated twice."""
OF_TORQUE: Final = ("zero", *_SMOOTHING)
"""Families of the torque, in the motor balance by what it costs there (`JointSignals.per_torque`)."""
_SMOOTHED: Final = 0.3
"""Prior standard deviation of the part that its smoothing took of it at COMPUTED_HZ."""
_SHARE: Final = {"smooth": 0.3, "viscous": 0.08, "coulomb": 0.02}
"""Prior standard deviations of a run's own friction, as parts of the joint's usual one (`usual_friction`)."""
_TORSION_ZERO: Final = 25.0
"""The same of the torsion's zero, part of the rated torque: any, as encoders are mounted."""
_LEAST_COULOMB: Final = 0.0125
_LEAST_SMOOTH: Final = 0.0025
_LEAST_VISCOUS: Final = 0.01
"""Parts of the rated torque that a usual friction is at least (viscous: at the usual speed), whatever the file has."""

LINE: Final = "line"


def families(
    runs: Sequence[Sequence[JointSignals]], lines: Sequence[Line] = (), *, computed: bool = False
) -> list[Family]:
    """Return the families of nuisances of these runs [run][joint], and of lines; scales are in proportion to the joint.

    A torque that is computed has no zero. It was smoothed instead, in a way that nobody states: to the fourth order of the
    frequency, what a filter without delay takes are second and fourth derivatives.
    """
    joints = [s.number for s in runs[0]]
    rated = {s.number: s.joint.rated_torque_nm for s in runs[0]}
    usual = {n: usual_friction([s for run in runs for s in run if s.number == n]) for n in joints}
    if computed:
        out = [Family(name, n, _SMOOTHED) for name in _SMOOTHING for n in joints]
    else:
        out = [Family("zero", 0, _ZERO * min(rated.values()))]
    out += [Family(name, n, part * usual[n][name]) for name, part in _SHARE.items() for n in joints]
    out += [Family("torsion_zero", n, _TORSION_ZERO * rated[n]) for n in joints]
    for line in lines:
        wave = {"hz": line.order} if line.unit == "Hz" else {"order": line.order}
        for phase in (0.0, 0.5 * np.pi):
            c = line.channel
            out.append(Family(LINE, c.joint, line.amplitude_nm, c.balance, phase_rad=phase, **wave))
    return out


def usual_friction(signals: Sequence[JointSignals]) -> dict[str, float]:
    """Return what friction of one joint is usual in its runs, per family: Nm, viscous Nms/rad."""
    joint = signals[0].joint
    rated, friction = joint.rated_torque_nm, joint.friction
    speed = math.sqrt(float(np.mean([np.mean(s.state.velocity_rad_s**2) for s in signals])))
    return {
        "smooth": max(friction.coulomb_nm, _LEAST_SMOOTH * rated),
        "viscous": max(friction.viscous_nms_per_rad, _LEAST_VISCOUS * rated / max(speed, SLOWEST_RAD_S)),
        "coulomb": max(friction.coulomb_nm, _LEAST_COULOMB * rated),
    }


def nuisances_of(
    s: JointSignals, balance: str, groups: Sequence[Family], names: Iterable[str] | None = None
) -> list[tuple[int, FloatArray]]:
    """Return the columns [n] of families in one channel with their numbers; names: of these alone."""
    made = [(k, _nuisance(s, balance, g)) for k, g in enumerate(groups) if names is None or g.name in names]
    return [(k, c) for k, c in made if c is not None]


def _nuisance(s: JointSignals, balance: str, family: Family) -> FloatArray | None:
    """Return the column of one family in one channel, None where it has none."""
    if family.joint not in {0, s.number}:
        return None
    if family.name == "zero" or family.name in _SMOOTHING:
        smooth = (
            family.name in _SMOOTHING
        )  # printed steps are not, and four times differentiated all that there is
        torque = below(s.reading_nm, s.step_s, 2.0 * COMPUTED_HZ) if smooth else np.ones(len(s.time_s))
        for _ in range(_SMOOTHING.get(family.name, 0)):
            torque = second_difference(torque, s.time_s) / (2.0 * math.pi * COMPUTED_HZ) ** 2
        return -torque * (s.per_torque if balance == MOTOR else 1.0)
    if family.name == LINE:
        if family.balance != balance:
            return None
        turn = family.order * s.state.motor_position_rad + 2.0 * np.pi * family.hz * s.state.time_s
        return np.asarray(np.cos(turn - family.phase_rad))
    v, d = s.state.velocity_rad_s, s.state.direction
    if balance == TORSION:
        return np.ones(len(s.time_s)) if family.name == "torsion_zero" else None
    return {"smooth": d * (1.0 - np.tanh(np.abs(v) / 0.02)), "viscous": v, "coulomb": d}.get(family.name)


def run_data(
    run: Sequence[JointSignals],
    candidates: Sequence[EffectCandidate],
    samples: float,
    groups: Sequence[Family] = (),
) -> RunData:
    """Return one run's binned residuals and regressors; `run`: its joints; groups: nuisances, the usual ones if empty."""
    groups = groups or families([run])
    made = basis_columns(run, candidates)
    channels: dict[Channel, ChannelData] = {}
    for s in run:
        for balance in (MOTOR, TORSION):
            residual = s.motor_nm if balance == MOTOR else s.torsion_nm
            if residual is None:
                continue
            channel = Channel(s.number, balance)
            valid, known = (all_in_bin(x, samples) for x in (s.usable(balance), s.known(balance)))
            index, regressors = seen_in_bins(s, made.get(channel, ()), samples)
            own, changes = seen_in_bins(s, nuisances_of(s, balance, groups), samples)
            worth = binned(s.held_nm[balance], samples) if balance in s.held_nm else np.zeros(len(known))
            channels[channel] = ChannelData(
                valid,
                binned(s.visible(residual), samples),
                regressors,
                index,
                changes,
                own,
                known & ~valid if balance in s.held else None,
                worth[(worth != 0.0) & ~known],
            )
    axes = {s.number: _axes(s, samples) for s in run}
    return RunData(run[0].run, binned(run[0].time_s, samples), channels, axes, samples)


def basis_columns(
    run: Sequence[JointSignals], candidates: Iterable[EffectCandidate]
) -> dict[Channel, list[tuple[int, FloatArray]]]:
    """Return what the columns of these candidates leave in each channel: their numbers, and values [n] in Nm."""
    out: dict[Channel, list[tuple[int, FloatArray]]] = {}
    for candidate in candidates:
        for s in (s for s in run if shows_at(candidate.joint, s.number)):
            for column, p in zip(candidate.columns, candidate.term.basis, strict=True):
                for balance, value in contribution(candidate.effect, p, s).items():
                    out.setdefault(Channel(s.number, balance), []).append((column, value))
    return out


def _axes(s: JointSignals, samples: float) -> dict[str, FloatArray]:
    """Return the operating conditions, binned; angles unwrapped. Rates of the load [Nm/s, Nm/s^2] as columns are seen;
    what a step of an angle is worth in torsion [Nm].
    """
    rates = [(1, s.state.torque_rate_nm_s), (2, second_difference(s.state.torque_nm, s.state.time_s))]
    of_load = dict(zip(_RATES, seen_in_bins(s, rates, samples)[1].T, strict=True))
    of_load[TORSION] = binned(s.rounded_nm, samples)
    return {axis: binned(getattr(s.state, name), samples) for axis, name in _AXES.items()} | of_load


_CONDITIONS: Final = ("velocity", "load", "link_angle")
_RATES: Final = ("load_rate", "load_second_rate")
_POINTS: Final = 200
"""Of the conditions, at which the eigenfunctions are found."""


def features(
    runs: Sequence[RunData], channel: Channel, rng: np.random.Generator, disturbed: Sequence[RunData] = ()
) -> list[FloatArray]:
    """Return the features of the discrepancy of one balance per run and disturbed run [n, k]: their squares add up to 1 Nm^2
    in the mean over the runs.

    The discrepancy is what the library does not hold: a Gaussian process over speed, load and angle, plain and, in the motor
    balance, in the direction of motion, as friction is; Matern 3/2, because friction has kinks. The features are its largest
    eigenfunctions over the conditions of the runs (Nystrom approximation: Williams and Seeger 2001, NIPS 13). What frame,
    gear and recorder answer with delay is, to the second order of the frequency, a part of the load's first two rates; each
    is a feature as large as the others are in the mean.
    """
    axes = [run.axes[channel.joint] for run in (*runs, *disturbed)]
    valid = [run.channels[channel].valid for run in runs]
    scaled = [_scaled(name, axes, valid) for name in _CONDITIONS]
    conditions = [np.column_stack(x) for x in zip(*scaled, strict=True)]
    known = np.vstack([x[v] if v.any() else x for x, v in zip(conditions, valid, strict=False)])
    points = known[rng.choice(len(known), min(_POINTS, len(known)), replace=False)]
    values, vectors = np.linalg.eigh(_kernel(points, points))
    largest = np.argsort(values)[::-1][: limits.FEATURES]
    weights = vectors[:, largest] / np.sqrt(np.maximum(values[largest], 1e-9))
    out = [_kernel(x, points) @ weights for x in conditions]
    if channel.balance == MOTOR:
        out = [np.hstack((f, f * np.sign(a["velocity"])[:, None])) for f, a in zip(out, axes, strict=True)]
    rates = [np.column_stack([a[name] for name in _RATES]) for a in axes]
    size = _mean_square(out, valid)
    square = np.append(np.full(len(size), np.mean(size)), _mean_square(rates, valid))
    scale = 1.0 / np.sqrt(np.where(square > 0.0, square, np.inf) * len(square))
    return [np.hstack(parts) * scale for parts in zip(out, rates, strict=True)]


def _mean_square(parts: Sequence[FloatArray], valid: Sequence[BoolArray]) -> FloatArray:
    """Return the mean square of columns over the valid bins of the runs [k]."""
    every = np.vstack([x[v] for x, v in zip(parts, valid, strict=False)])
    return np.asarray(np.sum(every**2, axis=0) / max(len(every), 1))


def _kernel(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the covariance of the process between conditions a [n, c] and b [m, c]: Matern 3/2 [n, m]."""
    square = np.sum(a * a, axis=1)[:, None] + np.sum(b * b, axis=1) - 2.0 * a @ b.T
    distance = np.sqrt(3.0 * np.maximum(square, 0.0)) / limits.LENGTH
    return np.asarray((1.0 + distance) * np.exp(-distance))


def _scaled(name: str, axes: Sequence[dict[str, FloatArray]], valid: Sequence[BoolArray]) -> list[FloatArray]:
    """Return a condition per run in deviations of the runs about their mean; about zero where its sign has a meaning."""
    known = np.concatenate([a[name][v] for a, v in zip(axes, valid, strict=False)])
    middle = float(np.mean(known)) if name == "link_angle" and len(known) else 0.0
    width = max(float(np.sqrt(np.mean((known - middle) ** 2))) if len(known) else 0.0, 1e-9)
    return [(a[name] - middle) / width for a in axes]


# Noise and normal equations.
#
# What a model leaves is slow for the most part, and small where it is quick. That it is small there proves neither that the
# model is right there to the same part nor that the noise is: whitening would let the quick errors of a simulation decide
# which slow cause is named. So every row of a channel has the same weight, as under independence, and its variance is that
# which sums over a second have per row: estimates are those of least squares, and intervals are as wide as correlation in
# time makes them (Liang and Zeger 1986, Biometrika 73: independence as the working covariance).

_BLOCK_S: Final = 1.0


class Noise(NamedTuple):
    """Noise of the channels: standard deviation of each [Nm]; inflation: how many rows count as one, of all; repeats: what
    the equations are exact to, as a variance per row [Nm^2]. It is evidence for no set, and makes no size smaller.
    """

    sigma: Mapping[Channel, float]
    inflation: float
    repeats: Mapping[Channel, float]

    @property
    def random(self) -> Noise:
        """The noise without what repeats."""
        return self._replace(repeats={})


def noise_of_channels(
    residuals: Mapping[Channel, Sequence[FloatArray]],
    step_s: float,
    exact_nm: float = 0.0,
    directions: int = 1,
) -> Noise:
    """Return the noise of all channels from what is left of them [run][n], NaN where not valid. With an inflation of its own
    a channel that is fitted badly would weigh little, and stay so.

    exact_nm: what the equations are exact to, rms. It is no noise: it repeats, so bins do not average it. Spread over the
    directions that columns span, it is in each of them exact_nm^2 / directions, however many bins there are.
    """
    block = max(1, round(_BLOCK_S / step_s))
    every = {c: np.concatenate(parts) for c, parts in residuals.items()}
    sigma = {c: max(float(np.sqrt(np.nanmean(x**2))), 1e-12) for c, x in every.items()}
    slow = [_slowness(parts, sigma[c], block) for c, parts in residuals.items()]
    inflation = max(1.0, float(np.mean(slow)))
    each = exact_nm**2 / (directions * inflation)
    return Noise(sigma, inflation, {c: int(np.isfinite(x).sum()) * each for c, x in every.items()})


def _slowness(series: Sequence[FloatArray], sigma: float, block: int) -> float:
    """Return the mean square of sums over blocks against that of white noise, 1 where no block is long enough."""
    ratios = []
    for x in series:
        count = len(x) // block
        parts = x[: count * block].reshape(count, block)
        many = np.isfinite(parts).sum(axis=1)
        use = many > block // 4
        if use.any():
            ratios.append(float(np.mean(np.nansum(parts[use], axis=1) ** 2 / many[use])) / sigma**2)
    return float(np.mean(ratios)) if ratios else 1.0


class Sums(NamedTuple):
    """Normal equations of one run in units of noise: gram [P + Q + 1, P + Q + 1] over effects' columns, nuisances, residual;
    rows: how many independent measurements.
    """

    gram: FloatArray
    rows: float


def run_sums(run: RunData, noise: Noise, columns: int, nuisances: int) -> Sums:
    """Return the normal equations of one run in units of noise."""
    width = columns + nuisances + 1
    gram = np.zeros((width, width))
    rows = 0.0
    for channel, d in run.channels.items():
        block = np.column_stack((d.regressors, d.nuisances, d.residual))[d.valid]
        places = np.concatenate((d.index, columns + d.families, [width - 1])).astype(np.intp)
        variance = noise.sigma[channel] ** 2 + noise.repeats.get(channel, 0.0)
        gram[np.ix_(places, places)] += block.T @ block / (variance * noise.inflation)
        rows += len(block) / noise.inflation
    return Sums(gram, rows)


def saturated_residuals(
    runs: Sequence[RunData], channel: Channel, candidates: Iterable[EffectCandidate] = ()
) -> list[FloatArray]:
    """Return what no effect and no change from run to run explains, per run [n], NaN where not valid.

    The residual is a sum of measured terms (current, friction, acceleration, sensor); with a regressor for each of them it
    would be explained completely by taking all of them away. So a gain of the sensor, of these candidates, is none.
    """
    leave = [k for c in candidates if c.effect.scales_all for k in c.columns]
    data = [run.channels[channel] for run in runs if channel in run.channels]
    keep = np.flatnonzero(~np.isin(data[0].index, leave))
    q = data[0].nuisances.shape[1]
    p = len(keep)
    total = p + q * len(data)
    gram, right = np.zeros((total, total)), np.zeros(total)
    blocks = []
    for r, d in enumerate(data):
        x = np.hstack((d.regressors[:, keep], d.nuisances))[d.valid]
        places = np.concatenate((np.arange(p), p + q * r + np.arange(q)))
        gram[np.ix_(places, places)] += x.T @ x
        right[places] += x.T @ d.residual[d.valid]
        blocks.append(places)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(gram), 1e-30))
    scaled = gram * scale[:, None] * scale[None, :]
    solution = scale * np.linalg.solve(scaled + 1e-7 * np.eye(total), scale * right)
    out = []
    for places, d in zip(blocks, data, strict=True):
        rest = d.residual - np.hstack((d.regressors[:, keep], d.nuisances)) @ solution[places]
        out.append(np.where(d.valid, rest, np.nan))
    return out
