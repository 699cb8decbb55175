"""The runs as the statistics see them: signals, binned residuals, regressors of the library's candidates, nuisances.

`usable_signals` takes what is usable from the run tables and refuses the rest with reasons; `build_dataset` makes
everything of it that the search, the refinement and the maps share.

Runs that are segments of one recording share its offset, its friction of the day and its errors, and count once: a
held-out run shows nothing while another piece of the same recording is still there.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import permutations, product
from typing import Any, Final

import numpy as np
from scipy.sparse.csgraph import connected_components

from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.estimator.effects import EFFECTS
from jtqd.estimator.effects.effect import MOTOR, TORSION, Effect, ScalarFunctions, State, Values
from jtqd.estimator.joint import Joint
from jtqd.estimator.run import RunTable
from jtqd.estimator.text import counted
from jtqd.sysid.diagnosis.findings import EVERYTHING, JointName, Scope
from jtqd.sysid.diagnosis.limits import RELEVANCE
from jtqd.sysid.diagnosis.regressors import (
    ChannelData,
    EffectCandidate,
    Family,
    RunData,
    Sums,
    bin_samples,
    contribution,
    families,
    run_data,
    samples_in,
    saturated_residuals,
)
from jtqd.sysid.diagnosis.signals import (
    SLOWEST_RAD_S,
    BaseLoss,
    Channel,
    JointSignals,
    Line,
    SignalsError,
    about_zero,
    joint_signals,
    with_one_sensor,
    without_held,
)
from jtqd.sysid.diagnosis.structure import HZ_STEP, STRONG_LINE, View, frequency_lines, order_lines, sharpened
from jtqd.sysid.runs.bad_samples import held_values, saturation_limits
from jtqd.sysid.runs.channels import Channels

FEWEST_RUNS: Final = 2
"""Recordings: one is held out."""
SHORTEST_MOVING_S: Final = 5.0
"""Time in motion of all runs."""
SLOWEST_HZ: Final = 50.0
"""Sampling rate: friction near reversals and ripple are lost below."""
ORDER_STEP_S: Final = 0.002
"""Bins in which whole orders are looked for: the motor turns a fraction of a wave."""
_SIDELOBES: Final = 0.25
"""Distance of orders within which a peak belongs to a stronger line."""
_MOST_LINES: Final = 4
"""Lines of a channel that become regressors."""
_DRAWS: Final = 6
"""Fixed-point steps to the current that a file with effects draws."""
_NAMED: Final = re.compile(r"(?P<of>.+) \((?P<piece>\d+) of (?P<all>\d+)\)")
_LOST_S: Final = 1.0
"""Gap between the stamps of two pieces of one recording, at most: a recorder's restart takes longer."""

SETTLED_S: Final = 0.1
"""After the stage went off: the current dies away, and what it twisted springs back. Left out at the other end too."""
DRIFT: Final = 0.1 * RELEVANCE
"""Of the rated torque over G Kt: what the zero of a current sensor may change by between the reading and the motion. All
readings of a joint together are no more certain than this.
"""


@dataclass(frozen=True)
class Reading:
    """What the current of a joint reads without power in one run [A], less what the joint file knows of it; noise_a: its
    standard deviation by noise alone; drift_a: what all readings of the joint may have in common beside the motion.
    """

    current_a: float
    noise_a: float
    drift_a: float


Readings = Mapping[int, Reading]
"""One run's, by the number of the joint."""
UnpoweredColumn = tuple[JointName, int, float]
"""Joint, column, what it reads without power [A]."""


@dataclass(frozen=True)
class Dataset:
    """All runs of one diagnosis.

    Attributes:
        signals: [run][joint]. runs: the same binned, each at its own rate, to bins of step_s seconds.
        candidates: of the library, columns numbered. families: of nuisances.
        recordings: number of the recording that each run is a piece of.
        readings: per run what the current reads without power.
        no_torque: no torque was measured, the reference is a known load or a model's.
        events: what is not valid in `runs` only because it is an event, per channel and run [n].
    """

    signals: list[list[JointSignals]]
    runs: list[RunData]
    candidates: list[EffectCandidate]
    step_s: float
    families: list[Family]
    recordings: Sequence[int]
    readings: Sequence[Readings]
    events: Mapping[Channel, Sequence[BoolArray]] = field(default_factory=dict)
    no_torque: bool = False
    disturbed: Sequence[list[JointSignals]] = ()
    trust: Mapping[str, float] = field(default_factory=dict)

    @property
    def joints(self) -> dict[int, Joint]:
        """The joint files by number, their own effects taken off the residuals already."""
        return {s.number: s.joint for s in self.signals[0]}

    @property
    def rated_torque_nm(self) -> float:
        """The largest of the joints."""
        return max(joint.rated_torque_nm for joint in self.joints.values())

    @cached_property
    def unexplained(self) -> dict[Channel, list[FloatArray]]:
        """What none of the candidates explains, per channel and run [n]."""
        return {c: saturated_residuals(self.runs, c, self.candidates) for c in self.runs[0].channels}

    def of(self, channel: Channel) -> list[ChannelData]:
        """Return a channel of every run."""
        return [run.channels[channel] for run in self.runs]

    def shown(self, channel: Channel, parts: Sequence[FloatArray]) -> list[FloatArray]:
        """Return a residual [run][n] with NaN where its channel is neither valid nor in an event."""
        valid = [d.valid for d in self.of(channel)]
        if channel in self.events:
            valid = [a | b for a, b in zip(valid, self.events[channel], strict=True)]
        return [np.where(v, x, np.nan) for v, x in zip(valid, parts, strict=True)]

    def without_events(self, events: Mapping[Channel, View]) -> Dataset:
        """Return the runs with these events taken for not valid."""
        runs, hidden = [], {c: list(e.masks) for c, e in events.items()}
        for r, run in enumerate(self.runs):
            channels = dict(run.channels)
            for channel, masks in hidden.items():
                d = channels[channel]
                masks[r] = masks[r] & d.valid
                channels[channel] = replace(d, valid=d.valid & ~masks[r])
            runs.append(replace(run, channels=channels))
        return replace(self, runs=runs, events=hidden)


def usable_signals(
    runs: Sequence[tuple[str, RunTable]],
    joints: Mapping[int, Joint],
    numbers: Sequence[int],
    known_loads: Collection[int] = (),
    like: Iterable[JointSignals] = (),
    *,
    as_recorded: bool = False,
) -> tuple[list[list[JointSignals]], list[str]]:
    """Return the signals [run][joint] of the usable runs, and why others cannot be used. known_loads: joints whose torque is
    computed and no sensor's; like: signals of the same runs whose filters are used (`joint_signals`); as_recorded: whatever
    is known of such a torque.
    """
    same = {(s.run, s.number): s for s in like}
    if not numbers:
        return [], ["found no joint that is in both the runs and the joint files"]
    out: list[list[JointSignals]] = []
    reasons: list[str] = []
    bases = {n: BaseLoss(joints[n]) for n in numbers}
    limits = saturation_limits((table for _, table in runs), {n: joints[n] for n in numbers}, known_loads)
    for name, table in runs:
        rate = 1.0 / float(np.median(np.diff(table.time_s)))
        if rate < SLOWEST_HZ:
            reasons.append(f"{name}: found {rate:.3g} samples per second, expected at least {SLOWEST_HZ:.0f}")
            continue
        mine = []
        for n in numbers:
            if n not in table.joints:
                continue
            try:
                c = Channels(table.time_s, table.joints[n], joints[n], name, n in known_loads)
                slow = n in known_loads and not as_recorded
                like_it = same.get((name, n))
                signals = joint_signals(name, table, n, joints[n], bases[n], like_it, computed=slow)
                mine.append(without_held(signals, held_values(c, limits[n])))
            except SignalsError as error:
                reasons.append(str(error))
        if mine:
            out.append([without_known_effects(s) for s in about_zero(mine, bases)])
    out, apart = with_the_same_joints(out)
    reasons += apart
    # what is stacked must be there in all runs
    lacking = {s.number for run in out for s in run if s.torsion_nm is None}
    out = [
        [replace(s, torsion_nm=None, twist_rad=None) if s.number in lacking else s for s in run]
        for run in out
    ]
    return [with_one_sensor(run) for run in out], reasons or ([] if out else ["found no usable run"])


def with_the_same_joints(
    runs: Sequence[Sequence[JointSignals]],
) -> tuple[list[list[JointSignals]], list[str]]:
    """Return the runs with the joints that all of them have, since only these can be stacked, and what is left out for that:
    runs without a joint that the others have, or a joint that few runs have, whichever leaves more of both.
    """
    each = [frozenset(s.number for s in run) for run in runs]
    if len(set(each)) <= 1:
        return [list(run) for run in runs], []
    choices = {a & b for a in each for b in each} - {frozenset()}

    def kept(joints: frozenset[int]) -> tuple[int, int]:
        return len(joints) * sum(joints <= one for one in each), len(joints)

    joints = max(sorted(choices, key=sorted), key=kept)
    stacked, reasons = [], []
    for run, there in zip(runs, each, strict=True):
        if joints <= there:
            stacked.append([s for s in run if s.number in joints])
        else:
            lacking = " and ".join(str(n) for n in sorted(joints - there))
            reasons.append(
                f"{run[0].run}: left out, because joint {lacking} of it cannot be used as in the others"
            )
    for n in sorted(frozenset().union(*each) - joints):
        usable = sum(n in there for there in each)
        reasons.append(f"joint {n}: left out, because only {usable} of {len(runs)} runs of it can be used")
    return stacked, reasons


def recordings(runs: Sequence[Sequence[JointSignals]]) -> list[int]:
    """Return the number of the recording that each run [run][joint] belongs to, from 0 in order of their first pieces.

    Pieces are known by their names ("a.csv (2 of 3)": the reader cuts a recording at its gaps), or because one begins where
    another ends. Where stamps begin at zero again, two runs are one recording only if the joint moves at the cut: many runs
    begin and end at rest in the same place.
    """
    names = [_NAMED.fullmatch(run[0].run) for run in runs]
    joined = np.zeros((len(runs), len(runs)), bool)
    for a, b in permutations(range(len(runs)), 2):
        one, two = names[a], names[b]
        same = one is not None and two is not None and one["of"] == two["of"]
        # of a recording in pieces only the last one ends, and the first begins
        may_follow = (one is None or one["piece"] == one["all"]) and (two is None or two["piece"] == "1")
        joined[a, b] = same or (may_follow and _goes_on(runs[a], runs[b]))
    labels: list[int] = connected_components(joined, directed=False)[1].tolist()
    return labels


def piece_notes(runs: Sequence[Sequence[JointSignals]]) -> list[str]:
    """Return one line per recording that came in pieces."""
    pieces: dict[int, list[str]] = {}
    for run, number in zip(runs, recordings(runs), strict=True):
        pieces.setdefault(number, []).append(run[0].run)
    return [
        f"{', '.join(names)}: pieces of one recording: they count as one run"
        for names in pieces.values()
        if len(names) > 1
    ]


def _goes_on(before: Sequence[JointSignals], after: Sequence[JointSignals]) -> bool:
    """Return whether every joint of `after` begins where it ends in `before`: position, velocity and temperature change over
    the cut by no more than they do in as many sampling steps of these runs.
    """
    gap = float(after[0].time_s[0] - before[0].time_s[-1])
    stamped, moving = 0.0 < gap <= _LOST_S, False
    steps = 1.0 + (gap / before[0].step_s if stamped else 1.0)  # one for the ends of the filter
    for one, two in zip(before, after, strict=True):
        for name in ("link_position_rad", "velocity_rad_s", "temperature_c"):
            x, y = (np.asarray(getattr(s.state, name)) for s in (one, two))
            if abs(y[0] - x[-1]) > steps * max(np.max(np.abs(np.diff(z))) for z in (x, y)):
                return False
        ends = one.state.velocity_rad_s[-1], two.state.velocity_rad_s[0]
        moving = moving or min(map(abs, ends)) > SLOWEST_RAD_S
    return stamped or moving


def too_little(signals: Sequence[Sequence[JointSignals]]) -> str | None:
    """Return why these runs [run][joint], at least one, are too few or too short for a diagnosis; None: they are not."""
    count = max(recordings(signals)) + 1
    if count < FEWEST_RUNS:
        found = counted(count, "usable run") + (" in pieces of one recording" if count < len(signals) else "")
        return f"found {found}, expected at least {FEWEST_RUNS}: a gain is measured on held-out runs"
    moving = moving_s(signals)
    if moving < SHORTEST_MOVING_S:
        in_motion = math.floor(10.0 * moving) / 10.0
        return f"found {in_motion:.1f} s in motion in all runs, expected at least {SHORTEST_MOVING_S:.0f} s"
    return None


def moving_s(signals: Sequence[Sequence[JointSignals]]) -> float:
    """Return the time in motion [s], over all joints and runs."""
    return sum(float(s.moving.sum()) * s.step_s for run in signals for s in run)


def resolution_notes(signals: Sequence[Sequence[JointSignals]]) -> list[str]:
    """Return what the resolution of the recordings costs, one line per joint: of the run where it costs most."""
    costs: dict[int, list[tuple[float, str]]] = {}
    for s in (s for run in signals for s in run if s.coarse):
        costs.setdefault(s.number, []).append((s.visible.slowest_hz, f"{s.run}: j{s.number}.{s.coarse}"))
    return [
        min(found)[1] + (f" (so in {counted(len(found), 'run')})" if len(found) > 1 else "")
        for _, found in sorted(costs.items())
    ]


def without_known_effects(s: JointSignals) -> JointSignals:
    """Return the signals less what the joint file's own effects explain, at the torsion that the encoders saw and the
    current that the simulation with them draws; the current that other effects see is that of the simulation without them.
    """
    known = [(EFFECTS[e.name], e.parameters) for e in s.joint.effects]
    left: dict[str, Any] = {MOTOR: s.motor_nm, TORSION: s.torsion_nm}
    usual = s.state.torsion_rad
    if s.twist_rad is not None:
        s.state.torsion_rad = s.twist_rad
    for _ in range(_DRAWS if known else 0):
        drawn = sum(contribution(*each, s).get(MOTOR, 0.0) for each in known)
        s.state.current_a = (s.demand_nm + drawn) / s.nm_per_a
    for each in known:
        for balance, value in contribution(*each, s).items():
            left[balance] = left[balance] - value
    s.state.torsion_rad = usual
    out = replace(s, motor_nm=left[MOTOR], torsion_nm=left[TORSION])
    out.state.current_a = out.demand_nm / s.nm_per_a
    return out


def build_dataset(
    signals: list[list[JointSignals]], joints: Mapping[int, Joint], scope: Scope = EVERYTHING
) -> Dataset:
    """Return binned residuals, candidates, unknown lines and zero readings of these runs [run][joint]."""
    every = [s for run in signals for s in run]
    step = bin_samples(every) * max(s.step_s for s in every)
    candidates = _whole_orders(signals, library_candidates(signals, joints, scope), scope)
    no_torque = bool(scope.known_references & set(joints))
    groups = families(signals, unknown_lines(signals, candidates, step), computed=no_torque)
    runs = binned_runs(signals, step, candidates, groups)
    found = recordings(signals), readings(signals)
    return Dataset(signals, runs, candidates, step, groups, *found, no_torque=no_torque)


def binned_runs(
    signals: Sequence[Sequence[JointSignals]],
    step_s: float,
    candidates: Sequence[EffectCandidate] = (),
    groups: Sequence[Family] = (),
) -> list[RunData]:
    """Return all runs in bins of step_s seconds (`run_data`)."""
    return [run_data(run, candidates, samples_in(step_s, run), groups) for run in signals]


def library_candidates(
    signals: Sequence[Sequence[JointSignals]], joints: Mapping[int, Joint], scope: Scope = EVERYTHING
) -> list[EffectCandidate]:
    """Return every term of every effect of the scope that these runs have the channels for, columns numbered."""
    out: list[EffectCandidate] = []
    for effect, s in product(EFFECTS.values(), signals[0]):
        for term in effect.terms(joints[s.number]):
            at_sensor = effect.at_sensor_of(term.basis[0])
            if at_sensor and s is not signals[0][0]:
                continue
            where: JointName = "sensor" if at_sensor else s.number
            if not scope.looks_for(effect.name, where, s.number) or not _has_channels(
                effect, signals, s.number
            ):
                continue
            shown = contribution(effect, term.basis[0], s)
            size = max((float(np.abs(v).max()) for v in shown.values()), default=0.0)
            if size > 0.0 and np.isfinite(size):
                out.append(EffectCandidate(effect, where, term, _next_column(out)))
    return out


def _next_column(candidates: Sequence[EffectCandidate]) -> int:
    return candidates[-1].columns.stop if candidates else 0


def _has_channels(effect: Effect, signals: Sequence[Sequence[JointSignals]], number: int) -> bool:
    """Return whether the runs have what the effect needs."""
    states = [s.state for run in signals for s in run if s.number == number]
    return all(
        np.isfinite(np.asarray(getattr(state, name), np.float64)).any()
        for state in states
        for name in effect.needs
    )


def _whole_orders(
    signals: Sequence[Sequence[JointSignals]], candidates: Sequence[EffectCandidate], scope: Scope
) -> list[EffectCandidate]:
    """Return the candidates and waves at whole orders that stand out of the residual's order spectrum, of effects that may
    have any.
    """
    out = list(candidates)
    coarsest = max(s.step_s for run in signals for s in run)
    step = coarsest * max(1, round(ORDER_STEP_S / coarsest))
    bare = binned_runs(signals, step)
    for effect, s in product((e for e in EFFECTS.values() if e.whole_orders), signals[0]):
        if not scope.looks_for(effect.name, s.number, s.number):
            continue
        channel = Channel(s.number, "motor")
        parts = [np.where(r.channels[channel].valid, r.channels[channel].residual, np.nan) for r in bare]
        mine = (c for c in candidates if c.key == (effect.name, s.number))
        there = {round(c.term.basis[0]["order_per_motor_rev"]) for c in mine}
        orders = np.array(effect.whole_orders, np.float64)
        for line in order_lines(bare, {channel: parts}, step, orders)[:_MOST_LINES]:
            order = round(line.order)
            term = effect.term_of_order(float(order))
            if term is not None and order not in there:
                out.append(EffectCandidate(effect, s.number, term, _next_column(out)))
                there.add(order)
    return out


def unknown_lines(
    signals: Sequence[Sequence[JointSignals]], candidates: Sequence[EffectCandidate], step_s: float
) -> list[Line]:
    """Return strong lines of the residuals at orders and frequencies that no candidate has; no sidelobes of others."""
    bare = binned_runs(signals, step_s)
    residuals = {c: saturated_residuals(bare, c) for c in bare[0].channels}
    known = [(c.joint, c.term.basis[0].get("order_per_motor_rev", math.inf)) for c in candidates]
    out: list[Line] = []
    for line in order_lines(bare, residuals, step_s):
        there = [o.order for o in out if o.channel == line.channel]
        there += [order for joint, order in known if joint == line.channel.joint]
        near = any(abs(order - line.order) < _SIDELOBES for order in there)
        if line.ratio > STRONG_LINE and not near:
            out.append(sharpened(line, bare, residuals[line.channel], step_s))
    hz = [line for line in frequency_lines(bare, residuals, step_s) if line.ratio > STRONG_LINE]
    # one vibration of the frame or the sensor, in every channel that shows it
    return [*out[:_MOST_LINES], *(line for line in hz if abs(line.order - hz[0].order) <= HZ_STEP)]


# Readings without power.
#
# While a joint turns, an offset of the current and an asymmetric friction are the same torque in every sample. With the
# power stage off (column `jN.enabled`) no current flows, whatever friction does: what is read then is the current sensor's
# own error, which only effects of the current measurement (hook `current_a`) explain. So each run with such a rest adds one
# row per joint to its normal equations: reading / sigma = sum over effects of current_a(effect, no current) / sigma + noise
# of unit variance.


def reading(s: JointSignals) -> Reading | None:
    """Return the reading of one joint in one run, None without a rest without power that is long enough."""
    if s.off is None or not s.off.any():
        return None
    edge = round(SETTLED_S / s.step_s)
    bounds = np.flatnonzero(np.diff(np.concatenate(([0], s.off.astype(np.int8), [0]))))
    rests = [
        s.current_a[first:last]
        for first, last in zip(bounds[::2] + edge, bounds[1::2] - edge, strict=True)
        if last - first >= edge
    ]
    if not rests:
        return None
    current = np.concatenate(rests)
    noise = float(np.std(current)) / math.sqrt(len(current))
    known = sum(unpowered(EFFECTS[e.name], e.parameters, s.joint) for e in s.joint.effects)
    rated_a = s.joint.rated_torque_nm / s.nm_per_a
    return Reading(float(np.mean(current)) - known, noise, DRIFT * rated_a)


def readings(signals: Sequence[Sequence[JointSignals]]) -> list[Readings]:
    """Return the readings of every run."""
    return [{s.number: found for s in run if (found := reading(s)) is not None} for run in signals]


def unpowered(effect: Effect, p: Values, joint: Joint) -> float:
    """Return what the effect makes the current of a joint read without current and at rest [A]."""
    if "current_a" not in effect.hooks:
        return 0.0
    rest = State(**dict.fromkeys(State.__slots__, 0.0))
    return float(effect.current_a(p, rest, joint, ScalarFunctions()))


def with_readings(
    sums: Sequence[Sums], found: Sequence[Readings], columns: Sequence[UnpoweredColumn]
) -> list[Sums]:
    """Return the runs' normal equations with a row for every reading; columns: what they read (`unpowered_columns`)."""
    counts = Counter(number for run in found for number in run)
    out = []
    for one, run in zip(sums, found, strict=True):
        gram = one.gram
        for number, r in run.items():
            row = np.zeros(len(gram))
            for where, column, of in columns:
                if where == number:
                    row[column] += of
            row[-1] += r.current_a
            # the drift is common to all readings of the joint: however many there are, it stays
            row /= np.hypot(r.noise_a, r.drift_a * np.sqrt(counts[number]))
            gram = gram + np.outer(row, row)
        out.append(Sums(gram, one.rows + len(run)) if run else one)
    return out


def unpowered_columns(
    candidates: Sequence[EffectCandidate], joints: Mapping[int, Joint]
) -> list[UnpoweredColumn]:
    """Return what the search's columns read without power, those that read something."""
    out = [
        (c.joint, column, unpowered(c.effect, p, joints[c.joint]))
        for c in candidates
        if "current_a" in c.effect.hooks and isinstance(c.joint, int)
        for column, p in zip(c.columns, c.term.basis, strict=True)
    ]
    return [each for each in out if each[-1]]
